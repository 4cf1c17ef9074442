"""Clusters as bodies that the host moves: what moves their particles moves them as a whole."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .block_matrix import summed
from .integrator import h2_effective_of
from .rigid_rows import HEAVY


class Solids:
    """Clusters that share no particle with another one, as they are at rest, or as they hang together under their loads.

    Particle k belongs to owner[k] and is who[k], of mass m[k]. worst: by how much passes have left their shapes undone, as a
    share of the radius of a cluster.
    """

    def __init__(self, w: np.ndarray, parts: list[tuple[np.ndarray, ...]]):
        """w: inverse masses, (n,). parts: of each batch, who its particles are, of which of its clusters each is, and shapes."""
        self.count, self.free, self.worst = sum(1 + int(owner.max()) for _, owner, *_ in parts), (w > 0)[:, None], 0.0
        if not self.count:
            return
        first = np.cumsum([0, *(1 + int(owner.max()) for _, owner, *_ in parts)])
        self.who, q = (np.concatenate([part[k] for part in parts]) for k in (0, 2))
        self.owner = np.concatenate([owner + k for (_, owner, *_), k in zip(parts, first, strict=False)])
        m = np.divide(1, w[self.who], out=np.zeros(len(self.who)), where=w[self.who] > 0)
        self.m = np.where(m > 0, m, HEAVY * np.bincount(self.owner, m)[self.owner])
        self.total = np.bincount(self.owner, self.m)
        self.shape = q - self._means(q)
        self.radius = np.sqrt(np.bincount(self.owner, self.m * (self.shape**2).sum(axis=1)) / self.total)[self.owner]

    @staticmethod
    def loaded(runner: Any, x: np.ndarray, ratio: float) -> "Solids":
        """Each keeps the shape that it has at x, (n, dim), but for what passes have left undone of it, Z as in projection.py:
        ratio^2 of that stays."""
        w, h, h2_effective = runner.scene.inv_mass, runner.clock.h, h2_effective_of(runner.clock)
        found = [(b, some) for b, some in _apart(runner.batches, w) if some.any()]
        columns = [(b.indices, b.owner, *_state(b, w, h, h2_effective)) for b, _ in found]
        parts = [_of(b, some, rows) for (b, some), rows in zip(found, columns, strict=True)]
        out = Solids(w, parts)
        if out.count:
            last, pull, now, give = (np.concatenate([part[k] for part in parts]) for k in range(3, 7))
            off, turn = x[out.who] - out._placed(x), out.turn[out.owner]
            off, pull = np.einsum("kba,kb->ka", turn, off), np.einsum("kba,kb->ka", turn, pull)
            undone = now[:, None] * off + (1 - now)[:, None] * last + give[:, None] * pull
            out.worst = float(out._shares(undone).max())
            out.shape = out.shape + off - (1 - ratio**2) * undone
        return out

    @staticmethod
    def rigid(batches: list[Any], w: np.ndarray, first: int = 0) -> "Solids":
        """Rigid ones as they are at rest, with any of the particles from number `first` on. worst: what loads leave of that."""
        parts = []
        for b, some in _apart(batches, w):
            some &= (b.compliance == 0) & (np.maximum.reduceat(b.indices, b.members.starts[:-1]) >= first)
            if some.any():
                read, corners = b.scene.memory.read, len(b.owner)
                columns = b.indices, b.owner, read(b.dev.shape)[:corners], read(b.dev.pull)[:corners].astype(np.float64)
                parts.append(_of(b, some, columns))
        out = Solids(w, parts)
        if out.count:  # what passes take back in each substep is what others have moved before
            out.worst = float(out._shares(np.concatenate([part[3] for part in parts])).max())
        return out

    def _shares(self, way: np.ndarray) -> np.ndarray:
        """Of vectors of particles: lengths as shares of the radius of their cluster."""
        return np.divide(np.linalg.norm(way, axis=1), self.radius, out=np.zeros_like(self.radius), where=self.radius > 0)

    def far(self, x: np.ndarray) -> np.ndarray:
        """How far those that can move are from the shape of their cluster where it fits best to x, as shares of its radius."""
        return self._shares(np.where(self.free, x - self.fitted(x), 0.0)[self.who]) if self.count else np.zeros(0)

    def _means(self, values: np.ndarray) -> np.ndarray:
        """Means over bodies, by their masses, for each of their particles."""
        return np.stack([np.bincount(self.owner, self.m * v) / self.total for v in values.T], axis=1)[self.owner]

    def _placed(self, x: np.ndarray) -> np.ndarray:
        """Where shapes are that fit best to positions x (Kabsch 1976)."""
        center = self._means(x[self.who])
        moment = self._summed((x[self.who] - center)[:, :, None] * self.shape[:, None, :])
        u, _, vt = np.linalg.svd(moment)
        u[:, :, -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[:, None]
        self.turn = u @ vt
        return center + np.einsum("kab,kb->ka", self.turn[self.owner], self.shape)

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Sums over bodies of m times matrices or vectors of particles."""
        weighted = self.m[:, None] * values.reshape(len(self.m), -1)
        return summed(weighted.reshape(values.shape), self.owner, len(self.total))

    def fitted(self, x: np.ndarray) -> np.ndarray:
        """Positions x, with all bodies in shape."""
        if not self.count:
            return x
        out = x.copy()
        out[self.who] = self._placed(x)
        return np.where(self.free, out, x)

    def off(self, x: np.ndarray) -> float:
        """How far particles are from these: the sum of m times the square."""
        return float((self.m * ((x - self.fitted(x))[self.who] ** 2).sum(axis=1)).sum()) if self.count else 0.0

    def whole(self, x: np.ndarray) -> Callable[[np.ndarray], np.ndarray] | None:
        """What makes moves of particles at x, (n, dim), moves of bodies, with the same momentum and angular momentum."""
        if not self.count:
            return None
        r, dim = x[self.who] - self._means(x[self.who]), x.shape[1]
        turned = np.zeros((len(r), dim * (dim - 1) // 2, dim))  # what a turn in each plane moves
        for k, (a, b) in enumerate(zip(*np.triu_indices(dim, 1), strict=True)):
            turned[:, k, a], turned[:, k, b] = -r[:, b], r[:, a]
        inverse = np.linalg.pinv(self._summed(np.einsum("kia,kja->kij", turned, turned)), hermitian=True)

        def project(moves: np.ndarray) -> np.ndarray:
            """The moves of whole bodies, others as they are."""
            p, out = moves[self.who], moves.copy()
            omega = np.einsum("cij,cj->ci", inverse, self._summed(np.einsum("kia,ka->ki", turned, p)))
            out[self.who] = self._means(p) + np.einsum("kia,ki->ka", turned, omega[self.owner])
            return np.where(self.free, out, moves)

        return project


def _apart(batches: list[Any], w: np.ndarray) -> list[tuple[Any, np.ndarray]]:
    """Of each batch of clusters, those that share no particle with others, are whole, and can move, a mask (m,)."""
    clusters = [b for b in batches if b.clusters and b.count]
    degree = np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices for b in clusters)]), minlength=len(w))
    return [
        (b, (np.maximum.reduceat(degree[b.indices], b.members.starts[:-1]) == 1) & ~b.immovable(w) & ~b.broken) for b in clusters
    ]


def _of(batch: Any, some: np.ndarray, columns: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """The rows of some of its clusters, a mask (m,), which are numbered anew: particles, owners, and what else there is."""
    who, owner, *others = (column[some[batch.owner]] for column in columns)
    return who, (np.cumsum(some) - 1)[owner], *others


def _state(batch: Any, w: np.ndarray, h: float, h2_effective: float) -> tuple[np.ndarray, ...]:
    """By corners: the shape at rest, the deformation before and what moved each, (corners, dim), the share of the present
    deformation in what passes see, and what a multiplier gives. See ShapeMatch and Equation for the letters."""
    read, spring, owner = batch.scene.memory.read, batch.dev.spring, batch.owner
    mass = np.divide(1, w[batch.indices], out=np.zeros(len(owner)), where=w[batch.indices] > 0)
    alpha, total = batch.compliance, np.bincount(owner, mass)
    reach = h * h * np.divide(1, total, out=np.zeros_like(total), where=total > 0)
    theta = np.divide(reach**2, reach**2 + alpha**2, out=np.zeros_like(reach), where=reach > 0)
    q, pull = (read(field)[: len(owner)].astype(np.float64) for field in (batch.dev.shape, batch.dev.pull))
    last = read(spring.last)[: len(owner)].astype(np.float64) if spring.soft else np.zeros_like(q)
    return q, last, pull, (theta + batch.damping * alpha / h)[owner], (alpha * total / h2_effective)[owner]
