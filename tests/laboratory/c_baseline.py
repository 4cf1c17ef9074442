"""The pile written by hand in C, compiled at run time."""

import os
import pathlib
import shutil
import subprocess

from .processes import Talker

SOURCE = pathlib.Path(__file__).with_name("pile.c")
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fopenmp")


def build(folder) -> tuple[str | None, str]:
    """Return the program and the command that compiled it, or None and the reason."""
    names = [name for name in (os.environ.get("CC"), "gcc", "cc", "clang") if name]
    compiler = next((found for name in names if (found := shutil.which(name))), None)
    if compiler is None:
        return None, f"no C compiler is on the path ({', '.join(names)})"
    program = os.path.join(folder, "pile")
    command = [compiler, *FLAGS, str(SOURCE), "-lm", "-o", program]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        return None, f"{' '.join([pathlib.Path(compiler).name, *FLAGS])} fails: {' '.join(done.stderr.split())[:200]}"
    return program, " ".join([pathlib.Path(compiler).name, *FLAGS])


def started(program: str, n: int, substeps: int, threads: int) -> Talker:
    """Start the program on n discs; see pile.c for its commands."""
    # Each thread has its own core, like Taichi's: Linux wakes threads on one core, and takes milliseconds to move them.
    return Talker([program, str(n), str(substeps)], OMP_NUM_THREADS=str(threads), OMP_PROC_BIND="true")
