"""How kernels are compiled: in a third of the time that Taichi takes by itself, to the same bits.

Most of that time goes into Taichi's analysis of control flow and, in small worlds, its simplifier; LLVM does both again. They are
left out while a kernel of ours compiles, and only then: what the user compiles in the same process is compiled as ever. A kernel
keeps them where a vector is assigned to a variable that is a number, as functions of the user's may do where nobody reads it
(`_, gap, _ = nearest(x)`): Taichi finds that nobody does, and LLVM would end the process. How functions are read is in
source_cache.py, and how they become statements in syntax_cache.py.

These are settings, which Quadrants has, too. What goes past the door of a launch knows the inside of Taichi 1.7.4; with another
one, every launch goes through the door.
"""

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from ..language import active, impl, sources
from . import lean, patched
from .unrolling import as_ever, leave_loops

HOSTS = ("Arch.x64", "Arch.arm64")  # whose kernels LLVM makes as fast without it; measured on x64
# No variables for what loops read and write at one address: Taichi does not see that another address may be the same place, such
# as field[k] for field[0].
SAFE = {"cache_loop_invariant_global_vars": False}
LEAN = SAFE | {"cfg_optimization": False}  # and no analysis of control flow
# In small worlds no simplifying either: compiling takes two thirds of the time. Frames with contacts take a tenth more where they
# take more than the launch, because the address of the fields is looked up again after every store. What Taichi would simplify to
# other bits (LLVM does not), a power of 1/2 to a root, is to be written so.
BRIEF = LEAN | {"advanced_optimization": False}
# Between the two: simplified, but without a search for equal expressions, which takes most of that time where kernels are long.
UNSEARCHED = LEAN | {"opt_level": 0}
SETTINGS = {*BRIEF, *UNSEARCHED}
FEW = 1000  # particles from which it pays
MADE = 20_000  # objects; what else is done in between makes fewer, and is looked through as ever
_INSIDE = contextlib.nullcontext()
_lock = threading.RLock()  # the type of literals is one for all threads


@dataclass
class Times:
    """What was compiled for a world [s], by kernels and by features; nothing for what another world had compiled."""

    kernels: dict[str, float]
    features: dict[str, float]

    def add(self, earlier: "Times") -> None:
        """Count what was compiled before the world was built anew, too."""
        for own, more in ((self.kernels, earlier.kernels), (self.features, earlier.features)):
            for name, seconds in more.items():
                own[name] = own.get(name, 0.0) + seconds


class Compiler:
    """How the kernels of one world are compiled, while it is called as a context.

    real: the type of their literals. Taichi rounds the literal 0.1 to its default type even next to f64 operands; a world of
    precision "f64" (and the user's own functions in it) must not lose half of the digits that way. few: whether they are
    for fewer than FEW particles. passes: settings of Taichi's, LEAN, UNSEARCHED or BRIEF. many: whether there are many copies of
    the world. Kernels compile at their first launch.
    """

    kernels_read = ("real", "few", "passes", "many", "thorough")

    def __init__(self, real, few: bool = False, passes: Mapping[str, Any] = LEAN, many: bool = False):
        self.real, self.few, self.passes, self.many = real, few, passes, many
        self.launches = False  # whether loops at the top of kernels are spread over threads, or those of a GPU
        self.thorough = not lean  # once and for all, since what Taichi fails to compile may be tried again
        self.config: Any = None  # of Taichi, while kernels compile
        self._host: bool | None = None  # whether they are for the host, once that is asked: Taichi takes 6 us to say so
        self._settings: dict[str, Any] = {}  # that Taichi was started with
        self._thread = 0
        self._hurried = False
        self.refused: Exception | None = None  # what is wrong with a function that is being compiled, see refuse()
        self.times = Times({}, {})
        self.places: list[tuple[Any, int]] = []  # where the world's fields are: layouts and addresses

    @property
    def calls(self) -> bool:
        """Whether kernels call functions that are long, see calls.py. These do not know which copy of a world it is, and have no
        loops that are spread."""
        return bool(self._host) and self.passes is BRIEF and not (self.many or self.launches or self.thorough)

    def point(self) -> None:
        """Have kernels find the fields of this world."""
        for layout, address in self.places:
            if layout.shared:
                layout.point(address)

    def __call__(self) -> contextlib.AbstractContextManager[None]:
        """The context; inside itself it has nothing to do."""
        if active and active[-1] is self and self._thread == threading.get_ident():
            return _INSIDE
        return self._entered()

    @contextlib.contextmanager
    def _entered(self) -> Iterator[None]:
        runtime: Any = impl.get_runtime()
        with _lock:
            config, literals = runtime.prog.config(), runtime.default_fp
            self.config = config
            before = {name: getattr(config, name) for name in SETTINGS}
            self._settings = active[0]._settings if active else before
            runtime.set_default_fp(self.real)
            if self._host is None:
                self._host = str(config.arch) in HOSTS
            _set(config, self.passes if self._host and not self.thorough else SAFE)
            active.append(self)
            self._thread = threading.get_ident()
            self.point()
            collects = gc.isenabled()
            gc.disable()  # trees are many small objects, none of them garbage
            try:
                yield
            except Exception:
                if self.refused is None:
                    raise
                error, self.refused = self.refused, None
                raise error from None
            finally:
                active.pop()
                if self._hurried:
                    as_ever()
                    self._hurried = False
                if active:
                    active[-1].point()
                runtime.set_default_fp(literals)
                _set(config, before)
                if collects:
                    _pass_over()
                    gc.enable()

    def hurry(self) -> None:
        """A kernel is about to be compiled, and launched before the context ends: have LLVM take less time for it."""
        if self._host and not self.thorough:
            leave_loops()
            self._hurried = True

    def beware(self) -> None:
        """Be thorough from here on: there is what LLVM does not take as it is."""
        runtime: Any = impl.get_runtime()
        self.thorough = True
        _set(runtime.prog.config(), self._settings | SAFE)


def refuse(error: Exception) -> None:
    """Stop compiling because of what a user's function does, with this error and not what Taichi makes of it."""
    if active:
        active[-1].refused = error
    raise error


def readable(function: Any) -> bool:
    """Whether Taichi will find the source of a Python function."""
    try:
        sources.getsourcelines(function)
    except (OSError, TypeError):
        return False
    return True


class CachedLaunch:
    """A kernel of one object, for many launches: after the first one, past the door at which Taichi looks at the object and at
    each argument anew, which takes 25 us.

    Its arguments are arrays, which stay where they are; what they hold may change from launch to launch. It returns nothing. What
    Taichi freezes at the first compile is frozen, as ever: an object that has changed takes a new CachedLaunch.
    """

    def __init__(self, owner: Any, name: str, compiler: Compiler, *arrays: np.ndarray):
        self.owner, self.name, self.compiler, self.arrays = owner, name, compiler, arrays
        self._ready: Any = None

    def __call__(self) -> None:
        """Launch it."""
        if self._ready is None:
            with self.compiler():
                getattr(self.owner, self.name)(*self.arrays)
                if patched:
                    self._ready = self._prepared()
        else:
            self.launch()

    def launch(self) -> None:
        """Launch it when it is compiled."""
        with _lock:  # lest another thread's world is told to kernels before
            self.compiler.point()
            self._ready()

    def _prepared(self) -> Callable[[], Any]:
        """A launch; each one on a GPU, which copies arrays to and fro, has a context of its own."""
        primal: Any = getattr(type(self.owner), self.name)._primal
        kernel = primal.compiled_kernels[primal.ensure_compiled(self.owner, *self.arrays)]
        program: Any = impl.get_runtime().prog
        compiled = program.compile_kernel(program.config(), program.get_device_caps(), kernel)
        if str(program.config().arch) in HOSTS:
            return partial(program.launch_kernel, compiled, self._context(kernel))
        return lambda: program.launch_kernel(compiled, self._context(kernel))

    def _context(self, kernel: Any) -> Any:
        """Where the arrays are."""
        context = kernel.make_launch_context()
        for k, array in enumerate(self.arrays):
            context.set_arg_external_array_with_shape((k,), array.ctypes.data, array.nbytes, array.shape, 0)
        return context


def _pass_over() -> None:
    """Have Python take what there is for old where a kernel was compiled, most of which stays: looking through it took 50 ms."""
    if gc.get_count()[0] > MADE and not gc.get_freeze_count():  # or it would thaw what the user froze
        gc.freeze()
        gc.unfreeze()


def _set(config, settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        setattr(config, name, value)
