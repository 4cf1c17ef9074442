"""Cluster release: reduces the deformation of clusters on walls before the substep gets shorter. Else it would become energy.

A pass holds a load F by a deformation C = D h^2 F, like a spring of stiffness 1 / (D h^2). A shorter substep h' makes that spring
stiffer while it is pressed, and its energy (h / h')^2 times as large. So clusters first move as rigid bodies to where the same
loads need the deformation (h' / h)^2 C, and velocities stay. Constraints move to the violations that the same loads need, by the
least moves in the metric of the masses, as in projection.py:

    x += w J^T lam,  (J w J^T + mu D) lam = C - (h' / h)^2 C_0,  D the diagonal of J w J^T

Particles do not move into walls that stopped them, and walls only push. mu falls while the stored energy, the sum of C^2 / D,
falls, and rises otherwise (Levenberg and Marquardt). Motion pays for lifted particles, as in projection.py.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from .cluster_rows import cluster_rows
from .free_bodies import FreeBodies
from .jacobian import Jacobian
from .one_sided import Walls, move_with_walls, one_sided
from .projection import Rows, given_back, seen, seen_before, take_energy, would_vibrate
from .rails import tethered
from .sideways_rows import sideways_rows
from .solids import Solids

SOFT, SOFTEST = 1e-2, 1e-5  # mu of the first round, and the least
ROUNDS = 16  # of moves, at most
LEFT = 0.01  # of the energy that clusters store: what may be left of it in the shorter substep


def release(runner: Any, h: float, longest: float, small: bool = False) -> bool:
    """Remove the energy that clusters would store in a shorter substep; d holds velocities.

    Nothing happens if deformations are small, unless `small`. h: the coming substep [s]. longest: the longest substep since the
    last release [s]. Returns whether clusters have been treated.
    """
    state, memory, step, ratio = runner.scene.state, runner.memory, runner.step, h / longest
    x = state.get(memory)
    if not (step.walls and np.isfinite(x).all()):
        return False
    solids = Solids.loaded(runner, x, ratio)
    if not solids.count:
        return False
    energy, overlap = seen_before(runner)
    if not small and not would_vibrate(max(overlap, solids.worst), ratio):
        return False
    jacobian = part(runner, solids, x, ratio)
    if jacobian:
        v, now = memory.read(state.d).astype(np.float64), state.get(memory)
        stopped = tethered(runner)
        stopped[jacobian.who[np.bincount(jacobian.row)[jacobian.row] == 1]] = True
        bodies = FreeBodies(jacobian, now, stopped)
        v[: len(x)], spun = bodies.spun(v[: len(x)], x, v[: len(x)])
        memory.write(state.d, v)
        due = seen(runner)[0] - energy - given_back(runner, energy, spun)
        if due > 0:
            v[: len(x)] = take_energy(jacobian, v[: len(x)], bodies.unturned(now - x), due)
            memory.write(state.d, v)
    return True


def part(runner: Any, solids: Solids, x: np.ndarray, ratio: float) -> Jacobian | None:
    """Move particles from x, (n, dim), until clusters store about ratio^4 of their energy, or as near to that as possible.

    Returns the Jacobian of the last round; None if there was none.
    """
    state, memory, w, jacobian = runner.scene.state, runner.memory, runner.scene.inv_mass, None
    soft, tied, walls = SOFT, bound(runner, x, ratio), Walls(x)

    def seen_at(x: np.ndarray) -> tuple[float, Rows | None]:
        """Return the energy stored at x, and the rows of constraints."""
        rows = tied.at(x) if tied else None
        return solids.off(x) + (rows.stored if rows else 0.0), rows

    first = seen_at(x)[0]
    best = move_with_walls(runner, x, solids.fitted(x))[1]
    least = seen_at(best)[0]
    for _ in range(ROUNDS):
        if least <= LEFT * ratio**2 * first:
            break
        begin = solids.fitted(best)
        rows = seen_at(begin)[1]
        k = len(walls.who)
        row, who, J, right = [np.arange(k)], [walls.who], [walls.normal], [walls.along(best - begin)]
        if rows:
            row, who, J, right = [*row, k + rows.row], [*who, rows.who], [*J, rows.J], [*right, -rows.C]
        # An empty row for each cluster, which connects its particles.
        row, who = [*row, sum(map(len, right)) + solids.owner], [*who, solids.who]
        J, right = [*J, np.zeros((len(solids.who), x.shape[1]))], [*right, np.zeros(solids.count)]
        wanted = np.concatenate(right)
        jacobian = Jacobian(len(wanted), np.concatenate(row), np.concatenate(who), w, np.concatenate(J), solids.whole(begin))
        one_way = np.arange(len(wanted)) < k
        sent, new = move_with_walls(runner, best, solids.fitted(begin + one_sided(jacobian, wanted, one_way, soft)))
        walls.push(new - sent)
        stored = seen_at(new)[0]
        if stored < least:
            best, least, soft = new, stored, max(soft / 4, SOFTEST)
        else:
            soft = 10 * soft
    state.put(memory, best)
    return jacobian


def bound(runner: Any, x: np.ndarray, ratio: float) -> Rows | None:
    """Return rows of the world's constraints and of rigid clusters that share particles with others; None without any.

    C is measured from its goal, as in projection.py.
    """
    w = runner.scene.inv_mass
    scalars = [b for b in runner.batches if isinstance(b, Scalar) and b.count]
    some = [b for b in scalars if (~b.immovable(w) & ~b.broken).any()]
    some += sideways_rows(some)
    some += cluster_rows([b for b in runner.batches if b.clusters], w)
    if not some:
        return None
    rows = Rows(some, w, x, runner.scene.periodic)
    return rows.with_goal(rows.C - (1 - ratio**2) * rows.undone(runner))
