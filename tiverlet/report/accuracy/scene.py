"""Error against run time of the user's own scene: its reference, the cheapest settings, and the share of f32 in the error."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from rich.progress import Progress

from ... import checks
from ...constraints import ShapeMatch
from ...constraints.core.scalar import Scalar
from ...features.feature import Batch
from ...solvers import Direct, Jacobi
from ...world import World
from ..output import Report, Table, plain
from .cases.case import rms

EFFORTS = (2, 5, 10, 20, 40, 80, 160)
RUNS = 3
ITSELF = 0.1  # largest error of a usable reference, as a share of the motion
MARGIN = 3.0  # errors below this multiple of the error of the reference are shown as a bound


@dataclass(frozen=True)
class Setting:
    """One way to run the scene, with its cost and error.

    error: root mean square distance from the reference at the end [m]. rounding: distance between f32 and f64 with the same
    settings [m], 0 in f64. share: of the error that is due to f32. seconds: per simulated second, median. best: whether no
    setting is both faster and more accurate. residual, flags: as in StepReport, the worst of all frames. energy_change: the sum
    of all frames [J].
    """

    solver: str
    substeps: int
    iterations: int
    precision: str
    error: float
    rounding: float
    share: float
    seconds: float
    best: bool
    residual: float
    energy_change: float
    flags: tuple[str, ...]
    order: int = 2

    @property
    def paste(self) -> str:
        """The arguments of a World with these settings, as code."""
        words = [f"substeps={self.substeps}"]
        words += [f"iterations={self.iterations}"] if self.iterations != 1 else []
        words += [f"solver=tv.{self.solver}"]
        words += [f'precision="{self.precision}"'] if self.precision != "f32" else []
        words += [f"order={self.order}"] if self.order != 2 else []
        return ", ".join(words)


class SceneReport(Report):
    """Settings of a scene, with error and cost. print() shows them; see .recommended, .paste, .json(), .markdown().

    settings: all that were tried. reference: the settings of the reference. reference_error: its own error [m], estimated from
    its convergence; infinite if it does not converge. tolerance: the requested error [m]. order: the order of convergence.
    motion: root mean square displacement of the reference [m].
    """

    width = 150

    def __init__(
        self, settings: list[Setting], reference: str, reference_error: float, order: float, tolerance: float, motion: float
    ):
        self.settings, self.reference, self.order = settings, reference, order
        self.reference_error, self.tolerance, self.motion = reference_error, tolerance, motion

    @property
    def converges(self) -> bool:
        """Whether the reference is usable: its error is less than a tenth of the motion."""
        return bool(self.reference_error < ITSELF * self.motion)

    @property
    def recommended(self) -> Setting | None:
        """The cheapest setting whose error plus that of the reference is within the tolerance; None if there is none."""
        if not self.converges:
            return None
        good = [s for s in self.settings if s.error + self.reference_error <= self.tolerance and "non-finite" not in s.flags]
        return min(good, key=lambda s: s.seconds, default=None)

    @property
    def paste(self) -> str:
        """The recommendation as code, or a comment that says why there is none."""
        if self.recommended:
            return f"world = tv.World(particles, features, {self.recommended.paste})"
        if not self.converges:
            return (
                f"# No setting can be recommended: the reference itself is uncertain by {self.reference_error:.2g} m of a motion "
                f"of {self.motion:.2g} m, as of chaos or of impacts. Ask for fewer seconds."
            )
        reach = min((s.error for s in self.settings), default=np.inf) + self.reference_error
        return f"# No setting tried is within {self.tolerance:.2g} m; the best reaches {reach:.2g} m. Try more substeps."

    def tables(self) -> Iterator[Table]:
        """Yield the table of all settings."""
        styles = ["bold" if s is self.recommended else "" if s.best else "dim" for s in self.settings]
        order = f"Observed order: {self.order:.2f}. Tolerance: {self.tolerance:.2g} m. In bold the cheapest setting within it."
        title = f"Error against run time; reference: {self.reference}, itself within {self.reference_error:.1e} m"
        yield Table(title, HEADS, [self.cells(s) for s in self.settings], [order, self.paste], (), styles)

    def cells(self, s: Setting) -> tuple[str, ...]:
        """Return the table row of a setting; an error near that of the reference is shown as a bound."""
        near = s.error < MARGIN * self.reference_error
        error = f"< {MARGIN * self.reference_error:.1e}" if near else f"{s.error:.1e}"
        error = error if self.converges else f"({s.error:.1e})"
        return (
            s.solver, f"{s.substeps} x {s.iterations}", s.precision, error if np.isfinite(s.error) else "diverged",
            f"{100 * s.share:.0f} %" if s.precision != "f64" else "", f"{1e3 * s.seconds:.2f}", f"{s.residual:.1e}",
            f"{s.energy_change:+.1e}", "*" if s.best else "", " ".join(s.flags),
        )  # fmt: skip

    def json(self) -> str:
        """Return the report as JSON."""
        names = ("reference", "reference_error", "order", "tolerance", "motion", "converges", "paste")
        about = plain({k: getattr(self, k) for k in names})
        return json.dumps({**about, "settings": [plain(asdict(s)) for s in self.settings]}, indent=1, allow_nan=False)


HEADS = ("solver", "substeps", "precision", "error [m]", "f32's share", "ms per s", "residual", "energy [J]", "Pareto", "flags")


def scene_report(
    world: World, seconds: float, tolerance: float | None = None, *, dt: float = 1 / 60, substeps: Sequence[int] = EFFORTS,
    progress: bool = False,
) -> SceneReport:  # fmt: skip
    """Return the report of World.report(), which describes the arguments."""
    seconds = checks.number("World.report", "seconds", seconds, above=0.0)
    dt = checks.number("World.report", "dt", dt, above=0.0)
    if tolerance is not None:
        tolerance = checks.number("World.report", "tolerance", tolerance, above=0.0)
    efforts = sorted({checks.integer("World.report", "substeps", n, least=1) for n in substeps})
    if len(efforts) < 2:
        raise ValueError(f"World.report: substeps has {len(efforts)} different value(s), but convergence shows from 2 on.")
    if not len(world.particles):
        raise ValueError("World.report: there are no particles.")
    frames = max(1, round(seconds / dt))
    runner = Runner(world, frames, dt)
    # The reference has twice the substeps of the finest setting, so that it is finer than all of them.
    finer = [*efforts, 2 * efforts[-1]]
    rows: dict[tuple[str, str], list[Result]] = {}
    solvers, precisions = solvers_of(world), ("f64", "f32") if world.order == 2 else ("f64",)
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("report", total=len(solvers) * (1 + len(precisions) * len(efforts)))
        for solver in solvers:
            for precision in precisions:
                some = finer if precision == "f64" else efforts
                rows[repr(solver), precision] = runner.run(solver, precision, some, lambda: bar.advance(shown))
    best, truth, error, order = reference(rows)
    motion = rms(truth, runner.start[0]) if np.isfinite(truth).all() else np.inf
    settings = []
    for (solver, precision), results in rows.items():
        exact = {r.substeps: r.position for r in rows[solver, "f64"]}
        for r in (r for r in results if r.substeps <= efforts[-1]):
            wrong = distance(r.position, truth)
            rounding = distance(r.position, exact[r.substeps]) if precision != "f64" else 0.0
            share = min(1.0, rounding / wrong) if wrong > 0 and np.isfinite(wrong) and np.isfinite(rounding) else 0.0
            settings.append(Setting(
                solver, r.substeps, world.iterations, precision, wrong, rounding, share, r.seconds / seconds, False, r.residual,
                r.energy, r.flags, world.order,
            ))  # fmt: skip
    settings.sort(key=lambda s: s.seconds)
    beaten = [any(o.seconds <= s.seconds and o.error < s.error for o in settings) for s in settings]
    settings = [replace(s, best=not some) for s, some in zip(settings, beaten, strict=True)]
    name = f"{best}, {finer[-1]} substeps, f64"
    return SceneReport(settings, name, error, order, 1e-3 * motion if tolerance is None else tolerance, motion)


@dataclass
class Result:
    """The result of one run."""

    substeps: int
    position: np.ndarray
    seconds: float
    residual: float
    energy: float
    flags: tuple[str, ...]


class Runner:
    """Runs clones of a world from its current state."""

    def __init__(self, world: World, frames: int, dt: float):
        self.world, self.frames, self.dt = world, frames, dt
        self.start = world.position.copy(), world.velocity.copy()
        # If constraints break or shapes creep, positions and velocities do not restore the start: every run needs its own clone.
        self.fresh = any(isinstance(f, Batch) and f.breaks or isinstance(f, ShapeMatch) and f.creep.any() for f in world.features)

    def run(self, solver, precision: str, efforts: Sequence[int], done) -> list[Result]:
        """Run all substeps `efforts` with one solver in one precision. done: called after each."""
        clone, out = self.world.clone(solver=solver, precision=precision, substeps=1), []
        try:
            self.run_once(clone, 1)  # compiles
            for n in efforts:
                times, report = [], None
                for _ in range(RUNS):
                    if self.fresh:
                        clone.close()
                        clone = self.world.clone(solver=solver, precision=precision, substeps=n)
                    report, energy, t = self.run_once(clone, n)
                    times.append(t)
                assert report
                flags = tuple(sorted(report.flags))
                out.append(Result(n, clone.position, float(np.median(times)), report.residual, energy, flags))
                done()
        finally:
            clone.close()
        return out

    def run_once(self, clone: World, substeps: int) -> tuple[Any, float, float]:
        """Run once: return the worst report, the change of energy [J], and the seconds by the median frame."""
        if not self.fresh:
            clone.position, clone.velocity = self.start
        clone.substeps = substeps
        worst, change, times = None, 0.0, []
        for _ in range(self.frames):
            report = clone.step(self.dt)
            times.append(report.seconds)
            change += report.energy_change
            worst = report if worst is None else worst.worse(report)
        return worst, change, float(np.median(times)) * self.frames


def solvers_of(world: World) -> list[Any]:
    """Return the solvers to try: the scene's own and, in order 2 with links that can be solved together, Direct or Jacobi."""
    own = world._solver
    if world.order > 2:
        return [own]
    scalars = [f for f in world.features if isinstance(f, Scalar) and f.solvable_together and f.count]
    other = Direct() if isinstance(own, Jacobi) else Jacobi()
    return [own, other] if scalars and type(other) is not type(own) else [own]


def distance(position: np.ndarray, reference: np.ndarray) -> float:
    """Return the root mean square distance [m]; infinite if it is not finite."""
    with np.errstate(all="ignore"):
        value = rms(position, reference)
    return value if np.isfinite(value) else np.inf


def reference(rows: dict[tuple[str, str], list[Result]]) -> tuple[str, np.ndarray, float, float]:
    """Return the solver with the least estimated error in f64, its finest positions, their error [m], and its order.

    With an order p, runs at n/2 and n substeps differ by (2^p - 1) times the error at n (Richardson). p is measured on three
    runs and used up to 2. Below 1/2 the run does not converge, and the error counts as infinite.
    """
    best = ("", np.zeros(0), np.inf, np.nan)
    for (solver, precision), results in rows.items():
        if precision != "f64":
            continue
        a, b, c = [*results[-3:]] if len(results) > 2 else [results[0], *results[-2:]]
        wide, close = distance(a.position, b.position), distance(b.position, c.position)
        ratio = c.substeps / b.substeps
        order = np.log(wide / close) / np.log(b.substeps / a.substeps) if close > 0 and wide > 0 and b is not a else 2.0
        if wide <= 1e-12 * max(1.0, float(np.abs(c.position).max())):  # the solution is exact but for rounding
            order = 2.0
        error = close / (ratio ** min(order, 2.0) - 1) if np.isfinite(close) and order > 0.5 else np.inf
        if not best[0] or error < best[2]:
            best = (solver, c.position, error, float(order))
    return best
