"""Stretches: parts of a recording in which no particles are added or removed."""

import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shapes import Shape
from ..hues import BY_BODY, Coloring
from ..journal import Entry
from ..quantities import QUANTITIES
from ..scene import Parts, set_knobs
from .geometry import Geometry, flat, geometry, without_broken

if TYPE_CHECKING:
    from ...world import World
    from ..replay import Replay


@dataclass(frozen=True)
class Stretch:
    """Frames with the same particles and features.

    entry: the entry of the scene. frames: their numbers. times [s]. knob_changes: the knobs that the user set: before which
    frame, the number of the feature, and the values of its knobs. broken: constraints that broke: before which frame, the number
    of the feature, and those of its constraints. motion: yields what Replay.motion() does for each frame; nothing unless asked.
    coloring: how particles are coloured. known: yields for each frame what tells their quantity: the world or None, and what was
    logged.
    """

    recording: "Replay"
    entry: Entry
    frames: np.ndarray
    times: np.ndarray
    knob_changes: list[tuple[int, int, dict[str, Any]]]
    broken: list[tuple[int, int, np.ndarray]]
    motion: Iterator[dict[str, np.ndarray]]
    coloring: Coloring
    known: "Iterator[tuple[World | None, dict[str, np.ndarray]]]"

    def __iter__(self) -> Iterator[tuple[int, float, np.ndarray]]:
        """Yield number, time [s] and positions [m] of each frame."""
        for frame, time in zip(self.frames.tolist(), self.times.tolist(), strict=True):
            yield frame, time, self.recording.position(frame)

    def column(self, name: str) -> np.ndarray:
        """Return the "mass" [kg] or "radius" [m] of each particle."""
        return self.entry.arrays[name]

    @functools.cached_property
    def parts(self) -> Parts:
        """Particles and features of the scene."""
        return self.recording.parts(self.entry)

    def geometry(self, shape: Shape | None) -> Geometry:
        """Return faces, links, also those that break, and loose particles; in colours by body where these change."""
        return geometry(self.parts, shape, BY_BODY if self.coloring.name else self.coloring)

    def geometries(self, shape: Shape | None) -> Iterator[Geometry]:
        """Yield the geometry of each frame, without broken links; the same object until more links break or colours change."""
        now, coming = self.geometry(shape), list(self.broken)
        gone: dict[int, np.ndarray] = {}
        for frame in self.frames.tolist():
            if coming and coming[0][0] <= frame:
                while coming and coming[0][0] <= frame:
                    _, k, rows = coming.pop(0)
                    gone[k] = np.concatenate([gone.get(k, rows[:0]), rows])
                now = without_broken(now, self.parts, gone)
            if self.coloring.name:
                world, logged = next(self.known)
                now = replace(now, hues=self.coloring.colors(world or self.parts, logged))
            yield now

    def knobs_at(self) -> Callable[[int], None]:
        """Return a function that gives the features of `parts` the knobs that they have in a frame; frames must ascend."""
        features, changes = dict(zip(self.parts.numbers, self.parts.features, strict=True)), list(self.knob_changes)

        def turn(frame: int) -> None:
            """Set the knobs that the user had set before the frame."""
            while changes and changes[0][0] <= frame:
                _, k, values = changes.pop(0)
                if k in features:
                    set_knobs(features[k], values)

        return turn


def in_space(moved: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return velocities (n, 3), spins (n, 3) and orientations as quaternions (n, 4) (x, y, z, w). A 2D scene lies at z = 0."""
    out = {}
    for name, values in moved.items():
        if name == "velocity":
            values = flat(values)
        elif values.ndim == 1:
            none = np.zeros((len(values), 2))
            values = np.column_stack([none, values] if name == "spin" else [none, np.sin(values / 2), np.cos(values / 2)])
        out[name] = values
    return out


def _known(recording: "Replay", coloring: Coloring) -> "Iterator[tuple[World | None, dict[str, np.ndarray]]]":
    """Yield for each frame what tells the quantity of its particles: what was logged, else a world that is computed again."""
    logged = recording.logged(coloring.name) if coloring.function is QUANTITIES.get(coloring.name) else []
    if coloring.function and not logged:
        yield from ((world, {}) for world in recording.worlds())
    values = np.zeros(0)
    for frame in recording.frames.tolist():
        while logged and logged[0][0] <= frame:
            values = logged.pop(0)[1]
        yield None, {coloring.name: values}


def stretches(recording: "Replay", motion: bool = False, color: Any = None) -> list[Stretch]:
    """Return the stretches of a recording, in order, each to be read once if motion or a quantity's colours are asked for.

    color: see Replay.export().
    """
    moved, coloring = recording.motion() if motion else itertools.repeat({}), recording.overlays.color
    if color is not None:
        count = len(recording.scenes[0].entry.arrays["position"])
        coloring = Coloring.checked("replay", color, count, recording.quantities)
    known = _known(recording, coloring)
    times = dict(zip(recording.frames.tolist(), recording.times.tolist(), strict=True))
    return [
        Stretch(recording, entry, np.array(frames), np.array([times[k] for k in frames]), knobs, broken, moved, coloring, known)
        for entry, frames, knobs, broken in recording.scenes
        if frames
    ]


def only(recording: "Replay", path: str, what: str, others: str, motion: bool = False, color: Any = None) -> Stretch:
    """Return the only stretch of a recording; raise ValueError if there are more or none.

    what, others: for the message, what needs a single stretch, and which formats can hold several.
    """
    found = stretches(recording, motion, color)
    if not found:
        raise ValueError(f"replay: {recording.path} has no frame, so there is nothing for {path}.")
    if len(found) > 1:
        raise ValueError(f"replay: the particles are not the same in all frames, so they are no {what}; export to {others}.")
    return found[0]
