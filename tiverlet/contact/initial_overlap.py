"""The test whether particles overlap where they are placed. Its result saves a world from compiling for overlap, or twice."""

from itertools import product

import numpy as np

from ..features.feature import Batch, Scene
from ..features.material import Table
from ..particles import State
from .exclusions import excluded_pairs

FEW = 1_000_000  # most pairs for which all pairs are compared
MANY = 20_000  # particles above which the test takes too long
CROWD = 16  # particles in a cell above which the test takes too long


def overlapping(
    scene: Scene, batches: list[Batch], table: Table, x: np.ndarray, first: int = 0, moved: np.ndarray | None = None
) -> bool | None:  # fmt: skip
    """Whether discs or spheres at x (n, dim) [m] that push each other, by this table, overlap; None if the test would take long.

    Only pairs count of which one particle is free to move and one has an index of `first` or more, and is in the mask `moved`,
    (n,), if that is given. Linked pairs never touch.

    Without both, an overlap counts exactly if the device finds it, rounding included, because the world is compiled for that.
    Otherwise an overlap within the rounding of f32 does not count.
    """
    chosen, exact = np.arange(len(x)) >= first, first == 0 and moved is None
    chosen = chosen if moved is None else chosen & moved
    radius, free = scene.particles.radius, scene.inv_mass > 0
    count, number = len(x), np.arange(len(x))
    if scene.periodic is not None:  # particles and their images side by side
        number, x = scene.periodic.ghosts(x, 2 * float(radius.max(initial=0.0)))
        radius, free = radius[number], free[number]
    close = 2.0**-20 * float(np.abs(x).max(initial=0.0) + radius.max(initial=0.0))
    begin = first if len(x) == count else 0
    wide = radius + (close / 2 if exact else 0.0)  # include pairs that overlap by rounding only
    pairs = _by_all(x, wide, begin) if (len(x) - begin) * len(x) <= FEW else _by_cells(x, wide)
    if pairs is None:
        return None
    i, j = pairs[chosen[number[pairs]].any(axis=1)].T
    if not exact:
        near = ((x[i] - x[j]) ** 2).sum(axis=1) < np.maximum(radius[i] + radius[j] - close, 0) ** 2
    else:
        near = _meet(scene.state, x, radius, i, j)
    pairs = number[np.stack([i, j], axis=1)[near & (free[i] | free[j])]]
    pairs = pairs[table.pushing(scene.particles.group, pairs)]
    if not len(pairs):
        return False
    linked = excluded_pairs(batches, scene.particles.radius)
    some, without = (np.sort(p, axis=1).astype(np.int64) @ [count, 1] for p in (pairs, linked))
    return not np.isin(some, without).all()


def _meet(state: State, x: np.ndarray, radius: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return the mask of pairs that overlap, computed as on the device, see DiscGeometry.overlap()."""
    real = np.float64 if state.double else np.float32
    high, r = x.astype(real), radius.astype(real)
    apart = high[i] - high[j]
    if state.compensated:
        low = (x - high).astype(real)
        apart += low[i] - low[j]
    square, reach = apart[:, 0] * apart[:, 0], r[i] + r[j]
    for k in range(1, x.shape[1]):
        square += apart[:, k] * apart[:, k]
    return (square < reach * reach) & (np.sqrt(square) < reach)


def _by_all(x: np.ndarray, radius: np.ndarray, first: int) -> np.ndarray:
    """Return pairs that are near along the first axis, and of which one index is at least `first`."""
    y, r = x[first:], radius[first:]
    reach = r.max(initial=0.0) + radius.max(initial=0.0)
    others = np.arange(len(x))
    for a in range(x.shape[1]):  # one axis at a time takes NumPy a tenth of the time
        low, high = y[:, a].min(initial=np.inf) - reach, y[:, a].max(initial=-np.inf) + reach
        others = others[(x[others, a] >= low) & (x[others, a] <= high)]
    near = np.abs(y[:, None, 0] - x[others, 0]) < r[:, None] + radius[others]
    i, j = np.nonzero(near)
    i, j = i + first, others[j]
    return np.stack([i, j], axis=1)[(j < i) | (j < first)]


def _by_cells(x: np.ndarray, radius: np.ndarray) -> np.ndarray | None:
    """Return pairs in the same cell or in adjacent cells; None if that would take long."""
    if len(x) > MANY:
        return None
    place = np.floor((x - x.min(axis=0)) / (2 * radius.max())) + 1
    size = place.max(axis=0) + 2
    if size.prod() >= 2.0**53:
        return None
    stride = np.concatenate([[1.0], np.cumprod(size[:-1])])
    key = place @ stride
    order = np.argsort(key, kind="stable")
    key, numbers, found = key[order], np.arange(len(x)), []
    for step in (s for s in (np.array(s) @ stride for s in product((-1, 0, 1), repeat=x.shape[1])) if s >= 0):
        begin, end = np.searchsorted(key, key + step), np.searchsorted(key, key + step, side="right")
        if (end - begin).max() > CROWD:
            return None
        for k in range((end - begin).max()):
            some = (begin + k < end) & ((step > 0) | (begin + k > numbers))
            found.append(np.stack([order[some], order[begin[some] + k]], axis=1))
    return np.concatenate(found)
