"""Workers of a sweep: this process, processes that the sweep starts, or a user's executor."""

import contextlib
import multiprocessing
import os
import pickle
import signal
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from multiprocessing import connection
from typing import Any, Protocol

from .. import checks
from ..device import runtime
from .part import Job, Lost, Outcome, Part, compute, compute_in_worker, format_call


class Workers(Protocol):
    """Computes parts, in any order. Only finished() waits."""

    @property
    def name(self) -> str:
        """The name for messages."""
        ...

    @property
    def free(self) -> bool:
        """Whether it accepts a part now."""
        ...

    @property
    def busy(self) -> bool:
        """Whether a part is unfinished."""
        ...

    def begin(self, part: Part) -> None:
        """Accept a part."""
        ...

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for at least one part, and return the finished parts."""
        ...

    def close(self) -> None:
        """Stop unfinished parts."""
        ...


class ThisProcess:
    """Computes one part at a time, in this process."""

    name = "this process"

    def __init__(self, job: Job):
        self._job = job
        self._part: Part | None = None

    @property
    def free(self) -> bool:
        """Whether it accepts a part now."""
        return self._part is None

    @property
    def busy(self) -> bool:
        """Whether a part is unfinished."""
        return self._part is not None

    def begin(self, part: Part) -> None:
        """Accept a part."""
        self._part = part

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Compute the part."""
        part, self._part = self._part, None
        return [(part, compute(self._job, part))] if part else []

    def close(self) -> None:
        """Do nothing: no part runs between calls."""


class _Process:
    """A process that computes one part after the other, and sends over a pipe which world it makes."""

    def __init__(self, context: Any, job: bytes, threads: int):
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, job, threads), daemon=True)
        self.process.start()
        theirs.close()  # so that the pipe closes when the process ends
        self.part: Part | None = None
        self.at: int | None = None  # number of the world being made; -1 after the last

    def begin(self, part: Part) -> None:
        """Send a part to the process."""
        self.part, self.at = part, None
        with contextlib.suppress(OSError):  # if the process died, receive() finds the pipe closed
            self.pipe.send(part)

    def receive(self) -> Outcome | Lost | None:
        """Return the outcome of its part; None while the part is unfinished."""
        try:
            message = self.pipe.recv()
        except (EOFError, OSError):
            self.end()
            return Lost(self._death())
        if isinstance(message, int):
            self.at = message
            return None
        self.part = None
        return message

    def end(self, kill: bool = False) -> None:
        """Close the pipe, and wait for the process. kill: terminate it."""
        self.pipe.close()
        if kill:
            self.process.terminate()
        self.process.join(5)
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()

    def _death(self) -> str:
        code, part = self.process.exitcode, self.part
        how = f"ended with exit code {code}"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                how = f"was ended by {signal.Signals(-code).name}"
            how += " (perhaps because memory is short)" if code == -9 else ""
        when = 'before it began; in a script, call tv.sweep below `if __name__ == "__main__":`'
        if self.at is not None and part:
            making = f"in {format_call(part.rows[self.at - part.first])}, number {self.at}"
            when = making if self.at >= 0 else "after all worlds were made"
        return f"worker process {self.process.pid} {how} {when}"


class Processes:
    """Processes that the sweep starts, each with a share of the cores; spawned, since Taichi does not survive a fork."""

    name = "another process"

    def __init__(self, count: int, job: bytes):
        self._count, self._job = count, job
        self._context = multiprocessing.get_context("spawn")
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = max(1, cores // count)
        self._all: list[_Process] = []

    @property
    def free(self) -> bool:
        """Whether it accepts a part now."""
        return len(self._all) < self._count or any(p.part is None for p in self._all)

    @property
    def busy(self) -> bool:
        """Whether a part is unfinished."""
        return any(p.part is not None for p in self._all)

    def begin(self, part: Part) -> None:
        """Accept a part."""
        idle = next((p for p in self._all if p.part is None), None)
        if idle is None:
            idle = _Process(self._context, self._job, self._threads)
            self._all.append(idle)
        idle.begin(part)

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for at least one part, and return the finished parts."""
        out = []
        while not out:
            working = {p.pipe: p for p in self._all if p.part is not None}
            for pipe in connection.wait(list(working)):
                worker = working[pipe]  # type: ignore[index]
                part, outcome = worker.part, worker.receive()
                if isinstance(outcome, Lost):
                    self._all.remove(worker)
                if outcome is not None:
                    out.append((part, outcome))
        return out

    def close(self) -> None:
        """End the processes, at once if they are computing."""
        for worker in self._all:
            worker.end(kill=worker.part is not None)
        self._all.clear()


def _serve(pipe: Any, job: bytes, threads: int) -> None:
    """Run a worker process until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the one that started the sweep ends the others
    runtime.share = threads
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(compute_in_worker(job, pipe.recv(), 0, pipe.send))


class ExecutorWorkers:
    """A user's executor with submit(). If it accepts no more parts after a loss, processes of the sweep do the rest.

    A part that ended a worker is not computed in this process, which it might end, too. The exception is a job that cannot be
    sent to processes of the sweep: then this process is the only place left.
    """

    def __init__(self, executor: Any, job: Job):
        self._executor, self._job = executor, job
        self._pool = isinstance(executor, ProcessPoolExecutor)
        # A pool of processes fails as a whole. It gets one part per process, so that few parts are lost with a worker.
        self._most: int = getattr(executor, "_max_workers", 1) if self._pool else 2**31
        self._waiting: dict[Any, Part] = {}
        self._submitted, self._lost = 0, False
        self._fallback: Workers | None = None

    @property
    def name(self) -> str:
        """The name for messages."""
        return self._fallback.name if self._fallback else "the executor"

    @property
    def free(self) -> bool:
        """Whether it accepts a part now."""
        if self._fallback:
            return not self._waiting and self._fallback.free
        return len(self._waiting) < self._most

    @property
    def busy(self) -> bool:
        """Whether a part is unfinished."""
        return bool(self._waiting) or (self._fallback is not None and self._fallback.busy)

    def begin(self, part: Part) -> None:
        """Accept a part."""
        if self._fallback is None:
            job = sent(self._job) if self._pool else self._job
            self._submitted += 1
            try:
                self._waiting[self._executor.submit(compute_in_worker, job, part, self._submitted)] = part
                return
            except Exception:
                if not self._lost:  # the executor never worked
                    raise
            self._fallback = self._make_fallback()
        self._fallback.begin(part)

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for at least one part, and return the finished parts."""
        if not self._waiting and self._fallback:
            return self._fallback.finished()
        out: list[tuple[Part, Outcome | Lost]] = []
        done = self._done()
        while done:
            future = done.pop()
            part = self._waiting.pop(future)
            try:
                out.append((part, future.result()))
            except Exception as error:
                self._lost = True
                out.append((part, Lost(f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(".: "))))
                if isinstance(error, BrokenExecutor):
                    done = list(self._waiting)  # all other parts fail with the pool
        return out

    def close(self) -> None:
        """Cancel parts that have not begun. The executor itself stays open for the user."""
        for future in self._waiting:
            with contextlib.suppress(Exception):
                future.cancel()
        if self._fallback:
            self._fallback.close()

    def _done(self) -> list[Any]:
        first = next(iter(self._waiting))
        if isinstance(first, Future):
            return list(wait(self._waiting, return_when=FIRST_COMPLETED).done)
        return [first]  # futures of other kinds are awaited one by one

    def _make_fallback(self) -> Workers:
        try:
            return Processes(min(self._most, os.cpu_count() or 1), sent(self._job))
        except TypeError:
            return ThisProcess(self._job)


def choose_workers(executor: Any, job: Job) -> tuple[Workers, int]:
    """Return the workers, and the least number of parts."""
    if executor is None:
        return ThisProcess(job), 1
    if isinstance(executor, int):
        count = checks.integer("sweep", "executor", executor, least=1)
        return Processes(count, sent(job)), count
    if isinstance(executor, type) or not callable(getattr(executor, "submit", None)):
        kind = "class, not an object" if isinstance(executor, type) else type(executor).__name__
        raise TypeError(
            f"sweep: executor = {executor!r} is a {kind}, but None, a number of processes or an object with submit() is needed, "
            "such as a ProcessPoolExecutor."
        )
    if isinstance(executor, ThreadPoolExecutor):
        raise TypeError(
            "sweep: executor is a ThreadPoolExecutor, but threads of one process share one Taichi. Leave it out: all worlds of a "
            "part are stepped on all cores; or give a number of processes."
        )
    if isinstance(executor, ProcessPoolExecutor):
        method = getattr(getattr(executor, "_mp_context", None), "get_start_method", lambda: "")()
        if method == "fork":
            raise ValueError(
                'sweep: executor forks its processes ("fork"), but Taichi hangs after a fork. Type executor=4 for four '
                'processes, or ProcessPoolExecutor(4, mp_context=multiprocessing.get_context("spawn")).'
            )
        sent(job)
    of_client = getattr(executor, "get_executor", None)  # of Dask; not pure: a failed call may be repeated
    executor = of_client(pure=False) if callable(of_client) else executor
    return ExecutorWorkers(executor, job), 1


def sent(job: Job) -> bytes:
    """Pickle a job for other processes. Raises TypeError if it cannot be pickled."""
    try:
        return pickle.dumps(job)
    except Exception as error:
        raise TypeError(
            f"sweep: make and figures must be sent to other processes, but {type(error).__name__}: {error}. Write them as "
            "functions at the top of a file (no lambda, nothing inside another function), or leave executor out."
        ) from None
