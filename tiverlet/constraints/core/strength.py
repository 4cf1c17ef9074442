"""Strength of constraints: the loads at which they break."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device import always, at, inline, ti

if TYPE_CHECKING:
    from ...features.feature import Batch, Scene

BREAKS = 2**30  # substeps after which stamps repeat
MARGIN = 4  # roundings that sums of loads may contain; measured in f32: 0.2 to 2 for links, angles, areas and clusters


def strength_of(batch: "Batch", value: Any) -> np.ndarray | None:
    """Return break_at as the user gives it, checked: (m,), or None for never."""
    if value is None:
        return None
    return checks.per_item(repr(batch), "break_at", value, batch.count, above=0.0, infinite=True)


class Strength:
    """The loads at which the constraints of a batch (with break_at and breaks) break, and which have broken, on the device.

    A constraint whose load exceeds break_at at the end of a substep does not act from the next one on, unless what breaks beside
    it unloads it, see Breaks. It keeps its share of the masses that are split between constraints until the world is rebuilt.
    That is safe, but slows convergence.

    Positions are known to about ulp(x), so a load is known to m ulp(x) / h^2: in f32 at 1280 substeps a frame, 2 kg that hang
    at rest pull with 0 to 1400 N. But a body that gets too much in one substep gets less in the next: sums of multipliers over
    time are right to m ulp(x), however many substeps there are. So the excess of loads over break_at is summed over substeps
    (CUSUM, Page 1954),

        over <- (over + lam) max(0, 1 - break_at h^2 / |over + lam|),    broken where |over| > MARGIN m ulp(x)

    Where rounding is small, a load above break_at breaks at once; elsewhere it breaks within the substeps that tell it from
    rounding. m: the root of the sum of the squares of the masses of the body, since roundings of particles are independent. x:
    the largest coordinate of the body, as links bear the roundings of all that hangs on them.

    A batch that never `breaks` costs nothing. overload: the load as a multiple of break_at, 0 up to 1. in_state: its fields in
    the exact state, by name. corners: those of the batch, if its loads are a vector for each corner, not a number for each
    constraint.
    """

    host_only = ("_memory",)

    def __init__(self, scene: "Scene", name: str, batch: Any, corners: Any = None):
        self._memory, self.breaks, self.corners, self.in_state = scene.memory, batch.breaks, corners, {}
        if self.breaks:
            limit = np.full(batch.count, np.inf) if batch.break_at is None else batch.break_at
            self.counter, self.state = scene.slots.broken, scene.state
            self.limit = scene.memory.field(f"{name}.break_at", batch.count, values=limit)
            self.stamp = scene.memory.field(f"{name}.broken", batch.count, kind=ti.i32, state=True)
            self.overload = scene.memory.field(f"{name}.overload", batch.count)
            total, width = (corners.total, scene.state.dim) if corners else (batch.count, 0)
            self.excess = scene.memory.field(f"{name}.over", total, width=width, state=True)
            epsilon = np.finfo(np.float32 if scene.real == ti.f32 else np.float64).eps
            body, least = scene.slots.body(batch), MARGIN * epsilon * scene.slots.rounding_masses
            self.rounding_scale = scene.memory.field(f"{name}.unsure", batch.count, values=least[body])
            self.size = scene.memory.field(f"{name}.body_size", batch.count, values=scene.slots.body_sizes[body])
            self.in_state = {"broken": self.stamp, "over": self.excess}

    def upload(self, break_at: np.ndarray | None) -> None:
        """Write new values to the device, if anything could break when kernels were compiled."""
        if self.breaks:
            self._memory.write(self.limit, np.inf if break_at is None else break_at)

    def stamps(self) -> np.ndarray:
        """Return when each constraint broke, (m,): the number of the substep from 1 on, modulo BREAKS; 0 where it holds."""
        return self._memory.read(self.stamp)

    @inline
    def is_intact(self, c):
        """Whether constraint c has not broken."""
        return at(self.stamp, c) == 0 if self.breaks else always()

    @ti.func
    def add_excess(self, c, e, load, per_newton):
        """Add a load of constraint c, the multiplier of entry e, to its excess. Returns the size, negative without excess."""
        total = self.excess[e] + load
        size = 0 * per_newton
        if ti.static(bool(self.corners)):
            size = total.norm()
        else:
            size = ti.abs(total)
        past, share = size - self.limit[c] * per_newton, 0 * size
        if past > 0:
            share = past / size
        else:
            past = share
        self.excess[e] = share * total
        return past

    @ti.func
    def forget_excess(self, c):
        """Forget the excess of constraint c: what breaks beside it unloads it."""
        if ti.static(bool(self.corners)):
            for e in range(self.corners.starts[c], self.corners.starts[c + 1]):
                self.excess[e] *= 0
        else:
            self.excess[c] *= 0

    @ti.func
    def overload_by(self, c, past, per_newton):
        """Return the overload of constraint c from the excess of its load."""
        return 1 + past / (self.limit[c] * per_newton)

    @ti.func
    def rounding(self, c, i, j):
        """Return the most that rounding adds to sums of multipliers of constraint c, for a gradient of 1 at particle i.

        No particle of the body is further from the origin than i by more than the size of the body; where positions are carried
        to more digits, lengths are rounded. j: the particle from which positions are measured.
        """
        x = self.state.x[i]
        if ti.static(self.state.compensated):
            x = self.state.separation(i, j)
        return self.rounding_scale[c] * (x.norm() + self.size[c])

    @ti.func
    def mark_broken(self, c, tick):
        """Break constraint c in this substep."""
        self.stamp[c] = tick % ti.static(BREAKS) + 1
        self.counter[None] += 1
