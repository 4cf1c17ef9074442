"""The user's own functions of scenes. Taichi reads their source, so they are in a file."""

from tiverlet.device import ti


@ti.func
def attract(r):
    """A pair force that ends smoothly at 2 m: minus the slope of attraction()."""
    return -4.0 * r * (1.0 - r.norm_sqr() / 4.0)


@ti.func
def attraction(r):
    """Its potential, -4 J (1 - r^2 / 4)^2."""
    return -4.0 * (1.0 - r.norm_sqr() / 4.0) ** 2


@ti.func
def drift(x, v, t, i):
    """A force of 1 N + 1 N/s along x, and, by the number of the particle, along y, where it is braked."""
    f = 0.0 * x
    f[0] = 1.0 + t
    f[1] = ti.cast(i, ti.f32) - 0.5 * v[1]
    return f


@ti.func
def up(p):
    """The gradient of a height."""
    return ti.Vector([0.0, 1.0])
