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
