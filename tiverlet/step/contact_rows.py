"""Contacts as constraints that are one number each, for what moves together with links."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ..contact.candidates import Candidates


class ContactRows:
    """C = -overlap >= 0 of what touches, or may once particles have moved; to projection.Rows it is a batch of Scalar.

    What is apart has no gradient: nothing holds it there.
    """

    side, breaks = -1, False

    def __init__(self, pairs: Candidates, start: Any):
        self.pairs, self.start = pairs, start
        self.count, each = pairs.who.shape
        self.indices, self.owner = pairs.who, np.repeat(np.arange(self.count), each)
        self.compliance = self.damping = self.goal = np.zeros(self.count)
        self.broken = np.zeros(self.count, dtype=bool)
        self.dev = SimpleNamespace(spring=SimpleNamespace(soft=False))

    @classmethod
    def of(cls, runner: Any) -> "ContactRows | None":
        """Those of a world at the positions of now; None where it has no Contact."""
        contact = next(iter(runner.step.contacts), None)
        if not contact:
            return None
        runner.list_neighbours()
        return cls(contact.dev.geometry.candidates(runner.scene.state.get(runner.memory)), contact.start)

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Whether none of its particles can move."""
        return (w[self.indices] == 0).all(axis=1)

    def violation(self, x: np.ndarray) -> np.ndarray:
        """C at positions x, (m,)."""
        return -self.pairs.at(x)[0]

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Of all corners, (m, k, dim)."""
        overlap, gradient = self.pairs.at(x)
        return gradient * (overlap > 0)[:, None, None]

    def stored(self, x: np.ndarray, w: np.ndarray) -> float:
        """What overlaps at positions x store, but for a factor, as Rows.stored."""
        return stored_by(*self.pairs.at(x), w[self.indices])

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """What makes C a share of a radius, or of half an edge, (m,)."""
        size = self.pairs.size
        return np.divide(1, size, out=np.zeros_like(size), where=size > 0)


def stored_by(overlap: np.ndarray, gradient: np.ndarray, w: np.ndarray) -> float:
    """What overlaps (m,) store, but for a factor; gradient: (m, k, dim), of particles with inverse masses w (m, k)."""
    D = (w * (gradient**2).sum(axis=2)).sum(axis=1)
    return float(np.divide(np.maximum(overlap, 0.0) ** 2, D, out=np.zeros_like(D), where=D > 0).sum())
