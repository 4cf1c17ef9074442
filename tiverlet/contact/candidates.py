"""Possible contacts where the host moves particles: overlaps and their gradients, in NumPy."""

from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    pass

NONE = -2.0  # in near_contact(): the place on an edge where there is no contact


class Candidates(Protocol):
    """m possible contacts: some overlap, others may overlap once particles have moved.

    who: (m, k), the particles of each. size: (m,) [m], the length relative to which an overlap is deep.
    """

    who: np.ndarray
    size: np.ndarray

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return overlaps (m,) [m] at positions x (n, dim) [m], and the gradients (m, k, dim) of C = -overlap.

        Overlaps are negative where particles are apart.
        """
        ...


class NoCandidates:
    """No possible contacts: particles touch nothing but walls."""

    who, size = np.zeros((0, 2), dtype=np.int64), np.zeros(0)

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return no overlaps and no gradients."""
        return self.size, np.zeros((0, 2, x.shape[1]))


class EdgeCandidates:
    """Vertices v and edges from a to b; or corners that touch as discs do, where b is a (2D).

    C = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) + allowed, as in Polygons. A vertex is over the edge that
    pushed it last, even if another edge is nearer now, or else over the edge that PolygonGeometry finds. A vertex that touched
    nothing may come in over an edge that it was in front of, or over a corner.

    pairs: (m, 2), v and a. found: (m, 4), overlap, t and normal at positions x. discs: the value of t for discs. pushed: (m,),
    whether the pair was pushed apart in the last substep. ends: (n, 2), the next and the previous particle around the body of
    each particle, -1 without a body. body: (n,), its number. allowed: (m,), the allowed overlap [m].
    """

    def __init__(
        self, x: np.ndarray, pairs: np.ndarray, found: np.ndarray, discs: float, pushed: np.ndarray, ends: np.ndarray,
        body: np.ndarray, radius: np.ndarray, allowed: np.ndarray,
    ):  # fmt: skip
        self.radius, self.ends = radius, ends
        (v, a), after, lone = pairs.T, ends[:, 0], ends[:, 0] < 0
        both = v * (body.max(initial=0) + 1) + body[a]
        told = ~lone[a] & np.isin(both, both[pushed & ~lone[a]])  # a push of this vertex by this body shows where it came in
        touches = found[:, 0] > 0
        known = np.where(told, pushed, touches)
        at_edge = np.where(touches, found[:, 1] > discs, ~lone[a] & ~((radius[v] + radius[a] > 0) & self._corners(x, v, a)))
        keeps = np.where(lone[v] == lone[a], v < a, lone[v]) & (radius[v] + radius[a] > 0)  # one entry of two discs
        kinds = known & at_edge, ~known & ~lone[a], known & ~at_edge & keeps, ~known & keeps
        some = np.concatenate([np.flatnonzero(kind) for kind in kinds])
        known_edge, fresh_edge, _, fresh_disc = np.repeat(np.eye(4, dtype=bool), [kind.sum() for kind in kinds], axis=1)
        v, a, normal, self.allowed = v[some], a[some], found[some, 2:], allowed[some]
        edge = known_edge | fresh_edge
        self.who = np.stack([v, a, np.where(edge, after[a], a)], axis=1)
        # A vertex that has passed an inner corner goes back over that corner: the normal is not that of the edge.
        edges = x[self.who[:, 2]] - x[a]
        inner = known_edge & touches[some] & ((normal * edges).sum(axis=1) > 0.01 * np.linalg.norm(edges, axis=1))
        self.who[inner, 2] = a[inner]
        self.sign, self.edge = np.where(inner, -1.0, 1.0), edge & ~inner
        self.fresh_edge, self.fresh_disc = fresh_edge, fresh_disc
        self.low, self.high = np.zeros(len(v)), np.ones(len(v))
        overlap, _, place = self._measured(x)
        self.low[known_edge], self.high[known_edge] = np.minimum(place, 0)[known_edge], np.maximum(place, 1)[known_edge]
        behind = fresh_edge & (overlap > 0)
        for name in ("who", "allowed", "sign", "edge", "fresh_edge", "fresh_disc", "low", "high"):
            setattr(self, name, vars(self)[name][~behind])
        v, a, b = self.who.T
        self.size = np.where(self.edge, np.linalg.norm(x[b] - x[a], axis=1), radius[v] + radius[a]) / 2

    def _measured(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return overlaps [m], normals, and the place of each vertex along the line of its edge, 0 at a and 1 at b."""
        v, a, b = self.who.T
        r, u, one = x[v] - x[a], x[b] - x[a], np.ones(len(v))
        uu, rr = (u**2).sum(axis=1), (r**2).sum(axis=1)
        place = np.divide((r * u).sum(axis=1), uu, out=0 * one, where=self.edge & (uu > 0))
        t = np.clip(place, self.low, self.high)
        n = np.where(self.edge[:, None], np.stack([u[:, 1], -u[:, 0]], axis=1), self.sign[:, None] * r)
        size = np.sqrt(np.where(self.edge, uu, rr))
        n = np.divide(n, size[:, None], out=np.zeros_like(n), where=size[:, None] > 0)
        reach = self.radius[v] + (1 - t) * self.radius[a] + t * self.radius[b] - self.allowed
        return reach - (r * n).sum(axis=1), n, place

    def at(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return overlaps (m,) [m] and the gradients of C (m, 3, 2) by v, a and b.

        A vertex that touched nothing and is beside no edge has neither an overlap nor a gradient.
        """
        overlap, n, place = self._measured(x)
        t = np.clip(place, self.low, self.high)
        none = self.fresh_edge & (t != place)
        none[self.fresh_disc] = ~self._corners(x, *self.who[self.fresh_disc, :2].T)
        overlap[none], n[none] = 0.0, 0.0
        return overlap, np.stack([n, (t - 1)[:, None] * n, -t[:, None] * n], axis=1)

    def _corners(self, x: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Whether each of the particles v and a is in front of a corner of the other, beside none of its edges, (m,)."""
        out = np.ones(len(v), dtype=bool)
        for i, j in ((v, a), (a, v)):
            after, before = self.ends[j].T
            r, u, w = x[i] - x[j], x[after] - x[j], x[before] - x[j]
            outer = u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0] >= 0
            out &= (after < 0) | (((r * u).sum(axis=1) <= 0) & ((r * w).sum(axis=1) <= 0) & outer)
        return out
