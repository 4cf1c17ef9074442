"""Facets: segments in 2D, triangles in 3D, and the solid that they enclose, for queries from Python."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..features.feature import Scene
from ..geometry.bounding_tree import BoundingTree, distance_bound, ray_entry_bound
from ..geometry.intervals import ROUNDING, dot, entry, rounded, rounding, triangle
from ..geometry.nearest import closest_facet_point, surface_normal
from .facet_shape import FacetShape

PIECES = 1 << 12  # of a solid on the way out of it, at most


@dataclass(frozen=True)
class Facets:
    """Facets in the frame of the collider that holds them; the order of a facet's corners determines which way it faces.

    corners: (m, dim, dim) [m]. features: (m, k) the numbers of the corners (and in 3D, from column 3, of the edges 01, 12, 20).
    wings: (feature, direction) pairs: the directions in which facets continue from a feature. facing: (features, dim) mean
    normals.
    closed: the facets enclose a volume. inside: particles are kept inside, so that the solid is all around.
    """

    host_only = ("_normals",)

    corners: np.ndarray
    features: np.ndarray
    wings: tuple[np.ndarray, np.ndarray]
    facing: np.ndarray
    closed: bool
    inside: bool

    @cached_property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the facets, (m, dim)."""
        return facet_normals(self.corners)

    @cached_property
    def _tree(self) -> BoundingTree:
        """The facets in a tree, made at the first query."""
        return BoundingTree(self.corners.min(axis=1), self.corners.max(axis=1))

    def on_device(self, scene: Scene, who: str, radius: float) -> "FacetShape":
        """Return the facets as fields."""
        return FacetShape(self, scene, who, radius)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances of points to the facets, (k,) [m], negative where the mean normal nearest to them points away."""
        corners = self.corners

        def distance(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Return the distances of points q[i] to facets f[i]."""
            r = points[q] - closest_facet_point(points[q], corners[f])[0]
            return np.sqrt(dot(r, r))

        length, f = self._tree.find_least(len(points), np.full(len(points), np.inf), distance_bound(points), distance)
        if self.closed and len(points):
            at, part = closest_facet_point(points, corners[f])
            facing = np.where((part < 0)[:, None], self.normals[f], self.facing[self.features[f, part]])
            length = np.where(dot(points - at, facing) < 0, -length, length)
        return length

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how far rays (k, dim) go until within `radius` of the facets from outside, (k,) [m], and normals (k, dim)."""
        distance, f = self._bare(origin, direction) if radius == 0 else self._thick(origin, direction, radius)
        met = f >= 0
        d, corners = direction[met], self.corners[f[met]]
        normal = np.full(origin.shape, np.nan)
        if radius == 0:
            n = self.normals[f[met]]
            normal[met] = np.where((dot(n, d) > 0)[:, None], -n, n)
        else:
            x = origin[met] + distance[met, None] * d
            normal[met] = surface_normal(x, closest_facet_point(x, corners)[0], d, np.zeros_like(d), np.zeros(len(d)))
        return distance, normal

    def _bare(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and facets of rays without thickness. A closed shape is entered through facets seen from the front."""
        corners, closed = self.corners, self.closed

        def enter(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Return where rays q[i] pass facets f[i]."""
            o, d, c = origin[q], direction[q], corners[f]
            t, _ = triangle(o, d, c)
            slope = dot(d, self.normals[f])
            with np.errstate(divide="ignore"):
                close = rounding(o, c[:, 0], c[:, 1]) / np.abs(slope)
            if not closed:
                return entry((t, t), close)
            return np.where((t >= -close) & (slope < 0), np.maximum(t, 0.0), np.inf)

        return self._tree.find_least(len(origin), np.full(len(origin), np.inf), ray_entry_bound(origin, direction, 0.0), enter)

    def _thick(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return distances and facets where rays first come within `radius`. A ray that starts in the solid leaves it first."""
        start = self._way_out(origin, direction, radius)
        distance, f = np.full(len(origin), np.inf), np.full(len(origin), -1)
        some = start < np.inf
        o, d = origin[some] + start[some, None] * direction[some], direction[some]
        corners = self.corners

        def enter(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Return where rays q[i] come within `radius` of facets f[i]."""
            c = corners[f]
            return entry(rounded(o[q], d[q], c, radius), rounding(o[q], c[:, 0], c[:, 1]) + ROUNDING * radius)

        more, f[some] = self._tree.find_least(len(o), np.full(len(o), np.inf), ray_entry_bound(o, d, radius), enter)
        distance[some] = start[some] + more
        return distance, f

    def _way_out(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> np.ndarray:
        """Return how far rays go until they leave the solid that they start in: 0 outside of it, inf where they never do."""
        close = rounding(origin) + ROUNDING * (np.abs(self.corners).max() + radius)
        t, going = np.zeros(len(origin)), np.arange(len(origin))
        if not (self.closed and self.inside):
            low, high = self.corners.min(axis=(0, 1)), self.corners.max(axis=(0, 1))
            going = np.flatnonzero(((origin > low - radius) & (origin < high + radius)).all(axis=1))
        for _ in range(PIECES):
            x = origin[going] + t[going, None] * direction[going]
            gap = self.clearance(x)
            within = gap < radius - close[going]
            going, x, deep = going[within], x[within], gap[within] < close[going][within] - radius
            if not len(going):
                break
            step = self._step_out(x, direction[going], radius, close[going], deep)
            t[going] += step
            going = going[(step > 0) & (step < np.inf)]
        return t

    def _step_out(self, x: np.ndarray, d: np.ndarray, radius: float, close: np.ndarray, deep: np.ndarray) -> np.ndarray:
        """Return the step from points in the solid to where they leave the surroundings of facets; if `deep`, enter these."""
        corners = self.corners
        to_boxes, out_of_boxes = ray_entry_bound(x, d, 0.0), ray_entry_bound(x, d, radius, exits=True)

        def bound(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
            """Return bounds of the values in boxes around facets."""
            return np.where(deep[q][:, None], to_boxes(q, low, high), out_of_boxes(q, low, high))

        def value(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Return where rays q[i] pass facets f[i]; or minus where they leave the surroundings, to find the last one."""
            out, some = np.full(len(q), np.inf), deep[q]
            enter, _ = triangle(x[q[some]], d[q[some]], corners[f[some]])
            out[some] = np.where(enter > close[q[some]], enter, np.inf)
            some = ~some
            enter, leave = rounded(x[q[some]], d[q[some]], corners[f[some]], radius)
            out[some] = np.where((enter <= close[q[some]]) & (leave > close[q[some]]), -leave, np.inf)
            return out

        step, f = self._tree.find_least(len(x), np.full(len(x), np.inf), bound, value)
        return np.where(f >= 0, np.abs(step), np.where(deep, np.inf, 0.0))


def facet_normals(corners: np.ndarray) -> np.ndarray:
    """Return unit normals of facets with corners (m, dim, dim)."""
    if corners.shape[1] == 2:
        u = corners[:, 1] - corners[:, 0]
        n = np.stack([u[:, 1], -u[:, 0]], axis=1)
    else:
        n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return n / np.linalg.norm(n, axis=1)[:, None]
