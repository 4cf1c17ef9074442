"""Rigid clusters that share particles: those that can only move together as one body, and copies of what bodies share.

Two clusters that share so many particles that none can turn without the other are one rigid body, as all clusters of a lattice
are. Bodies that share fewer particles hang on each other as by hinges: each gets a copy of what they share, with its part of the
mass, and rows that hold copies together (initial_shape.py). So a lattice of any size gets into shape in one fit, where passes
from cluster to cluster would take as many rounds as the square of its length.
"""

from collections.abc import Iterator

import numpy as np

from .rotation import best_rotation

FLAT = 1e-6  # of the largest singular value: below, points do not extend along an axis
ALIKE = 1e-3  # of the radius: clusters whose shared particles differ by more contradict each other, and stay apart


class Copies:
    """One copy of each particle for each body that it belongs to, so that bodies move independently.

    The first copy has the number of its particle, further ones numbers from n on. particle: the particle of each copy, (N,).
    who: the copy of each corner. w: the inverse masses of copies, (N,), that share the mass of the particle equally.
    """

    def __init__(self, who: np.ndarray, w: np.ndarray):
        """Make copies for corners of bodies with the particles `who`. w: inverse masses, (n,)."""
        self.n, further = len(w), np.ones(len(who), dtype=bool)
        further[np.unique(who, return_index=True)[1]] = False
        self.who = np.where(further, self.n - 1 + np.cumsum(further), who)
        self.particle = np.concatenate([np.arange(self.n), who[further]])
        self.count = np.bincount(self.particle, minlength=self.n)
        self.w = (w * self.count)[self.particle]

    @property
    def shared(self) -> bool:
        """Whether any particle belongs to several bodies."""
        return len(self.particle) > self.n

    def lift(self, x: np.ndarray) -> np.ndarray:
        """Return the values of copies, (N, dim), that are those of their particles, (n, dim)."""
        return x[self.particle] if self.shared else x

    def mean(self, x: np.ndarray) -> np.ndarray:
        """Return the means of the values of copies, (n, dim)."""
        if not self.shared:
            return x
        return np.stack([np.bincount(self.particle, v, minlength=self.n) for v in x.T], axis=1) / self.count[:, None]

    def corners(self, row: np.ndarray, who: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return rows (k,), particles (k,) and gradients (k, dim) of corners, as those of rows that act on all copies alike."""
        if not self.shared:
            return row, who, J
        order = np.argsort(self.particle, kind="stable")
        first, count = np.cumsum(self.count) - self.count, self.count[who]
        corner = np.repeat(np.arange(len(who)), count)
        copy = order[np.repeat(first[who], count) + np.arange(len(corner)) - np.repeat(np.cumsum(count) - count, count)]
        return row[corner], copy, J[corner] / count[corner][:, None]

    def joints(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows that hold copies together: row, copy and gradient of their corners, and violations at x, (N, dim)."""
        further = self.n + np.flatnonzero(self.w[self.n :] > 0)
        pair, axes = np.stack([further, self.particle[further]], axis=1), np.eye(x.shape[1])
        row = np.repeat(np.arange(len(pair) * len(axes)), 2)
        who = np.repeat(pair, len(axes), axis=0).ravel()
        J = np.tile(np.stack([axes, -axes], axis=1), (len(pair), 1, 1)).reshape(-1, len(axes))
        return row, who, J, (x[pair[:, 0]] - x[pair[:, 1]]).ravel()


def joined(who: np.ndarray, owner: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the corners of bodies, from those of clusters that may share particles: particles, bodies, and rest shapes.

    Corner k is particle who[k] of cluster owner[k], at q[k] in its shape, (corners, dim). owner is in ascending order.
    """
    starts = np.append(np.searchsorted(owner, np.arange(owner.max() + 1)), len(owner))
    members = [slice(a, b) for a, b in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True)]
    of: list[list[int]] = [[] for _ in range(int(who.max()) + 1)]
    for i, c in zip(who.tolist(), owner.tolist(), strict=True):
        of[i].append(c)
    free, parts = np.ones(len(members), dtype=bool), []
    for c in range(len(members)):
        if free[c]:
            place = dict(_grown(c, members, of, free, who, q))
            parts.append((np.fromiter(place, dtype=np.int64), np.array(list(place.values()))))
    bodies = np.repeat(np.arange(len(parts)), [len(ids) for ids, _ in parts])
    return np.concatenate([ids for ids, _ in parts]), bodies, np.concatenate([shape for _, shape in parts])


def _grown(
    c: int, members: list[slice], of: list[list[int]], free: np.ndarray, who: np.ndarray, q: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:  # fmt: skip
    """Yield the particles of the body of cluster c, with their places in its shape, and mark its clusters as taken."""
    place: dict[int, np.ndarray] = {}
    waiting = {c: None}  # in order, so that results do not depend on how sets are stored
    while waiting:
        k = next(iter(waiting))
        del waiting[k]
        ids, shape = who[members[k]].tolist(), q[members[k]]
        shared = np.array([i in place for i in ids])
        if place:
            shape = _placed(shape, shared, np.array([place[i] for i in ids if i in place]))
        if shape is not None:
            free[k] = False
            new = [(i, p) for i, p, known in zip(ids, shape, shared.tolist(), strict=True) if not known]
            place.update(new)
            yield from new
            waiting |= {other: None for i, _ in new for other in of[i] if free[other]}


def _placed(shape: np.ndarray, shared: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
    """Return a cluster's shape, (k, dim), moved to where the particles in the mask `shared` are at `goal`.

    None where these do not determine its place, or differ.
    """
    own = shape[shared]
    begin, end = own.mean(axis=0), goal.mean(axis=0)
    if _rank(own) < min(shape.shape[1] - 1, _rank(shape)):
        return None
    out = end + (shape - begin) @ best_rotation((goal - end).T @ (own - begin)).T
    off, size = np.linalg.norm(out[shared] - goal, axis=1).max(), np.linalg.norm(shape - shape.mean(axis=0), axis=1).max()
    return out if off <= ALIKE * size else None


def _rank(x: np.ndarray) -> int:
    """Return along how many axes points extend."""
    s = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    return int((s > FLAT * max(s[0], np.finfo(float).tiny)).sum())
