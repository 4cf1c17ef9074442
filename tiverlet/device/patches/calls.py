"""Functions that kernels call. Taichi copies a ti.func into each place that calls it.

LLVM, and Taichi's simplifier even more so, take longer for one long function than for two of half its length. So a function that
is long and used in several places, or that runs once per frame or phase, is compiled once and called: a pile of 1600 spheres with
friction starts in 2.7 s instead of 5.3, and its frames take as long. In many copies of a world and on a GPU, functions are copied
into each place.
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

NEVER = "if {0} < -2147483647: self.{1}({2})"  # first statement of a function: LLVM does not inline one that calls itself
MOST = 16  # most functions of a kernel
_numbers = count()  # numbers of functions; they are no part of the key of a kernel
_kernel: Any = None  # the kernel that is being compiled
_keys: dict[Any, Any] = {}  # keys of its functions that have a body
_spare: list[tuple[Any, Any]] = []  # its functions without a body: keys and functions


def called(function: Any) -> Any:
    """Let kernels call a ti.func instead of copying it.

    It must be a method whose other arguments and result are numbers of the types of its annotations, the first an integer. All
    other results go to fields.
    """
    real = _real(function.func.func)
    return _calling(function, lambda self: real)


def called_with(types: Callable[[Any], tuple[tuple[Any, ...], tuple[Any, ...]]]) -> Any:
    """Like called(), for a method with other types of arguments and results. Its first argument must be an integer.

    types: a function of the object that returns the types of arguments and of results.
    """

    def decorated(function: Any) -> Any:
        """Wrap a ti.func whose types depend on the object."""
        reals: dict[Any, Any] = {}

        def real_for(self: Any) -> Any:
            """Return the function for the types of this object."""
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
    """Turn a function that would be copied into one that is called."""
    return kernel_impl.Func(function, _classfunc=True, is_real_function=True)


def _calling(function: Any, real_for: Callable[[Any], Any]) -> Any:
    """Return a method that kernels call where possible. real_for: the function to call, by the object."""

    @inline
    @wraps(function)
    def call(self, *args):
        """Call the function, or copy it."""
        if not (active and active[-1].calls):
            return function(self, *args)
        real = real_for(self)
        key = _key(real, (self, *args))
        return real.func_call_rvalue(key=key, args=(self, *args)) if key else function(self, *args)

    return call


def _key(real: Any, args: tuple[Any, ...]) -> Any:
    """Return the key of an object's function, compiled when a kernel first calls it; None if the kernel has too many functions.

    Taichi caches a kernel for other processes under a hash of its functions, in the order of their addresses. So all functions
    are created at once, and get their bodies in the order of their addresses.
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
    """Return the address of a function: the third word of pybind's object."""
    return ctypes.c_uint64.from_address(id(made[1]) + 16).value


def _compile(real: Any, key: Any, function: Any, args: tuple[Any, ...]) -> None:
    """Give a function a body."""
    runtime: Any = impl.get_runtime()
    read: Any = kernel_impl._get_tree_and_ctx
    tree, ctx = read(real, is_kernel=False, args=args, is_real_function=True)
    names = [one.name for one in real.arguments[1:]]
    tree.body[0].returns = real.return_type and ast.Constant(0)  # without it Taichi assumes that nothing is returned
    tree.body[0].body.insert(0, ast.parse(NEVER.format(names[0], real.func.__name__, ", ".join(names))).body[0])
    real.taichi_functions[key.instance_id] = function

    def body() -> None:
        """Translate the tree into statements of the function."""
        outer, runtime.compiling_callable = runtime.compiling_callable, function
        ctx.ast_builder = function.ast_builder()
        try:
            kernel_impl.transform_tree(tree, ctx)
        finally:
            runtime.compiling_callable = outer

    function.set_function_body(body)
