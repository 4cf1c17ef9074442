"""How known loads are learnt: from the load that was missing over a window of substeps, if it is steady."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from .feature import Scene

STEADY = 0.2  # relative difference of the missing load between two windows, at most
GAIN = 0.8  # largest share of the missing load that is learnt at once
WEIGHED = 32  # substeps from one look at own weights to the next
LAG = 64  # least number of substeps in which a load is learnt


class OwnWeight:
    """The acceleration of each particle by forces, at a start and at the end of a window: field, (n,) [m/s^2].

    Loads are compared with it: a load of k times a particle's own weight is that of k particles. So are impacts.
    """

    def __init__(self, scene: "Scene"):
        self.state = scene.state
        self.field = scene.memory.field("own_weight", scene.count, state=True)

    def follow(self, integrator: Any) -> None:
        """Set the integrator, which has all accelerations."""
        self.integrator, self.forces = integrator, integrator.forces

    @ti.func
    def store_weight(self, i, now):
        """Store the own weight of particle i."""
        x, v = self.state.place(i), self.state.d[i] / now.h
        a = self.forces.accelerate(i, x, v, now.time, self.forces.pull(now.time))
        self.field[i] = a.norm()


@ti.func
def is_steady(mean, earlier):
    """Whether the missing load equals that of the window before, within STEADY."""
    return ti.abs(mean - earlier) < STEADY * ti.abs(mean)


@ti.func
def learnt_share(own, slow, window):
    """Return the share of the missing load that is learnt at the end of a window of so many substeps.

    Integral control must be slower than the decay of the slowest sound of the connected particles. This decay takes a number of
    substeps in proportion to k^2, for the load of k particles. So learning takes LAG + slow / own substeps. slow is in proportion
    to k^2, own to 1.
    """
    return ti.min(window * own / (LAG * own + slow), GAIN)
