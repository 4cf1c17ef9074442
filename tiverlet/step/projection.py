"""Projection: reduces the violations that passes leave, before the substep gets shorter. Without it they would become energy.

A pass holds a load F by a violation Z = D h^2 F, in addition to that of its compliance, like a spring of stiffness 1 / (D h^2). A
shorter substep h' makes that spring stiffer while it is stretched, and its energy (h / h')^2 times as large. So positions first
move to where the same loads need the violations (h' / h)^2 Z, and velocities change so that they keep these:

    x += w J^T lam,  C(x) = C - (1 - (h' / h)^2) Z;     v += w J^T lam,  (J w J^T + mu) lam = u - J v

with u the rates of rest values, as those of motors. Z is the residual violation of the last substep, C + alpha lam / h^2 for
particles at rest. Springs that the substep resolves stay as they are. Positions move without changing velocities, as for contacts
that an impact left overlapping.

Where contacts are in the way, they are rows, too (ContactRows). Moves may lead into further contacts, which become rows in a few
rounds. Springs that hold particles at places are rows (AnchorRows). Beads are first drawn to their wires, and then stay on them
(Rails), and free bodies keep their angular momentum (FreeBodies).

Where moves lift particles, the motion pays for the energy as far as it can. A taut net has no direction to sag in, so its fall
does not show in velocities; lifting it back at the end of each fall would pump energy in. The energy gained is taken from the
velocities: first from the part along the moves, then from all motion of anchored bodies. A body that hangs at rest is lifted for
nothing, since its fall became heat when it stretched.
"""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..constraints.core.drive import STALL
from ..constraints.core.scalar import Scalar
from ..neighbours.queries import between
from ..particles import LARGEST
from ..solvers.corners import bodies_of
from .anchor_rows import AnchorRows, anchor_rows
from .block_matrix import WIDEST, BlockMatrix, WideRows, summed
from .clock import CHANGED
from .cluster_rows import ClusterRows, cluster_rows, left_out
from .free_bodies import FreeBodies
from .integrator import h2_effective_of
from .jacobian import Jacobian
from .one_sided import move_with_walls
from .rails import Rails, tethered
from .sideways_rows import SidewaysRows, sideways_rows
from .solids import Solids

if TYPE_CHECKING:
    from .clock import Clock
    from .runner import Runner

ENOUGH = 1e-3  # of its size: a violation that matters, divided by (r - 1)^2 / r, r = (h / h')^2: what one jump leaves to vibrate
# The same where a loop measures dt, for substeps of at least UNEVEN of the longest one, unless the scene would have more energy
# than ever. As much is lost where frames get longer.
LOOSE, UNEVEN = 0.2, 0.3
SAFE = 0.9  # of break_at: what a load may become there
FRAIL = 0.01  # of break_at: the extra load that a violation may cause in a shorter substep
FIRM = 0.9  # theta from which on velocities must not change a constraint
FAR = 0.75  # of the longest substep: below, violations that are small now are settled
NEWTON = 40  # steps, at most
PRODUCTS = 1e9  # multiplications, at most: some seconds, after which the remaining violations stay
QUICK = 1 / 32  # of these where a loop measures dt: a wait would make the next frame still longer
BEGIN, HARDEST, LEAST = 1e-3, 10.0, 1e-9  # mu of the first and of the last try; the least mu
FINE, STALLED = 1e-5, 0.05  # mu from which on a step must remove this share of the stored energy, or violations are left
SLIGHT = 0.01  # of the kinetic energy: what violations may become where walls are in the way
SLIGHTEST = 1e-3  # of the kinetic energy inside bodies: what violations, and moves in the next substep, may add to it
LOOKS = 8  # steps of conjugate gradients, to estimate the moves of a solver
LEFT = 0.01  # of the energy that violations store: what may be left of it in the shorter substep
DONE = 1e-6, 1e-13  # of its size: a violation that counts as none; and one that breaks nothing in the shortest substep
TURNS = 16  # with walls, at most: a link that stands on a wall halves its violation in each
WORSE = 2.0  # times the energy stored before: a result that stores more is discarded
HELD = 1e3  # of its mass: the stiffness with which a wall holds a particle that it has stopped
GRIP = 1e-3  # of the push of a wall: the tangential part from which on friction holds a particle


class Aims(NamedTuple):
    """The aims of _newton().

    share: what may be left of the stored energy, and of the work of a solver with so many `steps`. slight: the amount of both
    that may be left in any case. products: multiplications, at most. done: a violation that counts as none, as a share of its
    size.
    """

    share: float
    steps: int
    slight: float
    products: float
    done: float


def project(runner: "Runner", h: float, dt: float, longest: float, measured: bool = False, stiffens: bool = False) -> bool | None:
    """Remove the energy that violations would store in a shorter substep; d holds velocities.

    Nothing happens if violations are small. h: the coming substep [s], of a frame dt [s]. longest: the longest substep since the
    last projection [s]. measured: whether a loop measures dt; then more violation counts as small. stiffens: whether systems that
    give way are to bear their loads again; if not, they remain as soft as they are.
    Returns whether positions are settled for h; None where that fails and the energy is more than a hundredth of the kinetic
    energy.
    """
    ratio = h / longest
    uneven = measured and ratio >= UNEVEN
    breaks = any(b.breaks for b in runner.batches)  # then rows are needed, to compare their loads
    slots, enough = runner.scene.slots, LOOSE if uneven and not breaks else ENOUGH
    w, state, memory = runner.scene.inv_mass, runner.scene.state, runner.memory
    x = before = state.get(memory)
    if not (np.abs(x) < LARGEST).all():  # or NaN
        return True
    batches: list[Any] = [b for b in runner.batches if isinstance(b, Scalar) and b.count]
    stays = left_out(runner.batches, w, x, runner.clock.h)
    if would_vibrate(stays, ratio, enough):
        runner.released = stays
    system = slots and slots.system
    if system and not (system.steps or system.count_relaxed_alone(runner.batches)):
        # It holds loads without a violation, or gives way.
        batches = [b for b in batches if would_vibrate(_off(b, x, ~system.gives_way(b, stiffens)), ratio, enough)]
    batches += sideways_rows(batches)
    batches += anchor_rows(runner.batches, x)
    clusters = Solids.loaded(runner, x, 1.0, apart=False)  # a fast test
    if batches or would_vibrate(clusters.worst, ratio, enough):
        batches += cluster_rows(runner.batches, w)
    elif clusters.count and clusters.copies.shared:
        return ratio < FAR
    if not batches:
        return True
    rails = Rails(runner, x)
    start = Rows(batches, w, x, runner.scene.periodic, rails)
    undone = start.undone(runner)
    load = np.abs(start.multipliers(runner, undone)) / h2_effective_of(runner.clock)
    stored = float((load * np.abs(undone)).sum()) / 2
    uneven = uneven and is_slight(runner.clock, stored, ratio)
    enough = LOOSE if uneven else ENOUGH
    frail = start.would_break(undone, load, h, longest, uneven)
    off = max(float(np.abs(undone * start.close).max(initial=0.0)), rails.worst / runner.scene.particles.size)
    if not frail and not would_vibrate(off, ratio, enough):
        return uneven or ratio < FAR
    share = 1.0 if stiffens else 1 - ratio**2  # of the violations: what goes
    start = start.with_goal(start.C - share * undone)
    rows = start.at(rails.drawn(x, share)) if rails.worst else start
    kept = memory.read(state.d)
    v = kept.astype(np.float64)
    n = len(x)
    # A solver that converges removes remaining violations at once in the next substep, which leaves velocities.
    steps = LOOKS if slots.converges or slots.exact else 0
    slight = SLIGHTEST * 2 * h * h * start.kinetic(v[:n])
    still = (undone != 0) & (start.theta > FIRM)
    v[:n] += rows.jacobian.solve((rows.pace(runner, h, dt) - rows.jacobian.rates(v[:n])) * still, still)
    energy, overlap = seen_before(runner)
    finest = ratio**4 if frail else ratio**2  # by loads, or by energies
    products = PRODUCTS * (QUICK if measured else 1.0)
    aims = Aims(LEFT * finest, steps, 0.0 if frail else slight, products, DONE[frail])
    rows, stopped = _moved(runner, start, _leaning(runner, rows, share), aims)
    x = rows.x
    bodies = FreeBodies(start.jacobian, x, stopped | tethered(runner))
    v[:n], spun = bodies.spun(v[:n], before, kept[:n])
    memory.write(state.d, v)
    runner.invalidate()  # moves may lead to particles that are not listed
    more, deeper = seen(runner)
    if deeper > overlap or rows.stored > WORSE * start.stored:
        state.put(memory, before)
        memory.write(state.d, kept)
        stake = max(_over(start.weight * undone**2, start.diagonal).sum() / (2 * h * h), stored / ratio**2)
        kinetic = (start.mass[:, None] * kept[:n].astype(np.float64) ** 2).sum() / 2
        return None if stake > SLIGHT * kinetic else True
    due = more - energy - given_back(runner, energy, spun)
    if due > 0:
        moves = bodies.unturned(x - before)
        v[:n] = take_energy(start.jacobian, v[:n], moves, due, rows.wall.any(axis=1), bodies)
        memory.write(state.d, v)
    return True


def stiffen(runner: "Runner", h: float, dt: float, longest: float, measured: bool) -> None:
    """Let systems that gave way in a longer substep bear their loads again in substeps of h [s], if no energy comes from that.

    Otherwise one long frame would leave a chain so soft that it stretches ever further. Once it is stiff, its violations store
    (longest / h)^2 of their energy. So they are removed first, and the motion pays for it. The scene must not have more energy
    afterwards than it ever had.
    """
    system = runner.scene.slots.system if runner.scene.slots else None
    if not (system and system.can_stiffen):
        return
    state, memory, clock = runner.scene.state, runner.memory, runner.clock
    x, d, energy = state.get(memory), memory.read(state.d), seen_before(runner)[0]
    most = energy if clock.bound is None else max(energy, clock.bound)
    done = project(runner, h, dt, longest, measured=measured, stiffens=True)
    if done:
        room = most + SLIGHTEST * clock.kinetic - seen(runner)[0]
        if room >= 0 and system.stiffen(state.get(memory), h, room):
            return
    state.put(memory, x)
    memory.write(state.d, d)
    runner.invalidate()


def _leaning(runner: "Runner", rows: "Rows", share: float) -> "Rows":
    """Return the rows with particles that walls bear held on these walls, and held along them by friction.

    So a standing body does not turn over its feet, nor walk. share: the part of the pull of links that the rows give up.
    """
    if not runner.step.walls:
        return rows
    push = runner.memory.read(runner.step.particles.wall_displacement)[: rows.n].astype(np.float64)
    sent, stopped = move_with_walls(runner, rows.x, rows.x - push)
    normal = _units(stopped - sent)
    runner.scene.state.put(runner.memory, rows.x)
    along = np.linalg.norm(push - (push * normal).sum(axis=1)[:, None] * normal, axis=1)
    friction = any(w.has_friction for w in runner.step.walls)
    return rows.leaning(normal, push, share, friction & (along > GRIP * np.linalg.norm(push, axis=1)))


def _moved(runner: "Runner", start: "Rows", rows: "Rows", aims: Aims) -> tuple["Rows", np.ndarray]:
    """Move particles by _newton(), in turns with walls. Returns the rows there, and a mask of particles that walls stopped.

    start: the rows whose stored energy aims.share refers to.
    """
    before, enough = rows.x, aims.share * start.stored
    stopped = np.linalg.norm(rows.wall, axis=1) > 0
    for _ in range(TURNS):
        sent, x = move_with_walls(runner, before, _newton(rows, enough, aims))
        stopped |= (x != sent).any(axis=1)
        last, rows = rows, rows.at(x)  # other particles lift those that walls stop
        slips = rows.sticks.any() and rows.stored > enough  # friction does not hold two feet against each other
        if ((x == sent).all() and not slips) or rows.matrix.products > aims.products:
            break
        if rows.stored > last.stored or last.wall.any():  # particles on walls would be sent into them again and again
            rows = rows.held(last.wall, x - sent)
            if rows.stored <= enough:
                break
    return rows, stopped


def _newton(rows: "Rows", enough: float, aims: Aims) -> np.ndarray:
    """Return positions at which violations store at most `enough` [J s^2], and a solver would do little work, m p^2.

    That work, of a solver with aims.steps steps, is at most aims.share of that at the begin. Amounts below aims.slight are always
    accepted.
    """
    mu, begin = BEGIN, rows.work(aims.steps)
    for _ in range(NEWTON):
        new = rows.at(rows.x + rows.step(mu))
        better = new.stored < rows.stored
        stalled = better and mu <= FINE and new.stored > (1 - STALLED) * rows.stored
        mu = max(mu / 8, LEAST) if better else 8 * mu
        if better:
            rows = new
        near = rows.stored <= max(enough, aims.slight) and rows.work(aims.steps) <= max(aims.share * begin, aims.slight)
        if near or stalled or rows.worst <= aims.done or mu > HARDEST or rows.matrix.products > aims.products:
            break
    return rows.x


def would_vibrate(violation: float, ratio: float, enough: float = ENOUGH) -> bool:
    """Whether a violation, as a share of its size, would leave so much vibration that it must be removed. ratio: h' / h."""
    return violation * (1 - ratio**2) ** 2 > enough * ratio**2


def _off(batch: Scalar, x: np.ndarray, some: np.ndarray) -> float:
    """Return the worst violation of rigid constraints in the mask `some`, as a share of their size, as Newton's method leaves
    after an impact."""
    C = batch.violation(x) * batch.inverse_size(batch.start.position) * (batch.compliance == 0) * ~batch.broken * some
    return float((np.abs(C) if batch.side == 0 else C * batch.side).max(initial=0.0))


def _remembered(batch: Any, read: Any, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return C at the start of the last substep, and the multiplier, of springs, (m,) each; 0 for rigid batches. x: positions."""
    count, spring = batch.count, batch.dev.spring
    if isinstance(batch, ClusterRows):
        return batch.remembered(x)
    if isinstance(batch, AnchorRows):
        return batch.along(read(spring.last)), batch.along(read(batch.dev.lam))
    if not spring.soft:
        return np.zeros(count), np.zeros(count)
    return read(spring.last)[:count] - batch.rest_now, read(batch.dev.equation.lam)[:count]


def _pace(runner: Any, batch: Any, x: np.ndarray, h: float, dt: float) -> np.ndarray:
    """How fast the rest value of each constraint goes in the coming substep h, of a frame dt, (m,); 0 where it waits at x."""
    if getattr(batch, "driven", False):
        off = np.abs(batch.violation(x)) * batch.inverse_size(batch.start.position)
        return batch.dev.equation.drive.rates(h)[: batch.count] * (off < STALL)
    if any(batch is b for b in runner.ramping):
        _field, goal, difference = batch.tracks()[0]
        return -difference(batch.ramp.now()[0], goal) / dt
    return np.zeros(batch.count)


def seen(runner: Any) -> tuple[float, float]:
    """Return the energy [J], and the overlap of the worst contact, in radii."""
    runner.diagnose_state()
    report = runner.report()
    return report.energy, report.overlap


def seen_before(runner: Any) -> tuple[float, float]:
    """Return energy and overlap as seen() does, before positions move.

    The energy is that at the end of the last frame, if known: it does not contain the energy of violations as springs.
    """
    energy, overlap = seen(runner)
    return energy if runner.clock.energy is None else runner.clock.energy, overlap


def sizes(batch: Scalar | AnchorRows | SidewaysRows | ClusterRows) -> np.ndarray:
    """Return the number of corners of each constraint, (m,)."""
    return np.bincount(batch.owner, minlength=batch.count)


def _units(a: np.ndarray) -> np.ndarray:
    """Return vectors (n, dim) scaled to length 1; 0 for zero vectors."""
    size = np.linalg.norm(a, axis=1)[:, None]
    return a * _over(np.ones_like(size), size)


def _over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a / b; 0 where b is 0."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


class Rows:
    """Constraints at positions x: the violations C that they are to lose, and their gradients J by corners.

    Corner k belongs to row[k] and is particle who[k].
    """

    goal: Any = 0.0  # the violation from which C is measured
    theta: Any = 1.0  # how rigid rows are, 0 to 1
    weight: Any = 1.0  # theta with the split masses of passes

    rails: Any = None  # see Rails

    def __init__(
        self, batches: Sequence[Scalar | AnchorRows | SidewaysRows | ClusterRows], w: np.ndarray, x: np.ndarray, box: Any = None,
        rails: Rails | None = None,
    ):  # fmt: skip
        self.rails = rails if rails and len(rails.who) else None
        self.batches, self.w, self.n, self.dim = batches, w, *x.shape
        self.mass = _over(np.ones_like(w), w)  # 0 for particles that cannot move
        self.box = box  # the Periodic of the world
        self.some = [~b.immovable(w) & ~b.broken if b.breaks else ~b.immovable(w) for b in batches]
        for b, some in zip(batches, self.some, strict=True):
            if drive := getattr(b.dev, "drive", None):
                some &= ~drive.is_at_limit(b.dev.equation.lam)[: b.count]
        self.side, arity = (self._each([of(b) for b in batches]) for of in (lambda b: np.full(b.count, b.side), sizes))
        self.m = len(self.side)
        self.corner = [some[b.owner] for b, some in zip(batches, self.some, strict=True)]
        self.who = np.concatenate([b.indices.ravel()[some] for b, some in zip(batches, self.corner, strict=True)])
        self.row = np.repeat(np.arange(self.m), arity)
        self.close = self._each([b.inverse_size(b.start.position) for b in batches])
        first = (np.cumsum(arity) - arity)[arity == 2]
        self.pairs = self.row[first], self.who[first], self.who[first + 1]
        self.arity = arity
        self.wall = np.zeros_like(x)  # normals of the walls that hold particles; 0 where none does
        self.sticks = np.zeros(self.n, dtype=bool)  # whether friction holds them along walls, too
        self.rest = np.zeros_like(x)  # moves of particles on walls in a substep, by forces other than links
        self._measure(x)

    def _each(self, values: list[np.ndarray]) -> np.ndarray:
        """Return the values of the rows, from those of all constraints of the batches."""
        return np.concatenate([value[some] for value, some in zip(values, self.some, strict=True)])

    def _measure(self, x: np.ndarray) -> None:
        self.x, self.C = x, self._bounded(self._each([b.violation(x) for b in self.batches]) - self.goal)
        J = [b.gradients(x).reshape(-1, self.dim)[some] for b, some in zip(self.batches, self.corner, strict=True)]
        whole = self.rails.moves if self.rails else None
        self.jacobian = Jacobian(self.m, self.row, self.who, self.w, np.concatenate(J), whole)
        self.J, self.diagonal = self.jacobian.J, self.jacobian.diagonal
        self.worst = float(np.abs(self.C * self.close).max(initial=0.0))
        self.stored = float(_over(self.weight * self.C * self.C, self.diagonal).sum())

    def _bounded(self, C: np.ndarray) -> np.ndarray:
        """Return C, and 0 for one-sided constraints that do not act."""
        return np.where(self.side == 0, C, np.maximum(self.side * C, 0.0) * self.side)

    def _link(self) -> None:
        """Build the matrix of step(), with the blocks that rows and their tensions couple."""
        begin = np.cumsum(self.arity) - self.arity
        wide = self.arity * self.dim > 2 * WIDEST  # such a row does not fit into two adjacent levels
        rows = [r for r in self._alike() if len(r) > 1 and not wide[r[0]]]
        self.alike = [begin[r, None] + np.arange(int(self.arity[r[0]])) for r in rows]  # corners of each group
        apart = wide.copy()
        apart[np.concatenate([np.zeros(0, dtype=np.int64), *rows])] = True
        width = np.where(apart[self.row], 0, np.repeat(self.arity, self.arity))  # corners in the row of each corner
        a = np.repeat(np.arange(len(self.who)), width)
        b = np.repeat(begin[self.row], width) + np.arange(len(a)) - np.repeat(np.cumsum(width) - width, width)
        self.corners = a, b  # all pairs of corners within each of the other rows
        each = [self.who[c[0]] for c in self.alike]
        both = [np.repeat(who, len(who)) for who in each], [np.tile(who, len(who)) for who in each]
        self.wide = np.flatnonzero(wide[self.row] & (self.w[self.who] > 0))
        _, i, j = self.pairs
        self.inside = np.unique(self.who[self.w[self.who] > 0])
        number = np.full(self.n, -1)
        number[self.inside] = every = np.arange(len(self.inside))
        self.number = number
        sides = [i, j, i, j], [i, j, j, i]  # blocks of tensions across links
        ends = np.stack([
            np.concatenate([*(number[who] for who in (self.who[corner], *some, *side)), every])
            for corner, some, side in zip(self.corners, both, sides, strict=True)
        ])  # fmt: skip
        self.free = (ends >= 0).all(axis=0)
        self.matrix = BlockMatrix(len(self.inside), self.dim, *ends[:, self.free])

    def _alike(self) -> list[np.ndarray]:
        """Return groups of adjacent rows with the same particles in the same order, as those of a cluster."""
        before = np.maximum(np.arange(len(self.who)) - self.arity[self.row], 0)
        other = (self.row[before] != self.row - 1) | (self.who[before] != self.who)
        other |= self.arity[np.maximum(self.row - 1, 0)] != self.arity[self.row]  # the last of more corners are others
        return np.split(np.arange(self.m), np.flatnonzero(np.bincount(self.row, other, minlength=self.m))[1:])

    def leaning(self, wall: np.ndarray, push: np.ndarray, share: float, sticks: np.ndarray) -> "Rows":
        """Return these rows with walls of normals `wall`, (n, dim), that bear particles.

        push: (n, dim) [m], the moves by walls in the last substep. They balance the pull of links and all other forces. share:
        the part of the pull of links that the rows have. sticks: (n,), whether friction holds a particle.
        """
        new = copy.copy(self)
        new.wall, new.sticks = wall, sticks
        new.rest = -(push + self.w[:, None] * self.pull() / share) * wall.any(axis=1)[:, None]
        return new

    def held(self, wall: np.ndarray, back: np.ndarray) -> "Rows":
        """Return these rows with walls that hold particles which are not drawn off them, without friction.

        wall: (n, dim) the normals so far. back: (n, dim), by how much walls moved particles back, which gives further normals.
        """
        unit = _units(back)
        wall = np.where(unit.any(axis=1)[:, None], unit, wall)
        new = copy.copy(self)
        drawn = ((self.w[:, None] * self.pull() + self.rest) * wall).sum(axis=1)
        new.wall, new.sticks = wall * (drawn <= 0)[:, None], np.zeros(self.n, dtype=bool)
        return new

    def pull(self) -> np.ndarray:
        """Return the pull of the stored energy on particles, (n, dim)."""
        return -self.jacobian.gathered(self.J * (_over(self.weight, self.diagonal) * self.C)[self.row, None])

    def at(self, x: np.ndarray) -> "Rows":
        """Return these rows at other positions."""
        new = copy.copy(self)
        new._measure(x)
        return new

    def with_goal(self, goal: np.ndarray) -> "Rows":
        """Return these rows with C measured from `goal`, (m,)."""
        new = copy.copy(self)
        new.goal = goal
        new._measure(self.x)
        new._link()
        return new

    def undone(self, runner: Any) -> np.ndarray:
        """Return Z = theta C_(n+1) + (1 - theta) C_n + damping dC/dt + alpha lam / h^2, to second order, (m,).

        Sets theta, and the weight, which is theta with the split masses of passes.
        """
        read, h = runner.memory.read, runner.clock.h
        alpha, damping = (self._each([getattr(b, name) for b in self.batches]) for name in ("compliance", "damping"))
        split = read(runner.scene.slots.split)[: self.n].astype(np.float64)
        self.theta = self._rigid(alpha, self.diagonal * h * h)
        shared = np.bincount(self.row, split[self.who] * (self.J**2).sum(axis=1), minlength=self.m)
        self.weight = self._rigid(alpha, shared * h * h)
        gamma = self.theta + damping * alpha / h
        h2_effective = h2_effective_of(runner.clock)
        known = (_remembered(b, read, self.x) for b in self.batches)
        before, lam = (self._each(list(values)) for values in zip(*known, strict=True))
        return self._bounded(gamma * self.C + (1 - gamma) * self._bounded(before) + alpha * lam / h2_effective)

    def pace(self, runner: Any, h: float, dt: float) -> np.ndarray:
        """How fast rest values go in the coming substep h, of a frame dt."""
        return self._each([_pace(runner, b, self.x, h, dt) for b in self.batches])

    def multipliers(self, runner: Any, undone: np.ndarray) -> np.ndarray:
        """Return the multipliers of the last substep, (m,); for rows without any those of a single pass, which are larger."""
        read = runner.memory.read
        known = [read(b.dev.equation.lam)[: b.count] if isinstance(b, Scalar) else np.full(b.count, np.nan) for b in self.batches]
        lam = self._each(known)
        return np.where(np.isnan(lam), self.weight * _over(undone, self.diagonal), lam)

    def would_break(self, undone: np.ndarray, load: np.ndarray, h: float, longest: float, uneven: bool) -> bool:
        """Whether a violation would pull so much harder in a substep h that the change counts beside break_at of its row.

        load: of the last substep, (m,). uneven: whether loads may grow, by 1 / ratio^2 at most, and swing, as long as they remain
        below break_at.
        """
        if not any(b.breaks for b in self.batches):
            return False
        each: list[Any] = [getattr(b, "break_at", None) for b in self.batches]
        strength = self._each([np.full(b.count, np.inf if s is None else s) for b, s in zip(self.batches, each, strict=True)])
        extra = np.abs(undone) * (1 / h**2 - 1 / longest**2)
        frail = extra > FRAIL * strength * self.diagonal
        if uneven:
            swing = 2 * np.minimum(_over(extra, self.diagonal), load * ((longest / h) ** 2 - 1))
            frail &= load + swing > SAFE * strength
        return bool(frail.any())

    def _rigid(self, alpha: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """Return theta. reach: (m,) the move by a force of 1 N in a substep [m]."""
        return _over(reach * reach, reach * reach + alpha * alpha)

    def kinetic(self, v: np.ndarray) -> float:
        """Return the kinetic energy [J] at velocities v relative to the mean velocity of each body.

        Bodies are what constraints connect.
        """
        _, body = bodies_of(self.m, self.row, self.who, self.w)
        mass = np.bincount(body, self.mass, minlength=self.m + 1)[:, None]
        mean = summed(self.mass[:, None] * v, body, self.m + 1) * _over(np.ones_like(mass), mass)
        return float((self.mass[:, None] * (v - mean[body]) ** 2)[body < self.m].sum()) / 2

    def work(self, steps: int) -> float:
        """Return m p^2 of the moves p with which a solver of `steps` steps would satisfy the rows; 0 without steps."""
        move = self.jacobian.solve(-self.theta * self.C, steps=steps) if steps else np.zeros_like(self.x)
        return float((self.mass[:, None] * move**2).sum())

    def step(self, mu: float) -> np.ndarray:
        """Return moves p that minimize sum (C + J p)^2 / (2 D) + p^T M (mu + HELD n n^T) p / 2 + p^T K p / 2.

        D is the diagonal of J w J^T. n are the normals of walls that hold particles; n n^T is 1 where friction does. Without this
        term, particles would be sent into walls and stopped again and again.

        K is the transverse stiffness of links under tensions C / D. Without it, links in one line have no direction to give way
        in, and the step that should straighten a taut rope throws it into a zigzag.
        """
        stiff = _over(self.weight, self.diagonal)
        row, i, j = self.pairs
        across = between(self.x[i], self.x[j], self.box)
        length = np.linalg.norm(across, axis=1)
        across = across * _over(np.ones_like(length), length)[:, None]
        taut = _over(np.maximum(self.C[row], 0.0) * stiff[row], length)
        one, (a, b) = np.eye(self.dim), self.corners
        sides = taut[:, None, None] * (one - across[:, :, None] * across[:, None, :])
        wall, sticks = self.wall[self.inside], (self.sticks & self.wall.any(axis=1))[self.inside]
        held = np.where(sticks[:, None, None], one, wall[:, :, None] * wall[:, None, :])
        held = held + (self.rails.across(self.n)[self.inside] if self.rails else 0.0)
        mass = (mu * one + HELD * held) / self.w[self.inside][:, None, None]
        along = [(stiff[self.row[a], None] * self.J[a])[:, :, None] * self.J[b][:, None, :]]
        for corners in self.alike:
            J = self.J[corners]
            along.append(np.einsum("r,ria,rjb->ijab", stiff[self.row[corners[:, 0]]], J, J).reshape(-1, self.dim, self.dim))
        right = self.jacobian.gathered(self.J * (stiff * self.C)[self.row, None])
        blocks = np.concatenate((*along, sides, sides, -sides, -sides, mass))[self.free]
        out = np.zeros_like(right)
        some = self.wide
        wide = WideRows(len(self.inside), self.row[some], self.number[self.who[some]], self.J[some], stiff) if len(some) else None
        out[self.inside] = self.matrix.solve(blocks, -right[self.inside], wide)
        return self.rails.moves(out) if self.rails else out


def is_slight(clock: "Clock", stored: float, ratio: float) -> bool:
    """Whether the scene would not have more energy than ever if that which violations store [J] grew by 1 / ratio^2."""
    if clock.energy is None or clock.bound is None or clock.bound == CHANGED:
        return True
    return clock.energy + stored / ratio**2 <= clock.bound + SLIGHT * clock.kinetic


def given_back(runner: Any, energy: float, spun: float) -> float:
    """Return the part of `spun` [J] that bodies had before they were stretched: at most what the scene has lost since."""
    bound = runner.clock.bound
    return spun if bound is None or bound == CHANGED else min(spun, max(bound - energy, 0.0))


def take_energy(
    jacobian: Jacobian, v: np.ndarray, moves: np.ndarray, energy: float, walls: Any = False, bodies: FreeBodies | None = None
) -> np.ndarray:
    """Return velocities from which the energy [J] that moves added is taken, (n, dim).

    It is taken from the part of velocities along the moves first, then from all motion of bodies that are anchored or stand on
    something. Each body, of what constraints connect, pays in proportion to mass times distance of its moves, up to all it has.
    walls: mask of particles that walls hold. bodies: free bodies, which pay by their inner motion.
    """
    rows, row, who, w = jacobian.m, jacobian.row, jacobian.who, jacobian.w
    m = np.divide(1, w, out=np.zeros_like(w), where=w > 0)
    label, body = bodies_of(rows, row, who, w)

    def summed(values: np.ndarray) -> np.ndarray:
        """Return the sums of values times masses by body."""
        return np.bincount(body, m * values, minlength=rows + 1)

    work, size, along = summed(np.linalg.norm(moves, axis=1)), summed((moves**2).sum(axis=1)), summed((moves * v).sum(axis=1))
    due = energy * _over(work, np.full(len(work), work.sum()))  # 0 where no particle moved: such a gain is rounding
    part = _over(along, size)
    due, left = _settled(due, part * along / 2)
    v = v - ((1 - left) * part)[body][:, None] * moves
    if bodies:
        v = bodies.calmed(v, due[body])
    held = np.bincount(label[row[(w[who] == 0) | np.broadcast_to(walls, len(w))[who]]], minlength=rows + 1) > 0
    _, left = _settled(np.where(held, due, 0.0), summed((v**2).sum(axis=1)) / 2)
    return v * left[body][:, None]


def _settled(due: np.ndarray, kinetic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the energies still due after kinetic energies have paid, and the factor by which velocities shrink."""
    pays = np.minimum(due, kinetic)
    return due - pays, np.sqrt(np.maximum(1 - _over(pays, kinetic), 0.0))
