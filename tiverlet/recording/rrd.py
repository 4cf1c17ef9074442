"""Reads an .rrd file, complete or cut short by a crash.

A file may come from an untrusted source, and one wrong byte may end the process that reads it. So another process reads it, with
limits on memory and time, see reader.py. Its output is mapped into memory, which takes no memory until it is used.
"""

import importlib.util
import json
import mmap
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

import numpy as np

from . import reader

PATIENCE = 120.0  # [s] allowed for reading, plus 1 s per MB of the file
SINGLE_THREADED = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}


class Contents:
    """The contents of a file.

    whole: whether the file ends like a closed recording. why: what is wrong at its end, otherwise None. end: where the good part
    ends [bytes].
    """

    def __init__(self, found: dict[str, Any], data: Any):
        self._data = data
        self.whole, self.why, self.end = found["why"] is None, found["why"], found["end"]
        self.sealed = self.why != reader.BROKEN  # False: the file is complete, but some byte was changed
        self.entities: list[str] = found["entities"]
        self.stores = [tuple(store) for store in found["stores"]]
        self.shown = [tuple(one) for one in found["shown"]]
        self.trouble: list[str] = found["trouble"]  # faults outside the rows that could affect the viewer
        tables = {name: self._table(*where) for name, where in found["tables"].items()}
        self.numbers, self.rows, self._journal = tables["numbers"], tables["rows"], tables["journal"]

    def _table(self, at: int, kind: list, count: int) -> np.ndarray:
        return np.frombuffer(self._data, np.dtype([tuple(k) for k in kind]), count, at)

    def journal(self) -> Iterator[tuple[bytes, bytes, bytes, bytes]]:
        """Yield row id, text, blob and checksum of the entries, in the order of the file."""
        for row, at, text, blob, mark in self._journal.tolist():
            a, b, c = at + text, at + text + blob, at + text + blob + mark
            yield row, bytes(self._data[at:a]), bytes(self._data[a:b]), bytes(self._data[b:c])

    def values(self, number: int) -> np.ndarray:
        """Return the numbers of a row of `numbers`, (n,) or (n, width)."""
        *_, at, count, width, size = self.numbers[number].tolist()
        out = np.frombuffer(self._data, f"f{size}", count, at)
        return out if width == 1 else out.reshape(-1, width)


def read(path: str, rows: bool = False) -> Contents:
    """Read a file. rows: also compute a digest of each row.

    Raises ValueError if the file is no .rrd file, or cannot be read at all.
    """
    specs = [importlib.util.find_spec(name) for name in ("numpy", "pyarrow")]
    paths = sorted({os.path.dirname(os.path.dirname(str(spec.origin))) for spec in specs if spec})
    with open(path, "rb") as file, tempfile.TemporaryFile() as out:
        size = os.fstat(file.fileno()).st_size
        words = [sys.executable, "-I", "-S", "-B", reader.__file__, str(out.fileno()), "rows" if rows else "read", *paths]
        process = subprocess.Popen(
            words, stdin=file, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=(out.fileno(),),
            env={**os.environ, **SINGLE_THREADED},
        )  # fmt: skip
        try:
            said, wrong = process.communicate(timeout=PATIENCE + size / 1e6)
        except subprocess.TimeoutExpired:
            raise ValueError(f"replay: {path} cannot be read: it takes more than {PATIENCE + size / 1e6:.0f} s.") from None
        finally:
            process.kill()
            process.wait()
        if process.returncode:
            raise ValueError(f"replay: {path} cannot be read: {_end_reason(process.returncode, wrong)}.")
        found = json.loads(said)
        if "foreign" in found:
            raise ValueError(f"replay: {path} is not an .rrd file (or one of an old version of rerun).")
        return Contents(found, mmap.mmap(out.fileno(), 0, access=mmap.ACCESS_READ) if os.fstat(out.fileno()).st_size else b"")


def _end_reason(status: int, wrong: bytes) -> str:
    """Return why the reading process ended."""
    if status < 0:
        return f"it ends the process that reads it ({signal.Signals(-status).name})"
    last = (wrong.decode(errors="replace").strip().splitlines() or ["unknown"])[-1]
    return "it takes more memory than such a file may" if "MemoryError" in last or "malloc" in last else last
