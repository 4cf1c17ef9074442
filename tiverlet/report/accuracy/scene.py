"""Error against run time of the user's own scene: its reference, the cheapest settings, and the share of f32 in the error."""

import functools
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from time import perf_counter
from typing import Any

import numpy as np
from rich.progress import Progress

from ... import checks
from ...constraints.core.scalar import Scalar
from ...solvers import Direct, Jacobi
from ...step.checkpoint import keep, put_back
from ...step.step_report import StepReport
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
        title = f"Error against run time; reference: {self.reference}, itself within {self.reference_error:.1e} m"
        table = Table.of(title, COLUMNS | {"error [m]": self.error_of}, self.settings)
        order = f"Observed order: {self.order:.2f}. Tolerance: {self.tolerance:.2g} m. In bold the cheapest setting within it."
        styles = ["bold" if s is self.recommended else "" if s.best else "dim" for s in self.settings]
        yield replace(table, notes=[order, self.paste], styles=styles)

    def error_of(self, s: Setting) -> str:
        """Return the error of a setting as text; near the error of the reference as a bound."""
        if not np.isfinite(s.error):
            return "diverged"
        if not self.converges:
            return f"({s.error:.1e})"
        bound = MARGIN * self.reference_error
        return f"< {bound:.1e}" if s.error < bound else f"{s.error:.1e}"

    def json(self) -> str:
        """Return the report as JSON."""
        names = ("reference", "reference_error", "order", "tolerance", "motion", "converges", "paste")
        about = plain({k: getattr(self, k) for k in names})
        return json.dumps({**about, "settings": [plain(asdict(s)) for s in self.settings]}, indent=1, allow_nan=False)


COLUMNS: dict[str, Callable[[Setting], str]] = {
    "solver": lambda s: s.solver,
    "substeps": lambda s: f"{s.substeps} x {s.iterations}",
    "precision": lambda s: s.precision,
    "error [m]": lambda s: f"{s.error:.1e}",
    "f32's share": lambda s: f"{100 * s.share:.0f} %" if s.precision != "f64" else "",
    "ms per s": lambda s: f"{1e3 * s.seconds:.2f}",
    "residual": lambda s: f"{s.residual:.1e}",
    "energy [J]": lambda s: f"{s.energy_change:+.1e}",
    "Pareto": lambda s: "*" if s.best else "",
    "flags": lambda s: " ".join(s.flags),
}


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
    # The reference has twice the substeps of the finest setting, so that it is finer than all of them.
    finer = [*efforts, 2 * efforts[-1]]
    rows: dict[tuple[str, str], list[Result]] = {}
    solvers, precisions = solvers_of(world), ("f64", "f32") if world.order == 2 else ("f64",)
    with Progress(disable=not progress) as bar:
        shown = bar.add_task("report", total=len(solvers) * (1 + len(precisions) * len(efforts)))
        for solver in solvers:
            for precision in precisions:
                some = finer if precision == "f64" else efforts
                with world.clone(solver=solver, precision=precision) as clone:
                    rows[repr(solver), precision] = run(clone, some, frames, dt, lambda: bar.advance(shown))
    best, truth, error, order = reference(rows)
    motion = distance(truth, world.position)
    settings = []
    for (solver, precision), results in rows.items():
        exact = {r.substeps: r.position for r in rows[solver, "f64"]}
        for r in (r for r in results if r.substeps <= efforts[-1]):
            wrong = distance(r.position, truth)
            rounding = distance(r.position, exact[r.substeps]) if precision != "f64" else 0.0
            share = min(1.0, rounding / wrong) if wrong > 0 and np.isfinite(wrong) and np.isfinite(rounding) else 0.0
            settings.append(Setting(
                solver, r.substeps, world.iterations, precision, wrong, rounding, share, r.seconds / seconds, False,
                r.report.residual, r.report.energy_change, tuple(sorted(r.report.flags)), world.order,
            ))  # fmt: skip
    settings.sort(key=lambda s: s.seconds)
    beaten = [any(o.seconds <= s.seconds and o.error < s.error for o in settings) for s in settings]
    settings = [replace(s, best=not some) for s, some in zip(settings, beaten, strict=True)]
    name = f"{best}, {finer[-1]} substeps, f64"
    return SceneReport(settings, name, error, order, 1e-3 * motion if tolerance is None else tolerance, motion)


@dataclass
class Result:
    """The results of a number of substeps: final positions [m], run time [s], and the worst report of all frames."""

    substeps: int
    position: np.ndarray
    seconds: float
    report: StepReport


def run(clone: World, efforts: Sequence[int], frames: int, dt: float, done: Callable[[], object]) -> list[Result]:
    """Run a clone with each number of substeps from its present state. done: called after each."""
    start, out = keep(clone), []
    clone.step(dt)  # compiles
    for n in efforts:
        times = []
        for _ in range(RUNS):
            put_back(clone, start)
            clone.substeps = n
            clock = perf_counter()
            reports = [clone.step(dt) for _ in range(frames)]
            times.append(perf_counter() - clock)  # of all frames: where a heap lands, some take ten times as long as others
        out.append(Result(n, clone.position, float(np.median(times)), functools.reduce(StepReport.worse, reports)))
        done()
    return out


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
