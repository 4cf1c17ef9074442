"""Settling: what is placed off its rigid constraints moves to where these are met, without momentum.

A rigid constraint removes any violation in one substep, and what has moved goes on moving: a link that is placed a tenth too long
would leave with C / h. So particles that are placed, before the first frame or in any later one, settle first, by substeps of no
length. These are passes of the step, with all constraints, contacts and walls, but forces, springs, targets and displacements
have no time to move anything in them, nothing breaks, and there are no events. Of the bodies that settle, positions are kept; all
else, velocities and loads, contacts, and other bodies, is as before.

They end where violations are down to rounding, or where passes would move bodies by next to nothing in the coming frame. Without
walls and contacts, they are mixed, which takes a tenth of them (`anderson.py`). Straight and flat bodies whose links are too long
bulge first, as they have no direction to give way in. Constraints that contradict each other stay violated, and passes have
nothing left to do there. In a running world, part of a violation bears the load of the last substep, and is no reason to move.

Where substeps get shorter, what long ones have left violated, by impacts or where systems gave way, settles, too. See relieve().
"""

from typing import TYPE_CHECKING

import numpy as np

from .anderson import Anderson
from .checkpoint import fields, put_fields
from .clock import CHANGED
from .softness import stored
from .violations import ENOUGH, SEEN, Bodies

if TYPE_CHECKING:
    from .runner import Runner

TINY = 2.0**-36  # of a frame: what forces and springs do in such a substep is below rounding
FIRST, LOOK = 4, 64  # passes between two looks at violations; each is a substep, whose direction is that at its start
DONE = 1e-10  # of its size: a violation with which it ends, beside rounding of coordinates and of itself
HALVINGS = 64  # at most, of a way by which functions of the user are further from their rest; then of each single pass
BETTER = 0.99  # of what is violated: what bulging has to leave at most
LESS = 0.01  # of what would become of violations if nothing settled: what is worth it
SLIGHT = 1e-3  # of the largest kinetic energy: what violations may become
STILL = 1e-8  # of the way of a body, or of its least constraint: what the coming frame may move it yet
ROUGHLY = 1e-3  # the same for conjugate gradients, which solve nets: a taut one comes to rest as 1 / n only
LEAST, MOST, WORK = 16, 1000, 2_000_000  # looks, at least and at most; particles and constraints in all of them
SOFT = 30  # looks at most where what is left stays soft: a taut net comes to rest as 1 / n only


def relieve(runner: "Runner", h: float, dt: float) -> float:
    """Settle what longer substeps than h [s] have left violated. Returns the part of what it stores that is left: 1 for all.

    It lifts bodies as far as the scene has had that energy before, with what stays stored; for more, the motion of what moves
    pays, or nothing settles.
    Bodies that nothing holds stay soft instead, see softness.py: drawn together, they would lose angular momentum. Only rows that
    are solved exactly have no softness, and what is left of their violations becomes motion.
    """
    clock, state, memory, system = runner.clock, runner.scene.state, runner.memory, runner.scene.slots.system
    bodies, x, exact = Bodies(runner.scene, runner.batches), state.get(memory), bool(system) and not system.steps
    otherwise = bodies.energy(x, h) if np.isfinite(x).all() else np.nan
    if not np.isfinite(otherwise) or (exact and otherwise <= SLIGHT * clock.kinetic):
        return 1.0
    going = bodies.far(x, (h / clock.h) ** 2 / clock.softness)[0] > (0.0 if exact else SEEN)
    if not exact:
        going &= bodies.with_any(_held(runner))
    if not going.any():
        return 1.0
    before = clock.energy if clock.energy is not None else _energy(runner)
    store = stored(runner)
    supply = before + store if clock.bound is None else max(before, clock.bound)
    far, new = _settled(runner, bodies, going, x, h, dt, MOST if exact else SOFT)
    state.put(memory, new)
    energy, kept = _energy(runner), stored(runner)
    due = energy + bodies.energy(new, h) + kept - supply if clock.bound != CHANGED else 0.0
    some, w, d = (new != x).any(axis=1), runner.scene.inv_mass, memory.read(state.d)
    m = np.divide(some, w, out=np.zeros(len(w)), where=w > 0)
    kinetic = float(m @ (d[: runner.n].astype(np.float64) ** 2).sum(axis=1)) / 2
    if due > kinetic + LESS * otherwise:
        state.put(memory, x)
        runner.invalidate()
        return 1.0
    if due > 0 and kinetic > 0:
        d[: runner.n][some] *= max(1 - due / kinetic, 0.0) ** 0.5
        memory.write(state.d, d)
    bodies.forget_loads(going & (far > ENOUGH))
    clock.energy = energy - max(due, 0.0)  # for softness.py; it is computed again before the frame
    return min(kept / store if store > 0 else 0.0, 1 - LESS)


def _held(runner: "Runner") -> np.ndarray:
    """Return a mask of the particles that a wall has moved in the last substep, or that cannot move, (n,)."""
    out = runner.scene.inv_mass == 0
    if runner.step.walls:
        out |= (runner.memory.read(runner.step.particles.wall_displacement)[: runner.n] != 0).any(axis=1)
    return out


def _energy(runner: "Runner") -> float:
    """Return the energy of the present state [J]."""
    runner.diagnose_state()
    return runner.report().energy


def settle(runner: "Runner", placed: int, h: float, dt: float) -> tuple[np.ndarray, float] | None:
    """Move bodies with any particle from `placed` on to where their rigid constraints are met, or as near as they come.

    Displacements hold velocities. h, dt: of the coming frame [s]. Returns how far each particle moved, (n,) [m], and the largest
    violation that was removed, as a share of the size of its constraint or cluster; None if nothing moved.
    """
    state, memory = runner.scene.state, runner.memory
    x = state.get(memory)
    if not np.isfinite(x).all():
        return None
    bodies = Bodies(runner.scene, runner.batches)
    going = (bodies.far(x)[0] > 0) & (np.bincount(bodies.body[placed:], minlength=bodies.count) > 0)
    if not going.any():
        return None
    far, new = _settled(runner, bodies, going, x, h, dt)
    state.put(memory, new)
    bodies.forget_loads(going & (far > ENOUGH))
    return np.linalg.norm(new - x, axis=1), float(far.max())


def _settled(
    runner: "Runner", bodies: Bodies, going: np.ndarray, x: np.ndarray, h: float, dt: float, looks: int = MOST
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the bodies in the mask `going` are from their rest at x, (n, dim), and where they settle, (n, dim).

    The state is as before.
    """
    far, clock, values = bodies.far(x, 0.0)[0] * going, runner.clock.copy(), fields(runner)
    for b in runner.ramping:
        b.ramp.hold()
    if system := runner.scene.slots.system:
        system.forget()  # which parts give way
    runner.set_softness(1.0)
    new, left = _passed(runner, bodies, going, np.where(going[bodies.body][:, None], bodies.bulged(x), x), h, dt, looks)
    stuck = left > SEEN
    arcs = np.where(stuck[bodies.body][:, None], bodies.bulged(new), new)
    if (arcs != new).any():
        arcs, less = _passed(runner, bodies, stuck, arcs, h, dt, looks)
        new = np.where((less < BETTER * left)[bodies.body][:, None], arcs, new)
    put_fields(runner, values)
    runner.set_substep(clock.h, clock.drag)
    runner.set_softness(clock.softness)
    runner.clock.put_back(clock)
    return far, new


def _passed(
    runner: "Runner", bodies: Bodies, going: np.ndarray, x: np.ndarray, h: float, dt: float, looks: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return where passes move the bodies in the mask `going` from x, (n, dim), and what they leave violated, as far() does."""
    state, memory, some, most = runner.scene.state, runner.memory, going.copy(), max(LEAST, WORK // (runner.n + bodies.count))
    mixes = not (runner.step.walls or runner.step.contacts)  # which do not call back what a mix has put behind them
    frame = (dt / h) ** 2 / 2  # a pass that repeats in each substep moves particles by so many times its move in a frame
    new, left, mixing = x, bodies.far(x, 0.0, DONE + bodies.digit), Anderson(bodies)
    digit = bodies.digit * bodies.longest(x)  # of coordinates: a move that says nothing
    plain, many, still = x, True, ROUGHLY if (system := runner.scene.slots.system) and system.steps else STILL
    for look in range(min(most, looks)):
        state.put(memory, new)
        last, passes = new, min(LOOK, FIRST << min(look, 8)) if many else 1
        for _ in range(passes):
            runner.run_no_time(dt * TINY)
        new = state.get(memory)
        new = np.where((some[bodies.body] & np.isfinite(new).all(axis=1))[:, None], new, last)
        for k in range(HALVINGS):
            now = bodies.far(new, 0.0, DONE + bodies.digit)
            worse = ~(now[2] <= left[2])[bodies.body][:, None]
            if not worse.any():
                break
            new, many = np.where(worse, (new + last) / 2 if k < HALVINGS - 2 else last, new), False
        if last is not plain and ((now[1] > left[1]) & some).any():  # of no use: where passes alone had come is better
            new, last = plain, plain
            mixing.forget()
            continue
        left, plain = now, new
        move, way = bodies.longest(new - last), np.minimum(bodies.longest(new - x), bodies.size)
        some &= (left[0] > 0) & (move > digit) & (frame / passes * move > still * way)
        if not some.any():
            break
        if mixes and many and passes == LOOK:
            new = np.where(some[bodies.body][:, None], mixing.next(last, new), new)
    return plain, left[0] * going
