"""Systems: constraints that are solved together. The data of their rows, and the moves of their particles."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from .corners import by_batch

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Batch, Scene
    from .slots import Slots

REDUNDANT = 1e-12  # of its diagonal: a pivot this small belongs to a constraint that others imply
SLACK = 0.1  # of |step violation|: the energy that steps may add by their own curvature


def solvable(batches: "list[Batch]") -> list[Any]:
    """Return the batches whose constraints a System may solve; each is a Scalar."""
    return [b for b in batches if b.solvable_together]


class System:
    """A system: rows of constraints, each with a violation, weights, and the step of its multiplier that the solver finds.

    In every pass, constraints set their rows and gradients. Then solve() finds the steps of each part, with one thread per part.
    Or all threads call start(), `steps` times iterate(), and end(). Particles move by the sum of step * move over their slots.

    scalars: the batches that take part, with constraints numbered through. rows: these numbers, in the order of the solver.
    """

    host_only = ("_rows",)

    rows: Any = OnDevice()
    parts: Any = 1  # number of independent systems
    answers = False  # whether parts answer the impulses of contacts, see Elimination.answer_part()
    steps = 0  # iterations of a pass, by start(), iterate() and end(); 0 for a solution by solve()
    refines = False  # whether parts may take a second Newton step in a pass, see takes_step() and is_unmet()
    softest: Any = 1.0  # (h' / h)^2 for the longest substep h' whose yield loads a part has, see Elimination
    stored: Any = 0.0  # the energy of such parts, times h^2
    has_implied = False  # whether rows are links that others imply, which take no step
    late: tuple[str, ...] = ()  # the names of fields in the state that are not hashed where they are 0
    team: Any  # the threads that share the loops of start(), iterate() and end(); set when kernels are built
    stride: int  # iterations of such a loop for each block of rows

    def __init__(
        self, scene: "Scene", batches: "list[Batch]", slots: "Slots", scalars: "list[Scalar]", rows: np.ndarray,
        body: "np.ndarray | None" = None,
    ):  # fmt: skip
        """body: the body of each particle, see joined_clusters(). Clusters that are bodies get a row that acts on them."""
        self.state, self.real, self.dim = scene.state, scene.real, scene.state.dim
        self.move, self.tension = slots.move, slots.tension
        self.epsilon = float(np.finfo(np.float32 if scene.real == ti.f32 else np.float64).eps)
        self.memory, self.inv_mass, self.rows = scene.memory, scene.inv_mass, scene.memory.number(len(rows))
        row = np.full(sum(b.count for b in scalars), -1)
        row[rows] = np.arange(len(rows))
        self._rows = dict(zip(map(id, scalars), by_batch(scalars, row), strict=True))
        row, slot, who = self.corners(scalars, slots)
        if body is not None:
            clusters = [b for b in batches if b.clusters]
            own, some = np.full(sum(b.count for b in clusters), -1), body[who] >= 0
            np.maximum.at(own, body[who[some]], row[some])
            self._rows |= zip(map(id, clusters), by_batch(clusters, own), strict=True)
        self.blocks, self.has_shared_particles = self._blocks(batches, scene)
        of_slot = np.full(sum(b.indices.size for b in batches), -1)
        of_slot[slot] = row
        self.row_of = self.ints("row_of_slot", of_slot)
        self.step, self.violation, self.scale = self.reals("step"), self.reals("violation"), self.reals("scale")
        self.alpha, self.lam = self.reals("alpha"), self.reals("multiplier")
        self.geometric_stiffness = self.reals("geometric_stiffness")
        self.limits_steps = any(b.limited for b in scalars) and scene.order == 2
        if self.limits_steps:
            self.motion, self.spare_energy, self.own_step = self.reals("toward"), self.reals("spare"), self.reals("instead")
            self.trusted_step = self.reals("most")
        if self.has_shared_particles:
            self.blocks_of = scene.memory.field("system.share", scene.count, values=self.blocks)

    def ints(self, name: str, values: np.ndarray, width: int = 0):
        """Declare a field of integers with these values."""
        return self.memory.field(f"system.{name}", len(values), width=width, kind=ti.i32, values=values)

    def reals(self, name: str, length: int | None = None, width: int = 0, values: "np.ndarray | None" = None):
        """Declare a field of f64, with one number or vector for each row, or `length` of them."""
        length = self.rows if length is None else length
        return self.memory.field(f"system.{name}", length, width=width, kind=ti.f64, values=values)

    def _blocks(self, batches: "list[Batch]", scene: "Scene") -> tuple[np.ndarray, bool]:
        """Return the number of blocks of each particle, (n,), and whether any particle is both in a system and in other blocks.

        A block is a system or a constraint that is relaxed alone; a particle is in one system at most.
        """
        n = len(scene.inv_mass)
        inside, alone = np.zeros(n, dtype=bool), np.zeros(n, dtype=np.int64)
        for b in batches:
            row = self.row(b)
            if b.acts_as_force(scene).any():
                row = np.where(b.acts_as_force(scene), 0, row)  # constraints that act as forces take no share of the mass
            who, there = b.indices.ravel(), (row >= 0)[b.owner]
            inside[who[there]] = True
            alone += np.bincount(who[~there], minlength=n)
        free = scene.inv_mass > 0
        return np.where(free, inside + alone, 0), bool((inside & (alone > 0) & free).any())

    def row(self, batch: "Batch") -> np.ndarray:
        """Return the row of each constraint of a batch, (m,), -1 for constraints that are relaxed alone."""
        return self._rows.get(id(batch), np.full(batch.count, -1))

    def corners(self, scalars: "list[Scalar]", slots: "Slots") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the row, the slot and the particle of each corner that can move, in the order of rows, (k,) each."""
        row = np.concatenate([np.repeat(self.row(b), b.arity) for b in scalars])
        slot = np.concatenate([slots.places(b).ravel() for b in scalars])
        some = np.flatnonzero((slot >= 0) & (row >= 0))
        some = some[np.argsort(row[some], kind="stable")]
        return row[some], slot[some], np.concatenate([b.indices.ravel() for b in scalars])[some]

    def count_relaxed_alone(self, batches: "list[Batch]") -> int:
        """Return how many constraints with a movable particle are relaxed by themselves."""
        return sum(int((~b.immovable(self.inv_mass) & (self.row(b) < 0)).sum()) for b in batches)

    def forget(self, off: "Sequence[tuple[Batch, np.ndarray]]" = ()) -> None:
        """Reset data learnt from earlier positions, after particles were put elsewhere.

        off: for some batches, (m,), the violations of rigid constraints that cannot be removed at the new positions.
        """

    def sag(self, batch: "Batch") -> np.ndarray:
        """Return sigma, (m,), where each constraint of a batch holds a load F by a violation sigma W h^2 F: 1 by itself."""
        return np.where(self.row(batch) < 0, 1.0, 0.0)

    def gives_way(self, batch: "Batch") -> np.ndarray:
        """Return a mask of the constraints of a batch in parts that give way, (m,)."""
        return np.zeros(batch.count, dtype=bool)

    def stiffen(self, factor: float) -> None:
        """Let parts that give way bear tensions that are `factor` times as large, (omega h)^2, up to those of this substep."""

    @ti.func
    def bound_row(self, r, low, high):
        """Set the bounds of the multiplier of row r for this pass, before set_row(). Called where a drive has a largest load."""

    @ti.func
    def set_row(self, r, violation, A, alpha, lam, W, geometric_stiffness):
        """Set the data of row r for this pass, except gradients.

        violation: A C + B + alpha' lam. A, alpha, lam, W: see CornerPasses.linearise(); W is 0 where no corner can move.
        geometric_stiffness: see CornerPasses.
        """
        self.violation[r], self.alpha[r], self.lam[r], self.geometric_stiffness[r] = violation, alpha, lam, geometric_stiffness
        self.scale[r] = ti.select(W > 0, A, 0 * A)

    @ti.func
    def limit_row(self, r, motion, spare_energy, trusted_step, own_step):
        """Set the limits on the step of row r, see StepLimit.

        motion: along the row in this substep. spare_energy: the energy that the row may add. trusted_step: the step up to which
        its gradient is trusted. own_step: minus the step that it takes alone, where the steps of the system would add energy.
        """
        self.motion[r], self.spare_energy[r] = motion, spare_energy
        self.trusted_step[r], self.own_step[r] = trusted_step, own_step

    @ti.func
    def set_gradient(self, place, i, gradient):
        """Set the gradient at a corner with slot `place` and particle i."""

    @ti.func
    def takes_step(self, b, newton):
        """Whether part b takes Newton step number `newton` in a pass. All parts take the first, 0."""
        return True

    @ti.func
    def is_unmet(self, r):
        """Whether the part of row r takes another Newton step. Used where `refines`."""
        return False

    @ti.func
    def record_move(self, i, begin, end, move):
        """Record that particle i, with slots from `begin` up to `end`, has moved by `move` [m]. Called where `refines`."""

    @ti.func
    def solve(self, b, kick):
        """Find the steps of all multipliers in part b. kick: how many kicks they supply: 1, except at a start."""

    @ti.func
    def start(self, thread):
        """Prepare for the first of `steps` iterations."""

    @ti.func
    def iterate(self, thread):
        """Do one of `steps` iterations."""

    @ti.func
    def end(self, thread):
        """Finish after the last iteration."""

    @ti.func
    def total_of(self, i, begin, end):
        """Return the sum of the moves of particle i [m], in f64: moves of large tensions on both sides of it cancel."""
        total = ti.Vector.zero(ti.f64, self.dim)
        for s in range(begin, end):
            r, factor = self.row_of[s], ti.cast(1, ti.f64)
            if r >= 0:
                factor = self.step[r]
            total += factor * ti.cast(self.move[s], ti.f64)
        return ti.cast(total, self.real)
