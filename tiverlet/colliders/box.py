"""A box with particles inside."""

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.arguments import shifted
from ..features.feature import Knob, Scene
from ..geometry.intervals import box, exit_of, rounding
from ..particles import Particles
from .collider import Collider


def _corner(name: str):
    def check(box: "Box", value):
        """Check one corner against the other, where that is known."""
        value = checks.vector("Box", name, value, box.dim or len(np.atleast_1d(value)), infinite=True)
        other = box.__dict__.get("upper" if name == "lower" else "lower")
        if other is not None and len(other) == len(value):
            lower, upper = (value, other) if name == "lower" else (other, value)
            narrow = upper - lower < 2 * box.widest
            if (narrow | (upper <= lower)).any():
                k = int(np.argmax(narrow | (upper <= lower)))
                raise ValueError(
                    f"Box: along axis {k} it goes from {lower[k]:g} to {upper[k]:g} m, which does not hold a particle of "
                    f"radius {box.widest:g} m. Make upper - lower at least {2 * box.widest:g} m and above 0."
                )
        return value

    return check


class Box(Collider):
    """Particles stay inside: lower + radius <= x <= upper - radius along every axis.

    C(x) = x_k - lower_k - radius >= 0 and upper_k - x_k - radius >= 0, with unit gradients along axis k.

    lower, upper: (dim,) [m]; -inf and inf leave a side open. Live: assign to .lower or .upper between frames, and the walls move
    there during the next frame (to or from an open side they jump). friction, restitution, push_out, active, events,
    surface_velocity: see tiverlet/colliders/README.md.

    One-sided: a particle cannot leave at any speed, and no force can pull it out.
    """

    inside = poses = shares_code = True
    widest = 0.0
    lower = Knob(_corner("lower"), "Lower corner [m].", place=shifted)
    upper = Knob(_corner("upper"), "Upper corner [m].", place=shifted)

    def __init__(
        self, lower, upper, *, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float | None = None, active:
        bool | None = None, events: bool = False, surface_velocity=None,
    ):  # fmt: skip
        self.lower = lower
        self.upper = upper
        self.set_surface(friction, restitution, push_out, active, events, surface_velocity=surface_velocity)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the corners against the dimension and the widest particle."""
        self._keep(dim=particles.dim)
        self._keep(widest=float(particles.radius.max(initial=0.0)))
        self.lower, self.upper = self.lower, self.upper

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of particles whose centers start outside. A box that is switched off has no inside."""
        if not self.active:
            return
        x = particles.position
        out = np.maximum(self.lower - x, x - self.upper)
        out[inv_mass == 0] = 0
        if (out > 1e-6 * particles.size).any():
            given = "" if self.push_out is None else f" = {self.push_out:g} m/s"
            (i, k), number = np.unravel_index(int(np.argmax(out)), out.shape), int((out.max(axis=1) > 0).sum())
            checks.warn(
                f"Box: particle {i} starts {out[i, k]:.3g} m outside along axis {k} ({number} such in all); "
                f"push_out{given} brings it in. Move it, or make the box larger."
            )

    @property
    def needs_repeat(self) -> bool:
        """Whether one round may not be enough: friction on one side, or a bounce, may lead into another."""
        return self.dev.surface.has_friction or self.dev.surface.has_restitution

    def bind(self, scene: Scene) -> None:
        """Declare the corners at the start and the end of a frame."""
        super().bind(scene)
        sides = np.concatenate([self.lower, self.upper])
        self.dev.sides = scene.memory.field("Box.sides", len(sides), width=2, values=np.stack([sides, sides], 1), state=True)
        self.dev.now = scene.memory.field("Box.sides_now", len(sides), width=2)  # the plane, and its motion in the substep

    def upload(self) -> None:
        """Move from the last corners to the new ones in the next frame."""
        super().upload()
        old, new = self.scene.memory.read(self.dev.sides)[:, 1], np.concatenate([self.lower, self.upper])
        jump = np.isinf(old) | np.isinf(new)
        self.scene.memory.write(self.dev.sides, np.stack([np.where(jump, new, old), new], axis=1))

    def end_motion(self) -> None:
        """Stay at the last corners."""
        sides = self.scene.memory.read(self.dev.sides)[:, 1]
        self.scene.memory.write(self.dev.sides, np.stack([sides, sides], axis=1))

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the edges of the sides. A side at infinity is open, and edges that lead to it end with the scene."""
        bits = np.array([[(c >> k) & 1 for k in range(self.dim)] for c in range(2**self.dim)])
        open_ends = np.where(bits, np.isinf(self.upper), np.isinf(self.lower))
        corners = np.where(open_ends, np.where(bits, high, low), np.where(bits, self.upper, self.lower))
        beside = [(a, b, int(np.argmax(bits[a] != bits[b]))) for a in range(len(bits)) for b in range(a)]
        edges = [
            (a, b) for a, b, k in beside
            if np.abs(bits[a] - bits[b]).sum() == 1 and open_ends[a, np.arange(self.dim) != k].sum() < 1
        ]  # fmt: skip
        if not edges:
            return Collider.outline(self, low, high)
        return corners[np.array(edges)], 0.0

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance to the nearest side; outside, minus the distance to the nearest point of the box."""
        lower, upper = self._corners
        off = np.maximum(np.maximum(lower - points, points - upper), 0.0)
        within = np.minimum(points - lower, upper - points).min(axis=1)
        return np.where((off > 0).any(axis=1), -np.linalg.norm(off, axis=1), within)

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances out of the box, and the normals of the sides that are met first."""
        lower, upper = self._corners
        lower, upper = lower + radius, upper - radius
        finite = (np.where(np.isfinite(side), side, 0.0)[None] for side in (lower, upper))
        close = rounding(origin, *finite)
        distance = exit_of(box(origin, direction, lower, upper, close), close)
        with np.errstate(invalid="ignore", divide="ignore"):
            sides = np.where(direction > 0, upper - origin, lower - origin) / direction
        first = np.where(direction == 0, np.inf, sides).argmin(axis=1)
        normal = np.zeros(origin.shape)
        rows = np.arange(len(origin))
        normal[rows, first] = -np.sign(direction[rows, first])
        return distance, normal

    @property
    def _corners(self) -> tuple[np.ndarray, np.ndarray]:
        """The present lower and upper corners [m]."""
        if self.scene is None:
            return self.lower, self.upper
        sides = self.scene.memory.read(self.dev.sides)[:, 1].astype(np.float64)
        return sides[: self.dim], sides[self.dim :]

    @ti.func
    def pose(self, frame_fraction):
        """Compute the planes of this substep. A resting plane keeps its position bit for bit, also at infinity."""
        for side in range(ti.static(2 * self.dim)):
            a, b = self.dev.sides[side][0], self.dev.sides[side][1]
            at, shift = b, ti.zero(b)
            if a != b:
                at, shift = a * (1 - frame_fraction[1]) + b * frame_fraction[1], (b - a) * (frame_fraction[1] - frame_fraction[0])
            self.dev.now[side] = ti.Vector([at, shift])

    @property
    def sides(self) -> int:
        """Two for each axis."""
        return 2 * self.dim

    @ti.func
    def side(self, face):
        """Return the axis of a side, and the sign of its normal."""
        upper = face >= self.dim
        return ti.select(upper, face - self.dim, face), ti.select(upper, -1, 1)

    @ti.func
    def height(self, axis, sign, x, plane):
        """Return how far x is inside of a plane across an axis."""
        out = ti.zero(plane)
        for k in ti.static(range(self.dim)):
            if k == axis:
                out = sign * (x[k] - plane)
        return out

    @ti.func
    def normal(self, axis, sign):
        """Return the normal of a side."""
        n = ti.Vector.zero(self.dev.real, self.dim)
        for k in ti.static(range(self.dim)):
            if k == axis:
                n[k] = sign
        return n

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the gap at the inner one of the planes between which the side moves."""
        axis, sign = self.side(face)
        a, b, x = self.dev.sides[face][0], self.dev.sides[face][1], self.dev.state.place(i)
        return ti.min(self.height(axis, sign, x, a), self.height(axis, sign, x, b)) - radius

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap to a side."""
        axis, sign = self.side(face)
        n, now = self.normal(axis, sign), self.dev.now[face]
        gap = self.height(axis, sign, self.dev.state.place(i), now[0])
        if ti.static(at_start):
            gap = gap - n.dot(self.dev.state.d[i]) + sign * now[1]
        return gap - radius, n, 0 * gap, now[1] * sign * n

    @ti.func
    def may_touch(self, i, radius):
        """Return 1 if push() may have something to do, else 0."""
        out, x, close = 0, self.dev.state.place(i), self.dev.state.digits(i)
        for k in ti.static(range(self.dim)):
            out |= ti.cast(self.dev.now[k][0] + radius - x[k] > -close, ti.i32)
            out |= ti.cast(x[k] + radius - self.dev.now[k + self.dim][0] > -close, ti.i32)
        return out

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Press the particle at two planes per axis, lower ones first."""
        if self.may_touch(i, radius) != 0:
            for side in range(ti.static(2 * self.dim)):
                axis, sign = self.side(side)
                wall, x = self.dev.now[side][0], self.dev.state.place(i)
                n, depth = self.normal(axis, sign), ti.zero(wall)
                moved = self.dev.now[side][1] * abs(n)
                for k in ti.static(range(self.dim)):
                    if k == axis:
                        depth = ti.select(sign > 0, wall + radius - x[k], x[k] + radius - wall)
                self.dev.surface.push(i, depth, depth + self.dev.surface.path(i, moved).dot(n), n, moved, h, mode, False)
