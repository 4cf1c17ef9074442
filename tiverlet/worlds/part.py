"""One part of a sweep, in this process or in a worker: make its worlds, and compute their figures."""

import contextlib
import functools
import os
import pickle
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..device import runtime, ti
from ..world import World

Outcome = dict[str, np.ndarray] | Exception  # figures by name, or the exception of the user's functions


@dataclass(frozen=True)
class Part:
    """Consecutive sets of parameters, whose worlds are stepped together. first: the number of the first set."""

    first: int
    rows: list[dict[str, Any]]

    @property
    def numbers(self) -> range:
        """The numbers of its sets of parameters in the sweep."""
        return range(self.first, self.first + len(self.rows))

    def __str__(self) -> str:
        if len(self.rows) == 1:
            return describe_parameters(self.first, self.rows[0])
        return f"parameters {self.first} to {self.numbers[-1]}, {format_call(self.rows[0])} to {format_call(self.rows[-1])}"


@dataclass(frozen=True)
class Job:
    """The work for each part: functions and plain data, which can be sent to another process.

    settings: arguments of tv.init in the process that started the sweep. versions: those that determine results bit for bit,
    which must be equal everywhere.
    """

    make: Callable[..., World]
    figures: Callable[[Any], Mapping[str, Any]]
    settings: dict[str, Any]
    versions: str


def format_call(row: Mapping[str, Any]) -> str:
    """Return the call of make() with these parameters, as one line."""
    return f"make({', '.join(f'{name}={_short(value)}' for name, value in row.items())})"


def describe_parameters(number: int, row: Mapping[str, Any]) -> str:
    """Return the number and the call of one set of parameters."""
    return f"parameters {number}, {format_call(row)}"


def make_world(who: str, make: Callable[..., World], number: int, row: Mapping[str, Any], before: list[World]) -> World:
    """Call make() with a set of parameters, and append the World to those before. Raises TypeError or ValueError if it is none,
    or one of them."""
    with _noted(f"{who}: raised by {describe_parameters(number, row)}"):
        world = make(**row)
        if not isinstance(world, World):
            raise TypeError(f"{who}: make returned {world!r}, a {type(world).__name__}, but a tv.World is needed.")
        if world in before:
            raise ValueError(f"{who}: make returned the same World again. Make a new one for each call.")
    before.append(world)
    return world


def compute(job: Job, part: Part, report_number: Callable[[int], Any] = lambda number: None) -> dict[str, np.ndarray]:
    """Return the figures of a part by name. Exceptions of the user's functions get a note that names the parameters.

    report_number: called with the number of each world before it is made, and with -1 after the last.
    """
    from .worlds import Worlds

    with contextlib.ExitStack() as stack:
        made: list[World] = []
        for number, row in zip(part.numbers, part.rows, strict=True):
            report_number(number)
            stack.enter_context(make_world("sweep", job.make, number, row, made))
        report_number(-1)
        with _noted(f"sweep: raised by the worlds of {part}"):
            worlds = stack.enter_context(Worlds(made))
            return _checked(job.figures(worlds), len(part.rows))


def compute_in_worker(
    job: Job | bytes, part: Part, attempt: int, report_number: Callable[[int], Any] = lambda number: None
) -> Outcome:
    """Run compute() in a process of an executor. attempt: makes repeated calls differ, for executors that cache by arguments.

    Exceptions are returned, so that one that is raised means a failure of the worker itself. Taichi belongs to the thread that
    started it. Workers of some executors have several threads, so one dedicated thread does all parts there.
    """
    if threading.current_thread() is not threading.main_thread():
        return _thread().submit(_outcome, job, part, report_number).result()
    return _outcome(job, part, report_number)


def _outcome(job: Job | bytes, part: Part, report_number: Callable[[int], Any]) -> Outcome:
    try:
        job = _loaded(job) if isinstance(job, bytes) else job
        if job.versions != describe_versions():
            raise RuntimeError(
                f"sweep: a worker has {describe_versions()}, but the sweep was started with {job.versions}, so the bits could "
                "differ. Install the same versions on all machines."
            )
        if ti.cfg is None:
            runtime.share = runtime.share or _cores_of_worker()
            if job.settings:
                runtime.init(**job.settings)
        return compute(job, part, report_number)
    except Exception as error:
        return _sendable(error)


def _checked(found: Any, count: int) -> dict[str, np.ndarray]:
    """Return figures as new arrays, with one row for each world."""
    if not isinstance(found, Mapping):
        kind = type(found).__name__
        raise TypeError(f'sweep: figures returned a {kind}, but a dict of arrays is needed, such as {{"end": worlds.position}}.')
    out = {}
    for name, value in found.items():
        try:
            array = np.array(value)
        except ValueError:
            raise ValueError(
                f"sweep: figures returned {name!r} with rows of different lengths, but they must be equal."
            ) from None
        if array.dtype.hasobject:
            raise TypeError(f"sweep: figures returned {name!r} with Python objects in it, but numbers or strings are needed.")
        if not array.ndim or len(array) != count:
            raise ValueError(
                f"sweep: figures returned {name!r} with shape {array.shape}, but there are {count} worlds here and it must have "
                "one row for each."
            )
        out[name] = array
    return out


@contextlib.contextmanager
def _noted(note: str) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        error.add_note(note)
        raise


def _sendable(error: Exception) -> Exception:
    """Return an exception that survives pickling: the original, or a RuntimeError with its text. A note has the traceback."""
    error.add_note("".join(["In the worker:\n", *traceback.format_tb(error.__traceback__)]).rstrip())
    with contextlib.suppress(Exception):  # unpickling a user's exception may raise anything
        if type(pickle.loads(pickle.dumps(error))) is type(error):
            return error
    new = RuntimeError(f"{type(error).__name__}: {error}")
    for note in getattr(error, "__notes__", ()):
        new.add_note(note)
    return new


def settings() -> dict[str, Any]:
    """Return the arguments of tv.init in this process, without threads: each worker gets a share of the cores."""
    if ti.cfg is None:
        return {}
    return {k: v for k, v in runtime.wanted().items() if k != "threads"} | {"arch": runtime.architecture()}


def describe_versions() -> str:
    """Return the versions that determine results bit for bit: of tiverlet and of the compiler."""
    from .. import __version__

    return f"tiverlet {__version__} on {runtime.compiler()}"


def _cores_of_worker() -> int:
    """Return the threads for a worker of a user's executor: OMP_NUM_THREADS, which such tools set, else 1."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, int(told)) if told.isdecimal() else 1


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


@functools.lru_cache(1)
def _loaded(job: bytes) -> Job:
    try:
        return pickle.loads(job)
    except Exception as error:
        error.add_note(
            "sweep: a worker process could not import make or figures. Write them at the top of a file; processes do not see "
            "what is defined in a notebook or a prompt."
        )
        raise


@functools.cache
def _thread() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, "sweep")
