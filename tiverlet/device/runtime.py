"""Starting Taichi, and queries about the running one."""

import atexit
import contextlib
import ctypes
import numbers
import os
import pathlib
import threading
import time
from typing import Any

from . import language
from .language import ti

ARCHITECTURES = ("cpu", "cuda", "metal", "vulkan")
HELD = 60.0  # [s]: Taichi holds the lock of its cache while it reads or writes, seconds at most; an older lock was left behind
LLVM = ("cpu", "cuda")  # compiled by LLVM; for the others Taichi writes SPIR-V

_started: dict = {}  # the arguments of init(), and the process and thread that called it
trees = 0  # live trees of fields of this runtime; layout.py counts them
share: int | None = None  # the default number of CPU threads, in a process that may use only some of the cores


def init(arch: str = "cpu", threads: int | None = None, debug: bool = False, seed: int = 0) -> None:
    """Start Taichi. Optional: the first World does it with these defaults.

    arch: "cpu", "cuda", "metal" or "vulkan". One that this machine lacks is an error, never a fallback.
    threads: number of CPU threads; None for all cores. The bits of a simulation do not depend on it.
    debug: Taichi checks array bounds in kernels (slow).
    seed: of Taichi's random numbers; tiverlet itself uses none.

    If the user has started Taichi, it is used as it is. Calling init again with the same settings does nothing. Calling it with
    other settings raises RuntimeError, because a restart of Taichi would destroy the fields of every live world.
    """
    if arch not in ARCHITECTURES:
        raise ValueError(f"init: arch = {arch!r}, but it must be one of {', '.join(map(repr, ARCHITECTURES))}.")
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, numbers.Integral) or threads < 1):
        raise ValueError(f"init: threads = {threads!r}, but it must be an integer of at least 1, or None for all cores.")
    threads, seed = None if threads is None else int(threads), int(seed)  # Taichi refuses integers of NumPy
    wanted = {"arch": arch, "threads": threads, "debug": debug, "seed": seed}
    if ti.cfg is not None:
        if _started.get("runtime") is language.current() and wanted == _started["wanted"]:
            return
        raise RuntimeError(
            f"init: Taichi already runs (arch {architecture()}), and starting it again would destroy every live "
            "world's fields. Call tv.init before the first World and before any ti.init, or leave it out."
        )
    if arch != "cpu" and not language.supports(arch):
        offer = ", ".join(map(repr, available()))
        raise RuntimeError(f'init: arch "{arch}" is not available on this machine. Available: {offer}.')
    running = _threads()
    threads = threads or share
    options: dict[str, Any] = {} if threads is None else {"cpu_max_num_threads": threads}
    if arch == "cpu":  # a kernel is one task there, and each compiling thread first loads what all kernels share
        options["num_compile_threads"] = 1  # 0: the calling thread, which ends the process if it did not start Taichi
    language.start(
        arch=getattr(ti, arch), default_fp=ti.f32, fast_math=False, debug=debug, random_seed=seed, log_level=ti.ERROR, **options
    )
    if architecture() != arch:
        found = architecture()
        ti.reset()
        raise RuntimeError(f'init: arch "{arch}" was asked for, but Taichi started "{found}". Use tv.init(arch="cpu").')
    _register(wanted)
    _pin_workers(_threads() - running)


def _threads() -> set[int]:
    """Return the threads of this process, on systems that list them."""
    with contextlib.suppress(OSError):
        return {int(name) for name in os.listdir("/proc/self/task")}
    return set()


def _pin_workers(started: set[int]) -> None:
    """Pin each of Taichi's workers to a core of its own, if Taichi has a worker for every core. Taichi starts the workers last.

    Workers sleep between loops. Linux wakes the workers of a loop on one core, and moves one of them away only milliseconds
    later. Without pinning, a loop of 1.7 ms on one thread takes 1.7 ms on two; pinned, 0.9 ms. Ten short loops take 0.45 and 0.16
    ms.
    """
    with contextlib.suppress(AttributeError, OSError):
        cores, workers = sorted(os.sched_getaffinity(0)), sorted(started)[-threads() :]
        if len(workers) >= len(cores) > 1:
            for k, worker in enumerate(workers):
                os.sched_setaffinity(worker, {cores[k % len(cores)]})


def architecture() -> str:
    """Return the architecture that Taichi runs on, by the names of init()."""
    name = str(_config().arch).rsplit(".", 1)[-1]
    return "cpu" if name in ("x64", "arm64") else name


def available() -> list[str]:
    """Return the architectures that this machine and this Taichi support."""
    return [a for a in ARCHITECTURES if a == "cpu" or language.supports(a)]


def threads() -> int:
    """Return the number of CPU threads that Taichi may use."""
    return int(_config().cpu_max_num_threads)


def cores() -> int:
    """Return how many CPU threads can run at the same time; 1 if Taichi does not run on the CPU."""
    here = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(threads(), here) if architecture() == "cpu" else 1


def fast_math() -> bool:
    """Whether the running Taichi may reorder arithmetic; init() forbids it."""
    return bool(_config().fast_math)


def default_fp() -> str:
    """Return the type of plain numbers in the user's own functions: "f32" or "f64"."""
    return str(_config().default_fp)


def compiler() -> str:
    """Return the compiler that makes the machine code of kernels, Taichi or Quadrants, with version, commit and LLVM target."""
    library: Any = ti._lib
    core = library.core
    return f"{language.NAME} {core.get_version_string()} ({core.get_commit_hash()[:8]}), LLVM {core.get_llvm_target_support()}"


def wanted() -> dict[str, Any]:
    """Return the arguments of init(); empty if the user started Taichi."""
    return _started.get("wanted") or {}


def ensure_started() -> None:
    """Start Taichi with the defaults if it does not run. Raise RuntimeError where building fields would crash or hang."""
    if ti.cfg is None:
        init()
    if _started.get("runtime") is not language.current():
        _register()
    if forked():
        raise RuntimeError(
            "Taichi was started before this process was forked, and hangs in the child. Use the start method "
            '"spawn": multiprocessing.get_context("spawn").'
        )
    if _started["thread"] != threading.get_ident():
        raise RuntimeError("A World must be built in the thread that started Taichi; stepping it elsewhere is fine.")


def forked() -> bool:
    """Whether this process was forked after Taichi was started."""
    return _started["pid"] != os.getpid()


def _config() -> Any:
    return ti.cfg


def _keep_taichi_in_child() -> None:
    """In a forked child: keep Taichi from shutting down. It would wait forever for threads that only the parent has."""
    runtime = _started.get("runtime")
    if runtime is not None and runtime is language.current() and runtime.prog:
        hold = ctypes.pythonapi.Py_IncRef
        hold.argtypes = [ctypes.py_object]
        hold(runtime.prog)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_keep_taichi_in_child)


@atexit.register  # so it runs after what the user registers
def _write_cache() -> None:
    """End Taichi with the process, which writes its cache of kernels. Else it may outlive its modules, and the cache is lost."""
    runtime = _started.get("runtime")
    if runtime is not None and runtime is language.current() and runtime.prog and not forked():
        ti.reset()


def _register(wanted: dict | None = None) -> None:
    """Register the running Taichi, with the arguments of init() if init() started it."""
    global trees
    trees = 0
    _remove_old_lock()
    _started.update(runtime=language.current(), pid=os.getpid(), thread=threading.get_ident(), wanted=wanted)


def _remove_old_lock() -> None:
    """Remove the lock of Taichi's cache that a killed process left. Without a word, all later ones would compile everything."""
    with contextlib.suppress(OSError, AttributeError):  # no lock; Quadrants has other settings
        lock = pathlib.Path(_config().offline_cache_file_path, "ticache.lock")
        if time.time() - lock.stat().st_mtime > HELD:
            lock.unlink()
