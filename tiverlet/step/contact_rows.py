"""Contacts as scalar constraints, for projections in which contacts move together with links."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ..contact.candidates import Candidates


class ContactRows:
    """Rows C = -overlap >= 0 of pairs that overlap, or may once particles have moved.

    projection.Rows uses them like a batch of Scalar. Pairs that do not overlap have the gradient 0, so nothing holds them.
    """

    side, breaks = -1, False

    def __init__(self, pairs: Candidates, start: Any):
        self.pairs, self.start = pairs, start
        self.count, each = pairs.who.shape
        self.indices, self.owner = pairs.who, np.repeat(np.arange(self.count), each)
        self.compliance = self.damping = self.rest_now = np.zeros(self.count)
        self.broken = np.zeros(self.count, dtype=bool)
        self.dev = SimpleNamespace(spring=SimpleNamespace(soft=False))

    @classmethod
    def of(cls, runner: Any) -> "ContactRows | None":
        """Return the rows of a world at its present positions; None where it has no Contact."""
        contact = next(iter(runner.step.contacts), None)
        if not contact or contact.solves_rows:
            return None
        runner.list_neighbours()
        return cls(contact.dev.geometry.candidates(runner.scene.state.get(runner.memory)), contact.start)

    def immovable(self, w: np.ndarray) -> np.ndarray:
        """Return a mask of rows none of whose particles can move, (m,)."""
        return (w[self.indices] == 0).all(axis=1)

    def violation(self, x: np.ndarray) -> np.ndarray:
        """Return C at positions x, (m,) [m]."""
        return -self.pairs.at(x)[0]

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients at all corners, (m, k, dim)."""
        overlap, gradient = self.pairs.at(x)
        return gradient * (overlap > 0)[:, None, None]

    def stored(self, x: np.ndarray, w: np.ndarray) -> float:
        """Return the energy that overlaps at positions x store, up to the factor of Rows.stored."""
        return stored_by(*self.pairs.at(x), w[self.indices])

    def inverse_size(self, x: np.ndarray) -> np.ndarray:
        """Return the factors that turn C into a share of a radius, or of half an edge, (m,)."""
        size = self.pairs.size
        return np.divide(1, size, out=np.zeros_like(size), where=size > 0)


def stored_by(overlap: np.ndarray, gradient: np.ndarray, w: np.ndarray) -> float:
    """Return the energy that overlaps (m,) store, up to a factor: sum C^2 / D, D the diagonal of J w J^T.

    gradient: (m, k, dim). w: (m, k) inverse masses of the particles.
    """
    D = (w * (gradient**2).sum(axis=2)).sum(axis=1)
    return float(np.divide(np.maximum(overlap, 0.0) ** 2, D, out=np.zeros_like(D), where=D > 0).sum())
