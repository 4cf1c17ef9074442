"""The projection of velocities that removes sound, the elastic waves through loaded contacts."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..neighbours.neighbour_list import WORD, lowest_bit
from .eigenvalues import chebyshev, largest
from .projection_times import ALWAYS, MAYBE

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import PairData

RESTLESS = 0.25  # change of an overlap in a substep, in overlaps that bear the load of the particle: more of it is restless
FAINT = 2.0**-10  # the same, in displacements of the particle: less may be rounding
UNEQUAL = 3.0  # ratio of the masses of a pair from which it is projected at once
RINGS = 16  # how many contacts away from a restless particle others are projected, too, at most
REACH = 2.0  # around what is projected at once, per root of the ratio of masses: it presses on no more than that
FAR = -1  # ring of a particle beyond them
PASSES = 32
CONDITION = 400.0  # modes with an eigenvalue of at least 1 / CONDITION keep 1 / T(PASSES) = 8 % of their velocity


class VelocityProjection:
    """The projection of displacements after which loaded pairs neither approach nor separate.

    With one pass per substep loaded contacts are springs. Sound in them decays by a third of its eigenvalue L per substep, which
    for the longest wave in a column of N is (pi / 4 N)^2. So every EVERY substeps displacements are projected onto those that
    keep the lengths of loaded pairs, (d_i - d_j) . n = 0, by PASSES Jacobi passes with Chebyshev acceleration. Slow modes then
    lose PASSES^2 L of their velocity, not PASSES L. The polynomial is within -1 ... 1 on all eigenvalues 0 ... 1, so it adds no
    energy. Corrections of a pair are opposite, so momentum is conserved. Particles pressed on a wall do not move into it or off
    it.

    Inelastic rigid discs, in which there is no sound, behave so. Pairs that bounce (restitution) are left out.

    What lands on a pile presses its contacts together, and is thrown back by them. A particle is restless if the overlap of its
    pairs changes, in a substep, by more than a quarter of the largest overlap that bears its load. What was restless at the last
    projection is projected again after OFTEN substeps, with all that is up to RINGS contacts away. A heavy particle, M, on a
    light one, m, that cannot give way is held as by a spring that turns it round in about sqrt(M / m) substeps. So what is
    restless in such a pair is projected at once, with all that is up to REACH sqrt(M / m) contacts away: what presses on heaps of
    unequal discs in every substep costs that in each. Pairs that part are left out: what is thrown off a pile is free to go.

    push: pair data, the push of each pair in the last substep. weight: m_i w_i of each particle. restitution: the Restitution of
    the pairs, or None. change: a scratch field of vectors, (n,).
    """

    def __init__(
        self, scene: "Scene", geometry: Any, push: "PairData", weight: Any, restitution: Any, change: Any, team: "Team"
    ):  # fmt: skip
        self.geometry, self.list, self.push, self.weight, self.restitution = geometry, geometry.list, push, weight, restitution
        self.state, self.change, self.has_restitution = scene.state, change, restitution is not None
        # The fields of the old list are free except while a list is built. Here they hold the loaded pairs of each particle, the
        # number of these pairs, and the particles that have any, piece by piece.
        self.number, self.loaded = self.list.old_number, self.list.old_first
        add, pieces = scene.memory.field, self._pieces(scene.particles.count, team)
        self.count, self.restless_count = (add(f"Contact.{name}", pieces, kind=ti.i32) for name in ("loaded", "restless_count"))
        self.factors = add("Contact.chebyshev", PASSES, values=chebyshev(PASSES, CONDITION))
        # Which particles were restless at their last projection, and whether any was. The ring of each particle around those that
        # are projected now.
        self.restless = add("Contact.restless", scene.count, kind=ti.i32, state=True)
        self.any_restless = add("Contact.any_restless", None, kind=ti.i32, state=True)
        self.ring = add("Contact.ring", scene.count, kind=ti.i32)
        self.unequal = unequal(scene.particles.mass)
        if self.unequal:  # how far around a particle that is restless in a pair of unequal masses others are projected in this
            # substep (0: it is not), and whether any is restless
            self.struck = add("Contact.struck", scene.count, kind=ti.i32)
            # The largest change of overlaps with lighter particles, the largest overlap that bears a load, both [m], and the
            # inverse mass of the lightest of these particles.
            self.strike = add("Contact.strike", scene.count, width=3)
            self.any_struck = add("Contact.any_struck", None, kind=ti.i32)

    @staticmethod
    def _pieces(n: int, team: "Team") -> int:
        return -(-n // team.piece)

    def can_regroup(self, mass: np.ndarray) -> bool:
        """Whether the present kernels will do for particles of these masses, (n,) [kg]."""
        return self.unequal or not unequal(mass)

    def regroup(self, n: int, team: "Team") -> None:
        """Resize the field of pieces for n particles."""
        for field in (self.count, self.restless_count):
            self.list.memory.resize(field, self._pieces(n, team))

    @ti.func
    def is_due(self, now):
        """Whether velocities are projected after this substep, whatever happens in it."""
        out = now.damps == ALWAYS
        if now.damps == MAYBE:
            out = self.any_restless[None] != 0
        return out

    @ti.func
    def is_needed(self, now):
        """Whether velocities are projected after this substep, which has ended."""
        out = self.is_due(now)
        if ti.static(self.unequal):
            out = out or self.any_struck[None] != 0
        return out

    @ti.func
    def change_of(self, i, j, n, overlap, borne):
        """Return the change of the overlap of a pair with the normal n in this substep [m], or -1 if the pair parts.

        overlap: its overlap. borne: the one that its push takes back, both [m]. A pair parts if its overlap ends in a substep.
        Pairs that know their load have almost none, and part if they are restless. What was placed into another particle parts.
        """
        apart = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(n)
        parts = apart > ti.max(overlap, ti.static(RESTLESS) * borne)
        parts = parts or self.geometry.is_shrunk(i) or self.geometry.is_shrunk(j)
        return ti.select(parts, -1 + 0 * apart, ti.abs(apart))

    @ti.func
    def is_restless(self, i, change, borne):
        """Whether particle i is restless. change: the largest change of its overlaps. borne: the largest overlap that bears its
        load, both [m]. A change that is small beside the displacement may be the rounding of that."""
        return change > ti.max(ti.static(RESTLESS) * borne, ti.static(FAINT) * self.state.d[i].norm())

    @ti.func
    def is_heavier(self, i, j):
        """Whether particle i has a larger mass than j, and both can move."""
        w, other = self.state.w.of(i), self.state.w.of(j)
        return w > 0 and other > ti.static(UNEQUAL) * w

    @ti.func
    def begin_strike(self, i):
        """Begin a substep of particle i, before its pairs are noted."""
        self.strike[i] = ti.Vector.zero(self.state.real, 3)

    @ti.func
    def note_pair(self, i, j, n, overlap, borne):
        """Note for particle i what its pair with j, with the normal n, changes and bears in this substep, see change_of()."""
        self.strike[i][1] = ti.max(self.strike[i][1], borne)
        if borne > 0 and self.is_heavier(i, j):
            self.strike[i][0] = ti.max(self.strike[i][0], self.change_of(i, j, n, overlap, borne))
            self.strike[i][2] = ti.max(self.strike[i][2], self.state.w.of(j))

    @ti.func
    def note_struck(self, i):
        """Note if particle i is restless, and how far around it, once all of its pairs are noted."""
        change, borne, least = self.strike[i]
        reach = 0
        if self.is_restless(i, change, borne):
            reach = ti.cast(ti.min(ti.static(REACH) * ti.sqrt(least / self.state.w.of(i)), ti.static(RINGS)), ti.i32)
            self.any_struck[None] = 1
        self.struck[i] = reach

    @ti.func
    def bears(self, i, e):
        """Whether entry e in the list of particle i is a pair that bears a load."""
        out = self.push.field[e] > 0
        if ti.static(self.has_restitution):
            if self.restitution.weight[i] > 0:
                out = out and self.restitution.struck.field[e] == 0
        return out

    @ti.func
    def can_list(self, i):
        """Whether particle i can have loaded pairs of its own, to be listed."""
        return self.weight[i] > 0 and self.state.awake(i)

    @ti.func
    def list_loaded(self, i, every):
        """List the loaded pairs of particle i: all of them, or without those that part. Returns their number."""
        first, w = self.list.first[i], self.state.w.of(i)
        change, borne = ti.zero(w), ti.zero(w)
        at = first
        if self.can_list(i):
            for word in range(self.list.word_count(i)):
                # Not touches(): the pair may have parted in this pass, and both of its particles have to agree.
                bits = self.list.touching_bits(i, word)
                while bits != 0:
                    e = first + word * WORD + lowest_bit(bits)
                    bits &= bits - ti.u32(1)
                    if self.bears(i, e):
                        j = self.list.neighbour[e]
                        r = self.state.separation(i, j)
                        length, load = r.norm(), (w + self.state.w.of(j)) * self.push.field[e]
                        moved = -1 + 0 * w
                        if length > 0:
                            moved = self.change_of(i, j, r / length, self.geometry.contact_distance(i, j) - length, load)
                        if length > 0 and (every or moved >= 0):
                            change, borne = ti.max(change, moved), ti.max(borne, load)
                            self.list.old_neighbour[at] = j
                            at += 1
        self.change[i][0], self.change[i][1] = change, borne  # for find_restless()
        return at - first

    @ti.func
    def find(self, piece, begin, end, k, rounds, damps):
        """Do round k of finding what is projected, of particles begin ... end - 1, a piece.

        The first round finds the centers of what is projected. The next ones list the loaded pairs of one ring after the other
        around these, and split masses by the present normals. The last round finishes the lists.
        """
        if k == 0:
            for i in range(begin, end):
                self.number[i], self.ring[i] = 0, self.first_ring(i, damps)
        elif k == rounds - 1:
            self.finish_list(piece, begin, end)
            self.find_restless(piece, begin, end, damps == ALWAYS)
        else:
            for i in range(begin, end):
                if self.ring[i] == k - 1:
                    self.number[i] = self.list_loaded(i, damps == ALWAYS)
                    self.split_by_present_normals(i)
                    if k < rounds - 2:
                        self.spread(i, k)

    @ti.func
    def first_ring(self, i, damps):
        """Return the ring of particle i before others spread theirs: 0 for all particles, or for restless ones, else FAR.

        Particles without pairs of their own also have ring 0: a pair with one that cannot move is never left out.
        """
        ring = 0
        if damps != ALWAYS and self.can_list(i):
            ring = ti.select(damps == MAYBE and self.restless[i] != 0, 0, FAR)
            if ti.static(self.unequal):
                if ring == FAR and self.struck[i] != 0:
                    ring = ti.static(RINGS) - self.struck[i]
        return ring

    @ti.func
    def spread(self, i, ring):
        """Put what touches particle i into this ring, unless it is in one farther in."""
        for e in range(self.list.first[i], self.list.first[i] + self.number[i]):
            j = self.list.old_neighbour[e]
            if self.ring[j] == FAR or self.ring[j] > ring:
                self.ring[j] = ring  # whoever else does this writes the same

    @ti.func
    def split_by_present_normals(self, i):
        """Split the mass of particle i, which is projected, by the present normals if need be.

        A particle that has turned around another one since the start of the substep, as a small one does that is pressed into a
        large one, would have eigenvalues above 1 by the normals there, and the polynomial multiplies these.
        """
        normals = ti.Matrix.zero(self.state.real, self.state.dim, self.state.dim)
        for e in range(self.list.first[i], self.list.first[i] + self.number[i]):
            r = self.state.separation(i, self.list.old_neighbour[e])
            normals += r.outer_product(r) / r.dot(r)
        split = self.state.w.of(i) * largest(normals)
        if split > ti.static(1 + 1 / CONDITION) * self.weight[i]:  # up to there the polynomial is below 1
            self.weight[i] = split

    @ti.func
    def finish_list(self, piece, begin, end):
        """Leave out what is FAR, of particles begin ... end - 1, a piece: particles, and pairs with them. Store the factor of
        each other pair that all passes multiply by."""
        count = 0
        for i in range(begin, end):
            if self.number[i] > 0:
                first = self.list.first[i]
                at = first
                for e in range(first, first + self.number[i]):
                    j = self.list.old_neighbour[e]
                    if self.ring[j] != FAR:
                        r = self.state.separation(i, j)
                        shared = self.weight[i] + self.weight[j]
                        self.list.old_neighbour[at], self.push.old[at] = j, self.state.w.of(i) / (r.dot(r) * shared)
                        at += 1
                self.number[i] = at - first
                self.loaded[begin + count] = i
                count += 1
        self.count[piece] = count

    @ti.func
    def find_restless(self, piece, begin, end, every):
        """Note which particles are restless, of begin ... end - 1, a piece: of all of them, or of those that were projected.

        What rattles among particles that bear much more is not.
        """
        if every:
            for i in range(begin, end):
                self.restless[i] = 0
        for m in range(begin, begin + self.count[piece]):
            i = self.loaded[m]
            borne = self.change[i][1]
            for e in range(self.list.first[i], self.list.first[i] + self.number[i]):
                j = self.list.old_neighbour[e]
                if self.number[j] > 0:
                    borne = ti.max(borne, self.change[j][1])
            self.restless[i] = ti.cast(self.is_restless(i, self.change[i][0], borne), ti.i32)
        restless = 0
        for i in range(begin, end):
            restless += self.restless[i]
        self.restless_count[piece] = restless

    @ti.func
    def sum_up(self, pieces):
        """Note whether any particle is restless, and that what was struck is dealt with."""
        restless = 0
        for piece in range(pieces):
            restless += self.restless_count[piece]
        self.any_restless[None] = ti.cast(restless > 0, ti.i32)
        if ti.static(self.unequal):
            self.any_struck[None] = 0

    @ti.func
    def relax(self, i, k):
        """Compute pass k for particle i: change = (factor - 1) change + factor 2 / (1 + 1 / CONDITION) want."""
        want, first = 0 * self.state.d[i], self.list.first[i]
        for e in range(first, first + self.number[i]):
            j = self.list.old_neighbour[e]
            r = self.state.separation(i, j)
            want -= self.push.old[e] * self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(r) * r
        want = self.state.across_walls(i, want)
        factor = self.factors[k]
        want *= factor * ti.static(2 / (1 + 1 / CONDITION))
        if k > 0:
            want += (factor - 1) * self.change[i]
        self.change[i] = want

    @ti.func
    def apply(self, i):
        """Add the change of this pass to the displacement of particle i."""
        self.state.d[i] = self.state.d[i] + self.change[i]


def unequal(mass: np.ndarray) -> bool:
    """Whether any two of these masses, (n,) [kg], are unequal, of particles that can move."""
    some = mass[np.isfinite(mass)]
    return bool(len(some) and some.max() > UNEQUAL * some.min())
