"""The second direction in which straight paths in 3D bend.

The angle f of a path has one gradient, in its present plane. To first order, the bending of a path that is to be straight is a
vector f e, with the normal e: it has two directions. With the first alone, Newton's method bends such paths across their planes,
as if that cost nothing, finds them bent more than before, and ends far from the goal.
"""

from typing import Any

import numpy as np

from ..constraints.core.angle import directions
from ..geometry.intervals import cross


class SidewaysRows:
    """Rows that hold the bending of the paths `some`, (m,), across their present planes at 0."""

    def __init__(self, batch: Any, some: np.ndarray):
        self.batch, self.some, self.count, self.indices = batch, some, int(some.sum()), batch.indices[some]
        self.owner = np.repeat(np.arange(self.count), batch.arity)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients, (m, 3, dim): those of the angle, turned by a right angle about the legs."""
        q, g = self.batch.placed(x)[self.some], self.batch.gradients(x)[self.some]
        first, last = (cross(directions(q[:, k + 1] - q[:, k])[0], g[:, 2 * k]) for k in (0, 1))
        return np.stack([first, -(first + last), last], axis=1)
