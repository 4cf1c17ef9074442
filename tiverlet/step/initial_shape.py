"""Rigid clusters that the user placed out of their shape, or made rigid while deformed, are restored before the first substep.

A pass restores a rigid cluster in one substep. The cluster itself is at rest after that, but it has thrown off linked particles
and walls: a square that sagged by 2 cm on a floor left it at 1500 m/s when it was made rigid, at 100 substeps. So, as
initial_violation.py does for scalar constraints, clusters and the bodies linked to them first move to where the clusters are in
shape and the links are met, as rigid bodies and without velocity. Walls push back along the normals along which they stopped a
particle. Clusters that share particles move as one body, or as bodies on hinges (joined_clusters.py). Where they contradict each
other, passes without velocity follow, which end where those of the step would.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..solvers.corners import bodies_of
from .clock import MET
from .initial_violation import ROUNDING, Rows
from .jacobian import DONE, Jacobian
from .one_sided import STEPS, Walls, move_with_walls, one_sided
from .solids import SEEN, Solids

ROUNDS = 64  # of Newton's method, at most, each with the walls that stopped particles in the one before
BETTER = 0.9  # factor by which a round must lower the violation to count as progress
PATIENCE = 8  # rounds without progress that end the iteration
SOFT = 1e-6  # mu, see Jacobian
JOINED = 1000  # steps of conjugate gradients, at most, through bodies that hang on each other
PASSES, FLAT = 300, 1e-6  # over clusters that contradict each other; the relative decrease in a pass at which they end


def restore(runner: Any, placed: int) -> tuple[np.ndarray, float] | None:
    """Move rigid clusters and linked bodies to where clusters are in shape and rigid constraints are met.

    placed: the first particle that the user placed. Returns how far each particle moved, (n,) [m], and the largest violation that
    was removed, relative to the size of its cluster or constraint; None if nothing moved.
    """
    scene, w = runner.scene, runner.scene.inv_mass
    if not any(b.clusters for b in runner.batches):
        return None
    clusters = Solids.rigid(runner.batches, w, placed)
    x = scene.state.get(runner.memory)
    if not clusters.count or not np.isfinite(x).all():
        return None
    rigid = [b for b in runner.batches if isinstance(b, Scalar) and b.count and (b.compliance == 0).any() and not b.broken.any()]
    rows = Rows(rigid, x, w, ROUNDING[scene.real]) if rigid else None
    far = _left(clusters, rows, x, w)
    if far <= clusters.borne:
        return None
    solids = clusters.joined()
    copies = solids.copies
    best, least, walls, waited = x, np.inf, Walls(x), 0
    met = max(MET, ROUNDING[scene.real] * float(np.abs(x).max()) / float(solids.radius.max() or np.inf))
    for _ in range(ROUNDS):
        begin = solids.fitted(copies.lift(best))
        middle = copies.mean(begin)
        J, row, who, right = [walls.normal], [np.arange(len(walls.who))], [walls.who], [walls.along(best - middle)]
        if rows:
            here = rows.at(middle)
            tied = _tied(solids, here, w)
            number = np.cumsum(tied) - 1 + len(walls.who)
            corners = tied[here.row]
            J, row, who = [*J, here.J[corners]], [*row, number[here.row[corners]]], [*who, here.who[corners]]
            right = [*right, -here.C[tied]]
        corner = copies.corners(*(np.concatenate(part) for part in (row, who, J)))
        if copies.shared:
            *more, apart = copies.joints(begin)
            more[0] += sum(map(len, right))
            corner, right = tuple(np.concatenate(pair) for pair in zip(corner, more, strict=True)), [*right, -apart]
        wanted = np.concatenate(right)
        jacobian = Jacobian(len(wanted), corner[0], corner[1], copies.w, corner[2], solids.whole(begin))
        new = begin
        if len(wanted):
            one_way = np.arange(len(wanted)) < len(walls.who)
            new = solids.fitted(begin + one_sided(jacobian, wanted, one_way, SOFT, JOINED if copies.shared else STEPS))
        sent, new = move_with_walls(runner, best, copies.mean(new))
        walls.push(new - sent)
        left = _left(solids, rows, new, w)
        waited = 0 if left < BETTER * least else waited + 1
        if left < least:
            least, best = left, new
        if least <= met or waited == PATIENCE:
            break
    if clusters.copies.shared:
        best = _relaxed(runner, clusters, best)
        _calm(runner, solids, best)
    scene.state.put(runner.memory, best)
    return np.linalg.norm(best - x, axis=1), far


def _relaxed(runner: Any, clusters: Solids, x: np.ndarray) -> np.ndarray:
    """Return positions after passes from x, (n, dim), over clusters that contradict each other, or particles that cannot move.

    A pass moves each particle to the mean of its places in clusters, which lowers the sum of m / n times the squares of the
    distances to these. Passes of the coming substeps would do that as blows.
    """
    copies, before = clusters.copies, np.inf
    for _ in range(PASSES):
        off = float(clusters.far(copies.lift(x)).max())
        left = clusters.off(copies.lift(x))
        if off <= SEEN or left > (1 - FLAT) * before:
            break
        before, (_, x) = left, move_with_walls(runner, x, copies.mean(clusters.fitted(copies.lift(x))))
    return x


def _calm(runner: Any, solids: Solids, x: np.ndarray) -> None:
    """Take from velocities what deforms bodies at x, (n, dim): what hangs together moves on as one.

    That is the least change in the metric of the masses, v += w J^T lam with J v = 0, which adds no energy. Passes take it out of
    a single cluster in one substep, but out of a lattice in as many rounds as the square of its length.
    """
    copies, state = solids.copies, runner.scene.state
    begin = solids.fitted(copies.lift(x))
    whole: Any = solids.whole(begin)
    v = runner.memory.read(state.d).astype(np.float64)
    new = whole(copies.lift(v[: copies.n]))
    if copies.shared:
        row, who, J, apart = copies.joints(begin)
        jacobian = Jacobian(len(apart), row, who, copies.w, J, whole)
        new = new + jacobian.solve(-jacobian.rates(new), enough=DONE, steps=JOINED)
    v[: copies.n] = copies.mean(new)
    runner.memory.write(state.d, v)


def _left(solids: Solids, rows: Rows | None, x: np.ndarray, w: np.ndarray) -> float:
    """How far the worst of clusters, and of the rows that are tied to them, is off at x."""
    worst = float(solids.far(solids.copies.lift(x)).max())
    if rows:
        here = rows.at(x)
        worst = max(worst, float(np.abs(here.C * here.close)[_tied(solids, here, w)].max(initial=0.0)))
    return worst


def _tied(solids: Solids, rows: Rows, w: np.ndarray) -> np.ndarray:
    """Which rows hang together with a cluster, (rows,)."""
    m = len(rows.C)
    who = np.concatenate([rows.who, solids.copies.particle[solids.who]])
    label, _ = bodies_of(m + solids.count, np.concatenate([rows.row, m + solids.owner]), who, w)
    return np.isin(label[:m], label[m:])
