"""Sparse symmetric systems of equations between particles: narrow ones are solved directly, wide ones by iteration.

Ordered by levels of the graph, the matrix is block tridiagonal. The particles of a level are one step further from the first
particle than those of the level before, so neighbours are in the same level or in adjacent levels. A sheet of n x n has levels of
about n particles, a chain has levels of one.
"""

import functools
from collections.abc import Callable

import numpy as np

WIDEST = 60  # rows of a level: for larger matrices LAPACK's bits depend on the number of threads
MOST = 20_000_000  # numbers in all blocks for a direct solution
STEPS = 200  # of conjugate gradients, at most
ENOUGH = 1e-4  # of r . z at the start: where conjugate gradients end


class WideRows:
    """The matrix J^T k J of rows with many particles, stored without a block for each pair of particles.

    Corner i belongs to row[i] and is particle who[i] of `count`, with the gradient J[i]. k: stiffness of each row.
    """

    def __init__(self, count: int, row: np.ndarray, who: np.ndarray, J: np.ndarray, k: np.ndarray):
        self.count, self.row, self.who, self.J, self.k = count, row, who, J, k

    def times(self, p: np.ndarray) -> np.ndarray:
        """Return the product of the matrix with p, (count, dim)."""
        along = self.k * np.bincount(self.row, (self.J * p[self.who]).sum(axis=1), minlength=len(self.k))
        return summed(self.J * along[self.row, None], self.who, self.count)

    def own(self) -> np.ndarray:
        """Return the diagonal blocks, (count, dim, dim)."""
        return summed((self.k[self.row, None] * self.J)[:, :, None] * self.J[:, None, :], self.who, self.count)


class BlockMatrix:
    """A positive definite matrix: a sum of dim x dim blocks. Block k is between the particles a[k] and b[k] of `count`."""

    products = 0  # multiplications in iterations so far

    def __init__(self, count: int, dim: int, a: np.ndarray, b: np.ndarray):
        self.count, self.dim, self.a, self.b = count, dim, a, b
        level, levels = ordered(count, a, b)
        self.sizes = sizes = dim * np.bincount(level, minlength=levels)
        after = np.append(sizes[1:], 0)
        self.within = np.concatenate([[0], np.cumsum(sizes**2)])
        self.between = self.within[-1] + np.concatenate([[0], np.cumsum(sizes * after)])
        self.narrow = bool(sizes.max(initial=0) <= WIDEST and self.between[-1] <= MOST)
        if not self.narrow:
            return
        order = np.argsort(level, kind="stable")
        place = np.empty(count, dtype=np.int64)
        place[order] = np.arange(count)
        place -= np.searchsorted(level[order], np.arange(levels))[level]
        self.rows = np.split((dim * order[:, None] + np.arange(dim)).ravel(), np.cumsum(sizes)[:-1])
        self.some = level[b] >= level[a]  # half of the blocks: the matrix is symmetric
        a, b = a[self.some], b[self.some]
        same, axis = level[a] == level[b], np.arange(dim)
        begin = np.where(same, self.within[level[a]], self.between[level[a]])
        width = np.where(same, sizes[level[a]], after[level[a]])
        i, j = dim * place[a][:, None] + axis, dim * place[b][:, None] + axis
        self.address = (begin[:, None, None] + i[:, :, None] * width[:, None, None] + j[:, None, :]).ravel()

    def solve(self, blocks: np.ndarray, right: np.ndarray, wide: WideRows | None = None) -> np.ndarray:
        """Return x with A x = right, (count, dim). A is the sum of blocks, (pairs, dim, dim), and of wide rows."""
        return self._eliminate(blocks, right) if self.narrow and wide is None else self._iterate(blocks, right, wide)

    @functools.cached_property
    def pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The pair of each block; the two particles of each pair; and where the pairs of each first particle begin.

        Every particle has a pair with itself.
        """
        pairs, pair = np.unique(self.a * self.count + self.b, return_inverse=True)
        first, second = np.divmod(pairs, max(self.count, 1))
        return pair, first, second, np.searchsorted(first, np.arange(self.count))

    def _eliminate(self, blocks: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Solve by elimination, level by level."""
        A = np.bincount(self.address, blocks[self.some].ravel(), minlength=self.between[-1])
        r, sizes, levels = right.ravel(), self.sizes, len(self.sizes)
        held, out = [], np.zeros(right.size)
        filled, known = np.zeros(()), np.zeros(())
        for k in range(levels):
            n, m = sizes[k], sizes[k + 1] if k + 1 < levels else 0
            D = A[self.within[k] : self.within[k + 1]].reshape(n, n) - filled
            U = A[self.between[k] : self.between[k + 1]].reshape(n, m)
            X = np.linalg.solve(D, np.concatenate([U, (r[self.rows[k]] - known)[:, None]], axis=1))
            held.append(X)
            filled, known = U.T @ X[:, :-1], U.T @ X[:, -1]
        last = np.zeros(0)
        for k in reversed(range(levels)):
            last = held[k][:, -1] - held[k][:, :-1] @ last
            out[self.rows[k]] = last
        return out.reshape(right.shape)

    def _iterate(self, blocks: np.ndarray, right: np.ndarray, wide: WideRows | None) -> np.ndarray:
        """Solve by conjugate gradients, with the diagonal blocks as preconditioner."""
        pair, first, second, begin = self.pairs
        A = summed(blocks, pair, len(first))
        diagonal, A = A[first == second], np.moveaxis(A, 0, 2).copy()

        def times(p: np.ndarray) -> np.ndarray:
            """Return the product of the matrix with p."""
            self.products += A.size
            out = np.add.reduceat(np.einsum("abk,bk->ak", A, p[second].T), begin, axis=1).T
            return out if wide is None else out + wide.times(p)

        inverse = np.linalg.inv(diagonal if wide is None else diagonal + wide.own())
        return conjugate_gradients(times, lambda r: np.einsum("iab,ib->ia", inverse, r), right, ENOUGH)


def summed(values: np.ndarray, who: np.ndarray, count: int) -> np.ndarray:
    """Return the sums of values (numbers, vectors or matrices) by particle or body who[k], (count, ...)."""
    sums = [np.bincount(who, column, minlength=count) for column in values.reshape(len(values), -1).T]
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


def ordered(count: int, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the level of each of `count` particles, and the number of levels. Connected pieces have separate levels."""
    order = np.argsort(a, kind="stable")
    b, begin = b[order], np.concatenate([[0], np.cumsum(np.bincount(a, minlength=count))])
    level, last = np.full(count, -1), 0
    for first in range(count):
        if level[first] < 0:
            far = spread(level, b, begin, first, last)[1]  # begin at an end of the piece, for narrow levels
            level[level >= last] = -1
            last = spread(level, b, begin, far, last)[0]
    return level, last


def spread(level: np.ndarray, b: np.ndarray, begin: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """Number the piece that contains `first`, from level `last` on. Returns the next level, and a particle farthest away."""
    front = np.array([first])
    while len(front):
        level[front] = last
        last, far = last + 1, int(front[0])
        near = np.concatenate([b[begin[i] : begin[i + 1]] for i in front])
        front = np.unique(near[level[near] < 0])
    return last, far
