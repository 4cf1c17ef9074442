"""Numbers that kernels read from fields, so that what is compiled does not depend on them."""

from typing import Any

from .language import at, inside_kernel


class Number:
    """One number, at a place of a field. Where kernels are translated `now` is that place, elsewhere the number."""

    def __init__(self, memory: Any, field: Any, place: int, value: float):
        self.field, self.place = field, place
        self._memory, self._value = memory, value

    @property
    def now(self) -> Any:
        """What it is."""
        return at(self.field, self.place) if inside_kernel() else self._value

    def set(self, value: float) -> None:
        """Make it another one."""
        self._value = value
        self._memory.set_number(self)


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
