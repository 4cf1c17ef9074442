"""Sleep: particles that have come to rest are skipped until something reaches them."""

import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import at, inline, ti
from ..device.number import OnDevice
from ..device.thread_team import BLOCK
from ..features.feature import Batch, Feature, Knob, Scene
from ..features.regrouping import Regrouping
from .span import Span

if TYPE_CHECKING:
    from .clock import Clock
    from .step import Step

TRIES = 4  # searches for islands that can fall asleep, in each `time`
ROAM = 1 / 16  # of speed times time: what has moved farther does not tremble, it goes somewhere


class Sleep(Feature):
    """Skips particles that have come to rest, until something reaches them.

    speed: [m/s] below which a particle is slow, both its center and its turning surface. time: [s] for which it must be slow.
    Both are live. In this time it must not go anywhere either: what moves by speed times time / 16 drifts, or is about to turn
    round, and stays awake. So what rolls up a slope, flies or swings goes on if it is accelerated by more than speed / time / 2.

    Particles that press on each other, or are linked, form an island. An island falls asleep as a whole, once each of its
    particles has been slow for `time`. A sleeping particle keeps the state of its last substep bit for bit: position,
    displacement, spin, loads, slip of friction. So its energy and momentum do not change, and it continues from this state when
    it wakes. An island wakes as a whole when
    a moving or a driven particle touches it, the force on one of its particles changes, or one of them is given a velocity or
    spin. All islands wake before a frame in which a wall is moved, a knob is changed (but the target of a driven particle),
    positions are assigned, particles or features come or go, or the length of substeps changes; discs and spheres without spin
    and constraints sleep on where frames are between 0.4 and 2.5 times as long as the last one. What a function of your own reads
    from a Taichi field is not noticed: after writing it, assign world.position = world.position. Nothing falls asleep while a
    surface moves.

    It is the same bit for bit on all paths, in clones and in replays. Particles of motors and winches, and particles that are
    linked to driven ones, never sleep. World.events() reports that sleeping particles go on touching, without impulses.

    Raises ValueError with a PairForce or a sheared Periodic box, which islands do not take into account, in orders above 2, and
    in Worlds. A world has at most one.
    """

    speed = Knob(lambda f, v: checks.number("Sleep", "speed", v, above=0.0), "Below which a particle is slow [m/s].")
    time = Knob(lambda f, v: checks.number("Sleep", "time", v, above=0.0), "For which it has to be slow [s].")
    code_size = 0.5

    def __init__(self, speed: float = 0.01, time: float = 0.5):
        self.speed, self.time = speed, time

    def bind(self, scene: Scene) -> None:
        """Declare the fields, and make them part of the state."""
        if scene.memory.copies:
            raise ValueError("Worlds: Sleep is for a world alone, where frames that are not computed take no time. Leave it out.")
        self.scene = scene
        self.dev.islands = scene.state.sleepers = Sleepers(scene, self.speed, self.time)
        self.changed = False

    def can_regroup(self, change: Regrouping) -> bool:
        """Always true: particles can be added and removed in place. All of them wake then."""
        return True

    def regroup(self, change: Regrouping) -> None:
        """Resize the fields after particles were added and removed."""
        self.dev.islands.regroup()

    def upload(self) -> None:
        """Write speed and time to the device."""
        islands = self.dev.islands
        islands.time = self.time
        self.scene.memory.write(islands.limits, [self.speed, self.time])


def blocks_of(n: int) -> int:
    """Return the number of blocks of n particles."""
    return -(-max(1, n) // BLOCK)


class Sleepers:
    """The sleeping particles of one world, on the device. time: [s] of Sleep.

    asleep: 1 if a particle sleeps. still: for how long it has been slow [s]. place: where it was when it became so. island: the
    particle that stands for the island of a sleeping particle, the same for the whole island. called: 1 for islands that are
    to wake, by the particle that stands for them. calls: whether there are any. blocks: 0 for blocks of particles that all
    sleep. count: number of sleeping particles. pull: the acceleration with which a particle fell asleep, if forces may change
    by themselves.
    """

    host_only = ("scene", "time")
    n: Any = OnDevice()
    pull: Any

    def __init__(self, scene: Scene, speed: float, time: float):
        n, add = scene.count, scene.memory.field
        self.scene, self.n, self.time = scene, n, time
        self.asleep = add("Sleep.asleep", n, kind=ti.i32, state=True)
        self.still = add("Sleep.still", n, state=True)
        self.place = add("Sleep.place", n, width=scene.particles.dim, state=True)
        self.island = add("Sleep.island", n, kind=ti.i32, state=True)
        self.count = add("Sleep.count", None, kind=ti.i32, state=True)
        self.blocks = add("Sleep.blocks", blocks_of(scene.particles.count), kind=ti.i32, values=1)
        self.called = add("Sleep.called", n, kind=ti.i32)
        self.calls = add("Sleep.calls", None, kind=ti.i32)
        self.limits = add("Sleep.limits", None, width=2, values=[speed, time])

    @inline
    def awake(self, i):
        """Whether particle i is awake."""
        return at(self.asleep, i) == 0

    @ti.func
    def any_awake(self, begin, end):
        """Return 1 if any block of particles from `begin` up to `end` contains an awake particle, else 0."""
        out = 0
        for b in range(begin // BLOCK, (end + (BLOCK - 1)) // BLOCK):
            out |= self.blocks[b]
        return out

    @ti.func
    def root(self, i):
        """Return the particle that stands for the island of particle i, while islands are found.

        Union-find with path compression.
        """
        r, k = i, i
        while self.island[r] != r:
            r = self.island[r]
        while self.island[k] != r:
            up = self.island[k]
            self.island[k] = r
            k = up
        return r

    @ti.func
    def join(self, i, j):
        """Merge the islands of particles i and j."""
        a, b = self.root(i), self.root(j)
        self.island[ti.max(a, b)] = ti.min(a, b)

    def wake(self, particles: Any = None) -> None:
        """Wake the islands of some particles; None: all."""
        memory = self.scene.memory
        if particles is None and not memory.read(self.count)[0]:
            memory.write(self.still, 0.0)
            return
        asleep, still = memory.read(self.asleep), memory.read(self.still)
        up = asleep != 0
        if particles is not None:
            island = memory.read(self.island)
            up &= np.isin(island, island[particles][up[particles]])
            still[particles] = 0.0
        asleep[up], still[up if particles is not None else ...] = 0, 0.0
        memory.write(self.asleep, asleep)
        memory.write(self.still, still)
        self.review()

    def regroup(self) -> None:
        """Take the new number of particles, and count the sleeping ones, after particles were added and removed."""
        self.scene.memory.resize(self.blocks, blocks_of(self.scene.particles.count))
        self.review()

    def review(self) -> None:
        """Count sleeping particles, and mark the blocks of which all sleep."""
        memory, n = self.scene.memory, self.scene.particles.count
        asleep = memory.read(self.asleep)
        padded = np.zeros(blocks_of(n) * BLOCK, dtype=asleep.dtype)
        padded[:n] = asleep[:n] == 0
        memory.write(self.blocks, padded.reshape(-1, BLOCK).any(axis=1))
        memory.write(self.count, int((asleep[:n] != 0).sum()))


# The sheet of settle(): its arguments, then the numbers of awake particles and of those that have been slow for long enough, and
# whether any island is called.
DT, H, TIME, AWAKE, READY, CALLED = range(6)


@ti.data_oriented
class SleepPass:
    """The kernels of Sleep in one world: they find slow particles, put islands to sleep, and wake them.

    watches: whether forces on sleeping particles may change by themselves. rests: whether all particles slept in the last frame
    and nothing else moves. goes_on: whether something moves although all particles sleep.
    """

    host_only = ("sheet", "rests", "goes_on")
    has_own_compile_time = True  # its compile time is reported by itself, as that of a Feature
    n: Any = OnDevice()  # particles
    links: Any = OnDevice()  # pairs of particles that constraints hold together

    def __init__(self, step: "Step", sleepers: Sleepers, drivers: list[Batch], batches: list[Batch]):
        self.step: Any = step
        self.sleepers, self.state, self.n, self.real = sleepers, step.state, step.scene.count, step.real
        self.contacts, self.forces = step.contacts, step.integrator.forces
        self.watches = any(not (f.uniform and f.steady) for f in self.forces.all)
        memory, n = step.scene.memory, step.scene.count
        kept, pairs = linked(step.scene.inv_mass, drivers, batches, step.contacts)
        self.restless = memory.field("Sleep.restless", n, kind=ti.i32)  # 1 for islands that stay awake, while they are found
        self.kept_awake = memory.field("Sleep.kept_awake", n, kind=ti.i32, values=kept)
        self.links = memory.number(len(pairs))
        self.pairs = memory.field("Sleep.links", len(pairs), width=2, kind=ti.i32, values=pairs)
        if self.watches:
            sleepers.pull = memory.field("Sleep.pull", n, width=step.dim, state=True)
        self.sheet, self.rests = np.zeros(CALLED + 1), False
        self.regroup()

    def __repr__(self) -> str:
        return "sleep"

    def regroup(self) -> None:
        """Find out, for the present particles, whether something moves although all sleep.

        Driven particles do, and static particles turn on if orientations are computed.
        """
        turns = self.step.orients and bool((self.step.scene.inv_mass == 0).any())
        self.goes_on = turns or bool(self.step.drivers)

    def bind_again(self, drivers: list[Batch], batches: list[Batch]) -> None:
        """Take the links, and the particles that never sleep, after constraints were added or removed."""
        memory = self.step.scene.memory
        kept, pairs = linked(self.step.scene.inv_mass, drivers, batches, self.contacts)
        memory.write(self.kept_awake, kept)
        memory.resize(self.pairs, len(pairs))
        memory.write(self.pairs, pairs)
        self.links = len(pairs)

    def compile(self, clock: "Clock") -> None:
        """Compile the kernels by launching them now, when no island is ready to sleep and none is called."""
        self.fall_asleep(clock.time)
        self.wake_called(clock.h, clock.time, 0, 0, 1, 1, 1, 0)

    def begin(self, dt: float, clock: "Clock") -> None:
        """Write the arguments of settle(), after a frame of dt [s]."""
        self.sheet[:] = dt, clock.h, clock.time, 0, 0, 0

    def finish(self, dt: float, clock: "Clock") -> bool:
        """After settle(): put islands to sleep, and wake those that were called.

        Returns whether all particles slept in the last frame, and nothing else moves.
        """
        awake, ready, called = self.sheet[AWAKE:].tolist()
        if called:
            self.wake_called(clock.h, clock.time, 0, 0, 1, 1, 1, 0)
        part = self.sleepers.time / TRIES
        if any(wall.does_work for wall in self.step.walls):  # what a slow belt carries along is no slower than its speed
            ready = 0
        if ready and clock.time // part > (clock.time - dt) // part:
            self.fall_asleep(clock.time)
        return awake == 0 and not called and not self.goes_on

    def of(self, step: "Step") -> "SleepPass":
        """Return a copy with the same fields, for another Step."""
        new = copy.copy(self)
        new.step, new.contacts = step, step.contacts
        return new

    @ti.kernel
    def settle(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """At the end of a frame: count for how long each particle has been slow, and call islands whose forces have changed."""
        for b in range((self.n + (BLOCK - 1)) // BLOCK):
            awake, ready = 0, 0
            for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
                if self.state.w[i] > 0:
                    if self.sleepers.awake(i):
                        awake += 1
                        self.time_still(i, sheet[DT], sheet[H])
                        ready += ti.cast(self.sleepers.still[i] >= self.sleepers.limits[None][1], ti.i32)
                    elif ti.static(self.watches):
                        if (self.pull(i, sheet[TIME]) != self.sleepers.pull[i]).any():
                            self.call(i)
                            sheet[CALLED] = 1
            ti.atomic_add(sheet[AWAKE], awake)
            ti.atomic_add(sheet[READY], ready)

    @ti.func
    def time_still(self, i, dt, h):
        """Count one more frame in which particle i was slow, or start again from 0 if it was not."""
        d = self.state.d[i]
        way = d.dot(d)
        if ti.static(self.state.spins):
            s = self.state.spin.s[i]
            way = ti.max(way, s.dot(s))
        x, limits = self.state.place(i), self.sleepers.limits[None]
        still, most = self.sleepers.still[i] + ti.cast(dt, self.real), limits[0] * ti.cast(h, self.real)
        stays = (x - self.sleepers.place[i]).norm() < ti.static(ROAM) * limits[0] * limits[1]
        if not (way < most * most and stays and self.kept_awake[i] == 0):
            still *= 0
            self.sleepers.place[i] = x
        self.sleepers.still[i] = still

    @ti.func
    def pull(self, i, t):
        """Return the acceleration of particle i by forces, at rest."""
        time = ti.cast(t, self.real)
        return self.forces.accelerate(i, self.state.place(i), 0 * self.state.d[i], time, self.forces.pull(time))

    @ti.func
    def call(self, i):
        """Mark the island of particle i, so that it wakes."""
        self.sleepers.called[self.sleepers.island[i]] = 1
        self.sleepers.calls[None] = 1

    @ti.kernel
    def fall_asleep(self, t: ti.f64):
        """Find the islands of awake particles, and put those to sleep that have been slow for long enough.

        On one thread: it takes some 0.1 us per particle, and runs a few times per second at most.
        """
        ti.loop_config(serialize=True)
        for _ in range(1):
            for i in range(self.n):
                if self.sleepers.awake(i):
                    self.sleepers.island[i] = i
                    self.restless[i] = 0
            for c in ti.static(self.contacts):
                for i in range(self.n):
                    if self.drifts(i):
                        for e in range(c.dev.list.first[i], c.dev.list.first[i] + c.dev.list.number[i]):
                            j = c.pressed_particle(c.dev.list.neighbour[e])
                            if self.drifts(j) and self.sleepers.root(i) != self.sleepers.root(j):
                                if c.is_pressed(i, e):
                                    self.sleepers.join(i, j)
            for k in range(self.links):
                i, j = self.pairs[k][0], self.pairs[k][1]
                if self.drifts(i) and self.drifts(j):
                    self.sleepers.join(i, j)
            for i in range(self.n):
                if self.drifts(i) and self.sleepers.still[i] < self.sleepers.limits[None][1]:
                    self.restless[self.sleepers.root(i)] = 1
            for i in range(self.n):
                if self.drifts(i):
                    root = self.sleepers.root(i)
                    if self.restless[root] != 1:
                        self.restless[i] = -1  # asleep after this loop: other particles still need the root
            for i in range(self.n):
                if self.drifts(i):
                    if self.restless[i] == -1:
                        self.sleepers.asleep[i] = 1
                        self.sleepers.count[None] = self.sleepers.count[None] + 1
                        if ti.static(self.watches):
                            self.sleepers.pull[i] = self.pull(i, t)
            self.note_blocks()

    @ti.func
    def drifts(self, i):
        """Whether particle i can move, and is awake."""
        return self.state.w[i] > 0 and self.sleepers.awake(i)

    @ti.func
    def note_blocks(self):
        """Mark the blocks with an awake particle."""
        for b in range((self.n + (BLOCK - 1)) // BLOCK):
            awake = 0
            for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
                awake |= ti.cast(self.sleepers.awake(i), ti.i32)
            self.sleepers.blocks[b] = awake

    @ti.func
    def call_touched(self, i, before):
        """Call the sleeping islands that particle i touches; if it is driven, also those that it touched at the substep's start.

        before: 1 if constraints are solved before contacts in this pass. Then also call islands that the particle would touch if
        constraints moved it as far as it moved by itself: islands that wake after constraints were solved would miss them.
        """
        drifts, d = self.drifts(i), self.state.d[i]
        margin = before * d.norm()
        for c in ti.static(self.contacts):
            if drifts or (self.sleepers.awake(i) and d.dot(d) > 0):
                for e in range(c.dev.list.first[i], c.dev.list.first[i] + c.dev.list.number[i]):
                    j = c.touched_sleeper(i, e, margin)
                    if j >= 0:
                        self.call(j)

    @ti.func
    def note_wake(self, i, s):
        """Record in the logs of events that particle i wakes in substep s of a frame."""
        for c in ti.static(self.contacts):
            if ti.static(c.dev.has_events):
                c.dev.events.wake(i, s)
        for log in ti.static(self.step.wall_logs):
            log.wake(i, s)

    @ti.kernel
    def wake_called(
        self, h64: ti.f64, start: ti.f64, tick: ti.i32, fresh: ti.i32, s: ti.i32, substeps: ti.i32,
        iterations: ti.i32, half: ti.i32,
    ):  # fmt: skip
        """Wake the called islands, and integrate their particles as all others were in substep s; not if s = substeps."""
        span = Span(h64, start, start, tick, fresh, 0.0, 0, substeps, iterations)
        now = self.step.pass_of(self.step.moment(span, s), half)
        for i in range(self.n):
            if not self.sleepers.awake(i):
                if self.sleepers.called[self.sleepers.island[i]] != 0:
                    self.sleepers.asleep[i] = 0
                    self.sleepers.still[i] = 0
                    ti.atomic_sub(self.sleepers.count[None], 1)
                    if s < substeps:
                        self.step.particles.advance(i, i + 1, now)
                        if s > 0:
                            self.note_wake(i, s)
        for i in range(self.n):
            self.sleepers.called[i] = 0
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.sleepers.calls[None] = 0
            self.note_blocks()


def linked(inv_mass: np.ndarray, drivers: list[Batch], batches: list[Batch], contacts: list) -> tuple[np.ndarray, np.ndarray]:
    """Return the mask of particles that never sleep because of constraints, (n,), and pairs of particles that can move and are
    held together by constraints or bodies, (m, 2)."""
    pairs, (driven, kept) = [np.zeros((0, 2), dtype=np.int64)], np.zeros((2, len(inv_mass)), dtype=bool)
    for b in drivers:
        driven[b.indices] = True
    rows = [(b.indices.ravel(), b.owner, b.driven) for b in batches]
    for c in contacts:
        sizes = [len(body) for body in c.bodies]
        rows.append((np.concatenate([*c.bodies, pairs[0][:, 0]]), np.repeat(np.arange(len(sizes)), sizes), False))
    for who, owner, restless in rows:
        held = np.bincount(owner, driven[who], minlength=1)[owner] > 0
        kept[who[held | restless]] = True
        some = inv_mass[who] > 0
        who, owner = who[some], owner[some]
        pairs.append(np.stack([who[:-1], who[1:]], axis=1)[owner[:-1] == owner[1:]])
    return kept, np.concatenate(pairs).astype(np.int64)
