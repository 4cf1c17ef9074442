"""Measure one curve: a case, with one method in one precision, over numbers of substeps."""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from ...features.feature import Batch
from ...measure import kinetic_energy
from ...solvers import ConjugateGradient, Direct
from ...world import World
from .baselines import BASELINES, Baseline
from .cases import CASES, METHODS, Case, Run

PATIENCE = 1.0  # [s] after which no further timed run of a point begins
TIMED = 60  # most frames of a timed run
ELIMINATION = 2.5  # constraint visits that an elimination counts as, per link (1.0 measured)


@dataclass(frozen=True)
class Task:
    """One curve to measure. Plain names and numbers, so that it can be sent to another process."""

    case: str
    method: str
    precision: str = "f64"
    efforts: tuple[int, ...] = ()
    runs: int = 5

    def __str__(self) -> str:
        return f"{self.case}, {self.method}, {self.precision}"


@dataclass(frozen=True)
class Point:
    """One run: its settings, error and cost.

    error: in the unit of the case. seconds: per simulated second, the median of `runs` runs of the first frames, without
    compiling, after the run whose error is measured. compile: time until the end of the first frame [s]. visits: constraints
    evaluated per simulated second; an elimination counts 2.5. residual: the worst relative violation at the ends of frames.
    energy, momentum: the largest drift during the run, as a share of the largest kinetic energy and of the largest momentum; NaN
    if it is not conserved. diverged: whether the error is not finite or exceeds the size of the motion.
    """

    case: str
    method: str
    precision: str
    substeps: int
    iterations: int
    error: float
    seconds: float
    runs: int
    compile: float
    visits: float
    residual: float
    energy: float
    momentum: float
    flags: tuple[str, ...]
    diverged: bool


def curve(task: Task) -> list[Point]:
    """Measure a curve. Task and points are plain data, so that any executor can run this function."""
    case = CASES[task.case]
    particles, features = case.build()
    clock = perf_counter()
    if task.method in BASELINES:
        world: Any = BASELINES[task.method](particles, features)
        iterations, charge = 1, 1.0
    else:
        solver, iterations = METHODS[task.method]
        world = World(particles, features, solver=solver, iterations=iterations, precision=task.precision)
        charge = charge_of(solver)
    with world:
        count = sum(f.count for f in features if isinstance(f, Batch))
        world.substeps = 1
        world.step(case.frame)
        kinetic_energy(world)
        compiled, out = perf_counter() - clock, []
        for substeps in task.efforts or case.efforts:
            world.substeps = substeps
            run, energy, momentum = observe(case, world)
            with np.errstate(all="ignore"):
                error = float(case.error(run)) if np.isfinite(world.position).all() else np.inf
            times = timed(lambda: repeat(case, world), task.runs)
            flags: set[str] = set().union(*(r.flags for r in run.reports))
            visits = substeps * iterations * charge * count / case.frame
            point = Point(
                case.name, task.method, task.precision, substeps, iterations, error,
                float(np.median(times)), len(times), compiled, visits,
                max(r.residual for r in run.reports) if run.reports else world.residual, energy, momentum,
                tuple(sorted(flags)), not error <= case.size,
            )  # fmt: skip
            out.append(point)
        return out


def charge_of(solver) -> float:
    """Return the constraint visits that one iteration of a solver counts as, per constraint."""
    if isinstance(solver, Direct):
        return ELIMINATION
    return float(solver.steps) if isinstance(solver, ConjugateGradient) else 1.0


def restart(world) -> None:
    """Restore the start of a World or a baseline."""
    if isinstance(world, Baseline):
        world.restart()
    else:
        world.position, world.velocity = world.particles.position, world.particles.velocity


def observe(case: Case, world) -> tuple[Run, float, float]:
    """Run a case, recording every frame. Returns the run, the drift of energy and the drift of momentum."""
    restart(world)
    run, energies, kinetic, momenta = Run(world), [], [1e-300], []
    for k in range(case.frames):
        report = world.step(case.frame)
        run.times.append((k + 1) * case.frame)
        if report is None:  # a baseline
            energies.append(world.energy)
        else:
            run.reports.append(report)
            energies += [report.energy - report.energy_change, report.energy] if k == 0 else [report.energy]
        kinetic.append(kinetic_energy(world))
        if case.watch:
            run.seen.append(case.watch(world))
        if case.momentum:
            momenta.append(case.momentum(world))
    energy = momentum = np.nan
    with np.errstate(all="ignore"):
        if case.conserves:
            energy = float(np.abs(np.array(energies) - energies[0]).max() / max(kinetic))
        if momenta:
            p, size = np.array([m for m, _ in momenta]), max(s for _, s in momenta)
            momentum = float(np.abs(p - p[0]).max() / max(size, 1e-300))
    return run, energy, momentum


def repeat(case: Case, world) -> float:
    """Run the first frames of a case again, without measurements, and return the seconds per simulated second."""
    frames = min(case.frames, TIMED)
    restart(world)
    clock = perf_counter()
    for _ in range(frames):
        world.step(case.frame)
    return (perf_counter() - clock) / (frames * case.frame)


def timed(again: Callable[[], float], runs: int) -> list[float]:
    """Return the times of several runs; fewer if they take long, but at least one."""
    out = [again()]
    clock = perf_counter()
    while len(out) < runs and perf_counter() - clock < PATIENCE:
        out.append(again())
    return out
