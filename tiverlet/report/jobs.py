"""Run the parts of a report, one after the other here or in the workers of an executor, with a progress bar."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import as_completed
from typing import Any, TypeVar

from rich.progress import Progress

from .output import error_line

T = TypeVar("T")
Done = tuple[T, Any, str]  # a part, its result or None, and the error or ""


def done(
    title: str, function: Callable[[T], Any], parts: Sequence[T], executor: Any, progress: bool, name: Callable[[T], str] = str
) -> Iterator[Done[T]]:
    """Yield (part, function(part), "") for each part as it finishes, or (part, None, error) if it or its worker failed.

    executor: an object with submit(), or None. progress: whether to show a bar. name(part): the text beside the bar.
    """
    with Progress(disable=not progress) as bar:
        shown = bar.add_task(title, total=len(parts))
        for part, made, why in _submitted(function, parts, executor) if executor is not None else _here(function, parts):
            yield part, made, why
            bar.update(shown, advance=1, description=name(part))


def _here(function: Callable[[T], Any], parts: Iterable[T]) -> Iterator[Done[T]]:
    for part in parts:
        try:
            made, why = function(part), ""
        except Exception as error:
            made, why = None, error_line(error)
        yield part, made, why


def _submitted(function: Callable[[T], Any], parts: Iterable[T], executor: Any) -> Iterator[Done[T]]:
    waiting = {}
    for part in parts:
        try:
            waiting[executor.submit(function, part)] = part
        except Exception as error:  # a pool that has lost a worker accepts no more jobs
            yield part, None, error_line(error)
    for future in as_completed(waiting):
        try:
            made, why = future.result(), ""
        except Exception as error:
            made, why = None, error_line(error)
        yield waiting[future], made, why
