"""Walls, wires and the edges of a periodic box, as surfaces or lines."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..colliders import Ball, Box, Capsule, Mesh, Polygon
from ..colliders.collider import Collider
from ..constraints import Path
from ..features.feature import Feature
from ..neighbours import Periodic

WALL = np.array([[92, 97, 112]], dtype=np.uint8)  # colour of surfaces
EDGE = (120, 125, 140)  # colour of lines
OPEN = (60, 63, 70)  # colour of the lines of an inactive wall
FINITE = (Ball, Capsule, Mesh, Path, Periodic, Polygon)


@dataclass(frozen=True)
class Outline:
    """A wall at its present place: a surface in 3D, otherwise lines.

    vertices, (v, 3) [m], and faces, (t, 3), of its surface. strips: lines, (m, k, dim) [m], none where it has a surface. radius:
    half their width [m]; 0 for thin lines.
    """

    vertices: np.ndarray
    faces: np.ndarray
    strips: np.ndarray
    radius: float
    active: bool


def outline(feature: Feature, low: np.ndarray, high: np.ndarray) -> Outline | None:
    """Return what a feature looks like between two corners (dim,) [m]; None for one that is no wall, wire or box."""
    if not isinstance(feature, (Collider, Path, Periodic)):
        return None
    wall = isinstance(feature, Collider)
    vertices, faces = feature.solid(low, high) if wall else (np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    strips, radius = (np.zeros((0, 2, len(low))), 0.0) if len(faces) else lines(feature, low, high)
    return Outline(vertices, faces, strips, radius, feature.active if wall else True)


def lines(feature: Collider | Path | Periodic, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the lines of a wall, (m, k, dim) [m], and half their width [m], between two corners."""
    return (feature.outline(low, high), 0.0) if isinstance(feature, Periodic) else feature.outline(low, high)


def walled(features: Iterable[Feature], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extend the box between two corners [m] by the walls, wires and boxes of finite size."""
    for f in features:
        if isinstance(f, FINITE):
            strips, radius = lines(f, low, high)
            if strips.size:
                low, high = np.minimum(low, strips.min(axis=(0, 1)) - radius), np.maximum(high, strips.max(axis=(0, 1)) + radius)
        if isinstance(f, Box):
            low = np.where(np.isfinite(f.lower), np.minimum(low, f.lower), low)
            high = np.where(np.isfinite(f.upper), np.maximum(high, f.upper), high)
    return low, high
