"""Fields of a world: declared together, placed in one or two trees, freed together.

Taichi 1.7.4 ends the process without an exception in these cases: a field outlives its runtime, 512 trees of fields are alive, a
field has no elements, or a child made by fork launches a kernel. The checks here and in layout.py raise errors instead that name
the remedy, so that no other module has to check.
"""

import contextlib
import mmap
import weakref
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from . import language, layout, runtime
from .copies import Copies
from .host_copy import Entry, Transfer
from .interrupts import in_turn
from .language import ti
from .layout import WIDE, Declared, Layout
from .members import Members
from .number import Number
from .patches import enabled
from .patches.compiler import LEAN, Compiler
from .redeclaration import Redeclaration
from .room import refuse_beyond

GROUP = 16  # fields per transfer kernel; Taichi unrolls the loop over them
Rows = np.ndarray | slice  # which elements of fields, by index; NumPy finds a single one in a fifth of the time by a slice
ALL = slice(None)


def rows_of(indices: np.ndarray) -> Rows:
    """Return indices, (m, 1), as Rows."""
    if len(indices) == 1:
        i = indices.item()
        return slice(i, i + 1)
    return indices[:, 0]


def numbers_of(some: Rows) -> Any:
    """Return the indices of rows_of(), (m,); a number where there is one."""
    return some.start if isinstance(some, slice) else some


class Memory:
    """The fields of one world: declared first, then placed together, freed together.

    real: ti.f32 or ti.f64. few, passes: whether the world has few particles, and its compiler settings, see Compiler. copies: if
    there are many copies of the world; reading, writing, state() and restore() then act on the chosen copy, or on all. Every
    method that touches the fields first checks that they still exist.
    """

    kernels_read = ("real",)

    def __init__(
        self, real, few: bool = False, passes: Mapping[str, Any] = LEAN, compiler: Compiler | None = None,
        copies: Copies | None = None,
    ):  # fmt: skip
        if "sharing" not in enabled:  # fields are then made at once, and need a place
            layout.check_trees()
        self.real, self.copies = real, copies
        self.compiler = compiler or Compiler(real, few, passes, copies is not None)
        self.entries: list[Entry] = []
        self._at: dict[int, int] = {}  # index of the entry, by the id of the field
        self._named: Counter[str] = Counter()
        self._in_order: list[Number] = []
        self._owned: dict[Any, tuple[range, list[Number]]] = {}  # fields and numbers, by owner
        self._redeclaration: Redeclaration | None = None  # set while owners declare their fields a second time
        self._members: Members | None = None  # set while one of several members declares its fields
        self._parts: dict[int, tuple[Any, int, slice]] = {}  # of members, by the id of a handle: it, its entry, its elements
        self._of_members: list[Members] = []
        self._later: list[tuple[Entry, np.ndarray]] = []
        self._declared: list[Declared] = []
        self.numbers: dict[Any, tuple[Any, list[Number]]] = {}  # by type: the field, and the numbers that it holds
        self._apart = not aligned()
        self._layout: Layout | None = None
        self._which: list[int] = []  # the index of each field in the layout
        self._runtime = language.current()
        self._transfers: dict[tuple, Transfer] = {}  # kept, since compiling costs more than running
        self._views: dict[int, np.ndarray] = {}  # see _host_views()
        self._rooms: dict[int, np.ndarray] = {}  # of resized fields, by index: arrays of the whole reserved room
        self._address = 0  # of the bytes of this memory
        self._room: Any = None  # keeps the bytes alive, where they are not Taichi's own
        self._most: dict[int, int] = {}  # of resized fields: for how many elements the system has given memory
        self._ends: Any = None  # the finalizer that frees the fields
        if copies and copies.number is None:
            copies.number = self.field("copy", None, kind=ti.i32, shared=True)

    def make_companion(self) -> "Memory":
        """Return another memory of the same world, for fields that are made and freed on their own."""
        return Memory(self.real, compiler=self.compiler, copies=self.copies)

    def field(
        self, name: str, length: int | Number | None, *, width: int = 0, kind=None, values=None, shared: bool = False, **role: Any
    ) -> Any:  # fmt: skip
        """Declare a field of `length` elements (None: one element, of 0 dimensions) and give it its first values.

        length: a Number makes the length follow that number, see regroup(). shared: all copies of the world share the field.
        role: state, for_reports and index_limit, see Entry.
        """
        kind, rows = self.real if kind is None else kind, None
        if self._members:
            return self._members.field(layout.field, name, length, width, kind, values, **role)
        if self._redeclaration:
            return self._redeclaration.field(length, width, np.dtype(_NUMPY[kind]), values)
        if isinstance(length, Number):
            rows, length = length, int(length.now)
        length = 0 if length is None else max(1, length)  # a field of 0 elements breaks the runtime
        made = layout.field(kind, width)
        self._declare(name, made, length, width, kind, values, shared, rows=rows, **role)
        return made

    def _declare(
        self, name: str, made: Any, length: int, width: int, kind: Any, values: Any = None, shared: bool = False, **role: Any
    ) -> None:  # fmt: skip
        """Declare a field. Arguments as those of field()."""
        copies = 0 if shared or not self.copies else self.copies.count
        in_all = max(1, length) * copies if copies else length
        if in_all >= 2**31:
            raise MemoryError(f"{name} would have {in_all} elements, and can have {2**31 - 1}. Make fewer worlds at a time.")
        self._declared.append(Declared(kind, width, in_all, self._apart and kind in WIDE))
        self._named[name] += 1
        same = self._named[name]
        name = f"{name} #{same}" if same > 1 else name  # several batches of a kind
        valued = values is not None and np.size(values) > 0
        self._at[id(made)] = len(self.entries)
        self.entries.append(Entry(name, made, width, length, np.dtype(_NUMPY[kind]), copies, valued, **role))
        if valued:
            self._later.append((self.entries[-1], np.asarray(values, dtype=np.float64)))

    def number(self, value: float, kind=None) -> Number:
        """Declare a number that kernels read from a field, so that worlds with other values share kernels.

        kind: the number's type, i32 by default.
        """
        kind = ti.i32 if kind is None else kind
        if self._members:
            return self._members.number(layout.field, value, kind)
        if kind not in self.numbers:
            self.numbers[kind] = layout.field(kind, 0), []
        field, known = self.numbers[kind]
        if self._redeclaration:
            return self._redeclaration.number(value, field)
        known.append(Number(self, field, len(known), value))
        self._in_order.append(known[-1])
        return known[-1]

    @contextlib.contextmanager
    def owned(self, owner: Any) -> Iterator[None]:
        """Within this context, declarations belong to `owner`, which may repeat them within redeclare()."""
        if self._redeclaration:
            with self._redeclaration.owned(*self._owned[owner]):
                yield
            return
        fields, numbers = len(self.entries), len(self._in_order)
        yield
        self._owned[owner] = range(fields, len(self.entries)), self._in_order[numbers:]

    @contextlib.contextmanager
    def member(self, members: Members) -> Iterator[None]:
        """Within this context, declarations are those of the next of several members."""
        members.begin_member()
        self._members = members
        try:
            yield
        finally:
            self._members = None

    def place_members(self, members: Members) -> None:
        """Declare the fields of members, of which all have declared theirs."""
        self._of_members.append(members)
        for one in members.shared:
            ends = np.cumsum(one.lengths)
            begins, pitch = ends - one.lengths, one.lengths[0]
            if any(length != pitch for length in one.lengths):
                pitch = self.field(f"{one.name}.begins", len(begins), kind=ti.i32, values=begins)
            one.pitch = pitch
            self._declare(one.name, one.whole, int(ends[-1]), one.width, one.kind, one.first_values, state=one.state)
            for handle, begin, end in zip(one.handles, begins.tolist(), ends.tolist(), strict=True):
                self._parts[id(handle)] = handle, len(self.entries) - 1, slice(begin, end)

    @contextlib.contextmanager
    def redeclare(self, counts: dict[Number, int]) -> "Iterator[Redeclaration]":
        """Within this context, owners declare their fields a second time, see Redeclaration."""
        self._redeclaration = Redeclaration(self, counts)
        try:
            yield self._redeclaration
        finally:
            self._redeclaration = None

    def scratch(self, owner: Any) -> list[np.ndarray]:
        """Return copies of an owner's working fields: those declared without values and no part of the state.

        They hold values from earlier passes, which the residuals use before the next step.
        """
        return self._dump(self._scratch(owner))

    def put_scratch(self, owner: Any, noted: list[np.ndarray], kept: tuple[np.ndarray, ...] = ()) -> None:
        """Write arrays from scratch() back to an owner's working fields, if it still has as many.

        kept: masks of the rows that remain; each applies to arrays of its length.
        """
        entries = self._scratch(owner)
        if len(entries) != len(noted):
            return
        arrays = self._dump(entries)
        for now, before in zip(arrays, noted, strict=True):
            some = next((mask for mask in kept if len(mask) == len(before)), None)
            rows = before if some is None else before[some]
            if now.shape[1:] == rows.shape[1:] and len(rows) <= len(now):
                now[: len(rows)] = rows
        self._load(entries, arrays)

    def _scratch(self, owner: Any) -> list[Entry]:
        fields = self._owned[owner][0] if owner in self._owned else ()
        return [e for e in (self.entries[k] for k in fields) if not (e.valued or e.state)]

    def fill(self, k: int, length: int, values: Any) -> None:
        """Give a field of an elastic memory, by its index, a length and the value of its elements."""
        self._resized(k, length)[...] = values

    def set_number(self, number: Number) -> None:
        """Write a number to the device, if it is placed already. All copies get it, since they share kernels."""
        if number.place is None:
            self.write(number.field, number._value)
        elif view := self._host_views():
            view[id(self._find(number.field))][..., number.place] = number._value
        elif self._layout:
            with self.copies.all() if self.copies else contextlib.nullcontext():
                values = self.read(number.field)
                values[..., number.place] = number._value
                self.write(number.field, values)

    def _declare_numbers(self) -> None:
        for kind, (field, known) in self.numbers.items():
            self._declare(f"numbers.{np.dtype(_NUMPY[kind]).name}", field, len(known), 0, kind, [n._value for n in known])

    def place(self) -> None:
        """Allocate the declared fields and write their first values (all others are zero)."""
        self._declare_numbers()
        wanted = sum(e.bytes * max(1, e.copies) for e in self.entries)
        refuse_beyond(wanted, "World: its fields take", "Take fewer particles, or fewer worlds at a time.")
        with self.compiler():
            shared = layout.can_share()
            held = [one for one, _ in self.compiler.places]
            self._layout, self._which = layout.get_layout(self._declared, [e.field for e in self.entries], held, shared)
        for e in self.entries:
            if e.copies and self.copies:
                self.copies.add(e.field, max(1, e.length))
        for members in self._of_members:
            members.place()
        address, room = self._layout.allocate()
        self._ends = weakref.finalize(self, _end, self._layout, address, self.compiler)
        self._ends.atexit = False
        self._address, self._room = address, room
        self.compiler.places.append((self._layout, address))
        if self._layout.shared:
            self._layout.use_bytes(address)
        if self._later:
            self._load([entry for entry, _ in self._later], [values for _, values in self._later])
            self._later.clear()

    def set_length(self, length: int) -> bool:
        """Give all fields `length` elements in place. Returns False and changes nothing where kernels would need recompiling."""
        if self.copies or not (self._layout and self._layout.shared and length <= self._layout.room):
            return False  # the offsets of copies would change with the length
        self._views = {}
        for e in self.entries:
            e.length = length
        return True

    @property
    def fields(self) -> list[Any]:
        """All fields; those of members twice: whole, and as kernels see them that enter a member."""
        return [*(e.field for e in self.entries), *(one.field for members in self._of_members for one in members.shared)]

    @property
    def elastic(self) -> bool:
        """Whether fields can change their lengths in place: on a CPU, for a single world."""
        return not self.copies and bool(self._layout and self._layout.shared and self._host_views())

    def has_room(self, length: int) -> bool:
        """Whether there is room for `length` elements in each field."""
        return bool(self._layout) and length <= self._layout.room  # type: ignore[union-attr]

    def regroup(self, rows: Number, first: int, behind: np.ndarray, count: int) -> None:
        """Remove and add rows of all fields whose length follows the Number `rows`, in an elastic memory.

        Each field keeps its `first` first rows, then the rows with the indices `behind`, in that order. It gets `count` rows in
        all; new rows are 0.
        """
        kept = first + len(behind)
        for k, e in enumerate(self.entries):
            if e.rows is rows:
                moved = self._host_views()[id(e)].take(behind, axis=0) if len(behind) else 0
                view = self._resized(k, max(1, count))
                view[first:kept], view[kept:] = moved, 0

    def resize(self, field, length: int) -> None:
        """Change the length of a field in an elastic memory: present elements stay, and new ones are 0."""
        k = self._at[id(field)]
        before = self.entries[k].length
        self._resized(k, max(1, length))[before:] = 0

    def _resized(self, k: int, length: int) -> np.ndarray:
        """Change the length of a field, by its index, and return the field as an array."""
        e = self.entries[k]
        if e.length == length:
            return self._host_views()[id(e)]
        assert self._layout
        before, e.length = e.length, length
        room = self._rooms.get(k)
        if room is None:
            (room,) = self._layout.views(self._address, [(self._which[k], (self._layout.room, *e.whole[1:]), e.kind)])
            self._rooms[k] = room
        self._host_views()[id(e)] = view = room[:length]
        most = max(length, self._most.get(k, before))
        if most > 2 * length:
            self._release_pages(room[length:most])
            most = length
        self._most[k] = most
        return view

    def _release_pages(self, rows: np.ndarray) -> None:
        """Return the memory of removed rows to the system, page by page; these rows then read as 0."""
        if not (self._room and hasattr(mmap, "MADV_DONTNEED")):
            return
        begin = rows.ctypes.data - self._address
        first, end = -(-begin // mmap.PAGESIZE) * mmap.PAGESIZE, (begin + rows.nbytes) // mmap.PAGESIZE * mmap.PAGESIZE
        if first < end:
            self._room.madvise(mmap.MADV_DONTNEED, first, end - first)

    @property
    def spare_bytes(self) -> int:
        """Memory kept after rows were removed: at most as much as the present rows take [bytes]."""
        return sum(max(0, most - self.entries[k].length) * self._rooms[k][:1].nbytes for k, most in self._most.items())

    def _host_views(self) -> dict[int, np.ndarray]:
        """Return the fields as arrays, by the id of the entry; empty if the host has no access.

        Access through kernels takes longer to compile than everything else takes to run.
        """
        if not self._views and self._layout:
            self._layout.find_addresses()
            if self._layout.size:
                wanted = [(k, e.whole, e.kind) for k, e in zip(self._which, self.entries, strict=True)]
                views = self._layout.views(self._address, wanted)
                for e, view in zip(self.entries, views, strict=False):
                    self._views[id(e)] = view.reshape(e.copies, *e.shape) if e.copies else view  # same bytes
                if self.copies and views and self.entries[0].field is self.copies.number:
                    self.copies.set_view(self._views[id(self.entries[0])])
        return self._views

    def check(self) -> None:
        """Raise RuntimeError if the fields were freed or their runtime has ended."""
        if language.current() is not self._runtime:
            raise RuntimeError(
                "Taichi was started again after this world was built, which destroyed its fields. Build the world anew."
            )
        if not self._layout:
            raise RuntimeError("This world is closed; build a new one.")
        if self.copies and self.copies.closed:
            raise RuntimeError(
                "This feature acts in many worlds, which differ. Ask each: worlds.each(lambda world: world.features[0].residual)."
            )
        if runtime.forked():
            raise RuntimeError('This world was built before a fork and cannot run in the child; use "spawn".')

    def destroy(self) -> None:
        """Free the fields. Calling it twice, or after another ti.init, does nothing."""
        if self._ends:
            self._ends()
        elif self.entries and "sharing" not in enabled:  # fields without a place would break everything that Taichi does later
            self._declare_numbers()
            Layout(tuple(self._declared), [e.field for e in self.entries]).destroy()
        self._layout, self._views, self._rooms, self._most, self._room = None, {}, {}, {}, None
        self.entries = self.entries if self._ends else []

    def choose(self, copy: int | None) -> None:
        """Choose one of the copies, or all (None), see Copies."""
        assert self.copies
        if not self.copies.choose(copy) and id(self.copies.number) in self._at:
            self.write(self.copies.number, copy)

    def write(self, field, values) -> None:
        """Overwrite a whole field. Without a chosen copy, write to all: values are the same for all, or have one more axis."""
        self.check()
        array = np.asarray(values, dtype=np.float64)
        if array.size and id(field) in self._parts:
            entry, whole, part = self._part(field)
            part[...] = array
            if not self._host_views():
                self._load([entry], [whole])
        elif array.size:
            self._load([self._find(field)], [array])

    def write_from(self, field, first: int, values) -> None:
        """Overwrite elements of a field from index `first` on. For a single world (not one of many copies)."""
        self.write_rows(slice(first, first + len(values)), (field, values))

    def write_rows(self, some: Rows, *values: tuple[Any, Any]) -> None:
        """Overwrite some elements of fields. For a single world (not one of many copies)."""
        self.check()
        views = self._host_views()
        for field, rows in values:
            if views:
                views[id(self._find(field))][some] = rows
            else:
                whole = self.read(field)
                whole[some] = rows
                self.write(field, whole)

    def write_some(self, field, values, some: np.ndarray) -> None:
        """Overwrite a field of some copies. values: one value for all of them, or one row per copy."""
        self.check()
        self._load_some([self._find(field)], [np.asarray(values)], some)

    def _load_some(self, entries: list[Entry], arrays: list[np.ndarray], some: np.ndarray) -> None:
        views = self._host_views()
        if views:
            for e, a in zip(entries, arrays, strict=True):
                views[id(e)][some] = a
            return
        for k, copy in enumerate(some):
            self.choose(int(copy))
            parts = [a[k if len(a) > 1 else 0] if a.ndim > len(e.shape) else a for e, a in zip(entries, arrays, strict=True)]
            self._load(entries, parts)
        self.choose(None)

    @in_turn
    def read(self, field, kind: Any = None) -> np.ndarray:
        """Return a copy of a whole field, in its own type unless `kind` is given.

        Without a chosen copy, the array has one more axis, the first.
        """
        self.check()
        if id(field) in self._parts:
            return np.array(self._part(field)[2], dtype=kind)
        entry, views = self._find(field), self._host_views()
        if views:
            return np.array(self._one(entry, views[id(entry)]), dtype=kind)
        return self._dump([entry])[0].astype(kind or entry.kind, copy=False)

    def _part(self, field) -> tuple[Entry, np.ndarray, np.ndarray]:
        """Return a field that members share, its elements, and a member's part of these. They are copies without host access."""
        _, k, some = self._parts[id(field)]
        entry, views = self.entries[k], self._host_views()
        whole = self._one(entry, views[id(entry)]) if views else self._dump([entry])[0]
        return entry, whole, whole[:, some] if whole.ndim > len(entry.shape) else whole[some]

    def view(self, field) -> np.ndarray:
        """Return the field itself as an array, where the host has access; otherwise a copy."""
        self.check()
        view = self._host_views().get(id(self._find(field)))
        return self.read(field) if view is None else view

    @in_turn
    def rows(self, some: Rows, *fields) -> list[np.ndarray]:
        """Return some elements of fields, which the caller must not change. For a single world (not one of many copies)."""
        self.check()
        views, entries = self._host_views(), [self._find(field) for field in fields]
        return [(views[id(e)] if views else self._dump([e])[0])[some] for e in entries]

    @in_turn
    def state(self) -> dict[str, np.ndarray]:
        """Return copies of the fields that make up the exact state, by name."""
        self.check()
        chosen = [e for e in self.entries if e.state]
        return dict(zip((e.name for e in chosen), self._dump(chosen), strict=True))

    def places_in_state(self) -> dict[int, tuple[str, slice]]:
        """Return the names of the fields that make up the exact state, by the ids of fields and handles; and whose elements."""
        out = {id(e.field): (e.name, ALL) for e in self.entries if e.state}
        return out | {i: (self.entries[k].name, some) for i, (_, k, some) in self._parts.items() if self.entries[k].state}

    def restore(self, state: dict[str, np.ndarray], some: np.ndarray | None = None) -> None:
        """Write back what state() returned, bit for bit. Fields not in it become 0.

        some: copies, each of which gets a row of the arrays, or all the only one.
        """
        self.check()
        chosen = [e for e in self.entries if e.state]
        arrays = [state.get(e.name, np.zeros(1)) for e in chosen]
        if some is None:
            self._load(chosen, arrays)
        else:
            self._load_some(chosen, arrays, some)

    def copy_from(self, other: "Memory") -> None:
        """Copy into the chosen copy all fields of another memory with the same names.

        The sums of a frame ("survey.") are left out, since they may be fewer here.
        """
        self.check()
        theirs = {e.name: e for e in other.entries if not e.name.startswith("survey.")}
        ours = [e for e in self.entries if e.name in theirs]
        self._load(ours, other._dump([theirs[e.name] for e in ours]))

    def copy_to_all(self) -> None:
        """Copy the fields of the chosen copy to all copies."""
        assert self.copies
        some = [e for e in self.entries if e.copies]
        values = self._dump(some)
        with self.copies.all():
            self._load(some, values)

    def _find(self, field) -> Entry:
        return self.entries[self._at[id(field)]]

    def _load(self, entries: list[Entry], arrays: list[np.ndarray]) -> None:
        views = self._host_views()
        if views:
            for e, a in zip(entries, arrays, strict=True):
                self._one(e, views[id(e)])[...] = a
            return
        if self._all_of(entries):
            self._each(entries, lambda k: self._load(entries, [_part(e, a, k) for e, a in zip(entries, arrays, strict=True)]))
            return
        # Every type of field (f32, f64, i32, u32) is exact in f64, so one kernel and one flat array serve all.
        for k in range(0, len(entries), GROUP):
            some = entries[k : k + GROUP]
            parts = [np.broadcast_to(a, e.shape).ravel() for e, a in zip(some, arrays[k : k + GROUP], strict=True)]
            with self.compiler():
                self._transfer(some).load(np.concatenate(parts).astype(np.float64))

    def _dump(self, entries: list[Entry]) -> list[np.ndarray]:
        views = self._host_views()
        if views:
            return [self._one(e, views[id(e)]).copy() for e in entries]
        if self._all_of(entries):
            return [np.stack(arrays) for arrays in zip(*self._each(entries, lambda k: self._dump(entries)), strict=True)]
        out = []
        for k in range(0, len(entries), GROUP):
            some = entries[k : k + GROUP]
            sizes = [e.bytes // e.kind.itemsize for e in some]
            flat = np.empty(sum(sizes), dtype=np.float64)
            with self.compiler():
                self._transfer(some).dump(flat)
            parts = np.split(flat, np.cumsum(sizes)[:-1])
            out += [p.astype(e.kind).reshape(e.shape) for p, e in zip(parts, some, strict=True)]
        return out

    def _one(self, entry: Entry, view: np.ndarray) -> np.ndarray:
        """Return the chosen copy's part of a field; all of it if none is chosen."""
        return view if not entry.copies or self.copies.chosen is None else view[self.copies.chosen]  # type: ignore[union-attr]

    def _all_of(self, entries: list[Entry]) -> bool:
        """Whether a transfer covers all copies."""
        return bool(self.copies) and self.copies.chosen is None and any(e.copies for e in entries)  # type: ignore[union-attr]

    def _each(self, entries: list[Entry], act: Any) -> list[Any]:
        """Call `act` for each copy in turn."""
        out = []
        for k in range(self.copies.count):  # type: ignore[union-attr]
            self.choose(k)
            out.append(act(k))
        self.choose(None)
        return out

    def _transfer(self, entries: list[Entry]) -> Transfer:
        key = tuple(id(e) for e in entries)
        if key not in self._transfers:
            self._transfers[key] = Transfer(entries)
        return self._transfers[key]


def _end(one: Layout, address: int, compiler: Compiler) -> None:
    """Release a memory's place in a layout."""
    compiler.places.remove((one, address))
    one.destroy()


def _part(entry: Entry, values: np.ndarray, copy: int) -> np.ndarray:
    """Return the part of an array that belongs to one copy."""
    return values[copy] if np.ndim(values) > len(entry.shape) else values


_NUMPY = {ti.f32: np.float32, ti.f64: np.float64, ti.i32: np.int32, ti.u32: np.uint32, ti.i64: np.int64}


def aligned() -> bool:
    """Whether an f64 field may share a tree with fields of other types.

    LLVM aligns all fields of a tree. For other backends Taichi 1.7.4 packs fields one behind the other, the smallest first, and
    computes the index of an f64 as its address divided by 8. In a tree of 3 i32 and 4 f64, the first f64 begins at byte 12 but is
    written to byte 8, over the last i32. In a tree of their own all f64 are aligned.
    """
    return runtime.architecture() in runtime.LLVM
