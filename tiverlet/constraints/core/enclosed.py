"""What a line or a surface encloses: areas and volumes, of simplices and of closed outlines of any size."""

from typing import Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import FAR, Knob, Scene
from ...particles import Particles
from .scalar import Scalar


class Enclosed(Scalar):
    """Constraints C(x) = f(x) - pressure rest on what simplices, or closed outlines of any size, enclose; see Scalar for the law.

    It holds its function, which has

        members         FixedSize or VariableSize: the particles of each constraint
        listing         what the user gave, for those that are left; pairs(): neighbours, which may overlap
        values(members, x)  f at NumPy positions, (m,)
        reversed(mask)  the function with these constraints turned inside out
        remapped(mask, number)  the function of what stays, by the new numbers of the particles
        measure(q)      of simplices: f and its gradients at corners q
        slopes(x)       of outlines: grad_e f at NumPy positions, of each corner, (total, dim)
        bind(scene, corners)  of outlines: an object with slope(e, back) = grad_e f of corner e

    f is a polynomial of degree dim in the corners and the same after a translation. So dim f = sum_e (x_e - x_0) . grad_e f
    (Euler), and outlines need no more than their gradients.
    """

    function: Any
    each = (*Scalar.each, "pressure")
    pressure = Knob(lambda f, v: checks.per_item(repr(f), "pressure", v, f.count, least=0.0), "Factor on the rest value.")

    def __repr__(self) -> str:
        return type(self).__name__

    def function_of(self, indices) -> Any:
        """The function on these particles, as the user gives them."""
        raise NotImplementedError

    def keep_indices(self, indices) -> None:
        """Keep the particles of each constraint."""
        self.function = self.function_of(indices)
        self.members = self.function.members
        self.arity = getattr(self.members, "arity", 0)
        if self.arity:
            self._warn_duplicates()

    @property
    def reweighs(self) -> bool:
        """Outlines do."""
        return self.arity == 0

    @property
    def goal(self) -> np.ndarray:
        """pressure rest."""
        return self.pressure * self.rest

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """f at the given positions."""
        return self.function.values(self.members, position)

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """grad f at the given positions: of simplices (m, arity, dim), of outlines (total, dim)."""
        return self.function.gradients(position) if self.arity == 0 else super().gradients(position)

    def inverse_size(self, position: np.ndarray) -> np.ndarray:
        """What makes C a share of the size of its constraint, (m,); 0 for what has collapsed."""
        if self.arity or not self.count:
            return super().inverse_size(position) if self.count else np.zeros(0)
        x, starts, owner = position[self.indices], self.members.starts, self.owner
        size = np.maximum.reduceat(np.linalg.norm(x - x[starts[owner]], axis=1), starts[:-1])
        size *= np.sqrt(np.bincount(owner, (self.gradients(position) ** 2).sum(axis=1), minlength=self.count) / 2)
        return np.divide(1, size, out=np.zeros(self.count), where=size > 0)

    @property
    def listing(self) -> Any:
        """As the user gives them."""
        return self.function.listing

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep these constraints, by the new numbers of their particles."""
        function = self.function.remapped(some, number)
        self._keep(function=function, members=function.members)

    def reverse(self, which: np.ndarray) -> None:
        """Turn these inside out."""
        function = self.function.reversed(which)
        self._keep(function=function, members=function.members)

    def excluded_pairs(self, particles: Particles) -> np.ndarray:
        """Neighbours along an outline may overlap, and all corners of a simplex."""
        return self.function.pairs()

    def bind(self, scene: Scene) -> None:
        """What Scalar needs, and of outlines the sums of each block."""
        super().bind(scene)
        if self.arity == 0:
            name, dim, add = repr(self), scene.state.dim, scene.memory.field
            self.dev.sums = add(f"{name}.sums", self.blocks, width=8)
            self.dev.start = add(f"{name}.gradient", self.corner_count, width=dim)
            self.dev.change = add(f"{name}.change", self.count)
            self.dev.astray = add(f"{name}.turned", self.count, kind=ti.i32)
            self.dev.outline = self.function.bind(scene, self.dev.corners)

    @ti.func
    def reach(self, c, q):
        """The size of a simplex."""
        return q.norm()

    @ti.func
    def measure(self, c, q):
        """See the function."""
        return self.function.measure(q)

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """Of a block: f and f0, w |grad|^2; mass-split along both, current, start; its squared size, and of what it moves."""
        begin, end, c = self.dev.corners.block[b]
        i0 = self.dev.corners.hub(c)
        sums = ti.Vector.zero(self.dev.real, 8)
        for e in range(begin, end):
            i = self.dev.corners.members[e]
            g, n = self.dev.outline.slope(e, 0), self.dev.outline.slope(e, 1)
            sums[0] += self.dev.corners.arm(e, i0, 0).dot(g)
            sums[1] += self.dev.corners.arm(e, i0, 1).dot(n)
            sums[2] += self.dev.w.of(i) * g.dot(g)
            sums[3] += self.dev.slots.split[i] * g.dot(n)
            sums[4] += self.dev.slots.split[i] * g.dot(g)
            sums[5] += self.dev.slots.split[i] * n.dot(n)
            sums[6] += self.dev.corners.arm(e, i0, 0).norm_sqr()
            sums[7] += self.dev.w.of(i) * self.dev.w.of(i) * ti.max(g.dot(g), n.dot(n))
            self.dev.start[e] = n
        self.dev.sums[b] = sums

    @ti.func
    def total(self, c):
        """f, f0, the sum of w |grad|^2, the mass-split weight, how far it turned, and the last two sums."""
        sums = ti.Vector.zero(self.dev.real, 8)
        for b in range(self.dev.corners.blocks[c], self.dev.corners.blocks[c + 1]):
            sums += self.dev.sums[b]
        turn = self.dev.slots.turn(sums[3], ti.sqrt(sums[4] * sums[5]))
        W = sums[3]
        if turn == FAR:
            W = sums[4]
        return sums[0] / self.dev.state.dim, sums[1] / self.dev.state.dim, sums[2], W, turn, sums[6], sums[7]

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Find dlam."""
        if ti.static(self.arity > 0):
            Scalar.relax(self, c, h, h2_effective, frame_fraction, first, fresh)
        else:
            f, f0, w, W, turn, extent, move = self.total(c)
            violation, A, alpha, lam, W = self.equation(c, f, f0, w, W, h, h2_effective, first, fresh)
            if ti.static(self.dev.limited):
                violation -= A * self.postpone(c, f0, W, frame_fraction[1] - frame_fraction[0], first)
            new, left = self.jacobi_update(c, violation, A, alpha, lam, W, turn)
            new = self.limit_collapse(c, lam, new, extent, move)
            self.dev.lam[c], self.dev.change[c], self.dev.astray[c] = new, new - lam, turn == FAR

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """Move each corner by w_j dlam grad_j C."""
        c = self.dev.corners.owner[e]
        n = self.dev.start[e]
        if self.dev.astray[c] != 0:
            n = self.dev.outline.slope(e, 0)
        self.dev.corners.give(e, self.dev.w.of(self.dev.corners.members[e]) * self.dev.change[c] * n)

    @ti.func
    def push_spring_force(self, c, h):
        """As in Scalar; of outlines, scatter_corner() pushes what is found here."""
        if ti.static(self.arity > 0):
            Scalar.push_spring_force(self, c, h)
        else:
            f, f0, w, W, turn, extent, move = self.total(c)
            self.dev.change[c], self.dev.astray[c] = h * h * self.spring_force(c, f, f0, w, h), 1

    @ti.func
    def push_reaction(self, c, firm, soft):
        """As in Scalar."""
        if ti.static(self.arity > 0):
            Scalar.push_reaction(self, c, firm, soft)
        else:
            pull = self.dev.lam[c] * ti.select(self.dev.spring.is_rigid(c), firm, soft)
            for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                self.dev.corners.give(e, self.dev.w.of(self.dev.corners.members[e]) * pull * self.dev.outline.slope(e, 0))

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """The violation that is left, relative to the rest value."""
        if ti.static(self.arity > 0):
            return Scalar.residual_of(self, c, h, h2_effective, frame_fraction, fresh)
        else:
            f, f0, w, W, turn, extent, move = self.total(c)
            violation, A, alpha, lam, W = self.equation(c, f, f0, w, W, h, h2_effective, 0, fresh)
            new, left = self.jacobi_update(c, violation, A, alpha, lam, W, turn)
            if w == 0:  # collapsed, or static
                for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                    if self.dev.w.of(self.dev.corners.members[e]) > 0 and self.dev.strength.holds(c):
                        left = ti.abs(f - self.dev.rest[c])
            return left / self.residual_scale(c)

    @ti.func
    def value(self, c, back):
        """f at x - back d, by Euler's theorem."""
        if ti.static(self.arity > 0):
            return Scalar.value(self, c, back)
        else:
            f, i0 = ti.cast(0, self.dev.real), self.dev.corners.hub(c)
            for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                f += self.dev.corners.arm(e, i0, back).dot(self.dev.outline.slope(e, back))
            return f / self.dev.state.dim
