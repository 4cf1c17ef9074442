"""The journal of a recording: everything that happened to a world, entry by entry, so that it can be repeated.

    scene     particles, features, settings, versions; a new one when particles or features were added or removed.
              A state follows.
    state     an exact state to continue from
    taken     the state after a step that ended in an exception; taken as recorded, since no complete steps lead to it
    turned    knobs that the user set before the next step
    assigned  positions, velocities or spins that the user assigned
    logged    quantities of the user's, for the next frame
    frame     a frame of the picture, and the hash of its state
    thinned   of all earlier frames, only one of `stride` is left in the picture
    end       the recording was closed

Each entry also lists the steps made since the one before. A row of the file is one entry; once the file is closed, a row may hold
several entries of frames, line by line. Each row carries a checksum of itself and of all rows before.
"""

import base64
import hashlib
import json
import math
import re
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from . import rrd

if TYPE_CHECKING:
    from ..step.step_report import StepReport

FORMAT = 13
GUARD = {"stuck", "substeps-capped"}  # flags that depend on the StepController's failed tries, not on the recorded steps
JOURNAL = "tiverlet/journal"
SCENE = "world/scene"
PARTED = "clock.parted"  # name of the clock's array, see Clock
PARTICLES = "particles"  # last part of the entities with the positions of frames
NOTHING = "was cut short, or damaged, before anything that can be replayed"
WORLDS = re.compile(r"worlds/\d{1,9}/")  # first part of entities of many worlds, see side_by_side.py


class Changed(ValueError):
    """Raised if a recording was changed after it was written. frames: how many frames before that place are unchanged."""

    def __init__(self, text: str, frames: int = 0):
        super().__init__(text)
        self.frames = frames


@dataclass
class Entry:
    """One entry: an event after `steps`, which are rows of dt [s], substeps, iterations, the iterations that the user set where
    these were chosen for accuracy, else 0, and the number of such steps.

    data["now"]: substeps, iterations and the memory of the controller after the event, if they differ from the entry before.
    """

    kind: str
    frame: int
    data: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    steps: list[list] = field(default_factory=list)

    def pack(self, serial: int) -> tuple[str, bytes]:
        """Return the entry as text and bytes."""
        arrays = {name: np.asarray(a, dtype=a.dtype.newbyteorder("<")) for name, a in self.arrays.items()}
        table = [[name, a.dtype.str, list(a.shape)] for name, a in arrays.items()]
        parts = {"serial": serial, "kind": self.kind, "frame": self.frame, "steps": self.steps, "data": self.data}
        return json.dumps({**parts, "arrays": table}), b"".join(a.tobytes() for a in arrays.values())

    @staticmethod
    def unpack(text: str, blob: bytes) -> "Entry":
        """Return the entry that pack() encoded."""
        parts, arrays, at = json.loads(text), {}, 0
        for name, kind, shape in parts["arrays"]:
            dtype = np.dtype(str(kind))
            if dtype.kind not in "biuf":
                raise ValueError(f"array {name!r} has the type {kind}")
            count = math.prod(shape)
            if len(shape) > 3 or any(type(k) is not int or k < 0 for k in shape) or count * dtype.itemsize > len(blob) - at:
                raise ValueError(f"array {name!r} has the shape {shape}, but {len(blob) - at} bytes are left")
            arrays[name] = np.frombuffer(blob, dtype, count, at).reshape(shape).astype(dtype.newbyteorder("="))
            at += arrays[name].nbytes
        return Entry(parts["kind"], parts["frame"], parts["data"], arrays, parts["steps"])


def checksum(before: str, text: str, blob: bytes) -> str:
    """Return the checksum of an entry and all before it."""
    return brief(hashlib.sha256(b"\n".join([before.encode(), text.encode(), blob])).hexdigest())


def brief(digest: str) -> str:
    """Return the first 128 bits of a digest in 20 characters. LZ4 cannot compress random digits, each of which takes a byte."""
    return base64.b85encode(bytes.fromhex(digest)[:16]).decode()


def flags_to_record(report: "StepReport | None") -> dict[str, Any]:
    """Return flags and notes of a report if some flags do not follow from the steps alone; otherwise nothing."""
    return {"flags": sorted(report.flags), "notes": list(report.notes)} if report and report.flags & GUARD else {}


def read(path: str, contents: rrd.Contents) -> tuple[list[Entry], str, int | None]:
    """Return the entries in order, checked; why they end early, if they do; and then how many frames follow the gap.

    Raises ValueError if the file is no recording or has another format, and Changed if a checksum is wrong.
    """
    rows = []
    for number, (ident, text, blob, mark) in enumerate(contents.journal()):
        try:
            serials = [json.loads(line)["serial"] for line in text.split(b"\n")]
            if serials != [*range(serials[0], serials[0] + len(serials))] or (len(serials) > 1 and blob):
                raise ValueError
        except (ValueError, KeyError, TypeError, RecursionError):
            raise Changed(f"replay: {path} was changed after it was recorded: entry {number} of its journal is none.") from None
        rows.append((serials[0], ident, text, blob, mark))
    if not rows and (some := sorted({int(e.split("/")[1]) for e in contents.entities if WORLDS.match(e)})):
        raise ValueError(
            f"replay: {path} shows worlds {', '.join(map(str, some))} side by side, and holds no state to go on from; "
            "`rerun` shows it. Record one by itself, which has the same bits: tv.Recorder(path, worlds[k])."
        )
    if not rows:
        why = "is not a recording of tiverlet; `rerun` shows it" if contents.whole else f"{NOTHING}: {contents.why}"
        raise ValueError(f"replay: {path} {why}.")
    rows.sort(key=lambda row: row[:2])
    _check_format(path, rows[0][2].split(b"\n")[0])
    entries, mark, frames = [], "", 0
    for n, (serial, _, text, blob, wanted) in enumerate(rows):
        k, lines = len(entries), text.split(b"\n")
        if serial > k:
            later = sum(kind_of(line) == "frame" for row in rows[n:] for line in row[2].split(b"\n"))
            return entries, f"entry {k} of the journal is missing", later
        mark = checksum(mark, text.decode(errors="replace"), blob)
        if serial < k or mark.encode() != wanted:
            what = f"entry {k}, {kind_of(lines[0])!r} of frame {json.loads(lines[0]).get('frame')}"
            raise Changed(f"replay: {path} was changed after it was recorded: {what}.", frames)
        entries += [Entry.unpack(line.decode(), blob) for line in lines]
        frames += sum(entry.kind == "frame" for entry in entries[k:])
    ids = [row[1] for row in rows]
    if ids != sorted(ids) or len(set(ids)) < len(ids):
        raise Changed(f"replay: {path} was changed after it was recorded: entries of the journal were written in another order.")
    if entries[-1].kind == "scene":  # the state that belongs to it was not flushed
        entries.pop()
    if not entries:
        raise ValueError(f"replay: {path} {NOTHING}: {contents.why}.")
    kinds = [entry.kind for entry in entries]
    if kinds[:2] != ["scene", "state"][: len(kinds)] or "end" in kinds[:-1]:
        raise ValueError(f"replay: {path} is damaged, or was not written by a Recorder: its entries are {', '.join(kinds[:5])}.")
    return entries, "", None


def kind_of(text: bytes | str) -> str:
    """Return the kind of an entry."""
    return json.loads(text).get("kind")


def _check_format(path: str, text: bytes) -> None:
    first = json.loads(text)
    if first.get("kind") == "scene" and first["data"]["format"] != FORMAT:
        theirs, version = first["data"]["format"], first["data"]["environment"]["tiverlet"]
        raise ValueError(
            f"replay: {path} is in format {theirs}, of tiverlet {version}, but this version reads format {FORMAT}. "
            "The picture opens with `rerun`; for the rest use that version."
        )
