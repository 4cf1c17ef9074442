"""Clusters as bodies that the host moves: what moves their particles moves them as a whole."""

from typing import Any

import numpy as np

from .rigid_rows import HEAVY


class Solids:
    """The clusters of a world that share no particle with each other, at positions x (n, dim), by their particles.

    Each keeps its shape: that at rest and, times `kept`, how far from it x are; all of it where the cluster is soft. Particle k
    belongs to owner[k] and is who[k], of mass m[k].
    """

    def __init__(self, batches: list, w: np.ndarray, x: np.ndarray, kept: float):
        clusters = [b for b in batches if b.clusters and b.count]
        degree = np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices for b in clusters)]), minlength=len(w))
        who, mass, sizes, shape, share = [], [], [], [], []
        for b in clusters:
            alone = np.maximum.reduceat(degree[b.indices], b.members.starts[:-1]) == 1
            for c in np.flatnonzero(alone & ~b.idle(w) & ~b.broken).tolist():
                some = b.members_of(c).astype(np.int64)
                m = np.divide(1, w[some], out=np.zeros(len(some)), where=w[some] > 0)
                who.append(some)
                mass.append(np.where(m > 0, m, HEAVY * m.sum()))
                sizes.append(len(some))
                shape.append(b.shape_of(c))
                share.append(np.full(len(some), 1.0 if b.compliance[c] else kept))
        self.count, self.free = len(sizes), (w > 0)[:, None]
        if self.count:
            self.who, self.m, self.owner = np.concatenate(who), np.concatenate(mass), np.repeat(np.arange(self.count), sizes)
            self.total = np.bincount(self.owner, self.m)
            q = np.concatenate(shape)
            self.shape = q - self._means(q)
            off = x[self.who] - self._placed(x)
            self.shape = self.shape + np.concatenate(share)[:, None] * np.einsum("kba,kb->ka", self.turn[self.owner], off)

    def _means(self, values: np.ndarray) -> np.ndarray:
        """Means over bodies, by their masses, for each of their particles."""
        return np.stack([np.bincount(self.owner, self.m * v) / self.total for v in values.T], axis=1)[self.owner]

    def _placed(self, x: np.ndarray) -> np.ndarray:
        """Where shapes are that fit best to positions x (Kabsch 1976)."""
        center = self._means(x[self.who])
        moment = np.zeros((self.count, x.shape[1], x.shape[1]))
        np.add.at(moment, self.owner, self.m[:, None, None] * (x[self.who] - center)[:, :, None] * self.shape[:, None, :])
        u, _, vt = np.linalg.svd(moment)
        u[:, :, -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
        self.turn = u @ vt
        return center + np.einsum("kab,kb->ka", self.turn[self.owner], self.shape)

    def fitted(self, x: np.ndarray) -> np.ndarray:
        """Positions x, with all bodies in shape."""
        out = x.copy()
        if self.count:
            out[self.who] = self._placed(x)
        return np.where(self.free, out, x)

    def off(self, x: np.ndarray) -> float:
        """How far particles are from these: sum of m times the square."""
        return float((self.m * ((x - self.fitted(x))[self.who] ** 2).sum(axis=1)).sum()) if self.count else 0.0

    def at(self, x: np.ndarray):
        """What makes moves (n, dim) of particles at x moves of bodies, of the same momentum and angular momentum."""
        if not self.count:
            return None
        r = x[self.who] - self._means(x[self.who])
        dim = x.shape[1]
        spins = [(a, b) for a in range(dim) for b in range(a)]  # planes
        turned = np.zeros((len(r), len(spins), dim))  # what a turn in each plane moves
        for k, (a, b) in enumerate(spins):
            turned[:, k, a], turned[:, k, b] = -r[:, b], r[:, a]
        inertia = np.zeros((self.count, len(spins), len(spins)))
        np.add.at(inertia, self.owner, self.m[:, None, None] * np.einsum("kia,kja->kij", turned, turned))
        inverse = np.linalg.pinv(inertia, hermitian=True)

        def project(moves: np.ndarray) -> np.ndarray:
            p = moves[self.who]
            L = np.zeros((self.count, len(spins)))
            np.add.at(L, self.owner, self.m[:, None] * np.einsum("kia,ka->ki", turned, p))
            omega = np.einsum("cij,cj->ci", inverse, L)
            out = moves.copy()
            out[self.who] = self._means(p) + np.einsum("kia,ki->ka", turned, omega[self.owner])
            return np.where(self.free, out, moves)

        return project
