"""Rows about links: mass ratios, stiffness, links without direction, and links that contradict each other."""

from typing import Any

import numpy as np

from ....constraints import Distance
from ....forces import Drag, Gravity
from ....measure import strain
from ....particles import Particles
from ....solvers import Direct, Jacobi
from ....world import World
from ...accuracy.cases import known
from ...accuracy.cases.chains import hung
from .row import Findings, at_most, finite, rerun, row, warned, world

DS = ("D01_double_pendulum", "D02_double_pendulum_low", "D03_mueller_triple", "D04_mueller_heavy", "D05_chain10", "D06_chain100",
      "D07_massratio_1000", "D07_massratio_1000000", "D08_massratio10", "D09_massratio_inverted")  # fmt: skip


@row(1, "mass ratio of 1:1e3 in a chain", "Direct: error <= 1e-4 m after 1 s; Jacobi: the residual says what is wrong")
def _ratio() -> Findings:
    for name, at, key, limit in (("D07_massratio_1000", 2, "heavy_xy", 1e-5), ("D08_massratio10", 10, "xy", 1e-4)):
        want = np.atleast_2d(known(name)["values"]["t1.0"][key])[-1]
        particles, features = hung(name)
        with world(particles, features, solver=Direct()) as w:
            w.run(1.0)
            error = float(np.linalg.norm(w.position[at] - want))
            yield at_most(f"{name[:3]} {error:.1e} m", error, limit)
    particles, (pull, link) = hung("D07_massratio_1000")
    with world(particles, [pull, link], solver=Jacobi()) as w:
        residual = w.run(0.5).residual
        now = np.abs(strain(w, link.indices, link.rest)).max()
        yield f"Jacobi reports {residual:.1e}", residual >= now * (1 - 1e-9) and residual > 1e-3


@row(2, "mass ratio of 1:1e6",
     "as accurate with enough substeps, by hand or by the controller (1e-6 m); with too few bounded and flagged")  # fmt: skip
def _million() -> Findings:
    want = known("D07_massratio_1000000")["values"]["t0.5"]["heavy_xy"]
    particles, features = hung("D07_massratio_1000000")
    with world(particles, features, solver=Direct(), substeps="auto") as w:
        for substeps, limit in (("auto", 1e-6), (320, 3e-8)):
            most = rerun(w, 0.5, substeps=substeps).substeps
            error = float(np.linalg.norm(w.position[2] - want))
            yield at_most(f"{substeps}, up to {most} substeps: {error:.0e} m", error, limit)
        flags = rerun(w, 0.5, substeps=20).flags
        yield f"at 20: {', '.join(sorted(flags))}", "softened" in flags and finite(w)


@row(4, "mass inf", "the same bits as of a pinned particle")
def _infinite() -> Findings:
    made = []
    for settings in ({"mass": [np.inf, 1.0]}, {"pinned": [0]}):
        with world(Particles([[0.0, 0], [1, 0]], **settings), [Gravity(), Distance([[0, 1]])]) as w:
            w.run(0.5)
            made.append(w.hash())
    yield "the same hash", made[0] == made[1]


@row(7, "a link between two static particles", "skipped, and warned of where it is violated")
def _idle() -> Findings:
    start = Particles([[0.0, 0], [1, 0]], pinned=[0, 1])
    yield "warned of", warned(lambda: World(start, [Distance([[0, 1]], 3.0)]), "cannot move")
    with world(start, [Distance([[0, 1]], 3.0), Gravity()]) as w:
        w.run(0.1)
        yield "unmoved", np.array_equal(w.position, [[0, 0], [1, 0]])


@row(8, "compliance 0", "hard: lengths to 1e-12, in f32 and f64")
def _hard() -> Findings:
    for precision in ("f32", "f64"):
        with world(Particles([[0.0, 0], [1, 0]], pinned=[0]), [Gravity(), Distance([[0, 1]])], precision=precision) as w:
            w.run(5.0)
            error = abs(float(strain(w, [[0, 1]], [1.0])[0]))
            yield at_most(f"{precision} {error:.0e}", error, 1e-12)


@row(9, "compliance from 1e-12 to 1e12 m/N", "finite, monotone, and alpha m g where it has come to rest")
def _sweep() -> Findings:
    alpha: Any = 10.0 ** np.arange(-12, 13)
    n = len(alpha)
    x = np.stack([np.tile(np.arange(float(n)), 2), np.repeat([0.0, -1.0], n)], axis=1)
    pairs = np.stack([np.arange(n), np.arange(n) + n], axis=1)
    with world(Particles(x, pinned=np.arange(n)), [Gravity(9.81), Distance(pairs, compliance=alpha), Drag(4.0)]) as w:
        w.run(20.0)
        stretch = -1 - w.position[n:, 1]
        rest = alpha <= 0.1
        error = np.abs(stretch[rest] / (alpha[rest] * 9.81) - 1)[alpha[rest] >= 1e-9].max()
        yield at_most(f"alpha m g to {error:.0e}", error, 4e-8, finite(w))
        yield "monotone", (np.diff(stretch) >= -1e-12).all()


@row(12, "dt = 0.1 s in one substep", "all D chains: finite, and no more energy than gravity can supply")
def _one_step() -> Findings:
    for solver, limit in ((Jacobi(), 0.0), (Direct(), 0.3)):
        x, mass, pairs, pins, n = [], [], [], [], 0
        for name in DS:
            p, (_, link) = hung(name)
            x, mass, pairs, pins = [*x, p.position], [*mass, p.mass], [*pairs, link.indices + n], [*pins, n]
            n += len(p)
        chain = np.repeat(np.arange(len(DS)), [len(part) for part in x])
        m = np.concatenate(mass)
        m[pins] = 0
        at = np.vstack(x)
        start = Particles(at, mass=np.maximum(m, 1e-9), pinned=pins)
        all_pairs = np.vstack(pairs)
        reach = np.zeros(n)
        for i, j in all_pairs:
            reach[j] = reach[i] + np.linalg.norm(at[j] - at[i])
        with world(start, [Gravity(9.81), Distance(all_pairs)], substeps=1, solver=solver) as w:
            first = np.bincount(chain, m * 9.81 * at[:, 1])
            worst, before = -np.inf, w.position
            for _ in range(100):
                w.step(0.1)
                d = (w.position - before) / 0.1
                middle = (w.position + before) / 2
                energy = np.bincount(chain, m * (0.5 * (d**2).sum(axis=1) + 9.81 * middle[:, 1]))
                worst = max(worst, float(((energy - first) / np.bincount(chain, m * 9.81 * reach)).max()))
                before = w.position
            yield at_most(f"{solver} {worst:+.2f} m g L", worst, limit, finite(w))


@row(15, "zero rest length, pairs 0 and 1e-20 m apart", "a spring to a point works; without a direction nothing moves, no NaN")
def _point() -> Findings:
    x = np.array([[0.0, 0], [0, 0], [1, 0], [1 + 1e-20, 0], [3, 0], [3.5, 0]])
    alpha: Any = [0, 0, 0.01]
    for precision in ("f32", "f64"):
        link = Distance([[0, 1], [2, 3], [4, 5]], 0.0, compliance=alpha)
        with world(Particles(x), [link], precision=precision) as w:
            w.run(1.0)
            apart = abs(w.position[5, 0] - w.position[4, 0])
            moved = np.abs(w.position[:4] - x[:4]).max()
            yield f"{precision} moved {moved:g} m", finite(w) and moved < 1e-15 and apart <= 0.5 + 1e-12


@row(17, "coincident at x_n, apart at the prediction", "the direction at the prediction takes its place")
def _late() -> Findings:
    for precision, limit in (("f32", 1e-12), ("f64", 1e-12)):
        start = Particles([[2.0, 0], [2, 0]], velocity=[[0, 0], [0, 3.0]])
        with world(start, [Distance([[0, 1]], 0.5)], precision=precision) as w:
            w.run(1.0)
            error = abs(float(strain(w, [[0, 1]], [0.5])[0]))
            yield at_most(f"{precision}: length to {error:.0e}", error, limit, finite(w))


@row(18, "links that turn too far in a substep", "falls back and is flagged: the whip of 100 links at 4 substeps, bounded")
def _whip() -> Findings:
    for solver in (Jacobi(), Direct()):
        particles, features = hung("D06_chain100")
        with world(particles, features, substeps=4, iterations=10, solver=solver) as w:
            report = w.run(1.5)
            told = ", ".join(sorted(report.flags)) or "no flag"
            yield f"{solver}: {told}", report.flags & {"turned", "softened"}
            yield at_most(f"energy {w.last.energy:+.1e} J", w.last.energy, 0.0, finite(w))


@row(21, "links that contradict each other (triangle 1, 1, 3)", "bounded for 1e5 substeps, the residual is least squares",
     known="links that contradict each other yield one by one: the sum is least, not that of squares")  # fmt: skip
def _contradiction() -> Findings:
    x = np.array([[0.0, 0], [1, 0], [0.5, 0.3]])
    link = Distance([[0, 2], [2, 1], [0, 1]], [1.0, 1.0, 3.0])
    with world(Particles(x), [link, Drag(1.0)], substeps=100) as w:
        seen = []
        for _ in range(1000):
            seen.append(w.step(1 / 6).energy)
        # On a line, with lengths a, a and 2 a, 2 (a - 1)^2 + (2 a - 3)^2 is least at a = 4/3, where each link is off by 1/3.
        error = abs(w.last.residual - 1 / 3)
        yield at_most(f"residual {w.last.residual:.4f}, least squares 0.3333, {error:.0e} off", error, 1e-12, finite(w))
        yield "no growth", max(seen[500:]) <= max(seen[:500]) + 1e-9


@row(44, "spin of 1e3 rad/s, omega h = 0.83", "length kept, bounded, and flagged as more than a substep can follow")
def _spin() -> Findings:
    start = Particles([[0.5, 0.0], [-0.5, 0.0]], velocity=[[0, 500.0], [0, -500.0]])
    with world(start, [Distance([[0, 1]])], iterations=20) as w:
        report = w.run(1.0)
        error = abs(float(strain(w, [[0, 1]], [1.0])[0]))
        yield at_most(f"length to {error:.0e}", error, 1e-12)
        gained = w.last.energy / 250000.0 - 1
        yield at_most(f"energy {gained:+.0e}", gained, 0.0)
        yield ", ".join(sorted(report.flags)), "turned" in report.flags
