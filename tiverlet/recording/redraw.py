"""Draws a recording again, to compare it row by row with the picture in the file."""

import hashlib
from collections import Counter, defaultdict
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..step.step_report import StepReport
from . import reader
from .journal import GUARD, JOURNAL, PARTICLES, Entry
from .messages import droppable, thins
from .overlays import Overlays
from .picture import Picture, layout
from .reader import LAYOUTS
from .rrd import Contents

if TYPE_CHECKING:
    from ..world import World

NOTHING = hashlib.blake2b(digest_size=16).digest()  # digest of a row without components: the start time of the file
Row = tuple[str, bool, int, int, bytes]  # entity, whether static, frame, time [ns], digest of the components


class Rows:
    """Replaces a rerun stream and keeps the rows."""

    def __init__(self):
        self.rows: list[Row] = []
        self._frame = self._time = 0

    def set_time(self, timeline: str, *, sequence: int = 0, duration: float = 0.0) -> None:
        """Set frame or time of the coming rows, as rerun's stream does."""
        if timeline == "frame":
            self._frame = sequence
        elif timeline == "time":
            self._time = round(1e9 * float(duration))

    def log(self, entity: str, *what: Any, static: bool = False, strict: bool | None = None) -> None:
        """Keep one row, as rerun's stream logs it."""
        parts = {part.component_descriptor(): part.as_arrow_array() for one in what for part in one.as_component_batches()}
        frame, time = (-1, 0) if static else (self._frame, self._time)
        self.rows.append((entity.lstrip("/"), static, frame, time, _digest(parts)))

    def send_columns(self, entity: str, indexes: Any, columns: Any, strict: bool | None = None) -> None:
        """Keep several rows, as rerun's stream sends them."""
        times = {index.timeline_name(): index.as_arrow_array().cast("int64").to_pylist() for index in indexes}
        lists = {column.component_descriptor(): column.as_arrow_array() for column in columns}
        for k, (frame, time) in enumerate(zip(times["frame"], times["time"], strict=True)):
            self.rows.append((entity, False, frame, time, _digest({name: a[k].values for name, a in lists.items()})))


def _digest(parts: dict[Any, Any]) -> bytes:
    into = hashlib.blake2b(digest_size=16)
    for name in sorted(parts, key=lambda name: name.component):
        into.update(f"{name.component} {name.archetype} {name.component_type} ".encode())
        reader.update_digest(into, parts[name])
    return into.digest()


class Redraw:
    """Draws the contents of a journal, from worlds that are computed again."""

    def __init__(self, scene_data: dict[str, Any]):
        self._scene_data, self._rows, self._scenes = scene_data, Rows(), 1
        self._changed_features = set(range(len(scene_data["features"])))
        self._picture: Picture | None = None
        self._world: Any = None
        self._recent: StepReport | None = None
        self._worst: StepReport | None = None
        self.layouts: list[list[Row]] = []  # the layout at the start, and the one at the end
        self.frames = 0
        self.ended = False
        self._stride, self._thin = 1, -1  # up to frame `_thin`, the picture may have only one of `_stride` frames

    @property
    def rows(self) -> list[Row]:
        """All rows, in the order of logging."""
        return self._rows.rows

    def watch(self, world: "World") -> None:
        """Observe this world from now on."""
        if world is self._world:
            return
        import rerun as rr

        self._world = world
        world._watchers.append(self)
        if self._picture:
            self._picture.set_world(world)
            return
        self._rows.log("__properties", rr.archetypes.RecordingInfo(name=self._scene_data["title"]), static=True)
        self._overlays = overlays = Overlays.of(self._scene_data["overlays"])
        self._picture = Picture(world, self._rows, self._scene_data["explained"], self._scene_data["environment"], overlays)
        self.layouts.append(_rows_of(layout(world, overlays)))

    def before(self) -> None:
        """Before a step: do nothing."""

    def after(self, dt: float, report: StepReport) -> None:
        """After a step: record its report."""
        self._recent = report if self._recent is None else self._recent.worse(report)
        self._worst = report if self._worst is None else self._worst.worse(report)

    def assigned(self, name: str, value: np.ndarray) -> None:
        """After positions or velocities were assigned: do nothing."""

    def broken_off(self) -> None:
        """After a failed step: do nothing."""

    def apply(self, entry: Entry) -> str | None:
        """Take what an entry means for the picture, other than a frame. Returns what is wrong with it, or None."""
        assert self._picture
        if entry.kind == "scene":
            self._scenes += 1
            self._changed_features = set(range(len(self._world.features)))
        elif entry.kind == "turned":
            self._changed_features.update(map(int, entry.data["features"]))
        elif entry.kind == "thinned":
            self._stride, self._thin = checks.integer("replay", "stride", entry.data["stride"], least=1), entry.frame
        elif entry.kind == "logged":  # quantities of the user's; those of every world are computed
            color = self._overlays.color
            arrays = {name: values for name, values in entry.arrays.items() if not (color.function and name == color.name)}
            self._picture.log(entry.frame, {**entry.data["numbers"], **arrays})
        return self._end(entry) if entry.kind == "end" else None

    def expected(self, found: list[Row]) -> list[Row]:
        """Return the rows that must be in the file: those drawn, except rows that are missing because the file was thinned."""
        there = Counter(found)
        frames: dict[str, list[int]] = defaultdict(list)
        for entity, static, frame, *_ in self.rows:
            if not static and thins(f"/{entity}"):
                frames[entity].append(frame)
        gone = {entity: np.unique(numbers) for entity, numbers in frames.items()}
        may = {entity: set(numbers[droppable(numbers, self._stride)].tolist()) for entity, numbers in gone.items()}
        out = []
        for row in self.rows:
            if there[row] > 0:
                there[row] -= 1
            elif row[2] <= self._thin and row[2] in may.get(row[0], ()):
                continue
            out.append(row)
        return out

    def frame(self, entry: Entry) -> tuple[dict[str, Any], np.ndarray, str | None]:
        """Draw a frame. Returns what Picture.frame() does, and what is wrong with its entry in the journal, or None."""
        assert self._picture
        report, wrong = self._recent, None
        if report:
            report, wrong = _amended(report, entry.data)
            report = replace(report, seconds=entry.data["seconds"])
        self._picture.stamp(entry.frame)
        data, x32 = self._picture.frame(entry.frame, report, self._scenes, self._changed_features)
        self._recent, self._changed_features = None, set()
        self.frames += 1
        if data.get("broke", {}) != entry.data.get("broke", {}):
            wrong = wrong or "other constraints broke than were recorded"
        return data, x32, wrong

    def _end(self, entry: Entry) -> str | None:
        """Draw the last entry. Returns what is wrong with it, or None."""
        assert self._picture
        self.ended = True
        self._picture.curves.send()
        if entry.data["frames"] != self.frames:
            return f"the journal has {self.frames} frames, but says at its end that there are {entry.data['frames']}"
        if entry.data["time"] != self._world.time:
            return f"the end says {entry.data['time']} s, but it is {self._world.time} s"
        worst, wrong = (self._worst, None) if self._worst is None else _amended(self._worst, entry.data)
        if wrong:
            return wrong
        if "hash" in entry.data:
            self._picture.end(worst, self.frames, entry.data["note"])
            self.layouts.append(_rows_of(self._picture.layout()))
        return None

    def send(self) -> None:
        """Send the collected curves, if the recording has no end."""
        if self._picture:
            self._picture.curves.send()


def _rows_of(blueprint: Any) -> list[Row]:
    views = Rows()
    blueprint._log_to_stream(views)
    return views.rows


def _amended(report: StepReport, recorded: dict[str, Any]) -> tuple[StepReport, str | None]:
    """Return a report with the flags of the journal, which may have more, and what is wrong with these flags, or None."""
    if "flags" not in recorded:
        return report, None
    flags, notes = set(recorded["flags"]), tuple(recorded["notes"])
    if not report.flags <= flags or flags - report.flags - GUARD or not set(report.notes) <= set(notes):
        return report, f"flags are {sorted(report.flags)}, but the journal says {sorted(flags)}"
    if any(not note.startswith("The frame is not as good") for note in set(notes) - set(report.notes)):
        return report, "the journal has notes that no report has"
    return replace(report, flags=frozenset(flags), notes=notes), None


def compare(contents: Contents, redraw: Redraw, application: str, complete: bool) -> tuple[int | None, str] | int:
    """Return the first difference between a file and the picture drawn again: its frame, if it has one, and a description.

    Without a difference, return the number of complete frames. At each time the viewer shows the row with the highest id, and
    static rows before all others. So the rows of each entity must agree in the order of their ids, and so must the rows of all
    entities together, except for curves, which are sent from time to time. In an incomplete recording, rows may be missing at the
    end of each entity.
    """
    if contents.trouble:
        return None, contents.trouble[0]
    stores = list(dict.fromkeys(contents.stores))
    blueprints = [store[2] for store in stores if store[0] == 2]
    kinds = [(1, application), *[(2, application)] * len(blueprints)]
    if sorted(store[:2] for store in stores) != kinds or len({store[2] for store in stores}) != len(kinds):
        return None, f"it has other stores than a recording of {application}"
    shown = [(blueprint, 0, 1) for blueprint in blueprints]
    if contents.shown != shown and (complete or contents.shown != shown[:1]):
        return None, "it opens with another layout"
    rows = np.sort(contents.rows, order="f5")  # f5 is the id
    if len(np.unique(rows["f5"])) != len(rows):
        return None, "two rows have the same id"
    names = contents.entities
    last = None if complete else max((row[2] for row in redraw.rows), default=-1)  # later frames cannot be checked
    found: list[Row] = []
    views: list[list[tuple[str, bytes]]] = [[] for _ in blueprints]
    for store, static, entity, frame, time, _, digest in rows.tolist():
        digest = digest.ljust(16, b"\0")
        if store >= LAYOUTS:
            views[store - LAYOUTS].append((names[entity], digest))
        elif names[entity] == "about" and not redraw.ended and any(row[0] == "about" for row in found):
            continue  # the page about all frames is in the file, but the entry that it follows from is not
        elif names[entity] != JOURNAL and digest != NOTHING and (last is None or frame <= last):
            found.append((names[entity], bool(static), frame, time, digest))
    if not _opens_so(views, redraw, complete):
        return None, "the layout is not that of the recording"
    return _first(found, redraw.expected(found), complete)


def _opens_so(views: list[list[tuple[str, bytes]]], redraw: Redraw, complete: bool) -> bool:
    """Whether the layouts of a file are those of its recording: the one at the start, the one of the whole run, or both.

    In an incomplete recording, the last layout may be there in part, and the one of the whole run may be unknown.
    """
    drawn = [Counter((entity, digest) for entity, *_, digest in rows) for rows in redraw.layouts]
    given = [Counter(rows) for rows in views]
    if complete:
        return given in (drawn, drawn[-1:])
    if not redraw.ended:
        return given[:1] == drawn[:1] or len(given) == 1
    known = drawn if len(given) == len(drawn) else drawn[:1] if given[0] == drawn[0] else drawn[-1:]
    return len(given) == len(known) and given[:-1] == known[:-1] and given[-1] <= known[-1]


def _first(found: list[Row], drawn: list[Row], complete: bool) -> tuple[int | None, str] | int:
    by: dict[str, tuple[list[Row], list[Row]]] = {}
    for k, rows in enumerate((found, drawn)):
        for row in rows:
            by.setdefault(row[0], ([], []))[k].append(row)
    differences: list[tuple[int, str]] = []
    least: list[int] = []  # for each entity with rows missing at its end, the first frame without them
    for entity, (there, wanted) in by.items():
        for one, other in zip(there, wanted, strict=False):
            if one != other:
                differences.append((max(min(one[2], other[2]), -1), f"{entity} is not what was recorded"))
                break
        else:
            if len(there) > len(wanted):
                differences.append((there[len(wanted)][2], f"{entity} has rows that were not recorded"))
            elif len(there) < len(wanted):
                missing = wanted[len(there)]
                if complete:
                    differences.append((missing[2], f"{entity} is missing"))
                elif not missing[1] and not entity.startswith("figures/"):
                    least.append(missing[2])
    if differences:
        frame, what = min(differences)
        return (None if frame < 0 else frame), what
    counts = {entity: len(there) for entity, (there, _) in by.items()}
    order = []
    for row in drawn:
        if counts.get(row[0], 0) > 0:
            counts[row[0]] -= 1
            order.append(row)
    plain = [[row for row in rows if not row[0].startswith("figures/")] for rows in (found, order)]
    for one, other in zip(*plain, strict=True):
        if one != other:
            return (other[2] if other[2] >= 0 else None), f"{one[0]} stands before {other[0]}, in another order than recorded"
    frames = {row[2] for row in drawn if row[0].endswith(f"/{PARTICLES}") and not row[1]}
    return sum(frame < min(least) for frame in frames) if least else len(frames)
