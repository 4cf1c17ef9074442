"""Free bodies keep their angular momentum when the host moves their particles.

Moves p along constraints have sum m p = 0, but a body that they draw together loses sum m p x v. So a rotating body, stretched by
its substep, would be braked each time that the substep gets shorter. Each free body gets the missing spin u,

    I u = sum m (x - c) x v - sum m (x' - c') x v',     v' += u x (x' - c').

The energy that this adds is the energy that the body lost when it was stretched.
"""

import numpy as np

from ..geometry.ordered import distinct
from ..solvers.corners import bodies_of
from .jacobian import Jacobian, summed

FLAT = 1e-9  # of the largest moment of inertia: below, a moment is zero up to rounding


class FreeBodies:
    """The bodies whose particles the rows of a Jacobian connect, at positions x (n, dim), and which of them are free.

    stopped: (n,) mask of particles that a wall has moved, or that something else holds.
    """

    def __init__(self, jacobian: Jacobian, x: np.ndarray, stopped: np.ndarray):
        real = jacobian.diagonal[jacobian.row] > 0  # open contacts have gradient 0 and connect nothing
        rows, row, who, w = jacobian.m, jacobian.row[real], jacobian.who[real], jacobian.w
        label, body = bodies_of(rows, row, who, w)
        held = np.bincount(label[row[(w[who] == 0) | stopped[who]]], minlength=rows + 1) > 0
        self.free = (~held[body] & (body < rows))[:, None]
        each, self.body, _ = distinct(np.where(self.free[:, 0], body, rows))  # all particles that are not free share a label
        self.count = len(each)
        self.mass = np.divide(1, w, out=np.zeros_like(w), where=w > 0)[:, None] * self.free
        self.arm = self._about_center(x)
        axes = 3 if x.shape[1] == 3 else 1
        inertia = summed(self.mass * _inertia(self.arm).reshape(len(x), -1), self.body, self.count).reshape(-1, axes, axes)
        self._mobility = np.linalg.pinv(inertia, rcond=FLAT, hermitian=True)  # pinv: a rod has no inertia about its axis

    def _about_center(self, x: np.ndarray) -> np.ndarray:
        """Return positions or velocities relative to those of the centers of mass, (n, dim)."""
        total = summed(self.mass, self.body, self.count)
        return x - (summed(self.mass * x, self.body, self.count) / np.where(total > 0, total, 1.0))[self.body]

    def moment(self, arm: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the angular momentum sum m r x v of each body, (bodies, 1 or 3)."""
        return summed(self.mass * _cross(arm, v), self.body, self.count)

    def turned(self, moment: np.ndarray) -> np.ndarray:
        """Return velocities, (n, dim), of bodies that rotate with these angular momenta; 0 for bodies that are not free."""
        spin = np.einsum("kij,kj->ki", self._mobility, moment)
        return self.free * _turning(spin[self.body], self.arm)

    def spun(self, v: np.ndarray, x: np.ndarray, before: np.ndarray) -> np.ndarray:
        """Return v with the angular momenta that velocities `before` had at positions x, (n, dim)."""
        if not self.free.any():
            return v
        return v + self.turned(self.moment(self._about_center(x), before) - self.moment(self.arm, v))

    def inner(self, v: np.ndarray) -> np.ndarray:
        """Return velocities v, (n, dim), without the translation and the rotation of free bodies."""
        if not self.free.any():
            return v
        out = np.where(self.free, self._about_center(v), v)
        return out - self.turned(self.moment(self.arm, out))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products a x b of vectors (n, dim), (n, 1 or 3)."""
    return np.cross(a, b) if a.shape[1] == 3 else (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None]


def _turning(u: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return u x r, (n, dim), with u, (n, 1 or 3), as _cross() returns it."""
    return np.cross(u, r) if r.shape[1] == 3 else u * np.stack([-r[:, 1], r[:, 0]], axis=1)


def _inertia(r: np.ndarray) -> np.ndarray:
    """Return the inertia r^2 1 - r r^T of points (n, dim) of unit mass, about the axes of _cross()."""
    square = (r**2).sum(axis=1)[:, None, None]
    return square * np.eye(3) - r[:, :, None] * r[:, None, :] if r.shape[1] == 3 else square
