"""A second declaration of existing fields, for parts of a world that are rebuilt in place with other lengths and values."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from .number import Number

if TYPE_CHECKING:
    from .memory import Memory


class DeclarationsDiffer(Exception):
    """Raised when an owner would declare other fields than before, so that kernels would have to be compiled again."""


class Redeclaration:
    """Stands in for Memory.field() and Memory.number() while owners declare their fields a second time.

    Each owner gets the fields and numbers that it declared the first time, in the same order. Memory does not change until
    write(). counts: the coming values of numbers that other owners hold. Raises DeclarationsDiffer where a declaration is not the
    same as the first.
    """

    def __init__(self, memory: "Memory", counts: dict[Number, int]):
        self._memory, self._counts = memory, counts
        self._fields: Iterator[int] = iter(())
        self._places: Iterator[Number] = iter(())
        self.wanted: list[tuple[int, int, Any]] = []  # index of the field, its length, its values
        self.numbers: list[Number] = []

    @contextlib.contextmanager
    def owned(self, fields: range, numbers: list[Number]) -> Iterator[None]:
        """Serve the declarations of one owner. fields, numbers: what this owner declared the first time."""
        self._fields, self._places = iter(fields), iter(numbers)
        yield
        if next(self._fields, None) is not None or next(self._places, None) is not None:
            raise DeclarationsDiffer

    def field(self, length: int | Number | None, width: int, kind: np.dtype, values: Any) -> Any:
        """Return the owner's next field, and note its new length and values."""
        k = next(self._fields, None)
        if k is None:
            raise DeclarationsDiffer
        entry = self._memory.entries[k]
        if isinstance(length, Number):
            length = self._counts.get(length, length.now)
        if entry.width != width or entry.kind != kind or (entry.length == 0) != (length is None):
            raise DeclarationsDiffer
        self.wanted.append((k, 0 if length is None else max(1, int(length)), values))
        return entry.field

    def number(self, value: float, field: Any) -> Number:
        """Return the owner's next number, with a new value."""
        old = next(self._places, None)
        if old is None or old.field is not field:
            raise DeclarationsDiffer
        self.numbers.append(Number(self._memory, field, old.place, value))
        return self.numbers[-1]

    @property
    def longest(self) -> int:
        """The length of the longest of the fields [elements]."""
        return max((length for _, length, _ in self.wanted), default=0)

    @property
    def state(self) -> list[int]:
        """The indices of those fields that are part of the exact state."""
        return [k for k, _, _ in self.wanted if self._memory.entries[k].state]

    def write(self) -> None:
        """Set lengths and values of the fields (0 where no values were given), and the values of the numbers."""
        for k, length, values in self.wanted:
            self._memory.fill(k, length, 0 if values is None or not np.size(values) else values)
        for number in self.numbers:
            known = next(known for field, known in self._memory.numbers.values() if field is number.field)
            assert number.place is not None
            known[number.place] = number
            number.set(number.now)
