"""HTML of worlds, reports, features and recordings for notebooks: a few lines, with a small picture of the scene.

The HTML loads nothing and runs no script, so it also shows in a notebook that is only read.
"""

import base64
import io
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawing import bounds, view_up
from .exports.geometry import geometry
from .exports.sketch import Look, Sketch, View
from .images import InBox
from .scene import Parts

if TYPE_CHECKING:
    from ..features.feature import Feature
    from ..step.step_report import StepReport
    from ..world import World
    from .replay import Replay

SIZE = 320  # width of a picture [pixels]


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
        image = picture(world)
    except RuntimeError:  # the world was closed
        return f"<code>{escape(repr(world))}</code>"
    return f"<div><code>{escape(repr(world))}, {world.time:.4g} s</code><br>{image}{more}</div>"


def of_replay(replay: "Replay") -> str:
    """Return the HTML of a recording: its description."""
    names = {"frames": len(replay.frames), "seconds": float(replay.times[-1]) if len(replay.times) else 0.0}
    rows = names | {"complete": replay.complete, "curves": ", ".join(replay.curves)}
    return table(rows, replay.path) + f"<p>{escape(replay.text)}</p>"


def picture(world: "World") -> str:
    """Return the present picture of a world as an image that needs no other file; "" where positions are not finite."""
    parts, corners = Parts(world.particles, world.features, tuple(range(len(world.features)))), bounds(world)
    if not np.isfinite(corners).all():
        return ""
    shape, out = geometry(parts), io.BytesIO()
    sketch = Sketch(parts, shape, View(*corners, view_up(world), Look((SIZE, None))), corners)
    sketch.frame(InBox().drawn_positions(world, world.position), shape).save(out, "PNG")
    return f"<img src='data:image/png;base64,{base64.b64encode(out.getvalue()).decode()}'>"
