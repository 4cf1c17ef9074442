"""Machine code of cached kernels is kept on disk, too: programs start in half of the time, bit for bit the same.

Taichi keeps LLVM's code of the kernels that it has compiled. A later process has LLVM generate machine code from it again, which
takes half of a first step, and a tenth of a second for Taichi's own functions. LLVM can ask a cache for machine code, but Taichi
gives it none. So here LLVM's generator (ConcurrentIRCompiler) is replaced, in its table of virtual functions, by one that first
looks for a file. The file is named by a hash of the module, the processor, LLVM's switches and the build of the library.

Only what tiverlet starts and compiles is looked for. Without the functions used here (another system, a stripped library),
without Taichi's cache, and for a damaged file, LLVM generates the code as ever.
"""

import contextlib
import ctypes
import functools
import hashlib
import mmap
import os
import pathlib
import platform
from collections.abc import Callable, Iterator
from ctypes import POINTER, PYFUNCTYPE, Structure, addressof, c_bool, c_int, c_size_t, c_uint8, c_uint64, c_void_p, sizeof
from typing import Any

from .. import language
from ..interrupts import deferred_signals
from ..language import impl
from .library import SWITCHED, command_line, find, folder, replace_file, stamp

# Tables of virtual functions, then functions.
NAMES = (
    b"_ZTVN4llvm3orc20ConcurrentIRCompilerE",
    b"_ZTVN4llvm19raw_svector_ostreamE",
    b"_ZN4llvm3orc20ConcurrentIRCompilerclERNS_6ModuleE",
    b"_ZN4llvm18WriteBitcodeToFileERKNS_6ModuleERNS_11raw_ostreamEbPKNS_18ModuleSummaryIndexEbPSt5arrayIjLm5EE",
    b"_ZNK4llvm6Module5printERNS_11raw_ostreamEPNS_24AssemblyAnnotationWriterEbb",
    b"_ZN4llvm12MemoryBuffer16getMemBufferCopyENS_9StringRefERKNS_5TwineE",
    b"_ZN4llvm11LLVMContextC1Ev",
    b"_ZNK4llvm11LLVMContext17setOpaquePointersEb",
    b"_ZN4llvm11LLVMContextD1Ev",
    b"LLVMParseIRInContext",
)
SLOTS = 5  # entries of the generator's table: two of C++, two destructors, the generator
HEAD = 16  # bytes of a table before its functions
HASH = 16  # bytes of a hash, which names a file or stands in it before the code
SAME = ("vendor_id", "cpu family", "model", "stepping", "flags")  # what two equal processors have in common
MARKED, FAILED = 2, 1  # flags of a result of LLVM's: not examined yet; an error
EMPTY = 1  # kind of a text of LLVM's


class Vector(Structure):
    """LLVM's SmallVector of bytes. An empty one points behind itself, and takes memory when it grows."""

    _fields_ = (("begin", c_void_p), ("size", c_size_t), ("capacity", c_size_t))


class Stream(Structure):
    """LLVM's raw_svector_ostream, without a buffer: what is written to it goes to the vector."""

    _fields_ = (("table", c_void_p), ("unbuffered", c_uint64 * 7), ("vector", c_void_p))


class Text(Structure):
    """LLVM's Twine of two texts, as which it takes names."""

    _fields_ = (("texts", c_uint64 * 4), ("kinds", c_uint8 * 2))


class Buffer(Structure):
    """LLVM's MemoryBuffer."""

    _fields_ = (("table", c_void_p), ("begin", c_void_p), ("end", c_void_p))


class Result(Structure):
    """What the generator returns: LLVM's Expected<std::unique_ptr<MemoryBuffer>>."""

    _fields_ = (("buffer", POINTER(Buffer)), ("flags", c_uint8))


class MachineCode:
    """LLVM's generator of machine code, which looks for it on disk within the context `with kept():`.

    found, generated: how many modules of these contexts were read from files, and generated.
    """

    def __init__(self, addresses: list[int]):
        table, self._streams, generate, write, show, copy, begin, typed, end, parse = addresses
        void, pointer = None, c_void_p
        signature = PYFUNCTYPE(pointer, pointer, pointer, pointer)
        self._generate = signature(generate)
        self._write = PYFUNCTYPE(void, pointer, pointer, c_bool, pointer, c_bool, pointer)(write)
        self._print = PYFUNCTYPE(void, pointer, pointer, pointer, c_bool, c_bool)(show)
        self._copy = PYFUNCTYPE(pointer, pointer, ctypes.c_char_p, c_size_t, pointer)(copy)
        self._begin, self._end = PYFUNCTYPE(void, pointer)(begin), PYFUNCTYPE(void, pointer)(end)
        self._set_opaque = PYFUNCTYPE(void, pointer, c_bool)(typed)
        self._parse = PYFUNCTYPE(c_int, pointer, pointer, pointer, pointer)(parse)
        self._free = ctypes.CDLL(None).free
        self._free.argtypes, self._free.restype = (pointer,), void
        self._name = Text(kinds=(EMPTY, EMPTY))
        self._replacement = signature(self.generate)
        self.contexts = self.found = self.generated = 0
        self.replaced = self._replace(table, generate)

    def _replace(self, table: int, generate: int) -> bool:
        """Replace the generator in its table of virtual functions, and say whether it was there."""
        entries = (c_uint64 * SLOTS).from_address(table)
        page = table & -mmap.PAGESIZE
        size = table + sizeof(entries) - page
        if entries[-1] != generate or ctypes.CDLL(None).mprotect(
            c_void_p(page), c_size_t(size), mmap.PROT_READ | mmap.PROT_WRITE
        ):
            return False
        entries[-1] = ctypes.cast(self._replacement, c_void_p).value or generate
        return True

    def generate(self, result: int, generator: int, module: int) -> int:
        """Write the machine code of a module to `result`, from a file if there is one."""
        path = None
        with contextlib.suppress(Exception):  # LLVM called this function: it must return
            where = folder() if self.contexts else None
            if where:
                path, code = self._find(where, module)
                if code is not None:
                    self._copy(result, code, len(code), addressof(self._name))
                    Result.from_address(result).flags = MARKED
                    self.found += 1
                    return result
        self._generate(result, generator, module)
        with contextlib.suppress(Exception):
            made = Result.from_address(result)
            if path and not made.flags & FAILED:
                begin, end = made.buffer.contents.begin, made.buffer.contents.end
                _keep(path, ctypes.string_at(begin, end - begin))
                self.generated += 1
        return result

    def _find(self, where: pathlib.Path, module: int) -> tuple[pathlib.Path, bytes | None]:
        """Return the file for the machine code of a module, and the code; None if there is no such file.

        A module that Taichi has just compiled differs a little from the same one in another process, which read it from Taichi's
        cache: in attributes of LLVM's own functions, and in its order. Printed and parsed once more, both are the same. That
        takes 35 ms of a long kernel where the first hash takes 5, so the code then gets the first name, too.
        """
        first = where / _hash(self._bitcode(module))
        code = _read(first)
        if code is not None:
            return first, code
        path = where / _hash(self._parsed_again(module))
        code = _read(path)
        if code is not None:
            with contextlib.suppress(OSError):
                os.link(path, first)
        return path, code

    def _bitcode(self, module: int) -> bytes:
        return self._written(lambda stream: self._write(module, stream, False, None, False, None))

    def _parsed_again(self, module: int) -> bytes:
        """Return the bitcode of a module that is printed and parsed."""
        text = self._written(lambda stream: self._print(module, stream, None, False, False))
        context, buffer, parsed, message = c_void_p(), c_void_p(), c_void_p(), c_void_p()
        self._begin(addressof(context))
        try:
            self._set_opaque(addressof(context), False)
            self._copy(addressof(buffer), text, len(text), addressof(self._name))
            if self._parse(addressof(context), buffer, addressof(parsed), addressof(message)):
                raise ValueError("LLVM does not parse what it prints.")
            return self._bitcode(parsed.value or 0)
        finally:
            self._end(addressof(context))  # with the module

    def _written(self, write: Callable[[int], None]) -> bytes:
        """Return what a function writes to a stream."""
        vector = Vector()
        vector.begin = addressof(vector) + sizeof(vector)
        stream = Stream(self._streams + HEAD, (0,) * 7, addressof(vector))
        write(addressof(stream))
        try:
            return ctypes.string_at(vector.begin, vector.size)
        finally:
            if vector.capacity:
                self._free(vector.begin)


@functools.cache
def machine_code() -> MachineCode | None:
    """Replace LLVM's generator; None where this is not possible, and without patches."""
    if language.start is not _start or platform.machine() != "x86_64" or not _processor():
        return None
    addresses = find(*NAMES, *SWITCHED)  # those of the switches, too, in one search
    made = MachineCode(addresses[: len(NAMES)]) if addresses else None
    return made if made and made.replaced else None


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Within this context, machine code is read from files, and kept in them."""
    code = machine_code()
    if not code:
        yield
        return
    with deferred_signals:  # no handler of Python's may raise inside LLVM
        code.contexts += 1
        try:
            yield
        finally:
            code.contexts -= 1


def _start(**options: Any) -> None:
    """Start Taichi, which compiles functions of its own."""
    with kept():
        _start_anew(**options)


def apply() -> None:
    """Replace the function that starts Taichi."""
    language.start = _start


@functools.cache
def _processor() -> str:
    """Return what tells this processor from others; empty if the system does not say."""
    with contextlib.suppress(OSError), open("/proc/cpuinfo", "rb", buffering=0) as file:
        lines = file.read(2 * mmap.PAGESIZE).split(b"\n\n")[0].decode().splitlines()
        found = [line for line in lines if line.split("\t")[0].strip() in SAME]
        return "\n".join(found) if len(found) == len(SAME) else ""
    return ""


def _hash(bitcode: bytes) -> str:
    """Return the name of the file with the machine code of a module."""
    line = command_line()
    config: Any = impl.default_cfg()
    around = repr((stamp(), _processor(), line.given if line else (), config.fast_math))
    return hashlib.blake2b(bitcode, digest_size=HASH, key=_digest(around.encode())).hexdigest()


def _digest(code: bytes) -> bytes:
    return hashlib.blake2b(code, digest_size=HASH).digest()


def _read(path: pathlib.Path) -> bytes | None:
    """Return the machine code in a file; None if there is none. A damaged file is deleted."""
    with contextlib.suppress(OSError):
        content = path.read_bytes()
        if _digest(content[HASH:]) == content[:HASH]:
            with contextlib.suppress(OSError):  # the file may be somebody else's
                os.utime(path)  # see drop_old()
            return content[HASH:]
        path.unlink()
    return None


def _keep(path: pathlib.Path, code: bytes) -> None:
    """Keep machine code in a file."""
    with contextlib.suppress(OSError):
        drop_old(path.parent)
        replace_file(path, _digest(code) + code)


@functools.cache  # once in a process
def drop_old(where: pathlib.Path) -> None:
    """Delete the files that were read least recently, down to half of the limit of Taichi's cache, if all together exceed it."""
    if not where.exists():
        return
    files = sorted((found.st_mtime, found.st_size, entry.path) for entry in os.scandir(where) for found in [entry.stat()])
    most, total = impl.default_cfg().offline_cache_max_size_of_files, sum(size for _, size, _ in files)
    if total <= most:
        return
    for _, size, path in files:
        if total > most // 2:
            os.unlink(path)
            total -= size


_start_anew: Any = language.start
