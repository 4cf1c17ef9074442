"""Settling: what is placed off its rigid constraints moves to where these are met, without momentum.

A rigid constraint removes any violation in one substep, and what has moved goes on moving: a link that is placed a tenth too long
would leave with C / h. So particles that are placed, before the first frame or in any later one, settle first, by substeps of no
length. These are passes of the step, with all constraints, contacts and walls, but forces, springs, targets and displacements
have no time to move anything in them, nothing breaks, and there are no events. Of the bodies that settle, positions are kept; all
else, velocities and loads, contacts, and other bodies, is as before.

They end where violations are down to rounding, or where bodies stand still. Straight and flat bodies whose links are too long
bulge first, as they have no direction to give way in. Constraints that contradict each other stay violated, and passes have
nothing left to do there. In a running world, part of a violation bears the load of the last substep, and is no reason to move.

Where substeps get shorter, what long ones have left violated, by impacts or where systems gave way, settles, too. See relieve().
"""

from typing import TYPE_CHECKING

import numpy as np

from .checkpoint import fields, put_fields
from .clock import CHANGED
from .softness import stored
from .violations import ENOUGH, SEEN, Bodies

if TYPE_CHECKING:
    from .runner import Runner

TINY = 2.0**-36  # of a frame: what forces and springs do in such a substep is below rounding
LOOK = 64  # passes between two looks at violations, at first fewer; each is a substep, whose direction is that at its start
DONE = 1e-10  # of its size: a violation with which it ends, beside rounding of coordinates and of itself
HALVINGS = 64  # at most, of a way by which functions of the user are further from their rest; then of each single pass
BETTER, PATIENCE = 0.99, 16  # a violation that falls more slowly in so many looks has come as low as it can,
LESS = 0.01  # of what would become of violations if nothing settled: what is worth it
SLIGHT = 1e-3  # of the largest kinetic energy: what violations may become
STILL = 1e-4  # if its body also moves by no more of its way in a look
QUICK = 200  # looks, at most, where substeps get shorter
MOST, WORK = 1000, 2_000_000  # looks, and particles and constraints in all looks, at most: a second or two


def relieve(runner: "Runner", h: float, dt: float) -> bool:
    """Settle what longer substeps than h [s] have left violated. Returns whether it did.

    It lifts bodies as far as the scene has had that energy before; for more, the motion of what moves pays, or nothing settles.
    Bodies that nothing holds stay soft instead, see softness.py: drawn together, they would lose angular momentum. Only systems
    that are solved exactly have no softness.
    """
    clock, state, memory, system = runner.clock, runner.scene.state, runner.memory, runner.scene.slots.system
    bodies, x, exact = Bodies(runner.scene, runner.batches), state.get(memory), bool(system) and not system.steps
    otherwise = bodies.energy(x, h) if exact else 0.0  # what exact systems, which nothing softens, make of it
    if not np.isfinite(x).all() or (exact and otherwise <= SLIGHT * clock.kinetic):
        return False
    going = bodies.far(x, (h / clock.h) ** 2 / clock.softness)[0] > (0.0 if exact else SEEN)
    if not exact:
        going &= bodies.with_any(_held(runner))
    if not going.any():
        return False
    before = clock.energy if clock.energy is not None else _energy(runner)
    supply = max(before, clock.bound) if clock.bound is not None else before + stored(runner)
    far, new = _settled(runner, bodies, going, x, dt, hurries=True)
    state.put(memory, new)
    left = bodies.energy(new, h) * clock.softness
    due = _energy(runner) + left - supply if clock.bound != CHANGED else 0.0
    some, w, d = (new != x).any(axis=1), runner.scene.inv_mass, memory.read(state.d)
    m = np.divide(some, w, out=np.zeros(len(w)), where=w > 0)
    kinetic = float(m @ (d[: runner.n].astype(np.float64) ** 2).sum(axis=1)) / 2
    if due > kinetic + LESS * otherwise:
        state.put(memory, x)
        runner.invalidate()
        return False
    if due > 0 and kinetic > 0:
        d[: runner.n][some] *= max(1 - due / kinetic, 0.0) ** 0.5
        memory.write(state.d, d)
    bodies.forget_loads(going & (far > ENOUGH))
    clock.energy = None
    return True


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


def settle(runner: "Runner", placed: int, dt: float) -> tuple[np.ndarray, float] | None:
    """Move bodies with any particle from `placed` on to where their rigid constraints are met, or as near as they come.

    Displacements hold velocities. dt: of the coming frame [s]. Returns how far each particle moved, (n,) [m], and the largest
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
    far, new = _settled(runner, bodies, going, x, dt, hurries=False)
    state.put(memory, new)
    bodies.forget_loads(going & (far > ENOUGH))
    return np.linalg.norm(new - x, axis=1), float(far.max())


def _settled(
    runner: "Runner", bodies: Bodies, going: np.ndarray, x: np.ndarray, dt: float, hurries: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far the bodies in the mask `going` are from their rest at x, (n, dim), and where they settle, (n, dim).

    hurries: whether to end after QUICK looks. The state is as before.
    """
    far, clock, values = bodies.far(x, 0.0)[0] * going, runner.clock.copy(), fields(runner)
    for b in runner.ramping:
        b.ramp.hold()
    if system := runner.scene.slots.system:
        system.forget()  # which parts give way
    runner.set_softness(1.0)
    new, left = _passed(runner, bodies, going, np.where(going[bodies.body][:, None], bodies.bulged(x), x), dt, hurries)
    stuck = left > SEEN
    arcs = np.where(stuck[bodies.body][:, None], bodies.bulged(new), new)
    if (arcs != new).any():
        arcs, less = _passed(runner, bodies, stuck, arcs, dt, hurries)
        new = np.where((less < BETTER * left)[bodies.body][:, None], arcs, new)
    put_fields(runner, values)
    runner.set_substep(clock.h, clock.drag)
    runner.set_softness(clock.softness)
    runner.clock.put_back(clock)
    return far, new


def _passed(
    runner: "Runner", bodies: Bodies, going: np.ndarray, x: np.ndarray, dt: float, hurries: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return where passes move the bodies in the mask `going` from x, (n, dim), and what they leave violated, as far() does."""
    state, memory, some = runner.scene.state, runner.memory, going[bodies.body]
    # Nesterov's steps, only near a rest: elsewhere they throw off what has no direction, and what walls cannot call back.
    speeds = hurries and not (
        runner.step.walls or runner.step.contacts or (runner.scene.slots.system and runner.scene.slots.system.steps)
    )
    most = min(QUICK if hurries else MOST, max(PATIENCE, WORK // (runner.n + bodies.count)))
    new, history, many, pace = x, [bodies.far(x, 0.0, DONE + bodies.digit) * going], True, 0
    for _ in range(most):
        state.put(memory, new)
        last = new
        for _ in range(min(LOOK, 4 << len(history)) if many else 1):
            runner.run_no_time(dt * TINY)
            if speeds and many:
                before, new, pace = new, state.get(memory), pace + 1
                state.put(memory, np.where(some[:, None], new + pace / (pace + 3) * (new - before), new))
        new = state.get(memory) if not (speeds and many) else new
        new = np.where(np.isfinite(new), new, last)
        for k in range(HALVINGS):
            left = bodies.far(new, 0.0, DONE + bodies.digit) * going
            worse = ~(left[2] <= history[-1][2])[bodies.body][:, None]
            if not worse.any():
                break
            new, many = np.where(worse, (new + last) / 2 if k < HALVINGS - 2 else last, new), False
        pace = pace if (left[1] <= history[-1][1]).all() else 0
        history.append(left)
        stands = len(history) > PATIENCE and (left[1] >= BETTER**2 * history[-PATIENCE][1]).all()
        stands = stands and _longest(new - last, some) <= STILL * _longest(new - x, some)
        if not left.any() or (stands and not speeds):
            break
        if stands:  # what contradicts itself comes to rest by plain passes
            speeds, history = False, history[-1:]
    return np.where(some[:, None], new, x), history[-1][0]


def _longest(way: np.ndarray, some: np.ndarray) -> float:
    """Return the length of the longest way, (n, dim), of the particles in the mask `some`."""
    return float(np.linalg.norm(way[some], axis=1).max())
