"""Joints with limited rotation: limbs and hinges."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.feature import Knob
from ..particles import Particles
from .core.angle import TURN, PathAngle, angles_of_paths, wrap_to_pi
from .core.quantity import Quantity
from .core.scalar import Scalar


class AngleLimit(Scalar):
    """Corners that turn freely between two angles: elbows, knees, doors.

    C(x) = |f(x) - (lower + upper) / 2| - (upper - lower) / 2 <= 0, with the angle f [rad] of Bend, taken within half a turn of
    the middle. The gradients are those of f, with the sign of f - middle.

    triples: (m, 3) particle indices, the corner in the middle; 0 is straight.
    lower, upper: number or (m,) [rad], lower <= upper and at most a turn apart; in 2D signed, positive to the left, in 3D in
    [0, pi]. Live.
    compliance: number or (m,) [rad/(N m)] of the stops; 0 is rigid. damping: [N m s/rad], acts while at a stop. break_at: [N m].

    A rigid stop takes the impact inelastically. Assigned limits are reached during the next frame; a rigid stop removes at most a
    third of a radian of its violation per frame. The particles that it pushes then have that speed.
    `load` is the moment at either stop [N m].
    """

    code_size = 3.0
    uploads_all = False  # limits are checked against each other, for a single world
    index_name = "triples"
    each = ("lower", "upper", "compliance", "damping", "break_at")
    side = 1
    lower = Knob(lambda f, v: f._bound("lower", v), "The smaller limit [rad].")
    upper = Knob(lambda f, v: f._bound("upper", v), "The larger limit [rad].")

    def __init__(self, triples, lower, upper, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(triples, None, compliance, damping, break_at)
        self.lower, self.upper = lower, upper

    def _bound(self, name: str, value) -> np.ndarray:
        value = angles_of_paths(self, name, value)
        low = value if name == "lower" else self.__dict__.get("lower", value)
        high = value if name == "upper" else self.__dict__.get("upper", value)
        for wrong, why in ((low > high, "lower must not exceed upper"), (high - low > TURN, "they are more than a turn apart")):
            if wrong.any():
                i = int(np.argmax(wrong))
                raise ValueError(f"AngleLimit: lower[{i}] = {low[i]:g} and upper[{i}] = {high[i]:g}, but {why}.")
        return value

    @property
    def middle(self) -> np.ndarray:
        """The middle of each free range [rad], (m,)."""
        low, high = self._range
        return (low + high) / 2

    @property
    def rest(self) -> np.ndarray:
        """Half the width of each free range [rad], (m,)."""
        low, high = self._range
        return (high - low) / 2

    @property
    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        """The free ranges [rad]. In 3D a path turns on through straight, and through folded back: 0 and pi are no limits."""
        low, high = self.lower, self.upper
        if self.start and self.start.dim == 3:
            low = np.where(self.lower == 0, -self.upper, low)
            high = np.where((self.upper == np.pi) & (self.lower > 0), TURN - self.lower, high)
        return low, high

    def quantity_of(self, indices) -> Quantity:
        """Return the distances of the angles of these paths from the middles of their ranges."""
        return PathAngle(self.fixed(indices, 3), centred=True)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices, and check the limits against the dimension."""
        checks.indices("AngleLimit", self.index_name, self.indices, particles.count, arity=3)
        for name, value in (("lower", self.lower), ("upper", self.upper)):
            angles_of_paths(self, name, value, particles.dim)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return how far the angles are from the middle [rad]."""
        return np.abs(wrap_to_pi(super().values(x) - self.middle))

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """Return the gradients of |angle - middle| by each corner, (m, 3, dim), as PathAngle.measure() does."""
        side = np.where(wrap_to_pi(super().values(self.placed(position)) - self.middle) < 0, -1.0, 1.0)
        return side[:, None, None] * super().gradients(position)

    def tracks(self) -> list[tuple[Any, np.ndarray, Callable]]:
        """List what an assignment moves: half of the range, and its middle."""
        middle = self.dev.quantity.middle, self.middle, self.quantity.difference
        return [(self.dev.equation.rest, self.rest, np.subtract), middle]

    def violation(self, position: np.ndarray) -> np.ndarray:
        """Return C at the given positions, (m,)."""
        half, middle = self.ramp.now() if self.ramp and self.ramp.under_way else (self.rest, self.middle)
        return np.abs(wrap_to_pi(super().values(self.placed(position)) - middle)) - half
