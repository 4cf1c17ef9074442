"""The figures of each frame as curves."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..snapshot import Kept
from ..step_report import StepReport
from .layout import CURVES

if TYPE_CHECKING:
    from ..world import World


class Curves:
    """Collects the figures of frames, and sends them on together, which takes a fifth of the time of sending each."""

    def __init__(self, world: "World", stream: Any):
        import rerun as rr

        self._rr, self._stream = rr, stream
        self.weigh(world)
        self._rows: dict[str, list[tuple[int, float, float]]] = {}
        self._begun = False
        for curves in CURVES.values():
            for name, (title, color) in curves.items():
                stream.log(f"figures/{name}", rr.SeriesLines(names=[title], colors=[color]), static=True, strict=True)

    def weigh(self, world: "World") -> None:
        """Look at the masses; there may be others when particles were added or removed."""
        p = world.particles
        self._mass = np.where(p.inv_mass > 0, p.mass, 0.0)

    def add(self, frame: int, report: StepReport, now: Kept) -> None:
        """The figures of a frame. The momentum is that of the displacements, half a substep ago, as the energy is."""
        scale = 1.0 if now.clock["_fresh"] else 1 / now.clock["_h"]
        momentum = scale * (self._mass @ now.values["displacement"][: len(self._mass)])
        figures = {name: getattr(report, name) for name in ("residual", "overlap", "energy", "substeps")}
        figures |= {f"momentum/{axis}": p for axis, p in zip("xyz", momentum.tolist(), strict=False)}
        if self._begun:  # the first frame compiles the kernels, and would dwarf all others
            figures["milliseconds"] = report.seconds * 1e3
        self._begun = True
        for name, value in figures.items():
            self._rows.setdefault(name, []).append((frame, now.clock["_time"], value))

    def send(self) -> None:
        """Log what was collected."""
        rr = self._rr
        for name, rows in self._rows.items():
            frames, times, values = zip(*rows, strict=True)
            when = [rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("time", duration=times)]
            self._stream.send_columns(f"figures/{name}", indexes=when, columns=rr.Scalars.columns(scalars=values), strict=True)
        self._rows.clear()
