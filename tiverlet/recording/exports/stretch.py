"""A part of a recording in which no particles come or go."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...shapes import Shape
from ..journal import Entry
from ..scene import Parts
from .geometry import Geometry, geometry

if TYPE_CHECKING:
    from ..replay import Replay


@dataclass(frozen=True)
class Stretch:
    """Frames with the same particles and features.

    entry: of the scene. frames: their numbers. times [s]. turned: what the user turned: before which frame, the number of the
    feature, and its knobs.
    """

    recording: "Replay"
    entry: Entry
    frames: np.ndarray
    times: np.ndarray
    turned: list[tuple[int, int, dict[str, Any]]]

    def __iter__(self) -> Iterator[tuple[int, float, np.ndarray]]:
        """Number, time [s] and positions [m] of each frame."""
        for frame, time in zip(self.frames.tolist(), self.times.tolist(), strict=True):
            yield frame, time, self.recording.position(frame)

    def column(self, name: str) -> np.ndarray:
        """The "mass" [kg] or "radius" [m] of each particle."""
        return self.entry.arrays[name]

    @functools.cached_property
    def parts(self) -> Parts:
        """Particles and features."""
        return self.recording.parts(self.entry)

    def geometry(self, shape: Shape | None) -> Geometry:
        """Faces, links and loose particles."""
        return geometry(self.parts, shape)

    def flat(self, x: np.ndarray) -> np.ndarray:
        """Positions in 3D: a plane is at z = 0."""
        out = np.zeros((len(x), 3), dtype=x.dtype)
        out[:, : x.shape[1]] = x
        return out


def stretches(recording: "Replay") -> list[Stretch]:
    """Those of a recording, in order."""
    times = dict(zip(recording.frames.tolist(), recording.times.tolist(), strict=True))
    out = []
    for entry, frames, turned in recording.scenes:
        if frames:
            out.append(Stretch(recording, entry, np.array(frames), np.array([times[k] for k in frames]), turned))
    return out


def only(recording: "Replay", path: str, what: str, others: str) -> Stretch:
    """The one stretch of a recording. what, others: why there has to be one, and which endings can do with more."""
    found = stretches(recording)
    if not found:
        raise ValueError(f"replay: {recording.path} has no frame, so there is nothing for {path}.")
    if len(found) > 1:
        raise ValueError(f"replay: the particles are not the same in all frames, so they are no {what}; export to {others}.")
    return found[0]
