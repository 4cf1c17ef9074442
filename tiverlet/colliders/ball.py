"""A ball with particles outside, or inside."""

from types import MappingProxyType

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import inline, ti
from ..features.arguments import shifted
from ..features.feature import Knob
from ..geometry.intervals import ball, entry, exit_of, rounding
from ..geometry.nearest import surface_normal
from ..particles import Particles
from .collider import Collider
from .round_mesh import rounded
from .surface import ALONG, FRICTIONLESS, NEAR, TOUCH


class Ball(Collider):
    """Particles stay outside of a disc or ball, or inside.

    C(x) = |x - center| - (R + r) >= 0 outside, R - r - |x - center| >= 0 inside; grad C = +- (x - center) / |x - center|.

    center: (dim,) [m], live: assign to it between frames, and the ball moves there during the next frame. radius: R [m], live: it
    changes at once, and particles that are then inside move out at push_out. inside: keep particles in. friction, restitution,
    push_out, active, events, surface_velocity: see tiverlet/colliders/README.md.

    A particle that passes through in one substep is caught on the way in: the time when it met the surface is solved for, as for
    pairs. Nothing passes at any speed, and no force can pull a particle through.
    A particle that slides inside without restitution is pushed along n at the start of the substep until C(x) = 0 at its end, as
    a rigid link is (SHAKE): it is second order in the substep and conserves energy. With restitution, and outside, it is pushed
    along n where it is nearest or was met: first order, and it loses speed.
    """

    center = Knob(
        lambda f, v: checks.vector("Ball", "center", v, f.dim or len(np.atleast_1d(v))), "Middle of the ball [m].", place=shifted
    )

    shares_code = True
    tracks = MappingProxyType({"center": None})
    radius = Knob(lambda f, v: f._size(v), "Of the ball [m].", device="size")
    widest = 0.0  # radius of a particle [m]

    def __init__(
        self, center, radius, inside: bool = False, *, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float
        | None = None, active: bool | None = None, events: bool = False, surface_velocity=None,
    ):  # fmt: skip
        self.center = center
        self.inside = bool(inside)
        self.radius = radius
        self.set_surface(friction, restitution, push_out, active, events, surface_velocity=surface_velocity)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension, and that particles fit in."""
        self._keep(dim=particles.dim)
        self.center = self.center
        wide = particles.radius >= self.radius
        if self.inside and wide.any():
            i = int(np.argmax(wide))
            raise ValueError(f"Ball: particle {i} of radius {particles.radius[i]:g} m does not fit inside {self.radius:g} m.")
        self._keep(widest=float(particles.radius.max(initial=0.0)))

    def _size(self, value) -> float:
        value = checks.number("Ball", "radius", value, above=0.0)
        if self.inside and value <= self.widest:
            raise ValueError(f"Ball: radius = {value:g}, but a particle of radius {self.widest:g} m does not fit inside.")
        return value

    @property
    def needs_repeat(self) -> bool:
        """Whether one round may not be enough: inside, motion along the surface or a bounce may lead to the other end."""
        return self.inside and (self.dev.surface.has_friction or self.dev.surface.has_restitution)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return a circle in 2D, three circles in 3D."""
        turn = np.linspace(0, 2 * np.pi, 65)
        circles = []
        for a in range(self.dim):
            for b in range(a):
                circle = np.tile(self.center, (len(turn), 1))
                circle[:, a] += self.radius * np.cos(turn)
                circle[:, b] += self.radius * np.sin(turn)
                circles.append(circle)
        return np.array(circles), 0.0

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the ball, unless the scene is inside of it."""
        if self.dim != 3 or self.inside:
            return Collider.solid(self, low, high)
        return rounded(self.center, self.center, self.radius)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return |x - center| - R outside, the opposite inside."""
        gap = np.linalg.norm(points - self.place_of("center"), axis=1) - self.radius
        return -gap if self.inside else gap

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances into the ball, or out of it, and the normals there."""
        center = self.place_of("center")
        way = ball(origin, direction, center, self.radius + (-radius if self.inside else radius))
        close = rounding(origin, center[None])
        distance = exit_of(way, close) if self.inside else entry(way, close)
        r = origin + np.where(distance < np.inf, distance, np.nan)[:, None] * direction - center
        return distance, surface_normal(-r if self.inside else r, np.zeros_like(r), direction, np.zeros_like(r), close)

    @property
    def has_bounds(self) -> bool:
        """Whether particles are outside."""
        return not self.inside

    @property
    def middle(self) -> np.ndarray:
        """The center."""
        return self.center

    @ti.func
    def bounds(self):
        """Return the corners of the box around the ball at the start and the end of the frame."""
        a, b, r = self.dev.center.ends[0], self.dev.center.ends[1], self.own()
        return ti.min(a, b) - r, ti.max(a, b) + r

    sides = 1  # type: ignore[assignment]
    bends = True

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the gap at the last center, less how far it moves."""
        depth, _n = self.nearest(self.dev.state.nearest(self.dev.state.place(i) - self.dev.center.ends[1]), radius)
        return -depth - (self.dev.center.ends[1] - self.dev.center.ends[0]).norm()

    @inline
    def own(self):
        """Return the radius of the ball."""
        return ti.cast(self.radius, self.dev.real)

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap to the ball."""
        r = self.dev.state.nearest(self.dev.state.place(i) - self.dev.center.at(frame_fraction[ti.static(0 if at_start else 1)]))
        if ti.static(at_start):
            r -= self.dev.state.d[i]
        depth, n = self.nearest(r, radius)
        bend = ti.static(-1 if self.inside else 1) / ti.max(r.norm(), self.own() * TOUCH)
        return -depth, n, bend, self.dev.center.step(frame_fraction)

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Press the particle where it met the surface or is nearest; one that slides inside, along the normal at its start."""
        center, moved = self.dev.center.at(frame_fraction[1]), self.dev.center.step(frame_fraction)
        r = self.dev.state.nearest(self.dev.state.place(i) - center)
        own = self.own()
        depth, n = self.nearest(r, radius)
        d = self.dev.surface.path(i, moved)
        start = r - d
        slides = False
        start_depth, first = self.nearest(start, radius)
        if ti.static(not self.inside):
            contact_distance = own + radius
            c, b, a = start.dot(start) - contact_distance * contact_distance, start.dot(d), d.dot(d)
            root = b * b - a * c
            outside = c > -TOUCH * contact_distance * contact_distance
            if (outside or self.dev.surface.starts_on(i, start_depth, first, depth, n, d.norm())) and b < 0 and root > 0:
                s = ti.max(c, 0) / (ti.sqrt(root) - b)
                if s < 1:
                    n = (start + s * d).normalized()
                    depth = (s - 1) * d.dot(n)
        elif ti.static(not self.dev.surface.has_restitution):
            # A slide: the particle lay on the surface, which turns little along its displacement.
            close = self.dev.state.digits(i)
            bounced, _lift = self.dev.surface.bounced(i)
            near = d.norm() * ti.static(NEAR) + 4 * close
            if mode != FRICTIONLESS and depth > -close and ti.abs(start_depth) <= near and not bounced:
                along, reach = r.dot(first), own - radius
                root = along * along - (r.dot(r) - reach * reach)
                if along < 0 and root > ti.static(ALONG * ALONG) * reach * reach:
                    depth, n = (r.dot(r) - reach * reach) / (ti.sqrt(root) - along), first
                    slides = True
        self.dev.surface.push(i, depth, start_depth, n, moved, h, mode, slides)

    @ti.func
    def nearest(self, r, radius):
        """Return depth in the surface and its normal at r from the center; a particle at the center moves along +x."""
        length, n = r.norm(), 0 * r
        n[0] = 1
        if length > 0:
            n = r / length
        depth = self.own() + radius - length
        if ti.static(self.inside):
            depth, n = length + radius - self.own(), -n
        return depth, n
