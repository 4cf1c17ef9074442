"""Beads on rigid wires, when the host moves particles: beads move along the wires only."""

from typing import TYPE_CHECKING

import numpy as np

from ..constraints.core.anchored import Anchored

if TYPE_CHECKING:
    from .runner import Runner


class Rails:
    """The directions along which beads on rigid wires can move at positions x (n, dim). No row of a constraint contains them.

    who: (k,) the beads. along: (k, dim) unit directions. off: (k, dim) [m], how far beads are off their wires.
    """

    def __init__(self, runner: "Runner", x: np.ndarray):
        wires = [b for b in runner.batches if isinstance(b, Anchored) and not b.is_kinematic and (b.compliance == 0).any()]
        rigid = [b.compliance == 0 for b in wires]
        self.who = np.concatenate(
            [np.zeros(0, dtype=np.int64), *(b.indices[some, 0] for b, some in zip(wires, rigid, strict=True))]
        )
        along, off = (
            np.concatenate([np.zeros((0, x.shape[1])), *(of(b)[some] for b, some in zip(wires, rigid, strict=True))])
            for of in (lambda b: b.tangents(x[b.indices[:, 0]]), lambda b: b.offset(x))
        )
        self.along, self.off = along, off - (off * along).sum(axis=1)[:, None] * along  # not beyond the ends of wires

    @property
    def worst(self) -> float:
        """How far the worst bead is off its wire [m]."""
        return float(np.linalg.norm(self.off, axis=1).max(initial=0.0))

    def drawn(self, x: np.ndarray, share: float) -> np.ndarray:
        """Return positions x, (n, dim), with beads drawn to their wires by this share of their distance."""
        out = x.copy()
        out[self.who] -= share * self.off
        return out

    def moves(self, moves: np.ndarray) -> np.ndarray:
        """Return moves, (n, dim), with those of beads projected on their wires."""
        out = moves.copy()
        out[self.who] = (moves[self.who] * self.along).sum(axis=1)[:, None] * self.along
        return out

    def across(self, n: int) -> np.ndarray:
        """Return for each of n particles the projector across its wire, (n, dim, dim); 0 for particles on no wire."""
        dim = self.along.shape[1]
        out = np.zeros((n, dim, dim))
        out[self.who] = np.eye(dim) - self.along[:, :, None] * self.along[:, None, :]
        return out


def tethered(runner: "Runner") -> np.ndarray:
    """Return a mask of the particles that are held at a place or path, (n,). Their bodies are not free.

    In a periodic box all particles are in the mask: among images there is no angular momentum.
    """
    out = np.full(runner.n, runner.scene.periodic is not None)
    for b in runner.batches:
        if isinstance(b, Anchored):
            out[b.indices[:, 0]] = True
    return out
