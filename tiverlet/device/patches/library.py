"""The LLVM in Taichi's library: its command line, whose functions the library does not export.

They are found in the library's symbol table. Searching it takes some hundredths of a second, so the addresses found are kept in a
file beside Taichi's cached kernels.
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
from dataclasses import dataclass

import numpy as np

SWITCHED = b"LLVMParseCommandLineOptions", b"_ZN4llvm2cl25ResetAllOptionOccurrencesEv"  # the functions of switches
SEEN = b"PyInit_taichi_python"  # an exported function, as the reference address
SYMBOL = np.dtype([("name", "<u4"), ("kind", "<u4"), ("value", "<u8"), ("size", "<u8")])  # ELF-64; kind includes the section
TABLE = 2  # section type of a symbol table


def _folder() -> pathlib.Path | None:
    """Return the folder of what is kept between processes, inside that of Taichi's cached kernels; None if Taichi keeps none."""
    impl = sys.modules["taichi.lang.impl"]  # loaded wherever the library is
    config, runs = impl.default_cfg(), impl.get_runtime().prog is not None
    if os.environ.get("TI_OFFLINE_CACHE") == "0" or runs and not config.offline_cache:
        return None
    asked = None if runs else os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")  # ti.init reads it
    return pathlib.Path(asked or config.offline_cache_file_path, "tiverlet")


def _replace_file(path: pathlib.Path, content: bytes) -> None:
    """Write a file that other processes see whole or not at all. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}")
    part.write_bytes(content)
    part.replace(path)


@functools.cache
def _stamp() -> str | None:
    """Return what tells this build of the library from others; None where its symbol table cannot be read."""
    path = getattr(sys.modules.get("taichi._lib.core.taichi_python"), "__file__", None)
    if path and sys.platform == "linux" and sys.byteorder == "little":
        with contextlib.suppress(OSError):
            found = os.stat(path)
            return f"{path} {found.st_size} {found.st_mtime_ns}"
    return None


@dataclass
class CommandLine:
    """LLVM's command line. parse: takes the number of words, the words, and None. reset: resets all switches."""

    parse: Callable
    reset: Callable
    given: tuple[str, ...] = ()  # the switches that are set

    def set_switches(self, *switches: str) -> None:
        """Set switches. LLVM ignores unknown ones."""
        words = [b"tiverlet", *[s.encode() for s in switches]]
        self.parse(len(words), (ctypes.c_char_p * len(words))(*words), None)
        self.given = switches

    def reset_switches(self) -> None:
        """Reset all switches."""
        self.reset()
        self.given = ()


@functools.cache
def command_line() -> CommandLine | None:
    """Return the command line of the LLVM in Taichi's library; None if it is not found."""
    addresses = _find(*SWITCHED)
    if addresses is None:
        return None
    parse, reset = addresses
    arguments = ctypes.c_int, ctypes.POINTER(ctypes.c_char_p), ctypes.c_char_p
    return CommandLine(ctypes.CFUNCTYPE(None, *arguments)(parse), ctypes.CFUNCTYPE(None)(reset))


def _find(*names: bytes) -> list[int] | None:
    """Return the addresses of functions in this process, by their mangled names; None if one of them is missing."""
    if _stamp() is None:
        return None
    known, asked = _known(), [name.decode() for name in (*names, SEEN)]
    if not all(name in known for name in asked):
        known.update(_search(_path(), *names, SEEN))
        with contextlib.suppress(OSError):
            if path := _file():
                _replace_file(path, json.dumps(known).encode())
    at = [known[name] for name in asked]
    if not all(at):
        return None
    start = ctypes.cast(ctypes.PyDLL(_path())[SEEN.decode()], ctypes.c_void_p).value or 0
    return [start + there - at[-1] for there in at[:-1]]


def _path() -> str:
    return str(sys.modules["taichi._lib.core.taichi_python"].__file__)


def _file() -> pathlib.Path | None:
    """Return the file with the addresses in this build of the library."""
    where = _folder()
    return where / f"{hashlib.blake2b(str(_stamp()).encode(), digest_size=8).hexdigest()}.json" if where else None


@functools.cache
def _known() -> dict[str, int]:
    """Return the addresses found before, by name and relative to the library; 0 for what the library lacks."""
    with contextlib.suppress(OSError, ValueError, TypeError, AttributeError):  # no such file, or a damaged one
        if path := _file():
            return {str(name): int(value) for name, value in json.loads(path.read_bytes()).items()}
    return {}


def _search(path: str, *names: bytes) -> dict[str, int]:
    """Return the addresses of functions in a library by name, relative to one place; 0 if its symbol table lacks the function."""
    none = dict.fromkeys((name.decode() for name in names), 0)
    with (
        contextlib.suppress(OSError, ValueError, struct.error),  # no such file, or an unexpected format
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as image,
    ):
        if image[:5] != b"\x7fELF\x02":
            return none
        (first,), (size, count) = struct.unpack_from("<Q", image, 0x28), struct.unpack_from("<HH", image, 0x3A)
        sections = [struct.unpack_from("<IIQQQQII", image, first + k * size) for k in range(count)]
        for _, kind, _, _, offset, length, link, _ in sections:
            if kind == TABLE:
                begin, end = sections[link][4], sections[link][4] + sections[link][5]
                table = np.frombuffer(image, SYMBOL, length // SYMBOL.itemsize, offset)
                places = [image.find(b"\0" + name + b"\0", begin, end) + 1 - begin for name in names]
                found = [table["value"][table["name"] == place] if place > 0 else () for place in places]
                del table  # it holds the mapping open
                return {name: int(at[0]) if len(at) == 1 else 0 for name, at in zip(none, found, strict=True)}
    return none
