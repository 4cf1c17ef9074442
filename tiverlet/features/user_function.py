"""Checks of functions that users write: that Taichi can compile them, their arguments, and what they return.

Taichi matches neither names nor shapes. A number would be added to all components of a vector, a vector stored as a number ends
the process, and f(x, t) would get the velocity as t.
"""

import inspect
from typing import Any

import numpy as np

from ..device.language import Expression, is_kernel_function, undecorated
from ..device.patches.compiler import readable, refuse


def check_function(who: str, name: str, function: Any, takes: tuple[str, ...], counts: tuple[int, ...]) -> int:
    """Return how many of the arguments in `takes` a ti.func of the user takes. It must be one of `counts`."""
    if not is_kernel_function(function):
        raise TypeError(
            f"{who}: {name} = {function!r} is not a Taichi function. Put the decorator @ti.func above its def "
            "(import taichi as ti), in a file: Taichi reads its source."
        )
    plain = undecorated(function)
    if not readable(plain):
        raise ValueError(
            f"{who}: the source of {plain.__name__} cannot be read, and Taichi compiles the source. Write it in a file or "
            "in a notebook; what is typed in a console is not kept."
        )
    names = list(inspect.signature(plain).parameters)
    some = f"{counts[0]} to {counts[-1]}" if len(counts) == counts[-1] > 1 else " or ".join(map(str, counts))
    wanted = f"it must take {some} of ({', '.join(takes)}), in this order"
    if names[:1] == ["self"]:
        raise TypeError(f"{who}: {name} is a method, {plain.__qualname__}, but {wanted}: a function outside of a class.")
    if len(names) not in counts:
        raise TypeError(f"{who}: {name} takes {names}, but {wanted}.")
    for k, argument in enumerate(names):
        if argument in takes and takes[k] != argument:
            raise TypeError(f"{who}: {name} takes {names}, but {wanted}: its {argument} would get {takes[k]}.")
    return len(names)


def check_vector(who: str, name: str, value: Any, dim: int, what: str = "a force", unit: str = " [N]") -> Any:
    """Return the value of a function if it is a vector, else refuse it while its kernel is compiled."""
    if _shape(value) != (dim,):
        want = f"in {dim}D {what} has {dim} components{unit}: ti.Vector([...])"
        refuse(TypeError(f"{who}: {name} returns {_described(value)}, but {want}."))
    return value


def check_number(who: str, name: str, value: Any) -> Any:
    """Return the value of a function if it is a number, else refuse it while its kernel is compiled."""
    if _shape(value) != ():
        refuse(TypeError(f"{who}: {name} returns {_described(value)}, but it must return one number, such as v.norm()."))
    return value


def _shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of what a function returns in a kernel; None where it returns nothing, or several things."""
    if isinstance(value, Expression):
        return tuple(value.get_shape()) if value.is_tensor() else ()
    return None if value is None else np.shape(value)


def _described(value: Any) -> str:
    """Return in words what a function returns in a kernel."""
    shape = _shape(value)
    if shape is None:
        return "nothing"
    return f"{shape[0]} components" if len(shape) == 1 else f"a matrix of shape {shape}" if shape else "a number"
