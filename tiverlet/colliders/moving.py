"""Walls of any shape, which are moved and turned as a whole: what all of them share."""

from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Knob, Scene
from ..particles import Particles
from .angle import cos_sin
from .collider import Track, Wall

TOUCHES = 8  # of one particle in one substep; then it stays where it is known to be free


def _position(solid: "Solid", value):
    if np.ndim(value) == 0 and not np.any(value):
        return np.zeros(solid.dim) if solid.dim else 0.0
    return checks.vector(repr(solid), "position", value, solid.dim or len(np.atleast_1d(value)))


def _rotation(solid: "Solid", value):
    if solid.dim == 2 or (solid.dim == 0 and np.ndim(value) == 0):
        return checks.number(repr(solid), "rotation", value)
    if np.ndim(value) == 0 and not np.any(value):
        return np.zeros(3)
    return checks.vector(repr(solid), "rotation", value, 3)


class Solid(Wall):
    """A wall that is described in a frame of its own: its point p is at position + R p in the world.

    position: (dim,) [m]. rotation: an angle [rad] in 2D, counterclockwise; a rotation vector, axis times angle [rad], in 3D. Both
    are live: assign between frames, and the wall goes there during the next frame, along the straight line between the old value
    and the new. About a fixed axis that is a constant angular velocity, however many turns it makes. Friction and restitution
    feel the velocity of the wall where it is touched.

    A particle is followed in the wall's frame, along the straight line from where it was at the start of the substep: strike()
    finds the first touch, press() deals with it, and the rest of the way is followed in turn. So nothing passes, at any speed of
    either, and corners need no special case. Where a particle is still on its way in after TOUCHES of them (in a wedge), it stays
    at the last one.
    """

    sweeps = poses = True
    guesses = False  # strike() may miss a touch, so that ends of ways are looked at: a place is free or astray()
    dim = 0
    radius: Any = Knob(
        lambda f, v: checks.number(repr(f), "radius", v, least=0.0), "It is rounded by so much [m].", compiled=True
    )
    position = Knob(_position, "Where the origin of the wall's frame is [m].")
    rotation = Knob(_rotation, "Angle (2D) or rotation vector (3D) [rad].")

    def place(self, position: Any, rotation: Any) -> None:
        """Check and keep where the wall starts."""
        self.position, self.rotation = position, rotation

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension."""
        if self.dim and self.dim != particles.dim:
            raise ValueError(f"{self!r}: it is a wall for {self.dim}D, but the particles are in {particles.dim}D.")
        self.dim = particles.dim
        self.position, self.rotation = self.position, self.rotation

    def bind(self, scene: Scene) -> None:
        """Position and rotation at the ends of a frame, and at the ends of the substep that is under way."""
        Wall.bind(self, scene)
        self.dev.close = 0.0  # what rounding amounts to in the wall's frame [m]
        name, add = repr(self), scene.memory.field
        self.dev.position = Track(scene.memory, f"{name}.position", self.position)
        self.dev.rotation = Track(scene.memory, f"{name}.rotation", np.atleast_1d(self.rotation), kind=ti.f64)
        self.dev.turn = add(f"{name}.turn", 3 * self.dim, width=self.dim)  # rows of R at the start, the end, their difference
        self.dev.place = add(f"{name}.place", 3, width=self.dim)
        self.changed = False

    def upload(self) -> None:
        """Move and turn to the new place."""
        Wall.upload(self)
        self.dev.position.aim(self.position)
        self.dev.rotation.aim(np.atleast_1d(self.rotation))
        self.moving = True

    def settle(self) -> None:
        """Stay."""
        self.dev.position.settle()
        self.dev.rotation.settle()

    def placed(self, points: np.ndarray) -> np.ndarray:
        """Where points (..., dim) of the wall's frame are in the world, for pictures."""
        return points @ rotation_matrix(self.rotation).T + self.position

    @ti.func
    def pose(self, when):
        """Where the wall is at the start and the end of a substep, and how it moves in between; differences are taken in f64."""
        before = ti.Matrix.zero(ti.f64, self.dim, self.dim)
        for k in range(2):
            turn = self.matrix(self.dev.rotation.at(ti.cast(ti.select(k == 0, when[0], when[1]), ti.f64)))
            for a in ti.static(range(self.dim)):
                self.dev.turn[k * self.dim + a] = ti.cast(turn[a, :], self.dev.real)
                self.dev.turn[2 * self.dim + a] = ti.cast(turn[a, :] - before[a, :], self.dev.real)
            before = turn
        self.dev.place[0], self.dev.place[1] = self.dev.position.at(when[0]), self.dev.position.at(when[1])
        self.dev.place[2] = self.dev.position.step(when)

    @ti.func
    def matrix(self, rotation):
        """R of an angle or a rotation vector (Rodrigues); exactly 1 at 0."""
        angle, out = rotation.norm(), ti.Matrix.identity(ti.f64, self.dim)
        if angle > 0:
            if ti.static(self.dim == 2):
                c, s = cos_sin(rotation[0])
                out = ti.Matrix([[c, -s], [s, c]])
            else:
                u = rotation / angle
                c, s = cos_sin(angle)
                _, half = cos_sin(angle / 2)
                out = c * out + 2 * half * half * u.outer_product(u)
                for a in ti.static(range(3)):
                    b, d = ti.static((a + 1) % 3, (a + 2) % 3)
                    out[d, b] += s * u[a]
                    out[b, d] -= s * u[a]
        return out

    @ti.func
    def inward(self, k: ti.template(), v):  # type: ignore[valid-type]
        """R^T v: a vector of the world in the wall's frame, at the start (k = 0) or the end (1) of the substep."""
        out = 0 * v
        for a in ti.static(range(self.dim)):
            out += self.dev.turn[k * self.dim + a] * v[a]
        return out

    @ti.func
    def outward(self, k: ti.template(), v):  # type: ignore[valid-type]
        """R v, or with k = 2 how R v changes in the substep."""
        out = 0 * v
        for a in ti.static(range(self.dim)):
            out[a] = self.dev.turn[k * self.dim + a].dot(v)
        return out

    @ti.func
    def strike(self, a, e, far, close, limit):
        """The first touch of a particle, whose center must stay at least `far` from the shape, on its way from a to a + e.

        close: what rounding amounts to. limit: how far a start that is inside may be pushed out.
        Returns the fraction of the way (2 for none), the depth at a + e below the plane that touches there, and its normal.
        """
        return ti.cast(2, self.dev.real), 0 * far, 0 * e

    @ti.func
    def confine(self, i, radius, h, when, turn):
        """Touch by touch along the way.

        The wall moves by what its point under the start of the particle moves, so what sticks rides along and does not creep.
        """
        start, far = self.dev.state.begin(i), radius + ti.cast(self.radius, self.dev.real)
        first = self.inward(0, start - self.dev.place[0])
        moved = self.dev.place[2] + self.outward(2, first)
        e = self.inward(1, self.dev.state.d[i] - moved)
        close = ti.max(self.dev.state.digits(i), self.rounding(first))
        if ti.static(self.dev.state.befores):
            # What has bounced in this substep is not where its displacement says.
            high, lift = self.lifted(i)
            if high:
                e += self.inward(1, lift)
        a, going, touched = first, True, False
        for k in range(TOUCHES + 1):
            if going:
                s, depth, n = self.strike(a, e, far, close, self.push_out * h)
                if s > 1:
                    going = False
                elif k < TOUCHES:
                    touched = True
                    sunk = ti.select(s > 0, ti.min(depth, 0), depth + e.dot(n))
                    shift = self.press(i, depth, sunk, self.outward(1, n), moved, h, turn)
                    a += s * e
                    e += self.inward(1, shift) - s * e
        if ti.static(self.guesses):
            if touched and not self.astray(first, far - 8 * close, close):
                going = going or self.astray(a + e, far, close)
                if going and self.astray(a, far, close):
                    a = first
        if going:
            # There with no more speed than it had.
            gone = self.outward(1, a - first)
            d = self.dev.state.d[i]
            size, speed = gone.norm(), (d - moved).norm()
            self.dev.state.d[i] = moved + gone
            self.dev.state.restart(i)
            if size > speed:
                self.dev.state.d[i] = moved + gone * (speed / size)
            if ti.static(self.dev.state.befores):
                self.dev.state.before[i] = self.dev.state.before[i] + (self.dev.state.d[i] - d)

    @ti.func
    def rounding(self, q):
        """What it amounts to around a point q of the wall's frame [m]."""
        return ti.cast(self.dev.close, self.dev.real)

    @ti.func
    def astray(self, q, far, close):
        """Whether a particle with its center at q, in the wall's frame, is inside of the wall."""
        return False


def rotation_matrix(rotation) -> np.ndarray:
    """R of an angle (2D) or a rotation vector (3D)."""
    w = np.atleast_1d(np.asarray(rotation, dtype=np.float64))
    if len(w) == 1:
        return np.array([[np.cos(w[0]), -np.sin(w[0])], [np.sin(w[0]), np.cos(w[0])]])
    angle = float(np.linalg.norm(w))
    if angle == 0:
        return np.eye(3)
    x, y, z = w / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * (cross @ cross)
