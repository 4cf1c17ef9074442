"""Which pairs touch, and how often their masses are split for it."""

from ..device import ti
from ..device.patches.compiler import FEW
from ..neighbours.neighbour_list import WORD, lowest
from .narrow_phase import Touch

FADE = 31 / 32  # of how much more often than needed a mass was split, what is left a pass later


class Splitting(Touch):
    """A particle has its mass split m times, so that all pairs which touch can be solved at once; see Contact."""

    @ti.func
    def touches(self, i, word):
        """Bits for the entries of particle i that the word is for: which touch, as in touch(), to the last digit."""
        out, begin = ti.u32(0), self.dev.grid.first[i] + word * WORD
        for k in range(ti.min(self.dev.grid.number[i] - word * WORD, WORD)):
            j = self.dev.grid.near[begin + k]
            r, far = self.dev.state.apart(i, j), self.far(i, j)
            out |= ti.cast(r.dot(r) < far * far, ti.u32) << ti.cast(k, ti.u32)  # no branch: it would be taken at random
        return out

    @ti.func
    def touching(self, i, word):
        """The same bits, of the first word as count() left them."""
        out = self.dev.grid.touching[i]
        if word > 0:
            out = self.touches(i, word)
        return out

    @ti.func
    def count(self, begin, end):
        """Which pairs of some particles touch, and how often their masses are split. Where none did, that none does is known in
        half the time; small worlds compile faster without it."""
        some = 1
        if ti.static(self.scene.particles.count >= FEW):
            some = 0
            for i in range(begin, end):
                some |= ti.cast(self.dev.split[i] > 0, ti.i32)
            if some == 0:
                for i in range(begin, end):
                    some |= self.meets(i)
        if ti.static(self.dev.skips):
            self.dev.some[begin // self.dev.block] = some
        if some != 0:
            for i in range(begin, end):
                self.tell(i)

    @ti.func
    def busy(self, begin):
        """0 if none of the particles that were counted together, from `begin` on, touches another, and nothing is to be done."""
        out = 1
        if ti.static(self.dev.skips):
            out = self.dev.some[begin // self.dev.block]
        return out

    @ti.func
    def meets(self, i):
        """1 if any pair of particle i touches, to the last digit: a difference is below 0 if and only if one is the lesser."""
        same = ti.static(self.dev.radius.uniform and not self.dev.eases)
        gap, begin = ti.cast(ti.math.inf, self.scene.real), self.dev.grid.first[i]
        for e in range(begin, begin + self.dev.grid.number[i]):
            j = self.dev.grid.near[e]
            r = self.dev.state.apart(i, j)
            rr = r.dot(r)
            if ti.static(not same):
                rr -= self.far(i, j) * self.far(i, j)
            gap = lesser(rr, gap)
        if ti.static(same):
            gap -= self.far(i, i) * self.far(i, i)
        return ti.cast(gap < 0, ti.i32)

    @ti.func
    def tell(self, i):
        """Which pairs of particle i touch, and how often its mass is split. What does not touch has no push to keep."""
        bits = self.touches(i, 0)
        pairs = ti.math.popcnt(bits)
        self.forget(i, 0, self.dev.grid.touching[i] & ~bits)
        self.dev.grid.touching[i] = bits
        for word in range(1, self.dev.grid.words(i)):
            bits = self.touches(i, word)
            pairs += ti.math.popcnt(bits)
            self.forget(i, word, self.dev.grid.whole(i, word) & ~bits)
        split = ti.cast(pairs, self.scene.real)
        if ti.static(not self.dev.rubs):
            if pairs > 2:
                tensor = ti.Matrix.zero(self.scene.real, self.dev.state.dim, self.dev.state.dim)
                deepest = ti.cast(1, self.scene.real)
                for word in range(self.dev.grid.words(i)):
                    bits = self.touching(i, word)
                    while bits != 0:
                        j = self.dev.grid.near[self.dev.grid.first[i] + word * WORD + lowest(bits)]
                        bits &= bits - ti.u32(1)
                        r, far = self.dev.state.apart(i, j), self.far(i, j)
                        scale = 1 / (far * far)
                        tensor += scale * r.outer_product(r)
                        deepest = lesser(r.dot(r) * scale, deepest)
                if deepest > 0.25:
                    split = lesser(largest(tensor) / deepest, split)
        split *= self.dev.state.w.of(i)
        rest = ti.static(FADE) * ti.max(self.dev.split[i] - split, 0)
        self.dev.split[i] = ti.select(pairs > 0, split + rest, split)

    @ti.func
    def forget(self, i, word, gone):
        """Some pairs do not touch any more."""
        while gone != 0:
            e = self.dev.grid.first[i] + word * WORD + lowest(gone)
            self.dev.push.field[e] = 0
            if ti.static(self.dev.bounces):
                self.dev.slack.field[e] = 0
            gone &= gone - ti.u32(1)


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
