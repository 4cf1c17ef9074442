"""How kernels are compiled: in a third of the time that Taichi takes by itself, to the same bits.

Most of that time goes into Taichi's analysis of control flow, which LLVM does again, and into pictures of source lines for
errors that do not happen. Both are left out while a kernel of ours compiles, and only then: what the user compiles in the same
process is compiled as ever. A kernel with the user's functions in it keeps the analysis, because it can hide what LLVM ends the
process for: a vector assigned to a variable that is a number, where nobody reads it (`_, gap, _ = nearest(x)`).

Everything here knows the inside of Taichi 1.7.4; with another one, kernels are compiled as Taichi does.
"""

import contextlib
import linecache
import os
import pathlib
import sys
import textwrap
import threading
import weakref
from collections.abc import Iterator
from functools import lru_cache
from types import CodeType, SimpleNamespace
from typing import Any

import numpy as np
import taichi as ti
from taichi.lang import impl, kernel_impl
from taichi.lang.ast import ASTTransformerContext

# Where functions come from that are known to be safe.
HOME = tuple(str(pathlib.Path(file).parent) + os.sep for file in (__file__, ti.__file__))
HOSTS = ("Arch.x64", "Arch.arm64")  # whose kernels LLVM makes as fast without it; measured on x64
# No variables for what loops read and write at one address: Taichi does not see that another address may be the same place, such
# as field[k] for field[0].
SAFE = {"cache_loop_invariant_global_vars": False}
LEAN = SAFE | {"cfg_optimization": False}  # and no analysis of control flow
# In small worlds, no search for equal expressions either: compiling takes two thirds of the time, and frames with contacts a
# tenth more, because the address of the fields is looked up again after every store.
BRIEF = {"opt_level": 0}
FEW = 1000  # particles from which it pays
NOTHING = 8  # bytes of code of a function that has nothing but a docstring
_INSIDE = contextlib.nullcontext()
_lock = threading.RLock()  # the type of literals is one for all threads
_active: list["Compiler"] = []  # whose kernels are being compiled or launched, the innermost last
_lines: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # of functions, as inspect finds them
_files: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


class Compiler:
    """How the kernels of one world are compiled, while it is called as a context.

    real: the type of their literals. Taichi rounds the literal 0.1 to its default type even next to f64 operands; a world of
    precision "f64" (and the user's own functions in it) must not lose half of the digits that way. particles: how many they are
    for. Kernels compile at their first launch.
    """

    def __init__(self, real, particles: int = FEW):
        self.real = real
        self.lean = LEAN | BRIEF if particles < FEW else LEAN
        self.thorough = not _patched  # once and for all, since what Taichi fails to compile may be tried again
        self._settings: dict[str, Any] = {}  # that Taichi was started with
        self._thread = 0

    def __call__(self) -> contextlib.AbstractContextManager[None]:
        """The context; inside itself it has nothing to do."""
        if _active and _active[-1] is self and self._thread == threading.get_ident():
            return _INSIDE
        return self._entered()

    @contextlib.contextmanager
    def _entered(self) -> Iterator[None]:
        runtime: Any = impl.get_runtime()
        with _lock:
            config, literals = runtime.prog.config(), runtime.default_fp
            before = {name: getattr(config, name) for name in LEAN | BRIEF}
            self._settings = _active[0]._settings if _active else before
            runtime.set_default_fp(self.real)
            _set(config, self.lean if str(config.arch) in HOSTS and not self.thorough else SAFE)
            _active.append(self)
            self._thread = threading.get_ident()
            try:
                yield
            finally:
                _active.pop()
                runtime.set_default_fp(literals)
                _set(config, before)

    def beware(self) -> None:
        """Be thorough from here on: a function that is not ours is being compiled."""
        runtime: Any = impl.get_runtime()
        self.thorough = True
        _set(runtime.prog.config(), self._settings | SAFE)


class Quick:
    """A kernel of one object, for many launches: after the first one, past the door at which Taichi looks at the object and at
    each argument anew, which takes 25 us.

    Its arguments are arrays, which stay where they are; what they hold may change from launch to launch. It returns nothing. What
    Taichi freezes at the first compile is frozen, as ever: an object that has changed takes a new Quick.
    """

    def __init__(self, owner: Any, name: str, compiler: Compiler, *arrays: np.ndarray):
        self.owner, self.name, self.compiler, self.arrays = owner, name, compiler, arrays
        self._ready: Any = None

    def __call__(self) -> None:
        """Launch it."""
        if self._ready is None:
            with self.compiler():
                getattr(self.owner, self.name)(*self.arrays)
                if _patched:
                    self._ready = self._prepared()
        else:
            self.launch()

    def launch(self) -> None:
        """Launch it when it is compiled."""
        program, kernel, compiled, context = self._ready
        program.launch_kernel(compiled, context or self._context(kernel))

    def _prepared(self) -> tuple:
        """What a launch needs; for one on a GPU, which copies arrays to and fro, a context of its own."""
        primal: Any = getattr(type(self.owner), self.name)._primal
        kernel = primal.compiled_kernels[primal.ensure_compiled(self.owner, *self.arrays)]
        program: Any = impl.get_runtime().prog
        compiled = program.compile_kernel(program.config(), program.get_device_caps(), kernel)
        return program, kernel, compiled, self._context(kernel) if str(program.config().arch) in HOSTS else None

    def _context(self, kernel: Any) -> Any:
        """Where the arrays are."""
        context = kernel.make_launch_context()
        for k, array in enumerate(self.arrays):
            context.set_arg_external_array_with_shape((k,), array.ctypes.data, array.nbytes, array.shape, 0)
        return context


def _set(config, settings: dict[str, Any]) -> None:
    for name, value in settings.items():
        setattr(config, name, value)


def _lines_of(function) -> tuple[list[str], int]:
    """The source of a function that is about to be compiled, found once and not at each call of it."""
    if not _active:
        return _find_lines(function)
    if not function.__code__.co_filename.startswith(HOME):
        _active[-1].beware()
    if function not in _lines:
        _lines[function] = _cut_out(function.__code__) or _find_lines(function)
    return _lines[function]


def _cut_out(code: CodeType) -> tuple[list[str], int] | None:
    """The lines of a function from where its code begins to where it ends; inspect looks for the end token by token.

    None for one that does nothing, whose code does not tell.
    """
    first, lines = code.co_firstlineno, linecache.getlines(code.co_filename)
    return (lines[first - 1 : _end(code)], first) if lines and len(code.co_code) > NOTHING else None


def _end(code: CodeType) -> int:
    """The last line of a function and of those inside it."""
    inside = [_end(const) for const in code.co_consts if isinstance(const, CodeType)]
    return max([code.co_firstlineno, *inside, *(end for _, end, _, _ in code.co_positions() if end)])


def _file_of(function) -> str:
    """The file that it is in, found once."""
    if function not in _files:
        _files[function] = _find_file(function)
    return _files[function]


def _place_of(self: Any, node: Any) -> str:
    """Where a node is, without the picture of it that Taichi draws for every node; errors still get it."""
    if not _active or self.raised:
        return _draw(self, node)
    line, name = self.src[node.lineno - 1], self.func.func.__name__
    return f'File "{self.file}", line {node.lineno + self.lineno_offset}, in {name}:\n{line}\n'


def _in_class(level_of_class_stackframe: int) -> bool:
    """Whether a decorator is at work in the body of a class; Taichi looks for the source of the statement around it, which for
    all of ours took half of the time that importing them took."""
    body = sys._getframe(level_of_class_stackframe - 1)
    if body.f_code.co_filename.startswith(HOME):
        return "__qualname__" in body.f_locals
    return _look_around(level_of_class_stackframe + 1)


def _patch() -> bool:
    """Put these in the place of what Taichi calls; whether it is the Taichi that they are made for."""
    names = ("getsourcelines", "getsourcefile", "textwrap", "_inside_class")
    config = impl.default_cfg()
    if (
        ti.__version__ != (1, 7, 4)
        or not all(hasattr(kernel_impl, name) for name in names)
        or not all(hasattr(config, name) for name in LEAN | BRIEF)
    ):
        return False
    kernel_impl.getsourcelines, kernel_impl.getsourcefile, kernel_impl._inside_class = _lines_of, _file_of, _in_class
    # Every line of a function is expanded at every call of it.
    kernel_impl.textwrap = SimpleNamespace(fill=lru_cache(1 << 14)(textwrap.fill), dedent=lru_cache(1 << 10)(textwrap.dedent))
    ASTTransformerContext.get_pos_info = _place_of
    return True


_find_lines: Any = getattr(kernel_impl, "getsourcelines", None)
_find_file: Any = getattr(kernel_impl, "getsourcefile", None)
_look_around: Any = getattr(kernel_impl, "_inside_class", None)
_draw: Any = getattr(ASTTransformerContext, "get_pos_info", None)
_patched = _patch()
