"""Pairs that contacts leave out: constraints say where the two are to each other.

These are the pairs of each constraint, and those that a chain of links holds closer than they reach, with lengths l at the start:

    sum l <= r_i + r_j

They overlap however the chain bends, while links are as long as they were, as a ball does with all of the rope that ends inside
of it, or beads thicker than the links between them are long with the next but one: a contact would push against the links for
good. Links that give way, or break, hold nothing there.
"""

from collections.abc import Sequence

import numpy as np

from ..features.feature import Batch
from ..geometry.ordered import distinct

DIGIT = 1e-6  # of a length: what beads that just touch may be off
FOLDED = 0.25  # of the smaller radius: a link that is shorter at the start has yet to get its length


def excluded_pairs(batches: Sequence[Batch], radius: np.ndarray) -> np.ndarray:
    """Pairs of particles with these radii (n,) [m] that never touch, (m, 2)."""
    own = [b.excluded_pairs(b.start) for b in batches]
    ties = [b.ties() for b in batches]
    links, lengths = (np.concatenate(some) for some in zip((np.zeros((0, 2), dtype=np.int32), np.zeros(0)), *ties, strict=True))
    return np.concatenate([np.zeros((0, 2), dtype=np.int32), *own, _inside(links, lengths, radius)])


def _inside(links: np.ndarray, lengths: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Pairs that chains of two links (m, 2) or more hold closer than their radii (n,) reach; lengths: (m,).

    Ways go out from the larger of two, for as long as they are shorter than it is wide.
    """
    some = lengths > FOLDED * radius[links].min(axis=1)
    if lengths[some].min(initial=np.inf) > (1 + DIGIT) * radius.max(initial=0.0):
        return np.zeros((0, 2), dtype=np.int32)
    i, j = np.concatenate([links[some], links[some][:, ::-1]]).T.astype(np.int64)
    n, far = len(radius), np.tile(lengths[some], 2) * (1 - DIGIT)
    order = np.argsort(i, kind="stable")
    i, j, far = i[order], j[order], far[order]
    begin, degree = np.searchsorted(i, np.arange(n)), np.bincount(i, minlength=n)
    least = np.full(n, np.inf)
    np.minimum.at(least, i, far)
    known, ways = np.zeros(0, dtype=np.int64), np.zeros(0)  # from a * n + to b, and how long
    a, b, way = i, j, far
    while len(a):
        goes = way + least[b] <= 2 * radius[a]
        a, b, way = a[goes], b[goes], way[goes]
        each = np.repeat(np.arange(len(a)), degree[b])
        link = begin[b[each]] + np.arange(len(each)) - np.repeat(np.cumsum(degree[b]) - degree[b], degree[b])
        a, b, way = a[each], j[link], way[each] + far[link]
        near = (way <= 2 * radius[a]) & (a != b)
        before = len(known)
        key, length = np.concatenate([known, a[near] * n + b[near]]), np.concatenate([ways, way[near]])
        shortest = np.lexsort([length, key])
        shortest = shortest[np.concatenate([[True], np.diff(key[shortest]) > 0])] if len(key) else shortest
        known, ways, new = key[shortest], length[shortest], shortest >= before
        a, b, way = known[new] // n, known[new] % n, ways[new]
    a, b = known // n, known % n
    close = (ways <= radius[a] + radius[b]) & (radius[b] <= radius[a])
    return distinct(np.sort(np.stack([a, b], axis=1)[close], axis=1))[0].astype(np.int32)
