"""What of the pushes of contacts are forces: the part that counts for velocities at the end of a frame."""

from typing import TYPE_CHECKING

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene


class ForceShare:
    """Pushes of the last substep of a frame, as far as they are forces, which act before and after, and not impacts.

    in_state: its fields that are part of the state. lasting: whether they are.
    """

    def __init__(self, scene: "Scene", sums: bool, lasting: bool):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state = scene.state
        self.before = add("Contact.before", n, width=dim, state=lasting)  # displacements in the substep before
        self.in_state = {"before": self.before}
        if sums:
            self.sum = add("Contact.bond", n, width=dim, state=True)
            self.in_state["sum"] = self.sum
        self.spins = sums and scene.state.spins
        if self.spins:
            self.turned = add("Contact.torque", n, width=scene.state.spin.axes, state=True)
            self.in_state["turned"] = self.turned

    @ti.func
    def start(self, i, scale):
        """At the start of the last substep of a frame: keep the displacement of particle i, `scale` times what is kept there."""
        self.before[i] = scale * self.state.d[i]

    @ti.func
    def share(self, approach, push):
        """How much of a push is a force.

        An impact is no more than what stops a pair that came together by `approach` in the substep before. It is the same for
        both of a pair, which keeps momentum.
        """
        return ti.max(1 - ti.select(push > 0, ti.max(approach, 0) / push, ti.zero(push)) ** 2, 0)

    @ti.func
    def add_turn(self, i, turned, first):
        """Add what forces of a pass turned the surface of particle i by; the first pass begins the sum."""
        accumulate(self.turned, i, turned, first)

    @ti.func
    def add(self, i, moved, first):
        """Add what forces of a pass moved particle i by; the first pass begins the sum."""
        accumulate(self.sum, i, moved, first)


@ti.func
def accumulate(field: ti.template(), i, value, first):  # type: ignore[valid-type]
    """Add to what a field has of particle i; the first pass begins the sum."""
    if first != 0:
        field[i] = value
    else:
        field[i] = field[i] + value
