"""Constraints that are solved together: what they tell, and what particles make of the answer."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch, Scene
    from .slots import Slots

REDUNDANT = 1e-12  # of its diagonal: what is left of a constraint that others imply
SLACK = 0.1  # of |step violation|: how much energy steps may bring in by their own curvature


def solvable(batches: "list[Batch]") -> list[Any]:
    """Batches whose constraints a System may solve: each is a Scalar."""
    return [b for b in batches if b.solvable_together]


class System:
    """Rows of constraints, each with its violation, its weights and the step of its multiplier that a solver finds.

    In every pass constraints set their rows and gradients. Then solve() finds the steps part by part, each by one thread; or all
    threads go through start(), `steps` times iterate(), and end(). Particles move by the sum of step times move over their slots.

    scalars: the batches that take part, their constraints numbered through; rows: those numbers, in the order of the solver.
    """

    rows: Any = OnDevice()
    parts: Any = 1  # systems that have nothing to do with each other
    steps = 0  # of an iteration, by start(), iterate() and end(); 0 for a solution by solve()
    refines = False  # whether parts may take a second step of Newton's method in a pass, which takes_step() and is_unmet() tell
    team: Any  # the threads that share the loops of start(), iterate() and end(), given when the kernels are made
    stride: int  # iterations of such a loop for each block of rows

    def __init__(self, scene: "Scene", batches: "list[Batch]", slots: "Slots", scalars: "list[Scalar]", rows: np.ndarray):
        self.state, self.real, self.dim = scene.state, scene.real, scene.state.dim
        self.move, self.tension = slots.move, slots.tension
        self.epsilon = float(np.finfo(np.float32 if scene.real == ti.f32 else np.float64).eps)
        self.memory, self.inv_mass, self.rows = scene.memory, scene.inv_mass, scene.memory.number(len(rows))
        counts = [b.count for b in scalars]
        row = np.full(sum(counts), -1)
        row[rows] = np.arange(len(rows))
        self._rows = dict(zip(map(id, scalars), np.split(row, np.cumsum(counts)[:-1]), strict=True))
        self.blocks, self.shares = self._blocks(batches, scene)
        of_slot = np.full(sum(b.indices.size for b in batches), -1)
        for b in scalars:
            slot = slots.places(b)
            of_slot[slot[slot >= 0]] = np.broadcast_to(self.row(b)[:, None], slot.shape)[slot >= 0]
        self.row_of = self.ints("row_of_slot", of_slot)
        self.step, self.violation, self.scale = self.reals("step"), self.reals("violation"), self.reals("scale")
        self.alpha, self.lam = self.reals("alpha"), self.reals("multiplier")
        self.geometric_stiffness = self.reals("geometric_stiffness")
        self.limits_steps = any(b.limited for b in scalars) and scene.order == 2
        if self.limits_steps:
            self.motion, self.spare_energy, self.own_step = self.reals("toward"), self.reals("spare"), self.reals("instead")
            self.trusted_step = self.reals("most")
        if self.shares:
            self.share = scene.memory.field("system.share", scene.count, kind=ti.i32, values=self.blocks)

    def ints(self, name: str, values: np.ndarray, width: int = 0):
        """A field of integers."""
        return self.memory.field(f"system.{name}", len(values), width=width, kind=ti.i32, values=values)

    def reals(self, name: str, length: int | None = None):
        """A field of f64, one for each row."""
        return self.memory.field(f"system.{name}", self.rows if length is None else length, kind=ti.f64)

    def _blocks(self, batches: "list[Batch]", scene: "Scene") -> tuple[np.ndarray, bool]:
        """The number of blocks that each particle belongs to, one system at most; and whether any is in a system and others."""
        n = len(scene.inv_mass)
        inside, alone = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)
        for b in batches:
            row = self.row(b)
            if b.acts_as_force(scene).any():
                row = np.where(b.acts_as_force(scene), 0, row)  # forces take no share of the mass
            if (row >= 0).any():
                inside[b.indices[row >= 0]] = True
                alone += np.bincount(b.indices[row < 0].ravel(), minlength=n)
            else:
                alone += np.bincount(b.indices.ravel(), minlength=n)
        free = scene.inv_mass > 0
        return np.where(free, inside + alone, 0), bool((inside & (alone > 0) & free).any())

    def row(self, batch: "Batch") -> np.ndarray:
        """The row of each constraint of a batch, -1 where it is relaxed by itself."""
        return self._rows.get(id(batch), np.full(batch.count, -1))

    def leads(self, scalars: "list[Scalar]", slots: "Slots") -> np.ndarray:
        """One particle of each row that can move."""
        out = np.zeros(self.rows, dtype=np.int64)
        for b in scalars:
            row = np.broadcast_to(self.row(b)[:, None], b.indices.shape)
            free = (slots.places(b) >= 0) & (row >= 0)
            out[row[free]] = b.indices[free]
        return out

    def left_out(self, batches: "list[Batch]") -> int:
        """How many constraints are relaxed by themselves, of those with a particle that can move."""
        return sum(int((~b.immovable(self.inv_mass) & (self.row(b) < 0)).sum()) for b in batches)

    def forget(self, off: "Sequence[tuple[Batch, np.ndarray]]" = ()) -> None:
        """Particles were placed anew: forget what was found out on the way to their old places. off: of batches, (m,), by how
        much rigid constraints cannot be met at the new ones."""

    @ti.func
    def set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness):
        """What constraint r is about in this pass, but for what its corners tell. geometric_stiffness: see CornerPasses."""
        self.violation[r], self.alpha[r], self.lam[r], self.geometric_stiffness[r] = violation, alpha, lam, geometric_stiffness
        self.scale[r] = ti.select(W > 0, A, 0 * A)

    @ti.func
    def limit_row(self, r, motion, spare_energy, trusted_step, own_step):
        """Where steps are limited, see StepLimit: the motion along row r in this substep, the energy that it may bring in, the
        step up to which its gradient is trusted, and minus the step that it takes where the others' brings in energy."""
        self.motion[r], self.spare_energy[r] = motion, spare_energy
        self.trusted_step[r], self.own_step[r] = trusted_step, own_step

    @ti.func
    def set_gradient(self, place, i, gradient):
        """The gradient at one corner, whose slot is `place` and particle i."""

    @ti.func
    def takes_step(self, b, newton):
        """Whether part b takes this step of Newton's method in a pass: all take the first, 0."""
        return True

    @ti.func
    def is_unmet(self, r):
        """Where it refines: whether the part of row r takes another step of Newton's method."""
        return False

    @ti.func
    def note_move(self, i, begin, end, move):
        """Where it refines: particle i, with the slots from `begin` up to `end`, moved."""

    @ti.func
    def solve(self, b):
        """Part b: the step of every multiplier in it."""

    @ti.func
    def start(self, thread):
        """Before the first of `steps` iterations."""

    @ti.func
    def iterate(self, thread):
        """One of `steps` iterations."""

    @ti.func
    def end(self, thread):
        """After the last iteration."""

    @ti.func
    def total_of(self, i, begin, end):
        """The sum of the moves of particle i: those of a large tension at both sides of it cancel, in f64."""
        total = ti.Vector.zero(ti.f64, self.dim)
        for s in range(begin, end):
            r, factor = self.row_of[s], ti.cast(1, ti.f64)
            if r >= 0:
                factor = self.step[r]
            total += factor * ti.cast(self.move[s], ti.f64)
        return ti.cast(total, self.real)
