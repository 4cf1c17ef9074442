"""The angle of a path that remembers its plane, which a straight path in 3D does not have."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from .angle import Angle, faint, path_angle, path_angles, shorter_leg

if TYPE_CHECKING:
    from ...features.feature import Scene


class BendAngle(Angle):
    """As PathAngle; in 3D seen about an axis, the normal as it was last, so that it has a direction and a sign while a rod swings
    through straight. in_state: what it has in the exact state, by name."""

    arity = 3
    exchangeable = ((0, 2),)
    axis: Any
    in_state: dict[str, Any]

    def values(self, x: np.ndarray) -> np.ndarray:
        """The angles of paths."""
        return path_angles(x[:, 0], x[:, 1], x[:, 2])

    def bind(self, scene: "Scene", batch: Any, equation: Any) -> "BendAngle":
        """In 3D, with the normals as they were last."""
        bound = super().bind(scene, batch, equation)
        bound.in_state = {}
        if scene.state.dim == 3:
            bound.axis = scene.memory.field(f"{batch!r}.axis", batch.count, width=3, state=True)
            bound.in_state = {"axis": bound.axis}
        return bound

    @ti.func
    def reach(self, q):
        """The shorter of the two legs."""
        return shorter_leg(q)

    @ti.func
    def measure(self, c, q):
        """See path_angle(); in 3D, about the axis that is remembered."""
        axis = 0 * q[0, :]
        if ti.static(self.state.dim == 3):
            axis = self.axis[c]
        return path_angle(q, axis, self.mirrored(c), faint(self.state, self.real))

    @ti.func
    def mirrored(self, c):
        """Whether the angle is seen from the side of its axis: where straight is the rest shape."""
        return self.rest[c] == 0

    @ti.func
    def direction_reliable(self, f, f0):
        """In 3D, the plane of a nearly straight path turns at the least motion."""
        out = True
        if ti.static(self.state.dim == 3):
            out = ti.max(ti.abs(f), ti.abs(f0)) > 0.1
        return out

    @ti.func
    def start_substep(self, c, now, start, fresh):
        """Remember the normal, that of the end where the start is straight, and from which side it is seen."""
        if ti.static(self.state.dim == 3):
            if fresh != 0:
                self.axis[c] = ti.Vector.zero(self.real, 3)
            least = 10 * faint(self.state, self.real)
            e = crossed(start)
            if e.norm() < least:
                e = crossed(now)
            if e.norm() > least:
                side = ti.cast(1, self.real)
                if self.mirrored(c) and self.axis[c].dot(e) < 0:
                    side = -side
                self.axis[c] = side * e / e.norm()


@ti.func
def crossed(q):
    """u x v of a path in 3D."""
    return (q[1, :] - q[0, :]).normalized(1e-30).cross((q[2, :] - q[1, :]).normalized(1e-30))
