"""Times of compiling kernels, in all and by parts marked `has_own_compile_time`; and a message for the waiting user.

While LLVM works, Taichi holds Python's lock, so nothing can change on a terminal. The message has to be printed before. LLVM
takes longer than the translation, whose measured time decides whether to print it.
"""

import contextlib
import sys
from collections.abc import Iterator
from time import perf_counter
from typing import Any

from taichi.lang import impl
from taichi.lang.kernel_impl import Func

from ..language import active

LONG = 0.3  # [s] of translating a kernel; LLVM then takes most of a second


class Translation:
    """A translation in progress, and the time in functions of each feature, without the functions that they call of others."""

    now: "Translation | None" = None

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._open: list[str] = [""]
        self._since = perf_counter()

    def enter(self, name: str) -> None:
        """Begin a function of the named feature."""
        self._count()
        self._open.append(name)

    def leave(self) -> None:
        """End the function entered last."""
        self._count()
        self._open.pop()

    def _count(self) -> None:
        now = perf_counter()
        self.seconds[self._open[-1]] = self.seconds.get(self._open[-1], 0.0) + now - self._since
        self._since = now


def compiled(kernel: Any, key: Any, name: str, translate: Any) -> None:
    """Translate and compile a kernel, and record the time: in all, and by feature in proportion to the time of translation."""
    if key in kernel.compiled_kernels:
        return
    active[-1].compile_fast()
    begin, outer, translation = perf_counter(), Translation.now, Translation()
    Translation.now = translation
    try:
        translate()
        translation.leave()
    finally:
        Translation.now = outer
    program: Any = impl.get_runtime().prog
    own = {feature: seconds for feature, seconds in translation.seconds.items() if feature}
    with _show_message(name, [*own]) if perf_counter() - begin > LONG else contextlib.nullcontext():
        program.compile_kernel(program.config(), program.get_device_caps(), kernel.compiled_kernels[key])
    taken, times = perf_counter() - begin, active[-1].times
    times.kernels[name] = times.kernels.get(name, 0.0) + taken
    part = taken / sum(translation.seconds.values())
    for feature, seconds in own.items():
        times.features[feature] = times.features.get(feature, 0.0) + part * seconds


@contextlib.contextmanager
def _show_message(name: str, features: list[str]) -> Iterator[None]:
    """Show what is compiled in a line on the terminal, as long as the context lasts."""
    if not (sys.stderr and sys.stderr.isatty()):
        yield
        return
    from rich.console import Console  # noqa: PLC0415  # importing it takes 50 ms

    with Console(stderr=True).status(f"compiling {name}: {', '.join(sorted(features)) or 'motion'} (kept for the next time)"):
        yield


def _called(self: Any, *args: Any, **kwargs: Any) -> Any:
    """Translate a function called in a kernel, and count its time for the object that it belongs to."""
    now = Translation.now
    if now is None or not args or not getattr(args[0], "has_own_compile_time", False):
        return _call(self, *args, **kwargs)
    now.enter(repr(args[0]))
    try:
        return _call(self, *args, **kwargs)
    finally:
        now.leave()


def apply() -> None:
    """Replace Taichi's Func.__call__."""
    Func.__call__ = _called  # type: ignore[method-assign]


_call: Any = Func.__call__
