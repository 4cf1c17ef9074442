"""Output of all reports: text, tables, Markdown, means with errors, numbers for JSON, errors in one line, the machine's name."""

import os
import platform
from collections.abc import Container, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

Titled = tuple[str, Sequence[str], Iterable[Sequence[str]]]  # a table: title, column heads, rows of text


def text(shown: Any, width: int) -> str:
    """Return the text that rich's print() shows, in lines of `width` characters."""
    console = Console(width=width)
    with console.capture() as out:
        console.print(shown)
    return out.get()


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (heads, *rows)]
    return [lines[0], "|" + "---|" * len(heads), *lines[1:]]


def printed(tables: Iterable[Titled], lines: Iterable[str], left: Container[str] = ()) -> Iterator[Table | Text]:
    """Yield tables, and lines below them, for rich. left: heads of columns that are left-aligned, besides the first."""
    for title, heads, rows in tables:
        out = Table(title=title, box=SIMPLE, padding=(0, 1, 0, 0), pad_edge=False)
        for k, head in enumerate(heads):
            out.add_column(head, justify="left" if k == 0 or head in left else "right")
        for row in rows:
            out.add_row(*map(Text, row))
        yield out
    yield from map(Text, lines)


def markdown(tables: Iterable[Titled], lines: Iterable[str]) -> str:
    """Return tables, and lines below them, as Markdown."""
    out: list[str] = []
    for title, heads, rows in tables:
        out += [f"**{title}**", "", *table(heads, rows), ""]
    return "\n".join([*out, *(f"- {line}" for line in lines)]) + "\n"


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of independent values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def plain(row: dict) -> dict:
    """Return the row with None for numbers that JSON does not have."""
    return {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()}


def canvas(folder) -> Any:
    """Create the folder for plots and return matplotlib's Figure class. Raises RuntimeError if matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise RuntimeError('plot: matplotlib is not there. Install it with the extra: pip install "tiverlet[plots]".') from error
    os.makedirs(folder, exist_ok=True)
    return Figure


def error_line(error: BaseException) -> str:
    """Return an error as one line of at most 200 characters."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    return text if len(text) <= 200 else text[:197] + "..."


def machine() -> str:
    """Return the name of the machine: processor, cores, system and Python."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            name = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
