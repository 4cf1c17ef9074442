"""The picture of a world in the viewer, as rows of a rerun stream.

Everything in it follows from the world, its reports and the journal, so that verify() can draw it again and compare.
"""

import zlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..step import checkpoint
from ..step.step_report import StepReport
from .journal import brief

if TYPE_CHECKING:
    from ..world import World
    from .overlays import Overlays

NEAR = 0.35  # walls are in view up to this share of the size of the region in which particles moved
FLOWN = 100.0  # particles beyond this multiple of the scene's size are ignored by the view


class Picture:
    """The scene, its figures as curves, events, and a page about it.

    explained: the text of world.explain(). environment: the environment of the recording, see scene.environment(). overlays: what
    is drawn on request.
    """

    def __init__(self, world: "World", stream: Any, explained: str, environment: dict[str, Any], overlays: "Overlays"):

        from .curves import Curves
        from .drawing import Drawing, bounds, upwards, view_up
        from .layout import SCENE, transform, unit, upright

        self.world, self._stream, self._explained, self._environment = world, stream, explained, environment
        self._overlays = overlays
        self.drawing = Drawing(world, stream, bounds(world), overlays)
        self._unit, dim = unit(*self.drawing.extent), world.particles.dim
        about = [transform(view_up(world, overlays.y_down), self._unit)] if dim == 2 or self._unit != 1 else []
        self.drawing.static(SCENE, *about, *([upright(upwards(world))] if dim == 3 else []))
        self.curves = Curves(world, stream)
        self._about(None, 0, "")
        self._seen: set[str] = set()  # flags reported as events already

    def _about(self, worst: StepReport | None, frames: int, note: str) -> None:
        import rerun as rr

        text = about(self.world, self._explained, self._environment, worst, frames, note)
        self.drawing.static("about", rr.TextDocument(text, media_type="text/markdown"))

    def set_world(self, world: "World") -> None:
        """Draw another world from now on; the viewer shows no difference."""
        self.world = self.drawing.world = world

    def stamp(self, number: int) -> None:
        """Set the frame of everything logged from now on."""
        self._stream.set_time("frame", sequence=number)
        self._stream.set_time("time", duration=self.world.time)

    @np.errstate(over="ignore")  # positions of a diverged simulation may exceed f32
    def frame(
        self, number: int, report: StepReport | None, scenes: int, changed_features: Iterable[int]
    ) -> tuple[dict[str, Any], np.ndarray]:
        """Draw a frame. Returns what the journal says of it, and where particles are drawn, (n, dim) [m] in f32.

        report: the worst of the steps since the last frame. scenes: the number of scenes so far. changed_features: features whose
        knobs were set since the last frame.
        """
        now = checkpoint.keep(self.world, pairs=False)
        x = self.drawing.drawn_positions(now.position(len(self.world.particles)))
        x32 = x.astype(np.float32)
        if scenes > self.drawing.scenes:
            self.curves.read_masses(self.world)
            self.drawing.begin(scenes)
        self.drawing.frame(x, x32, changed_features, bool(report and report.broken))
        if report:
            self.curves.add(number, report, now)
            if report.flags - self._seen:
                self._seen |= report.flags
                self.drawing.event(" ".join(report.notes), "WARN")
        data = {"time": self.world.time, "hash": brief(checkpoint.digest(self.world, now)), "crc": zlib.crc32(x32.tobytes())}
        broke = self.drawing.pop_broken()
        return data | ({"broke": broke} if broke else {}), x32

    def log(self, number: int, values: dict[str, Any]) -> None:
        """Add the user's quantities for the coming frame: numbers, and arrays of one number per particle, (n,)."""
        self.curves.log(number, self.world.time, {name: value for name, value in values.items() if np.ndim(value) == 0})
        self.drawing.logged |= {name: value for name, value in values.items() if np.ndim(value)}

    def layout(self) -> Any:
        """Return the layout in which the finished recording opens: the view frames the whole run."""
        extent = framed(self.drawing.extent, self.drawing.low, self.drawing.high)
        return layout(self.world, self._overlays, (extent, self._unit), self.curves.own)

    def end(self, worst: StepReport | None, frames: int, note: str) -> None:
        """Write the page about all frames."""
        self._about(worst, frames, note)


def layout(
    world: "World", overlays: "Overlays", seen: tuple[tuple[np.ndarray, np.ndarray], float] | None = None, own: Iterable[str] = ()
) -> Any:
    """Return the layout in which the viewer opens a recording.

    seen: corners of the visible region [m], and the factor of scale; None for what is known beforehand. own: names of the user's
    quantities that have curves.
    """
    from .curves import informative_views, own_path
    from .drawing import bounds, links, view_up
    from .layout import blueprint, unit

    (low, high), scale = seen or (bounds(world), unit(*bounds(world)))
    figures = {name: (own_path(name), [True]) for name in own} | informative_views(world)
    return blueprint(scale * low, scale * high, overlays.title(bool(links(world))), figures, view_up(world, overlays.y_down))


def framed(extent: tuple[np.ndarray, np.ndarray], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the view of a run: the region between `low` and `high` where particles were, and the scene near it.

    Particles that flew so far away that the rest would shrink to a speck are left out.
    """
    if not (low <= high).all():
        return extent
    size = np.maximum(extent[1] - extent[0], 1e-12).max()
    low, high = np.maximum(low, extent[0] - FLOWN * size), np.minimum(high, extent[1] + FLOWN * size)
    near = NEAR * max(float((high - low).max()), 1e-12)
    return np.minimum(low, np.maximum(extent[0], low - near)), np.maximum(high, np.minimum(extent[1], high + near))


def about(
    world: "World", explained: str, environment: dict[str, Any], worst: StepReport | None = None, frames: int = 0, note: str = ""
) -> str:
    """Return a page about the scene, and about all frames once there are some."""
    head, summary = f"# {len(world.particles)} particles in {world.particles.dim}D", []
    if worst is not None:
        summary = [
            "", f"{frames} frames, {world.time:.4g} s simulated.", "", *([note, ""] if note else []),
            "| worst of all frames | |", "|---|---|", f"| constraint violation | {worst.residual:.2e} |",
            f"| overlap | {worst.overlap:.2e} radii |", f"| contacts | {worst.contacts} |", f"| broken | {worst.broken} |",
            f"| flags | {', '.join(sorted(worst.flags)) or 'none'} |", *(f"\n{note}" for note in worst.notes),
        ]  # fmt: skip
    by = ", ".join(f"{name} {value}" for name, value in environment.items())
    return "\n".join([head, *summary, "", "```", explained, "```", "", f"Recorded with {by}."])
