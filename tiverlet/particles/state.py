"""The state of particles that a world keeps on the device."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import at, inline, ti
from ..features.regrouping import Regrouping
from .per_particle import PerParticle

if TYPE_CHECKING:
    from ..device.memory import Memory
    from .particles import Particles


class State:
    """The moving state on the device: position x, displacement d of the last substep, inverse mass w.

    Displacement form (numerics: "summed" Verlet): every correction goes to x and to d alike, so that x - d is the
    start of the substep and d / h the velocity half a substep ago, without the cancellation of x_n - x_(n-1).
    With `compensated`, x has a second word, `low`. With `carries`, what rounding takes from the sums in x and d is carried along
    in `low` and `d_low` (two-sum, Knuth): in f32, where rounding is the error that is left, the larger the shorter substeps are.
    So `low` is there with either of them, but what only reads x does without where it is not `compensated`.
    """

    host_only = ("count", "number")
    spin: Any  # where particles spin: the same for their rotation, see spin.py

    def __init__(self, memory: "Memory", particles: "Particles", inv_mass: np.ndarray, compensated: bool):
        n, dim = particles.count, particles.dim
        self.compensated = compensated
        self.real, self.double = memory.real, memory.real == ti.f64
        self.count, self.dim = n, dim
        self.starts = self.befores = self.keeps_wall_push = self.carries = self.spins = False
        self.images: Any = None  # where the world has a periodic box, see neighbours/periodic.py
        self.sleepers: Any = None  # where particles may fall asleep, see step/sleep.py
        self.number = memory.number(n)  # of particles
        self.x = memory.field("position", self.number, width=dim, values=particles.position, state=True)
        self.d = memory.field("displacement", self.number, width=dim, values=particles.velocity, state=True)
        self.w = PerParticle(memory, "inv_mass", inv_mass, self.number)
        self.sums = compensated  # x in two words
        if compensated:
            self._add_low(memory, particles)

    def _add_low(self, memory: "Memory", particles: "Particles") -> None:
        low = particles.position - particles.position.astype(np.float32)
        self.low = memory.field("position_low", self.number, width=self.dim, values=low, state=True)

    def carry(self, memory: "Memory", particles: "Particles") -> None:
        """Declare the low words of displacements, and of positions where there are none."""
        self.d_low = memory.field("displacement_low", self.number, width=self.dim, state=True)
        if not self.sums:
            self._add_low(memory, particles)
        self.carries = self.sums = True

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can come and go where it is."""
        spins = change.now.spins == self.spins and (not self.spins or self.spin.can_regroup(change))
        return spins and self.w.can_be(change.inv_mass)

    def regroup(self, memory: "Memory", change: Regrouping) -> None:
        """They came and went: give new ones their places and velocities. The memory has the rows of those that stay."""
        self.count, first = change.now.count, change.kept
        self.w.become(memory, change.inv_mass)
        x = change.now.position[first:]
        memory.write_from(self.x, first, x)
        memory.write_from(self.d, first, change.now.velocity[first:])
        if self.sums:
            memory.write_from(self.low, first, x - x.astype(np.float32))
        if self.spins:
            self.spin.regroup(memory, change)

    def can_weigh(self, particles: "Particles", inv_mass: np.ndarray, some: np.ndarray) -> bool:
        """Whether the same particles can have other inverse masses where it is. some: those of which they may differ."""
        return self.w.can_change(inv_mass, some) and (not self.spins or self.spin.can_weigh(particles, inv_mass))

    def weigh(self, memory: "Memory", particles: "Particles", inv_mass: np.ndarray, some: np.ndarray) -> None:
        """They have these."""
        self.w.change(memory, inv_mass, some)
        if self.spins:
            self.spin.weigh(memory, particles, inv_mass)

    def get(self, memory: "Memory") -> np.ndarray:
        """A copy of the positions, low words added in f64."""
        out = memory.read(self.x, np.float64)
        return (out + memory.read(self.low) if self.sums else out)[..., : self.count, :]

    def get_some(self, memory: "Memory", some: np.ndarray) -> np.ndarray:
        """The same of some particles, by their numbers; of a world alone."""
        out = memory.seen(self.x)[some].astype(np.float64)
        return out + memory.seen(self.low)[some] if self.sums else out

    def put(self, memory: "Memory", position: np.ndarray) -> None:
        """Overwrite the positions."""
        memory.write(self.x, position)
        if self.sums:
            memory.write(self.low, position - position.astype(np.float32))

    def start(self, memory: "Memory", velocity: np.ndarray) -> None:
        """Overwrite the displacements with velocities, which they are at a start."""
        memory.write(self.d, velocity)
        if self.carries:
            memory.write(self.d_low, np.zeros_like(velocity))

    @inline
    def awake(self, i):
        """Whether particle i is awake; where none can sleep, no branch is left."""
        return self.sleepers.awake(i) if self.sleepers else ti.cast(1, ti.i32) > 0

    @inline
    def moves(self, i):
        """Whether particle i can move, and is awake."""
        if not self.sleepers:
            return self.w.positive(i)
        return ti.select(self.sleepers.awake(i), self.w.of(i), ti.cast(0, self.real)) > 0

    @inline
    def stirs(self, begin, end):
        """1 unless all blocks of particles from `begin` up to `end` sleep."""
        return self.sleepers.stirs(begin, end) if self.sleepers else 1

    @inline
    def apart(self, i, j):
        """x_i - x_j, with the low words where there are any; in a periodic box that of the nearest images."""
        if self.images and self.compensated:  # the difference of what is boxes apart is not known in f32
            return ti.cast(self.between(i, j), self.real)
        r = at(self.x, i) - at(self.x, j)
        return self.nearest(r + (at(self.low, i) - at(self.low, j)) if self.compensated else r)

    @ti.func
    def between(self, i, j):
        """x_i - x_j in f64."""
        r = ti.cast(self.x[i], ti.f64) - ti.cast(self.x[j], ti.f64)
        if ti.static(self.sums):
            r += ti.cast(self.low[i], ti.f64) - ti.cast(self.low[j], ti.f64)
        return self.nearest(r)

    @inline
    def nearest(self, r):
        """A difference of places, between nearest images in a periodic box."""
        return self.images.nearest(r) if self.images else r

    @inline
    def around(self, x, middle):
        """Of a place, the image nearest to another one in a periodic box."""
        return middle + self.images.nearest(x - middle) if self.images else x

    @inline
    def inside(self, x):
        """Of a place, the image in a periodic box."""
        return self.images.inside(x) if self.images else x

    @inline
    def slid(self, moved, i, j):
        """How much further particle i moved than particle j did, as images of a box that may be sheared."""
        return self.images.slid(moved, at(self.x, i) - at(self.x, j)) if self.images and self.images.sheared else moved

    @inline
    def place(self, i):
        """x_i as one number per axis."""
        return at(self.x, i) + at(self.low, i) if self.compensated else at(self.x, i)

    @ti.func
    def begin(self, i):
        """Where particle i was at the start of the substep, as one number per axis."""
        x = self.x0[i]
        if ti.static(self.compensated):
            x += self.low0[i]
        return x

    def remember(self, memory: "Memory", start: bool, before: bool, wall_push: bool) -> None:
        """Declare what friction, swept walls and bounces need, position and displacement at the start of the substep, and how far
        walls have pushed since then."""
        self.starts, self.befores, self.keeps_wall_push = start, before, wall_push
        if wall_push:
            self.wall_push = memory.field("wall_push", self.number, width=self.dim)
        if start:
            self.x0 = memory.field("position_at_start", self.number, width=self.dim)
            if self.sums:
                self.low0 = memory.field("position_low_at_start", self.number, width=self.dim)
        if before:
            self.before = memory.field("displacement_at_start", self.number, width=self.dim)

    @ti.func
    def digits(self, i):
        """What the last two binary digits of the coordinates of particle i amount to [m]."""
        x = self.x[i]
        size = ti.abs(x[0])
        for k in ti.static(range(1, self.dim)):
            size = ti.max(size, ti.abs(x[k]))
        return ti.static(2.0**-50 if self.double else 2.0**-21) * size

    @ti.func
    def restart(self, i):
        """x = start + d in one sum: a particle whose d has come to nothing is where it was, to the bit."""
        self.x[i] = self.x0[i]
        if ti.static(self.sums):
            self.low[i] = self.low0[i]
        self.advance(i, self.d[i])

    @ti.func
    def sum(self, a, low, b):
        """a + low + b in two words. Where it `carries`, what rounding takes is found in half of the time (Dekker); for |b| > |a|
        some of it may be missed, which is no worse than without."""
        s = a + b
        part = s - a
        if ti.static(self.carries):
            low += b - part
        else:
            low += (a - (s - part)) + (b - part)
        t = s + low
        return t, low - (t - s)

    @ti.func
    def advance(self, i, d):
        """x_i += d."""
        if ti.static(self.sums):
            self.x[i], self.low[i] = self.sum(self.x[i], self.low[i], d)
        else:
            self.x[i] = self.x[i] + d

    @ti.func
    def bring(self, i, place):
        """Particle i goes to a place in f64, where positions are sums."""
        self.d[i] = ti.cast(place - ti.cast(self.x[i], ti.f64) - ti.cast(self.low[i], ti.f64), self.real)
        self.x[i] = ti.cast(place, self.real)
        self.low[i] = ti.cast(place - ti.cast(self.x[i], ti.f64), self.real)

    @ti.func
    def shift(self, i, move):
        """A correction: the same move to x_i and to d_i, so that x - d stays the start of the substep."""
        if ti.static(self.carries):
            self.d[i], self.d_low[i] = self.sum(self.d[i], self.d_low[i], move)
        else:
            self.d[i] = self.d[i] + move
        self.advance(i, move)
