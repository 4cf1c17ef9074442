"""Chains, trees and loops by elimination: exact for any length, any mass ratio and any compliance."""

from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import runtime, ti
from ..device.number import OnDevice
from ..features.feature import Batch, Scene
from .corners import corners_of
from .elimination import Plan, plan
from .slots import TENSEST, Slots
from .solver import WIDTH, Solver
from .system import REDUNDANT, SLACK, System, solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar

CONTRADICTION = 1e-6  # of its violation: what others leave of such a constraint without contradicting it
SMALL_PIVOT = 2e-3  # of what the heaviest of its particles adds to it: with a pivot below, a load is hardly borne to first order
AGREEMENT = 0.25  # of the tension: how far the two ends of a substep may differ about it there
STABLE = 2.0  # (omega h)^2 that is allowed there: half the limit of stability
ROUNDS = 8  # of finding out which ropes pull, and how soft a system has to be

# A second step of Newton's method is taken where a particle moved by more than LONG (of a length, squared), unless a tension was
# above CALM, (omega h)^2: such vibrations are not resolved, and bring in energy, which what the first step leaves takes out.
LONG, CALM = 1e-5, 0.35
UNKNOWN, UNMET, ENDED = range(3)  # whether a system takes it: known by the moves of the first; yes; no, whatever these are

# (omega h)^2 to which a tension gives way with directions at the end of the substep. There the move is a step down the gradient
# of a convex energy, sum lam |r|; as long as this is at most 1, it brings in no more than lam times what the links shorten.
SOFTENED_TO = 1.0
LEAST_SOFTNESS = 2e-12  # of its diagonal: how much it gives way in any case, so that no pivot vanishes

# What a system is solved for: with directions at the start of the substep, in f32 first with violations to f32; with those at its
# end, to compare; then as before if they agree, else at the end as softly as it has to be.
ROUGH, FORWARD, AGAIN, COMPARE, GIVE_WAY, DONE = range(6)


class Direct(Solver):
    """Constraints that hang together like chains, trees or closed loops are solved as one linear system, by elimination.

    Each iteration is a step of Newton's method for all multipliers of a system, in the metric of SHAKE, with the gradients at the
    current positions and the directions at the start of the substep (Barth et al. 1995, Leimkuhler and Skeel 1994 for the same in
    f64). With iterations=1 a system takes a second one where the first was long:

        A_j sum_k (grad C_j(x) . w . grad C_k(x_n)) dlam_k + alpha'_j dlam_j = -(A_j C_j + B_j + alpha'_j lam_j)

    which is tridiagonal for a chain. The systems are found when the world is built: constraints that share a particle that can
    move are coupled, and are eliminated in order of least degree, the same order on every run; one thread for each system.

    width: a set of connected constraints becomes a system when no step of its elimination couples more than this many others;
    a chain has width 1, a closed loop 2, a joint of k rods k - 1. What is wider (cloth), and what is not one number, is relaxed
    as by Jacobi; a particle in both gives each of them a share of its mass. world.explain() says what went where.

    Ropes, spacers and limits take part: which of them act is found by switching off those whose multiplier has the wrong sign
    and on those that are violated, until nothing changes. A constraint that others imply (a double link) is left to them.
    The elimination is in f64 in every world, for its pivots span the mass ratio.

    A load that cannot be borne to first order (a straight rope between two pins) has no tension to speak of with directions at
    the start of the step: any number, which brings in energy. Such a system, and one with (omega h)^2 > 4 across a tension, is
    solved with directions at the end, and made softer until (omega h)^2 <= 1: it gives way and loses energy, and "softened" says
    so. It is known by a pivot that is a small part of its diagonal while both ends of the substep disagree about the tension.
    """

    converges = True

    def __init__(self, width: int = WIDTH):
        self.width = checks.integer("Direct", "width", width, least=0)

    def system(self, scene: Scene, batches: list[Batch], slots: Slots) -> "Elimination | None":
        """The systems of a scene on the device; None where there are none."""
        scalars = solvable(batches)
        if not scalars:
            return None
        slot = np.concatenate([slots.places(b).ravel() for b in scalars])
        owner, item = corners_of(scalars)
        alone = np.concatenate([b.relaxed_alone(scene) for b in scalars])
        free = (slot >= 0) & ~alone[owner]
        found = plan(len(alone), owner[free], item[free], self.width)
        return Elimination(scene, batches, slots, scalars, found, slot[free], item[free]) if found.parts else None

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

    host_only = ("plan",)
    parts: Any = OnDevice()
    entries: Any = OnDevice()

    def __init__(
        self, scene: Scene, batches: list[Batch], slots: Slots, scalars: "list[Scalar]", found: Plan, slot: np.ndarray,
        item: np.ndarray,
    ):  # fmt: skip
        super().__init__(scene, batches, slots, scalars, found.rows)
        self.plan, self.parts, self.entries = found, self.memory.number(found.parts), self.memory.number(len(found.column))
        product = found.product.copy()
        product[:, 1:] = slot[product[:, 1:]]
        side = np.repeat([b.side for b in scalars], [b.count for b in scalars])[found.rows]
        self.one_sided = bool(side.any())
        ints, reals = self.ints, self.reals
        self.part_begin, self.column, self.update = (ints(k, getattr(found, k)) for k in ("part_begin", "column", "update"))
        self.entry_begin, self.product_begin = ints("entry_begin", found.entry_begin), ints("product_begin", found.product_begin)
        self.update_begin, self.product = ints("update_begin", found.update_begin), ints("product", product, 3)
        self.gradient = scene.memory.field("system.gradient", slots.total, width=self.dim)
        self.value, self.diagonal = reals("value", self.rows + 2 * self.entries), reals("weight")
        who = np.zeros(slots.total, dtype=np.int64)
        who[slot] = item
        self.particle_of, self.w, self.inverse_size = ints("who", who), scene.state.w, reals("close")
        self.refines = scene.order == 2 and not self.limits_steps and not self.shares
        if self.refines:
            parts = np.repeat(np.arange(found.parts), np.diff(found.part_begin))
            self.part_of, self.newton = ints("part_of", parts), ints("newton", np.full(found.parts, UNKNOWN))
            near = np.zeros(len(scene.inv_mass))
            for b in scalars:
                inside = self.row(b) >= 0
                np.maximum.at(near, b.indices[inside], b.inverse_size(b.start.position)[inside, None])
            self.near = scene.memory.field("system.near", scene.count, values=near)
            self.any_unmet = scene.memory.field("system.any_unmet", None, kind=ti.i32)
        self.sleeps = bool(scene.state.sleepers)
        if self.sleeps:  # all of a system, or nothing
            self.lead = ints("lead", self.leads(scalars, slots)[found.part_begin[:-1]])
        parts = [scene.inv_mass[b.indices] * (b.gradients(b.start.position) ** 2).sum(axis=2) for b in scalars]
        least = np.concatenate([np.where(p > 0, p, np.inf).min(axis=1, initial=np.inf) for p in parts])[found.rows]
        small = np.where(np.isfinite(least), SMALL_PIVOT * least, 0.0)
        self.small_pivot = scene.memory.field("system.small", self.rows, kind=ti.f64, values=small)
        llvm = runtime.architecture() in runtime.LLVM  # which has all functions in f64
        exact = [b.quantity.precise and scene.real == ti.f32 and (llvm or not b.quantity.transcends) for b in scalars]
        self.precise = [(k, b) for k, b in enumerate(scalars) if exact[k]]
        if self.precise:
            batch = np.repeat(np.arange(len(scalars)), [b.count for b in scalars])[found.rows]
            number = np.concatenate([np.arange(b.count) for b in scalars])[found.rows]
            self.batch, self.number = ints("batch", batch), ints("number", number)
        if self.one_sided:
            self.side, self.active, self.remaining = ints("side", side), ints("active", 0 * side), reals("left")

    @ti.func
    def set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness):
        """What constraint r is about in this pass, but for what its corners tell. geometric_stiffness: see CornerPasses."""
        System.set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness)
        if W > 0:
            self.inverse_size[r] = geometric_stiffness / (2 * W)
        if ti.static(self.one_sided):
            acts = self.side[r] == 0 or self.side[r] * violation > 0 or lam != 0
            self.active[r] = ti.cast(acts and W > 0, ti.i32)

    @ti.func
    def set_gradient(self, place, i, gradient):
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
    def assemble(self, begin, end, softness, at_end):
        """The matrix, `softness` added to its diagonal, and the right side of the rows that act; others get the multiplier 0."""
        rows, entries = self.rows, self.entries
        for r in range(begin, end):
            self.value[r] = 0
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                self.value[rows + e] = 0
                self.value[rows + entries + e] = 0
        for r in range(begin, end):
            if self.acts(r):
                for q in range(self.product_begin[r], self.product_begin[r + 1]):
                    at = self.product[q]
                    self.value[at[0]] = self.value[at[0]] + self.scale[r] * self.coupling(at, at_end)
                self.value[r] = self.value[r] + (self.alpha[r] + softness)
                self.step[r] = -self.violation[r]
            else:
                self.value[r] = 1
                self.step[r] = -self.lam[r]
            self.diagonal[r] = self.value[r]

    @ti.func
    def coupling(self, at, at_end):
        """grad C_j . w . grad C_k of one particle. at_end: with the gradient at the end of the substep for both."""
        move = self.move[at[2]]
        if at_end != 0:
            move = self.move_at_end(at[2])
        out = ti.cast(0, ti.f64)
        for k in ti.static(range(self.dim)):
            out += ti.cast(self.gradient[at[1]][k], ti.f64) * ti.cast(move[k], ti.f64)
        return out

    @ti.func
    def move_at_end(self, s):
        """What a multiplier of 1 moves the corner of slot s along the gradient at the end of the substep."""
        i = self.particle_of[s]
        move = self.gradient[s] * self.w.of(i)
        if ti.static(self.shares):
            move /= self.share[i]
        return move

    @ti.func
    def use_end_directions(self, begin, end):
        """Rows move corners along their gradients at the end of the substep."""
        for r in range(begin, end):
            for q in range(self.product_begin[r], self.product_begin[r + 1]):
                s = self.product[q][1]
                if s == self.product[q][2]:
                    self.move[s] = self.move_at_end(s)

    @ti.func
    def eliminate(self, begin, end):
        """Each row from those that it is coupled to, then back. Returns 1 where a pivot was small, 2 for a contradiction.

        A constraint that others imply is left to them; it contradicts them where it is off by more than its digits.
        """
        hard, rows, entries = 0, self.rows, self.entries
        for r in range(begin, end):
            first, last, pivot, step = self.entry_begin[r], self.entry_begin[r + 1], self.value[r], self.step[r]
            if ti.abs(pivot) <= REDUNDANT * self.diagonal[r]:
                if (ti.abs(step) - CONTRADICTION * ti.abs(self.violation[r])) * self.inverse_size[r] > 8 * self.epsilon:
                    hard = 2
                self.value[r] = 1
                self.step[r] = 0
                for e in range(first, last):
                    self.value[rows + e] = 0
            else:
                if pivot <= self.small_pivot[r]:
                    hard = ti.max(hard, 1)
                u = self.update_begin[r]
                for e in range(first, last):
                    part, later = self.value[rows + entries + e] / pivot, self.column[e]
                    self.step[later] = self.step[later] - part * step
                    for k in range(first, last):
                        at = self.update[u]
                        self.value[at] = self.value[at] - part * self.value[rows + k]
                        u += 1
        for k in range(end - begin):
            r = end - 1 - k
            rest = self.step[r]
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                rest -= self.value[rows + e] * self.step[self.column[e]]
            self.step[r] = rest / self.value[r]
        return hard

    @ti.func
    def update_active_set(self, begin, end, at_end):
        """Rows off that would push where they can only pull, rows on that are violated; returns whether any changed."""
        for r in range(begin, end):
            self.remaining[r] = 0
        changed = 0
        for r in range(begin, end):
            for q in range(self.product_begin[r], self.product_begin[r + 1]):
                at = self.product[q]
                self.remaining[r] = self.remaining[r] + self.scale[r] * self.coupling(at, at_end) * self.step[self.row_of[at[2]]]
            if self.side[r] != 0 and self.scale[r] != 0:
                new = self.lam[r] + self.step[r]
                left = self.violation[r] + self.remaining[r] + self.alpha[r] * self.step[r]
                acts = ti.select(self.active[r] != 0, self.side[r] * new < 0, self.side[r] * left > 0)
                if acts != (self.active[r] != 0):
                    self.active[r] = 1 - self.active[r]
                    changed = 1
        return changed

    @ti.func
    def solve_active_set(self, begin, end, softness, at_end):
        """The step of every multiplier, of those that act. Returns what eliminate() does."""
        hard = 0
        if ti.static(self.one_sided):
            k = 0
            while k < ROUNDS:
                self.assemble(begin, end, softness, at_end)
                found = self.eliminate(begin, end)
                hard = ti.max(found, ti.select(hard == 2, 2, 0))  # one that contradicts gets no multiplier, and is switched off
                k = ti.select(self.update_active_set(begin, end, at_end) != 0, k + 1, ROUNDS)
            for r in range(begin, end):
                if self.side[r] * (self.lam[r] + self.step[r]) > 0:
                    self.step[r] = -self.lam[r]
        else:
            self.assemble(begin, end, softness, at_end)
            hard = self.eliminate(begin, end)
        return hard

    @ti.func
    def limit_steps(self, begin, end):
        """Whether steps go beyond where gradients are trusted and bring in energy, sum step (u + A step / 2) with A step =
        -violation.

        Then rows with a curved f take the step that they would take by themselves, and the others have to follow.
        """
        gain, spare, too_far, found = ti.cast(0, ti.f64), ti.cast(0, ti.f64), False, 0
        for r in range(begin, end):
            gain += self.step[r] * (self.motion[r] - self.violation[r] / 2)
            spare += self.spare_energy[r] + SLACK * ti.abs(self.step[r] * self.violation[r])
            too_far = too_far or (self.scale[r] != 0 and ti.abs(self.step[r]) > self.trusted_step[r])
        if too_far and gain > spare:
            for r in range(begin, end):
                if self.trusted_step[r] < ti.math.inf and self.scale[r] != 0:
                    self.scale[r], self.lam[r], self.geometric_stiffness[r], found = 0, self.own_step[r], 0, 1
                    if ti.static(self.one_sided):
                        self.active[r] = 0
        return found

    @ti.func
    def stretch(self, r):
        """The length of constraint r, relative to that at rest: a longer one vibrates less."""
        out = ti.cast(1, ti.f64)
        if self.scale[r] != 0:
            out += ti.max(self.violation[r], 0 * out) * self.inverse_size[r] / self.scale[r]
        return out

    @ti.func
    def tensions(self, begin, end, at_end):
        """(omega h)^2 of a transverse vibration under the multipliers found: the largest, and the sum; the stiffness behind it,
        and the largest diagonal."""
        worst, total = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        size, steps, most = ti.cast(0, ti.f64), ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for r in range(begin, end):
            step, geometric_stiffness = self.step[r], self.geometric_stiffness[r]
            if at_end != 0:
                geometric_stiffness /= self.stretch(r)
            worst = ti.max(worst, geometric_stiffness * ti.abs(self.lam[r] + step))
            total += geometric_stiffness * (self.lam[r] + step)
            size += ti.abs(self.violation[r])
            steps += ti.abs(step)
            most = ti.max(most, self.diagonal[r])
        return worst, total, ti.select(steps > 0, size / steps, 0 * size), most

    @ti.func
    def bears(self, begin, end):
        """(omega h)^2 under the multipliers of the passes before."""
        worst = ti.cast(0, ti.f64)
        for r in range(begin, end):
            worst = ti.max(worst, self.geometric_stiffness[r] * ti.abs(self.lam[r]))
        return worst

    @ti.func
    def stay(self, begin, end):
        """Make no step."""
        for r in range(begin, end):
            self.step[r] = 0

    @ti.func
    def refine_violations(self, begin, end):
        """In f32: violations to all the digits that positions have. Those of a taut rope are of second order in its slopes."""
        for r in range(begin, end):
            for k, b in ti.static(self.precise):
                if self.batch[r] == k and self.alpha[r] == 0 and self.scale[r] != 0:
                    self.violation[r] = b.dev.quantity.exactly(self.number[r])
                    if ti.static(b.dev.limit.acts):
                        self.violation[r] -= b.dev.limit.postponed[self.number[r]]

    @ti.func
    def limit_tensions(self, begin, end):
        """Limit each multiplier to the largest tension that the substep can stand."""
        for r in range(begin, end):
            if self.geometric_stiffness[r] > 0:
                most = SOFTENED_TO * self.stretch(r) / self.geometric_stiffness[r]
                self.step[r] = ti.max(-most, ti.min(most, self.lam[r] + self.step[r])) - self.lam[r]

    @ti.func
    def takes_step(self, b, newton):
        """Whether system b takes this step of Newton's method in a pass."""
        out = True
        if ti.static(self.refines):
            if newton == 0:
                self.newton[b] = UNKNOWN
                self.any_unmet[None] = 0  # all write the same
            out = newton == 0 or self.newton[b] == UNMET
        return out

    @ti.func
    def end_newton(self, b):
        """System b takes no other step of Newton's method in this pass."""
        if ti.static(self.refines):
            self.newton[b] = ENDED

    @ti.func
    def is_unmet(self, r):
        """Whether the system of row r takes another step of Newton's method."""
        return self.newton[self.part_of[r]] == UNMET

    @ti.func
    def note_move(self, i, begin, end, move):
        """Note where particle i moved so far that rigid constraints of its system are left unmet: a length l by |u|^2 / (2 l),
        where its ends moved across it by u, relative to each other."""
        if (self.near[i] * move).norm_sqr() > LONG:
            for s in range(begin, end):
                r = self.row_of[s]
                b = self.part_of[r]
                if self.alpha[r] == 0 and self.newton[b] == UNKNOWN:
                    self.newton[b] = UNMET
                    self.any_unmet[None] = 1

    @ti.func
    def solve(self, b):
        """System b: the step of every multiplier in it.

        A tension makes particles vibrate across. Where the substep is too long for that, or no tension is right, see Direct, the
        system is solved with directions at the end of the substep, and gives way until its tension is small enough: one over the
        tension grows linearly with the softness, where one load cannot be borne. Where an earlier pass found more tension than
        that, to give way now would be to take most of it back, along other directions: the system stays where it is.
        """
        begin, end = self.part_begin[b], self.part_begin[b + 1]
        if ti.static(self.sleeps):
            if not self.state.awake(self.lead[b]):
                end = begin
        zero = ti.cast(0, ti.f64)
        softness, least, inverse, tension_at_start, total_at_start = zero, zero, zero, zero, zero
        stage, k, bound = FORWARD, 0, True
        if ti.static(len(self.precise) > 0):
            stage = ROUGH
        while stage != DONE:
            hard = self.solve_active_set(begin, end, softness, ti.cast(stage >= COMPARE, ti.i32))
            tension, total, stiffness, most = self.tensions(begin, end, ti.cast(stage >= COMPARE, ti.i32))
            if ti.static(self.limits_steps):
                if stage <= FORWARD and self.limit_steps(begin, end) != 0:
                    continue
            if stage <= AGAIN:
                if (hard == 0 and tension <= TENSEST) or stage == AGAIN:
                    ti.atomic_max(self.tension[None], tension)
                    stage = DONE
                    if tension > CALM:
                        self.end_newton(b)
                elif stage == ROUGH:
                    self.refine_violations(begin, end)
                    stage = FORWARD
                elif hard == 2:
                    ti.atomic_max(self.tension[None], ti.cast(TENSEST, ti.f64))
                    softness, stage = LEAST_SOFTNESS * most, GIVE_WAY
                    self.end_newton(b)
                else:
                    tension_at_start, total_at_start, bound, stage = tension, total, hard == 0, COMPARE
            elif stage == COMPARE:
                same = ti.abs(tension - tension_at_start) <= AGREEMENT * tension
                same = same and ti.abs(total - total_at_start) <= AGREEMENT * ti.abs(total)
                if same and tension <= STABLE:
                    stage = AGAIN
                else:
                    # What more substeps do not help has the figure of what is just unstable.
                    ti.atomic_max(self.tension[None], ti.select(bound, tension_at_start, ti.min(tension, TENSEST)))
                    softness, stage = LEAST_SOFTNESS * most, GIVE_WAY
                    self.end_newton(b)
                    if self.bears(begin, end) > SOFTENED_TO:
                        self.stay(begin, end)
                        stage = DONE
            else:
                k += 1
                if k == ROUNDS or (tension <= SOFTENED_TO and (k == 1 or k > 3 or tension > 0.8 * SOFTENED_TO)):
                    self.use_end_directions(begin, end)
                    self.limit_tensions(begin, end)
                    stage = DONE
                else:
                    new = softness + stiffness * (tension / SOFTENED_TO - 1)
                    if k > 1 and 1 / tension > inverse:
                        new = least + (softness - least) * (1.1 / SOFTENED_TO - inverse) / (1 / tension - inverse)
                    if tension > SOFTENED_TO:
                        least, inverse = softness, 1 / tension
                        new = ti.max(new, 1.1 * softness)
                    softness = new
