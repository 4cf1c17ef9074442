"""What happens in a substep, phase by phase: loops over particles, constraints and contacts."""

from typing import Any

from ..constraints.core.scalar import Scalar
from ..contact.velocity_projection import EVERY
from ..device import runtime, ti
from ..device.thread_team import LEAST, Team, block, blocks
from ..features.feature import Acceleration, Batch, Scene
from .particle_pass import Tiles


class Phases(Tiles):
    """The features of one world at work on its particles. contact and grid may be None.

    `me` is the thread that goes through a phase, see Team. Where it has no team, loops are serial inside the fused kernel, and
    Taichi spreads them over threads at the top of the others.
    """

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
        super().__init__(scene, accelerations, batches, contact, grid, walls, team)
        self.launched = team.launched
        # Iterations of a loop for each of few pieces of work: to each CPU thread Taichi gives LEAST of them, at least.
        self.stride = LEAST if self.launched and runtime.architecture() == "cpu" else 1
        self.systems = [scene.slots.system] if scene.slots and scene.slots.system else []
        self.steps = max([s.steps for s in self.systems], default=0) if self.launched else 0
        for system in self.systems:
            system.team, system.spread = team, self.stride
        self.hurries = bool(scene.slots) and scene.slots.accelerates
        self.told = [b for b in self.batches if isinstance(b, Scalar) and b.dev.told]
        self.ragged = [b for b in self.batches if b.blocks]
        self.drivers = drivers
        self.hashes = bool(grid)
        self.halves = 2 if self.batches and self.contacts else 1  # of a pass, each with a list that is good
        self.breakers: list[Any] = [b for b in self.batches if b.breaks]
        self.concludes = any(c.rubs or c.bounces for c in self.contacts) or bool(self.breakers)
        self.bounces = any(c.bounces for c in self.contacts)
        self.calms = any(c.calms for c in self.contacts)
        self.posed = [w for w in walls if w.poses]
        self.springs = any(b.soft for b in self.batches)
        if grid:
            self.halt = scene.memory.field("halt", None, width=3, kind=ti.i32)

    @ti.func
    def predict(self, me, h, time, tick, fresh, when, calming, final):
        """1 Integrate, and move what walls are made of; 2 put driven particles on their targets."""
        for w in ti.static(self.posed):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, me)):
                w.pose(when)
        for k in range(self.team.deal(self.pieces * self.each, self.each, me)):
            self.advance(self.team.turn(k, self.each, me), h, time, tick, fresh, calming, final)
        self.team.wait()
        self.team.watch(me)
        for f in ti.static(self.drivers):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.drive(c, h, when[1])
                if ti.static(self.state.befores):  # at the velocity with which it is driven, others meet it
                    self.state.before[f.member(c, 0)] = self.state.d[f.member(c, 0)]
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
        for system in ti.static(self.systems):
            if ti.static(system.steps > 0):
                system.close(me)
        for f in ti.static(self.told):
            for c in range(self.team.low(f.count, me), self.team.high(f.count, me)):
                f.take(c, first)
        if ti.static(len(self.told) > 0):
            self.team.wait()

    @ti.func
    def draw(self, me):
        """3c Where there are contacts, particles gather the moves of constraints first, which the list has to hear of, too."""
        if ti.static(self.halves == 2):
            for c in ti.static(self.contacts):
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    self.slots.gather(i)
                    c.heed(self.grid.outrun(i), c.overshoots(i))
                self.team.wait()

    @ti.func
    def meet(self, me, first, fresh, final):
        """3d Contacts: which there are, and what they want."""
        for c in ti.static(self.contacts):
            if ti.static(c.measures):
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.measure(i, first)
                self.team.wait()
            for k in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(k, me)
                for b in range(blocks(begin, end)):
                    low, high = block(b, begin, end)
                    c.count(low, high)
            self.team.wait()
            for k in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(k, me)
                for b in range(blocks(begin, end)):
                    low, high = block(b, begin, end)
                    if c.busy(low) != 0:
                        for i in range(low, high):
                            c.relax(i, first, fresh, final)
                    elif final != 0:
                        if ti.static(c.rubs):
                            for i in range(low, high):
                                c.sum_up(i, ti.Vector.zero(self.real, self.dim), first)
            self.team.wait()

    @ti.func
    def rebound(self, me):
        """3e One round of restitution, in the first pass; hit tells whether another one is needed."""
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                self.team.wait()
                ti.loop_config(serialize=True)
                for _ in range(self.team.one(1, me)):
                    c.dev.hit[None] = 0
                self.team.wait()
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.rebound(i)
                self.team.wait()
                for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
                    c.part_ways(i)
                self.team.wait()

    @ti.func
    def collect(self, me, h, when, first, final, looks):
        """3f Particles gather their moves; walls. looks: 0 if predict() is next, which asks for the list, too."""
        if ti.static(len(self.batches) > 0 or len(self.contacts) > 0 or len(self.walls) > 0):
            for k in range(self.team.deal(self.pieces * self.each, self.each, me)):
                self.move(self.team.turn(k, self.each, me), h, when, first, final, looks)
        self.team.wait()

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
                    c.dev.hit[None] = 0
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
                    c.dev.calm.open(piece, begin, end)
                for m in range(begin, begin + c.dev.calm.count[piece]):
                    c.dev.calm.want(c.dev.calm.loaded[m], k)
            self.team.wait()
            for p in range(self.team.deal(self.pieces, 1, me)):
                begin, end = self.part(p, me)
                for m in range(begin, begin + c.dev.calm.count[self.team.turn(p, 1, me)]):
                    c.dev.calm.move(c.dev.calm.loaded[m])
            self.team.wait()

    @ti.func
    def struck(self):
        """1 when a pair bounces in this substep."""
        out = 0
        for c in ti.static(self.contacts):
            if ti.static(c.bounces):
                out = c.dev.hit[None]
        return out

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
