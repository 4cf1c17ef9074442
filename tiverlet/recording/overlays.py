"""What is drawn on request: strain, loads of contacts, velocities; and how particles are coloured."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..contact import Polygons
from .hues import BY_BODY, Coloring
from .strain import legend

if TYPE_CHECKING:
    from ..world import World

AHEAD = 0.05  # [s] an arrow shows the path of so much time
WIDEST = 0.2  # half the width of the line of a load at the quantile COMMON, in radii
COMMON = 0.95  # quantile of the loads of a frame
LOAD, ARROW = (255, 150, 60), (240, 240, 160)


@dataclass(frozen=True)
class Overlays:
    """What is requested of a Recorder. strain is shown only where particles are coloured by body. y_down: see view_up()."""

    strain: bool = True
    forces: bool = False
    velocities: bool = False
    color: Coloring = BY_BODY
    y_down: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "strain", self.strain and self.color is BY_BODY)

    @staticmethod
    def checked(who: str, color: Coloring, **flags: Any) -> "Overlays":
        """Return overlays from the arguments of a recorder, or raise TypeError."""
        return Overlays(color=color, **{name: checks.flag(who, name, value) for name, value in flags.items()})

    def title(self, links: bool) -> str | None:
        """Return the title of the colour scale, or None without a scale. links: whether the scene has any."""
        return self.color.title or ("Strain of links" if links and self.strain else None)

    def scale(self, links: bool) -> tuple[np.ndarray, list[str]] | None:
        """Return colours and labels of the scale, or None."""
        return self.color.scale() or (legend() if self.title(links) else None)

    def stored(self) -> dict[str, Any]:
        """Return the overlays as JSON."""
        return {**vars(self), "color": self.color.stored()}

    @staticmethod
    def of(stored: dict[str, Any]) -> "Overlays":
        """Return the overlays stored in a recording."""
        return Overlays(**{**stored, "color": Coloring.of(stored["color"])})


def checked_y_down(who: str, world: "World", value: Any) -> bool:
    """Check the argument `y_down`, which is for 2D."""
    if checks.flag(who, "y_down", value) and world.particles.dim == 3:
        raise ValueError(f"{who}: y_down is for worlds in 2D; in 3D the direction of gravity is down.")
    return bool(value)


def loads(world: "World", x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the loads of contacts as lines from centre to centre, (m, 3, dim), and half their widths [m].

    Widths are proportional to the loads, relative to the other loads of the frame. x: positions, (n, dim).
    """
    dim = x.shape[1]
    if not world._clock.h:
        return np.zeros((0, 3, dim)), np.zeros(0)
    found = world.contacts
    some = found.impulse > 0
    ends = x.copy()
    for f in world.features:
        if isinstance(f, Polygons):
            for loop in f.loops:
                ends[loop] = x[loop].mean(axis=0)
    a, b = (ends[found.pairs[some, k]] for k in (0, 1))
    load = found.impulse[some]
    if not len(load):
        return np.zeros((0, 3, dim)), np.zeros(0)
    point, box = found.point[some], world._runner.scene.periodic
    if box is not None:  # the images nearest to the first particle of each pair
        b, point = a - box.difference(a, b), a - box.difference(a, point)
    size = np.linalg.norm(a - point, axis=1).mean()
    return np.stack([a, point, b], axis=1), WIDEST * size * load / max(np.quantile(load, COMMON), 1e-300)
