"""The Jacobian of constraints, stored by corners, and the least moves along it in the metric of the masses."""

import math
from collections.abc import Callable

import numpy as np

SOFT = 1e-6  # of the diagonal: softness, so that nearly singular directions stay
STEPS = 200  # of conjugate gradients, at most
DONE = 1e-12  # of r . z at the start: where conjugate gradients end


class Jacobian:
    """The Jacobian J of m constraints between n particles.

    Corner k belongs to row[k] and is particle who[k], with the gradient J[k], (corners, dim). w: inverse masses, (n,). whole:
    projects moves of particles, (n, dim), on rigid moves of their bodies, see Solids; None where each particle moves alone.
    """

    def __init__(
        self, m: int, row: np.ndarray, who: np.ndarray, w: np.ndarray, J: np.ndarray,
        whole: Callable[[np.ndarray], np.ndarray] | None = None,
    ):  # fmt: skip
        self.m, self.row, self.who, self.w, self.J, self.whole = m, row, who, w, J, whole
        self.diagonal = np.bincount(row, w[who] * (J**2).sum(axis=1), minlength=m)  # of J w J^T

    def rates(self, v: np.ndarray) -> np.ndarray:
        """Return J v, (m,)."""
        return np.bincount(self.row, (self.J * v[self.who]).sum(axis=1), minlength=self.m)

    def gathered(self, values: np.ndarray) -> np.ndarray:
        """Return the sums of the values of corners by particle, (n, dim)."""
        return summed(values, self.who, len(self.w))

    def moves(self, lam: np.ndarray) -> np.ndarray:
        """Return the moves w J^T lam, (n, dim), projected on those of whole bodies."""
        moves = self.w[:, None] * self.gathered(self.J * lam[self.row][:, None])
        return self.whole(moves) if self.whole else moves

    def solve(
        self, right: np.ndarray, some: np.ndarray | float = 1.0, enough: float = DONE, steps: int = STEPS, soft: float = SOFT
    ) -> np.ndarray:  # fmt: skip
        """Return w J^T lam with (J w J^T + mu) lam = right, (n, dim). some: the rows that take part."""
        return self.moves(self.multipliers(right, some, enough, steps, soft))

    def multipliers(self, right: np.ndarray, some: np.ndarray | float, enough: float, steps: int, soft: float) -> np.ndarray:
        """Return lam, (m,), by conjugate gradients preconditioned by the diagonal. See solve()."""
        mu = soft * self.diagonal
        scale = np.divide(1, self.diagonal + mu, out=np.zeros_like(mu), where=self.diagonal > 0)
        return conjugate_gradients(lambda p: some * self.rates(self.moves(p)) + mu * p, lambda r: scale * r, right, enough, steps)


def summed(values: np.ndarray, who: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of values (numbers, vectors or matrices) by particle or body who[k], (count, ...)."""
    sums = [np.bincount(who, column, minlength=count) for column in values.reshape(len(values), math.prod(values.shape[1:])).T]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def conjugate_gradients(
    apply: Callable[[np.ndarray], np.ndarray], precondition: Callable[[np.ndarray], np.ndarray], right: np.ndarray, enough: float,
    steps: int = STEPS,
) -> np.ndarray:  # fmt: skip
    """Return x with A x = right, by preconditioned conjugate gradients (Hestenes and Stiefel 1952).

    enough: the share of the first r . z at which the iteration ends. steps: the largest number of steps. Sums are NumPy's,
    because bits of BLAS depend on its number of threads.
    """
    x, r = np.zeros_like(right), right
    p = z = precondition(r)
    now = first = float((r * z).sum())
    for _ in range(steps):
        if now <= enough * first:
            break
        q = apply(p)
        step = now / float((p * q).sum())
        x, r = x + step * p, r - step * q
        z = precondition(r)
        now, last = float((r * z).sum()), now
        p = z + now / last * p
    return x
