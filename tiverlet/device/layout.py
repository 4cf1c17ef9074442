"""Trees of fields, which worlds of the same structure share: bytes are their own, and kernels find those that they are told.

A kernel of Taichi knows of a field in which tree it is, and where in that. Where the tree is, it looks up at each launch. So
worlds whose fields are of the same kinds and lengths have one tree, and before a launch the place of their own bytes is written
to where kernels look it up, see patches/roots.py. Where that cannot be done, as on a GPU, every world has trees of its own.
"""

import contextlib
import ctypes
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count, pairwise
from typing import Any

import numpy as np

from . import language, runtime
from .host_copy import Places, chain
from .language import ti
from .patches import patched

MAX_TREES = 400  # Taichi holds at most 511 trees of fields and does not check; the rest is left to the user's own fields.
SPARE = 64  # trees that are kept for the next world while no world has them
SPARE_BYTES = 1 << 26  # that they may take up together
ROOMS = (64, 256, 1024, 4096)  # elements for which small fields have room
MANY = ROOMS[-1]
BETWEEN = 23 * 64  # bytes; 64 fields, one after the other, begin at 64 places of a page
LINE = 64  # bytes, at a multiple of which a tree begins


@dataclass(frozen=True)
class Declared:
    """A field that is to be."""

    kind: Any  # of Taichi
    width: int  # components of one element; 0 for a scalar
    length: int  # elements; 0 for a single one of 0 dimensions
    apart: bool  # in a second tree


class Layout:
    """Fields that are placed together, and where. serial: no other one ever has this number."""

    _serials = count()

    def __init__(self, declared: tuple[Declared, ...], fields: list[Any] | None = None):
        if runtime.trees >= MAX_TREES:
            raise RuntimeError(
                f"So many worlds are alive that they have {runtime.trees} trees of fields, and Taichi crashes near 512. "
                "Close worlds that you no longer need: world.close(), or `with tv.World(...) as world:`."
            )
        self.declared, self.serial, self.runtime, self.users = declared, next(self._serials), language.current(), 0
        self.fields = fields or [made(d.kind, d.width) for d in declared]
        builders: dict[bool, Any] = {d.apart: None for d in declared}
        for apart in builders:
            builders[apart] = ti.FieldsBuilder()
        for d, field in zip(declared, self.fields, strict=True):
            (builders[d.apart].dense(ti.i, d.length) if d.length else builders[d.apart]).place(field)
        self.trees = [builder.finalize() for builder in builders.values()]
        runtime.trees += len(self.trees)
        self._table: Any = None  # where kernels look up where trees are
        self._home = self._now = 0  # the address of Taichi's own bytes of the tree, and of those that kernels find
        self._at_home, self._used = False, False  # whether somebody has these, and whether somebody had
        self._places: list[tuple[int, tuple[int, ...]]] = []  # of the fields in the tree: offset, strides; none if not seen
        self.lasting = False  # whether it is kept for others
        self.size = 0  # [bytes] of the tree; 0 where the host cannot see it
        if patched:
            self.look()
        if _table[0] is not self.runtime:
            _know(self.runtime, None)

    @property
    def shared(self) -> bool:
        """Whether several can have it."""
        return self._table is not None

    def look(self) -> None:
        """Find the tree, and the fields in it, where the host can see them. All fields that were made must have their places."""
        if self.size or runtime.architecture() != "cpu" or len(self.trees) > 1:
            return
        (first, *_), tree = chain(self.fields[0])
        if patched and _table[0] is not self.runtime:
            from .patches.roots import table_of  # noqa: PLC0415  # which is there only where it is patched

            addresses = np.zeros(1, dtype=np.uint64)
            finder = Places(self.fields[0])
            _know(self.runtime, table_of(finder, "find", addresses, self.trees[0].id, first))
            self._home = int(addresses[0]) - first
        if _table[1] is not None:
            self._table = _table[1]
            self._home = int(self._table[self.trees[0].id])
        elif not self._home:
            addresses = np.zeros(1, dtype=np.uint64)
            Places(self.fields[0]).find(addresses)
            self._home = int(addresses[0]) - first
        self._now, self.size = self._home, tree.cell_size_bytes
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

        The address is 0 for Taichi's own bytes that nobody has looked for yet.
        """
        self.users += 1
        if not self._at_home:
            if self._used and self.size:
                ctypes.memset(self._home, 0, self.size)
            self._at_home = self._used = True
            return self._home, None
        room = np.zeros(self.size + LINE, dtype=np.uint8)
        return -(-room.ctypes.data // LINE) * LINE, room

    def give_back(self, address: int) -> None:
        """These are no longer needed."""
        self.users -= 1
        if address == self._home:
            self._at_home = False

    def point(self, address: int) -> None:
        """Have kernels find these bytes."""
        if address != self._now:
            self._table[self.trees[0].id] = self._now = address

    def views(self, address: int, shapes: list[tuple[tuple[int, ...], np.dtype]]) -> list[np.ndarray]:
        """The fields, as arrays of these shapes that are what is at this address; none where the host cannot see them."""
        memory: Any = (ctypes.c_char * self.size).from_address(address or self._home)
        return [
            np.ndarray(shape, kind, memory, offset, strides[: len(shape)])
            for (shape, kind), (offset, strides) in zip(shapes, self._places, strict=False)
        ]

    def destroy(self) -> None:
        """Free the trees."""
        if self.trees and language.current() is self.runtime and not runtime.forked():
            self.runtime.materialize()  # no kernel may have run since they were made
            for tree in self.trees:
                if self.shared:  # no kernel that knows it will be asked for again; Taichi would forget all others, too
                    tree.ptr.destroy_snode_tree(language.current().prog)
                    tree.destroyed = True
                else:
                    tree.destroy()
            runtime.trees -= len(self.trees)
        self.trees = []


@contextlib.contextmanager
def unshared() -> Iterator[None]:
    """Worlds that are built within it have trees and kernels of their own."""
    global _alone
    before, _alone = _alone, True
    try:
        yield
    finally:
        _alone = before


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


def roomy(declared: list[Declared]) -> tuple[Declared, ...]:
    """The same fields where worlds with other numbers of elements find place, too: so that these can share what is compiled, and
    particles can come and go. The first world of a layout has Taichi's own bytes, which are all in memory; of the bytes of others
    only those that are used.

    Beyond the last of ROOMS it is for an eighth more at most. Between fields are BETWEEN bytes: where two begin at the same place
    of a page, a processor takes a write to one for a write to the other, and they drive each other out of its first cache.
    """
    if patched and _table[0] is not language.current():
        Layout((Declared(ti.i32, 0, 1, False),)).destroy()  # which finds out whether they can
    if _table[1] is None or _alone:
        return tuple(declared)
    return tuple(replace(d, length=_room(d)) if d.length else d for d in declared)


def _room(d: Declared) -> int:
    size = (8 if d.kind == ti.f64 else 4) * max(1, d.width)
    if d.length <= MANY:
        room = next(room for room in ROOMS if d.length <= room)
    else:
        step = 1 << ((d.length - 1).bit_length() - 4)
        room = -(-d.length // step) * step
    return room + -(-BETWEEN // size)


def take(declared: tuple[Declared, ...], turn: int, fields: list[Any]) -> Layout:
    """A layout of these fields, for one more: one that is there, or a new one. turn: how many of the same the world has already,
    since kernels of one world need a tree for each. fields: from field(); they get their places."""
    now = language.current()
    for key in [key for key, layout in _layouts.items() if layout.runtime is not now]:
        del _layouts[key]
    layout = None if _alone else _layouts.get((declared, turn))
    if layout is None:
        layout = Layout(declared, None if patched else fields)
        layout.lasting = layout.shared and not _alone
        if layout.lasting:
            _layouts[declared, turn] = layout
    else:
        _layouts.move_to_end((declared, turn))
    unused = [(key, one) for key, one in _layouts.items() if not one.users and one is not layout]
    while unused and (len(unused) > SPARE or sum(one.size for _, one in unused) > SPARE_BYTES):
        key, one = unused.pop(0)
        del _layouts[key]
        one.destroy()
    if patched:
        for k, (unplaced, placed) in enumerate(zip(fields, layout.fields, strict=True)):
            language.place_field(unplaced, placed, (layout.serial, k))
    return layout


_layouts: OrderedDict[tuple[tuple[Declared, ...], int], Layout] = OrderedDict()  # the last to be taken last
_alone = False
_table: tuple[Any, Any] = (None, None)  # a runtime, and where its kernels look up where trees are
