"""Which particles are added and removed, for data that is edited in place: see step/edit_in_place.py."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..particles import Particles


@dataclass(frozen=True)
class Regrouping:
    """A change of the particles: those in the mask `some`, (n,), stay, in order; added ones come after them.

    number: new numbers of the old particles, -1 if removed. before: the particles as they were when the world was built. now: all
    particles after the change, at their present positions. inv_mass: of the particles in `now`, after pins. extensions: a mapping
    from features to others whose bodies they append.
    """

    some: np.ndarray
    number: np.ndarray
    before: "Particles"
    now: "Particles"
    inv_mass: np.ndarray
    extensions: Mapping[Any, Any] = field(default_factory=dict)

    @cached_property
    def first(self) -> int:
        """The first removed particle; particles before it keep their numbers."""
        return int(np.argmin(self.some)) if self.has_removed else len(self.some)

    @cached_property
    def kept(self) -> int:
        """The number of particles that stay; from this number on particles are new."""
        return int(np.count_nonzero(self.some))

    @cached_property
    def kept_indices(self) -> np.ndarray:
        """The old numbers of the particles that stay. NumPy takes rows by numbers ten times as fast as by a mask."""
        return np.flatnonzero(self.some)

    def regrouped_rows(self, rows: np.ndarray, added: np.ndarray | None) -> np.ndarray:
        """Return the rows of the particles that stay, out of rows for all old ones, and the added rows behind them."""
        left = np.asarray(rows).take(self.kept_indices, axis=0) if self.has_removed else np.asarray(rows)
        return left if added is None else np.concatenate([left, added])

    @property
    def has_removed(self) -> bool:
        """Whether any particle is removed."""
        return self.kept < len(self.some)
