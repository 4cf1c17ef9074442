"""What happens in a substep: the bodies for one particle or one constraint, and the phases that loop over them."""

from typing import Any

import taichi as ti

from . import runtime
from .calm import EVERY
from .compiling import FEW
from .feature import Acceleration, Batch, Scene
from .scalar import Scalar
from .team import LEAST, Team
from .tools import golden_steps
from .wall import Wall

# Multiples of the golden ratio of two dimensions, mod 1, are the most even sequence of pairs: one for each of the two sums.
DITHER = golden_steps(2)
TILE = 256  # particles that a thread takes at a time, through several loops: their state stays in its cache
BLOCK = 16  # of them that are asked at once whether any is near a wall, or touches another
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
        team: Team,
    ):
        self.team, self.launched = team, team.launched
        self.pieces = -(-scene.particles.count // team.piece)
        self.tile = min(TILE, team.piece)
        self.each = -(-team.piece // self.tile)  # tiles of a piece
        # Iterations of a loop for each of few pieces of work: to each CPU thread Taichi gives LEAST of them, at least.
        self.stride = LEAST if self.launched and runtime.architecture() == "cpu" else 1
        # For substeps made of stages: the share of the first, what accelerates in the last per h^2, omega^2 of springs.
        self.first, self.reaches, self.fastest = 1.0, 1.0, 0.0
        self.scene, self.state, self.slots = scene, scene.state, scene.slots
        self.n, self.dim, self.real = scene.particles.count, scene.particles.dim, scene.real
        self.accelerations = [f for f in accelerations if f.accelerates]
        self.common, self.others = ([f for f in self.accelerations if f.common is it] for it in (True, False))
        self.uses_velocity = any(f.uses_velocity for f in accelerations)
        self.drags = [f for f in accelerations if f.decays]
        self.decays = bool(self.drags)
        self.batches: list[Batch] = [b for b in batches if b.count]
        self.systems = [scene.slots.system] if scene.slots and scene.slots.system else []
        self.steps = max([s.steps for s in self.systems], default=0) if self.launched else 0
        for system in self.systems:
            system.team, system.spread = team, self.stride
        self.hurries = bool(scene.slots) and scene.slots.accelerates
        self.told = [b for b in self.batches if isinstance(b, Scalar) and b._on_told]
        self.ragged = [b for b in self.batches if b.blocks]
        self.drivers = drivers
        self.contacts = [contact] if contact else []
        self.grid, self.hashes = grid, bool(grid)
        self.breakers: list[Any] = [b for b in self.batches if b.breaks]
        self.concludes = any(c.rubs or c.bounces for c in self.contacts) or bool(self.breakers)
        self.bounces = any(c.bounces for c in self.contacts)
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
        before = ti.select(fresh != 0, h * v - h * h / 2 * a, d)
        if ti.static(self.decays or len(self.accelerations) > 0):
            kick = reach * a
            if ti.static(self.decays):
                # d' = exp(-z) d + phi1 h^2 a, as a small change of d, which f32 holds to more digits.
                kick -= ti.select(fresh != 0, ti.zero(d), self.decay[None][4] * d)
            d *= share
            d += self.dithered(d, kick, tick, DITHER[0])
        else:
            d *= share
        step = d
        if ti.static(not self.state.compensated):
            step = self.dithered(x, d, tick, DITHER[1])
        if live:
            self.state.d[i] = d
            if ti.static(self.state.compensated):
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
    def part(self, k, me):
        """The particles of the k-th piece of thread `me`: the first, and where they end."""
        first = self.team.turn(k, 1, me) * self.team.piece
        return first, ti.min(first + self.team.piece, self.n)

    @ti.func
    def within(self, tile):
        """Those of a tile of a piece."""
        piece, first = tile, tile * self.team.piece
        if ti.static(self.each > 1):
            piece = tile // self.each
            first = piece * self.team.piece + tile % self.each * self.tile
        return first, ti.min(first + self.tile, (piece + 1) * self.team.piece, self.n)

    @ti.func
    def advance(self, tile, h, t, tick, fresh, calming):
        """Integrate a tile of particles. Short loops, so that each is done for several particles at once."""
        first, end = self.within(tile)
        if ti.static(self.state.starts):
            for i in range(first, end):
                self.state.x0[i] = self.state.x[i]
                if ti.static(self.state.compensated):
                    self.state.low0[i] = self.state.low[i]
        if ti.static(self.state.leans):
            if calming != 0:
                for i in range(first, end):
                    self.state.lean[i] = ti.zero(self.state.x[i])
        pull, share, reach = self.pull(t), ti.cast(1, self.real), self.reach(h, fresh)
        if fresh != 0:
            share = h
            if ti.static(self.decays):
                share *= self.decay[None][1]
        for i in range(first, end):
            self.integrate(i, h, t, tick, fresh, pull, share, reach)
        for c in ti.static(self.contacts):
            stale, fast = 0, 0
            for i in range(first, end):
                c.grow(i, h)
            for i in range(first, end):
                stale |= self.grid.outrun(i)
            for i in range(first, end):
                fast |= c.overshoots(i)
            c.heed(stale, fast)

    @ti.func
    def confine(self, i, h, when):
        """The walls, which have the last word; several take turns until they agree, or for SWEEPS rounds in a sharp corner."""
        if self.state.w.of(i) > 0:
            if ti.static(len(self.walls) == 1):
                for f in ti.static(self.walls):
                    f.confine(i, self.radius.of(i), h, when)
            else:
                moving = True
                for _ in range(SWEEPS):
                    if moving:
                        before = self.state.d[i]
                        for f in ti.static(self.walls):
                            f.confine(i, self.radius.of(i), h, when)
                        moving = (self.state.d[i] != before).any()

    # The phases: loops over the bodies. `me` is the thread that goes through them, see Team. Where it has no team, loops are
    # serial inside the fused kernel, and Taichi spreads them over threads at the top of the others.

    @ti.func
    def predict(self, me, h, time, tick, fresh, when, calming):
        """1 Integrate, and move what walls are made of; 2 put driven particles on their targets."""
        for w in ti.static(self.posed):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, me)):
                w.pose(when)
        for k in range(self.team.deal(self.pieces * self.each, self.each, me)):
            self.advance(self.team.turn(k, self.each, me), h, time, tick, fresh, calming)
        self.team.wait()
        self.team.watch(me)
        for f in ti.static(self.drivers):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.drive(c, h, when[1])
                for k in ti.static(self.contacts):
                    k.heed(self.grid.outrun(f.member(c, 0)), k.overshoots(f.member(c, 0)))
            self.team.wait()

    @ti.func
    def weigh(self, me, h, hh, first, fresh, some: ti.template()):  # type: ignore[valid-type]
        """The sums of constraints on many particles, by blocks. some: for which; those of the residual, or all."""
        for f in ti.static([f for f in self.ragged if f.reweighs or some]):
            for b in range(self.team.low(f.blocks, me), self.team.high(f.blocks, me)):
                f.weigh(b, h, hh, first, fresh)
            self.team.wait()

    @ti.func
    def spread(self, me, h, hh, first, fresh):
        """The moves of constraints on many particles."""
        for f in ti.static(self.ragged):
            for e in range(self.team.low(f.corner_count, me), self.team.high(f.corner_count, me)):
                f.spread(e, h, hh, first, fresh)
            self.team.wait()

    @ti.func
    def kick(self, me, h):
        """h^2 times what springs, at the present positions, accelerate: to the slots."""
        self.weigh(me, h, h * h, -1, 0, True)
        for f in ti.static(self.batches):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.kick(c, h)
        self.team.wait()
        self.spread(me, h, h * h, -1, 0)

    @ti.func
    def tell(self, me, h, when, first, fresh):
        """3a Every constraint leaves the moves that it wants in its slots, or tells its system what it is about."""
        hh = self.reach(h, fresh)
        self.weigh(me, h, hh, first, fresh, True)
        if ti.static(self.hurries):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, me)):
                self.slots.hurry(first)
            self.team.wait()
        for f in ti.static(self.batches):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.relax(c, h, hh, when, first, fresh)
        if ti.static(len(self.batches) > 0):
            self.team.wait()
        self.spread(me, h, hh, first, fresh)

    @ti.func
    def settle(self, me, first):
        """3b Systems are solved."""
        for system in ti.static(self.systems):
            if ti.static(system.steps > 0):
                system.open(me)
                for _ in range(system.steps):
                    system.go(me)
            else:
                for b in range(self.team.low(system.parts, me), self.team.high(system.parts, me)):
                    system.solve(b)
                self.team.wait()
        self.take(me, first)

    @ti.func
    def take(self, me, first):
        """What systems found goes to the multipliers."""
        for f in ti.static(self.told):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.take(c, first)
        if ti.static(len(self.told) > 0):
            self.team.wait()

    @ti.func
    def meet(self, me, first, fresh, final):
        """3c Contacts: which there are, and what they want."""
        for c in ti.static(self.contacts):
            if ti.static(len(self.batches) > 0):
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    self.slots.gather(i, first, final)
                self.team.wait()
            if ti.static(c.measures):
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.measure(i)
                self.team.wait()
            for k in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(k, me)
                for b in range((end - begin + (BLOCK - 1)) // BLOCK):
                    c.count(begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end))
            self.team.wait()
            for k in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(k, me)
                for i in range(begin, end):
                    c.relax(i, first, fresh)
            self.team.wait()

    @ti.func
    def rebound(self, me):
        """3d One round of restitution, in the first pass; hit tells whether another one is needed."""
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                self.team.wait()
                ti.loop_config(serialize=True)
                for _ in range(self.team.one(1, me)):
                    c._on_hit[None] = 0
                self.team.wait()
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.rebound(i)
                self.team.wait()
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.part_ways(i)
                self.team.wait()

    @ti.func
    def collect(self, me, h, when, first, final, looks):
        """3e Particles gather their moves; walls. looks: 0 if predict() is next, which asks for the list, too."""
        if ti.static(len(self.batches) > 0 or len(self.contacts) > 0 or len(self.walls) > 0):
            for k in range(self.team.deal(self.pieces * self.each, self.each, me)):
                self.move(self.team.turn(k, self.each, me), h, when, first, final, looks)
        self.team.wait()

    @ti.func
    def move(self, tile, h, when, first, final, looks):
        """What a tile of particles gathers."""
        begin, end = self.within(tile)
        if ti.static(len(self.batches) > 0 and len(self.contacts) == 0):
            for i in range(begin, end):
                self.slots.gather(i, first, final)
        if ti.static(len(self.walls) > 0 or len(self.contacts) > 0):
            if final != 0:
                for i in range(begin, end):
                    if first != 0:
                        self.thrust[i] = -self.state.d[i]
                    else:
                        self.thrust[i] = self.thrust[i] - self.state.d[i]
        for c in ti.static(self.contacts):
            for i in range(begin, end):
                c.gather(i, first)
        if ti.static(len(self.walls) > 0 and self.n < FEW):
            for i in range(begin, end):
                self.confine(i, h, when)
        elif ti.static(len(self.walls) > 0):
            for b in range((end - begin + (BLOCK - 1)) // BLOCK):
                low, high = begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)
                near = 0
                for i in range(low, high):
                    for f in ti.static(self.walls):
                        near |= f.near(i, self.radius.of(i))
                if near != 0:
                    for i in range(low, high):
                        self.confine(i, h, when)
        for c in ti.static(self.contacts):
            if looks != 0:
                stale = 0
                for i in range(begin, end):
                    stale |= self.grid.outrun(i)
                c.heed(stale, 0)
        if ti.static(len(self.walls) > 0 or len(self.contacts) > 0):
            if final != 0:
                for i in range(begin, end):
                    self.thrust[i] = self.thrust[i] + self.state.d[i]

    @ti.func
    def remember(self, me, h, tick):
        """The end of a substep with constraints that break, or contacts that rub or bounce.

        A rigid constraint may find a whole kick in a start that follows another step, so loads are never taken for half a kick.
        """
        for f in ti.static(self.breakers):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.tear(c, self.reach(h, 0), tick)
        for c in ti.static(self.contacts):
            if ti.static(c.rubs or c.bounces):
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.remember(i)
            self.team.wait()
            if ti.static(c.bounces):
                ti.loop_config(serialize=True)
                for _ in range(self.team.one(1, me)):
                    c._on_hit[None] = 0
        self.team.wait()

    @ti.func
    def calming(self, since):
        """1 in a substep after which sound is taken out; since: substeps since the last start."""
        return ti.cast(since % EVERY == EVERY - 1, ti.i32)

    @ti.func
    def calm(self, me, k):
        """5 Now and then: pass k of taking the sound out of loaded contacts."""
        for c in ti.static(self.contacts):
            for p in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(p, me)
                piece = self.team.turn(p, 1, me)
                if k == 0:
                    c._on_calm.open(piece, begin, end)
                for m in range(begin, begin + c._on_calm.count[piece]):
                    c._on_calm.want(c._on_calm.loaded[m], k)
            self.team.wait()
            for p in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(p, me)
                for m in range(begin, begin + c._on_calm.count[self.team.turn(p, 1, me)]):
                    c._on_calm.move(c._on_calm.loaded[m])
            self.team.wait()

    @ti.func
    def struck(self):
        """1 when a pair bounces in this substep."""
        out = 0
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                out = c._on_hit[None]
        return out

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
        if self.state.w.of(i) > 0:
            if ti.static(self.uses_velocity):
                v = (3 * d - self.earlier[i]) / (2 * h)
            force = h * h * self.accelerate(i, self.state.place(i), v, t, self.pull(t)) + bond
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
            limit = (h * h * self.accelerate(i, self.state.place(i), v, t, self.pull(t)) + bond).norm()
            size = push.norm()
            if size > limit:
                push *= limit / size
            bond += push
        return bond
