"""The particles that the constraints of a batch act on: a fixed number each, or any number. On the device: corners.py.

These objects do not change: other particles are another object.
"""

import functools
from collections.abc import Sequence
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...features.read_only import as_read_only, structure_advice
from .corners import FixedCorners, VariableCorners

if TYPE_CHECKING:
    from ...features.feature import Scene


class FixedSize:
    """m constraints on `arity` particles each. indices: (m, arity). kind: the class of the batch, for errors."""

    host_only = ("indices",)

    def __init__(self, kind: str, indices: np.ndarray):
        self.kind = kind
        self.rows = np.asarray(indices, dtype=np.int32)
        self.arity = self.rows.shape[1]

    @functools.cached_property
    def indices(self) -> np.ndarray:
        """The same for users, with advice in its error; made when it is first read, which other particles of a Pin seldom are."""
        return as_read_only(self.rows, structure_advice(self.kind, "indices"))

    @property
    def count(self) -> int:
        """The number of constraints."""
        return len(self.rows)

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (m arity,)."""
        return np.repeat(np.arange(self.count), self.arity)

    @property
    def listing(self) -> np.ndarray:
        """The particles of each constraint, as the user gives them."""
        return self.indices

    def row(self, c: int) -> np.ndarray:
        """Return the particles of constraint c."""
        return self.indices[c]

    def check(self, who: str, name: str, count: int) -> None:
        """Raise ValueError for a particle that is none of `count`; name: the argument of `who` that has the indices."""
        checks.indices(who, name, self.indices, count, arity=self.arity)

    def immovable(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return (inv_mass[self.indices] == 0).all(axis=1)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return which constraints have only particles that stay, whose new numbers are not -1."""
        return (np.all(number[self.indices] >= 0, axis=1),)

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "FixedSize":
        """Return the constraints in the mask `some`, with the new numbers of their particles."""
        return FixedSize(self.kind, number[self.indices[some]])

    def pairs(self) -> np.ndarray:
        """Return all pairs of particles of the same constraint, (k, 2)."""
        pairs = [self.indices[:, [a, b]] for a in range(self.arity) for b in range(a)]
        return np.concatenate([*pairs, np.zeros((0, 2), dtype=np.int32)])

    def bind(self, scene: "Scene", batch: Any) -> FixedCorners:
        """Return the corners on the device, for a batch; with slots, unless the batch drives its particles."""
        return FixedCorners(scene, repr(batch), self.indices, None if batch.is_kinematic else scene.slots.places(batch))


def rows(who: str, name: str, value: Any, least: int) -> list[np.ndarray]:
    """Check a sequence of index sequences of any lengths (or a single one), each of at least `least` distinct particles."""
    value = checks.rows(who, name, value, "a sequence of index sequences")
    if len(value) and np.ndim(value[0]) == 0:
        value = [value]
    out = []
    for k, row in enumerate(value):
        row = checks.indices(who, f"{name}[{k}]", row, checks.ANY)
        if len(row) < least:
            raise ValueError(f"{who}: {name}[{k}] has {len(row)} particles, but at least {least} are needed.")
        twice = np.flatnonzero(np.bincount(np.unique(row, return_inverse=True)[1]) > 1)
        if len(twice):
            raise ValueError(f"{who}: {name}[{k}] names particle {np.unique(row)[twice[0]]} twice; its members must differ.")
        out.append(row)
    return out


class VariableSize:
    """m constraints of the same kind, each on any number of particles; see FixedSize for the methods.

    `indices` (total,) has the corners of all constraints one after the other; constraint c owns starts[c] to starts[c + 1].
    kind: the class of the batch, for errors.
    """

    def __init__(self, kind: str, members: Sequence[np.ndarray]):
        self.kind = kind
        sizes = np.array([len(r) for r in members], dtype=np.int64)
        self.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        indices = np.concatenate([*members, np.zeros(0, dtype=np.int32)]).astype(np.int32)
        self.indices = as_read_only(indices, structure_advice(kind, "indices"))

    @property
    def count(self) -> int:
        """The number of constraints."""
        return len(self.starts) - 1

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (total,)."""
        return np.repeat(np.arange(self.count), np.diff(self.starts))

    @property
    def listing(self) -> list[np.ndarray]:
        """The particles of each constraint."""
        return [self.row(k) for k in range(self.count)]

    def row(self, c: int) -> np.ndarray:
        """Return the particles of constraint c."""
        return self.indices[self.starts[c] : self.starts[c + 1]]

    def check(self, who: str, name: str, count: int) -> None:
        """Raise ValueError for a particle that is none of `count`."""
        wrong = np.flatnonzero(self.indices >= count)
        if len(wrong):
            k = int(self.owner[wrong[0]])
            checks.indices(who, f"{name}[{k}]", self.row(k), count)

    def immovable(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return np.bincount(self.owner, weights=inv_mass[self.indices] > 0, minlength=self.count) == 0

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return masks of the constraints, and of their corners, that have only particles that stay."""
        some = np.bincount(self.owner, weights=number[self.indices] < 0, minlength=self.count) == 0
        return some, some[self.owner]

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "VariableSize":
        """Return the constraints in the mask `some`, with the new numbers of their particles."""
        out, sizes = copy(self), np.diff(self.starts)[some]
        out.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        out.indices = as_read_only(
            number[self.indices[some[self.owner]]].astype(np.int32), structure_advice(self.kind, "indices")
        )
        return out

    def pairs(self) -> np.ndarray:
        """Return no pairs: corners of one constraint may be far from each other."""
        return np.zeros((0, 2), dtype=np.int32)

    def bind(self, scene: "Scene", batch: Any) -> VariableCorners:
        """Return the corners on the device, for a batch."""
        return VariableCorners(scene, repr(batch), self.starts, self.indices, self.owner, scene.slots.places(batch))
