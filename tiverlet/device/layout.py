"""Trees of fields, which worlds of the same structure share; each world has its own bytes.

A Taichi kernel has compiled into it the tree of each field and the offset within the tree. It looks up the tree's address at each
launch. So worlds whose fields are of the same kinds share one tree. Before a launch, the address of the world's own bytes is
written to the place where kernels look it up, see patches/sharing.py.

Every field of a shared tree reserves room; the system gives memory page by page, as it is used. So fields grow in place, and no
kernel changes. A shared tree exists as long as Taichi runs, and takes no memory itself. Once there are MANY trees, the next one
has the fields of all kinds that any earlier tree had, so that few further ones are needed. Where trees cannot be shared, as on a
GPU, every world has its own, with fields just as long as needed.
"""

import ctypes
import mmap
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import count, pairwise
from typing import Any

import numpy as np

from . import language, runtime
from .host_copy import AddressFinder, offsets_in_tree
from .language import ti
from .patches import enabled

if "sharing" in enabled:
    from .patches import sharing

MAX_TREES = 400  # Taichi holds at most 511 trees, without a check; the rest is left to the user's own fields
NODES = 900  # nodes of a tree from which it has no spare fields
MOST_NODES = 1024  # Taichi's limit, beyond which it leaves its runtime in pieces
MANY = 200  # shared trees, each for worlds of one kind; further trees serve all kinds
WIDE = ti.f64, ti.i64  # of 8 bytes
FEW = 4  # a shared tree has 4, 8, 16, ... fields of each kind
ROOMS = (1 << 24, 1 << 20, 1 << 17)  # elements reserved per field: the first with which the tree fits into NEAR
NEAR = 1 << 31  # [bytes] offsets up to this fit into a processor instruction, without an extra register
BETWEEN = 23 * 64  # [bytes] between fields: 64 successive fields begin at 64 different places of a page
NORESERVE = {"linux": 0x4000}.get(sys.platform, 0)  # else Linux counts addresses as memory; Python has it since 3.13
LAZY = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | NORESERVE if sys.platform != "win32" else 0


@dataclass(frozen=True)
class Declared:
    """A declared field without a place."""

    kind: Any  # Taichi's type
    width: int  # components of one element; 0 for a scalar
    length: int  # elements; 0 for a single one of 0 dimensions
    apart: bool  # whether it goes into a second tree

    @property
    def sort(self) -> "Kind":
        """Its kind in a shared tree."""
        return self.kind, self.width, self.length > 0


Kind = tuple[Any, int, bool]  # the kind of a field in a shared tree: its type, its width, whether it has many elements


class Layout:
    """Fields that are placed together, and their offsets.

    serial: a number unique to this layout. shared: whether several worlds can use it.
    """

    _serials = count()

    def __init__(self, declared: tuple[Declared, ...], fields: list[Any] | None = None, shared: bool = False):
        check_trees()
        nodes = 1 + _nodes(Counter(d.sort for d in declared))
        if nodes > MOST_NODES:
            raise ValueError(
                f"World: its features need {nodes} fields and components, but Taichi has room for {MOST_NODES}. Leave out "
                "features, or make a second world."
            )
        self.serial, self.runtime, self.shared = next(self._serials), language.current(), shared
        self.fields = fields or [make_field(d.kind, d.width) for d in declared]
        builders: dict[bool, Any] = {apart: ti.FieldsBuilder() for apart in dict.fromkeys(d.apart for d in declared)}
        for d, field in zip(declared, self.fields, strict=True):
            (builders[d.apart].dense(ti.i, d.length) if d.length else builders[d.apart]).place(field)
        self.trees = [sharing.finalize_without_memory(builder) if shared else builder.finalize() for builder in builders.values()]
        runtime.trees += len(self.trees)
        self.numbers: dict[Kind, list[int]] = {}  # if shared: the indices of its fields, by kind
        self.room = 0  # if shared: the most elements of a field
        self._now = 0  # the address of the bytes that kernels use
        self._places: list[tuple[int, tuple[int, ...]]] = []  # offset and strides of each field; empty without host access
        self.size = 0  # [bytes] of the tree; 0 without host access
        if shared:
            self.find_addresses()

    def find_addresses(self) -> None:
        """Find the addresses of the tree and its fields, where the host can access them. All fields must be placed already."""
        if self.size or runtime.architecture() != "cpu" or len(self.trees) > 1:
            return
        (first, *_), tree = offsets_in_tree(self.fields[0])
        if not self.shared:
            addresses = np.zeros(1, dtype=np.uint64)
            AddressFinder(self.fields[0]).find(addresses)
            self._now = int(addresses[0]) - first
        self.size = tree.cell_size_bytes
        for field in self.fields:
            offsets, _ = offsets_in_tree(field)
            steps = {b - a for a, b in pairwise(offsets)}
            if len(steps) > 1:
                self._places = []  # components are not evenly spaced: copy by kernels instead
                return
            cell = field.parent().ptr.cell_size_bytes
            self._places.append((offsets[0], (cell, steps.pop() if steps else cell)))

    def allocate(self) -> tuple[int, Any]:
        """Provide zeroed bytes for one more memory: return their address, and an object to keep as long as they are needed.

        The address is 0 for Taichi's own bytes before find_addresses() has found them.
        """
        if not self.shared:
            return self._now, None
        try:
            room = mmap.mmap(-1, self.size, flags=LAZY)
        except OSError as e:
            raise MemoryError(f"The system has no room for one more world: {self.size >> 20} MiB of addresses ({e}).") from None
        return ctypes.addressof(ctypes.c_char.from_buffer(room)), room

    def use_bytes(self, address: int) -> None:
        """Let kernels use the bytes at this address."""
        if address != self._now:
            _table[1][self.trees[0].id] = self._now = address

    def views(self, address: int, wanted: list[tuple[int, tuple[int, ...], np.dtype]]) -> list[np.ndarray]:
        """Return fields at this address as arrays. wanted: index, shape and type of each. Empty without host access."""
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
                self.runtime.materialize()  # Taichi needs this if no kernel has run since the trees were made
            except RuntimeError:  # another world under construction has fields without a place: a later call frees these trees
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
    """Raise RuntimeError if there is no room for one more tree."""
    if runtime.trees >= MAX_TREES:
        raise RuntimeError(
            f"So many worlds are alive that they have {runtime.trees} trees of fields, and Taichi crashes near 512. "
            "Close worlds that you no longer need: world.close(), or `with tv.World(...) as world:`."
        )


def make_field(kind: Any, width: int) -> Any:
    """Make a field."""
    return ti.Vector.field(width, kind) if width else ti.field(kind)


def field(kind: Any, width: int) -> Any:
    """Make a field that get_layout() will place."""
    return language.unplaced_field(width) if "sharing" in enabled else make_field(kind, width)


def can_share() -> bool:
    """Whether worlds can share trees: the table in which kernels look up their addresses is found by means of one tree."""
    global _table
    if "sharing" in enabled and _table[0] is not language.current():
        probe, table = Layout((Declared(ti.i32, 0, 1, False),)), None
        if runtime.architecture() == "cpu":
            table = sharing.table_of(AddressFinder(probe.fields[0]), probe.trees[0].id, offsets_in_tree(probe.fields[0])[0][0])
        _table = language.current(), table
        probe.destroy()
    return bool(LAZY) and _table[1] is not None


def get_layout(declared: list[Declared], fields: list[Any], held: list[Layout], shared: bool) -> tuple[Layout, list[int]]:
    """Return a layout with the declared fields, and the index of each of them in it.

    fields: from field(); this function places them. held: the layouts that the world has already; they are not returned again,
    since each memory of a world needs a tree of its own. shared: see can_share().
    """
    if not shared:
        layout, which = Layout(tuple(declared), None if "sharing" in enabled else fields), list(range(len(declared)))
    else:
        kinds = [d.sort for d in declared]
        layout = _shared(Counter(kinds), max(d.length for d in declared), held)
        numbers = {kind: iter(some) for kind, some in layout.numbers.items()}
        which = [next(numbers[kind]) for kind in kinds]
    if "sharing" in enabled:
        for k, unplaced in zip(which, fields, strict=True):
            vars(unplaced).update(vars(layout.fields[k]), place_name=(layout.serial, k))  # by which shared kernels are keyed
    return layout, which


def _shared(need: Counter[Kind], length: int, held: list[Layout]) -> Layout:
    """Return a shared layout with so many fields of each kind and room for `length` elements, other than those in `held`."""
    now = language.current()
    for layout in [layout for layout in _known if layout.runtime is not now]:
        del _known[layout]
    want = Counter({kind: max(FEW, 1 << (number - 1).bit_length()) for kind, number in need.items()})
    if _nodes(want) > NODES:
        want = need
    room = _room(want, length)
    for layout, has in _known.items():
        if has == want and layout.room == room and layout not in held:
            return layout
    if len(_known) >= MANY:
        for layout, has in _known.items():
            if need <= has and layout.room >= length and layout not in held:
                return layout
            if _nodes(want | has) <= NODES:
                want |= has
        room = _room(want, length)
    kinds = sorted(want.elements(), key=lambda kind: (kind[2], kind[1], str(kind[0])))
    layout = Layout(tuple(_with_room(*kind, room) for kind in kinds), shared=True)
    layout.numbers, layout.room = {kind: [k for k, one in enumerate(kinds) if one == kind] for kind in want}, room
    _known[layout] = want
    return layout


def _nodes(want: Counter[Kind]) -> int:
    """Return how many nodes so many fields of each kind have.

    Each component has one, and many elements have one more. Components of a single element have one more each.
    """
    return sum(number * (1 + max(1, width) if many else 2 * max(1, width)) for (_, width, many), number in want.items())


def _room(want: Counter[Kind], length: int) -> int:
    """Return how many elements each field of a tree reserves, at least `length`."""
    each = sum(number * _size(kind, width) for (kind, width, many), number in want.items() if many)
    return next((room for room in ROOMS if length <= room and room * each <= NEAR), 1 << (length - 1).bit_length())


def _size(kind: Any, width: int) -> int:
    return (8 if kind in WIDE else 4) * max(1, width)


def _with_room(kind: Any, width: int, many: bool, room: int) -> Declared:
    """Declare a field of a shared tree.

    BETWEEN bytes separate two fields. Without this gap, two fields can begin at the same offset within a page. A processor then
    takes a write to one for a write to the other, and they evict each other from its first cache.
    """
    return Declared(kind, width, room + -(-BETWEEN // _size(kind, width)) if many else 0, False)


_leaving: list[Layout] = []  # layouts to free
_known: dict[Layout, Counter[Kind]] = {}  # the shared layouts, and how many fields of each kind they have
_table: tuple[Any, Any] = (None, None)  # a runtime, and the table in which its kernels look up tree addresses
