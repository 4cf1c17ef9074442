"""How known loads are learnt: from the load that was missing over a window of substeps, if it is steady."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from .feature import Acceleration, Scene

STEADY = 0.2  # relative difference of the missing load between two windows, at most
SWING = 0.1  # acceleration in a window, relative to its own weight, above which a body learns no load
GAIN = 0.8  # largest share of the missing load that is learnt at once
WEIGHED = 32  # substeps from one look at own weights to the next
LAG = 64  # least number of substeps in which a load is learnt


class OwnWeight:
    """The acceleration of each particle by forces other than known loads, at a start and at the end of a window: field, (n,)
    [m/s^2].

    Loads are compared with it: a load of k times a particle's own weight is that of k particles. So are impacts.
    """

    def __init__(self, scene: "Scene"):
        self.state = scene.state
        self.field = scene.memory.field("own_weight", scene.count, state=True)

    def follow(self, integrator: Any, loads: "list[Acceleration]") -> None:
        """Set the integrator, which has all accelerations, and the known loads among them."""
        self.integrator, self.forces, self.loads = integrator, integrator.forces, loads

    @ti.func
    def store_weight(self, i, now):
        """Store the own weight of particle i."""
        x, v = self.state.place(i), self.state.d[i] / now.h
        a = self.forces.accelerate(i, x, v, now.time, self.forces.pull(now.time))
        for f in ti.static(self.loads):
            a -= f.acceleration(i, x, v, now.time)
        self.field[i] = a.norm()


class SteadyMotion:
    """How much each particle is accelerated in a window, against its own weight: bodies that swing learn no loads.

    At the end of its swing a pile bears up to twice its load, and for long enough to look steady. velocity: (n, dim) [m/s], at
    the end of the window before. acceleration: (n,) [m/s^2], its mean over the last window.
    """

    def __init__(self, scene: "Scene"):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state, self.weights = scene.state, scene.own_weight
        self.velocity = add("Contact.window_velocity", n, width=dim, state=True)
        self.acceleration = add("Contact.window_acceleration", n)

    @ti.func
    def end_window(self, i, now, window):
        """Measure the acceleration of particle i at the end of a window of so many substeps."""
        v = self.state.d[i] / now.h
        self.acceleration[i] = (v - self.velocity[i]).norm() / (window * now.h)
        self.velocity[i] = v

    @ti.func
    def is_steady(self, i):
        """Whether particle i was hardly accelerated in the last window."""
        return self.acceleration[i] <= ti.static(SWING) * self.weights.field[i] or not self.state.w.positive(i)


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
