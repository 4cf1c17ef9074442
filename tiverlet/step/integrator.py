"""The motion of a single particle under forces: position Verlet in displacement form, with exact linear drag."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..features.feature import Acceleration, Scene
from ..tools import golden_steps
from .clock import SHARE
from .span import ENDLESS

if TYPE_CHECKING:
    from .clock import Clock

# Multiples of the golden ratio of two dimensions, mod 1, are the most even sequence of pairs. Each of the two sums takes one.
DITHER = golden_steps(2, bits=32)
ALIKE = {ti.f32: 2.0**-12, ti.f64: 2.0**-26}  # least variation of a velocity, relative: the square root of its rounding error
STIFF = 4.0  # (omega h)^2 beyond which Verlet diverges; velocities that forces turn this fast turn far too slowly
CLOSE = 0.4  # the same in an encounter that changes the energy of motion by SHARE: a kick of 0.4 of the velocity
FORCE = 0.06  # (omega h)^2 of forces that a substep resolves: 25 substeps per period, as in molecular dynamics
TINY = 1e-18  # [m/s], [m/s^2]: keeps divisors from being 0
LEAST = 0.25  # least pivot with which a velocity is solved for; a force that feeds motion faster is taken explicitly


class Forces:
    """The forces and drags of one world.

    all: forces. common: those that are the same for all particles. others: the rest, `positional` or `velocity_dependent`.
    pairwise: forces between particles. drags: features with a drag rate. uneven: forces that vary in space.
    """

    def __init__(self, scene: Scene, accelerations: list[Acceleration]):
        self.real, self.dim = scene.real, scene.particles.dim
        self.all = [f for f in accelerations if f.accelerates]
        self.common, self.others = ([f for f in self.all if f.common is it] for it in (True, False))
        self.pairwise = [f for f in self.all if f.pairwise]
        self.use_velocity = any(f.uses_velocity for f in accelerations)
        self.positional, self.velocity_dependent = ([f for f in self.others if f.uses_velocity is it] for it in (False, True))
        self.drags = [f for f in accelerations if f.decays]
        self.uneven = [f for f in self.all if not f.uniform]
        self.w, self.has_unresolved = scene.state.w, bool(self.uneven or self.pairwise)
        if self.has_unresolved:
            add = scene.memory.field
            self.unresolved = add("forces.unresolved", None, kind=ti.f64)
            self.kicked = add("forces.kicked", None, kind=ti.f64)

    @ti.func
    def change_along(self, i, x, d, h, t):
        """Return the change of the acceleration of particle i along its last displacement d, in a substep h."""
        change = 0 * d
        for f in ti.static(self.uneven):
            change += f.acceleration(i, x, d / h, t) - f.acceleration(i, x - d, d / h, t)
        return change

    @ti.func
    def note_unresolved(self, i, x, d, h, t, a):
        """Note how fast forces change along the last displacement d of particle i.

        a: its acceleration. `unresolved` is the largest (omega h)^2 = h^2 |a(x) - a(x - d)| / |d| since the last report, from
        FORCE on, and `kicked` the largest energy m (|d / h|^2 + |h (a(x) - a(x - d))|^2) / 2 of these particles [J]. A close
        encounter in a force that grows without bound lasts a few substeps, and the end of the frame does not show it.
        """
        size = ti.cast(d.norm(), ti.f64)
        if self.w[i] > 0 and size > 0 and 2 * h * h * a.norm() > FORCE * size:  # a(x) or a(x - d) is half of the change, or more
            change = self.change_along(i, x, d, h, t)
            for f in ti.static(self.pairwise):
                change += f.dev.now[i] - f.dev.last[i]
            kick, v = ti.cast(h * change.norm(), ti.f64), size / h
            if kick > FORCE * v:
                ti.atomic_max(self.unresolved[None], kick / v)
                ti.atomic_max(self.kicked[None], (v * v + kick * kick) / (2 * self.w[i]))

    @ti.func
    def encounter(self, stiff, kinetic):
        """Return (omega h)^2 of the closest encounter since the last report, 0 if there was none, and forget it.

        stiff, kinetic: (omega h)^2 at the end of the frame, and all energy of motion [J], of which what creeps over an edge of a
        force has no share. A linear force is stable up to STIFF. Where a force has grown and fallen within the frame, and so is
        not linear, CLOSE counts as much.
        """
        out = ti.cast(0, ti.f64)
        if self.kicked[None] > SHARE * kinetic:
            out = self.unresolved[None]
            if out > STIFF * stiff:
                out *= ti.static(STIFF / CLOSE)
        self.unresolved[None] = 0
        self.kicked[None] = 0
        return out

    @ti.func
    def pull(self, t):
        """Return the sum of the accelerations that all particles have in common, at time t."""
        a = ti.Vector.zero(self.real, self.dim)
        for f in ti.static(self.common):
            a += f.acceleration(0, a, a, t)
        return a

    @ti.func
    def accelerate(self, i, x, v, t, pull):
        """Return the acceleration of particle i by forces. pull: the result of pull()."""
        a = pull
        for f in ti.static(self.others):
            a += f.acceleration(i, x, v, t)
        return a

    @ti.func
    def reads_velocity_of(self, i):
        """Whether any force that reads velocities acts on particle i."""
        out = False
        for f in ti.static(self.velocity_dependent):
            out = out or f.acts_on(i)
        return out

    @ti.func
    def velocity_part(self, i, x, v, t):
        """Return the part of accelerate() that reads velocities."""
        a = 0 * x
        for f in ti.static(self.velocity_dependent):
            a += f.acceleration(i, x, v, t)
        return a

    @ti.func
    def velocity_slope(self, i, x, v, t, a, c):
        """Return c times the matrix of derivatives of velocity_part() by v, where velocity_part() is a.

        They are finite differences over the change of v to come: |c a|, less if the force brakes, and at most twice |v|, as far
        beyond rest as v is from rest. A kink within this range, as of friction at rest, appears as a slope.
        """
        size, speed = a.norm(), v.norm()
        least = ti.max(ti.static(ALIKE[self.real]) * speed, TINY)
        along = a / ti.max(size, TINY)
        near = ti.static(ALIKE[self.real]) * c * size + least
        braked = c / near * (a - self.velocity_part(i, x, v + near * along, t)).dot(along)
        full = c * size / (1 + ti.max(braked, 0))
        way = ti.max(ti.min(full, 2 * speed), full / 64, least)
        out = ti.Matrix.zero(self.real, self.dim, self.dim)
        for k in ti.static(range(self.dim)):
            other = v
            other[k] += ti.select(a[k] < 0, -way, way)
            change = c / (other[k] - v[k]) * (self.velocity_part(i, x, other, t) - a)
            for j in ti.static(range(self.dim)):
                out[j, k] = change[j]
        return out

    @ti.func
    def velocity_stiffness(self, i, x, v, t, h):
        """Return (omega h)^2 of forces that turn a velocity faster than they brake it, or that feed motion.

        Braking forces do not count: they settle, however strong they are. The trace of (h da/dv)^2 is the part that brakes minus
        the part that turns. A kink, which appears in one column only, adds nothing.
        """
        a = self.velocity_part(i, x, v, t)
        slope = self.velocity_slope(i, x, v, t, a, h)
        rate = a.dot(slope @ a) / ti.max(a.dot(a), TINY * TINY)
        return ti.max(-(slope @ slope).trace() / 2, rate * ti.max(rate, 0))

    @ti.func
    def accelerate_implicitly(self, i, x, u, c, part, t, pull):
        """Return the acceleration a of particle i at the velocity that it gives itself, v = u + (part + theta) c a(x, v).

        It takes one step of Newton's method, which is exact if a is linear in v. part: 1, or 0 at a start (the first substep
        after velocities were set), where u is v_n.
        With theta = 0, a force that turns v conserves |v|, whatever c is. But drag would overshoot from c rate = 1 on. So
        theta = q^2 / (1 + q^2), where q is c times the rate at which a brakes: third order in h, and 1 where drag is stiff.
        """
        still = pull
        for f in ti.static(self.positional):
            still += f.acceleration(i, x, u, t)
        v = u + part * c * still
        a = self.velocity_part(i, x, v, t)
        slope = self.velocity_slope(i, x, v, t, a, c)
        q = ti.max(-a.dot(slope @ a) / ti.max(a.dot(a), TINY * TINY), 0)
        theta = 1 - 1 / (1 + q * q)
        left, more = -(part + theta) * slope, slope @ ((part + theta) * a + theta * still)
        regular = ti.cast(1, ti.i32)
        for k in ti.static(range(self.dim)):  # Gaussian elimination; forces that brake or turn give pivots of 1 or more
            left[k, k] += 1
            regular &= ti.cast(left[k, k] > LEAST, ti.i32)  # false for NaN, as from v / |v| if v + way is 0
            for j in ti.static(range(k + 1, self.dim)):
                share = left[j, k] / left[k, k]
                more[j] -= share * more[k]
                for m in ti.static(range(k + 1, self.dim)):
                    left[j, m] -= share * left[k, m]
        for k in ti.static(range(self.dim - 1, -1, -1)):
            for j in ti.static(range(k + 1, self.dim)):
                more[k] -= left[k, j] * more[j]
            more[k] /= left[k, k]
        a += ti.select(regular != 0, more, ti.zero(a))
        return still + a


class Verlet:
    """d += h^2 a, x += d: the substep of order 2, which is one stage; see high_order.Composition for more.

    A *start* is the first substep after velocities were set or h has changed: there, d holds a velocity.
    """

    stages = 1  # in a substep
    first = 1.0  # length of the first stage, as a share of the substep
    h2_factor = 1.0  # displacement by a constant acceleration of 1 in the last stage, per h^2
    fastest = 0.0  # bound on omega^2 of springs that act as forces [1/s^2]
    springs_pull = False  # whether springs act as forces in every stage, and not only at starts
    half_kick = True  # whether constraints take into account that forces act for half of the substep at a start

    def __init__(self, scene: Scene, forces: Forces, touches: bool):
        self.forces, self.state, self.touches = forces, scene.state, touches
        self.dim, self.real = scene.particles.dim, scene.real
        self.uses_velocity = forces.use_velocity
        self.decays = bool(forces.drags)
        self.dithers = scene.real == ti.f32 and not scene.state.carries
        if self.uses_velocity:
            self.free = scene.memory.field("displacement_free", scene.count, width=self.dim, state=True)
        if self.decays:
            self.decay = scene.memory.field("decay", None, width=5)

    def passes(self, iterations: int) -> int:
        """Return the number of passes over the constraints in each stage."""
        return iterations

    @ti.func
    def times(self, at, s):
        """Return the length of substep s and of the one before [s], its start [s], and the fractions of the frame at its ends."""
        h = ti.cast(at.h64, self.real)
        return h, h, ti.cast(at.start + s * at.h64, self.real), self.frame_fraction(s, at.substeps)

    @ti.func
    def frame_fraction(self, s, substeps):
        """Return the fractions of the frame at the start and the end of substep s, and its share of the frame.

        In an endless frame each substep counts as a frame.
        """
        begin, end = ti.cast(s, self.real) / substeps, ti.cast(s + 1, self.real) / substeps
        return ti.Vector([begin, end, ti.select(substeps < ti.static(ENDLESS), end - begin, 1)])

    @ti.func
    def advance(self, first, end, now):
        """Integrate the particles from `first` to `end` - 1, in a short loop that the compiler can vectorize."""
        pull, share, h2_effective = self.forces.pull(now.time), ti.cast(1, self.real), self.h2_effective(now.h, now.fresh)
        if now.fresh != 0:
            share = now.h
            if ti.static(self.decays):
                share *= self.decay[None][1]
        for i in range(first, end):
            self.integrate(i, now, pull, share, h2_effective)

    @ti.func
    def acceleration_at(self, i, h, t, fresh, pull):
        """Return the acceleration of particle i by forces at x_n and v_n; at a start, d is v_n.

        v_n is the velocity that velocity_after() returns with the reaction of the last substep, see reaction_before(). pull: the
        result of Forces.pull().
        """
        x, u = self.state.place(i), self.state.d[i]
        a = ti.zero(u)
        reads = False
        if ti.static(self.uses_velocity):
            reads = self.forces.reads_velocity_of(i)
            if reads:
                share, rest, phi1 = ti.cast(1, self.real), ti.cast(0.5, self.real), ti.cast(1, self.real)
                if ti.static(self.decays):
                    share, phi1, rest = self.decay[None][0], self.decay[None][1], self.decay[None][3]
                part = ti.select(fresh != 0, ti.cast(0, self.real), ti.cast(1, self.real))
                u = ti.select(fresh != 0, u, (share * u + rest / phi1 * self.reaction_before(i, x, h, t, pull)) / h)
                a = self.forces.accelerate_implicitly(i, x, u, rest * h, part, t, pull)
        if not reads:
            a = self.forces.accelerate(i, x, u, t, pull)
        return a

    @ti.func
    def reaction_before(self, i, x, h, t, pull):
        """Return the reaction of the last substep: the part of d that forces did not cause.

        It is 0 if it is larger than d and than twice the displacement by forces: this is a blow, which does not continue. It is
        also 0 in scenes with contacts, where a slight blow cannot be told from a load.
        """
        d = self.state.d[i]
        reaction = ti.zero(d)
        if ti.static(not self.touches):
            reaction = d - self.free[i]
            force = h * h * self.forces.accelerate(i, x, d / h, t, pull)
            reaction = ti.select(reaction.dot(reaction) > ti.max(d.dot(d), 4 * force.dot(force)), ti.zero(d), reaction)
        return reaction

    @ti.func
    def dithered(self, big, small, tick, step: ti.template()):  # type: ignore[valid-type]
        """Return `small` with a dither, before it is added to `big`.

        In f32, while `small` is constant, such a sum would always be rounded to the same side. In free fall and in uniform motion
        this would be the largest error.
        """
        if ti.static(self.dithers):
            small = self.state.dithered(big, small, ti.cast(tick, ti.u32) * ti.u32(step))
        return small

    @ti.func
    def dithered_move(self, x, d, tick):
        """Return a displacement d with the dither of the substep `tick`, before it is added to a place x."""
        return self.dithered(x, d, tick, DITHER[1])

    @ti.func
    def integrate(self, i, now, pull, share, h2_effective):
        """Integrate particle i: d += h^2 a, x += d; at a start (d is v) x += h v + h^2 a / 2. Linear drag is exact in both.

        Only the writes depend on whether the particle moves, so that the compiler can vectorize over particles.
        """
        live, x, d, h = self.state.moves(i), self.state.x[i], self.state.d[i], now.h
        a = self.acceleration_at(i, h, now.time, now.fresh, pull)
        if ti.static(self.forces.has_unresolved):
            if now.fresh == 0:
                self.forces.note_unresolved(i, self.state.place(i), d, h, now.time, a - pull)
        before, low = ti.select(now.fresh != 0, h * d - h * h / 2 * a, d), ti.zero(d)
        if ti.static(self.state.carries):
            low = self.state.d_low[i]
        if ti.static(self.decays or len(self.forces.all) > 0):
            kick = h2_effective * a
            if ti.static(self.decays):
                # d' = exp(-z) d + phi1 h^2 a, computed as a small change of d, of which f32 keeps more digits.
                kick -= ti.select(now.fresh != 0, ti.zero(d), self.decay[None][4] * d)
            d *= share
            if ti.static(self.state.carries):
                d, low = self.state.sum(d, low, kick)
            else:
                d += self.dithered(d, kick, now.tick, DITHER[0])
        else:
            d *= share
        step = d
        if ti.static(not self.state.sums):
            step = self.dithered(x, d, now.tick, DITHER[1])
        if live:
            self.state.d[i] = d
            if ti.static(self.state.carries):
                self.state.d_low[i] = low
                self.state.x[i], self.state.low[i] = self.state.sum(x, self.state.low[i] + low, d)
            elif ti.static(self.state.compensated):
                self.state.advance(i, d)
            else:
                self.state.x[i] = x + step
            if ti.static(self.state.befores):
                self.state.before[i] = before
            if ti.static(self.uses_velocity):
                self.free[i] = d
        elif now.fresh != 0:
            self.state.d[i] = ti.zero(d)

    @ti.func
    def h2_effective(self, h, fresh):
        """Return what a constant acceleration of 1 m/s^2 adds to the displacement: h^2, half of it at a start; less with drag."""
        h2_effective = h * h
        if ti.static(self.decays):
            h2_effective *= ti.select(fresh != 0, self.decay[None][2], self.decay[None][1])
        else:
            h2_effective = ti.select(fresh != 0, h2_effective / 2, h2_effective)
        return h2_effective

    @ti.func
    def h2_rigid(self, h, fresh, owed):
        """Return h2_effective() for a rigid constraint, which at a start also supplies the kick that velocities lack.

        owed: this kick as a time [s], see Step.to_velocity(). The sum is h (h + h_old) / 2: h times the time between the middles
        of two substeps.
        """
        late = h * owed
        if ti.static(self.decays):
            late *= self.decay[None][1]
        return self.h2_effective(h, fresh) + ti.select(fresh != 0, late, 0 * late)

    @ti.func
    def velocity_after(self, i, h, t, reaction):
        """Return v_n from d_n and the acceleration at x_n: d / h + (h a + reaction / h) / 2; with drag, from its exact solution.

        reaction: h^2 times the acceleration by constraints, contacts and walls.
        """
        d = self.state.d[i]
        v = d / h
        if self.state.w[i] > 0:
            force = h * h * self.acceleration_at(i, h, t, 0, self.forces.pull(t)) + reaction
            if ti.static(self.decays):
                v = (self.decay[None][0] * d + self.decay[None][3] * force) / h
            else:
                v = (d + force / 2) / h
        return v


def decay(rate: float, h: float) -> list[float]:
    """Return the factors of drag in a substep h [s], with z = rate h.

    share = z / (exp(z) - 1), phi1 = (1 - exp(-z)) / z, phi2 = (z - 1 + exp(-z)) / z^2, rest = (1 - share) / z, 1 - exp(-z).
    The velocity at the end of the substep is (share d + rest h^2 a) / h. It contains no exp(z), which overflows f32 at z = 88.
    """
    z = rate * h
    if z < 1e-3:  # series, since terms of the closed forms cancel
        share = 1 - z / 2 + z * z / 12
        phi1 = 1 - z / 2 + z * z / 6 - z**3 / 24
        phi2 = 1 / 2 - z / 6 + z * z / 24 - z**3 / 120
        rest = 1 / 2 - z / 12 + z**3 / 720
    else:
        share = -z * np.exp(-z) / np.expm1(-z)
        phi1 = -np.expm1(-z) / z
        phi2 = (z + np.expm1(-z)) / z**2
        rest = (1 - share) / z
    return [float(share), float(phi1), float(phi2), float(rest), float(-np.expm1(-z))]


FREE = decay(0.0, 1.0)  # the factors without drag


def h2_effective_of(clock: "Clock") -> float:
    """Return what a constant acceleration of 1 m/s^2 added to the displacement in the last substep [s^2]."""
    return clock.h**2 * (clock.drag or FREE)[2 if clock.started else 1]


def h2_rigid_of(clock: "Clock") -> float:
    """Return h2_effective_of() for a rigid constraint, which at a start also supplied the kick that velocities lacked [s^2]."""
    return h2_effective_of(clock) + clock.h * clock.lacked * (clock.drag or FREE)[1]


def shares_of(h: Any, started: Any, lacked: Any, drag: np.ndarray) -> tuple[Any, Any]:
    """Return the factors from multipliers of the last substep to h^2 times accelerations, for rigid and for soft constraints.

    Each is h^2 divided by what a constant acceleration of 1 m/s^2 added to the displacement. At a start from velocities that
    lacked half a kick of rigid constraints, these constraints also supplied that kick. Arguments: of one world, or arrays of many
    worlds; drag, (..., 5): factors as decay() returns them.
    """
    whole, half = drag[..., 1], drag[..., 2]
    return 1 / np.where(started, half + whole * lacked / h, whole), 1 / np.where(started, half, whole)
