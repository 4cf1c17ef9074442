"""The file of figures: a line for each figure of a scene, with a column for each way to step it; read, written and compared.

    rope | default f64 | error [m] | 0.01 1e-4 - 3e-5

What is not in the file is as good as it can be: a figure below what rounding makes of it, or no flag.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FILE = Path(__file__).with_name("figures.txt")
COLUMNS = ("4", "20", "80", "auto", "late")  # substeps; "late": 20 in frames of uneven length, some of a quarter of a second
HEAD = f"# Written by `python -m tests.ledger --write`. Columns: {', '.join(COLUMNS)}; see runs.py.\n"
SHARE = 0.05  # by which a figure may be worse without being told: more than its last digit of three, less than a user would see
NONE = "-"

Key = tuple[str, str, str]  # scene, how it is solved, figure
Row = dict[str, str]  # column -> a number, flags joined by +, or a word; columns that are not there have none
Book = dict[Key, Row]


def read(file: Path = FILE) -> Book:
    """Return the figures of a file; none if there is no file."""
    lines = file.read_text().splitlines() if file.exists() else []
    out: Book = {}
    for line in lines:
        if not line.startswith("#"):
            *key, cells = (part.strip() for part in line.split("|"))
            out[key[0], key[1], key[2]] = {c: v for c, v in zip(COLUMNS, cells.split(), strict=False) if v != NONE}
    return out


def write(book: Book, file: Path = FILE) -> None:
    """Write figures in the order of their keys."""
    lines = [
        f"{' | '.join(key)} | {' '.join(row.get(c, NONE) for c in COLUMNS).rstrip(' -')}\n" for key, row in sorted(book.items())
    ]
    file.write_text(HEAD + "".join(lines))


@dataclass(frozen=True)
class Change:
    """A figure that is not what it was. worse: whether that is a fault; else it is better, or neither."""

    key: Key
    column: str
    old: str
    new: str
    worse: bool

    def __str__(self) -> str:
        return f"{'worse ' if self.worse else 'better'} {' | '.join(self.key)} | {self.column}: {self.old} -> {self.new}"


def is_number(cell: str) -> bool:
    """Whether a cell is a figure, and no list of words."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def compare(old: Book, new: Book) -> Iterator[Change]:
    """Yield what differs: numbers by more than SHARE, words at all. A word that comes or goes is a fault either way.

    Of scenes that only one of the two has, nothing is told.
    """
    known = {key[0] for key in old} & {key[0] for key in new}
    for key in sorted(key for key in old.keys() | new.keys() if key[0] in known):
        before, after = old.get(key, {}), new.get(key, {})
        for column in COLUMNS:
            a, b = before.get(column, "0"), after.get(column, "0")
            if a == b:
                continue
            if not (is_number(a) and is_number(b)):
                yield Change(key, column, a, b, worse=True)
            elif not float(b) <= (1 + SHARE) * float(a):  # also where it is no number any more
                yield Change(key, column, a, b, worse=not np.isnan(float(a)))
            elif float(b) < (1 - SHARE) * float(a):
                yield Change(key, column, a, b, worse=False)
