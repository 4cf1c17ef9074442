"""The angle of a path that remembers its plane, since a straight path in 3D does not define one."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from .angle import Angle, least_sine, path_angle, path_angles, path_gradients, shorter_link

if TYPE_CHECKING:
    from ...features.feature import Scene


class BendAngle(Angle):
    """The angle of a path, as in PathAngle, with a remembered axis in 3D.

    The axis is the last normal. With it the angle has a direction and a sign while a rod swings through straight. in_state: its
    fields in the exact state, by name.
    """

    arity = 3
    exchangeable = ((0, 2),)
    axis: Any
    in_state: dict[str, Any]

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the angles of the paths, (m,)."""
        return path_angles(x[:, 0], x[:, 1], x[:, 2])

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of the angles, (m, 3, dim)."""
        return path_gradients(x[:, 0], x[:, 1], x[:, 2])

    def bind(self, scene: "Scene", batch: Any, equation: Any) -> "BendAngle":
        """Return the quantity for kernels; in 3D, with a field for the last normals."""
        bound = super().bind(scene, batch, equation)
        bound.in_state = {}
        if scene.state.dim == 3:
            bound.axis = scene.memory.field(f"{batch!r}.axis", batch.count, width=3, state=True)
            bound.in_state = {"axis": bound.axis}
        return bound

    @ti.func
    def trust_radius(self, q):
        """Return the length of the shorter link."""
        return shorter_link(q)

    @ti.func
    def measure(self, c, q):
        """Return path_angle(); in 3D, about the remembered axis."""
        axis = 0 * q[0, :]
        if ti.static(self.state.dim == 3):
            axis = self.axis[c]
        return path_angle(q, axis, self.mirrored(c), least_sine(self.state, self.real))

    @ti.func
    def mirrored(self, c):
        """Whether the angle is measured about its axis: where the rest shape is straight."""
        return self.rest[c] == 0

    @ti.func
    def is_radial(self, c):
        """Whether the path turns in 3D and its rest shape is straight: it may bend in any plane."""
        out = False
        if ti.static(self.state.dim == 3):
            out = self.mirrored(c)
        return out

    @ti.func
    def direction_reliable(self, f, f0):
        """Whether the path is bent by more than 0.1 rad; in 2D always True.

        In 3D the plane of a nearly straight path turns with the least motion.
        """
        out = True
        if ti.static(self.state.dim == 3):
            out = ti.max(ti.abs(f), ti.abs(f0)) > 0.1
        return out

    @ti.func
    def start_substep(self, c, now, start, fresh):
        """Remember the normal, with the sign that suits the last one.

        Where the path is straight at the start, the normal at the end is used.
        """
        if ti.static(self.state.dim == 3):
            if fresh != 0:
                self.axis[c] = ti.Vector.zero(self.real, 3)
            least = 10 * least_sine(self.state, self.real)
            e = path_cross(start)
            if e.norm() < least:
                e = path_cross(now)
            if e.norm() > least:
                side = ti.cast(1, self.real)
                if self.mirrored(c) and self.axis[c].dot(e) < 0:
                    side = -side
                self.axis[c] = side * e / e.norm()


@ti.func
def path_cross(q):
    """Return u x v of a path in 3D."""
    return (q[1, :] - q[0, :]).normalized(1e-30).cross((q[2, :] - q[1, :]).normalized(1e-30))
