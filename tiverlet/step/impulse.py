"""Velocities that are assigned between two substeps, as impulses: of added particles, released particles, and steered ones.

The velocity is v = (share d + rest (h^2 a + reaction)) / h, see Integrator.velocity_after(). So d grows by the missing velocity
times h / share. Nothing else of the state changes: particles whose velocity is not changed continue bit for bit, which they
would not after a start, the first substep after velocities were set.

Half of the reaction of the last substep is left in d, and must act on in the next substep. The reaction of links does, since they
stay. The reaction of contacts and walls may end, if the particle is sent off or friction reverses. Then the particle gets this
half back, so that the next substep finds the same load as a start would, see Displacements.steer(). A particle in contact with
it keeps its own half. If that contact ends too, the other particle falls too fast by g h / 2. If a taut rope may go slack, the
whole world takes a start.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .integrator import FREE, decay

ROUNDS = 100  # evaluations of velocities, at most, where forces read them
NOTHING = 2.0**-20  # smallest share of a velocity that drag leaves, in factor()
WEAK = 0.01  # share of a velocity that drag leaves: below, displacements give velocities with too few digits
LEANS = 0.25  # of the velocity of half of a reaction: a change of v that ends the reaction; a smaller one ends a part of it
MET = 1e-5  # of the largest velocity: the error that is accepted where forces read velocities
DIGITS = 4  # rounding errors of the largest velocity, at which the iteration ends
Write = Callable[[Any, np.ndarray], None]


def factor(h: Any, drag: np.ndarray) -> np.ndarray:
    """Return the change of displacement per change of velocity [s], after a substep h [s], for worlds with `drag`, (worlds, 5).

    Where drag leaves almost nothing of a velocity in a substep, d does not matter, and the factor is bounded.
    """
    return h / np.maximum(drag[:, 0], NOTHING)


def factor_of(clock: Any) -> float:
    """Return factor() for a single world (not one of many copies)."""
    return clock.h / max((clock.drag or FREE)[0], NOTHING)


class Displacements:
    """Displacements of some particles, (..., dim) [m], with their low words and the parts that forces gave them.

    some: the mask of particles that change, (...,). read, write: get and set the rows of a field.
    """

    def __init__(self, runner: Any, some: np.ndarray, read: Callable[[Any], np.ndarray], write: Write):
        state, integrator = runner.scene.state, runner.integrator
        self.field, self.low = state.d, state.d_low if state.carries else None
        self.some, self.write, self.again = some[..., None], write, integrator.uses_velocity
        self.others = [integrator.free] if integrator.uses_velocity else []
        self.was = {field: read(field) for field in (state.d, *([self.low] if self.low else []), *self.others)}

    def begin_with(self, d: np.ndarray) -> None:
        """Set the displacements of added particles to d, (..., dim) [m], all of it as given by forces."""
        for field in (self.field, *self.others):
            self.was[field] = d
            self.write(field, d)

    def lengthen(self, more: np.ndarray) -> None:
        """Restore the displacements and add `more`, (..., dim) [m]. Step.keep_velocity() does the same on the device."""
        d = self.was[self.field]
        new = d.astype(np.float64) + more
        if self.low:
            low = self.was[self.low]
            whole = new + low
            new = whole.astype(d.dtype)
            self.write(self.low, np.where(self.some, whole - new, low))
        self.write(self.field, np.where(self.some, new, d))
        for field in self.others:
            self.write(field, np.where(self.some, self.was[field] + more, self.was[field]))

    def give(
        self, want: np.ndarray, velocity: Callable[[], np.ndarray], factor: np.ndarray, seen: np.ndarray | None = None,
        change: float | np.ndarray = 0.0,
    ) -> np.ndarray:  # fmt: skip
        """Change displacements until they give velocities `want`, (worlds, ..., dim) [m/s]. Returns where they do, (worlds,).

        One round suffices, and a second removes the rounding of the first. Where forces read velocities, rounds are repeated
        until the error falls no further. velocity: computes the velocities of the present displacements. factor: of each world,
        see factor(). seen: the first result of velocity(), if it is known. change: the largest change of velocities [m/s], or
        that of each world, if the error may be relative to it.
        """
        more = best = np.zeros(want.shape)
        least, factor = np.full(len(want), np.inf), factor.reshape(-1, 1, 1)
        largest = np.maximum(np.abs(want).max(axis=(1, 2), initial=0.0), change)
        enough = DIGITS * np.finfo(self.was[self.field].dtype).eps * largest if self.again else 0.0
        for _ in range(ROUNDS if self.again else 2):
            lack = np.where(self.some, want - (velocity() if seen is None else seen), 0.0)
            seen = None
            most = np.abs(lack).max(axis=(1, 2), initial=0.0)
            nearer = most < least
            better = nearer[:, None, None]
            best, least = np.where(better, more, best), np.where(nearer, most, least)
            ends = ~nearer | (least <= enough)
            if (ends & nearer).all():
                break
            more = np.where(ends[:, None, None], best, more + factor * lack)
            self.lengthen(more)
            if ends.all():
                break
        return least <= MET * largest if self.again else np.ones(len(want), dtype=bool)

    def steer(
        self, want: np.ndarray, change: np.ndarray, seen: np.ndarray, had: np.ndarray, bare: np.ndarray, free: np.ndarray,
        pulled: np.ndarray, friction: bool, velocity: Callable[[], np.ndarray], h: Any, drag: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Set velocities `want` as give() does, and end the reactions that the `change` of velocities or spins ends.

        Returns the share of each particle's contact reaction that ends, (worlds, n, 1), and in which worlds this succeeded,
        (worlds,). Velocities are (worlds, n, dim) [m/s]. seen: those that the user read last. had: those of the displacements,
        which differ from `seen` where a reaction has ended before. bare: without reactions. free: without the reactions of
        contacts and walls. pulled: mask of particles that links which may go slack hold. friction: whether there is friction. h,
        drag: of each world.
        """
        leaning = had - free
        over = _ratio(((had - seen) * leaning).sum(axis=2), leaning) + _ended(change, had - bare, friction)
        share = np.where(self.some, np.clip(over, 0, 1)[..., None], 0.0)
        more = np.where(self.some, share * leaning, 0.0)
        r = (h * drag[:, 1] / drag[:, 3]).reshape(-1, 1, 1) * more
        for field in self.others:  # forces that read velocities read them without the ended reaction, too
            self.was[field] = self.was[field] + r
        found = np.isfinite(more).all(axis=(1, 2)) & ~(pulled & (share[..., 0] == 1)).any(axis=1)
        return share, found & self.give(want + more, velocity, factor(h, drag), had)


def _ended(change: np.ndarray, leaning: np.ndarray, friction: bool) -> np.ndarray:
    """Return the share of each particle's reaction that a change of velocity ends, (worlds, n). It may exceed 1.

    A change of LEANS of the reaction's velocity or more ends all of it: a change along the reaction or, with friction, in any
    direction. leaning: the velocity that reactions give in half a substep, (worlds, n, dim) [m/s].
    """
    if friction:
        part = np.sqrt((change**2).sum(axis=2) * (leaning**2).sum(axis=2))
    else:
        part = np.abs((change * leaning).sum(axis=2))
    return _ratio(part, leaning) / LEANS


def _ratio(part: np.ndarray, leaning: np.ndarray) -> np.ndarray:
    """Return `part` divided by the square of `leaning`, (worlds, n); 0 where there is no reaction."""
    square = (leaning**2).sum(axis=2)
    return np.divide(part, square, out=np.zeros_like(square), where=square != 0)


def has_friction(runner: Any) -> bool:
    """Whether contacts or walls have friction."""
    return any(c.has_friction for c in runner.step.contacts) or any(wall.has_friction for wall in runner.step.walls)


def pulled(runner: Any, worlds: int, read: Callable[[Any], np.ndarray]) -> np.ndarray:
    """Return a mask of the particles that taut, rigid, one-sided links hold, (worlds, n): these links may go slack.

    read: returns a field of all worlds.
    """
    out = np.zeros((worlds, runner.n), dtype=bool)
    for batch in runner.batches:
        if getattr(batch, "side", 0):
            world, c = np.nonzero((read(batch.dev.equation.lam)[:, : batch.count] != 0) & (batch.compliance == 0))
            out[world[:, None], batch.indices[c]] = True
    return out


def has_enough_digits(runner: Any) -> bool:
    """Whether displacements determine velocities with enough digits, in a world of order 2."""
    return not runner.probe and (runner.clock.drag or FREE)[0] >= WEAK


def steer(
    runner: Any, want: np.ndarray, seen: np.ndarray, change: np.ndarray, iterations: int, spun: np.ndarray | None = None
) -> bool:  # fmt: skip
    """Set the velocities of movable particles with a `change` of velocity or spin, (n, any) [m/s], between two substeps.

    want: the new velocities, (n, dim) [m/s]. seen: the present ones. spun: the result of Runner.spin(), if it is known. Returns
    whether displacements were found that give the new velocities; if not, the caller must take a start.
    """
    some, clock, drag = (change != 0).any(axis=1), runner.clock, np.array([runner.clock.drag or FREE])
    if clock.d_is_velocity or not has_enough_digits(runner):
        return False
    first, end, chosen = _movable(runner, some)
    if first < end:
        rows, those = slice(first, end), _those(runner, first, chosen)
        with runner.memory.compiler():
            had = seen if clock.velocity_override is None else runner.velocity(iterations)
            free = runner.velocity(iterations, first, end, touches=False)[None]
            bare = runner.velocity(iterations, first, end, links=False, touches=False)[None] if runner.batches else free
            share, found = those.steer(
                want[None, rows], change[None, rows], seen[None, rows], had[None, rows], bare, free,
                pulled(runner, 1, lambda field: runner.memory.read(field)[None])[:, rows], has_friction(runner),
                lambda: runner.velocity(iterations, first, end)[None], clock.h, drag,
            )  # fmt: skip
        if not found[0]:
            return False
        restore_turn(runner, first, share[0], spun)
    runner.wake(np.flatnonzero(some))
    clock.energy, clock.velocity_override = None, want.copy()
    return True


def has_same_drag(runner: Any) -> bool:
    """Whether the drag rates are those of the last substep."""
    clock = runner.clock
    return clock.drag == (decay(sum(f.rate for f in runner.drags), clock.h) if runner.drags else None)


def keep_velocities(runner: Any, want: np.ndarray, iterations: int) -> bool:
    """Let particles go on with velocities `want`, (n, dim) [m/s], after forces have changed from a to a'.

    The velocity is d / h + h (a + reaction) / 2, so d grows by h^2 (a - a') / 2. With the next substep, which adds h^2 a', that
    is half a kick of the old force and half of the new one, and reactions follow from it. Particles on which the same forces act
    continue bit for bit. Returns whether displacements were found; if not, the caller must take a start.
    """
    rows = (0, runner.n) if runner.paths else None  # velocities of beads point along their wires if all of them are computed
    with runner.memory.compiler():
        seen = runner.velocity(iterations)
        first, end, chosen = _movable(runner, (seen != want).any(axis=1))
        if first == end:
            return True
        begin, last = rows or (first, end)

        def velocity() -> np.ndarray:
            """Return the velocities of the present displacements."""
            return runner.velocity(iterations, begin, last)[None, first - begin : end - begin]

        change, factor = float(np.abs(want - seen).max()), np.array([factor_of(runner.clock)])
        return bool(_those(runner, first, chosen).give(want[None, first:end], velocity, factor, seen[None, first:end], change)[0])


def restore_turn(runner: Any, first: int, share: np.ndarray, spun: np.ndarray | None = None) -> None:
    """Give particles from `first` on back the part of friction's turn in half a substep that has ended. share: (m, 1).

    spun: the result of Runner.spin(), if it is known.
    """
    state, memory, step = runner.scene.state, runner.memory, runner.step
    turned = [c.dev.rows.turned for c in step.contacts if c.dev.rows and state.spins]
    turned += [step.particles.wall_turn] if step.particles.turned_by_walls else []
    if not (state.spins and turned and share.any()):
        return
    with memory.compiler():
        spun = runner.spin() if spun is None else spun
    half = runner.clock.h * spun - memory.read(state.spin.s)[: runner.n]
    rows, s = slice(first, first + len(share)), memory.read(state.spin.s)
    s[rows] += share * half[rows]
    memory.write(state.spin.s, s)
    for field in turned:
        left = memory.read(field)
        left[rows] *= 1 - share
        memory.write(field, left)


def let_go(runner: Any, some: np.ndarray, want: np.ndarray, iterations: int) -> None:
    """Let particles `some`, (k,) numbers in ascending order, go on with velocities `want`, (k, dim) [m/s], as far as they can
    move."""
    memory, moves = runner.memory, runner.scene.inv_mass[some] > 0
    if not moves.all():
        some, want = some[moves], want[moves]
    if not len(some):
        return
    if runner.clock.d_is_velocity:
        memory.write_rows(some, (runner.scene.state.d, want))
        return
    first = int(some[0])
    lack = want - runner.velocity(iterations, first, int(some[-1]) + 1)[some - first]
    those = Displacements(
        runner, moves[moves], lambda field: memory.view(field)[some], lambda field, rows: memory.write_rows(some, (field, rows))
    )
    those.lengthen(factor_of(runner.clock) * lack)


def give_new(runner: Any, first: int, want: np.ndarray, iterations: int) -> None:
    """Set the displacements of added particles to those that velocities `want`, (m, dim) [m/s], need.

    The particles are those from index `first` on. They touch nothing yet.
    """
    moves = runner.scene.inv_mass[first:] > 0
    want = np.where(moves[:, None], want, 0.0)[None]
    those = _those(runner, first, moves)
    those.begin_with(runner.clock.h * want)

    def velocity() -> np.ndarray:
        """Return the velocities of the present displacements."""
        return runner.velocity(iterations, first, just_added=True)[None]

    with runner.memory.compiler():  # for orders above 2
        if any(f.may_act_from(first) for f in runner.integrator.forces.velocity_dependent):
            those.give(want, velocity, np.array([factor_of(runner.clock)]))
        else:
            those.lengthen(factor_of(runner.clock) * (want - velocity()))


def _movable(runner: Any, some: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Return the range of movable particles in a mask: the first, one behind the last, and the mask within the range."""
    some = some & (runner.scene.inv_mass > 0)
    rows = np.flatnonzero(some)
    first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
    return first, end, some[first:end]


def _those(runner: Any, first: int, some: np.ndarray) -> Displacements:
    """Return the Displacements of particles from index `first` on, of a single world, or of the chosen one of many copies."""
    memory, rows = runner.memory, slice(first, first + len(some))

    def write(field: Any, v: np.ndarray) -> None:
        """Write rows of the chosen copy."""
        values = memory.read(field)
        values[rows] = v[0]
        memory.write(field, values)

    if memory.copies:
        return Displacements(runner, some[None], lambda field: memory.read(field)[None, rows].copy(), write)
    return Displacements(
        runner,
        some[None],
        lambda field: memory.view(field)[None, rows].copy(),
        lambda field, v: memory.write_from(field, first, v[0]),
    )
