"""Functions that kernels call. Taichi copies a ti.func into each place that calls it, and LLVM takes longer for one long function
than for two of half its length.

Kernels of small worlds compile longer than they run. So there, what is long and stands in several places, or runs once in a
frame, is compiled once, and called. Large worlds, and many copies of one, have it where it is called, as they have on a GPU.

Everything here knows the inside of Taichi 1.7.4; with another one, all is copied.
"""

import ast
import ctypes
import inspect
from collections.abc import Callable
from functools import wraps
from itertools import count
from types import FunctionType
from typing import Any

from taichi._lib import core
from taichi.lang import impl, kernel_impl

from ..language import active, inline, ti

NEVER = "if {0} < -2147483647: self.{1}({2})"  # what a function begins with: LLVM copies none that calls itself
MOST = 8  # functions of a kernel
_numbers = count()  # of functions; they are no part of what kernels are known by
_kernel: Any = None  # that is compiled,
_keys: dict[Any, Any] = {}  # those of its functions that have a body,
_spare: list[tuple[Any, Any]] = []  # and those that have none: keys and functions


def called(function: Any) -> Any:
    """A ti.func for kernels to call: a method whose other arguments, and what it returns, are integers that its annotations name.
    What else it finds out, it writes to fields."""
    real = _real(function.func.func)
    return _calling(function, lambda self: real)


def called_with(types: Callable[[Any], tuple[tuple[Any, ...], tuple[Any, ...]]]) -> Any:
    """The same for a method that takes and returns other types, see below; the first is an integer's. types: of arguments and of
    results, by the object."""

    def decorated(function: Any) -> Any:
        """A ti.func whose types depend on the object."""
        reals: dict[Any, Any] = {}

        def real_for(self: Any) -> Any:
            """The function for the types of this object."""
            given, returned = key = types(self)
            if key not in reals:
                of: Any = function.func.func
                new = FunctionType(of.__code__, of.__globals__, of.__name__, of.__defaults__, of.__closure__)
                new.__annotations__ = dict(zip(inspect.signature(of).parameters, (ti.template(), *given), strict=True))
                new.__annotations__["return"] = returned
                reals[key] = _real(new)
            return reals[key]

        return _calling(function, real_for)

    return decorated


def _real(function: Any) -> Any:
    """A function that is called, of one that would be copied."""
    return kernel_impl.Func(function, _classfunc=True, is_real_function=True)


def _calling(function: Any, real_for: Callable[[Any], Any]) -> Any:
    """A method that kernels call where they may. real_for: what they call of an object."""

    @inline
    @wraps(function)
    def call(self, *args):
        """Call it, or have it copied."""
        if not (active and active[-1].calls):
            return function(self, *args)
        real = real_for(self)
        key = _key(real, (self, *args))
        return real.func_call_rvalue(key=key, args=(self, *args)) if key else function(self, *args)

    return call


def _key(real: Any, args: tuple[Any, ...]) -> Any:
    """By what the compiler knows a function of an object, which is compiled when a kernel calls it first; None where it has too
    many.

    The kernel is kept for other processes by what is in its functions, in the order of their addresses. So all are made at once,
    and get their bodies in that order.
    """
    global _kernel, _keys, _spare
    runtime: Any = impl.get_runtime()
    if _kernel is not runtime.current_kernel.kernel_cpp:
        keys = [core.FunctionKey("called", 0, next(_numbers)) for _ in range(MOST)]
        made = [(key, runtime.prog.create_function(key)) for key in keys]
        _kernel, _keys, _spare = runtime.current_kernel.kernel_cpp, {}, sorted(made, key=_address)
    which = real, id(args[0])
    if which not in _keys and _spare:
        _keys[which], function = _spare.pop(0)
        _compile(real, _keys[which], function, args)
    return _keys.get(which)


def _address(made: tuple[Any, Any]) -> int:
    """Where a function is: of pybind's object, the third word says so."""
    return ctypes.c_uint64.from_address(id(made[1]) + 16).value


def _compile(real: Any, key: Any, function: Any, args: tuple[Any, ...]) -> None:
    """Give a function a body."""
    runtime: Any = impl.get_runtime()
    read: Any = kernel_impl._get_tree_and_ctx
    tree, ctx = read(real, is_kernel=False, args=args, is_real_function=True)
    names = [one.name for one in real.arguments[1:]]
    tree.body[0].returns = real.return_type and ast.Constant(0)  # else Taichi takes it for one that returns nothing
    tree.body[0].body.insert(0, ast.parse(NEVER.format(names[0], real.func.__name__, ", ".join(names))).body[0])
    real.taichi_functions[key.instance_id] = function

    def body() -> None:
        """Make statements of it."""
        outer, runtime.compiling_callable = runtime.compiling_callable, function
        ctx.ast_builder = function.ast_builder()
        try:
            kernel_impl.transform_tree(tree, ctx)
        finally:
            runtime.compiling_callable = outer

    function.set_function_body(body)
