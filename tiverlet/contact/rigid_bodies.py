"""Bodies that move as one in impacts: rigid clusters, and particles that rigid links fix to each other."""

from collections.abc import Iterator, Sequence
from operator import mul
from typing import Any

import numpy as np

from ..features.feature import Batch

FLAT = 1e-3  # of the largest extent: links in directions that extend no further fix no particle


def rigid_bodies(batches: Sequence[Batch], x: np.ndarray, inv_mass: np.ndarray) -> list[list[int]]:
    """Return the particles of each body, of particles at x, (n, dim) [m]. No particle is in two of them.

    A body grows from a rigid cluster, or from three particles that links join in a triangle. It takes in clusters with which it
    shares as many particles as fix them, and particles that as many links hold. What is compliant, breaks or is driven does not
    count. Bodies that share fewer particles hang on each other as by hinges, and what they share belongs to the first of them.
    """
    dim, links, clusters, at = x.shape[1], _links(batches), _clusters(batches), x.tolist()
    of: dict[int, list[int]] = {}
    for c, members in enumerate(clusters):
        for i in members:
            of.setdefault(i, []).append(c)
    taken, out = set[int](), []
    for seed, least in [*((members, 2) for members in clusters), *((three, dim + 1) for three in _triangles(links))]:
        if taken.isdisjoint(seed):
            body, waiting, shared = dict.fromkeys(seed), list(seed), dict[int, int]()
            while waiting:
                i = waiting.pop()
                new = [k for k in links.get(i, ()) if k not in body and _fixed(at, k, [m for m in links[k] if m in body])]
                for c in of.get(i, ()):
                    shared[c] = shared.get(c, 0) + 1
                    if shared[c] == min(dim, len(clusters[c])):
                        new += [k for k in clusters[c] if k not in body]
                body.update(dict.fromkeys(new))
                waiting += dict.fromkeys(new)
            own = [i for i in body if i not in taken]
            if len(own) >= least and (inv_mass[own] > 0).any():
                taken.update(own)
                out.append(own)
    return out


def _clusters(batches: Sequence[Any]) -> list[list[int]]:
    """Return the particles of all rigid clusters."""
    out = []
    for b in batches:
        if b.clusters and not b.breaks:
            rigid = np.broadcast_to(b.compliance == 0, b.count)
            first = np.searchsorted(b.owner, np.arange(b.count + 1))
            out += [b.indices[first[c] : first[c + 1]].tolist() for c in np.flatnonzero(rigid)]
    return out


def _links(batches: Sequence[Any]) -> dict[int, dict[int, None]]:
    """Return the particles to which rigid links hold each particle."""
    out: dict[int, dict[int, None]] = {}
    for b in batches:
        if getattr(getattr(b, "quantity", None), "is_distance", False) and b.side == 0 and not (b.breaks or b.driven):
            for i, j in b.indices[np.broadcast_to(b.compliance == 0, b.count)].tolist():
                out.setdefault(i, {})[j] = None
                out.setdefault(j, {})[i] = None
    return out


def _triangles(links: dict[int, dict[int, None]]) -> Iterator[list[int]]:
    """Yield each three particles that are linked to each other."""
    for i, others in links.items():
        for j in others:
            if i < j:
                yield from ([i, j, k] for k in links[j] if j < k and k in others)


def _fixed(x: Sequence[Sequence[float]], i: int, others: Sequence[int]) -> bool:
    """Whether links to these particles of a body fix particle i in it.

    The links d span all directions if the least eigenvalue of M = sum d d^T is not small beside its trace. If it is small, it is
    the determinant of M by the sum of the minors of one order less. Bodies have few particles, and there are many: NumPy's
    decomposition takes five times as long.
    """
    dim = len(x[i])
    if len(others) < dim:
        return False
    (a, b, c), (d, e), f = _moments([[p - q for p, q in zip(x[j], x[i], strict=True)] for j in others])
    trace, minors = a + d + f, a * d - b * b + a * f - c * c + d * f - e * e
    if dim == 2:
        return minors > FLAT**2 * trace**2
    return a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d) > FLAT**2 * trace * minors


def _moments(links: list[list[float]]) -> tuple[tuple[float, float, float], tuple[float, float], float]:
    """Return the sums of products of coordinates, row by row and without those that occur twice; z = 0 in 2D."""
    x, y, *rest = zip(*links, strict=True)
    z = rest[0] if rest else (0.0,) * len(x)
    return (_dot(x, x), _dot(x, y), _dot(x, z)), (_dot(y, y), _dot(y, z)), _dot(z, z)


def _dot(u: Sequence[float], v: Sequence[float]) -> float:
    return sum(map(mul, u, v))
