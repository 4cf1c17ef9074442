"""Particles that are each drawn to a place: what pins, paths and grids share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device.interrupts import in_turn
from ...features.feature import Batch, Feature, Knob, Scene
from ...features.items import Items
from ...features.regrouping import Regrouping
from .anchor_passes import AnchorPasses, Place
from .members import Members
from .spring import SOFTEST, bears_nothing, per_newton

if TYPE_CHECKING:
    from ...particles import Particles


def one_each(who: str, indices, count: int = checks.ANY) -> Members:
    """Check particles below `count`, each of which has one place, and return them as members."""
    rows = checks.indices(who, "indices", indices, count)
    if len(rows) > 1 and len(np.unique(rows)) < len(rows):
        values, counts = np.unique(rows, return_counts=True)
        raise ValueError(f"{who}: particle {values[counts > 1][0]} is named twice, and can have only one place.")
    return Members(who, rows[:, None])


class Anchored(Batch):
    """Constraints C(x) = x - place on one particle each, a vector, from soft to rigid.

    Each axis follows the law of Equation, with unit vectors for gradients. place_of() of each kind makes the place on the device.
    """

    host_only = ("_soft_cache",)

    arity = 1
    answers_alone = True
    each = ("compliance", "damping")
    uploads_all = True
    exclusive = False  # no other feature may hold its particles
    compliance = Knob(lambda f, v: f._compliance(v), "Inverse stiffness [m/N].", force=True)
    damping = Knob(Items("damping", least=0.0), "Of the dashpot [N s/m].", force=True)
    compiled_for = ("soft",)
    _soft_cache: tuple[Any, bool] = (None, False)  # compliances, and whether any of them is above 0

    def setup(self, indices, compliance, damping) -> None:
        """Store the arguments of __init__."""
        self.members = one_each(repr(self), indices)
        self.compliance, self.damping = compliance, damping

    def _compliance(self, value) -> np.ndarray:
        return checks.per_item(repr(self), "compliance", value, self.count, least=0.0, most=SOFTEST)

    @property
    def listing(self) -> np.ndarray:
        """The particle of each constraint, (m,)."""
        return self.indices[:, 0]

    def set_listing(self, listing: Any) -> None:
        """Act on these particles."""
        self._keep(members=one_each(repr(self), listing))

    @property
    def soft(self) -> bool:
        """Whether any of the constraints is a spring, or was when kernels were compiled."""
        rows = self.compliance
        if rows is not self._soft_cache[0]:  # cached: a pin that takes other particles reads it ten times
            self._soft_cache = rows, bool((rows > 0).any())
        return self._soft_cache[1] or "soft" in self.compiled_so_far

    def upload(self) -> None:
        """Write new stiffnesses to the device."""
        if self.acts and not self.is_kinematic:
            self.dev.spring.upload(self.compliance, self.damping)

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check that the particles exist, and set the inverse mass of driven ones to 0."""
        rows = checks.indices(repr(self), "indices", self.indices[:, 0], particles.count)
        if self.is_kinematic:
            inv_mass[rows] = 0.0

    def end_motion(self) -> None:
        """Start the next frame from the targets of the last one, where particles go to such."""
        if self.acts:
            self.scene.memory.write(self.dev.place.source, self.scene.memory.read(self.dev.place.target))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether none of its particles goes or gets another number."""
        return not (self.indices >= change.first).any()

    def regroup(self, change: Regrouping) -> None:
        """Update the size of the scene, which violations are relative to."""
        if self.acts:
            self.dev.size.set(self.start.size)

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """Return C at the start, (m, dim)."""
        return np.zeros((self.count, position.shape[1]))

    def offset(self, position: np.ndarray) -> np.ndarray:
        """Return C at positions (n, dim), with the places where the coming frame begins, (m, dim)."""
        raise NotImplementedError

    def weights(self, position: np.ndarray) -> np.ndarray:
        """Return the inverse masses of the particles, (m,)."""
        return self.scene.inv_mass[self.indices[:, 0]]

    def place_of(self, scene: Scene, passes: AnchorPasses) -> Place:
        """Make the places of the particles, on the device."""
        raise NotImplementedError

    def bind(self, scene: Scene) -> None:
        """Declare fields. Driven particles have to go from where they are to their places, so these are uploaded first."""
        super().bind(scene)
        self.changed = self.is_kinematic

    def passes(self, scene: Scene) -> AnchorPasses:
        """Make the passes that draw particles to their places."""
        return AnchorPasses(scene, self, self.start_offset(self.start.position))

    @property
    @in_turn
    def load(self) -> np.ndarray:
        """The force on each particle during the last substep [N], (m, dim)."""
        nothing = bears_nothing(self)
        if self.is_kinematic and self.count:
            raise RuntimeError(f"{self!r}.load: driven particles are taken along whatever it takes; give compliance to measure.")
        if nothing:
            return np.zeros((self.count, 0 if self.start is None else self.start.dim))
        scale = per_newton(self.scene.multipliers_per_newton, self.compliance, lambda: self.weights(self.start.position))
        return scale[:, None] * self.scene.memory.read(self.dev.lam)[: self.count].astype(np.float64)


def refuse_held_twice(particles: "Particles", features: tuple[Feature, ...], some: Sequence[Feature] | None = None) -> None:
    """Raise ValueError for a particle that two features hold, or one that is pinned. some: features that changed; None: all."""
    tethers = [(k, f) for k, f in enumerate(features) if isinstance(f, Anchored) and f.exclusive]
    if some is not None and len(tethers) == 1 and not particles.pinned[tethers[0][1].members.rows].any():
        return
    holder = np.full(len(particles), -1)
    # Springs last: they have no effect on driven particles.
    for k, f in sorted(tethers, key=lambda item: not item[1].is_kinematic):
        rows = f.indices[:, 0]
        wrong = particles.pinned[rows] | (holder[rows] >= 0)
        if wrong.any():
            i = int(rows[np.argmax(wrong)])
            other = "is pinned" if particles.pinned[i] else f"is held by features[{holder[i]}] = {features[holder[i]]!r}"
            raise ValueError(
                f"World: features[{k}] = {f!r} holds particle {i}, which {other}. It has one place; leave one of them out."
            )
        if f.is_kinematic:
            holder[rows] = k
