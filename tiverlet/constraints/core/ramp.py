"""Rest values on their way from what they were to what they were assigned, in the course of a frame."""

from typing import Any

import numpy as np

from ...device import ti
from ...device.memory import Memory


class Ramp:
    """Fields of a batch that go straight to their goals in a frame, as a Pin goes to its target:

        rest(s) = goal - (goal - begin) (1 - s),   s: the fraction of the frame at the end of a substep.

    A rigid constraint takes out its whole violation in one substep h. A rest value that jumped by C would be one, and would move
    corners with speeds of C / h; so they have speeds of C / dt, whatever the substep. Where nothing is on its way, begin = goal,
    which gives the bits of the goal.

    memory: where room for it is taken from, in a world that is there already: it is made when it is needed. fields: what moves,
    (m,) each; `step` is that of the first in this substep.
    """

    host_only = ("memory",)

    def __init__(self, memory: Memory, name: str, fields: list[Any], count: int):
        self.memory, self.fields = memory.more(), fields
        self.begin = [self.memory.field(f"{name}.rest_at_begin", count) for _ in fields]
        self.goal = [self.memory.field(f"{name}.rest_at_end", count) for _ in fields]
        self.step = self.memory.field(f"{name}.step_of_rest", count)
        self.memory.place()

    def aim(self, begin: list[np.ndarray], goal: list[np.ndarray]) -> None:
        """Go from here to there in the coming frame."""
        for field, values in zip([*self.begin, *self.goal], [*begin, *goal], strict=True):
            self.memory.write(field, values)

    @ti.func
    def follow(self, c, frame_fraction):
        """Take the rest value of constraint c to where it is at the end of the substep."""
        for k in ti.static(range(len(self.fields))):
            way = self.goal[k][c] - self.begin[k][c]
            self.fields[k][c] = self.goal[k][c] - way * (1 - frame_fraction[1])
            if ti.static(k == 0):
                self.step[c] = way * (frame_fraction[1] - frame_fraction[0])
