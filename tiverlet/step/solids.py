"""Clusters as rigid bodies, when the host moves particles: moves of their particles become moves of the whole cluster."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..solvers.corners import bodies_of, corners_of
from .jacobian import summed
from .joined_clusters import Copies, joined
from .rotation import best_rotation

HEAVY = 1024  # masses of the cluster: the mass of a particle that cannot move
SEEN, BORNE = 1e-3, 4.0  # of the radius: out of shape by more, and by so many times what loads do to a cluster


class Solids:
    """Clusters, or bodies of several ones, with the shapes that they have at rest.

    Each has its own copy of the particles that several of them share, and all positions and moves are those of copies. Corner k
    belongs to cluster owner[k] and is copy who[k], of mass m[k]. worst: the largest deformation by loads, as a share of
    the radius of its cluster.
    """

    def __init__(self, w: np.ndarray, parts: list[tuple[np.ndarray, ...]]):
        """Declare bodies. w: (n,) inverse masses. parts: for each batch the particle, cluster and rest shape of each corner."""
        self.count, self.inverse, self.worst = sum(1 + int(owner.max()) for _, owner, *_ in parts), w, 0.0
        if not self.count:
            return
        first = np.cumsum([0, *(1 + int(owner.max()) for _, owner, *_ in parts)])
        who, q = (np.concatenate([part[k] for part in parts]) for k in (0, 2))
        self.copies = Copies(who, w)
        self.who, w = self.copies.who, self.copies.w
        self.free = (w > 0)[:, None]
        self.owner = np.concatenate([owner + k for (_, owner, *_), k in zip(parts, first, strict=False)])
        m = np.divide(1, w[self.who], out=np.zeros(len(self.who)), where=w[self.who] > 0)
        self.m = np.where(m > 0, m, HEAVY * np.bincount(self.owner, m)[self.owner])
        self.total = np.bincount(self.owner, self.m)
        self.shape = q - self._means(q)
        self.radius = np.sqrt(np.bincount(self.owner, self.m * (self.shape**2).sum(axis=1)) / self.total)[self.owner]

    @staticmethod
    def rigid(batches: list[Any], w: np.ndarray, first: int = 0) -> "Solids":
        """Return the rigid clusters with any particle from `first` on, and those that share particles with them, at rest.

        worst: deformation by loads.
        """
        found = [(b, some & (b.compliance == 0)) for b, some in _movable(batches, w)]
        found = [(b, some) for b, some in found if some.any()]
        parts = []
        for (b, some), reached in zip(found, _reached([b for b, _ in found], [some for _, some in found], w, first), strict=True):
            if reached.any():
                read, corners = b.scene.memory.read, len(b.owner)
                columns = b.indices, b.owner, read(b.dev.shape)[:corners], read(b.dev.pull)[:corners].astype(np.float64)
                parts.append(_of(b, reached, columns))
        out = Solids(w, parts)
        if out.count:  # passes undo in each substep the deformation that loads have caused; clusters with a particle share that
            pull = np.concatenate([part[3] for part in parts])
            out.worst = float(out._shares(pull * out.copies.count[out.copies.particle[out.who]][:, None]).max())
        return out

    def joined(self) -> "Solids":
        """Return the bodies of clusters that can only move together."""
        if not self.copies.shared:
            return self
        return Solids(self.inverse, [joined(self.copies.particle[self.who], self.owner, self.shape)])

    def _shares(self, way: np.ndarray) -> np.ndarray:
        """Return the lengths of vectors of corners, as shares of the radius of their cluster, (corners,)."""
        return np.divide(np.linalg.norm(way, axis=1), self.radius, out=np.zeros_like(self.radius), where=self.radius > 0)

    @property
    def borne(self) -> float:
        """How far rigid ones may be from their shapes under their loads, as a share of the radius."""
        return max(SEEN, BORNE * self.worst)

    def far(self, x: np.ndarray) -> np.ndarray:
        """Return how far movable particles at x are from the best fit of their cluster's shape, as shares of its radius."""
        return self._shares(np.where(self.free, x - self.fitted(x), 0.0)[self.who]) if self.count else np.zeros(0)

    def _means(self, values: np.ndarray) -> np.ndarray:
        """Return the mass-weighted mean over its body, for each particle."""
        return np.stack([np.bincount(self.owner, self.m * v) / self.total for v in values.T], axis=1)[self.owner]

    def _placed(self, x: np.ndarray) -> np.ndarray:
        """Return the positions of the shapes where they fit best to positions x."""
        center = self._means(x[self.who])
        moment = self._summed((x[self.who] - center)[:, :, None] * self.shape[:, None, :])
        self.turn = best_rotation(moment)
        return center + np.einsum("kab,kb->ka", self.turn[self.owner], self.shape)

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Return the sums over bodies of m times matrices or vectors of particles."""
        weighted = self.m[:, None] * values.reshape(len(self.m), -1)
        return summed(weighted.reshape(values.shape), self.owner, len(self.total))

    def fitted(self, x: np.ndarray) -> np.ndarray:
        """Return positions x with all bodies put into their shapes."""
        if not self.count:
            return x
        out = x.copy()
        out[self.who] = self._placed(x)
        return np.where(self.free, out, x)

    def off(self, x: np.ndarray) -> float:
        """Return the sum of m times the square of the distances from x to fitted(x)."""
        return float((self.m * ((x - self.fitted(x))[self.who] ** 2).sum(axis=1)).sum()) if self.count else 0.0

    def whole(self, x: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
        """Return a function that projects moves, (n, dim), of particles at x on moves of whole bodies; None without clusters.

        Momentum and angular momentum stay the same.
        """
        if not self.count:
            return None
        r, dim = x[self.who] - self._means(x[self.who]), x.shape[1]
        turned = np.zeros((len(r), dim * (dim - 1) // 2, dim))  # what a turn in each plane moves
        for k, (a, b) in enumerate(zip(*np.triu_indices(dim, 1), strict=True)):
            turned[:, k, a], turned[:, k, b] = -r[:, b], r[:, a]
        inverse = np.linalg.pinv(self._summed(np.einsum("kia,kja->kij", turned, turned)), hermitian=True)

        def project(moves: np.ndarray) -> np.ndarray:
            """Return moves projected on those of whole bodies; moves of other particles stay."""
            p, out = moves[self.who], moves.copy()
            omega = np.einsum("cij,cj->ci", inverse, self._summed(np.einsum("kia,ka->ki", turned, p)))
            out[self.who] = self._means(p) + np.einsum("kia,ki->ka", turned, omega[self.owner])
            return np.where(self.free, out, moves)

        return project


def first_off(batches: list[Any], w: np.ndarray, x: np.ndarray) -> int | None:
    """The first particle of rigid clusters that are out of shape at x, (n, dim); None where none is."""
    solids = Solids.rigid(batches, w)
    if not solids.count:
        return None
    off = solids.far(solids.copies.lift(x)) > solids.borne
    return min(solids.copies.particle[solids.who[off]].tolist(), default=None)


def _movable(batches: list[Any], w: np.ndarray) -> list[tuple[Any, np.ndarray]]:
    """Return each batch of clusters, and the mask, (m,), of those that are not broken and can move."""
    return [(b, ~b.immovable(w) & ~b.broken) for b in batches if b.clusters and b.count]


def _reached(batches: list[Any], some: list[np.ndarray], w: np.ndarray, first: int) -> list[np.ndarray]:
    """Return masks of the clusters in the masks `some`, (m,), that movable particles connect to a particle from `first` on."""
    if not (first and batches):
        return some
    owner, who = corners_of(batches)
    corners = np.concatenate(some)[owner]
    label, _ = bodies_of(sum(map(len, some)), owner[corners], who[corners], w)
    here = np.bincount(label[owner], who >= first, minlength=len(label)) > 0
    cuts = np.cumsum([b.count for b in batches])[:-1]
    return [mask & reached for mask, reached in zip(some, np.split(here[label], cuts), strict=True)]


def _of(batch: Any, some: np.ndarray, columns: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Return the columns (particles, owners, others) for the clusters in the mask `some`, (m,), with owners renumbered."""
    who, owner, *others = (column[some[batch.owner]] for column in columns)
    return who, (np.cumsum(some) - 1)[owner], *others
