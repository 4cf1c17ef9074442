"""Chains, trees and loops by elimination: exact for any length, any mass ratio and any compliance."""

import numpy as np
import taichi as ti

from .. import checks
from ..feature import Batch, Scene
from ..scalar import TENSEST, Scalar
from .elimination import Plan, plan
from .slots import Slots
from .solver import WIDTH, Solver
from .system import System

REDUNDANT = 1e-12  # of its diagonal: a pivot this small belongs to a constraint that others imply
ROUNDS = 8  # of finding out which ropes pull, and how soft a system has to be


class Direct(Solver):
    """Constraints that hang together like chains, trees or closed loops are solved as one linear system, by elimination.

    Each iteration is a Newton step of all multipliers of a system, in the metric of SHAKE, with the gradients at the current
    positions and the directions at the start of the step (Barth et al. 1995, Leimkuhler and Skeel 1994 for the same in f64):

        A_j sum_k (grad C_j(x) . w . grad C_k(x_n)) dlam_k + alpha'_j dlam_j = -(A_j C_j + B_j + alpha'_j lam_j)

    which is tridiagonal for a chain. The systems are found when the world is built: constraints that share a particle that can
    move are coupled, and are eliminated in order of least degree, the same order on every run; one thread for each system.

    width: a set of connected constraints becomes a system when no step of its elimination couples more than this many others;
    a chain has width 1, a closed loop 2, a joint of k rods k - 1. What is wider (cloth), and what is not one number, is relaxed
    as by Jacobi; a particle in both gives each of them a share of its mass. world.explain() says what went where.

    Ropes, spacers and limits take part: which of them act is found by switching off those whose multiplier has the wrong sign
    and on those that are violated, until nothing changes. A constraint that others imply (a double link) is left to them.
    The elimination is in f64 in every world, for its pivots span the mass ratio.
    """

    converges = True

    def __init__(self, width: int = WIDTH):
        self.width = checks.integer("Direct", "width", width, least=0)

    def system(self, scene: Scene, batches: list[Batch], slots: Slots) -> "Elimination | None":
        """The systems of a scene on the device; None where there are none."""
        scalars = [b for b in batches if isinstance(b, Scalar) and b.joins]
        if not scalars:
            return None
        slot = np.concatenate([slots.places(b).ravel() for b in scalars])
        item = np.concatenate([b.indices.ravel() for b in scalars])
        arity = np.repeat([b.arity for b in scalars], [b.count for b in scalars])
        owner = np.repeat(np.arange(len(arity)), arity)
        free = (slot >= 0) & ~np.concatenate([b.sprung(scene) for b in scalars])[owner]
        found = plan(len(arity), owner[free], item[free], self.width)
        return Elimination(scene, batches, slots, scalars, found, slot[free]) if found.parts else None

    def explain(self, batches: list[Batch], slots: Slots) -> str:
        """What is solved how."""
        system = slots.system
        if not system:
            return f"{self!r}: no system; all are relaxed as by Jacobi (wider than {self.width}, or not one number)"
        alone = system.left_out(batches)
        parts = f"{system.rows} constraints by elimination (systems: {system.parts}, width: {max(system.plan.widths)})"
        alone = f"; {alone} relaxed as by Jacobi (wider than {self.width}, or not one number)" if alone else ""
        return f"{self!r}: {parts}{alone}"

    def __repr__(self) -> str:
        return "Direct()" if self.width == WIDTH else f"Direct(width={self.width})"


class Elimination(System):
    """The systems of one world on the device. Row r is a constraint, at its place in the elimination."""

    def __init__(self, scene: Scene, batches: list[Batch], slots: Slots, scalars: list[Scalar], found: Plan, slot: np.ndarray):
        super().__init__(scene, batches, slots, scalars, found.rows)
        self.plan, self.parts, self.entries = found, found.parts, len(found.column)
        product = found.product.copy()
        product[:, 1:] = slot[product[:, 1:]]
        side = np.repeat([b.side for b in scalars], [b.count for b in scalars])[found.rows]
        self.one_sided = bool(side.any())
        ints, reals = self.ints, self.reals
        self.part_begin, self.column, self.update = (ints(k, getattr(found, k)) for k in ("part_begin", "column", "update"))
        self.entry_begin, self.product_begin = ints("entry_begin", found.entry_begin), ints("product_begin", found.product_begin)
        self.update_begin, self.product = ints("update_begin", found.update_begin), ints("product", product, 3)
        self.gradient = scene.memory.field("system.gradient", slots.total, width=self.dim)
        self.value, self.weight = reals("value", self.rows + 2 * self.entries), reals("weight")
        if self.one_sided:
            self.side, self.active, self.left = ints("side", side), ints("active", 0 * side), reals("left")

    @ti.func
    def tell(self, r, violation, A, alpha, lam, W, lever):
        """What constraint r is about in this pass, but for what its corners tell. lever: see Scalar."""
        System.tell(self, r, violation, A, alpha, lam, W, lever)
        if ti.static(self.one_sided):
            acts = self.side[r] == 0 or self.side[r] * violation > 0 or lam != 0
            self.active[r] = ti.cast(acts and W > 0, ti.i32)

    @ti.func
    def lean(self, place, i, gradient):
        """The gradient at one corner, whose slot is `place` and particle i."""
        if place >= 0:
            if ti.static(self.shares):
                gradient *= self.share[i]
            self.gradient[place] = gradient

    @ti.func
    def acts(self, r):
        """Whether row r takes part."""
        out = self.scale[r] != 0
        if ti.static(self.one_sided):
            out = self.active[r] != 0
        return out

    @ti.func
    def assemble(self, begin, end, soft):
        """The matrix, with `soft` added to its diagonal, and the right side of the rows that act; others get the multiplier 0."""
        for r in range(begin, end):
            self.value[r] = 0
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                self.value[self.rows + e] = 0
                self.value[self.rows + self.entries + e] = 0
        for r in range(begin, end):
            if self.acts(r):
                for q in range(self.product_begin[r], self.product_begin[r + 1]):
                    at = self.product[q]
                    self.value[at[0]] = self.value[at[0]] + self.scale[r] * self.coupling(at)
                self.value[r] = self.value[r] + (self.alpha[r] + soft)
                self.step[r] = -self.violation[r]
            else:
                self.value[r] = 1
                self.step[r] = -self.lam[r]
            self.weight[r] = self.value[r]

    @ti.func
    def coupling(self, at):
        """grad C_j . w . grad C_k of one particle."""
        out = ti.cast(0, ti.f64)
        for k in ti.static(range(self.dim)):
            out += ti.cast(self.gradient[at[1]][k], ti.f64) * ti.cast(self.move[at[2]][k], ti.f64)
        return out

    @ti.func
    def eliminate(self, begin, end):
        """Each row from those that it is coupled to, then back."""
        for r in range(begin, end):
            first, last, pivot, step = self.entry_begin[r], self.entry_begin[r + 1], self.value[r], self.step[r]
            if ti.abs(pivot) <= REDUNDANT * self.weight[r]:
                self.value[r] = 1
                self.step[r] = 0
                for e in range(first, last):
                    self.value[self.rows + e] = 0
            else:
                u = self.update_begin[r]
                for e in range(first, last):
                    part, later = self.value[self.rows + self.entries + e] / pivot, self.column[e]
                    self.step[later] = self.step[later] - part * step
                    for k in range(first, last):
                        at = self.update[u]
                        self.value[at] = self.value[at] - part * self.value[self.rows + k]
                        u += 1
        for k in range(end - begin):
            r = end - 1 - k
            rest = self.step[r]
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                rest -= self.value[self.rows + e] * self.step[self.column[e]]
            self.step[r] = rest / self.value[r]

    @ti.func
    def switch(self, begin, end):
        """Rows off that would push where they can only pull, rows on that are violated; returns whether any changed."""
        for r in range(begin, end):
            self.left[r] = 0
        changed = 0
        for r in range(begin, end):
            for q in range(self.product_begin[r], self.product_begin[r + 1]):
                at = self.product[q]
                self.left[r] = self.left[r] + self.scale[r] * self.coupling(at) * self.step[self.row_of[at[2]]]
            if self.side[r] != 0 and self.scale[r] != 0:
                new = self.lam[r] + self.step[r]
                left = self.violation[r] + self.left[r] + self.alpha[r] * self.step[r]
                acts = ti.select(self.active[r] != 0, self.side[r] * new < 0, self.side[r] * left > 0)
                if acts != (self.active[r] != 0):
                    self.active[r] = 1 - self.active[r]
                    changed = 1
        return changed

    @ti.func
    def find(self, begin, end, soft):
        """The step of every multiplier, of those that act."""
        if ti.static(self.one_sided):
            k = 0
            while k < ROUNDS:
                self.assemble(begin, end, soft)
                self.eliminate(begin, end)
                k = ti.select(self.switch(begin, end) != 0, k + 1, ROUNDS)
            for r in range(begin, end):
                if self.side[r] * (self.lam[r] + self.step[r]) > 0:
                    self.step[r] = -self.lam[r]
        else:
            self.assemble(begin, end, soft)
            self.eliminate(begin, end)

    @ti.func
    def tensest(self, begin, end):
        """The largest (omega h)^2 of a transverse vibration under the multipliers found, and the stiffness behind it."""
        worst, size, steps = ti.cast(0, ti.f64), ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for r in range(begin, end):
            step = self.step[r]
            worst = ti.max(worst, self.lever[r] * ti.abs(self.lam[r] + step))
            size += ti.abs(self.violation[r])
            steps += ti.abs(step)
        return worst, ti.select(steps > 0, size / steps, 0 * size)

    @ti.func
    def solve(self, b):
        """System b: the step of every multiplier in it.

        A tension makes particles vibrate across. Where the substep is too long for that, the system gives way until it is not.
        """
        begin, end = self.part_begin[b], self.part_begin[b + 1]
        soft, k = ti.cast(0, ti.f64), 0
        while k < ROUNDS:
            self.find(begin, end, soft)
            tension, stiffness = self.tensest(begin, end)
            if k == 0:
                ti.atomic_max(self.tension[None], tension)
            soft = ti.max(2 * soft, soft + stiffness * (tension / TENSEST - 1))
            k = ti.select(tension > TENSEST, k + 1, ROUNDS)
