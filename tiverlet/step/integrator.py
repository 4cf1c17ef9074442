"""How one particle moves on its own: position Verlet in displacement form, with drag that is exact."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..features.feature import Acceleration, Scene
from ..tools import golden_steps

if TYPE_CHECKING:
    from .clock import Clock

# Multiples of the golden ratio of two dimensions, mod 1, are the most even sequence of pairs: one for each of the two sums.
DITHER = golden_steps(2)
ALIKE = {ti.f32: 2.0**-12, ti.f64: 2.0**-26}  # of a velocity: by how much it is varied at least, the root of its rounding
TINY = 1e-18  # [m/s], [m/s^2]: keeps what is divided by from 0
LEAST = 0.25  # pivot with which a velocity is solved for; where a force feeds motion faster, it is taken as it is


class Forces:
    """What accelerates the particles of one world, and what slows them."""

    def __init__(self, scene: Scene, accelerations: list[Acceleration]):
        self.real, self.dim = scene.real, scene.particles.dim
        self.all = [f for f in accelerations if f.accelerates]
        self.common, self.others = ([f for f in self.all if f.common is it] for it in (True, False))
        self.pairwise = [f for f in self.all if f.pairwise]
        self.use_velocity = any(f.uses_velocity for f in accelerations)
        self.positional, self.velocity_dependent = ([f for f in self.others if f.uses_velocity is it] for it in (False, True))
        self.drags = [f for f in accelerations if f.decays]
        self.uneven = [f for f in self.all if not f.uniform]

    @ti.func
    def change_along(self, i, x, d, h, t):
        """How much what accelerates particle i has changed along its last move d, in a substep h."""
        change = 0 * d
        for f in ti.static(self.uneven):
            change += f.acceleration(i, x, d / h, t) - f.acceleration(i, x - d, d / h, t)
        return change

    @ti.func
    def pull(self, t):
        """The sum of what accelerates all particles alike."""
        a = ti.Vector.zero(self.real, self.dim)
        for f in ti.static(self.common):
            a += f.acceleration(0, a, a, t)
        return a

    @ti.func
    def accelerate(self, i, x, v, t, pull):
        """The sum of what accelerates particle i. pull: what pull() returned."""
        a = pull
        for f in ti.static(self.others):
            a += f.acceleration(i, x, v, t)
        return a

    @ti.func
    def reads_velocity_of(self, i):
        """Whether any of the forces that read velocities acts on particle i."""
        out = False
        for f in ti.static(self.velocity_dependent):
            out = out or f.acts_on(i)
        return out

    @ti.func
    def velocity_part(self, i, x, v, t):
        """The part of accelerate() that reads velocities."""
        a = 0 * x
        for f in ti.static(self.velocity_dependent):
            a += f.acceleration(i, x, v, t)
        return a

    @ti.func
    def velocity_slope(self, i, x, v, t, a, c):
        """c times the derivatives of velocity_part() by v, where it is a.

        They are differences over the way that v is about to go: |c a|, less where it brakes, and at most as far beyond rest as v
        is from it. A kink on this way, as of friction at rest, is seen as a slope.
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
        """(omega h)^2 of what turns velocities faster than it brakes them, or feeds them; what brakes settles, however hard.

        The trace of the square of h da/dv is that of what brakes less that of what turns; a kink, seen in one column, adds none.
        """
        a = self.velocity_part(i, x, v, t)
        slope = self.velocity_slope(i, x, v, t, a, h)
        rate = a.dot(slope @ a) / ti.max(a.dot(a), TINY * TINY)
        return ti.max(-(slope @ slope).trace() / 2, rate * ti.max(rate, 0))

    @ti.func
    def accelerate_implicitly(self, i, x, u, c, part, t, pull):
        """What accelerates particle i at the velocity that this gives it itself, v = u + (part + theta) c a(x, v), by one step of
        Newton's method, which is exact where a is linear in v. part: 1, or 0 at a start, where u is v_n.

        With theta = 0 a force that turns v leaves |v| as it is, whatever c is. Drag would overshoot from c rate = 1 on, so
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
        for k in ti.static(range(self.dim)):  # Gauss; what brakes and turns has pivots of 1 or more
            left[k, k] += 1
            regular &= ti.cast(left[k, k] > LEAST, ti.i32)  # nor is NaN, as of v / |v| where v + way comes to be 0
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
    """d += h^2 a, x += d: the substep of order 2. It is one stage; see high_order.Composition for more."""

    stages = 1  # of a substep
    first = 1.0  # the share of the first of them
    h2_factor = 1.0  # what accelerates in the last of them, per h^2
    fastest = 0.0  # omega^2 of springs that act as forces [1/s^2]
    springs_pull = False  # springs act as forces in every stage, and not only at starts
    half_kick = True  # at a start, constraints know that the force acts for half of the substep

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
        """Passes over the constraints in each stage."""
        return iterations

    @ti.func
    def times(self, at, s):
        """Of substep s: its length, that of the one before [s], its start [s], and where it starts and ends in the frame."""
        h = ti.cast(at.h64, self.real)
        return h, h, ti.cast(at.start + s * at.h64, self.real), self.frame_fraction(s, at.substeps)

    @ti.func
    def frame_fraction(self, s, substeps):
        """The fractions of the frame at the start and the end of substep s."""
        return ti.Vector([ti.cast(s, self.real) / substeps, ti.cast(s + 1, self.real) / substeps])

    @ti.func
    def advance(self, first, end, now):
        """Integrate some particles. Short loops, so that it is done for several of them at once."""
        pull, share, h2_effective = self.forces.pull(now.time), ti.cast(1, self.real), self.h2_effective(now.h, now.fresh)
        if now.fresh != 0:
            share = now.h
            if ti.static(self.decays):
                share *= self.decay[None][1]
        for i in range(first, end):
            self.integrate(i, now, pull, share, h2_effective)

    @ti.func
    def acceleration_at(self, i, h, t, fresh, pull):
        """What forces accelerate particle i by at x_n and v_n; at a start, d is v_n. pull: what Forces.pull() returned.

        v_n is what velocity_after() gives with the reaction of the last substep: the part of d that forces did not bring about.
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
        """What of d did not come from forces; 0 where it is larger than d, and than twice what they do: a blow, which is over.
        So are those of contacts, which may be slight, and are not told from what leans on them."""
        d = self.state.d[i]
        reaction = ti.zero(d)
        if ti.static(not self.touches):
            reaction = d - self.free[i]
            force = h * h * self.forces.accelerate(i, x, d / h, t, pull)
            reaction = ti.select(reaction.dot(reaction) > ti.max(d.dot(d), 4 * force.dot(force)), ti.zero(d), reaction)
        return reaction

    @ti.func
    def dithered(self, big, small, tick, step: ti.template()):  # type: ignore[valid-type]
        """`small`, to be added to `big`.

        In f32 the rounding of such a sum, always to the same side while `small` is constant, would be the largest error of all:
        of a free fall, and of a body in uniform motion. So `small` is dithered: it gets a fraction in (-1/2, 1/2) of the last
        digit of `big`, taken from the golden sequence. The rounded sums then follow the true one, with an error that grows like
        the logarithm of the number of steps instead of that number.
        """
        if ti.static(self.dithers):
            u = ti.cast(ti.cast(tick, ti.u32) * ti.u32(step), ti.f32) * ti.static(2.0**-32) - 0.5
            for a in ti.static(range(self.dim)):
                exponent = ti.bit_cast(big[a], ti.u32) & ti.u32(0x7F800000)
                sign = ti.bit_cast(small[a], ti.u32) & ti.u32(0x80000000)
                digit = ti.bit_cast(exponent | sign, ti.f32) * (u * ti.static(2.0**-23))
                small[a] += ti.select(small[a] == 0, ti.cast(0, ti.f32), digit)
        return small

    @ti.func
    def integrate(self, i, now, pull, share, h2_effective):
        """d += h^2 a, x += d; at a start (d is v) x += h v + h^2 a / 2. Linear drag is exact in both.

        Only the writes depend on whether it moves, so that several particles are integrated at once.
        """
        live, x, d, h = self.state.moves(i), self.state.x[i], self.state.d[i], now.h
        a = self.acceleration_at(i, h, now.time, now.fresh, pull)
        before, low = ti.select(now.fresh != 0, h * d - h * h / 2 * a, d), ti.zero(d)
        if ti.static(self.state.carries):
            low = self.state.d_low[i]
        if ti.static(self.decays or len(self.forces.all) > 0):
            kick = h2_effective * a
            if ti.static(self.decays):
                # d' = exp(-z) d + phi1 h^2 a, as a small change of d, which f32 holds to more digits.
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
        """What a constant acceleration adds to the displacement in a substep, per m/s^2: h^2, half of it at a start."""
        h2_effective = h * h
        if ti.static(self.decays):
            h2_effective *= ti.select(fresh != 0, self.decay[None][2], self.decay[None][1])
        else:
            h2_effective = ti.select(fresh != 0, h2_effective / 2, h2_effective)
        return h2_effective

    @ti.func
    def h2_rigid(self, h, fresh, owed):
        """The same of a rigid constraint: at a start it also makes up for `owed` [s] of its kick, which velocities lack, see
        to_velocity(). That is h (h + h_old) / 2: h times what is between the middles of two substeps."""
        late = h * owed
        if ti.static(self.decays):
            late *= self.decay[None][1]
        return self.h2_effective(h, fresh) + ti.select(fresh != 0, late, 0 * late)

    @ti.func
    def velocity_after(self, i, h, t, reaction):
        """v_n from d_n and the acceleration at x_n: d / h + (h a + reaction / h) / 2, or what the solution with drag makes of it.

        reaction: h^2 times the acceleration by constraints.
        """
        d = self.state.d[i]
        v = d / h
        if self.state.w.positive(i):
            force = h * h * self.acceleration_at(i, h, t, 0, self.forces.pull(t)) + reaction
            if ti.static(self.decays):
                v = (self.decay[None][0] * d + self.decay[None][3] * force) / h
            else:
                v = (d + force / 2) / h
        return v


def decay(rate: float, h: float) -> list[float]:
    """What drag makes of a substep, for z = rate h.

    share = z / (exp(z) - 1), phi1 = (1 - exp(-z)) / z, phi2 = (z - 1 + exp(-z)) / z^2, rest = (1 - share) / z, 1 - exp(-z).
    The velocity at its end is (share d + rest h^2 a) / h; no exp(z) is left in it, which leaves f32 at z = 88.
    """
    z = rate * h
    if z < 1e-3:  # series: the closed forms cancel
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


FREE = decay(0.0, 1.0)  # what no drag makes of a substep


def h2_effective_of(clock: "Clock") -> float:
    """What a constant acceleration added to the displacement in the last substep, per m/s^2 [s^2]."""
    return clock.h**2 * (clock.drag or FREE)[2 if clock.started else 1]


def h2_rigid_of(clock: "Clock") -> float:
    """The same of a rigid constraint, which in a start also made up for the kick that velocities lacked [s^2]."""
    return h2_effective_of(clock) + clock.h * clock.lacked * (clock.drag or FREE)[1]


def shares_of(h: Any, started: Any, lacked: Any, drag: np.ndarray) -> tuple[Any, Any]:
    """By what multipliers of a substep h become h^2 times accelerations, for rigid and for soft constraints: h^2 over what a
    constant acceleration added to the displacement. In a start from velocities that lacked half a kick of rigid constraints,
    these gave that, too. Of one world, or arrays of many, with drag (..., 5) of each."""
    whole, half = drag[..., 1], drag[..., 2]
    return 1 / np.where(started, half + whole * lacked / h, whole), 1 / np.where(started, half, whole)
