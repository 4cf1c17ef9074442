"""The second direction in which straight paths in 3D bend, as rows of a projection.

The angle f of a path has one gradient, in its present plane. To first order, the bending of a path that is to be straight is a
vector f e, with the normal e: it has two directions. With the first alone, Newton's method bends such paths across their planes,
as if that cost nothing, finds them bent more than before, and ends far from the goal. Then violations stay, and become energy in
the shorter substep.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ..constraints.core.angle import directions
from ..geometry.intervals import cross


class SidewaysRows:
    """Rows that hold the bending of the paths `some`, (m,), across their present planes at 0.

    projection.Rows uses them like a batch.
    """

    side, breaks = 0, False

    def __init__(self, batch: Any, some: np.ndarray):
        self.batch, self.some, self.start = batch, some, batch.start
        self.count, self.indices = int(some.sum()), batch.indices[some]
        self.owner = np.repeat(np.arange(self.count), batch.arity)
        self.compliance, self.damping, self.broken = batch.compliance[some], batch.damping[some], batch.broken[some]
        self.rest_now, self.dev = np.zeros(self.count), SimpleNamespace(spring=SimpleNamespace(soft=False))

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of immovable rows, (m,)."""
        return self.batch.immovable(w)[self.some]

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return C: f e has no part across e, (m,)."""
        return np.zeros(self.count)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients, (m, 3, dim): those of the angle, turned by a right angle about the legs."""
        q, g = self.batch.placed(x)[self.some], self.batch.gradients(x)[self.some]
        first, last = (cross(directions(q[:, k + 1] - q[:, k])[0], g[:, 2 * k]) for k in (0, 1))
        return np.stack([first, -(first + last), last], axis=1)

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """Return the factors that turn C into a share of the size of its path, (m,)."""
        return self.batch.inverse_size(x)[self.some]


def sideways_rows(batches: list[Any]) -> list[SidewaysRows]:
    """Return the rows of the paths that are to be straight in 3D."""
    some = [(b, b.straight & ~b.broken) for b in batches]
    return [SidewaysRows(b, straight) for b, straight in some if straight.any()]
