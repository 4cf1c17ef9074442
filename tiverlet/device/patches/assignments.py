"""What a kernel is to be compiled for with all passes: assignments that only Taichi's own analysis makes whole."""

from typing import Any

from ..language import Expression, Operations, active, ti


def _assigned(self: Any, value: Any) -> Any:
    """An assignment. That of a vector to a number, or of a number to a truth value, ends the process where Taichi does not find
    that nobody reads it."""
    if active and type(self) is type(value) is Expression and not self.is_tensor():
        if value.is_tensor() or self.ptr.get_rvalue_type() == ti.u1 and value.ptr.get_rvalue_type() != ti.u1:
            active[-1].beware()
    return _assign(self, value)


def apply() -> None:
    """Put this in the place of what Taichi, or Quadrants, calls."""
    Operations._assign = _assigned


_assign: Any = Operations._assign
