"""Output of all reports: tables, in a terminal and in Markdown; numbers for JSON; errors in one line; the machine's name."""

import os
import platform
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.jupyter import JupyterMixin
from rich.table import Table as RichTable
from rich.text import Text


@dataclass
class Table:
    """A table of text: title, heads of the columns, rows, and lines below.

    left: heads of columns that are left-aligned, besides the first and the last. styles: of rows, for rich; none without any.
    """

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    notes: Sequence[str] = ()
    left: Container[str] = ()
    styles: Sequence[str] = ()

    @classmethod
    def of(cls, title: str, columns: Mapping[str, Callable[[Any], str]], items: Iterable[Any]) -> "Table":
        """Return a table with a row per item. columns: the head of each, and the function from an item to its text."""
        return cls(title, list(columns), [[cell(item) for cell in columns.values()] for item in items])

    def shown(self) -> Iterator[RichTable | Text]:
        """Yield the table and its notes, for rich."""
        out = RichTable(title=Text(self.title), title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)
        for k, head in enumerate(self.heads):
            left = k in (0, len(self.heads) - 1) or head in self.left
            out.add_column(Text(head), justify="left" if left else "right", overflow="fold")
        for k, row in enumerate(self.rows):
            out.add_row(*map(Text, row), style=self.styles[k] if self.styles else "")
        yield out
        yield from map(Text, self.notes)

    def markdown(self) -> str:
        """Return title, table and notes as Markdown."""
        lines = ["| " + " | ".join(row) + " |" for row in (self.heads, *self.rows)]
        lines.insert(1, "|" + "---|" * len(self.heads))
        return "\n".join([f"**{self.title}**", "", *lines, "", *(f"- {note}" for note in self.notes)]).strip() + "\n"


class Report(JupyterMixin):
    """A report that is tables. print() and rich show them, .markdown() returns them. width: characters of a line of print()."""

    width = 80

    def tables(self) -> Iterator[Table]:
        """Yield the tables."""
        raise NotImplementedError

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for table in self.tables():
            yield from table.shown()

    def __str__(self) -> str:
        console = Console(width=self.width)
        with console.capture() as out:
            console.print(self)
        return out.get()

    def markdown(self) -> str:
        """Return the tables as Markdown."""
        return "\n".join(table.markdown() for table in self.tables())


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
