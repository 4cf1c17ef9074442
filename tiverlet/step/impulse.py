"""Velocities that are given between two substeps, as impulses: to particles that come, that are let go, or that a user steers.

A velocity is (share d + rest (h^2 a + reaction)) / h, see Integrator.velocity_after(). So what a particle lacks of the velocity
that it is to have, times h / share, is what its displacement lacks. Nothing else of the state changes: what is to have the
velocity that it has goes on to the bit, known loads stay known, and sound goes on being damped, as they would not after a start.

The half of the reaction that this leaves in d has to go on in the next substep. That of links does, or they would part. What a
particle leans on by contacts and walls may end, where it is sent off or friction turns round: it gets that half back, so that the
next substep finds as much to bear as a start would, see Displacements.steer(). What touches it has its own half all the same, and
falls by g h / 2 too fast where that ends with it. Where a rope that is taut may go slack, all start.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from .integrator import FREE

ROUNDS = 100  # of asking for velocities, at most, where forces read them
NOTHING = 2.0**-20  # of a velocity: less than this of it is in the next displacement
WEAK = 0.01  # the same: below it, displacements tell velocities by too few digits
LEANS = 0.25  # of what half of a reaction gives: a change of velocity that ends it, and smaller ones a part of it
MET = 1e-5  # of the largest velocity: what may be lacking where forces read velocities
DIGITS = 4  # roundings of it: as near as one comes
Write = Callable[[Any, np.ndarray], None]


def factor(h: np.ndarray, drag: np.ndarray) -> np.ndarray:
    """By how much a displacement has to be longer for a velocity of 1 m/s more [s], after a substep h. Where drag leaves nothing
    of a velocity in a substep, d does not matter. Of many worlds, with drag (worlds, 5)."""
    return h / np.maximum(drag[:, 0], NOTHING)


class Displacements:
    """Those of some particles, (..., dim), and what goes with them: what of them forces did, and their low words.

    some: the mask of those that change, (...,). read, write: get and set a field's rows.
    """

    def __init__(self, runner: Any, some: np.ndarray, read: Callable[[Any], np.ndarray], write: Write):
        state, integrator = runner.scene.state, runner.integrator
        self.field, self.low = state.d, state.d_low if state.carries else None
        self.some, self.write, self.again = some[..., None], write, integrator.uses_velocity
        self.others = [integrator.free] if integrator.uses_velocity else []
        self.was = {field: read(field) for field in (state.d, *([self.low] if self.low else []), *self.others)}

    def begin_with(self, d: np.ndarray) -> None:
        """Of particles that come: what forces alone would have made of them."""
        for field in (self.field, *self.others):
            self.was[field] = d
            self.write(field, d)

    def lengthen(self, more: np.ndarray) -> None:
        """Have them be as they were, and longer by `more`, (..., dim)."""
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
        self, want: np.ndarray, velocity: Callable[[], np.ndarray], factor: np.ndarray, seen: np.ndarray | None = None
    ) -> np.ndarray:
        """Have them stand for velocities `want`, (worlds, ..., dim): at once, but for a round for what the first one rounded, or
        one time after the other where forces read velocities, until these come no nearer. velocity: asks for those that they
        stand for. factor: of each world, see factor(). seen: what velocity() would say at first, if that is known. Returns in
        which worlds that was found, (worlds,)."""
        more = best = np.zeros(want.shape)
        least, factor = np.full(len(want), np.inf), factor.reshape(-1, 1, 1)
        largest = np.abs(want).max(axis=(1, 2), initial=0.0)
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
        pulled: np.ndarray, rubs: bool, velocity: Callable[[], np.ndarray], h: Any, drag: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """The same for `want` where velocities or spins get a `change`, with which what particles lean on may end. Returns which
        share of that is over, (worlds, n, 1), and in which worlds that was found.

        seen: velocities so far, for the user; had: what displacements stand for, which is more where something is over; bare:
        that without reactions; free: without those of contacts and walls. pulled: by links that may go slack. h, drag: of each.
        """
        leaning = had - free
        over = _ratio(((had - seen) * leaning).sum(axis=2), leaning) + _ended(change, had - bare, rubs)
        share = np.where(self.some, np.clip(over, 0, 1)[..., None], 0.0)
        more = np.where(self.some, share * leaning, 0.0)
        r = (h * drag[:, 1] / drag[:, 3]).reshape(-1, 1, 1) * more
        for field in self.others:  # forces that read velocities do without it, too
            self.was[field] = self.was[field] + r
        found = np.isfinite(more).all(axis=(1, 2)) & ~(pulled & (share[..., 0] == 1)).any(axis=1)
        return share, found & self.give(want + more, velocity, factor(h, drag), had)


def _ended(change: np.ndarray, leaning: np.ndarray, rubs: bool) -> np.ndarray:
    """Which share of what particles lean with a change of velocity ends, (worlds, n): all from LEANS of it on, along it or, with
    friction, in any direction. leaning: what reactions give in half a substep."""
    if rubs:
        part = np.sqrt((change**2).sum(axis=2) * (leaning**2).sum(axis=2))
    else:
        part = np.abs((change * leaning).sum(axis=2))
    return _ratio(part, leaning) / LEANS


def _ratio(part: np.ndarray, leaning: np.ndarray) -> np.ndarray:
    """By the square of `leaning`; 0 where nothing leans."""
    square = (leaning**2).sum(axis=2)
    return np.divide(part, square, out=np.zeros_like(square), where=square != 0)


def rubs(runner: Any) -> bool:
    """Whether anything has friction."""
    return any(c.has_friction for c in runner.step.contacts) or any(wall.has_friction for wall in runner.step.walls)


def pulled(runner: Any, worlds: int, read: Callable[[Any], np.ndarray]) -> np.ndarray:
    """The particles that rigid links hold which may go slack, a mask (worlds, n). read: gets a field, of each."""
    out = np.zeros((worlds, runner.n), dtype=bool)
    for batch in runner.batches:
        if getattr(batch, "side", 0):
            world, c = np.nonzero((read(batch.dev.equation.lam)[:, : batch.count] != 0) & (batch.compliance == 0))
            out[world[:, None], batch.indices[c]] = True
    return out


def tells(runner: Any) -> bool:
    """Whether displacements tell velocities: in order 2, by enough digits."""
    return not runner.probe and (runner.clock.drag or FREE)[0] >= WEAK


def steer(runner: Any, want: np.ndarray, seen: np.ndarray, change: np.ndarray, iterations: int) -> bool:
    """Have particles with a `change` of velocity or spin, (n, any) [m/s], that can move go on with velocities `want`, (n, dim)
    [m/s], instead of `seen`. Returns whether displacements were found that stand for these; else it takes a start."""
    some, clock, drag = (change != 0).any(axis=1), runner.clock, np.array([runner.clock.drag or FREE])
    if clock.d_is_velocity or not tells(runner):
        return False
    first, end, chosen = _movable(runner, some)
    if first < end:
        rows, those = slice(first, end), _those(runner, first, chosen)
        with runner.memory.compiler():
            had = seen if clock.parted is None else runner.velocity(iterations)
            free = runner.velocity(iterations, first, end, touches=False)[None]
            bare = runner.velocity(iterations, first, end, links=False, touches=False)[None] if runner.batches else free
            share, found = those.steer(
                want[None, rows], change[None, rows], seen[None, rows], had[None, rows], bare, free,
                pulled(runner, 1, lambda field: runner.memory.read(field)[None])[:, rows], rubs(runner),
                lambda: runner.velocity(iterations, first, end)[None], clock.h, drag,
            )  # fmt: skip
        if not found[0]:
            return False
        turn_on(runner, first, share[0])
    runner.wake(np.flatnonzero(some))
    clock.energy, clock.parted = None, want.copy()
    return True


def turn_on(runner: Any, first: int, share: np.ndarray) -> None:
    """Have particles from number `first` on keep of what friction turned them by in half a substep the part that is over."""
    state, memory, step = runner.scene.state, runner.memory, runner.step
    turned = [c.dev.forces.turned for c in step.contacts if c.dev.forces.spins]
    turned += [step.particles.wall_turn] if step.particles.turned_by_walls else []
    if not (state.spins and turned and share.any()):
        return
    with memory.compiler():
        half = runner.clock.h * runner.spin() - memory.read(state.spin.s)[: runner.n]
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
        memory.write_rows(runner.scene.state.d, some, want)
        return
    first = int(some[0])
    lack = want - runner.velocity(iterations, first, int(some[-1]) + 1)[some - first]
    those = Displacements(
        runner, moves[moves], lambda field: memory.view(field)[some], lambda field, rows: memory.write_rows(field, some, rows)
    )
    those.lengthen(_factor(runner) * lack)


def give_new(runner: Any, first: int, want: np.ndarray, iterations: int) -> None:
    """Give particles from number `first` on, which touch nothing yet, the displacements that velocities `want` need, (m, dim)."""
    moves = runner.scene.inv_mass[first:] > 0
    want = np.where(moves[:, None], want, 0.0)[None]
    those = _those(runner, first, moves)
    those.begin_with(runner.clock.h * want)

    def velocity() -> np.ndarray:
        """What they stand for."""
        return runner.velocity(iterations, first, came=True)[None]

    with runner.memory.compiler():  # for orders above 2
        if any(f.may_act_from(first) for f in runner.integrator.forces.velocity_dependent):
            those.give(want, velocity, np.array([_factor(runner)]))
        else:
            those.lengthen(_factor(runner) * (want - velocity()))


def _movable(runner: Any, some: np.ndarray) -> tuple[int, int, np.ndarray]:
    """Of the particles of a mask that can move, the first, the number behind the last, and which in between they are, a mask."""
    some = some & (runner.scene.inv_mass > 0)
    rows = np.flatnonzero(some)
    first, end = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
    return first, end, some[first:end]


def _factor(runner: Any) -> float:
    """That of factor() for a world alone."""
    return runner.clock.h / max((runner.clock.drag or FREE)[0], NOTHING)


def _those(runner: Any, first: int, some: np.ndarray) -> Displacements:
    """Of a world alone, those of particles from number `first` on."""
    memory, rows = runner.memory, slice(first, first + len(some))
    return Displacements(
        runner,
        some[None],
        lambda field: memory.view(field)[None, rows].copy(),
        lambda field, v: memory.write_from(field, first, v[0]),
    )
