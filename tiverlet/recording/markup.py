"""HTML of worlds, reports, features and recordings for notebooks: a few lines, with a small picture of the scene.

The HTML loads nothing and runs no script, so it also shows in a notebook that is only read.
"""

from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..constraints import Path
from .drawing import bounds, links, upwards
from .hues import by_body
from .images import InBox
from .layout import eye_axes
from .rims import rims

if TYPE_CHECKING:
    from ..features.feature import Feature
    from ..step.step_report import StepReport
    from ..world import World
    from .replay import Replay

MANY = 800  # most particles drawn; of more, an even selection
SIZE = 280  # pixels of the longer side of a picture
GREY = "#8a8f9c"  # visible on black and on white


def table(rows: Mapping[str, Any], title: str = "") -> str:
    """Return names and values as rows of a table."""
    head = f"<caption style='text-align:left;font-weight:bold'>{escape(title)}</caption>" if title else ""
    cells = "".join(
        f"<tr><td style='text-align:left'>{escape(name)}</td><td style='text-align:left'>{escape(short_text(value))}</td></tr>"
        for name, value in rows.items()
    )
    return f"<table>{head}{cells}</table>"


def short_text(value: Any) -> str:
    """Return a value in a few words; for a large array its shape and range."""
    if isinstance(value, np.ndarray) and value.size > 8:
        ends = f", {np.nanmin(value):.4g} ... {np.nanmax(value):.4g}" if value.dtype.kind in "biuf" else ""
        return f"array {value.shape}{ends}"
    if isinstance(value, (list, tuple)) and len(value) > 8:
        return f"{len(value)} of {type(value[0]).__name__}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def of_report(report: "StepReport") -> str:
    """Return the HTML of a report: its figures, and each flag with its note."""
    names = ("time", "substeps", "iterations", "residual", "overlap", "contacts", "energy", "energy_change", "broken", "tries")
    notes = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    flags = ", ".join(sorted(report.flags)) or "none"
    return table({name: getattr(report, name) for name in names} | {"flags": flags}, "StepReport") + (
        f"<ul>{notes}</ul>" if notes else ""
    )


def of_feature(feature: "Feature") -> str:
    """Return the HTML of a feature: the arguments that it was made with."""
    return table({name: value for name, value in feature.arguments.items() if value is not None}, repr(feature))


def of_world(world: "World") -> str:
    """Return the HTML of a world: its picture, and the text of explain(), folded."""
    try:
        more = f"<details><summary>explain()</summary><pre>{escape(world.explain())}</pre></details>"
        image = picture(world, InBox().drawn_positions(world, world.position))
    except RuntimeError:  # the world was closed
        return f"<code>{escape(repr(world))}</code>"
    return f"<div><code>{escape(repr(world))}, {world.time:.4g} s</code><br>{image}{more}</div>"


def of_replay(replay: "Replay") -> str:
    """Return the HTML of a recording: its description."""
    names = {"frames": len(replay.frames), "seconds": float(replay.times[-1]) if len(replay.times) else 0.0}
    rows = names | {"complete": replay.complete, "curves": ", ".join(replay.curves)}
    return table(rows, replay.path) + f"<p>{escape(replay.text)}</p>"


def picture(world: "World", x: np.ndarray) -> str:
    """Return particles at x (n, dim), links, walls and paths as SVG; a 3D scene is seen from the front and a little above."""
    low, high = bounds(world)
    view = np.eye(2) if len(low) == 2 else eye_axes(upwards(world))
    some = np.arange(0, len(x), -(-len(x) // MANY) or 1)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, len(low)) @ view.T
    left, top = corners.min(axis=0)[:2]
    wide, tall = np.maximum(corners.max(axis=0)[:2] - corners.min(axis=0)[:2], 1e-12)
    scale = SIZE / max(wide, tall)

    def place(points: np.ndarray) -> np.ndarray:
        """Return pixels."""
        flat = (points @ view.T)[..., :2]
        return np.stack([(flat[..., 0] - left) * scale, (tall - flat[..., 1] + top) * scale], axis=-1) + 2

    parts = []
    for f in world.features:
        if isinstance(f, (Collider, Path)):
            strips, radius = f.outline(low, high)
            parts += [_line(strip, GREY, max(1.0, 2 * radius * scale)) for strip in place(strips)] if strips.size else []
    ends = np.concatenate([np.zeros((0, 2), dtype=np.int64), *(f.indices for _, f in links(world))])
    parts += [_line(pair, GREY, 1.0) for pair in place(x[ends[:: -(-len(ends) // MANY) or 1]])]
    hues, (edges, thick) = by_body(world), rims(world)
    parts += [_line(pair, _hex(hues[i]), 2 * r * scale) for pair, i, r in zip(place(x[edges]), edges[:, 0], thick, strict=True)]
    depth = (x @ view.T)[:, 2] if x.shape[1] == 3 else np.zeros(len(x))
    radii = np.maximum(world.particles.radius * scale, 1.2)
    for i in some[np.argsort(depth[some], kind="stable")]:
        a, b = place(x[i])
        parts.append(f"<circle cx='{a:.1f}' cy='{b:.1f}' r='{radii[i]:.1f}' fill='{_hex(hues[i])}'/>")
    size = f"width='{wide * scale + 4:.0f}' height='{tall * scale + 4:.0f}'"
    return f"<svg xmlns='http://www.w3.org/2000/svg' {size}>{''.join(parts)}</svg>"


def _hex(hue: np.ndarray) -> str:
    return "#" + bytes(hue.tolist()).hex()


def _line(points: np.ndarray, color: str, width: float) -> str:
    at = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
    return f"<polyline points='{at}' fill='none' stroke='{color}' stroke-width='{width:.1f}'/>"
