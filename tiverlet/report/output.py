"""What all reports print with: text, tables, Markdown, means and errors, numbers that JSON has, errors in a line, the machine."""

import os
import platform
from collections.abc import Container, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

Titled = tuple[str, Sequence[str], Iterable[Sequence[str]]]  # a table: its title, the heads of columns, rows of text


def text(shown: Any, width: int) -> str:
    """What print() of rich shows of something, in lines of `width`."""
    console = Console(width=width)
    with console.capture() as out:
        console.print(shown)
    return out.get()


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (heads, *rows)]
    return [lines[0], "|" + "---|" * len(heads), *lines[1:]]


def printed(tables: Iterable[Titled], lines: Iterable[str], left: Container[str] = ()) -> Iterator[Table | Text]:
    """Tables, and lines below them, for rich. left: heads of columns of words, as the first one is."""
    for title, heads, rows in tables:
        out = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0), pad_edge=False)
        for k, head in enumerate(heads):
            out.add_column(head, justify="left" if k == 0 or head in left else "right")
        for row in rows:
            out.add_row(*map(Text, row))
        yield out
    yield from map(Text, lines)


def markdown(tables: Iterable[Titled], lines: Iterable[str]) -> str:
    """The same as Markdown."""
    out: list[str] = []
    for title, heads, rows in tables:
        out += [f"**{title}**", "", *table(heads, rows), ""]
    return "\n".join([*out, *(f"- {line}" for line in lines)]) + "\n"


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """The mean of independent values, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def plain(row: dict) -> dict:
    """With None for numbers that JSON does not have."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def canvas(folder) -> Any:
    """The Figure of matplotlib, to plot into a folder, which is made. Raises RuntimeError where there is no matplotlib."""
    try:
        from matplotlib.figure import Figure  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RuntimeError('plot: matplotlib is not there. Install it with the extra: pip install "tiverlet[plots]".') from error
    os.makedirs(folder, exist_ok=True)
    return Figure


def said(error: BaseException) -> str:
    """An error in a line."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= 200 else text[:197] + "..."


def machine() -> str:
    """What the times were measured on."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
