"""A point that attracts particles."""

from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.arguments import shifted
from ..features.feature import Acceleration, Knob


class Attractor(Acceleration):
    """The gravity of a point mass: a = -strength r / (r^2 + softening^2)^(3/2), r = x - center.

    center: (dim,) [m]. strength: G M [m^3/s^2]; a negative strength repels. softening: the radius [m] of a Plummer sphere (1911)
    in place of the point. All are live.

    Without softening the acceleration grows without bound towards the center, and no substep resolves a fall into it. At the
    center itself it is 0. Elsewhere the step resolves an orbit of angular velocity omega while omega h is well below 1.
    """

    is_fixed_in_space = False
    has_no_particle_data = True
    conservative = True
    center = Knob(lambda f, v: checks.vector("Attractor", "center", v, f.dim or len(np.atleast_1d(v))), "[m].", place=shifted)
    strength = Knob(lambda f, v: checks.number("Attractor", "strength", v), "G M [m^3/s^2].")
    softening = Knob(lambda f, v: checks.number("Attractor", "softening", v, least=0.0), "[m].")

    def __init__(self, center, strength, *, softening=0.0):
        self.center = center
        self.strength = strength
        self.softening = softening

    def kernel_values(self) -> dict[str, Any]:
        """Return center, strength and softening, for kernels."""
        return {"center": self.center, "strength": self.strength, "softening": self.softening}

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return -strength r / (r^2 + softening^2)^(3/2) [m/s^2]."""
        r = x - self.dev.center[None]
        rr = r.dot(r) + self.dev.softening[None] * self.dev.softening[None]
        out = 0 * r
        if rr > 0:
            out = -self.dev.strength[None] / (rr * ti.sqrt(rr)) * r
        return out

    @ti.func
    def potential(self, i, x):
        """Return -strength / sqrt(r^2 + softening^2) [J/kg]."""
        r = x - self.dev.center[None]
        rr = r.dot(r) + self.dev.softening[None] * self.dev.softening[None]
        out = 0 * rr
        if rr > 0:
            out = -self.dev.strength[None] / ti.sqrt(rr)
        return out
