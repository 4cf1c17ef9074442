"""What contacts overlap by becomes less where the substep gets shorter: else it would become energy.

A pass holds a load F by an overlap C = D h^2 F, as a spring of stiffness 1 / (D h^2) would. A shorter substep h' makes that
spring stiffer while it is pressed, and its energy (h / h')^2 times as large. So positions first go to where the same loads need
the overlap (h' / h)^2 C, by the least moves in the metric of the masses, and velocities stay:

    x += w J^T lam,  (J w J^T + mu D) lam = C - (h' / h)^2 C_0,  D the diagonal of J w J^T

for what overlaps, whatever its geometry (Candidates); what the moves push into each other parts again, C_0 = 0. Constraints go
to where the same loads need them, as in projection.py: that alone would push bodies into each other again. Clusters move as a
whole, and out of the shape that contacts and walls have left them in (Solids). Nothing moves into walls that stopped it, and
these only push. mu falls while what is stored does, the sum of C^2 / D, and rises where it does not (Levenberg and Marquardt).
Motion pays for what is lifted, as in projection.py.
"""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..contact.candidates import Candidates, DiscCandidates
from .contact_rows import stored_by
from .free_bodies import FreeBodies
from .jacobian import Jacobian
from .projection import Rows, given_back, matters, paid, seen, seen_before
from .rails import tethered
from .rigid_rows import rigid_rows
from .solids import Solids

SOFT, SOFTEST = 1e-2, 1e-5  # mu of the first round, and the least
STEPS, ENOUGH = 32, 1e-6  # of conjugate gradients, at most; what of r . z they leave
ROUNDS = 16  # of them, each with what particles were pushed into in the one before
TURNS = 8  # at most, until nothing pulls that cannot
LEFT = 0.01  # of what overlaps store: what may be left of it in the shorter substep


def release(runner: Any, h: float, longest: float, small: bool = False) -> bool:
    """Take out what overlaps would store; d holds velocities. Nothing happens where they are small, unless `small` asks for it.

    h: the coming substep [s]; longest: since this was done last. Returns whether overlaps have been looked after.
    """
    state, memory, step, ratio = runner.scene.state, runner.memory, runner.step, h / longest
    x, contact = state.get(memory), next(iter(step.contacts), None)
    if not (contact or step.walls) or not np.isfinite(x).all():
        return False
    solids = Solids.loaded(runner, x, ratio)
    if not (contact or solids.count):
        return False
    energy, overlap = seen_before(runner)
    if not small and not matters(max(overlap, solids.worst), ratio):
        return False
    pairs: Candidates = DiscCandidates(np.zeros((0, 2), dtype=np.int64), np.zeros(0), None)
    if contact:
        runner.invalidate()  # so that it does not matter when they were listed last
        runner.look()
        pairs = contact.dev.geometry.candidates(x)
    jacobian = part(runner, pairs, solids, x, ratio)
    if jacobian:
        v, now = memory.read(state.d).astype(np.float64), state.get(memory)
        stopped = tethered(runner)
        stopped[jacobian.who[np.bincount(jacobian.row)[jacobian.row] == 1]] = True
        bodies = FreeBodies(jacobian, now, stopped)
        v[: len(x)], spun = bodies.spun(v[: len(x)], x, v[: len(x)])
        memory.write(state.d, v)
        due = seen(runner)[0] - energy - given_back(runner, energy, spun)
        if due > 0:
            v[: len(x)] = paid(jacobian, v[: len(x)], bodies.unturned(now - x), due)
            memory.write(state.d, v)
    return True


def part(runner: Any, pairs: Candidates, solids: Solids, x: np.ndarray, ratio: float) -> Jacobian | None:
    """Move particles from x, (n, dim), until what they store is about ratio^4 of it, or as near to that as they get; returns the
    rows of the last round."""
    state, memory, w, jacobian = runner.scene.state, runner.memory, runner.scene.inv_mass, None
    overlap = pairs.at(x)[0]
    known = active = overlap > 0
    goal = ratio**2 * np.maximum(overlap, 0.0)
    soft, tied, walls = SOFT, bound(runner, x, ratio), Walls(x)

    def seen_at(x: np.ndarray) -> tuple[float, np.ndarray, Rows | None]:
        """What is stored there, how much deeper contacts are than they are to be, and the rows of constraints."""
        overlap, gradient = pairs.at(x)
        rows = tied.at(x) if tied else None
        stored = stored_by(overlap - goal, gradient, w[pairs.who]) + solids.off(x)
        return stored + (rows.stored if rows else 0.0), overlap - goal, rows

    first = seen_at(x)[0]
    best = moved(runner, x, solids.fitted(x))[1] if solids.count else x
    least = seen_at(best)[0]
    for _ in range(ROUNDS):
        if least <= LEFT * ratio**2 * first:
            break
        begin = solids.fitted(best)
        gradient, (_, more, rows) = pairs.at(begin)[1], seen_at(begin)
        some = np.flatnonzero(active)
        m, k = len(some), len(walls.who)
        row, who = [np.tile(np.arange(m), pairs.who.shape[1]), m + np.arange(k)], [*pairs.who[some].T, walls.who]
        J, right = [*gradient[some].transpose(1, 0, 2), walls.normal], [more[some], walls.along(best - begin)]
        if rows:
            row, who, J, right = [*row, m + k + rows.row], [*who, rows.who], [*J, rows.J], [*right, -rows.C]
        if solids.count:  # a row of nothing for each, which tells what hangs together
            row, who = [*row, sum(map(len, right)) + solids.owner], [*who, solids.who]
            J, right = [*J, np.zeros((len(solids.who), x.shape[1]))], [*right, np.zeros(solids.count)]
        wanted = np.concatenate(right)
        jacobian = Jacobian(len(wanted), np.concatenate(row), np.concatenate(who), w, np.concatenate(J), solids.whole(begin))
        one_way = np.arange(len(wanted)) < m + k
        one_way[:m] = ~known[some]
        sent, new = moved(runner, best, solids.fitted(begin + one_sided(jacobian, wanted, one_way, soft)))
        walls.push(new - sent)
        stored, more, _ = seen_at(new)
        if stored < least:
            best, least, soft, active = new, stored, max(soft / 4, SOFTEST), known | (more > 0)
        else:
            soft, active = 10 * soft, active | (more > 0)
    state.put(memory, best)
    return jacobian


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


def bound(runner: Any, x: np.ndarray, ratio: float) -> Rows | None:
    """The constraints of the world, and rigid clusters that share particles with others; C is measured from what it is to be, as
    in projection.py."""
    w = runner.scene.inv_mass
    scalars = [b for b in runner.batches if isinstance(b, Scalar) and b.count]
    some = [b for b in scalars if (~b.immovable(w) & ~b.broken).any()]
    some += rigid_rows([b for b in runner.batches if b.clusters], w)
    if not some:
        return None
    rows = Rows(some, w, x, runner.scene.periodic)
    return rows.towards(rows.C - (1 - ratio**2) * rows.undone(runner))
