"""Records which kernels Taichi translates and launches, for `report speed`. Costs nothing while no context here is open."""

import contextlib
from collections import Counter
from collections.abc import Iterator
from time import perf_counter
from typing import Any

import numpy as np

from ..language import COMPILER, Operations, impl, module, ti
from .compiler import CachedLaunch

Kernel: Any = module("kernel_impl" if COMPILER == "taichi" else "kernel").Kernel
ASTTransformer: Any = module("ast.ast_transformer").ASTTransformer
ATOMIC = (ti.atomic_add, ti.atomic_sub, ti.atomic_max, ti.atomic_min)


@contextlib.contextmanager
def replaced(*places: tuple[Any, str, Any]) -> Iterator[None]:
    """Within this context, attributes of objects have other values."""
    before = [(owner, name, owner.__dict__[name]) for owner, name, _ in places]
    for owner, name, value in places:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in before:
            setattr(owner, name, value)


def known_as(kernel: Any, args: tuple) -> str:
    """Return the name of a kernel, or its first argument that is a text, which names it."""
    return next((a for a in args if isinstance(a, str)), kernel.func.__name__)


class Launches(Counter[str]):
    """The number of launches by name of the kernel.

    seconds: their total times, if they were timed. answers: how often the host waited for a result, either a number or an array.
    """

    def __init__(self):
        super().__init__()
        self.seconds: dict[str, float] = {}
        self.answers = 0


@contextlib.contextmanager
def launches(timed: bool = False) -> Iterator[Launches]:
    """Count the kernels launched within this context. timed: wait for the end of each."""
    count = Launches()

    def counted(launch, name):
        """Wrap a method that launches kernels."""

        def run(self, *args, **options):
            """Launch, and record count and time."""
            clock = perf_counter()
            out = launch(self, *args, **options)
            known = name(self, args)
            count[known] += 1
            count.answers += out is not None or any(isinstance(a, np.ndarray) for a in (*args, *getattr(self, "arrays", ())))
            if timed:
                ti.sync()
                count.seconds[known] = count.seconds.get(known, 0.0) + perf_counter() - clock
            return out

        return run

    with replaced(
        (Kernel, "launch_kernel", counted(Kernel.launch_kernel, known_as)),
        (CachedLaunch, "launch", counted(CachedLaunch.launch, lambda quick, _: quick.name)),
    ):
        yield count


class Sweep:
    """One outermost loop of a kernel: how often it runs (None: known only at run time), and which fields it reads and writes."""

    def __init__(self):
        self.trips: int | None = None
        self.sites: list[list] = []  # [field, read, written, whether in a loop inside the loop]

    def bytes(self, lengths: dict[int, tuple[int, int]]) -> int:
        """Return the bytes moved, if the loop reads and writes each element of a field once. lengths: see traffic()."""
        total, fields = 0, {id(site[0]) for site in self.sites}
        for key in fields & lengths.keys():
            sites = [s for s in self.sites if id(s[0]) == key]
            length, size = lengths[key]
            if self.trips is not None and not any(deep for *_, deep in sites):
                length = min(length, self.trips * len(sites))
            total += length * size * (any(s[1] for s in sites) + any(s[2] for s in sites))
        return total


class Tracer:
    """Records the translation of kernels: .sweeps has the loops of each kernel, by its name."""

    def __init__(self):
        self.sweeps: dict[str, list[Sweep]] = {}
        self._open: list[Sweep] = []
        self._depth = 0
        self._known: dict[int, tuple[Any, list]] = {}  # expressions of field elements; kept alive, so that ids stay unique

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Record within this context."""
        materialize, subscript = Kernel.materialize, impl.subscript
        loop, call, define = ASTTransformer.build_range_for, ASTTransformer.build_Call, ASTTransformer.build_FunctionDef
        assign, augment = Operations._assign, Operations._augassign

        def begun(ctx, node):
            """Begin to translate a function; reset the record if it is a kernel."""
            if ctx.is_kernel:  # Quadrants translates a kernel twice, and the second time counts
                self._open, self._known = [], {}
            return define(ctx, node)

        def translated(kernel, **given):
            """Compile a kernel and keep the accesses of its loops."""
            self._open, self._known = [], {}
            out = materialize(kernel, **given)
            args = given.get("args") or given.get("py_args") or ()
            if self._known:  # empty if the kernel was compiled already
                self.sweeps[known_as(kernel, args)] = self._open
            return out

        def looped(ctx, node):
            """Translate a loop; each outermost loop is one sweep."""
            self._depth += 1
            if self._depth == 1:
                self._open.append(Sweep())
            try:
                out = loop(ctx, node)
            finally:
                self._depth -= 1
            if self._depth == 0:
                ends = [0, *(arg.ptr for arg in node.iter.args)][-2:]
                self._open[-1].trips = ends[1] - ends[0] if all(isinstance(e, int) for e in ends) else None
            return out

        def subscripted(builder, value, *args, **kwargs):
            """Translate a subscript; an element of a field counts as read until it is assigned."""
            out = subscript(builder, value, *args, **kwargs)
            if isinstance(value, ti.Field) and self._open and self._depth:
                site = [value, True, False, self._depth > 1]
                self._open[-1].sites.append(site)
                self._known[id(out)] = (out, site)
            elif id(value) in self._known and isinstance(out, type(value)):  # a component
                self._known[id(out)] = (out, self._known[id(value)][1])
            return out

        def assigned(to, value):
            """Translate an assignment; an element of a field counts as written."""
            if id(to) in self._known:
                site = self._known[id(to)][1]
                site[1], site[2] = False, True
            return assign(to, value)

        def changed(to, value, op):
            """Translate an augmented assignment; an element of a field counts as read and written."""
            if id(to) in self._known:
                self._known[id(to)][1][2] = True
            return augment(to, value, op)

        def called(ctx, node):
            """Translate a call; an atomic operation writes its first argument."""
            out = call(ctx, node)
            if any(node.func.ptr is function for function in ATOMIC) and id(node.args[0].ptr) in self._known:
                self._known[id(node.args[0].ptr)][1][2] = True
            return out

        with replaced(
            (Kernel, "materialize", translated), (ASTTransformer, "build_range_for", staticmethod(looped)),
            (impl, "subscript", subscripted), (Operations, "_assign", assigned), (Operations, "_augassign", changed),
            (ASTTransformer, "build_Call", staticmethod(called)),
            (ASTTransformer, "build_FunctionDef", staticmethod(begun)),
        ):  # fmt: skip
            yield
