"""Uniform gravity."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.feature import Acceleration, Knob


def _vector(feature: "Gravity", g):
    if np.ndim(g) == 0:
        size = checks.number("Gravity", "g", g)
        if size < 0:
            up = f"(0, {-size:g})" if feature.dim != 3 else f"(0, {-size:g}, 0)"
            raise ValueError(
                f"Gravity: g = {size:g}, but a number is how strongly it pulls down, along -y: write {-size:g}, or {up} for "
                "gravity that pulls up."
            )
        return size
    return checks.vector("Gravity", "g", g, feature.dim or len(np.asarray(g)))


class Gravity(Acceleration):
    """Uniform gravity: a = g for every particle. Position Verlet follows the parabola exactly, for any step.

    g: a number [m/s^2] along -y, at least 0, or a vector (dim,) in any direction. Live: assign to .g between frames.
    """

    has_no_particle_data = True
    conservative = True
    uniform = common = steady = True
    is_fixed_in_space = False
    g = Knob(_vector, "Acceleration [m/s^2]: a number of at least 0 along -y, or a vector.")

    def __init__(self, g: ArrayLike = 9.81):
        self.g = g

    def kernel_values(self) -> dict[str, Any]:
        """Return g as a vector, for kernels."""
        g = np.asarray(self.g, dtype=np.float64)
        return {"g": (g if g.ndim else g * [0.0, -1.0, 0.0][: self.dim]).tolist()}

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return g [m/s^2]."""
        return self.dev.g[None]

    @ti.func
    def potential(self, i, x):
        """Return -g . x [J/kg]."""
        return -self.dev.g[None].dot(x)
