"""RESULTS.md, the file of the laboratory's results: one section for each experiment, written by write() alone."""

import datetime
import re
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tiverlet.report.output import Table, machine

FILE = Path(__file__).with_name("RESULTS.md")
HEAD = "# Results of the laboratory\n\nWritten by `python -m tests.laboratory NAME --write`; do not edit.\n\n"


def commit() -> str:
    """Return the commit that is measured, with a + where files differ from it."""
    git = ["git", "-C", str(FILE.parent)]
    named = subprocess.run([*git, "describe", "--always", "--dirty=+", "--exclude=*"], capture_output=True, text=True)
    return named.stdout.strip() or "unknown"


def sections(text: str) -> dict[str, str]:
    """Return the sections of the file by the names of their experiments."""
    parts = re.split(r"^(?=## )", text, flags=re.M)[1:]
    return {part[3:].partition("\n")[0]: part for part in parts}


def write(name: str, command: str, tables: Iterable[Table], file: Path = FILE, origin: str = "") -> None:
    """Replace a section of the file, or add one. origin: date, machine and commit, if they are not those of now."""
    text = file.read_text() if file.exists() else HEAD
    parts = sections(text)
    origin = origin or f"{datetime.date.today()}, {machine()}, commit {commit()}"
    lines = [f"## {name}", "", f"`{command}`: {origin}.", ""]
    parts[name] = "\n".join([*lines, *(table.markdown() for table in tables)]) + "\n"
    file.write_text(HEAD + "".join(parts[key] for key in sorted(parts)))


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Return the mean of independent values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
