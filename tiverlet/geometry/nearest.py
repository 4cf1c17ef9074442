"""Nearest points of segments and triangles, and normals there."""

import numpy as np

from .intervals import dot


def closest_segment_point(x: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of the segment from a to b nearest to x, (m, dim) [m], and its parameter, (m,), 0 at a and 1 at b."""
    axis = b - a
    square = dot(axis, axis)
    t = np.clip(dot(x - a, axis) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return np.where((t == 1)[:, None], b, a + t[:, None] * axis), t


def closest_facet_point(x: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the point of a facet, corners (m, dim, dim), nearest to x, (m, dim) [m], and the part of the facet, (m,).

    Parts: corners are 0, 1 (and 2 in 3D); the edges 01, 12, 20 in 3D are 3, 4, 5; the inside is -1.
    """
    dim = x.shape[1]
    if dim == 2:
        point, t = closest_segment_point(x, corners[:, 0], corners[:, 1])
        return point, np.where(t == 0, 0, np.where(t == 1, 1, -1))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    over = np.ones(len(x), dtype=bool)
    best, point, part = np.full(len(x), np.inf), x, np.zeros(len(x), dtype=int)
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        over &= dot(np.cross(normal, b - a), x - a) > 0
        p, t = closest_segment_point(x, a, b)
        square = dot(x - p, x - p)
        nearer = square < best
        best, point = np.where(nearer, square, best), np.where(nearer[:, None], p, point)
        part = np.where(nearer, np.where(t == 0, k, np.where(t == 1, (k + 1) % 3, 3 + k)), part)
    foot = x - (dot(x - corners[:, 0], normal) / dot(normal, normal))[:, None] * normal
    return np.where(over[:, None], foot, point), np.where(over, -1, part)


def surface_normal(
    point: np.ndarray, nearest: np.ndarray, direction: np.ndarray, along: np.ndarray, close: np.ndarray
) -> np.ndarray:
    """Return unit normals (m, dim) at points of a rounded surface.

    point, nearest: the point, and the nearest point of the core inside the surface, (m, dim) [m]. Where both agree within
    `close`, the normal is opposite to the ray's `direction`, at right angles to `along`.
    """
    r = point - nearest
    size = np.sqrt(dot(r, r))
    square = dot(along, along)
    back = -direction + (dot(direction, along) / np.where(square > 0, square, 1.0))[:, None] * along
    back = np.where((np.sqrt(dot(back, back)) > 2.0**-40)[:, None], back, -direction)
    n = np.where((size > close)[:, None], r / np.where(size > 0, size, 1.0)[:, None], back)
    return n / np.sqrt(dot(n, n))[:, None]
