"""Ctrl-C between frames: whatever changes a world is done or not done.

Python calls the handler of a signal between any two instructions, and what it raises would leave a world with the positions of
one frame and the time of another. So while a world changes, signals are noted, and their handlers are called after it.
"""

import _signal  # type: ignore[import]  # of which `signal` is a wrapper that takes ten times as long
import functools
import signal
import threading
from _thread import interrupt_main
from collections.abc import Callable
from threading import get_ident
from types import FrameType
from typing import Any

SIGNALS = tuple(int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGALRM") if hasattr(signal, name))


class Whole:
    """`with whole:` around what no signal's handler may cut in two.

    Handlers run in the main thread, so other threads have nothing to wait for, and only handlers written in Python can raise.
    Blocks may be nested: handlers are called after the outermost. It takes 0.8 us.
    """

    def __init__(self):
        self._main = threading.main_thread().ident
        self._depth = 0  # of blocks, in the main thread
        self._handlers: dict[int, Any] = {}  # those that wait
        self._noted: set[int] = set()  # the signals that came

    def __enter__(self) -> None:
        if get_ident() != self._main:
            return
        if not self._depth:
            self._noted.clear()
            try:
                for number in SIGNALS:
                    handler = _signal.getsignal(number)
                    if callable(handler):
                        self._handlers[number] = handler
                        _signal.signal(number, self._note)
            except BaseException:  # from a handler that does not wait yet
                self._restore()
                raise
        self._depth += 1

    def __exit__(self, *exc) -> None:
        if get_ident() != self._main:
            return
        self._depth -= 1
        if not self._depth:
            self._restore()
            while self._noted:
                interrupt_main(self._noted.pop())  # type: ignore[arg-type]  # as if it came now

    def raise_pending(self) -> None:
        """In a block: call the handlers of signals that have come. The caller undoes what it has done if one of them raises."""
        if get_ident() == self._main:
            while self._noted:
                number = self._noted.pop()
                self._handlers[number](number, None)

    def _restore(self) -> None:
        try:
            while self._handlers:
                number = next(reversed(self._handlers))
                _signal.signal(number, self._handlers[number])
                del self._handlers[number]
        finally:  # one that is back may raise while others are not
            if self._handlers:
                self._restore()

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._noted.add(number)


whole = Whole()


def uncut(function: Callable) -> Callable:
    """The function, as a whole."""

    @functools.wraps(function)
    def guarded(*args, **kwargs):
        """The function, which no interrupt cuts in two."""
        with whole:
            return function(*args, **kwargs)

    return guarded
