"""Bodies as loops of particles, in NumPy: orientation, edge lengths, and particles that start inside of them (2D)."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from .. import checks


def checked(loops: Iterable) -> list[np.ndarray]:
    """Return the particles of each body, checked: at least 3 in a body, and no particle twice."""
    loops = checks.rows("Polygons", "loops", loops, "a sequence of index sequences, one for each body,")
    if len(loops) and np.ndim(loops[0]) == 0:
        raise TypeError(f"Polygons: loops = {loops!r} is one body; write a list of bodies, [[...]].")
    out = [checks.indices("Polygons", f"loops[{k}]", loop, checks.ANY) for k, loop in enumerate(loops)]
    seen: dict[int, int] = {}
    for k, loop in enumerate(out):
        if len(loop) < 3:
            raise ValueError(f"Polygons: loops[{k}] has {len(loop)} particles, but a body needs at least 3.")
        for i in loop.tolist():
            if i in seen:
                raise ValueError(f"Polygons: particle {i} is in loops[{seen[i]}] and again in loops[{k}]; once is enough.")
            seen[i] = k
    return out


def laid(loops: list[np.ndarray], x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the arrays of an Outline for particles at x (n, 2) [m], and refuse flat loops.

    These are the next and the previous particle, counterclockwise (n, 2), the number of the loop (n,), both -1 in no loop, the
    length of the longer edge (n,) [m], and thinnest() (n,) [m].
    """
    n = len(x)
    ends, body, longer = np.full((n, 2), -1), np.full(n, -1), np.zeros(n)
    if not loops:
        return ends, body, longer, np.zeros(n)
    corner, begin, owner = flat(loops)
    if corner.max() >= n:
        k = int(owner[np.argmax(corner >= n)])
        checks.indices("Polygons", f"loops[{k}]", loops[k], n)
    after, before = corner[turned(begin, 1)], corner[turned(begin, -1)]
    v = x[corner] - (np.add.reduceat(x[corner], begin[:-1]) / np.diff(begin)[:, None])[owner]
    w = v[turned(begin, 1)]
    area = np.add.reduceat(v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0], begin[:-1]) / 2
    extent = (np.maximum.reduceat(x[corner], begin[:-1]) - np.minimum.reduceat(x[corner], begin[:-1])).max(axis=1)
    edge = np.linalg.norm(x[after] - x[corner], axis=1)
    thin, short = np.abs(area) <= 1e-9 * extent**2, edge <= 1e-6 * extent[owner]
    if thin.any() or short.any():
        k = int(np.argmax(thin | (np.bincount(owner, short) > 0)))
        if thin[k]:
            raise ValueError(
                f"Polygons: loops[{k}] encloses {area[k]:g} m^2; its particles are on a line, or not in order around it. "
                "A shape has its corners in order in its loops: shape.loops[0] + n for particles from n on."
            )
        m = int(begin[k] + np.argmin(edge[begin[k] : begin[k + 1]]))
        raise ValueError(f"Polygons: particles {corner[m]} and {after[m]} of loops[{k}] are in the same place.")
    left = area[owner] > 0
    ends[corner, 0], ends[corner, 1], body[corner] = np.where(left, after, before), np.where(left, before, after), owner
    before = edge[turned(begin, -1)]
    longer[corner] = np.maximum(edge, before)
    return ends, body, longer, thinnest(x, ends[:, 0], ends[:, 1])


def thinnest(x: np.ndarray, after: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return how thin a body is at each particle and its edges, (n,) [m]; 0 for particles in no body.

    That is the length of an edge, or a way through the body from a corner to another edge. after, before: the next and the
    previous particle, counterclockwise, -1 in no body.
    """
    z: Any = x @ [1, 1j]
    u, back = z[after] - z, z[before] - z  # conj(u) w = u . w + i u x w
    convex, length, corner = (u.conj() * back).imag > 0, np.abs(u), np.flatnonzero(after >= 0)
    at_corner, at_edge = np.where(after >= 0, np.minimum(length, length[before]), 0), np.where(after >= 0, length, 0)
    v, a = corner, after[corner]
    while len(v):  # the edge from a is one further from its corner v in each turn
        ends = after[a] == v
        if ends.any():
            v, a = v[~ends], a[~ends]
        r = z[v] - z[a]
        t = np.clip((u[a].conj() * r).real / length[a] ** 2, 0, 1)
        way, along = t * u[a] - r, ((a == after[v]) & (t == 0)) | ((after[a] == before[v]) & (t == 1))
        left, right = (u[v].conj() * way).imag > 0, (way.conj() * back[v]).imag > 0
        inward = (left & right) | ((left | right) & ~convex[v])
        width = np.where(inward & ~along, np.abs(way), np.inf)
        at_corner[v], at_edge[a] = np.minimum(at_corner[v], width), np.minimum(at_edge[a], width)
        a = after[a]
    return np.minimum(at_corner, np.minimum(at_edge, at_edge[before]))


def flat(loops: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the corners of one or more loops in one array, the offsets of loops (k + 1,), and the loop of each corner."""
    begin = np.concatenate([[0], np.cumsum([len(loop) for loop in loops])])
    return np.concatenate(loops), begin, np.repeat(np.arange(len(loops)), np.diff(begin))


def turned(begin: np.ndarray, by: int) -> np.ndarray:
    """Return the position of the next (by = 1) or previous (-1) corner around the loop, for each corner. begin: of flat()."""
    out = np.arange(begin[-1]) + by
    first, last = (begin[:-1], begin[1:] - 1) if by > 0 else (begin[1:] - 1, begin[:-1])
    out[last] = first
    return out


def refuse_deep(
    loops: list[np.ndarray], x: np.ndarray, first: int, left_out: Callable[[int, np.ndarray], bool] = lambda i, loop: False
) -> None:  # fmt: skip
    """Raise ValueError if a particle of index `first` or more is deeper inside of a body than half of its nearest edge.

    left_out: whether a particle touches no corner of a loop, as a hub that is tied to all of them.
    """
    if not loops or first >= len(x):
        return
    corner, begin, _ = flat(loops)
    low, high = (of.reduceat(x[corner], begin[:-1]) for of in (np.minimum, np.maximum))
    for k in np.flatnonzero(((low <= x[first:].max(axis=0)) & (high >= x[first:].min(axis=0))).all(axis=1)).tolist():
        some = ((x >= low[k]) & (x <= high[k])).all(axis=1)
        some[:first] = some[loops[k]] = False
        for i in np.flatnonzero(some).tolist():
            depth, edge = depth_of(x[i], x[loops[k]])
            if depth > edge / 2 and not left_out(i, loops[k]):
                raise ValueError(
                    f"Polygons: particle {i} starts {depth:.3g} m inside of loops[{k}], deeper than half of the nearest edge "
                    f"({edge:.3g} m), so there is no telling where it came from. Move it out, or tie it to all corners of "
                    "this loop, as a hub, or by tv.ShapeMatch over them and it; links to its neighbours are not enough."
                )


def depth_of(point: np.ndarray, loop: np.ndarray) -> tuple[float, float]:
    """Return how deep a point is inside of a loop [m], 0 outside, and the length of the nearest edge [m]."""
    a, b = loop, np.roll(loop, -1, axis=0)
    u, r = b - a, point - a
    length = np.linalg.norm(u, axis=1)
    t = np.clip((r * u).sum(axis=1) / length**2, 0, 1)
    distance = np.linalg.norm(r - t[:, None] * u, axis=1)
    k = int(np.argmin(distance))
    above = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        right = a[:, 0] + r[:, 1] / u[:, 1] * u[:, 0] > point[0]
    return (float(distance[k]) if (above & right).sum() % 2 else 0.0), float(length[k])
