"""Numbers of particles on the device: one for all where they are equal."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import at, inline, ti
from ..device.number import Number, OnDevice

if TYPE_CHECKING:
    from ..device.memory import Memory


class PerParticle:
    """A number for each particle: a single one where all are equal, a field otherwise. number: of particles."""

    constant: Any = OnDevice()

    def __init__(self, memory: "Memory", name: str, values: np.ndarray, number: Number):
        self.real = memory.real
        self.uniform = bool(len(values) == 0 or (values == values[0]).all())
        self.all_positive = self.uniform and bool(len(values) and values[0] > 0)
        self.constant = memory.number(float(values[0]) if len(values) else 0.0, memory.real)
        if not self.uniform:
            self.field = memory.field(name, number, values=values)

    def can_be(self, values: np.ndarray) -> bool:
        """Whether its kernels are those for other values, too."""
        uniform = bool(len(values) == 0 or (values == values[0]).all())
        return uniform == self.uniform and (uniform and bool(len(values) and values[0] > 0)) == self.all_positive

    def become(self, memory: "Memory", values: np.ndarray) -> None:
        """Take other values, as can_be() says."""
        if self.uniform:
            self.constant = float(values[0]) if len(values) else 0.0
        else:
            memory.write(self.field, values)

    def can_change(self, values: np.ndarray, some: np.ndarray) -> bool:
        """The same as can_be(), where others than `some` are what they are; where these differ, nobody looks at all."""
        return (not self.uniform and len({*values[some].tolist()}) > 1) or self.can_be(values)

    def change(self, memory: "Memory", values: np.ndarray, some: np.ndarray) -> None:
        """The same as become(), for an elastic memory."""
        if self.uniform:
            self.become(memory, values)
        else:
            memory.seen(self.field)[some] = values[some]

    @inline
    def of(self, i):
        """That of particle i."""
        return ti.cast(self.constant, self.real) if self.uniform else at(self.field, i)

    @inline
    def positive(self, i):
        """Whether it is above 0 for particle i; where it is for all, no branch is left."""
        return ti.cast(1, ti.i32) > 0 if self.all_positive else self.of(i) > 0


class Radii:
    """Radii on the device."""

    least: Any = OnDevice()

    def __init__(self, memory: "Memory", radius: np.ndarray, number: Number):
        self.each = PerParticle(memory, "radius", radius, number)
        self.uniform, self.real = self.each.uniform, memory.real
        least, self.points, self.discs = self._kinds(radius)
        self.least = memory.number(least, memory.real)

    @staticmethod
    def _kinds(radius: np.ndarray) -> tuple[float, bool, bool]:
        """The least radius that is not 0, and whether there are points and discs."""
        positive = radius[radius > 0]
        return float(positive.min()) if len(positive) else 0.0, bool((radius == 0).any()), bool(len(positive))

    def can_be(self, values: np.ndarray) -> bool:
        """Whether its kernels are those for other radii, too."""
        return self.each.can_be(values) and self._kinds(values)[1:] == (self.points, self.discs)

    def become(self, memory: "Memory", values: np.ndarray) -> None:
        """Take other radii, as can_be() says."""
        self.each.become(memory, values)
        self.least = self._kinds(values)[0]

    @inline
    def of(self, i):
        """That of particle i."""
        return self.each.of(i)

    @ti.func
    def stride(self, i):
        """The longest step with which particle i cannot pass another: two such steps never exceed r_i + r_j."""
        least = ti.cast(self.least, self.real)
        step = least / 2
        if ti.static(not self.points):
            step = (self.of(i) + least) / 2
        return step
