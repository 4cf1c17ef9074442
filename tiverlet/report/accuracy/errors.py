"""The report of a sweep: fitted orders, comparisons at equal run time, and verdicts, as tables, JSON and plots."""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ...tools import golden_colors
from ..output import Report, Table, canvas, plain
from .baselines import BASELINES
from .cases import CASES, SLACK, Case

if TYPE_CHECKING:
    from .points import Point

RESOLVED = 0.02  # share of the size of the motion below which errors count for the order
FLOOR = 10.0  # multiple of the uncertainty of the answer above which errors count for the order
ORDER = 0.1  # tolerance of a fitted order
COLORS = {"ok": "", "known": "yellow", "FAIL": "red"}


@dataclass(frozen=True)
class Missing:
    """A curve that could not be measured: its case, its name, and why."""

    case: str
    task: str
    why: str


@dataclass(frozen=True)
class Summary:
    """The result of one case: its first measured method in f64, at the substeps of its limit, with comparisons.

    order: measured with the solver shown_by. single: the error in f32. in_time, in_work: the error of XPBD over this one, at the
    same run time and at the same number of constraint visits; over_article: that of the article's scheme at the same run time;
    see ErrorReport.advantage. failures: reasons why the case fails. known: the fault that is known, and how it shows.
    """

    case: Case
    best: "Point"
    order: float | None
    shown_by: str
    single: float | None
    in_time: tuple[float, float] | None
    in_work: tuple[float, float] | None
    over_article: tuple[float, float] | None
    failures: tuple[str, ...]
    known: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """Whether the case fails, in a word."""
        return "FAIL" if self.failures else "known" if self.known else "ok"


class ErrorReport(Report):
    """Points of error against run time. print() shows a table; see .markdown(), .json(), .plot(folder).

    points: all measured points. missing: curves that could not be measured. omissions: what was left out on purpose. failures:
    cases that fail, with reasons; empty for a good report.
    """

    def __init__(self, cases: list[str], points: "list[Point]", missing: list[Missing], omissions: list[str], machine: str):
        self.cases, self.points, self.missing, self.machine = cases, points, missing, machine
        lost = [f"{p.case}, {p.method}, {p.precision}, {p.substeps} substeps: diverged" for p in points if p.diverged]
        self.omissions = omissions + lost

    def curve(self, case: str, method: str, precision: str = "f64") -> "list[Point]":
        """Return the points of one curve, by substeps."""
        found = [p for p in self.points if (p.case, p.method, p.precision) == (case, method, precision)]
        return sorted(found, key=lambda p: p.substeps)

    def curves(self, case: str) -> "list[list[Point]]":
        """Return all curves of a case."""
        keys = dict.fromkeys((p.method, p.precision) for p in self.points if p.case == case)
        return [self.curve(case, *key) for key in keys]

    def order(self, case: str, method: str, precision: str = "f64") -> float | None:
        """Return the order of convergence, see fitted(); None if fewer than three points show one."""
        return fitted(CASES[case], self.curve(case, method, precision))

    def advantage(self, case: str, method: str, against: str = "XPBD", cost: str = "seconds") -> tuple[float, float] | None:
        """Return the error of a baseline over that of `method` at equal cost: the median and the least, or None.

        cost: "seconds" or "visits" (of constraints). Both curves are interpolated over the costs that both cover; None if there
        are none. The time of a frame is a fixed part, mostly Python in small scenes, and a part for each substep; both are fitted
        to the measured times. Visits are the same on every machine.
        """
        ours, theirs = (front(self.curve(case, name), cost) for name in (method, against))
        if not len(ours) or not len(theirs):
            return None
        low, high = max(ours[0, 0], theirs[0, 0]), min(ours[-1, 0], theirs[-1, 0])
        if high < low:
            return None
        at = np.linspace(low, high, 33)
        ratio = np.exp(np.interp(at, *theirs.T) - np.interp(at, *ours.T))
        return float(np.median(ratio)), float(ratio.min())

    def summary(self, name: str) -> Summary | None:
        """Return the result of a case with its first measured method; None if none was measured."""
        case = CASES[name]
        method = next((m for m in case.methods if self.curve(name, m)), None)
        if method is None:
            return None
        points, failures = self.curve(name, method), []
        best = next((p for p in points if p.substeps == case.at), points[-1])
        single = next((p.error for p in self.curve(name, method, "f32") if p.substeps == best.substeps), None)
        shown = {m: o for m in case.methods if case.order and (o := self.order(name, m)) is not None}
        if best.diverged:
            failures.append(f"diverged at {best.substeps} substeps")
        elif best.substeps == case.at and method == case.methods[0]:
            failures += beyond(case, "error", best.error, case.limit[0])
            failures += [] if single is None else beyond(case, "f32: error", single, case.limit[1])
        failures += [f"{m}: order {o:.2f}, not {case.order:g}" for m, o in shown.items() if abs(o - (case.order or 0)) > ORDER]
        if case.order and not shown and any(len(self.curve(name, m)) >= 3 for m in case.methods):
            failures.append("no order shows: the error does not fall with the step")
        by, known = next(iter(shown), ""), ()
        if case.known and failures:
            known, failures = (case.known, *failures), []
        elif case.known:
            failures = [f"this fault no longer shows, strike it in its case: {case.known}"]
        return Summary(
            case, best, shown.get(by), by, single, self.advantage(name, method), self.advantage(name, method, cost="visits"),
            self.advantage(name, method, "article"), tuple(failures), known,
        )  # fmt: skip

    @cached_property
    def summaries(self) -> list[Summary]:
        """The results of all cases."""
        return [s for s in map(self.summary, self.cases) if s is not None]

    @property
    def failures(self) -> dict[str, tuple[str, ...]]:
        """Cases that fail and curves that could not be measured, with the reasons."""
        out = {s.case.name: s.failures for s in self.summaries if s.failures}
        return out | {m.task: (f"missing: {m.why}",) for m in self.missing}

    def tables(self) -> Iterator[Table]:
        """Yield the table of the main columns, in 80 characters."""
        known = {s.case.name: ("known fault", *s.known) for s in self.summaries if s.known}
        notes = [*(f"{case}: {'; '.join(why)}" for case, why in (self.failures | known).items()), LEGEND]
        notes += [f"left out: {line}" for line in self.omissions]
        table = Table.of(f"Error against run time ({self.machine})", SHORT, self.summaries)
        yield replace(table, notes=notes, styles=[COLORS[s.verdict] for s in self.summaries])

    def wide(self) -> Table:
        """Return the table of all columns."""
        return Table.of("Error against run time", WIDE, self.summaries)

    def markdown(self) -> str:
        """Return the table of all columns, one of all points for each case, and what was left out, as Markdown."""
        out = [self.wide()]
        for case in self.cases:
            out.append(Table.of(f"{case}: {CASES[case].title}", OF_POINTS, [p for some in self.curves(case) for p in some]))
        out[-1].notes = [*(f"missing: {m.task}: {m.why}" for m in self.missing), *(f"left out: {o}" for o in self.omissions)]
        return "\n".join(table.markdown() for table in out)

    def json(self) -> str:
        """Return the report as JSON."""
        cases = {n: {k: getattr(CASES[n], k) for k in ("title", "unit", "seconds", "limit", "trusted")} for n in self.cases}
        orders = {f"{c}, {m}": o for c in self.cases for m in CASES[c].methods if (o := self.order(c, m))}
        report = {
            "machine": self.machine, "cases": cases, "points": [plain(asdict(p)) for p in self.points], "orders": orders,
            "failures": self.failures, "missing": [asdict(m) for m in self.missing], "omissions": self.omissions,
        }  # fmt: skip
        return json.dumps(report, indent=1, allow_nan=False)

    def plot(self, folder) -> list[str]:
        """Plot each case log-log, as PNG in `folder`; return the paths. Needs matplotlib (the extra "plots").

        Diverged points are crosses at the top edge, baselines are dashed.
        """
        Figure = canvas(folder)
        out = []
        for name in self.cases:
            figure = Figure(figsize=(7, 5), layout="constrained")
            axes, curves = figure.subplots(), self.curves(name)
            top = max([p.error for c in curves for p in c if not p.diverged and p.error > 0] or [CASES[name].size])
            for curve, color in zip(curves, golden_colors(max(1, len(curves))) / 255, strict=False):
                good, lost = [p for p in curve if not p.diverged and p.error > 0], [p for p in curve if p.diverged]
                label, line = f"{curve[0].method}, {curve[0].precision}", "--" if curve[0].method in BASELINES else "-"
                axes.loglog([p.seconds for p in good], [p.error for p in good], line, marker="o", ms=4, color=color, label=label)
                axes.loglog([p.seconds for p in lost], [2 * top] * len(lost), "x", color=color)
            axes.set(xlabel="run time [s per simulated s]", ylabel=f"error [{CASES[name].unit}]", title=CASES[name].title)
            axes.grid(True, which="both", alpha=0.2)
            axes.legend(fontsize=8)
            out.append(os.path.join(folder, name.replace(":", "_").replace("/", "_") + ".png"))
            figure.savefig(out[-1], dpi=110)
        return out


LEGEND = (
    "error with n substeps of a frame; its order in the substep; run time per simulated second; the error of XPBD at the same "
    "run time over ours. All columns, and all points: --markdown FILE"
)


def verdict(case: str, points: "list[Point]", missing: list[Missing]) -> str:
    """Return the verdict on one case in a line: its name, "ok" or why it fails, its error and its order."""
    report = ErrorReport([case], [p for p in points if p.case == case], missing, [], "")
    figures = [
        "; ".join([f"{SHORT['error'](s).strip()} at {s.best.substeps} substeps, order {ordered(s) or 'none'}", *s.known])
        for s in report.summaries
    ]
    word = "FAIL" if report.failures else report.summaries[0].verdict
    return "; ".join([f"{case:36} {word:5} {' '.join(figures)}", *chain(*report.failures.values())])


def beyond(case: Case, what: str, error: float, limit: float) -> list[str]:
    """Return why an error at the substeps of its limit fails: it is above its limit, or so far below that the limit sees nothing
    get worse."""
    if error > limit or np.isnan(error):
        return [f"{what} {error:.2g} {case.unit} at {case.at} substeps, limit {limit:.2g}"]
    loose = limit > max(SLACK * error, case.trusted)
    return [f"{what} {error:.2g} {case.unit} is more than {SLACK:g} times below its limit of {limit:.2g}: tighten it"] * loose


def fitted(case: Case, points: "list[Point]") -> float | None:
    """Return the order by least squares over the points whose error is neither a large part of the motion nor near the
    uncertainty of the answer; None for fewer than three.

    Points with a flag do not count: there constraints gave way or were not met, so the error is not that of the step.
    """
    some = [
        p for p in points
        if FLOOR * case.trusted < p.error < RESOLVED * case.size and not p.flags and (not case.fit or p.substeps in case.fit)
    ]  # fmt: skip
    if len(some) < 3:
        return None
    return -float(np.polyfit(np.log([p.substeps for p in some]), np.log([p.error for p in some]), 1)[0])


def front(points: "list[Point]", cost: str) -> np.ndarray:
    """Return the logarithms of costs and of the best error within each cost, (k, 2). cost: an attribute of points."""
    good = [p for p in points if np.isfinite(p.error) and p.error > 0 and getattr(p, cost) > 0]
    if len(good) < 3:
        return np.zeros((0, 2))
    n, t = np.array([p.substeps for p in good], dtype=float), np.array([getattr(p, cost) for p in good])
    if cost == "seconds":
        slope, fixed = np.polyfit(n, t, 1, w=1 / t)
        t = np.maximum(fixed, 0.1 * t.min()) + max(slope, 1e-12) * n
    return np.log(np.stack([t, np.minimum.accumulate([p.error for p in good])], axis=1))


def ordered(s: Summary) -> str:
    """Return the order as text, with the solver that shows it if that is not the first one."""
    if s.order is None:
        return ""
    return f"{s.order:.2f}" if s.shown_by == s.best.method else f"{s.order:.2f} ({s.shown_by})"


def times(ratios: tuple[float, ...] | None) -> str:
    """Return ratios (median and least, or the median alone) as text with two digits."""
    if ratios is None:
        return ""
    return " / ".join(f"{r:.0f}" if 10 <= r < 1e4 else f"{r:.2g}" for r in ratios)


def drift(value: float) -> str:
    """Return a drift as text; empty if nothing is conserved."""
    return "" if not np.isfinite(value) else f"{value:.0e}"


SHORT: dict[str, Callable[[Summary], str]] = {  # on a screen of 80 characters
    "case": lambda s: s.case.name,
    "n": lambda s: str(s.best.substeps),
    "error": lambda s: f"{s.best.error:.1e} {'rel.' if s.case.unit == 'relative' else s.case.unit[:4]:4}",
    "order": lambda s: ordered(s)[:4],
    "ms/s": lambda s: f"{1e3 * s.best.seconds:.1f}",
    "XPBD": lambda s: times(s.in_time and s.in_time[:1]),
    "": lambda s: s.verdict,
}
WIDE: dict[str, Callable[[Summary], str]] = {
    "case": lambda s: s.case.name,
    "solver": lambda s: s.best.method,
    "substeps": lambda s: str(s.best.substeps),
    "error": lambda s: f"{s.best.error:.1e} {s.case.unit}",
    "order": ordered,
    "ms per s": lambda s: f"{1e3 * s.best.seconds:.1f}",
    "XPBD / ours": lambda s: times(s.in_time),
    "at equal work": lambda s: times(s.in_work),
    "article / ours": lambda s: times(s.over_article),
    "f32 error": lambda s: "" if s.single is None else f"{s.single:.1e}",
    "energy drift": lambda s: drift(s.best.energy),
    "momentum drift": lambda s: drift(s.best.momentum),
    "verdict": lambda s: "; ".join([s.verdict, *s.failures, *s.known]),
}
OF_POINTS: "dict[str, Callable[[Point], str]]" = {
    "solver": lambda p: p.method,
    "precision": lambda p: p.precision,
    "substeps": lambda p: f"{p.substeps} x {p.iterations}",
    "error": lambda p: "diverged" if p.diverged else f"{p.error:.2e}",
    "s per s": lambda p: f"{p.seconds:.2e}",
    "visits per s": lambda p: f"{p.visits:.1e}",
    "residual": lambda p: f"{p.residual:.1e}",
    "energy drift": lambda p: drift(p.energy),
    "compile [s]": lambda p: f"{p.compile:.1f}",
    "flags": lambda p: " ".join(p.flags),
}
