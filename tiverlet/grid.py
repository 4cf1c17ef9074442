"""Neighbours: the list of near pairs.

The list holds, for each particle, all others closer than the sum of radii plus a skin, sorted by index. It stays valid until
something has moved by half the skin, and no sum over it depends on when it was built, on the hash, or on the skin.
"""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import taichi as ti

from .cells import Cells, raised
from .compiling import FEW
from .feature import Scene
from .material import Table
from .memory import Memory
from .sorting import exchange, sort, sorting_network
from .sums import MOST, Sums
from .team import Team
from .tools import distinct

CROWDED = 300  # near pairs per particle beyond which the user is told
FARTHEST = 1 << 22  # cells from the origin: beyond it, f32 cannot tell a cell from the next
WORD, FULL = 32, 2**32 - 1  # entries that one word of bits is for
APPEND, COUNT, FILL = range(3)  # what a scan of the cells around a particle does with the neighbours that it finds


class Luggage:
    """What each pair carries along: a number, or a vector of `width`.

    lasting: it is part of the state, beyond a substep. kept: it goes from list to list; what is not has to be worked out anew.
    marked: only pairs whose bit in Grid.touching is set have other than 0.
    """

    field: Any
    aside: Any

    def __init__(self, name: str, width: int, lasting: bool, kept: bool = True, marked: bool = False):
        self.name, self.width, self.lasting, self.kept, self.marked = name, width, lasting, kept, marked


class Grid:
    """The list of near pairs, and what pairs carry along.

    skin: what is listed beyond touching [m]. linked: (m, 2) pairs that are never listed. table: which groups touch. luggage: what
    the entries of the list carry along when it is built anew. scratch: a field of vectors, (n,), to use while it is built.
    """

    def __init__(
        self, scene: Scene, skin: float, linked: np.ndarray, table: Table, luggage: list["Luggage"], team: Team, scratch: Any
    ):  # fmt: skip
        self.team = team
        n, dim, add = scene.particles.count, scene.particles.dim, scene.memory.field
        self.n, self.dim, self.state, self.radius = n, dim, scene.state, scene.radius
        self.table, self.luggage = table, luggage
        self.lasting, self.bags = [p for p in luggage if p.lasting], [p for p in luggage if p.kept]
        self.marked = all(p.marked for p in self.bags)
        self.real, self.memory, self.skin = scene.real, scene.memory, skin
        self._extent: Sequence[float] = [-1.0] * dim
        self.cells = Cells(scene, scene.particles.radius, skin, team, scratch)
        self.several = self.cells.levels > 1
        self.counts = self.several or team.launched  # before it lists
        self.serial = not self.counts or (team.size == 1 and not team.launched)  # one thread makes a list, in order
        # Parts of the list, each filled by one thread.
        self.blocks = max(1, -(-n // team.piece)) if team.size > 1 and not self.counts else 1
        self.origin = add("grid.built_at", n, width=dim)
        self.sums = Sums(n, team, capped=True)
        self.first = add("grid.first", self.sums.room, kind=ti.i32)
        self.number = add("grid.number", n, kind=ti.i32)
        self.stale = add("grid.stale", None, kind=ti.i32, values=1)
        self.need = add("grid.need", None, kind=ti.i32)
        self.still = bool((scene.inv_mass == 0).any())  # whether there are pairs that cannot move
        self.linked = len(linked) > 0
        if self.linked:
            both = np.concatenate([linked, linked[:, ::-1]])
            both = distinct(both)[0]
            begin = np.searchsorted(both[:, 0], np.arange(n + 1))
            self.mates = add("grid.linked", len(both), kind=ti.i32, values=both[:, 1])
            self.mates_begin = add("grid.linked_begin", n + 1, kind=ti.i32, values=begin)
        self.touching = add("grid.touching", n, kind=ti.u32)  # bits: which of the first entries touch, when last looked at
        self.old_first = add("grid.old_first", n, kind=ti.i32)
        self.old_number = add("grid.old_number", n, kind=ti.i32)
        self.kept = add("grid.kept", None, kind=ti.i32)  # 1: the old list is put aside for the one that is being built
        # Entries of a list that is sorted without branches; to compile that takes an eighth of all.
        self.short = 1 if n < FEW else 8 if dim == 2 else 16
        self.network = sorting_network(self.short)
        self.near: Any = None
        self.aside: Any = None  # those of the old list that carry something, while a new one is built
        self.store: Memory | None = None

    def allocate(self, capacity: int) -> None:
        """Room for `capacity` entries of the list, in a tree of its own, so that it can grow."""
        if 2 * capacity > 2**31 - 1:
            raise MemoryError(f"{capacity} near pairs exceed what a list can index; the particles overlap too much.")
        if self.store:
            self.store.destroy()
        self.capacity = max(1, -(-capacity // self.blocks))  # of one block
        self.pitch = self.capacity + self.short  # from one block to the next
        self.room = self.pitch * self.blocks  # of one list
        self.store = Memory(self.real)
        self.near = self.store.field("grid.near", self.room, kind=ti.i32)
        self.aside = self.store.field("grid.aside", self.room, kind=ti.i32)
        for piece in self.luggage:
            piece.field = self.store.field(f"grid.{piece.name}", self.room, width=piece.width)
            if piece.kept:
                piece.aside = self.store.field(f"grid.{piece.name}_aside", self.room, width=piece.width)
        self.store.place()

    def grow(self) -> None:
        """Make room for what the last build needed, and a quarter more."""
        need = int(self.memory.read(self.need)[0])
        each = need * self.blocks / self.n
        if each > CROWDED:
            warnings.warn(
                f"Contact: up to {each:.0f} near pairs per particle, so steps cost as the square of their number. Particles "
                "overlap each other, or one is much larger than the rest.",
                stacklevel=2,
            )
        assert self.store
        kept = [self.store.read(field) for field in self._fields()]
        self.allocate(int(need * 1.25 + 16) * self.blocks)
        for field, values in zip(self._fields(), kept, strict=True):
            self._aside(field, values)
        self.age()

    def _fields(self) -> list:
        return [self.aside, *(piece.aside for piece in self.bags)]

    def _aside(self, field, values: np.ndarray) -> None:
        """Write what was put aside."""
        room = np.zeros((self.room, *values.shape[1:]), dtype=values.dtype)
        room[: len(values)] = values
        self.store.write(field, room)  # type: ignore[union-attr]

    @property
    def finest(self) -> float:
        """The size of the smallest cells [m]."""
        return float(self.cells.sizes.min())

    def fit(self, extent: Sequence[float]) -> None:
        """Shape the hash for the extent of the particles [m], if it is another one by an eighth; affects speed only."""
        for new, old in zip(extent, self._extent, strict=True):
            if not abs(new - old) <= old / 8:
                self._extent = extent
                if self.cells.fit(np.asarray(extent)):
                    self.age()
                return

    def age(self) -> None:
        """Have a new list built in the next frame."""
        self.memory.write(self.stale, 1)  # Taichi would compile a kernel for stale[None] = 1

    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """The listed pairs (m, 2) either way round, in order, and where they are in the list."""
        assert self.store
        i, at = self._entries(self.first, self.number)
        return np.stack([i, self.store.read(self.near)[at]], axis=1).astype(np.int64), at

    def read(self, piece: Luggage, at: np.ndarray) -> np.ndarray:
        """What some entries of the list carry."""
        assert self.store
        return self.store.read(piece.field)[at].astype(np.float64)

    def _entries(self, first, number) -> tuple[np.ndarray, np.ndarray]:
        """For every entry of the lists, whose it is and where it is."""
        first, number = self.memory.read(first)[: self.n], self.memory.read(number)[: self.n]
        i = np.repeat(np.arange(self.n), number)
        return i, np.repeat(first, number) + np.arange(len(i)) - np.repeat(np.cumsum(number) - number, number)

    def carried(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Every listed pair (i, j) that carries something lasting other than 0, in order, and what: the same whatever the list's
        layout."""
        assert self.store
        aside = bool(self.memory.read(self.kept)[0])  # given by restore(), and not built into a list yet
        first, number = (self.old_first, self.old_number) if aside else (self.first, self.number)
        i, at = self._entries(first, number)
        near = self.store.read(self.aside if aside else self.near)[at]
        values = {piece.name: self.store.read(piece.aside if aside else piece.field)[at] for piece in self.lasting}
        some = np.zeros(len(i), dtype=bool)
        for value in values.values():
            some |= (value != 0) if value.ndim == 1 else (value != 0).any(axis=1)
        return np.stack([i[some], near[some]], axis=1), {name: value[some] for name, value in values.items()}

    def restore(self, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Give what carried() returned to the next list that is built."""
        if len(pairs) > self.room:
            self.allocate(len(pairs))
        self._aside(self.aside, pairs[:, 1].astype(np.int32))
        for piece in self.bags:
            self._aside(piece.aside, values[piece.name] if piece.lasting else np.zeros((1, *[piece.width] * (piece.width > 0))))
        counts = np.bincount(pairs[:, 0], minlength=max(1, self.n))
        self.memory.write(self.old_first, np.cumsum(counts) - counts)
        self.memory.write(self.old_number, counts)
        self.memory.write(self.kept, 1)
        self.age()

    @ti.func
    def keep(self, me):
        """Put the list aside, unless one is there already, from a build that did not fit."""
        kept = self.kept[None]
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            if kept == 0:
                self.pack(i)
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, me)):
            self.kept[None] = 1
            self.need[None] = 0

    @ti.func
    def pack(self, i):
        """Put aside what carries something."""
        first = self.first[i]
        at = first
        for word in range(self.words(i)):
            bits = self.whole(i, word)
            if ti.static(self.marked):
                if word == 0:
                    bits = self.touching[i]
            while bits != 0:
                e = first + word * WORD + lowest(bits)
                bits &= bits - ti.u32(1)
                some = 0
                self.aside[at] = self.near[e]
                for piece in ti.static(self.bags):
                    value = piece.field[e]
                    piece.aside[at] = value
                    if ti.static(piece.width == 0):
                        some |= ti.cast(value != 0, ti.i32)
                    else:
                        for k in ti.static(range(piece.width)):
                            some |= ti.cast(value[k] != 0, ti.i32)
                at += some
        self.old_first[i], self.old_number[i] = first, at - first

    @ti.func
    def carry(self, i):
        """Give each neighbour of particle i what it carried in the old list; both are sorted. Returns bits for those that got
        something, among the first."""
        first, number = self.first[i], self.number[i]
        for piece in ti.static(self.luggage):
            for e in range(first, first + number):
                if ti.static(piece.width == 0):
                    piece.field[e] = 0
                else:
                    for k in ti.static(range(piece.width)):
                        piece.field[e][k] = 0
        bits, at = ti.u32(0), 0
        for old in range(self.old_first[i], self.old_first[i] + self.old_number[i]):
            while at < number and self.near[first + at] < self.aside[old]:
                at += 1
            if at < number:
                if self.near[first + at] == self.aside[old]:
                    for piece in ti.static(self.bags):
                        piece.field[first + at] = piece.aside[old]
                    if at < WORD:
                        bits |= ti.u32(1) << ti.cast(at, ti.u32)
        return bits

    @ti.func
    def outrun(self, i):
        """1 if the list is stale: once a particle has moved by half the skin."""
        r = self.state.x[i] - self.origin[i]
        return ti.select(r.dot(r) <= ti.cast((0.49 * self.skin) ** 2, self.real), 0, 1)  # 1 for NaN

    @ti.func
    def build(self, me):
        """Sort the particles into cells, then list the near ones of each. `me`: see Team."""
        self.keep(me)
        self.cells.sort(me)
        if ti.static(self.counts):
            self.pair_up(me)
        else:
            for k in range(self.team.deal(self.blocks, 1, me)):
                self.fill(self.team.turn(k, 1, me))
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            self.origin[i] = self.state.x[i]
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, me)):
            self.stale[None] = 0
            if self.need[None] <= self.capacity:
                self.kept[None] = 0
        self.team.wait()

    @ti.func
    def fill(self, block):
        """One level: list the neighbours of a block of particles, one after the other. Beyond the room they are only counted."""
        start, room = block * self.pitch, self.capacity
        size = ti.static(-(-self.n // self.blocks))
        used = 0
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.first[i] = start + ti.min(used, room)
            begin = used
            used = self.scan(i, APPEND, start, ti.min(used, MOST))
            self.number[i] = ti.max(ti.min(used, room) - begin, 0)
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.finish(i)
        ti.atomic_max(self.need[None], used)

    @ti.func
    def pair_up(self, me):
        """Count, then list: on a GPU, by a thread for each particle; and for several levels, each pair that one of the two finds
        with both. What does not fit is only counted."""
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            self.number[i] = 0
        self.team.wait()
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            raised(self.number, i, self.scan(i, COUNT, 0, 0), self.serial)
        self.team.wait()
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            self.first[i] = self.number[i]
        self.team.wait()
        self.sums.run(self.first, me)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, me)):
            self.need[None] = self.first[self.n - 1]
        self.team.wait()
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            self.first[i] = self.first[i] - self.number[i]
            self.number[i] = 0
        self.team.wait()
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            if self.need[None] <= self.capacity:
                used = self.scan(i, FILL, self.first[i], 0)
                if ti.static(not self.several):
                    self.number[i] = used
        self.team.wait()
        for i in range(self.team.low(self.n, me), self.team.high(self.n, me)):
            self.finish(i)

    @ti.func
    def finish(self, i):
        """Put the list of particle i in order."""
        self.order(self.first[i], self.number[i])
        self.touching[i] = self.carry(i)

    @ti.func
    def words(self, i):
        """How many words of bits the list of particle i has entries for."""
        return (self.number[i] + (WORD - 1)) >> 5  # a division by WORD would look at the sign

    @ti.func
    def whole(self, i, word):
        """Bits of all entries that the word is for."""
        left = self.number[i] - word * WORD
        return ti.select(left < WORD, (ti.u32(1) << ti.cast(left & (WORD - 1), ti.u32)) - ti.u32(1), ti.u32(FULL))

    @ti.func
    def scan(self, i, what: ti.template(), start, used):  # type: ignore[valid-type]
        """Look for neighbours in the cells around particle i, at its own level and the coarser ones. Its list begins at `start`
        and has `used` entries; returns how many it has then."""
        own = self.cells.level_of(i)
        for m in range(own + 1):
            cell = self.cells.home(i, m)
            for r in range(ti.static(3 ** (self.dim - 1))):
                base, low, mask, span = self.cells.row(cell, m, r)
                for part in range(3 // span):
                    b = base + ((low + part) & mask)
                    for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                        j = self.cells.sorted[e]
                        listed = self.listed(i, j, self.cells.apart(i, e))
                        if ti.static(what == APPEND):
                            # No branch: it would be taken at random. What is not listed is written over by the next.
                            self.near[start + ti.min(used, self.capacity)] = j
                            used += listed
                        elif ti.static(what == COUNT):
                            used += listed
                            if ti.static(self.several):
                                if m < own and listed != 0:
                                    raised(self.number, j, 1, self.serial)
                        elif listed != 0:
                            at = used
                            if ti.static(self.several):  # others write to this list, too
                                at = raised(self.number, i, 1, self.serial)
                                if m < own:
                                    self.near[self.first[j] + raised(self.number, j, 1, self.serial)] = i
                            self.near[start + at] = j
                            used += 1
        return used

    @ti.func
    def listed(self, i, j, r):
        """1 if a pair, apart by r, belongs on the list: near, not both immovable, not linked."""
        far = self.radius.of(i) + self.radius.of(j) + ti.cast(self.skin, self.real)
        yes = ti.cast(r.dot(r) < far * far, ti.i32) & ti.cast(i != j, ti.i32)
        if ti.static(self.still):
            if yes != 0:
                yes = ti.cast(self.state.w.of(i) + self.state.w.of(j) > 0, ti.i32)
        if ti.static(not self.table.uniform):
            if yes != 0:
                yes = ti.cast(self.table.of(i, j)[3] > 0, ti.i32)
        if ti.static(self.linked):
            if yes != 0:
                for e in range(self.mates_begin[i], self.mates_begin[i + 1]):
                    if self.mates[e] == j:
                        yes = 0
        return yes

    @ti.func
    def order(self, begin, count):
        """Sort by index, which makes every sum over the list independent of the table."""
        if ti.static(self.several or self.short == 1):
            sort(self.near, begin, count, self.serial)
        elif count > ti.static(self.short):
            sort(self.near, begin, count, self.serial)
        else:
            # Where neighbours in space are neighbours in number too, they are in order as they come.
            exchange(self.near, begin, count, self.network, self.short)


@ti.func
def lowest(bits):
    """The number of the lowest bit that is set."""
    return ti.math.popcnt((bits - ti.u32(1)) & ~bits)
