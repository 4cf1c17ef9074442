"""What the viewer shows of a world, as rows of a rerun stream.

All of it follows from the world, its reports and what the journal says, so that it can be drawn again and compared.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..step.checkpoint import Checkpoint
from ..step.step_report import StepReport
from .overlays import Overlays

if TYPE_CHECKING:
    from ..world import World

NEAR = 0.35  # of the size of what moved: how far around it the view goes where there are walls
FLOWN = 100.0  # times the size of the scene: what went further is not looked for


class Picture:
    """The scene, its figures as curves, events, and a page about it. explained: what world.explain() says. environment: what it
    was recorded with, see scene.environment(). overlays: what is drawn on request.
    """

    def __init__(self, world: "World", stream: Any, explained: str, environment: dict[str, Any], overlays: Overlays):

        from .curves import Curves
        from .drawing import Drawing, bounds, upwards
        from .layout import SCENE, transform, unit, upright

        self.world, self._stream, self._explained, self._environment = world, stream, explained, environment
        self._overlays = overlays
        self.drawing = Drawing(world, stream, bounds(world), overlays)
        self._low, self._high = np.full((2, world.particles.dim), [[np.inf], [-np.inf]])  # of all that was drawn
        self._unit, dim = unit(*self.drawing.extent), world.particles.dim
        about = [transform(dim, self._unit)] if dim == 2 or self._unit != 1 else []
        self.drawing.static(SCENE, *about, *([upright(upwards(world))] if dim == 3 else []))
        self.curves = Curves(world, stream)
        self._about(None, 0, "")
        self._seen: set[str] = set()  # flags

    def _about(self, worst: StepReport | None, frames: int, note: str) -> None:
        import rerun as rr

        text = about(self.world, self._explained, self._environment, worst, frames, note)
        self.drawing.static("about", rr.TextDocument(text, media_type="text/markdown"))

    def follow(self, world: "World") -> None:
        """Draw another world from now on, which is the same to the viewer."""
        self.world = self.drawing.world = world

    def stamp(self, number: int) -> None:
        """What is logged from now on belongs to this frame."""
        self._stream.set_time("frame", sequence=number)
        self._stream.set_time("time", duration=self.world.time)

    def frame(
        self, number: int, now: Checkpoint, x: np.ndarray, x32: np.ndarray, report: StepReport | None, scenes: int,
        stirred: Iterable[int],
    ) -> None:  # fmt: skip
        """Draw a frame. now: its state. x, x32: positions, (n, dim), and rounded to f32. report: the worst of the steps since the
        last one. scenes: how many there were. stirred: features that were turned since the last frame.
        """
        if scenes > self.drawing.scenes:
            self.curves.weigh(self.world)
            self.drawing.begin()
        self._frame_all(x)
        self.drawing.frame(x, x32, stirred, bool(report and report.broken))
        if report:
            self.curves.add(number, report, now)
            if report.flags - self._seen:
                self._seen |= report.flags
                self.drawing.event(" ".join(report.notes), "WARN")

    def log(self, number: int, values: dict[str, Any]) -> None:
        """Quantities of the user's, for the coming frame: numbers, and arrays of one for each particle, (n,)."""
        self.curves.log(number, self.world.time, {name: value for name, value in values.items() if np.ndim(value) == 0})
        color = self._overlays.color
        if color and np.ndim(values.get(color[0], 0.0)):
            self.drawing.color(values[color[0]])

    def _frame_all(self, x: np.ndarray) -> None:
        """Remember where particles are, for layout()."""
        radius = self.world.particles.radius[:, None]
        some = np.isfinite(x).all(axis=1)
        if some.any():
            self._low = np.minimum(self._low, (x - radius)[some].min(axis=0))
            self._high = np.maximum(self._high, (x + radius)[some].max(axis=0))

    def layout(self) -> Any:
        """How the recording opens, once all of it is known: the view frames the whole run."""
        extent = framed(self.drawing.extent, self._low, self._high)
        return layout(self.world, self._overlays, (extent, self._unit), self.curves.own)

    def end(self, worst: StepReport | None, frames: int, note: str) -> None:
        """The page about all frames."""
        self._about(worst, frames, note)


def layout(
    world: "World", overlays: Overlays, seen: tuple[tuple[np.ndarray, np.ndarray], float] | None = None, own: Iterable[str] = ()
) -> Any:
    """How it opens in the viewer. seen: the corners of what is to be seen [m], and how many times its size; None for what is
    known beforehand. own: quantities of the user's that have curves.
    """
    from .curves import OWN, shown
    from .drawing import bounds, links, upwards
    from .layout import blueprint, unit

    (low, high), scale = seen or (bounds(world), unit(*bounds(world)))
    figures = {name: (f"{OWN}/{name}", [True]) for name in own} | shown(world)
    return blueprint(scale * low, scale * high, overlays.title(bool(links(world))), figures, upwards(world))


def framed(extent: tuple[np.ndarray, np.ndarray], low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The corners of the view of a run whose particles were between `low` and `high`: these, and what of the scene is near.

    What flew out so far that the rest would be a speck is left out.
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
    """A page about the scene, and about all frames once there are some."""
    rows = [
        f"# {len(world.particles)} particles in {world.particles.dim}D",
        "",
        "```",
        explained,
        "```",
        "",
        f"Recorded with {', '.join(f'{name} {value}' for name, value in environment.items())}.",
    ]
    if worst is not None:
        rows[1:1] = [
            "", f"{frames} frames, {world.time:.4g} s simulated.", "", *([note, ""] if note else []),
            "| worst of all frames | |", "|---|---|", f"| constraint violation | {worst.residual:.2e} |",
            f"| overlap | {worst.overlap:.2e} radii |", f"| contacts | {worst.contacts} |", f"| broken | {worst.broken} |",
            f"| flags | {', '.join(sorted(worst.flags)) or 'none'} |", *(f"\n{note}" for note in worst.notes),
        ]  # fmt: skip
    return "\n".join(rows)
