"""What is drawn on request: strain, loads of contacts, velocities, and a quantity of the user's as colours."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..contact import Polygons
from .curves import CURVES, SPIN
from .strain import legend

if TYPE_CHECKING:
    from ..world import World

AHEAD = 0.05  # [s] an arrow shows the path of so much time
WIDEST = 0.2  # half the width of the line of a load at the quantile COMMON, in radii
COMMON = 0.95  # quantile of the loads of a frame
LOAD, ARROW = (255, 150, 60), (240, 240, 160)
RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)  # viridis


@dataclass(frozen=True)
class Overlays:
    """What is requested of a Recorder. color: name, least and most value of a quantity of particles. y_down: see view_up()."""

    strain: bool = True
    forces: bool = False
    velocities: bool = False
    color: tuple[str, float, float] | None = None
    y_down: bool = False

    def title(self, links: bool) -> str | None:
        """Return the title of the colour scale, or None without a scale. links: whether the scene has any."""
        if self.color:
            return self.color[0]
        return "Strain of links" if links and self.strain else None

    def scale(self, links: bool) -> tuple[np.ndarray, list[str]] | None:
        """Return colours and labels of the scale, or None."""
        if self.color:
            at = np.linspace(*self.color[1:], 7)
            return ramp(at, *self.color[1:]), [f"{value:.4g}" for value in at]
        return legend() if self.title(links) else None

    @staticmethod
    def of(stored: dict[str, Any]) -> "Overlays":
        """Return the overlays stored in a recording."""
        color = stored["color"]
        return Overlays(**{**stored, "color": None if color is None else (*color,)})  # type: ignore[arg-type]


def checked_y_down(who: str, world: "World", value: Any) -> bool:
    """Check the argument `y_down`, which is for 2D."""
    if checks.flag(who, "y_down", value) and world.particles.dim == 3:
        raise ValueError(f"{who}: y_down is for worlds in 2D; in 3D the direction of gravity is down.")
    return bool(value)


def checked_color(value: Any) -> tuple[str, float, float] | None:
    """Check the argument `color` of a Recorder: None, or (name, least, most)."""
    if value is None:
        return None
    if not (isinstance(value, (tuple, list)) and len(value) == 3 and isinstance(value[0], str)):
        raise TypeError(
            f'Recorder: color = {value!r}, but a name and the numbers of both ends of the scale are needed: ("heat", 0, 1).'
        )
    low, high = (checks.number("Recorder", "color", end) for end in value[1:])
    if not low < high:
        raise ValueError(f"Recorder: color = {value!r}, but {low:g} is not less than {high:g}.")
    return value[0], low, high


def is_name(name: str) -> bool:
    """Whether a quantity may have this name, which becomes part of a path in recordings and exports."""
    return name.isprintable() and "\\" not in name and not {"", ".", ".."} & {*name.split("/")}


def checked_quantities(given: dict[str, Any], count: int) -> dict[str, Any]:
    """Check the user's quantities; return them as floats and arrays (count,) in f64."""
    taken = {name for _, curves in (CURVES | SPIN).values() for name in curves}
    out: dict[str, Any] = {}
    for name, value in given.items():
        array = np.asarray(value)
        if name in taken:
            raise ValueError(f"Recorder.log: {name} is the name of a curve of every recording; choose another.")
        if not is_name(name):
            raise ValueError(
                f"Recorder.log: {name!r} is no name of a quantity. Write words, or a path of them such as 'arm/angle'."
            )
        if array.dtype.kind not in "biuf" or array.shape not in ((), (count,)):
            raise ValueError(
                f"Recorder.log: {name} has the shape {array.shape} and the type {array.dtype}, but a number, or one for each of "
                f"the {count} particles, is needed."
            )
        out[name] = float(array) if array.ndim == 0 else array.astype(np.float64)
    return out


def ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return colours, (n, 3), of numbers (n,) between two limits; grey where they are not finite."""
    with np.errstate(invalid="ignore"):
        at = np.clip((values - low) / (high - low), 0, 1) * (len(RAMP) - 1)
    known = np.isfinite(at)
    at = np.where(known, at, 0.0)
    k = np.minimum(at.astype(np.int64), len(RAMP) - 2)
    colors = RAMP[k] + (at - k)[:, None] * (RAMP[k + 1] - RAMP[k])
    return np.where(known[:, None], np.rint(colors), 128).astype(np.uint8)


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
