"""How constraints answer the impulses of contacts, each kind in its own way.

- Rows: links that are relaxed by themselves, in the passes of contacts (links.py).
- Systems: links that are eliminated together, with the matrix of this substep (Elimination.answer_part()).
- By themselves: rigid and soft clusters, and particles that are drawn to a place (Passes.answer()).

The last two write the sum of their answers to Slots.answer after each pass. An answer is a projection in the metric of masses,
and raises no eigenvalue of a pass.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from ..solvers.corners import corners_of
from .links import Links

if TYPE_CHECKING:
    from ..device.memory import Memory
    from ..features.feature import Batch, Scene
    from .rows import Rows


class Answers:
    """The constraints of one world that answer contacts.

    held: how far the answers of systems, clusters and places move each particle [m]. mobility: where clusters are, by how much a
    unit impulse moves each particle at most [1/kg]. begin, particle: the particles that each constraint connects.
    """

    n: Any = OnDevice()

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
            self.mobility = add("answers.mobility", count)
        self.n = scene.memory.number(sum(b.count for b in batches))
        begin, particle = self._tables(scene.inv_mass)
        self.begin = add("answers.begin", len(begin), kind=ti.i32, values=begin)
        self.particle = add("answers.particle", len(particle), kind=ti.i32, values=particle)

    def _tables(self, inv_mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the movable particles of each constraint begin, and these particles."""
        owner, item = corners_of(self.batches)
        movable = inv_mass[item] > 0
        count = sum(b.count for b in self.batches)
        return np.searchsorted(owner[movable], np.arange(count + 1)), item[movable]

    def reassign(self, memory: "Memory", inv_mass: np.ndarray) -> None:
        """Follow constraints that moved to other particles, as many of which can move as before."""
        begin, particle = self._tables(inv_mass)
        memory.write(self.begin, begin)
        memory.write(self.particle, particle)
        self.links.reassign(memory, len(inv_mass))

    @ti.func
    def begin_particle(self, i):
        """Begin a substep: no answers to particle i."""
        if ti.static(self.answer_later):
            self.held[i] = 0 * self.state.d[i]
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                self.slots.answer[s] = 0 * self.state.d[i]
        if ti.static(self.has_clusters):
            self.mobility[i] = self.state.w.of(i)

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
    def scale(self, i, scale):
        """Multiply the answers to particle i by a number."""
        for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
            if ti.static(self.answer_later):
                self.slots.answer[s] = scale * self.slots.answer[s]
            r = self.links.row_of[s]
            if r >= 0:
                if self.links.is_first(s):
                    self.links.mu[r] = scale * self.links.mu[r]
        for system in ti.static(self.systems):
            for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                r = system.row_of[s]
                if r >= 0:
                    if system.corner[system.corner_begin[r]] == s:
                        system.answer[r] = scale * system.answer[r]
        if ti.static(self.answer_later):
            self.held[i] = scale * self.held[i]
