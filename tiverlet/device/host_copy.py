"""Fields as NumPy arrays: entries, addresses in host memory, and copy kernels where the host has no access."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import runtime
from .language import ti

SMALL = 300_000  # how many numbers one thread copies in a millisecond


@dataclass(eq=False)
class Entry:
    """One field: its shape and type, its role in the state, and what explain() reports about it. Its Memory sets the length."""

    name: str
    field: Any
    width: int  # components of one element; 0 for a scalar
    length: int  # elements; 0 for a single one
    kind: np.dtype
    copies: int  # number of copies with `length` elements each; 0 where all copies share the field
    valued: bool  # declared with values
    state: bool = False  # part of the exact state, hence of hash() and clone()
    rows: Any = None  # the Number that its length follows; None where it follows none
    for_reports: bool = False  # state that only reports read, hence not part of hash()
    index_limit: int | None = None  # where kernels use its elements as indices: the size of what they index

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the field as an array, for one copy."""
        return (max(1, self.length),) + ((self.width,) if self.width else ())

    @property
    def whole(self) -> tuple[int, ...]:
        """The shape of the array that holds all copies, one after the other."""
        first, *rest = self.shape
        return (first * max(1, self.copies), *rest)

    @property
    def bytes(self) -> int:
        """The size of one copy in memory [bytes]."""
        return self.kind.itemsize * max(1, self.width) * max(1, self.length)


def offsets_in_tree(field) -> tuple[list[int], Any]:
    """Return the byte offset of each component of the first element from the begin of its tree, and the root of the tree."""
    offsets, node = [], None
    for component in field._get_field_members():
        node, offset = component.ptr.snode(), 0
        while node.parent is not None:
            offset, node = offset + node.offset_bytes_in_parent_cell, node.parent
        offsets.append(offset)
    return offsets, node


@ti.data_oriented
class AddressFinder:
    """Finds the address of a field."""

    def __init__(self, field: Any):
        self.field, self.first = field, [0] * len(field.shape)

    @ti.kernel
    def find(self, out: ti.types.ndarray(ti.u64, 1)):  # type: ignore[valid-type]
        """Write the address of the field's first element to `out`."""
        out[0] = ti.get_addr(self.field, ti.static(self.first))


@ti.data_oriented
class Transfer:
    """Kernels that copy between a list of fields and one flat f64 array."""

    def __init__(self, entries: list[Entry]):
        offset, self.plan = 0, []
        for e in entries:
            self.plan.append((e.field, e.field.dtype, max(1, e.length), e.width, bool(e.length), offset))
            offset += e.bytes // e.kind.itemsize
        self.serial = offset < SMALL and runtime.architecture() == "cpu"  # serial code compiles in half the time

    @ti.kernel
    def load(self, flat: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Copy from the flat array to the fields."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.put(flat)
        else:
            self.put(flat)

    @ti.kernel
    def dump(self, flat: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Copy from the fields to the flat array."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.get(flat)
        else:
            self.get(flat)

    @ti.func
    def put(self, flat: ti.template()):  # type: ignore[valid-type]
        """Write all fields from the flat array, one after the other."""
        for field, kind, length, width, many, offset in ti.static(self.plan):
            for i in range(length):
                if ti.static(width == 0):
                    if ti.static(many):
                        field[i] = ti.cast(flat[offset + i], kind)
                    else:
                        field[None] = ti.cast(flat[offset], kind)
                else:
                    for k in ti.static(range(width)):
                        if ti.static(many):
                            field[i][k] = ti.cast(flat[offset + i * width + k], kind)
                        else:
                            field[None][k] = ti.cast(flat[offset + k], kind)

    @ti.func
    def get(self, flat: ti.template()):  # type: ignore[valid-type]
        """Read all fields into the flat array, one after the other."""
        for field, kind, length, width, many, offset in ti.static(self.plan):
            for i in range(length):
                if ti.static(width == 0):
                    if ti.static(many):
                        flat[offset + i] = field[i]
                    else:
                        flat[offset] = field[None]
                else:
                    for k in ti.static(range(width)):
                        if ti.static(many):
                            flat[offset + i * width + k] = field[i][k]
                        else:
                            flat[offset + k] = field[None][k]
