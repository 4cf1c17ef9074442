"""Sleep: particles that have come to rest are left out of the substep until something reaches them."""

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

TRIES = 4  # in `time`, to find what can fall asleep


class Sleep(Feature):
    """Particles that have come to rest are left out of the substep until something reaches them.

    speed: [m/s] that a particle has to stay below, of its center and of the surface that it turns. time: [s] for which it has to.
    Both are live.

    Particles that press on each other, or are linked, are an island: it falls asleep as a whole, once each of them has been slow
    for `time`. What sleeps is as it was in its last substep, to the bit: place, displacement, spin, loads, slip of friction. So
    its energy and momentum do not change, and it goes on from there when it is woken, whole, in the substep in which

    - a particle that moves, or a driven one, touches it: before that contact is solved;
    - a force on it is another one than it was when it fell asleep (those of the user's own, in frames);
    - it, or another of its island, is given another velocity or spin (all wake where a start is made of it);

    and before a frame in which a wall is moved, a knob is changed, positions are assigned, particles or features come or go, or
    substeps become shorter or longer. Against a world that never sleeps, it is off by less than speed
    times time where it sleeps, for it would have crept by less.

    Decided by the state alone: on the same bits everywhere, in clones and replays too. What is pinned does not join two islands.
    Never asleep are particles of motors and winches, and what is linked to what is driven.

    World.events() tells of what sleeps that it goes on touching what it touched, without impulses.

    StepReport.asleep says how many sleep. Where all do, a frame is not computed at all. (Box2D and others: sleeping islands.)

    Raises ValueError beside PairForce and a sheared Periodic box, which islands do not know of, in order above 2, and in Worlds.
    A world has at most one.
    """

    speed = Knob(lambda f, v: checks.number("Sleep", "speed", v, above=0.0), "Below which a particle is slow [m/s].")
    time = Knob(lambda f, v: checks.number("Sleep", "time", v, above=0.0), "For which it has to be slow [s].")
    bulk = 0.5

    def __init__(self, speed: float = 0.01, time: float = 0.5):
        self.speed, self.time = speed, time

    def bind(self, scene: Scene) -> None:
        """The fields, which the state then knows of."""
        if scene.memory.copies:
            raise ValueError("Worlds: Sleep is for a world alone, where frames that are not computed take no time. Leave it out.")
        self.scene = scene
        self.dev.islands = scene.state.sleepers = Sleepers(scene, self.speed, self.time)
        self.changed = False

    def can_regroup(self, change: Regrouping) -> bool:
        """Particles can come and go, and all wake then."""
        return True

    def regroup(self, change: Regrouping) -> None:
        """They came and went."""
        self.dev.islands.regroup()

    def upload(self) -> None:
        """Write both."""
        islands = self.dev.islands
        islands.time = self.time
        self.scene.memory.write(islands.limits, [self.speed, self.time])


def blocks_of(n: int) -> int:
    """Blocks that n particles are."""
    return -(-max(1, n) // BLOCK)


class Sleepers:
    """Who sleeps, in one world on the device. time: [s] of Sleep.

    asleep: 1 where a particle sleeps. still: for how long it has been slow [s]. island: one particle of the island that it sleeps
    in, by which all of them know it. called: islands, by that particle, that are to wake; calls: whether there are any.
    blocks: 0 where a whole block of particles sleeps. count: of those that sleep. pull: the acceleration when it fell asleep,
    where forces may change by themselves.
    """

    host_only = ("scene", "time")
    n: Any = OnDevice()
    pull: Any

    def __init__(self, scene: Scene, speed: float, time: float):
        n, add = scene.count, scene.memory.field
        self.scene, self.n, self.time = scene, n, time
        self.asleep = add("Sleep.asleep", n, kind=ti.i32, state=True)
        self.still = add("Sleep.still", n, state=True)
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
    def stirs(self, begin, end):
        """1 if any block of particles from `begin` up to `end` has one that is awake."""
        out = 0
        for b in range(begin // BLOCK, (end + (BLOCK - 1)) // BLOCK):
            out |= self.blocks[b]
        return out

    @ti.func
    def root(self, i):
        """The particle by which the island of particle i is known, while islands are found (union-find, path compression)."""
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
        """Particles i and j are in the same island."""
        a, b = self.root(i), self.root(j)
        self.island[ti.max(a, b)] = ti.min(a, b)

    def wake(self, particles: Any = None) -> None:
        """Have the islands of some particles wake; None: all."""
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
        """Particles came and went: take their number, and note who sleeps."""
        self.scene.memory.resize(self.blocks, blocks_of(self.scene.particles.count))
        self.review()

    def review(self) -> None:
        """Note how many sleep, and of which blocks all do."""
        memory, n = self.scene.memory, self.scene.particles.count
        asleep = memory.read(self.asleep)
        padded = np.zeros(blocks_of(n) * BLOCK, dtype=asleep.dtype)
        padded[:n] = asleep[:n] == 0
        memory.write(self.blocks, padded.reshape(-1, BLOCK).any(axis=1))
        memory.write(self.count, int((asleep[:n] != 0).sum()))


DT, H, TIME, AWAKE, READY, CALLED = range(6)  # of the sheet of a frame: what is given, and counts of particles


@ti.data_oriented
class SleepPass:
    """The kernels of one world: who is slow, who falls asleep, who wakes."""

    host_only = ("sheet", "rests", "goes_on")
    told_apart = True  # as a Feature
    n: Any = OnDevice()  # particles
    links: Any = OnDevice()  # pairs of them that constraints hold together

    def __init__(self, step: "Step", sleepers: Sleepers, drivers: list[Batch], batches: list[Batch]):
        self.step: Any = step
        self.sleepers, self.state, self.n, self.real = sleepers, step.state, step.scene.count, step.real
        self.contacts, self.forces = step.contacts, step.integrator.forces
        self.watches = any(not f.uniform for f in self.forces.all)
        memory, n = step.scene.memory, step.scene.count
        kept, pairs = linked(step.scene.inv_mass, drivers, batches, step.contacts)
        self.restless = memory.field("Sleep.restless", n, kind=ti.i32)  # by islands, while they are found
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
        """Of the particles that there are: what is driven goes on; what cannot move keeps turning, where that is asked for."""
        turns = self.step.orients and bool((self.step.scene.inv_mass == 0).any())
        self.goes_on = turns or bool(self.step.drivers)

    def bind_again(self, drivers: list[Batch], batches: list[Batch]) -> None:
        """Constraints came or went: who is linked now, and who never sleeps."""
        memory = self.step.scene.memory
        kept, pairs = linked(self.step.scene.inv_mass, drivers, batches, self.contacts)
        memory.write(self.kept_awake, kept)
        memory.resize(self.pairs, len(pairs))
        memory.write(self.pairs, pairs)
        self.links = len(pairs)

    def compile(self, clock: "Clock") -> None:
        """Now, so that nobody waits for it later: nothing is ready to sleep yet, and none is called."""
        self.fall_asleep(clock.time)
        self.wake_called(clock.h, clock.time, 0, 0, 0, 1, 1, 1, 0)

    def begin(self, dt: float, clock: "Clock") -> None:
        """Before settle(), after a frame of dt [s]."""
        self.sheet[:] = dt, clock.h, clock.time, 0, 0, 0

    def finish(self, dt: float, clock: "Clock") -> bool:
        """After it: have islands fall asleep, or wake. Returns whether all slept in the frame that has gone by, and nothing else
        goes on."""
        awake, ready, called = self.sheet[AWAKE:].tolist()
        if called:
            self.wake_called(clock.h, clock.time, 0, 0, 0, 1, 1, 1, 0)
        part = self.sleepers.time / TRIES
        if ready and clock.time // part > (clock.time - dt) // part:
            self.fall_asleep(clock.time)
        return awake == 0 and not called and not self.goes_on

    def of(self, step: "Step") -> "SleepPass":
        """The same fields, for another Step."""
        new = copy.copy(self)
        new.step, new.contacts = step, step.contacts
        return new

    @ti.kernel
    def settle(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """As a frame ends: for how long each particle has been slow, and whether forces on those asleep have changed."""
        for b in range((self.n + (BLOCK - 1)) // BLOCK):
            awake, ready = 0, 0
            for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
                if self.state.w.positive(i):
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
        """Count one more frame in which particle i was slow, or begin anew if it was not."""
        d = self.state.d[i]
        way = d.dot(d)
        if ti.static(self.state.spins):
            s = self.state.spin.s[i]
            way = ti.max(way, s.dot(s))
        still, most = self.sleepers.still[i] + ti.cast(dt, self.real), self.sleepers.limits[None][0] * ti.cast(h, self.real)
        slow = way < most * most and self.kept_awake[i] == 0
        for c in ti.static(self.contacts):
            slow = slow and not c.dev.geometry.is_eased(i)
        self.sleepers.still[i] = ti.select(slow, still, 0 * still)

    @ti.func
    def pull(self, i, t):
        """What accelerates particle i at rest."""
        time = ti.cast(t, self.real)
        return self.forces.accelerate(i, self.state.place(i), 0 * self.state.d[i], time, self.forces.pull(time))

    @ti.func
    def call(self, i):
        """The island of particle i is to wake."""
        self.sleepers.called[self.sleepers.island[i]] = 1
        self.sleepers.calls[None] = 1

    @ti.kernel
    def fall_asleep(self, t: ti.f64):
        """Find islands of those that are awake, and let those sleep that have been slow for long enough. By one thread: it takes
        some 0.1 us for each particle, and is done a few times a second at most."""
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
                            j = c.held_by(c.dev.list.neighbour[e])
                            if self.drifts(j) and self.sleepers.root(i) != self.sleepers.root(j):
                                if c.presses(i, e):
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
                        self.restless[i] = -1  # asleep in a moment: others still look for the root
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
        return self.state.w.positive(i) and self.sleepers.awake(i)

    @ti.func
    def note_blocks(self):
        """Of which blocks all sleep."""
        for b in range((self.n + (BLOCK - 1)) // BLOCK):
            stirs = 0
            for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
                stirs |= ti.cast(self.sleepers.awake(i), ti.i32)
            self.sleepers.blocks[b] = stirs

    @ti.func
    def look(self, i, before):
        """Call the islands that particle i touches; if it is driven, also those that it touched as the substep began. before: 1
        if constraints come first: also those that it would touch if they moved it as far as it moves by itself, for what wakes
        after them has gone without them."""
        drifts, d = self.drifts(i), self.state.d[i]
        margin = before * d.norm()
        for c in ti.static(self.contacts):
            if drifts or (self.sleepers.awake(i) and d.dot(d) > 0):
                for e in range(c.dev.list.first[i], c.dev.list.first[i] + c.dev.list.number[i]):
                    j = c.reached(i, e, margin)
                    if j >= 0:
                        self.call(j)

    @ti.func
    def note_wake(self, i, s):
        """Tell of particle i that it wakes in substep s of a frame."""
        for c in ti.static(self.contacts):
            if ti.static(c.dev.has_events):
                c.dev.events.wake(i, s)
        for log in ti.static(self.step.wall_logs):
            log.wake(i, s)

    @ti.kernel
    def wake_called(
        self, h64: ti.f64, start: ti.f64, tick: ti.i32, since: ti.i32, fresh: ti.i32, s: ti.i32, substeps: ti.i32,
        iterations: ti.i32, half: ti.i32,
    ):  # fmt: skip
        """Wake the islands that were called. In substep s they move as all others have done; where s = substeps, they do not."""
        now = self.step.turn(self.step.moment(Span(h64, start, start, tick, since, fresh, 0.0, 0, substeps, iterations), s), half)
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
    """Which particles never sleep, a mask, because of constraints on them; and pairs of those that constraints and bodies hold
    together, of what can move."""
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
