"""The share of contact pushes that are forces, not impacts: it counts for velocities at the end of a frame."""

from typing import TYPE_CHECKING

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene


class ForceShare:
    """The pushes of the last substep of a frame, as far as they are forces, which act before and after it, and not impacts.

    sums: whether pushes are summed up here. lasting: whether `before` is part of the state. in_state: its fields by name.
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
    def share_of(self, i, j, n, push):
        """Return share() of the push of particles i and j along their normal n [m]."""
        return self.share(-self.state.relative_displacement(self.before[i] - self.before[j], i, j).dot(n), push)

    @ti.func
    def add_turn(self, i, turned, first):
        """Add how far forces of a pass turned the surface of particle i [m]. The first pass begins the sum."""
        accumulate(self.turned, i, turned, first)

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
