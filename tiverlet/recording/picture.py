"""What the viewer shows of a world, as rows of a rerun stream.

All of it follows from the world, its reports and what the journal says, so that it can be drawn again and compared.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..step.checkpoint import Checkpoint
from ..step_report import StepReport

if TYPE_CHECKING:
    from ..world import World


class Picture:
    """The scene, its figures as curves, events, and a page about it. explained: what world.explain() says. environment: what it
    was recorded with, see scene.environment().
    """

    def __init__(self, world: "World", stream: Any, explained: str, environment: dict[str, Any]):

        from .curves import Curves
        from .drawing import Drawing, bounds, upwards
        from .layout import MIRROR, SCENE, upright

        self.world, self._stream, self._explained, self._environment = world, stream, explained, environment
        self.drawing = Drawing(world, stream, bounds(world))
        self.drawing.static(SCENE, MIRROR if world.particles.dim == 2 else upright(upwards(world)))
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
        self.drawing.frame(x, x32, stirred, bool(report and report.broken))
        if report:
            self.curves.add(number, report, now)
            if report.flags - self._seen:
                self._seen |= report.flags
                self.drawing.event(" ".join(report.notes), "WARN")

    def end(self, worst: StepReport | None, frames: int, note: str) -> None:
        """The page about all frames."""
        self._about(worst, frames, note)


def layout(world: "World") -> Any:
    """How it opens in the viewer."""
    from .curves import shown
    from .drawing import bounds, links, upwards
    from .layout import blueprint

    return blueprint(*bounds(world), bool(links(world)), shown(world), upwards(world))


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
