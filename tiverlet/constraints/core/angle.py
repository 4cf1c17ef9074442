"""Angles: the angle of a path, and the angle between two triangles."""

from functools import cache
from typing import Any

import numpy as np

from ... import checks
from ...device import called_with, inline, ti
from ...features.feature import Knob, Scene
from ...features.items import Items
from ...geometry.intervals import cross, cross_2d
from .quantity import Quantity, exact_rest

TURN = 2 * np.pi
LEAST_SINE = 1e-13  # of unit vectors u and v: |u x v| below which f64 loses their normal in rounding
SHORT = 1e-24  # [m^2] squared length below which a link has no direction: representable in f32, and far below any in use


REST_ANGLE = Knob(Items(None, least=-TURN, most=TURN), "Rest angle [rad].")


def angles_of_paths(batch: Any, name: str, value: Any, dim: int | None = None) -> np.ndarray:
    """Return checked angles of paths, (m,), within a turn, in 3D in [0, pi]. dim: of the world; None for that of the batch."""
    if (batch.start.dim if dim is None and batch.start else dim) == 3:
        return checks.per_item(repr(batch), f"{name} (in 3D)", value, batch.count, least=0.0, most=np.pi)
    return checks.per_item(repr(batch), name, value, batch.count, least=-TURN, most=TURN)


@cache
def _types(arity: int, dim: int, real: Any) -> Any:
    corners = ti.types.matrix(arity, dim, real)
    return (ti.i32, corners), (real, corners)


class Angle(Quantity):
    """Angles: values that are whole turns apart are equivalent, and residuals are in radians."""

    unit, transcends, curved, precise, is_angle = 1.0, True, True, True, True

    def difference(self, f: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return differences of angles, in (-pi, pi]."""
        return wrap_to_pi(f - goal)

    @ti.func
    def unwrap(self, f, other):
        """Return f plus whole turns, within half a turn of `other`."""
        return wrap_near(f, other)

    @ti.func
    def excess(self, c, f):
        """f - rest, to all digits of the low words, where there are any."""
        return excess_of(self, c, f)

    @ti.func
    def exact_excess(self, c):
        """f - rest in f64, within half a turn of 0."""
        return exactly_off(self, c)

    @called_with(lambda self: _types(self.arity, self.state.dim, self.real))
    @ti.func
    def remeasure(self, c, q):
        """Return measure(c, q), as one function: it is long and called from up to three places."""
        return self.measure(c, q)


class PathAngle(Angle):
    """The angle by which a path i - j - k turns at j, see path_angle(), or how far it is from the middle of its range.

    remembers: whether paths in 3D remember their last normal, the `axis`. With it the angle has a direction and a sign while a
    rod swings through straight. centred: f is |angle - middle|; on the host values() returns the angle itself, since the middle
    depends on knobs. in_state: its fields in the exact state, by name.
    """

    arity = 3
    exchangeable = ((0, 2),)
    has_axis = False
    axis: Any  # on the device, as are the next two
    middle: Any
    in_state: dict[str, Any]

    def __init__(self, members: Any, remembers: bool = False, centred: bool = False):
        super().__init__(members)
        self.remembers, self.centred = remembers, centred

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return what path_angle() measures, of corners (m, 3, dim) [m]: (m,) [rad]."""
        a, b = x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]
        dot = (a * b).sum(axis=1)
        if x.shape[2] == 2:
            return np.arctan2(cross_2d(a, b), dot)
        return np.arctan2(np.linalg.norm(cross(a, b), axis=1), dot)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of values(), (m, 3, dim), as path_angle() does: in some plane for a straight path in 3D."""
        (u, a), (v, b) = directions(x[:, 1] - x[:, 0]), directions(x[:, 2] - x[:, 1])
        if x.shape[2] == 2:
            across = [np.stack([-r[:, 1], r[:, 0]], axis=1) for r in (u, v)]
        else:
            axis = np.where(np.abs(u[:, :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
            axis, _ = directions(axis - (axis * u).sum(axis=1)[:, None] * u)
            e, size = directions(cross(u, v))
            e = np.where(size > LEAST_SINE, e, axis)
            across = [cross(e, r) for r in (u, v)]
        some = (a > SHORT**0.5) & (b > SHORT**0.5)
        g, h = (np.divide(r, size, out=np.zeros_like(r), where=some) for r, size in zip(across, (a, b), strict=True))
        return np.stack([g, -(g + h), h], axis=1)

    def bind(self, scene: Scene, batch: Any, equation: Any) -> "PathAngle":
        """Return the quantity for kernels, with fields for the axes or the middles of ranges."""
        bound = super().bind(scene, batch, equation)
        if self.remembers and scene.state.dim == 3:
            bound.has_axis, bound.axis = True, scene.memory.field(f"{batch!r}.axis", batch.count, width=3, state=True)
            bound.in_state = {"axis": bound.axis}
        if self.centred:
            bound.middle = scene.memory.field("AngleLimit.middle", batch.count, values=batch.middle)
        return bound

    @ti.func
    def trust_radius(self, q):
        """Return the length of the shorter of the two links of a path."""
        return ti.min((q[1, :] - q[0, :]).norm(), (q[2, :] - q[1, :]).norm())

    @ti.func
    def unwrap(self, f, other):
        """Return f plus whole turns, within half a turn of `other`; unchanged where it is a distance from the middle."""
        if ti.static(not self.centred):
            f = wrap_near(f, other)
        return f

    @ti.func
    def measure(self, c, q):
        """Return path_angle(), about the remembered axis if there is one; or its distance from the middle, and the gradients."""
        axis = 0 * q[0, :]
        if ti.static(self.has_axis):
            axis = self.axis[c]
        f, g = path_angle(q, axis, self.mirrored(c), least_sine(self.state, self.real))
        if ti.static(self.centred):
            middle = self.middle[c]
            f = wrap_near(f, middle) - middle
            side = ti.select(f < 0, ti.cast(-1, self.real), ti.cast(1, self.real))
            f, g = side * f, side * g
        return f, g

    @ti.func
    def mirrored(self, c):
        """Whether the angle is measured about its axis: where paths have one, and the rest shape is straight."""
        out = False
        if ti.static(self.has_axis):
            out = self.rest[c] == 0
        return out

    @ti.func
    def is_radial(self, c):
        """Whether the path turns in 3D and its rest shape is straight: it may bend in any plane."""
        return self.mirrored(c)

    @ti.func
    def direction_reliable(self, f, f0):
        """Whether the path is bent by more than 0.1 rad, where it has an axis: the plane of one less bent turns at once."""
        out = True
        if ti.static(self.has_axis):
            out = ti.max(ti.abs(f), ti.abs(f0)) > 0.1
        return out

    @ti.func
    def start_substep(self, c, now, start, fresh):
        """Remember the normal at the start, or at the end if it is straight there, with the sign that suits the last one."""
        if ti.static(self.has_axis):
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


class DihedralAngle(Angle):
    """The angle between two triangles with a common edge, see dihedral_angle()."""

    arity = 4
    exchangeable = ((0, 1), (2, 3))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return what dihedral_angle() measures, of corners (m, 4, 3) [m]: (m,) [rad]."""
        e, a, b = (x[:, k] - x[:, 0] for k in (1, 2, 3))
        e = e / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-300)
        p, q = (r - e * (r * e).sum(axis=1, keepdims=True) for r in (a, b))
        return np.arctan2((e * cross(p, q)).sum(axis=1), -(p * q).sum(axis=1))

    @ti.func
    def trust_radius(self, q):
        """Return the shortest distance from one end of the edge to another corner."""
        return ti.min(q[1, :].norm(), ti.min(q[2, :].norm(), q[3, :].norm()))

    @ti.func
    def measure(self, c, q):
        """Return dihedral_angle()."""
        return dihedral_angle(q)


@ti.func
def excess_of(angle: ti.template(), c, f):  # type: ignore[valid-type]
    """See Angle.excess()."""
    C = f - angle.rest[c]
    if ti.static(angle.state.carries):
        C = ti.cast(wrap_near(exactly_off(angle, c), ti.cast(C, ti.f64)), angle.real)
    return C


@ti.func
def exactly_off(angle: ti.template(), c):  # type: ignore[valid-type]
    """See Angle.exact_excess()."""
    q = ti.Matrix.zero(ti.f64, angle.arity, angle.state.dim)
    for k in ti.static(range(1, angle.arity)):
        r = angle.state.between(angle.corners.member(c, k), angle.corners.member(c, 0))
        for a in ti.static(range(angle.state.dim)):
            q[k, a] = r[a]
    f, _gradients = angle.measure(c, q)
    return wrap_near(f - exact_rest(angle, c), ti.cast(0, ti.f64))


def wrap_to_pi(C: np.ndarray) -> np.ndarray:
    """Return differences of angles, in (-pi, pi]."""
    return C - TURN * np.round(C / TURN)


@ti.func
def wrap_near(f, other):
    """Return f plus whole turns, within half a turn of `other`."""
    return f - ti.static(TURN) * ti.round((f - other) * ti.static(1 / TURN))


@inline
def least_sine(state, real):
    """Return |u x v| of unit vectors below which their normal is lost in rounding."""
    return ti.cast(LEAST_SINE if state.double else 1e-6, real)


def directions(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors of vectors r (m, dim), 0 where r is 0; and their lengths, (m, 1)."""
    size = np.linalg.norm(r, axis=1, keepdims=True)
    return np.divide(r, size, out=np.zeros_like(r), where=size > 0), size


@ti.func
def path_angle(q, axis, mirrored, faint):
    """Return the angle by which a path of corners q = (i, j, k) turns at j, and its gradients.

    The angle is 0 where the path is straight and pi where it folds back. There is none where two corners coincide.
    f(x) = atan2(|u x v|, u . v) with the unit vectors u of a = x_j - x_i and v of b = x_k - x_j; signed in 2D, positive to the
    left. With the unit normal e of the plane (2D: out of the page),

        grad_i f = e x u / |a|,   grad_k f = e x v / |b|,   grad_j f = -(grad_i f + grad_k f).

    In 3D the normal of a straight or folded path is undefined; `axis` replaces it there, or any normal where axis is 0.
    mirrored: the angle is measured about `axis`, so that it is negative where the normal points away from it.
    faint: |u x v| below which the normal is lost in rounding.
    """
    a, b = q[1, :] - q[0, :], q[2, :] - q[1, :]
    aa, bb = a.dot(a), b.dot(b)
    f, g, k = ti.zero(aa), 0 * a, 0 * a
    if aa > SHORT and bb > SHORT:
        u, v = a / ti.sqrt(aa), b / ti.sqrt(bb)
        if ti.static(q.m == 2):
            f = ti.atan2(u[0] * v[1] - u[1] * v[0], u.dot(v))
            g, k = ti.Vector([-u[1], u[0]]), ti.Vector([-v[1], v[0]])
        else:
            e, side = u.cross(v), 1 + ti.zero(aa)
            if mirrored and axis.dot(e) < 0:
                side = -side
            if axis.dot(axis) == 0:  # any axis away from u
                if ti.abs(u[0]) < 0.6:
                    axis[0] = 1
                else:
                    axis[1] = 1
            n = side * e + faint * (axis - axis.dot(u) * u)
            n /= ti.max(n.norm(), 1e-30)
            s = e.dot(n)
            if not mirrored:  # near straight, where `axis` is the normal, the sign of s is rounding
                s = ti.max(s, 0)
            f = ti.atan2(s, u.dot(v))
            g, k = n.cross(u), n.cross(v)
        g, k = g / ti.sqrt(aa), k / ti.sqrt(bb)
    return f, ti.Matrix.rows([g, -(g + k), k])


@ti.func
def path_cross(q):
    """Return u x v of a path in 3D."""
    return (q[1, :] - q[0, :]).normalized(1e-30).cross((q[2, :] - q[1, :]).normalized(1e-30))


@ti.func
def dihedral_angle(q):
    """Return the angle between two triangles with a common edge, and its gradients; 0 where an edge or a triangle has no size.

    q: the corners (i, j, k, l), with i at the origin: the ends of the edge, then the wings.
    f = atan2(e . (p x q), -p . q) in (-pi, pi]: 0 where flat, pi where folded, positive where the wings fold towards the side of
    e x p. e: unit vector of the edge x_j - x_i; p, q: unit vectors at right angles to it towards the wings x_k and x_l, at
    distances P and Q from it, with feet at the fractions s and t of the edge (Bergou et al. 2006, eq. 7 ff.).

        grad_k f = e x p / P,   grad_l f = -e x q / Q,
        grad_j f = -(s grad_k f + t grad_l f),   grad_i f = -((1 - s) grad_k f + (1 - t) grad_l f)
    """
    edge, a, b = q[1, :], q[2, :], q[3, :]
    ee = edge.dot(edge)
    f, g = ti.zero(ee), 0 * q
    if ee > SHORT:
        e, s, t = edge / ti.sqrt(ee), a.dot(edge) / ee, b.dot(edge) / ee
        p, r = a - s * edge, b - t * edge
        pp, rr = p.dot(p), r.dot(r)
        if pp > SHORT and rr > SHORT:
            f = ti.atan2(e.dot(p.cross(r)), -p.dot(r))
            k, l = e.cross(p) / pp, -e.cross(r) / rr  # noqa: E741
            g = ti.Matrix.rows([-((1 - s) * k + (1 - t) * l), -(s * k + t * l), k, l])
    return f, g
