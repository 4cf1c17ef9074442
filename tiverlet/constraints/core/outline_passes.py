"""The passes over constraints on one number, of any number of corners each: areas in lines and volumes in surfaces."""

from typing import Any

import numpy as np

from ...device import ti
from ...features.feature import FAR, Knob, Scene
from ...features.items import Items
from .equation import Equation
from .passes import Passes

GOAL = property(lambda f: f.pressure * f.rest, doc="The target values of f, pressure * rest, (m,).")
PRESSURE = Knob(Items("pressure", least=0.0), "Factor on the rest value.")


class OutlinePasses(Passes):
    """The passes of a Scalar on closed outlines of any size, in the loops of VariableCorners; see Equation for the law.

    f is a polynomial of degree dim in the corners and does not change in a translation. So dim f = sum_e (x_e - x_0) . grad_e f
    (Euler), and outlines need only their gradients, which are slope(e, back) of their Quantity.
    """

    needs_reduce_block = True

    def __init__(self, scene: Scene, batch: Any, start: np.ndarray):
        self.name = name = repr(batch)
        m, add = batch.count, scene.memory.field
        self.slots, self.w, self.real, self.dim = scene.slots, scene.state.w, scene.real, scene.state.dim
        self.corners = batch.members.bind(scene, batch)
        self.equation = Equation(scene, batch, self.corners, start)
        self.spring, self.strength, self.limit = self.equation.spring, self.equation.strength, self.equation.limit
        self.quantity, self.drive = self.equation.quantity, self.equation.drive
        self.sums = add(f"{name}.sums", self.corners.block_count, width=8)
        self.start = add(f"{name}.gradient", self.corners.total, width=self.dim)
        self.change = add(f"{name}.change", m)
        self.use_current_gradient = add(f"{name}.turned", m, kind=ti.i32)

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """Sum f, f0, w |grad|^2; mass-split along both, current, start; squared size; squared move by a multiplier of 1."""
        begin, end, c = self.corners.block[b]
        i0 = self.corners.reference_particle(c)
        sums = ti.Vector.zero(self.real, 8)
        for e in range(begin, end):
            i = self.corners.members[e]
            g, n = self.quantity.slope(e, 0), self.quantity.slope(e, 1)
            sums[0] += self.corners.relative_position(e, i0, 0).dot(g)
            sums[1] += self.corners.relative_position(e, i0, 1).dot(n)
            sums[2] += self.w[i] * g.dot(g)
            sums[3] += self.slots.split[i] * g.dot(n)
            sums[4] += self.slots.split[i] * g.dot(g)
            sums[5] += self.slots.split[i] * n.dot(n)
            sums[6] += self.corners.relative_position(e, i0, 0).norm_sqr()
            sums[7] += self.w[i] * self.w[i] * ti.max(g.dot(g), n.dot(n))
            self.start[e] = n
        self.sums[b] = sums

    @ti.func
    def sum_blocks(self, c):
        """Return f, f0, the sum of w |grad|^2, the mass-split weight, how far it turned, and the last two sums."""
        sums = ti.Vector.zero(self.real, 8)
        for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
            sums += self.sums[b]
        turn = self.slots.classify_turn(sums[3], ti.sqrt(sums[4]) * ti.sqrt(sums[5]))
        W = sums[3]
        if turn == FAR:
            W = sums[4]
        return sums[0] / self.dim, sums[1] / self.dim, sums[2], W, turn, sums[6], sums[7]

    @ti.func
    def linearise(self, c, h, h2_effective, share, fresh):
        """Return A C + B + alpha' lam, A, alpha', lam and W where the solver has left constraint c. share: of the frame."""
        i0 = self.corners.reference_particle(c)
        f, f0, w, W = ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            i, g, n = self.corners.members[e], self.quantity.slope(e, 0), self.start[e]
            f += self.corners.relative_position(e, i0, 0).dot(g) / self.dim
            f0 += self.corners.relative_position(e, i0, 1).dot(n) / self.dim
            w += self.w[i] * g.dot(g)
            W += self.slots.split[i] * g.dot(g if self.use_current_gradient[c] != 0 else n)
        violation, A, alpha, lam, W = self.equation.terms(c, f, f0, w, W, h, h2_effective, 0, fresh)
        if ti.static(self.limit.acts):
            violation -= A * self.equation.postpone(c, f0, W, share, 0)
        return violation, A, alpha, lam, W

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Compute dlam; scatter_corner() moves the corners."""
        if ti.static(self.equation.ramp.is_allocated):
            if first != 0:
                self.equation.ramp.update_rest(c, frame_fraction)
        f, f0, w, W, turn, extent, move = self.sum_blocks(c)
        if ti.static(self.equation.answers):
            if first != 0:
                self.equation.remember(c, f0)
        violation, A, alpha, lam, W = self.equation.terms(c, f, f0, w, W, h, h2_effective, first, fresh)
        if ti.static(self.limit.acts):
            violation -= A * self.equation.postpone(c, f0, W, frame_fraction[2], first)
        new = self.equation.jacobi_update(c, violation, A, alpha, lam, W, turn)
        new = self.limit.limit_collapse(lam, new, self.equation.rest[c], extent, move)
        self.equation.lam[c], self.change[c], self.use_current_gradient[c] = new, new - lam, turn == FAR

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """Move corner e by w_j dlam grad_j C."""
        c = self.corners.owner[e]
        n = self.start[e]
        if self.use_current_gradient[c] != 0:
            n = self.quantity.slope(e, 0)
        self.corners.write_move(e, self.w[self.corners.members[e]] * self.change[c] * n)

    @ti.func
    def push_spring_force(self, c, h, soft, alone):
        """Compute h^2 F as in CornerPasses; scatter_corner() pushes it."""
        f, f0, w, W, turn, extent, move = self.sum_blocks(c)
        self.change[c], self.use_current_gradient[c] = h * h * self.equation.spring_force(c, f, f0, w, W, h, soft), 1

    @ti.func
    def push_reaction(self, c, h, firm, soft):
        """Push h^2 w_j F grad_j C, as in CornerPasses."""
        f, w, W, i0 = ti.cast(0, self.real), ti.cast(0, self.real), ti.cast(0, self.real), self.corners.reference_particle(c)
        if ti.static(self.spring.soft):
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                i, g = self.corners.members[e], self.quantity.slope(e, 0)
                f += self.corners.relative_position(e, i0, 0).dot(g) / self.dim
                w += self.w[i] * g.dot(g)
                W += self.slots.split[i] * g.dot(g)
        pull = self.equation.reaction(c, f, w, W, h, firm, soft)
        for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
            self.corners.write_move(e, self.w[self.corners.members[e]] * pull * self.quantity.slope(e, 0))

    @ti.func
    def overload(self, c, h2_rigid, h2_effective):
        """Return by how much the multiplier of constraint c, or the sum over many substeps, is too large, see Strength."""
        out = 0 * h2_rigid
        if self.strength.is_intact(c):
            per_newton = self.equation.spring.multiplier_per_newton(c, self.weight(c), h2_rigid, h2_effective)
            past = self.strength.add_excess(c, c, self.equation.lam[c], per_newton)
            unsure, i0 = 0 * per_newton, self.corners.reference_particle(c)
            if past > 0:
                for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                    g = self.quantity.slope(e, 0).norm()
                    if g > 0:
                        unsure = ti.max(unsure, self.strength.rounding(c, self.corners.members[e], i0) / g)
                if past > unsure:
                    out = self.strength.overload_by(c, past, per_newton)
        return out

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """Return the violation that is left, as in CornerPasses."""
        f, f0, w, W, turn, extent, move = self.sum_blocks(c)
        left = self.equation.left_violation(c, f, w, W, h, h2_effective, fresh)
        if w == 0:  # collapsed, or static
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                if self.w[self.corners.members[e]] > 0 and self.strength.is_intact(c):
                    left = ti.abs(f - self.equation.rest[c])
        return left / self.equation.residual_scale(c)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Return the energy of the constraint's spring, with f by Euler's theorem."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.spring.soft):
            if self.equation.stores_energy(c):
                f, i0 = ti.cast(0, self.real), self.corners.reference_particle(c)
                for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                    f += self.corners.relative_position(e, i0, back).dot(self.quantity.slope(e, back))
                out = self.equation.energy(c, f / self.dim, self.weight(c), h2_effective, residual)
        return out

    @ti.func
    def weight(self, c):
        """Return sum_j w_j |grad_j f|^2 of a spring, as summed up in the last pass."""
        w = ti.cast(0, self.real)
        if ti.static(self.spring.soft):
            for b in range(self.corners.blocks[c], self.corners.blocks[c + 1]):
                w += self.sums[b][2]
        return w
