"""Fields that are declared a second time, where parts of a world are made anew with other lengths and values."""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from .number import Number

if TYPE_CHECKING:
    from .memory import Memory


class Differs(Exception):
    """Other fields would be declared than there are: kernels would have to know."""


class Again:
    """What Memory.field() and Memory.number() do meanwhile: give each owner the fields and numbers that it declared before, in
    order. Nothing changes until write().

    counts: what numbers that others own are going to be. Raises Differs for what was not declared so.
    """

    def __init__(self, memory: "Memory", counts: dict[Number, int]):
        self._memory, self._counts = memory, counts
        self._fields: Iterator[int] = iter(())
        self._places: Iterator[Number] = iter(())
        self.wanted: list[tuple[int, int, Any]] = []  # which field, how long, with which values
        self.numbers: list[Number] = []

    @contextlib.contextmanager
    def owned(self, fields: range, numbers: list[Number]) -> Iterator[None]:
        """Of one owner, who has declared these."""
        self._fields, self._places = iter(fields), iter(numbers)
        yield
        if next(self._fields, None) is not None or next(self._places, None) is not None:
            raise Differs

    def field(self, length: int | Number | None, width: int, kind: np.dtype, values: Any) -> Any:
        """The next one."""
        k = next(self._fields, None)
        if k is None:
            raise Differs
        entry = self._memory.entries[k]
        if isinstance(length, Number):
            length = self._counts.get(length, length.now)
        if entry.width != width or entry.kind != kind or (entry.length == 0) != (length is None):
            raise Differs
        self.wanted.append((k, 0 if length is None else max(1, int(length)), values))
        return entry.field

    def number(self, value: float, field: Any) -> Number:
        """The next one."""
        old = next(self._places, None)
        if old is None or old.field is not field:
            raise Differs
        self.numbers.append(Number(self._memory, field, old.place, value))
        return self.numbers[-1]

    @property
    def longest(self) -> int:
        """Of the fields, by elements."""
        return max((length for _, length, _ in self.wanted), default=0)

    @property
    def state(self) -> list[int]:
        """Which of the fields are part of the exact state."""
        return [k for k, _, _ in self.wanted if self._memory.entries[k].state]

    def write(self) -> None:
        """Give fields their lengths and values, 0 where they have none, and numbers theirs."""
        for k, length, values in self.wanted:
            self._memory.fill(k, length, 0 if values is None or not np.size(values) else values)
        for number in self.numbers:
            known = next(known for field, known in self._memory.numbers.values() if field is number.field)
            known[number.place] = number
            number.set(number.now)
