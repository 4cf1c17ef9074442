"""Rigid clusters as scalar constraints: their deformations, in the frame of the cluster."""

import functools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

HEAVY = 1024  # masses of the cluster: the mass of a particle that cannot move
WIDEST = 60  # coordinates of a cluster: for larger matrices LAPACK's bits depend on the number of threads
NONE = 1e-9  # of the largest singular value: below, a motion is zero up to rounding


class RigidRows:
    """Rows that hold all deformations of some rigid clusters at 0. projection.Rows uses them like a batch of Scalar.

    With D_i = R^T (x_i - c) - q_i for the best fit c, R of a cluster, C_r = sum_i m_i B_ri . D_i. B_r is a basis, orthonormal in
    the metric of the masses, of all displacements that are not rigid motions. To first order changes of R and c do not matter:
    grad_i C_r = m_i R B_ri.
    """

    side, breaks = 0, False

    def __init__(self, batch: Any, w: np.ndarray, some: np.ndarray):
        self.clusters = [Cluster(batch, c, w) for c in np.flatnonzero(some).tolist()]
        self.count = sum(len(c.basis) for c in self.clusters)
        who = [(c.who, len(c.basis)) for c in self.clusters]
        self.indices = np.concatenate([*(np.tile(members, m) for members, m in who), np.zeros(0, dtype=np.int64)])
        self.owner = np.repeat(np.arange(self.count), [len(members) for members, m in who for _ in range(m)])
        self.compliance = self.damping = self.rest_now = np.zeros(self.count)
        self.broken = np.zeros(self.count, dtype=bool)
        self.start, self.dev = batch.start, SimpleNamespace(spring=SimpleNamespace(soft=False))

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of immovable rows, (m,): none, because clusters that cannot move are left out already."""
        return np.zeros(self.count, dtype=bool)

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return C at positions x, (m,)."""
        return np.concatenate([np.einsum("rka,ka->r", c.basis, c.strain(x)[1]) for c in self.clusters])

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients at all corners, (total, dim)."""
        return np.concatenate([(c.basis @ c.strain(x)[0].T).reshape(-1, x.shape[1]) for c in self.clusters])

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """Return the factors that turn C into a share of the size of its cluster, (m,)."""
        return np.concatenate([np.full(len(c.basis), c.close) for c in self.clusters])


class Cluster:
    """A cluster: its particles and masses (k,), its rest shape (k, dim) about its center, and its radius [m].

    w: (n,) inverse masses.
    """

    def __init__(self, batch: Any, c: int, w: np.ndarray):
        self.who = batch.members_of(c).astype(np.int64)
        free = w[self.who] > 0
        m = np.divide(1, w[self.who], out=np.zeros(len(free)), where=free)
        self.mass = np.where(free, m, HEAVY * m.sum())
        q = batch.shape_of(c)
        self.shape = q - self.mass @ q / self.mass.sum()
        self.radius = np.sqrt(self.mass @ (self.shape**2).sum(axis=1) / self.mass.sum())
        self.free = free

    @functools.cached_property
    def basis(self) -> np.ndarray:
        """The basis of deformations times the masses, m B, (rows, k, dim)."""
        q, root = self.shape, np.sqrt(self.mass)
        dim = q.shape[1]
        shifts = [np.tile(e, (len(q), 1)) for e in np.eye(dim)]
        turns = [np.outer(q[:, b], np.eye(dim)[a]) - np.outer(q[:, a], np.eye(dim)[b])
                 for a, b in zip(*np.triu_indices(dim, 1), strict=True)]  # fmt: skip
        motions = np.stack([(root[:, None] * motion).ravel() for motion in (*shifts, *turns)], axis=1)
        u, s, _ = np.linalg.svd(motions, full_matrices=True)
        rest = u[:, (s > NONE * s[0]).sum() :].T.reshape(-1, len(q), dim) * root[:, None]
        return rest[(rest[:, self.free] != 0).any(axis=(1, 2))]

    @property
    def close(self) -> float:
        """The factor that turns a row's C into a share of the size of the cluster."""
        return 1 / (self.radius * np.sqrt(self.mass[self.free].min())) if self.radius > 0 else 0.0

    def strain(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R, and D (k, dim), at positions x (Kabsch 1976)."""
        p = x[self.who] - self.mass @ x[self.who] / self.mass.sum()
        u, _, vt = np.linalg.svd((self.mass[:, None] * p).T @ self.shape)
        u[:, -1] *= np.sign(np.linalg.det(u @ vt)) or 1.0
        R = u @ vt
        return R, p @ R - self.shape


def rigid_rows(batches: list, w: np.ndarray, every: bool = False) -> list[RigidRows]:
    """Return rows of the rigid clusters that share particles with other constraints, or, with `every`, of all rigid clusters.

    Passes leave clusters that share particles violated. Large clusters get no rows, see WIDEST.
    """
    rows = [RigidRows(b, w, some & ~_wide(b)) for b, some in _coupled(batches, w, every) if (some & ~_wide(b)).any()]
    return [some for some in rows if some.count]


def left_out(batches: list, w: np.ndarray, x: np.ndarray) -> float:
    """Return the largest deviation of a particle from the rest shape, in radii, for clusters that are too large for rows."""
    worst = 0.0
    for b, some in _coupled(batches, w):
        for c in np.flatnonzero(some & _wide(b)).tolist():
            cluster = Cluster(b, c, w)
            far = np.linalg.norm(cluster.strain(x)[1], axis=1).max()
            worst = max(worst, float(far / cluster.radius) if cluster.radius > 0 else 0.0)
    return worst


def _coupled(batches: list, w: np.ndarray, every: bool = False) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each batch and the mask of its rigid clusters that share particles with other constraints; with `every`, of all."""
    degree = np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices.ravel() for b in batches)]), minlength=len(w))
    for b in batches:
        if b.clusters and b.count:
            shares = every | (np.maximum.reduceat(degree[b.indices], b.members.starts[:-1]) > 1)
            yield b, (b.compliance == 0) & ~b.broken & ~b.immovable(w) & shares


def _wide(batch: Any) -> np.ndarray:
    """Return a mask of the clusters that are too large for rows."""
    return np.diff(batch.members.starts) * batch.start.dim > WIDEST
