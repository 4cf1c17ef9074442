"""How fast particles part that were placed into each other."""

from typing import TYPE_CHECKING

import numpy as np

from ..solvers.corners import bodies_of, components, corners_of

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene
    from .candidates import Candidates


def parting_speeds(
    scene: "Scene", batches: "list[Batch]", candidates: "Candidates", x: np.ndarray, first: int, push_out: float
) -> np.ndarray:
    """Return the speed at which particles at x (n, dim) [m] are to part from those that they overlap, (n,) [m/s].

    All pairs of a heap part at the same time. So if d pairs are between two of its particles, these part d times as fast as each
    pair. A pair parts at push_out / D, where D pairs are between the two particles that are farthest from each other: then the
    ends of a heap part at push_out, or at up to 1.7 times that, since pushes are over-relaxed. If each pair parted at push_out, a
    column of ten discs would throw its top one 5 m high.

    Only overlaps of particles with an index of `first` or more count. Bodies move as a whole, so they count as one particle. What
    cannot move connects nothing.
    """
    w, n = scene.inv_mass, len(x)
    overlap, _ = candidates.at(x)
    pairs = candidates.who[(overlap > 0) & (candidates.who >= first).any(axis=1), :2]
    node = np.arange(n)
    if tied := [b for b in batches if b.count and (b.arity > 1 or b.clusters)]:
        row, who = corners_of(tied)
        label, body = bodies_of(sum(b.count for b in tied), row, who, w)
        node = np.where(body < len(label), n + body, node)
    ends, fixed = node[pairs], w[pairs] == 0
    ends[fixed] = ends.max(initial=n) + 1 + np.arange(fixed.sum())  # each a particle of its own
    apart = ends[:, 0] != ends[:, 1]
    known, edges = np.unique(ends[apart], return_inverse=True)
    most = np.ones(max(n, int(ends.max(initial=0)), int(node.max(initial=0))) + 1, dtype=np.int64)
    most[known] = diameters(len(known), edges.reshape(-1, 2))
    return push_out / most[node]


def diameters(n: int, edges: np.ndarray) -> np.ndarray:
    """Return how many edges (m, 2) are between the two nodes of each piece of a graph that are farthest apart, (n,), per node.

    Each of the n nodes has an edge. The distance is from any node to the farthest one, and from that to the farthest one: exact
    in trees and lattices, and at least half of the diameter elsewhere.
    """
    both = np.concatenate([edges, edges[:, ::-1]])
    both = both[np.argsort(both[:, 0], kind="stable")]
    begin, other = np.searchsorted(both[:, 0], np.arange(n + 1)), both[:, 1]
    label = components(n, edges.ravel(), np.repeat(np.arange(len(edges)), 2))
    _, start, piece = np.unique(label, return_index=True, return_inverse=True)
    far = _distances(start, begin, other)
    order = np.lexsort((far, piece))
    ends = order[np.append(np.flatnonzero(np.diff(piece[order])), n - 1)] if n else order
    most = np.zeros(len(start), dtype=np.int64)
    np.maximum.at(most, piece, _distances(ends, begin, other))
    return most[piece]


def _distances(start: np.ndarray, begin: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return how many edges each node is away from the nearest node in `start`. Node k has the neighbours other[begin[k] :
    begin[k + 1]]."""
    out, front, k = np.full(len(begin) - 1, -1), start, 0
    while len(front):
        out[front] = k
        count = begin[front + 1] - begin[front]
        at = np.repeat(begin[front] - np.cumsum(count) + count, count) + np.arange(count.sum())
        front, k = np.unique(other[at]), k + 1
        front = front[out[front] < 0]
    return out
