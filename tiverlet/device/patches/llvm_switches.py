"""Switches of LLVM: kernels start in half of the time, bit for bit the same.

For a loop whose length is known only at run time, LLVM writes up to eight rounds one after the other, and peels first rounds off
in front of it. All later passes work on these copies. Frames take as long without them, since tiverlet's loops wait for memory
and square roots. LLVM also spends a twelfth of its time on a second search for addresses that loops compute by fewer additions.
Frames of a pile take 1 % less for it, those of boxes do not. Kernels of small worlds, and long ones, do without.

Taichi has no setting for this. But LLVM is part of its library, and reads switches as from a command line. The library does not
export its functions, so they are found in its symbol table. This takes some hundredths of a second, so what is found is kept in a
file beside Taichi's cached kernels. Where nothing is found (another system, a stripped library), no switch is set.
"""

import contextlib
import ctypes
import functools
import hashlib
import json
import mmap
import os
import pathlib
import struct
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from ..language import ti

SWITCHES = (
    b"-unroll-runtime=false",  # loops whose length is known only at run time
    b"-unroll-max-upperbound=0",  # loops with a known upper bound of rounds only
    b"-unroll-allow-peeling=false",  # copies of first rounds
)
NO_SEARCH = (b"-disable-lsr",)
# Functions of the library: sets switches, LLVM ignores unknown ones; resets all; exported, as the reference address.
NAMES = "LLVMParseCommandLineOptions", "_ZN4llvm2cl25ResetAllOptionOccurrencesEv", "PyInit_taichi_python"
SYMBOL = np.dtype([("name", "<u4"), ("kind", "<u4"), ("value", "<u8"), ("size", "<u8")])  # ELF-64; kind includes the section
TABLE = 2  # section type of a symbol table

_set = False  # whether switches are set


def set_switches(search: bool) -> None:
    """Have LLVM leave loops as they are in kernels compiled until restore_switches(), and, unless told to, not search."""
    global _set
    if not _set and (line := _command_line()):
        words = [b"tiverlet", *SWITCHES, *(() if search else NO_SEARCH)]
        line[0](len(words), (ctypes.c_char_p * len(words))(*words), None)
        _set = True


def restore_switches() -> None:
    """Have LLVM compile as by default."""
    global _set
    if _set and (line := _command_line()):
        line[1]()
        _set = False


@functools.cache
def _command_line() -> tuple[Callable, Callable] | None:
    """Return the functions that set switches and reset them; None if they are not found."""
    path = getattr(sys.modules.get("taichi._lib.core.taichi_python"), "__file__", "")
    if sys.platform != "linux" or sys.byteorder != "little" or not os.path.isfile(path):
        return None
    parse, reset, exported = _places(path)
    if not (parse and reset and exported):
        return None
    begin = (ctypes.cast(ctypes.PyDLL(path)[NAMES[2]], ctypes.c_void_p).value or 0) - exported
    arguments = ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p
    return ctypes.CFUNCTYPE(None, *arguments)(begin + parse), ctypes.CFUNCTYPE(None)(begin + reset)


def _places(path: str) -> list[int]:
    """Return the addresses of NAMES relative to the library, kept from process to process unless Taichi keeps nothing."""
    config: Any = ti.cfg
    if not config.offline_cache:
        return _search(path)
    found = os.stat(path)
    build = hashlib.blake2b(f"{path} {found.st_size} {found.st_mtime_ns}".encode(), digest_size=8).hexdigest()
    file = pathlib.Path(config.offline_cache_file_path, "tiverlet", f"{build}.json")
    with contextlib.suppress(OSError, ValueError, TypeError):  # no such file, or a damaged one
        parse, reset, exported = map(int, json.loads(file.read_bytes()))
        return [parse, reset, exported]
    places = _search(path)
    with contextlib.suppress(OSError):  # other processes see the file whole or not at all
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_name(f"{file.name}.{os.getpid()}")
        part.write_text(json.dumps(places))
        part.replace(file)
    return places


def _search(path: str) -> list[int]:
    """Return the addresses of NAMES from the symbol table of the library; 0 for what it lacks."""
    with (
        contextlib.suppress(OSError, ValueError, struct.error),  # no such file, or an unexpected format
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as image,
    ):
        (first,), (size, count) = struct.unpack_from("<Q", image, 0x28), struct.unpack_from("<HH", image, 0x3A)
        sections = [struct.unpack_from("<IIQQQQII", image, first + k * size) for k in range(count)]
        for _, kind, _, _, offset, length, link, _ in sections:
            if kind == TABLE:
                begin, end = sections[link][4], sections[link][4] + sections[link][5]
                table = np.frombuffer(image, SYMBOL, length // SYMBOL.itemsize, offset)
                places = [image.find(f"\0{name}\0".encode(), begin, end) + 1 - begin for name in NAMES]
                found = [table["value"][table["name"] == place] if place > 0 else () for place in places]
                del table  # it holds the mapping open
                return [int(at[0]) if len(at) == 1 else 0 for at in found]
    return [0] * len(NAMES)
