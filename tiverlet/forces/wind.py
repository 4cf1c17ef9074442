"""Wind: drag relative to moving air."""

from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Acceleration, Knob


class Wind(Acceleration):
    """Drag relative to moving air: a = -rate (v - velocity). It is exact, as Drag is.

    velocity: of the air, (dim,) [m/s]. rate: [1/s], at least 0. Both are live.
    """

    has_no_particle_data = True
    velocity = Knob(lambda f, v: checks.vector("Wind", "velocity", v, f.dim or len(np.atleast_1d(v))), "Of the air [m/s].")
    rate = Knob(lambda f, v: checks.number("Wind", "rate", v, least=0.0), "Drag rate [1/s].")
    decays = True
    uniform = steady = True
    is_fixed_in_space = False

    def __init__(self, velocity, rate):
        self.velocity = velocity
        self.rate = rate

    def kernel_values(self) -> dict[str, Any]:
        """Return rate * velocity, the part of the acceleration beside the drag -rate v, for kernels."""
        return {"push": self.rate * self.velocity}

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return rate * velocity [m/s^2]. The step solves the part -rate v by `rate`, as for Drag."""
        return self.dev.push[None]
