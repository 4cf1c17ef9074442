"""Ropes that are wound up and paid out."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.feature import Knob, Scene
from ..features.items import Items
from ..particles import Particles
from .core.drive import Drive, driven_rest
from .core.length import Length
from .core.scalar import Scalar

SHORTEST = 1e-2  # of its initial length: the default for `shortest`


class Winch(Scalar):
    """Winches: ropes whose length changes at a given speed, with a largest force.

    C(x) = |x_i - x_j| - rest <= 0, gradients as in Distance; the multiplier may only pull. In a substep h the length `rest` grows
    by speed h, between `shortest` and `longest`. The pull is clamped, lam <= force h^2. Below the largest force the length
    changes at the given speed; beyond it the rope runs out; see tiverlet/constraints/README.md.

    pairs: (m, 2) particle indices.
    speed: number or (m,) [m/s]; positive pays out, negative winds up, 0 holds. Live.
    length: number or (m,) [m] at the start, above 0; None takes the initial distances.
    shortest, longest: number or (m,) [m], where the winch stops; shortest is above 0, None for a hundredth of `length`. Live.
    force: the largest pull, number or (m,) [N]. Live. 0 lets the rope run free. Without it the winch meets any load.
    compliance: number or (m,) [m/N] and damping [N s/m] of the taut rope. break_at: tension at which it breaks, [N].

    `load` is the tension [N], `rest` the current length [m].
    """

    measures = Length
    side = 1
    driven = True
    cusp = False  # no length of a winch is 0
    each = ("speed", "length", "shortest", "longest", "force", "compliance", "damping", "break_at")
    speed = Knob(Items("speed"), "Change of length [m/s].")
    shortest = Knob(Items("shortest", above=0.0), "Least length [m].")
    longest = Knob(Items("longest", above=0.0, infinite=True), "Largest length [m].")
    rest = driven_rest("length", "The current lengths [m], (m,).")
    force = Knob(Items("force", least=0.0, infinite=True), "The largest pull [N].")

    def __init__(
        self, pairs, speed: ArrayLike = 0.0, *, length=None, shortest=None, longest: ArrayLike = np.inf, force:
        ArrayLike = np.inf, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None,
    ):  # fmt: skip
        self.setup(pairs, None, compliance, damping, break_at)
        if length is not None:
            self.length = checks.per_item("Winch", "length", length, self.count, above=0.0)
        if shortest is not None:
            self.shortest = shortest
        self.speed, self.longest, self.force = speed, longest, force

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices, and take the initial distances as lengths where none were given."""
        self.check_indices(particles)
        if "length" not in self.__dict__:
            self._keep(length=self.rest_of(particles.position))
            if (self.length == 0).any():
                i = int(np.argmax(self.length == 0))
                pair = tuple(int(v) for v in self.indices[i])
                raise ValueError(f"Winch: pairs[{i}] = {pair} are in the same place, so the rope has no length. Give length=...")
        if "shortest" not in self.__dict__:
            self.shortest = SHORTEST * self.length

    def drive_of(self, scene: Scene) -> Drive:
        """Make the drive, which goes to the shortest or the longest length."""
        return Drive(scene, self, self.length)

    def course(self) -> tuple[Any, Any, Any]:
        """Return the goals of the lengths [m], the speeds [m/s] and the largest pulls [N]."""
        return np.where(self.speed > 0, self.longest, self.shortest), np.abs(self.speed), self.force

    def start_at(self, position: np.ndarray, first: int) -> None:
        """Lengthen ropes with a limited force whose ends were placed further apart, to the new distance."""
        far = np.isfinite(self.force) & (self.violation(position) > 0) & (self.indices >= first).any(axis=1)
        if far.any():
            self.dev.drive.put(np.where(far, self.rest_of(position), self.rest))
