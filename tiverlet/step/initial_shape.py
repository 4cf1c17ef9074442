"""Shapes that are kept, for clusters that the user put out of them, or made rigid while they were.

A pass takes a rigid cluster back to its shape in one substep. By itself it is at rest after that, but what it is linked to, or
stands on, it has sent off: a square that sagged on a floor by 2 cm as it was made rigid left it at 1500 m/s, at 100 substeps. So
what initial_violation.py does for constraints that are one number is done first for clusters, and for what is linked to them:
they go to where they are in shape and their links are met, as whole bodies, without velocity. Walls push back along the normals
along which they stopped something. Clusters that share particles with others are left to passes.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..solvers.corners import bodies_of
from .clock import MET
from .initial_violation import ROUNDING, Rows
from .jacobian import Jacobian
from .one_sided import Walls, moved, one_sided
from .solids import Solids

ROUNDS = 64  # of Newton's method, at most, each with what walls stopped in the one before
BETTER = 0.9  # of what is left: rounds that leave no less, this many of them, end it
PATIENCE = 8
SOFT = 1e-6  # mu, see Jacobian


def restore(runner: Any, placed: int) -> tuple[np.ndarray, float] | None:
    """Move rigid clusters, and what is linked to them, to where they are in shape and rigid constraints are met; those that are
    stay. placed: the first of the particles that were placed anew. Returns how far each particle went [m], (n,), and what was
    taken out, as a share of the size of its cluster or constraint; None where nothing moved."""
    scene, w = runner.scene, runner.scene.inv_mass
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
        sent, new = moved(runner, best, new)
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
