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
    goal, active, known = ratio**2 * np.maximum(overlap, 0.0), overlap > 0, overlap > 0
    best, soft, tied, walls = x, SOFT, rigid(runner, x), Walls(x)
    if tied:
        tied = tied.towards(ratio**2 * tied.C)
    held = stored_by(overlap - goal, gradient, w[pairs.who])
    least = first = held + tied.stored if tied else held
    for _ in range(ROUNDS):
        if least <= LEFT * ratio**2 * first:
            break
        overlap, gradient = pairs.at(best)
        some = np.flatnonzero(active)
        m, k = len(some), len(walls.who)
        row, who = [np.tile(np.arange(m), pairs.who.shape[1]), m + np.arange(k)], [*pairs.who[some].T, walls.who]
        J, right = [*gradient[some].transpose(1, 0, 2), walls.normal], [(overlap - goal)[some], np.zeros(k)]
        if tied:
            row, who, J, right = [*row, m + k + tied.row], [*who, tied.who], [*J, tied.J], [*right, -tied.C]
        wanted = np.concatenate(right)
        jacobian = Jacobian(len(wanted), np.concatenate(row), np.concatenate(who), w, np.concatenate(J))
        state.put(memory, best + jacobian.solve(wanted, enough=ENOUGH, steps=STEPS, soft=soft))
        sent = state.get(memory)
        runner.stop_at_walls(best)
        new = state.get(memory)
        walls.push(new - sent)
        overlap, gradient = pairs.at(new)
        more = overlap - goal
        active = active | (more > 0)
        stored = stored_by(more, gradient, w[pairs.who])
        now = tied.at(new) if tied else None
        stored += now.stored if now else 0.0
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


def rigid(runner: Any, x: np.ndarray) -> Rows | None:
    """The rigid constraints of the world, and its rigid clusters, where there are any that are not too large."""
    w = runner.scene.inv_mass
    scalars = [b for b in runner.batches if isinstance(b, Scalar) and b.count and not b.compliance.any()]
    some = [b for b in scalars if sizes(b).max() <= LARGEST and (~b.idle(w) & ~b.broken).any()]
    some += rigid_rows(runner.batches, w)
    return Rows(some, w, x, runner.scene.periodic) if some else None


def stored_by(overlap: np.ndarray, gradient: np.ndarray, w: np.ndarray) -> float:
    """What overlaps (m,) store, but for a factor; gradient: (m, k, dim), of particles with inverse masses w (m, k)."""
    D = (w * (gradient**2).sum(axis=2)).sum(axis=1)
    return float(np.divide(np.maximum(overlap, 0.0) ** 2, D, out=np.zeros_like(D), where=D > 0).sum())
