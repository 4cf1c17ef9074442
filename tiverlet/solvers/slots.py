"""Slots: constraints write their corrections into them, and particles sum them."""

from typing import Any

import numpy as np

from .. import checks
from ..device import at, inline, ti
from ..device.memory import Memory
from ..features.feature import BENT, FAR, Batch, Scene
from ..features.regrouping import Regrouping
from ..tools import golden_steps
from .breaks import Breaks
from .corners import bodies_of, corners_of
from .system import solvable

# Where constraints converge within a substep, SHAKE is an explicit method for transverse vibrations, with a limit of stability:
TENSEST = 4.0  # (omega h)^2 of a transverse vibration under a tension, beyond which Verlet diverges
# Strain up to which giving way is not told where no tension bears the load: a straight rope so much longer sags by 0.3 %.
SLIGHT = 2e-5
# Steps of the dither of moves, from a substep and from a pass to the next, times 2^32.
DITHER = golden_steps(1, bits=32)[0], golden_steps(2, bits=32)[0]


def assign_slots(batches: list[Batch], inv_mass: np.ndarray) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """Return the slot of each corner, by the id of its batch, and the number of slots of each particle, (n,).

    Corners that cannot move have the slot -1.
    """
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
    """A slot for each corner of a constraint, into which the constraint writes the correction of the particle [m].

    The slots of a particle are adjacent, in the order of batches and constraints, so a particle always sums them in the same
    order. Corners that cannot move have no slot.

    answers: whether constraints answer the impulses of contacts; `answer` is how far each moves its corner then [m].
    split: the mass-split weight n w of each particle, for the n blocks of constraints that it belongs to. A block is a system,
    or a constraint that is relaxed by itself.
    """

    host_only = (
        "total", "exact", "body_sizes", "rounding_masses", "_alone", "_blocks", "_bodies", "_places", "_sagging", "_scalars",
    )  # fmt: skip

    def __init__(self, scene: Scene, batches: list[Batch], solver, answers: bool):
        memory, state, inv_mass = scene.memory, scene.state, scene.inv_mass
        self._places, degree = assign_slots(batches, inv_mass)
        self.total, begin = int(degree.sum()), np.concatenate([[0], np.cumsum(degree)])
        self.state = state
        self.move = memory.field("slots.move", self.total, width=state.dim)
        self.begin = memory.field("slots.begin", len(begin), kind=ti.i32, values=begin)
        self.semi_iteration = solver.semi_iteration(scene)
        self.converges, self.answers = solver.converges, answers
        if answers:
            self.answer = memory.field("slots.answer", self.total, width=state.dim)
        if self.converges:
            self.tension = memory.field("slots.tension", None, kind=ti.f64)
        self.turned = memory.field("slots.turned", None, kind=ti.i32)  # the worst turn since the last diagnostics
        if any(b.breaks for b in batches):
            self.broken, self.breaks = memory.field("slots.broken", None, kind=ti.i32), Breaks(scene)
        self.system: Any = solver.system(scene, batches, self)
        self.has_system = bool(self.system)
        self.refines = self.has_system and self.system.refines
        # Whether a substep satisfies constraints up to rounding.
        scalars = solvable(batches)
        self.exact = bool(scalars) and (not self.system.steps if self.system else bool(degree.max(initial=0) <= 1))
        self._scalars = bool(scalars)
        self._blocks = blocks = self.system.blocks if self.system else degree
        self._alone = 0 if scene.walls and not answers else 1  # blocks of a particle that a pass solves exactly
        self._sagging: np.ndarray | None = None  # see _in_sagging_bodies()
        # Whether passes leave violations that bear loads, see softness.py. Links that answer contacts are solved with them.
        alone = not self.system or self.system.steps > 0 or self.system.count_relaxed_alone(batches) > 0
        self.can_soften = alone and (not answers or any(b.clusters or b.arity == 1 for b in batches))
        if any(b.breaks for b in batches):
            self._connect_bodies(batches, inv_mass, scene.particles.position)
        self.split = memory.field("slots.split_mass", scene.count, values=blocks * inv_mass)
        if self.can_soften:
            self.softness = memory.field("slots.softness", None, values=[1.0])
        factor = solver.relaxed_by(scene, batches, blocks * inv_mass)
        self.relaxation = checks.number(type(solver).__name__, "relaxed_by()", factor, above=0.0)

    def _connect_bodies(self, batches: list[Batch], inv_mass: np.ndarray, x: np.ndarray) -> None:
        """Find the body of each constraint, by the id of its batch, and for each body its size [m], and the mass that rounding of
        positions moves [kg], the root of the sum of squared masses, see Strength.

        Constraints that share movable particles, directly or through other constraints, are of one body.
        """
        parts, body = bodies_of(batches, inv_mass)
        most = 1 + sum(b.count for b in batches)
        squares = np.divide(1, inv_mass, out=np.zeros(len(inv_mass)), where=inv_mass > 0) ** 2
        self.rounding_masses = np.sqrt(np.bincount(body, weights=squares, minlength=most))
        self._bodies = {id(b): part for b, part in zip(batches, parts, strict=True)}
        count = np.maximum(np.bincount(body, minlength=most), 1)
        center = np.stack([np.bincount(body, weights=each, minlength=most) / count for each in x.T], axis=1)
        self.body_sizes = np.zeros(most)
        np.maximum.at(self.body_sizes, body, 2 * np.linalg.norm(x - center[body], axis=1))

    def body(self, batch: Batch) -> np.ndarray:
        """Return the body of each constraint of a batch, (m,), where constraints break."""
        return self._bodies[id(batch)]

    @property
    def exact_answers(self) -> bool:
        """Whether no particle belongs to several blocks, so that one answer of each to an impulse is exact."""
        return bool((self._blocks <= 1).all())

    def soften(self, memory: Memory, inv_mass: np.ndarray, batches: list[Batch], softness: float) -> None:
        """Make constraints hold their loads by violations `softness` times as large as those of the solver.

        A pass holds a load F by the violation W h^2 F, so masses are split `softness` times as often. Conjugate gradients hold it
        by sigma W h^2 F, with their floor sigma. Constraints that a pass solves exactly, as no other one shares their particles,
        stay exact.
        """
        memory.write(self.split, self._blocks * inv_mass * np.where(self.sags(inv_mass, batches), softness, 1.0))
        if self.can_soften:
            memory.write(self.softness, softness)
        if self.system and self.system.has_shared_particles:
            memory.write(self.system.blocks_of, self._blocks * np.where(self._blocks > 1, softness, 1.0))

    def sag(self, batch: Batch) -> np.ndarray:
        """Return sigma, (m,), where each constraint of a batch holds a load F by a violation sigma W h^2 F."""
        return self.system.sag(batch) if self.system else np.ones(batch.count)

    @property
    def sags_anywhere(self) -> bool:
        """Whether any constraint bears loads by a violation."""
        return self.can_soften and bool(self._inexact.any() or (self.system and self.system.steps))

    @property
    def _inexact(self) -> np.ndarray:
        """Mask of the particles for which one pass is not exact, because blocks share them, or walls without rows press, (n,)."""
        return self._blocks > self._alone

    def sags(self, inv_mass: np.ndarray, batches: list[Batch]) -> np.ndarray:
        """Return a mask of the particles whose constraints soften() changes, of all that constraints hold."""
        if self._sagging is None:
            self._sagging = self._in_sagging_bodies(batches, inv_mass)
        return self._sagging

    def _in_sagging_bodies(self, batches: list[Batch], inv_mass: np.ndarray) -> np.ndarray:
        """Return a mask of the particles whose constraints a pass does not solve exactly, with all that is connected to them."""
        rows = sum(b.count for b in batches)
        body = bodies_of(batches, inv_mass)[1]
        sags = self._inexact
        for b in batches if self.system and self.system.steps else ():  # conjugate gradients
            sags[b.indices.ravel()[(self.rows(b) >= 0)[b.owner]]] = True
        out = np.zeros(rows + 1, dtype=bool)
        out[body[sags]] = True
        out[rows] = False  # particles that no constraint moves
        return out[body]

    def regroup(self, memory: Memory, change: Regrouping) -> None:
        """Adapt the slots to added and removed particles, none of which any constraint holds."""
        n, first = change.now.count, change.first
        self._blocks, self._sagging = np.append(self._blocks[:first], np.zeros(n - first, dtype=int)), None
        memory.resize(self.begin, n + 1)
        memory.write_from(self.begin, first, np.full(n + 1 - first, self.total))

    def can_reassign(self, inv_mass: np.ndarray, batches: list[Batch]) -> bool:
        """Whether constraints can be moved to other particles with the same kernels.

        That requires that each is relaxed by itself, and that the number of slots and `exact` stay the same.
        """
        if self.system or self.semi_iteration or not all(b.arity for b in batches):
            return False
        degree = assign_slots(batches, inv_mass)[1]
        return int(degree.sum()) == self.total and self.exact == (self._scalars and bool(degree.max(initial=0) <= 1))

    def reassign(self, memory: Memory, inv_mass: np.ndarray, batches: list[Batch]) -> None:
        """Move constraints to other particles: assign slots from their present corners."""
        self._places, self._blocks = assign_slots(batches, inv_mass)
        degree, self._sagging = self._blocks, None
        memory.write(self.begin, np.concatenate([[0], np.cumsum(degree)]))
        memory.write(self.split, degree * inv_mass)
        for b in batches:
            memory.write(b.dev.corners.places, self.places(b))

    def places(self, batch: Batch) -> np.ndarray:
        """Return the slot of each corner of a batch, (m, corners), -1 for corners that cannot move."""
        return self._places[id(batch)]

    def rows(self, batch: Batch) -> np.ndarray:
        """Return the row of each constraint of a batch in the system, (m,), -1 for constraints that are relaxed alone."""
        return self.system.row(batch) if self.system else np.full(batch.count, -1)

    @inline
    def softened(self, w):
        """Return w h^2 / h'^2, where h' is the substep whose stiffness constraints have, see softness.py."""
        return w * at(self.softness, None) if self.can_soften else w

    @ti.func
    def most_tense(self, geometric_stiffness):
        """Return the largest multiplier that the substep can stand, with (omega h)^2 = geometric_stiffness |multiplier|."""
        return TENSEST / geometric_stiffness

    @ti.func
    def limit_multiplier(self, wanted, geometric_stiffness):
        """Return the multiplier `wanted`, limited so that (omega h)^2 = geometric_stiffness |multiplier| is at most TENSEST.

        Where the limit acts, the value without the limit is stored for the report.
        """
        most = self.most_tense(geometric_stiffness)
        if ti.abs(wanted) >= most:
            ti.atomic_max(self.tension[None], ti.cast(TENSEST * ti.abs(wanted) / most, ti.f64))
        return ti.max(-most, ti.min(most, wanted))

    @ti.func
    def classify_turn(self, along, sizes):
        """Return how far a direction turned: 0, BENT or FAR.

        along: the dot product of the old and new direction. sizes: the product of their norms.
        """
        out = 0
        if along < 0.9 * sizes:
            out = BENT
        if along < 0.75 * sizes or sizes == 0:
            out = FAR
        return out

    @ti.func
    def record_turn(self, turn):
        """Store the largest turn. The field is read first, because atomic writes to one place make threads wait."""
        if turn > self.turned[None]:
            ti.atomic_max(self.turned[None], turn)

    @ti.func
    def total_of(self, i):
        """Return the sum of the moves in the slots of particle i, in order [m]."""
        total = 0 * self.state.x[i]
        for s in range(self.begin[i], self.begin[i + 1]):
            total += self.move[s]
        return total

    @ti.func
    def gather(self, i, now):
        """Move particle i by the sum of its slots. In later Newton steps, only particles of systems that take the step move."""
        begin, end = self.begin[i], self.begin[i + 1]
        if ti.static(self.refines):
            if now.newton > 0 and end > begin:
                r = self.system.row_of[begin]
                if r < 0 or not self.system.is_unmet(r):
                    end = begin
        if end > begin:
            correction = 0 * self.state.x[i]
            if ti.static(self.has_system):  # in f64, as large moves cancel
                correction = self.system.total_of(i, begin, end)
            else:
                correction = self.total_of(i)
            self.shift(i, correction, now)
            if ti.static(self.refines):
                self.system.record_move(i, begin, end, correction)

    @ti.func
    def shift(self, i, move, now):
        """Add a move to x_i and d_i. In f32 without low words, x_i gets it with a dither, see State.dithered().

        A move below half a digit of x would be lost in x and kept in d, which brings it to x a substep later. A spring whose
        force is late by h gains energy at the rate omega^2 h, and rigid constraints at rest tremble.
        """
        if ti.static(self.state.sums or self.state.double):
            self.state.shift(i, move)
        else:
            turn = ti.cast(now.tick, ti.u32) * ti.u32(DITHER[0]) + ti.cast(now.it, ti.u32) * ti.u32(DITHER[1])
            self.state.d[i] = self.state.d[i] + move
            self.state.advance(i, self.state.dithered(self.state.x[i], move, turn))
