"""LLVM is told to leave loops as they are: kernels start in half of the time, to the same bits.

Of a loop whose length is known only when it runs, LLVM writes up to eight rounds one after the other, and takes first rounds out
in front of it. All that comes after works on these copies, and frames take as long without, for what loops of ours wait for is
memory and roots. Taichi has no switch for it. But LLVM is a part of its library, and reads switches of its own, as on a command
line (LLVMParseCommandLineOptions, of its C API). That function is not among those that the system looks up; it stands in the
library's table of symbols, as the one that sets all switches back. Where it does not (another system, a stripped library),
nothing is told.
"""

import contextlib
import ctypes
import functools
import mmap
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

SWITCHES = (
    "-unroll-runtime=false",  # loops whose length is known when they run
    "-unroll-max-upperbound=0",  # loops of which no more is known than the most rounds that they can take
    "-unroll-allow-peeling=false",  # first rounds
)
PARSE, RESET = b"LLVMParseCommandLineOptions", b"_ZN4llvm2cl25ResetAllOptionOccurrencesEv"
SEEN = b"PyInit_taichi_python"  # one that the system looks up
SYMBOL = np.dtype([("name", "<u4"), ("kind", "<u4"), ("value", "<u8"), ("size", "<u8")])  # ELF-64; kind: with the section
TABLE = 2  # the type of a section that is a table of symbols


@dataclass
class CommandLine:
    """LLVM's: parse takes how many words, these, and None; reset sets all switches back."""

    parse: Callable
    reset: Callable
    given: bool = False  # switches that are not set back yet

    def give(self, *switches: str) -> None:
        """Pass switches on. What LLVM does not know, it passes over."""
        words = [b"tiverlet", *[s.encode() for s in switches]]
        self.parse(len(words), (ctypes.c_char_p * len(words))(*words), None)
        self.given = True

    def take_back(self) -> None:
        """Have LLVM work as ever."""
        self.reset()
        self.given = False


@functools.cache
def command_line() -> CommandLine | None:
    """That of the LLVM in Taichi's library; None where it is not found."""
    path, at = getattr(sys.modules.get("taichi._lib.core.taichi_python"), "__file__", None), None
    if path and sys.platform == "linux" and sys.byteorder == "little":
        with contextlib.suppress(OSError, ValueError, struct.error):  # a file that is none, or not as others are
            at = _addresses(path, PARSE, RESET, SEEN)
    if at is None:
        return None
    start = ctypes.cast(ctypes.PyDLL(path)[SEEN.decode()], ctypes.c_void_p).value or 0
    parse, reset = (start + there - at[-1] for there in at[:-1])
    arguments = ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p
    return CommandLine(ctypes.CFUNCTYPE(None, *arguments)(parse), ctypes.CFUNCTYPE(None)(reset))


def leave_loops() -> None:
    """Tell LLVM so, for the kernels that are compiled until as_ever()."""
    line = command_line()
    if line and not line.given:
        line.give(*SWITCHES)


def as_ever() -> None:
    """Tell it nothing any more."""
    line = command_line()
    if line and line.given:
        line.take_back()


def _addresses(path: str, *names: bytes) -> list[int] | None:
    """Where functions are in a library, in bytes from one place; None where its table of symbols does not say that."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as image:
        if image[:5] != b"\x7fELF\x02":
            return None
        (first,), (size, count) = struct.unpack_from("<Q", image, 0x28), struct.unpack_from("<HH", image, 0x3A)
        sections = [struct.unpack_from("<IIQQQQII", image, first + k * size) for k in range(count)]
        for _, kind, _, _, offset, length, link, _ in sections:
            if kind == TABLE:
                begin, end = sections[link][4], sections[link][4] + sections[link][5]
                table = np.frombuffer(image, SYMBOL, length // SYMBOL.itemsize, offset)
                places = [image.find(b"\0" + name + b"\0", begin, end) + 1 - begin for name in names]
                found = [int(v) for place in places for v in table["value"][table["name"] == place]]
                del table  # or the file could not be let go
                return found if min(places) > 0 and len(found) == len(names) else None
    return None
