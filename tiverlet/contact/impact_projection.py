"""Impacts of discs that touch others: what is struck goes on with what it presses, and no overlap is left to throw it back."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..features.material import RESTITUTION, limit_length
from .eigenvalues import chebyshev, largest

if TYPE_CHECKING:
    from ..colliders.wall_log import WallLog
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import PairData
    from .mass_splitting import MassSplitting

FALL = 0.25  # a pair is struck if it closes as after a fall by this share of the distance of its centers,
SLOW = 8.0  # and if it closes by more than so many substeps of forces
AROUND = 2  # how many contacts away from a struck pair others are projected, too
PASSES = 12
CONDITION = 36.0  # modes with an eigenvalue of at least 1 / CONDITION keep 1 / T(PASSES) = 4 % of their velocity
# The same around what bounces off a wall, with 0.3 % left of the velocity of these modes. A column of FAR_AROUND has them all.
FAR_AROUND, MANY_PASSES, LARGE_CONDITION = 16, 64, 400.0
LIFTS = 32  # passes of positions there
GAP = 2.0**-10  # of the distance of their centers: particles this close touch
PARTED = 1 / 64  # of the velocity with which they close after an impact: particles that parted faster before it did not touch
ELASTIC = 31 / 32  # restitution above which pairs bounce one after the other
BY_PAIR, BY_WALL = 1, 2  # what struck a particle
RELAXATION = 1.6  # of the passes that take back overlap; below 2
RUBS = 8  # passes of friction
LEFT = 2.0**-6  # of the overlap of a struck pair, so that it still touches


class ImpactProjection:
    """The inelastic impact of discs and spheres that touch others.

    A pass takes overlap back by pushes, which act like springs. Where a column lands, these throw it back: three discs come back
    to half of the height of their fall. So where a pair closes fast, the substep ends with a projection of the discs
    around it. Pairs that touch and do not part go on together, and no pair overlaps by more than before:

        (d_i - d_j) . n = 0,    C <= C_0,

    for displacements d and overlaps C. C_0 is nearly 0 for struck pairs, and the overlap before the substep for others, which
    bears their load. The velocity with which struck pairs close is lost, as in the inelastic impact of rigid discs. Overlap is
    taken back from positions, without velocity, and struck pairs forget their push. What is farther away follows later.

    Passes are those of Jacobi, with masses split as in Contact. Those of velocities have Chebyshev's acceleration, as in
    VelocityProjection: the polynomial is within -1 ... 1 on all eigenvalues 0 ... 1, so it adds no kinetic energy. Corrections
    of a pair are opposite, so momentum is conserved. Positions change by about the overlap of an impact, v h. Of the energy
    m v^2 / 2 that an impact takes out, that is the part 2 g h / v. Particles pressed on a wall do not move into it or off it.

    Friction. RUBS passes give pairs that go on together the friction that the impulse p of the impact can hold: an impulse t
    across n, with |t| <= mu |p|, that takes back how far their surfaces slide past each other in the substep. They turn what
    spins, see Spinning. Walls rub by the same law. Masses are split by the number of pairs, since t may have any direction.
    Overlap is taken back with friction as well, or heaps would creep apart with each disc that lands.

    A pair is struck if its overlap doubles, and it closes in the substep by s with

        s > SLOW f    and    s^2 > FALL (r_i + r_j) f,    f = h^2 (|a_i| + |a_j|),

    for accelerations a by forces. Under gravity that is a fall by FALL (r_i + r_j). So nothing is struck in a pile at rest.
    Particles of constraints take no part, because constraints would not know of it.

    Restitution. Pairs and walls bounce one after the other, see Restitution. What a wall strikes may have others on it, which
    strike it in turn, and so on without end. So if a wall strikes a particle, by the same measure, that touched another as the
    substep began, and now closes with it, all that touches, up to FAR_AROUND contacts away, is struck at the same time. By
    Newton's law each contact is left with -e times its velocity:

        u_wall' = -e u_wall,    u_pair' = -e 0 = 0.

    So a column leaves the floor as a whole, with e times its speed. The impulses p give it the energy sum p . (u + u') / 2,
    which is p (1 - e) u_wall / 2 < 0 at the wall and 0 in pairs. Pairs that parted before, or are more than GAP apart, bounce one
    after the other. So do nearly elastic pairs, e > ELASTIC: the wall takes hardly any energy from them, and errors in u_pair
    could give them more. A pair that does not bounce, but rests with its slack, is struck as above if it closes fast and e > 0.
    At e = 0, among others that bounce, it is left to the pass, which resolves its impact in time.

    Many passes find these displacements before others take back overlap. Together, positions would turn the normals in which
    masses are split; eigenvalues exceed 1 by a few %, and the polynomial of 64 passes multiplies such modes by 1000.

    struck, any_struck: whether each particle, and any, was struck in this substep. ring: a scratch field, (n,): the ring of each
    particle around those that were struck. near: the particles in rings, `count` of them; `size` is the count that all threads
    read. Their order depends on threads, but no result does. restitution: the Restitution of the pairs, or None. slip: pair data
    whose old field holds the impulses p n + t [kg m], with friction. lifted: how far each particle was moved without velocity
    [m]. pressed, pressing, rubbed: how far walls with friction pushed each particle in all passes and in this one, and rubbed it
    [m]. events, given: the log of pairs that reports impulses, or None, and the push of a pair in a pass [kg m]. wall_logs, free:
    those of walls, and for them how far a pass would move each particle without walls [m].
    """

    wall_logs: "list[WallLog]"

    def __init__(
        self, scene: "Scene", geometry: Any, table: Any, push: "PairData", slip: "PairData", splitting: "MassSplitting",
        move: Any, events: Any, given: "PairData", ring: Any, restitution: Any, spinning: Any,
    ):  # fmt: skip
        self.restitution, self.has_restitution, self.bounces = restitution, restitution is not None, scene.bounces
        self.around, self.passes, self.lifts, self.condition, self.gap = AROUND, PASSES, 0, CONDITION, 0.0
        if self.bounces:
            self.around, self.passes, self.lifts, self.condition, self.gap = FAR_AROUND, MANY_PASSES, LIFTS, LARGE_CONDITION, GAP
        self.table, self.has_friction, self.spinning = table, table.has_friction, spinning
        self.axes = scene.particles.axes
        self.events, self.given, self.slip = events, given, slip
        self.state, self.w, self.slots = scene.state, scene.state.w, scene.slots
        self.geometry, self.list, self.push, self.move = geometry, geometry.list, push, move
        self.splitting, self.weight = splitting, splitting.weight
        self.own_weight = scene.own_weight
        # The fields of the old list are free except while a list is built. Here they hold the pairs that are projected.
        self.near, self.number = self.list.old_first, self.list.old_number
        add, n = scene.memory.field, scene.count
        self.any_struck, self.count, self.size = (add(f"landing.{k}", None, kind=ti.i32) for k in ("any_struck", "count", "size"))
        self.struck, self.ring = add("landing.struck", n, kind=ti.i32), ring
        self.lift, self.split = add("landing.lift", n, width=scene.particles.dim), add("landing.split_mass", n)
        if self.has_friction:
            self.lifted = add("landing.lifted", n, width=scene.particles.dim)
        self.factors = add("landing.chebyshev", self.passes, values=chebyshev(self.passes, self.condition))

    def meet_walls(self, scene: "Scene", wall_logs: "list[WallLog]") -> None:
        """Declare what walls need, and report to their logs what they take up. Call it before fields are placed."""
        self.rubs = RUBS if self.has_friction or self.state.keeps_wall_grip else 0
        # Find what is struck, then what is around it, list pairs, and the passes.
        self.rounds = 1 + self.around + 1 + self.passes + self.lifts + self.rubs
        if self.state.keeps_wall_grip:
            self.pressed, self.pressing = (scene.memory.field(f"landing.{k}", scene.count) for k in ("pressed", "pressing"))
            self.rubbed = scene.memory.field("landing.rubbed", scene.count, width=scene.particles.dim)
        self.wall_logs = wall_logs
        if wall_logs:
            self.free = scene.memory.field("landing.free", scene.count, width=scene.particles.dim)

    @ti.func
    def note(self, pair, h):
        """Note whether a pair is struck, before it is pushed."""
        i, j = pair.i, pair.j
        if pair.overlap > 2 * pair.alone * pair.last:  # it has doubled since the last push, which took back alone * last
            closes = -self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(pair.n)
            forced = h * h * (self.own_weight.field[i] + self.own_weight.field[j])
            falls = closes * closes > ti.static(FALL) * self.geometry.contact_distance(i, j) * forced
            loose = self.is_loose(i) and self.is_loose(j) and self.is_inelastic(i, j)
            if falls and closes > ti.static(SLOW) * forced and loose:
                self.struck[i] = self.any_struck[None] = BY_PAIR
                if pair.other >= 0 or not self.w.positive(j):
                    self.struck[j] = BY_PAIR

    @ti.func
    def note_bounce(self, i, h):
        """At the end of a substep h [s]: note whether a wall struck particle i, which now closes with one that it touched."""
        blow, forced = self.state.wall_push[i].norm(), h * h * self.own_weight.field[i]
        falls = blow * blow > ti.static(FALL) * self.geometry.contact_distance(i, i) * forced
        if falls and blow > ti.static(SLOW) * forced and self.is_loose(i):
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                j = self.list.neighbour[e]
                r, distance = self.state.separation(i, j), ti.static(1 + GAP) * self.geometry.contact_distance(i, j)
                way = self.state.place(i) - self.state.begin(i) - (self.state.place(j) - self.state.begin(j))
                start = r - self.state.relative_displacement(way, i, j)
                moved = self.state.d[i] - self.state.d[j]
                came = moved - (self.state.wall_push[i] - self.state.wall_push[j])
                closes = -self.state.relative_displacement(moved, i, j).dot(r)
                parted = self.state.relative_displacement(came, i, j).dot(r)
                if start.dot(start) < distance * distance and parted < ti.static(PARTED) * closes:
                    if closes > 0.5 * blow * distance and self.joins(i, j):
                        self.struck[i] = self.any_struck[None] = BY_WALL

    @ti.func
    def is_elastic(self, i, j):
        """Whether particles i and j lose hardly any energy in an impact."""
        out = False
        if ti.static(self.has_restitution):
            out = self.restitution.table.of(i, j)[RESTITUTION] > ti.static(ELASTIC)
        return out

    @ti.func
    def is_inelastic(self, i, j):
        """Whether a pair that closes fast is struck. Among pairs that bounce, those without restitution are not, see above."""
        out = True
        if ti.static(self.has_restitution):
            e = self.restitution.table.of(i, j)[RESTITUTION]
            out = e > 0 and e <= ti.static(ELASTIC)
        return out

    @ti.func
    def joins(self, i, j):
        """Whether particle j takes part in what strikes particle i, if they touch."""
        pushes = self.geometry.pushes(i, j) != 0
        return pushes and self.state.awake(j) and self.is_loose(j) and not self.is_elastic(i, j)

    @ti.func
    def is_loose(self, i):
        """Whether particle i is in no constraint, and has its full size: what was placed into others parts in its own way."""
        out = not self.geometry.is_shrunk(i)
        if ti.static(bool(self.slots)):
            out = out and self.slots.begin[i] == self.slots.begin[i + 1]
        return out

    @ti.func
    def take(self, i, ring):
        """Put particle i into a ring, unless it is in one. Those in the next ring up are known already."""
        if ti.atomic_max(self.ring[i], ring) == 0:
            self.near[ti.atomic_add(self.count[None], 1)] = i

    @ti.func
    def begin(self, i):
        """Put particle i into the first ring if it was struck, else into none."""
        self.ring[i] = 0
        if self.struck[i] == BY_WALL:
            self.take(i, self.around + 1)
        elif self.struck[i] == BY_PAIR:
            self.take(i, AROUND + 1)

    @ti.func
    def find(self, i, k):
        """Do round k > 0 of particle i, which is in a ring: find those around it, then its pairs, then its changes."""
        if k <= self.around:
            self.spread(i, self.around + 2 - k)
        elif k == self.around + 1:
            self.list_pairs(i)
        elif k < self.rounds - self.rubs:
            self.relax(i, k - self.around - 2)
        elif ti.static(self.rubs > 0):
            self.rub(i)

    @ti.func
    def spread(self, i, ring):
        """Put what touches particle i, in this ring, into the ring around it."""
        if self.ring[i] == ring and self.state.moves(i):
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                j = self.list.neighbour[e]
                r, distance = self.state.separation(i, j), ti.static(1 + self.gap) * self.geometry.contact_distance(i, j)
                if r.dot(r) < distance * distance and self.joins(i, j):
                    self.take(j, ring - 1)

    @ti.func
    def list_pairs(self, i):
        """List the pairs of particle i that touch, each with C_0, and split its mass for them.

        Pairs that go on together are listed by their entry e, others by ~e.
        """
        normals = ti.Matrix.zero(self.state.real, self.state.dim, self.state.dim)
        first, w = self.list.first[i], self.w.of(i)
        at = first
        for e in range(first, first + ti.select(w > 0, self.list.number[i], 0)):
            j = self.list.neighbour[e]
            r, distance, push = self.state.separation(i, j), self.geometry.contact_distance(i, j), self.push.field[e]
            moved = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
            length = r.norm()
            near = ti.static(self.gap) * distance
            touches = length > 0 and (length < distance + near or push > 0)
            if touches and self.geometry.pushes(i, j) != 0 and not self.is_elastic(i, j):
                overlap, listed = distance - length, ~e
                kept = ti.min(ti.max(distance - (r - moved).norm(), 0), ti.max(overlap, 0))
                if self.ring[j] != 0:
                    if self.struck[i] == BY_PAIR and self.struck[j] == BY_PAIR:
                        listed, kept, self.push.field[e] = e, ti.static(LEFT) * ti.max(overlap, 0), ti.zero(kept)
                        self.splitting.invalidate_bound(i)
                    elif moved.dot(r) < length * self.least_way(i, e, ti.max(overlap, near, (w + self.w.of(j)) * push)):
                        listed = e
                normals += r.outer_product(r) / (length * length)
                self.list.old_neighbour[at], self.push.old[at] = listed, kept
                at += 1
        self.number[i] = at - first
        self.move[i] = ti.zero(self.state.d[i])
        if ti.static(self.has_friction):
            self.lifted[i] = ti.zero(self.state.d[i])
        if ti.static(self.state.keeps_wall_grip):
            self.pressed[i] = self.pressing[i] = ti.zero(w)
            self.rubbed[i] = ti.zero(self.state.d[i])
        self.split[i] = ti.max(self.weight[i], w * largest(normals))

    @ti.func
    def least_way(self, i, e, overlap):
        """Return how far the pair at entry e of particle i comes apart in a substep, at least, if it parts [m].

        It is this overlap, as pushes take back. A pair that bounced parts however slow it is.
        """
        if ti.static(self.has_restitution):
            if self.restitution.weight[i] > 0 and self.restitution.struck.field[e] != 0:
                overlap = ti.zero(overlap)
        return overlap

    @ti.func
    def relax(self, i, k):
        """Compute pass k for particle i: the change of its displacement, and of its position alone."""
        # Without `lifts` all passes are of both.
        velocities, positions = True, True
        if ti.static(self.lifts > 0):
            velocities, positions = k < self.passes, k >= self.passes
        want, first, w = ti.zero(self.state.d[i]), self.list.first[i], self.w.of(i)
        lift, again, gain = want, ti.zero(w), ti.zero(w)
        if velocities:
            again = self.factors[k] - 1
            gain = self.factors[k] * ti.static(2 / (1 + 1 / self.condition))
        for m in range(first, first + self.number[i]):
            listed = self.list.old_neighbour[m]
            e = ti.max(listed, ~listed)
            j = self.list.neighbour[e]
            r = self.state.separation(i, j)
            length = r.norm()
            if length > 0:
                shared = self.split[i] + ti.select(self.ring[j] != 0, self.split[j], self.weight[j])
                push = w / (shared * length) * r
                if positions:
                    deep = ti.max(self.geometry.contact_distance(i, j) - length - self.push.old[m], 0)
                    lift += deep * push
                    if ti.static(self.has_friction):
                        if self.ring[j] != 0:
                            slip = self.state.relative_displacement(self.lifted[i] - self.lifted[j], i, j)
                            lift -= w / self.split_by_number(i, j) * self.table.held(i, j, r / length, deep, slip)
                if velocities:
                    if listed >= 0:
                        apart = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(r) / length
                        want -= apart * push
                        if ti.static(self.has_friction or bool(self.events)):
                            given = ti.select(k == 0, 0 * gain, again * self.given.field[e]) - gain * apart / shared
                            self.given.field[e] = given
                            self.note_push(i, j, e, given, r / length, k)
        self.move[i] = gain * self.state.across_walls(i, want) + again * self.move[i]
        if ti.static(self.state.keeps_wall_grip):
            n = self.state.wall_normal(i)
            if velocities:
                self.pressing[i] = again * self.pressing[i] - gain * want.dot(n)
                self.pressed[i] = self.pressed[i] + self.pressing[i]
            pushed, grip = ti.max(-lift.dot(n), 0), self.state.wall_grip[i]
            lift -= limit_length(lift - lift.dot(n) * n, grip[0] * pushed, grip[1] * pushed)
        self.lift[i] = ti.static(RELAXATION) * self.state.across_walls(i, lift)
        if ti.static(len(self.wall_logs) > 0):
            if velocities:
                self.free[i] = gain * want + ti.select(k == 0, 0 * want, again * self.free[i])
                self.report_walls(i, self.move[i] - self.free[i])

    @ti.func
    def note_push(self, i, j, e, given, n, k):
        """Note what pass k pushed the pair at entry e along n [kg m]: friction and the log of events need it."""
        if ti.static(self.has_friction):
            self.slip.old[e] = ti.select(k == 0, 0 * n, self.slip.old[e]) + given * n
        if ti.static(bool(self.events)):
            self.events.record(i, j, e, n, given, 0)

    @ti.func
    def parts(self, i):
        """Return in how many parts friction splits the mass of particle i: one for each pair, and one for walls."""
        out = self.number[i]
        if ti.static(self.state.keeps_wall_grip):
            out += ti.select((self.state.wall_push[i] != 0).any(), 1, 0)
        return out

    @ti.func
    def split_by_number(self, i, j):
        """Return the inverse mass of a pair, with masses split by the number of pairs, so that pushes may have any direction."""
        return self.w.of(i) * self.parts(i) + self.w.of(j) * self.parts(j)

    @ti.func
    def spin_split_by_number(self, i, j):
        """Return the same for how far surfaces slide past each other per push across the normal, see Spinning [1/kg]."""
        own, other = self.w.of(i) * self.parts(i), self.w.of(j) * self.parts(j)
        return (1 + self.spinning.spin.inverse_inertia.of(i)) * own + (1 + self.spinning.spin.inverse_inertia.of(j)) * other

    @ti.func
    def rub(self, i):
        """Compute a pass of friction for particle i: pairs that go on together do so across n, too, as far as friction holds."""
        want, turned = ti.zero(self.state.d[i]), ti.Vector.zero(self.state.real, ti.static(self.axes))
        if ti.static(self.has_friction):
            want, turned = self.rub_pairs(i)
        if ti.static(self.state.keeps_wall_grip):
            change = self.rub_wall(i, want)
            want += change
            if ti.static(bool(self.spinning)):
                turned += self.spinning.turned(i, self.state.wall_normal(i), change)
        self.move[i], self.lift[i] = self.state.across_walls(i, want), ti.zero(want)
        if ti.static(bool(self.spinning)):
            self.spinning.change[i] = turned
        if ti.static(len(self.wall_logs) > 0):
            self.report_walls(i, self.move[i] - want)

    @ti.func
    def rub_pairs(self, i):
        """Return how far its pairs move particle i in a pass of friction, and turn its surface [m]."""
        want, first, w = ti.zero(self.state.d[i]), self.list.first[i], self.w.of(i)
        turned = ti.Vector.zero(self.state.real, ti.static(self.axes))
        for at in range(first, first + self.number[i]):
            e = self.list.old_neighbour[at]
            if e >= 0:
                j = self.list.neighbour[e]
                r = self.state.separation(i, j)
                length = r.norm()
                if length > 0:
                    n, shared, push = r / length, self.split_by_number(i, j), self.slip.old[e]
                    pressed, moved = push.dot(n), self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
                    slip, m = moved / shared, n
                    if ti.static(bool(self.spinning)):
                        m = self.spinning.arm(i, j, n)
                        slip = self.spinning.slip(i, j, m) / self.spin_split_by_number(i, j)
                    held = -self.table.held(i, j, n, ti.max(pressed, 0), slip - push)
                    after = (pressed - moved.dot(n) / shared) * n + held
                    self.slip.old[e] = after
                    want += w * (after - push)
                    if ti.static(bool(self.spinning)):
                        turned += w * self.spinning.turned(i, m, held - (push - pressed * n))
                    if ti.static(bool(self.events)):
                        self.events.record(i, j, e, n, after.dot(n) - pressed, 0)
        return want, turned

    @ti.func
    def rub_wall(self, i, want):
        """Return what the friction of walls adds to a pass, in which pairs move particle i by `want` [m]."""
        n, grip, before = self.state.wall_normal(i), self.state.wall_grip[i], self.rubbed[i]
        slip = self.state.d[i] - self.state.wall_moved[i]
        slip -= slip.dot(n) * n
        if ti.static(bool(self.spinning)):
            slip -= self.spinning.spin.surface(self.spinning.spin.s[i], n)
            slip /= 1 + self.spinning.spin.inverse_inertia.of(i)
        pressed = ti.max(self.pressed[i], 0)
        self.pressed[i] = self.pressed[i] - want.dot(n)
        self.rubbed[i] = limit_length(before - slip / ti.max(self.parts(i), 1), grip[0] * pressed, grip[1] * pressed)
        return self.rubbed[i] - before

    @ti.func
    def report_walls(self, i, push):
        """Add a push [m] to the impulses of the walls that press particle i in this substep, in equal parts."""
        number = 0
        for log in ti.static(self.wall_logs):
            number += log.presses(i)
        for log in ti.static(self.wall_logs):
            if log.presses(i) != 0:
                log.add(i, push / number)

    @ti.func
    def apply(self, i, k):
        """Add the changes of particle i in round k. Returns whether that was the last round."""
        last = k == self.rounds - 1
        if k > self.around + 1:
            self.state.d[i] = self.state.d[i] + self.move[i]
            self.state.advance(i, self.lift[i])
            if ti.static(self.has_friction):
                self.lifted[i] = self.lifted[i] + self.lift[i]
            if ti.static(bool(self.spinning)):
                if k >= self.rounds - self.rubs:
                    self.spinning.spin.s[i] = self.spinning.spin.s[i] + self.spinning.change[i]
        if last:
            self.struck[i] = 0
        return last

    @ti.func
    def end_round(self, k):
        """Tell all threads how many particles are near what was struck; after the last round, that there are none."""
        self.size[None] = self.count[None]
        if k == self.rounds - 1:
            self.any_struck[None] = self.count[None] = 0
