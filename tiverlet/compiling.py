"""How kernels are compiled: in half of the time that Taichi takes by itself, to the same bits.

Three quarters of that time go into Taichi's analysis of control flow, which LLVM does again, and into pictures of source lines
for errors that do not happen. Both are left out while a kernel of ours compiles, and only then: what the user compiles in the
same process is compiled as ever. A kernel with the user's functions in it keeps the analysis. What it leaves out can hide what
LLVM ends the process for: a vector assigned to a variable that is a number, where nobody reads it.

Everything here knows the inside of Taichi 1.7.4; where another Taichi looks different, it is compiled as Taichi does.
"""

import contextlib
import pathlib
import textwrap
import threading
import weakref
from collections.abc import Iterator
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import taichi as ti
from taichi.lang import impl, kernel_impl
from taichi.lang.ast import ASTTransformerContext

HOME = tuple(
    str(pathlib.Path(str(module)).parent) for module in (__file__, ti.__file__)
)  # of functions that are known to be safe
HOSTS = ("Arch.x64", "Arch.arm64")  # where leaving the analysis out was measured to cost nothing
_lock = threading.RLock()  # the type of literals is one for all threads
_active: list["Compiler"] = []  # whose kernels are being compiled or launched, the innermost last
_lines: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()  # of functions, as inspect finds them
_files: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


class Compiler:
    """How the kernels of one world are compiled, while it is called as a context.

    real: the type of their literals. Taichi rounds the literal 0.1 to its default type even next to f64 operands; a world of
    precision "f64" (and the user's own functions in it) must not lose half of the digits that way. Kernels compile at their
    first launch.
    """

    def __init__(self, real):
        self.real = real
        self.thorough = not _patched  # once and for all, since what Taichi fails to compile may be tried again
        self._analysis = True  # what Taichi was started with

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        runtime = impl.get_runtime()
        with _lock:
            config = runtime.prog.config()
            before = runtime.default_fp, config.cfg_optimization
            self._analysis = _active[0]._analysis if _active else config.cfg_optimization
            runtime.set_default_fp(self.real)
            if str(config.arch) in HOSTS and not self.thorough:
                config.cfg_optimization = False
            _active.append(self)
            try:
                yield
            finally:
                _active.pop()
                runtime.set_default_fp(before[0])
                config.cfg_optimization = before[1]

    def beware(self) -> None:
        """Be thorough from here on: a function that is not ours is being compiled."""
        self.thorough = True
        impl.get_runtime().prog.config().cfg_optimization = self._analysis


def _lines_of(function) -> tuple[list[str], int]:
    """The source of a function that is about to be compiled, found once and not at each call of it."""
    if not _active:
        return _find_lines(function)
    if not function.__code__.co_filename.startswith(HOME):
        _active[-1].beware()
    if function not in _lines:
        _lines[function] = _find_lines(function)
    return _lines[function]


def _file_of(function) -> str:
    """The file that it is in, found once."""
    if function not in _files:
        _files[function] = _find_file(function)
    return _files[function]


def _place_of(context, node) -> str:
    """Where a node is, without the picture of it that Taichi draws for every node; errors still get it."""
    if not _active or context.raised:
        return _draw(context, node)
    line, name = context.src[node.lineno - 1], context.func.func.__name__
    return f'File "{context.file}", line {node.lineno + context.lineno_offset}, in {name}:\n{line}\n'


def _patch() -> bool:
    """Put these in the place of what Taichi calls; whether it is the Taichi that they are made for."""
    names = ("getsourcelines", "getsourcefile", "textwrap")
    if ti.__version__ != (1, 7, 4) or not all(hasattr(kernel_impl, name) for name in names):
        return False
    kernel_impl.getsourcelines, kernel_impl.getsourcefile = _lines_of, _file_of
    # Every line of a function is expanded at every call of it.
    kernel_impl.textwrap = SimpleNamespace(fill=lru_cache(1 << 14)(textwrap.fill), dedent=textwrap.dedent)
    ASTTransformerContext.get_pos_info = _place_of
    return True


_find_lines: Any = kernel_impl.getsourcelines
_find_file: Any = kernel_impl.getsourcefile
_draw: Any = ASTTransformerContext.get_pos_info
_patched = _patch()
