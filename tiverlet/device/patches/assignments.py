"""Detects assignments that only Taichi's own analysis makes valid, and has such kernels compiled with all passes."""

from typing import Any

from ..language import Expression, Operations, active, ti


def _assigned(self: Any, value: Any) -> Any:
    """Make an assignment, and request all passes for a dubious one.

    Assigning a vector to a number, or a number to a truth value, is valid only if no statement reads it. Without Taichi's
    analysis, which removes it then, it ends the process.
    """
    if active and type(self) is type(value) is Expression and not self.is_tensor():
        if value.is_tensor() or self.ptr.get_rvalue_type() == ti.u1 and value.ptr.get_rvalue_type() != ti.u1:
            active[-1].compile_thoroughly()
    return _assign(self, value)


def apply() -> None:
    """Replace the assignment of the compiler, Taichi or Quadrants."""
    Operations._assign = _assigned


_assign: Any = Operations._assign
