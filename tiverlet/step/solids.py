"""Clusters as rigid bodies, when the host moves particles: moves of their particles become moves of the whole cluster."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .block_matrix import summed
from .integrator import h2_effective_of
from .rigid_rows import HEAVY


class Solids:
    """The clusters of a world that share no particle with another one, at positions x (n, dim).

    Each keeps the shape that it has there, but for what passes have left undone of it, Z as in projection.py: ratio^2 of that
    stays. Particle k belongs to owner[k] and is who[k], of mass m[k]. worst: |Z|, as a share of the radius of its cluster.
    """

    def __init__(self, runner: Any, x: np.ndarray, ratio: float):
        w, h, clusters = runner.scene.inv_mass, runner.clock.h, [b for b in runner.batches if b.clusters and b.count]
        degree = np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices for b in clusters)]), minlength=len(w))
        self.count, self.free, self.worst = 0, (w > 0)[:, None], 0.0
        parts = []
        for b in clusters:
            some = (np.maximum.reduceat(degree[b.indices], b.members.starts[:-1]) == 1) & ~b.idle(w) & ~b.broken
            if some.any():
                owner = self.count + np.cumsum(some) - 1
                columns = b.indices, owner[b.owner], *_state(b, w, h, h2_effective_of(runner.clock))
                parts.append([column[some[b.owner]] for column in columns])
                self.count += int(some.sum())
        if not self.count:
            return
        self.who, self.owner, q, last, pull, now, give = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        m = np.divide(1, w[self.who], out=np.zeros(len(self.who)), where=w[self.who] > 0)
        self.m = np.where(m > 0, m, HEAVY * np.bincount(self.owner, m)[self.owner])
        self.total = np.bincount(self.owner, self.m)
        self.shape = q - self._means(q)
        off, turn = x[self.who] - self._placed(x), self.turn[self.owner]
        off, pull = np.einsum("kba,kb->ka", turn, off), np.einsum("kba,kb->ka", turn, pull)
        undone = now[:, None] * off + (1 - now)[:, None] * last + give[:, None] * pull
        radius = np.sqrt(np.bincount(self.owner, self.m * (self.shape**2).sum(axis=1)) / self.total)[self.owner]
        self.worst = float(np.divide(np.linalg.norm(undone, axis=1), radius, out=np.zeros_like(radius), where=radius > 0).max())
        self.shape = self.shape + off - (1 - ratio**2) * undone

    def _means(self, values: np.ndarray) -> np.ndarray:
        """Return the mass-weighted mean over its body, for each particle."""
        return np.stack([np.bincount(self.owner, self.m * v) / self.total for v in values.T], axis=1)[self.owner]

    def _placed(self, x: np.ndarray) -> np.ndarray:
        """Return the positions of the shapes where they fit best to positions x (Kabsch 1976)."""
        center = self._means(x[self.who])
        moment = self._summed((x[self.who] - center)[:, :, None] * self.shape[:, None, :])
        u, _, vt = np.linalg.svd(moment)
        u[:, :, -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
        self.turn = u @ vt
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


def _state(batch: Any, w: np.ndarray, h: float, h2_effective: float) -> tuple[np.ndarray, ...]:
    """Return for each corner the rest shape, the last deformation and the pull, (corners, dim), and two weights, (corners,).

    The weights are those of the present deformation and of the pull in the residual of passes. See ShapeMatch and Equation for
    the symbols.
    """
    read, spring, owner = batch.scene.memory.read, batch.dev.spring, batch.owner
    mass = np.divide(1, w[batch.indices], out=np.zeros(len(owner)), where=w[batch.indices] > 0)
    alpha, total = batch.compliance, np.bincount(owner, mass)
    reach = h * h * np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    theta = np.divide(reach**2, reach**2 + alpha**2, out=np.zeros_like(reach), where=reach > 0)
    q, pull = (read(field)[: len(owner)].astype(np.float64) for field in (batch.dev.shape, batch.dev.pull))
    last = read(spring.last)[: len(owner)].astype(np.float64) if spring.soft else np.zeros_like(q)
    return q, last, pull, (theta + batch.damping * alpha / h)[owner], (alpha * total / h2_effective)[owner]
