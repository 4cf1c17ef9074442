"""Workers of a sweep: this process, processes that the sweep starts, or a user's executor. All are executors with submit()."""

import contextlib
import multiprocessing
import os
import pickle
import signal
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from typing import Any

from .. import checks
from ..device import runtime
from .part import Job, Outcome, Part, compute, compute_in_worker, format_call


class ThisProcess:
    """Computes one part at a time, in this process."""

    name, most = "this process", 1

    def submit(self, function: Any, job: Job, part: Part, attempt: int) -> "Future[Outcome]":
        """Compute the part."""
        future: Future[Outcome] = Future()
        future.set_result(compute(job, part))
        return future


class Died(Exception):
    """A process ended before its part was done."""


class _Process:
    """A process that computes one part after the other, and sends over a pipe which world it makes."""

    def __init__(self, context: Any, threads: int):
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, threads), daemon=True)
        self.process.start()
        theirs.close()  # so that the pipe closes when the process ends

    def compute(self, job: bytes, part: Part) -> Outcome:
        """Return the outcome of a part. Raises Died."""
        at = None  # number of the world being made; -1 after the last
        with contextlib.suppress(OSError):  # if the process died, recv() finds the pipe closed
            self.pipe.send((job, part))
        try:
            while isinstance(message := self.pipe.recv(), int):
                at = message
        except (EOFError, OSError):
            self.end()
            raise Died(self._death(part, at)) from None
        return message

    def end(self) -> None:
        """Close the pipe, and wait for the process."""
        self.pipe.close()
        self.process.join(5)
        if self.process.exitcode is None:
            self.process.kill()
            self.process.join()

    def _death(self, part: Part, at: int | None) -> str:
        code = self.process.exitcode
        how = f"ended with exit code {code}"
        if code is not None and code < 0:
            with contextlib.suppress(ValueError):
                how = f"was ended by {signal.Signals(-code).name}"
            how += " (perhaps because memory is short)" if code == -9 else ""
        when = 'before it began; in a script, call tv.sweep below `if __name__ == "__main__":`'
        if at is not None:
            making = f"in {format_call(part.rows[at - part.first])}, number {at}"
            when = making if at >= 0 else "after all worlds were made"
        return f"worker process {self.process.pid} {how} {when}"


class Processes:
    """Processes that the sweep starts, each with a share of the cores; spawned, since Taichi does not survive a fork.

    A process starts with the first part that finds no other one idle. A thread waits for each part that is being computed.
    """

    name = "another process"

    def __init__(self, count: int):
        self.most = count
        self._context = multiprocessing.get_context("spawn")
        self._share = max(1, _cores() // count)
        self._threads = ThreadPoolExecutor(count)
        self._idle: list[_Process] = []
        self._busy: list[_Process] = []

    def submit(self, function: Any, job: bytes, part: Part, attempt: int) -> "Future[Outcome]":
        """Send the part to a process. Its future has the outcome, or raises Died."""
        worker = self._idle.pop() if self._idle else _Process(self._context, self._share)
        self._busy.append(worker)
        return self._threads.submit(self._compute, worker, job, part)

    def _compute(self, worker: _Process, job: bytes, part: Part) -> Outcome:
        try:
            outcome = worker.compute(job, part)
            self._idle.append(worker)
            return outcome
        finally:
            self._busy.remove(worker)

    def close(self) -> None:
        """End the processes, at once if they are computing."""
        for worker in [*self._busy]:
            worker.process.terminate()
        self._threads.shutdown()
        for worker in self._idle:
            worker.end()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _serve(pipe: Any, threads: int) -> None:
    """Run a worker process until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the one that started the sweep ends the others
    runtime.share = threads
    with contextlib.suppress(EOFError, OSError):
        while True:
            job, part = pipe.recv()
            pipe.send(compute_in_worker(job, part, 0, pipe.send))


class Workers:
    """Gives parts to an executor. If a user's one accepts no more parts after a loss, processes of the sweep do the rest.

    A part that ended a worker is not computed in this process, which it might end, too. The exception is a job that cannot be
    sent to processes of the sweep: then this process is the only place left.
    """

    def __init__(self, job: Job, executor: Any):
        self._job = job
        self._waiting: dict[Any, Part] = {}
        self._submitted, self._lost = 0, False
        self._use(executor)

    def _use(self, executor: Any) -> None:
        """Give parts to this executor from now on."""
        self._executor, pool = executor, isinstance(executor, ProcessPoolExecutor)
        self._own = isinstance(executor, (ThisProcess, Processes))
        self.name: str = executor.name if self._own else "the executor"
        # A pool of processes fails as a whole. It gets one part per process, so that few parts are lost with a worker.
        self._most: int = executor.most if self._own else getattr(executor, "_max_workers", 1) if pool else 2**31
        self._sent = sent(self._job) if pool or isinstance(executor, Processes) else self._job

    @property
    def free(self) -> bool:
        """Whether a part can begin now."""
        return len(self._waiting) < self._most

    @property
    def busy(self) -> bool:
        """Whether a part is unfinished."""
        return bool(self._waiting)

    def begin(self, part: Part) -> None:
        """Begin a part."""
        try:
            self._submit(part)
        except Exception:
            if self._own or not self._lost:  # the executor never worked
                raise
            try:
                self._use(Processes(min(self._most, os.cpu_count() or 1)))
            except TypeError:
                self._use(ThisProcess())
            self._submit(part)

    def _submit(self, part: Part) -> None:
        self._submitted += 1
        self._waiting[self._executor.submit(compute_in_worker, self._sent, part, self._submitted)] = part

    def finished(self) -> Iterator[tuple[Part, Outcome | None, str]]:
        """Wait for at least one part, and return each finished part with its outcome; None, and why, if its worker died."""
        futures = [future for future in self._waiting if isinstance(future, Future)]
        # futures of other kinds are awaited one by one
        for future in wait(futures, return_when=FIRST_COMPLETED).done if futures else [next(iter(self._waiting))]:
            part = self._waiting.pop(future)
            try:
                yield part, future.result(), ""
            except Died as error:
                yield part, None, str(error)
            except Exception as error:
                self._lost = True
                yield part, None, f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(".: ")

    def close(self) -> None:
        """Cancel parts that have not begun, and end processes of the sweep. A user's executor stays open."""
        for future in self._waiting:
            with contextlib.suppress(Exception):
                future.cancel()
        if isinstance(self._executor, Processes):
            self._executor.close()


def choose_workers(executor: Any, job: Job) -> tuple[Workers, int]:
    """Return the workers, and the least number of parts."""
    if executor is None:
        return Workers(job, ThisProcess()), 1
    if isinstance(executor, int):
        count = checks.integer("sweep", "executor", executor, least=1)
        return Workers(job, Processes(count)), count
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
    of_client = getattr(executor, "get_executor", None)  # of Dask; not pure: a failed call may be repeated
    return Workers(job, of_client(pure=False) if callable(of_client) else executor), 1


def sent(job: Job) -> bytes:
    """Pickle a job for other processes. Raises TypeError if it cannot be pickled."""
    try:
        return pickle.dumps(job)
    except Exception as error:
        raise TypeError(
            f"sweep: make and figures must be sent to other processes, but {type(error).__name__}: {error}. Write them as "
            "functions at the top of a file (no lambda, nothing inside another function), or leave executor out."
        ) from None
