"""Corners of constraints: their particles, and the pieces that movable particles connect."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..features.feature import Batch


def corners_of(batches: "Sequence[Batch]") -> tuple[np.ndarray, np.ndarray]:
    """Return the constraint, numbered through all batches, and the particle of every corner, batch by batch."""
    first, none = np.cumsum([0] + [b.count for b in batches]), np.zeros(0, dtype=np.int32)
    owner = np.concatenate([none, *(b.owner + k for b, k in zip(batches, first, strict=False))])
    return owner, np.concatenate([none, *(b.indices.ravel() for b in batches)])


def components(n: int, owner: np.ndarray, item: np.ndarray) -> np.ndarray:
    """Return labels of n owners, (n,): equal where shared items connect them. Owner owner[k] has item item[k]."""
    label, items = np.arange(n), int(item.max(initial=-1)) + 1
    while True:
        least = np.full(items, n)
        np.minimum.at(least, item, label[owner])
        new = label.copy()
        np.minimum.at(new, owner, least[item])
        np.minimum.at(new, label, new.copy())  # owners with one label get the least label that any of them has found
        while not np.array_equal(new, new[new]):
            new = new[new]
        if np.array_equal(new, label):
            return label
        label = new


def by_batch(batches: "Sequence[Batch]", values: np.ndarray) -> list[np.ndarray]:
    """Split values of constraints, numbered through all batches, into those of each batch."""
    return np.split(values, np.cumsum([b.count for b in batches])[:-1])[: len(batches)]


def bodies_of(batches: "Sequence[Batch]", inv_mass: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """Return labels of bodies, which movable particles connect: for the constraints of each batch, and for particles, (n,).

    Particles that no constraint can move have the number of constraints as their label.
    """
    count, (row, who) = sum(b.count for b in batches), corners_of(batches)
    free = inv_mass[who] > 0
    label = components(count, row[free], who[free])
    body = np.full(len(inv_mass), count)
    body[who[free]] = label[row[free]]
    return by_batch(batches, label), body
