"""Whether particles overlap when a world is built: what is known then need not be compiled for twice."""

from itertools import product

import numpy as np

from ..features.feature import Batch, Scene

MANY = 20_000  # particles for which it is not worth the time
CROWD = 16  # in a cell, likewise


def overlapping(scene: Scene, batches: list[Batch]) -> bool:
    """Whether discs or spheres overlap, one of them free to move, by more than what f32 rounds; what is linked never touches.

    False also where finding out would take long.
    """
    x, radius, free = scene.particles.position, scene.particles.radius, scene.inv_mass > 0
    if not 1 < len(x) <= MANY:
        return False
    cell, close = 2 * radius.max(), 2.0**-20 * float(np.abs(x).max() + radius.max())
    place = np.floor((x - x.min(axis=0)) / cell) + 1
    size = place.max(axis=0) + 2
    if size.prod() >= 2.0**53:
        return False
    stride = np.concatenate([[1.0], np.cumprod(size[:-1])])
    key = place @ stride
    order = np.argsort(key, kind="stable")
    key, numbers, found = key[order], np.arange(len(x)), []
    for step in (s for s in (np.array(s) @ stride for s in product((-1, 0, 1), repeat=x.shape[1])) if s >= 0):
        begin, end = np.searchsorted(key, key + step), np.searchsorted(key, key + step, side="right")
        if (end - begin).max() > CROWD:
            return False
        for k in range((end - begin).max()):
            some = (begin + k < end) & ((step > 0) | (begin + k > numbers))
            i, j = order[some], order[begin[some] + k]
            near = ((x[i] - x[j]) ** 2).sum(axis=1) < np.maximum(radius[i] + radius[j] - close, 0) ** 2
            found.append(np.stack([i, j], axis=1)[near & (free[i] | free[j])])
    pairs = np.concatenate(found)
    if not len(pairs):
        return False
    linked = np.concatenate([*(b.excluded_pairs(b.start) for b in batches), pairs[:0]])
    some, without = (np.sort(p, axis=1).astype(np.int64) @ [len(x), 1] for p in (pairs, linked))
    return not np.isin(some, without).all()
