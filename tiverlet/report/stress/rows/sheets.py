"""Rows about sheets: nets and cloth that are taut, large, or stiffer than a solver resolves."""

import numpy as np

from ....colliders import Ball
from ....constraints import Dihedral, Distance
from ....forces import Gravity, Wind
from ....particles import Particles
from ....shapes import cloth, net
from ....solvers import Chebyshev, ConjugateGradient, Jacobi
from ....solvers.solver import Solver
from ....step.adaptive import StepController
from ....step.step_report import UNCONVERGED
from .row import FRAMES, Findings, at_most, excused, finite, row, world

G = 9.81


@row(73, "nets pinned at the rim, at four corners, drawn straight between two pins",
     "no energy: any solver, 2, 20, 200 substeps and auto")  # fmt: skip
def _taut() -> Findings:
    n, m = 10, 1e-3
    sheet, k = net((0, 0, 0), (1, 0, 0), (0, 0, 1), (n, n)), np.arange(n * n).reshape(n, n)
    rim = np.unique(np.concatenate([k[0], k[-1], k[:, 0], k[:, -1]]))
    pins = [rim, [k[0, 0], k[0, -1], k[-1, 0], k[-1, -1]], [k[0, 0], k[0, -1]]]
    x = np.concatenate([sheet.position + [2.0 * c, 0, 0] for c in range(3)])
    pinned = np.concatenate([np.asarray(p) + c * n * n for c, p in enumerate(pins)])
    pairs = np.concatenate([sheet.links + c * n * n for c in range(3)])
    supply, gains = m * n * n * G, []
    for solver, precision in ((None, "f32"), (ConjugateGradient(8), "f64"), (Chebyshev(), "f64"), (Jacobi(), "f64")):
        start = Particles(x, mass=m, pinned=pinned)
        passes = 4 if isinstance(solver, Chebyshev) else 1
        with world(start, [Gravity(G), Distance(pairs)], solver=solver, precision=precision, iterations=passes) as w:
            for substeps, frames in FRAMES.items():
                w.position, w.velocity, w._controller = x, 0 * x, StepController()
                w.substeps = substeps
                gain = max(w.step(1 / 60).energy for _ in range(frames)) / supply
                gains.append((gain if finite(w) else np.inf, f"{w._solver}, {substeps} substeps"))
    most, where = max(gains)
    yield at_most(f"energy {most:+.1e} m g L ({where})", most, 0.0)


def under_a_ball(substeps: int, *sheets: tuple[str, float, Solver | None]) -> Findings:
    """Move a ball into cloths of some compliances by some solvers, in wind."""
    n, mass, gale, speed = 60, 0.2, 3.0, 1.0
    sheet = cloth((0, 0, 0), (1, 0, 0), (0, 0, 1), (n, n))
    pairs = np.concatenate([sheet.links, sheet.braces])
    supplied = 0.5 * mass * (gale + speed) ** 2  # bound: the energy at the speed of wind plus ball
    for name, compliance, solver in sheets:
        ball = Ball((0.5, -0.5, 0.5), 0.3)
        features = [
            Gravity(G),
            Distance(pairs, compliance=compliance),
            Dihedral(sheet.quads, compliance=100.0),
            Wind((gale, 0, 0), 0.5),
            ball,
        ]
        start = Particles(sheet.position, mass=mass / n**2, pinned=[0, n - 1])
        with world(start, features, solver=solver, precision="f32", substeps=substeps) as w:
            reports = []
            for frame in range(30):
                ball.center = (0.5, -0.5 + speed * frame / 60, 0.5)
                reports.append(w.step(1 / 60))
            gain, stretch = max(r.energy for r in reports) - supplied, max(r.residual for r in reports)
            yield at_most(f"{name}: {gain:+.2g} J beyond what wind and ball supply", gain, 0.0, finite(w))
            yield f"{name}: stretch {stretch:.2g}", all(excused(r, "residual", UNCONVERGED) for r in reports)


SHEETS = (("rigid", 0.0, None), ("1e-6 m/N", 1e-6, None))


@row(79, "cloth, rigid or of 1e-6 m/N, with Dihedral, in wind, under a ball that moves",
     "no energy, and flagged where it stretches, to twice its length at most")  # fmt: skip
def _wide() -> Findings:
    return under_a_ball(20, *SHEETS)


@row(126, "the same cloth in 5 substeps, and by Jacobi", "the same",
     known="stiff cloth of 3600 that few substeps or Jacobi do not resolve stretches without a bound, flagged")  # fmt: skip
def _wide_coarse() -> Findings:
    yield from under_a_ball(5, *SHEETS)
    yield from under_a_ball(20, ("1e-6 m/N, Jacobi", 1e-6, Jacobi()))
