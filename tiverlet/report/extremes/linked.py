"""Rows about links: mass ratios, stiffness, contradictions, long chains, loops and trees."""

from typing import Any

import numpy as np

from ...constraints import Distance, Pin, ShapeMatch
from ...forces import Drag, Gravity
from ...measure import angular_momentum, kinetic_energy, momentum, strain
from ...particles import Particles
from ...solvers import Direct
from ..cases import known
from ..cases.case import links, rms
from ..cases.chains import hung
from ..cases.free import racket
from ..cases.statics import rope
from .row import Finding, finite, rerun, row, warned, world

DS = ("D01_double_pendulum", "D02_double_pendulum_low", "D03_mueller_triple", "D04_mueller_heavy", "D05_chain10", "D06_chain100",
      "D07_massratio_1000", "D07_massratio_1000000", "D08_massratio10", "D09_massratio_inverted")  # fmt: skip


@row(1, "mass ratio of 1:1e3 in a chain", "Direct: error <= 1e-4 m after 1 s; Jacobi: the residual says what is wrong")
def _ratio() -> Finding:
    holds = {}
    for name, at, key in (("D07_massratio_1000", 2, "heavy_xy"), ("D08_massratio10", 10, "xy")):
        want = np.atleast_2d(known(name)["values"]["t1.0"][key])[-1]
        particles, features = hung(name)
        with world(particles, features, solver=Direct()) as w:
            w.run(1.0)
            error = float(np.linalg.norm(w.position[at] - want))
            holds[f"{name[:3]} {error:.1e} m"] = error <= 1e-4
    text = ", ".join(holds)
    particles, (pull, link) = hung("D07_massratio_1000")
    with world(particles, [pull, link]) as w:
        residual = w.run(0.5).residual
        now = np.abs(strain(w, link.indices, link.rest)).max()
        holds[f"Jacobi reports {residual:.1e}"] = residual >= now * (1 - 1e-9) and residual > 1e-3
    return Finding(text, holds)


@row(
    2,
    "mass ratio of 1:1e6",
    "as accurate with enough substeps, by hand or by the guard (1e-6 m); with too few bounded and flagged",
)
def _million() -> Finding:
    want = known("D07_massratio_1000000")["values"]["t0.5"]["heavy_xy"]
    particles, features = hung("D07_massratio_1000000")
    errors = {}
    with world(particles, features, solver=Direct(), substeps="auto") as w:
        most = rerun(w, 0.5).substeps
        errors["auto"] = float(np.linalg.norm(w.position[2] - want))
        rerun(w, 0.5, substeps=320)
        errors["320 substeps"] = float(np.linalg.norm(w.position[2] - want))
        flags = rerun(w, 0.5, substeps=20).flags
        holds = {f"{k}: {e:.0e} m": e <= 1e-6 for k, e in errors.items()}
        text = f"{', '.join(holds)} (up to {most}); at 20: {', '.join(sorted(flags))}"
        return Finding(text, {**holds, "flagged": "softened" in flags, "bounded": finite(w)})


@row(4, "mass inf", "the same bits as of a pinned particle")
def _infinite() -> Finding:
    made = []
    for settings in ({"mass": [np.inf, 1.0]}, {"pinned": [0]}):
        with world(Particles([[0.0, 0], [1, 0]], **settings), [Gravity(), Distance([[0, 1]])]) as w:
            w.run(0.5)
            made.append(w.hash())
    return Finding("equal" if made[0] == made[1] else "different", {"same hash": made[0] == made[1]})


@row(7, "a link between two static particles", "skipped, and warned of where it is violated")
def _idle() -> Finding:
    def build():
        from ...world import World

        return World(Particles([[0.0, 0], [1, 0]], pinned=[0, 1]), [Distance([[0, 1]], 3.0)])

    told = warned(build, "cannot move")
    with world(Particles([[0.0, 0], [1, 0]], pinned=[0, 1]), [Distance([[0, 1]], 3.0), Gravity()]) as w:
        w.run(0.1)
        still = np.array_equal(w.position, [[0, 0], [1, 0]])
    return Finding("warned of" if told else "silent", {"warned": told, "unmoved": still})


@row(8, "compliance 0", "hard: lengths to 1e-6, in f32 and f64")
def _hard() -> Finding:
    holds = {}
    for precision in ("f32", "f64"):
        with world(Particles([[0.0, 0], [1, 0]], pinned=[0]), [Gravity(), Distance([[0, 1]])], precision=precision) as w:
            w.run(5.0)
            error = abs(float(strain(w, [[0, 1]], [1.0])[0]))
            holds[f"{precision} {error:.0e}"] = error <= 1e-6
    return Finding(", ".join(holds), holds)


@row(9, "compliance from 1e-12 to 1e12 m/N", "finite, monotone, and alpha m g where it has come to rest")
def _sweep() -> Finding:
    alpha: Any = 10.0 ** np.arange(-12, 13)
    n = len(alpha)
    x = np.stack([np.tile(np.arange(float(n)), 2), np.repeat([0.0, -1.0], n)], axis=1)
    pairs = np.stack([np.arange(n), np.arange(n) + n], axis=1)
    with world(Particles(x, pinned=np.arange(n)), [Gravity(9.81), Distance(pairs, compliance=alpha), Drag(4.0)]) as w:
        w.run(20.0)
        stretch = -1 - w.position[n:, 1]
        rest = alpha <= 0.1
        error = np.abs(stretch[rest] / (alpha[rest] * 9.81) - 1)[alpha[rest] >= 1e-9].max()
        return Finding(
            f"alpha m g to {error:.0e}",
            {"finite": finite(w), "monotone": bool((np.diff(stretch) >= -1e-12).all()), "exact": bool(error < 1e-6)},
        )


@row(12, "dt = 0.1 s in one substep", "all D chains: finite, and no more energy than gravity can supply")
def _one_step() -> Finding:
    holds = {}
    for solver in (None, Direct()):
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
            holds[f"{solver or 'Jacobi()'} {worst:+.2f} m g L"] = finite(w) and worst <= 1.0
    return Finding(", ".join(holds), holds)


@row(15, "zero rest length, pairs 0 and 1e-20 m apart", "a spring to a point works; without a direction nothing moves, no NaN")
def _point() -> Finding:
    x = np.array([[0.0, 0], [0, 0], [1, 0], [1 + 1e-20, 0], [3, 0], [3.5, 0]])
    holds: dict[str, bool] = {}
    alpha: Any = [0, 0, 0.01]
    for precision in ("f32", "f64"):
        link = Distance([[0, 1], [2, 3], [4, 5]], 0.0, compliance=alpha)
        with world(Particles(x), [link], precision=precision) as w:
            w.run(1.0)
            apart = abs(w.position[5, 0] - w.position[4, 0])
            holds[precision] = finite(w) and bool(np.abs(w.position[:4] - x[:4]).max() < 1e-15 and apart <= 0.5 + 1e-6)
    return Finding("finite, unmoved", holds)


@row(17, "coincident at x_n, apart at the prediction", "the direction at the prediction takes its place")
def _late() -> Finding:
    holds = {}
    for precision in ("f32", "f64"):
        start = Particles([[2.0, 0], [2, 0]], velocity=[[0, 0], [0, 3.0]])
        with world(start, [Distance([[0, 1]], 0.5)], precision=precision) as w:
            w.run(1.0)
            error = abs(float(strain(w, [[0, 1]], [0.5])[0]))
            holds[f"{precision}: length to {error:.0e}"] = finite(w) and error <= 1e-3
    return Finding(", ".join(holds), holds)


@row(18, "links that turn too far in a substep", "falls back and is flagged: the whip of 100 links at 4 substeps, bounded")
def _whip() -> Finding:
    particles, features = hung("D06_chain100")
    with world(particles, features, substeps=4, iterations=10) as w:
        report = w.run(1.5)
        gain = w.last.energy
        return Finding(
            f"{', '.join(sorted(report.flags))}; energy {gain:+.3f} J",
            {"finite": finite(w), "flagged": "turned" in report.flags, "no energy": gain <= 1e-2},
        )


@row(21, "links that contradict each other (triangle 1, 1, 3)", "bounded for 1e5 substeps, the residual is least squares")
def _contradiction() -> Finding:
    x = np.array([[0.0, 0], [1, 0], [0.5, 0.3]])
    link = Distance([[0, 2], [2, 1], [0, 1]], [1.0, 1.0, 3.0])
    with world(Particles(x), [link, Drag(1.0)], substeps=100) as w:
        seen = []
        for _ in range(1000):
            seen.append(w.step(1 / 6).energy)
        # On a line, a + a against 3: 2 (a - 1)^2 + (2 a - 3)^2 is least at a = 4/3, where each is off by 1/3.
        error = abs(w.last.residual - 1 / 3)
        return Finding(
            f"residual {w.last.residual:.4f}, least squares 0.3333",
            {"finite": finite(w), "no growth": max(seen[500:]) <= max(seen[:500]) + 1e-9, "least squares": error <= 1e-3},
        )


@row(22, "double links", "the same shape as of single ones")
def _double() -> Finding:
    made = []
    for count in (1, 2):
        particles, features = rope(10, 10.0, 6.0, 0.0)
        pairs = np.tile(links(10), (count, 1))
        with world(particles, [features[0], Distance(pairs, 1.0), features[2]], iterations=16) as w:
            w.run(8.0)
            made.append(w.position)
    error = float(np.abs(made[0] - made[1]).max())
    sag = abs(-made[1][:, 1].min() / known("R10b_discrete_catenary_N10")["values"]["sag"] - 1)
    return Finding(f"{error:.1e} m apart, sag to {sag:.0e}", {"same": error < 1e-3, "sag": sag < 1e-4})


@row(23, "over-constrained clusters (all 15 links of 6 masses)", "converges to the rigid body, angular momentum is kept")
def _cluster() -> Finding:
    particles, _ = racket()
    pairs = [(i, j) for i in range(6) for j in range(i)]
    values = known("S05_tennis_racket")["values"]["t2.0"]
    errors = {}
    for name, feature in (("links", Distance(pairs)), ("cluster", ShapeMatch([np.arange(6)]))):
        with world(particles, [feature], iterations=30 if name == "links" else 1) as w:
            w.run(1 / 60)
            before = angular_momentum(w)
            w.run(2.0 - 1 / 60)
            drift = float(np.linalg.norm(angular_momentum(w) - before) / np.linalg.norm(before))
            errors[name] = (rms(w.position[[0, 2]], [values["particle1_xyz"], values["particle3_xyz"]]), drift)
    return Finding(
        ", ".join(f"{k} {e:.0e} m, L {d:.0e}" for k, (e, d) in errors.items()),
        {f"{k}": e < 1e-4 and d < 1e-6 for k, (e, d) in errors.items()},
    )


@row(24, "a particle with 1000 links", "stable: the hub of a star that falls and spins")
def _hub() -> Finding:
    n = 1000
    a = 2 * np.pi * np.arange(n) / n
    x = np.vstack([[0, 0], np.stack([np.cos(a), np.sin(a)], axis=1)])
    v = 2.0 * np.stack([-x[:, 1], x[:, 0]], axis=1)
    pairs = np.stack([np.zeros(n, dtype=int), np.arange(n) + 1], axis=1)
    with world(Particles(x, velocity=v, mass=np.r_[10.0, np.full(n, 0.01)]), [Gravity(), Distance(pairs)], iterations=4) as w:
        energy = kinetic_energy(w)
        w.run(1 / 60)
        report = w.run(2.0)
        gain = (w.last.energy - energy) / energy
        return Finding(
            f"stretch {report.residual:.1e}, energy {gain:+.1e}",
            {"finite": finite(w), "no energy": gain <= 1e-2, "holds": report.residual < 1e-2},
        )


@row(39, "a chain of 10 000 links", "Direct: the k-th link carries (N - k) m g after one substep, and stays")
def _long() -> Finding:
    n, m = 10_000, 0.01
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    link = Distance(links(n))
    with world(Particles(x, mass=m, pinned=[0]), [Gravity(9.81), link], substeps=1, solver=Direct()) as w:
        w.step(1e-3)
        error = float(np.abs(link.load / (m * 9.81 * np.arange(n, 0, -1)) - 1).max())
        report = w.run(0.2, dt=1e-3)
        return Finding(f"loads to {error:.0e}", {"loads": error < 1e-7, "rest": report.clean and report.residual < 1e-9})


@row(40, "a closed loop of 100 links", "solved as one system: lengths, momentum and energy hold")
def _loop() -> Finding:
    n = 100
    a = 2 * np.pi * np.arange(n) / n
    x = np.stack([np.cos(a), 0.7 * np.sin(a)], axis=1)
    v = np.stack([-x[:, 1], x[:, 0]], axis=1) * 3 + [1.0, 2.0]
    pairs = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    with world(Particles(x, velocity=v), [Distance(pairs)], solver=Direct(), iterations=2) as w:
        first = w.step(1 / 60).energy
        report = w.run(2.0)
        drift = abs(w.last.energy - first) / first
        lost = float(np.abs(momentum(w) - [n, 2 * n]).max()) / n
        solved = "elimination" in w.explain()
    return Finding(
        f"lengths to {report.residual:.0e}, energy {drift:.0e}, momentum {lost:.0e}",
        {"one system": solved, "lengths": report.residual < 1e-6, "energy": drift < 1e-2, "momentum": lost < 1e-9},
    )


@row(41, "trees with branches", "elimination equals a dense solution to 1e-10")
def _trees() -> Finding:
    rng = np.random.default_rng(0)
    n = 100
    pairs = np.array([(rng.integers(i), i) for i in range(1, n)])
    x, mass = rng.normal(size=(n, 2)), np.exp(rng.uniform(0, np.log(1000), n))
    v, h = 0.2 * rng.normal(size=(n, 2)), 1e-3
    with world(Particles(x, velocity=v, mass=mass), [Distance(pairs)], substeps=1, solver=Direct()) as w:
        w.step(h)
        found = w.position
    # One Newton step of all links at once: gradients at the prediction, directions at the start.
    i, j = pairs.T
    now, before = (x + h * v)[i] - (x + h * v)[j], x[i] - x[j]
    length, rest = np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1)
    G, N = (np.zeros((n - 1, n, 2)) for _ in range(2))
    k = np.arange(n - 1)
    for J, r in ((G, now / length[:, None]), (N, before / rest[:, None])):
        J[k, i], J[k, j] = r, -r
    lam = np.linalg.solve(np.einsum("jia,i,kia->jk", G, 1 / mass, N), rest - length)
    want = x + h * v + np.einsum("k,i,kia->ia", lam, 1 / mass, N)
    error = float(np.abs(found - want).max() / np.abs(want - x).max())
    return Finding(f"{error:.0e} of the moves", {"equal": error <= 1e-10})


@row(44, "spin of 1e3 rad/s, omega h = 0.83", "length kept, bounded, and flagged as more than a substep can follow")
def _spin() -> Finding:
    start = Particles([[0.5, 0.0], [-0.5, 0.0]], velocity=[[0, 500.0], [0, -500.0]])
    with world(start, [Distance([[0, 1]])], iterations=20) as w:
        report = w.run(1.0)
        error = abs(float(strain(w, [[0, 1]], [1.0])[0]))
        return Finding(
            f"length to {error:.0e}, {', '.join(sorted(report.flags))}",
            {"length": error <= 1e-6, "flagged": "turned" in report.flags, "bounded": w.last.energy <= 250000.0 * 1.0001},
        )


@row(69, "a pinned particle moved by 10 m in a frame", "bounded, the chain recovers, and the energy put in is reported")
def _yank() -> Finding:
    n = 10
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    hand = Pin([0])
    with world(Particles(x), [Gravity(9.81), Distance(links(n)), hand, Drag(1.0)], iterations=4) as w:
        w.step(1 / 60)
        hand.target = (10.0, 0.0)
        put = w.step(1 / 60).energy_change
        w.run(8.0)
        far = float(np.abs(w.position - [10.0, 0.0]).max())
        return Finding(
            f"{put:.3g} J put in; residual {w.last.residual:.0e} in the end",
            {"finite": finite(w), "recovers": w.last.residual < 1e-2 and far < 1.05, "reported": put > 1.0},
        )
