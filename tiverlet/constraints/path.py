"""Beads on a wire."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..features.feature import Knob, Scene
from ..particles import Particles
from .core.anchor_passes import AnchorPasses
from .core.anchored import Anchored
from .core.curve import Curve
from .core.on_curve import OnCurve


class Path(Anchored):
    """Particles on a curve: free to slide without friction, or driven along it.

    C(x) = x - P(s), a vector across the curve. For free particles, s is where the curve meets the plane through the predicted
    position, normal to the curve at the start of the substep: the force of the wire has no component along it (SHAKE). Second
    order, and energy is conserved. Where the curve turns by more than 41 degrees in a substep, the nearest point is used instead,
    and the report has a flag. Particles stop at the ends of an open curve.

    indices: (m,) particles. points: (k, dim) [m], along the curve. closed: the last point is connected to the first.
    smooth: a cubic spline through the points, with continuous curvature; otherwise a polyline, with corners. At a corner of angle
    phi a free particle changes its speed by a factor between cos(phi) and 1 / cos(phi), by where in the substep it passes: energy
    is not conserved there, however short the substep (flag "energy-gain" once it adds up). Take smooth=True, or small angles.
    speed: number or (m,) [m/s]; driven at this speed, positive in the order of the points. Live.
    at: number or (m,) [m]; driven to this arc length, evenly during each frame in which it changes. Live. Not with `speed`.
    compliance: number or (m,) [m/N], of a soft wire; damping: number or (m,) [N s/m], across it. Free particles only.

    `length` is the length of the curve [m], `place(s)` its points, `load` the force of the wire on each particle [N].
    """

    host_only = ("_start",)

    for_users = ("length",)
    is_fixed_in_space = True
    each = ("compliance", "damping", "speed", "at")
    speed = Knob(lambda f, v: f._drive("speed", v), "Along the curve [m/s], (m,).")
    at = Knob(lambda f, v: f._drive("at", v), "Arc length at the end of the next frame [m].")

    def __init__(
        self, indices, points, *, closed: bool = False, smooth: bool = True, speed=None, at=None, compliance: ArrayLike = 0.0,
        damping: ArrayLike = 0.0,
    ):  # fmt: skip
        self.driver = "speed" if speed is not None else "at" if at is not None else ""
        self.setup(indices, compliance, damping)
        self.points = checks.points("Path", "points", points)
        self.points.flags.writeable = False
        if len(self.points) < (3 if closed else 2):
            raise ValueError(f"Path: {len(self.points)} points make no {'closed' if closed else 'open'} curve.")
        steps = np.linalg.norm(np.diff(self.points, axis=0, append=self.points[:1]), axis=1)
        if (steps[: None if closed else -1] == 0).any():
            k = int(np.argmin(steps))
            raise ValueError(f"Path: points[{k}] and the next are the same, {tuple(map(float, self.points[k]))}; leave one out.")
        self.curve = Curve(self.points, bool(closed), bool(smooth))
        if speed is not None and at is not None:
            raise ValueError("Path: speed and at exclude each other; give one of them, or none for free particles.")
        if speed is not None:
            self.speed = speed
        if at is not None:
            self.at = at

    @property
    def is_kinematic(self) -> bool:
        """Whether the particles are driven, which may add energy."""
        return bool(self.driver)

    exclusive = does_work = is_kinematic

    def _drive(self, name: str, value) -> np.ndarray:
        if name != self.driver:
            how = f"driven by {self.driver}" if self.driver else "free to slide"
            raise ValueError(f"Path: {name} cannot be set: these particles are {how}. Make a Path with {name}=... for them.")
        return checks.per_item("Path", name, value, self.count)

    def _compliance(self, value) -> np.ndarray:
        value = super()._compliance(value)
        if self.is_kinematic and (value > 0).any():
            raise ValueError("Path: driven particles take no compliance; they go along whatever pulls at them.")
        return value

    @property
    def length(self) -> float:
        """Length of the curve [m]."""
        return self.curve.length

    def place(self, s) -> np.ndarray:
        """Return the points of the curve at arc lengths s [m]."""
        return self.curve.at(s)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Find the start on the curve."""
        super().prepare(particles, inv_mass)
        checks.points("Path", "points", self.points, dim=particles.dim)
        self._start = self.curve.nearest(particles.position[self.indices[:, 0]])

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of particles that do not start on the curve."""
        x = particles.position[self.indices[:, 0]]
        off = np.linalg.norm(x - self.curve.at(self._start), axis=1)
        if not self.is_kinematic and not self.soft and (off > 1e-2 * self.length).any():
            k = int(np.argmax(off))
            at = tuple(round(float(v), 6) for v in self.curve.at(self._start[k]))
            checks.warn(
                f"Path: particle {self.indices[k, 0]} starts {off[k]:.3g} m off the curve, and is moved to {at}. Start it there."
            )

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """Return C at the start, (m, dim)."""
        return position[self.indices[:, 0]] - self.curve.at(self._start)

    def offset(self, position: np.ndarray) -> np.ndarray:
        """Return the offsets from the nearest points of the curve, (m, dim)."""
        x = position[self.indices[:, 0]]
        return x - self.curve.at(self.curve.nearest(x))

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return points along the curve, for pictures."""
        return self.curve.at(np.linspace(0, self.length * (1 - 1e-12), 4 * len(self.curve.lengths) + 1))[None], 0.0

    def place_of(self, scene: Scene, passes: AnchorPasses) -> OnCurve:
        """Make the arc length of each particle, on the device."""
        extent, moves = float(np.ptp(self.points, axis=0).max()), "speed" in self.__dict__
        target = None if not self.is_kinematic else self.speed if moves else self._start
        return OnCurve(scene, passes, self.curve, self._start, target, moves, extent)

    def upload(self) -> None:
        """Write the new speed, or the new target arc lengths."""
        super().upload()
        if self.acts and self.is_kinematic:
            self.scene.memory.write(self.dev.place.target, self.speed if self.dev.place.moves else self.at)
            self.moving = not self.dev.place.moves

    def point_along(self, velocity: np.ndarray, dt: Any, some: np.ndarray | None = None) -> None:
        """Set `velocity` (..., n, dim) of driven particles to the velocity along the curve [m/s].

        It is taken where each particle is now, at the speed of the last frame, dt [s]; 0 at the ends of an open curve. some:
        which worlds, where there are many.
        """
        place, read = self.dev.place, self.scene.memory.read
        begin, end = (read(field)[..., : self.count] for field in (place.source, place.target))
        if some is not None:
            begin, end = begin[some], end[some]
        s, speed = (begin, end) if place.moves else (end, (end - begin) / np.reshape(dt, (-1, 1) if np.ndim(dt) else ()))
        if not self.curve.closed:
            speed = np.where((s <= 0) & (speed < 0) | (s >= self.length) & (speed > 0), 0.0, speed)
        velocity[..., self.indices[:, 0], :] = speed[..., None] * self.curve.tangent(s)
