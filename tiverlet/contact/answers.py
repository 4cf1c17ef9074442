"""How constraints answer the impulses of contacts, each kind in its own way.

- Rows: links that are relaxed by themselves, in the passes of contacts (links.py).
- Systems: links that are eliminated together, with the matrix of this substep (Elimination.answer_part()).
- By themselves: rigid and soft clusters, and particles that are drawn to a place (Passes.answer()).

The last two write the sum of their answers to Slots.answer after each pass. An answer is a projection in the metric of masses,
and raises no eigenvalue of a pass. Where one of each is exact, rounds of impacts have answers of their own, see impacts.py.
"""

from typing import TYPE_CHECKING

import numpy as np

from ..device import at, inline, ti
from ..solvers.corners import bodies_of
from .links import Links

TURN = 1 / 64  # of its length: by how much places may move an end of a link in a substep

if TYPE_CHECKING:
    from ..device.memory import Memory
    from ..features.feature import Batch, Scene
    from .rows import Rows


def answer_at_once(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether one answer of each constraint is the answer of all: none is a row, and none shares a particle with another one."""
    slots = scene.slots
    if not batches:
        return True
    eliminated = bool(slots.system) and slots.system.answers
    rows = [b for b in batches if not b.answers_alone]
    return slots.exact_answers and all(eliminated and (slots.rows(b) >= 0).all() for b in rows)


class Answers:
    """The constraints of one world that answer contacts.

    held: how far the answers of systems, clusters and places move each particle [m]. mobility: where clusters are, by how much a
    unit impulse moves each particle at most [1/kg]; shared: the largest eigenvalue of how all rows of its body move it, over the
    number of these rows [1/kg]. below: how many numbers below each particle the first one of its body is, which constraints
    connect with it; 0 for particles that come later.

    Of rounds of impacts: before: the answers before a round, of slots and rows of systems; given: how far all rounds have moved
    each particle by answers [m].
    """

    def __init__(self, scene: "Scene", batches: "list[Batch]", rows: "Rows"):
        slots, add, count, dim = scene.slots, scene.memory.field, scene.count, scene.particles.dim
        self.state, self.slots, self.batches = scene.state, slots, batches
        self.links = Links(scene, batches, rows)
        self.systems = [slots.system] if slots.system and slots.system.answers else []
        self.alone = [b for b in batches if b.answers_alone]
        self.has_clusters = any(b.clusters for b in batches)
        self.answer_later = bool(self.systems or self.alone)
        if self.answer_later:
            self.held, self.nothing = add("answers.held", count, width=dim), add("answers.nothing", count, width=dim)
        if self.has_clusters:
            self.mobility, self.shared = add("answers.mobility", count), add("answers.shared", count)
        self.below = add("answers.below", count, kind=ti.i32, values=self._below(scene.inv_mass))
        self.in_turn = bool(rows.impacts)
        if self.in_turn:
            self.given = add("answers.given", count, width=dim)
            self.before = add("answers.before", slots.total, width=dim)
            self.before_row = add("answers.before_row", slots.system.rows if self.systems else 1, kind=ti.f64)

    def _below(self, inv_mass: np.ndarray) -> np.ndarray:
        """Return `below`, (n,)."""
        label = bodies_of(self.batches, inv_mass)[1]
        _labels, first, where = np.unique(label, return_index=True, return_inverse=True)
        return np.where(label < sum(b.count for b in self.batches), np.arange(len(label)) - first[where], 0)

    def reassign(self, memory: "Memory", inv_mass: np.ndarray) -> None:
        """Follow constraints that moved to other particles, as many of which can move as before."""
        memory.write(self.below, self._below(inv_mass))
        self.links.reassign(memory, len(inv_mass))

    @ti.func
    def begin_particle(self, i):
        """Begin a substep: no answers to particle i."""
        if ti.static(self.answer_later):
            self.held[i] = 0 * self.state.d[i]
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                self.slots.answer[s] = 0 * self.state.d[i]
        if ti.static(self.in_turn):
            self.given[i] = 0 * self.state.d[i]
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                self.before[s] = 0 * self.state.d[i]
                for system in ti.static(self.systems):
                    r = system.row_that_begins(s)
                    if r >= 0:
                        self.before_row[r] = 0
        if ti.static(self.has_clusters):
            self.mobility[i] = self.shared[i] = self.state.w[i]

    @ti.func
    def body(self, i):
        """Return the first particle of the body of particle i."""
        return i - self.below[i]

    @ti.func
    def holds(self, i):
        """Whether any constraint holds particle i."""
        return self.slots.begin[i + 1] > self.slots.begin[i]

    @ti.func
    def hold(self, i):
        """Sum up the answers to particle i. Returns by how much they have changed."""
        held = 0 * self.state.d[i]
        for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
            held += self.slots.answer[s]
        change = held - self.held[i]
        self.held[i] = held
        return change

    @ti.func
    def count_left(self, i):
        """Return how many rows of systems, whose first corner is particle i, places have left violated."""
        out = 0 * self.state.w[i]
        for system in ti.static(self.systems):
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                r = system.row_that_begins(s)
                if r >= 0:
                    out += ti.select(system.left[r] != 0, 1 + 0 * out, 0 * out)
        return out

    @ti.func
    def most_placed(self, i):
        """Return by how much places may move particle i in a substep, so that what holds it turns little [m]."""
        out = ti.math.inf + 0 * self.state.w[i]
        for system in ti.static(self.systems):
            if system.particle_inverse_size[i] > 0:
                out = ti.static(TURN) / system.particle_inverse_size[i]
        return out

    @inline
    def beyond(self, i):
        """Return how far answers of passes move particle i, without those of rounds [m]."""
        return at(self.held, i) - at(self.given, i) if self.in_turn else at(self.held, i)

    @ti.func
    def keep(self, i):
        """Keep the answers to particle i as they are before a round of impacts, or after the last one."""
        self.given[i] = self.held[i]
        for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
            self.before[s] = self.slots.answer[s]
        for system in ti.static(self.systems):
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                r = system.row_that_begins(s)
                if r >= 0:
                    self.before_row[r] = system.answer[r]

    @ti.func
    def scale(self, i, scale):
        """Multiply the answers to particle i by a number, or what a round of impacts has added to them."""
        for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
            if ti.static(self.in_turn):
                self.slots.answer[s] = self.before[s] + scale * (self.slots.answer[s] - self.before[s])
            elif ti.static(self.answer_later):
                self.slots.answer[s] = scale * self.slots.answer[s]
            r = self.links.row_of[s]
            if r >= 0:
                if self.links.is_first(s):
                    self.links.mu[r] = scale * self.links.mu[r]
        for system in ti.static(self.systems):
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                r = system.row_that_begins(s)
                if r >= 0:
                    before = 0 * system.answer[r]
                    if ti.static(self.in_turn):
                        before = self.before_row[r]
                    system.answer[r] = before + scale * (system.answer[r] - before)
        if ti.static(self.in_turn):
            self.held[i] = self.given[i] + scale * (self.held[i] - self.given[i])
        elif ti.static(self.answer_later):
            self.held[i] = scale * self.held[i]
