"""A point that attracts."""

from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Acceleration, Knob
from ..particles import Particles


class Attractor(Acceleration):
    """a = -strength r / |r|^3, r = x - center: a point of gravity (strength = G M); negative strength repels.

    center: (dim,) [m]; strength: [m^3/s^2]. Both live. At the center itself the acceleration is taken as 0. The step
    resolves an orbit of angular velocity omega while omega h is well below 1.
    """

    for_all = True
    conservative = True
    center = Knob(lambda f, v: checks.vector("Attractor", "center", v, f.dim or len(np.atleast_1d(v))), "[m].")
    strength = Knob(lambda f, v: checks.number("Attractor", "strength", v), "G M [m^3/s^2].")
    dim = 0

    def __init__(self, center, strength):
        self.center = center
        self.strength = strength

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the vector's length."""
        self._keep(dim=particles.dim)
        self.center = self.center

    def settings(self) -> dict[str, Any]:
        """Both."""
        return {"center": self.center, "strength": self.strength}

    @ti.func
    def acceleration(self, i, x, v, t):
        """-strength r / |r|^3."""
        r = x - self.dev.center[None]
        rr = r.dot(r)
        out = 0 * r
        if rr > 0:
            out = -self.dev.strength[None] / (rr * ti.sqrt(rr)) * r
        return out

    @ti.func
    def potential(self, i, x):
        """-strength / |r|."""
        r = x - self.dev.center[None]
        rr = r.dot(r)
        out = 0 * rr
        if rr > 0:
            out = -self.dev.strength[None] / ti.sqrt(rr)
        return out
