"""The data that the page gets about a world: once its parts, and in every frame its positions."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..colliders.collider import Collider
from ..constraints import Path
from ..constraints.core.length import is_link
from ..features.feature import Batch
from ..forces import Hand
from ..recording.drawing import bounds, colors, links, upwards
from ..recording.images import InBox
from ..recording.surfaces import covered, triangles

if TYPE_CHECKING:
    from ..world import World


def scene(world: "World", title: str) -> str:
    """Return everything that does not change, as JSON."""
    p = world.particles
    found = links(world)
    none = np.zeros((0, 2), dtype=np.int64)
    rest = [np.asarray(f.rest, dtype=np.float64) if is_link(f) else np.zeros(f.count) for _, f in found]
    low, high = bounds(world)
    corners = triangles(world)
    return json.dumps({
        "kind": "scene", "title": title, "dim": p.dim, "radius": _short(p.radius),
        "pinned": (p.inv_mass == 0).astype(int).tolist(),
        "color": colors(world).tolist(), "links": np.concatenate([none, *(f.indices for _, f in found)]).tolist(),
        "rest": _short(np.concatenate([np.zeros(0), *rest])), "triangles": corners.tolist(),
        "covered": covered(world, corners).astype(int).tolist(), "low": _short(low),
        "high": _short(high), "up": _short(upwards(world)),
    })  # fmt: skip


def _short(values: np.ndarray) -> list:
    return np.asarray(values, dtype=np.float32).astype(np.float64).tolist()


def walls(world: "World", extent: tuple[np.ndarray, np.ndarray]) -> list[dict[str, Any]]:
    """Return outlines of walls and paths at their present places."""
    out = []
    for f in world.features:
        if isinstance(f, (Collider, Path)) and getattr(f, "active", True):
            strips, radius = f.outline(*extent)
            vertices, faces = f.solid(*extent) if isinstance(f, Collider) else (np.zeros((0, 3)), np.zeros((0, 3)))
            lines = [] if len(faces) else [_short(strip) for strip in strips]
            out.append({"strips": lines, "radius": float(radius), "vertices": _short(vertices.ravel()), "faces": faces.tolist()})
    return out


def message(text: str) -> str:
    """Return a message for the user, as JSON."""
    return json.dumps({"kind": "told", "text": text})


def placed_walls(outlines: list[dict[str, Any]]) -> str:
    """Return the result of walls() as JSON."""
    return json.dumps({"kind": "walls", "walls": outlines})


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


def frame(world: "World", figures: dict[str, Any]) -> bytes:
    """Return a frame as bytes: the length of the JSON figures (u32, little-endian), the figures, and positions in f32."""
    text = json.dumps(figures).encode()
    text += b" " * (-len(text) % 4)
    places = InBox().drawn_positions(world, world.position)
    return len(text).to_bytes(4, "little") + text + places.astype("<f4").tobytes()
