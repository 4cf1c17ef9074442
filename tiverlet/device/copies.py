"""Many copies of a world's fields, side by side in the same memory, so that one launch works on all of them.

A field of a world with copies has `stride` elements for each. Where a kernel subscripts it, the number of the copy, times the
stride, is added to the index; nothing else in a kernel knows of copies. Which copy it is, a kernel that goes through many says by
enter(); any other one finds it in a field, where choose() has written it.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from .language import current, impl, inline, plain_field


class Copies:
    """count: how many there are. chosen: the one that the host reads and writes, and small kernels work on; None for all."""

    host_only = ("count", "chosen", "closed")

    def __init__(self, count: int):
        self.count = count
        self.chosen: int | None = None
        self.closed = False  # whether somebody who does not know of copies might read fields: Memory.check() refuses it
        self.number: Any = None  # a field of one number: the copy that is chosen
        self._strides: set[int] = set()  # of all fields
        self._now: tuple[Any, dict[int, Any]] = (None, {})  # a kernel, and where its copy begins in fields of each stride
        self._seen: np.ndarray | None = None  # the field, where the host sees it

    def add(self, field: Any, stride: int) -> None:
        """Tell a field that it has so many elements for each copy."""
        vars(field).update(copies=self, stride=stride)
        if "place_name" in vars(field):  # what kernels are known by
            vars(field)["place_name"] += (stride,)
        self._strides.add(stride)

    def choose(self, copy: int | None) -> bool:
        """Take one for the host, or all. False where somebody has to write it to the field."""
        self.chosen = copy
        if self._seen is not None and copy is not None:
            self._seen[...] = copy
        return self._seen is not None or copy is None

    def see(self, array: np.ndarray | None) -> None:
        """Keep the array that the field is."""
        self._seen = array

    @inline
    def enter(self, copy):
        """In a kernel: from here on, fields are those of this copy."""
        kernel = current().compiling_callable
        self._now = kernel, {stride: impl.expr_init(copy * stride) for stride in sorted(self._strides)}

    def begin(self, stride: int) -> Any:
        """Where the copy begins in a field, while a kernel is translated."""
        kernel, begins = self._now
        if kernel is current().compiling_callable:
            return begins[stride]
        return _subscript(kernel, self.number, None) * stride

    @contextlib.contextmanager
    def all(self) -> Iterator[None]:
        """Meanwhile the host reads and writes all of them: arrays have one more axis, the first."""
        before = self.chosen, self.closed
        self.chosen, self.closed = None, False
        try:
            yield
        finally:
            self.chosen, self.closed = before


def _of_copy(builder: Any, value: Any, *indices: Any, **options: Any) -> Any:
    """field[indices], of the copy that the kernel works on."""
    if plain_field(value) and "copies" in vars(value):
        begin = vars(value)["copies"].begin(vars(value)["stride"])
        indices = (begin + indices[0] if indices and indices[0] is not None else begin,)
    return _subscript(builder, value, *indices, **options)


def apply() -> None:
    """Put this in the place of what subscripts call."""
    impl.subscript = _of_copy


_subscript: Any = impl.subscript
