"""Beads on rigid wires, where the host moves particles: along these, and not across."""

from typing import TYPE_CHECKING

import numpy as np

from ..constraints.core.anchored import Anchored

if TYPE_CHECKING:
    from .runner import Runner


class Rails:
    """The directions in which beads can move at positions x (n, dim), which no row of a constraint knows. who: (k,) particles."""

    def __init__(self, runner: "Runner", x: np.ndarray):
        wires = [b for b in runner.batches if isinstance(b, Anchored) and not b.is_kinematic and (b.compliance == 0).any()]
        rigid = [b.compliance == 0 for b in wires]
        self.who = np.concatenate(
            [np.zeros(0, dtype=np.int64), *(b.indices[some, 0] for b, some in zip(wires, rigid, strict=True))]
        )
        along = [b.tangents(x[b.indices[:, 0]])[some] for b, some in zip(wires, rigid, strict=True)]
        self.along = np.concatenate([np.zeros((0, x.shape[1])), *along])

    def moves(self, moves: np.ndarray) -> np.ndarray:
        """Moves (n, dim), of beads along their wires."""
        out = moves.copy()
        out[self.who] = (moves[self.who] * self.along).sum(axis=1)[:, None] * self.along
        return out

    def across(self, n: int) -> np.ndarray:
        """For each of n particles the projection on what is across its wire, (n, dim, dim)."""
        dim = self.along.shape[1]
        out = np.zeros((n, dim, dim))
        out[self.who] = np.eye(dim) - self.along[:, :, None] * self.along[:, None, :]
        return out


def tethered(runner: "Runner") -> np.ndarray:
    """Which particles anything draws to a place of its own, (n,): bodies of theirs are not free; nor is any in a periodic box,
    for among images there is no moment."""
    out = np.full(runner.n, runner.scene.periodic is not None)
    for b in runner.batches:
        if isinstance(b, Anchored):
            out[b.indices[:, 0]] = True
    return out
