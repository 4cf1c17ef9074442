"""The share of contact pushes that are forces, not impacts: it counts for velocities at the end of a frame."""

from typing import TYPE_CHECKING

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene


class ForceShare:
    """The pushes of the last substep of a frame, as far as they are forces, which act before and after it, and not impacts.

    before: displacements in the substep before [m]. sum: how far forces moved each particle [m]. in_state: its fields by name.
    """

    def __init__(self, scene: "Scene"):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state = scene.state
        self.before, self.sum = add("Contact.before", n, width=dim), add("Contact.bond", n, width=dim, state=True)
        self.in_state = {"before": self.before, "sum": self.sum}

    @ti.func
    def start(self, i, scale):
        """Keep the displacement of particle i, times `scale`, at the start of the last substep of a frame."""
        self.before[i] = scale * self.state.d[i]

    @ti.func
    def share(self, approach, push):
        """Return the share of a push that is a force, 0 to 1.

        An impact is at most the push that stops a pair that approached by `approach` in the substep before. The share is the same
        for both particles of a pair, which conserves momentum.
        """
        return ti.max(1 - ti.select(push > 0, ti.max(approach, 0) / push, ti.zero(push)) ** 2, 0)

    @ti.func
    def add(self, i, moved, first):
        """Add how far forces of a pass moved particle i [m]. The first pass begins the sum."""
        accumulate(self.sum, i, moved, first)


@ti.func
def accumulate(field: ti.template(), i, value, first):  # type: ignore[valid-type]
    """Add a value to the entry of particle i in a field. The first pass begins the sum."""
    if first != 0:
        field[i] = value
    else:
        field[i] = field[i] + value
