"""Restitution of pairs of discs or spheres: impacts, one after the other."""

from typing import Any

from ..device import ti
from ..features.feature import Scene
from ..features.material import Table
from ..neighbours.neighbour_list import PairData
from .narrow_phase import DiscGeometry

SLOW = 2.0  # substeps of forces that give a pair no more than the speed at which it rests, see Restitution


class Restitution:
    """A pair leaves with -e times the normal velocity that it has at the time of impact, from then on, see under_force().

    struck: of its pairs, those that are struck in this substep. slack: of their overlap, what no push is for. impulse: pushes
    and impacts of the last substep [kg m]. events: an EventLog, or None.

    A pair rests, unless e is 1, at the speed that two substeps of forces give it. Else what is pressed in between others would
    bounce on and on, by loads that pairs know or as a corner of a body: what an impact takes the next one gives back.
    """

    def __init__(
        self, scene: Scene, geometry: DiscGeometry, table: Table, struck: PairData, slack: PairData, impulse: PairData,
        events: Any,
    ):  # fmt: skip
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.geometry, self.list, self.table, self.state = geometry, geometry.list, table, scene.state
        self.struck, self.slack, self.impulse, self.events = struck, slack, impulse, events
        self.has_events = events is not None
        self.takes_along = False  # whether linked particles take their bodies along
        self.impacts: Any = None  # then the BodyImpacts
        self.weight = add("Contact.struck", n)  # the split mass of the first pass, 0 where nothing touched
        self.d_change = add("Contact.d_change", n, width=dim)
        self.lift = add("Contact.lift", n, width=dim)  # moves the position alone
        self.left = add("Contact.left", n)  # of the substep after the impact, as a fraction
        self.partner = add("Contact.partner", n, kind=ti.i32)
        self.first = add("Contact.first", n, kind=ti.i32)
        self.hit = add("Contact.hit", None, kind=ti.i32)

    def bind(self, scene: Scene, impacts: Any) -> None:
        """Leave impacts of linked particles to the passes of a BodyImpacts."""
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.takes_along, self.impacts = True, impacts
        self.normal, self.target_of = add("Contact.normal", n, width=dim), add("Contact.target", n)

    @ti.func
    def clear(self, i, weight):
        """Before the first pass: no pair of particle i has been struck."""
        self.weight[i] = weight
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            self.struck.field[e] = 0
            self.impulse.field[e] = 0

    @ti.func
    def bounce(self, i, j, n, overlap, slack, last, first):
        """The displacement that takes a pair that was struck in this substep from coming together to leaving, 0 for others; its
        slack; and whether it rests, so that it is pushed apart, as it was in the last substep. overlap: and what
        would hold the load that it knows."""
        given, here, a = self.target(i, j, n)
        rests, e = True, self.table.of(i, j)[2]
        if e > 0:
            deep = ti.select(last > 0, overlap, ti.select(e < 1, slack, 0))  # nothing that is elastic rests where nothing pulls
            if last == 0:
                slack = ti.max(slack, overlap - ti.max(here, 0))
            # Later passes have what others pushed in it, too.
            if first != 0 and e < 1 and a <= ti.static(SLOW) * (here - a):
                deep = ti.max(deep, given)
            if a > 0:
                rests = deep > 0 and (first == 0 or given <= deep)
            elif a < 0:
                rests = deep > 0 or overlap <= here
        if rests or a < 0 or first == 0:
            given = 0 * given
        if not rests:
            slack = ti.select(given > 0, ti.max(overlap - given, 0), 0)
        return given, ti.min(slack, overlap), rests

    @ti.func
    def target(self, i, j, n):
        """What takes a pair from coming together to leaving at e times its velocity before the substep; how far it comes together
        in this substep, and without forces."""
        a = -self.state.slid(self.state.before[i] - self.state.before[j], i, j).dot(n)
        here = -self.state.slid(self.state.d[i] - self.state.d[j], i, j).dot(n)
        return here + self.table.of(i, j)[2] * ti.max(a, 0), here, a

    @ti.func
    def collision(self, i, j, n, overlap):
        """What takes a pair that overlaps from coming together to leaving, with the force in the substep; the part of the substep
        that is left after the impact; and how far the pair comes together without forces."""
        given, here, a = self.target(i, j, n)
        left = ti.select(overlap < here, overlap / here, 1)
        given, left = under_force(given, left, here, a, overlap, self.table.of(i, j)[2])
        return given, left, a

    @ti.func
    def choose(self, i):
        """The first of the pairs of particle i that were struck and still come together, and what it does to i."""
        first, partner, most, w = -1, -1, 0 * self.weight[i], self.state.w.of(i)
        if ti.static(self.takes_along):
            self.impacts.prepare(i)
        if self.weight[i] > 0:
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.struck.field[e] > 0 and not self.left_to_passes(i, self.list.neighbour[e]):
                    j = self.list.neighbour[e]
                    contact_distance = self.geometry.contact_distance(i, j)
                    overlap, _each, n, _reach = self.geometry.impact(i, j, contact_distance, self.weight[i], False)
                    given, left, a = self.collision(i, j, n, overlap)
                    if overlap > 0 and a > 0 and given > 0:
                        if left > most or (left == most and earlier(i, j, partner)):
                            first, partner, most = e, j, left
                            self.d_change[i] = w / (w + self.state.w.of(j)) * given * n
                            if ti.static(self.takes_along):
                                self.wanted(i, j, n, given)
                            if self.hit[None] == 0:
                                self.hit[None] = 1
        self.first[i] = first
        self.partner[i] = partner
        self.left[i] = most

    @ti.func
    def apply(self, i):
        """Let particle i bounce off its partner, if it is the partner's partner."""
        j = self.partner[i]
        if j >= 0:
            meets = self.partner[j] == i or self.state.w.of(j) == 0
            if ti.static(self.takes_along):
                if meets:
                    meets = not self.impacts.strike_other(i, j, self.normal[i], self.target_of[i])
            if meets:
                e, d_change = self.first[i], self.d_change[i]
                impulse = d_change.norm() / self.state.w.of(i)
                self.impulse.field[e] = self.impulse.field[e] + impulse
                if ti.static(self.has_events):
                    given = impulse * (self.state.w.of(i) + self.state.w.of(j))
                    self.events.note_impact(e, impulse, given / (1 + self.table.of(i, j)[2]))
                self.state.d[i] = self.state.d[i] + d_change
                self.state.before[i] = self.state.before[i] + d_change
                self.state.advance(i, self.left[i] * d_change)

    @ti.func
    def left_to_passes(self, i, j):
        """Whether the impact of particles i and j is left to passes to come, see BodyImpacts."""
        out = False
        if ti.static(self.takes_along):
            out = self.impacts.meets(i, j)
        return out

    @ti.func
    def wanted(self, i, j, n, given):
        """Note the displacement along n with which particle i is to leave particle j."""
        self.normal[i] = n
        self.target_of[i] = given + self.state.slid(self.state.d[i] - self.state.d[j], i, j).dot(n)

    @ti.func
    def push_on(self, i):
        """In one of these passes: work out what particle i is pushed by, and note the impulse. Returns whether it was off."""
        off, push = self.impacts.work_out(i)
        if push != 0:
            j = self.impacts.partner[i]
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.list.neighbour[e] == j:
                    impulse = push / (self.state.w.of(i) + self.state.w.of(j))
                    self.impulse.field[e] = self.impulse.field[e] + impulse
                    if ti.static(self.has_events):
                        self.events.note_impact(e, impulse, self.impacts.first_push[i] / (1 + self.table.of(i, j)[2]))
        return off


@ti.func
def under_force(given, left, here, a, overlap, e):
    """The impact of a pair in a substep in which a force acts: what takes it from coming together to leaving [m], and the part of
    the substep that is left after it; `given` and `left` where no force acts, or where the pair does not get free of overlap.

    In units of the substep, the pair comes together by `here`, of which f = here - a is what forces added. At s its way is
    u s + f s^2 / 2, u = here - f / 2, and its velocity u + f s. It meets at s = 2 gap / (u + sqrt(u^2 + 2 f gap)), gap = here -
    overlap, leaves at e times its velocity then, and falls back by f (1 - s)^2 / 2. So energy is kept at e = 1, whatever s is:
    a change J of the velocity at s changes what d and x are worth at the end by J (J / 2 - u - f s).
    """
    f, gap = here - a, here - overlap
    u = here - f / 2
    if f != 0 and gap > 0 and u > 0:
        s = ti.min(2 * gap / (u + ti.sqrt(ti.max(u * u + 2 * f * gap, 0))), 1)
        met = here + (s - 0.5) * f
        if e * met > ti.max((1 - s) * f / 2, 0):
            given, left = (1 + e) * met, 1 - s
    return given, left


@ti.func
def earlier(i, j, k):
    """Whether (i, j) comes before (i, k) among pairs that are struck at the same time: an order of all pairs, whichever is i."""
    a, b = ti.min(i, j), ti.min(i, k)
    return a < b or (a == b and ti.max(i, j) < ti.max(i, k))
