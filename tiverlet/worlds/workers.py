"""Who does the parts of a sweep: this process, processes of its own, or an executor of the user's."""

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
from .part import Job, Lost, Outcome, Part, call, compute, compute_in_worker


class Workers(Protocol):
    """Does parts, in any order. Only finished() waits."""

    @property
    def name(self) -> str:
        """Who it is, for messages."""
        ...

    @property
    def free(self) -> bool:
        """Whether it takes a part now."""
        ...

    @property
    def busy(self) -> bool:
        """Whether a part is not finished yet."""
        ...

    def begin(self, part: Part) -> None:
        """Take a part."""
        ...

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for parts, at least for one."""
        ...

    def close(self) -> None:
        """End what is not finished."""
        ...


class ThisProcess:
    """Does one part at a time, here."""

    name = "this process"

    def __init__(self, job: Job):
        self._job = job
        self._part: Part | None = None

    @property
    def free(self) -> bool:
        """Whether it takes a part now."""
        return self._part is None

    @property
    def busy(self) -> bool:
        """Whether a part is not finished yet."""
        return self._part is not None

    def begin(self, part: Part) -> None:
        """Take a part."""
        self._part = part

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Do it."""
        part, self._part = self._part, None
        return [(part, compute(self._job, part))] if part else []

    def close(self) -> None:
        """Nothing is left to end."""


class _Process:
    """A process that does one part after the other, and tells over a pipe which world it makes."""

    def __init__(self, context: Any, job: bytes, threads: int):
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, job, threads), daemon=True)
        self.process.start()
        theirs.close()  # so that the pipe ends when the process does
        self.part: Part | None = None
        self.at: int | None = None  # the world that it makes; -1 when all of the part are made

    def begin(self, part: Part) -> None:
        """Send it a part to make."""
        self.part, self.at = part, None
        with contextlib.suppress(OSError):  # where it died meanwhile, the pipe will say so
            self.pipe.send(part)

    def receive(self) -> Outcome | Lost | None:
        """What became of its part; None while it goes on."""
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
        """Close the pipe, and wait for the process; `kill`: end it."""
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
            making = f"in {call(part.rows[self.at - part.first])}, number {self.at}"
            when = making if self.at >= 0 else "after all worlds were made"
        return f"worker process {self.process.pid} {how} {when}"


class Processes:
    """Processes of its own, each with a share of the cores; started anew ("spawn"), since Taichi does not survive a fork."""

    name = "another process"

    def __init__(self, count: int, job: bytes):
        self._count, self._job = count, job
        self._context = multiprocessing.get_context("spawn")
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._threads = max(1, cores // count)
        self._all: list[_Process] = []

    @property
    def free(self) -> bool:
        """Whether it takes a part now."""
        return len(self._all) < self._count or any(p.part is None for p in self._all)

    @property
    def busy(self) -> bool:
        """Whether a part is not finished yet."""
        return any(p.part is not None for p in self._all)

    def begin(self, part: Part) -> None:
        """Take a part."""
        idle = next((p for p in self._all if p.part is None), None)
        if idle is None:
            idle = _Process(self._context, self._job, self._threads)
            self._all.append(idle)
        idle.begin(part)

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for parts, at least for one."""
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
        """End them; at once where they are at work."""
        for worker in self._all:
            worker.end(kill=worker.part is not None)
        self._all.clear()


def _serve(pipe: Any, job: bytes, threads: int) -> None:
    """The main function of a worker process: until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all; the process that asked ends the others
    runtime.share = threads
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(compute_in_worker(job, pipe.recv(), 0, pipe.send))


class Given:
    """An executor with submit(), of the user's. When it takes no more parts after a loss, processes of our own do the rest.

    A part that ended a worker is not done in this process, which it might end, too; but where make and figures cannot be sent
    to processes of our own, there is no other place.
    """

    def __init__(self, executor: Any, job: Job):
        self._executor, self._job = executor, job
        self._pool = isinstance(executor, ProcessPoolExecutor)
        # A pool of processes fails as a whole. It gets one part for each process, so that few are lost with one that dies.
        self._most: int = getattr(executor, "_max_workers", 1) if self._pool else 2**31
        self._waiting: dict[Any, Part] = {}
        self._submitted, self._lost = 0, False
        self._instead: Workers | None = None

    @property
    def name(self) -> str:
        """Who does it."""
        return self._instead.name if self._instead else "the executor"

    @property
    def free(self) -> bool:
        """Whether it takes a part now."""
        if self._instead:
            return not self._waiting and self._instead.free
        return len(self._waiting) < self._most

    @property
    def busy(self) -> bool:
        """Whether a part is not finished yet."""
        return bool(self._waiting) or (self._instead is not None and self._instead.busy)

    def begin(self, part: Part) -> None:
        """Take a part."""
        if self._instead is None:
            job = sent(self._job) if self._pool else self._job
            self._submitted += 1
            try:
                self._waiting[self._executor.submit(compute_in_worker, job, part, self._submitted)] = part
                return
            except Exception:
                if not self._lost:  # it never worked
                    raise
            self._instead = self._successor()
        self._instead.begin(part)

    def finished(self) -> list[tuple[Part, Outcome | Lost]]:
        """Wait for parts, at least for one."""
        if not self._waiting and self._instead:
            return self._instead.finished()
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
                    done = list(self._waiting)  # which fail with it
        return out

    def close(self) -> None:
        """Take back what has not begun. The executor is the user's."""
        for future in self._waiting:
            with contextlib.suppress(Exception):
                future.cancel()
        if self._instead:
            self._instead.close()

    def _done(self) -> list[Any]:
        first = next(iter(self._waiting))
        if isinstance(first, Future):
            return list(wait(self._waiting, return_when=FIRST_COMPLETED).done)
        return [first]  # futures of other kinds are waited for in turn

    def _successor(self) -> Workers:
        try:
            return Processes(min(self._most, os.cpu_count() or 1), sent(self._job))
        except TypeError:
            return ThisProcess(self._job)


def chosen(executor: Any, job: Job) -> tuple[Workers, int]:
    """Who does the parts, and how many parts there should be at least."""
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
    of_client = getattr(executor, "get_executor", None)  # Dask's; pure: what has failed once may be tried again
    executor = of_client(pure=False) if callable(of_client) else executor
    return Given(executor, job), 1


def sent(job: Job) -> bytes:
    """A job for other processes; raises TypeError where it cannot be sent."""
    try:
        return pickle.dumps(job)
    except Exception as error:
        raise TypeError(
            f"sweep: make and figures must be sent to other processes, but {type(error).__name__}: {error}. Write them as "
            "functions at the top of a file (no lambda, nothing inside another function), or leave executor out."
        ) from None
