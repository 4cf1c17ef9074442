"""What facets enclose, as the host sees it: which points are inside, and where rays come in."""

from typing import TYPE_CHECKING

import numpy as np

from ..geometry.bounding_tree import BoundingTree, ahead, apart
from ..geometry.intervals import ROUNDING, dot, entry, rounded, rounding, triangle
from ..geometry.nearest import away, on_facet

if TYPE_CHECKING:
    from .facets import Facets


class FacetSolid:
    """Facets in the frame of the collider that holds them, in a tree; the solid is what is behind them, or near to them."""

    def __init__(self, facets: "Facets"):
        self._facets = facets
        self._tree = BoundingTree(facets.corners.min(axis=1), facets.corners.max(axis=1))
        self._normals, self._size = facets.normals, float(np.abs(facets.corners).max())

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """The distance of points to the facets, (k,) [m]; negative behind them where they are closed.

        Behind is where the mean normal of the nearest facet, edge or corner points away from (Baerentzen and Aanaes 2005).
        """
        corners = self._facets.corners

        def distance(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Of point q[i] to facet f[i]."""
            r = points[q] - on_facet(points[q], corners[f])[0]
            return np.sqrt(dot(r, r))

        length, f = self._tree.first(len(points), np.full(len(points), np.inf), apart(points), distance)
        if self._facets.closed and len(points):
            at, part = on_facet(points, corners[f])
            facing = np.where((part < 0)[:, None], self._normals[f], self._facets.facing[self._facets.features[f, part]])
            length = np.where(dot(points - at, facing) < 0, -length, length)
        return length

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """How far rays go until they come within `radius` of the facets from outside, (k,) [m], and the normals, (k, dim)."""
        distance, f = self._bare(origin, direction) if radius == 0 else self._thick(origin, direction, radius)
        met = f >= 0
        d, corners = direction[met], self._facets.corners[f[met]]
        normal = np.full(origin.shape, np.nan)
        if radius == 0:
            n = self._normals[f[met]]
            normal[met] = np.where((dot(n, d) > 0)[:, None], -n, n)
        else:
            x = origin[met] + distance[met, None] * d
            normal[met] = away(x, on_facet(x, corners)[0], d, np.zeros_like(d), np.zeros(len(d)))
        return distance, normal

    def _bare(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances, and which facets: of closed ones those that are seen from in front."""
        corners, closed = self._facets.corners, self._facets.closed

        def enter(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Where ray q[i] passes facet f[i]."""
            o, d, c = origin[q], direction[q], corners[f]
            t, _ = triangle(o, d, c)
            slope = dot(d, self._normals[f])
            with np.errstate(divide="ignore"):
                close = rounding(o, c[:, 0], c[:, 1]) / np.abs(slope)
            if not closed:
                return entry((t, t), close)
            return np.where((t >= -close) & (slope < 0), np.maximum(t, 0.0), np.inf)

        return self._tree.first(len(origin), np.full(len(origin), np.inf), ahead(origin, direction, 0.0), enter)

    def _thick(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """The same: the first facet whose surroundings are entered, by rays that start outside of the solid."""
        corners = self._facets.corners

        def enter(q: np.ndarray, f: np.ndarray) -> np.ndarray:
            """Where ray q[i] comes near facet f[i]."""
            o, c = origin[q], corners[f]
            return entry(rounded(o, direction[q], c, radius), rounding(o, c[:, 0], c[:, 1]) + ROUNDING * radius)

        distance, f = self._tree.first(len(origin), np.full(len(origin), np.inf), ahead(origin, direction, radius), enter)
        close = rounding(origin) + ROUNDING * (self._size + radius)
        for k in np.flatnonzero(self.clearance(origin) < radius - close):
            distance[k], f[k] = self._from_inside(origin[k], direction[k], radius, close[k])
        return distance, f

    def _from_inside(self, origin: np.ndarray, direction: np.ndarray, radius: float, close: float) -> tuple[float, int]:
        """Where a ray that starts in the solid comes in again: after the first gap in the intervals of it that are solid."""
        corners = self._facets.corners
        o, d = np.broadcast_to(origin, (len(corners), len(origin))), np.broadcast_to(direction, (len(corners), len(origin)))
        enter, leave = rounded(o, d, corners, radius)
        number = np.arange(len(corners))
        if self._facets.closed:
            t = np.unique(triangle(o, d, corners)[0])
            ends = np.concatenate([[0.0], t[(t > 0) & (t < np.inf)], [np.inf]])
            far = ends[-2] + self._size
            middle = np.append((ends[:-2] + ends[1:-1]) / 2, far)
            behind = self.clearance(origin + middle[:, None] * direction) < 0
            enter, leave = np.append(enter, ends[:-1][behind]), np.append(leave, ends[1:][behind])
            number = np.append(number, np.full(int(behind.sum()), -1))
        there = leave > close
        order = np.argsort(enter[there], kind="stable")
        enter, leave, number = enter[there][order], leave[there][order], number[there][order]
        until = np.maximum.accumulate(np.append(0.0, leave))[:-1]
        again = np.flatnonzero((enter > until + close) & (number >= 0))
        return (float(enter[again[0]]), int(number[again[0]])) if len(again) else (np.inf, -1)
