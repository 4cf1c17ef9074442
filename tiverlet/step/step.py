"""The substep on the device, and two ways to run it that give the same bits.

fused: a whole frame in one launch, by one CPU thread or by a team of them.
parallel: a few launches per substep, whose loops Taichi spreads over the threads of a GPU.
"""

from struct import Struct
from typing import Any

import numpy as np

from ..contact.velocity_projection import PASSES
from ..device import at, inline, ti
from ..device.thread_team import LEAST
from .phases import Phases

# The sheet of a frame, one array, since a launch takes 0.25 us more for each. First what the frame came to, see Survey; then how
# it ended: whether, in which substep and before which iteration it stopped to have the list grown; how many threads of a team
# were at work. Then what it is given: the substep, and the times at the start and the end of the frame [s]; substeps so far, and
# since the last start; whether it starts; how many substeps and iterations; where it goes on if it stopped (substep, pass or half
# of it, 1); 0, the number of the first thread; how the state that it leaves came about, see Survey; before which substep, and
# which iteration of it, the launch ends: a long frame is made in several, between which Python looks at signals.
FIGURES = 14
HALT, HANDS = FIGURES, FIGURES + 3
GIVEN = tuple(range(HANDS + 1, HANDS + 16))
H, START, END, TICK, SINCE, FRESH, SUBSTEPS, ITERATIONS, BEGIN, PASS, RESUMED, FIRST, CAME, UNTIL, PART = GIVEN
SHEET = PART + 1
GIVE = Struct(f"{len(GIVEN)}d").pack_into  # in a third of the time of an assignment to an array
REBOUNDS = 8  # rounds of restitution in a substep, at most


@inline
def integer(sheet, k):
    """An integer on it."""
    return ti.cast(at(sheet, k), ti.i32)


@ti.data_oriented
class Substep(Phases):
    """The kernels of one world."""

    survey: Any  # what sums up a frame; given once it is there

    @ti.kernel
    def fused(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """All substeps of a frame, in one launch, and what it came to; without substeps that alone."""
        ti.loop_config(serialize=self.team.size == 1)
        for thread in range(self.team.spread):
            if thread % LEAST == 0:
                self.frame(integer(sheet, FIRST) + thread // LEAST, sheet)

    @ti.func
    def frame(self, me, sheet: ti.template()):  # type: ignore[valid-type]
        """What thread `me` does of a frame. All threads of a team take the same branches, for what they depend on is written only
        where the others wait."""
        h64, t, end = sheet[H], sheet[START], sheet[END]
        tick, since, fresh, came = integer(sheet, TICK), integer(sheet, SINCE), integer(sheet, FRESH), integer(sheet, CAME)
        substeps, iterations = integer(sheet, SUBSTEPS), integer(sheet, ITERATIONS)
        begin, it0, resumed = integer(sheet, BEGIN), integer(sheet, PASS), integer(sheet, RESUMED)
        until, part = integer(sheet, UNTIL), integer(sheet, PART)
        for s in range(begin, until):
            h, more = ti.cast(h64, self.real), s < substeps
            when = self.clock(s, substeps)
            starts, again = ti.select(s == 0, fresh, 0), ti.select(s == begin, resumed, 0)
            if self.team.works(me) and self.halted() == 0:
                if more and again == 0:
                    time, final = ti.cast(t + s * h64, self.real), ti.cast(s == substeps - 1, ti.i32)
                    self.predict(me, h, time, tick + s, starts, when, self.calming(since + s), final)
                for q in range(ti.select(again != 0, it0, 0), ti.select(more, part * self.halves, 1)):
                    it = q // self.halves
                    if ti.static(self.hashes):
                        if self.halted() == 0 and self.is_stale() != 0:
                            self.grid.build(me)
                            if self.grid.need[None] > self.grid.capacity:
                                self.halt[None] = [1, s, q]  # all write the same
                    if more and self.halted() == 0:
                        first, final = ti.cast(it == 0, ti.i32), ti.cast(s == substeps - 1, ti.i32)
                        if q % self.halves == 0:
                            self.tell(me, h, when, first, starts)
                            self.settle(me, first)
                            self.draw(me)
                        if q % self.halves == self.halves - 1:
                            self.meet(me, first, starts, final)
                            if ti.static(self.bounces):
                                for _ in range(REBOUNDS):
                                    if it == 0 and self.struck() != 0:
                                        self.rebound(me)
                            self.collect(me, h, when, first, final, ti.cast(final != 0 or it + 1 < iterations, ti.i32))
                if ti.static(self.concludes):
                    if more and part == iterations and self.halted() == 0:
                        self.remember(me, h, tick + s)
                if ti.static(self.calms):
                    if more and part == iterations and self.halted() == 0 and self.calming(since + s) != 0:
                        for k in range(PASSES):
                            self.calm(me, k)
                if not more and self.halted() == 0:
                    self.survey.weigh(me, h, came)
                    self.survey.sum_up(me, h64, end, came, sheet)
                    self.team.forgive()
        if me == 0:
            if ti.static(self.hashes):
                for k in ti.static(range(3)):
                    sheet[HALT + k] = self.halt[None][k]
            if ti.static(self.team.size > 1):
                sheet[HANDS] = self.team.hands[None]

    @ti.kernel
    def predicted(
        self, h64: ti.f64, t: ti.f64, tick: ti.i32, since: ti.i32, fresh: ti.i32, s: ti.i32, substeps: ti.i32
    ) -> ti.i32:  # fmt: skip
        """Phases 1 and 2 of substep s; returns whether the neighbour list is stale."""
        h = ti.cast(h64, self.real)
        when, calming, final = self.clock(s, substeps), self.calming(since + s), ti.cast(s == substeps - 1, ti.i32)
        self.predict(0, h, ti.cast(t + s * h64, self.real), tick + s, fresh, when, calming, final)
        return self.is_stale()

    @ti.kernel
    def relaxed(self, h64: ti.f64, s: ti.i32, substeps: ti.i32, it: ti.i32, fresh: ti.i32) -> ti.i32:
        """One pass of phase 3, or the half of it before contacts where there are constraints, too, or what comes before bounces;
        returns whether the list is stale, and 2 more if a pair bounces."""
        h, when = ti.cast(h64, self.real), self.clock(s, substeps)
        first = ti.cast(it == 0, ti.i32)
        self.tell(0, h, when, first, fresh)
        self.settle(0, first)
        self.draw(0)
        if ti.static(self.halves == 1):
            self.go_on(h, when, first, fresh, ti.cast(s == substeps - 1, ti.i32))
        return self.is_stale() + 2 * self.struck()

    @ti.func
    def go_on(self, h, when, first, fresh, final):
        """The rest of a pass, or what of it comes before bounces."""
        self.meet(0, first, fresh, final)
        if ti.static(not self.bounces):
            self.collect(0, h, when, first, final, 1)

    @ti.kernel
    def met(self, h64: ti.f64, s: ti.i32, substeps: ti.i32, it: ti.i32, fresh: ti.i32) -> ti.i32:
        """The other half; returns what relaxed() does."""
        first, final = ti.cast(it == 0, ti.i32), ti.cast(s == substeps - 1, ti.i32)
        self.go_on(ti.cast(h64, self.real), self.clock(s, substeps), first, fresh, final)
        return self.is_stale() + 2 * self.struck()

    @ti.kernel
    def opened(self, h64: ti.f64, s: ti.i32, substeps: ti.i32, it: ti.i32, fresh: ti.i32):
        """The start of a pass in which a system iterates."""
        self.tell(0, ti.cast(h64, self.real), self.clock(s, substeps), ti.cast(it == 0, ti.i32), fresh)
        for system in ti.static(self.systems):
            system.open(0)

    @ti.kernel
    def iterated(self):
        """One step of such a system."""
        for system in ti.static(self.systems):
            system.go(0)

    @ti.kernel
    def collected(self, h64: ti.f64, s: ti.i32, substeps: ti.i32, it: ti.i32, fresh: ti.i32) -> ti.i32:
        """The end of the pass, or of its half; returns what relaxed() does."""
        first = ti.cast(it == 0, ti.i32)
        self.take(0, first)
        self.draw(0)
        if ti.static(self.halves == 1):
            self.go_on(ti.cast(h64, self.real), self.clock(s, substeps), first, fresh, ti.cast(s == substeps - 1, ti.i32))
        return self.is_stale() + 2 * self.struck()

    @ti.kernel
    def rebounded(self) -> ti.i32:
        """One round of bounces; returns whether another one is needed."""
        self.rebound(0)
        return self.struck()

    @ti.kernel
    def gathered(self, h64: ti.f64, s: ti.i32, substeps: ti.i32, it: ti.i32) -> ti.i32:
        """What comes after bounces; returns whether the list is stale."""
        first, final = ti.cast(it == 0, ti.i32), ti.cast(s == substeps - 1, ti.i32)
        self.collect(0, ti.cast(h64, self.real), self.clock(s, substeps), first, final, 1)
        return self.is_stale()

    @ti.kernel
    def remembered(self, h64: ti.f64, tick: ti.i32):
        """The end of a substep with constraints that break, or contacts that rub or bounce."""
        self.remember(0, ti.cast(h64, self.real), tick)

    @ti.kernel
    def calmed(self, k: ti.i32):
        """Pass k of phase 5."""
        self.calm(0, k)

    @ti.kernel
    def listed(self) -> ti.i32:
        """Build the neighbour list where frames do not; returns the largest number of entries that a block needs."""
        self.grid.build(0)
        return self.grid.need[None]

    @ti.kernel
    def shrunk(self, first: ti.i32):
        """Make particles that overlap with those from number `first` on small enough to fit, from where they grow back."""
        for c in ti.static(self.contacts):
            for i in range(self.n):
                c.shrink(i, first)

    @ti.kernel
    def to_velocity(self, h64: ti.f64, t: ti.f64):
        """Turn displacements into velocities, for a start with another h or another state.

        Springs count with their force at x_n. Rigid links do not: the part of v_n along them is what the next substep corrects,
        and across them d / h + h a / 2 is what RATTLE has, so nothing is lost to second order nor to any other.
        """
        h = ti.cast(h64, self.real)
        if ti.static(self.springs):
            if ti.static(self.team.size == 1):
                self.kick(0, h)
            else:
                for thread in range(self.team.spread):
                    if thread % LEAST == 0:
                        self.kick(thread // LEAST, h)
        for i in range(self.n):
            bond = 0 * self.state.d[i]
            if ti.static(self.springs):
                bond = self.slots.total_of(i)
            self.state.d[i] = self.velocity_after(i, h, ti.cast(t, self.real), bond)
            if ti.static(self.state.carries):
                self.state.d_low[i] = ti.zero(self.state.d[i])

    @ti.kernel
    def velocities(self, h64: ti.f64, t: ti.f64, fresh: ti.i32, firm64: ti.f64, soft64: ti.f64, out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Velocities as the user sees them. firm, soft: see Batch.bond.

        With the multipliers of the last substep along the directions at its end they are second order, and have the momentum and
        the angular momentum of the motion, sum m x_n x (x_n - x_(n-1)) / h and what forces from outside add in h / 2.
        """
        for f in ti.static(self.batches):
            for c in range(f.count):
                f.bond(c, ti.cast(firm64, self.real), ti.cast(soft64, self.real))
        for i in range(self.n):
            v = self.state.d[i]
            if fresh == 0:
                h, time, firm = ti.cast(h64, self.real), ti.cast(t, self.real), ti.cast(firm64, self.real)
                v = self.velocity_after(i, h, time, self.felt(i, h, time, firm))
            for k in ti.static(range(self.dim)):
                out[i, k] = v[k]


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
