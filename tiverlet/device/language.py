"""The language that kernels are written in: Taichi, or Quadrants, its maintained fork, where TIVERLET_COMPILER=quadrants.

Both speak nearly the same language. They are imported here alone, quietly and offline: without banner, and without a version
check over the network. Where their insides differ, it is said here.
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

if COMPILER not in sys.modules and os.name == "posix" and "HOME" not in os.environ:  # or it ends the process
    os.environ["HOME"] = next(folder for folder in (os.path.expanduser("~"), tempfile.gettempdir()) if os.path.isabs(folder))
if TYPE_CHECKING or COMPILER == "taichi":
    # Taichi reads these when it is imported; where that was before, it has printed its banner, and it would warn of the level
    # being set twice.
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
    """A module of the compiler's Python, by its path below `lang`."""
    return import_module(f"{COMPILER}.lang.{name}")


if COMPILER == "quadrants":
    # It would keep the functions of an object in the object, bound; those of a copy would go on with the original.
    _callables: Any = module("_quadrants_callable")
    _callables.QuadrantsCallable.__get__ = lambda self, instance, owner: (
        self if instance is None else _callables.BoundQuadrantsCallable(instance, self)
    )
impl, sources = module("impl"), module("_wrap_inspect")
inside_kernel: Callable[[], bool] = impl.inside_kernel
Expression: Any = module("expr").Expr  # a number or a vector while a kernel is translated
_VECTORS, _NUMBERS = module("matrix").MatrixField, module("field").ScalarField
Operations: Any = getattr(module("common_ops"), f"{NAME}Operations")  # what it inherits


active: list[Any] = []  # Compilers whose kernels are being compiled or launched, the innermost last
# Where functions come from that are known to be safe.
HOME = OURS, TAICHI = tuple(str(p) + os.sep for p in (pathlib.Path(__file__).parents[1], pathlib.Path(ti.__file__).parent))


def current() -> Any:
    """What runs: another object after each ti.init and ti.reset."""
    return impl.get_runtime()


def has(arch: str) -> bool:
    """Whether this machine and this compiler have an architecture, by its name in Taichi."""
    with contextlib.suppress(Exception):
        library: Any = ti._lib
        return bool(getattr(library.core, f"with_{arch}")())
    return False


def unplaced_field(width: int) -> Any:
    """A field that is nowhere yet, of vectors or, with a width of 0, of numbers."""
    return object.__new__(_VECTORS if width else _NUMBERS)


def place_field(field: Any, placed: Any, name: Any) -> None:
    """Make it the same as one that has a place. name: of this place, by which it is known."""
    field.__dict__.update(vars(placed), place_name=name)


def plain_field(thing: Any) -> bool:
    """Whether it is a field of numbers or of vectors."""
    return type(thing) is _NUMBERS or type(thing) is _VECTORS


def before_fields(check: Callable[[], None]) -> None:
    """Have `check` called before a field is made, by whoever makes it."""
    create: Any = impl.create_field_member

    @functools.wraps(create)
    def created(*args, **kwargs):
        """A field's member, where a check allows one."""
        check()
        return create(*args, **kwargs)

    impl.create_field_member = created


def at(field: Any, index: Any) -> Any:
    """field[index], in a Python function that a kernel calls as it is; see inline()."""
    return impl.subscript(current().compiling_callable.ast_builder(), field, index)


class _Text(str):
    """A text that can be weakly referred to, as a str cannot."""


@functools.cache
def template(text: str) -> str:
    """A text for a kernel to have as a template: Quadrants refers weakly to what these are."""
    return _Text(text)


def callable_in_kernels(function: Any) -> Any:
    """A Python function or class that kernels may call as it is, without a warning; functions are asked for these two."""
    setattr(function, _MARK, True)
    setattr(function, _INNER, SimpleNamespace(has_print=False))
    return function


def inline(function: Any) -> Any:
    """A function of one expression, for kernels to call as Python does: they get the expression itself.

    Taichi compiles a call of a ti.func by reading its source, copying each argument to a variable, and each result: as much as
    for ten more operations.
    """
    return callable_in_kernels(function)


def copied(function: Any) -> Any:
    """A ti.func as it is: each place that calls it gets a copy of it."""
    return function


def copied_with(types: Any) -> Any:
    """The same, where it would be called with other types than integers."""
    return copied


def record(kind: Any) -> Any:
    """A class of several values under names, for kernels: what they call makes one, passes it on whole and reads it."""
    kind._data_oriented = True  # by this Taichi knows objects of ours, which it leaves as they are
    return inline(kind)


def is_kernel_function(thing: Any) -> bool:
    """Whether it is a ti.func, or was made callable in kernels."""
    return bool(getattr(thing, _MARK, False))


def undecorated(thing: Any) -> Any:
    """The Python function that a ti.func was made of; others are what they are."""
    return getattr(getattr(thing, _INNER, None), "func", thing) if is_kernel_function(thing) else thing
