"""The equation of constraints on one number, C = f - rest: one law from soft to rigid."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from .ramp import Ramp
from .spring import RESTARTED, Spring
from .step_limit import StepLimit
from .strength import Strength

SMALLEST = 1e-6  # of the size of the scene: a longer length is not rounding; of the size of f at a constraint: nor is a larger f
SHOWS = 1e-4  # of its size: a residual that is no rounding in f32, and from which on links may be told as softer than given
ROUNDING = 1e-9  # of the size of the scene: a longer rest length is not rounding

if TYPE_CHECKING:
    from ...features.feature import Scene


class Equation:
    """The equation for the multiplier lam of each constraint C(x) = f(x) - rest = 0, >= 0 or <= 0, on the device:

        theta = s^4 / (1 + s^4), s^2 = (omega h)^2 = w h^2 / alpha     0: resolved by the step, 1: rigid
        C*    = (1 - theta) (C_(n+1) + 2 C_n + C_(n-1)) / 4 + theta C_(n+1)
        dlam  = -(A C + B + alpha' lam) / (A W + alpha'),  A = (1 - theta)/4 + theta,  alpha' = alpha / h^2
        dx_j  = w_j dlam grad_j C(x_n)

    W = sum_j n_j w_j grad_j C(x_(n+1)) . grad_j C(x_n) is the mass-split weight: particle j belongs to n_j constraints, and
    gives each an n_j-th of its mass (Tonge 2012), which keeps the sum of all corrections stable and conserves momentum.
    A start is the first substep after velocities were set (`fresh`). Its force acts for half a kick, alpha' = alpha / (h^2 / 2),
    and C* is made of C_(n+1) and C_n. With drag, alpha' = alpha / (phi h^2) with the factor phi that the exact solution gives
    every other acceleration.

    CornerPasses and OutlinePasses compute f and its gradients, and call the methods here.
    batch: the Scalar. start: f at the start, (m,). side: 0: C = 0; 1: C <= 0; -1: C >= 0. scale: what residuals are relative to
    where the rest value is 0, or rounding: not above `least`. scene_sized: whether that is the size of the scene. in_state: its
    fields in the exact state, by name.
    """

    host_only = ("scene_sized",)

    def __init__(self, scene: "Scene", batch: Any, corners: Any, start: np.ndarray):
        name, m, add, unit = repr(batch), batch.count, scene.memory.field, batch.quantity.unit
        self.slots, self.real, self.side, self.corners = scene.slots, scene.real, batch.side, corners
        self.forces = bool(batch.acts_as_force(scene).any())
        scale, self.scene_sized = unit or 0.0, False
        if not unit:
            scale, least, self.scene_sized = residual_sizes(batch, start)
            self.least = scene.memory.number(least, scene.real)
        self.scale = scene.memory.number(scale, scene.real)
        self.rest = add(f"{name}.rest", m, values=batch.goal, state=batch.driven)
        self.driven = batch.driven
        self.drive: Any = batch.drive_of(scene) if batch.driven else None
        self.capped = batch.driven and self.drive.capped
        self.bounded = self.capped or self.side != 0
        self.lam = add(f"{name}.multiplier", m, state=True)
        self.in_state = {"lam": self.lam}
        self.answers = scene.slots.answers
        if self.answers:
            self.touched = add(f"{name}.touched", m, kind=ti.i32, state=True)  # whether contacts moved it in the last substep
            self.left = add(f"{name}.left", m, state=True)  # what they left it violated by: no reason for an impulse
            self.answered = add(f"{name}.answered", m, state=True)  # the answer of the last substep, with lam where relaxed alone
            self.blow = add(f"{name}.blow", m, state=True)  # the part of lam that is over
            self.in_state |= {"touched": self.touched, "left": self.left, "answered": self.answered, "blow": self.blow}
        if batch.driven:
            self.in_state["rest"] = self.rest
        compliance, damping = batch.compliance if batch.soft else None, batch.damping if batch.damped else None
        self.spring = Spring(scene, name, compliance, damping, start, restarts=not self.forces)
        self.strength = Strength(scene, name, batch)
        self.limit = StepLimit(scene, name, batch)
        self.cusp, self.ramp = batch.cusp, Ramp(scene.memory, batch)
        self.quantity = batch.quantity.bind(scene, batch, self)

    @ti.func
    def clip_to_side(self, value):
        """Return `value` where the constraint acts on its side, else 0."""
        if ti.static(self.side != 0):
            value = ti.max(self.side * value, 0) * self.side
        return value

    @ti.func
    def bounds(self, c):
        """Return the least and the largest multiplier of constraint c: by its side, and by the largest load of its drive.

        Whoever finds multipliers asks here: passes, systems, and contacts (`contact/links.py`).
        """
        low, high = ti.cast(-ti.math.inf, self.real), ti.cast(ti.math.inf, self.real)
        if ti.static(self.capped):
            low, high = -self.drive.most[c], self.drive.most[c]
        if ti.static(self.side > 0):
            high = ti.cast(0, self.real)
        elif ti.static(self.side < 0):
            low = ti.cast(0, self.real)
        return low, high

    @ti.func
    def within_bounds(self, c, lam):
        """Return the multiplier within the bounds of constraint c that is nearest to `lam`."""
        if ti.static(self.bounded):
            low, high = self.bounds(c)
            lam = ti.max(low, ti.min(high, lam))
        return lam

    @ti.func
    def has_cusp(self, c):
        """Whether constraint c is rigid and at a cusp, where its directions are unrelated from one pass to the next."""
        out = False
        if ti.static(self.cusp):
            out = self.rest[c] == 0 and self.spring.is_rigid(c)
        return out

    @ti.func
    def terms(self, c, f, f0, w, W, h, h2_effective, first, fresh):
        """Return A C + B + alpha' lam, A, alpha', lam and W (0 if broken). f, f0: at the end and the start. w: see stiff()."""
        if ti.static(self.strength.breaks):
            if not self.strength.is_intact(c):
                W = 0
        if ti.static(self.forces):
            if not self.spring.is_rigid(c):
                W = 0
        C, A = self.quantity.excess(c, f), ti.cast(1, self.real)
        if ti.static(self.answers):
            C -= self.left[c]
        B, alpha = ti.cast(0, self.real), ti.cast(0, self.real)
        lam = self.lam[c]
        if first != 0:
            lam = 0
        if ti.static(self.spring.soft):
            if W > 0:
                A, now, last = self.spring.law(c, h, w, fresh)
                alpha = self.spring.alpha[c] / h2_effective
                if first != 0:
                    f_last = self.quantity.unwrap(self.spring.last_value(c, f0, fresh), f0)
                    C_now, C_last = self.earlier_violation(c, f0, 1), self.earlier_violation(c, f_last, 2)
                    B = now * self.clip_to_side(C_now) + last * self.clip_to_side(C_last)
                    if ti.static(not self.forces):
                        if fresh == RESTARTED:
                            B += (1 - self.spring.stiff(c, h, w)) * self.spring.offset[c]
                    self.spring.history[c] = B
                    self.spring.last[c] = f0
                else:
                    B = self.spring.history[c]
            elif first != 0:  # without a direction now, it may get one in a later pass
                self.spring.history[c] = 0
                self.spring.last[c] = f0
        return A * C + B + alpha * lam, A, alpha, lam, W

    @ti.func
    def remember(self, c, f0):
        """At the start of a substep, note what the passes of contacts have left constraint c violated by, which they touched."""
        stays = self.touched[c] != 0 and not self.has_cusp(c)  # at a cusp, its direction would not be that of a link
        self.left[c] = ti.select(stays, self.clip_to_side(self.earlier_violation(c, f0, 1)), 0 * f0)

    @ti.func
    def earlier_violation(self, c, f, ago: ti.template()):  # type: ignore[valid-type]
        """Return f - rest with the rest value of `ago` substeps ago."""
        C = f - self.rest[c]
        if ti.static(self.driven):
            C += ago * self.drive.step[c]
        elif ti.static(self.ramp.is_allocated and not self.quantity.centred):
            C += self.ramp.step[c] if ti.static(ago == 1) else self.ramp.steps[c]
        return C

    @ti.func
    def postpone(self, c, f0, W, share, first):
        """Return the part of the violation that is left for later, see StepLimit. share: of the frame; 0 outside of a substep."""
        out = ti.cast(0, self.real)
        if first != 0:
            C = f0 - self.rest[c]
            if ti.static(self.driven):  # the motion of the drive in this substep is not postponed
                C += self.drive.step[c]
            if self.spring.is_rigid(c):
                out = self.limit.postpone(c, self.clip_to_side(C), W * ti.abs(self.lam[c]), self.residual_scale(c), share)
            self.limit.postponed[c] = out
        elif share > 0:
            out = self.limit.postponed[c]
        return out

    @ti.func
    def multiplier_of(self, c, violation, A, alpha, lam, W):
        """Return the multiplier after a Jacobi pass."""
        new = lam
        if W > 0:
            new = self.within_bounds(c, lam - self.slots.relaxation * violation / (A * W + alpha))
        return new

    @ti.func
    def jacobi_update(self, c, violation, A, alpha, lam, W, turn):
        """Return the multiplier after a Jacobi pass. Where it changes, record how far the constraint turned."""
        new = self.multiplier_of(c, violation, A, alpha, lam, W)
        if new != lam:
            self.slots.record_turn(turn)
        return new

    @ti.func
    def left_violation(self, c, f, w, W, h, h2_effective, fresh):
        """Return the size of the violation that a Jacobi pass would remove. f, w, W, ...: as in terms()."""
        violation, A, alpha, lam, W = self.terms(c, f, f, w, W, h, h2_effective, 0, fresh)
        if ti.static(self.answers):  # what contacts left: no reason for an impulse, but part of the residual
            violation += A * self.left[c]
        size = ti.cast(0, self.real)
        if W > 0:
            new = self.multiplier_of(c, violation, A, alpha, lam, W)
            size = ti.abs(new - lam) * (A * W + alpha) / self.slots.relaxation
        return size

    @ti.func
    def take_answer(self, c, mu, before, weight, slight, rows: ti.template()):  # type: ignore[valid-type]
        """Add the answer mu to impulses of contacts to the multiplier. Unless it is steady, it came of a blow, which is over.

        before: of the last substep. weight: by how much a multiplier of 1 changes f. slight: by how much forces change it.
        """
        self.lam[c] = self.lam[c] + mu
        self.answered[c] = mu
        steady = rows.is_steady(weight * ti.abs(mu - before), weight * ti.abs(mu), slight)
        self.blow[c] = ti.select(steady, 0 * mu, mu)

    @ti.func
    def spring_force(self, c, f, f0, w, W, h, soft):
        """Return the force of a spring at x_n, for starts: 1 - theta of that of the last substep, and its change since.

        f, f0: now and a substep ago. w, W: as in Spring.force_change(). soft: as in Passes.push_reaction(). Springs that act as
        forces have F = -(C / alpha + damping dC/dt). With that force, starts are steps of explicit Verlet: they pump the modes
        in which many springs act together and omega h > 2, though each of them alone is resolved. So the start begins with this
        force, too: `offset` is -alpha F - C_n, by which F differs from that of a spring.
        """
        force = ti.cast(0, self.real)
        if ti.static(self.spring.soft):
            alpha = self.spring.alpha[c]
            if w > 0 and alpha > 0 and self.strength.is_intact(c):
                C = self.clip_to_side(f - self.rest[c])
                if ti.static(self.forces):
                    force = -C / alpha
                    if ti.static(self.spring.damped):
                        if ti.static(self.side == 0) or C != 0:
                            force -= self.spring.damping[c] * (f - f0) / h
                else:
                    had, change = soft * self.lam[c], self.spring.force_change(c, self.growth(c, f), h, w, W)
                    force, elastic = (1 - self.spring.stiff(c, h, w)) * had + change, had + change
                    if ti.static(self.side != 0):
                        force, elastic = -self.clip_to_side(-force), -self.clip_to_side(-elastic)
                    force /= h * h
                    elastic /= h * h
                    if ti.static(self.spring.damped):
                        elastic += self.spring.damping[c] * (f - f0) / h
                    if self.corners.awake(c):
                        self.spring.offset[c] = -alpha * elastic - C
                if ti.static(self.driven):
                    force = self.drive.clamp_force(c, force)
        return force

    @ti.func
    def growth(self, c, f):
        """Return how much the violation of a spring has grown since the start of the last substep, with f now."""
        last = self.quantity.unwrap(self.spring.last[c], f)
        return self.clip_to_side(f - self.rest[c]) - self.clip_to_side(self.earlier_violation(c, last, 1))

    @ti.func
    def reaction(self, c, f, w, W, h, firm, soft):
        """Return h^2 F of the last substep and its change since, 0 if broken, see Spring and Passes.push_reaction()."""
        lam = self.lam[c]
        if ti.static(self.answers):
            lam -= self.blow[c]
        pull = firm * lam
        if ti.static(self.spring.soft):
            if not self.spring.is_rigid(c):
                pull = soft * lam
                if w > 0 and self.strength.is_intact(c):
                    pull += self.spring.force_change(c, self.growth(c, f), h, w, W)
                    if ti.static(self.side != 0):
                        pull = -self.clip_to_side(-pull)
                    if ti.static(self.driven):
                        pull = h * h * self.drive.clamp_force(c, pull / (h * h))
        if ti.static(self.strength.breaks):
            if not self.strength.is_intact(c):
                pull = 0 * pull
        return pull

    @ti.func
    def stores_energy(self, c):
        """Whether constraint c is a spring that holds, and can store energy."""
        return self.spring.alpha[c] > 0 and self.strength.is_intact(c)

    @ti.func
    def energy(self, c, f, w, h2_effective, residual):
        """Return the elastic energy [J] of a spring at f, F C / 2 with F = -lam / h2_effective, see Spring.energy()."""
        alpha = self.spring.alpha[c]
        C = self.clip_to_side(self.quantity.unwrap(f, self.rest[c]) - self.rest[c])
        out = ti.cast(C, ti.f64) * C / (2 * alpha)
        if ti.static(not self.forces):
            out *= self.spring.bearing_share(ti.abs(self.lam[c]) * alpha, h2_effective, residual * self.residual_scale(c))
            force = ti.cast(self.lam[c], ti.f64)
            if h2_effective > 0:
                force /= h2_effective
            out = self.spring.energy(c, w, h2_effective, out, force * force * alpha / 2)
        return out

    @ti.func
    def softening(self, c, h2_effective, residual):
        """Return |F| times what passes left of the violation, where it shows, and times alpha |F| [J]; 0 where rigid."""
        out = ti.Vector.zero(ti.f64, 2)
        if ti.static(self.spring.soft and not self.forces):
            if h2_effective > 0 and self.stores_energy(c):
                force = ti.abs(ti.cast(self.lam[c], ti.f64)) / h2_effective
                out[1] = self.spring.alpha[c] * force * force
                if residual > SHOWS:
                    out[0] = residual * self.residual_scale(c) * force
        return out

    @ti.func
    def residual_scale(self, c):
        """Return the scale of the residual of constraint c."""
        size = self.scale.now
        if ti.static(not self.quantity.unit):
            if ti.abs(self.rest[c]) > self.least.now:
                size = ti.abs(self.rest[c])
        return size


def residual_sizes(batch: Any, start: np.ndarray) -> tuple[float, float, bool]:
    """Return what residuals are relative to where the rest value is 0 or rounding, the largest rest value that is rounding, and
    whether the former is the size of the scene.

    start: f at the start, (m,). The size of f at a constraint is its extent times |grad f|, see Scalar.inverse_size(). A volume
    of 1e-17 m^3 between corners 1 m apart is rounding: its size is 1 m^3.
    """
    size, distance = batch.start.size, batch.quantity.is_distance
    inverse = np.zeros(0) if distance else batch.inverse_size(batch.start.position)
    sizes = 1 / inverse[inverse > 0]
    least = SMALLEST * (size if distance else sizes.min(initial=np.inf) if len(sizes) else 0.0)
    rest = ROUNDING * size if distance else least
    if (np.abs(start) > least).any():
        return float(np.abs(start).mean()), rest, False
    return (float(sizes.mean()), rest, False) if len(sizes) else (size, rest, True)
