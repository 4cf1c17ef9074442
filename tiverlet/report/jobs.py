"""Run the parts of a report, one after the other here or in the workers of an executor, and say what has finished."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import Progress

from .output import error_line

T = TypeVar("T")


@contextmanager
def finishing(title: str, count: int, shown: bool) -> Iterator[Callable[[str], None]]:
    """Provide a function to call as each of `count` parts finishes, with a line to print at once; "" for none.

    Lines are flushed, into a pipe or a file too; in a terminal they stand above a bar. shown: whether to print at all.
    """
    console = Console(soft_wrap=True, highlight=False, markup=False, quiet=not shown)
    with Progress(console=console, disable=not (shown and console.is_terminal)) as bar:
        task = bar.add_task(title, total=count)

        def say(line: str) -> None:
            """Print the line, if there is one, and advance the bar."""
            if line:
                console.print(line)
            bar.advance(task)

        yield say


def done(function: Callable[[T], Any], parts: Sequence[T], executor: Any) -> Iterator[tuple[T, Any, str]]:
    """Yield (part, function(part), "") for each part as it finishes, or (part, None, error) if it or its worker failed.

    executor: an object with submit(), or None.
    """
    for part, call in _calls(function, parts, executor):
        try:
            made, why = call(), ""
        except Exception as error:
            made, why = None, error_line(error)
        yield part, made, why


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
