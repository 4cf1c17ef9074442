"""The user's own functions of random scenes. Taichi reads their source, so they are in a file."""

import numpy as np

from tiverlet.device import ti


@ti.func
def spring(x):
    """A force towards the origin."""
    return -10.0 * x


@ti.func
def repel(r):
    """A pair force like that of a spring of 1 N/m that ends at 1 m."""
    return r * ti.max(1.0 / (r.norm() + 1e-9) - 1.0, 0.0)


@ti.func
def swirl(x, v):
    """A force across the velocity."""
    f = 0.0 * x
    f[0] = -3.0 * v[1]
    f[1] = 3.0 * v[0]
    return f


@ti.func
def waves(x, v, t, i):
    """A force that depends on place, velocity, time and index."""
    return ti.sin(3.0 * x + t + 0.1 * ti.cast(i, ti.f32)) - 0.1 * v


TABLE = np.array([0.0, 2.0])  # kernels compare it when they are compiled


@ti.func
def compared(x):
    """A force by comparisons and choices of all kinds. NaN is not less than any number."""
    s, v, n = x[0], ti.Vector([x[0], 2 * x[0]]), ti.cast(4 * x[0], ti.i32)
    u, none, f = ti.cast(ti.abs(n), ti.u32), (s - s) / (s - s), 0.0 * x
    for k in ti.static(range(2)):
        if ti.static(TABLE[k] > 1.5):
            f[0] += 1
    if ti.static(np.int64(2) == 2) and TABLE[1] > 1.5:
        f[1] += 1
    larger, same, chosen = v > 0.5, v == v, ti.select(v > 0.5, v, 0 * v)
    f[0] += larger[0] + 2 * larger.any() + 4 * same.all() + chosen[0] - chosen[1]
    f[1] += (s != s) + 2 * (0 < s < 0.5) + 4 * (s >= 0.1) + 8 * (not s < 0.1) + (none < 1) + 2 * (none >= 1) + 4 * (none != none)
    f[0] += (s > 0.3) + (s > 0.2) - 3.0 * (s > 0) + (u > -1) + ((n > 1) << 2)
    f[1] += ti.select(s > 0.1, 1.0, 2.0) - ti.select(not s > 0.1, 1.0, 2.0) + ti.select(n, 3.0, 4.0)
    return f + ((s > 0.1) != (s > 0.2)) - ((s > 0.1) == (s > 0.3))


def perimeter(a, b, c):
    """Return the perimeter of a triangle."""
    return (a - b).norm() + (b - c).norm() + (c - a).norm()


def moment(a, b):
    """Return half of the squared distance, the moment of inertia of a pair of unit masses about its middle."""
    return (a - b).dot(a - b) / 2


@ti.func
def ground(p):
    """Return the height above y = -1."""
    return p.y + 1.0


@ti.func
def pillar(p):
    """Return the distance from a round pillar beside the origin."""
    return ti.sqrt((p.x - 2.0) ** 2 + p.y**2) - 0.5


SDF = {  # the same functions in NumPy, for points (n, dim)
    "ground": lambda p: p[:, 1] + 1.0,
    "pillar": lambda p: np.sqrt((p[:, 0] - 2.0) ** 2 + p[:, 1] ** 2) - 0.5,
}
