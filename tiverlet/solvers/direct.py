"""Elimination of chains, trees and loops: exact for any length, mass ratio and compliance."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import at, called, inline, runtime, ti
from ..device.number import OnDevice
from ..features.feature import Batch, Scene
from .corners import corners_of
from .elimination import Plan, plan
from .joined import Joined, couples, joined_clusters
from .redundancy import implied_links
from .slots import SLIGHT, TENSEST, Slots
from .solver import WIDTH, Solver
from .system import REDUNDANT, SLACK, System, solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar

CONTRADICTION = 1e-6  # of its violation: a redundant constraint with a smaller residual does not contradict the others
SMALL_PIVOT = 2e-3  # of the contribution of its heaviest particle: below, a load is hardly borne to first order
AGREEMENT = 0.25  # of the tension: how far solutions with directions at the two ends of the substep may differ there
STABLE = 2.0  # (omega h)^2 that is allowed there: half the limit of stability
PATIENCE = 3  # rounds of an active set that may leave as many rows misplaced as one before, until they move one by one

# A system takes a second Newton step if a particle moved by more than the square root of LONG_MOVE, in lengths, unless a tension
# was above CALM_TENSION, (omega h)^2. Such vibrations are not resolved and gain energy; the error of the first step removes it.
LONG_MOVE, CALM_TENSION = 1e-5, 0.35
UNKNOWN, UNMET, ENDED = range(3)  # whether a system takes it: decided by the moves of the first step; yes; no

# (omega h)^2 at which rows yield. A pull then is a step down the gradient of a convex energy, sum lam |r|, see let_yield().
YIELD = 1.0
LEAST_SOFTNESS, SOFTER = 1e-9, 100.0  # of the largest diagonal, but no less than rounding; and the factor of a next try
GONE = 0.1  # of its violations: what may be left of them a substep after they seem to have been removed
SOFTENED = "system.softened"  # a field, by its name in recordings

# Stages of solve(). ROUGH: directions at the start of the substep, violations in f32. FORWARD: the same directions, accurate
# violations. COMPARE: directions at the end. AGAIN: as FORWARD, once both agree. GIVE_WAY: rows yield.
ROUGH, FORWARD, AGAIN, COMPARE, GIVE_WAY, DONE = range(6)


class Direct(Solver):
    """Solves connected constraints (chains, trees, closed loops) as one linear system, by elimination.

    Each iteration is a Newton step for all multipliers of a system, in the metric of SHAKE, with the gradients at the current
    positions and the directions at the start of the substep (Barth et al. 1995, Leimkuhler and Skeel 1994 for the same in f64):

        A_j sum_k (grad C_j(x) . w . grad C_k(x_n)) dlam_k + alpha'_j dlam_j = -(A_j C_j + B_j + alpha'_j lam_j)

    The matrix is tridiagonal for a chain. With iterations=1 a system takes a second step where the first was long. Systems are
    found when the world is built. Constraints that share a movable particle are coupled. They are eliminated in order of least
    degree, the same order on every run, with one thread for each system.

    width: a set of connected constraints becomes a system when no step of its elimination couples more than this many others.
    A chain has width 1, a closed loop 2, a joint of k rods k - 1. Rigid clusters that only such constraints join take part as
    bodies. Wider sets (cloth), and all else, are relaxed as by Jacobi. A particle in both gives each a share of its mass.
    world.explain() says which constraints are solved in which way.

    Ropes, spacers, limits and winches of limited force take part by an active set: those whose multiplier is beyond a bound are
    held there, and those that need another one are let go, until nothing changes. A constraint that others imply gets no
    multiplier: a double link, or the second diagonal of a square, whose other links hold it (implied_links()). Elimination is in
    f64 in every world, because its pivots span the mass ratio.

    A load that cannot be borne to first order (a straight rope between two pins) leaves the tension undetermined with directions
    at the start of the substep. In such a system links yield at (omega h)^2 = 1, with directions at the end where they pull; so
    they do in one with a transverse (omega h)^2 > 4. It gives way, with the flag "softened", see tiverlet/solvers/README.md.
    """

    converges = True

    def __init__(self, width: int = WIDTH):
        self.width = checks.integer("Direct", "width", width, least=0)

    def system(self, scene: Scene, batches: list[Batch], slots: Slots) -> "Elimination | None":
        """Return the systems of a scene on the device; None where there are none."""
        scalars = solvable(batches)
        if not scalars:
            return None
        slot = np.concatenate([slots.places(b).ravel() for b in scalars])
        owner, item = corners_of(scalars)
        implied = implied_links(scalars, scene)
        alone = np.concatenate([b.relaxed_alone(scene, bounded=True) for b in scalars])
        body = joined_clusters(batches, alone, scene, slots.answers)
        free = (slot >= 0) & ~(alone | implied)[owner]
        found = plan(len(alone), owner[free], couples(body, item[free]), self.width)
        if not found.parts:
            return None
        return Elimination(scene, batches, slots, scalars, found, slot[free], implied, body)

    def explain(self, batches: list[Batch], slots: Slots) -> str:
        """Return how many constraints are solved by elimination, and how many relaxed alone."""
        system = slots.system
        if not system:
            return f"{self!r}: no system; all are relaxed as by Jacobi (wider than {self.width}, or not one number)"
        alone = system.count_relaxed_alone(batches)
        parts = f"{system.solved} constraints by elimination (systems: {system.parts}, width: {max(system.plan.widths)})"
        implied = system.rows - system.solved
        implied = f"; {implied} that these imply" if implied else ""
        implied += f"; {system.bodies} clusters as bodies" if system.bodies else ""
        alone = f"; {alone} relaxed as by Jacobi (wider than {self.width}, or not one number)" if alone else ""
        return f"{self!r}: {parts}{implied}{alone}"

    def __repr__(self) -> str:
        return "Direct()" if self.width == WIDTH else f"Direct(width={self.width})"


class Elimination(System):
    """The systems of one world on the device. Rows are constraints in the order of elimination.

    solved: the number of rows that are solved. Behind them come those of links that others imply: they take no step. bodies: the
    number of clusters that take part.
    """

    host_only = ("plan", "late", "has_implied", "bodies", "_part")
    late = (SOFTENED,)
    parts: Any = OnDevice()  # number of systems
    entries: Any = OnDevice()  # number of couplings of two rows
    solved: Any = OnDevice()

    def __init__(
        self, scene: Scene, batches: list[Batch], slots: Slots, scalars: "list[Scalar]", found: Plan, slot: np.ndarray,
        implied: np.ndarray, body: np.ndarray,
    ):  # fmt: skip
        rows, self._part = _with_implied(found, scalars, scene, implied)
        super().__init__(scene, batches, slots, scalars, rows, body)
        row, corner, particle = self.corners(scalars, slots)
        self.plan, self.parts, self.entries = found, self.memory.number(found.parts), self.memory.number(len(found.column))
        self.solved, self.has_implied = self.memory.number(len(found.rows)), len(rows) > len(found.rows)
        # Of each part that gave way in the last substep: (h' / h)^2 for the substep h' whose yield loads it has, below 0 where it
        # seems to have borne its load, until its violations are seen to be gone; the sum of these; and the energy that they store
        # with the multipliers found, times h^2. Else 0.
        self.softened = scene.memory.field(SOFTENED, found.parts, width=3, kind=ti.f64, state=True)
        product = found.product.copy()
        product[:, 1:] = slot[product[:, 1:]]
        side = np.repeat([b.side for b in scalars], [b.count for b in scalars])[rows]
        bounded = [np.isfinite(b.course()[2]) if b.driven else np.zeros(b.count, dtype=bool) for b in scalars]
        self.bounds = bool(((side != 0) | np.concatenate(bounded)[rows]).any())
        ints, reals = self.ints, self.reals
        self.part_begin, self.column, self.update = (ints(k, getattr(found, k)) for k in ("part_begin", "column", "update"))
        self.entry_begin, self.product_begin = ints("entry_begin", found.entry_begin), ints("product_begin", found.product_begin)
        self.update_begin, self.product = ints("update_begin", found.update_begin), ints("product", product, 3)
        self.gradient = scene.memory.field("system.gradient", slots.total, width=self.dim)
        self.value, self.diagonal = reals("value", self.solved + 2 * self.entries), reals("weight")
        bodies = [b for b in batches if b.clusters and (self.row(b) >= 0).any()]
        self.bodies = sum(int((self.row(b) >= 0).sum()) for b in bodies)
        self.joined: Any = Joined(scene, self, bodies, slots, self._part, corner, particle, found.parts) if bodies else None
        self.answers = slots.answers
        if self.joined or self.answers:
            self.corner_begin = ints("corner_begin", np.searchsorted(row, np.arange(len(rows) + 1)))
            self.corner = ints("corner", corner)
        if self.joined:
            self.shift = reals("shift")
        if self.answers:
            self.slots = slots
            self.answer, self.change, self.solution, self.gap = (reals(k) for k in ("answer", "change", "solution", "gap"))
            # What is no reason for an impulse, and places remove; and the other violations at the start of the substep.
            self.left, self.at_start = reals("left_by_places"), reals("at_start")
            self.bends_far = ints("bends_far", np.zeros(found.parts))  # whether impulses of contacts turn a part far
            self.added, self.turned_to = reals("added", found.parts), reals("turned_to", found.parts)
        who = np.zeros(slots.total, dtype=np.int64)
        who[corner] = particle
        self.particle_of, self.w = ints("who", who), scene.state.w
        self.inverse_size = reals("close", values=np.concatenate([b.inverse_size(b.start.position) for b in scalars])[rows])
        self.refines = scene.order == 2 and not (self.limits_steps or self.has_shared_particles)
        self.part_of = ints("part_of", self._part)
        near = np.zeros(len(scene.inv_mass))
        for b in scalars:
            inside = self.row(b) >= 0
            np.maximum.at(near, b.indices[inside], b.inverse_size(b.start.position)[inside, None])
        near[body >= 0] = 0  # which turn as a whole
        self.particle_inverse_size = scene.memory.field("system.near", scene.count, values=near)
        if self.refines:
            self.newton = ints("newton", np.full(found.parts, UNKNOWN))
            self.any_unmet = scene.memory.field("system.any_unmet", None, kind=ti.i32)
        self.sleeps = bool(scene.state.sleepers)
        if self.sleeps:  # all particles of a system sleep, or none
            self.representative = ints("lead", particle[np.searchsorted(row, found.part_begin[:-1], side="right") - 1])
        w = self.joined.lightest(scene.inv_mass) if self.joined else scene.inv_mass
        parts = [w[b.indices] * (b.gradients(b.start.position) ** 2).sum(axis=2) for b in scalars]
        least = np.concatenate([np.where(p > 0, p, np.inf).min(axis=1, initial=np.inf) for p in parts])[rows]
        self.small_pivot = reals("small", values=np.where(np.isfinite(least), SMALL_PIVOT * least, 0.0))
        llvm = runtime.architecture() in runtime.LLVM  # LLVM has all functions in f64
        exact = [b.quantity.precise and scene.real == ti.f32 and (llvm or not b.quantity.transcends) for b in scalars]
        self.precise = [(k, b) for k, b in enumerate(scalars) if exact[k]]
        if self.precise:
            batch = np.repeat(np.arange(len(scalars)), [b.count for b in scalars])[rows]
            number = np.concatenate([np.arange(b.count) for b in scalars])[rows]
            self.batch, self.number = ints("batch", batch), ints("number", number)
        # bound: that of a row which is at one, where active is 0. yield_load: the largest multiplier while the part gives way.
        # remaining: the change of violations by the steps.
        self.active, self.bound, self.remaining = ints("active", 0 * side), reals("bound"), reals("left")
        self.yield_load = reals("yield_load")
        self.is_length = ints("is_length", np.repeat([b.quantity.is_distance for b in scalars], [b.count for b in scalars])[rows])
        if self.bounds:
            self.low = reals("low", values=np.where(side < 0, 0.0, -np.inf))
            self.high = reals("high", values=np.where(side > 0, 0.0, np.inf))

    def stiffen(self, factor: float) -> None:
        """Let parts that give way bear tensions that are `factor` times as large, (omega h)^2, up to those of this substep."""
        state = self.memory.read(self.softened)
        if state.any():
            soft = state[:, 0]
            state[:, 0] = np.copysign(np.maximum(np.abs(soft) / factor, 1.0), soft) * (soft != 0)
            self.memory.write(self.softened, state)

    @property
    def softest(self) -> float:
        """(h' / h)^2 for the longest substep h' whose yield loads a part has; 1 without any."""
        return float(np.abs(self.memory.read(self.softened)[:, 0]).max(initial=1.0))

    @property
    def stored(self) -> float:
        """The energy of parts with the yield loads of a longer substep, times h^2 of the last one."""
        soft, _, energy = self.memory.read(self.softened).T
        return float(energy[np.abs(soft) > 1].sum())

    def gives_way(self, batch: Batch) -> np.ndarray:
        """Return a mask of the constraints of a batch in parts that give way, (m,)."""
        row = self.row(batch)
        return (self.memory.read(self.softened)[self._part[row], 0] != 0) & (row >= 0)

    def forget(self, off: "Sequence[tuple[Batch, np.ndarray]]" = ()) -> None:
        """Forget which parts give way."""
        self.memory.write(self.softened, 0.0)

    @ti.func
    def set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness):
        """Set the data of row r for this pass, see System.set_row(), and whether a one-sided row is active."""
        System.set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness)
        self.yield_load[r] = ti.math.inf
        self.begin_row(r)

    @ti.func
    def begin_row(self, r):
        """Begin an active set: row r is active unless it is at a bound and needs no other multiplier."""
        low, high = self.bounds_of(r)
        self.bound[r] = ti.select(self.scale[r] != 0, ti.max(low, ti.min(high, self.lam[r])), 0 * self.lam[r])
        acts = self.is_inside(r, self.lam[r]) or self.leaves_bound(r, self.lam[r], self.violation[r])
        self.active[r] = ti.cast(self.scale[r] != 0 and acts, ti.i32)

    @ti.func
    def bound_row(self, r, low, high):
        """Set the bounds of the multiplier of row r, see System.bound_row()."""
        if ti.static(self.bounds):
            self.low[r], self.high[r] = low, high

    @ti.func
    def bounds_of(self, r):
        """Return the least and the largest multiplier of row r."""
        low, high = -self.yield_load[r], self.yield_load[r]
        if ti.static(self.bounds):
            low, high = ti.max(low, ti.min(self.low[r], high)), ti.min(high, ti.max(self.high[r], low))
        return low, high

    @ti.func
    def is_limited(self, r):
        """Whether the multiplier of row r has a bound."""
        low, high = self.bounds_of(r)
        return low > -ti.math.inf or high < ti.math.inf

    @ti.func
    def is_inside(self, r, lam):
        """Whether a multiplier of row r is within its bounds."""
        low, high = self.bounds_of(r)
        return low < lam and lam < high

    @ti.func
    def leaves_bound(self, r, lam, violation):
        """Whether row r, whose multiplier is at a bound, needs another one for such a violation."""
        low, high = self.bounds_of(r)
        return low < high and ((lam >= high and violation > 0) or (lam <= low and violation < 0))

    @ti.func
    def nearest_bound(self, r, lam):
        """Return the bound of row r that a multiplier is beyond."""
        low, high = self.bounds_of(r)
        return ti.select(lam >= high, high, low)

    @ti.func
    def set_gradient(self, place, i, gradient):
        """Set the gradient at a corner with slot `place` and particle i."""
        if place >= 0:
            if ti.static(self.has_shared_particles):
                gradient *= self.blocks_of[i]
            self.gradient[place] = gradient

    @inline
    def is_active(self, r):
        """Whether row r takes part in the system."""
        return at(self.active, r) != 0

    @called
    @ti.func
    def assemble(self, begin: ti.i32, end: ti.i32, softness: ti.f64, at_end: ti.i32):
        """Assemble the matrix and right side of rows from `begin` up to `end`. Rows that do not act get their bound.

        softness: added to the diagonal. at_end: whether directions are those at the end of the substep.
        """
        rows, entries = self.solved, self.entries
        if ti.static(bool(self.joined)):
            self.note_pushes(begin, end, at_end)
        for r in range(begin, end):
            self.value[r] = 0
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                self.value[rows + e] = 0
                self.value[rows + entries + e] = 0
        for r in range(begin, end):
            if self.is_active(r):
                for q in range(self.product_begin[r], self.product_begin[r + 1]):
                    at = self.product[q]
                    self.value[at[0]] = self.value[at[0]] + self.scale[r] * self.coupling(at, at_end)
                self.value[r] = self.value[r] + (self.alpha[r] + softness)
                self.step[r] = -self.violation[r]
            else:
                self.value[r] = 1
                self.step[r] = self.bound[r] - self.lam[r]
            self.diagonal[r] = self.value[r]

    @called
    @ti.func
    def note_pushes(self, begin: ti.i32, end: ti.i32, at_end: ti.i32):
        """Store how rows from `begin` up to `end` push bodies."""
        for r in range(begin, end):
            for q in range(self.corner_begin[r], self.corner_begin[r + 1]):
                move = self.move[self.corner[q]]
                if at_end != 0:
                    move = self.move_at_end(self.corner[q])
                self.joined.note_push(self.corner[q], move)

    @ti.func
    def coupling(self, at, at_end):
        """Return grad C_j . w . grad C_k for one particle or body. at_end: both gradients are at the end of the substep."""
        move = self.move[at[2]]
        if at_end != 0:
            move = self.move_at_end(at[2])
        if ti.static(bool(self.joined)):
            if self.joined.corner_of[at[1]] >= 0:
                move = self.joined.move_for(at[1], at[2])
        out = ti.cast(0, ti.f64)
        for k in ti.static(range(self.dim)):
            out += ti.cast(self.gradient[at[1]][k], ti.f64) * ti.cast(move[k], ti.f64)
        return out

    @ti.func
    def move_at_end(self, s):
        """Return the move of the corner with slot s for a multiplier of 1, along the gradient at the end of the substep."""
        i = self.particle_of[s]
        move = self.gradient[s] * self.w[i]
        if ti.static(self.has_shared_particles):
            move /= self.blocks_of[i]
        return move

    @ti.func
    def gradient_at_start(self, s):
        """Return the gradient at the corner with slot s, in the direction in which its multiplier moves it."""
        i = self.particle_of[s]
        out = self.move[s] / self.w[i]
        if ti.static(self.has_shared_particles):
            out *= self.blocks_of[i]
        return out

    @called
    @ti.func
    def eliminate(self, begin: ti.i32, end: ti.i32) -> ti.i32:
        """Eliminate rows from `begin` up to `end`, then substitute back. Returns 1 if a pivot was small, 2 for a contradiction.

        A constraint that others imply gets no step. It contradicts them if its residual is larger than rounding.
        """
        hard, rows, entries = 0, self.solved, self.entries
        for r in range(begin, end):
            first, last, pivot, step = self.entry_begin[r], self.entry_begin[r + 1], self.value[r], self.step[r]
            if ti.abs(pivot) <= REDUNDANT * self.diagonal[r]:
                if (ti.abs(step) - CONTRADICTION * ti.abs(self.violation[r])) * self.inverse_size[r] > 8 * self.epsilon:
                    hard = 2
                self.value[r], self.diagonal[r] = 1, 0
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
        self.substitute_back(self.step, begin, end)
        return hard

    @ti.func
    def substitute_back(self, x: ti.template(), begin, end):  # type: ignore[valid-type]
        """Find x from the eliminated rows from `begin` up to `end`; 0 for rows that others imply."""
        for k in range(end - begin):
            r = end - 1 - k
            rest = x[r]
            for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                rest -= self.value[self.solved + e] * x[self.column[e]]
            x[r] = ti.select(self.diagonal[r] != 0, rest / self.value[r], 0 * rest)

    @ti.func
    def bears(self, r):
        """Whether row r is met by its multiplier: it is not slack, and its part does not give way."""
        out = self.alpha[r] == 0 and self.is_active(r) and self.added[self.part_of[r]] == 0 and self.diagonal[r] != 0
        if self.is_limited(r):
            out = out and self.is_inside(r, self.solution[r] + self.answer[r])
        return out

    @ti.func
    def row_that_begins(self, s):
        """Return the row whose first corner has slot s, -1 if that is none."""
        r = self.row_of[s]
        if r >= 0:
            if self.corner[self.corner_begin[r]] != s:
                r = -1
        return r

    @ti.func
    def begin_answer(self, b):
        """Before contacts are solved: part b has answered nothing, and has its directions at the start of the substep."""
        self.turned_to[b] = 0
        self.bends_far[b] = 0
        for r in range(self.part_begin[b], self.part_begin[b + 1]):
            self.answer[r], self.solution[r], self.gap[r] = 0, self.lam[r] + self.step[r], 0
            if self.is_limited(r) and self.active[r] == 0:
                self.gap[r] = self.violation[r] + self.remaining[r] + self.alpha[r] * self.step[r]
        if self.added[b] > 0:
            self.assemble(self.part_begin[b], self.part_begin[b + 1], self.added[b], 0)
            self.eliminate(self.part_begin[b], self.part_begin[b + 1])

    @ti.func
    def turn_answer(self, b, rows: ti.template()):  # type: ignore[valid-type]
        """Turn the directions of part b to those at the time of its impact."""
        when, before = ti.cast(0, self.real), ti.cast(self.turned_to[b], self.real)
        for q in range(self.corner_begin[self.part_begin[b]], self.corner_begin[self.part_begin[b + 1]]):
            when = ti.max(when, rows.when_of(self.particle_of[self.corner[q]]))
        if when != before:
            turn = (when - before) / ti.max(1 - before, ti.static(2.0**-10))  # what is at the end already stays there
            self.turned_to[b] = when
            if ti.static(bool(self.joined)):
                self.joined.place_bodies(b, 1 - when)
            for q in range(self.corner_begin[self.part_begin[b]], self.corner_begin[self.part_begin[b + 1]]):
                s = self.corner[q]
                self.move[s] = self.move[s] + turn * (self.move_at_end(s) - self.move[s])
            self.assemble(self.part_begin[b], self.part_begin[b + 1], self.added[b], 0)
            self.eliminate(self.part_begin[b], self.part_begin[b + 1])

    @ti.func
    def answer_part(self, b, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Answer moves of the particles of part b, `moved` - d, by multipliers `answer`, with the matrix of the last solution.

        With the moves A u + gap + (alpha' + softness) answer = 0 again, where u is how far they have changed f.
        """
        begin, end, any_change, switched = self.part_begin[b], self.part_begin[b + 1], False, False
        rows, entries = self.solved, self.entries
        if ti.static(bool(self.joined)):
            self.joined.begin_answer(b, self, moved, d)
        for r in range(begin, end):
            change = -self.scale[r] * self.moved_along(r, moved, d, True) - self.gap[r]
            if self.is_limited(r) and self.scale[r] != 0:
                lam = self.solution[r] + self.answer[r]
                acts = ti.select(self.active[r] != 0, self.is_inside(r, lam), self.leaves_bound(r, lam, -change))
                if acts != (self.active[r] != 0):
                    self.active[r], switched = 1 - self.active[r], True
                    if not acts:
                        self.bound[r] = self.nearest_bound(r, lam)
                        self.answer[r] = self.bound[r] - self.solution[r]
            if self.is_active(r):
                change -= (self.alpha[r] + self.added[b]) * self.answer[r]
            else:
                change = 0
            self.change[r] = change
            any_change = any_change or change != 0
        if switched:
            self.assemble(begin, end, self.added[b], 0)
            self.eliminate(begin, end)
        for r in range(begin, end):
            if self.diagonal[r] == 0:
                self.change[r] = 0
        if any_change or switched:
            for r in range(begin, end):
                part = self.change[r] / self.value[r]
                for e in range(self.entry_begin[r], self.entry_begin[r + 1]):
                    later = self.column[e]
                    self.change[later] = self.change[later] - self.value[rows + entries + e] * part
            self.substitute_back(self.change, begin, end)
            for r in range(begin, end):
                self.answer[r] = self.answer[r] + self.change[r]
                for q in range(self.corner_begin[r], self.corner_begin[r + 1]):
                    s = self.corner[q]
                    self.slots.answer[s] = ti.cast(self.answer[r] * ti.cast(self.move[s], ti.f64), self.real)
        if ti.static(bool(self.joined)):
            self.joined.end_answer(b, self)

    @ti.func
    def end_answer(self, b, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """End the answers of part b to moves of its particles, `moved` - d. Those to places remove what earlier ones left."""
        for r in range(self.part_begin[b], self.part_begin[b + 1]):
            gap = self.scale[r] * self.left[r]
            if self.is_limited(r):
                if self.active[r] == 0:
                    gap += self.gap[r] + self.scale[r] * self.moved_along(r, moved, d, False)
                self.solution[r] = self.solution[r] + self.answer[r]
            self.gap[r], self.answer[r] = gap, 0

    @ti.func
    def note_bend(self, r, turn):
        """Note that impulses of contacts turn row r: the square of a move over its length."""
        if turn > LONG_MOVE:
            self.bends_far[self.part_of[r]] = 1  # all write the same

    @ti.func
    def bends(self, r):
        """Whether row r answers to second order: it bears, and impulses of contacts do not turn its part far, see LONG_MOVE."""
        return self.bears(r) and self.bends_far[self.part_of[r]] == 0

    @ti.func
    def bend_part(self, b, moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Let rows of part b answer with the violations that moves of its particles, `moved` - d, lead to, beyond first order."""
        if ti.static(bool(self.joined)):
            self.joined.begin_answer(b, self, moved, d)
        for r in range(self.part_begin[b], self.part_begin[b + 1]):
            if self.bends(r):
                self.gap[r] = self.gap[r] - self.scale[r] * self.moved_along(r, moved, d, True)

    @ti.func
    def moved_along(self, r, moved: ti.template(), d: ti.template(), fits: ti.template()):  # type: ignore[valid-type]
        """Return by how much moves of particles, `moved` - d, change the constraint of row r. fits: whether bodies follow yet."""
        out = ti.cast(0, ti.f64)
        for q in range(self.corner_begin[r], self.corner_begin[r + 1]):
            s = self.corner[q]
            i = self.particle_of[s]
            u = self.gradient[s].dot(moved[i] - d[i])
            if ti.static(fits and bool(self.joined)):
                if self.joined.corner_of[s] >= 0:
                    u = self.gradient[s].dot(ti.cast(self.joined.fitted(self.joined.corner_of[s]), self.real))
            if ti.static(self.has_shared_particles):
                u /= self.blocks_of[i]
            out += u
        return out

    @ti.func
    def is_misplaced(self, r):
        """Whether row r has passed its bound, or is at one and needs another multiplier."""
        out = False
        if self.is_limited(r) and self.scale[r] != 0:
            left = self.violation[r] + self.remaining[r] + self.alpha[r] * self.step[r]
            inside, leaves = self.is_inside(r, self.lam[r] + self.step[r]), self.leaves_bound(r, self.bound[r], left)
            out = ti.select(self.active[r] != 0, not inside, leaves)
        return out

    @ti.func
    def count_misplaced(self, begin, end, at_end):
        """Find what the steps leave of violations. Returns the number of rows that are misplaced."""
        count = 0
        for r in range(begin, end):
            self.remaining[r] = 0
            for q in range(self.product_begin[r], self.product_begin[r + 1]):
                at = self.product[q]
                self.remaining[r] = self.remaining[r] + self.scale[r] * self.coupling(at, at_end) * self.step[self.row_of[at[2]]]
            count += ti.cast(self.is_misplaced(r), ti.i32)
        return count

    @ti.func
    def move_misplaced(self, begin, end, all_of_them):
        """Move misplaced rows, or the last of them, to the bounds that they have passed, or off theirs."""
        done = False
        for k in range(end - begin):
            r = end - 1 - k
            if not done and self.is_misplaced(r):
                done = not all_of_them
                self.active[r] = 1 - self.active[r]
                if self.active[r] == 0:
                    self.bound[r] = self.nearest_bound(r, self.lam[r] + self.step[r])

    @ti.func
    def solve_active_set(self, begin, end, softness, at_end, gives_way):
        """Find the steps of all rows that act, by an active set. Returns the result of eliminate(), and whether it was found.

        All misplaced rows move at once, as long as their number falls; then the last one alone, by which the set is found for any
        matrix with positive principal minors (Judice and Pires 1994). The search ends early only where rounding hides that.
        """
        hard, k, bounded, found = 0, 0, gives_way or ti.static(self.bounds), False
        fewest, patience = end - begin + 1, PATIENCE
        while k < 2 * (end - begin) + 8 and not found:
            self.assemble(begin, end, softness, at_end)
            now = self.eliminate(begin, end)
            hard = ti.max(now, ti.select(hard == 2, 2, 0))  # a contradiction is kept: its row may be switched off next
            k += 1
            found = True
            if bounded:
                count = self.count_misplaced(begin, end, at_end)
                found = count == 0
                patience = ti.select(count < fewest, PATIENCE, patience - 1)
                fewest = ti.min(fewest, count)
                if not found:
                    self.move_misplaced(begin, end, patience >= 0)
        if bounded:
            for r in range(begin, end):
                if self.scale[r] != 0:
                    low, high = self.bounds_of(r)
                    self.step[r] = ti.max(low, ti.min(high, self.lam[r] + self.step[r])) - self.lam[r]
        return hard, found

    @ti.func
    def limit_steps(self, begin, end):
        """Limit steps that go beyond where gradients are trusted and add energy. Returns whether any was limited.

        The energy is sum step (u + A step / 2), with A step = -violation. Rows with a curved f then take the step that they
        would take alone, and the system is solved again for the other rows.
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
                    self.active[r], self.bound[r] = 0, 0
        return found

    @ti.func
    def relative_length(self, r):
        """Return the length of constraint r relative to its rest length. A longer one has a lower transverse frequency."""
        out = ti.cast(1, ti.f64)
        if self.scale[r] != 0:
            out += ti.max(self.violation[r], 0 * out) * self.inverse_size[r] / self.scale[r]
        return out

    @ti.func
    def tensions(self, begin, end, at_end, longer):
        """Return (omega h)^2 of transverse vibrations under the multipliers found: by pull or pressure, by pull, the signed sum.

        Pull makes particles vibrate, pressure lets them buckle. longer: the square of the substep for which they are computed,
        relative to the present one.
        """
        worst, pull, total = ti.cast(0, ti.f64), ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for r in range(begin, end):
            stiffness = longer * self.geometric_stiffness[r] * (self.lam[r] + self.step[r])
            if at_end != 0:
                stiffness /= self.relative_length(r)
            worst, pull, total = ti.max(worst, ti.abs(stiffness)), ti.max(pull, -stiffness), total + stiffness
        return worst, pull, total

    @ti.func
    def unlimited_tension(self, begin, end):
        """Return the largest (omega h)^2 of rows that do not yield, since they are no lengths."""
        out = ti.cast(0, ti.f64)
        for r in range(begin, end):
            if self.is_length[r] == 0:
                out = ti.max(out, self.geometric_stiffness[r] * ti.abs(self.lam[r] + self.step[r]))
        return out

    @ti.func
    def largest_diagonal(self, begin, end):
        """Return the largest entry of the diagonal of the matrix that was assembled last."""
        out = ti.cast(0, ti.f64)
        for r in range(begin, end):
            out = ti.max(out, self.diagonal[r])
        return out

    @ti.func
    def earlier_tension(self, begin, end):
        """Return the largest (omega h)^2 of a transverse vibration under the multipliers of the earlier passes."""
        worst = ti.cast(0, ti.f64)
        for r in range(begin, end):
            worst = ti.max(worst, self.geometric_stiffness[r] * ti.abs(self.lam[r]))
        return worst

    @ti.func
    def strain(self, begin, end):
        """Return what rows at their yield loads give way by, relative to the size of all rows.

        Along a straight rope all links bear the same, so any of them may be the one that yields.
        """
        left, size = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        for r in range(begin, end):
            if self.scale[r] != 0 and self.inverse_size[r] > 0:
                size += 1 / self.inverse_size[r]
                if self.active[r] == 0 and self.yield_load[r] < ti.math.inf:
                    left += ti.abs(self.violation[r] + self.remaining[r]) / self.scale[r]
        return ti.select(size > 0, left / size, 0 * left)

    @ti.func
    def refine_violations(self, begin, end):
        """Recompute rigid violations to the full accuracy of positions, in f32.

        A taut rope needs this: its violations are of second order in its slopes.
        """
        for r in range(begin, end):
            for k, b in ti.static(self.precise):
                if self.batch[r] == k and self.alpha[r] == 0 and self.scale[r] != 0:
                    self.violation[r] = b.dev.quantity.exact_excess(self.number[r])
                    if ti.static(b.dev.limit.acts):
                        self.violation[r] -= b.dev.limit.postponed[self.number[r]]
                    if ti.static(self.answers):
                        self.violation[r] -= self.left[r]
                    if ti.static(bool(self.joined)):
                        self.violation[r] += self.shift[r]

    @ti.func
    def softness(self, b, begin, end):
        """Return (h' / h)^2 for the substep h' whose yield loads part b has; 0 if it does not give way."""
        soft, off = ti.abs(self.softened[b][0]), ti.cast(0, ti.f64)
        if soft > 0 and begin < end and self.earlier_tension(begin, end) == 0:
            for r in range(begin, end):
                off += ti.abs(self.violation[r])
            if self.softened[b][0] < 0 and off <= GONE * self.softened[b][1]:
                soft, off = 0 * soft, 0 * off
            self.softened[b][0] = soft
            self.softened[b][1] = off
        return soft

    @ti.func
    def record_softness(self, b, begin, end, soft, gives_way):
        """Record whether part b, which had this softness(), gives way."""
        if gives_way or soft > 1:
            energy = ti.cast(0, ti.f64)
            for r in range(begin, end):
                energy += ti.abs((self.lam[r] + self.step[r]) * self.violation[r])
            self.softened[b][0] = ti.select(gives_way, ti.max(soft, 1 + 0 * soft), -soft)
            self.softened[b][2] = energy
        else:
            self.softened[b] = ti.Vector.zero(ti.f64, 3)

    @ti.func
    def leave_to_places(self, begin, end):
        """Leave to places what a part, which bears its load again, gave way by.

        Its removal by an impulse would take contacts along, whose mass the tension found does not tell.
        """
        for r in range(begin, end):
            self.violation[r] -= self.at_start[r]
            self.left[r] = self.left[r] + self.at_start[r]

    @ti.func
    def let_yield(self, begin, end, longer):
        """Bound each multiplier by the tension with (omega h)^2 = YIELD. longer: see tensions().

        A row with such bounds bears what it can, whatever it is violated by, as if its energy were its yield load times |C|. Let
        N be its direction at the end of the substep, before the impulses w N^T lam, where it pulls, lam < 0, and at the start
        where it presses. C is convex, as lengths are, so lam . N d <= lam . (C_1 - C_0), and the impulses do the work

            lam . N (d + w N^T lam / 2) <= lam . (C_1 - C_0) + lam . A lam / 2,   A = N w N^T

        which is at most what that energy falls by, as long as (omega h)^2 <= 1: no energy comes of it.
        """
        for r in range(begin, end):
            for q in range(self.product_begin[r], self.product_begin[r + 1]):
                s = self.product[q][1]
                if s == self.product[q][2]:
                    if self.lam[r] + self.step[r] > 0:
                        self.gradient[s] = self.gradient_at_start(s)
                    self.move[s] = self.move_at_end(s)
            if self.geometric_stiffness[r] > 0 and self.is_length[r] != 0:
                self.yield_load[r] = YIELD * self.relative_length(r) / (longer * self.geometric_stiffness[r])
            self.begin_row(r)

    @ti.func
    def takes_step(self, b, newton):
        """Whether system b takes Newton step number `newton` of a pass."""
        out = True
        if ti.static(self.refines):
            if newton == 0:
                self.newton[b] = UNKNOWN
                self.any_unmet[None] = 0  # all write the same
            out = newton == 0 or self.newton[b] == UNMET
        return out

    @ti.func
    def end_newton(self, b):
        """Mark system b as taking no further Newton step in this pass."""
        if ti.static(self.refines):
            self.newton[b] = ENDED

    @ti.func
    def is_unmet(self, r):
        """Whether the system of row r takes another Newton step."""
        return self.newton[self.part_of[r]] == UNMET

    @ti.func
    def record_move(self, i, begin, end, move):
        """Mark the system of particle i for another Newton step if i moved so far that rigid constraints stay violated.

        A length l whose ends moved across it by u relative to each other is violated by |u|^2 / (2 l).
        """
        if (self.particle_inverse_size[i] * move).norm_sqr() > LONG_MOVE:
            for s in range(begin, end):
                r = self.row_of[s]
                b = self.part_of[r]
                if self.alpha[r] == 0 and self.newton[b] == UNKNOWN:
                    self.newton[b] = UNMET
                    self.any_unmet[None] = 1

    @ti.func
    def solve(self, b, kick):
        """Find the steps of all multipliers in system b. kick: how many kicks they supply: 1, except at a start.

        Particles under tension vibrate transversely. If the substep is too long for that, or the tension is undetermined (see
        Direct), links yield, see let_yield(). If an earlier pass found a larger tension, that would take most of it back, along
        other directions; then the system takes no step.
        """
        begin, end = self.part_begin[b], self.part_begin[b + 1]
        if ti.static(self.sleeps):
            if not self.state.awake(self.representative[b]):
                end = begin
        if ti.static(bool(self.joined)):
            if begin < end:
                self.begin_bodies(b, begin, end)
        zero = ti.cast(0, ti.f64)
        softness, stiffest, tension_at_start, total_at_start, reported = zero, zero, zero, zero, zero
        stage, bound, soft, longer = FORWARD, True, self.softness(b, begin, end), 1 + zero
        if soft > 0:
            longer = soft / kick
        most_borne = ti.select(soft == 1, YIELD, TENSEST)  # what gave way bears no more at once than it did then
        if ti.static(len(self.precise) > 0):
            stage = ROUGH
        if begin == end:
            stage = DONE
        while stage != DONE:
            if ti.static(bool(self.joined)):
                self.joined.place_bodies(b, ti.select(stage >= COMPARE, 0, 1))
            at_end, gives_way = ti.cast(stage == COMPARE, ti.i32), stage == GIVE_WAY
            hard, found = self.solve_active_set(begin, end, softness, at_end, gives_way)
            found = found and (not gives_way or longer * self.unlimited_tension(begin, end) <= YIELD)
            if gives_way and not found and softness < stiffest:
                softness *= SOFTER
                for r in range(begin, end):
                    self.begin_row(r)
                continue
            if ti.static(self.answers):
                self.added[b] = softness
                if hard != 0 or gives_way:  # answers to moves in f32 would be their rounding over a pivot
                    for r in range(begin, end):
                        self.added[b] = ti.max(self.added[b], self.small_pivot[r])
            tension, pull, total = self.tensions(begin, end, ti.cast(stage >= COMPARE, ti.i32), longer)
            if ti.static(self.limits_steps):
                if stage <= FORWARD and self.limit_steps(begin, end) != 0:
                    continue
            if stage <= AGAIN:
                if (hard == 0 and tension <= most_borne) or stage == AGAIN:
                    ti.atomic_max(self.tension[None], pull / longer)
                    self.record_softness(b, begin, end, soft, False)
                    if ti.static(self.answers):
                        if soft == 1 and hard == 0:
                            soft = zero
                            self.leave_to_places(begin, end)
                            continue
                    stage = DONE
                    if tension > CALM_TENSION:
                        self.end_newton(b)
                elif stage == ROUGH:
                    self.refine_violations(begin, end)
                    stage = FORWARD
                elif hard == 2:
                    reported, bound, stage = TENSEST + zero, False, GIVE_WAY
                else:
                    tension_at_start, total_at_start, bound, stage = tension, total, hard == 0, COMPARE
            elif stage == COMPARE:
                same = ti.abs(tension - tension_at_start) <= AGREEMENT * tension
                same = same and ti.abs(total - total_at_start) <= AGREEMENT * ti.abs(total)
                if same and ti.select(soft == 1, tension, pull) <= ti.min(STABLE, most_borne):
                    stage = AGAIN
                else:
                    # A load that more substeps do not help to bear is reported as just unstable, TENSEST.
                    reported = ti.select(bound, tension_at_start, ti.min(tension, TENSEST))
                    reported = ti.select(longer > 1, ti.min(reported, TENSEST), reported)
                    stage = GIVE_WAY
                    if longer * self.earlier_tension(begin, end) > YIELD:
                        for r in range(begin, end):
                            self.step[r] = 0
                        ti.atomic_max(self.tension[None], reported)
                        stage = DONE
                        self.end_newton(b)
            else:
                strain = self.strain(begin, end)
                self.record_softness(b, begin, end, soft, strain > 0)
                ti.atomic_max(self.tension[None], ti.select(bound or strain > SLIGHT, reported, pull / longer))
                stage = DONE
            if stage == GIVE_WAY:
                self.end_newton(b)
                stiffest = self.largest_diagonal(begin, end)
                softness = ti.max(LEAST_SOFTNESS, self.epsilon) * stiffest
                self.solve_active_set(begin, end, softness, 1, False)  # where pivots vanish, the signs found so far are rounding
                self.let_yield(begin, end, longer)
        if ti.static(bool(self.joined)):
            if begin < end:
                self.joined.follow(b, self)

    @ti.func
    def begin_bodies(self, b, begin, end):
        """Begin a pass of part b: its rows are violated at where their clusters bring the corners. It takes one Newton step."""
        if self.joined.part_begin[b] < self.joined.part_begin[b + 1]:
            self.end_newton(b)
        for r in range(begin, end):
            moved = ti.cast(0, ti.f64)
            for q in range(self.corner_begin[r], self.corner_begin[r + 1]):
                s = self.corner[q]
                moved += ti.cast(self.gradient[s].dot(self.joined.own_move(s)), ti.f64)
            self.shift[r] = self.scale[r] * moved
            self.violation[r] += self.shift[r]


def _with_implied(found: Plan, scalars: "list[Scalar]", scene: Scene, implied: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a plan with the implied links of its systems behind them, and the system of each row, (rows,) both."""
    part = np.repeat(np.arange(found.parts), np.diff(found.part_begin))
    owner, item = corners_of(scalars)
    free = scene.inv_mass[item] > 0
    system, inside = np.full(len(scene.inv_mass), -1), np.full(len(implied), -1)
    inside[found.rows] = part
    held = free & (inside[owner] >= 0)
    system[item[held]] = inside[owner[held]]
    also = free & implied[owner] & (system[item] >= 0)
    inside[owner[also]] = system[item[also]]
    more = np.flatnonzero(implied & (inside >= 0))
    return np.concatenate([found.rows, more]), np.concatenate([part, inside[more]])
