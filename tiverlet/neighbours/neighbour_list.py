"""The neighbour list: its storage, and the data of pairs that is carried from one list to the next."""

import contextlib
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..device import at, inline, ti
from ..device.number import Number, OnDevice
from ..device.room import refuse_beyond
from ..device.thread_team import Team
from .pair_data import Column, PairData

if TYPE_CHECKING:
    from ..device.memory import Memory

CROWDED = 300  # near pairs per particle beyond which the user is warned
STALE = 0.49  # of the skin: a list is valid until a particle has moved so far
MOVED = 2  # value of NeighbourList.stale where the only cause is that particles moved
WALL = 2**30  # the number of the first face of a wall, behind those of particles


class NeighbourList:
    """The neighbour list: pairs of particles closer than contact distance + skin. Each pair is listed for both particles.

    The neighbours of particle i are the `number[i]` entries from `first[i]` on, sorted by index. pair_data: the data of each
    pair. network_size: length of the longest part that a sorting network sorts; as many entries of room follow each block.
    """

    n: Any = OnDevice()  # number of particles
    blocks: Any = OnDevice()  # parts of the list, each filled by one thread
    capacity: Any = OnDevice()  # entries of one block
    pitch: Any = OnDevice()  # entries from the begin of a block to the begin of the next
    capacity_number: Number
    pitch_number: Number
    host_only = ("room",)
    has_own_compile_time = True  # see Feature

    def __init__(
        self, memory: "Memory", count: Number, rooms: Number, pair_data: list[PairData], team: Team, network_size: int,
        lists_walls: bool,
    ):  # fmt: skip
        self.team, self.n, self.memory, self.network_size = team, count, memory, network_size
        self.capacity, self.pitch = memory.number(0), memory.number(0)
        self.pair_data = pair_data
        self.persistent, self.transferred = [p for p in pair_data if p.persistent], [p for p in pair_data if p.is_transferred]
        add = memory.field
        self.first = add("grid.first", rooms, kind=ti.i32)
        self.number = add("grid.number", count, kind=ti.i32)
        # Of the entries of walls, which follow those of particles.
        self.wall_number: Any = add("grid.wall_number", count, kind=ti.i32) if lists_walls else None
        self.stale = add("grid.stale", None, kind=ti.i32, values=1)
        self.need = add("grid.need", None, kind=ti.i32)
        self.old_first = add("grid.old_first", count, kind=ti.i32)
        self.old_number = add("grid.old_number", count, kind=ti.i32)
        self.old_saved = add("grid.kept", None, kind=ti.i32)  # 1: the old list is saved for the one that is being built
        self.neighbour: Any = None
        self.old_neighbour: Any = None  # the pairs of the old list with data other than 0, while a new list is built
        self.store: Memory | None = None
        self.room = 0  # entries for which there is memory
        self.movable: Any = None  # a function that returns which particles can move, (n,), where any pair data have owners
        self.columns: list[Column] = []  # columns of a table with as many rows

    def __repr__(self) -> str:
        return "neighbour list"

    @inline
    def count(self, i):
        """Return the number of entries of particle i, with those of walls."""
        return at(self.number, i) if self.wall_number is None else at(self.number, i) + at(self.wall_number, i)

    @ti.func
    def has(self, i, other):
        """Return 1 if a particle or a face of a wall is on the list of particle i, else 0."""
        out = 0
        for e in range(self.first[i], self.first[i] + self.count(i)):
            if self.neighbour[e] == other:
                out = 1
        return out

    def allocate(self, capacity: int) -> bool:
        """Allocate `capacity` entries in fields of their own, and keep the old list. Returns whether there are new fields."""
        self._refuse_beyond(capacity)
        self.capacity_number.set(max(1, -(-capacity // self.blocks)))
        self.pitch_number.set(self.capacity + self.network_size)
        self.room = self.pitch * self.blocks
        if self.store and self.store.set_length(self.room):
            return False
        kept = []
        if self.store:
            with self._all_copies():
                kept = [self.store.read(field) for field in self._fields()]
            self.store.destroy()
        self.store = self.memory.make_companion()
        self.neighbour = self.store.field("grid.near", self.room, kind=ti.i32)
        self.old_neighbour = self.store.field("grid.aside", self.room, kind=ti.i32)
        for piece in self.pair_data:
            piece.field = self.store.field(f"grid.{piece.name}", self.room, width=piece.width, kind=piece.kind)
            if piece.is_transferred:
                piece.old = self.store.field(f"grid.{piece.name}_aside", self.room, width=piece.width, kind=piece.kind)
        for column in self.columns:
            column.field = self.store.field(f"grid.{column.name}", self.room, width=column.width, kind=column.kind)
        self.store.place()
        with self._all_copies():
            for field, values in zip(self._fields(), kept, strict=False):
                self._write_padded(field, values)
        return True

    def _refuse_beyond(self, capacity: int) -> None:
        """Raise MemoryError if so many entries are more than can be numbered, or take more memory than is free."""
        what = f"World: a list of {capacity} near neighbours, {capacity / self.n:.0f} for each particle,"
        instead = (
            "Particles overlap each other, or one is much larger than the rest: place them apart, as tv.shapes.pile does, give "
            "them smaller radii, or give Contact a smaller skin."
        )
        if 2 * capacity > 2**31 - 1:
            raise MemoryError(f"{what} is longer than {2**30 - 1}. {instead}")
        width = {False: 2, True: 0}  # of an entry, in numbers of 4 bytes, and in those of the world
        for piece in (*self.pair_data, *self.transferred, *self.columns):
            width[piece.kind is None] += max(1, piece.width)
        entry = 4 * width[False] + (8 if self.memory.real == ti.f64 else 4) * width[True]
        copies = self.memory.copies.count if self.memory.copies else 1
        refuse_beyond(entry * copies * (capacity - self.room), f"{what} takes", instead)

    def grow(self) -> bool:
        """Make room for the entries of the last build, plus a quarter. Returns whether kernels must be compiled again."""
        with self._all_copies():
            need = int(self.memory.read(self.need).max())
        self.invalidate()  # also if there is no room for more: a list that is too short is never used
        each = need * self.blocks / self.n
        if each > CROWDED:
            checks.warn(
                f"World: up to {each:.0f} near pairs per particle, so steps cost as the square of their number. Particles "
                "overlap each other, or one is much larger than the rest."
            )
        return self.allocate(int(need * 1.25 + 16) * self.blocks)

    def _fields(self) -> list:
        """Return the fields to keep: those of the old list; of many copies, some continue with their present list."""
        old = [self.old_neighbour, *(piece.old for piece in self.transferred), *(column.field for column in self.columns)]
        return [*old, self.neighbour, *(piece.field for piece in self.pair_data)] if self.memory.copies else old

    def _all_copies(self) -> contextlib.AbstractContextManager[None]:
        """Return a context in which reads and writes are for all copies of the world."""
        return self.memory.copies.all() if self.memory.copies else contextlib.nullcontext()

    def _write_padded(self, field, values: np.ndarray) -> None:
        """Write a field of the list, padded with 0 behind the values."""
        axis = int(self.memory.copies is not None and self.memory.copies.chosen is None)  # the axis of copies comes first
        room = np.zeros((*values.shape[:axis], self.room, *values.shape[axis + 1 :]), dtype=values.dtype)
        some = min(self.room, values.shape[axis])
        np.moveaxis(room, axis, 0)[:some] = np.moveaxis(values, axis, 0)[:some]
        self.store.write(field, room)  # type: ignore[union-attr]

    def _write_begin(self, field, values: np.ndarray) -> None:
        """Write the first entries of a field of the list. Entries behind these values are not read."""
        if self.store.elastic:  # type: ignore[union-attr]
            self.store.write_from(field, 0, values)  # type: ignore[union-attr]
        else:
            self._write_padded(field, values)

    def invalidate(self) -> None:
        """Mark the list as stale, so that the next frame rebuilds it."""
        self.memory.write(self.stale, 1)  # not stale[None] = 1, for which Taichi would compile a kernel

    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the listed pairs, (m, 2), in both orders and sorted, and their places in the list, (m,)."""
        assert self.store
        i, at = self._entries(self.first, self.number)
        return np.stack([i, self.store.read(self.neighbour)[at]], axis=1).astype(np.int64), at

    def read(self, piece: PairData, at: np.ndarray) -> np.ndarray:
        """Return the data of the entries at places `at`, (m,), of the list."""
        assert self.store
        return self.store.read(piece.field)[at].astype(np.float64)

    def _entries(self, first, number, with_walls: bool = False, some: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the particle of every entry and the place of the entry, (m,) each. some: particles in order; None for all."""
        seen, some = self.memory.view if self.memory.elastic else self.memory.read, np.arange(self.n) if some is None else some
        count = seen(number)[some]
        if with_walls:
            count = count + seen(self.wall_number)[some]
        i = some.repeat(count)
        return i, (seen(first)[some] - count.cumsum() + count).repeat(count) + np.arange(len(i))

    def persistent_data(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the listed pairs (i, j) with persistent data other than 0, sorted, and their data by name.

        The result does not depend on the layout of the list. Data that have an owner are those of the lower particle of a pair.
        """
        assert self.store
        seen = self.store.view if self.store.elastic else self.store.read
        saved = bool(self.memory.read(self.old_saved)[0])  # restored by restore(), and not yet transferred to a new list
        first, number = (self.old_first, self.old_number) if saved else (self.first, self.number)
        i, at = self._entries(first, number, not saved and self.wall_number is not None)
        near = seen(self.old_neighbour if saved else self.neighbour).take(at)
        values = {piece.name: seen(piece.old if saved else piece.field).take(at, axis=0) for piece in self.persistent}
        pairs, values = _set(np.stack([i, near], axis=1), values)
        if self.movable is None:
            return pairs, values
        (first, second), lower = self._can_move(pairs), pairs[:, 0] < pairs[:, 1]
        return _set(*self._given(pairs, values, lower & first, ~lower & ~second))

    def restore(self, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Store the result of persistent_data() as the old list, from which the next build takes the data of pairs."""
        if self.movable is not None:
            first, second = self._can_move(pairs)
            pieces = pairs // self.team.piece
            pairs, values = self._given(pairs, values, first, second & ~(first & (pieces[:, 0] == pieces[:, 1])))
        if len(pairs) > self.room:
            self.allocate(len(pairs))
        self._write_begin(self.old_neighbour, pairs[:, 1].astype(np.int32))
        for piece in self.transferred:
            nothing = np.zeros((len(pairs), *[piece.width] * (piece.width > 0)))
            self._write_begin(piece.old, values[piece.name] if piece.persistent else nothing)
        counts = np.bincount(pairs[:, 0], minlength=max(1, self.n))
        self.memory.write(self.old_first, np.cumsum(counts) - counts)
        self.memory.write(self.old_number, counts)
        self.memory.write(self.old_saved, 1)
        self.invalidate()

    def replace(self, pairs: np.ndarray, values: dict[str, np.ndarray]) -> None:
        """Forget the list, and store the result of persistent_data() for the next one."""
        for number in (self.number, *([] if self.wall_number is None else [self.wall_number])):
            self.memory.write(number, 0)
        self.restore(pairs, values)

    def _can_move(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the first and the second particle of each pair can move, (m,) each. Walls cannot."""
        movable, walls = self.movable(), pairs[:, 1] >= WALL
        return movable[pairs[:, 0]], movable[np.where(walls, 0, pairs[:, 1])] & ~walls

    def _given(
        self, pairs: np.ndarray, values: dict[str, np.ndarray], kept: np.ndarray, other: np.ndarray
    ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return pairs and their data where data that have an owner stay in the pairs `kept`, and are also given to the other
        particle of the pairs `other`, (m,) each."""
        i, j = np.concatenate([pairs, pairs[other, ::-1]]).T
        keys, where = np.unique(i * (2 * WALL) + j, return_inverse=True)
        owned, out = {piece.name: -1 if piece.width else 1 for piece in self.persistent if piece.has_owner}, {}
        for name, value in values.items():
            out[name] = np.zeros((len(keys), *value.shape[1:]), dtype=value.dtype)
            out[name][where[: len(pairs)]] = value
            if name in owned:
                out[name][where[: len(pairs)][~kept]] = 0
                out[name][where[len(pairs) :]] = owned[name] * value[other]
        return np.stack([keys // (2 * WALL), keys % (2 * WALL)], axis=1), out

    @property
    def saved(self) -> bool:
        """Whether the old list is saved for a new one that is not built yet."""
        return bool(self.memory.view(self.old_saved)[0])

    def remove_particles(self, number: np.ndarray) -> None:
        """Delete the pairs of removed particles. number: (n,) new indices, -1 for removed particles.

        For an elastic list that is not saved, whose rows of particles are already in the new order. Other pairs stay where they
        are, or move up among the entries of their particle.
        """
        assert self.store
        first, count = self.memory.view(self.first), self.memory.view(self.number)
        i, at = self._entries(self.first, self.number, self.wall_number is not None)
        near = self.store.view(self.neighbour)
        new = near.take(at)
        some = new < WALL
        new[some] = number.take(new[some])
        near[at] = new
        fewer = np.flatnonzero(np.bincount(i, new < 0, self.n))
        if not len(fewer):
            return
        loses = np.zeros(self.n, dtype=bool)
        loses[fewer] = True
        stay = np.flatnonzero(loses[i] & (new >= 0))
        i, at = i[stay], at[stay]
        place = np.arange(len(i)) - np.searchsorted(i, i)
        for field in (self.neighbour, *(piece.field for piece in self.pair_data)):
            rows = self.store.view(field)
            rows[first[i] + place] = rows[at]
        count[fewer] = np.bincount(i, near.take(first[i] + place) < WALL, self.n)[fewer]

    def settle_owners(self, some: np.ndarray | None = None) -> None:
        """Give data to their owners, after pieces or movable particles changed. some: particles, (k,); the list is not saved."""
        assert self.store
        near, movable, piece = self.store.view(self.neighbour), self.movable(), self.team.piece
        around = np.full(self.n, some is None)
        if some is not None:
            around[some] = around[near[self._entries(self.first, self.number, some=some)[1]]] = True
        i, at = self._entries(self.first, self.number, some=around.nonzero()[0])
        j = near[at]
        lower = (around[j] & (i < j)).nonzero()[0]
        there = at[(i * WALL + j).searchsorted(j[lower].astype(np.int64) * WALL + i[lower])]
        here, i, j = at[lower], i[lower], j[lower]
        own, other = movable[i], movable[j] & ~(movable[i] & (i // piece == j // piece))
        for data in self.pair_data:
            if data.has_owner:
                rows, sign = self.store.view(data.field), -1 if data.width else 1
                value = rows[here]
                value += (value == 0) * sign * rows[there]
                rows[here], rows[there] = (value.T * own).T, (sign * value.T * other).T

    @ti.func
    def save_old_list(self, thread):
        """Save the list as the old one, unless a build that did not fit has already saved it."""
        kept = self.old_saved[None]
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if kept == 0:
                self.save_pairs(i)
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.old_saved[None] = 1
            self.need[None] = 0

    @ti.func
    def save_pairs(self, i):
        """Save the pairs of particle i that have data other than 0."""
        first = self.first[i]
        at = first
        for e in range(first, first + self.count(i)):
            some = 0
            self.old_neighbour[at] = self.neighbour[e]
            for piece in ti.static(self.transferred):
                value = piece.field[e]
                piece.old[at] = value
                some |= piece.is_set(value)
            at += some
        self.old_first[i], self.old_number[i] = first, at - first

    @ti.func
    def transfer_pair_data(self, i):
        """Copy the data of each pair of particle i from the old list. Both lists are sorted."""
        first, number = self.first[i], self.count(i)
        for piece in ti.static(self.pair_data):
            for e in range(first, first + number):
                if ti.static(piece.width == 0):
                    piece.field[e] = 0
                else:
                    for k in ti.static(range(piece.width)):
                        piece.field[e][k] = 0
        at = 0
        for old in range(self.old_first[i], self.old_first[i] + self.old_number[i]):
            while at < number and self.neighbour[first + at] < self.old_neighbour[old]:
                at += 1
            if at < number:
                if self.neighbour[first + at] == self.old_neighbour[old]:
                    for piece in ti.static(self.transferred):
                        piece.field[first + at] = piece.old[old]


def _set(pairs: np.ndarray, values: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the pairs with data other than 0, and these data."""
    some = np.zeros(len(pairs), dtype=bool)
    for value in values.values():
        for column in value.T if value.ndim > 1 else [value]:  # any(axis=1) takes ten times as long
            some |= column != 0
    kept = np.flatnonzero(some)
    return pairs.take(kept, axis=0), {name: value.take(kept, axis=0) for name, value in values.items()}
