"""Which of the constraints that bear too much break: what breaks first unloads the others."""

from typing import TYPE_CHECKING

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene

ALIKE = 1 / 8  # by how much loads may differ, relative to them, so that which is larger may be due to rounding or passes
NONE = 2**31 - 1  # the number of no constraint
LARGEST, FIRST, DECIDE, CLEAR = range(4)  # the loops over overloaded constraints, see Breaks.compare()


class Breaks:
    """The largest overload at each particle in a substep, on the device. overload: a load, as a multiple of break_at.

    Often all links of a chain bear too much in one substep, and all but one no longer do once that one has broken. So of the
    overloaded constraints at a particle that can move, only the one with the largest overload breaks, and of those that are ALIKE
    the first. The others bear on; what is still too much breaks them in the next substeps.

    any: 1 if any constraint is overloaded. largest: of each particle, 0 for none. first: the number of the first constraint there
    that is as much overloaded.
    """

    def __init__(self, scene: "Scene"):
        self.w = scene.state.w
        self.any = scene.memory.field("slots.overloaded", None, kind=ti.i32)
        self.largest = scene.memory.field("slots.overload", scene.count)
        self.first = scene.memory.field("slots.first_overloaded", scene.count, kind=ti.i32)

    @ti.func
    def compare(self, loop: ti.template(), i, overload, number):  # type: ignore[valid-type]
        """Compare the overload of a constraint, by its number, with others at particle i. Returns 1 if none comes before it."""
        out = 1
        if self.w[i] > 0:
            if ti.static(loop == LARGEST):
                ti.atomic_max(self.largest[i], overload)
                self.first[i] = NONE
            elif ti.static(loop == FIRST):
                if overload >= ti.static(1 - ALIKE) * self.largest[i]:
                    ti.atomic_min(self.first[i], number)
            elif ti.static(loop == DECIDE):
                out = ti.cast(self.first[i] == number, ti.i32)
            else:
                self.largest[i] = 0
        return out
