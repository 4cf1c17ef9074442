"""The data that the page gets about a world: its parts when they have changed, and in every frame its positions."""

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..colliders import Box, HalfSpace
from ..constraints.core.length import is_link
from ..features.feature import Batch
from ..forces import Hand
from ..recording.bodies import rims
from ..recording.drawing import links, upwards, view_up
from ..recording.hues import BY_BODY, Coloring
from ..recording.images import box_of
from ..recording.surfaces import covered, triangles
from ..recording.walls import outline

if TYPE_CHECKING:
    from ..world import World

STEEP = 0.9  # the least cosine of the slope of a floor: 25 degrees


def scene(
    world: "World", title: str, extent: tuple[np.ndarray, np.ndarray], y_down: bool = False, coloring: Coloring = BY_BODY
) -> str:
    """Return particles, links, surfaces and the view as JSON. extent: the corners of the view [m]. y_down: see play()."""
    p = world.particles
    found = links(world)
    none = np.zeros((0, 2), dtype=np.int64)
    rest = [np.asarray(f.rest, dtype=np.float64) if is_link(f) else np.zeros(f.count) for _, f in found]
    corners, box, (edges, radius) = triangles(world), box_of(world), rims(world)
    return json.dumps({
        "kind": "scene", "title": title, "dim": p.dim, "radius": _short(p.radius),
        "pinned": (p.inv_mass == 0).astype(int).tolist(), "turns": p.orientation is not None,
        "color": coloring.colors(world).ravel().tolist(),
        "links": np.concatenate([none, *(f.indices for _, f in found)]).tolist(),
        "rest": _short(np.concatenate([np.zeros(0), *rest])), "triangles": corners.tolist(),
        "covered": covered(world, corners).astype(int).tolist(), "edges": edges.tolist(), "edge_radius": _short(radius),
        "low": _short(extent[0]), "high": _short(extent[1]),
        "up": _short(view_up(world, y_down)), "box": None if box is None else _short(box.lengths),
    })  # fmt: skip


def _short(values: np.ndarray) -> list:
    """Return numbers as f32 has them; None where they are not finite, which JSON cannot say."""
    with np.errstate(over="ignore"):
        short = np.asarray(values, dtype=np.float32).astype(np.float64)
    known = np.isfinite(short)
    if not known.all():
        short = short.astype(object)
        short[~known] = None
    return short.tolist()


def walls(world: "World", extent: tuple[np.ndarray, np.ndarray]) -> str:
    """Return outlines of walls, paths and a periodic box at their present places, as JSON. extent: see scene()."""
    out = []
    for f in world.features:
        if (shape := outline(f, *extent)) and shape.active:
            out.append({
                "strips": [_short(strip) for strip in shape.strips], "radius": float(shape.radius),
                "vertices": _short(shape.vertices.ravel()), "faces": shape.faces.tolist(),
            })  # fmt: skip
    return json.dumps({"kind": "walls", "walls": out, "floor": floor(world, extent)})


def floor(world: "World", extent: tuple[np.ndarray, np.ndarray]) -> float | None:
    """Return the height of the highest floor against gravity [m], below which no eye should get; None without one."""
    up, heights = upwards(world), []
    for f in world.features:
        if isinstance(f, HalfSpace) and f.active and f.normal @ up > STEEP:
            heights.append(float((f.outline(*extent)[0] @ up).mean()))
        elif isinstance(f, Box) and f.active:
            heights.append(float((f.outline(*extent)[0] @ up).min()))
    return max(heights, default=None)


def broken(world: "World") -> str:
    """Return the numbers of broken links, as JSON."""
    each = [f.broken if f.breaks else np.zeros(f.count, dtype=bool) for _, f in links(world)]
    return json.dumps({"kind": "broken", "links": np.flatnonzero(np.concatenate(each)).tolist()})


def message(text: str) -> str:
    """Return a message for the user, as JSON."""
    return json.dumps({"kind": "told", "text": text})


def describe_particle(world: "World", i: int) -> str:
    """Describe a particle in words."""
    p = world.particles
    i = checks.indices("play", "particle", [i], len(p))[0]
    x, v = world.position[i], world.velocity[i]
    acts = [repr(f) for f in world.features if isinstance(f, Batch) and i in f.indices and not isinstance(f, Hand)]
    vector = ", ".join(f"{c:.4g}" for c in x)
    lines = [
        f"particle {i}" + (", pinned" if p.inv_mass[i] == 0 else ""),
        f"mass {p.mass[i]:.4g} kg, radius {p.radius[i]:.4g} m" + (f", group {p.group[i]}" if p.group.any() else ""),
        f"at ({vector}) m, {np.linalg.norm(v):.4g} m/s",
    ]
    return "\n".join(lines + ([f"in {', '.join(dict.fromkeys(acts))}"] if acts else []))


def frame(world: "World", figures: dict[str, Any], places: np.ndarray, coloring: Coloring = BY_BODY) -> bytes:
    """Return a frame as bytes: the length of the JSON figures (u32, little-endian), the figures, positions in f32, and more.

    Figures that are not finite are null. places: where particles are drawn, (n, dim) [m]. Orientations follow in f32 where
    particles have them: angles in 2D [rad], quaternions (x, y, z, w) in 3D. Last are colours, (n, 3) u8, if a quantity is shown.
    """
    known = {name: v if not isinstance(v, float) or math.isfinite(v) else None for name, v in figures.items()}
    text = json.dumps(known).encode()
    text += b" " * (-len(text) % 4)
    turned = b"" if world.particles.orientation is None else world.orientation.astype("<f4").tobytes()
    with np.errstate(over="ignore"):  # positions of a diverged scene may exceed f32
        out = len(text).to_bytes(4, "little") + text + places.astype("<f4").tobytes() + turned
    return out + coloring.colors(world).tobytes() if coloring.name else out
