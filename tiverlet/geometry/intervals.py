"""Intervals of a straight line inside convex shapes: the distances at which it enters and leaves, (inf, -inf) if it misses.

A line is origin + t direction, with a unit direction. Origins, directions and shapes have one row per line, (m, dim). A line that
only grazes a shape, within rounding, enters and leaves it at the same distance.
"""

import numpy as np

ROUNDING = 2.0**-44  # of the largest length in a result: a sum of some terms, each rounded to 2^-53 of its size
PARALLEL = 2.0**-96  # square of the sine of an angle that is only rounding

Interval = tuple[np.ndarray, np.ndarray]


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the dot products of rows."""
    return np.einsum("...i,...i->...", a, b)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of rows (m, 3), bit for bit those of np.cross, which takes three times as long."""
    x, y, z = a.T
    u, v, w = b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def cross_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products of rows (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def rounding(*vectors: np.ndarray) -> np.ndarray:
    """Return the rounding error of results that are computed from these rows, (m,) [m]."""
    size = np.abs(vectors[0]).max(axis=-1)
    for v in vectors[1:]:
        size = np.maximum(size, np.abs(v).max(axis=-1))
    return ROUNDING * size


def entry(interval: Interval, close: np.ndarray) -> np.ndarray:
    """Return the distance at which a ray enters; inf where it does not.

    A ray does not enter a shape in which it starts. A ray that starts on the surface, within `close`, enters at 0 if it leads
    into the shape; but not where the interval ends there, as for a shape without thickness.
    """
    enter, leave = interval
    with np.errstate(invalid="ignore"):
        return np.where((enter >= -close) & (leave > close), np.maximum(enter, 0.0), np.inf)


def exit_of(interval: Interval, close: np.ndarray) -> np.ndarray:
    """Return the distance at which a ray leaves the shape; inf where it does not, 0 where it leaves at its start."""
    enter, leave = interval
    with np.errstate(invalid="ignore"):
        return np.where((leave >= -close) & (enter < leave), np.maximum(leave, 0.0), np.inf)


def union(*intervals: Interval) -> Interval:
    """Return the union of intervals of the pieces of one convex shape."""
    enter, leave = intervals[0]
    for a, b in intervals[1:]:
        enter, leave = np.minimum(enter, a), np.maximum(leave, b)
    return enter, leave


def intersection(*intervals: Interval) -> Interval:
    """Return the intersection of intervals."""
    enter, leave = intervals[0]
    for a, b in intervals[1:]:
        enter, leave = np.maximum(enter, a), np.minimum(leave, b)
    return _unless_missed(enter > leave, enter, leave)


def ball(origin: np.ndarray, direction: np.ndarray, center: np.ndarray, radius) -> Interval:
    """Return the intervals within `radius` of a center. A radius below 0 gives none."""
    m = origin - center
    middle = -dot(m, direction)
    return _chord(middle, m + middle[:, None] * direction, np.ones(len(m)), radius, rounding(m, origin))


def capsule(origin: np.ndarray, direction: np.ndarray, a: np.ndarray, b: np.ndarray, radius) -> Interval:
    """Return the intervals within `radius` of the segment from a to b: a cylinder and two balls."""
    axis = b - a
    length = np.sqrt(dot(axis, axis))
    u = axis / np.where(length > 0, length, 1.0)[:, None]
    m = origin - a
    along, speed = dot(m, u), dot(direction, u)
    mp, dp = m - along[:, None] * u, direction - speed[:, None] * u
    square = dot(dp, dp)
    is_parallel = square <= PARALLEL
    square = np.where(is_parallel, 1.0, square)
    middle = np.where(is_parallel, 0.0, -dot(mp, dp) / square)
    close = rounding(m, origin, axis)
    enter, leave = _chord(middle, mp + middle[:, None] * np.where(is_parallel[:, None], 0.0, dp), square, radius, close)
    within = enter <= leave
    enter, leave = np.where(is_parallel & within, -np.inf, enter), np.where(is_parallel & within, np.inf, leave)
    rod = intersection((enter, leave), slab(along, speed, -close, length + close))
    return union(rod, ball(origin, direction, a, radius), ball(origin, direction, b, radius))


def slab(place: np.ndarray, speed: np.ndarray, low, high, close: np.ndarray | float = 0.0) -> Interval:
    """Return the intervals of t with low <= place + t speed <= high, up to infinity. close: as near as this is on a bound."""
    is_parallel = speed == 0
    inverse = 1.0 / np.where(is_parallel, 1.0, speed)
    below, above = low - place, high - place
    below, above = np.where(np.abs(below) <= close, 0.0, below), np.where(np.abs(above) <= close, 0.0, above)
    one, two = below * inverse, above * inverse
    inside = (below <= 0) & (above >= 0)
    enter = np.where(is_parallel, np.where(inside, -np.inf, np.inf), np.minimum(one, two))
    leave = np.where(is_parallel, np.where(inside, np.inf, -np.inf), np.maximum(one, two))
    return _unless_missed((enter > leave) | (below > above), enter, leave)


def box(origin: np.ndarray, direction: np.ndarray, low: np.ndarray, high: np.ndarray, close: np.ndarray) -> Interval:
    """Return the intervals inside a box between two corners (dim,)."""
    return intersection(*(slab(origin[:, k], direction[:, k], low[k], high[k], close) for k in range(origin.shape[1])))


def triangle(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> Interval:
    """Return the intervals (of length 0) at which lines hit facets, corners (m, dim, dim): triangles, or segments in 2D.

    Lines cannot pass between adjacent facets: the side on which a line passes a corner (2D) or an edge (3D) is computed bit for
    bit alike for all facets that share it.
    """
    if origin.shape[1] == 2:
        sides = cross_2d(direction[:, None], corners - origin[:, None])
        sides = np.stack([sides[:, 0], -sides[:, 1]], axis=1)
        edge = corners[:, 1] - corners[:, 0]
        normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    else:
        r = corners - origin[:, None]
        sides = dot(direction[:, None], np.cross(r, r[:, [1, 2, 0]]))  # cross(b, a) is -cross(a, b) bit for bit
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = dot(normal, direction)
    hit = ((sides >= 0).all(axis=1) | (sides <= 0).all(axis=1)) & (across != 0)
    t = dot(normal, corners[:, 0] - origin) / np.where(hit, across, 1.0)
    return _unless_missed(~hit, t, t)


def rounded(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray, radius) -> Interval:
    """Return the intervals within `radius` of facets, corners (m, dim, dim): capsules around the edges, and in 3D a prism."""
    if origin.shape[1] == 2:
        return capsule(origin, direction, corners[:, 0], corners[:, 1], radius)
    edges = [capsule(origin, direction, corners[:, k], corners[:, (k + 1) % 3], radius) for k in range(3)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.sqrt(dot(normal, normal))[:, None]
    high = np.broadcast_to(radius, len(origin))
    sides = [slab(dot(origin - corners[:, 0], normal), dot(direction, normal), -high, high)]
    for k in range(3):
        out = np.cross(corners[:, (k + 1) % 3] - corners[:, k], normal)
        sides.append(slab(dot(origin - corners[:, k], out), dot(direction, out), -np.inf, np.zeros(len(origin))))
    return union(intersection(*sides), *edges)


def _chord(middle: np.ndarray, off: np.ndarray, square: np.ndarray, radius, close: np.ndarray) -> Interval:
    """Return where lines of speed sqrt(square) are within `radius` of a center; middle, off: nearest parameter, vector there."""
    h = np.sqrt(dot(off, off))
    half = np.sqrt(np.maximum((radius - h) * (radius + h), 0.0) / square)
    return _unless_missed((h > radius + close) | (np.asarray(radius) < 0), middle - half, middle + half)


def _unless_missed(missed: np.ndarray, enter: np.ndarray, leave: np.ndarray) -> Interval:
    return np.where(missed, np.inf, enter), np.where(missed, -np.inf, leave)
