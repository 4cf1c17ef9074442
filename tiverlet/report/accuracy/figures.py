"""Log-log curves of error against run time: PNG by matplotlib, and a recording for the rerun viewer."""

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from ...tools import golden_colors
from ..output import canvas
from .baselines import BASELINES
from .cases import CASES
from .points import Point

if TYPE_CHECKING:
    from .errors import ErrorReport


def plot(report: "ErrorReport", folder) -> list[str]:
    """Plot one PNG for each case; diverged points are crosses at the top edge. Returns the paths."""
    Figure = canvas(folder)
    out = []
    for name in report.cases:
        curves = [c for c in report.curves(name) if c]
        if not curves:
            continue
        figure = Figure(figsize=(7, 5), layout="constrained")
        axes = figure.subplots()
        top = max([p.error for c in curves for p in c if not p.diverged and p.error > 0] or [CASES[name].size])
        for curve, color in zip(curves, golden_colors(len(curves)) / 255, strict=True):
            good = [p for p in curve if not p.diverged and p.error > 0]
            label = f"{curve[0].method}, {curve[0].precision}"
            dashes = "--" if curve[0].method in BASELINES else "-"
            axes.loglog([p.seconds for p in good], [p.error for p in good], dashes, marker="o", ms=4, color=color, label=label)
            lost = [p for p in curve if p.diverged]
            axes.loglog([p.seconds for p in lost], [2 * top] * len(lost), "x", color=color)
        axes.set(xlabel="run time [s per simulated s]", ylabel=f"error [{CASES[name].unit}]", title=CASES[name].title)
        axes.grid(True, which="both", alpha=0.2)
        axes.legend(fontsize=8)
        path = os.path.join(folder, name.replace(":", "_").replace("/", "_") + ".png")
        figure.savefig(path, dpi=110)
        out.append(path)
    return out


def decades(points: list[Point]) -> np.ndarray:
    """Return log10 of run time and error of the points, (k, 2)."""
    return np.log10([[p.seconds, p.error] for p in points if not p.diverged and p.error > 0]).reshape(-1, 2)


def record(report: "ErrorReport", path) -> None:
    """Write a recording of all curves. The viewer has no logarithmic axes, so curves are drawn in decades, with a grid."""
    import rerun as rr
    import rerun.blueprint as rrb

    from ...recording.layout import transform

    stream: Any = rr.RecordingStream("tiverlet_error_against_time")
    views = []
    for name in report.cases:
        curves = [(c, decades(c)) for c in report.curves(name)]
        curves = [(c, xy) for c, xy in curves if len(xy)]
        if not curves:
            continue
        entity = "cases/" + "".join(k if k.isalnum() or k in "_-" else "_" for k in name)
        stream.log(entity, transform(np.array([0.0, 1.0]), 1.0), static=True)
        every = np.concatenate([xy for _, xy in curves])
        low, high = np.floor(every.min(axis=0)), np.ceil(every.max(axis=0))
        grid = [[[x, low[1]], [x, high[1]]] for x in np.arange(low[0], high[0] + 1)]
        grid += [[[low[0], y], [high[0], y]] for y in np.arange(low[1], high[1] + 1)]
        stream.log(f"{entity}/decades", rr.LineStrips2D(grid, colors=[[70, 70, 80]], radii=[-0.5]), static=True)
        marks = [[x, low[1]] for x in np.arange(low[0], high[0] + 1)] + [[low[0], y] for y in np.arange(low[1], high[1] + 1)]
        labels = [f"1e{x:.0f} s/s" for x in np.arange(low[0], high[0] + 1)]
        labels += [f"1e{y:.0f} {CASES[name].unit}" for y in np.arange(low[1], high[1] + 1)]
        stream.log(f"{entity}/marks", rr.Points2D(marks, labels=labels, radii=-1.0, colors=[[150, 150, 160]]), static=True)
        for (curve, xy), color in zip(curves, golden_colors(len(curves)), strict=True):
            label = f"{curve[0].method}, {curve[0].precision}"
            at = f"{entity}/{curve[0].method.replace(' ', '_')}_{curve[0].precision}"
            stream.log(at, rr.LineStrips2D([xy], colors=[color], labels=[label], radii=-1.5), static=True)
            stream.log(f"{at}/points", rr.Points2D(xy, colors=[color], radii=-3.0), static=True)
        views.append(rrb.Spatial2DView(origin=entity, name=CASES[name].title, background=[18, 20, 26]))
    text = "# Error against run time\n\n" + report.markdown()
    stream.log("about", rr.TextDocument(text, media_type="text/markdown"), static=True)
    tabs = rrb.Tabs(rrb.TextDocumentView(origin="about", name="Table"), *views)
    stream.save(os.fspath(path), default_blueprint=rrb.Blueprint(tabs, auto_views=False, auto_layout=False))
    stream.disconnect()
