"""Plots of a speed report by matplotlib."""

import os
from typing import TYPE_CHECKING

from ...tools import golden_colors
from ..output import canvas

if TYPE_CHECKING:
    from .result import SpeedReport


def plot(report: "SpeedReport", folder) -> list[str]:
    """Write speed.png (rates by size, pile.c dashed), start.png (first step, cold and warm) and memory.png. Returns the paths."""
    Figure = canvas(folder)
    curves = list(report.curves())
    scenes = list(dict.fromkeys(scene for scene, _, _ in curves))
    colors = dict(zip(scenes, golden_colors(max(1, len(scenes))) / 255, strict=False))
    out = []
    for name, unit in (("speed", "particle-substeps per second"), ("start", "first step [s]"), ("memory", "bytes per particle")):
        figure = Figure(figsize=(8, 5.5), layout="constrained")
        axes = figure.subplots()
        for scene, threads, runs in curves:
            n, style = [r.particles for r in runs], {"color": colors[scene], "marker": "o", "ms": 4}
            label = f"{scene}, {threads} thread{'s' * (threads > 1)}"
            width = 1 + 0.7 * (threads > 1)
            if name == "speed":
                axes.loglog(n, [r.rate for r in runs], label=label, lw=width, **style)
                by = [(r.particles, r.particles * r.substeps / r.yardstick) for r in runs if r.yardstick]
                if by:
                    axes.loglog(*zip(*by, strict=True), "--", label=f"pile.c, {label}", lw=width, **style)
            elif threads == max(t for s, t, _ in curves if s == scene):
                if name == "start":
                    axes.loglog(n, [r.cold for r in runs], label=f"{scene}, cold", **style)
                    axes.loglog(n, [r.warm for r in runs], ":", label=f"{scene}, warm", **style)
                else:
                    axes.loglog(n, [r.memory for r in runs], label=scene, **style)
        axes.set(xlabel="particles", ylabel=unit, title=report.machine)
        axes.grid(True, which="both", alpha=0.2)
        axes.legend(fontsize=7)
        path = os.path.join(folder, f"{name}.png")
        figure.savefig(path, dpi=110)
        out.append(path)
    return out
