"""Impacts of discs without restitution: what is struck goes on with what it presses, and no overlap is left to throw it back."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from .eigenvalues import chebyshev, largest

if TYPE_CHECKING:
    from ..colliders.wall_log import WallLog
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import PairData
    from .mass_splitting import MassSplitting

FALL = 0.25  # a pair is struck if it closes as after a fall by this share of the distance of its centers,
SLOW = 8.0  # and if it closes by more than so many substeps of forces
AROUND = 2  # how many contacts away from a struck pair others are projected, too
STRUCK = AROUND + 1  # ring of a struck particle; those around it have lower ones, down to 1, and all others 0
PASSES = 12
CONDITION = 36.0  # modes with an eigenvalue of at least 1 / CONDITION keep 1 / T(PASSES) = 4 % of their velocity
RELAXATION = 1.6  # of the passes that take back overlap; below 2
LEFT = 2.0**-6  # of the overlap of a struck pair, so that it still touches
ROUNDS = 1 + AROUND + 1 + PASSES  # find what is struck, then what is around it, list pairs, and the passes


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

    A pair is struck if its overlap doubles, and it closes in the substep by s with

        s > SLOW f    and    s^2 > FALL (r_i + r_j) f,    f = h^2 (|a_i| + |a_j|),

    for accelerations a by forces. Under gravity that is a fall by FALL (r_i + r_j). So nothing is struck in a pile at rest.
    Particles of constraints take no part, because constraints would not know of it. Worlds with restitution have no such
    projection, see Restitution.

    struck, any_struck: whether each particle, and any, was struck in this substep. ring: a scratch field, (n,): the ring of each
    particle around those that were struck. near: the particles in rings, `count` of them; `size` is the count that all threads
    read. Their order depends on threads, but no result does. events, given: the log of pairs that reports impulses, or None, and
    for it the push of a pair in a pass [kg m]. wall_logs, free: those of walls, and for them how far a pass would move each
    particle without walls [m].
    """

    wall_logs: "list[WallLog]"

    def __init__(
        self, scene: "Scene", geometry: Any, push: "PairData", splitting: "MassSplitting", move: Any, events: Any,
        given: "PairData", ring: Any,
    ):  # fmt: skip
        self.events, self.given = events, given
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
        self.factors = add("landing.chebyshev", PASSES, values=chebyshev(PASSES, CONDITION))

    def report_to(self, scene: "Scene", wall_logs: "list[WallLog]") -> None:
        """Report to the logs of walls what these take up. Call it before fields are placed."""
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
            if falls and closes > ti.static(SLOW) * forced and self.is_loose(i) and self.is_loose(j):
                self.struck[i] = self.any_struck[None] = 1
                if pair.other >= 0 or not self.w.positive(j):
                    self.struck[j] = 1

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
        if self.struck[i] != 0:
            self.struck[i] = 0
            self.take(i, ti.static(STRUCK))

    @ti.func
    def find(self, i, k):
        """Do round k > 0 of particle i, which is in a ring: find those around it, then its pairs, then its changes."""
        if k <= AROUND:
            self.spread(i, STRUCK + 1 - k)
        elif k == AROUND + 1:
            self.list_pairs(i)
        else:
            self.relax(i, k - AROUND - 2)

    @ti.func
    def spread(self, i, ring):
        """Put what touches particle i, in this ring, into the ring around it."""
        if self.ring[i] == ring and self.state.moves(i):
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                j = self.list.neighbour[e]
                r, distance = self.state.separation(i, j), self.geometry.contact_distance(i, j)
                if r.dot(r) < distance * distance and self.state.awake(j) and self.is_loose(j):
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
            if length > 0 and (length < distance or push > 0):
                overlap, listed = distance - length, ~e
                kept = ti.min(ti.max(distance - (r - moved).norm(), 0), ti.max(overlap, 0))
                if self.ring[j] != 0 and (overlap > 0 or push > 0):
                    if self.ring[i] == STRUCK and self.ring[j] == STRUCK:
                        listed, kept, self.push.field[e] = e, ti.static(LEFT) * ti.max(overlap, 0), ti.zero(kept)
                        self.splitting.invalidate_bound(i)
                    elif moved.dot(r) < length * ti.max(overlap, (w + self.w.of(j)) * push):
                        listed = e
                normals += r.outer_product(r) / (length * length)
                self.list.old_neighbour[at], self.push.old[at] = listed, kept
                at += 1
        self.number[i] = at - first
        self.move[i] = ti.zero(self.state.d[i])
        self.split[i] = ti.max(self.weight[i], w * largest(normals))

    @ti.func
    def relax(self, i, k):
        """Compute pass k for particle i: the change of its displacement, and of its position alone."""
        want, first, w = ti.zero(self.state.d[i]), self.list.first[i], self.w.of(i)
        lift, again = want, self.factors[k] - 1
        gain = self.factors[k] * ti.static(2 / (1 + 1 / CONDITION))
        for m in range(first, first + self.number[i]):
            listed = self.list.old_neighbour[m]
            e = ti.max(listed, ~listed)
            j = self.list.neighbour[e]
            r = self.state.separation(i, j)
            length = r.norm()
            if length > 0:
                shared = self.split[i] + ti.select(self.ring[j] != 0, self.split[j], self.weight[j])
                push = w / (shared * length) * r
                lift += ti.max(self.geometry.contact_distance(i, j) - length - self.push.old[m], 0) * push
                if listed >= 0:
                    apart = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(r) / length
                    want -= apart * push
                    if ti.static(bool(self.events)):
                        given = ti.select(k == 0, 0 * gain, again * self.given.field[e])
                        self.given.field[e] = given - gain * apart / shared
                        self.events.record(i, j, e, r / length, self.given.field[e], 0)
        self.move[i] = gain * self.state.across_walls(i, want) + again * self.move[i]
        self.lift[i] = ti.static(RELAXATION) * self.state.across_walls(i, lift)
        if ti.static(len(self.wall_logs) > 0):
            self.free[i] = gain * want + ti.select(k == 0, 0 * want, again * self.free[i])
            self.report_walls(i, self.move[i] - self.free[i])

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
        if k > AROUND + 1:
            self.state.d[i] = self.state.d[i] + self.move[i]
            self.state.advance(i, self.lift[i])
        return k == ROUNDS - 1

    @ti.func
    def end_round(self, k):
        """Tell all threads how many particles are near what was struck; after the last round, that there are none."""
        self.size[None] = self.count[None]
        if k == ROUNDS - 1:
            self.any_struck[None] = self.count[None] = 0
