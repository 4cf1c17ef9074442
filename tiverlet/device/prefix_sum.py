"""Running sums of whole numbers, by one thread or by all of a GPU."""

from typing import TYPE_CHECKING, Any

from .language import ti
from .number import OnDevice

if TYPE_CHECKING:
    from .thread_team import Team

RADIX = 64  # entries that one thread of a GPU adds up
MOST = 2**30 - 1  # two of them are still an i32


class Sums:
    """field[k] becomes field[0] + ... + field[k]; with `capped`, MOST where that is more.

    Where the team is launched, in parallel. Each thread adds up a block of RADIX entries, then of the sums of RADIX blocks, and
    so on until one block is left; then each block goes on from the sum of those before it. A level is a loop in each direction,
    and none takes more than RADIX steps. The sums of the blocks stand behind the `length` entries, so the field has to have
    `room` for both.
    """

    room: Any = OnDevice()

    def __init__(self, length: int, team: "Team", capped: bool = False):
        self.team, self.capped = team, capped
        lengths, self.begins = [length], [0]  # of each level
        while team.launched and lengths[-1] > RADIX:
            self.begins.append(self.begins[-1] + lengths[-1])
            lengths.append(-(-lengths[-1] // RADIX))
        self.levels, self.above = len(lengths), lengths[1:]
        self.room = team.memory.number(self.begins[-1] + lengths[-1])

    @ti.func
    def run(self, field: ti.template(), me):  # type: ignore[valid-type]
        """Add up."""
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
        """Their sum."""
        out = a + b
        if ti.static(self.capped):
            out = ti.min(out, MOST)
        return out

    @ti.func
    def low(self, m: ti.template(), b):  # type: ignore[valid-type]
        """Where the entries begin that block b of level m is the sum of."""
        return self.begins[m - 1] + b * RADIX

    @ti.func
    def high(self, m: ti.template(), b):  # type: ignore[valid-type]
        """Where they end."""
        return ti.min(self.low(m, b) + RADIX, self.begins[m])
