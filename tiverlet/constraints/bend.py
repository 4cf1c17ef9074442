"""Angles between links."""

from numpy.typing import ArrayLike

from ..device import ti
from ..features.feature import Scene
from .core.angle import REST_ANGLE, PathAngle, path_angle
from .core.scalar import Scalar


class Bend(Scalar):
    """Bending springs and rigid corners: the path i - j - k turns by a given angle at j.

    C(x) = f(x) - rest, the angle f [rad] and its gradients as in path_angle(): f = 0 where the path is straight.

    triples: (m, 3) particle indices, the corner in the middle.
    rest: rest angle, number or (m,) [rad]; None takes the initial angles. Live. In 2D signed, positive to the left; in 3D in
    [0, pi], and with rest = 0 the angle keeps its sign while a rod swings through straight.
    compliance: number or (m,) [rad/(N m)]; 0 is rigid. A beam of stiffness EI [N m^2] cut into links of length l has l / EI.
    damping: of a dashpot beside the spring, number or (m,) [N m s/rad].
    break_at: moment beyond which it breaks, number or (m,) [N m].

    Corners that coincide have no angle: nothing acts until they part. `load` is the moment [N m].
    Jacobi passes stiffen a long beam slowly: in a chain of masses m [kg] and links l [m], one pass per substep h leaves a joint
    the compliance 30 h^2 / (m l^2), however rigid it was meant to be.
    """

    measures = PathAngle
    index_name = "triples"
    rest = REST_ANGLE

    def __init__(self, triples, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(triples, rest, compliance, damping, break_at)

    def bind(self, scene: Scene) -> None:
        """In 3D, the normals as they were last."""
        super().bind(scene)
        if scene.state.dim == 3:
            self.dev.axis = scene.memory.field(f"{self!r}.axis", self.count, width=3, state=True)

    @ti.func
    def measure(self, c, q):
        """See path_angle(); in 3D, about the axis that is remembered."""
        axis = 0 * q[0, :]
        if ti.static(self.dev.state.dim == 3):
            axis = self.dev.axis[c]
        return path_angle(q, axis, self.mirrored(c), self.dev.quantity.faint())

    @ti.func
    def mirrored(self, c):
        """Whether the angle is seen from the side of its axis: where straight is the rest shape."""
        return self.dev.rest[c] == 0

    @ti.func
    def direction_reliable(self, f, f0):
        """In 3D, the plane of a nearly straight path turns at the least motion."""
        out = True
        if ti.static(self.dev.state.dim == 3):
            out = ti.max(ti.abs(f), ti.abs(f0)) > 0.1
        return out

    @ti.func
    def start_substep(self, c, fresh):
        """Remember the normal, that of the end where the start is straight, and from which side it is seen."""
        if ti.static(self.dev.state.dim == 3):
            if fresh != 0:
                self.dev.axis[c] = ti.Vector.zero(self.dev.real, 3)
            e = crossed(self.corners(c, 1))
            if e.norm() < 10 * self.dev.quantity.faint():
                e = crossed(self.corners(c, 0))
            if e.norm() > 10 * self.dev.quantity.faint():
                side = ti.cast(1, self.dev.real)
                if self.mirrored(c) and self.dev.axis[c].dot(e) < 0:
                    side = -side
                self.dev.axis[c] = side * e / e.norm()


@ti.func
def crossed(q):
    """u x v of a path in 3D."""
    return (q[1, :] - q[0, :]).normalized(1e-30).cross((q[2, :] - q[1, :]).normalized(1e-30))
