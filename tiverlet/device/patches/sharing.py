"""Kernels are compiled for a structure, not for an object: objects of which all that kernels could read is equal share them.

Taichi compiles a kernel anew for every object that it belongs to. What it compiles is a function of what it reads meanwhile:
attributes of the object and of all that hangs on it, and functions. So all of this is written down in an order that does not
depend on who asks, numbers by their bits, fields by their places, functions by what they are and what they know from around them.
Where two objects have the same writing, the second one takes what was compiled for the first. Left out are attributes of our
objects whose names begin with an underscore, those that a class lists as `host_only` or does not list in `kernels_read` where it
has that, and what arrays hold: kernels must not read these, which tests/test_sharing.py makes sure of. Whatever else hangs on an
object counts, read or not: what nobody has thought of has kernels compiled once more, and never makes them wrong.

Everything here knows the inside of Taichi 1.7.4; with another one, every object has kernels of its own.
"""

import types
import weakref
from collections.abc import Callable
from functools import lru_cache, partial
from hashlib import blake2b
from typing import Any

import numpy as np
import taichi as ti
from taichi.lang.field import Field
from taichi.lang.kernel_impl import Func, Kernel

from ..language import OURS, TAICHI, active

OF_TAICHI = ("taichi", "numpy", "math")  # modules that stay as they are
EQUAL = frozenset((int, str, bool, type(None), bytes, complex))  # told apart by what they are equal to, among their own type
ITSELF = frozenset((type, types.ModuleType, types.BuiltinFunctionType, np.ufunc, np.dtype, type(ti.f32)))


class Same:
    """An object that is equal only to itself; it lives as long as somebody asks about it."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return type(other) is Same and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


class Writing:
    """All that hangs on an object, in order. known: objects that are not looked into."""

    def __init__(self, value: Any, known: tuple[Any, ...] = ()):
        self.out: list[Any] = []
        self._numbers: dict[int, int] = {id(one): k for k, one in enumerate(known)}
        self._alive: list[Any] = []  # whose ids must not go to others
        self._ours = True  # whether it hangs on an object of ours, and not on one of the user's
        self.write(value)

    @property
    def key(self) -> tuple[bytes, tuple[Same, ...]]:
        """It in short: a digest, and the objects that are meant themselves."""
        text = repr([0 if type(word) is Same else word for word in self.out])
        return blake2b(text.encode()).digest(), tuple(word for word in self.out if type(word) is Same)

    def write(self, value: Any) -> None:
        """Add one object."""
        out, kind = self.out, type(value)
        if kind in EQUAL:
            out += (kind, value)
            return
        if kind is float:
            out.append(value.hex())
            return
        if kind in ITSELF:
            out.append(Same(value))
            return
        if id(value) in self._numbers:
            out += ("again", self._numbers[id(value)])
            return
        self._numbers[id(value)] = len(self._numbers)
        self._alive.append(value)
        _way(kind)(self, value)

    def _write_row(self, value: Any) -> None:
        """A list or a tuple: of our objects, kernels go through either alike; and a recording gives arguments back as lists."""
        self.out += ("row" if self._ours else type(value), len(value))
        for one in value:
            self.write(one)

    def _write_set(self, value: Any) -> None:
        """A set, in an order of its own."""
        self.out.append(type(value))
        self.write(sorted(value, key=repr))

    def _write_mapping(self, value: Any) -> None:
        """A dictionary."""
        self.out += (type(value), len(value))
        for key, one in value.items():
            self.write(key)
            self.write(one)

    def _write_array(self, value: Any) -> None:
        """An array: of ours, kernels do not read what it holds."""
        self.out.append(type(value))
        if not self._ours:
            self.out += (value.dtype.str, value.shape, value.tobytes())

    def _write_number(self, value: Any) -> None:
        """A number of NumPy."""
        self.out += (type(value), value.tobytes())

    def _write_method(self, value: Any) -> None:
        """A function of an object."""
        self.out.append(type(value))
        self.write(value.__func__)
        self.write(value.__self__)

    def _write_partial(self, value: Any) -> None:
        """A function with some of its arguments."""
        self.out.append(type(value))
        self.write((value.func, value.args, value.keywords))

    def _write_kernel(self, value: Any) -> None:
        """A function or kernel of Taichi."""
        self.write(value.func)

    def _write_field(self, value: Any) -> None:
        """A field, by its place."""
        self.out.append(vars(value).get("place_name") or Same(value))

    def _write_object(self, value: Any) -> None:
        """An object, by what of it kernels may read."""
        kind, own = type(value), vars(value)
        before, self._ours = self._ours, _is_ours(kind)
        self.out.append(Same(kind))
        for name in _read_of(kind, tuple(own)):
            self.out.append(name)
            self.write(own[name])
        if self._ours and hasattr(kind, "compiled"):
            self.write(value.compiled())
        self._ours = before

    def _write_itself(self, value: Any) -> None:
        """What is equal to nothing else."""
        self.out.append(Same(value))

    def _write_function(self, function: Any) -> None:
        """A function, with what it knows from around it."""
        self.out.append(Same(function.__code__))
        if function.__code__.co_filename.startswith((OURS, TAICHI)) and not function.__closure__:
            return
        before, self._ours = self._ours, False
        self.write((function.__defaults__, function.__kwdefaults__))
        for cell in function.__closure__ or ():
            self.write(cell.cell_contents)
        for name in _names(function.__code__):
            if name in function.__globals__:
                known = function.__globals__[name]
                self.out.append(name)
                self.write(known)
                if isinstance(known, types.ModuleType) and not known.__name__.startswith(OF_TAICHI):
                    for of in _names(function.__code__):
                        if of in vars(known):
                            self.out.append(of)
                            self.write(vars(known)[of])
        self._ours = before


def _names(code: types.CodeType) -> list[str]:
    """The names that a function asks of what is around it."""
    inside = [name for const in code.co_consts if isinstance(const, types.CodeType) for name in _names(const)]
    return [*code.co_names, *inside]


@lru_cache(None)
def _way(kind: type) -> Callable[[Writing, Any], None]:
    """How objects of a class are written."""
    if kind in (types.FunctionType, types.MethodType, partial):
        ways = {types.FunctionType: Writing._write_function, types.MethodType: Writing._write_method}
        return ways.get(kind, Writing._write_partial)
    for kinds, way in WAYS:
        if issubclass(kind, kinds):
            return way
    return Writing._write_object if kind.__dictoffset__ else Writing._write_itself


@lru_cache(None)
def _is_ours(kind: type) -> bool:
    """Whether a class is ours, and not one of the user's."""
    return kind.__module__.startswith("tiverlet.")


@lru_cache(1000)
def _read_of(kind: type, names: tuple[str, ...]) -> list[str]:
    """The attributes that kernels may read, of an object of a class that has these."""
    return sorted(name for name in names if may_read(kind, name))


@lru_cache(None)
def may_read(kind: type, name: str) -> bool:
    """Whether kernels may read an attribute of objects of a class."""
    if _is_ours(kind) and name.startswith("_"):
        return False
    said = [vars(base) for base in kind.__mro__]
    only = next((base["kernels_read"] for base in said if "kernels_read" in base), (name,))
    return name in only and not any(name in base.get("host_only", ()) for base in said)


WAYS: tuple[tuple[Any, Callable[[Writing, Any], None]], ...] = (
    ((tuple, list), Writing._write_row), ((set, frozenset), Writing._write_set), (dict, Writing._write_mapping),
    (np.ndarray, Writing._write_array), (np.generic, Writing._write_number), ((Func, Kernel), Writing._write_kernel),
    (Field, Writing._write_field),
)  # fmt: skip
_known: dict[tuple, str] = {}  # writings in short, and by which name their kernels are known
_names_of: weakref.WeakKeyDictionary[Any, dict[tuple, str]] = weakref.WeakKeyDictionary()  # by objects: their kernels
_keys_of: weakref.WeakKeyDictionary[Any, tuple] = weakref.WeakKeyDictionary()  # by objects: their writings in short


def _ensured(self: Any, *args: Any) -> Any:
    """Compile a kernel, unless one is there."""
    if not active or not self.classkernel or not getattr(type(args[0]), "__module__", "").startswith("tiverlet"):
        return _ensure(self, *args)
    features, compiler = self.mapper.extract(args), active[-1]
    known = _names_of.setdefault(args[0], {})
    which = (self.func, *features[1:])
    if which not in known:
        options = (compiler.real, compiler.thorough, tuple(compiler.passes.items()))
        if args[0] not in _keys_of:
            _keys_of[args[0]] = Writing(args[0]).key
        writing = (self.func, options, features[1:], _keys_of[args[0]])
        known[which] = _known.setdefault(writing, f"shared{len(_known)}")
    key = (self.func, known[which], self.autodiff_mode)
    name = next((a for a in args if isinstance(a, str)), self.func.__name__)
    _compile(self, key, name, lambda: self.materialize(key=key, args=args, arg_features=features))
    return key


def apply(compile_: Callable) -> None:
    """Put this in the place of what Taichi calls. compile_: what makes kernels that are not there, as timing.compiled does."""
    global _compile
    _compile = compile_
    Kernel.ensure_compiled = _ensured  # type: ignore[method-assign]


_ensure: Any = Kernel.ensure_compiled
_compile: Any = None
