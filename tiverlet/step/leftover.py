"""What a long substep leaves violated: systems after impacts, chains that gave way, and rigid links by their loads.

Shorter substeps would remove it at once, which leaves velocities, or hold a load by less. So it is treated as if the user had
placed particles there, see initial_violation.py: bodies move to where their constraints are met, but for what bears loads in a
shorter substep. Velocities along links go, and free bodies keep their angular momentum. Nothing supplies energy: the motion pays
for what is lifted, or all stays as it is, see softness.py.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..constraints.core.anchored import Anchored
from ..constraints.core.scalar import Scalar
from . import initial_violation
from .free_bodies import FreeBodies
from .jacobian import Jacobian
from .softness import stored, worst

if TYPE_CHECKING:
    from .runner import Runner

ENOUGH = 1e-3  # of its size: a violation that matters, times (1 - r^2)^2 / r^2, r = h' / h: what a jump leaves to vibrate
QUICK = 8  # steps of Newton's method where links may stay soft instead
SLIGHT = 1e-3  # of the largest kinetic energy: what velocities may gain, and what may be more than ever


def remove(runner: "Runner", h: float, measured: bool, adapts: bool) -> bool:
    """Remove it before substeps h [s], shorter than the last one; displacements hold velocities.

    Loads count only where all links are rigid. measured: whether a loop measures dt; then they do not count, because a wait would
    make its next frame longer. adapts: whether substeps are chosen for accuracy; then this may take long. Returns whether what is
    left stores no more energy if links are as stiff as shorter substeps make them.
    """
    clock, scene, memory, state = runner.clock, runner.scene, runner.memory, runner.scene.state
    system, x = scene.slots.system, state.get(memory)
    stiffens = bool(system) and system.can_stiffen
    sags = not measured and all(isinstance(b, Scalar) and not b.soft for b in runner.batches)
    if not np.isfinite(x).all():
        return False
    square = (h / clock.h) ** 2 / clock.softness  # by how much less the same loads need
    off = worst(runner.batches, x) if sags else 0.0
    must = stiffens or bool(system and _gain(runner, x, h) > SLIGHT * clock.kinetic)
    if not (must or off * (1 - square) ** 2 > ENOUGH * square):
        return False
    d, n = memory.read(state.d), runner.n
    loads = [(b.dev.equation.lam, memory.read(b.dev.equation.lam)) for b in runner.batches if isinstance(b, Scalar)]
    energy, before = clock.energy if clock.energy is not None else _energy(runner), stored(runner) if sags else 0.0
    moved = initial_violation.remove(
        scene, runner.batches, 0, square**0.5, runner.stop_at_walls, initial_violation.NEWTON if must or adapts else QUICK
    )
    if moved is None:
        return False
    runner.invalidate()
    some, new = moved[0] > 0, state.get(memory)
    v, jacobian = d[:n].astype(np.float64), _jacobian(runner, new)
    bodies = FreeBodies(jacobian, new, _held(runner))
    v = bodies.spun(v + some[:, None] * jacobian.solve(-jacobian.rates(v)), x, v)
    memory.write(state.d, np.concatenate([v, d[n:]]))
    after = _stored(runner, new, h) if sags else 0.0
    settled = sags and after <= before
    due = _energy(runner) + settled * after - max(energy + before, _bound(clock))
    pays, w, slight = some[:, None] * bodies.inner(v), scene.inv_mass, SLIGHT * clock.kinetic
    kinetic = float(np.divide(1, w, out=np.zeros(n), where=w > 0) @ (pays**2).sum(axis=1)) / 2
    if due > kinetic + slight or not (must or settled) or (stiffens and not system.stiffen(new, h, slight - min(due, 0.0))):
        state.put(memory, x)
        for field, values in [(state.d, d), *loads]:
            memory.write(field, values)
        return False
    if due > 0 and kinetic > 0:
        v -= (1 - max(1 - due / kinetic, 0.0) ** 0.5) * pays
        memory.write(state.d, np.concatenate([v, d[n:]]))
    if system and system.steps:
        system.forget(initial_violation.left(runner.batches, new))
    return settled


def _jacobian(runner: "Runner", x: np.ndarray) -> Jacobian:
    """Return the Jacobian of two-sided rigid links at x, (n, dim), which keep their lengths."""
    some = [b for b in runner.batches if isinstance(b, Scalar) and b.count and not (b.side or b.driven or b.broken.any())]
    rows = initial_violation.Rows(some, x, runner.scene.inv_mass, 0.0)
    return Jacobian(len(rows.C), rows.row, rows.who, rows.w, rows.J)


def _held(runner: "Runner") -> np.ndarray:
    """Return a mask of the particles that are held at a place, by a wall or by contacts, (n,). Their bodies are not free.

    In a periodic box all particles are in the mask: among images there is no angular momentum.
    """
    out = np.full(runner.n, runner.scene.periodic is not None)
    if runner.step.walls:
        out |= (runner.memory.read(runner.step.particles.wall_displacement)[: runner.n] != 0).any(axis=1)
    for b in runner.batches:
        if isinstance(b, Anchored):
            out[b.indices[:, 0]] = True
    return out


def _energy(runner: "Runner") -> float:
    """Return the energy of the present state [J]."""
    runner.diagnose_state()
    return runner.report().energy


def _gain(runner: "Runner", x: np.ndarray, h: float) -> float:
    """Return the energy that a substep h [s] would make of what systems left at x, (n, dim), sum C^2 / 2 w h^2 [J].

    It is 0 where loads need these violations.
    """
    clock, slots, gain, loads = runner.clock, runner.scene.slots, 0.0, 0.0
    shared = slots.shared
    for b in runner.batches:
        if isinstance(b, Scalar) and b.count:
            alone = np.bincount(b.owner, shared[b.indices.ravel()], minlength=b.count) == 0
            some = alone & (slots.rows(b) >= 0) & (b.compliance == 0) & ~b.broken & ~slots.system.gives_way(b)
            C, w = b.violation(x) * some, b.weights(x)
            C = C if b.side == 0 else np.maximum(b.side * C, 0.0)
            gain += float(np.divide(C * C, w, out=np.zeros(len(C)), where=w > 0).sum()) / 2
            loads += float(np.abs(b.load * C).sum()) / 2
    return gain / h**2 if gain > 2 * slots.system.greatest_floor * clock.softness * clock.h**2 * loads else 0.0


def _stored(runner: "Runner", x: np.ndarray, h: float) -> float:
    """Return the energy that violations at x, (n, dim), store in substeps h [s], sum C^2 / 2 W h^2 [J]."""
    some = [b for b in runner.batches if isinstance(b, Scalar) and b.count and not b.broken.any()]
    rows = initial_violation.Rows(some, x, runner.scene.inv_mass, 0.0)
    return runner.clock.iterations * float(((rows.C * rows.scale) ** 2).sum()) / (2 * h * h)


def _bound(clock: Any) -> float:
    """Return the energy that the scene must not exceed [J]."""
    return -np.inf if clock.bound is None else clock.bound
