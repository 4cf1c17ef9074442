"""What the user of a world reads and sets: state, clock, settings, and who is near or in contact."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from .. import checks
from ..constraints.core.strength import BREAKS
from ..device.interrupts import whole
from ..device.memory import Memory
from ..features.feature import Feature
from ..features.read_only import assign_whole, read_only
from ..neighbours.queries import Contacts, Search, near_by_all, nearest
from ..particles import Particles, in_range
from ..step_report import StepReport
from . import edit_scene, high_order
from .edit_scene import Handle
from .step import FREE


class Access:
    """The half of a World that does not step it."""

    _particles: Particles
    _features: tuple[Feature, ...]
    _memory: Memory
    _solver: Any
    _scene: Any
    _sub: Any
    _guard: Any
    _grid: Any
    _h: float
    _time: float
    _tick: int
    _fresh: bool
    _started: bool
    _owed: float
    _parted: np.ndarray | None
    _drag: list[float] | None
    _placed: int | None
    _handles: Any
    _energy: float | None
    _last: StepReport | None
    _search: Search | None
    _precision: str
    _path: str
    _order: int
    _watchers: list[Any]
    _restart: Any
    _list: Any
    _look: Any

    @property
    def position(self) -> np.ndarray:
        """Positions [m], (n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        return read_only(self._scene.state.get(self._memory), assign_whole("World", "position"))

    @position.setter
    def position(self, value) -> None:
        value = checks.points("World", "position", value, dim=self._particles.dim, count=len(self._particles))
        in_range("World", "position", value)
        if self._sub.contacts:
            self._sub.contacts[0].check_range(value)
        self._memory.check()
        with whole:
            for watcher in self._watchers:
                watcher.assigned("position", value)
            with self._memory.compiler():
                self._restart()
                self._scene.state.put(self._memory, value)
            self._energy, self._placed = None, 0
            if self._grid:
                self._grid.age()

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (n, dim), a read-only copy in f64; of the order of the world. Assign an array to set them."""
        if self._parted is not None:
            return read_only(self._parted.copy(), assign_whole("World", "velocity"))
        if self._order == 2 or self._fresh:
            return self._export(self._sub.velocities, self._h, self._time, int(self._fresh), *self._shares())
        self._memory.check()
        with whole, self._memory.compiler():
            out = high_order.velocity(self)[: len(self._particles)]
        return read_only(out, assign_whole("World", "velocity"))

    @velocity.setter
    def velocity(self, value) -> None:
        value = checks.points("World", "velocity", value, dim=self._particles.dim, count=len(self._particles))
        self._memory.check()
        with whole:
            for watcher in self._watchers:
                watcher.assigned("velocity", value)
            self._scene.state.start(self._memory, value)
            self._fresh, self._energy, self._owed, self._parted = True, None, 0.0, None

    def _shares(self) -> tuple[float, float]:
        """What multipliers of the last substep are to be taken for: h^2 over what an acceleration added to the displacement. A
        start from velocities without what rigid constraints did in half a substep left that to them, too."""
        drag = self._drag or FREE
        if not self._started:
            return 1 / drag[1], 1 / drag[1]
        owed = drag[1] * self._owed / self._h
        return 1 / (drag[2] + owed), 1 / drag[2]

    def _export(self, kernel, *args) -> np.ndarray:
        self._memory.check()
        out = np.zeros((max(1, len(self._particles)), self._particles.dim))
        with self._memory.compiler():
            kernel(*args, out)
        return read_only(out[: len(self._particles)], assign_whole("World", "velocity"))

    def near(self, points, radius) -> np.ndarray:
        """The particles whose centers are within `radius` [m] of points: (m, 2), rows of `points` and particles, in order.

        points: (k, dim) [m]. radius: number or (k,), at least 0. With a Contact in the world its grid is used; without, all are
        compared.
        """
        points = checks.points("World.near", "points", points, dim=self._particles.dim)
        radius = checks.per_item("World.near", "radius", radius, len(points), least=0.0)
        self._memory.check()
        if not len(points) or not len(self._particles):
            return np.zeros((0, 2), dtype=np.int64)
        if not self._grid:
            return near_by_all(self.position, points, radius)
        with whole:
            self._list()
            with self._memory.compiler():
                self._search = self._search or Search(self._grid)
                return self._search.near(points, radius)

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Index of, and distance [m] to, the particle whose center is nearest to each point; of equally near ones the first."""
        points = checks.points("World.nearest", "points", points, dim=self._particles.dim)
        if not len(self._particles):
            raise ValueError("World.nearest: there are no particles.")
        position = self.position
        start = self._grid.finest if self._grid else 2 * float(np.abs(position).max() + np.abs(points).max(initial=1.0))
        return nearest(self.near, position, points, start)

    @property
    def contacts(self) -> Contacts:
        """What touches now, as arrays: discs or spheres, and vertices and edges of Polygons. Empty without a Contact."""
        self._memory.check()
        if not self._grid:
            none, index = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
            vectors = np.zeros((0, self._particles.dim))
            return Contacts(index, index[:, 0], none, none, vectors, vectors, none)
        contact = self._sub.contacts[0]
        with whole:
            self._list()
            if contact.measures and self._sub.launched:
                self._look()  # which measures; elsewhere it makes the list, too
        return contact.found(self.position, self._h or 1.0)

    @property
    def broken(self) -> list[tuple[Feature, np.ndarray]]:
        """What broke in the last frame: features, and the indices of their constraints. Those of all frames: feature.broken."""
        self._memory.check()
        out = []
        if self._last and self._last.broken:
            for f in self._sub.breakers:
                stamps = f.stamps()
                recent = (stamps > 0) & ((self._tick - stamps) % BREAKS < self._last.substeps)
                if recent.any():
                    out.append((f, np.flatnonzero(recent)))
        return out

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._time

    @property
    def last(self) -> StepReport | None:
        """The report of the last step; None before the first."""
        return self._last

    @property
    def particles(self) -> Particles:
        """What the world was built from: initial state and structure."""
        return self._particles

    @property
    def features(self) -> tuple[Feature, ...]:
        """What acts on the particles."""
        return self._features

    @property
    def precision(self) -> str:
        """ "f32", "f32-compensated" or "f64"."""
        return self._precision

    @property
    def order(self) -> int:
        """Of the error in the substep."""
        return self._order

    @property
    def path(self) -> str:
        """ "fused" or "parallel"."""
        return self._path

    @property
    def substeps(self) -> int:
        """Substeps of a frame; of the next one where they are chosen. Assign a number, or "auto"."""
        return self._guard.substeps if self._guard.auto else self._substeps

    @substeps.setter
    def substeps(self, value: int | str) -> None:
        if isinstance(value, str) and value != "auto":
            raise ValueError(f'World: substeps = {value!r}, but it must be an integer of at least 1, or "auto".')
        self._guard.auto = value == "auto"
        if not self._guard.auto:
            self._substeps = checks.integer("World", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in a substep."""
        return self._iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        value = checks.integer("World", "iterations", value, least=1)
        self._solver.check(value)
        self._iterations = value

    @property
    def fields(self) -> dict[str, int]:
        """Every field on the device, by name, and its size [bytes]."""
        return {e.name: e.bytes for memory in self._memories for e in memory.entries}

    def add(self, particles: Particles | None = None, features: Iterable[Feature] = ()) -> Handle:
        """Add particles and features, between frames. Returns a handle to the particles, see Handle.

        The new particles come after the last; features name all of them by their numbers, so a rope that is added on top of n
        particles has the links shapes.rope(...).links + n. Rest values that are not given are taken from the present positions.
        Particles that overlap others part gently, as at the start.

        What was there goes on to the bit: time, positions, velocities, multipliers, the history of springs, what pairs in contact
        remember. Where a force or a spring is added, displacements are first turned into velocities, as when a force changes.
        It costs what building a world costs, some seconds of compiling for a large scene: add many things at once.

        Raises as World() does; the world is then as before.
        """
        with whole:
            return edit_scene.add(self, particles, features)

    def remove(self, particles: Any = (), features: Iterable[Feature] = ()) -> None:
        """Remove particles and features, between frames.

        particles: a handle, indices or a Boolean mask. The others close up, in order. A constraint goes with any of its
        particles, and so do a loop, a surface, a cluster or a body of Polygons, whole; what it was part of stays, with what is
        left, in the same Python object, and costs nothing once it is empty. features: of world.features; they become free.

        What stays goes on to the bit, see add(). A force that goes with a particle is gone from the next substep on, as when a
        constraint breaks. Functions of the user's own that take the number of a particle or constraint get the new one.

        Raises ValueError or TypeError for what there is not; the world is then as before.
        """
        with whole:
            edit_scene.remove(self, particles, features)

    def handle(self, particles: Any) -> Handle:
        """A handle to some particles, by indices or a Boolean mask; it knows their numbers when others are removed."""
        self._memory.check()
        return edit_scene.handle(self, edit_scene.chosen(self, "World.handle", particles))

    @property
    def _memories(self) -> list[Memory]:
        """The trees of fields: one from the start, others where a list or a need has grown."""
        grown = [self._grid.store if self._grid else None, *(c.dev.store for c in self._sub.contacts)]
        return [self._memory, *(m for m in grown if m)]
