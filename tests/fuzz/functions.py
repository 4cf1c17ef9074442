"""The user's own functions of random scenes: Taichi reads their source, so they stand in a file."""

import numpy as np

from tiverlet.device import ti


@ti.func
def spring(x):
    """Towards the origin."""
    return -10.0 * x


@ti.func
def repel(r):
    """As a spring that ends at 1 m, of 1 N/m."""
    return r * ti.max(1.0 / (r.norm() + 1e-9) - 1.0, 0.0)


@ti.func
def swirl(x, v):
    """Across the velocity."""
    f = 0.0 * x
    f[0] = -3.0 * v[1]
    f[1] = 3.0 * v[0]
    return f


@ti.func
def waves(x, v, t, i):
    """By place, velocity, time and number."""
    return ti.sin(3.0 * x + t + 0.1 * ti.cast(i, ti.f32)) - 0.1 * v


def perimeter(a, b, c):
    """Of a triangle."""
    return (a - b).norm() + (b - c).norm() + (c - a).norm()


def moment(a, b):
    """Of a pair about its middle."""
    return (a - b).dot(a - b) / 2


@ti.func
def ground(p):
    """Height above y = -1."""
    return p.y + 1.0


@ti.func
def pillar(p):
    """Distance from a round pillar beside the origin."""
    return ti.sqrt((p.x - 2.0) ** 2 + p.y**2) - 0.5


SDF = {  # the same in NumPy, of points (n, dim)
    "ground": lambda p: p[:, 1] + 1.0,
    "pillar": lambda p: np.sqrt((p[:, 0] - 2.0) ** 2 + p[:, 1] ** 2) - 0.5,
}
