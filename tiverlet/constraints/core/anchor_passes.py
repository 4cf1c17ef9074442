"""The passes over particles that are each drawn to a place."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from .passes import Passes
from .spring import Spring

if TYPE_CHECKING:
    from ...features.feature import Scene


class Place:
    """The contract of the places that particles are drawn to, on the device: C = x - place.

    name: distinguishes it from other features. corners: the particles. in_state: its fields in the exact state, by name.
    """

    has_own_compile_time = True
    name: str
    state: Any
    corners: Any
    in_state: dict[str, Any]

    def __repr__(self) -> str:
        return self.name

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """Return C at the end and at the start of the substep."""
        return 0.0, 0.0

    @ti.func
    def offset_now(self, c, back):
        """Return C at x - back d."""
        return 0.0

    @ti.func
    def offset_change(self, c):
        """Return how far C changed in the last substep by the motion of the particle."""
        return self.state.d[self.corners.member(c, 0)]

    @ti.func
    def drive(self, c, h, frame_fraction):
        """Where particles are driven: put particle c in its place."""


class AnchorPasses(Passes):
    """The passes of an Anchored. Driven particles have no multipliers and springs. start: C at the start, (m, dim)."""

    def __init__(self, scene: "Scene", batch: Any, start: np.ndarray):
        self.name = name = repr(batch)
        self.state, self.slots, self.w, self.real = scene.state, scene.slots, scene.state.w, scene.real
        self.corners = batch.members.bind(scene, batch)
        self.size = scene.memory.number(batch.start.size, scene.real)
        if not batch.is_kinematic:
            self.lam = scene.memory.field(f"{name}.multiplier", batch.count, width=scene.particles.dim, state=True)
            compliance, damping = (batch.compliance, batch.damping) if batch.soft else (None, None)
            self.spring = Spring(scene, name, compliance, damping, start)
            if scene.slots.answers:
                dim = scene.particles.dim
                self.law_now = scene.memory.field(f"{name}.answering", batch.count, width=2)  # A and alpha' in this substep
                self.answered = scene.memory.field(f"{name}.answered", batch.count, width=dim, state=True)  # in the last substep
                self.blow = scene.memory.field(f"{name}.blow", batch.count, width=dim, state=True)  # part of lam that is over
        self.place = batch.place_of(scene, self)

    @ti.func
    def solve(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Return the multiplier before and after a pass, and the size of the violation that the pass removes."""
        w = self.w[self.corners.member(c, 0)]
        C, C0 = self.place.offsets(c, frame_fraction, first, fresh)
        lam, B = self.lam[c], 0 * C
        if first != 0:
            lam = ti.Vector.zero(self.real, self.state.dim)
        new, size = lam, 0 * w
        if w > 0:
            alpha, A = 0 * w, 1 + 0 * w
            if ti.static(self.spring.soft):
                alpha = self.spring.alpha[c] / h2_effective
                A, now, last = self.spring.law(c, h, w, fresh)
                if first != 0:
                    self.spring.history[c] = now * C0 + last * self.spring.last_value(c, C0, fresh)
                    self.spring.last[c] = C0
                B = self.spring.history[c]
            K = A * self.slots.split[self.corners.member(c, 0)] + alpha
            left = A * C + B + alpha * lam
            new, size = lam - self.slots.relaxation * left / K, left.norm()
        return lam, new, size

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Draw the particle to its place."""
        lam, new, size = self.solve(c, h, h2_effective, frame_fraction, first, fresh)
        self.lam[c] = new
        self.corners.write_move(c, 0, self.w[self.corners.member(c, 0)] * (new - lam))

    @ti.func
    def begin_answer(self, c, h, h2_effective, fresh, bodies: ti.template()):  # type: ignore[valid-type]
        """Store the law of this substep."""
        w = self.w[self.corners.member(c, 0)]
        alpha, A = 0 * w, 1 + 0 * w
        if ti.static(self.spring.soft):
            alpha = self.spring.alpha[c] / h2_effective
            A, _now, _last = self.spring.law(c, h, w, fresh)
        self.law_now[c] = [A, alpha]

    @ti.func
    def answer(self, c, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Hold the particle against a move: A (its move) + alpha' (answer / w) = 0."""
        i, place = self.corners.member(c, 0), self.corners.places[c][0]
        if place >= 0:
            A, alpha, w, before = self.law_now[c][0], self.law_now[c][1], self.w[i], self.slots.answer[place]
            change = (A * w * (moved[i] - d[i]) + alpha * before) / (A * self.slots.split[i] + alpha)
            self.slots.answer[place] = before - change

    @ti.func
    def end_answer(self, c, rows: ti.template()):  # type: ignore[valid-type]
        """Add the answer to the multiplier. Unless it is steady, it came of a blow."""
        i, place = self.corners.member(c, 0), self.corners.places[c][0]
        if place >= 0:
            answer, impulse = self.slots.answer[place], self.slots.answer[place] / self.w[i]
            change = (answer - rows.scale[None] * self.answered[c]).norm()
            self.answered[c] = answer
            self.blow[c] = ti.select(rows.is_steady(change, answer.norm(), rows.kick(i).norm()), 0 * impulse, impulse)
            self.lam[c] = self.lam[c] + impulse

    @ti.func
    def push_spring_force(self, c, h, soft, alone):
        """Push h^2 times the spring acceleration, as in CornerPasses, for each axis."""
        move = ti.Vector.zero(self.real, self.state.dim)
        if ti.static(self.spring.soft):
            w, alpha = self.w[self.corners.member(c, 0)], self.spring.alpha[c]
            if w > 0 and alpha > 0:
                C = self.place.offset_now(c, 0)
                rate = self.place.offset_change(c) / h
                move = -h * h * w * (1 - self.spring.stiff(c, h, w)) * (C / alpha + self.spring.damping[c] * rate)
        self.corners.write_move(c, 0, move)

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push the reaction, as in CornerPasses, for each axis."""
        i = self.corners.member(c, 0)
        w, lam = self.w[i], self.lam[c]
        if ti.static(self.slots.answers):
            lam -= self.blow[c]
        pull = firm * lam
        if ti.static(self.spring.soft):
            if w > 0 and self.spring.alpha[c] > 0:
                grown = self.place.offset_now(c, 0) - self.spring.last[c]
                pull = soft * lam + self.spring.force_change(c, grown, h, w, self.slots.split[i])
        self.corners.write_move(c, 0, w * pull)

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """Return the violation that is left, relative to the size of the scene."""
        _, _, size = self.solve(c, h, h2_effective, frame_fraction, 0, fresh)
        return size / self.size.now

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Return |C|^2 / (2 alpha), of the part of C that bears a load: F C / 2, see Equation."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.spring.soft):
            alpha = self.spring.alpha[c]
            if alpha > 0:
                C = self.place.offset_now(c, back)
                out = ti.cast(C.dot(C) / (2 * alpha), ti.f64)
                pull, w = ti.cast(self.lam[c], ti.f64), self.w[self.corners.member(c, 0)]
                force = ti.math.length(pull)
                out *= self.spring.bearing_share(force * alpha, h2_effective, residual * self.size.now)
                if h2_effective > 0:
                    force /= h2_effective
                out = self.spring.energy(c, w, h2_effective, out, force * force * alpha / 2)
        return out
