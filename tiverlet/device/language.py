"""The language of kernels: Taichi, or its maintained fork Quadrants with TIVERLET_COMPILER=quadrants.

Both accept nearly the same language. Only this module imports them, without their banner and without a version check over the
network. All differences between their internals are handled here.
"""

import contextlib
import functools
import io
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable
from importlib import import_module
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

NAMES = {"taichi": "Taichi", "quadrants": "Quadrants"}
COMPILER = os.environ.get("TIVERLET_COMPILER") or "taichi"
if COMPILER not in NAMES:
    raise ImportError(f'TIVERLET_COMPILER = {COMPILER!r}, but it must be "taichi", as where it is not set, or "quadrants".')
NAME = NAMES[COMPILER]

if COMPILER not in sys.modules and os.name == "posix" and "HOME" not in os.environ:  # without HOME the import ends the process
    os.environ["HOME"] = next(folder for folder in (os.path.expanduser("~"), tempfile.gettempdir()) if os.path.isabs(folder))
if TYPE_CHECKING or COMPILER == "taichi":
    # Taichi reads these variables at import. If it was imported before, the banner is printed already, and setting the log level
    # again would cause a warning.
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
    if "taichi" not in sys.modules:
        os.environ.setdefault("TI_LOG_LEVEL", "error")
    import taichi as ti
else:
    if "quadrants" not in sys.modules:
        os.environ.setdefault("QD_LOG_LEVEL", "error")
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import quadrants as ti
    except ModuleNotFoundError as e:
        raise ImportError("TIVERLET_COMPILER=quadrants needs Quadrants: pip install 'tiverlet[quadrants]'.") from e

_MARK, _INNER = ("_is_taichi_function", "func") if COMPILER == "taichi" else ("_is_quadrants_function", "wrapper")


def module(name: str) -> Any:
    """Return a module of the compiler's Python, by its path below `lang`."""
    return import_module(f"{COMPILER}.lang.{name}")


if COMPILER == "quadrants":
    # Quadrants caches an object's bound functions in the object; in a copy they would still act on the original.
    _callables: Any = module("_quadrants_callable")
    _callables.QuadrantsCallable.__get__ = lambda self, instance, owner: (
        self if instance is None else _callables.BoundQuadrantsCallable(instance, self)
    )
impl, sources = module("impl"), module("_wrap_inspect")
inside_kernel: Callable[[], bool] = impl.inside_kernel
Expression: Any = module("expr").Expr  # the type of numbers and vectors while a kernel is translated
_VECTORS, _NUMBERS = module("matrix").MatrixField, module("field").ScalarField
Operations: Any = getattr(module("common_ops"), f"{NAME}Operations")  # the base class of Expression


active: list[Any] = []  # the Compilers whose context is open, the innermost last
# Folders of source code that the patches may handle: tiverlet's own and the compiler's.
HOME = OURS, TAICHI = tuple(str(p) + os.sep for p in (pathlib.Path(__file__).parents[1], pathlib.Path(ti.__file__).parent))


def current() -> Any:
    """Return the compiler's runtime object; each ti.init and ti.reset makes another one."""
    return impl.get_runtime()


def start(**options: Any) -> None:
    """Start the compiler with options of ti.init, which prints its banner whatever the log level."""
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(**options)


def supports(arch: str) -> bool:
    """Whether this machine and this compiler support an architecture, by its name in Taichi."""
    with contextlib.suppress(Exception):
        library: Any = ti._lib
        return bool(getattr(library.core, f"with_{arch}")())
    return False


def unplaced_field(width: int) -> Any:
    """Return a field without memory: of vectors, or of numbers where width is 0."""
    return object.__new__(_VECTORS if width else _NUMBERS)


def plain_field(thing: Any) -> bool:
    """Whether a thing is a field of numbers or of vectors."""
    return type(thing) is _NUMBERS or type(thing) is _VECTORS


def _create_field_member(*args: Any, **kwargs: Any) -> Any:
    """Create the member of a field. Before Taichi runs, its own message would name ti.init, whose defaults round otherwise."""
    if current().prog is None:
        raise RuntimeError(
            "A field of Taichi was asked for before Taichi runs. Call tv.init() first; else the first tv.World starts it."
        )
    return _create(*args, **kwargs)


_create: Any = impl.create_field_member
impl.create_field_member = functools.wraps(_create)(_create_field_member)


def at(field: Any, index: Any) -> Any:
    """Return field[index], in a Python function that kernels call as it is; see inline()."""
    return impl.subscript(current().compiling_callable.ast_builder(), field, index)


def always() -> Any:
    """Return an expression that is true, in a Python function that kernels call as it is."""
    return ti.cast(1, ti.i32) > 0


def never() -> Any:
    """Return an expression that is false, in a Python function that kernels call as it is."""
    return ti.cast(0, ti.i32) > 0


class _Text(str):
    """A string that can be weakly referenced, unlike a str."""


@functools.cache
def template(text: str) -> str:
    """Return a text as a template argument for a kernel: Quadrants keeps weak references to these."""
    return _Text(text)


def inline(function: Any) -> Any:
    """Let kernels call a Python function of one expression, or a class, as it is: they get the expression itself.

    For a call of a ti.func, Taichi reads the source and copies each argument and each result to a variable: as much work as for
    ten more operations.
    """
    setattr(function, _MARK, True)  # without these two attributes, the compiler warns
    setattr(function, _INNER, SimpleNamespace(has_print=False))
    return function


def copied(function: Any) -> Any:
    """Return a ti.func unchanged: each place that calls it gets a copy of its code."""
    return function


def copied_with(types: Any) -> Any:
    """Return copied(), whatever the types; the counterpart of called_with() without patches."""
    return copied


def record(kind: Any) -> Any:
    """Let kernels use a class of several named values: they can construct it, pass it on whole and read it.

    It stores what it is given, not a copy: a variable can be assigned to through it, an expression is computed wherever it is
    read.
    """
    kind._data_oriented = True  # Taichi passes such objects on unchanged
    return inline(kind)


def is_kernel_function(thing: Any) -> bool:
    """Whether a thing is a ti.func, or was made callable in kernels."""
    return bool(getattr(thing, _MARK, False))


def undecorated(thing: Any) -> Any:
    """Return the Python function behind a ti.func; anything else unchanged."""
    return getattr(getattr(thing, _INNER, None), "func", thing) if is_kernel_function(thing) else thing
