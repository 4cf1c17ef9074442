"""Reading an .rrd file: whole, or what a crash has left of it."""

import os
import struct
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

MAGIC = b"RRF2"
HEADER = 12  # bytes before the first message; each message has its kind and its length in front


@contextmanager
def chunks(path: str) -> Iterator[tuple[list[Any], bool]]:
    """The data of a file, and whether all of it is there."""
    with open(path, "rb") as file:
        if file.read(4) != MAGIC:
            raise ValueError(f"replay: {path} is not an .rrd file (or one of an old version of rerun).")
        whole, end = _messages(file)
    with tempfile.TemporaryDirectory() as folder:
        readable = path
        if not whole:
            readable = os.path.join(folder, "part.rrd")
            _copy(path, readable, end)
        yield _read(readable, path, whole), whole


def _messages(file) -> tuple[bool, int]:
    """Whether the file ends with the message that ends it, and where the last whole message does."""
    size, at, kind = os.fstat(file.fileno()).st_size, HEADER, 1
    while kind and at + 16 <= size:
        file.seek(at)
        kind, length = struct.unpack("<QQ", file.read(16))
        if at + 16 + length > size:
            return False, at
        at += 16 + length
    return kind == 0, at


def _copy(path: str, to: str, end: int) -> None:
    with open(path, "rb") as source, open(to, "wb") as out:
        while end > 0 and (piece := source.read(min(end, 1 << 20))):
            out.write(piece)
            end -= len(piece)


def _read(readable: str, path: str, whole: bool) -> list[Any]:
    import rerun as rr

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a file without an end has none
            return list(rr.chunk.RrdReader(readable).stream())
    except (RuntimeError, ValueError) as e:
        if not whole:
            return []
        raise ValueError(f"replay: {path} cannot be read: {e}") from None


def rows(chunk: Any, column: str) -> list:
    """What a column of a chunk has, row by row; NumPy arrays where it has numbers. Where all are empty, rerun leaves it out."""
    import pyarrow as pa

    batch = chunk.to_record_batch()
    if column not in batch.schema.names:
        return [np.zeros(0, dtype=np.uint8)] * chunk.num_rows
    values = batch.column(column)
    inner, width = values.values, 1
    while pa.types.is_fixed_size_list(inner.type) or pa.types.is_list(inner.type):
        width *= inner.type.list_size
        inner = inner.values
    if not pa.types.is_primitive(inner.type):
        return [row[0] if row else None for row in values.to_pylist()]
    flat, ends = inner.to_numpy(zero_copy_only=False), values.offsets.to_numpy() * width
    return [flat[a:b].reshape(-1, width) if width > 1 else flat[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]


def numbers(chunk: Any, timeline: str) -> np.ndarray:
    """The times of the rows of a chunk."""
    return chunk.to_record_batch().column(timeline).to_numpy(zero_copy_only=False)


def by_frame(chunks: list[Any], entity: str, column: str) -> dict[int, np.ndarray]:
    """What a column of an entity has, or of all whose paths end like this, by frame."""
    out = {}
    for chunk in chunks:
        if chunk.entity_path.endswith(f"/{entity}") and not chunk.is_static and column in chunk.to_record_batch().schema.names:
            out.update(zip(numbers(chunk, "frame").tolist(), rows(chunk, column), strict=True))
    return dict(sorted(out.items()))


def curves(chunks: list[Any]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frames and values of each figure."""
    names = {chunk.entity_path for chunk in chunks if chunk.entity_path.startswith("/figures/")}
    found = {name: by_frame(chunks, name[1:], "Scalars:scalars") for name in sorted(names)}
    return {
        name[len("/figures/") :]: (np.array(list(by)), np.concatenate(list(by.values()))) for name, by in found.items() if by
    }  # fmt: skip
