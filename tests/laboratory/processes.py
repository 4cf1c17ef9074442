"""Time processes side by side: each computes a number of frames in turn, and answers with seconds."""

import json
import os
import pathlib
import subprocess
import sys
from collections.abc import Sequence
from statistics import mean
from time import perf_counter, sleep
from typing import Any

ROOT = pathlib.Path(__file__).parents[2]
PATIENCE = 600.0  # [s] to wait for a process to end
REST = 0.02  # [s] before a turn: OpenMP's threads poll for work for some milliseconds, on the cores of the next process


class Talker:
    """A process that answers lines with lines of JSON. ask() raises RuntimeError, with the end of its errors, if it died."""

    def __init__(self, command: Sequence[str], **environment: str):
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


def started(module: str, job: dict[str, Any], cache: str = "", **environment: str) -> Talker:
    """Start a process that times the import of job["import"] (default: tiverlet), and runs main(job, seconds) of a module here.

    cache: the folder in which Taichi or Quadrants stores compiled kernels. The module is imported after the timed import.
    """
    code = f"""
import importlib, json, sys, time
clock = time.perf_counter()
importlib.import_module({job.get("import", "tiverlet")!r})
seconds = time.perf_counter() - clock
from tests.laboratory.{module} import process
process(json.loads(sys.argv[1]), seconds)
"""
    keeps = {f"{of}_OFFLINE_CACHE{what}": value for of in ("TI", "QD") for what, value in (("", "1"), ("_FILE_PATH", cache))}
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    words = [sys.executable, "-P", "-c", code, json.dumps(job)]
    return Talker(words, PYTHONPATH=path, **(keeps if cache else {}), **environment)


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


def answer(frame, restart_, quality_, start: dict[str, Any], more=lambda word: None) -> None:
    """Run the process of a scene: say `start`, then answer the commands of side_by_side() and quality().

    frame(): computes one. restart_(): restores the start. quality_(): returns the figures of quality(). more(word): answers other
    words. What an engine itself prints goes to stderr.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(what: Any) -> None:
        """Print one answer, a line of JSON."""
        print(json.dumps(what), file=answers, flush=True)

    say(start)
    for line in sys.stdin:
        word, *number = line.split()
        if word == "run":
            clock = perf_counter()
            for _ in range(int(number[0])):
                frame()
            say(perf_counter() - clock)
        elif word == "restart":
            restart_()
            frame()
            say(0.0)
        else:
            say(quality_() if word == "quality" else more(word))
