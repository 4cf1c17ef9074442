"""Reading an .rrd file: whole, or what a crash has left of it.

A file may come from anyone, and one wrong byte in it may be enough to end the process that reads it. So another process does,
with a limit on its memory and time, see reader.py; what it finds is mapped into memory, so that it takes none while nobody looks.
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

PATIENCE = 120.0  # [s] that reading may take, and as many more as the file has MB
ENOUGH = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system"}


class Contents:
    """What is in a file.

    whole: whether it ends as a recording does that was closed. why: what is wrong where it ends, if not. end: where that is.
    """

    def __init__(self, found: dict[str, Any], data: Any):
        self._data = data
        self.whole, self.why, self.end = found["why"] is None, found["why"], found["end"]
        self.sealed = self.why != reader.BROKEN  # false: all is there, but not every byte is as it was
        self.entities: list[str] = found["entities"]
        self.stores = [tuple(store) for store in found["stores"]]
        self.shown = [tuple(one) for one in found["shown"]]
        self.trouble: list[str] = found["trouble"]  # what the viewer may see and no row says
        tables = {name: self._table(*where) for name, where in found["tables"].items()}
        self.numbers, self.rows, self._journal = tables["numbers"], tables["rows"], tables["journal"]

    def _table(self, at: int, kind: list, count: int) -> np.ndarray:
        return np.frombuffer(self._data, np.dtype([tuple(k) for k in kind]), count, at)

    def journal(self) -> Iterator[tuple[bytes, bytes, bytes, bytes]]:
        """Row id, text, blob and checksum of the entries, as they stand in the file."""
        for row, at, text, blob, mark in self._journal.tolist():
            a, b, c = at + text, at + text + blob, at + text + blob + mark
            yield row, bytes(self._data[at:a]), bytes(self._data[a:b]), bytes(self._data[b:c])

    def values(self, number: int) -> np.ndarray:
        """The numbers of a row of `numbers`, (n,) or (n, width)."""
        *_, at, count, width, size = self.numbers[number].tolist()
        out = np.frombuffer(self._data, f"f{size}", count, at)
        return out if width == 1 else out.reshape(-1, width)


def read(path: str, rows: bool = False) -> Contents:
    """What is in a file; rows: a digest of each row, too.

    Raises ValueError for what is no .rrd file, or cannot be read at all.
    """
    specs = [importlib.util.find_spec(name) for name in ("numpy", "pyarrow")]
    paths = sorted({os.path.dirname(os.path.dirname(str(spec.origin))) for spec in specs if spec})
    with open(path, "rb") as file, tempfile.TemporaryFile() as out:
        size = os.fstat(file.fileno()).st_size
        words = [sys.executable, "-I", "-S", "-B", reader.__file__, str(out.fileno()), "rows" if rows else "read", *paths]
        process = subprocess.Popen(
            words, stdin=file, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=(out.fileno(),),
            env={**os.environ, **ENOUGH},
        )  # fmt: skip
        try:
            said, wrong = process.communicate(timeout=PATIENCE + size / 1e6)
        except subprocess.TimeoutExpired:
            raise ValueError(f"replay: {path} cannot be read: it takes more than {PATIENCE + size / 1e6:.0f} s.") from None
        finally:
            process.kill()
            process.wait()
        if process.returncode:
            raise ValueError(f"replay: {path} cannot be read: {_ended(process.returncode, wrong)}.")
        found = json.loads(said)
        if "foreign" in found:
            raise ValueError(f"replay: {path} is not an .rrd file (or one of an old version of rerun).")
        return Contents(found, mmap.mmap(out.fileno(), 0, access=mmap.ACCESS_READ) if os.fstat(out.fileno()).st_size else b"")


def _ended(status: int, wrong: bytes) -> str:
    """Why the process that reads ended."""
    if status < 0:
        return f"it ends the process that reads it ({signal.Signals(-status).name})"
    last = (wrong.decode(errors="replace").strip().splitlines() or ["unknown"])[-1]
    return "it takes more memory than such a file may" if "MemoryError" in last or "malloc" in last else last
