"""A rod with round ends."""

from types import MappingProxyType

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import inline, ti
from ..features.arguments import shifted
from ..features.feature import Knob
from ..geometry.intervals import capsule, entry, rounding
from ..geometry.nearest import closest_segment_point, surface_normal
from ..particles import Particles
from .collider import Collider
from .round_mesh import rounded
from .surface import TOUCH

SHORT = 1e-30  # square of the length of an axis that has no direction, as where both ends have moved to one place [m^2]
STEPS = 64  # most steps along a path; each at least halves what is left of one that grazes the rod


def _end(name: str) -> Knob:
    return Knob(
        lambda f, v: checks.vector("Capsule", name, v, f.dim or len(np.atleast_1d(v))), "End of the axis [m].", place=shifted
    )


class Capsule(Collider):
    """Particles stay outside of all points within `radius` of the segment from a to b: a rod, a peg, a thin wall.

    C(x) = |x - q| - (R + r) >= 0 with q the nearest point of the segment; grad C = (x - q) / |x - q|.

    a, b: (dim,) [m], live: the ends move to assigned places during the next frame. radius: R [m], above 0,
    live: it changes at once. friction, restitution, push_out, active, events, surface_velocity, one_way: see
    tiverlet/colliders/README.md.

    A particle that passes through in one substep is caught on the way in, however thin the rod. Its path relative to the rod is
    followed to where it meets the surface. No force can pull a particle through either.
    """

    code_size = 0.6
    shares_code = has_bounds = True
    tracks = MappingProxyType({"a": None, "b": None})
    a, b = _end("a"), _end("b")
    radius = Knob(lambda f, v: checks.number("Capsule", "radius", v, above=0.0), "Of the rod [m].", device="size")

    def __init__(
        self, a, b, radius, *, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float | None = None, active:
        bool | None = None, events: bool = False, surface_velocity=None, one_way=None,
    ):  # fmt: skip
        self.a, self.b = a, b
        self.radius = radius
        self.set_surface(friction, restitution, push_out, active, events, one_way, len(self.a), surface_velocity=surface_velocity)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension."""
        self._keep(dim=particles.dim)
        self.a, self.b = self.a, self.b

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the axis, as thick as the rod."""
        return np.array([[self.a, self.b]]), self.radius

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rod in 3D."""
        return rounded(self.a, self.b, self.radius) if len(self.a) == 3 else Collider.solid(self, low, high)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance to the axis, less the radius."""
        a, b = self.place_of("a"), self.place_of("b")
        return np.linalg.norm(points - closest_segment_point(points, a[None], b[None])[0], axis=1) - self.radius

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances into the rod, and the normals there."""
        a, b = (np.broadcast_to(end, origin.shape) for end in (self.place_of("a"), self.place_of("b")))
        close = rounding(origin, a, b)
        distance = entry(capsule(origin, direction, a, b, self.radius + radius), close)
        x = origin + np.where(distance < np.inf, distance, np.nan)[:, None] * direction
        return distance, surface_normal(x, closest_segment_point(x, a, b)[0], direction, b - a, close)

    @ti.func
    def nearest(self, x, a, b):
        """Return the point of the axis nearest to x, from 0 at a to 1 at b, the distance to it, and the direction from it."""
        axis = b - a
        size = axis.dot(axis)
        t = 0 * size
        if size > 0:
            t = ti.min(ti.max((x - a).dot(axis) / size, 0), 1)
        r = x - a * (1 - t) - b * t
        length, n = r.norm(), 0 * r
        n[0] = 1
        if length > 0:
            n = r / length
        return t, length, n

    @ti.func
    def along(self, x, a, b, frame_fraction):
        """Return where a point at x would be if the rod, with its ends at a and b now, carried it along in the substep."""
        t, length, n = self.nearest(x, self.dev.a.at(frame_fraction[0]), self.dev.b.at(frame_fraction[0]))
        axis = b - a
        if 0 < t < 1:
            n -= axis * (n.dot(axis) / ti.max(axis.dot(axis), SHORT))
        return a * (1 - t) + b * t + n * (length / ti.max(n.norm(), TOUCH))

    @property
    def middle(self) -> np.ndarray:
        """The middle of the axis."""
        return (self.a + self.b) / 2

    @ti.func
    def bounds(self):
        """Return the corners of the box around both ends, at the start and the end of the frame."""
        low, high = ti.min(self.dev.a.ends[0], self.dev.b.ends[0]), ti.max(self.dev.a.ends[0], self.dev.b.ends[0])
        low, high = ti.min(low, self.dev.a.ends[1], self.dev.b.ends[1]), ti.max(high, self.dev.a.ends[1], self.dev.b.ends[1])
        r = ti.cast(self.radius, self.dev.real)
        return low - r, high + r

    sides = 1  # type: ignore[assignment]
    bends = True

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the gap at the last ends, less how far these move."""
        a, b = self.dev.a.ends[1], self.dev.b.ends[1]
        x = self.dev.state.around(self.dev.state.place(i), (a + b) / 2)
        _t, length, _n = self.nearest(x, a, b)
        return length - self.reach(radius) - ti.max((a - self.dev.a.ends[0]).norm(), (b - self.dev.b.ends[0]).norm())

    @inline
    def reach(self, radius):
        """Return the distance from the axis at which a particle touches."""
        return ti.cast(self.radius, self.dev.real) + radius

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap to the rod. Beside the axis it is flat, but for the corners of the cap that end in the substep."""
        when = frame_fraction[ti.static(0 if at_start else 1)]
        a, b = self.dev.a.at(when), self.dev.b.at(when)
        x = self.dev.state.around(self.dev.state.place(i), (a + b) / 2)
        if ti.static(at_start):
            x -= self.dev.state.d[i]
        t, length, n = self.nearest(x, a, b)
        bend = 1 / ti.max(length, self.reach(radius) * TOUCH)
        if ti.static(self.dim == 2):
            bend = ti.select(0 < t < 1, 0 * length, bend)
        moved = self.dev.a.step(frame_fraction) * (1 - t) + self.dev.b.step(frame_fraction) * t
        return length - self.reach(radius), n, bend, moved

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Press the particle at the surface where it was met, or where it is nearest."""
        a, b = self.dev.a.at(frame_fraction[1]), self.dev.b.at(frame_fraction[1])
        a_moved, b_moved = self.dev.a.step(frame_fraction), self.dev.b.step(frame_fraction)
        middle, contact_distance = (a + b) / 2, self.reach(radius)
        x = self.dev.state.around(self.dev.state.place(i), middle)
        t, length, n = self.nearest(x, a, b)
        depth = contact_distance - length
        moved = a_moved * (1 - t) + b_moved * t
        d = self.dev.surface.path(i, moved)
        if (a_moved != b_moved).any():
            d = x - self.along(x - self.dev.surface.path(i, 0 * x), a, b, frame_fraction)
        way = d.norm()
        ends = abs(a).sum() + abs(b).sum()
        # Otherwise the path begins further from the rod than it is long, whatever the rounding.
        if depth + 2 * way > -TOUCH * (ends + abs(x).sum() + contact_distance):
            s, start_depth, k, going = 0 * length, 0 * length, 0, True
            # If the particle was outside, or touched, follow its path by Newton's method: the gap is convex along it, so no step
            # goes beyond the surface.
            while going:
                _t, distance, m = self.nearest(x - (1 - s) * d, a, b)
                gap = distance - contact_distance
                if k == 0:
                    start_depth = -gap
                    going = gap > -TOUCH * contact_distance and gap < way
                    if not going and gap < way:
                        going = self.dev.surface.starts_on(i, start_depth, m, depth, n, ends + way)
                if going:
                    further, closing = 0 * s + 1, -d.dot(m)
                    if closing > 0 and gap < closing * (1 - s):
                        further = s + ti.max(gap, 0) / closing
                    if k == STEPS:
                        further = s
                    k += 1
                    if not (further < 1) or further == s:  # past the end, or at the surface
                        going, depth = False, ti.min(depth, 0)
                        if further < 1:
                            n, depth = m, (s - 1) * d.dot(m)
                    s = further
            if not self.dev.surface.lets_through(i, n, start_depth, contact_distance):
                self.dev.surface.push(i, depth, start_depth, n, moved, h, mode, False)
