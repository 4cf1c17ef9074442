"""Corners of constraints: their particles, and the pieces that movable particles connect."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..features.feature import Batch


def corners_of(batches: "Sequence[Batch]") -> tuple[np.ndarray, np.ndarray]:
    """Return the constraint, numbered through all batches, and the particle of every corner, batch by batch."""
    first = np.cumsum([0] + [b.count for b in batches])
    owner = np.concatenate([b.owner + k for b, k in zip(batches, first, strict=False)])
    return owner, np.concatenate([b.indices.ravel() for b in batches])


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


def bodies_of(m: int, row: np.ndarray, who: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels of bodies, for constraints (m,) and particles (n,). A body is what movable particles connect.

    Corner k belongs to constraint row[k] of m, and is particle who[k]. w: inverse masses, (n,). Particles that no constraint can
    move have the label m.
    """
    free = w[who] > 0
    label = components(m, row[free], who[free])
    body = np.full(len(w), m)
    body[who[free]] = label[row[free]]
    return label, body
