"""How often the mass of a particle is split, so that all contacts that it is in can be solved at once."""

from typing import Any

from ..device import ti
from ..device.thread_team import BLOCK, Team
from ..features.feature import Scene
from ..neighbours.neighbour_list import WORD, PairData, lowest_bit
from .narrow_phase import SAME_PLACE, DiscGeometry

# Of (|r| / contact distance)^2: down to here all pairs count as if they were as deep as the deepest, which spares a division for
# each. Deeper that would split masses too often, and a heap that is compressed would stay so.
DEEP = 0.8
EVERY = 8  # substeps after which a bound is worked out again, for pairs slide
SLOW = 1 / 64  # of its radius in a substep: what moves further has it worked out in each; in 8 a normal turns by 1/8 at most
FADE = 31 / 32  # of how much more often than needed a mass was split, what is left a pass later


class MassSplitting:
    """A disc or sphere i has its mass split m_i times, see Contact; `weight` is m_i w_i, 0 where it touches nothing.

    ended: what pairs carry only while they touch. slid: what those with friction carry only while they touch as a substep ends.
    skips: whether blocks of particles without contact are skipped. known: the KnownLoads of pairs, or None. in_state: its fields
    that are part of the state.
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
        """Whether blocks are what they were when so many particles make up a piece of the team."""
        return not self.skips or self.block == min(BLOCK, piece)

    def regroup(self, n: int) -> None:
        """There are n particles now."""
        if self.skips:
            self.list.memory.resize(self.some, self._blocks(n))

    @ti.func
    def touches(self, i, word):
        """Bits for the entries of particle i that the word is for: which touch, as in overlap(), to the last digit, or know a
        load."""
        out, begin = ti.u32(0), self.list.first[i] + word * WORD
        for k in range(ti.min(self.list.number[i] - word * WORD, WORD)):
            j = self.list.neighbour[begin + k]
            r, contact_distance = self.state.apart(i, j), self.geometry.contact_distance(i, j)
            one = ti.cast(r.dot(r) < contact_distance * contact_distance, ti.u32)  # no branch: it would be taken at random
            if ti.static(self.has_loads):
                one |= ti.cast(self.known.load.field[begin + k] > 0, ti.u32)
            out |= one << ti.cast(k, ti.u32)
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
        """The same bits, of the first word as count() left them."""
        out = self.list.touching[i]
        if word > 0:
            out = self.touches(i, word)
        return out

    @ti.func
    def count(self, begin, end, now):
        """Which pairs of some particles touch, and how often their masses are split.

        Fast path: a block without contact in the last pass is tested only for any contact. Small worlds compile faster without.
        """
        some = self.state.stirs(begin, end)
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
        """0 if none of the particles that were counted together, from `begin` on, touches another, and nothing is to be done."""
        out = 1
        if ti.static(self.skips):
            out = self.some[begin // self.block]
        return out

    @ti.func
    def any_contact(self, i):
        """1 if any pair of particle i touches, to the last digit: a difference is below 0 if and only if one is the lesser."""
        same = ti.static(self.geometry.radius.uniform and not self.geometry.shrinks)
        gap, begin = ti.cast(ti.math.inf, self.real), self.list.first[i]
        for e in range(begin, begin + self.list.number[i]):
            j = self.list.neighbour[e]
            r = self.state.apart(i, j)
            rr = r.dot(r)
            if ti.static(not same):
                rr -= self.geometry.contact_distance(i, j) * self.geometry.contact_distance(i, j)
            gap = lesser(rr, gap)
        if ti.static(same):
            gap -= self.geometry.contact_distance(i, i) * self.geometry.contact_distance(i, i)
        return ti.cast(gap < 0, ti.i32)

    @ti.func
    def split(self, i, now):
        """Which pairs of particle i touch, and how often its mass is split. What does not touch has no push to keep."""
        bits = self.touches(i, 0)
        pairs, others = ti.math.popcnt(bits), self.list.touching[i] != bits
        self.clear(i, 0, self.list.touching[i] & ~bits, now)
        self.list.touching[i] = bits
        for word in range(1, self.list.words(i)):
            bits = self.touches(i, word)
            pairs += ti.math.popcnt(bits)
            if ti.static(not self.has_friction):
                others = others or self.changes(i, word, bits)
            self.clear(i, word, self.list.all_bits(i, word) & ~bits, now)
        split = ti.cast(pairs, self.real)
        if ti.static(not self.has_friction):
            if pairs > 2:
                split = self.bound[i]
                if others or split == 0 or self.hurries(i) or (now.span.since + now.s + i) % EVERY == 0:
                    split = self.bound_of(i, ti.cast(pairs, self.real))
        split *= self.state.w.of(i)
        rest = ti.static(FADE) * ti.max(self.weight[i] - split, 0)
        self.weight[i] = ti.select(pairs > 0, split + rest, split)

    @ti.func
    def hurries(self, i):
        """Whether particle i moves so far in a substep that its normals turn."""
        d, slow = self.state.d[i], ti.static(SLOW) * self.geometry.radius.of(i)
        return d.dot(d) > slow * slow

    @ti.func
    def changes(self, i, word, bits):
        """Whether, of the entries of this word, others touch than those that got a push; bits of later words are kept nowhere."""
        out, begin = False, self.list.first[i] + word * WORD
        for k in range(ti.min(self.list.number[i] - word * WORD, WORD)):
            touch = bits >> ti.cast(k, ti.u32) & ti.u32(1)
            out = out or (touch != 0) != (self.push.field[begin + k] != 0)
        return out

    @ti.func
    def bound_of(self, i, pairs):
        """What bounds the eigenvalues of S of particle i, no more than there are pairs."""
        tensor = ti.Matrix.zero(self.real, self.state.dim, self.state.dim)
        deepest = ti.cast(1, self.real)
        for word in range(self.list.words(i)):
            bits = self.touching(i, word)
            while bits != 0:
                j = self.list.neighbour[self.list.entry(i, word, bits)]
                bits &= bits - ti.u32(1)
                r, contact_distance = self.state.apart(i, j), self.geometry.contact_distance(i, j)
                scale = 1 / (contact_distance * contact_distance)
                tensor += scale * r.outer_product(r)
                deepest = lesser(r.dot(r) * scale, deepest)
        if deepest <= ti.static(DEEP):
            tensor, deepest = self.normals(i), ti.cast(1, self.real)
        m = lesser(largest(tensor) / deepest, pairs)
        self.bound[i] = m
        return m

    @ti.func
    def doubt(self, i):
        """Have the bound of particle i worked out again: it touches a particle that gave it no push, which a new list would not
        remember."""
        if ti.static(not self.has_friction):
            self.bound[i] = 0

    @ti.func
    def normals(self, i):
        """S, the sum of n n^T over the pairs of particle i that touch, and of the identity for those in the same place."""
        tensor = ti.Matrix.zero(self.real, self.state.dim, self.state.dim)
        for word in range(self.list.words(i)):
            bits = self.touching(i, word)
            while bits != 0:
                j = self.list.neighbour[self.list.entry(i, word, bits)]
                bits &= bits - ti.u32(1)
                r, contact_distance = self.state.apart(i, j), self.geometry.contact_distance(i, j)
                rr = r.dot(r)
                if rr > contact_distance * contact_distance * ti.static(SAME_PLACE):
                    tensor += r.outer_product(r) / rr
                else:
                    for k in ti.static(range(self.state.dim)):
                        tensor[k, k] += 1
        return tensor

    @ti.func
    def clear(self, i, word, gone, now):
        """Take from pairs that do not touch any more what they carry only while they touch."""
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
        """Bits for the entries of particle i that may have slid, as a substep ends: those that touch. Where there are several
        passes a pair may touch in some and not in others, so it keeps what it carries to the end."""
        return ti.select(now.span.iterations == 1, self.list.touched(i, word), self.list.all_bits(i, word))


@ti.func
def lesser(a, b):
    """The lesser of two numbers; ti.min asks whether either is NaN, which takes longer."""
    return ti.select(a < b, a, b)


@ti.func
def largest(tensor):
    """The largest eigenvalue of a symmetric 2 x 2 matrix, and an upper bound for 3 x 3 ones (Wolkowicz and Styan 1980)."""
    n = ti.static(tensor.n)
    mean = tensor.trace() / n
    for k in ti.static(range(n)):
        tensor[k, k] -= mean
    return mean + ti.static(((n - 1) / n) ** 0.5) * tensor.norm()
