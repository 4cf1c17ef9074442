"""Many copies of a world's fields, side by side in the same memory, so that one launch works on all of them.

In a world with copies, a field has `stride` elements for each copy. Where a kernel subscripts the field, the index of the copy
times the stride is added to the subscript; no other kernel code depends on copies. A kernel that loops over many copies sets the
current one by enter(). Any other kernel reads it from a field, which choose() writes.
"""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from .language import current, impl, inline, plain_field


class Copies:
    """The copies of one world.

    count: their number. chosen: the copy that the host reads and writes, and that small kernels work on; None for all.
    """

    host_only = ("count", "chosen", "closed")

    def __init__(self, count: int):
        self.count = count
        self.chosen: int | None = None
        self.closed = False  # whether Memory.check() refuses access, because the caller may not handle copies
        self.number: Any = None  # a field with one number: the chosen copy
        self._strides: set[int] = set()  # the strides of all fields
        self._now: tuple[Any, dict[int, Any]] = (None, {})  # a kernel, and the offset of its copy by stride
        self._view: np.ndarray | None = None  # the field `number` as an array, where the host can access it

    def add(self, field: Any, stride: int) -> None:
        """Mark a field as having `stride` elements for each copy."""
        vars(field).update(copies=self, stride=stride)
        if "place_name" in vars(field):  # part of the key of shared kernels
            vars(field)["place_name"] += (stride,)
        self._strides.add(stride)

    def choose(self, copy: int | None) -> bool:
        """Choose one copy for the host, or all (None). Returns False if the caller has to write the choice to the field."""
        self.chosen = copy
        if self._view is not None and copy is not None:
            self._view[...] = copy
        return self._view is not None or copy is None

    def set_view(self, array: np.ndarray | None) -> None:
        """Keep the host's view of the field `number`."""
        self._view = array

    @inline
    def enter(self, copy):
        """In a kernel: from here on, subscripts address this copy."""
        kernel = current().compiling_callable
        self._now = kernel, {stride: impl.expr_init(copy * stride) for stride in sorted(self._strides)}

    def begin(self, stride: int) -> Any:
        """Return the offset of the current copy in fields of this stride, while a kernel is translated."""
        kernel, begins = self._now
        if kernel is current().compiling_callable:
            return begins[stride]
        return _subscript(kernel, self.number, None) * stride

    @contextlib.contextmanager
    def all(self) -> Iterator[None]:
        """Within this context the host reads and writes all copies: arrays have one more axis, the first."""
        before = self.chosen, self.closed
        self.chosen, self.closed = None, False
        try:
            yield
        finally:
            self.chosen, self.closed = before


def _of_copy(builder: Any, value: Any, *indices: Any, **options: Any) -> Any:
    """Evaluate field[indices] for the copy, and the member, that the kernel works on."""
    if plain_field(value):
        own = vars(value)
        if "members" in own:
            begin = own["members"].begin(own["pitch"])
            indices = (begin + indices[0] if indices and indices[0] is not None else begin,)
        if "copies" in own:
            begin = own["copies"].begin(own["stride"])
            indices = (begin + indices[0] if indices and indices[0] is not None else begin,)
    return _subscript(builder, value, *indices, **options)


def apply() -> None:
    """Replace Taichi's subscript function."""
    impl.subscript = _of_copy


_subscript: Any = impl.subscript
