"""Prefix sums of integers, by one thread or by all threads of a GPU."""

from typing import TYPE_CHECKING, Any

from .language import ti
from .number import OnDevice

if TYPE_CHECKING:
    from .thread_team import Team

RADIX = 64  # entries per GPU thread
MOST = 2**30 - 1  # the sum of two still fits in an i32


class Sums:
    """Replaces field[k] by field[0] + ... + field[k]; with `capped`, by at most MOST.

    Where phases are launched one by one, as on a GPU, the sums run in parallel. Each thread adds up a block of RADIX entries. The
    next level adds up RADIX block sums, and so on until one block is left. Then each block continues from the sum of the blocks
    before it. A level is one loop in each direction, and no loop takes more than RADIX steps. The block sums are stored behind
    the `length` entries, so the field needs `room` for both.
    """

    room: Any = OnDevice()

    def __init__(self, length: int, team: "Team", capped: bool = False):
        self.team, self.capped = team, capped
        lengths, self.begins = [length], [0]  # length and first index of each level
        while team.launched and lengths[-1] > RADIX:
            self.begins.append(self.begins[-1] + lengths[-1])
            lengths.append(-(-lengths[-1] // RADIX))
        self.levels, self.above = len(lengths), lengths[1:]
        self.room = team.memory.number(self.begins[-1] + lengths[-1])

    @ti.func
    def run(self, field: ti.template(), me):  # type: ignore[valid-type]
        """Compute the prefix sums in place."""
        for m in ti.static(range(1, self.levels)):
            for b in range(ti.static(self.above[m - 1])):
                total = 0
                for k in range(self.low(m, b), self.high(m, b)):
                    total = self.plus(total, field[k])
                field[self.begins[m] + b] = total
        ti.loop_config(serialize=True)
        for k in range(self.begins[-1] + 1, self.team.one(self.room, me)):
            field[k] = self.plus(field[k], field[k - 1])
        for m in ti.static(range(self.levels - 1, 0, -1)):
            for b in range(ti.static(self.above[m - 1])):
                total = 0
                if b > 0:
                    total = field[self.begins[m] + b - 1]
                for k in range(self.low(m, b), self.high(m, b)):
                    total = self.plus(total, field[k])
                    field[k] = total

    @ti.func
    def plus(self, a, b):
        """Return a + b, capped if requested."""
        out = a + b
        if ti.static(self.capped):
            out = ti.min(out, MOST)
        return out

    @ti.func
    def low(self, m: ti.template(), b):  # type: ignore[valid-type]
        """Return the first of the entries whose sum is block b of level m."""
        return self.begins[m - 1] + b * RADIX

    @ti.func
    def high(self, m: ti.template(), b):  # type: ignore[valid-type]
        """Return the end of the entries whose sum is block b of level m."""
        return ti.min(self.low(m, b) + RADIX, self.begins[m])
