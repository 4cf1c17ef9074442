"""Sharing of kernels: objects share a kernel if everything that it could read of them is equal. Each has its own memory.

Taichi compiles a kernel again for every object that it belongs to. The compiled code is a function of everything that Taichi
reads meanwhile: attributes of the object and of all objects that it refers to, and functions. This module writes all of that to a
list, in an order that depends on the objects alone: numbers by their bits, fields by their places, functions by their code and
the values that they refer to. If two objects give the same list, the second uses the kernel of the first.

Two things are left out of the list: attributes that a class lists as `host_only`, or does not list in its `kernels_read` if it
has that; and the values of arrays. Kernels must not read these; tests/test_sharing.py checks it. Everything else counts, whether
kernels read it or not. So an overlooked attribute can cause one more compilation, never a wrong kernel.

Each launch reads the addresses of trees of fields from a table of Taichi's runtime. After another address is written to the
table, the same kernel works on other memory of the same layout. Where the table is not found, or kernels do not follow it, every
world has a tree and kernels of its own.
"""

import ctypes
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

from ..language import OURS, TAICHI, active, impl

OF_TAICHI = ("taichi", "numpy", "math")  # modules that do not change
NEAR = 64  # the table begins within so many words of the runtime's begin; it begins at the twelfth
TREES = 512  # entries of the table
COMPARED_BY_VALUE = frozenset((int, str, bool, type(None), bytes, complex))  # types compared by value
COMPARED_BY_IDENTITY = frozenset((type, types.ModuleType, types.BuiltinFunctionType, np.ufunc, np.dtype, type(ti.f32)))


class ByIdentity:
    """An object that is equal only to itself; it lives as long as this wrapper."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return type(other) is ByIdentity and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


class KernelInputs:
    """The list of everything that kernels could read of an object, in order. known: objects whose contents are left out."""

    def __init__(self, value: Any, known: tuple[Any, ...] = ()):
        self.out: list[Any] = []
        self._numbers: dict[int, int] = {id(one): k for k, one in enumerate(known)}
        self._alive: list[Any] = []  # kept alive, so that no other object gets their ids
        self._ours = True  # whether the value belongs to an object of tiverlet's, not of the user's
        self.write(value)

    @property
    def key(self) -> tuple[bytes, tuple[ByIdentity, ...]]:
        """The list in short: a digest, and the objects that are compared by identity."""
        text = repr([0 if type(word) is ByIdentity else word for word in self.out])
        return blake2b(text.encode()).digest(), tuple(word for word in self.out if type(word) is ByIdentity)

    def write(self, value: Any) -> None:
        """Append one object."""
        out, kind = self.out, type(value)
        if kind in COMPARED_BY_VALUE:
            out += (kind, value)
            return
        if kind is float:
            out.append(value.hex())
            return
        if kind in COMPARED_BY_IDENTITY:
            out.append(ByIdentity(value))
            return
        if id(value) in self._numbers:
            out += ("again", self._numbers[id(value)])
            return
        self._numbers[id(value)] = len(self._numbers)
        self._alive.append(value)
        _writer_of(kind)(self, value)

    def _write_row(self, value: Any) -> None:
        """Append a list or a tuple. In tiverlet's objects the two count as equal: replay turns arguments into lists."""
        self.out += ("row" if self._ours else type(value), len(value))
        for one in value:
            self.write(one)

    def _write_set(self, value: Any) -> None:
        """Append a set, sorted."""
        self.out.append(type(value))
        self.write(sorted(value, key=repr))

    def _write_mapping(self, value: Any) -> None:
        """Append a dictionary."""
        self.out += (type(value), len(value))
        for key, one in value.items():
            self.write(key)
            self.write(one)

    def _write_array(self, value: Any) -> None:
        """Append an array. Of tiverlet's own arrays the values are left out, since kernels do not read them."""
        self.out.append(type(value))
        if not self._ours:
            self.out += (value.dtype.str, value.shape, value.tobytes())

    def _write_number(self, value: Any) -> None:
        """Append a number of NumPy."""
        self.out += (type(value), value.tobytes())

    def _write_method(self, value: Any) -> None:
        """Append a bound method."""
        self.out.append(type(value))
        self.write(value.__func__)
        self.write(value.__self__)

    def _write_partial(self, value: Any) -> None:
        """Append a partial function."""
        self.out.append(type(value))
        self.write((value.func, value.args, value.keywords))

    def _write_kernel(self, value: Any) -> None:
        """Append a function or kernel of Taichi."""
        self.write(value.func)

    def _write_field(self, value: Any) -> None:
        """Append a field, by its place."""
        self.out.append(vars(value).get("place_name") or ByIdentity(value))

    def _write_object(self, value: Any) -> None:
        """Append an object, by the attributes that kernels may read."""
        kind, own = type(value), vars(value)
        before, self._ours = self._ours, _is_ours(kind)
        self.out.append(ByIdentity(kind))
        for name in _read_of(kind, tuple(own)):
            self.out.append(name)
            self.write(own[name])
        if self._ours and hasattr(kind, "compiled"):
            self.write(value.compiled())
        self._ours = before

    def _write_itself(self, value: Any) -> None:
        """Append an object that is compared by identity."""
        self.out.append(ByIdentity(value))

    def _write_function(self, function: Any) -> None:
        """Append a function, with its defaults and the values that it refers to from outside."""
        self.out.append(ByIdentity(function.__code__))
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
    """Return the names that a function refers to, including those of functions inside it."""
    inside = [name for const in code.co_consts if isinstance(const, types.CodeType) for name in _names(const)]
    return [*code.co_names, *inside]


@lru_cache(None)
def _writer_of(kind: type) -> Callable[[KernelInputs, Any], None]:
    """Return the method of KernelInputs for objects of a class."""
    if kind in (types.FunctionType, types.MethodType, partial):
        writers = {types.FunctionType: KernelInputs._write_function, types.MethodType: KernelInputs._write_method}
        return writers.get(kind, KernelInputs._write_partial)
    for kinds, writer in WRITERS:
        if issubclass(kind, kinds):
            return writer
    return KernelInputs._write_object if kind.__dictoffset__ else KernelInputs._write_itself


@lru_cache(None)
def _is_ours(kind: type) -> bool:
    """Whether a class is tiverlet's, not the user's."""
    return kind.__module__.startswith("tiverlet.")


@lru_cache(1000)
def _read_of(kind: type, names: tuple[str, ...]) -> list[str]:
    """Return the attributes that kernels may read, out of the `names` of an object's attributes, sorted."""
    return sorted(name for name in names if may_read(kind, name))


@lru_cache(None)
def may_read(kind: type, name: str) -> bool:
    """Whether kernels may read an attribute of objects of a class."""
    said = [vars(base) for base in kind.__mro__]
    only = next((base["kernels_read"] for base in said if "kernels_read" in base), (name,))
    return name in only and not any(name in base.get("host_only", ()) for base in said)


WRITERS: tuple[tuple[Any, Callable[[KernelInputs, Any], None]], ...] = (
    ((tuple, list), KernelInputs._write_row), ((set, frozenset), KernelInputs._write_set), (dict, KernelInputs._write_mapping),
    (np.ndarray, KernelInputs._write_array), (np.generic, KernelInputs._write_number),
    ((Func, Kernel), KernelInputs._write_kernel), (Field, KernelInputs._write_field),
)  # fmt: skip
_known: dict[tuple, str] = {}  # the name of the shared kernel, by the key of a KernelInputs
_names_of: weakref.WeakKeyDictionary[Any, dict[tuple, str]] = weakref.WeakKeyDictionary()  # names of kernels, by object
_keys_of: weakref.WeakKeyDictionary[Any, tuple] = weakref.WeakKeyDictionary()  # the key of the KernelInputs, by object


def _ensured(self: Any, *args: Any) -> Any:
    """Compile a kernel unless an object with an equal list has it already. Return the kernel's key."""
    if not active or not self.classkernel or not getattr(type(args[0]), "__module__", "").startswith("tiverlet"):
        return _ensure(self, *args)
    features, compiler = self.mapper.extract(args), active[-1]
    known = _names_of.setdefault(args[0], {})
    which = (self.func, *features[1:])
    if which not in known:
        options = (compiler.real, compiler.thorough, tuple(compiler.passes.items()))
        if args[0] not in _keys_of:
            _keys_of[args[0]] = KernelInputs(args[0]).key
        writing = (self.func, options, features[1:], _keys_of[args[0]])
        known[which] = _known.setdefault(writing, f"shared{len(_known)}")
    key = (self.func, known[which], self.autodiff_mode)
    name = next((a for a in args if isinstance(a, str)), self.func.__name__)
    _compile(self, key, name, lambda: self.materialize(key=key, args=args, arg_features=features))
    return key


def finalize_without_memory(builder: Any) -> Any:
    """Finalize a tree of fields without memory. Kernels can be compiled for it; it needs an address before they run."""
    return builder._finalize_for_aot()


def table_of(finder: Any, tree: int, offset: int) -> Any:
    """Return the table as an array of addresses, indexed by tree; None if it is not found, or kernels do not follow it.

    finder: an AddressFinder of a field, `offset` bytes behind the begin of the tree with number `tree`.
    """
    program: Any = impl.get_runtime().prog
    addresses = np.zeros(1, dtype=np.uint64)
    finder.find(addresses)
    begin = int(addresses[0]) - offset
    primal: Any = type(finder).find._primal
    made = primal.compiled_kernels[primal.ensure_compiled(finder, addresses)]
    context = made.make_launch_context()
    context.set_arg_external_array_with_shape((0,), addresses.ctypes.data, addresses.nbytes, addresses.shape, 0)
    program.launch_kernel(program.compile_kernel(program.config(), program.get_device_caps(), made), context)
    builder = _words(_words(id(context), 3)[2], 3)  # the third word of pybind's object is the address of the C++ object
    owned, borrowed = builder[1], builder[2]  # two equal pointers to the context that kernels get
    if not owned or owned != borrowed:
        return None
    runtime = _words(owned, 2)[1]
    if not runtime or runtime % 8:
        return None
    found = [k for k, word in enumerate(_words(runtime, NEAR)) if word == begin]
    if len(found) != 1 or found[0] < tree:
        return None
    table = np.ctypeslib.as_array((ctypes.c_uint64 * TREES).from_address(runtime + 8 * (found[0] - tree)))
    table[tree] = begin + NEAR  # the kernel only computes an address there, and reads nothing
    finder.find(addresses)
    table[tree] = begin
    return table if int(addresses[0]) == begin + NEAR + offset else None


def _words(address: int, count: int) -> Any:
    return (ctypes.c_uint64 * count).from_address(address)


def apply(compile_: Callable) -> None:
    """Replace Taichi's Kernel.ensure_compiled. compile_: compiles a missing kernel, as timing.compiled does."""
    global _compile
    _compile = compile_
    Kernel.ensure_compiled = _ensured  # type: ignore[method-assign]


_ensure: Any = Kernel.ensure_compiled
_compile: Any = None
