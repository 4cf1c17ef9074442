"""Substeps of order 4, 6 and 8: symmetric compositions of the substep of order 2, which is reversible in time.

A substep of length H consists of stages of length g_k H, some of them backwards. With g_k = g_(s+1-k), sum g_k = 1, sum g_k^3 = 0
and, from order 6 on, further conditions, the errors of the stages cancel (Suzuki 1990; Kahan and Li 1997; Suzuki and Umeno 1993;
all in Hairer, Lubich and Wanner, Geometric Numerical Integration, V.3.2). A stage of h' after a stage of h is time-corrected
Verlet,

    d' = (h'/h) d + h' (h + h') / 2 a(x),   x' = x + d'

Rigid constraints are satisfied at the end of a stage, along their directions at its begin. As a map of positions, a stage is
RATTLE, which is symmetric and symplectic, so the composition is both. A spring counts as a force, -C grad C / alpha, in a.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders.collider import Collider
from ..constraints.core.scalar import Scalar
from ..contact.pair_contact import PairContact
from ..device import ti
from ..device.memory import Memory
from ..features.feature import Acceleration, Batch, Feature, Scene
from ..solvers.solver import Solver
from .clock import Clock
from .integrator import Forces
from .span import Moment, Span
from .step import substep

if TYPE_CHECKING:
    from .step import Step

# The first half of the stages, by order. The stage in the middle makes their sum 1.
_HALVES = {
    2: (),
    4: (1 / (4 - 4 ** (1 / 3)),) * 2,
    6: (0.39216144400731413928, 0.33259913678935943860, -0.70624617255763935981, 0.082213596293550800230),
    8: (
        0.74167036435061295345, -0.40910082580003159400, 0.19075471029623837995, -0.57386247111608226666,
        0.29906418130365592384, 0.33462491824529818378, 0.31529309239676659663,
    ),
}  # fmt: skip
ORDERS = tuple(_HALVES)
PASSES = {2: 1, 4: 2, 6: 3, 8: 3}  # Newton's method begins with an error of h^2 in x, and each pass squares the error
PROBE = 64  # velocities are read from two stages, forwards and backwards, of a 64th of the last one


def stages(order: int) -> np.ndarray:
    """Return the lengths of the stages of a substep of length 1."""
    half = np.array(_HALVES[order])
    return np.concatenate([half, [1 - 2 * half.sum()], half[::-1]])


def refuse(order: int, features: tuple[Feature, ...], precision: str, path: str) -> None:
    """Raise ValueError, with the reason, if the scene does not allow a substep of this order."""
    who = f"World: order = {order}"
    if precision != "f64":
        raise ValueError(
            f'{who} with precision = "{precision}", whose rounding is larger than what it gains. Use precision="f64".'
        )
    if path == "parallel":
        raise ValueError(f'{who} runs in one launch and one thread only. Use path="auto".')
    for f in features:
        why = ""
        if isinstance(f, (PairContact, Collider)):
            why = "is one-sided: where it starts to act, motion has no derivatives of that order"
        elif isinstance(f, Acceleration) and (f.decays or f.uses_velocity):
            why = "depends on velocities, so that the substep is not reversible"
        elif isinstance(f, Scalar):
            if f.side:
                why = "is one-sided: where it starts to act, motion has no derivatives of that order"
            elif (f.damping > 0).any():
                why = "has damping, so that the substep is not reversible"
            elif f.driven:
                why = "moves on its own, up to a largest load: there motion has no derivatives of that order"
            elif f.breaks:
                why = "can break, where motion has no derivatives of that order"
            elif not f.arity:
                why = "has any number of corners, which this order is not made for"
        elif isinstance(f, Batch) and not f.is_kinematic:
            why = "is not one number, so that it cannot be solved exactly"
        if why:
            raise ValueError(f"{who}, but {f!r} {why}. Use order=2.")


def check_solved(batches: list[Batch], scene: Scene, solver: Solver) -> None:
    """Raise ValueError if the solver would relax a rigid constraint instead of solving it."""
    for b in batches:
        assert isinstance(b, Scalar)
        left = ~b.acts_as_force(scene) & (scene.slots.rows(b) < 0) & ~b.immovable(scene.inv_mass)
        if left.any():
            raise ValueError(
                f"World: order = {scene.order} needs rigid constraints to be solved to the end, but {solver!r} relaxes {b!r} ("
                f"{int(left.sum())} of them, the first is number {int(np.argmax(left))}). Use solver=tv.Direct(width=...), "
                "a compliance, or order=2."
            )


class Composition:
    """The integrator of a world of order 4 or more: Verlet in stages, with springs as forces. Runs fused only."""

    uses_velocity = decays = half_kick = False
    host_only = ("fastest",)

    def __init__(self, scene: Scene, forces: Forces, batches: list[Batch]):
        self.forces, self.state, self.slots = forces, scene.state, scene.slots
        self.real, self.dim = scene.real, scene.particles.dim
        g = stages(scene.order)
        self.stages, self.first, self.longest = len(g), float(g[0]), int(np.argmax(np.abs(g)))
        self.h2_factor = float(1 + g[-2] / g[-1]) / 2
        self.springs_pull = any(b.soft for b in batches)
        self.solved = PASSES[scene.order] if scene.slots and scene.slots.system else 0
        begin = np.concatenate([[0], np.cumsum(g)[:-1]])
        table = np.stack([g, np.roll(g, 1), begin, begin + g], axis=1)
        self.table = scene.memory.field("composition.stages", self.stages, width=4, kind=ti.f64, values=table)
        self.fastest = (float(np.abs(g).max()) / self.first) ** 2 * fastest(batches, scene)

    def passes(self, iterations: int) -> int:
        """Return the number of passes over the constraints in each stage."""
        return max(iterations, self.solved) if self.solved else 0

    @ti.func
    def times(self, span, s):
        """Return length, last length, time and fractions of the frame for stage s, as Verlet.times() does for substeps.

        The length in `span` is that of the first stage, which is as long as the last.
        """
        whole, g = span.h64 / self.first, self.table[s % self.stages]
        substep, substeps = s // self.stages, span.substeps // self.stages
        fraction = ti.Vector([(substep + g[2]) / substeps, (substep + g[3]) / substeps, (g[3] - g[2]) / substeps])
        return g[0] * whole, g[1] * whole, span.start + (substep + g[2]) * whole, fraction

    @ti.func
    def frame_fraction(self, s, substeps):
        """Return the fractions of the frame at the begin and the end of substep s, and its share of the frame."""
        begin, end = ti.cast(s, self.real) / substeps, ti.cast(s + 1, self.real) / substeps
        return ti.Vector([begin, end, end - begin])

    @ti.func
    def h2_effective(self, h, fresh):
        """Return what a constant acceleration adds to the displacement in a substep, per m/s^2 [s^2]."""
        return h * h / 2 if fresh != 0 else h * h

    @ti.func
    def advance(self, first, end, now):
        """Integrate particles from `first` up to `end`."""
        for i in range(first, end):
            self.integrate(i, now.h, now.last, now.time, now.fresh)

    @ti.func
    def integrate(self, i, h, last, t, starts):
        """Integrate particle i by Verlet with the force at x, in a stage of h after one of `last` [s].

        starts: 1 in a start, the first stage after velocities were set; there d holds the velocity.
        """
        if self.state.w[i] > 0:
            d = self.state.d[i]
            a = self.forces.accelerate(i, self.state.place(i), 0 * d, t, self.forces.pull(t))
            if ti.static(self.forces.has_unresolved):
                if starts == 0:
                    self.forces.note_unresolved(i, self.state.place(i), d, h, t, a - self.forces.pull(t))
            if ti.static(self.springs_pull):
                a += self.slots.total_of(i) / (h * h)
            if starts != 0:
                d = h * d + h * h / 2 * a
            else:
                d = h / last * d + h * (h + last) / 2 * a
            self.state.d[i] = d
            self.state.advance(i, d)
        elif starts != 0:
            self.state.d[i] = 0 * self.state.d[i]

    @ti.func
    def velocity_after(self, i, h, t, reaction):
        """Return the velocity where d holds it. See velocity() for all other times."""
        return self.state.d[i]


@ti.data_oriented
class Probe:
    """The kernel that computes the displacements of one more stage."""

    def __init__(self, step: "Step"):
        self.step = step

    @ti.kernel
    def stage(self, h: ti.f64, last: ti.f64, t: ti.f64, end: ti.f64, passes: ti.i32):
        """Take a stage of h after one of `last` [s]. t: time [s]. end: fraction of the frame at its end."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            span = Span(h, t, t, tick=0, fresh=0, owed=0.0, state_origin=0, substeps=1, iterations=passes, part=passes)
            substep(self.step, Moment(span, 0, h, last, t, 0, ti.Vector([1.0, end, end - 1.0]), final=1))


def fastest(batches: list[Any], scene: Scene) -> float:
    """Return a bound on omega^2 of the springs [1/s^2]: the largest, if each particle divides its mass among its springs."""
    members = [b.indices[b.compliance > 0].ravel() for b in batches]
    degree = np.bincount(np.concatenate([np.zeros(0, dtype=np.int64), *members]), minlength=len(scene.inv_mass))
    worst = 0.0
    for b in batches:
        soft = b.compliance > 0
        w = (degree * scene.inv_mass)[b.indices][:, :, None]
        squares = (w * b.gradients(b.start.position) ** 2).sum(axis=(1, 2))
        worst = max(worst, float((squares[soft] / b.compliance[soft]).max(initial=0.0)))
    return worst


def velocity(probe: Probe, clock: Clock, memory: Memory, iterations: int) -> np.ndarray:
    """Return velocities to the order of the world, (n, dim) [m/s]: the mean over a short stage forwards and one backwards.

    The accelerations within the two stages cancel, and constraints remove the components along them.
    """
    kept, out, h, step = memory.state(), 0.0, clock.h, probe.step
    for e in (h / PROBE, -h / PROBE):
        probe.stage(e, h, clock.time, 1 + e / clock.frame[1], step.integrator.passes(iterations))
        out = out + memory.read(step.state.d) / e
        memory.restore(kept)
    return np.asarray(out / 2)
