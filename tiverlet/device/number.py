"""Numbers that kernels read from fields, so that what is compiled does not depend on them.

None changes while a kernel runs. The kernel of a frame reads all of them first: each time that an element of a field is looked up
takes as much code as twenty operations.
"""

from typing import Any

from .language import at, current, impl, inline, inside_kernel

# The kernel that is being translated, and its variables, by what they are. Not an attribute: kernels share what they do not read.
_read: tuple[Any, dict[int, Any]] = (None, {})


class Number:
    """One number, at a place of a field. Where kernels are translated `now` is that place, elsewhere the number."""

    def __init__(self, memory: Any, field: Any, place: int, value: float):
        self.field, self.place = field, place
        self._memory, self._value = memory, value

    @property
    def now(self) -> Any:
        """What it is."""
        if not inside_kernel():
            return self._value
        kernel, known = _read
        read = kernel is current().compiling_callable and id(self) in known
        return known[id(self)] if read else at(self.field, self.place)

    def set(self, value: float) -> None:
        """Make it another one."""
        self._value = value
        self._memory.set_number(self)


@inline
def read_all(numbers):
    """In a kernel: from here on they are variables. numbers: of a Memory."""
    global _read
    known = [number for _, some in numbers.values() for number in some]
    _read = current().compiling_callable, {id(k): impl.expr_init(at(k.field, k.place)) for k in known}


class OnDevice:
    """An attribute that holds a Number: read as a number by the host, and by kernels as what stands in the field. Assign the
    Number first, and later what it is to be."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.kept = f"{name}_number"

    def __get__(self, owner: Any, kind: type | None = None) -> Any:
        return self if owner is None else vars(owner)[self.kept].now

    def __set__(self, owner: Any, value: Any) -> None:
        if isinstance(value, Number):
            vars(owner)[self.kept] = value
        elif vars(owner)[self.kept].now != value:
            vars(owner)[self.kept].set(value)
