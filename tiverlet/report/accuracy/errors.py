"""The report of a sweep: fitted orders, comparisons at equal run time, and verdicts, as tables, JSON, plots and a recording."""

import json
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.jupyter import JupyterMixin
from rich.table import Table

from .. import output
from .cases import CASES, Case

if TYPE_CHECKING:
    from .points import Point

RESOLVED = 0.02  # share of the size of the motion below which errors count for the order
FLOOR = 10.0  # multiple of the uncertainty of the answer above which errors count for the order
ORDER = 0.1  # tolerance of a fitted order


@dataclass(frozen=True)
class Missing:
    """A curve that could not be measured, and why."""

    task: str
    why: str


@dataclass(frozen=True)
class Summary:
    """The result of one case: its first method in f64, at the substeps of its limit, with comparisons.

    in_time, in_work: the error of XPBD over this one, at the same run time and at the same number of constraint visits.
    over_article: the error of the article's scheme over this one at the same run time; see ErrorReport.advantage. order: measured
    with the solver shown_by. single: the error in f32. failures: reasons why the case fails.
    """

    case: str
    method: str
    substeps: int
    error: float
    unit: str
    order: float | None
    shown_by: str
    seconds: float
    energy: float
    momentum: float
    single: float | None
    in_time: tuple[float, float] | None
    in_work: tuple[float, float] | None
    over_article: tuple[float, float] | None
    failures: tuple[str, ...]


class ErrorReport(JupyterMixin):
    """Points of error against run time. print() shows a table; see .markdown(), .json(), .plot(path), .record(path).

    every_column: whether print() shows all columns (200 characters), not only those that fit into 80. points: all measured
    points. missing: curves that could not be measured. omissions: what was left out on purpose. failures: cases that fail, with
    reasons; empty for a good report.
    """

    every_column = False

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
        points = self.curve(name, method)
        best = next((p for p in points if p.substeps == case.at), points[-1])
        single = next((p.error for p in self.curve(name, method, "f32") if p.substeps == best.substeps), None)
        shown = [(o, m) for m in case.methods if (o := self.order(name, m)) is not None] if case.order else []
        slope, by = (shown or [(None, "")])[0]
        return Summary(
            name, method, best.substeps, best.error, case.unit, slope, by, best.seconds, best.energy, best.momentum, single,
            self.advantage(name, method), self.advantage(name, method, cost="visits"), self.advantage(name, method, "article"),
            tuple(self.faults(case, method, best)),
        )  # fmt: skip

    def faults(self, case: Case, method: str, best: "Point") -> list[str]:
        """Return the reasons why a case fails; empty if it passes."""
        out = []
        if best.diverged:
            out.append(f"diverged at {best.substeps} substeps")
        elif best.substeps == case.at and method == case.methods[0] and best.error > case.limit:
            out.append(f"error {best.error:.2g} {case.unit} at {case.at} substeps, limit {case.limit:.2g}")
        if case.order:
            slopes = {m: self.order(case.name, m) for m in case.methods if len(self.curve(case.name, m)) >= 3}
            shown = {m: o for m, o in slopes.items() if o is not None}
            out += [f"{m}: order {o:.2f}, not {case.order:g}" for m, o in shown.items() if abs(o - case.order) > ORDER]
            if slopes and not shown:
                out.append("no order shows: the error does not fall with the step")
        single = [p for p in self.curve(case.name, method, "f32") if p.substeps == best.substeps]
        if single and single[0].error > max(10 * best.error, case.single):
            out.append(f"f32: error {single[0].error:.2g} {case.unit} at {best.substeps} substeps, floor {case.single:.2g}")
        return out

    @cached_property
    def summaries(self) -> list[Summary]:
        """The results of all cases."""
        return [s for s in map(self.summary, self.cases) if s is not None]

    @property
    def failures(self) -> dict[str, tuple[str, ...]]:
        """Cases that fail and curves that could not be measured, with the reasons."""
        out = {s.case: s.failures for s in self.summaries if s.failures}
        return out | {m.task: (f"missing: {m.why}",) for m in self.missing}

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield f"[bold]Error against run time[/] ({self.machine})"
        yield self._wide() if self.every_column else self._narrow()
        for case, why in self.failures.items():
            yield f"[red]{case}: {'; '.join(why)}[/]"
        if not self.every_column and self.summaries:
            yield (
                "[dim]error with n substeps of a frame; its order in the substep; run time per simulated second; the error of "
                "XPBD at the same run time over ours. All columns: --wide, .markdown()[/]"
            )
        for line in self.omissions:
            yield f"left out: {line}"

    def _narrow(self) -> Table:
        """Return the table of the main columns, in 80 characters."""
        table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="bold")
        for k, head in enumerate(SHORT):
            table.add_column(head, justify="right" if 0 < k < len(SHORT) - 1 else "left", no_wrap=k > 0, overflow="fold")
        for s in self.summaries:
            verdict, unit = "[red]FAIL[/]" if s.failures else "[green]ok[/]", "rel." if s.unit == "relative" else s.unit
            error, faster = f"{s.error:.1e} {unit[:4]:4}", times(s.in_time and s.in_time[:1])
            table.add_row(s.case, str(s.substeps), error, ordered(s)[:4], f"{1e3 * s.seconds:.1f}", faster, verdict)
        return table

    def _wide(self) -> Table:
        """Return the table of all columns."""
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style="bold")
        for k, head in enumerate(HEADS):
            last = head == HEADS[-1]
            table.add_column(head, justify="left" if k < 2 or last else "right", no_wrap=not last)
        for s in self.summaries:
            table.add_row(*cells(s), style="red" if s.failures else "")
        return table

    def __str__(self) -> str:
        return output.text(self, 200 if self.every_column else 80)

    def markdown(self, every: bool = False) -> str:
        """Return the table as Markdown. every: also one table of all points for each case."""
        lines = output.table(HEADS, map(cells, self.summaries))
        for case in self.cases if every else ():
            rows = [entry(p) for points in self.curves(case) for p in points]
            lines += ["", f"**{case}**: {CASES[case].title}", "", *output.table(COLUMNS, rows)]
        lines += ["", *(f"- missing: {m.task}: {m.why}" for m in self.missing)]
        lines += [f"- left out: {line}" for line in self.omissions] if every else []
        return "\n".join(lines).strip() + "\n"

    def json(self) -> str:
        """Return the report as JSON."""
        cases = {n: {k: getattr(CASES[n], k) for k in ("title", "unit", "seconds", "limit", "trusted")} for n in self.cases}
        return json.dumps(
            {
                "machine": self.machine,
                "cases": cases,
                "points": [output.plain(asdict(p)) for p in self.points],
                "orders": {f"{c}, {m}": o for c in self.cases for m in CASES[c].methods if (o := self.order(c, m))},
                "failures": {k: list(v) for k, v in self.failures.items()},
                "missing": [asdict(m) for m in self.missing],
                "omissions": self.omissions,
            },
            indent=1, allow_nan=False,
        )  # fmt: skip

    def plot(self, folder) -> list[str]:
        """Plot every case log-log, as PNG in `folder`; return the paths. Needs matplotlib (the extra "plots")."""
        from .figures import plot

        return plot(self, folder)

    def record(self, path) -> None:
        """Write the log-log curves of all cases as a recording for the rerun viewer."""
        from .figures import record

        record(self, path)


SHORT = ("case", "n", "error", "order", "ms/s", "XPBD", "")  # on a screen
HEADS = (
    "case", "solver", "substeps", "error", "order", "ms per s", "XPBD / ours", "at equal work", "article / ours", "f32 error",
    "energy drift", "momentum drift", "verdict",
)  # fmt: skip
COLUMNS = (
    "solver",
    "precision",
    "substeps",
    "error",
    "s per s",
    "visits per s",
    "residual",
    "energy drift",
    "compile [s]",
    "flags",
)


def fitted(case: Case, points: "list[Point]") -> float | None:
    """Return the order by least squares over the points whose error is neither a large part of the motion nor near the
    uncertainty of the answer; None for fewer than three."""
    some = [
        p for p in points
        if FLOOR * case.trusted < p.error < RESOLVED * case.size and (not case.fit or p.substeps in case.fit)
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


def cells(s: Summary) -> tuple[str, ...]:
    """Return the table row of a result."""
    return (
        s.case, s.method, str(s.substeps), f"{s.error:.1e} {s.unit}", ordered(s),
        f"{1e3 * s.seconds:.1f}", times(s.in_time), times(s.in_work), times(s.over_article),
        "" if s.single is None else f"{s.single:.1e}", drift(s.energy), drift(s.momentum), "; ".join(s.failures) or "ok",
    )  # fmt: skip


def entry(p: "Point") -> tuple[str, ...]:
    """Return the table row of a point."""
    error = "diverged" if p.diverged else f"{p.error:.2e}"
    return (
        p.method, p.precision, f"{p.substeps} x {p.iterations}", error, f"{p.seconds:.2e}", f"{p.visits:.1e}",
        f"{p.residual:.1e}", drift(p.energy), f"{p.compile:.1f}", " ".join(p.flags),
    )  # fmt: skip


def ordered(s: Summary) -> str:
    """Return the order as text, with the solver that shows it if that is not the first one."""
    if s.order is None:
        return ""
    return f"{s.order:.2f}" if s.shown_by == s.method else f"{s.order:.2f} ({s.shown_by})"


def times(ratios: tuple[float, ...] | None) -> str:
    """Return ratios (median and least, or the median alone) as text with two digits."""
    if ratios is None:
        return ""
    return " / ".join(f"{r:.0f}" if 10 <= r < 1e4 else f"{r:.2g}" for r in ratios)


def drift(value: float) -> str:
    """Return a drift as text; empty if nothing is conserved."""
    return "" if not np.isfinite(value) else f"{value:.0e}"
