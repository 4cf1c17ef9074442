"""Integer places in boxes."""

from collections.abc import Iterator

import numpy as np

CHUNK = 1 << 20  # places that are listed together, about


def places_between(first: np.ndarray, last: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield all integer places from first to last, (m, k) each, axis 0 fastest; none where last is below first.

    They come in chunks of whole rows, in order: the rows of first to which places belong, (c,), and the places, (c, k).
    """
    size = np.maximum(last - first + 1, 0)
    number = size.prod(axis=1)
    for some in np.split(np.arange(len(first)), np.flatnonzero(np.diff(np.cumsum(number) // CHUNK)) + 1):
        row = np.repeat(some, number[some])
        rest = np.arange(len(row)) - np.repeat(np.cumsum(number[some]) - number[some], number[some])
        place = np.empty((len(row), first.shape[1]), dtype=np.int64)
        for k in range(first.shape[1]):
            place[:, k] = first[row, k] + rest % size[row, k]
            rest = rest // size[row, k]
        yield row, place
