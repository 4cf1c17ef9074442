"""The figures of each frame as curves."""

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..constraints.core.anchored import Anchored
from ..features.feature import Batch
from ..measure import moment_sum
from ..particles.spin import moments_of_inertia
from ..step.checkpoint import Checkpoint
from ..step.step_report import StepReport

if TYPE_CHECKING:
    from ..world import World

TURNING = "angular_momentum"  # path of the rows of angular momentum
# Views of curves, by title: the last part of the path of their rows, and name, label and colour of each number in a row. Curves
# of one view share rows, since a row takes 14 bytes in addition to its numbers. See curves_of() for those that a world has.
CURVES = {
    "Worst violation": ("violation", {
        "residual": ("of constraints", [230, 120, 60]), "overlap": ("overlap [radii]", [90, 160, 230]),
    }),
    "Energy [J]": ("energy", {"energy": ("energy", [120, 200, 120])}),
    "Momentum [kg m/s]": ("momentum", {
        "momentum/x": ("x", [235, 110, 100]), "momentum/y": ("y", [130, 200, 110]), "momentum/z": ("z", [110, 150, 240]),
    }),
    "Substeps": ("substeps", {"substeps": ("substeps", [150, 160, 175])}),
    "Time per frame [ms]": ("milliseconds", {"milliseconds": ("ms", [190, 140, 220])}),
    "Angular momentum [kg m^2/s]": (TURNING, {
        "angular momentum/z": ("z", [110, 150, 240]), "angular momentum/x": ("x", [235, 110, 100]),
        "angular momentum/y": ("y", [130, 200, 110]),
    }),
}  # fmt: skip
OWN = "own"  # first part of the paths of the user's quantities
ESCAPED = re.compile(r"\\u\{([0-9A-F]{1,6})\}|\\(.)")  # a character in such a path


def own_path(name: str) -> str:
    """Return the path of the rows of a quantity of the user's, below "figures". rerun wants most characters in it escaped."""
    import rerun as rr

    return "/".join([OWN, *(rr.escape_entity_path_part(part) for part in name.split("/"))])


def own_name(path: str) -> str | None:
    """Return the name of the quantity with this path, see own_path(); None for a curve of every recording."""
    if not path.startswith(f"{OWN}/"):
        return None
    return ESCAPED.sub(lambda found: chr(int(found[1], 16)) if found[1] else found[2], path.removeprefix(f"{OWN}/"))


def curves_of(world: "World") -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the views of CURVES that a world has, of as many axes: angular momentum about the origin only if particles spin."""
    p = world.particles
    most = {TURNING: p.axes if p.spins else 0}
    some = {title: (end, dict(list(c.items())[: most.get(end, max(2, p.dim))])) for title, (end, c) in CURVES.items()}
    return {title: (end, curves) for title, (end, curves) in some.items() if curves}


def informative_views(world: "World") -> dict[str, tuple[str, list[bool]]]:
    """Return the views of curves that are informative for this scene, by title: last part of the path, and which curves to show.

    Left out are overlap without contacts, momentum where walls or pins change it, and substeps if their number is fixed.
    """
    held = bool((world.particles.inv_mass == 0).any()) or any(isinstance(f, (Collider, Anchored)) for f in world.features)
    hidden = {
        "residual": not any(isinstance(f, Batch) for f in world.features), "overlap": not world._runner.step.contacts,
        "substeps": world.settings["substeps"] != "auto", **{f"momentum/{axis}": held for axis in "xyz"},
        **{f"angular momentum/{axis}": held for axis in "xyz"},
    }  # fmt: skip
    views = curves_of(world).items()
    out = {title: (end, [not hidden.get(name, False) for name in curves]) for title, (end, curves) in views}
    return {title: (end, those) for title, (end, those) in out.items() if any(those)}


class Curves:
    """Collects the figures of frames and sends them together, which takes a fifth of the time of sending each."""

    def __init__(self, world: "World", stream: Any):
        import rerun as rr

        self._rr, self._stream = rr, stream
        self._curves = curves_of(world)
        self.read_masses(world)
        self._rows: dict[str, list[tuple[int, float, list[float]]]] = {}
        self._begun = False
        self.own: list[str] = []  # names of the user's quantities
        for title, (end, curves) in self._curves.items():
            titles, colors = zip(*curves.values(), strict=True)
            _, those = informative_views(world).get(title, (end, [False] * len(titles)))
            lines = rr.SeriesLines(names=titles, colors=colors, visible_series=those)
            stream.log(f"figures/{end}", lines, static=True, strict=True)

    def read_masses(self, world: "World") -> None:
        """Read the masses again; they change when particles are added or removed."""
        p = world.particles
        self._mass = np.where(p.inv_mass > 0, p.mass, 0.0)
        # Factors that turn r omega into I omega.
        self._lever = np.divide(moments_of_inertia(p), p.radius, out=np.zeros(len(p)), where=p.radius > 0)

    def add(self, frame: int, report: StepReport, now: Checkpoint) -> None:
        """Add the figures of a frame. Momentum is that of the displacements, half a substep ago, like energy."""
        scale = 1.0 if now.clock.d_is_velocity else 1 / now.clock.h
        momentum = scale * (self._mass @ now.values["displacement"][: len(self._mass)])
        figures = {name: getattr(report, name) for name in ("residual", "overlap", "energy", "substeps")}
        figures |= {f"momentum/{axis}": p for axis, p in zip("xyz", momentum.tolist(), strict=False)}
        if "spin" in now.values:
            figures |= self._angular(now, scale)
        if self._begun:  # the first frame also compiles the kernels, and its time would dwarf all others
            figures["milliseconds"] = report.seconds * 1e3
        self._begun = True
        for end, curves in self._curves.values():
            if values := [figures[name] for name in curves if name in figures]:
                self._rows.setdefault(end, []).append((frame, now.clock.time, values))

    def _angular(self, now: Checkpoint, scale: float) -> dict[str, float]:
        """Return the angular momentum about the origin, half a substep ago as well: m x (x_n - d) x d / h + I omega."""
        n = len(self._mass)
        d, spin = scale * now.values["displacement"][:n].astype(np.float64), scale * now.values["spin"][:n]
        total = self._lever @ spin + moment_sum(now.position(n), self._mass[:, None] * d)
        return {f"angular momentum/{axis}": float(v) for axis, v in zip("z" if len(total) == 1 else "xyz", total, strict=True)}

    def log(self, frame: int, time: float, numbers: dict[str, float]) -> None:
        """Add the user's quantities."""
        for name, value in numbers.items():
            if name not in self.own:
                self.own.append(name)
                self._stream.log(f"figures/{own_path(name)}", self._rr.SeriesLines(names=[name]), static=True, strict=True)
            self._rows.setdefault(own_path(name), []).append((frame, time, [value]))

    def send(self) -> None:
        """Log all collected figures."""
        rr = self._rr
        for end, rows in self._rows.items():
            frames, times, values = zip(*rows, strict=True)
            when = [rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("time", duration=times)]
            scalars = rr.Scalars.columns(scalars=np.concatenate(values)).partition([len(row) for row in values])
            self._stream.send_columns(f"figures/{end}", indexes=when, columns=scalars, strict=True)
        self._rows.clear()
