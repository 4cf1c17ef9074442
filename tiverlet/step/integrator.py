"""How one particle moves on its own: position Verlet in displacement form, with drag that is exact."""

from ..device import ti
from ..features.feature import Acceleration, Scene
from ..tools import golden_steps

# Multiples of the golden ratio of two dimensions, mod 1, are the most even sequence of pairs: one for each of the two sums.
DITHER = golden_steps(2)


class Motion:
    """What accelerates and slows the particles of one world."""

    def __init__(self, scene: Scene, accelerations: list[Acceleration]):
        # For substeps made of stages: the share of the first, what accelerates in the last per h^2, omega^2 of springs.
        self.first, self.reaches, self.fastest = 1.0, 1.0, 0.0
        self.scene, self.state = scene, scene.state
        self.n, self.dim, self.real = scene.particles.count, scene.particles.dim, scene.real
        self.accelerations = [f for f in accelerations if f.accelerates]
        self.common, self.others = ([f for f in self.accelerations if f.common is it] for it in (True, False))
        self.uses_velocity = any(f.uses_velocity for f in accelerations)
        self.drags = [f for f in accelerations if f.decays]
        self.decays = bool(self.drags)
        self.dithers = scene.real == ti.f32 and not scene.state.carries
        if self.uses_velocity:
            self.earlier = scene.memory.field("displacement_before", self.n, width=self.dim, state=True)
        if self.decays:
            self.decay = scene.memory.field("decay", None, width=5)

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
    def velocity_before(self, i, h, fresh):
        """v_n to second order, from the displacements of the last two substeps; at a start, d is the velocity itself."""
        v = self.state.d[i]
        if ti.static(self.uses_velocity):
            if fresh == 0:
                v = (3 * self.state.d[i] - self.earlier[i]) / (2 * h)
        return v

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
    def integrate(self, i, h, t, tick, fresh, pull, share, reach):
        """d += h^2 a, x += d; at a start (d is v) x += h v + h^2 a / 2. Linear drag is exact in both.

        Only the writes depend on whether it moves, so that several particles are integrated at once.
        """
        live, x, d = self.state.w.of(i) > 0, self.state.x[i], self.state.d[i]
        v = self.velocity_before(i, h, fresh)
        a = self.accelerate(i, self.state.place(i), v, t, pull)
        before, low = ti.select(fresh != 0, h * v - h * h / 2 * a, d), ti.zero(d)
        if ti.static(self.state.carries):
            low = self.state.d_low[i]
        if ti.static(self.decays or len(self.accelerations) > 0):
            kick = reach * a
            if ti.static(self.decays):
                # d' = exp(-z) d + phi1 h^2 a, as a small change of d, which f32 holds to more digits.
                kick -= ti.select(fresh != 0, ti.zero(d), self.decay[None][4] * d)
            d *= share
            if ti.static(self.state.carries):
                d, low = self.state.sum(d, low, kick)
            else:
                d += self.dithered(d, kick, tick, DITHER[0])
        else:
            d *= share
        step = d
        if ti.static(not self.state.sums):
            step = self.dithered(x, d, tick, DITHER[1])
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
                self.earlier[i] = before
        elif fresh != 0:
            self.state.d[i] = ti.zero(d)

    @ti.func
    def reach(self, h, fresh):
        """What a constant acceleration adds to the displacement in a substep, per m/s^2: h^2, half of it at a start."""
        hh = h * h
        if ti.static(self.decays):
            hh *= self.decay[None][2] if fresh != 0 else self.decay[None][1]
        elif fresh != 0:
            hh /= 2
        return hh

    @ti.func
    def velocity_after(self, i, h, t, bond):
        """v_n from d_n and the acceleration at x_n: d / h + (h a + bond / h) / 2, or what the solution with drag makes of it.

        bond: h^2 times the acceleration by constraints.
        """
        d = self.state.d[i]
        v = d / h
        if self.state.w.of(i) > 0:
            if ti.static(self.uses_velocity):
                v = (3 * d - self.earlier[i]) / (2 * h)
            force = h * h * self.accelerate(i, self.state.place(i), v, t, self.pull(t)) + bond
            if ti.static(self.decays):
                v = (self.decay[None][0] * d + self.decay[None][3] * force) / h
            else:
                v = (d + force / 2) / h
        return v
