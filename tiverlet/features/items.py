"""Knobs with a number for each constraint of a batch."""

from collections.abc import Callable
from typing import Any

import numpy as np

from .. import checks


class Items:
    """The check of such a knob: a number, or one for each constraint, finite and within bounds; see checks.per_item().

    name: of the knob; None for the name that rest values have in the batch. refuse: raises for numbers that cannot be.
    """

    def __init__(self, name: str | None, refuse: Callable[[Any, np.ndarray], None] | None = None, **bounds: Any):
        self.name, self.refuse, self.bounds = name, refuse, bounds

    def __call__(self, batch: Any, value: Any) -> np.ndarray:
        return self.check(batch, value, batch.count)

    def check(self, batch: Any, value: Any, count: int) -> np.ndarray:
        """Return the numbers, (count,), of one world or of several."""
        out = checks.per_item(repr(batch), self.name or batch.rest_name, value, count, **self.bounds)
        if self.refuse:
            self.refuse(batch, out)
        return out

    def of_worlds(self, batch: Any, values: np.ndarray) -> np.ndarray:
        """Return the numbers of many worlds, (worlds, m). values: a number for each world, or one for each of its constraints."""
        each = np.broadcast_to(values.reshape(len(values), -1), (len(values), batch.count))
        return self.check(batch, each.reshape(-1), each.size).reshape(each.shape)
