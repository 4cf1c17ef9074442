"""Clusters as scalar constraints: their deformations, in the frame of the cluster."""

import functools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np

HEAVY = 1024  # masses of the cluster: the mass of a particle that cannot move
WIDEST = 120  # coordinates of a cluster with rows: each has about as many rows as coordinates
NONE = 1e-9  # of the largest motion: below, what a further one adds is rounding


class ClusterRows:
    """Rows of all deformations of some clusters. projection.Rows uses them like a batch of Scalar.

    With D_i = R^T (x_i - c) - q_i for the best fit c, R of a cluster, C_r = sum_i m_i B_ri . D_i. B_r is a basis, orthonormal in
    the metric of the masses, of all displacements that are not rigid motions. While D is small, changes of R and c do not matter,
    and grad_i C_r = m_i R B_ri. gradients() adds what they do: else rows of clusters that share particles, deformed differently,
    would hold these against any turn of the whole.

    Since sum_r C_r^2 = sum_i m_i |D_i|^2, a cluster of mass M and compliance alpha has rows of compliance alpha M.
    """

    side, breaks = 0, False

    def __init__(self, batch: Any, w: np.ndarray, some: np.ndarray):
        read, corners = batch.scene.memory.read, len(batch.owner)
        shape = read(batch.dev.shape)[:corners] if batch.dev.plastic else None
        self.batch, self.which = batch, np.flatnonzero(some).tolist()
        self.clusters = [Cluster(batch, c, w, shape) for c in self.which]
        counts = [len(c.basis) for c in self.clusters]
        self.count = sum(counts)
        who = [(c.who, len(c.basis)) for c in self.clusters]
        self.indices = np.concatenate([*(np.tile(members, m) for members, m in who), np.zeros(0, dtype=np.int64)])
        self.owner = np.repeat(np.arange(self.count), [len(members) for members, m in who for _ in range(m)])
        total = np.array([c.mass[c.free].sum() for c in self.clusters])
        self.compliance = np.repeat(batch.compliance[some] * total, counts)
        self.damping = np.repeat(batch.damping[some] / total, counts)
        self.rest_now = np.zeros(self.count)
        self.broken = np.zeros(self.count, dtype=bool)
        self.start, self.dev = batch.start, SimpleNamespace(spring=batch.dev.spring)

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of immovable rows, (m,): none, because clusters that cannot move are left out already."""
        return np.zeros(self.count, dtype=bool)

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return C at positions x, (m,)."""
        return np.concatenate([np.einsum("rka,ka->r", c.basis, c.strain(x)[1]) for c in self.clusters])

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients at all corners, (total, dim)."""
        return np.concatenate([c.gradients(x).reshape(-1, x.shape[1]) for c in self.clusters])

    def remembered(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return C at the start of the last substep, and the multipliers at positions x, (m,) each."""
        read, starts = self.batch.scene.memory.read, self.batch.members.starts
        pull, soft = read(self.batch.dev.pull).astype(np.float64), self.batch.dev.spring.soft
        last = read(self.batch.dev.spring.last).astype(np.float64) if soft else np.zeros_like(pull)
        before, lam = [], []
        for k, c in zip(self.which, self.clusters, strict=True):
            corners = slice(starts[k], starts[k + 1])
            before.append(np.einsum("rka,ka->r", c.basis, last[corners]))
            lam.append(np.einsum("rka,ka->r", c.basis, pull[corners] @ c.strain(x)[0]))
        return np.concatenate(before), np.concatenate(lam)

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """Return the factors that turn C into a share of the size of its cluster, (m,)."""
        return np.concatenate([np.full(len(c.basis), c.close) for c in self.clusters])


class Cluster:
    """A cluster: its particles and masses (k,), its rest shape (k, dim) about its center, and its radius [m].

    w: (n,) inverse masses. shape: rest shapes of all clusters of the batch, (corners, dim); None for those that it was given.
    """

    def __init__(self, batch: Any, c: int, w: np.ndarray, shape: np.ndarray | None = None):
        self.who = batch.members_of(c).astype(np.int64)
        free = w[self.who] > 0
        m = np.divide(1, w[self.who], out=np.zeros(len(free)), where=free)
        self.mass = np.where(free, m, HEAVY * m.sum())
        q = batch.shape_of(c) if shape is None else shape[batch.members.starts[c] : batch.members.starts[c + 1]]
        self.shape = q - self.mass @ q / self.mass.sum()
        self.radius = np.sqrt(self.mass @ (self.shape**2).sum(axis=1) / self.mass.sum())
        self.free = free

    @functools.cached_property
    def basis(self) -> np.ndarray:
        """The basis of deformations times the masses, m B, (rows, k, dim)."""
        q, root = self.shape, np.sqrt(self.mass)
        dim = q.shape[1]
        shifts = [np.tile(e, (len(q), 1)) for e in np.eye(dim)]
        motions = np.stack([(root[:, None] * motion).ravel() for motion in (*shifts, *turns(q))], axis=1)
        rest = complement(motions).T.reshape(-1, len(q), dim) * root[:, None]
        return rest[(rest[:, self.free] != 0).any(axis=(1, 2))]

    @property
    def close(self) -> float:
        """The factor that turns a row's C into a share of the size of the cluster."""
        return 1 / (self.radius * np.sqrt(self.mass[self.free].min())) if self.radius > 0 else 0.0

    def strain(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return R, and D (k, dim), at positions x."""
        p = x[self.who] - self.mass @ x[self.who] / self.mass.sum()
        R = best_rotation((self.mass[:, None] * p).T @ self.shape)
        return R, p @ R - self.shape

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of the rows at positions x, (rows, k, dim).

        R follows x so that sum_i m_i G_k q_i . P_i = 0, P_i = q_i + D_i. So it turns by G_l M_lk^-1 sum_i m_i G_k q_i . R^T dx_i
        with M_kl = sum_i m_i G_k q_i . G_l P_i, and C_r loses sum_i m_i B_ri . G_l D_i of that.
        """
        R, D = self.strain(x)
        weighted = self.mass[:, None] * turns(self.shape)
        M = np.einsum("kia,lia->kl", weighted, turns(self.shape + D))
        lost = np.einsum("ria,lia->rl", self.basis, turns(D)) @ np.linalg.pinv(M)
        return (self.basis - np.einsum("rk,kia->ria", lost, weighted)) @ R.T


def best_rotation(A: np.ndarray) -> np.ndarray:
    """Return the R that fits R q_i best to p_i, from A = sum_i m_i p_i q_i^T, or those of a stack (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(A)
    u[..., -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[..., None]
    return u @ vt


def turns(q: np.ndarray) -> np.ndarray:
    """Return the displacements G_k q of points q, (k, dim), in a turn in each plane of the axes, (planes, k, dim)."""
    dim = q.shape[1]
    e = np.eye(dim)
    return np.stack([np.outer(q[:, b], e[a]) - np.outer(q[:, a], e[b]) for a, b in zip(*np.triu_indices(dim, 1), strict=True)])


def complement(a: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of all vectors that are orthogonal to the columns of a, (n, n - rank), by Householder's method.

    LAPACK's bits would depend on the number of threads.
    """
    a, reflections, largest = a.copy(), [], np.sqrt((a**2).sum(axis=0).max())
    for k in range(min(a.shape)):
        size = np.sqrt((a[k:, k:] ** 2).sum(axis=0))
        pivot = k + int(size.argmax())
        if size.max() <= NONE * largest:
            break
        a[:, [k, pivot]] = a[:, [pivot, k]]
        u = np.concatenate([np.zeros(k), a[k:, k]])
        u[k] += np.copysign(size.max(), u[k])
        u /= np.sqrt((u**2).sum())
        a -= 2 * u[:, None] * (u[:, None] * a).sum(axis=0)
        reflections.append(u)
    out = np.eye(len(a))[:, len(reflections) :]
    for u in reversed(reflections):
        out = out - 2 * u[:, None] * (u[:, None] * out).sum(axis=0)
    return out


def cluster_rows(batches: list, w: np.ndarray) -> list[ClusterRows]:
    """Return rows of the rigid clusters that share particles with other constraints, and of the soft ones that share particles
    with other clusters.

    Passes leave clusters that share particles violated. Large clusters get no rows, see WIDEST.
    """
    rows = [ClusterRows(b, w, some & ~_wide(b)) for b, some in _coupled(batches, w) if (some & ~_wide(b)).any()]
    return [some for some in rows if some.count]


def left_out(batches: list, w: np.ndarray, x: np.ndarray, h: float) -> float:
    """Return the largest deviation of a particle from the rest shape, in radii, for clusters that are too large for rows.

    Springs count as far as they are rigid in a substep h [s].
    """
    worst = 0.0
    for b, some in _coupled(batches, w):
        for c in np.flatnonzero(some & _wide(b)).tolist():
            cluster = Cluster(b, c, w)
            alpha = b.compliance[c] * cluster.mass[cluster.free].sum()
            far = h**4 / (h**4 + alpha**2) * np.linalg.norm(cluster.strain(x)[1], axis=1).max()
            worst = max(worst, float(far / cluster.radius) if cluster.radius > 0 else 0.0)
    return worst


def _coupled(batches: list, w: np.ndarray) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each batch and the mask of its rigid clusters that share particles with other constraints, and of its soft clusters
    that share particles with other clusters."""
    clusters = [b for b in batches if b.clusters and b.count]
    degrees = [
        np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *(b.indices.ravel() for b in some)]), minlength=len(w))
        for some in (batches, clusters)
    ]
    for b in clusters:
        with_any, with_clusters = (np.maximum.reduceat(degree[b.indices], b.members.starts[:-1]) > 1 for degree in degrees)
        yield b, np.where(b.compliance == 0, with_any, with_clusters) & ~b.broken & ~b.immovable(w)


def _wide(batch: Any) -> np.ndarray:
    """Return a mask of the clusters that are too large for rows."""
    return np.diff(batch.members.starts) * batch.start.dim > WIDEST
