"""Switches of LLVM: kernels start in half of the time, bit for bit the same.

For a loop whose length is known only at run time, LLVM writes up to eight rounds one after the other, and peels first rounds off
in front of it. All later passes work on these copies. Frames take as long without them, since tiverlet's loops wait for memory
and square roots. LLVM also spends a twelfth of its time on a second search for addresses that loops compute by fewer additions.
Frames of a pile take 1 % less for it, those of boxes do not. Kernels of small worlds, and long ones, do without.

Taichi has no setting for this. But LLVM is part of its library, and reads switches as from a command line
(LLVMParseCommandLineOptions, of its C API). That function is not exported. It is in the library's symbol table, and so is the
function that resets all switches. Where they are missing (another system, a stripped library), no switch is set.
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
    "-unroll-runtime=false",  # loops whose length is known only at run time
    "-unroll-max-upperbound=0",  # loops with a known upper bound of rounds only
    "-unroll-allow-peeling=false",  # copies of first rounds
)
NO_SEARCH = ("-disable-lsr",)
PARSE, RESET = b"LLVMParseCommandLineOptions", b"_ZN4llvm2cl25ResetAllOptionOccurrencesEv"
SEEN = b"PyInit_taichi_python"  # an exported function, as the reference address
SYMBOL = np.dtype([("name", "<u4"), ("kind", "<u4"), ("value", "<u8"), ("size", "<u8")])  # ELF-64; kind includes the section
TABLE = 2  # section type of a symbol table


@dataclass
class CommandLine:
    """LLVM's command line. parse: takes the number of words, the words, and None. reset: resets all switches."""

    parse: Callable
    reset: Callable
    given: bool = False  # whether switches are set

    def set_switches(self, *switches: str) -> None:
        """Set switches. LLVM ignores unknown ones."""
        words = [b"tiverlet", *[s.encode() for s in switches]]
        self.parse(len(words), (ctypes.c_char_p * len(words))(*words), None)
        self.given = True

    def reset_switches(self) -> None:
        """Reset all switches."""
        self.reset()
        self.given = False


@functools.cache
def command_line() -> CommandLine | None:
    """Return the command line of the LLVM in Taichi's library; None if it is not found."""
    path, at = getattr(sys.modules.get("taichi._lib.core.taichi_python"), "__file__", None), None
    if path and sys.platform == "linux" and sys.byteorder == "little":
        with contextlib.suppress(OSError, ValueError, struct.error):  # no such file, or an unexpected format
            at = _addresses(path, PARSE, RESET, SEEN)
    if at is None:
        return None
    start = ctypes.cast(ctypes.PyDLL(path)[SEEN.decode()], ctypes.c_void_p).value or 0
    parse, reset = (start + there - at[-1] for there in at[:-1])
    arguments = ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p
    return CommandLine(ctypes.CFUNCTYPE(None, *arguments)(parse), ctypes.CFUNCTYPE(None)(reset))


def set_switches(search: bool) -> None:
    """Have LLVM leave loops as they are in kernels compiled until restore_switches(), and, unless told to, not search."""
    line = command_line()
    if line and not line.given:
        line.set_switches(*SWITCHES, *(() if search else NO_SEARCH))


def restore_switches() -> None:
    """Have LLVM compile as by default."""
    line = command_line()
    if line and line.given:
        line.reset_switches()


def _addresses(path: str, *names: bytes) -> list[int] | None:
    """Return the addresses of functions in a library, relative to one place; None if its symbol table does not have them."""
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
                del table  # it holds the mapping open
                return found if min(places) > 0 and len(found) == len(names) else None
    return None
