"""Restitution of pairs of discs or spheres: impacts are resolved one after the other."""

from typing import Any

from ..device import ti
from ..features.feature import Scene
from ..features.material import RESTITUTION, Table
from ..neighbours.neighbour_list import PairData
from .narrow_phase import DiscGeometry

SLOW = 2.0  # a pair rests if this many substeps of forces account for its speed, see Restitution
ELASTIC = 2.0**-8  # the same for e = 1: rounding alone, so that a load at rest does not count as impacts
UPTAKE = 1 / 8  # share of the slack of a pair that a substep removes


class Restitution:
    """Restitution: from the time of impact on a pair has -e times its normal velocity at that time, see under_force().

    struck: pair data, 1 for pairs struck in this substep. slack: the part of the overlap that is not pushed out [m]. impulse:
    pushes and impacts of the last substep [kg m]. events: an EventLog, or None.

    Unless e is 1, a pair rests at a speed that two substeps of forces give it. Otherwise particles that are pressed between
    others would bounce for ever, by known loads or as a corner of a body: each impact returns what the last one took. At e = 1 a
    pair rests if it approaches by rounding only.
    """

    def __init__(
        self, scene: Scene, geometry: DiscGeometry, table: Table, struck: PairData, slack: PairData, impulse: PairData,
        events: Any, bodies: Any,
    ):  # fmt: skip
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.geometry, self.list, self.table, self.state = geometry, geometry.list, table, scene.state
        self.struck, self.slack, self.impulse, self.events = struck, slack, impulse, events
        self.has_events = events is not None
        self.bodies: Any = bodies  # a BodyRestitution, where bodies of linked particles bounce as wholes, or None
        if bodies:
            bodies.bind(self)
        self.weight = add("Contact.struck", n)  # the split mass of the first pass, 0 without contact
        self.d_change = add("Contact.d_change", n, width=dim)
        self.lift = add("Contact.lift", n, width=dim)  # moves the position only
        if table.has_friction:
            self.rubbed = add("Contact.rubbed", n, width=dim)  # change of displacement by the friction of impacts
        self.left = add("Contact.left", n)  # the fraction of the substep after the impact
        self.partner = add("Contact.partner", n, kind=ti.i32)
        self.first = add("Contact.first", n, kind=ti.i32)
        self.hit = add("Contact.hit", None, kind=ti.i32)

    @ti.func
    def joins_bodies(self, i, j):
        """Whether the impact of particles i and j is one of bodies, see BodyRestitution."""
        out = False
        if ti.static(bool(self.bodies)):
            out = self.bodies.joins(i, j)
        return out

    @ti.func
    def leave_to_bodies(self, i, j, e, n):
        """Begin the impact of a pair as one of bodies, if it is one. Returns whether it is."""
        out = self.joins_bodies(i, j)
        if ti.static(bool(self.bodies)):
            if out:
                self.bodies.begin(i, j, e, n)
        return out

    @ti.func
    def presses_bodies(self, i, j):
        """Whether rigid constraints hold particle i or j: they would turn a lift into speed, see kept_slack()."""
        out = False
        if ti.static(bool(self.bodies)):
            out = self.bodies.impacts.is_held_rigidly(i) or self.bodies.impacts.is_held_rigidly(j)
        return out

    @ti.func
    def clear(self, i, weight):
        """Clear the struck flags and impulses of the pairs of particle i before the first pass. weight: m_i w_i of it."""
        self.weight[i] = weight
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            self.struck.field[e] = 0
            self.impulse.field[e] = 0

    @ti.func
    def bounce(self, i, j, n, overlap, slack, last, first):
        """Return the impact of a pair [m], its slack [m], and whether it rests.

        The impact is the change of displacement from approach to separation, 0 for pairs that are not struck in this substep.
        Only resting pairs are pushed apart. overlap: including the overlap that would hold a known load. last: the push of the
        pair in the last substep [kg m].
        """
        impact, closing, approach = self.target(i, j, n)
        rests, restitution = True, self.table.of(i, j)[RESTITUTION]
        if restitution > 0:
            # The overlap up to which an impact counts as rest; an elastic pair rests only if it was pushed.
            deep = ti.select(last > 0, overlap, ti.select(restitution < 1, slack, 0))
            if self.presses_bodies(i, j):  # others press them together: an impact would leave them there
                deep = overlap
            if last == 0:
                slack = ti.max(slack, overlap - ti.max(closing, 0))
            # First pass only: later passes include pushes of other pairs.
            forced = closing - approach
            slow = ti.select(restitution < 1, ti.static(SLOW) * forced, ti.static(ELASTIC) * forced)
            if first != 0 and approach <= slow:
                deep = ti.max(deep, impact)
            if approach > 0:
                rests = deep > 0 and (first == 0 or impact <= deep)
            elif approach < 0:
                rests = deep > 0 or overlap <= closing
        if rests or approach < 0 or first == 0:
            impact = 0 * impact
        if not rests:
            slack = ti.select(impact > 0, ti.max(overlap - impact, 0), 0)
        return impact, ti.min(slack, overlap), rests

    @ti.func
    def remove_slack(self, pair, slack, own, now):
        """Return the part of its slack that a pair does not push out [m]. The first pass removes some of it from positions."""
        slack = ti.min(slack, ti.max(pair.overlap, 0))
        if now.first != 0:
            if self.presses_bodies(pair.i, pair.j):
                slack = self.kept_slack(pair.i, pair.j, slack, now.h)
                self.slack.field[pair.e] = slack
            else:
                back = ti.static(UPTAKE) * ti.min(slack * pair.stiffness, slack / pair.alone)
                own.lift += own.w * back * pair.n
                self.slack.field[pair.e] = slack - pair.alone * back
        return slack

    @ti.func
    def strike(self, pair, impact, own):
        """Mark a pair as struck if it has an impact [m]. Returns the impact, or 0 if it is one of bodies, see BodyRestitution."""
        if impact > 0:
            self.struck.field[pair.e] = 1
            if self.leave_to_bodies(pair.i, pair.j, pair.e, pair.n):
                impact, own.impacts = ti.zero(impact), own.impacts + 1
            elif self.hit[None] == 0:
                self.hit[None] = 1
        return impact

    @ti.func
    def clear_slack(self, i, weight):
        """Clear the slack of pairs of particle i that do not overlap at the end of a substep. weight: as it is split now."""
        if weight > 0:
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.slack.field[e] > 0:
                    j = self.list.neighbour[e]
                    overlap, _n = self.geometry.overlap(i, j, self.geometry.contact_distance(i, j))
                    if overlap <= 0:
                        self.slack.field[e] = 0

    @ti.func
    def kept_slack(self, i, j, slack, h):
        """Return the part of its slack [m] that a pair of bodies keeps in a substep h [s]. The rest is pushed out.

        Lifting a single particle of a body would become speed, as constraints take it back. So an eighth is pushed out, no faster
        than at push_out, and 1 - e of it whatever the speed: impacts take out more.
        """
        slack *= self.table.of(i, j)[RESTITUTION]
        return slack - ti.min(ti.static(UPTAKE) * slack, self.geometry.push_out * h)

    @ti.func
    def target(self, i, j, n):
        """Return the change of displacement from approach to separation at e times the speed before the substep [m].

        Also return how far the pair approaches in this substep, and how far it would without forces [m].
        """
        approach = self.approach(i, j, n)
        closing = -self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(n)
        return closing + self.table.of(i, j)[RESTITUTION] * ti.max(approach, 0), closing, approach

    @ti.func
    def approach(self, i, j, n):
        """Return how far particles i and j came together in the last substep [m]."""
        return -self.state.relative_displacement(self.state.before[i] - self.state.before[j], i, j).dot(n)

    @ti.func
    def collision(self, i, j, n, overlap):
        """Return the impact of an overlapping pair, with the force in the substep, see under_force() [m].

        Also return the fraction of the substep after the impact, and how far the pair would approach without forces [m].
        """
        impact, closing, approach = self.target(i, j, n)
        left = ti.select(overlap < closing, overlap / closing, 1)
        impact, left = under_force(impact, left, closing, approach, overlap, self.table.of(i, j)[RESTITUTION])
        return impact, left, approach

    @ti.func
    def parted_by_friction(self, i, j, n):
        """Return how far friction of impacts is going to part particles i and j along n [m].

        It counts as before the impacts along the normals. After them, friction of the one pair of a disc that meets two others
        would act along a slip that the other impact has changed, and might add energy.
        """
        out = 0 * self.weight[i]
        if ti.static(self.table.has_friction):
            out = (self.rubbed[i] - self.rubbed[j]).dot(n)
        return out

    @ti.func
    def apply_friction(self, i):
        """Count friction of impacts of particle i, by which its displacement has changed, as before impacts on walls, too."""
        if ti.static(self.table.has_friction):
            self.state.before[i] = self.state.before[i] + self.rubbed[i]

    @ti.func
    def choose(self, i):
        """Choose the earliest struck pair of particle i that still approaches, and store its impact on i."""
        first, partner, most, w = -1, -1, 0 * self.weight[i], self.state.w.of(i)
        if self.weight[i] > 0:
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.struck.field[e] > 0 and not self.joins_bodies(i, self.list.neighbour[e]):
                    j = self.list.neighbour[e]
                    contact_distance = self.geometry.contact_distance(i, j)
                    overlap, _each, n, _reach = self.geometry.impact(i, j, contact_distance, self.weight[i], False)
                    impact, left, approach = self.collision(i, j, n, overlap)
                    parted = self.parted_by_friction(i, j, n)
                    impact, approach = impact - (1 + self.table.of(i, j)[RESTITUTION]) * parted, approach - parted
                    if overlap > 0 and approach > 0 and impact > 0:
                        if left > most or (left == most and earlier(i, j, partner)):
                            first, partner, most = e, j, left
                            self.d_change[i] = w / (w + self.state.w.of(j)) * impact * n
                            if self.hit[None] == 0:
                                self.hit[None] = 1
        self.first[i] = first
        self.partner[i] = partner
        self.left[i] = most

    @ti.func
    def apply(self, i):
        """Let particle i bounce off its partner, if the partner chose i, too, or cannot move."""
        j = self.partner[i]
        if j >= 0:
            meets = self.partner[j] == i or self.state.w.of(j) == 0
            if meets:
                e, d_change = self.first[i], self.d_change[i]
                impulse = d_change.norm() / self.state.w.of(i)
                self.impulse.field[e] = self.impulse.field[e] + impulse
                if ti.static(self.has_events):
                    impact = impulse * (self.state.w.of(i) + self.state.w.of(j))
                    self.events.note_impact(e, impulse, impact / (1 + self.table.of(i, j)[RESTITUTION]))
                self.state.d[i] = self.state.d[i] + d_change
                self.state.before[i] = self.state.before[i] + d_change
                self.state.advance(i, self.left[i] * d_change)

    @ti.func
    def note_push(self, e, push, speed):
        """Add a push [kg m] of the pair at entry e, which met at a speed [m per substep], to its impulse and its event."""
        if push != 0:
            self.impulse.field[e] = self.impulse.field[e] + push
            if ti.static(self.has_events):
                self.events.note_impact(e, push, speed)

    @ti.func
    def push_body(self, i, now):
        """In an extra pass: compute the pushes of particle i. Returns whether any of them was off."""
        return self.bodies.correct(i, now)

    @ti.func
    def apply_push(self, i):
        """Push particle i by what push_body() found."""
        self.bodies.apply(i)


@ti.func
def under_force(impact, left, closing, approach, overlap, e):
    """Return the impact of a pair in a substep in which a force acts, and the fraction of the substep after the impact.

    The impact is the change of displacement from approach to separation [m]. Returns `impact` and `left` if no force acts, or
    if the pair would not be free of overlap at the end.

    In units of the substep, the pair approaches by `closing`, of which forces added f = closing - approach. At time s it has
    moved by u s + f s^2 / 2, u = closing - f / 2, with the velocity u + f s. It meets at s = 2 gap / (u + sqrt(u^2 + 2 f gap)),
    gap = closing - overlap. It leaves at e times its velocity at that time, and falls back by f (1 - s)^2 / 2. So energy is
    conserved at e = 1, whatever s is: a change J of the velocity at s changes the energy of d and x at the end by
    J (J / 2 - u - f s).
    """
    f, gap = closing - approach, closing - overlap
    u = closing - f / 2
    if f != 0 and gap > 0 and u > 0:
        s = ti.min(2 * gap / (u + ti.sqrt(ti.max(u * u + 2 * f * gap, 0))), 1)
        met = closing + (s - 0.5) * f
        if e * met > ti.max((1 - s) * f / 2, 0):
            impact, left = (1 + e) * met, 1 - s
    return impact, left


@ti.func
def earlier(i, j, k):
    """Whether (i, j) comes before (i, k) among pairs struck at the same time. The order is the same seen from either particle."""
    a, b = ti.min(i, j), ti.min(i, k)
    return a < b or (a == b and ti.max(i, j) < ti.max(i, k))
