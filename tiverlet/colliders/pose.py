"""The pose of a moving collider's frame, and its motion in a substep."""

import numpy as np

from ..device import ti
from ..features.feature import Scene
from .cos_sin import cos_sin
from .track import Track


class Pose:
    """The pose of a frame: a point p of it is at position + R p in the world. R is computed once for each substep.

    position: the Track of a place (dim,) [m]; rotation: that of an angle (2D) or a rotation vector (3D) [rad], in f64. turns:
    whether `spin` is needed, the angle or rotation vector of a substep [rad]; it is first order where the axis changes.
    """

    def __init__(self, scene: Scene, name: str, position: Track, rotation: Track, turns: bool):
        self.dim, self.real = scene.particles.dim, scene.real
        self.position, self.rotation, self.turns = position, rotation, turns
        # Rows of R at the start and the end of the substep, and of their difference; and the position likewise.
        self.turn = scene.memory.field(f"{name}.turn", 3 * self.dim, width=self.dim)
        self.place = scene.memory.field(f"{name}.place", 3, width=self.dim)
        if turns:
            self.spin = scene.memory.field(f"{name}.spin", None, width=2 * self.dim - 3)

    @ti.func
    def update(self, frame_fraction):
        """Compute the pose at the start and the end of a substep, and its change by differences in f64."""
        before = ti.Matrix.zero(ti.f64, self.dim, self.dim)
        for k in range(2):
            turn = self.matrix(self.rotation.at(ti.cast(ti.select(k == 0, frame_fraction[0], frame_fraction[1]), ti.f64)))
            for a in ti.static(range(self.dim)):
                self.turn[k * self.dim + a] = ti.cast(turn[a, :], self.real)
                self.turn[2 * self.dim + a] = ti.cast(turn[a, :] - before[a, :], self.real)
            before = turn
        self.place[0], self.place[1] = self.position.at(frame_fraction[0]), self.position.at(frame_fraction[1])
        self.place[2] = self.position.step(frame_fraction)
        if ti.static(self.turns):
            self.spin[None] = ti.cast(self.rotation.step(ti.cast(frame_fraction, ti.f64)), self.real)

    @ti.func
    def matrix(self, rotation):
        """Return R of an angle or a rotation vector (Rodrigues); exactly 1 at 0."""
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
    def bounds(self, low, high, radius):
        """Return the corners of a box in which all from low to high of the wall's frame, and a radius around it, stays."""
        a, b = self.rotation.ends[0], self.rotation.ends[1]
        middle, half = (low + high) / 2, (high - low) / 2
        turn = ti.cast(self.matrix(b), self.real)
        at, reach = turn @ middle, abs(turn) @ half
        if (a != b).any():
            at, reach = 0 * at, 0 * reach + ti.max(abs(low), abs(high)).norm()  # type: ignore[reportOptionalCall]
        first, last, more = self.position.ends[0], self.position.ends[1], reach + radius
        return ti.min(first, last) + at - more, ti.max(first, last) + at + more

    @ti.func
    def inward_at_end(self, x):
        """Return where a point x of the world is in the wall's frame at the end of the frame."""
        return ti.cast(self.matrix(self.rotation.ends[1]), self.real).transpose() @ (x - self.position.ends[1])  # type: ignore[reportOptionalCall]

    @ti.func
    def motion(self, size):
        """Return how far a point within `size` of the origin moves in the frame at most [m]."""
        turn = ti.cast((self.rotation.ends[1] - self.rotation.ends[0]).norm(), self.real)
        return (self.position.ends[1] - self.position.ends[0]).norm() + turn * size

    @ti.func
    def inward(self, k: ti.template(), v):  # type: ignore[valid-type]
        """Return R^T v: a vector of the world in the wall's frame, at the start (k = 0) or the end (1) of the substep."""
        out = 0 * v
        for a in ti.static(range(self.dim)):
            out += self.turn[k * self.dim + a] * v[a]
        return out

    @ti.func
    def outward(self, k: ti.template(), v):  # type: ignore[valid-type]
        """Return R v, or with k = 2 the change of R v in the substep."""
        out = 0 * v
        for a in ti.static(range(self.dim)):
            out[a] = self.turn[k * self.dim + a].dot(v)
        return out


def rotation_matrix(rotation) -> np.ndarray:
    """Return R of an angle (2D) or a rotation vector (3D)."""
    w = np.atleast_1d(np.asarray(rotation, dtype=np.float64))
    if len(w) == 1:
        return np.array([[np.cos(w[0]), -np.sin(w[0])], [np.sin(w[0]), np.cos(w[0])]])
    angle = float(np.linalg.norm(w))
    if angle == 0:
        return np.eye(3)
    x, y, z = w / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * (cross @ cross)
