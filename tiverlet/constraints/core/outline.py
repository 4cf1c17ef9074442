"""The passes over constraints of any number of corners: what a line or a surface encloses."""

from typing import Any

from ... import checks
from ...device import ti
from ...features.feature import FAR, Knob, Scene

PRESSURE = Knob(lambda f, v: checks.per_item(repr(f), "pressure", v, f.count, least=0.0), "Factor on the rest value.")


class Outline:
    """The passes of a Scalar on closed outlines of any size, in the loops of Corners; see Scalar for the law.

    f is a polynomial of degree dim in the corners and the same after a translation. So dim f = sum_e (x_e - x_0) . grad_e f
    (Euler), and outlines need no more than their gradients, which are slope(e, back) of their Quantity.
    batch: the Scalar.
    """

    def __init__(self, scene: Scene, batch: Any):
        name, add = repr(batch), scene.memory.field
        self.of, self.corners, self.slots, self.w = batch, batch.dev.corners, scene.slots, scene.state.w
        self.real, self.dim, self.limited = scene.real, scene.state.dim, batch.dev.limit.acts
        self.sums = add(f"{name}.sums", batch.blocks, width=8)
        self.start = add(f"{name}.gradient", batch.corner_count, width=self.dim)
        self.change = add(f"{name}.change", batch.count)
        self.astray = add(f"{name}.turned", batch.count, kind=ti.i32)

    @ti.func
    def slope(self, e, back):
        """grad_e f at x - back d."""
        return self.of.dev.quantity.slope(e, back)

    @ti.func
    def reduce_block(self, b):
        """Of a block: f and f0, w |grad|^2; mass-split along both, current, start; its squared size, and of what it moves."""
        begin, end, c = self.corners.block[b]
        i0 = self.corners.hub(c)
        sums = ti.Vector.zero(self.real, 8)
        for e in range(begin, end):
            i = self.corners.members[e]
            g, n = self.slope(e, 0), self.slope(e, 1)
            sums[0] += self.corners.arm(e, i0, 0).dot(g)
            sums[1] += self.corners.arm(e, i0, 1).dot(n)
            sums[2] += self.w.of(i) * g.dot(g)
            sums[3] += self.slots.split[i] * g.dot(n)
            sums[4] += self.slots.split[i] * g.dot(g)
            sums[5] += self.slots.split[i] * n.dot(n)
            sums[6] += self.corners.arm(e, i0, 0).norm_sqr()
            sums[7] += self.w.of(i) * self.w.of(i) * ti.max(g.dot(g), n.dot(n))
            self.start[e] = n
        self.sums[b] = sums

    @ti.func
    def total(self, c):
        """f, f0, the sum of w |grad|^2, the mass-split weight, how far it turned, and the last two sums."""
        sums = ti.Vector.zero(self.real, 8)
        for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
            sums += self.sums[b]
        turn = self.slots.turn(sums[3], ti.sqrt(sums[4] * sums[5]))
        W = sums[3]
        if turn == FAR:
            W = sums[4]
        return sums[0] / self.dim, sums[1] / self.dim, sums[2], W, turn, sums[6], sums[7]

    @ti.func
    def weight(self, c):
        """The sum of w |grad|^2."""
        w = ti.cast(0, self.real)
        for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
            w += self.sums[b][2]
        return w

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Find dlam."""
        f, f0, w, W, turn, extent, move = self.total(c)
        violation, A, alpha, lam, W = self.of.equation(c, f, f0, w, W, h, h2_effective, first, fresh)
        if ti.static(self.limited):
            violation -= A * self.of.postpone(c, f0, W, frame_fraction[1] - frame_fraction[0], first)
        new = self.of.jacobi_update(c, violation, A, alpha, lam, W, turn)
        new = self.of.dev.limit.limit_collapse(lam, new, self.of.dev.rest[c], extent, move)
        self.of.dev.lam[c], self.change[c], self.astray[c] = new, new - lam, turn == FAR

    @ti.func
    def scatter_corner(self, e):
        """Move each corner by w_j dlam grad_j C."""
        c = self.corners.owner[e]
        n = self.start[e]
        if self.astray[c] != 0:
            n = self.slope(e, 0)
        self.corners.give(e, self.w.of(self.corners.members[e]) * self.change[c] * n)

    @ti.func
    def push_spring_force(self, c, h):
        """As in Scalar; scatter_corner() pushes what is found here."""
        f, f0, w, W, turn, extent, move = self.total(c)
        self.change[c], self.astray[c] = h * h * self.of.spring_force(c, f, f0, w, h), 1

    @ti.func
    def push_reaction(self, c, pull):
        """Each corner by `pull`, along its gradient."""
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            self.corners.give(e, self.w.of(self.corners.members[e]) * pull * self.slope(e, 0))

    @ti.func
    def violation_left(self, c, h, h2_effective, fresh):
        """The violation that is left."""
        f, f0, w, W, turn, extent, move = self.total(c)
        violation, A, alpha, lam, W = self.of.equation(c, f, f0, w, W, h, h2_effective, 0, fresh)
        left = self.of.removed(c, violation, A, alpha, lam, W)
        if w == 0:  # collapsed, or static
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                if self.w.of(self.corners.members[e]) > 0 and self.of.dev.strength.holds(c):
                    left = ti.abs(f - self.of.dev.rest[c])
        return left

    @ti.func
    def value(self, c, back):
        """f at x - back d, by Euler's theorem."""
        f, i0 = ti.cast(0, self.real), self.corners.hub(c)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            f += self.corners.arm(e, i0, back).dot(self.slope(e, back))
        return f / self.dim
