"""Which particles come and go, for what stays where it is meanwhile: see step/edit_in_place.py."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..particles import Particles


@dataclass(frozen=True)
class Regrouping:
    """Particles in the mask `some`, (n,), stay, in order, and behind them come others. number: their new numbers, -1 for those
    that go. before, now: all particles, as they were when the world was built, and as and where they are. inv_mass: of those
    that there are now, after pins."""

    some: np.ndarray
    number: np.ndarray
    before: "Particles"
    now: "Particles"
    inv_mass: np.ndarray

    @cached_property
    def first(self) -> int:
        """The first particle that goes; those before it keep their numbers."""
        return len(self.some) if self.some.all() else int(np.argmin(self.some))

    @cached_property
    def kept(self) -> int:
        """How many stay; from this number on particles are new."""
        return int(self.some.sum())

    @property
    def goes(self) -> bool:
        """Whether any goes."""
        return self.kept < len(self.some)
