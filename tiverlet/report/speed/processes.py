"""Time processes side by side: each computes a number of frames in turn, and answers with seconds."""

import json
import os
import pathlib
import subprocess
import sys
from collections.abc import Mapping, Sequence
from statistics import mean
from time import sleep
from typing import Any

ROOT = str(pathlib.Path(__file__).parents[3])
PATIENCE = 600.0  # [s] to wait for a process to end
REST = 0.02  # [s] before a turn: OpenMP's threads poll for work for some milliseconds, on the cores of the next process


class Talker:
    """A process that answers lines with lines of JSON. ask() raises RuntimeError, with the end of its errors, if it died."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]):
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, **environment},
        )  # fmt: skip

    def ask(self, line: str = "") -> Any:
        """Send a line, unless it is empty, and wait for the answer."""
        process = self._process
        assert process.stdin and process.stdout and process.stderr
        answer = ""
        try:
            if line:
                process.stdin.write(line + "\n")
                process.stdin.flush()
            answer = process.stdout.readline()
        except BrokenPipeError:
            pass
        if not answer:
            process.stdin.close()
            said = process.stderr.read().strip()
            raise RuntimeError(f"exit status {process.wait()}: {' '.join(said.split())[-300:]}")
        return json.loads(answer)

    def __enter__(self) -> "Talker":
        return self

    def __exit__(self, *exc) -> None:
        self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
        for pipe in (self._process.stdout, self._process.stderr):
            pipe.close()  # type: ignore[union-attr]


def started(code: str, job: Any, cache: str, root: str = ROOT, **environment: str) -> Talker:
    """Start a process that runs code, with a job as its argument.

    cache: the folder in which Taichi or Quadrants stores compiled kernels. root: the folder of the package.
    """
    keeps = {f"{of}_OFFLINE_CACHE{what}": value for of in ("TI", "QD") for what, value in (("", "1"), ("_FILE_PATH", cache))}
    return Talker([sys.executable, "-P", "-c", code, json.dumps(job)], {"PYTHONPATH": paths(root), **keeps, **environment})


def world(job: Mapping[str, Any], cache: str, root: str = ROOT) -> Talker:
    """Start the process of a scene, with the package in `root`. cache: the folder in which Taichi stores compiled kernels."""
    from .child import START

    return started(START, job, cache, root)


def paths(root: str = ROOT) -> str:
    """Return the PYTHONPATH of a process: `root` first."""
    return os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])


def side_by_side(
    talkers: Sequence[Talker], frames: int, group: int, rounds: int, seconds: float, settles: int = 0
) -> list[list[float]]:  # fmt: skip
    """Return the seconds per frame of each process in each round.

    A round is a restart, then `frames` frames of each process, in alternating groups of `group`. There are at most `rounds`. None
    begins after the first process has taken `seconds` [s], or five times that for the first three rounds. settles: with it, there
    is one restart, then this many untimed frames, and each round continues from the one before.
    """
    if settles:
        restart(talkers, settles)
    out: list[list[float]] = [[] for _ in talkers]
    spent = 0.0
    while len(out[0]) < rounds and spent < seconds * (1 if len(out[0]) >= 3 else 5):
        if not settles:
            restart(talkers, 0)
        total = [0.0] * len(talkers)
        for done in range(0, frames, group):
            for k, talker in enumerate(talkers):
                sleep(REST)
                total[k] += talker.ask(f"run {min(group, frames - done)}")
        spent += total[0]
        for times, t in zip(out, total, strict=True):
            times.append(t / frames)
    return out


def restart(talkers: Sequence[Talker], settles: int) -> None:
    """Restart each process, and run `settles` untimed frames."""
    for talker in talkers:
        talker.ask("restart")
        if settles:
            talker.ask(f"run {settles}")


def quality(talker: Talker, frames: int, settles: int = 0, looks: int = 6) -> dict[str, float]:
    """Return the mean overlap [diameters] and the worst relative violation, sampled `looks` times in `frames` frames.

    The frames begin at the start, or `settles` frames later.
    """
    restart([talker], settles)
    seen = []
    for _ in range(looks):
        talker.ask(f"run {max(1, frames // looks)}")
        seen.append(talker.ask("quality"))
    touching = [s["overlap"] for s in seen if s["overlap"] > 0]
    return {"overlap": mean(touching) if touching else 0.0, "residual": max(s["residual"] for s in seen)}
