"""Which particles come and go, for what stays where it is meanwhile: see step/edit_in_place.py."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..particles import Particles


@dataclass(frozen=True)
class Regrouping:
    """Particles in the mask `some`, (n,), stay, in order, and behind them come others. number: their new numbers, -1 for those
    that go. before, now: all particles, as they were when the world was built, and as and where they are. inv_mass: of those
    that there are now, after pins. more: features, and others whose bodies they take behind their own."""

    some: np.ndarray
    number: np.ndarray
    before: "Particles"
    now: "Particles"
    inv_mass: np.ndarray
    more: Mapping[Any, Any] = field(default_factory=dict)

    @cached_property
    def first(self) -> int:
        """The first particle that goes; those before it keep their numbers."""
        return int(np.argmin(self.some)) if self.goes else len(self.some)

    @cached_property
    def kept(self) -> int:
        """How many stay; from this number on particles are new."""
        return int(np.count_nonzero(self.some))

    @cached_property
    def stay(self) -> np.ndarray:
        """Those that stay, by their old numbers. NumPy takes rows by numbers ten times as fast as by a mask."""
        return np.flatnonzero(self.some)

    def joined(self, rows: np.ndarray, added: np.ndarray | None) -> np.ndarray:
        """Of rows for all that there were, those of what stays, and behind them the added ones."""
        left = np.asarray(rows).take(self.stay, axis=0) if self.goes else np.asarray(rows)
        return left if added is None else np.concatenate([left, added])

    @property
    def goes(self) -> bool:
        """Whether any goes."""
        return self.kept < len(self.some)
