"""Functions that kernels call. Taichi copies a ti.func into each place that calls it, and LLVM takes longer for one long function
than for two of half its length.

Kernels of small worlds compile longer than they run. So there, what is long and stands in several places, or runs once in a
frame, is compiled once, and called. Large worlds, and many copies of one, have it where it is called, as they have on a GPU.

Everything here knows the inside of Taichi 1.7.4; with another one, all is copied.
"""

import ast
import ctypes
from functools import wraps
from itertools import count
from typing import Any

from taichi._lib import core
from taichi.lang import impl, kernel_impl

from ..language import active, inline

NEVER = "if {0} < -2147483647: self.{1}({2})"  # what a function begins with: LLVM copies none that calls itself
MOST = 8  # functions of a kernel
_numbers = count()  # of functions; they are no part of what kernels are known by
_kernel: Any = None  # that is compiled,
_keys: dict[Any, Any] = {}  # those of its functions that have a body,
_spare: list[tuple[Any, Any]] = []  # and those that have none: keys and functions


def called(function: Any) -> Any:
    """A ti.func for kernels to call: a method whose other arguments, and what it returns, are integers that its annotations name.
    What else it finds out, it writes to fields."""
    real: Any = kernel_impl.Func(function.func.func, _classfunc=True, is_real_function=True)

    @inline
    @wraps(function)
    def call(self, *args):
        """Call it, or have it copied."""
        key = _key(real, (self, *args)) if active and active[-1].calls else None
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
