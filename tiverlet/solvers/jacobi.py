"""Mass-split Jacobi by slots and gathers: parallel, momentum-conserving, the same bits on any number of threads."""

import numpy as np
import taichi as ti

from .. import checks
from ..feature import Batch
from ..particles import State
from ..runtime import Memory


class Jacobi:
    """Every constraint is solved by itself from the same positions, and every particle adds up its share.

    A particle in n constraints gives each an n-th of its mass (mass splitting, Tonge 2012): the corrections then never sum to
    more than the whole, and unlike averaging they conserve momentum.

    relaxation: factor on each correction. With one iteration per substep, stepping is stable if and only if every eigenvalue p of
    the residual polynomial has -1/3 < p < 1; for mass splitting (eigenvalues of the iteration at most 1) that means
    relaxation < 4/3. Larger values are refused.
    """

    def __init__(self, relaxation: float = 1.0):
        relaxation = checks.number("Jacobi", "relaxation", relaxation, above=0.0)
        if relaxation >= 4 / 3:
            raise ValueError(
                f"Jacobi: relaxation = {relaxation:g}, but stepping is stable only below 4/3 (residual polynomial "
                "p = 1 - relaxation, stable for -1/3 < p < 1). Use relaxation=1.0, or at most 1.3."
            )
        self.relaxation = relaxation

    def __repr__(self) -> str:
        return f"Jacobi(relaxation={self.relaxation:g})"


class Slots:
    """Where constraints leave the moves that they want, and where particles collect them.

    The slots of one particle stand side by side, in the order of the batches and of the constraints in them, so that a
    particle adds them in an order that depends on nothing else. Corners that cannot move have no slot.
    """

    def __init__(self, memory: Memory, state: State, batches: list[Batch], inv_mass: np.ndarray, solver: Jacobi):
        n = len(inv_mass)
        members = np.concatenate([b.indices.ravel() for b in batches])
        movable = inv_mass[members] > 0
        self.total = int(movable.sum())
        degree = np.bincount(members[movable], minlength=n)
        order = np.argsort(np.where(movable, members, n), kind="stable")
        place = np.empty(len(members), dtype=np.int64)
        place[order] = np.arange(len(members))
        place[~movable] = -1
        ends = np.cumsum([b.indices.size for b in batches])
        parts = np.split(place, ends[:-1])
        self._places = {id(b): p.reshape(b.indices.shape) for b, p in zip(batches, parts, strict=True)}
        self.relaxation = solver.relaxation
        self.state = state
        self.move = memory.field("slots.move", self.total, width=state.dim)
        self.begin = memory.field("slots.begin", n + 1, kind=ti.i32, values=np.concatenate([[0], np.cumsum(degree)]))
        self.split = memory.field("slots.split_mass", n, values=degree * inv_mass)
        self.pull = memory.field("slots.pull", n, width=state.dim, state=True)
        self.turned = memory.field("slots.turned", None, kind=ti.i32)
        if any(b.breaks for b in batches):
            self.broken = memory.field("slots.broken", None, kind=ti.i32)

    def places(self, batch: Batch) -> np.ndarray:
        """The slot of each corner of a batch, -1 where it cannot move."""
        return self._places[id(batch)]

    @ti.func
    def total_of(self, i):
        """The sum of the moves in the slots of particle i, in order."""
        total = 0 * self.state.x[i]
        for s in range(self.begin[i], self.begin[i + 1]):
            total += self.move[s]
        return total

    @ti.func
    def gather(self, i, first, final):
        """Add up what the constraints want of particle i. `pull` keeps the sum of a frame's last substep."""
        if self.begin[i + 1] > self.begin[i]:
            total = self.total_of(i)
            self.state.shift(i, total)
            if final != 0:
                if first != 0:
                    self.pull[i] = total
                else:
                    self.pull[i] += total
