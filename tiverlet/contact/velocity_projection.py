"""The projection of velocities that removes sound, the elastic waves through loaded contacts."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import inline, ti
from ..neighbours.neighbour_list import WORD, lowest_bit

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import PairData

EVERY = 32  # substeps from one projection to the next, in a quiet pile
OFTEN = 8  # the same, in a restless pile
NEVER, MAYBE, ALWAYS = range(3)  # whether a substep ends with a projection, see due()
RESTLESS = 0.25  # change of an overlap in a substep, in overlaps that bear the load of the particle: more of it is restless
FAINT = 2.0**-10  # the same, in displacements of the particle: less may be rounding
SHARE = 64  # loaded particles to a restless one, at most, in a restless pile
UNEQUAL = 1.5  # ratio of the masses of a pair from which it is projected at once
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
    pairs changes, in a substep, by more than a quarter of the largest overlap that bears its load. Where one loaded particle in
    SHARE is restless, the next projection comes after OFTEN substeps. A heavy particle, M, on a light one, m, that cannot give
    way is held as by a spring that turns it round in about sqrt(M / m) substeps. So in a substep in which such a pair is restless
    there is a projection at once. Pairs that part are left out: what is thrown off a pile is free to go.

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
        self.count, self.restless_count = (add(f"Contact.{name}", pieces, kind=ti.i32) for name in ("loaded", "restless"))
        self.factors = add("Contact.chebyshev", PASSES, values=chebyshev(PASSES, CONDITION))
        self.restless = add("Contact.is_restless", None, kind=ti.i32, state=True)  # whether the pile was, when last projected
        self.struck = add("Contact.struck", None, kind=ti.i32)  # whether a pair of unequal masses is restless in this substep
        self.unequal = unequal(scene.particles.mass)

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
            out = self.restless[None] != 0
        return out

    @ti.func
    def is_needed(self, now):
        """Whether velocities are projected after this substep, which has ended."""
        out = self.is_due(now)
        if ti.static(self.unequal):
            out = out or self.struck[None] != 0
        return out

    @ti.func
    def change_of(self, i, j, n, overlap, borne):
        """Return the change of the overlap of a pair with the normal n in this substep [m], or -1 if the pair parts.

        overlap: its overlap. borne: the one that its push takes back, both [m]. A pair parts if its overlap ends in a substep.
        Pairs that know their load have almost none, and part if they are restless.
        """
        apart = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(n)
        return ti.select(apart > ti.max(overlap, ti.static(RESTLESS) * borne), -1 + 0 * apart, ti.abs(apart))

    @ti.func
    def is_restless(self, i, change, borne):
        """Whether particle i is restless. change: the largest change of its overlaps. borne: the largest overlap that bears its
        load, both [m]. A change that is small beside the displacement may be the rounding of that."""
        return change > ti.max(ti.static(RESTLESS) * borne, ti.static(FAINT) * self.state.d[i].norm())

    @ti.func
    def are_unequal(self, i, j):
        """Whether the masses of two particles are unequal; not if one of them cannot move."""
        w, other = self.state.w.of(i), self.state.w.of(j)
        low, high = ti.min(w, other), ti.max(w, other)
        return low > 0 and high > ti.static(UNEQUAL) * low

    @ti.func
    def note_struck(self, i, change, borne):
        """Note if particle i is restless. change: that of overlaps in pairs of unequal masses, see is_restless()."""
        if self.is_restless(i, change, borne):
            self.struck[None] = 1

    @ti.func
    def bears(self, i, e):
        """Whether entry e in the list of particle i is a pair that bears a load."""
        out = self.push.field[e] > 0
        if ti.static(self.has_restitution):
            if self.restitution.weight[i] > 0:
                out = out and self.restitution.struck.field[e] == 0
        return out

    @ti.func
    def list_loaded(self, i):
        """List the loaded pairs of particle i, each with the factor that all passes multiply by.

        Returns their number, and whether the particle is restless.
        """
        first, w = self.list.first[i], self.state.w.of(i)
        change, borne = ti.zero(w), ti.zero(w)
        at = first
        if self.weight[i] > 0 and self.state.awake(i):
            for word in range(self.list.word_count(i)):
                # Not touches(): the pair may have parted in this pass, and both of its particles have to agree.
                bits = self.list.touching_bits(i, word)
                while bits != 0:
                    e = first + word * WORD + lowest_bit(bits)
                    bits &= bits - ti.u32(1)
                    if self.bears(i, e):
                        j = self.list.neighbour[e]
                        r = self.state.separation(i, j)
                        rr = r.dot(r)
                        length, load = ti.sqrt(rr), (w + self.state.w.of(j)) * self.push.field[e]
                        moved = -1 + 0 * w
                        if rr > 0:
                            moved = self.change_of(i, j, r / length, self.geometry.contact_distance(i, j) - length, load)
                        if moved >= 0:
                            shared = self.weight[i] + self.weight[j]
                            change, borne = ti.max(change, moved), ti.max(borne, load)
                            self.list.old_neighbour[at] = j
                            self.push.old[at] = w / (rr * shared)
                            at += 1
        return at - first, self.is_restless(i, change, borne)

    @ti.func
    def begin(self, piece, begin, end):
        """List the loaded pairs of particles begin ... end - 1, a piece. Positions do not change: one list serves all passes."""
        count, restless = 0, 0
        for i in range(begin, end):
            number, is_restless = self.list_loaded(i)
            self.number[i] = number
            if number > 0:
                restless += ti.cast(is_restless, ti.i32)
                self.loaded[begin + count] = i
                count += 1
        self.count[piece], self.restless_count[piece] = count, restless

    @ti.func
    def sum_up(self, pieces):
        """Note whether the pile is restless, and that what was struck is dealt with."""
        count, restless = 0, 0
        for piece in range(pieces):
            count += self.count[piece]
            restless += self.restless_count[piece]
        self.restless[None], self.struck[None] = ti.cast(restless * SHARE > count, ti.i32), 0

    @ti.func
    def relax(self, i, k):
        """Compute pass k for particle i: change = (factor - 1) change + factor 2 / (1 + 1 / CONDITION) want."""
        want, first = 0 * self.state.d[i], self.list.first[i]
        for e in range(first, first + self.number[i]):
            j = self.list.old_neighbour[e]
            r = self.state.separation(i, j)
            want -= self.push.old[e] * self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(r) * r
        if ti.static(self.state.keeps_wall_push):
            wall_push = self.state.wall_push[i]
            size = wall_push.dot(wall_push)
            if size > 0:
                want -= want.dot(wall_push) / size * wall_push
        factor = self.factors[k]
        want *= factor * ti.static(2 / (1 + 1 / CONDITION))
        if k > 0:
            want += (factor - 1) * self.change[i]
        self.change[i] = want

    @ti.func
    def apply(self, i):
        """Add the change of this pass to the displacement of particle i."""
        self.state.d[i] = self.state.d[i] + self.change[i]


@inline
def due(k):
    """Return whether velocities are projected after substep k after a start: NEVER, MAYBE (if the pile is restless) or ALWAYS."""
    return k % OFTEN // (OFTEN - 1) * (k >= EVERY) + k % EVERY // (EVERY - 1)


def unequal(mass: np.ndarray) -> bool:
    """Whether any two of these masses, (n,) [kg], are unequal."""
    return bool(len(mass) and mass.max() > UNEQUAL * mass.min())


def chebyshev(passes: int, condition: float) -> np.ndarray:
    """Return the factors of a Chebyshev semi-iteration for eigenvalues 1 / condition ... 1 (Golub and Varga 1961)."""
    rho = (condition - 1) / (condition + 1)
    out = [1.0, 2 / (2 - rho * rho)]
    while len(out) < passes:
        out.append(4 / (4 - rho * rho * out[-1]))
    return np.array(out[:passes])
