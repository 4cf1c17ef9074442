"""Where constraints leave the moves that they want, and where particles collect them."""

from typing import Any

import numpy as np

from ..constraints.core.scalar import TENSEST, Scalar
from ..device import ti
from ..device.memory import Memory
from ..features.feature import BENT, FAR, Batch, Scene
from ..features.regrouping import Regrouping


class Slots:
    """One slot for each corner of a constraint, in the order of the batches and of the constraints in them.

    The slots of one particle stand side by side, so that a particle adds them in an order that depends on nothing else. Corners
    that cannot move have no slot.

    split: the mass-split weight n w of each particle, for the n blocks of constraints that it belongs to: a system that is solved
    as a whole is one, and each constraint that is relaxed by itself.
    """

    host_only = ("total", "exact")

    def __init__(self, scene: Scene, batches: list[Batch], solver):
        memory, state, inv_mass = scene.memory, scene.state, scene.inv_mass
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
        self.state = state
        self.move = memory.field("slots.move", self.total, width=state.dim)
        self.begin = memory.field("slots.begin", n + 1, kind=ti.i32, values=np.concatenate([[0], np.cumsum(degree)]))
        self.semi_iteration = solver.semi_iteration(scene)
        self.converges = solver.converges
        if self.converges:
            self.tension = memory.field("slots.tension", None, kind=ti.f64)
        self.turned = memory.field("slots.turned", None, kind=ti.i32)  # the worst turn since the last survey
        if any(b.breaks for b in batches):
            self.broken = memory.field("slots.broken", None, kind=ti.i32)
        self.system: Any = solver.system(scene, batches, self)
        self.has_system = bool(self.system)
        # Whether a substep fulfils constraints to rounding, which is then the error that is left.
        scalars = [b for b in batches if isinstance(b, Scalar) and b.solvable_together]
        self.exact = bool(scalars) and (not self.system.steps if self.system else bool(degree.max(initial=0) <= 1))
        blocks = self.system.blocks if self.system else degree
        self.split = memory.field("slots.split_mass", scene.count, values=blocks * inv_mass)
        self.relaxation = solver.relaxed_by(scene, batches, blocks * inv_mass)

    def regroup(self, memory: Memory, change: Regrouping) -> None:
        """Particles that no constraint holds came and went."""
        n, first = change.now.count, change.first
        memory.resize(self.begin, n + 1)
        memory.write_from(self.begin, first, np.full(n + 1 - first, self.total))

    def places(self, batch: Batch) -> np.ndarray:
        """The slot of each corner of a batch, -1 where it cannot move."""
        return self._places[id(batch)]

    def rows(self, batch: Batch) -> np.ndarray:
        """The row of each constraint of a batch in a system, -1 where it is relaxed by itself."""
        return self.system.row(batch) if self.system else np.full(batch.count, -1)

    @ti.func
    def limited(self, wanted, geometric_stiffness):
        """A multiplier, at most what the substep can stand, (omega h)^2 = geometric_stiffness |multiplier| = TENSEST; noted."""
        most = TENSEST / geometric_stiffness
        if ti.abs(wanted) >= most:
            ti.atomic_max(self.tension[None], ti.cast(TENSEST * ti.abs(wanted) / most, ti.f64))
        return ti.max(-most, ti.min(most, wanted))

    @ti.func
    def turn(self, along, sizes):
        """How far a direction turned, from the product of what it was and is, and that of their sizes."""
        out = 0
        if along < 0.9 * sizes:
            out = BENT
        if along < 0.75 * sizes or sizes == 0:
            out = FAR
        return out

    @ti.func
    def note_turn(self, turn):
        """Keep the worst turn. Threads that all write to the same place wait for each other, so they look first."""
        if turn > self.turned[None]:
            ti.atomic_max(self.turned[None], turn)

    @ti.func
    def total_of(self, i):
        """The sum of the moves in the slots of particle i, in order."""
        total = 0 * self.state.x[i]
        for s in range(self.begin[i], self.begin[i + 1]):
            total += self.move[s]
        return total

    @ti.func
    def wanted(self, i):
        """What the constraints want of particle i: the sum of the moves, in f64 where large ones of a system cancel."""
        total = 0 * self.state.x[i]
        if ti.static(self.has_system):
            total = self.system.total_of(i, self.begin[i], self.begin[i + 1])
        else:
            total = self.total_of(i)
        return total

    @ti.func
    def gather(self, i):
        """Move particle i by what the constraints want."""
        if self.begin[i + 1] > self.begin[i]:
            self.state.shift(i, self.wanted(i))
