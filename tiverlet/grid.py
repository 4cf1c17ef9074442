"""Neighbours: the list of near pairs.

The list holds, for each particle, all others closer than the sum of radii plus a skin, sorted by index. It stays valid until
something has moved by half the skin, and no sum over it depends on when it was built, on the hash, or on the skin.
"""

import warnings
from typing import Any

import numpy as np
import taichi as ti

from .cells import Cells
from .feature import Scene
from .material import Table
from .runtime import Memory

CROWDED = 300  # near pairs per particle beyond which the user is told
FARTHEST = 1 << 22  # cells from the origin: beyond it, f32 cannot tell a cell from the next
APPEND, COUNT, FILL = range(3)  # what a scan of the cells around a particle does with the neighbours that it finds


class Luggage:
    """What each pair carries along: a number, or a vector of `width`. lasting: it is part of the state, beyond a substep."""

    field: Any

    def __init__(self, name: str, width: int, lasting: bool):
        self.name, self.width, self.lasting = name, width, lasting


class Grid:
    """The list of near pairs, and what pairs carry along.

    skin: what is listed beyond touching [m]. linked: (m, 2) pairs that are never listed. table: which groups touch. luggage: what
    the entries of the list carry along when it is built anew.
    """

    def __init__(self, scene: Scene, skin: float, linked: np.ndarray, table: Table, luggage: list["Luggage"], parallel: bool):
        n, dim, add = scene.particles.count, scene.particles.dim, scene.memory.field
        self.n, self.dim, self.state, self.radius = n, dim, scene.state, scene.radius
        self.table, self.luggage = table, luggage
        self.lasting = [piece for piece in luggage if piece.lasting]
        self.real, self.skin = scene.real, skin
        self.cells = Cells(scene, scene.particles.radius, skin)
        self.several = self.cells.levels > 1
        parallel = parallel and not self.several  # lists of several levels have parts of any length, in one piece
        self.blocks = 16 if parallel else 1  # parts of the list, each filled by one thread
        self.spread = 512 if parallel else 1  # Taichi gives each CPU thread at least 512 iterations of a loop
        self.origin = add("grid.built_at", n, width=dim)
        self.first = add("grid.first", n, kind=ti.i32)
        self.number = add("grid.number", n, kind=ti.i32)
        self.stale = add("grid.stale", None, kind=ti.i32, values=1)
        self.need = add("grid.need", None, kind=ti.i32)
        self.still = bool((scene.inv_mass == 0).any())  # whether there are pairs that cannot move
        self.linked = len(linked) > 0
        if self.linked:
            both = np.concatenate([linked, linked[:, ::-1]])
            both = np.unique(both, axis=0)
            begin = np.searchsorted(both[:, 0], np.arange(n + 1))
            self.mates = add("grid.linked", len(both), kind=ti.i32, values=both[:, 1])
            self.mates_begin = add("grid.linked_begin", n + 1, kind=ti.i32, values=begin)
        self.old_first = add("grid.old_first", n, kind=ti.i32)
        self.old_number = add("grid.old_number", n, kind=ti.i32)
        self.kept = add("grid.kept", None, kind=ti.i32)  # 1: the old list is put aside for the one that is being built
        self.half = add("grid.half", None, kind=ti.i32)  # of the entries, in which the list is; the old one is in the other
        self.near: Any = None
        self.store: Memory | None = None

    def allocate(self, capacity: int) -> None:
        """Room for `capacity` entries of the list, in a tree of its own, so that it can grow."""
        if 2 * capacity > 2**31 - 1:
            raise MemoryError(f"{capacity} near pairs exceed what a list can index; the particles overlap too much.")
        if self.store:
            self.store.destroy()
        self.capacity = max(1, -(-capacity // self.blocks))  # of one block
        self.room = self.capacity * self.blocks  # of one list
        self.store = Memory(self.real)
        self.near = self.store.field("grid.near", 2 * self.room, kind=ti.i32)
        for piece in self.luggage:
            piece.field = self.store.field(f"grid.{piece.name}", 2 * self.room, width=piece.width)
        self.store.place()

    def grow(self) -> None:
        """Make room for what the last build needed, and a quarter more."""
        each = self.need[None] * self.blocks / self.n
        if each > CROWDED:
            warnings.warn(
                f"Contact: up to {each:.0f} near pairs per particle, so steps cost as the square of their number. Particles "
                "overlap each other, or one is much larger than the rest.",
                stacklevel=2,
            )
        assert self.store
        before, old = self.room, 1 - self.half[None]
        kept = [self.store.read(field)[old * before :][:before] for field in self._fields()]
        self.allocate(int(self.need[None] * 1.25 + 16) * self.blocks)
        for field, values in zip(self._fields(), kept, strict=True):
            self._aside(field, values)
        self.old_first.from_numpy(self.old_first.to_numpy() + np.int32(old * (self.room - before)))
        self.stale[None] = 1

    def _fields(self) -> list:
        return [self.near, *(piece.field for piece in self.luggage)]

    def _aside(self, field, values: np.ndarray) -> None:
        """Write the entries of the old list."""
        room = np.zeros((2 * self.room, *values.shape[1:]), dtype=values.dtype)
        room[(1 - self.half[None]) * self.room :][: len(values)] = values
        self.store.write(field, room)  # type: ignore[union-attr]

    @property
    def finest(self) -> float:
        """The size of the smallest cells [m]."""
        return float(self.cells.sizes.min())

    def fit(self, extent: np.ndarray) -> None:
        """Shape the hash for the extent of the particles [m]; affects speed only."""
        if self.cells.fit(extent):
            self.stale[None] = 1

    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """The listed pairs (m, 2) with i < j, in order, and where they are in the list."""
        assert self.store
        i, at = self._entries(self.first, self.number)
        pairs = np.stack([i, self.store.read(self.near)[at]], axis=1).astype(np.int64)
        some = pairs[:, 0] < pairs[:, 1]
        return pairs[some], at[some]

    def read(self, piece: Luggage, at: np.ndarray) -> np.ndarray:
        """What some entries of the list carry."""
        assert self.store
        return self.store.read(piece.field)[at].astype(np.float64)

    def _entries(self, first, number) -> tuple[np.ndarray, np.ndarray]:
        """For every entry of the lists, whose it is and where it is."""
        first, number = first.to_numpy()[: self.n], number.to_numpy()[: self.n]
        i = np.repeat(np.arange(self.n), number)
        return i, np.repeat(first, number) + np.arange(len(i)) - np.repeat(np.cumsum(number) - number, number)

    def carried(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Every listed pair (i, j) that carries something lasting other than 0, in order, and what: the same whatever the list's
        layout."""
        assert self.store
        aside = bool(self.kept[None])  # given by restore(), and not built into a list yet
        first, number = (self.old_first, self.old_number) if aside else (self.first, self.number)
        i, at = self._entries(first, number)
        near = self.store.read(self.near)[at]
        values = {piece.name: self.store.read(piece.field)[at] for piece in self.lasting}
        some = np.zeros(len(i), dtype=bool)
        for value in values.values():
            some |= (value != 0) if value.ndim == 1 else (value != 0).any(axis=1)
        return np.stack([i[some], near[some]], axis=1), {name: value[some] for name, value in values.items()}

    def restore(self, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Give what carried() returned to the next list that is built."""
        if len(pairs) > self.room:
            self.allocate(len(pairs))
        self._aside(self.near, pairs[:, 1].astype(np.int32))
        for piece in self.lasting:
            self._aside(piece.field, values[piece.name])
        counts = np.bincount(pairs[:, 0], minlength=max(1, self.n))
        begin = (1 - self.half[None]) * self.room
        self.old_first.from_numpy((begin + np.cumsum(counts) - counts).astype(np.int32))
        self.old_number.from_numpy(counts.astype(np.int32))
        self.kept[None] = self.stale[None] = 1

    @ti.func
    def keep(self):
        """Put the list aside, unless one is there already, from a build that did not fit."""
        kept = self.kept[None]
        for i in range(self.n):
            if kept == 0:
                self.old_first[i], self.old_number[i] = self.first[i], self.number[i]
        ti.loop_config(serialize=True)
        for _ in range(1):
            if self.kept[None] == 0:
                self.half[None] = 1 - self.half[None]
            self.kept[None] = 1
            self.need[None] = 0

    @ti.func
    def carry(self, i):
        """Give each neighbour of particle i what it carried in the old list; both are sorted."""
        old, end = self.old_first[i], self.old_first[i] + self.old_number[i]
        for e in range(self.first[i], self.first[i] + self.number[i]):
            j = self.near[e]
            while old < end and self.near[old] < j:
                old += 1
            for piece in ti.static(self.luggage):
                piece.field[e] = ti.zero(piece.field[e])  # 0 times what is there could be -0
                if old < end and self.near[old] == j:
                    piece.field[e] = piece.field[old]

    @ti.func
    def watch(self, i):
        """The list is stale once a particle has moved by half the skin."""
        r = self.state.x[i] - self.origin[i]
        if not (r.dot(r) <= ti.cast((0.49 * self.skin) ** 2, self.real)):  # "not <=" also catches NaN
            if self.stale[None] == 0:  # threads that all write to the same place wait for each other
                self.stale[None] = 1

    @ti.func
    def build(self):
        """Sort the particles into cells, then list the near ones of each."""
        self.keep()
        self.cells.sort()
        if ti.static(self.several):
            self.pair_up()
        else:
            for t in range(self.blocks * self.spread):
                if t % self.spread == 0:
                    self.fill(t // self.spread)
        for i in range(self.n):
            self.origin[i] = self.state.x[i]
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.stale[None] = 0
            if self.need[None] <= self.capacity:
                self.kept[None] = 0

    @ti.func
    def fill(self, block):
        """One level: list the neighbours of a block of particles, one after the other. Beyond the room they are only counted."""
        start, room = self.half[None] * self.room + block * self.capacity, self.capacity
        size = (self.n + self.blocks - 1) // self.blocks
        used = 0
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.first[i] = start + ti.min(used, room)
            begin = used
            used = self.scan(i, APPEND, start, used)
            self.number[i] = ti.max(ti.min(used, room) - begin, 0)
            self.finish(i)
        ti.atomic_max(self.need[None], used)

    @ti.func
    def pair_up(self):
        """Several levels: count, then list each pair that one of the two finds with both."""
        for i in range(self.n):
            self.number[i] = 0
        ti.loop_config(serialize=self.cells.serial)
        for i in range(self.n):
            self.scan(i, COUNT, 0, 0)
        ti.loop_config(serialize=True)
        for i in range(self.n):
            self.first[i] = self.half[None] * self.room + self.need[None]
            self.need[None] += self.number[i]
            self.number[i] = 0
        ti.loop_config(serialize=self.cells.serial)
        for i in range(self.n):
            if self.need[None] <= self.capacity:
                self.scan(i, FILL, 0, 0)
        for i in range(self.n):
            self.finish(i)

    @ti.func
    def finish(self, i):
        """Put the list of particle i in order."""
        self.order(self.first[i], self.number[i])
        self.carry(i)

    @ti.func
    def scan(self, i, what: ti.template(), start, used):  # type: ignore[valid-type]
        """Look for neighbours in the cells around particle i, at its own level and the coarser ones."""
        own = self.cells.level_of(i)
        for m in range(own + 1):
            cell = self.cells.home(i, m)
            for r in range(ti.static(3 ** (self.dim - 1))):
                base, low, mask, span = self.cells.row(cell, m, r)
                for part in range(3 // span):
                    b = base + ((low + part) & mask)
                    for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                        j = self.cells.sorted[e]
                        if j != i and self.listed(i, j):
                            if ti.static(what == APPEND):
                                if used < self.capacity:
                                    self.near[start + used] = j
                                used += 1
                            else:
                                self.note(i, j, what)
                                if m < own:
                                    self.note(j, i, what)
        return used

    @ti.func
    def note(self, i, j, what: ti.template()):  # type: ignore[valid-type]
        """Count j among the neighbours of i, and list it."""
        k = ti.atomic_add(self.number[i], 1)
        if ti.static(what == FILL):
            self.near[self.first[i] + k] = j

    @ti.func
    def listed(self, i, j):
        """Whether a pair belongs on the list: near, not both immovable, not linked."""
        r = self.state.apart(i, j)
        far = self.radius.of(i) + self.radius.of(j) + ti.cast(self.skin, self.real)
        yes = r.dot(r) < far * far
        if ti.static(self.still):
            if yes:
                yes = self.state.w[i] + self.state.w[j] > 0
        if ti.static(not self.table.uniform):
            if yes:
                yes = self.table.of(i, j)[3] > 0
        if ti.static(self.linked):
            if yes:
                for e in range(self.mates_begin[i], self.mates_begin[i + 1]):
                    if self.mates[e] == j:
                        yes = False
        return yes

    @ti.func
    def order(self, begin, count):
        """Insertion sort by index: lists are short, and this makes every sum over them independent of the table."""
        for a in range(1, count):
            j = self.near[begin + a]
            b = a
            while b > 0 and self.near[begin + b - 1] > j:
                self.near[begin + b] = self.near[begin + b - 1]
                b -= 1
            self.near[begin + b] = j
