"""The particles that the constraints of a batch act on: a fixed number each, or any number. On the device: corners.py."""

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...features.read_only import as_read_only, structure_advice
from .corners import FixedCorners, VariableCorners

if TYPE_CHECKING:
    from ...features.feature import Scene


class Members:
    """m constraints on `arity` particles each, or with arity 0 on any number each. This object does not change.

    kind: the class of the batch, for errors. rows: their particles, (m, arity); with arity 0 those of all constraints one after
    the other, (total,), and the `sizes` of these, (m,). starts: (m + 1,), the first corner of each constraint, and their number.
    """

    host_only = ("indices",)

    def __init__(self, kind: str, rows: np.ndarray, sizes: Any = None):
        self.kind, self.rows, self.arity = kind, rows.astype(np.int32), 0 if sizes is not None else rows.shape[1]
        if sizes is None:
            self.starts = np.arange(0, rows.size + 1, self.arity, dtype=np.int32)
        else:
            self.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)

    @classmethod
    def joined(cls, kind: str, members: Sequence[np.ndarray]) -> "Members":
        """Return constraints on the particles in these arrays, one array each."""
        return cls(kind, np.concatenate([*members, np.zeros(0, dtype=np.int32)]), [len(row) for row in members])

    @functools.cached_property
    def indices(self) -> np.ndarray:
        """The rows for users, with advice in its error; made when it is first read, which other particles of a Pin seldom are."""
        return as_read_only(self.rows, structure_advice(self.kind, "indices"))

    @property
    def count(self) -> int:
        """The number of constraints."""
        return len(self.starts) - 1

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (total,)."""
        return np.repeat(np.arange(self.count), np.diff(self.starts))

    @property
    def listing(self) -> Any:
        """The particles of each constraint, as the user gives them."""
        return self.indices if self.arity else [self.row(k) for k in range(self.count)]

    def row(self, c: int) -> np.ndarray:
        """Return the particles of constraint c."""
        return self.indices.ravel()[self.starts[c] : self.starts[c + 1]]

    def check(self, who: str, name: str, count: int) -> None:
        """Raise ValueError for a particle that is none of `count`; name: the argument of `who` that has the indices."""
        if self.arity:
            checks.indices(who, name, self.indices, count, arity=self.arity)
        elif len(wrong := np.flatnonzero(self.rows >= count)):
            k = int(self.owner[wrong[0]])
            checks.indices(who, f"{name}[{k}]", self.row(k), count)

    def immovable(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return np.bincount(self.owner, inv_mass[self.rows.ravel()] > 0, minlength=self.count) == 0

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return masks of the constraints, and of their corners, that have only particles that stay: new numbers are not -1."""
        some = np.bincount(self.owner, number[self.rows.ravel()] < 0, minlength=self.count) == 0
        return (some,) if self.arity else (some, some[self.owner])

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "Members":
        """Return the constraints in the mask `some`, with the new numbers of their particles."""
        if self.arity:
            return Members(self.kind, number[self.rows[some]])
        return Members(self.kind, number[self.rows[some[self.owner]]], np.diff(self.starts)[some])

    def pairs(self) -> np.ndarray:
        """Return all pairs of particles of the same constraint, (k, 2); none with arity 0: corners may be far from each other."""
        pairs = [self.indices[:, [a, b]] for a in range(self.arity) for b in range(a)]
        return np.concatenate([*pairs, np.zeros((0, 2), dtype=np.int32)])

    def bind(self, scene: "Scene", batch: Any, origin: Any = None) -> Any:
        """Return the corners on the device; with slots, unless the batch drives its particles. origin: see Quantity."""
        if self.arity:
            places = None if batch.is_kinematic else scene.slots.places(batch)
            return FixedCorners(scene, repr(batch), self.indices, places, origin)
        return VariableCorners(scene, repr(batch), self.starts, self.indices, self.owner, scene.slots.places(batch))


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
