"""How loads at rest become known: what was missing of them over a window is learnt, where it is steady."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from .feature import Acceleration, Scene

STEADY = 0.2  # of itself: by how much what is missing may differ from one window to the next
GAIN = 0.8  # of what is missing is learnt at once, where little is borne
LAG = 64  # substeps that it takes, at least, to learn a load


class OwnWeight:
    """What forces accelerate each particle by, but for loads that are known: field, (n,) [m/s^2], as windows end.

    Loads are compared with it: one that gives a particle k times of it is borne by k particles.
    """

    def __init__(self, scene: "Scene"):
        self.state = scene.state
        self.field = scene.memory.field("own_weight", scene.count, state=True)

    def follow(self, integrator: Any, loads: "list[Acceleration]") -> None:
        """integrator: knows what accelerates particles. loads: of these, those that are known."""
        self.integrator, self.forces, self.loads = integrator, integrator.forces, loads

    @ti.func
    def weigh(self, i, now):
        """Note that of particle i."""
        x, v = self.state.place(i), self.state.d[i] / now.h
        a = self.forces.accelerate(i, x, v, now.time, self.forces.pull(now.time))
        for f in ti.static(self.loads):
            a -= f.acceleration(i, x, v, now.time)
        self.field[i] = a.norm()


@ti.func
def steady(mean, earlier):
    """Whether what was missing is what was missing in the window before."""
    return ti.abs(mean - earlier) < STEADY * ti.abs(mean)


@ti.func
def gain(own, slow, window):
    """The share of what is missing that is learnt at the end of a window, of so many substeps.

    Integral control must be slower than the slowest sound of what hangs together decays, which is in proportion to k^2 substeps
    where k particles are borne: to learn takes LAG + slow / own, of numbers in proportion to k^2 and 1.
    """
    return ti.min(window * own / (LAG * own + slow), GAIN)
