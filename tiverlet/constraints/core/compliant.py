"""What is asked of a number of particles, from soft to rigid: C = f - rest, and the spring behind it."""

import warnings
from typing import Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import Knob, Scene
from ...particles import Particles
from .breakable import Breaking
from .compliance import law, stiff
from .scalar_function import Number


class Elastic(Number, Breaking):
    """C = f - rest, and what a substep asks of it: A C + B + alpha' lam = 0, see Scalar for A and alpha'.

    B is what C was at the start of the substep and of the one before, by their shares: the memory of a soft constraint. As a
    force, F = -C / alpha - damping dC/dt, it acts at starts, and in substeps of an order above 2.
    """

    side = 0  # 0: C = 0;  1: C <= 0, pulls when f > rest;  -1: C >= 0, pushes when f < rest
    rest: Any  # a Knob in each constraint: (m,) array
    compliance = Knob(lambda f, v: checks.per_item(repr(f), "compliance", v, f.count, least=0.0), "Of springs.", force=True)
    damping = Knob(lambda f, v: checks.per_item(repr(f), "damping", v, f.count, least=0.0), "Of the dashpot.", force=True)
    compiled_for = ("soft", "damped", "breaks", "_strictly")

    each = ("rest", "compliance", "damping", "break_at")
    rest_name = "rest"
    unit: float | None = None  # what residuals are relative to; None: the rest value

    def setup(self, indices, rest, compliance, damping, break_at=None) -> None:
        """Keep the arguments of __init__; what depends on the particles is checked in prepare()."""
        self.lay(indices)
        self._rest_given = rest
        self.break_at, self.compliance, self.damping = break_at, compliance, damping

    @property
    def goal(self) -> np.ndarray:
        """What f is to be, (m,)."""
        return self.rest

    def violation(self, position: np.ndarray) -> np.ndarray:
        """C at the given positions, (m,)."""
        return self.rest_of(position) - self.goal

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check indices against the number of particles and settle the rest values."""
        self.fit(particles)
        if "rest" not in self.__dict__:
            if self._rest_given is None:
                self.__dict__["rest"] = self.rest_of(particles.position)
            else:
                self.rest = self._rest_given

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of constraints that are violated between particles that cannot move."""
        stuck = self.idle(inv_mass)
        if stuck.any():
            C = self.violation(particles.position)
            wrong = stuck & (
                np.abs(C if self.side == 0 else np.maximum(self.side * C, 0)) > 1e-6 * np.maximum(np.abs(self.goal), 1e-6)
            )
            if wrong.any():
                k = int(np.argmax(wrong))
                at = tuple(int(i) for i in self.members_of(k))
                warnings.warn(
                    f"{self!r}: {self.index_name}[{k}] = {at} is off by {C[k]:g}, but its particles cannot move "
                    f"({int(wrong.sum())} such in all). They are skipped.",
                    stacklevel=3,
                )

    @property
    def soft(self) -> bool:
        """Whether any constraint of the batch has compliance, or had when kernels were compiled."""
        return bool((self.compliance > 0).any()) or vars(self.dev).get("soft", False)

    @property
    def damped(self) -> bool:
        """Whether any has a dashpot."""
        return self.soft and bool((self.damping > 0).any()) or vars(self.dev).get("damped", False)

    @property
    def _strictly(self) -> bytes | None:
        """The compliances, where a world of higher order is made for these."""
        return self.compliance.tobytes() if self.scene and self.scene.order > 2 else None

    def sprung(self, scene: Scene) -> np.ndarray:
        """Which constraints act as forces, (m,): soft ones in substeps of an order above 2. See high_order.py."""
        return (self.compliance > 0) & (scene.order > 2)

    def bind(self, scene: Scene) -> None:
        """Declare rest values, multipliers, and for soft ones the memory that the averaged constraint needs."""
        super().bind(scene)
        self.dev.soft = self.soft
        self.dev.sprung = bool(self.sprung(scene).any())
        self.dev.damped = self.damped
        start = self.rest_of(self.start.position) if self.count else np.zeros(0)
        self.dev.scale = self.unit or (float(np.abs(start).mean()) if np.any(start) else self.start.size)
        name, m, add = repr(self), self.count, scene.memory.field
        self.dev.rest = add(f"{name}.rest", m, values=self.goal)
        self.dev.lam = add(f"{name}.multiplier", m, state=True)
        if self.dev.soft:
            self.dev.alpha = add(f"{name}.compliance", m, values=self.compliance)
            self.dev.last = add(f"{name}.last", m, values=start, state=True)
            self.dev.history = add(f"{name}.history", m)
        if self.dev.damped:
            self.dev.damping = add(f"{name}.damping", m, values=self.damping)
        self.bind_strength(scene)
        self.changed = False

    def upload(self) -> None:
        """Write new rest values, stiffnesses and strengths."""
        if self.acts:
            self.scene.memory.write(self.dev.rest, self.goal)
            self.upload_springs()

    def upload_springs(self) -> None:
        """Write new stiffnesses and strengths."""
        if self.dev.soft:
            self.scene.memory.write(self.dev.alpha, self.compliance)
        if self.dev.damped:
            self.scene.memory.write(self.dev.damping, self.damping)
        self.upload_strength()

    @ti.func
    def dashpot(self, c):
        """Damping of constraint c."""
        out = ti.cast(0, self.dev.real)
        if ti.static(self.dev.damped):
            out = self.dev.damping[c]
        return out

    @ti.func
    def is_rigid(self, c):
        """Whether constraint c has no compliance."""
        out = True
        if ti.static(self.dev.soft):
            out = self.dev.alpha[c] == 0
        return out

    @ti.func
    def bounded(self, value):
        """`value` on the side on which the constraint acts, 0 on the other."""
        if ti.static(self.side != 0):
            value = ti.max(self.side * value, 0) * self.side
        return value

    @ti.func
    def equation(self, c, f, f0, w, W, h, hh, first, fresh):
        """A C + B + alpha' lam, A, alpha', lam and W (0 where it is broken), from f at the end and at the start, and w."""
        if ti.static(self.breaks):
            if not self.holds(c):
                W = 0
        if ti.static(self.dev.sprung):
            if not self.is_rigid(c):
                W = 0
        C, A = self.excess(c, f, self.dev.rest[c]), ti.cast(1, self.dev.real)
        B, alpha = ti.cast(0, self.dev.real), ti.cast(0, self.dev.real)
        lam = self.dev.lam[c]
        if first != 0:
            lam = 0
        if ti.static(self.dev.soft):
            if W > 0:
                A, now, last = law(self.dev.alpha[c], self.dashpot(c), h, w, fresh)
                alpha = self.dev.alpha[c] / hh
                if first != 0:
                    rest = self.dev.rest[c]
                    B = now * self.bounded(f0 - rest) + last * self.bounded(self.near(self.dev.last[c], f0) - rest)
                    self.dev.history[c] = B
                    self.dev.last[c] = f0
                else:
                    B = self.dev.history[c]
            elif first != 0:  # it has no direction now, and may get one in a later pass
                self.dev.history[c] = 0
                self.dev.last[c] = f0
        return A * C + B + alpha * lam, A, alpha, lam, W

    @ti.func
    def kick(self, c, h):
        """h^2 w_j F grad_j C with F = -(1 - theta) (C / alpha + damping dC/dt).

        Rigid links find their force in the next substep.
        """
        f, g = self.measure(c, self.corners(c, 0))
        f = self.near(f, self.dev.rest[c])
        f0, w = f, ti.cast(0, self.dev.real)
        if ti.static(self.dev.damped):
            f0, _ = self.measure(c, self.corners(c, 1))
        for k in ti.static(range(self.arity)):
            w += self.dev.w.of(self.member(c, k)) * g[k, :].dot(g[k, :])
        force = self.force(c, f, self.near(f0, f), w, h)
        for k in ti.static(range(self.arity)):
            self.push(c, k, h * h * self.dev.w.of(self.member(c, k)) * force * g[k, :])

    @ti.func
    def bond(self, c, firm, soft):
        """scale w_j lam grad_j C(x_n)."""
        _, g = self.measure(c, self.corners(c, 0))
        pull = self.dev.lam[c] * ti.select(self.is_rigid(c), firm, soft)
        for k in ti.static(range(self.arity)):
            self.push(c, k, self.dev.w.of(self.member(c, k)) * pull * g[k, :])

    @ti.func
    def force(self, c, f, f0, w, h):
        """F of kick(), from f now and a substep ago."""
        force = ti.cast(0, self.dev.real)
        if ti.static(self.dev.soft):
            alpha = self.dev.alpha[c]
            if w > 0 and alpha > 0 and self.holds(c):
                resolved = ti.cast(1, self.dev.real)
                if ti.static(not self.dev.sprung):
                    resolved -= stiff(alpha, h, w)
                C = self.bounded(f - self.dev.rest[c])
                force = -resolved * C / alpha
                if ti.static(self.dev.damped):
                    if ti.static(self.side == 0) or C != 0:
                        force -= resolved * self.dev.damping[c] * (f - f0) / h
        return force

    @ti.func
    def energy(self, c, back, hh, miss):
        """Elastic energy [J] at x - back d: F C / 2, which is C^2 / (2 alpha) once solved.

        What a solver leaves of the violation bears no load: the spring is as soft as it was solved, F = C / (alpha + what that
        adds), and 1 / alpha would count energy that nobody supplied. hh: F = -lam / hh; 0 where there was no substep yet.
        """
        out = ti.cast(0, ti.f64)
        if ti.static(self.dev.soft):
            alpha = self.dev.alpha[c]
            if alpha > 0 and self.holds(c):
                C = self.bounded(self.near(self.value(c, back), self.dev.rest[c]) - self.dev.rest[c])
                out = ti.cast(C, ti.f64) * C / (2 * alpha)
                if ti.static(not self.dev.sprung):
                    if hh > 0 and miss > 0:
                        borne = ti.abs(self.dev.lam[c]) * alpha / hh
                        out *= borne / (borne + miss * self.extent(c))
        return out

    @ti.func
    def extent(self, c):
        """What the residual of constraint c is relative to."""
        size = ti.cast(self.dev.scale, self.dev.real)
        if ti.static(not self.unit):
            if self.dev.rest[c] != 0:
                size = ti.abs(self.dev.rest[c])
        return size
