"""Numbers that kernels read from fields, so that compiled code does not depend on their values.

No number changes while a kernel runs. The kernel of a frame reads all of them at its begin, since each lookup of a field element
takes as much code as twenty operations.
"""

from typing import Any

from .language import at, current, impl, inline, inside_kernel

# The kernel that is being translated, and its variables by the ids of their Numbers. A module variable, not an attribute: the
# structure by which worlds share kernels must not depend on it.
_read: tuple[Any, dict[int, Any]] = (None, {})


class Number:
    """One number in a field. While a kernel is translated, `now` is the field's element; on the host it is the number.

    place: its index; None where it is all that the field holds.
    """

    host_only = ("_memory", "_value")

    def __init__(self, memory: Any, field: Any, place: int | None, value: float):
        self.field, self.place = field, place
        self._memory, self._value = memory, value

    @property
    def now(self) -> Any:
        """The present value."""
        if not inside_kernel():
            return self._value
        kernel, known = _read
        read = kernel is current().compiling_callable and id(self) in known
        return known[id(self)] if read else at(self.field, self.place)

    def set(self, value: float) -> None:
        """Set the value, on the host and on the device."""
        self._value = value
        self._memory.set_number(self)


@inline
def read_all(numbers):
    """In a kernel: read all numbers of a Memory into variables, which are used from here on. numbers: Memory.numbers."""
    global _read
    known = [number for _, some in numbers.values() for number in some]
    _read = current().compiling_callable, {id(k): impl.expr_init(at(k.field, k.place)) for k in known}


class OnDevice:
    """An attribute that holds a Number. The host reads its value, and kernels read the field's element.

    Assign the Number first, and plain values afterwards.
    """

    def __set_name__(self, owner: type, name: str) -> None:
        self.kept = f"{name}_number"

    def __get__(self, owner: Any, kind: type | None = None) -> Any:
        return self if owner is None else vars(owner)[self.kept].now

    def __set__(self, owner: Any, value: Any) -> None:
        if isinstance(value, Number):
            vars(owner)[self.kept] = value
        elif vars(owner)[self.kept].now != value:
            vars(owner)[self.kept].set(value)
