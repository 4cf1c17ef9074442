"""Reads the rows of an .rrd file in a process of its own, since a file may come from an untrusted source. rrd.py starts it.

It runs as a script that does not import the rest of the package, so that it takes only 0.1 s. It writes arrays one behind the
other to a given file, and their places to the standard output. It accepts only what rerun writes, so that the viewer can show
nothing that is not read here. A file has messages, each a protobuf record with a chunk of rows as an Arrow stream, compressed by
LZ4.

    file       "RRF2", version and options (12 bytes); messages; the end
    message    kind, length (2 x u64); 1: a store, 2: a chunk of rows of a store, 3: which layout is shown; 0: the end, with
               SHA-256 of everything before it
"""

import contextlib
import hashlib
import json
import os
import struct
import sys

MAGIC, OPTIONS = b"RRF2", b"\1\2\0\0"  # LZ4, protobuf
HEADER = 12
SEAL = b"\x7a\x20"  # a field of 32 bytes in the last message that rerun ignores: SHA-256 of everything before that message
LZ4 = 255  # the largest ratio of compression
SPARE = 256 << 20  # bytes of memory and of output that are allowed in any case
FOLD = 64  # bytes of output that are allowed per byte of the file
UNTOLD = {"RecordingInfo:start_time"}  # components that cannot be verified
BROKEN = "its checksum is not that of the file"
LAYOUTS = 2  # number of the first layout's store; the recording's store is 1
DEEP = 16  # most levels of nested lists
ROWS = {"world/scene": "Points2D:positions Points3D:positions", "figures": "Scalars:scalars"}


class Damaged(Exception):
    """Raised where the file is not as rerun writes it."""


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Decode a number; return it and the index behind it."""
    value = shift = 0
    while shift < 64:
        byte = data[at]
        value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
        if byte < 128:
            return value, at
    raise Damaged("a number is too long")


def record(data: bytes, known: str) -> dict:
    """Decode a protobuf record into numbers and bytes by field number. Each field may occur once, and must be in `known`."""
    at, out = 0, {}
    while at < len(data):
        key, at = varint(data, at)
        field, kind = key >> 3, key & 7
        if kind == 0:
            value, at = varint(data, at)
        elif kind in (1, 2):
            length, at = (8, at) if kind == 1 else varint(data, at)
            if length > len(data) - at:
                raise Damaged("a record is longer than its message")
            value, at = data[at : at + length], at + length
        else:
            raise Damaged(f"a record has a field of kind {kind}")
        if field in out or str(field) not in known.split():
            raise Damaged(f"a record has an unexpected field {field}")
        out[field] = value
    return out


def store_of(data: bytes) -> tuple[int, str, str]:
    """Return kind (1: recording, 2: layout), application and id of a store."""
    parts = record(data, "1 2 3")
    return parts.get(1, 0), record(parts.get(3, b""), "1").get(1, b"").decode(), parts.get(2, b"").decode()


def rows_of(parts: dict):
    """Return the rows of a message of kind 2 as a pyarrow.RecordBatch. parts: the decoded message."""
    import pyarrow as pa

    packed, size = parts.get(5, b""), parts.get(3, 0)
    if parts.get(2) == 2:
        if size > LZ4 * len(packed) + 64:
            raise Damaged(f"{len(packed)} bytes say that they unpack to {size}")
        packed = pa.Codec("lz4_raw").decompress(packed, decompressed_size=size)
    return pa.ipc.open_stream(packed).read_next_batch()


class ResultFile:
    """The output for the parent process: arrays one behind the other in the file, and their places."""

    def __init__(self, file: int, most: int):
        self._file, self._most, self.size = os.fdopen(file, "wb"), most, 0
        self.tables: dict[str, list] = {}

    def put(self, data) -> int:
        """Write bytes; return where they begin."""
        begin = self.size
        self.size += len(data)
        if self.size > self._most:
            raise Damaged(f"it unpacks to more than {self._most >> 20} MB")
        self._file.write(data)
        return begin

    def table(self, name: str, rows: list, kind) -> None:
        """Write an array that is found by name."""
        import numpy as np

        array = np.array(rows, dtype=kind)
        self._file.write(b"\0" * (-self.size % 16))
        self.size += -self.size % 16
        self.tables[name] = [self.size, array.dtype.descr, len(array)]
        self._file.write(array.tobytes())
        self.size += array.nbytes

    def close(self) -> None:
        """Complete the file."""
        self._file.close()


def update_digest(into, array, depth: int = 0) -> None:
    """Add the contents of an Arrow array to a checksum. Equal arrays give equal checksums, whatever their layout in memory."""
    import numpy as np
    import pyarrow as pa

    kind, types = array.type, pa.types
    into.update(b"%d " % len(array))
    if depth > DEEP:
        raise Damaged("lists in lists in lists")
    if array.null_count:
        into.update(b"null" + np.packbits(array.is_null().to_numpy(zero_copy_only=False)).tobytes())
    if types.is_primitive(kind) and not array.null_count:
        into.update(str(kind).encode())
        into.update(np.ascontiguousarray(array.to_numpy(zero_copy_only=False)))
    elif types.is_fixed_size_list(kind):
        into.update(b"fixed%d" % kind.list_size)
        update_digest(into, array.flatten(), depth + 1)
    elif types.is_list(kind):
        into.update(b"list" + np.diff(array.offsets.to_numpy()).tobytes())
        update_digest(into, array.flatten(), depth + 1)
    else:
        into.update(repr(array.to_pylist()).encode())


class Reader:
    """Reads messages, and keeps the requested parts."""

    def __init__(self, found: ResultFile, rows: bool):
        import numpy as np
        import pyarrow as pa

        self.np, self.pa, self.found, self.wants_rows = np, pa, found, rows
        self.stores: list = []
        self.shown: list = []  # layouts that messages activate
        self.entities: dict[str, int] = {}
        self.journal: list = []
        self.numbers: list = []
        self.rows: list = []
        self.trouble: list[str] = []  # faults outside the rows that could affect the viewer

    def store(self, data: bytes) -> None:
        """Read a message that announces a store."""
        info = record(record(data, "1 2").get(2, b""), "2 5 6")
        self.stores.append(store_of(info.get(2, b"")))

    def show(self, data: bytes) -> None:
        """Read a message that activates a layout."""
        parts = record(data, "1 2 3")
        self.shown.append([store_of(parts.get(1, b""))[2], parts.get(2, 0), parts.get(3, 0)])

    def chunk(self, data: bytes) -> None:
        """Read a message with rows."""
        np, pa = self.np, self.pa
        parts = record(data, "1 2 3 4 5 6 7")
        store = store_of(parts.get(1, b""))
        if store not in self.stores:
            raise Damaged("rows of a store that is not announced")
        batch = rows_of(parts)
        batch.validate(full=True)
        about = {k.decode(): v.decode() for k, v in (batch.schema.metadata or {}).items()}
        entity = about.get("rerun:entity_path", "").lstrip("/")
        columns: dict[str, dict] = {"control": {}, "index": {}, "data": {}}
        for column, values in zip(batch.schema, batch.columns, strict=True):
            told = {k.decode(): v.decode() for k, v in (column.metadata or {}).items()}
            columns[told.get("rerun:kind", "data")][column.name] = values, told
        ((ids, told),) = columns["control"].values()
        ids = np.frombuffer(ids.buffers()[1], dtype="S16", count=len(ids), offset=16 * ids.offset)
        ids = [bytes(row).ljust(16, b"\0") for row in ids]
        times = {}
        for name, (values, said) in columns["index"].items():
            if values.null_count or said.get("rerun:index_name") != name:
                raise Damaged(f"a timeline {name!r} has gaps")
            times[name] = values.cast(pa.int64()).to_numpy()
            if said.get("rerun:is_sorted") == "true" and (np.diff(times[name]) < 0).any():
                self.trouble.append(f"rows of {entity} are said to be in order of {name} and are not")
            if (name, str(values.type)) not in {("frame", "int64"), ("time", "duration[ns]"), ("blueprint", "int64")}:
                if name != "log_time":
                    self.trouble.append(f"rows of {entity} have a timeline {name} of {values.type}")
        if told.get("rerun:is_sorted") == "true" and ids != sorted(ids):
            self.trouble.append(f"rows of {entity} are said to be in order and are not")
        if bool(parts.get(7, 0)) != (not times):
            self.trouble.append(f"rows of {entity} are said to be static or not, and are not so")
        number = 1 if store[0] == 1 else LAYOUTS + [one for one in dict.fromkeys(self.stores) if one[0] != 1].index(store)
        self._keep(number, entity, ids, times, columns["data"])

    def _keep(self, store: int, entity: str, ids: list, times: dict, data: dict) -> None:
        number = self.entities.setdefault(entity, len(self.entities))
        frames = times.get("frame", self.np.full(len(ids), -1)).tolist()
        if store == 1 and entity == "tiverlet/journal":
            self._journal(ids, data)
        wanted = next((v for k, v in ROWS.items() if entity.startswith(f"{k}/")), "")
        for name, (values, _) in data.items():
            if store == 1 and name in wanted.split() and times:
                self._numbers(number, ids, frames, values)
        if self.wants_rows:
            spans = times.get("time", self.np.zeros(len(ids), dtype=int)).tolist()
            for k, (row, frame, span) in enumerate(zip(ids, frames, spans, strict=True)):
                self.rows.append((store, not times, number, frame, span, row, self._digest(data, k)))

    def _journal(self, ids: list, data: dict) -> None:
        if set(data) - {"text", "blob", "checksum"} or not {"text", "checksum"} <= set(data):
            raise Damaged(f"the journal has columns {', '.join(data)}")
        for k, row in enumerate(ids):
            cells = [data[name][0][k] if name in data else None for name in ("text", "blob", "checksum")]
            values = [c.values if c is not None and c.is_valid else None for c in cells]
            text, blob, mark = (self._bytes(v) for v in values)
            at = self.found.put(text)
            self.found.put(blob)
            self.found.put(mark)
            self.journal.append((row, at, len(text), len(blob), len(mark)))

    def _bytes(self, array) -> bytes:
        if array is None:
            return b""
        if self.pa.types.is_string(array.type):
            if len(array) != 1:
                raise Damaged("an entry of the journal has more than one text")
            return array[0].as_py().encode()
        if str(array.type) != "uint8":
            raise Damaged(f"an entry of the journal has bytes of type {array.type}")
        return array.to_numpy().tobytes()

    def _numbers(self, entity: int, ids: list, frames: list, values) -> None:
        for k, (row, frame) in enumerate(zip(ids, frames, strict=True)):
            if not values[k].is_valid:
                continue
            inner, width = values[k].values, 1
            while self.pa.types.is_fixed_size_list(inner.type):
                width, inner = width * inner.type.list_size, inner.flatten()
            if str(inner.type) not in ("float", "double") or inner.null_count:
                raise Damaged(f"numbers of type {inner.type}")
            array = inner.to_numpy()
            self.numbers.append((entity, frame, row, self.found.put(array.tobytes()), len(array), width, array.dtype.itemsize))

    def _digest(self, data: dict, k: int) -> bytes:
        into = hashlib.blake2b(digest_size=16)
        for name in sorted(data):
            values, told = data[name]
            if values[k].is_valid and name not in UNTOLD:
                kind = f"{name} {told.get('rerun:archetype')} {told.get('rerun:component_type')} "
                into.update(kind.encode())
                update_digest(into, values[k].values)
        return into.digest()

    def write(self) -> None:
        """Write the tables."""
        self.found.table("journal", self.journal, "S16, i8, i8, i8, i8")
        self.found.table("numbers", self.numbers, "i4, i8, S16, i8, i8, i8, i8")
        self.found.table("rows", self.rows, "i1, i1, i4, i8, i8, S16, S16")


def messages(file, size: int, take) -> tuple[int, str | None]:
    """Pass every message to `take`. Return where the last good one ends, and why none follows; None if the file ends properly."""
    whole, at = hashlib.sha256(), HEADER
    file.seek(0)
    whole.update(file.read(HEADER))
    while at < size:
        head = file.read(16)
        if len(head) < 16:
            return at, "the file is cut short"
        kind, length = struct.unpack("<QQ", head)
        if length > size - at - 16:
            return at, "the file is cut short, or a length is wrong"
        data = file.read(length)
        if kind == 0:
            if at + 16 + length != size:
                return at, "something follows the end"
            if data[:2] != SEAL or data[2:] != whole.digest():
                return at, BROKEN
            return size, None
        whole.update(head)
        whole.update(data)
        try:
            if kind not in (1, 2, 3):
                raise Damaged(f"there is a message of kind {kind}")
            take[kind](data)
        except Exception as e:  # any error of Arrow, NumPy or Python means a damaged file
            return at, f"{type(e).__name__}: {e}" if not isinstance(e, Damaged) else str(e)
        at += 16 + length
    return at, "the file has no end"


def limit(size: int) -> None:
    """Limit the memory and the CPU time of this process."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        with open("/proc/self/statm") as f:
            now = int(f.read().split()[0]) * resource.getpagesize()
        memory, seconds = now + SPARE + 4 * FOLD * size, 60 + size // 1_000_000 * 10
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def read(file, out: int, rows: bool, limited: bool) -> dict:
    """Return the places of the arrays that are written to the file descriptor `out`. rows: also write digests of all rows."""
    size = os.fstat(file.fileno()).st_size
    head = file.read(HEADER)
    if head[:4] != MAGIC or len(head) < HEADER:
        return {"foreign": True}
    found = ResultFile(out, SPARE + FOLD * size)
    reader = Reader(found, rows)
    if limited:
        limit(size)
    at, why = messages(file, size, {1: reader.store, 2: reader.chunk, 3: reader.show})
    if head[8:] != OPTIONS:
        reader.trouble.append("the options of the file are not those of rerun")
    reader.write()
    found.close()
    about = {"stores": reader.stores, "shown": reader.shown, "entities": list(reader.entities), "tables": found.tables}
    return {**about, "end": at, "why": why, "trouble": reader.trouble[:20]}


if __name__ == "__main__":
    sys.path += sys.argv[3:]
    print(json.dumps(read(sys.stdin.buffer, int(sys.argv[1]), sys.argv[2] == "rows", limited=True)))
