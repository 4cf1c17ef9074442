"""Particles and links as rays see them."""

import numpy as np

from ...geometry.bounding_tree import BoundingTree, ahead
from ...geometry.intervals import ball, capsule, entry, rounding
from ...geometry.nearest import away, on_segment


class Rods:
    """m rods with round ends from a to b, (m, dim) [m], of a radius (m,) [m]; without b, discs and spheres around a.

    They are convex, so a ray that starts inside of one has left it for good.
    """

    def __init__(self, radius: np.ndarray, a: np.ndarray, b: np.ndarray | None = None):
        self._discs = b is None
        b = a if b is None else b
        self._a, self._b, self._radius = a, b, radius
        reach = radius[:, None]
        self._tree = BoundingTree(np.minimum(a, b) - reach, np.maximum(a, b) + reach)

    def first(self, origin: np.ndarray, direction: np.ndarray, most: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far each ray goes until it enters one, (k,), within most (k,); and which, -1 where there is none."""

        def value(q: np.ndarray, i: np.ndarray) -> np.ndarray:
            """Where ray q[.] enters rod i[.]."""
            o, d, a, b, radius = origin[q], direction[q], self._a[i], self._b[i], self._radius[i]
            way = ball(o, d, a, radius) if self._discs else capsule(o, d, a, b, radius)
            return entry(way, rounding(o, a, b))

        return self._tree.first(len(origin), most, ahead(origin, direction, 0.0), value)

    def normal(self, point: np.ndarray, direction: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Unit normals at points (k, dim) on the surface of rods, met by rays in these directions."""
        a, b = self._a[which], self._b[which]
        return away(point, on_segment(point, a, b)[0], direction, b - a, rounding(point, a, b))
