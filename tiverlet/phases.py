"""What happens in a substep: the bodies for one particle or one constraint, and the phases that loop over them."""

from typing import Any

import taichi as ti

from .feature import Acceleration, Batch, Scene
from .scalar import Scalar
from .tools import golden_steps
from .wall import Wall

# Multiples of the golden ratio of two dimensions, mod 1, are the most even sequence of pairs: one for each of the two sums.
DITHER = golden_steps(2)
SWEEPS = 8  # rounds over the walls, for particles that several of them push


class Phases:
    """The features of one world at work on its particles. contact and grid may be None."""

    def __init__(
        self,
        scene: Scene,
        accelerations: list[Acceleration],
        batches: list[Batch],
        drivers,
        contact,
        grid,
        walls,
        parallel: bool,
    ):
        self.parallel = parallel
        # For substeps made of stages: the share of the first, what accelerates in the last per h^2, omega^2 of springs.
        self.first, self.reaches, self.fastest = 1.0, 1.0, 0.0
        self.scene, self.state, self.slots = scene, scene.state, scene.slots
        self.n, self.dim, self.real = scene.particles.count, scene.particles.dim, scene.real
        self.accelerations = [f for f in accelerations if f.accelerates]
        self.uses_velocity = any(f.uses_velocity for f in accelerations)
        self.drags = [f for f in accelerations if f.decays]
        self.decays = bool(self.drags)
        self.batches: list[Batch] = [b for b in batches if b.count]
        self.systems = [scene.slots.system] if scene.slots and scene.slots.system else []
        self.steps = max([s.steps for s in self.systems], default=0) if parallel else 0
        for system in self.systems:
            system.spread = 512 if parallel else 1
        self.hurries = bool(scene.slots) and scene.slots.accelerates
        self.told = [b for b in self.batches if isinstance(b, Scalar) and b._on_told]
        self.ragged = [b for b in self.batches if b.blocks]
        self.drivers = drivers
        self.contacts = [contact] if contact else []
        self.grid, self.hashes = grid, bool(grid)
        self.breakers: list[Any] = [b for b in self.batches if b.breaks]
        self.concludes = any(c.rubs or c.bounces for c in self.contacts) or bool(self.breakers)
        self.calms = any(c.calms for c in self.contacts)
        self.walls: list[Wall] = walls
        self.posed = [w for w in walls if w.poses]
        self.radius = scene.radius
        self.springs = any(b.soft for b in self.batches)
        self.dithers = scene.real == ti.f32
        add = scene.memory.field
        if self.uses_velocity:
            self.earlier = add("displacement_before", self.n, width=self.dim, state=True)
        if self.decays:
            self.decay = add("decay", None, width=5)
        if walls or contact:
            self.thrust = add("thrust", self.n, width=self.dim, state=True)
        if grid:
            self.halt = add("halt", None, width=3, kind=ti.i32)

    # The bodies: what happens to one particle, one constraint.

    @ti.func
    def accelerate(self, i, x, v, t):
        """The sum of what accelerates particle i."""
        a = 0 * x
        for f in ti.static(self.accelerations):
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
    def integrate(self, i, h, t, tick, fresh):
        """d += h^2 a, x += d; at a start (d is v) x += h v + h^2 a / 2. Linear drag is exact in both."""
        if ti.static(self.state.starts):
            self.state.x0[i] = self.state.x[i]
            if ti.static(self.state.compensated):
                self.state.low0[i] = self.state.low[i]
        if ti.static(self.state.leans):
            self.state.lean[i] = 0 * self.state.x[i]
        if self.state.w[i] > 0:
            v = self.velocity_before(i, h, fresh)
            a = self.accelerate(i, self.state.place(i), v, t)
            d = self.state.d[i]
            if ti.static(self.state.befores):
                self.state.before[i] = d
                if fresh != 0:
                    self.state.before[i] = h * v - h * h / 2 * a
            if ti.static(self.uses_velocity):
                self.earlier[i] = d
                if fresh != 0:
                    self.earlier[i] = h * v - h * h / 2 * a
            if fresh != 0:
                if ti.static(self.decays):
                    d = self.decay[None][1] * h * v + self.decay[None][2] * h * h * a
                else:
                    d = h * v + h * h / 2 * a
            else:
                if ti.static(self.decays):
                    # d' = exp(-z) d + phi1 h^2 a, as a small change of d, which f32 holds to more digits.
                    k = self.decay[None][1] * h * h * a - self.decay[None][4] * d
                    d += self.dithered(d, k, tick, DITHER[0])
                elif ti.static(len(self.accelerations) > 0):
                    d += self.dithered(d, h * h * a, tick, DITHER[0])
            self.state.d[i] = d
            if ti.static(self.state.compensated):
                self.state.advance(i, d)
            else:
                self.state.advance(i, self.dithered(self.state.x[i], d, tick, DITHER[1]))
        elif fresh != 0:
            self.state.d[i] = 0 * self.state.d[i]
        for c in ti.static(self.contacts):
            c.watch(i)
            c.grow(i, h)

    @ti.func
    def confine(self, i, h, when, last):
        """The walls, which have the last word; several take turns until they agree, or for SWEEPS rounds in a sharp corner."""
        if self.state.w[i] > 0:
            moving = True
            for _ in range(ti.static(SWEEPS if len(self.walls) > 1 else 1)):
                if moving:
                    before = self.state.d[i]
                    for f in ti.static(self.walls):
                        f.confine(i, self.radius.of(i), h, when, last)
                    moving = (self.state.d[i] != before).any()

    # The phases: loops over the bodies, serial inside the fused kernel and parallel at the top of the others.

    @ti.func
    def predict(self, h, t, tick, fresh, when):
        """1 Integrate, and move what walls are made of; 2 put driven particles on their targets."""
        for w in ti.static(self.posed):
            ti.loop_config(serialize=True)
            for _ in range(1):
                w.pose(when)
        for i in range(self.n):
            self.integrate(i, h, t, tick, fresh)
        for f in ti.static(self.drivers):
            for c in range(f.count):
                f.drive(c, h, when[1])
                for k in ti.static(self.contacts):
                    k.watch(f.member(c, 0))

    @ti.func
    def weigh(self, h, hh, first, fresh, some: ti.template()):  # type: ignore[valid-type]
        """The sums of constraints on many particles, by blocks. some: for which; those of the residual, or all."""
        for f in ti.static([f for f in self.ragged if f.reweighs or some]):
            for b in range(f.blocks):
                f.weigh(b, h, hh, first, fresh)

    @ti.func
    def spread(self, h, hh, first, fresh):
        """The moves of constraints on many particles."""
        for f in ti.static(self.ragged):
            for e in range(f.corner_count):
                f.spread(e, h, hh, first, fresh)

    @ti.func
    def kick(self, h):
        """h^2 times what springs, at the present positions, accelerate: to the slots."""
        self.weigh(h, h * h, -1, 0, True)
        for f in ti.static(self.batches):
            for c in range(f.count):
                f.kick(c, h)
        self.spread(h, h * h, -1, 0)

    @ti.func
    def tell(self, h, when, first, fresh):
        """3a Every constraint leaves the moves that it wants in its slots, or tells its system what it is about."""
        hh = self.reach(h, fresh)
        self.weigh(h, hh, first, fresh, True)
        if ti.static(self.hurries):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.slots.hurry(first)
        for f in ti.static(self.batches):
            for c in range(f.count):
                f.relax(c, h, hh, when, first, fresh)
        self.spread(h, hh, first, fresh)

    @ti.func
    def settle(self, first):
        """3b Systems are solved."""
        for system in ti.static(self.systems):
            for b in range(system.parts):
                system.solve(b)
        self.take(first)

    @ti.func
    def take(self, first):
        """What systems found goes to the multipliers."""
        for f in ti.static(self.told):
            for c in range(f.count):
                f.take(c, first)

    @ti.func
    def collect(self, h, when, first, last, fresh, final):
        """3c Particles gather their moves; contacts; walls."""
        for c in ti.static(self.contacts):
            if ti.static(len(self.batches) > 0):
                for i in range(self.n):
                    self.slots.gather(i, first, final)
            if ti.static(c.measures):
                for i in range(self.n):
                    c.measure(i)
            for i in range(self.n):
                c.count(i, first)
            for i in range(self.n):
                c.relax(i, first, fresh)
        if ti.static(len(self.batches) > 0 or len(self.contacts) > 0 or len(self.walls) > 0):
            for i in range(self.n):
                if ti.static(len(self.batches) > 0 and len(self.contacts) == 0):
                    self.slots.gather(i, first, final)
                before = self.state.d[i]
                for c in ti.static(self.contacts):
                    c.gather(i, last)
                if ti.static(len(self.walls) > 0):
                    self.confine(i, h, when, last)
                for c in ti.static(self.contacts):
                    self.grid.watch(i)
                if ti.static(len(self.walls) > 0 or len(self.contacts) > 0):
                    if final != 0:
                        if first != 0:
                            self.thrust[i] = self.state.d[i] - before
                        else:
                            self.thrust[i] += self.state.d[i] - before

    @ti.func
    def rebound(self):
        """4 One pass of restitution, over displacements alone. Several let pairs that are struck at once agree."""
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                for i in range(self.n):
                    c.rebound(i)
                for i in range(self.n):
                    if self.state.w[i] > 0:
                        self.state.d[i] += c._on_kick[i]

    @ti.func
    def remember(self, h, tick):
        """The end of a substep with constraints that break, or contacts that rub or bounce.

        A rigid constraint may find a whole kick in a start that follows another step, so loads are never taken for half a kick.
        """
        for f in ti.static(self.breakers):
            for c in range(f.count):
                f.tear(c, self.reach(h, 0), tick)
        for c in ti.static(self.contacts):
            if ti.static(c.rubs):
                for i in range(self.n):
                    c.remember(i)
            if ti.static(c.bounces):
                ti.loop_config(serialize=True)
                for _ in range(1):
                    c._on_hit[None] = 0

    @ti.func
    def calm(self, k):
        """5 Now and then: pass k of taking the sound out of loaded contacts."""
        for c in ti.static(self.contacts):
            for i in range(self.n):
                c._on_calm.want(i, k)
            for i in range(self.n):
                c._on_calm.move(i)

    @ti.func
    def struck(self):
        """1 when a pair bounces in this substep."""
        out = 0
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                out = c._on_hit[None]
        return out

    @ti.func
    def pass_(self, h, when, it, iterations, fresh, s, substeps):
        """Pass `it` of substep s."""
        first, last = ti.cast(it == 0, ti.i32), ti.cast(it == iterations - 1, ti.i32)
        self.tell(h, when, first, fresh)
        self.settle(first)
        self.collect(h, when, first, last, fresh, ti.cast(s == substeps - 1, ti.i32))

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
    def clock(self, s, substeps):
        """The fractions of the frame at the start and the end of substep s."""
        return ti.Vector([ti.cast(s, self.real) / substeps, ti.cast(s + 1, self.real) / substeps])

    @ti.func
    def is_stale(self):
        """1 when the neighbour list has to be built anew."""
        out = 0
        if ti.static(self.hashes):
            out = self.grid.stale[None]
        return out

    @ti.func
    def halted(self):
        """1 when the frame waits for a longer list."""
        out = 0
        if ti.static(self.hashes):
            out = self.halt[None][0]
        return out

    @ti.func
    def velocity_after(self, i, h, t, bond):
        """v_n from d_n and the acceleration at x_n: d / h + (h a + bond / h) / 2, or what the solution with drag makes of it.

        bond: h^2 times the acceleration by constraints.
        """
        d = self.state.d[i]
        v = d / h
        if self.state.w[i] > 0:
            if ti.static(self.uses_velocity):
                v = (3 * d - self.earlier[i]) / (2 * h)
            force = h * h * self.accelerate(i, self.state.place(i), v, t) + bond
            if ti.static(self.decays):
                v = (d + self.decay[None][3] * force) * self.decay[None][0] / (self.decay[None][1] * h)
            else:
                v = (d + force / 2) / h
        return v

    @ti.func
    def felt(self, i, h, t):
        """h^2 times what constraints, contacts and walls did to particle i in the last substep, for its velocity.

        Contacts and walls count as far as they balance the rest: a body at rest has velocity 0, but one that has just bounced is
        not credited with half of the blow.
        """
        bond = 0 * self.state.d[i]
        if ti.static(len(self.batches) > 0):
            bond = self.slots.pull[i]
        if ti.static(len(self.walls) > 0 or len(self.contacts) > 0):
            push = self.thrust[i]
            v = self.state.d[i] / h
            limit = (h * h * self.accelerate(i, self.state.place(i), v, t) + bond).norm()
            size = push.norm()
            if size > limit:
                push *= limit / size
            bond += push
        return bond
