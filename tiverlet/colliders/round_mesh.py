"""Round surfaces as triangles, for pictures."""

import numpy as np

AROUND, ALONG = 32, 8  # corners of a circle, and steps from the pole to the equator


def rounded(a: np.ndarray, b: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface at `radius` from the line from a to b: vertices (v, 3) and triangles (t, 3). A ball where a is b."""
    axis = np.asarray(b, dtype=np.float64) - a
    length = float(np.linalg.norm(axis))
    up = axis / length if length else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    turn, lift = np.linspace(0, 2 * np.pi, AROUND, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 2 * ALONG + 1)
    lift = np.concatenate([lift[: ALONG + 1], lift[ALONG:]])  # the equator twice: once at each end
    ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(up, side)
    ends = np.repeat([a, b], ALONG + 1, axis=0)
    points = ends[:, None] + radius * (np.cos(lift)[:, None, None] * ring + np.sin(lift)[:, None, None] * up)
    k, j = np.meshgrid(np.arange(len(lift) - 1), np.arange(AROUND), indexing="ij")
    here, right, row = (k * AROUND + j).ravel(), (k * AROUND + (j + 1) % AROUND).ravel(), AROUND
    faces = np.concatenate([np.stack([here, right, right + row], axis=1), np.stack([here, right + row, here + row], axis=1)])
    return points.reshape(-1, 3), faces
