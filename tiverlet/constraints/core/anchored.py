"""Particles drawn to a place, each by itself: what pins, paths and grids share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import Batch, Feature, Knob, Scene
from ...features.regrouping import Regrouping
from .members import FixedSize
from .spring import Spring, stiff

if TYPE_CHECKING:
    from ...particles import Particles


def one_each(who: str, indices, count: int = checks.ANY) -> FixedSize:
    """Particles of `count`, each of which has a place."""
    rows = checks.indices(who, "indices", indices, count)
    if len(rows) > 1 and len(np.unique(rows)) < len(rows):
        values, counts = np.unique(rows, return_counts=True)
        raise ValueError(f"{who}: particle {values[counts > 1][0]} is named twice, and can have only one place.")
    return FixedSize(who, rows[:, None])


class Anchored(Batch):
    """Constraints C(x) = x - place on one particle each, a vector, from soft to rigid: the formula of Scalar for each axis alike,
    with unit vectors for gradients.

    Subclasses give, on the device, offsets(): C at the end and at the start of a substep, and offset_now(): C at present; where
    they drive their particles instead (`drives`), drive(c, h, frame_fraction) puts particle c in its place.
    """

    arity = 1
    each = ("compliance", "damping")
    uploads_all = True
    exclusive = False  # nothing else may hold its particles
    compliance = Knob(lambda f, v: f._compliance(v), "Inverse stiffness [m/N].", force=True)
    damping = Knob(lambda f, v: checks.per_item(repr(f), "damping", v, f.count, least=0.0), "Of the dashpot [N s/m].", force=True)
    compiled_for = ("soft",)
    _asked: tuple[Any, bool] = (None, False)  # compliances, and whether any of them is above 0

    def setup(self, indices, compliance, damping) -> None:
        """Keep the arguments of __init__."""
        self.members = one_each(repr(self), indices)
        self.compliance, self.damping = compliance, damping

    def _compliance(self, value) -> np.ndarray:
        return checks.per_item(repr(self), "compliance", value, self.count, least=0.0)

    @property
    def listing(self) -> np.ndarray:
        """The particle of each constraint."""
        return self.indices[:, 0]

    @property
    def soft(self) -> bool:
        """Whether any of them is a spring, or was when kernels were compiled."""
        rows = self.compliance
        if rows is not self._asked[0]:  # it is asked ten times when a pin takes others
            self._asked = rows, bool((rows > 0).any())
        return self._asked[1] or self._built("spring", "soft")

    def upload(self) -> None:
        """Write new stiffnesses."""
        if self.acts and not self.drives:
            self.dev.spring.upload(self.compliance, self.damping)

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check that the particles exist."""
        checks.indices(repr(self), "indices", self.indices[:, 0], particles.count)

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether none of its particles goes or gets another number."""
        return not (self.indices >= change.first).any()

    def regroup(self, change: Regrouping) -> None:
        """Violations are relative to the size of the scene, which is another one now."""
        if self.acts:
            self.dev.size.set(self.start.size)

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """C at the start, (m, dim)."""
        return np.zeros((self.count, position.shape[1]))

    def bind(self, scene: Scene) -> None:
        """Declare multipliers where particles are not driven, and the memory of springs."""
        super().bind(scene)
        self.dev.size = scene.memory.number(self.start.size, scene.real)
        if not self.drives:
            self.dev.lam = scene.memory.field(f"{self!r}.multiplier", self.count, width=scene.particles.dim, state=True)
            compliance, damping = (self.compliance, self.damping) if self.soft else (None, None)
            self.dev.spring = Spring(scene, repr(self), compliance, damping, self.start_offset(self.start.position))

    @property
    def load(self) -> np.ndarray:
        """The force on each particle during the last substep [N], (m, dim)."""
        if not self.count:
            return np.zeros((0, 0 if self.start is None else self.start.dim))
        if self.scene is None:
            raise RuntimeError(f"{self!r}.load: there is none before a world has been stepped with it.")
        if self.drives:
            raise RuntimeError(f"{self!r}.load: driven particles are taken along whatever it takes; give compliance to measure.")
        if not self.acts:
            return np.zeros((self.count, self.scene.particles.dim))
        scale = 1 / self.scene.h2_effective if self.scene.h2_effective else 0.0
        return scale * self.scene.memory.read(self.dev.lam)[: self.count].astype(np.float64)

    @ti.func
    def nothing(self):
        """A vector of zeros."""
        return ti.Vector.zero(self.dev.real, self.dev.state.dim)

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """C at the end and at the start of the substep."""
        return self.nothing(), self.nothing()

    @ti.func
    def offset_now(self, c, back):
        """C at x - back d."""
        return self.nothing()

    @ti.func
    def offset_change(self, c):
        """How far C changed in the last substep by the motion of the particle."""
        return self.dev.state.d[self.member(c, 0)]

    @ti.func
    def solve(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Multiplier before and after, and the size of the violation that this removes."""
        w = self.dev.w.of(self.member(c, 0))
        C, C0 = self.offsets(c, frame_fraction, first, fresh)
        lam, B = self.dev.lam[c], 0 * C
        if first != 0:
            lam = self.nothing()
        new, size = lam, 0 * w
        if w > 0:
            alpha, A = 0 * w, 1 + 0 * w
            if ti.static(self.dev.spring.soft):
                alpha = self.dev.spring.alpha[c] / h2_effective
                A, now, last = self.dev.spring.law(c, h, w, fresh)
                if first != 0:
                    self.dev.spring.history[c] = now * C0 + last * self.dev.spring.before(c, C0, fresh)
                    self.dev.spring.last[c] = C0
                B = self.dev.spring.history[c]
            K = A * self.dev.slots.split[self.member(c, 0)] + alpha
            new = lam - self.dev.slots.relaxation * (A * C + B + alpha * lam) / K
            size = (new - lam).norm() * K / self.dev.slots.relaxation
        return lam, new, size

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Draw the particle to its place."""
        lam, new, size = self.solve(c, h, h2_effective, frame_fraction, first, fresh)
        self.dev.lam[c] = new
        self.push(c, 0, self.dev.w.of(self.member(c, 0)) * (new - lam))

    @ti.func
    def push_spring_force(self, c, h):
        """As in Scalar, for each axis."""
        move = self.nothing()
        if ti.static(self.dev.spring.soft):
            w, alpha = self.dev.w.of(self.member(c, 0)), self.dev.spring.alpha[c]
            if w > 0 and alpha > 0:
                C = self.offset_now(c, 0)
                rate = self.offset_change(c) / h
                move = -h * h * w * (1 - stiff(alpha, h, w)) * (C / alpha + self.dev.spring.damping[c] * rate)
        self.push(c, 0, move)

    @ti.func
    def push_reaction(self, c, firm, soft):
        """As in Scalar, for each axis."""
        scale = firm
        if ti.static(self.dev.spring.soft):
            scale = ti.select(self.dev.spring.alpha[c] > 0, soft, firm)
        self.push(c, 0, scale * self.dev.w.of(self.member(c, 0)) * self.dev.lam[c])

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """The violation that is left, relative to the size of the scene."""
        _, _, size = self.solve(c, h, h2_effective, frame_fraction, 0, fresh)
        return size / self.dev.size.now

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """|C|^2 / (2 alpha), of what bears a load: F C / 2, see Scalar."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.dev.spring.soft):
            alpha = self.dev.spring.alpha[c]
            if alpha > 0:
                C = self.offset_now(c, back)
                out = ti.cast(C.dot(C) / (2 * alpha), ti.f64)
                out *= self.dev.spring.solved(self.dev.lam[c].norm() * alpha, h2_effective, residual * self.dev.size.now)
                force, w = ti.cast(self.dev.lam[c].norm(), ti.f64), self.dev.w.of(self.member(c, 0))
                if h2_effective > 0:
                    force /= h2_effective
                out = self.dev.spring.energy(c, w, h2_effective, out, force * force * alpha / 2)
        return out


def refuse_held_twice(particles: "Particles", features: tuple[Feature, ...], some: Sequence[Feature] | None = None) -> None:
    """A particle has one place: refuse pins and driven paths on one that is pinned, or that another one holds. some: those that
    hold others than before; None for all."""
    tethers = [(k, f) for k, f in enumerate(features) if isinstance(f, Anchored) and f.exclusive]
    if some is not None and len(tethers) == 1 and not particles.pinned[tethers[0][1].members.rows].any():
        return
    holder = np.full(len(particles), -1)
    for k, f in sorted(tethers, key=lambda item: not item[1].drives):  # springs are lost on what is driven
        rows = f.indices[:, 0]
        wrong = particles.pinned[rows] | (holder[rows] >= 0)
        if wrong.any():
            i = int(rows[np.argmax(wrong)])
            other = "is pinned" if particles.pinned[i] else f"is held by features[{holder[i]}] = {features[holder[i]]!r}"
            raise ValueError(
                f"World: features[{k}] = {f!r} holds particle {i}, which {other}. It has one place; leave one of them out."
            )
        if f.drives:
            holder[rows] = k
