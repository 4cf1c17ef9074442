"""Strength of constraints: the loads at which they break."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Batch, Scene

BREAKS = 2**30  # substeps after which stamps repeat


def strength_of(batch: "Batch", value: Any) -> np.ndarray | None:
    """Return break_at as the user gives it, checked: (m,), or None for never."""
    if value is None:
        return None
    return checks.per_item(repr(batch), "break_at", value, batch.count, above=0.0, infinite=True)


class Strength:
    """The loads at which the constraints of a batch (with break_at and breaks) break, and which have broken, on the device.

    A constraint whose load exceeds break_at at the end of a substep does not act from the next one on. It keeps its share of the
    masses that are split between constraints until the world is rebuilt. That is safe, but slows convergence.

    Where the batch never `breaks` it costs nothing. in_state: its fields in the exact state, by name.
    """

    def __init__(self, scene: "Scene", name: str, batch: Any):
        self._memory, self.breaks, self.in_state = scene.memory, batch.breaks, {}
        if self.breaks:
            limit = np.full(batch.count, np.inf) if batch.break_at is None else batch.break_at
            self.counter = scene.slots.broken
            self.limit = scene.memory.field(f"{name}.break_at", batch.count, values=limit)
            self.stamp = scene.memory.field(f"{name}.broken", batch.count, kind=ti.i32, state=True)
            self.in_state = {"broken": self.stamp}

    def upload(self, break_at: np.ndarray | None) -> None:
        """Write new values to the device, if anything could break when kernels were compiled."""
        if self.breaks:
            self._memory.write(self.limit, np.inf if break_at is None else break_at)

    def stamps(self) -> np.ndarray:
        """Return when each constraint broke, (m,): the number of the substep from 1 on, modulo BREAKS; 0 where it holds."""
        return self._memory.read(self.stamp)

    @ti.func
    def holds(self, c):
        """Whether constraint c has not broken."""
        out = True
        if ti.static(self.breaks):
            out = self.stamp[c] == 0
        return out

    @ti.func
    def test(self, c, load, reach, tick):
        """Break constraint c in this substep if its load, given as a multiplier, is too large. reach: the multiplier of 1 N."""
        if self.stamp[c] == 0 and load > self.limit[c] * reach:
            self.stamp[c] = tick % ti.static(BREAKS) + 1
            self.counter[None] += 1
