"""What all reports print with: text, Markdown, numbers that JSON has, errors in a line, the machine."""

import os
import platform
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.console import Console


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
