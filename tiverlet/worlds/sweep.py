"""One scene with many parameters: make worlds, step them together and measure them, in processes or on a cluster."""

import inspect
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..world import World
from .part import Job, Part, describe_parameters, describe_versions, settings

if TYPE_CHECKING:
    from .workers import Workers

TRIES = 3  # attempts at a part whose worker dies


@dataclass(frozen=True)
class Repeated:
    """A part that was repeated because its worker died.

    numbers: of its sets of parameters. parameters: their values. why: the known cause of each death. by: the worker that finished
    it.
    """

    numbers: range
    parameters: list[dict[str, Any]]
    why: tuple[str, ...]
    by: str

    def __str__(self) -> str:
        return f"{Part(self.numbers.start, self.parameters)}: {'; '.join(self.why)}; done by {self.by}"


class SweepResult(dict[str, np.ndarray]):
    """Figures by name, as arrays with a leading axis of parameters, in their order.

    repeated: the parts that were repeated because a worker died; empty if none died. Repeating does not change the figures.
    """

    def __init__(self, figures: Mapping[str, np.ndarray], repeated: Iterable[Repeated] = ()):
        super().__init__(figures)
        self.repeated = tuple(repeated)

    def __repr__(self) -> str:
        figures = ", ".join(f"{name}: {value.shape} {value.dtype}" for name, value in self.items())
        again = f"; done again: {len(self.repeated)} parts" if self.repeated else ""
        return f"SweepResult({figures}{again})"


@checks.answer_arguments
def sweep(
    make: Callable[..., World], parameters: Mapping[str, Any] | Iterable[Mapping],
    figures: Callable[[Any], Mapping], executor: Any = None, at_once: int = 256, progress: bool = False,
) -> SweepResult:  # fmt: skip
    """Compute figures of one scene for many sets of parameters, here, in processes or on a cluster.

    make: called as make(**row) for each set of parameters; returns a new World, always of the same structure. parameters: a dict
    of equally long arrays or lists, or a list of dicts. figures: called with a Worlds of up to `at_once` worlds; steps them and
    returns a dict of arrays with one row per world. If it computes each world's row from that world alone, results are the same
    bit for bit for any executor, any at_once, and any order of the parts.

    executor: None for this process; a number of processes, each with a share of the cores; or any object with submit(), as in
    concurrent.futures: ProcessPoolExecutor (with "spawn"), Dask's Client, mpi4py's MPIPoolExecutor. Workers of such an object use
    OMP_NUM_THREADS threads, by default one. Processes import make and figures, which must be defined at the top of a file.
    progress: show a bar.

    A part whose worker dies is done again, at most three times in all, and is named in a warning and in .repeated. If an executor
    accepts no more parts, the sweep starts processes of its own for the rest. Raises RuntimeError, with the parameters, if that
    fails too; ValueError or TypeError for invalid arguments. Exceptions of make and figures are raised at once, with a note of
    the parameters.
    """
    from rich.progress import Progress  # noqa: PLC0415

    from .workers import choose_workers  # noqa: PLC0415

    rows = _rows(make, parameters, figures)
    at_once = checks.integer("sweep", "at_once", at_once, least=1)
    progress = checks.flag("sweep", "progress", progress)
    job = Job(make, figures, settings(), describe_versions())
    workers, least = choose_workers(executor, job)
    size = _ceil(len(rows), least * _ceil(len(rows), least * at_once))  # the same number of parts for each process
    parts = [Part(first, rows[first : first + size]) for first in range(0, len(rows), size)]
    found: dict[int, dict[str, np.ndarray]] = {}
    repeated = []
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("sweep", total=len(rows))
        try:
            for part, made, again in _done(parts, workers):
                found[part.first] = made
                repeated += [again] if again else []
                bar.update(shown, advance=len(part.rows))
        finally:
            workers.close()
    repeated.sort(key=lambda r: r.numbers.start)
    return SweepResult(_joined(parts, found), repeated)


def _done(parts: list[Part], workers: "Workers") -> Iterable[tuple[Part, dict[str, np.ndarray], Repeated | None]]:
    """Yield each part with its figures, as it is finished."""
    todo, deaths = deque(parts), defaultdict[int, list[str]](list)  # why workers died, by the first number of their part
    while todo or workers.busy:
        while todo and workers.free:
            workers.begin(todo.popleft())
        for part, outcome, why in workers.finished():
            if isinstance(outcome, Exception):
                raise outcome
            causes = deaths[part.first]
            if outcome is not None:
                yield part, outcome, Repeated(part.numbers, part.rows, tuple(causes), workers.name) if causes else None
                continue
            causes.append(why)
            if len(causes) == TRIES:
                raise RuntimeError(
                    f"sweep: {part} could not be done, because its worker died {TRIES} times: {why}. Try these "
                    "parameters with executor=1 and at_once=1 to see which of them it is; where memory is short, take a smaller "
                    "at_once or fewer workers."
                )
            checks.warn(f"sweep: {part} is done again: {why}.", RuntimeWarning)
            todo.appendleft(part)


def _ceil(a: int, b: int) -> int:
    return -(-a // b)


def _joined(parts: list[Part], found: dict[int, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the figures of all parts, in the order of the parameters."""
    first = found[0]
    for part in parts:
        made = found[part.first]
        if made.keys() != first.keys():
            raise ValueError(f"sweep: figures returned {list(made)} for {part}, but {list(first)} for {parts[0]}.")
        for name, value in made.items():
            if value.shape[1:] != first[name].shape[1:]:
                raise ValueError(
                    f"sweep: figures returned {name!r} with rows of shape {value.shape[1:]} for {part}, but of shape "
                    f"{first[name].shape[1:]} for {parts[0]}."
                )
    return {name: np.concatenate([found[part.first][name] for part in parts]) for name in first}


def _rows(make: Any, parameters: Any, figures: Any) -> list[dict[str, Any]]:
    """Check make, figures and parameters; return each set of parameters."""
    for name, function in (("make", make), ("figures", figures)):
        if not callable(function):
            raise TypeError(f"sweep: {name} = {function!r} is a {type(function).__name__}, but a function is needed.")
    rows = _columns(parameters) if isinstance(parameters, Mapping) else _dicts(parameters)
    if not rows:
        raise ValueError("sweep: parameters are empty, so there is nothing to do. Give at least one set.")
    try:
        signature = inspect.signature(make)
    except ValueError:  # make is a builtin
        return rows
    for k, row in enumerate(rows):
        try:
            signature.bind(**row)
        except TypeError as why:
            raise TypeError(f"sweep: make{signature} does not take {describe_parameters(k, row)}: {why}.") from None
    return rows


def _columns(parameters: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a dict of columns."""
    columns = {name: _column(name, values) for name, values in parameters.items()}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        told = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ValueError(
            f"sweep: parameters must be equally long, but {told}. For all combinations of two, take np.meshgrid and ravel() both."
        )
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _column(name: str, values: Any) -> list:
    """Return the values of one parameter, with NumPy numbers converted to Python's."""
    if isinstance(values, Mapping) or not (isinstance(values, np.ndarray) or isinstance(values, Iterable)):
        raise TypeError(
            f"sweep: parameters[{name!r}] = {values!r} is a {type(values).__name__}, but a list or an array with one value for "
            "each world is needed. For one that all share, write it into make."
        )
    return [_plain(v) for v in checks.rows("sweep", f"parameters[{name!r}]", values, "a list or an array")]


def _dicts(parameters: Any) -> list[dict[str, Any]]:
    """Return the rows of a list of dicts."""
    rows = checks.rows("sweep", "parameters", parameters, "a dict of arrays or a list of dicts")
    for k, row in enumerate(rows):
        if not isinstance(row, Mapping):
            kind = type(row).__name__
            raise TypeError(
                f'sweep: parameters[{k}] = {row!r} is a {kind}, but a dict such as {{"length": 1.0}} is needed, or a dict of '
                "arrays for all."
            )
    return [{name: _plain(v) for name, v in row.items()} for row in rows]


def _plain(value: Any) -> Any:
    """Convert a NumPy number to Python's with the same value, so that figures do not depend on which was given."""
    return value.item() if isinstance(value, np.generic) else value
