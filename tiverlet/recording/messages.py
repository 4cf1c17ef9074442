"""The messages of an .rrd file, as far as writing needs them: rows pass through here on their way to the file."""

import struct
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from . import journal, reader

HEADER = 12  # bytes of a file before its first message
HEAD = struct.Struct("<QQ")  # head of a message: its kind, and how many bytes follow
END, STORE, CHUNK, SHOWN = range(4)  # kinds: the last message, a store, rows of an entity, which layout is shown
LAYOUT = 2  # the kind of a store with a layout
COMPRESSION, SIZE, PAYLOAD = 2, 3, 5  # fields of a chunk: the compression, the uncompressed size, the bytes
FIELDS = "1 2 3 4 5 6 7"  # all fields of a chunk
LZ4 = 2
BATCH = 120_000  # bytes sent together: LZ4 finds matches within 64 kB
LEVEL = 9  # LZ4 level that matches the points of lines with those of particles, at 60 MB/s
NOISE = 0.9  # from this compression ratio on, LEVEL saves only 1 % over rerun's faster LZ4, for 2 ms per 100 kB
PACKED = 64  # most entries of a journal in one row
WRITTEN = "log_time"  # column of the layout's rows with the time of writing, which nothing reads
PARTS = ("particles", "fill", "contacts", "velocities", "breaks")  # of the scene: drawn in each frame, or again in the next


def rows_of(message: bytes) -> Any:
    """Return the rows of a message as a pyarrow.RecordBatch."""
    return reader.rows_of(reader.record(message, FIELDS))


def holding(message: bytes, rows: Any) -> bytes:
    """Return the message with other rows, well compressed. pyarrow pads them less than rerun does."""
    import pyarrow as pa

    ids = rows.schema.field(0)  # rerun recognises ids by their kind, and needs no name of their type in addition
    told = {key: value for key, value in (ids.metadata or {}).items() if not key.startswith(b"ARROW:extension")}
    rows = rows.set_column(0, ids.with_metadata(told), rows.column(0))
    buffer = pa.BufferOutputStream()
    with pa.ipc.new_stream(buffer, rows.schema) as stream:
        stream.write_batch(rows)
    plain = buffer.getvalue()
    packed = pa.Codec("lz4_raw", compression_level=LEVEL).compress(plain).to_pybytes()
    fields = reader.record(message, FIELDS) | {COMPRESSION: LZ4, SIZE: len(plain), PAYLOAD: packed}
    out = b""
    for field, value in fields.items():
        if isinstance(value, int):
            out += bytes([field << 3]) + _varint(value)
        else:
            out += bytes([field << 3 | 2]) + _varint(len(value)) + value
    return out


def smaller(message: bytes) -> bytes:
    """Return a message with its rows compressed better than rerun does; unchanged where nothing is gained."""
    fields = reader.record(message, FIELDS)
    if fields.get(COMPRESSION) != LZ4 or len(fields[PAYLOAD]) > NOISE * fields[SIZE]:
        return message
    rows = reader.rows_of(fields)
    new = holding(message, rows.drop_columns([name for name in rows.schema.names if name == WRITTEN]))
    return new if len(new) < len(message) else message


def droppable(frames: np.ndarray, stride: int) -> np.ndarray:
    """Return which rows of an entity may be removed if one of `stride` frames is kept. frames: the frame of each row, ascending.

    Rows of kept frames stay. If a kept frame has no row of its own, the last row before it stays too, since the viewer shows it
    there.
    """
    following = np.append(frames[1:], np.iinfo(np.int64).max)
    return (frames % stride != 0) & (following <= -(-frames // stride) * stride)


def thins(entity: str) -> bool:
    """Whether rows of an entity may be removed."""
    return entity.startswith("/figures") or (entity.startswith("/world/") and entity.rpartition("/")[2] in PARTS)


def thinned(messages: list[tuple[int, bytes]], stride: int) -> Iterator[tuple[int, bytes]]:
    """Yield messages (kind, bytes) with the picture of one of `stride` frames; all other messages are unchanged.

    With stride = 1 only replaced layouts are left out. The rows of each entity are put together. Entries of the journal are
    packed as well and come first, in pieces, so that a file that was cut short can be replayed as far as it goes.
    """
    if stride == 1:
        messages = latest(messages)
    found, frames = [], defaultdict(list)
    for kind, message in messages:
        entity = ""
        if kind == CHUNK:
            rows = rows_of(message)
            name = rows.schema.metadata[b"rerun:entity_path"].decode()
            if "frame" in rows.schema.names and (thins(name) or stride == 1):
                entity = name
                frames[entity].append(rows.column("frame").to_numpy())
        found.append(entity)
    gone = {}
    for entity, numbers in frames.items():
        numbers = np.unique(np.concatenate(numbers))
        gone[entity] = numbers[droppable(numbers, stride)]
    entries, pictures = [], []
    waiting: dict[tuple, list] = defaultdict(list)  # rows to be put together: a message with a single row takes 1 kB
    for (kind, message), entity in zip(messages, found, strict=True):
        if not entity:
            yield kind, message
            continue
        rows = rows_of(message)
        if entity == f"/{journal.JOURNAL}":
            entries.append((message, rows))
            continue
        rows = rows.take(np.flatnonzero(~np.isin(rows.column("frame").to_numpy(), gone[entity])))
        together = waiting[entity, tuple(zip(rows.schema.names, rows.schema.types, strict=True))]
        if together and sum(rows.nbytes for _, rows in together) + rows.nbytes > BATCH:
            pictures.append(_joined(together))
            together.clear()
        if rows.num_rows:
            together.append((message, rows))
    yield from ((CHUNK, message) for message in _packed(entries))
    pictures += [_joined(together) for together in waiting.values() if together]
    yield from ((CHUNK, message) for message in pictures)


def latest(messages: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Return the messages without those of replaced layouts."""
    where = [_store(kind, message) for kind, message in messages]
    layouts = [store for store in dict.fromkeys(where) if store and store[0] == LAYOUT]
    return [one for one, store in zip(messages, where, strict=True) if store not in layouts[:-1]]


def _store(kind: int, message: bytes) -> tuple | None:
    """Return the store to which a message belongs."""
    if kind == STORE:
        message = reader.record(reader.record(message, "1 2").get(2, b""), "2 5 6")[2]
        return tuple(reader.store_of(message))
    return tuple(reader.store_of(reader.record(message, FIELDS).get(1, b""))) if kind in (CHUNK, SHOWN) else None


def _packed(entries: list[tuple[bytes, Any]]) -> Iterator[bytes]:
    """Yield messages with rows of a journal: the first row by itself, so that it is written early, the others together."""
    pieces, size, mark = [], BATCH, ""
    for message, rows in entries:
        size += rows.nbytes
        if len(pieces) < 2 or size > BATCH:
            pieces.append([])
            size = rows.nbytes
        pieces[-1].append((message, rows))
    for piece in pieces:
        rows, mark = _in_runs(_together(piece), mark)
        yield holding(piece[0][0], rows)


def _in_runs(rows: Any, mark: str) -> tuple[Any, str]:
    """Merge successive entries of frames into one row, since a row takes 60 bytes in addition to its text.

    mark: the checksum of the row before. Returns the rows and the checksum of the last one.
    """
    import pyarrow as pa

    texts, blobs = [text for (text,) in rows.column("text").to_pylist()], [bytes(b) for b in rows.column("blob").to_pylist()]
    firsts, together, marks = [], [], [mark]
    for k, text in enumerate(texts):
        alike = k and all(not blobs[j] and journal.kind_of(texts[j]) == "frame" for j in (k - 1, k))
        if alike and k - firsts[-1] < PACKED:
            together[-1].append(text)
        else:
            firsts.append(k)
            together.append([text])
    together = ["\n".join(lines) for lines in together]
    for k, text in zip(firsts, together, strict=True):
        marks.append(journal.checksum(marks[-1], text, blobs[k]))
    rows = rows.take(firsts)
    for name, values in (("text", together), ("checksum", marks[1:])):
        at = rows.schema.get_field_index(name)
        rows = rows.set_column(at, rows.schema.field(at), pa.array([[v] for v in values], rows.schema.field(at).type))
    return rows, marks[-1]


def _together(parts: list[tuple[bytes, Any]]) -> Any:
    """Join the rows of several messages, with the schema of the first."""
    import pyarrow as pa

    first = parts[0][1]
    table = pa.Table.from_batches([rows.replace_schema_metadata(first.schema.metadata) for _, rows in parts], first.schema)
    return table.combine_chunks().to_batches()[0]


def _joined(parts: list[tuple[bytes, Any]]) -> bytes:
    return holding(parts[0][0], _together(parts))


def split(data: bytes) -> list[tuple[int, bytes]]:
    """Return the messages of a file, each with its kind."""
    out, at = [], HEADER
    while at + HEAD.size <= len(data):
        kind, length = HEAD.unpack_from(data, at)
        out.append((kind, data[at + HEAD.size : at + HEAD.size + length]))
        at += HEAD.size + length
    return out


def _varint(number: int) -> bytes:
    """Encode a number with seven bits per byte."""
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])
