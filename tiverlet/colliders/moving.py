"""Colliders of any shape that are moved and turned as a whole."""

from types import MappingProxyType
from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.arguments import shifted
from ..features.feature import Knob, Scene
from ..particles import Particles
from .collider import Collider
from .facets import Facets
from .pose import Pose, rotation_matrix
from .surface import ANY_DEPTH

TOUCHES = 8  # of one particle in one substep; after these it stays at the last place known to be free


def _position(wall: "Moving", value):
    if np.ndim(value) == 0 and not np.any(value):
        return np.zeros(wall.dim) if wall.dim else 0.0
    return checks.vector(repr(wall), "position", value, wall.dim or len(np.atleast_1d(value)))


def _rotation(wall: "Moving", value):
    if wall.dim == 2 or (wall.dim == 0 and np.ndim(value) == 0):
        return checks.number(repr(wall), "rotation", value)
    if np.ndim(value) == 0 and not np.any(value):
        return np.zeros(3)
    return checks.vector(repr(wall), "rotation", value, 3)


class Moving(Collider):
    """A collider that is described in a frame of its own: its point p is at position + R p in the world.

    position: (dim,) [m]. rotation: an angle [rad] in 2D, counterclockwise; a rotation vector, axis times angle [rad], in 3D. Both
    are live: assign between frames, and the wall moves there during the next frame, linearly from the old value to the new. About
    a fixed axis that is a constant angular velocity, for any number of turns. Friction and restitution use the velocity of the
    wall at the contact point.

    It is made of `facets`, or a subclass gives it another shape in its own frame (host_shape). A particle is followed in the
    wall's frame, along the straight line from where it was at the start of the substep. shape.find_first_touch() finds the first
    touch, surface.push() corrects it, and then the rest of the way is followed. So nothing passes, at any speed of either, and
    corners need no special case. Where a particle still moves in after TOUCHES touches (in a wedge), it stays at the last one.
    """

    code_size = 1.5
    facets: Facets
    needs_start_position = poses = bends = True
    tracks = MappingProxyType({"position": None, "rotation": ti.f64})
    radius: Any = Knob(
        lambda f, v: checks.number(repr(f), "radius", v, least=0.0), "Rounded by so much [m].", built=True, device="thickness"
    )
    position = Knob(_position, "Where the origin of the wall's frame is [m].", place=shifted)
    rotation = Knob(_rotation, "Angle (2D) or rotation vector (3D) [rad].")

    def set_sides(self, closed: bool, inside: bool, open_shape: str) -> None:
        """Check and store on which sides of facets particles are. open_shape: what the wall is called where it is not closed."""
        self.closed, self.inside = bool(closed), bool(inside)
        if self.inside and not self.closed:
            raise ValueError(f"{self!r}: inside = True needs an inside; {open_shape} (closed = False) has none.")

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension, and refuse points at an open wall without thickness: a point on it would have no side."""
        if self.dim and self.dim != particles.dim:
            raise ValueError(f"{self!r}: it is a wall for {self.dim}D, but the particles are in {particles.dim}D.")
        self._keep(dim=particles.dim)
        self.position, self.rotation = self.position, self.rotation
        points = particles.radius + self.radius == 0
        if not self.closed and points.any():
            raise ValueError(
                f"{self!r}: particle {int(np.argmax(points))} has radius 0, and so has the open wall, so nothing tells on which "
                "side of it the particle is. Give one of them a radius."
            )

    def bind(self, scene: Scene) -> None:
        """Declare the pose in the current substep, and the shape."""
        super().bind(scene)
        self.dev.pose = Pose(scene, repr(self), self.dev.position, self.dev.rotation, self.dev.surface.turns)
        self.dev.surface.poses = [self.dev.pose]
        self.dev.shape = self.host_shape(self.dim).on_device(scene, repr(self), self.radius)
        self.dev.shape.can_slide = type(self.dev.shape).can_slide and not self.dev.surface.has_restitution

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Return points (..., dim) of the wall's frame in the world, for pictures."""
        return points @ rotation_matrix(self.rotation).T + self.position

    def current_pose(self, dim: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the present position (dim,) [m] and rotation matrix; outside of a world, for `dim` dimensions."""
        rotation = self.place_of("rotation")
        return self.place_of("position"), rotation_matrix(rotation) if rotation.any() else np.eye(dim)

    def host_shape(self, dim: int) -> Any:
        """Return the shape in its own frame, outside of a world for `dim` dimensions: the facets, or what a subclass has.

        It has clearance() and cast() as a Collider has, and on_device(scene, who, radius), the Shape for kernels. who: the name
        of the wall. radius: by what the shape is thickened [m].
        """
        return self.facets

    @property
    def normals(self) -> np.ndarray:
        """Outward unit normals of the facets, (m, dim)."""
        return self.facets.normals

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the clearance of the shape, less `radius`."""
        position, turn = self.current_pose(points.shape[1])
        return self.host_shape(points.shape[1]).clearance((points - position) @ turn) - self.radius

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the lengths and normals of the shape, cast in its frame."""
        position, turn = self.current_pose(origin.shape[1])
        shape = self.host_shape(origin.shape[1])
        distance, normal = shape.cast((origin - position) @ turn, direction @ turn, self.radius + radius)
        return distance, normal @ turn.T

    @property
    def has_bounds(self) -> bool:
        """Whether the solid is not all around."""
        return not (self.closed and self.inside)

    @property
    def middle(self) -> np.ndarray:
        """Where the middle of the box around the facets is."""
        return self.placed((self.facets.corners.min(axis=(0, 1)) + self.facets.corners.max(axis=(0, 1))) / 2)

    @ti.func
    def bounds(self):
        """Return the corners of a box around the shape, wherever it is and however it turns in the frame."""
        return self.dev.pose.bounds(*self.dev.shape.box(), ti.cast(self.radius, self.dev.real))

    @property
    def sides(self) -> int:
        """The number of facets."""
        return len(self.facets.corners)

    @ti.func
    def near_sides(self, i, reach):
        """Return the list of facets around particle i."""
        q = self.dev.pose.inward_at_end(self.dev.state.inside(self.dev.state.place(i)))
        return self.dev.shape.facets_near(q, reach + ti.cast(self.radius, self.dev.real) + self.motion())

    @ti.func
    def side_at(self, place):
        """Return the facet at a place of the lists."""
        return self.dev.shape.list[place]

    @ti.func
    def motion(self):
        """Return how far any point of the wall moves in the frame at most [m]."""
        low, high = self.dev.shape.box()
        return self.dev.pose.motion(ti.max(abs(low), abs(high)).norm())  # type: ignore[reportOptionalCall]

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the distance from a facet at the end of the frame, less how far the wall moves."""
        q = self.dev.pose.inward_at_end(self.dev.state.inside(self.dev.state.place(i)))
        distance, _n, _at = self.dev.shape.nearest(face, q)
        return distance - ti.cast(self.radius, self.dev.real) - radius - self.motion()

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap to a facet."""
        x, when = self.dev.state.place(i), ti.static(0 if at_start else 1)
        if ti.static(at_start):
            x -= self.dev.state.d[i]
        q = self.dev.pose.inward(when, self.dev.state.inside(x) - self.dev.pose.place[when])
        moved, e = self.dev.pose.place[2] + self.dev.pose.outward(2, q), 0 * q
        if ti.static(at_start):
            e = self.dev.pose.inward(0, self.dev.state.d[i] - moved)
        gap, n, bend = self.dev.shape.facet_gap(face, q, e, ti.cast(self.radius, self.dev.real) + radius, at_start)
        return gap, self.dev.pose.outward(when, n), bend, moved

    @ti.func
    def in_frame_of_one_way(self, n):
        """Return a normal in the frame of the wall."""
        return self.dev.pose.inward(0, n)

    @ti.func
    def pose(self, frame_fraction):
        """Compute the pose of the wall in a substep."""
        self.dev.pose.update(frame_fraction)

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Follow the displacement of particle i touch by touch, relative to the wall under its start: what sticks rides along."""
        start, contact_distance = self.dev.state.inside(self.dev.state.begin(i)), radius + ti.cast(self.radius, self.dev.real)
        first = self.dev.pose.inward(0, start - self.dev.pose.place[0])
        moved = self.dev.pose.place[2] + self.dev.pose.outward(2, first)
        e = self.dev.pose.inward(1, self.dev.state.d[i] - moved)
        close, lifted = ti.max(self.dev.state.digits(i), self.dev.shape.rounding(first)), False
        if ti.static(self.dev.state.lifts):
            # A particle that bounced in this substep is not where its displacement says.
            high, lift = self.dev.surface.bounced(i)
            lifted = high
            if high:
                e += self.dev.pose.inward(1, lift)
        a, going, touched, deferred = first, True, False, False
        for k in range(TOUCHES + 1):
            if going:
                s, depth, n = self.dev.shape.find_first_touch(a, e, contact_distance, close, self.dev.surface.most_parting(h))
                if s > 1:
                    going = False
                elif k < TOUCHES:
                    start_depth = ti.select(s > 0, ti.min(depth, 0), depth + e.dot(n))
                    if self.dev.surface.lets_through(i, n, start_depth, contact_distance):
                        going = False
                    else:
                        touched = True
                        out, slides = self.dev.pose.outward(1, n), False
                        if ti.static(self.dev.shape.can_slide):
                            slides = not lifted and start_depth <= 4 * close
                        shift = self.dev.surface.push(i, depth, start_depth, out, moved, h, mode, slides)
                        a += s * e
                        e += self.dev.pose.inward(1, shift) - s * e
                        if mode != ANY_DEPTH and depth <= self.dev.state.digits_along(i, out, radius):
                            e += ti.max(depth, 0) * n  # push() leaves rounding as it is; the way goes on along the surface
                        if self.dev.surface.is_deferred(i):
                            going, deferred = False, True
        if ti.static(self.dev.shape.may_miss_touches):
            if touched and not deferred and not self.dev.shape.is_penetrating(first, contact_distance - 8 * close, close):
                going = going or self.dev.shape.is_penetrating(a + e, contact_distance - 4 * close, close)
                if going and self.dev.shape.is_penetrating(a, contact_distance, close):
                    a = first
        if going:
            # It stays there, with no more speed than it had.
            gone = self.dev.pose.outward(1, a - first)
            d = self.dev.state.d[i]
            size, speed = gone.norm(), (d - moved).norm()
            self.dev.state.d[i] = moved + gone
            self.dev.state.restart(i)
            if size > speed:
                self.dev.state.d[i] = moved + gone * (speed / size)
            if ti.static(self.dev.state.befores):
                self.dev.state.before[i] = self.dev.state.before[i] + (self.dev.state.d[i] - d)
