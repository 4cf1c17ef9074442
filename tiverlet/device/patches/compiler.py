"""How kernels are compiled: in a third of the time that Taichi takes by itself, bit for bit the same.

Most of Taichi's time goes into its analysis of control flow and, in small worlds, its simplifier. LLVM repeats both. They are
switched off while a kernel of tiverlet compiles, and only then; kernels that the user compiles in the same process are not
affected. A kernel keeps both passes if it assigns a vector to a variable that is a number. The user's functions may do so where
no statement reads the variable (`_, gap, _ = nearest(x)`). Taichi's analysis removes the assignment; LLVM would end the process.

These are settings, which Quadrants has too.
"""

import contextlib
import gc
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from .. import runtime
from ..language import active, impl, sources
from ..user_errors import shortened
from . import enabled
from .llvm_switches import restore_switches, set_switches

# Loops do not cache a field element in a variable: Taichi misses that another index may be the same element, such as field[k] for
# field[0].
SAFE = {"cache_loop_invariant_global_vars": False}
LEAN = SAFE | {"cfg_optimization": False}  # also without analysis of control flow
# Small worlds also skip the simplifier: compiling takes two thirds of the time. Frames with contacts that take longer than the
# launch take a tenth more, because the address of the fields is looked up again after every store. Taichi's simplifier turns a
# power of 1/2 into a root, which has other bits, and LLVM does not: so write a root as a root.
BRIEF = LEAN | {"advanced_optimization": False}
# Between LEAN and BRIEF: the simplifier without its search for equal expressions, which takes most of its time in long kernels.
UNSEARCHED = LEAN | {"opt_level": 0}
SETTINGS = {*BRIEF, *UNSEARCHED}
FEW = 1000  # worlds with fewer particles count as small
MADE = 20_000  # new objects; a context that compiles a kernel makes more, any other one fewer
_INSIDE = contextlib.nullcontext()
_lock = threading.RLock()  # all threads share the type of literals


@dataclass
class Times:
    """What was compiled for a world [s], by kernel and by feature. Kernels that another world had compiled do not count."""

    kernels: dict[str, float]
    features: dict[str, float]

    def add(self, earlier: "Times") -> None:
        """Add the times of a world before it was rebuilt."""
        for own, more in ((self.kernels, earlier.kernels), (self.features, earlier.features)):
            for name, seconds in more.items():
                own[name] = own.get(name, 0.0) + seconds


class Compiler:
    """The compiler settings of one world, active within the context `with compiler():`.

    real: the type of literals in kernels. Taichi rounds the literal 0.1 to its default type even next to f64 operands; a world of
    precision "f64" (and the user's own functions in it) must not lose half of the digits that way. few: whether the world has
    fewer than FEW particles. passes: Taichi's settings, one of LEAN, UNSEARCHED and BRIEF. many: whether there are many copies of
    the world. Kernels compile at their first launch.
    """

    kernels_read = ("real", "few", "passes", "many", "thorough")

    def __init__(self, real, few: bool = False, passes: Mapping[str, Any] = LEAN, many: bool = False):
        self.real, self.few, self.passes, self.many = real, few, passes, many
        self.launches = False  # whether Taichi spreads top-level loops over the threads of a CPU or GPU
        self.thorough = "passes" not in enabled  # never reset: Taichi may retry a kernel that failed to compile
        self.config: Any = None  # Taichi's settings, while kernels compile
        self._settings: dict[str, Any] = {}  # the settings that Taichi was started with
        self._thread = 0
        self.refused: Exception | None = None  # the error in a function that is being compiled, see refuse()
        self.times = Times({}, {})
        self.places: list[tuple[Any, int]] = []  # layouts and addresses of the world's fields

    @cached_property
    def _host(self) -> bool:
        """Whether kernels run on the host, where LLVM makes them as fast without Taichi's passes. Asking Taichi takes 6 us."""
        return runtime.architecture() == "cpu"

    @property
    def calls(self) -> bool:
        """Whether kernels call long functions, see calls.py.

        Called functions cannot read which copy of a world is current, and their loops are not spread over threads.
        """
        return self._host and not (self.many or self.launches or self.thorough)

    def use_fields(self) -> None:
        """Let kernels use the fields of this world."""
        for layout, address in self.places:
            if layout.shared:
                layout.use_bytes(address)

    def __call__(self) -> contextlib.AbstractContextManager[None]:
        """Return the context; nested in itself it does nothing."""
        if active and active[-1] is self and self._thread == threading.get_ident():
            return _INSIDE
        return self._entered()

    @contextlib.contextmanager
    def _entered(self) -> Iterator[None]:
        taichi: Any = impl.get_runtime()
        with _lock:
            config, literals = taichi.prog.config(), taichi.default_fp
            self.config = config
            before = {name: getattr(config, name) for name in SETTINGS}
            self._settings = active[0]._settings if active else before
            taichi.set_default_fp(self.real)
            _set(config, self.passes if self._host and not self.thorough else SAFE)
            active.append(self)
            self._thread = threading.get_ident()
            self.use_fields()
            collects = gc.isenabled()
            gc.disable()  # trees are many small objects, none of them garbage
            try:
                yield
            except Exception as e:
                error, self.refused = self.refused or shortened(e), None
                if error is None:
                    raise
                raise error from None
            finally:
                active.pop()
                restore_switches()
                if active:
                    active[-1].use_fields()
                taichi.set_default_fp(literals)
                _set(config, before)
                if collects:
                    _age_objects()
                    gc.enable()

    def compile_fast(self) -> None:
        """Have LLVM spend less time on the kernel that is compiled next. Its first launch must come before the context ends."""
        if self._host and not self.thorough and "loops" in enabled:
            set_switches(search=self.passes is LEAN)

    def compile_thoroughly(self) -> None:
        """Compile with all passes from here on: the kernel has an assignment that LLVM cannot handle."""
        self.thorough = True
        _set(self.config, self._settings | SAFE)


def refuse(error: Exception) -> None:
    """Stop compiling because of an error in a user's function; this error is raised, not the one that Taichi makes of it."""
    if active:
        active[-1].refused = error
    raise error


def readable(function: Any) -> bool:
    """Whether Taichi can find the source of a Python function."""
    try:
        sources.getsourcelines(function)
    except (OSError, TypeError):
        return False
    return True


class CachedLaunch:
    """A kernel of one object, for many launches. After the first, they skip Taichi's Python argument checks (25 us a launch).

    The arguments are arrays that stay at their addresses; their values may change from launch to launch. The kernel returns
    nothing. Values that Taichi freezes at the first compile stay frozen: after a change of the object, make a new CachedLaunch.
    """

    def __init__(self, owner: Any, name: str, compiler: Compiler, *arrays: np.ndarray):
        self.owner, self.name, self.compiler, self.arrays = owner, name, compiler, arrays
        self._ready: Any = None

    def __call__(self) -> None:
        """Launch the kernel, and compile it before the first launch."""
        if self._ready is None:
            with self.compiler():
                getattr(self.owner, self.name)(*self.arrays)
                if "launches" in enabled:
                    self._ready = self._prepared()
        else:
            self.launch()

    def launch(self) -> None:
        """Launch the kernel, which must be compiled."""
        with _lock:  # so that no other thread points kernels at another world in between
            self.compiler.use_fields()
            self._ready()

    def _prepared(self) -> Callable[[], Any]:
        """Return a function that launches. On a GPU, which copies arrays to and fro, each launch has a context of its own."""
        primal: Any = getattr(type(self.owner), self.name)._primal
        kernel = primal.compiled_kernels[primal.ensure_compiled(self.owner, *self.arrays)]
        program: Any = impl.get_runtime().prog
        compiled = program.compile_kernel(program.config(), program.get_device_caps(), kernel)
        if runtime.architecture() == "cpu":
            return partial(program.launch_kernel, compiled, self._context(kernel))
        return lambda: program.launch_kernel(compiled, self._context(kernel))

    def _context(self, kernel: Any) -> Any:
        """Make a launch context with the addresses of the arrays."""
        context = kernel.make_launch_context()
        for k, array in enumerate(self.arrays):
            context.set_arg_external_array_with_shape((k,), array.ctypes.data, array.nbytes, array.shape, 0)
        return context


def _age_objects() -> None:
    """Move all objects to Python's oldest generation after a compilation. Most of them stay, and examining them takes 50 ms."""
    if gc.get_count()[0] > MADE and not gc.get_freeze_count():  # else unfreeze() would also thaw what the user froze
        gc.freeze()
        gc.unfreeze()


def _set(config, settings: Mapping[str, Any]) -> None:
    for name, value in settings.items():
        setattr(config, name, value)
