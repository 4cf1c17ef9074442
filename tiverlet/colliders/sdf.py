"""A wall given by a function."""

from typing import Any

import numpy as np

from ..checks import ArrayLike
from ..device import inline, runtime, ti
from ..device.language import undecorated
from ..device.patches.compiler import Compiler
from ..features.feature import Scene
from ..features.user_function import check_function, check_number, check_vector
from ..particles import Particles
from ..tools import golden
from .moving import Moving
from .pose import rotation_matrix
from .shape import Shape
from .surface import ALONG, NEAR

FINE = NEAR  # of a displacement: closer than that, the tangent plane replaces the surface
MARCH = 64  # steps along a displacement, each at least FINE of it
SAMPLES = 4096  # places where the function is checked before it is used
CAST = 1 << 14  # steps along a ray; one that grazes a plane at less than 1e-3 may miss it
STRIDE = 2.0**-16  # of the size of the scene: the shortest step of a ray; thinner objects may be missed from their side
SKIN = 2.0**-40  # of the size of the scene: rays that start no deeper than that are outside
AWAY = 1e16  # [m] beyond any particle
SLOPE = 1e-6  # of the largest coordinate: the step of differences at a surface
LEAST = 0.5  # the least gradient that is assumed near a surface
STEEP, FLAT = 1.1, 0.9  # bounds of a gradient that counts as 1


class Sdf(Moving):
    """Particles stay where a function is positive: outside of any shape that a formula describes.

    C(x) = function(x) - (R + r) >= 0, grad C = grad function.

    function: a ti.func that takes a position [m] and returns the signed distance to the surface [m], negative inside of the
    solid. Its literals have the world's precision. gradient: a ti.func of the position that returns the gradient; None for
    central differences. radius: R [m], by which the shape is thickened. position, rotation: pose of the shape; live.
    friction, restitution, push_out, active, events, surface_velocity: see tiverlet/colliders/README.md.

        @ti.func
        def torus(p):
            return ti.math.length(ti.Vector([ti.math.length(p.xz) - 1.0, p.y])) - 0.3

        world = tv.World(particles, [tv.Sdf(torus)])

    The path of a particle is followed by steps as long as the value of the function, never shorter than 1/64 of the path (sphere
    tracing, Hart 1996). No particle passes a wall that, with the particle's diameter added, is thicker than that step. A function
    that changes faster than distance would break this. One that changes more slowly at the surface would keep particles too far
    away. So the gradient is checked where particles start and around, and ValueError names the place. A particle that slides in a
    hollow is second order in the substep, as in a Ball, and conserves energy; on a hump, or with restitution, it is first order
    and loses some; among contacts it is second order on humps, too.
    """

    def __init__(
        self, function, gradient=None, *, radius: float = 0.0, position: ArrayLike = 0.0, rotation: ArrayLike = 0.0, friction:
        ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float | None = None, active: bool | None = None, events: bool
        = False, surface_velocity=None,
    ):  # fmt: skip
        check_function("Sdf", "function", function, ("p",), (1,))
        if gradient is not None:
            check_function("Sdf", "gradient", gradient, ("p",), (1,))
        self.function: Any = function
        self.gradient: Any = gradient
        self.radius = radius
        self.position, self.rotation = position, rotation
        self.set_surface(friction, restitution, push_out, active, events, surface_velocity=surface_velocity)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the dimension, and that the function is finite and a distance around the particles."""
        vars(self.dev).pop("probe", None)  # it may belong to an earlier start of Taichi
        Moving.prepare(self, particles, inv_mass)
        self._check_around(particles)

    def check_added(self, particles: Particles, first: int) -> None:
        """Check the function around particles that are added in place; otherwise prepare() has checked it."""
        if self.scene is not None and first < particles.count:
            self._check_around(particles)

    def _check_around(self, particles: Particles) -> None:
        """Evaluate and check the function at the particles and around them."""
        x, probe = particles.position, self.host_shape(self.dim)
        if not len(x):
            for read in (probe.clearance, probe.gradient)[: 2 if self.gradient else 1]:
                read(np.zeros((1, self.dim)))  # checks only what kind of thing is returned
            return
        low, high = x.min(axis=0), x.max(axis=0)
        reach = float((high - low).max()) or float(particles.radius.max()) or 1.0
        around = low - reach / 2 + golden(np.arange(SAMPLES), dim=self.dim) * (high - low + reach)
        points = (np.concatenate([x[:SAMPLES], around]) - self.position) @ rotation_matrix(self.rotation)
        value, slope = probe.clearance(points), probe.slope(points, 1e-6 * reach)
        size = np.linalg.norm(slope, axis=1)
        bad = ~np.isfinite(value) | ~np.isfinite(size)
        if bad.any():
            k = int(np.argmax(bad))
            raise ValueError(f"Sdf: function is {value[k]} at {_at(points[k])} and around; it must be finite everywhere.")
        if size.max() > STEEP:
            k = int(np.argmax(size))
            raise ValueError(
                f"Sdf: function has a gradient of size {size[k]:.3g} at {_at(points[k])}, but a distance has at most 1. Divide "
                "the function by the largest size of its gradient, or particles would pass through."
            )
        near = np.abs(value) < reach / 16
        if near.any() and np.median(size[near]) < FLAT:
            k = int(np.flatnonzero(near)[np.argmin(size[near])])
            raise ValueError(
                f"Sdf: function has a gradient of size {size[k]:.3g} at {_at(points[k])}, near its surface, but a distance has 1 "
                "there. Divide the function by the size of its gradient at the surface, or particles would stay too far away."
            )
        if self.gradient:
            off = np.linalg.norm(probe.gradient(points) - slope, axis=1)
            if not (np.median(off) < 1 - FLAT):
                k = int(np.argmax(off))
                raise ValueError(
                    f"Sdf: gradient is off by {off[k]:.3g} at {_at(points[k])}, compared with differences of function."
                )

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return where the surface meets the plane of a 2D scene, or the three planes through the middle of a 3D scene."""
        middle, half = (low + high) / 2, float((high - low).max()) * 0.6 or 1.0
        line = np.linspace(-half, half, 129)
        out = []
        for a in range(self.dim):
            for b in range(a):
                grid = np.tile(middle, (129, 129, 1))
                grid[..., a] += line[:, None]
                grid[..., b] += line[None, :]
                local = (grid.reshape(-1, self.dim) - self.position) @ rotation_matrix(self.rotation)
                out.append(contour(grid, self.host_shape(self.dim).clearance(local).reshape(129, 129) - self.radius))
        return np.concatenate(out), 0.0

    sides = 1  # type: ignore[assignment]
    has_bounds = False  # type: ignore[assignment]

    @ti.func
    def near_sides(self, i, reach):
        """Return its only side."""
        return 0, 1

    @ti.func
    def side_at(self, place):
        """Return its only side."""
        return place

    def host_shape(self, dim: int) -> "_Probe":
        """Return the function as a shape in `dim` dimensions; it also works outside of a world."""
        if "probe" not in vars(self.dev) or self.dev.probe.dim != dim:
            runtime.ensure_started()
            self.dev.probe = _Probe(self, dim)
        return self.dev.probe

    @ti.func
    def least_gap(self, face, i, radius):
        """Return the function at the end of the frame, less how far the wall moves there."""
        q = self.dev.pose.inward_at_end(self.dev.state.inside(self.dev.state.place(i)))
        return self.dev.shape.function(q) - ti.cast(self.radius, self.dev.real) - radius - self.dev.pose.motion(q.norm())


class FunctionShape(Shape):
    """The shape where a function of the position is negative, on the device."""

    may_miss_touches = can_slide = True

    def __init__(self, function: Any, gradient: Any, scene: Scene, dim: int):
        self.function, self.gradient, self.dim, self.real = function, gradient, dim, scene.real
        single = scene.real == ti.f32
        self.digits = 2.0**-21 if single else 2.0**-50
        self.slight = 2.0**-20 if single else 2.0**-48
        self.step = 2.0**-6 if single else 2.0**-16

    @ti.func
    def is_penetrating(self, q, contact_distance, close):
        """Whether the function at q is below contact_distance by more than rounding."""
        return self.function(q) < contact_distance - close

    @ti.func
    def rounding(self, q):
        """Return the rounding of a function of coordinates as large as those of q."""
        return q.norm() * ti.cast(self.digits, self.real)

    @ti.func
    def normal(self, q, contact_distance):
        """Return the direction of the gradient, +x where the gradient is 0, and its size."""
        g = self.slope(q, contact_distance)
        size, n = g.norm(), 0 * q
        n[0] = 1
        if size > 0:
            n = g / size
        return n, size

    @ti.func
    def slope(self, q, contact_distance):
        """Return the gradient: the user's, or central differences, whose step depends only on q and `contact_distance`."""
        out = 0 * q
        if ti.static(bool(self.gradient)):
            out = self.gradient(q)
        else:
            step = self.difference(q, contact_distance)
            for k in range(self.dim):
                ahead, behind = q, q
                for a in ti.static(range(self.dim)):
                    if a == k:
                        ahead[a] += step
                        behind[a] -= step
                change = (self.function(ahead) - self.function(behind)) / (2 * step)
                for a in ti.static(range(self.dim)):
                    if a == k:
                        out[a] = change
        return out

    @ti.func
    def difference(self, q, contact_distance):
        """Return the step of central differences [m]."""
        return ti.max(contact_distance, q.norm() / 100) * ti.cast(self.step, self.real)

    @ti.func
    def blur(self, q, contact_distance):
        """Return the angle by which rounding may turn the gradient [rad], so that no more is corrected in vain."""
        out = ti.cast(self.slight, self.real)
        if ti.static(not self.gradient):
            out += self.rounding(q) / ti.max(self.difference(q, contact_distance), self.rounding(q))
        return out

    @ti.func
    def facet_gap(self, f, q, e, contact_distance, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap, the normal and the curvature: that of the function on the way e across the normal, or on a step of
        differences if that is longer, so that rounding does not matter."""
        n, size = self.normal(q, contact_distance)
        value, t, bend, steep = self.function(q), e - e.dot(n) * n, 0 * contact_distance, ti.max(size, LEAST)
        length = t.norm()
        if length > 0:
            step = ti.max(length, self.difference(q, contact_distance))
            t *= step / length
            bend = 2 * (self.function(q + t) - value - size * n.dot(t)) / (steep * step * step)
        return (value - contact_distance) / steep, n, bend

    @ti.func
    def find_first_touch(self, a, e, contact_distance, close, limit):
        """Find the first touch on the way from a to a + e, see Shape.find_first_touch().

        A particle that starts close to the surface is first held above the tangent plane there. If nothing bounces, the end of
        its way on that plane is tested, too. In a hollow the end is inside the surface, and is pushed on along the same normal,
        as by SHAKE, which is second order. Then the way is followed at a height of 4 FINE of its length above the plane, so that
        steps do not shrink to nothing. At last the end is tested. A touch found there counts as at the start, since a later place
        on the way could be behind a thin wall.
        """
        way = e.norm()
        best, depth, normal, first = 0 * contact_distance + 2, 0 * contact_distance, 0 * e, 0 * e
        fine, lifted, s, going, end = way * FINE + close, 0 * contact_distance, 0 * contact_distance, True, a + e
        lift, blur = 0 * e, self.blur(a, contact_distance) * way
        for k in range(MARCH + 2):
            if going:
                ends = s >= 1
                q = a + s * e + lift
                if ends:
                    q = end
                gap = self.function(q) - contact_distance
                if k == 0 and gap > way + close:
                    going = False
                elif k == 0 or gap <= fine or ends:
                    n, size = self.normal(q, contact_distance)
                    slope = e.dot(n)
                    toward = slope < -ti.cast(self.slight, self.real) * way
                    if k == 0:
                        below = -(gap + slope)
                        lies = False
                        if ti.static(self.can_slide):
                            lies = -4 * close <= gap <= fine
                        if lies:
                            first = n
                        if gap <= 4 * fine:
                            if toward and gap <= close:
                                below = ti.max(below, ti.min(-slope, close))
                            pushed = gap < 0 and ti.min(below, limit - slope) > 2 * close
                            if (toward and below > blur) or pushed:
                                best, depth, normal, going = 0 * contact_distance, below, n, lies
                                end += below * n
                                s += 1
                            lifted = 4 * fine - gap
                            lift = lifted * n
                    elif ends:
                        going = False
                        if ti.min(-gap, limit - slope) > 2 * close:
                            more, along, rise = -gap / ti.max(size, LEAST), first.dot(n), first.dot(e)
                            if best == 0:
                                if along > ALONG:
                                    depth += more / along
                            else:
                                best, depth, normal = 0 * contact_distance, more, n
                                # The rest of such a push, or one that rounding hid at the start.
                                if along > ALONG and (rise < blur or more < rise * FINE):
                                    depth, normal = more / along, first
                    else:
                        below = -(gap - lift.dot(n) + (1 - s) * slope)
                        if toward and below > 0:
                            best, depth, normal, going = 0 * contact_distance, below, n, False
                            if lifted == 0:
                                best = ti.max(s + ti.min(gap, 0) / -slope, 0)
                s += ti.max(gap, fine) / way
        return best, depth, normal


@ti.data_oriented
class _Probe:
    """The function at many points, evaluated from Python in f64."""

    def __init__(self, wall: Sdf, dim: int):
        self.compiler = Compiler(ti.f64)
        self.wall: Any = wall
        self.dim = dim

    def on_device(self, scene: Scene, who: str, radius: float) -> FunctionShape:
        """Return the function for kernels."""
        return FunctionShape(self.wall.function, self.wall.gradient, scene, self.dim)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the function at points (n, dim) of the wall's frame, (n,)."""
        out = np.zeros(len(points))
        with self.compiler():
            self._value(np.ascontiguousarray(points, dtype=np.float64), out)
        return out

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how far rays go until the function falls to `radius`, (n,) [m], inf if not in CAST steps; and normals there."""
        distance, normal = np.zeros(len(origin)), np.full(origin.shape, np.nan)
        with self.compiler():
            self._cast(np.ascontiguousarray(origin), np.ascontiguousarray(direction), radius, distance)
        met = distance < np.inf
        x = origin[met] + distance[met, None] * direction[met]
        step = SLOPE * (float(np.abs(x).max(initial=0.0)) or 1.0)
        slope = self.gradient(x) if self.wall.gradient else self.slope(x, step)
        size = np.linalg.norm(slope, axis=1)[:, None]
        normal[met] = np.where(size > 0, slope / np.where(size > 0, size, 1.0), -direction[met])
        return distance, normal

    def slope(self, points: np.ndarray, step: float) -> np.ndarray:
        """Return central differences of the function, (n, dim)."""
        moves = np.concatenate([np.eye(self.dim), -np.eye(self.dim)]) * step
        ahead, behind = np.split(self.clearance((points + moves[:, None]).reshape(-1, self.dim)).reshape(2 * self.dim, -1), 2)
        return (ahead - behind).T / (2 * step)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return the user's gradient, (n, dim)."""
        out = np.zeros(points.shape)
        with self.compiler():
            self._gradient(np.ascontiguousarray(points, dtype=np.float64), out)
        return out

    @inline
    def number(self, value):
        """Return the value of the function if it is a number, else refuse it."""
        return check_number("Sdf", undecorated(self.wall.function).__name__, value)

    @inline
    def vector(self, value):
        """Return the value of the gradient if it is a vector, else refuse it."""
        return check_vector("Sdf", undecorated(self.wall.gradient).__name__, value, self.dim, "a gradient", "")

    @ti.func
    def _point(self, points: ti.template(), i):  # type: ignore[valid-type]
        return ti.Vector([points[i, k] for k in ti.static(range(self.dim))])

    @ti.kernel
    def _value(self, points: ti.types.ndarray(ti.f64, 2), out: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        for i in range(points.shape[0]):
            out[i] = self.number(self.wall.function(self._point(points, i)))

    @ti.kernel
    def _cast(
        self, points: ti.types.ndarray(ti.f64, 2), direction: ti.types.ndarray(ti.f64, 2), radius: ti.f64,
        out: ti.types.ndarray(ti.f64, 1),
    ):  # type: ignore[valid-type]  # fmt: skip
        """Trace rays by steps that are free (Hart 1996), first out of the solid; bisect the one that passes the surface."""
        for i in range(points.shape[0]):
            o, d = self._point(points, i), self._point(direction, i)
            size = ti.abs(o).max()  # type: ignore[reportOptionalCall]
            t, low, high, fine, found = 0 * size, 0 * size, 0 * size - 1, 0 * size, 0 * size + np.inf
            outside, going = False, True
            for k in range(CAST):
                if going:
                    gap = self.wall.function(o + t * d) - radius
                    if high >= 0:
                        if gap > 0:
                            low = t
                        else:
                            high = t
                    else:
                        if k == 0:
                            size = ti.max(size, ti.max(ti.abs(gap), radius))
                            if size == 0:
                                size = 1
                            fine = size * STRIDE
                        if outside and gap <= 0:
                            high = t
                        else:
                            outside = gap > 0 or (k == 0 and gap >= -size * SKIN)
                            low = t
                            t += ti.max(ti.abs(gap), fine)
                            going = t < AWAY
                    if high >= 0:
                        t = (low + high) / 2
                        if not low < t < high:
                            found, going = low, False
            out[i] = found

    @ti.kernel
    def _gradient(self, points: ti.types.ndarray(ti.f64, 2), out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        for i in range(points.shape[0]):
            g = self.vector(self.wall.gradient(self._point(points, i)))
            for k in ti.static(range(self.dim)):
                out[i, k] = g[k]


def contour(grid: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return segments (m, 2, dim) of the line value = 0 on a grid of points (r, c, dim): at most one in each half of a cell."""
    low, high = slice(0, -1), slice(1, None)
    corners = [(low, low), (high, low), (high, high), (low, high)]
    out = []
    for triangle in ((0, 1, 2), (0, 2, 3)):
        x = np.stack([grid[corners[k]].reshape(-1, grid.shape[2]) for k in triangle], axis=1)
        f = np.stack([value[corners[k]].ravel() for k in triangle], axis=1)
        cut = (f > 0).any(axis=1) & (f <= 0).any(axis=1)
        x, f = x[cut], f[cut]
        odd = np.argmax((f > 0) == ((f > 0).sum(axis=1) == 1)[:, None], axis=1)  # the corner that is alone on its side
        rows, ends = np.arange(len(f)), []
        for step in (1, 2):
            other = (odd + step) % 3
            weight = f[rows, odd] / (f[rows, odd] - f[rows, other])
            ends.append(x[rows, odd] + weight[:, None] * (x[rows, other] - x[rows, odd]))
        out.append(np.stack(ends, axis=1))
    return np.concatenate(out)


def _at(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.4g}" for v in point) + ")"
