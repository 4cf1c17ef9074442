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
EQUAL = (int, str, bool, type(None), bytes, complex)  # told apart by what they are equal to, among their own type
ITSELF = (type, types.ModuleType, types.BuiltinFunctionType, np.ufunc, np.dtype, type(ti.f32))


class Same:
    """An object that is equal only to itself; it lives as long as somebody asks about it."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return type(other) is Same and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


class Writing:
    """All that hangs on an object, in order."""

    def __init__(self, value: Any):
        self.out: list[Any] = []
        self._numbers: dict[int, int] = {}
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
        if isinstance(value, (tuple, list)):
            # Of our objects, kernels go through either alike; and a recording gives arguments back as lists.
            out += ("row" if self._ours else kind, len(value))
            for one in value:
                self.write(one)
        elif isinstance(value, (set, frozenset)):
            out.append(kind)
            self.write(sorted(value, key=repr))
        elif isinstance(value, dict):
            out += (kind, len(value))
            for key, one in value.items():
                self.write(key)
                self.write(one)
        elif isinstance(value, np.ndarray):
            out.append(kind)
            if not self._ours:
                out += (value.dtype.str, value.shape, value.tobytes())
        elif isinstance(value, np.generic):
            out += (kind, value.tobytes())
        elif kind is types.FunctionType:
            self._write_function(value)
        elif kind is types.MethodType:
            out.append(kind)
            self.write(value.__func__)
            self.write(value.__self__)
        elif kind is partial:
            out.append(kind)
            self.write((value.func, value.args, value.keywords))
        elif isinstance(value, (Func, Kernel)):
            self.write(value.func)
        elif isinstance(value, Field):
            out.append(vars(value).get("place_name") or Same(value))
        elif hasattr(value, "__dict__"):
            before, self._ours = self._ours, kind.__module__.startswith("tiverlet.")
            out.append(Same(kind))
            for name in read_names(value):
                out.append(name)
                self.write(vars(value)[name])
            if self._ours and hasattr(kind, "compiled"):
                self.write(value.compiled())
            self._ours = before
        else:
            out.append(Same(value))

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


def read_names(value: Any) -> list[str]:
    """The attributes of an object that kernels may read."""
    return sorted(name for name in vars(value) if may_read(type(value), name))


@lru_cache(None)
def may_read(kind: type, name: str) -> bool:
    """Whether kernels may read an attribute of objects of a class."""
    if kind.__module__.startswith("tiverlet.") and name.startswith("_"):
        return False
    said = [vars(base) for base in kind.__mro__]
    only = next((base["kernels_read"] for base in said if "kernels_read" in base), (name,))
    return name in only and not any(name in base.get("host_only", ()) for base in said)


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
        options = (compiler.real, compiler.thorough, tuple(compiler.lean.items()))
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
