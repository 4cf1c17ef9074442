"""Mass splitting: how often the mass of a particle is split, so that all of its contacts can be solved at once."""

from typing import Any

from ..device import ti
from ..device.thread_team import BLOCK, Team
from ..features.feature import Scene
from ..neighbours.neighbour_list import WORD, PairData, lowest_bit
from .eigenvalues import largest
from .narrow_phase import SAME_PLACE, DiscGeometry

# Least (|r| / contact distance)^2 for which all pairs count as being as deep as the deepest. This saves a division per pair. For
# deeper pairs it would split masses too often, and a compressed heap would stay compressed.
DEEP = 0.8
EVERY = 8  # substeps after which a bound is computed anew, because pairs slide
SLOW = 1 / 64  # radii per substep: a faster particle gets its bound anew in each; in 8 substeps a normal turns by 1/8 at most
FADE = 31 / 32  # share of the excess splitting that is left a pass later


class MassSplitting:
    """The split masses of discs or spheres: the mass of i is split m_i times, see Contact.

    weight: m_i w_i of each particle, 0 without contact.
    slid: pair data of friction, cleared unless the pair touches at the end of a substep.
    skips: whether blocks of particles without contact are skipped.
    ended: pair data that is cleared when the pair does not touch.
    known: the KnownLoads of pairs, or None. in_state: its fields that are part of the state.
    """

    def __init__(
        self, scene: Scene, geometry: DiscGeometry, slid: list[PairData], skips: bool, push: PairData, ended: list[PairData],
        team: Team, known: Any,
    ):  # fmt: skip
        self.known, self.has_loads = known, known is not None
        self.geometry, self.list, self.push, self.ended = geometry, geometry.list, push, ended
        self.slid, self.has_friction, self.skips = slid, bool(slid), skips
        self.state, self.real, self.few = scene.state, scene.real, scene.memory.compiler.few
        self.weight = scene.memory.field("Contact.split_mass", scene.count, state=True)
        self.in_state = {"weight": self.weight}
        if not slid:
            self.bound = scene.memory.field("Contact.bound", scene.count, state=True)
            self.in_state["bound"] = self.bound
        self.block = min(BLOCK, team.piece) if skips else BLOCK
        if skips:
            self.some = scene.memory.field("Contact.some_touch", self._blocks(scene.particles.count), kind=ti.i32)

    def _blocks(self, n: int) -> int:
        return -(-n // self.block)

    def can_regroup(self, piece: int) -> bool:
        """Whether the block size stays the same when a piece of the team has `piece` particles."""
        return not self.skips or self.block == min(BLOCK, piece)

    def regroup(self, n: int) -> None:
        """Resize the fields of blocks for n particles."""
        if self.skips:
            self.list.memory.resize(self.some, self._blocks(n))

    @ti.func
    def touches(self, i, word):
        """Return the bits of a word of the list of particle i: 1 for each entry that touches or has a known load.

        The comparison is bit for bit that of DiscGeometry.overlap(). The bits are pushed in from the last entry to the first: the
        compiler would vectorise a loop in the order of the list, with gathers that save nothing, and take longer for it.
        """
        out, begin = ti.u32(0), self.list.first[i] + word * WORD
        e = begin + ti.min(self.list.number[i] - word * WORD, WORD)
        while e > begin:
            e -= 1
            j = self.list.neighbour[e]
            r, contact_distance = self.state.separation(i, j), self.geometry.contact_distance(i, j)
            one = ti.cast(r.dot(r) < contact_distance * contact_distance, ti.u32)  # no branch: it would be mispredicted
            if ti.static(self.has_loads):
                one |= ti.cast(self.known.load.field[e] > 0, ti.u32)
            out = (out << ti.u32(1)) | one
        if ti.static(self.geometry.senses):
            left = out
            while left != 0:
                bit = left & (~left + ti.u32(1))
                left ^= bit
                if self.geometry.pushes(i, self.list.neighbour[begin + lowest_bit(bit)]) == 0:
                    out ^= bit
        return out

    @ti.func
    def touching(self, i, word):
        """Return the bits of touches(). Those of the first word are stored by count()."""
        out = self.list.touching[i]
        if word > 0:
            out = self.touches(i, word)
        return out

    @ti.func
    def count(self, begin, end, now):
        """Find the touching pairs of particles begin ... end - 1, and how often their masses are split.

        Fast path: a block without contact in the last pass is tested only for any contact. Small worlds leave this code out, to
        compile faster.
        """
        some = self.state.any_awake(begin, end)
        if ti.static(not self.few):
            if some != 0:
                some = 0
                for i in range(begin, end):
                    some |= ti.cast(self.weight[i] > 0, ti.i32)
                if some == 0:
                    for i in range(begin, end):
                        some |= self.any_contact(i)
        if ti.static(self.skips):
            self.some[begin // self.block] = some
        if some != 0:
            for i in range(begin, end):
                if self.state.awake(i):
                    self.split(i, now)

    @ti.func
    def busy(self, begin):
        """Return 0 if no particle in the block that begins at `begin` touches another, so relax() can be skipped."""
        out = 1
        if ti.static(self.skips):
            out = self.some[begin // self.block]
        return out

    @ti.func
    def any_contact(self, i):
        """Return 1 if any pair of particle i touches.

        The result is bit for bit that of touches(): a difference is below 0 if and only if the first number is less.
        """
        same = ti.static(self.geometry.radius.uniform and not self.geometry.shrinks)
        gap, begin = ti.cast(ti.math.inf, self.real), self.list.first[i]
        for e in range(begin, begin + self.list.number[i]):
            j = self.list.neighbour[e]
            r = self.state.separation(i, j)
            rr = r.dot(r)
            if ti.static(not same):
                rr -= self.geometry.contact_distance(i, j) * self.geometry.contact_distance(i, j)
            gap = lesser(rr, gap)
        if ti.static(same):
            gap -= self.geometry.contact_distance(i, i) * self.geometry.contact_distance(i, i)
        return ti.cast(gap < 0, ti.i32)

    @ti.func
    def split(self, i, now):
        """Find the touching pairs of particle i, and how often its mass is split. Clear the pushes of other pairs."""
        bits = self.touches(i, 0)
        pairs, others = ti.math.popcnt(bits), self.list.touching[i] != bits
        self.clear(i, 0, self.list.touching[i] & ~bits, now)
        self.list.touching[i] = bits
        for word in range(1, self.list.word_count(i)):
            bits = self.touches(i, word)
            pairs += ti.math.popcnt(bits)
            if ti.static(not self.has_friction):
                others = others or self.changes(i, word, bits)
            self.clear(i, word, self.list.all_bits(i, word) & ~bits, now)
        split = ti.cast(pairs, self.real)
        if ti.static(not self.has_friction):
            if pairs > 2:
                split = self.bound[i]
                if others or split == 0 or self.has_turning_normals(i) or (now.span.since + now.s + i) % EVERY == 0:
                    split = self.bound_of(i, ti.cast(pairs, self.real))
        split *= self.state.w.of(i)
        rest = ti.static(FADE) * ti.max(self.weight[i] - split, 0)
        self.weight[i] = ti.select(pairs > 0, split + rest, split)

    @ti.func
    def has_turning_normals(self, i):
        """Whether particle i moves so far in a substep that its normals turn, see SLOW."""
        d, slow = self.state.d[i], ti.static(SLOW) * self.geometry.radius.of(i)
        return d.dot(d) > slow * slow

    @ti.func
    def changes(self, i, word, bits):
        """Whether the touching entries of this word differ from those with a push. Bits of later words are not stored."""
        out, begin = False, self.list.first[i] + word * WORD
        for k in range(ti.min(self.list.number[i] - word * WORD, WORD)):
            touch = bits >> ti.cast(k, ti.u32) & ti.u32(1)
            out = out or (touch != 0) != (self.push.field[begin + k] != 0)
        return out

    @ti.func
    def bound_of(self, i, pairs):
        """Return and store m, a bound of the eigenvalues of S of particle i, see Contact; at most the number of pairs."""
        tensor = ti.Matrix.zero(self.real, self.state.dim, self.state.dim)
        deepest = ti.cast(1, self.real)
        for word in range(self.list.word_count(i)):
            bits = self.touching(i, word)
            while bits != 0:
                j = self.list.neighbour[self.list.entry(i, word, bits)]
                bits &= bits - ti.u32(1)
                r, contact_distance = self.state.separation(i, j), self.geometry.contact_distance(i, j)
                scale = 1 / (contact_distance * contact_distance)
                tensor += scale * r.outer_product(r)
                deepest = lesser(r.dot(r) * scale, deepest)
        if deepest <= ti.static(DEEP):
            tensor, deepest = self.normals(i), ti.cast(1, self.real)
        m = lesser(largest(tensor) / deepest, pairs)
        self.bound[i] = m
        return m

    @ti.func
    def invalidate_bound(self, i):
        """Invalidate the bound of particle i, which touches a particle without a push: a new list would not keep that bit."""
        if ti.static(not self.has_friction):
            self.bound[i] = 0

    @ti.func
    def normals(self, i):
        """Return S, the sum of n n^T over the touching pairs of particle i, and of the identity for pairs in the same place."""
        tensor = ti.Matrix.zero(self.real, self.state.dim, self.state.dim)
        for word in range(self.list.word_count(i)):
            bits = self.touching(i, word)
            while bits != 0:
                j = self.list.neighbour[self.list.entry(i, word, bits)]
                bits &= bits - ti.u32(1)
                r, contact_distance = self.state.separation(i, j), self.geometry.contact_distance(i, j)
                rr = r.dot(r)
                if rr > contact_distance * contact_distance * ti.static(SAME_PLACE):
                    tensor += r.outer_product(r) / rr
                else:
                    for k in ti.static(range(self.state.dim)):
                        tensor[k, k] += 1
        return tensor

    @ti.func
    def clear(self, i, word, gone, now):
        """Clear the data that pairs have only while they touch. gone: bits of entries of this word that do not touch."""
        while gone != 0:
            e = self.list.entry(i, word, gone)
            for piece in ti.static(self.ended):
                piece.field[e] = 0
            if now.span.iterations == 1:
                for piece in ti.static(self.slid):
                    piece.field[e] = 0
            gone &= gone - ti.u32(1)

    @ti.func
    def sliding(self, i, word, now):
        """Return the bits of the entries of particle i that may have slid in this substep.

        With one pass these are the touching pairs. With several passes a pair may touch in some of them only, so all entries
        count.
        """
        return ti.select(now.span.iterations == 1, self.list.touching_bits(i, word), self.list.all_bits(i, word))


def still_soft(h: float, longest: float, passes: int) -> float:
    """Return the substep [s] of the stiffness that contacts have after so many passes of substeps h, if they had that of
    substeps `longest` before: the excess of m has decayed."""
    return h * (1 + ((longest / h) ** 2 - 1) * FADE**passes) ** 0.5


@ti.func
def lesser(a, b):
    """Return the lesser of two numbers. ti.min would also test for NaN, which takes longer."""
    return ti.select(a < b, a, b)
