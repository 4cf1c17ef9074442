"""Particles that springs hold at places (pins, grids, soft wires) as scalar constraints, for projections."""

from typing import Any

import numpy as np

from ..constraints.core.anchored import Anchored


class AnchorRows:
    """Rows C = n . (x - place) of the springs of an Anchored, for orthonormal directions n in which each of them holds.

    projection.Rows uses them like a batch of Scalar. Places stay where they are at positions x, (n, dim). Passes leave stiff
    springs violated where other constraints pull at their particles, too.
    """

    side, breaks = 0, False

    def __init__(self, batch: Anchored, x: np.ndarray):
        self.batch, self.start, self.dev = batch, batch.start, batch.dev
        who, here = batch.indices[:, 0], x[batch.indices[:, 0]]
        holds, directions = np.linalg.eigh(batch.across(here))  # projectors: 1 or 0
        of, k = np.nonzero((holds > 0.5) & (batch.compliance > 0)[:, None])
        self.of, self.normal = of, directions[of, :, k]
        self.place = (here - batch.offset(x))[of]
        self.count, self.owner, self.indices = len(of), np.arange(len(of)), who[of][:, None]
        self.compliance, self.damping, self.rest_now = batch.compliance[of], batch.damping[of], np.zeros(len(of))
        self.broken = np.zeros(len(of), dtype=bool)

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of the rows of immovable particles, (m,)."""
        return w[self.indices[:, 0]] == 0

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return C at positions x, (m,) [m]."""
        return ((x[self.indices[:, 0]] - self.place) * self.normal).sum(axis=1)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients, (m, 1, dim)."""
        return self.normal[:, None]

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """Return the factors that turn C into a share of the size of the scene, (m,)."""
        return np.full(self.count, 1 / self.start.size)

    def along(self, values: np.ndarray) -> np.ndarray:
        """Return the components of vectors of the batch, (count, dim), along the directions of the rows, (m,)."""
        return (values[self.of] * self.normal).sum(axis=1)


def anchor_rows(batches: list[Any], x: np.ndarray) -> list[AnchorRows]:
    """Return the rows of all springs that hold particles at places."""
    some = [b for b in batches if isinstance(b, Anchored) and not b.is_kinematic and b.count and (b.compliance > 0).any()]
    return [AnchorRows(b, x) for b in some]
