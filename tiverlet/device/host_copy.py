"""A field as NumPy sees it: its entry, where it is in memory of the host, and kernels that copy it where it is not."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import runtime
from .language import ti

SMALL = 300_000  # numbers that one thread copies in a millisecond


@dataclass(frozen=True)
class Entry:
    """One field: its place in memory, and what explain() says of it."""

    name: str
    field: Any
    width: int  # components of one element; 0 for a scalar
    length: int  # elements; 0 for a single one
    kind: np.dtype
    state: bool  # part of the exact state, hence of hash() and clone()
    copies: int = 0  # of which each has so many elements; 0 where it is one for all
    rows: Any = None  # the Number of what it has an element for each of; None where that is not told
    told: bool = False  # part of the state for reports alone, hence not of hash()
    below: int | None = None  # where kernels take its elements for indices: how many there are of what these mean

    def of_length(self, length: int) -> "Entry":
        """The same field with so many elements; replace() takes three times as long."""
        return Entry(
            self.name, self.field, self.width, length, self.kind, self.state, self.copies, self.rows, self.told, self.below
        )  # fmt: skip

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the array that it is."""
        return (max(1, self.length),) + ((self.width,) if self.width else ())

    @property
    def whole(self) -> tuple[int, ...]:
        """Of the array that all copies are."""
        first, *rest = self.shape
        return (first * max(1, self.copies), *rest)

    @property
    def bytes(self) -> int:
        """Size in memory, of one copy [bytes]."""
        return self.kind.itemsize * max(1, self.width) * max(1, self.length)


def chain(field) -> tuple[list[int], Any]:
    """How many bytes from the begin of its tree each component of the first element is, and the root of the tree."""
    offsets, node = [], None
    for component in field._get_field_members():
        node, offset = component.ptr.snode(), 0
        while node.parent is not None:
            offset, node = offset + node.offset_bytes_in_parent_cell, node.parent
        offsets.append(offset)
    return offsets, node


@ti.data_oriented
class Places:
    """Where a field is."""

    def __init__(self, field: Any):
        self.field, self.first = field, [0] * len(field.shape)

    @ti.kernel
    def find(self, out: ti.types.ndarray(ti.u64, 1)):  # type: ignore[valid-type]
        """The address of its first element."""
        out[0] = ti.get_addr(self.field, ti.static(self.first))


@ti.data_oriented
class Transfer:
    """Kernels between a list of fields and one flat f64 array."""

    def __init__(self, entries: list[Entry]):
        offset, self.plan = 0, []
        for e in entries:
            self.plan.append((e.field, e.field.dtype, max(1, e.length), e.width, bool(e.length), offset))
            offset += e.bytes // e.kind.itemsize
        self.serial = offset < SMALL and runtime.architecture() == "cpu"  # in one piece, which compiles in half the time

    @ti.kernel
    def load(self, flat: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """From the array to the fields."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.put(flat)
        else:
            self.put(flat)

    @ti.kernel
    def dump(self, flat: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """From the fields to the array."""
        if ti.static(self.serial):
            ti.loop_config(serialize=True)
            for _ in range(1):
                self.get(flat)
        else:
            self.get(flat)

    @ti.func
    def put(self, flat: ti.template()):  # type: ignore[valid-type]
        """All fields, one after the other."""
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
        """All fields, one after the other."""
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
