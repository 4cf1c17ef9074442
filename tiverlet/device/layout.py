"""Trees of fields, which worlds of the same structure share: bytes are their own, and kernels find those that they are told.

A kernel of Taichi knows of a field in which tree it is, and where in that. Where the tree is, it looks up at each launch. So
worlds whose fields are of the same kinds have one tree, and before a launch the place of their own bytes is written to where
kernels look it up, see patches/roots.py. Every field of a shared tree has room, of which the system gives what is used, page by
page: what grows stays where it is, and no kernel has to know. Such a tree stays as long as Taichi runs; it takes no memory. When
there are MANY, the next has all that any had, so that there will not be many more. Where trees cannot be shared, as on a GPU,
every world has its own, with fields as long as they must be.
"""

import contextlib
import ctypes
import mmap
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, pairwise
from typing import Any

import numpy as np

from . import language, runtime
from .host_copy import Places, chain
from .language import ti
from .patches import patched, roots

MAX_TREES = 400  # Taichi holds at most 511 trees of fields and does not check; the rest is left to the user's own fields.
NODES = 900  # of a tree: one for a field, and one for each of its components; Taichi takes 1024
MANY = 200  # shared ones, each for worlds of one kind; further ones are for all
FEW = 4  # fields of a kind, at least, that a shared tree has; it has 4, 8, 16 and so on
ROOMS = (1 << 24, 1 << 20, 1 << 17)  # elements of a field: the first with which a tree is no larger than NEAR
NEAR = 1 << 31  # bytes: what is as near as that to the begin of a tree, processors find without a number of its own
BETWEEN = 23 * 64  # bytes; 64 fields, one after the other, begin at 64 places of a page
NORESERVE = {"linux": 0x4000}.get(sys.platform, 0)  # lest Linux counts addresses as memory; Python has no name for it before 3.13
LAZY = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | NORESERVE if sys.platform != "win32" else 0


@dataclass(frozen=True)
class Declared:
    """A field that is to be."""

    kind: Any  # of Taichi
    width: int  # components of one element; 0 for a scalar
    length: int  # elements; 0 for a single one of 0 dimensions
    apart: bool  # in a second tree


Kind = tuple[Any, int, bool]  # of a field in a shared tree: its type, width, and whether it has many elements


class Layout:
    """Fields that are placed together, and where. serial: no other one ever has this number. shared: several can have it."""

    _serials = count()

    def __init__(self, declared: tuple[Declared, ...], fields: list[Any] | None = None, shared: bool = False):
        check_trees()
        self.serial, self.runtime, self.shared = next(self._serials), language.current(), shared
        self.fields = fields or [made(d.kind, d.width) for d in declared]
        builders: dict[bool, Any] = {d.apart: None for d in declared}
        for apart in builders:
            builders[apart] = ti.FieldsBuilder()
        for d, field in zip(declared, self.fields, strict=True):
            (builders[d.apart].dense(ti.i, d.length) if d.length else builders[d.apart]).place(field)
        self.trees = [roots.planned(builder) if shared else builder.finalize() for builder in builders.values()]
        runtime.trees += len(self.trees)
        self.numbers: dict[Kind, list[int]] = {}  # of a shared one: by kind, which of its fields are of it
        self.room = 0  # elements that fields of a shared one can have
        self._now = 0  # the address of the bytes that kernels find
        self._places: list[tuple[int, tuple[int, ...]]] = []  # of the fields in the tree: offset, strides; none if not seen
        self.size = 0  # [bytes] of the tree; 0 where the host cannot see it
        if shared or patched:
            self.look()
        if not shared and patched and _table[0] is not self.runtime:
            _know(self.runtime, None)

    def look(self) -> None:
        """Find the tree, and the fields in it, where the host can see them. All fields that were made must have their places."""
        if self.size or runtime.architecture() != "cpu" or len(self.trees) > 1:
            return
        (first, *_), tree = chain(self.fields[0])
        if not self.shared:
            addresses = np.zeros(1, dtype=np.uint64)
            finder = Places(self.fields[0])
            if patched and _table[0] is not self.runtime:
                _know(self.runtime, roots.table_of(finder, "find", addresses, self.trees[0].id, first))
            else:
                finder.find(addresses)
            self._now = int(addresses[0]) - first
        self.size = tree.cell_size_bytes
        for field in self.fields:
            offsets, _ = chain(field)
            steps = {b - a for a, b in pairwise(offsets)}
            if len(steps) > 1:
                self._places = []  # laid out as never seen yet: by kernels, then
                return
            cell = field.parent().ptr.cell_size_bytes
            self._places.append((offsets[0], (cell, steps.pop() if steps else cell)))

    def lend(self) -> tuple[int, Any]:
        """Bytes, all 0, for one more: their address, and what is to be kept as long as they are needed.

        The address is 0 for bytes of Taichi's that nobody has looked for yet.
        """
        if not self.shared:
            return self._now, None
        try:
            room = mmap.mmap(-1, self.size, flags=LAZY)
        except OSError as e:
            raise MemoryError(f"The system has no room for one more world: {self.size >> 20} MiB of addresses ({e}).") from None
        return ctypes.addressof(ctypes.c_char.from_buffer(room)), room

    def point(self, address: int) -> None:
        """Have kernels find these bytes."""
        if address != self._now:
            _table[1][self.trees[0].id] = self._now = address

    def views(self, address: int, wanted: list[tuple[int, tuple[int, ...], np.dtype]]) -> list[np.ndarray]:
        """Some fields, by number, as arrays of these shapes that are what is at this address; none where the host sees none."""
        if not self._places:
            return []
        memory: Any = (ctypes.c_char * self.size).from_address(address or self._now)
        places = [(self._places[k], shape, kind) for k, shape, kind in wanted]
        return [np.ndarray(shape, kind, memory, offset, strides[: len(shape)]) for (offset, strides), shape, kind in places]

    def destroy(self) -> None:
        """Free the trees, unless they are shared."""
        if not self.shared and self.trees and language.current() is self.runtime and not runtime.forked():
            _leaving.append(self)
            try:
                self.runtime.materialize()  # no kernel may have run since they were made
            except RuntimeError:  # another world is being built, whose fields have no place: some time later
                return
            while _leaving:
                _leaving.pop()._free()

    def _free(self) -> None:
        if language.current() is self.runtime:
            for tree in self.trees:
                tree.destroy()
            runtime.trees -= len(self.trees)
        self.trees = []


def check_trees() -> None:
    """Raise RuntimeError where there is no room for one more."""
    if runtime.trees >= MAX_TREES:
        raise RuntimeError(
            f"So many worlds are alive that they have {runtime.trees} trees of fields, and Taichi crashes near 512. "
            "Close worlds that you no longer need: world.close(), or `with tv.World(...) as world:`."
        )


@contextlib.contextmanager
def unshared() -> Iterator[None]:
    """Worlds that are built within it have trees and kernels of their own."""
    global _unshared
    before, _unshared = _unshared, True
    try:
        yield
    finally:
        _unshared = before


def made(kind: Any, width: int) -> Any:
    """A new field."""
    return ti.Vector.field(width, kind) if width else ti.field(kind)


def field(kind: Any, width: int) -> Any:
    """A field that take() will give a place."""
    return language.unplaced_field(width) if patched else made(kind, width)


def _know(of: Any, table: Any) -> None:
    """Keep the table of a runtime; None where it has none."""
    global _table
    _table = of, table


def sharing() -> bool:
    """Whether worlds can share trees."""
    if patched and _table[0] is not language.current():
        Layout((Declared(ti.i32, 0, 1, False),)).destroy()  # which finds out
    return bool(LAZY) and _table[1] is not None and not _unshared


def take(declared: list[Declared], fields: list[Any], held: list[Layout], shared: bool) -> tuple[Layout, list[int]]:
    """A layout with such fields, and which of its fields they are. held: those that the world has, since the kernels of a world
    need another tree for each. fields: from field(); they get their places. shared: see sharing()."""
    if not shared:
        layout, which = Layout(tuple(declared), None if patched else fields), list(range(len(declared)))
    else:
        kinds = [(d.kind, d.width, d.length > 0) for d in declared]
        layout = _shared(Counter(kinds), max(d.length for d in declared), held)
        numbers = {kind: iter(some) for kind, some in layout.numbers.items()}
        which = [next(numbers[kind]) for kind in kinds]
    if patched:
        for k, unplaced in zip(which, fields, strict=True):
            language.place_field(unplaced, layout.fields[k], (layout.serial, k))
    return layout, which


def _shared(need: Counter[Kind], length: int, held: list[Layout]) -> Layout:
    """One that has so many fields of each kind with room for `length` elements, and is not held."""
    now = language.current()
    for layout in [layout for layout in _known if layout.runtime is not now]:
        del _known[layout]
    want = Counter({kind: max(FEW, 1 << (number - 1).bit_length()) for kind, number in need.items()})
    room = _room(want, length)
    for layout, has in _known.items():
        if has == want and layout.room == room and layout not in held:
            return layout
    if len(_known) >= MANY:
        for layout, has in _known.items():
            if need <= has and layout.room >= length and layout not in held:
                return layout
            if sum(number * (1 + max(1, kind[1])) for kind, number in (want | has).items()) <= NODES:
                want |= has
        room = _room(want, length)
    kinds = sorted(want.elements(), key=lambda kind: (kind[2], kind[1], str(kind[0])))
    layout = Layout(tuple(_roomy(*kind, room) for kind in kinds), shared=True)
    layout.numbers, layout.room = {kind: [k for k, one in enumerate(kinds) if one == kind] for kind in want}, room
    _known[layout] = want
    return layout


def _room(want: Counter[Kind], length: int) -> int:
    """Elements that each of these fields is to have room for, `length` at least."""
    each = sum(number * _size(kind, width) for (kind, width, many), number in want.items() if many)
    return next((room for room in ROOMS if length <= room and room * each <= NEAR), 1 << (length - 1).bit_length())


def _size(kind: Any, width: int) -> int:
    return (8 if kind == ti.f64 else 4) * max(1, width)


def _roomy(kind: Any, width: int, many: bool, room: int) -> Declared:
    """A field of a shared tree.

    Between two of them are BETWEEN bytes: where two begin at the same place of a page, a processor takes a write to one for a
    write to the other, and they drive each other out of its first cache.
    """
    return Declared(kind, width, room + -(-BETWEEN // _size(kind, width)) if many else 0, False)


_leaving: list[Layout] = []  # that are to be freed
_known: dict[Layout, Counter[Kind]] = {}  # the shared ones, and how many fields of each kind they have
_unshared = False
_table: tuple[Any, Any] = (None, None)  # a runtime, and where its kernels look up where trees are
