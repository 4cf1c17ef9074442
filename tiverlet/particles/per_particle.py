"""Numbers per particle on the device, stored once if they are all equal."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import at, inline, ti
from ..device.number import Number, OnDevice

if TYPE_CHECKING:
    from ..device.memory import Memory, Rows


class PerParticle:
    """A number for each particle: a single one if all are equal, else a field. number: the number of particles, on the device."""

    constant: Any = OnDevice()

    def __init__(self, memory: "Memory", name: str, values: np.ndarray, number: Number):
        self.real = memory.real
        self.uniform = bool(len(values) == 0 or (values == values[0]).all())
        self.all_positive = self.uniform and bool(len(values) and values[0] > 0)
        self.constant = memory.number(float(values[0]) if len(values) else 0.0, memory.real)
        if not self.uniform:
            self.field = memory.field(name, number, values=values)

    def can_assign(self, values: np.ndarray) -> bool:
        """Whether these values need the same kernels as the present ones."""
        uniform = bool(len(values) == 0 or (values == values[0]).all())
        return uniform == self.uniform and (uniform and bool(len(values) and values[0] > 0)) == self.all_positive

    def assign(self, memory: "Memory", values: np.ndarray) -> None:
        """Write other values, for which can_assign() is true."""
        if self.uniform:
            self.constant = float(values[0]) if len(values) else 0.0
        else:
            memory.write(self.field, values)

    def change(self, memory: "Memory", values: np.ndarray, *some: "Rows") -> None:
        """Write the values at `some`, in an elastic memory, where values were and are not all equal."""
        view = memory.view(self.field)
        for rows in some:
            view[rows] = values[rows]

    @inline
    def of(self, i):
        """Return the number of particle i."""
        return ti.cast(self.constant, self.real) if self.uniform else at(self.field, i)

    @inline
    def positive(self, i):
        """Whether the number of particle i is above 0. Compiles to no branch if all are."""
        return ti.cast(1, ti.i32) > 0 if self.all_positive else self.of(i) > 0


class Radii:
    """Radii of particles on the device."""

    least: Any = OnDevice()

    def __init__(self, memory: "Memory", radius: np.ndarray, number: Number):
        self.each = PerParticle(memory, "radius", radius, number)
        self.uniform, self.real = self.each.uniform, memory.real
        least, self.points, self.discs = self._kinds(radius)
        self.least = memory.number(least, memory.real)

    @staticmethod
    def _kinds(radius: np.ndarray) -> tuple[float, bool, bool]:
        """Return the least radius above 0, and whether there are points and discs."""
        positive = radius[radius > 0]
        return float(positive.min()) if len(positive) else 0.0, bool((radius == 0).any()), bool(len(positive))

    def can_assign(self, values: np.ndarray) -> bool:
        """Whether these radii need the same kernels as the present ones."""
        return self.each.can_assign(values) and self._kinds(values)[1:] == (self.points, self.discs)

    def assign(self, memory: "Memory", values: np.ndarray) -> None:
        """Write other radii, for which can_assign() is true."""
        self.each.assign(memory, values)
        self.least = self._kinds(values)[0]

    @inline
    def of(self, i):
        """Return the radius of particle i."""
        return self.each.of(i)

    @ti.func
    def stride(self, i):
        """Return the longest step with which particle i cannot pass another: two such steps never exceed r_i + r_j."""
        least = ti.cast(self.least, self.real)
        step = least / 2
        if ti.static(not self.points):
            step = (self.of(i) + least) / 2
        return step
