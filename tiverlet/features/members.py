"""Which particles the constraints of a batch act on. What is here does not change: another choice is another object."""

import numpy as np

from .. import checks
from ..device import ti
from .read_only import handed_out, structure


class FixedSize:
    """m constraints on `arity` particles each. indices: (m, arity). kind: the class of the batch, for errors."""

    def __init__(self, kind: str, indices: np.ndarray):
        self.kind = kind
        self.indices = handed_out(np.asarray(indices, dtype=np.int32), structure(kind, "indices"))
        self.arity = self.indices.shape[1]

    @property
    def count(self) -> int:
        """The number of constraints."""
        return len(self.indices)

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (m arity,)."""
        return np.repeat(np.arange(self.count), self.arity)

    @property
    def listing(self) -> np.ndarray:
        """As the user gives them."""
        return self.indices

    def row(self, c: int) -> np.ndarray:
        """The particles of constraint c."""
        return self.indices[c]

    def check(self, who: str, name: str, count: int) -> None:
        """Raise ValueError for a particle that is none of `count`; name: the argument of `who` that the indices are."""
        checks.indices(who, name, self.indices, count, arity=self.arity)

    def idle(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return (inv_mass[self.indices] == 0).all(axis=1)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Which constraints have none but particles that stay, whose new numbers are not -1."""
        return (np.all(number[self.indices] >= 0, axis=1),)

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "FixedSize":
        """Those in the mask `some`, by the new numbers of their particles."""
        return FixedSize(self.kind, number[self.indices[some]])

    def pairs(self) -> np.ndarray:
        """All pairs of particles of the same constraint, (k, 2)."""
        pairs = [self.indices[:, [a, b]] for a in range(self.arity) for b in range(a)]
        return np.concatenate([*pairs, np.zeros((0, 2), dtype=np.int32)])

    def bind(self, batch, scene) -> None:
        """Declare the particles of each constraint in batch.dev, and their slots unless they are driven."""
        name, add = repr(batch), scene.memory.field
        batch.dev.members = add(f"{name}.members", self.count, width=self.arity, kind=ti.i32, values=self.indices)
        if not batch.drives:
            places = scene.slots.places(batch)
            batch.dev.places = add(f"{name}.slots", self.count, width=self.arity, kind=ti.i32, values=places)
