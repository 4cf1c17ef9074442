"""Arrays with a row per contact or ray as text that fits a screen."""

from collections.abc import Mapping

import numpy as np

MOST = 8  # rows that are shown


def row_table(title: str, columns: Mapping[str, np.ndarray]) -> str:
    """Return a title with the number of rows, and the first rows of some columns, (m,) or (m, k), one below the other."""
    m = len(next(iter(columns.values())))
    cells = {name: [" ".join(f"{v:.3g}" for v in np.ravel(row)) for row in values[:MOST]] for name, values in columns.items()}
    shown = [[name, *column] for name, column in cells.items()]
    widths = [max(map(len, column)) for column in shown]
    lines = ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in zip(*shown, strict=True)]
    more = [f"... and {m - MOST} more"] if m > MOST else []
    return "\n".join([f"{title}: {m}", *(lines if m else []), *more])
