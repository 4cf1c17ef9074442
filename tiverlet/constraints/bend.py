"""Angles between links."""

import numpy as np

from ..checks import ArrayLike
from ..features.feature import Knob
from ..geometry.intervals import cross
from ..particles import Particles
from .core.angle import PathAngle, angles_of_paths
from .core.quantity import Quantity
from .core.scalar import Scalar

STRAIGHT = 1e-9  # [rad] below which an initial angle in 3D is rounding of positions


class Bend(Scalar):
    """Bending springs and rigid corners: the path i - j - k turns by a given angle at j.

    C(x) = f(x) - rest, the angle f [rad] and its gradients as in path_angle(): f = 0 where the path is straight.

    triples: (m, 3) particle indices, the corner in the middle.
    rest: rest angle, number or (m,) [rad]; None takes the initial angles. Live. In 2D signed, positive to the left; in 3D in
    [0, pi], and with rest = 0 the angle keeps its sign while a rod swings through straight; initial angles below 1e-9 count as 0.
    compliance: number or (m,) [rad/(N m)]; 0 is rigid. A beam of stiffness EI [N m^2] cut into links of length l has l / EI.
    damping: of a dashpot parallel to the spring, number or (m,) [N m s/rad].
    break_at: moment at which a corner breaks, number or (m,) [N m].

    Coincident particles have no angle: the constraint exerts no moment until they separate. `load` is the moment [N m].
    Jacobi passes stiffen a long beam slowly. In a chain of masses m [kg] and links l [m], one pass per substep h leaves each
    joint a compliance of 30 h^2 / (m l^2), even where compliance is 0.
    """

    index_name = "triples"
    rest = Knob(lambda f, v: angles_of_paths(f, "rest", v), "Rest angle [rad].")

    def __init__(self, triples, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(triples, rest, compliance, damping, break_at)

    def quantity_of(self, indices) -> Quantity:
        """Return the angles of these paths, which in 3D remember their planes: a straight path does not define one."""
        return PathAngle(self.fixed(indices, 3), remembers=True)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices and the rest angles. Initial angles are exactly 0 where a path in 3D is straight but for rounding."""
        first = "rest" not in vars(self) and self._rest_given is None
        super().prepare(particles, inv_mass)
        angles_of_paths(self, "rest", self.rest, particles.dim)
        if first and particles.dim == 3:
            self.start_from(np.where(self.rest < STRAIGHT, 0.0, self.rest))

    def violation(self, position: np.ndarray) -> np.ndarray:
        """Return C at the given positions, (m,), with the sign that the angles have on the device."""
        return self._sides(position) * super().violation(position)

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """Return the gradients of the angles, (m, 3, dim), with the sign that the angles have on the device."""
        return self._sides(position)[:, None, None] * super().gradients(position)

    def _sides(self, position: np.ndarray) -> np.ndarray:
        """Return -1 for paths that bend the other way than about their remembered axis, else 1, (m,)."""
        if "quantity" not in vars(self.dev) or not self.dev.quantity.has_axis:
            return np.ones(self.count)
        x, axis = self.placed(position), self.scene.memory.read(self.dev.quantity.axis)[: self.count]
        along = (cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]) * axis).sum(axis=1)
        straight = self.scene.memory.read(self.dev.equation.rest)[: self.count] == 0
        return np.where(straight & (along < 0), -1.0, 1.0)
