"""The own weights of particles, with which loads and impacts are compared."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from .feature import Scene

WEIGHED = 32  # substeps from one look at own weights to the next


class OwnWeight:
    """The acceleration of each particle by forces, at a start and at the end of a window: field, (n,) [m/s^2].

    A load of k times a particle's own weight is that of k particles.
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
