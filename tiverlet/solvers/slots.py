"""Where constraints leave the moves that they want, and where particles collect them."""

from typing import Any

import numpy as np

from ..device import ti
from ..device.memory import Memory
from ..device.number import OnDevice
from ..features.feature import BENT, FAR, Batch, Scene
from ..features.regrouping import Regrouping
from .corners import bodies_of, corners_of
from .system import solvable

# Where constraints converge within a substep, SHAKE is an explicit method for what is across them, with a limit:
TENSEST = 4.0  # (omega h)^2 of a vibration across a tension, beyond which Verlet diverges


def arranged(batches: list[Batch], inv_mass: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """The slots of the corners of each batch, by its id, -1 for what cannot move; and how many each particle has, (n,)."""
    n, members = len(inv_mass), corners_of(batches)[1]
    movable = inv_mass[members] > 0
    order = np.argsort(np.where(movable, members, n), kind="stable")
    place = np.empty(len(members), dtype=np.int64)
    place[order] = np.arange(len(members))
    place[~movable] = -1
    ends = np.cumsum([b.indices.size for b in batches])
    parts = np.split(place, ends[:-1])
    places = {id(b): p.reshape(b.indices.shape) for b, p in zip(batches, parts, strict=True)}
    return places, np.bincount(members[movable], minlength=n)


class Slots:
    """One slot for each corner of a constraint, in the order of the batches and of the constraints in them.

    The slots of one particle stand side by side, so that a particle adds them in an order that depends on nothing else. Corners
    that cannot move have no slot.

    loads: whether constraints that are relaxed by themselves know their loads. bears: where they do, the largest load in each
    body, in weights of a particle, as a window ends. split: the mass-split weight n w of each particle, for the n
    blocks of constraints that it belongs to: a system that is solved as a whole is one, and each constraint that is relaxed by
    itself.
    """

    bodies: Any = OnDevice()

    host_only = ("total", "exact")

    def __init__(self, scene: Scene, batches: list[Batch], solver):
        memory, state, inv_mass = scene.memory, scene.state, scene.inv_mass
        self._places, degree = arranged(batches, inv_mass)
        self.total, begin = int(degree.sum()), np.concatenate([[0], np.cumsum(degree)])
        self.state = state
        self.move = memory.field("slots.move", self.total, width=state.dim)
        self.begin = memory.field("slots.begin", len(begin), kind=ti.i32, values=begin)
        self.semi_iteration = solver.semi_iteration(scene)
        self.converges, self.loads = solver.converges, solver.loads
        if self.converges:
            self.tension = memory.field("slots.tension", None, kind=ti.f64)
        self.turned = memory.field("slots.turned", None, kind=ti.i32)  # the worst turn since the last diagnostics
        if any(b.breaks for b in batches):
            self.broken = memory.field("slots.broken", None, kind=ti.i32)
        self.system: Any = solver.system(scene, batches, self)
        self.has_system = bool(self.system)
        self.refines = self.has_system and self.system.refines
        # Whether a substep fulfils constraints to rounding, which is then the error that is left.
        scalars = solvable(batches)
        self.exact = bool(scalars) and (not self.system.steps if self.system else bool(degree.max(initial=0) <= 1))
        self._scalars = bool(scalars)
        blocks = self.system.blocks if self.system else degree
        if self.loads or any(b.breaks for b in batches):
            self._bodies, self._hefts = self._tied(batches, inv_mass)
        if self.loads:
            self.bodies = memory.number(1 + max(int(b.max(initial=0)) for b in self._bodies.values()))
            self.bears = memory.field("slots.bears", self.bodies)
        self.split = memory.field("slots.split_mass", scene.count, values=blocks * inv_mass)
        self.relaxation = solver.relaxed_by(scene, batches, blocks * inv_mass)

    @staticmethod
    def _tied(batches: list[Batch], inv_mass: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
        """The body of each constraint, by the batch's id; and the root of the sum of the squares of the masses [kg] of each body.
        Constraints that share particles that can move, directly or through others, are of one body."""
        ends = np.cumsum([b.count for b in batches])
        label, body = bodies_of(int(ends[-1]), *corners_of(batches), inv_mass)
        parts = np.split(label, ends[:-1])
        squares = np.divide(1, inv_mass, out=np.zeros(len(inv_mass)), where=inv_mass > 0) ** 2
        hefts = np.sqrt(np.bincount(body, weights=squares, minlength=int(ends[-1]) + 1))
        return {id(b): part for b, part in zip(batches, parts, strict=True)}, hefts

    def body(self, batch: Batch) -> np.ndarray:
        """The body of each constraint of a batch, where loads become known, or constraints break."""
        return self._bodies[id(batch)]

    def heft(self, batch: Batch) -> np.ndarray:
        """What rounding of places weighs in the body of each constraint [kg], see Strength."""
        return self._hefts[self.body(batch)]

    def regroup(self, memory: Memory, change: Regrouping) -> None:
        """Particles that no constraint holds came and went."""
        n, first = change.now.count, change.first
        memory.resize(self.begin, n + 1)
        memory.write_from(self.begin, first, np.full(n + 1 - first, self.total))

    def can_grab(self, inv_mass: np.ndarray, batches: list[Batch]) -> bool:
        """Whether constraints can act on other particles than before, with the same kernels: each is relaxed by itself, and they
        need as many slots and are as exact as before."""
        if self.system or self.semi_iteration or not all(b.arity for b in batches):
            return False
        degree = arranged(batches, inv_mass)[1]
        return int(degree.sum()) == self.total and self.exact == (self._scalars and bool(degree.max(initial=0) <= 1))

    def grab(self, memory: Memory, inv_mass: np.ndarray, batches: list[Batch]) -> None:
        """Have constraints act on other particles than before."""
        self._places, degree = arranged(batches, inv_mass)
        memory.write(self.begin, np.concatenate([[0], np.cumsum(degree)]))
        memory.write(self.split, degree * inv_mass)
        for b in batches:
            memory.write(b.dev.corners.places, self.places(b))

    def places(self, batch: Batch) -> np.ndarray:
        """The slot of each corner of a batch, -1 where it cannot move."""
        return self._places[id(batch)]

    def rows(self, batch: Batch) -> np.ndarray:
        """The row of each constraint of a batch in a system, -1 where it is relaxed by itself."""
        return self.system.row(batch) if self.system else np.full(batch.count, -1)

    @ti.func
    def limited(self, wanted, geometric_stiffness):
        """The multiplier `wanted`, limited so that (omega h)^2 = geometric_stiffness |multiplier| is at most TENSEST; what is
        beyond is noted."""
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
    def gather(self, i, newton):
        """Move particle i by what the constraints want; in later steps of Newton's method, by what its system wants."""
        begin, end = self.begin[i], self.begin[i + 1]
        if ti.static(self.refines):
            if newton > 0 and end > begin:
                r = self.system.row_of[begin]
                if r < 0 or not self.system.is_unmet(r):
                    end = begin
        if end > begin:
            wanted = self.wanted(i)
            self.state.shift(i, wanted)
            if ti.static(self.refines):
                self.system.note_move(i, begin, end, wanted)
