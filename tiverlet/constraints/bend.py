"""Angles between links."""

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Knob, Scene
from .core.scalar import Scalar

TURN = 2 * np.pi
SHORT = 1e-24  # [m^2] squared length below which a link has no direction, in f32 and far below any in use


class Angle(Scalar):
    """What all constraints on an angle share: C is the wrapped difference, in (-pi, pi], and residuals are in radians."""

    unit, transcends = 1.0, True
    rest = Knob(lambda f, v: checks.per_item(repr(f), f.rest_name, v, f.count, least=-TURN, most=TURN), "Rest angle [rad].")

    def violation(self, position: np.ndarray) -> np.ndarray:
        """C at the given positions."""
        C = self.rest_of(position) - self.rest
        return C - TURN * np.round(C / TURN)

    @ti.func
    def near(self, f, other):
        """f plus whole turns, within half a turn of `other`."""
        return f - ti.static(TURN) * ti.round((f - other) * ti.static(1 / TURN))


class Turning(Angle):
    """The angle by which a path i - j - k turns at j: 0 where it is straight, pi where it folds back.

    f(x) = atan2(|u x v|, u . v) with the unit vectors u of a = x_j - x_i and v of b = x_k - x_j; signed in 2D, positive to the
    left. With the unit normal e of the plane (2D: out of the page),

        grad_i f = e x u / |a|,   grad_k f = e x v / |b|,   grad_j f = -(grad_i f + grad_k f).

    In 3D the normal of a straight or folded path is undefined; the one in `lean` takes its place there.
    """

    arity = 3
    index_name = "triples"
    exchangeable = ((0, 2),)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """The angles at the given positions."""
        i, j, k = self.indices.T
        a, b = position[j] - position[i], position[k] - position[j]
        dot = (a * b).sum(axis=1)
        if position.shape[1] == 2:
            return np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], dot)
        return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), dot)

    @ti.func
    def lean(self, c, normal):
        """The side of the plane from which the angle is seen, 1 or -1, and a direction for its normal where it has none."""
        return ti.cast(1, self.dev.real), 0 * normal

    @ti.func
    def distinct(self, f, f0):
        """In 3D, the plane of a nearly straight path turns at the least motion."""
        out = True
        if ti.static(self.dev.state.dim == 3):
            out = ti.max(ti.abs(f), ti.abs(f0)) > 0.1
        return out

    @ti.func
    def faint(self):
        """|u x v| below which the normal is lost in rounding."""
        return ti.cast(ti.static(1e-13 if self.dev.state.double else 1e-6), self.dev.real)

    @ti.func
    def turning(self, c, q):
        """The angle and its gradients; none where two corners coincide."""
        a, b = q[1, :] - q[0, :], q[2, :] - q[1, :]
        aa, bb = a.dot(a), b.dot(b)
        f, g, k = ti.cast(0, self.dev.real), 0 * a, 0 * a
        if aa > SHORT and bb > SHORT:
            u, v = a / ti.sqrt(aa), b / ti.sqrt(bb)
            if ti.static(self.dev.state.dim == 2):
                f = ti.atan2(u[0] * v[1] - u[1] * v[0], u.dot(v))
                g, k = ti.Vector([-u[1], u[0]]), ti.Vector([-v[1], v[0]])
            else:
                e = u.cross(v)
                side, axis = self.lean(c, e)
                if axis.dot(axis) == 0:  # any, away from u
                    if ti.abs(u[0]) < 0.6:
                        axis[0] = 1
                    else:
                        axis[1] = 1
                n = side * e + self.faint() * (axis - axis.dot(u) * u)
                n /= ti.max(n.norm(), 1e-30)
                f = ti.atan2(e.dot(n), u.dot(v))
                g, k = n.cross(u), n.cross(v)
            g, k = g / ti.sqrt(aa), k / ti.sqrt(bb)
        return f, ti.Matrix.rows([g, -(g + k), k])

    @ti.func
    def measure(self, c, q):
        """See the class."""
        return self.turning(c, q)


class Bend(Turning):
    """Bending springs and rigid corners: the path i - j - k turns by a given angle at j.

    C(x) = f(x) - rest, the angle f [rad] and its gradients as in Turning: f = 0 where the path is straight.

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

    def __init__(self, triples, rest=None, *, compliance=0.0, damping=0.0, break_at=None):
        self.setup(triples, rest, compliance, damping, break_at)

    def bind(self, scene: Scene) -> None:
        """In 3D, the normals as they were last."""
        Turning.bind(self, scene)
        if scene.state.dim == 3:
            self.dev.axis = scene.memory.field(f"{self!r}.axis", self.count, width=3, state=True)

    @ti.func
    def lean(self, c, normal):
        """The axis that is remembered; seen from its side where straight is the rest shape."""
        axis = self.dev.axis[c]
        side = ti.cast(1, self.dev.real)
        if self.dev.rest[c] == 0 and axis.dot(normal) < 0:
            side = ti.cast(-1, self.dev.real)
        return side, axis

    @ti.func
    def begin(self, c, fresh):
        """Remember the normal, that of the end where the start is straight, and from which side it is seen."""
        if ti.static(self.dev.state.dim == 3):
            if fresh != 0:
                self.dev.axis[c] = 0 * self.dev.axis[c]
            e = crossed(self.corners(c, 1))
            if e.norm() < 10 * self.faint():
                e = crossed(self.corners(c, 0))
            if e.norm() > 10 * self.faint():
                side, _ = self.lean(c, e)
                self.dev.axis[c] = side * e / e.norm()


@ti.func
def crossed(q):
    """u x v of a path in 3D."""
    return (q[1, :] - q[0, :]).normalized(1e-30).cross((q[2, :] - q[1, :]).normalized(1e-30))
