"""The projection of velocities that removes sound, the elastic waves through loaded contacts."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..neighbours.neighbour_list import WORD, lowest_bit

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from ..neighbours.neighbour_list import NeighbourList, PairData

EVERY = 32  # substeps from one projection to the next
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

    push: pair data, the push of each pair in the last substep. weight: m_i w_i of each particle. restitution: the Restitution of
    the pairs, or None. change: a scratch field of vectors, (n,).
    """

    def __init__(
        self, scene: "Scene", pairs: "NeighbourList", push: "PairData", weight: Any, restitution: Any, change: Any, team: "Team"
    ):  # fmt: skip
        self.list, self.push, self.weight, self.restitution = pairs, push, weight, restitution
        self.state, self.change, self.has_restitution = scene.state, change, restitution is not None
        # The fields of the old list are free except while a list is built. Here they hold the loaded pairs of each particle, the
        # number of these pairs, and the particles that have any, piece by piece.
        self.number, self.loaded = self.list.old_number, self.list.old_first
        self.count = scene.memory.field("Contact.loaded", self._pieces(scene.particles.count, team), kind=ti.i32)
        self.factors = scene.memory.field("Contact.chebyshev", PASSES, values=chebyshev(PASSES, CONDITION))

    @staticmethod
    def _pieces(n: int, team: "Team") -> int:
        return -(-n // team.piece)

    def regroup(self, n: int, team: "Team") -> None:
        """Resize the field of pieces for n particles."""
        self.list.memory.resize(self.count, self._pieces(n, team))

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
        """List the loaded pairs of particle i, each with the factor that all passes multiply by. Returns their number."""
        first, w = self.list.first[i], self.state.w.of(i)
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
                        if rr > 0:
                            shared = self.weight[i] + self.weight[j]
                            self.list.old_neighbour[at] = j
                            self.push.old[at] = w / (rr * shared)
                            at += 1
        return at - first

    @ti.func
    def begin(self, piece, begin, end):
        """List the loaded pairs of particles begin ... end - 1, a piece. Positions do not change: one list serves all passes."""
        count = 0
        for i in range(begin, end):
            number = self.list_loaded(i)
            self.number[i] = number
            if number > 0:
                self.loaded[begin + count] = i
                count += 1
        self.count[piece] = count

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


def chebyshev(passes: int, condition: float) -> np.ndarray:
    """Return the factors of a Chebyshev semi-iteration for eigenvalues 1 / condition ... 1 (Golub and Varga 1961)."""
    rho = (condition - 1) / (condition + 1)
    out = [1.0, 2 / (2 - rho * rho)]
    while len(out) < passes:
        out.append(4 / (4 - rho * rho * out[-1]))
    return np.array(out[:passes])
