"""The loops that break overloaded constraints."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..solvers.breaks import CLEAR, DECIDE, FIRST, LARGEST

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene


class BreakPass:
    """Breaks the constraints of batches with break_at that bear too much in a substep, see Breaks."""

    def __init__(self, scene: "Scene", batches: list[Any], team: "Team"):
        self.batches, self.team, self.slots = list(enumerate(batches)), team, scene.slots

    @ti.func
    def run(self, now, h2_rigid, h2_effective):
        """At the end of a substep, see Passes.overload()."""
        for _, f in ti.static(self.batches):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                overload = f.dev.overload(c, h2_rigid, h2_effective)
                f.dev.strength.overload[c] = overload
                if overload > 0:
                    self.slots.breaks.any[None] = 1
        self.team.wait()
        any_now = self.slots.breaks.any[None]
        for loop in ti.static((LARGEST, FIRST, DECIDE, CLEAR)):
            for k, f in ti.static(self.batches):
                n = f.count * any_now
                for c in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                    overload, number = f.dev.strength.overload[c], c * ti.static(len(self.batches)) + k
                    if overload > 0:
                        first = f.dev.corners.compare(loop, c, overload, number)
                        if ti.static(loop == DECIDE):
                            f.dev.strength.forget_excess(c)
                            if first != 0:
                                f.dev.strength.mark_broken(c, now.tick)
            self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            self.slots.breaks.any[None] = 0
        self.team.wait()
