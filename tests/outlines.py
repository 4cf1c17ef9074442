"""Polygons and meshes of which walls are made, and distances of points to them by brute force."""

import numpy as np

SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
STAR = np.array([[(1.0 if k % 2 else 0.35) * f(np.pi * k / 5) for f in (np.cos, np.sin)] for k in range(10)])
CUBE = np.array([[a, b, c] for a in (-1.0, 1) for b in (-1.0, 1) for c in (-1.0, 1)])
CUBE_FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7),
    (1, 7, 3),
]  # fmt: skip


def outside(points: np.ndarray, loop: np.ndarray, closed: bool = True) -> np.ndarray:
    """Return the distance of points to a polygon, negative inside, by brute force."""
    a, b = loop, np.roll(loop, -1, axis=0)
    if not closed:
        a, b = a[:-1], b[:-1]
    u, r = b - a, points[:, None] - a
    t = np.clip((r * u).sum(axis=2) / (u * u).sum(axis=1), 0, 1)
    distance = np.linalg.norm(r - t[..., None] * u, axis=2).min(axis=1)
    if not closed:
        return distance
    low, high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    y = points[:, None, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = a[:, 0] + (y - a[:, 1]) / u[:, 1] * u[:, 0] > points[:, None, 0]
    return np.where((cross & (low <= y) & (y < high)).sum(axis=1) % 2, -distance, distance)
