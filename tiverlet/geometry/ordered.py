"""What NumPy's unique and median find: these load all that it has for masked arrays first, which takes 6 ms."""

import numpy as np


def distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, or numbers, each once and in order; which of these every row is; how often each is there."""
    table = rows if rows.ndim > 1 else rows[:, None]
    order = np.lexsort(table.T[::-1])
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (table[order][1:] != table[order][:-1]).any(axis=1)
    which = np.empty(len(rows), dtype=np.int64)
    which[order] = np.cumsum(new) - 1
    return rows[order[new]], which, np.bincount(which)


def median(values: np.ndarray) -> float:
    """The middle one of some numbers, in order."""
    ordered = np.sort(values, axis=None)
    return float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2
