"""Run the parts of a report, one after the other here or in the workers of an executor, with a progress bar."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from functools import partial
from typing import Any, TypeVar

from rich.progress import Progress

from .output import error_line

T = TypeVar("T")


def done(
    title: str, function: Callable[[T], Any], parts: Sequence[T], executor: Any, progress: bool, name: Callable[[T], str] = str
) -> Iterator[tuple[T, Any, str]]:
    """Yield (part, function(part), "") for each part as it finishes, or (part, None, error) if it or its worker failed.

    executor: an object with submit(), or None. progress: whether to show a bar. name(part): the text beside the bar.
    """
    with Progress(disable=not progress) as bar:
        shown = bar.add_task(title, total=len(parts))
        for part, call in _calls(function, parts, executor):
            try:
                made, why = call(), ""
            except Exception as error:
                made, why = None, error_line(error)
            yield part, made, why
            bar.update(shown, advance=1, description=name(part))


def _calls(function: Callable[[T], Any], parts: Sequence[T], executor: Any) -> Iterator[tuple[T, Callable[[], Any]]]:
    """Yield each part when its result can be had, with the call that returns the result."""
    waiting = {}
    for part in parts:
        if executor is None:
            yield part, partial(function, part)
            continue
        try:
            waiting[executor.submit(function, part)] = part
        except Exception as error:  # a pool that has lost a worker accepts no more jobs
            yield part, partial(_fail, error)
    for future in as_completed(waiting):
        yield waiting[future], future.result


def _fail(error: Exception) -> None:
    raise error
