"""What constraints leave undone becomes less where the substep gets shorter: else it would become energy.

A pass holds a load F by a violation Z = D h^2 F, beside what its compliance takes, as a spring of stiffness 1 / (D h^2) would.
A shorter substep h' makes that spring stiffer while it is stretched, and its energy (h / h')^2 times as large. So positions
first go to where the same loads need the violations (h' / h)^2 Z, and velocities to where they do not change:

    x += w J^T lam,  C(x) = C - (1 - (h' / h)^2) Z;     v += w J^T lam,  (J w J^T + mu) lam = -J v

Z, C + alpha lam / h^2 for what is at rest, is what the last substep left of a constraint; springs that it resolves stay as they
are. Positions move without velocities, as contacts do that an impact left overlapping.

Where contacts are in the way, they are rows, too (ContactRows), and what they lead into are others, in a few rounds. Beads stay
on their wires (Rails), and free bodies keep their angular momentum (FreeBodies).

Where that lifts what hangs, motion pays for it as far as it can: a taut net has no direction to sag in, so velocities know
nothing of its fall, and lifting it back at the end of each fall would be a pump. The energy that was gained is taken out of the
velocities, of the part along the moves first, then of the whole of what is anchored. What hangs at rest is lifted for nothing:
its fall became heat when it stretched.
"""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..constraints.core.scalar import Scalar
from ..neighbours.queries import between
from ..particles import LARGEST
from ..solvers.corners import bodies_of
from .block_matrix import WIDEST, BlockMatrix, WideRows, summed
from .clock import CHANGED
from .contact_rows import ContactRows
from .free_bodies import FreeBodies
from .integrator import h2_effective_of
from .jacobian import Jacobian
from .rails import Rails, tethered
from .rigid_rows import RigidRows, left_out, rigid_rows

if TYPE_CHECKING:
    from .runner import Runner

ENOUGH = 1e-3  # of its size: a violation that matters, over (r - 1)^2 / r with r = (h / h')^2: what one jump leaves to vibrate
FRAIL = 0.01  # of what breaks a constraint: a load that a violation may have by itself
FIRM = 0.9  # theta from where on velocities may not change a constraint
FAR = 0.75  # of the longest: a substep in which what is small now has had its chance
NEWTON = 40  # steps, at most
PRODUCTS = 1e9  # of numbers: some seconds, after which the rest is left as it is
SHARED = PRODUCTS / 8  # where contacts move, too: they are tried after links alone, some times
BEGIN, HARDEST, LEAST = 1e-3, 10.0, 1e-9  # mu of the first, and of the last try; the least
FINE, STALLED = 1e-5, 0.05  # mu from which on a step has to take out as much of what is stored: what cannot be met stays
SLIGHT = 0.01  # of the kinetic energy: what violations may become where contacts are in the way
SLIGHTEST = 1e-3  # of the kinetic energy inside of bodies: what violations, and moves in the next substep, may make of it
LOOKS = 8  # steps of conjugate gradients, to see what a solver would move
LEFT = 0.01  # of what violations store: what may be left of it in the shorter substep
DONE = 1e-6, 1e-13  # of its size: a violation that is none; and that breaks nothing in the shortest substep
TURNS = 16  # with walls, at most: a link that stands on one halves its violation in each
WORSE = 2.0  # times what violations stored before: what is left of it, at most, where it is taken at all
BETTER = 0.5  # times that, where contacts move, too: what they and links store then
TOGETHER = 4  # times that links and contacts move together: each may lead into others
HELD = 1e3  # of its mass: how firmly a wall holds a particle that it has stopped
GRIP = 1e-3  # of what a wall bears: what it bears along itself, by friction


class Aims(NamedTuple):
    """Of what violations store, and of the work that a solver of so many `steps` would do: the share that may be left, unless it
    is less than `slight`. products: how many numbers it may multiply. done: a violation that is none, of its size."""

    share: float
    steps: int
    slight: float
    products: float
    done: float


def project(runner: "Runner", h: float, longest: float, contacts: ContactRows | None = None) -> bool | None:
    """Take out what violations would store; d holds velocities. Nothing happens where they are small, or would overlap.

    h: the coming substep [s]; longest: since this was done last. contacts: which move together with links. Returns whether
    positions have been looked after; None where contacts are in the way of what would be more than a hundredth of the kinetic
    energy.
    """
    ratio = h / longest
    slots = runner.scene.slots
    w, state, memory = runner.scene.inv_mass, runner.scene.state, runner.memory
    x = before = state.get(memory)
    if not (np.abs(x) < LARGEST).all():  # nor what is no number
        return True
    batches: list[Any] = [b for b in runner.batches if isinstance(b, Scalar) and b.count]
    stays = left_out(runner.batches, w, x)
    if matters(stays, ratio):
        runner.released = stays
    if slots and slots.system and not slots.system.steps and not runner.clock.softened:  # it holds loads without a violation
        batches = [b for b in batches if ((slots.rows(b) < 0) & ~b.immovable(w)).any() or matters(_off(b, x), ratio)]
    batches += rigid_rows(runner.batches, w, every=contacts is not None)
    if not batches:
        return True
    batches += [contacts] if contacts else []
    rails = Rails(runner, x)
    start = Rows(batches, w, x, runner.scene.periodic, rails)
    undone = start.undone(runner)
    frail = start.would_break(undone, h, longest)
    if not frail and not matters(float(np.abs(undone * start.close).max(initial=0.0)), ratio):
        return ratio < FAR
    rows = start = start.towards(start.C - (1 - ratio**2) * undone)
    kept = memory.read(state.d)
    v = kept.astype(np.float64)
    n = len(x)
    # Where the solver converges, it moves what is left at once in the next substep, and that flies on.
    steps = LOOKS if slots.converges or slots.exact else 0
    slight = SLIGHTEST * 2 * h * h * start.kinetic(v[:n])
    still = (undone != 0) & (start.theta > FIRM) & ~start.touches
    v[:n] += rows.jacobian.solve(-rows.jacobian.rates(v[:n]) * still, still)
    energy, overlap = seen_before(runner)
    finest = ratio**4 if frail else ratio**2  # by loads, or by energies
    aims = Aims(LEFT * finest, steps, 0.0 if frail else slight, SHARED if contacts else PRODUCTS, DONE[frail])
    rows, stopped = _moved(runner, start, _leaning(runner, rows, 1 - ratio**2), aims)
    left = 0.0
    if contacts:
        rows, stopped, left = _together(runner, start, rows, stopped, contacts.stored(before, w), batches[:-1], aims)
    x = rows.x
    bodies = FreeBodies(start.jacobian, x, stopped | tethered(runner))
    v[:n], spun = bodies.spun(v[:n], before, kept[:n])
    memory.write(state.d, v)
    runner.invalidate()  # moves may have led into what was far
    more, deeper = seen(runner)
    fails = left > BETTER if contacts else deeper > overlap or rows.stored > WORSE * start.stored
    if fails:
        state.put(memory, before)
        memory.write(state.d, kept)
        stake = _over(start.weight * undone**2, start.diagonal).sum() / (2 * h * h)
        kinetic = (start.mass[:, None] * kept[:n].astype(np.float64) ** 2).sum() / 2
        return None if contacts or stake > SLIGHT * kinetic else True
    due = more - energy - given_back(runner, energy, spun)
    if due > 0:
        moves = bodies.unturned(x - before)
        v[:n] = paid(start.jacobian, v[:n], moves, due, rows.wall.any(axis=1), None if contacts else bodies)
        memory.write(state.d, v)
    return True


def _leaning(runner: "Runner", rows: "Rows", share: float) -> "Rows":
    """The rows where what walls bear stays on them, and where friction holds it: a body that stands does not turn over its feet,
    nor walk. share: of what links hold by their violations, which rows give up."""
    if not runner.step.walls:
        return rows
    state, memory = runner.scene.state, runner.memory
    push = memory.read(runner.step.particles.wall_displacement)[: rows.n].astype(np.float64)
    state.put(memory, rows.x - push)
    sent = state.get(memory)
    runner.stop_at_walls(rows.x)
    normal = _units(state.get(memory) - sent)
    state.put(memory, rows.x)
    along = np.linalg.norm(push - (push * normal).sum(axis=1)[:, None] * normal, axis=1)
    rubs = any(w.has_friction for w in runner.step.walls)
    return rows.leaning(normal, push, share, rubs & (along > GRIP * np.linalg.norm(push, axis=1)))


def _moved(runner: "Runner", start: "Rows", rows: "Rows", aims: Aims) -> tuple["Rows", np.ndarray]:
    """Rows where particles are then, and which of them walls have stopped, (n,). aims: for _newton(), a share of what rows stored
    at the start."""
    state, memory, before = runner.scene.state, runner.memory, rows.x
    enough = aims.share * start.stored
    stopped: np.ndarray = rows.wall.any(axis=1)
    for _ in range(TURNS):
        state.put(memory, _newton(rows, enough, aims))
        sent = state.get(memory)
        runner.stop_at_walls(before)
        x = state.get(memory)
        stopped |= (x != sent).any(axis=1)
        last, rows = rows, rows.at(x)  # what walls stop is lifted by the others
        slips = rows.sticks.any() and rows.stored > enough  # friction does not hold feet against each other
        if ((x == sent).all() and not slips) or rows.matrix.products > aims.products:
            break
        if rows.stored > last.stored or last.wall.any():  # what lies on them would be sent back there again and again
            rows = rows.held(last.wall, x - sent)
            if rows.stored <= enough:
                break
    return rows, stopped


def _together(
    runner: "Runner", start: "Rows", rows: "Rows", stopped: np.ndarray, pressed: float, links: list[Any],
    aims: Aims,
) -> tuple["Rows", np.ndarray, float]:  # fmt: skip
    """The best rows and stops of some rounds, each among the contacts that the one before led into; and what links and contacts
    store there, of what they did. pressed: what contacts stored at the start."""
    before, left, products = start.stored_in_links() + pressed, np.inf, 0
    for _ in range(TOGETHER):
        contacts: Any = ContactRows.of(runner)
        stored = rows.stored_in_links() + contacts.stored(rows.x, rows.w)
        if stored >= left:
            break
        best, left = (rows, stopped), stored
        products += rows.matrix.products
        if left <= aims.share * before or products > aims.products:
            break
        rows, more = _moved(runner, start, rows.among([*links, contacts], runner), aims)
        stopped = stopped | more
    runner.scene.state.put(runner.memory, best[0].x)
    rows, stopped = best
    return rows, stopped, left / before if before > 0 else np.inf


def _newton(rows: "Rows", enough: float, aims: Aims) -> np.ndarray:
    """Places at which what violations store is `enough` [J s^2], and where a solver of so many steps would move less, by this
    share of the work, m p^2, that it would do at the begin; both unless they are less than `slight`."""
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


def matters(violation: float, ratio: float) -> bool:
    """Whether what a violation, as a share of its size, leaves to vibrate is worth a look."""
    return violation * (1 - ratio**2) ** 2 > ENOUGH * ratio**2


def _off(batch: Scalar, x: np.ndarray) -> float:
    """The worst violation of rigid constraints, as a share of their size: what Newton's method left of it, as after an impact."""
    C = batch.violation(x) * batch.inverse_size(batch.start.position) * (batch.compliance == 0) * ~batch.broken
    return float((np.abs(C) if batch.side == 0 else C * batch.side).max(initial=0.0))


def seen(runner: Any) -> tuple[float, float]:
    """Energy [J], and the overlap of the worst contact, in radii."""
    runner.look()
    report = runner.report()
    return report.energy, report.overlap


def seen_before(runner: Any) -> tuple[float, float]:
    """The same before positions move; energy, where it is known, by the loads of the last substep: what springs of its violations
    would hold is not there."""
    energy, overlap = seen(runner)
    return energy if runner.clock.energy is None else runner.clock.energy, overlap


def sizes(batch: Scalar | RigidRows | ContactRows) -> np.ndarray:
    """The number of corners of each constraint, (m,)."""
    return np.bincount(batch.owner, minlength=batch.count)


def _units(a: np.ndarray) -> np.ndarray:
    """Vectors (n, dim) of length 1; 0 where there is none."""
    size = np.linalg.norm(a, axis=1)[:, None]
    return a * _over(np.ones_like(size), size)


def _over(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b; 0 where b is."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


class Rows:
    """Constraints at positions x: what they are to give up, C, and their gradients J by corners.

    Corner k belongs to row[k] and is particle who[k].
    """

    goal: Any = 0.0  # what C is measured from
    theta: Any = 1.0  # how rigid they are
    weight: Any = 1.0  # the same as passes see it, which split masses

    rails: Any = None  # see Rails

    def __init__(
        self, batches: Sequence[Scalar | RigidRows | ContactRows], w: np.ndarray, x: np.ndarray, box: Any = None,
        rails: Rails | None = None,
    ):  # fmt: skip
        self.rails = rails if rails and len(rails.who) else None
        self.batches, self.w, self.n, self.dim = batches, w, *x.shape
        self.mass = _over(np.ones_like(w), w)  # 0 of what cannot move
        self.box = box  # the Periodic of the world
        self.some = [~b.immovable(w) & ~b.broken if b.breaks else ~b.immovable(w) for b in batches]
        for b, some in zip(batches, self.some, strict=True):
            if drive := getattr(b.dev, "drive", None):
                some &= ~drive.slips(b.dev.equation.lam)[: b.count]
        self.touches = self._each([np.full(b.count, isinstance(b, ContactRows)) for b in batches])
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
        self.sticks = np.zeros(self.n, dtype=bool)  # held along them by friction, too
        self.rest = np.zeros_like(x)  # moves by what else draws those that walls bear, in a substep
        self._measure(x)

    def _each(self, values: list[np.ndarray]) -> np.ndarray:
        """Values of every constraint of the batches, for the rows."""
        return np.concatenate([value[some] for value, some in zip(values, self.some, strict=True)])

    def _measure(self, x: np.ndarray) -> None:
        self.x, self.C = x, self._bounded(self._each([b.violation(x) for b in self.batches]) - self.goal)
        J = [b.gradients(x).reshape(-1, self.dim)[some] for b, some in zip(self.batches, self.corner, strict=True)]
        whole = self.rails.moves if self.rails else None
        self.jacobian = Jacobian(self.m, self.row, self.who, self.w, np.concatenate(J), whole)
        self.J, self.diagonal = self.jacobian.J, self.jacobian.diagonal
        self.worst = float(np.abs(self.C * self.close).max(initial=0.0))
        self.stored = float(_over(self.weight * self.C * self.C, self.diagonal).sum())

    def stored_in_links(self) -> float:
        """What is stored in all but contacts."""
        return float((_over(self.weight * self.C * self.C, self.diagonal) * ~self.touches).sum())

    def _bounded(self, C: np.ndarray) -> np.ndarray:
        """C on the side on which constraints act."""
        return np.where(self.side == 0, C, np.maximum(self.side * C, 0.0) * self.side)

    def _link(self) -> None:
        """The matrix of step(), for what its rows and their tensions couple."""
        begin = np.cumsum(self.arity) - self.arity
        wide = self.arity * self.dim > 2 * WIDEST  # no two levels hold such a row
        rows = [r for r in self._alike() if len(r) > 1 and not wide[r[0]]]
        self.alike = [begin[r, None] + np.arange(int(self.arity[r[0]])) for r in rows]  # corners of each
        apart = wide.copy()
        apart[np.concatenate([np.zeros(0, dtype=np.int64), *rows])] = True
        width = np.where(apart[self.row], 0, np.repeat(self.arity, self.arity))  # of the row of each corner
        a = np.repeat(np.arange(len(self.who)), width)
        b = np.repeat(begin[self.row], width) + np.arange(len(a)) - np.repeat(np.cumsum(width) - width, width)
        self.corners = a, b  # of each other row, each with each
        each = [self.who[c[0]] for c in self.alike]
        both = [np.repeat(who, len(who)) for who in each], [np.tile(who, len(who)) for who in each]
        self.wide = np.flatnonzero(wide[self.row] & (self.w[self.who] > 0))
        _, i, j = self.pairs
        self.inside = np.unique(self.who[self.w[self.who] > 0])
        number = np.full(self.n, -1)
        number[self.inside] = every = np.arange(len(self.inside))
        self.number = number
        sides = [i, j, i, j], [i, j, j, i]  # of tensions across links
        ends = np.stack([
            np.concatenate([*(number[who] for who in (self.who[corner], *some, *side)), every])
            for corner, some, side in zip(self.corners, both, sides, strict=True)
        ])  # fmt: skip
        self.free = (ends >= 0).all(axis=0)
        self.matrix = BlockMatrix(len(self.inside), self.dim, *ends[:, self.free])

    def _alike(self) -> list[np.ndarray]:
        """Rows that follow one another, by the same particles in the same order, as those of a cluster."""
        before = np.maximum(np.arange(len(self.who)) - self.arity[self.row], 0)
        other = (self.row[before] != self.row - 1) | (self.who[before] != self.who)
        other |= self.arity[np.maximum(self.row - 1, 0)] != self.arity[self.row]  # the last of more corners are others
        return np.split(np.arange(self.m), np.flatnonzero(np.bincount(self.row, other, minlength=self.m))[1:])

    def leaning(self, wall: np.ndarray, push: np.ndarray, share: float, sticks: np.ndarray) -> "Rows":
        """The same rows where walls, of these normals, bear particles: they moved them by `push` in a substep, (n, dim), against
        links, of whose pull the rows have this share, and all else."""
        new = copy.copy(self)
        new.wall, new.sticks = wall, sticks
        new.rest = -(push + self.w[:, None] * self.pull() / share) * wall.any(axis=1)[:, None]
        return new

    def held(self, wall: np.ndarray, back: np.ndarray) -> "Rows":
        """The same rows where walls, of these normals, and of those along which particles were moved `back`, (n, dim), hold what
        is not drawn off them, and let it slip."""
        unit = _units(back)
        wall = np.where(unit.any(axis=1)[:, None], unit, wall)
        new = copy.copy(self)
        drawn = ((self.w[:, None] * self.pull() + self.rest) * wall).sum(axis=1)
        new.wall, new.sticks = wall * (drawn <= 0)[:, None], np.zeros(self.n, dtype=bool)
        return new

    def pull(self) -> np.ndarray:
        """What is stored draws particles this way, (n, dim)."""
        return -self.jacobian.gathered(self.J * (_over(self.weight, self.diagonal) * self.C)[self.row, None])

    def at(self, x: np.ndarray) -> "Rows":
        """The same rows elsewhere."""
        new = copy.copy(self)
        new._measure(x)
        return new

    def towards(self, goal: np.ndarray) -> "Rows":
        """The same rows, with C from what it is to be."""
        new = copy.copy(self)
        new.goal = goal
        new._measure(self.x)
        new._link()
        return new

    def among(self, batches: list[Any], runner: Any) -> "Rows":
        """The same links, towards the same, among other contacts, the last of these batches, which are to store nothing."""
        new = Rows(batches, self.w, self.x, self.box, self.rails)
        new.undone(runner)  # for how rigid they are
        return new.towards(np.concatenate([self.goal[~self.touches], np.zeros(int(new.touches.sum()))]))

    def undone(self, runner: Any) -> np.ndarray:
        """Z = theta C_(n+1) + (1 - theta) C_n + damping dC/dt + alpha lam / h^2, to second order; and how rigid the rows are."""
        read, h = runner.memory.read, runner.clock.h
        alpha, damping = (self._each([getattr(b, name) for b in self.batches]) for name in ("compliance", "damping"))
        split = read(runner.scene.slots.split)[: self.n].astype(np.float64)
        self.theta = self._rigid(alpha, self.diagonal * h * h)
        shared = np.bincount(self.row, split[self.who] * (self.J**2).sum(axis=1), minlength=self.m)
        self.weight = self._rigid(alpha, shared * h * h)
        gamma = self.theta + damping * alpha / h
        h2_effective = h2_effective_of(runner.clock)
        springs = [b.dev.spring for b in self.batches]
        before = [
            read(s.last)[: b.count] - b.goal if s.soft else np.zeros(b.count) for b, s in zip(self.batches, springs, strict=True)
        ]
        borne = [
            b.compliance * read(b.dev.equation.lam)[: b.count] / h2_effective if b.compliance.any() else b.compliance
            for b in self.batches
        ]
        return self._bounded(gamma * self.C + (1 - gamma) * self._bounded(self._each(before)) + self._each(borne))

    def would_break(self, undone: np.ndarray, h: float, longest: float) -> bool:
        """Whether a violation pulls harder in a substep h than it did, by so much that it counts beside what breaks its row."""
        if not any(b.breaks for b in self.batches):
            return False
        each: list[Any] = [getattr(b, "break_at", None) for b in self.batches]
        strength = self._each([np.full(b.count, np.inf if s is None else s) for b, s in zip(self.batches, each, strict=True)])
        return bool((np.abs(undone) * (1 / h**2 - 1 / longest**2) > FRAIL * strength * self.diagonal).any())

    def _rigid(self, alpha: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """theta, by what a force of 1 N moves in a substep."""
        return _over(reach * reach, reach * reach + alpha * alpha)

    def kinetic(self, v: np.ndarray) -> float:
        """The kinetic energy [J] of particles at velocities v, as they move in their bodies, of what constraints tie together."""
        _, body = bodies_of(self.m, self.row, self.who, self.w)
        mass = np.bincount(body, self.mass, minlength=self.m + 1)[:, None]
        mean = summed(self.mass[:, None] * v, body, self.m + 1) * _over(np.ones_like(mass), mass)
        return float((self.mass[:, None] * (v - mean[body]) ** 2)[body < self.m].sum()) / 2

    def work(self, steps: int) -> float:
        """m p^2 of the moves p by which a solver of so many steps, 0 for none, meets the rows."""
        move = self.jacobian.solve(-self.theta * self.C, steps=steps) if steps else np.zeros_like(self.x)
        return float((self.mass[:, None] * move**2).sum())

    def step(self, mu: float) -> np.ndarray:
        """Moves p that minimize sum (C + J p)^2 / (2 D) + p^T M (mu + HELD n n^T) p / 2 + p^T K p / 2, with D the diagonal of
        J w J^T and n the normals of walls that hold particles, 1 for n n^T where friction does: else these are sent into them
        again, and stopped again.

        K is what tensions C / D across links are: without it, those that are in one line have no direction to give way in, and
        what would draw a taut rope straight throws it into a zigzag.
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


def given_back(runner: Any, energy: float, spun: float) -> float:
    """How much of the energy [J] that bodies are spun up by they had before they were stretched: no more than the scene had."""
    bound = runner.clock.bound
    return spun if bound is None or bound == CHANGED else min(spun, max(bound - energy, 0.0))


def paid(
    jacobian: Jacobian, v: np.ndarray, moves: np.ndarray, energy: float, walls: Any = False, bodies: FreeBodies | None = None
) -> np.ndarray:
    """Velocities without the energy [J] that moves added: of their part along them first, then of what is anchored, or stands on
    something. walls: whether one holds each particle. bodies: free ones, which pay by how they move in themselves.

    Each body, of what constraints tie together, pays by the mass that it has lifted, up to all it has.
    """
    rows, row, who, w = jacobian.m, jacobian.row, jacobian.who, jacobian.w
    m = np.divide(1, w, out=np.zeros_like(w), where=w > 0)
    label, body = bodies_of(rows, row, who, w)

    def summed(values: np.ndarray) -> np.ndarray:
        """Sums by bodies."""
        return np.bincount(body, m * values, minlength=rows + 1)

    work, size, along = summed(np.linalg.norm(moves, axis=1)), summed((moves**2).sum(axis=1)), summed((moves * v).sum(axis=1))
    due = energy * _over(work, np.full(len(work), work.sum()))  # none where rounding gained it, and nothing moved
    part = _over(along, size)
    due, left = _settled(due, part * along / 2)
    v = v - ((1 - left) * part)[body][:, None] * moves
    if bodies:
        v = bodies.calmed(v, due[body])
    held = np.bincount(label[row[(w[who] == 0) | np.broadcast_to(walls, len(w))[who]]], minlength=rows + 1) > 0
    _, left = _settled(np.where(held, due, 0.0), summed((v**2).sum(axis=1)) / 2)
    return v * left[body][:, None]


def _settled(due: np.ndarray, kinetic: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is still due after kinetic energies have paid, and the factor of the velocities that they have left."""
    pays = np.minimum(due, kinetic)
    return due - pays, np.sqrt(np.maximum(1 - _over(pays, kinetic), 0.0))
