"""Preconditioned conjugate gradients on the constraints of a scene, for cloth and nets that must converge."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import ti
from ..device.number import OnDevice
from ..features.feature import Batch, Scene
from ..geometry.ordered import distinct
from .corners import components
from .slots import TENSEST, Slots
from .solver import Solver
from .spectrum import largest_eigenvalue
from .system import REDUNDANT, SLACK, System, solvable

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar

POWER, MARGIN = 30, 1.2  # rounds of power iteration for lambda_max, and what covers their error
GROWTH, HIGHEST = 1.1, 1.0  # the factor by which the floor grows, and its limit, at which a link is as soft as in Jacobi
CONVERGED = 1e-2  # of r . z at the start of an iteration: what may be left at its end
NULL = 8  # rounding errors of d . W d: if d . A d is below that, or below REDUNDANT, direction d is in the null space of A
BLOCKS = 64  # partial sums: a fixed number, so that totals are the same bit for bit on any number of threads
# Indices into `sums`: r . z; the length of the step, later the weight of the old direction in the next one; the length of a step
# that is taken back; r . z at the start of the iteration; the share of multipliers that the substep can stand.
RZ, FACTOR, TAKEN_BACK, RZ_START, BORNE = range(5)


class ConjugateGradient(Solver):
    """Solves all two-sided constraints that are scalar functions as one linear system in each iteration of a substep:

        A_j sum_k (grad C_j(x) . w . grad C_k(x_n)) dlam_k + alpha'_j dlam_j = -(A_j C_j + B_j + alpha'_j lam_j)

    It takes `steps` steps of conjugate gradients, preconditioned by the diagonal (Hestenes and Stiefel 1952). The matrix is
    symmetric except for the rotation of constraints within a substep. The error falls as
    ((sqrt(kappa) - 1) / (sqrt(kappa) + 1))^steps: some forty steps for a cloth of 30 x 30. Sums are over a fixed number of
    blocks, in f64, so results are the same bit for bit on any number of threads.

    If steps end before they have converged, their result differs in every substep. It acts as a spring whose stiffness jumps,
    which adds energy. So what is added to the diagonal has a floor,

        max(alpha'_j, sigma W_j),   sigma = lambda_max / steps^2

    with W_j the diagonal of A = G w G^T and lambda_max the largest eigenvalue of W^-1 A. The condition number is then at most
    steps^2 + 1, for which so many steps suffice, and a link gives way like one of compliance sigma W h^2. It stays as soft where
    the substep gets shorter. The floor grows where r . z has not fallen to a hundredth at the end of an iteration, as where
    constraints contradict each other (a row of links drawn straight between two pins), or where the tension is near the limit of
    the substep, until particles are put elsewhere.

    Where rigid constraints contradict each other at the positions given, sigma = 1 from the first substep on. With more links
    than needed (braced bodies), steps end where all rows are down to rounding.

    steps: of conjugate gradients in an iteration. Ropes, spacers and constraints that are not scalar functions are relaxed as by
    Jacobi beside it.
    """

    converges = True

    def __init__(self, steps: int = 20):
        self.steps = checks.integer("ConjugateGradient", "steps", steps, least=1)

    def system(self, scene: Scene, batches: list[Batch], slots: Slots) -> "CGSystem | None":
        """Return the system of a scene on the device; None where no constraint is solved together with others."""
        scalars = [b for b in solvable(batches) if b.side == 0]
        joined = any((~b.relaxed_alone(scene) & ~b.immovable(scene.inv_mass)).any() for b in scalars)
        return CGSystem(scene, batches, slots, scalars, self.steps) if joined else None

    def remedy(self, batches: list[Batch], slots: Slots, inv_mass: np.ndarray) -> str:
        """Return the setting that lowers residuals: twice the steps, where there is a system."""
        return f"solver=tv.ConjugateGradient({2 * self.steps})" if slots.system else Solver.remedy(self, batches, slots, inv_mass)

    def explain(self, batches: list[Batch], slots: Slots) -> str:
        """Return how many constraints are solved together, and how many relaxed alone."""
        rows = slots.system.rows if slots.system else 0
        alone = slots.system.count_relaxed_alone(batches) if rows else sum(b.count for b in batches)
        return f"{self!r}: {rows} constraints together" + (f"; {alone} relaxed as by Jacobi" if alone else "")

    def __repr__(self) -> str:
        return f"ConjugateGradient(steps={self.steps})"


class CGSystem(System):
    """The system of one world on the device. Rows are constraints in the order of their batches."""

    host_only = ("_least", "_part_of")

    n: Any = OnDevice()  # number of particles
    least: Any = OnDevice()  # first value of a floor
    part_count: Any = OnDevice()  # number of parts, plus one for particles in none

    def __init__(self, scene: Scene, batches: list[Batch], slots: Slots, scalars: "list[Scalar]", steps: int):
        places = [slots.places(b) for b in scalars]
        rows = np.flatnonzero(
            np.concatenate([(p >= 0).any(axis=1) & ~b.relaxed_alone(scene) for b, p in zip(scalars, places, strict=True)])
        )
        super().__init__(scene, batches, slots, scalars, rows)
        self.steps, self.n, self.begin, self.w = steps, scene.count, slots.begin, scene.state.w
        self.stride = 1  # iterations of a loop for each block; Taichi gives each CPU thread at least 512, see Step
        row, slot, who = self.corners(scalars, slots)
        ends = np.searchsorted(row, np.arange(self.rows + 1))
        self.corner_begin = self.ints("corner_begin", ends)
        self.corner = self.ints("corner", np.stack([slot, who], axis=1), 2)
        self.direction, self.residual = self.vector("direction"), self.vector("residual")
        self.matrix_times_direction = self.vector("applied")
        self.inverse_diagonal, self.shift = self.vector("preconditioner"), self.vector("shift")
        self.gradient = scene.memory.field("system.gradient", slots.total, width=self.dim)
        self.particle_move = scene.memory.field("system.pulled", scene.count, width=self.dim)
        self.partial, self.worst = self.reals("partial_sums", BLOCKS), self.reals("worst", BLOCKS)
        if self.limits_steps:
            self.gain, self.too_long = self.reals("gain", BLOCKS), self.reals("over", BLOCKS)
        self.sums = scene.memory.field("system.sums", None, width=5, kind=ti.f64)
        self.noise, self.above_noise = self.reals("noise"), self.reals("loud", BLOCKS)  # r z of rounding; 1 if a row is above it
        self.null = max(REDUNDANT, NULL * self.epsilon)
        self.rounding = self.epsilon ** (2 if scene.state.compensated else 1)  # of positions
        self._least = MARGIN * largest_eigenvalue(scene, scalars, self.blocks * scene.inv_mass, POWER) / steps**2
        self.least = self.memory.number(self._least, scene.real)
        _, part, _ = distinct(components(len(rows), row, who))
        self._part_of = np.zeros(scene.particles.count, dtype=np.int32)  # the part of each particle, counted from 1; 0: none
        self._part_of[who] = part[row] + 1
        self.part, self.representative = self.ints("part", part + 1), self.ints("lead", who[ends[1:] - 1])
        self.part_of = scene.memory.field("system.part_of", scene.count, kind=ti.i32, values=self._part_of)
        count = int(part.max(initial=0)) + 2
        self.part_count = self.memory.number(count)
        self.floor_too_low = self.ints("strained", np.zeros(count, dtype=np.int32))  # parts whose floor is too low
        self.floor = scene.memory.field("system.floor", scene.count, kind=ti.f64, state=True)  # floor of its part, by particle

    def vector(self, name: str):
        """Declare a field of real numbers, one for each row."""
        return self.memory.field(f"system.{name}", self.rows)

    def sag(self, batch: "Batch") -> np.ndarray:
        """Return the floor of the part of each constraint of a batch, (m,); 1 for those that are relaxed alone."""
        row, floor = self.row(batch), np.maximum(self.memory.read(self.floor), self._least)
        return np.where(row < 0, 1.0, floor[self.memory.read(self.representative)[row]])

    def forget(self, off: "Sequence[tuple[Batch, np.ndarray]]" = ()) -> None:
        """Reset the floors, because steps may converge from the new positions.

        Where constraints contradict each other there, floors begin at HIGHEST.
        """
        floor, contradicted = np.zeros(self.n), np.zeros(self.part_count, dtype=bool)
        part_of = self._part_of[: self.n]  # particles added or removed since are in no part, and behind all that are in one
        for batch, share in off:
            some = (share > 0) & (self.row(batch) >= 0)
            contradicted[part_of[batch.indices.ravel()[some[batch.owner]]]] = True
        contradicted[0] = False
        floor[: len(part_of)] = HIGHEST * contradicted[part_of]
        self.memory.write(self.floor, floor)

    @ti.func
    def set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness):
        """Set the right side, the preconditioner, and the first direction of row r."""
        System.set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness)
        zero = 0 * violation
        self.step[r] = ti.select(W > 0, ti.cast(0, ti.f64), -ti.cast(lam, ti.f64))
        self.residual[r] = ti.select(W > 0, -violation / A, zero)
        self.shift[r] = ti.select(W > 0, ti.max(alpha / A, self.floor_of(self.representative[r]) * W), zero)
        self.inverse_diagonal[r] = ti.select(W > 0, 1 / (W + self.shift[r]), zero)
        self.direction[r] = self.inverse_diagonal[r] * self.residual[r]

    @ti.func
    def floor_of(self, i):
        """Return the floor of the part of particle i."""
        return ti.max(ti.cast(self.floor[i], self.real), self.least)

    @ti.func
    def floor_at(self, slot):
        """Return the floor of the part of the row with this slot."""
        return self.floor_of(self.representative[self.row_of[slot]])

    @ti.func
    def set_gradient(self, place, i, gradient):
        """Set the gradient at a corner with slot `place` and particle i."""
        if place >= 0:
            self.gradient[place] = gradient

    @ti.func
    def first_row_of(self, b):
        """Return the first row of block b."""
        return b * ((self.rows + BLOCKS - 1) // BLOCKS)

    @ti.func
    def sum_partials(self):
        """Return the sum of the partial sums, in order."""
        out = ti.cast(0, ti.f64)
        for b in range(BLOCKS):
            out += self.partial[b]
        return out

    @ti.func
    def start(self, thread):
        """Compute r . z of the first residual; and for each row, r z of a violation that is only rounding, 2 eps |x| |grad C|."""
        for k in range(self.team.chunk_begin(BLOCKS * self.stride, thread), self.team.chunk_end(BLOCKS * self.stride, thread)):
            if k % self.stride == 0:
                b, total, above = k // self.stride, ti.cast(0, ti.f64), ti.cast(0, ti.f64)
                for r in range(self.first_row_of(b), ti.min(self.first_row_of(b + 1), self.rows)):
                    if ti.static(bool(self.state.sleepers)):
                        if not self.state.awake(self.representative[r]):  # rows of sleeping particles were not set in this pass
                            self.residual[r], self.direction[r], self.step[r] = 0, 0, 0
                    far, squares = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
                    for c in range(self.corner_begin[r], self.corner_begin[r + 1]):
                        at = self.corner[c]
                        far = ti.max(far, self.state.x[at[1]].norm_sqr())
                        squares += self.gradient[at[0]].norm_sqr()
                    self.noise[r] = ti.static((2 * self.rounding) ** 2) * far * squares * self.inverse_diagonal[r]
                    here = ti.cast(self.residual[r], ti.f64) * self.direction[r]
                    total += here
                    if here > self.noise[r]:
                        above = 1.0
                self.partial[b], self.above_noise[b] = total, above
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            now = self.sum_partials()
            self.sums[None] = ti.Vector([now, 0, 0, now, 1], ti.f64)
        self.team.wait()

    @ti.func
    def end(self, thread):
        """Raise the floors of parts where steps have not converged, or a tension came near the limit of the substep."""
        for r in range(self.team.chunk_begin(self.rows, thread), self.team.chunk_end(self.rows, thread)):
            share = CONVERGED * self.sums[None][RZ_START]
            if self.sums[None][RZ] > share:
                if self.rows * ti.cast(self.inverse_diagonal[r] * self.residual[r], ti.f64) * self.residual[r] > share:
                    self.floor_too_low[self.part[r]] = 1  # all write the same
        self.team.wait()
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if self.floor_too_low[self.part_of[i]] != 0:
                self.floor[i] = ti.min(GROWTH * self.floor_of(i), HIGHEST)
        self.team.wait()
        for p in range(self.team.chunk_begin(self.part_count, thread), self.team.chunk_end(self.part_count, thread)):
            self.floor_too_low[p] = 0
        self.team.wait()

    @ti.func
    def iterate(self, thread):
        """Take one step of conjugate gradients. If it needs too large a tension, all bear what they can, and no step follows."""
        self.compute_moves(thread)
        self.compute_step_length(thread)
        self.apply_step(thread)
        self.update_direction(thread)

    @ti.func
    def compute_moves(self, thread):
        """Compute w G^T d, the move of each particle along the direction."""
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if self.w[i] > 0:
                total = ti.Vector.zero(self.real, self.dim)
                for s in range(self.begin[i], self.begin[i + 1]):
                    r = self.row_of[s]
                    if r >= 0:
                        total += self.direction[r] * self.move[s]
                if ti.static(self.has_shared_particles):
                    total *= self.blocks_of[i]
                self.particle_move[i] = total
        self.team.wait()

    @ti.func
    def compute_step_length(self, thread):
        """Compute A d, and the length of the step, r . z / d . A d; 0 if only rounding is left and d is in the null space."""
        for k in range(self.team.chunk_begin(BLOCKS * self.stride, thread), self.team.chunk_end(BLOCKS * self.stride, thread)):
            if k % self.stride == 0:
                b, total, size = k // self.stride, ti.cast(0, ti.f64), ti.cast(0, ti.f64)
                for r in range(self.first_row_of(b), ti.min(self.first_row_of(b + 1), self.rows)):
                    value = self.shift[r] * self.direction[r]
                    if self.inverse_diagonal[r] > 0:
                        size += ti.cast(self.direction[r], ti.f64) * self.direction[r] / self.inverse_diagonal[r]
                    for c in range(self.corner_begin[r], self.corner_begin[r + 1]):
                        at = self.corner[c]
                        value += self.gradient[at[0]].dot(self.particle_move[at[1]])
                    self.matrix_times_direction[r] = value
                    total += ti.cast(value, ti.f64) * self.direction[r]
                self.partial[b], self.worst[b] = total, size
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            curve, size, above = self.sum_partials(), ti.cast(0, ti.f64), ti.cast(0, ti.f64)
            for b in range(BLOCKS):
                size += self.worst[b]
                above = ti.max(above, self.above_noise[b])
            if above == 0 and curve <= ti.static(self.null) * size:
                self.sums[None][RZ] = 0
            self.sums[None][FACTOR] = ti.select(curve > 0, self.sums[None][RZ] / curve, ti.cast(0, ti.f64))
        self.team.wait()

    @ti.func
    def apply_step(self, thread):
        """Take the step, and compute the residual and whether the step was too long."""
        for k in range(self.team.chunk_begin(BLOCKS * self.stride, thread), self.team.chunk_end(BLOCKS * self.stride, thread)):
            if k % self.stride == 0:
                b, total, worst = k // self.stride, ti.cast(0, ti.f64), ti.cast(0, ti.f64)
                far, gain, over = self.sums[None][FACTOR], ti.cast(0, ti.f64), ti.cast(0, ti.f64)
                above = ti.cast(0, ti.f64)
                for r in range(self.first_row_of(b), ti.min(self.first_row_of(b + 1), self.rows)):
                    self.step[r] = self.step[r] + far * self.direction[r]
                    left = self.residual[r] - ti.cast(far, self.real) * self.matrix_times_direction[r]
                    self.residual[r] = left
                    here = ti.cast(self.inverse_diagonal[r] * left, ti.f64) * left
                    total += here
                    if here > self.noise[r]:
                        above = 1.0
                    tension = self.geometric_stiffness[r] * ti.abs(self.lam[r] + self.step[r])
                    worst = ti.max(worst, tension)
                    if tension > TENSEST / 2:
                        self.floor_too_low[self.part[r]] = 1
                    if ti.static(self.limits_steps):
                        if self.scale[r] != 0:
                            change = self.violation[r] + self.scale[r] * (left + self.shift[r] * self.step[r])
                            gain += self.step[r] * (self.motion[r] - change / 2) - self.spare_energy[r]
                            gain -= SLACK * ti.abs(self.step[r] * self.violation[r])
                            if ti.abs(self.step[r]) > self.trusted_step[r]:
                                over = 1.0
                self.partial[b], self.worst[b], self.above_noise[b] = total, worst, above
                if ti.static(self.limits_steps):
                    self.gain[b], self.too_long[b] = gain, over
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            before, worst = self.sums[None][RZ], self.worst[0]
            now = ti.select(before > 0, self.sum_partials(), 0 * before)
            for b in range(1, BLOCKS):
                worst = ti.max(worst, self.worst[b])
            ti.atomic_max(self.tension[None], worst)
            back, borne = 0 * now, ti.min(TENSEST / ti.max(worst, TENSEST), 1 + 0 * now)
            if ti.static(self.limits_steps):
                gain, over = self.gain[0], self.too_long[0]
                for b in range(1, BLOCKS):
                    gain += self.gain[b]
                    over += self.too_long[b]
                if gain > 0 and over > 0:  # as in Elimination.limit_steps(): such a step is taken back
                    back = self.sums[None][FACTOR]
            if back != 0 or borne < 1:
                now = 0
            first = self.sums[None][RZ_START]
            self.sums[None] = ti.Vector([now, ti.select(before > 0, now / before, 0 * now), back, first, borne], ti.f64)
        self.team.wait()

    @ti.func
    def update_direction(self, thread):
        """Take a step back that was too long, limit tensions, and compute the next direction, z + (r . z / r . z before) d."""
        for r in range(self.team.chunk_begin(self.rows, thread), self.team.chunk_end(self.rows, thread)):
            if self.sums[None][TAKEN_BACK] != 0:
                self.step[r] = self.step[r] - self.sums[None][TAKEN_BACK] * self.direction[r]
                self.residual[r] = 0
            if self.sums[None][BORNE] < 1:
                self.step[r] = self.sums[None][BORNE] * self.step[r]
                self.residual[r] = 0
            self.direction[r] = (
                self.inverse_diagonal[r] * self.residual[r] + ti.cast(self.sums[None][FACTOR], self.real) * self.direction[r]
            )
        self.team.wait()
