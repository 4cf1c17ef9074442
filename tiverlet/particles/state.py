"""The moving state of particles on the device."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import always, at, inline, ti
from ..features.regrouping import Regrouping

if TYPE_CHECKING:
    from ..device.memory import Memory, Rows
    from .particles import Particles


class State:
    """The moving state on the device: position x, displacement d of the last substep, inverse mass w.

    Displacement form ("summed" Verlet in numerics): every correction is added to both x and d. So x - d is the start of the
    substep, and d / h is the velocity half a substep ago, without the cancellation of x_n - x_(n-1).
    With `compensated`, x has a second word, `low`. With `carries`, rounding errors of the sums in x and d are carried along in
    `low` and `d_low` (two-sum, Knuth). In f32 these rounding errors are the remaining error, and grow as substeps get shorter.
    Either of the two declares `low`, but code that only reads x ignores `low` unless `compensated` is set; differences of
    positions count it if `subtracts_low` is.
    """

    host_only = ("count", "number")
    spin: Any  # the Spin, if particles spin

    def __init__(self, memory: "Memory", particles: "Particles", inv_mass: np.ndarray, compensated: bool):
        n, dim = particles.count, particles.dim
        self.compensated = compensated
        self.real, self.double = memory.real, memory.real == ti.f64
        self.two_digits = 2.0**-50 if self.double else 2.0**-21  # the size of the last two binary digits of 1
        self.count, self.dim = n, dim
        self.starts = self.befores = self.lifts = self.carries = self.spins = False
        self.images: Any = None  # set in a periodic box, see neighbours/periodic.py
        self.sleepers: Any = None  # set if particles may sleep, see step/sleep.py
        self.number = memory.number(n)  # of particles
        self.x = memory.field("position", self.number, width=dim, values=particles.position, state=True)
        self.d = memory.field("displacement", self.number, width=dim, values=particles.velocity, state=True)
        self.w = memory.field("inv_mass", self.number, values=inv_mass)
        self.sums = self.subtracts_low = compensated  # sums: whether x has two words
        if compensated:
            self._add_low(memory, particles)

    def _add_low(self, memory: "Memory", particles: "Particles") -> None:
        low = particles.position - particles.position.astype(np.float32)
        self.low = memory.field("position_low", self.number, width=self.dim, values=low, state=True)

    def carry(self, memory: "Memory", particles: "Particles", subtracts: bool) -> None:
        """Declare the low words of displacements, and those of positions if there are none. subtracts: see `subtracts_low`."""
        self.d_low = memory.field("displacement_low", self.number, width=self.dim, state=True)
        if not self.sums:
            self._add_low(memory, particles)
        self.carries = self.sums = True
        self.subtracts_low |= subtracts

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can be added and removed in place."""
        return change.now.spins == self.spins and (not self.spins or self.spin.can_regroup(change))

    def regroup(self, memory: "Memory", change: Regrouping) -> None:
        """Set position and velocity of added particles. `memory` already holds only the rows of the remaining ones."""
        self.count, first = change.now.count, change.kept
        memory.write(self.w, change.inv_mass)
        x = change.now.position[first:]
        memory.write_from(self.x, first, x)
        memory.write_from(self.d, first, change.now.velocity[first:])
        if self.sums:
            memory.write_from(self.low, first, x - x.astype(np.float32))
        if self.spins:
            self.spin.regroup(memory, change)

    def set_inverse_mass(self, memory: "Memory", particles: "Particles", inv_mass: np.ndarray, *some: "Rows") -> None:
        """Write other inverse masses of the same particles. some: those whose inverse mass may differ."""
        w = memory.view(self.w)
        for rows in some:
            w[rows] = inv_mass[rows]
        if self.spins:
            self.spin.set_inverse_mass(memory, particles, inv_mass)

    def get(self, memory: "Memory") -> np.ndarray:
        """Return a copy of the positions, low words added in f64."""
        out = memory.read(self.x, np.float64)
        return (out + memory.read(self.low) if self.sums else out)[..., : self.count, :]

    def get_some(self, memory: "Memory", some: "Rows") -> np.ndarray:
        """Return the positions of the particles `some`, by their numbers, as get() does. For a single world."""
        if self.sums:
            x, low = memory.rows(some, self.x, self.low)
            return x.astype(np.float64) + low
        return memory.rows(some, self.x)[0].astype(np.float64)

    def put(self, memory: "Memory", position: np.ndarray) -> None:
        """Overwrite the positions."""
        memory.write(self.x, position)
        if self.sums:
            memory.write(self.low, position - position.astype(np.float32))

    def start(self, memory: "Memory", velocity: np.ndarray) -> None:
        """Overwrite the displacements with velocities, before a start (the first substep after velocities were set)."""
        memory.write(self.d, velocity)
        if self.carries:
            memory.write(self.d_low, np.zeros_like(velocity))

    @inline
    def awake(self, i):
        """Whether particle i is awake. Compiles to no branch if none can sleep."""
        return self.sleepers.awake(i) if self.sleepers else always()

    @inline
    def moves(self, i):
        """Whether particle i can move, and is awake."""
        if not self.sleepers:
            return at(self.w, i) > 0
        return ti.select(self.sleepers.awake(i), at(self.w, i), ti.cast(0, self.real)) > 0

    @inline
    def any_awake(self, begin, end):
        """Return 0 if all blocks of particles from `begin` up to `end` sleep, else 1."""
        return self.sleepers.any_awake(begin, end) if self.sleepers else 1

    @inline
    def separation(self, i, j):
        """Return x_i - x_j, with any low words; in a periodic box the difference of the nearest images."""
        if self.images and self.compensated:  # f32 cannot resolve the difference of particles many boxes apart
            return ti.cast(self.between(i, j), self.real)
        r = at(self.x, i) - at(self.x, j)
        return self.nearest(r + (at(self.low, i) - at(self.low, j)) if self.subtracts_low else r)

    @ti.func
    def between(self, i, j):
        """Return x_i - x_j in f64."""
        r = ti.cast(self.x[i], ti.f64) - ti.cast(self.x[j], ti.f64)
        if ti.static(self.sums):
            r += ti.cast(self.low[i], ti.f64) - ti.cast(self.low[j], ti.f64)
        return self.nearest(r)

    @ti.func
    def between_before(self, i, j, back):
        """Return x_i - x_j at x - back d in f64, so that positions at the start and predicted ones differ by exactly d."""
        return self.between(i, j) - back * (ti.cast(self.d[i], ti.f64) - ti.cast(self.d[j], ti.f64))

    @inline
    def nearest(self, r):
        """Map a difference of positions to that of the nearest images, in a periodic box."""
        return self.images.nearest(r) if self.images else r

    @inline
    def around(self, x, middle):
        """Return the image of x nearest to `middle`, in a periodic box."""
        return middle + self.images.nearest(x - middle) if self.images else x

    @inline
    def inside(self, x):
        """Return the image of x inside the periodic box."""
        return self.images.inside(x) if self.images else x

    @inline
    def relative_displacement(self, moved, i, j):
        """Return how much further particle i moved than particle j, as images of a periodic box that may be sheared."""
        sheared = self.images and self.images.sheared
        return self.images.relative_displacement(moved, at(self.x, i) - at(self.x, j)) if sheared else moved

    @inline
    def place(self, i):
        """Return x_i as one number per axis."""
        return at(self.x, i) + at(self.low, i) if self.compensated else at(self.x, i)

    @inline
    def exact(self, i):
        """Return x_i with all of its digits: in f64 where it has two words."""
        return ti.cast(at(self.x, i), ti.f64) + ti.cast(at(self.low, i), ti.f64) if self.compensated else at(self.x, i)

    @ti.func
    def begin(self, i):
        """Return the position of particle i at the start of the substep, as one number per axis."""
        x = self.x0[i]
        if ti.static(self.compensated):
            x += self.low0[i]
        return x

    def remember(self, memory: "Memory", start: bool, before: bool, lifts: bool) -> None:
        """Declare what friction, swept walls and impacts need.

        start, before: position and displacement at the start of the substep. lifts: whether particles that bounced may not be
        where their displacement says.
        """
        self.starts, self.befores, self.lifts = start, before, lifts
        if start:
            self.x0 = memory.field("position_at_start", self.number, width=self.dim)
            if self.sums:
                self.low0 = memory.field("position_low_at_start", self.number, width=self.dim)
        if before:
            self.before = memory.field("displacement_at_start", self.number, width=self.dim)

    @inline
    def kick(self, i):
        """Return the displacement of particle i by forces in the substep, twice that at a start, where `before` is kept [m]."""
        return at(self.d, i) - at(self.before, i)

    @ti.func
    def digits(self, i):
        """Return the size of the last two binary digits of the coordinates of particle i [m]."""
        x = self.x[i]
        size = ti.abs(x[0])
        for k in ti.static(range(1, self.dim)):
            size = ti.max(size, ti.abs(x[k]))
        return ti.static(self.two_digits) * size

    @ti.func
    def digits_of_difference(self, i, size):
        """Return the size of the last two binary digits of x_i - x_j, where it is of this size [m]."""
        close = ti.static(self.two_digits) * size
        if ti.static(not self.subtracts_low):
            close = self.digits(i)
        return close

    @ti.func
    def digits_along(self, i, n, size):
        """Return the size of the last two binary digits of n . x_i and of lengths of this size, for a unit vector n [m].

        Only compensated positions need it, which may be so far out that digits() exceeds the particle: there, only the
        coordinates along n count.
        """
        close = self.digits(i)
        if ti.static(self.compensated):
            close = ti.static(self.two_digits) * (abs(n).dot(abs(self.x[i])) + size)
        return close

    @ti.func
    def restart(self, i):
        """Set x = start + d in one sum: a particle with d = 0 is where it was, bit for bit."""
        self.x[i] = self.x0[i]
        if ti.static(self.sums):
            self.low[i] = self.low0[i]
        self.advance(i, self.d[i])

    @ti.func
    def sum(self, a, low, b):
        """Return a + low + b in two words.

        With `carries`, the rounding error is computed in half of the time (Dekker). For |b| > |a| some of it may be lost, which
        is no worse than without.
        """
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
        """Add d to x_i."""
        if ti.static(self.sums):
            self.x[i], self.low[i] = self.sum(self.x[i], self.low[i], d)
        else:
            self.x[i] = self.x[i] + d

    @ti.func
    def bring(self, i, place):
        """Move particle i to `place`, in f64 where positions are sums; d_i is the way there."""
        if ti.static(self.sums):
            self.d[i] = ti.cast(place - ti.cast(self.x[i], ti.f64) - ti.cast(self.low[i], ti.f64), self.real)
            self.x[i] = ti.cast(place, self.real)
            self.low[i] = ti.cast(place - ti.cast(self.x[i], ti.f64), self.real)
        else:
            d = place - self.place(i)
            self.d[i] = d
            self.advance(i, d)

    @ti.func
    def dithered(self, big, small, turn):
        """Return `small` with a dither, before it is added to `big` in f32. turn: an element of a golden sequence, times 2^32.

        `small` gets a fraction in (-1/2, 1/2) of the last digit of `big`. With the elements of a golden sequence, rounded sums
        follow the exact one, with an error that grows like the logarithm of the number of steps instead of that number.
        """
        share = ti.cast(turn, ti.f32) * ti.static(2.0**-32) - 0.5
        for a in ti.static(range(self.dim)):
            exponent = ti.bit_cast(big[a], ti.u32) & ti.u32(0x7F800000)
            sign = ti.bit_cast(small[a], ti.u32) & ti.u32(0x80000000)
            digit = ti.bit_cast(exponent | sign, ti.f32) * (share * ti.static(2.0**-23))
            small[a] += ti.select(small[a] == 0, ti.cast(0, ti.f32), digit)
        return small

    @ti.func
    def shift(self, i, move):
        """Add a correction to both x_i and d_i, so that x - d stays the start of the substep, up to a digit of x."""
        if ti.static(self.carries):
            self.d[i], self.d_low[i] = self.sum(self.d[i], self.d_low[i], move)
        else:
            self.d[i] = self.d[i] + move
        self.advance(i, move)
