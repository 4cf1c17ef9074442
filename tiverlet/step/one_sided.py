"""Moves by rows that push and never pull, as contacts and walls do; and the walls that stop moved particles."""

from typing import Any

import numpy as np

from .jacobian import Jacobian

STEPS, ENOUGH = 32, 1e-6  # of conjugate gradients, at most; the share of r . z at which they end
TURNS = 8  # at most, until no one-sided row pulls


def move_with_walls(runner: Any, before: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put particles, which come from `before`, to x. Returns the positions before and after walls stop them, (n, dim) each."""
    state, memory = runner.scene.state, runner.memory
    state.put(memory, x)
    sent = state.get(memory)
    runner.stop_at_walls(before)
    return sent, state.get(memory)


def one_sided(jacobian: Jacobian, right: np.ndarray, one_way: np.ndarray, soft: float, steps: int = STEPS) -> np.ndarray:
    """Return the least moves, (n, dim), without rows in the mask `one_way` that would pull. steps: at most."""
    some = np.ones(len(right))
    for _ in range(TURNS):
        lam = jacobian.multipliers(right * some, some, ENOUGH, steps, soft)
        pulls = one_way & (lam < 0)
        if not pulls.any():
            break
        some[pulls] = 0.0
    return jacobian.moves(lam)


class Walls:
    """The particles that walls have stopped, (k,), and the normals there, (k, dim)."""

    def __init__(self, x: np.ndarray):
        self.who, self.normal = np.zeros(0, dtype=np.int64), np.zeros((0, x.shape[1]))

    def push(self, way: np.ndarray) -> None:
        """Add particles that walls have moved back by `way`, (n, dim) [m]."""
        length = np.linalg.norm(way, axis=1)
        new = np.setdiff1d(np.flatnonzero(length > 0), self.who)
        self.who = np.concatenate([self.who, new])
        self.normal = np.concatenate([self.normal, way[new] / length[new, None]])

    def along(self, way: np.ndarray) -> np.ndarray:
        """Return the components of `way`, (n, dim), along the normals, (k,)."""
        return (way[self.who] * self.normal).sum(axis=1)
