"""The walls and wires of a recording as triangles or lines, at their places in each frame."""

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...colliders.collider import Collider
from ...constraints import Path
from ...features.feature import Feature
from ..walls import EDGE, WALL, outline
from .geometry import flat

if TYPE_CHECKING:
    from .stretch import Stretch


@dataclass(frozen=True)
class Wall:
    """A wall in all frames.

    corners: (frames, v, 3) [m], all in one point where the wall is inactive. parts: corners of its triangles, (t, 3), each with
    corners of its own, or ends of its lines, (m, 2). hue: its colour, (1, 3).
    """

    name: str
    corners: np.ndarray
    parts: np.ndarray
    hue: np.ndarray

    @property
    def solid(self) -> bool:
        """Whether it is made of triangles."""
        return self.parts.shape[1] == 3

    def at(self, some: np.ndarray) -> "Wall":
        """Return it in some of the frames."""
        return replace(self, corners=self.corners[some])


def drawn_walls(stretch: "Stretch", low: np.ndarray, high: np.ndarray) -> list[Wall]:
    """Return walls and wires in each frame of a stretch, as far as they are between two corners (dim,) [m]."""
    turn, found, out = stretch.knobs_at(), defaultdict(list), []
    for frame in stretch.frames.tolist():
        turn(frame)
        for k, f in zip(stretch.parts.numbers, stretch.parts.features, strict=True):
            if isinstance(f, Collider | Path):
                found[f"{type(f).__name__} {k}"].append(_shape(f, low, high))
    for name, shown in found.items():
        corners, parts = shown[0]
        same = np.array([now if now.shape == corners.shape else corners for now, _ in shown], dtype=np.float32)
        if len(parts):
            out.append(Wall(name, flat(same), parts, WALL if parts.shape[1] == 3 else np.array([EDGE])))
    return out


def _shape(wall: Feature, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (v, dim) [m], and those of each triangle or line."""
    shape = outline(wall, low, high)
    assert shape
    if len(shape.faces):
        corners, parts = shape.vertices[shape.faces].reshape(-1, 3), np.arange(shape.faces.size).reshape(-1, 3)
    else:
        strips = np.asarray(shape.strips)
        number = np.arange(strips.shape[0] * strips.shape[1]).reshape(strips.shape[:2])
        corners, parts = strips.reshape(-1, len(low)), np.stack([number[:, :-1], number[:, 1:]], axis=-1).reshape(-1, 2)
    if not shape.active:
        corners = np.broadcast_to(corners[:1], corners.shape)
    return corners, parts
