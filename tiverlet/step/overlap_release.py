"""What contacts overlap by becomes less where the substep gets shorter: else it would become energy.

A pass holds a load F by an overlap C = D h^2 F, as a spring of stiffness 1 / (D h^2) would. A shorter substep h' makes that
spring stiffer while it is pressed, and its energy (h / h')^2 times as large. So positions first go to where the same loads need
the overlap (h' / h)^2 C, by the least moves in the metric of the masses, and velocities stay:

    x += w J^T lam,  (J w J^T + mu D) lam = C - (h' / h)^2 C_0,  D the diagonal of J w J^T

for discs or spheres that overlap; those that the moves push into each other part again, C_0 = 0. What a wall has stopped does
not move into it again, and rigid constraints keep what they measure. mu falls while that helps and rises where it does not
(Levenberg and Marquardt). Motion pays for what is lifted, as in projection.py.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..contact.candidates import Candidates
from .jacobian import Jacobian
from .projection import LARGEST, Rows, matters, paid, seen, seen_before, sizes
from .rigid_rows import rigid_rows
from .solids import Solids

SOFT, SOFTEST = 1e-2, 1e-5  # mu of the first round, and the least
STEPS, ENOUGH = 32, 1e-6  # of conjugate gradients, at most; what of r . z they leave
ROUNDS = 16  # of them, each with what particles were pushed into in the one before
LEFT = 0.01  # of what overlaps store: what may be left of it in the shorter substep


def release(runner: Any, h: float, longest: float) -> bool:
    """Take out what overlaps would store; d holds velocities. Nothing happens where they are small.

    h: the coming substep [s]; longest: since this was done last. Returns whether overlaps have been looked after.
    """
    state, memory, ratio = runner.scene.state, runner.memory, h / longest
    x = state.get(memory)
    contact = next(iter(runner.step.contacts), None)
    if contact is None or not np.isfinite(x).all():
        return False
    energy, overlap = seen_before(runner)
    if not matters(overlap, ratio):
        return False
    runner.invalidate()  # so that it does not matter when they were listed last
    runner.look()
    jacobian = part(runner, contact.dev.geometry.candidates(x), x, ratio)
    more = seen(runner)[0]
    if jacobian and more > energy:
        d = memory.read(state.d)
        v = d.astype(np.float64)
        v[: len(x)] = paid(jacobian, v[: len(x)], state.get(memory) - x, more - energy)
        memory.write(state.d, v)
    return True


def part(runner: Any, pairs: Candidates, x: np.ndarray, ratio: float) -> Jacobian | None:
    """Move particles from x, (n, dim), until their overlaps are ratio^2 of what they are, or as near to that as they get; returns
    the rows of the last round."""
    state, memory, w, jacobian = runner.scene.state, runner.memory, runner.scene.inv_mass, None
    overlap, gradient = pairs.at(x)
    known = active = overlap > 0
    goal = ratio**2 * np.maximum(overlap, 0.0)
    best, soft, tied, walls = x, SOFT, bound(runner, x, ratio), Walls(x)
    solids = Solids(runner.batches, w, x, ratio**2)

    def storing(x: np.ndarray, more: np.ndarray, gradient: np.ndarray, tied: Rows | None) -> float:
        return stored_by(more, gradient, w[pairs.who]) + (tied.stored if tied else 0.0) + solids.off(x)

    least = first = storing(x, overlap - goal, gradient, tied)
    for _ in range(ROUNDS):
        if least <= LEFT * ratio**2 * first:
            break
        begin = solids.fitted(best) if solids.count else best
        now = tied.at(begin) if tied and solids.count else tied
        overlap, gradient = pairs.at(begin)
        some = np.flatnonzero(active)
        m, k = len(some), len(walls.who)
        row, who = [np.tile(np.arange(m), pairs.who.shape[1]), m + np.arange(k)], [*pairs.who[some].T, walls.who]
        J, right = [*gradient[some].transpose(1, 0, 2), walls.normal], [(overlap - goal)[some], walls.back(best - begin)]
        if now:
            row, who, J, right = [*row, m + k + now.row], [*who, now.who], [*J, now.J], [*right, -now.C]
        if solids.count:  # rows of nothing tell which particles hang together
            row, who = [*row, sum(map(len, right)) + solids.owner], [*who, solids.who]
            J, right = [*J, np.zeros((len(solids.who), x.shape[1]))], [*right, np.zeros(solids.count)]
        wanted = np.concatenate(right)
        jacobian = Jacobian(
            len(wanted), np.concatenate(row), np.concatenate(who), w, np.concatenate(J), solids.at(begin)
        )
        move = jacobian.solve(wanted, enough=ENOUGH, steps=STEPS, soft=soft)
        state.put(memory, solids.fitted(begin + move) if solids.count else begin + move)
        sent = state.get(memory)
        runner.stop_at_walls(best)
        new = state.get(memory)
        walls.push(new - sent)
        overlap, gradient = pairs.at(new)
        more, now = overlap - goal, tied.at(new) if tied else None
        stored = storing(new, more, gradient, now)
        active = active | (more > 0)
        if stored < least:
            best, least, tied, soft = new, stored, now, max(soft / 4, SOFTEST)
            active = known | (more > 0)
        else:
            soft *= 10
    state.put(memory, best)
    return jacobian


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

    def back(self, way: np.ndarray) -> np.ndarray:
        """How much of a way, (n, dim), is along the normals, (k,)."""
        return (way[self.who] * self.normal).sum(axis=1)


def bound(runner: Any, x: np.ndarray, ratio: float) -> Rows | None:
    """The constraints of the world that are not too large, and rigid clusters that share particles with others; with what they are
    to give up, as in projection.py."""
    w = runner.scene.inv_mass
    scalars = [b for b in runner.batches if isinstance(b, Scalar) and b.count]
    some = [b for b in scalars if sizes(b).max() <= LARGEST and (~b.idle(w) & ~b.broken).any()]
    some += rigid_rows([b for b in runner.batches if b.clusters], w)
    if not some:
        return None
    rows = Rows(some, w, x, runner.scene.periodic)
    return rows.towards(rows.C - (1 - ratio**2) * rows.undone(runner))


def stored_by(overlap: np.ndarray, gradient: np.ndarray, w: np.ndarray) -> float:
    """What overlaps (m,) store, but for a factor; gradient: (m, k, dim), of particles with inverse masses w (m, k)."""
    D = (w * (gradient**2).sum(axis=2)).sum(axis=1)
    return float(np.divide(np.maximum(overlap, 0.0) ** 2, D, out=np.zeros_like(D), where=D > 0).sum())
