"""How far rigid clusters are from their shapes, as the host sees it."""

from typing import Any

import numpy as np

from ..geometry import rotation

SEEN, BORNE = 1e-3, 4.0  # of the radius: out of shape by more, and by so many times what loads do to a cluster


class Solids:
    """Rigid clusters, with the shapes that they have at rest.

    Corner k is particle who[k] of cluster owner[k], with the mass m[k], at shape[k] about the center of mass. radius: of gyration
    of its cluster [m]. worst: the largest deformation by loads, as a share of the radius.
    """

    def __init__(self, batches: list[Any], w: np.ndarray):
        """Take the rigid clusters that are not broken and can move. w: (n,) inverse masses."""
        some = [(b, (b.compliance == 0) & ~b.immovable(w) & ~b.broken) for b in batches if b.clusters and b.count]
        parts = [_corners(b, mask) for b, mask in some if mask.any()]
        self.count, self.worst = sum(1 + int(part[1].max()) for part in parts), 0.0
        if not self.count:
            return
        first = np.cumsum([0, *(1 + int(part[1].max()) for part in parts)])
        self.owner = np.concatenate([part[1] + k for part, k in zip(parts, first, strict=False)])
        self.who, q, pull = (np.concatenate([part[k] for part in parts]) for k in (0, 2, 3))
        self.free = w[self.who] > 0
        m = np.divide(1, w[self.who], out=np.zeros(len(self.who)), where=self.free)
        self.m = np.where(self.free, m, rotation.HEAVY * np.bincount(self.owner, m)[self.owner])
        self.total = np.bincount(self.owner, self.m)
        self.shape = q - self._means(q)
        self.radius = np.sqrt(np.bincount(self.owner, self.m * (self.shape**2).sum(axis=1)) / self.total)[self.owner]
        # Passes undo in each substep the deformation that loads have caused; clusters with a particle share that.
        self.worst = float(self._shares(pull * np.bincount(self.who)[self.who, None]).max())

    @property
    def borne(self) -> float:
        """How far they may be from their shapes under their loads, as a share of the radius."""
        return max(SEEN, BORNE * self.worst)

    def far(self, x: np.ndarray) -> np.ndarray:
        """Return how far movable corners at x, (n, dim), are from the best fit of their cluster's shape, as shares of its radius,
        (corners,)."""
        p = x[self.who]
        center = self._means(p)
        moment = np.zeros((self.count, x.shape[1], x.shape[1]))
        np.add.at(moment, self.owner, self.m[:, None, None] * (p - center)[:, :, None] * self.shape[:, None, :])
        u, _, vt = np.linalg.svd(moment)  # the rotation of the fit, Kabsch 1976
        u[..., -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[..., None]
        fitted = center + np.einsum("kab,kb->ka", (u @ vt)[self.owner], self.shape)
        return self._shares(np.where(self.free[:, None], p - fitted, 0.0))

    def _means(self, values: np.ndarray) -> np.ndarray:
        """Return the mean over its cluster, weighted by mass, for each corner."""
        return np.stack([np.bincount(self.owner, self.m * v) / self.total for v in values.T], axis=1)[self.owner]

    def _shares(self, way: np.ndarray) -> np.ndarray:
        """Return the lengths of vectors of corners, as shares of the radius of their cluster, (corners,)."""
        return np.divide(np.linalg.norm(way, axis=1), self.radius, out=np.zeros_like(self.radius), where=self.radius > 0)


def first_off(batches: list[Any], w: np.ndarray, x: np.ndarray) -> int | None:
    """The first particle of rigid clusters that are out of shape at x, (n, dim); None where none is."""
    solids = Solids(batches, w)
    return min(solids.who[solids.far(x) > solids.borne].tolist(), default=None) if solids.count else None


def _corners(b: Any, some: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the particles, clusters, rest shapes and pulls of the corners of the clusters in the mask `some`, (m,)."""
    read, corners = b.scene.memory.read, some[b.owner]
    owner = (np.cumsum(some) - 1)[b.owner[corners]]
    shape, pull = (read(field)[: len(b.owner)][corners].astype(np.float64) for field in (b.dev.shape, b.dev.pull))
    return b.indices[corners], owner, shape, pull
