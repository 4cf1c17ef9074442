"""Radii of particles on the device."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import at, inline, ti
from ..device.number import Number, OnDevice

if TYPE_CHECKING:
    from ..device.memory import Memory

ENDLESS = 1e30  # [m], instead of the least radius where all are points: they pass each other in no step


class Radii:
    """Radii of particles on the device. least: of those above 0 [m]. discs: 1 if all radii are above 0, else 0."""

    least: Any = OnDevice()
    discs: Any = OnDevice()

    def __init__(self, memory: "Memory", radius: np.ndarray, number: Number):
        self.real, self.field = memory.real, memory.field("radius", number, values=radius)
        least, discs = self._least(radius)
        self.least, self.discs = memory.number(least, memory.real), memory.number(discs, memory.real)

    @staticmethod
    def _least(radius: np.ndarray) -> tuple[float, float]:
        return float(radius[radius > 0].min(initial=ENDLESS)), float((radius > 0).all())

    def assign(self, memory: "Memory", radius: np.ndarray) -> None:
        """Write other radii, (n,) [m]."""
        memory.write(self.field, radius)
        self.least, self.discs = self._least(radius)

    @inline
    def of(self, i):
        """Return the radius of particle i."""
        return at(self.field, i)

    @ti.func
    def stride(self, i):
        """Return the longest step with which particle i cannot pass another: two such steps never exceed r_i + r_j."""
        return (ti.cast(self.discs, self.real) * self.of(i) + ti.cast(self.least, self.real)) / 2

    def strides(self, radius: np.ndarray) -> np.ndarray:
        """Return stride() of particles of these radii, (n,) [m]."""
        return (self.discs * radius + self.least) / 2
