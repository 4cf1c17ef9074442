"""The largest eigenvalue of one pass over the constraints of a scene, which bounds the relaxation."""

from typing import TYPE_CHECKING

import numpy as np

from ..tools import golden
from .corners import corners_of

if TYPE_CHECKING:
    from ..constraints.core.scalar import Scalar
    from ..features.feature import Scene

ROUNDS = 300  # of power iteration, which converges from below; the margin from 1.2 to 4/3 covers its error


def largest_eigenvalue(scene: "Scene", scalars: "list[Scalar]", split: np.ndarray, rounds: int = ROUNDS) -> float:
    """Return lambda_max of D^-1 A for the scene as it starts: A = G w G^T, and D is its diagonal with mass-split weights."""
    w, n, dim = scene.inv_mass, len(scene.inv_mass), scene.particles.dim
    row, who = corners_of(scalars)
    G = np.concatenate([b.gradients(b.start.position).reshape(-1, dim) for b in scalars])
    D = np.bincount(row, split[who] * (G**2).sum(axis=1))
    scale = np.divide(1, np.sqrt(D), out=np.zeros(len(D)), where=D > 0)
    x = np.asarray(golden(np.arange(len(D)))) - 0.5
    value = 0.0
    for _ in range(rounds):
        pull = G * (scale * x)[row][:, None]
        move = np.stack([w * np.bincount(who, pull[:, a], minlength=n) for a in range(dim)], axis=1)
        y = scale * np.bincount(row, (G * move[who]).sum(axis=1))
        size = float(np.linalg.norm(y))
        if not size:
            return value
        value, x = size / float(np.linalg.norm(x)), y / size
    return value
