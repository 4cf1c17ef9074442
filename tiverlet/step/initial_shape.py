"""Rigid clusters that the user placed out of their shape, or made rigid while deformed, are restored before the first substep.

A pass restores a rigid cluster in one substep. The cluster itself is at rest after that, but it has thrown off linked particles
and walls: a square that sagged by 2 cm on a floor left it at 1500 m/s when it was made rigid, at 100 substeps. So, as
initial_violation.py does for scalar constraints, clusters and the bodies linked to them first move to where the clusters are in
shape and the links are met, as rigid bodies and without velocity. Walls push back along the normals along which they stopped a
particle. Clusters that share particles with others are left to the passes.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..solvers.corners import bodies_of
from .clock import MET
from .initial_violation import ROUNDING, Rows
from .jacobian import Jacobian
from .one_sided import Walls, move_with_walls, one_sided
from .solids import Solids

ROUNDS = 64  # of Newton's method, at most, each with the walls that stopped particles in the one before
BETTER = 0.9  # factor by which a round must lower the violation to count as progress
PATIENCE = 8  # rounds without progress that end the iteration
SOFT = 1e-6  # mu, see Jacobian


def restore(runner: Any, placed: int) -> tuple[np.ndarray, float] | None:
    """Move rigid clusters and linked bodies to where clusters are in shape and rigid constraints are met.

    placed: the first particle that the user placed. Returns how far each particle moved, (n,) [m], and the largest violation that
    was removed, relative to the size of its cluster or constraint; None if nothing moved.
    """
    scene, w = runner.scene, runner.scene.inv_mass
    if not any(b.clusters for b in runner.batches):
        return None
    solids = Solids.rigid(runner.batches, w, placed)
    x = scene.state.get(runner.memory)
    if not solids.count or not np.isfinite(x).all():
        return None
    rigid = [b for b in runner.batches if isinstance(b, Scalar) and b.count and (b.compliance == 0).any() and not b.broken.any()]
    rows = Rows(rigid, x, w, ROUNDING[scene.real]) if rigid else None
    far = _left(solids, rows, x, w)
    if far <= solids.borne:
        return None
    best, least, walls, waited = x, np.inf, Walls(x), 0
    for _ in range(ROUNDS):
        begin = solids.fitted(best)
        J, row, who, right = [walls.normal], [np.arange(len(walls.who))], [walls.who], [walls.along(best - begin)]
        if rows:
            here = rows.at(begin)
            tied = _tied(solids, here, w)
            number = np.cumsum(tied) - 1 + len(walls.who)
            corners = tied[here.row]
            J, row, who = [*J, here.J[corners]], [*row, number[here.row[corners]]], [*who, here.who[corners]]
            right = [*right, -here.C[tied]]
        wanted = np.concatenate(right)
        jacobian = Jacobian(len(wanted), np.concatenate(row), np.concatenate(who), w, np.concatenate(J), solids.whole(begin))
        new = begin
        if len(wanted):
            new = solids.fitted(begin + one_sided(jacobian, wanted, np.arange(len(wanted)) < len(walls.who), SOFT))
        sent, new = move_with_walls(runner, best, new)
        walls.push(new - sent)
        left = _left(solids, rows, new, w)
        waited = 0 if left < BETTER * least else waited + 1
        if left < least:
            least, best = left, new
        if least <= MET or waited == PATIENCE:
            break
    scene.state.put(runner.memory, best)
    return np.linalg.norm(best - x, axis=1), far


def _left(solids: Solids, rows: Rows | None, x: np.ndarray, w: np.ndarray) -> float:
    """How far the worst of clusters, and of the rows that are tied to them, is off at x."""
    worst = float(solids.far(x).max())
    if rows:
        here = rows.at(x)
        worst = max(worst, float(np.abs(here.C * here.close)[_tied(solids, here, w)].max(initial=0.0)))
    return worst


def _tied(solids: Solids, rows: Rows, w: np.ndarray) -> np.ndarray:
    """Which rows hang together with a cluster, (rows,)."""
    m = len(rows.C)
    label, _ = bodies_of(
        m + solids.count, np.concatenate([rows.row, m + solids.owner]), np.concatenate([rows.who, solids.who]), w
    )
    return np.isin(label[:m], label[m:])
