"""Moves of particles that contacts and walls make, which push and never pull; and what walls stop of them."""

from typing import Any

import numpy as np

from .jacobian import Jacobian

STEPS, ENOUGH = 32, 1e-6  # of conjugate gradients, at most; what of r . z they leave
TURNS = 8  # at most, until nothing pulls that cannot


def moved(runner: Any, before: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Put particles to x, where they come from `before`: where they are then, and where walls stop them."""
    state, memory = runner.scene.state, runner.memory
    state.put(memory, x)
    sent = state.get(memory)
    runner.stop_at_walls(before)
    return sent, state.get(memory)


def one_sided(jacobian: Jacobian, right: np.ndarray, one_way: np.ndarray, soft: float) -> np.ndarray:
    """The least moves, of which none is made by a row that goes one way and pulls."""
    some = np.ones(len(right))
    for _ in range(TURNS):
        lam = jacobian.multipliers(right * some, some, ENOUGH, STEPS, soft)
        pulls = one_way & (lam < 0)
        if not pulls.any():
            break
        some[pulls] = 0.0
    return jacobian.moves(lam)


class Walls:
    """Which particles were stopped by walls, (k,), and along which normals, (k, dim)."""

    def __init__(self, x: np.ndarray):
        self.who, self.normal = np.zeros(0, dtype=np.int64), np.zeros((0, x.shape[1]))

    def push(self, way: np.ndarray) -> None:
        """Note how far walls took particles back, (n, dim)."""
        length = np.linalg.norm(way, axis=1)
        new = np.setdiff1d(np.flatnonzero(length > 0), self.who)
        self.who = np.concatenate([self.who, new])
        self.normal = np.concatenate([self.normal, way[new] / length[new, None]])

    def along(self, way: np.ndarray) -> np.ndarray:
        """How much of a way, (n, dim), is along the normals, (k,)."""
        return (way[self.who] * self.normal).sum(axis=1)
