"""Rows about systems of links: doubled links, over-constrained clusters, hubs, long chains, loops and trees."""

import numpy as np

from ....constraints import Distance, Pin, ShapeMatch
from ....forces import Drag, Gravity
from ....measure import angular_momentum, kinetic_energy, momentum
from ....particles import Particles
from ....solvers import Direct
from ...accuracy.cases import known
from ...accuracy.cases.case import links, rms
from ...accuracy.cases.free import racket
from ...accuracy.cases.statics import rope
from .row import Findings, at_most, finite, row, world


@row(22, "double links", "the same shape as of single ones")
def _double() -> Findings:
    made = []
    for count in (1, 2):
        particles, features = rope(10, 10.0, 6.0, 0.0)
        pairs = np.tile(links(10), (count, 1))
        with world(particles, [features[0], Distance(pairs, 1.0), features[2]], iterations=16) as w:
            w.run(8.0)
            made.append(w.position)
    error = float(np.abs(made[0] - made[1]).max())
    sag = abs(-made[1][:, 1].min() / known("R10b_discrete_catenary_N10")["values"]["sag"] - 1)
    yield at_most(f"{error:.1e} m apart", error, 1e-12)
    yield at_most(f"sag to {sag:.0e}", sag, 1e-7)


@row(23, "over-constrained clusters (all 15 links of 6 masses)", "converges to the rigid body, angular momentum is kept")
def _cluster() -> Findings:
    particles, _ = racket()
    pairs = [(i, j) for i in range(6) for j in range(i)]
    values = known("S05_tennis_racket")["values"]["t2.0"]
    for name, feature, turn in (("links", Distance(pairs), 1e-12), ("cluster", ShapeMatch([np.arange(6)]), 1e-11)):
        with world(particles, [feature], iterations=30 if name == "links" else 1) as w:
            w.run(1 / 60)
            before = angular_momentum(w)
            w.run(2.0 - 1 / 60)
            drift = float(np.linalg.norm(angular_momentum(w) - before) / np.linalg.norm(before))
            error = rms(w.position[[0, 2]], [values["particle1_xyz"], values["particle3_xyz"]])
            yield at_most(f"{name} {error:.0e} m", error, 1e-4)
            yield at_most(f"L {drift:.0e}", drift, turn)


@row(24, "a particle with 1000 links", "stable: the hub of a star that falls and spins")
def _hub() -> Findings:
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
        yield at_most(f"stretch {report.residual:.1e}", report.residual, 3e-10, finite(w))
        yield at_most(f"energy {gain:+.1e}", gain, 0.0)


@row(39, "a chain of 10 000 links", "Direct: the k-th link carries (N - k) m g after one substep, and stays")
def _long() -> Findings:
    n, m = 10_000, 0.01
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    link = Distance(links(n))
    with world(Particles(x, mass=m, pinned=[0]), [Gravity(9.81), link], substeps=1, solver=Direct()) as w:
        w.step(1e-3)
        error = float(np.abs(link.load / (m * 9.81 * np.arange(n, 0, -1)) - 1).max())
        report = w.run(0.2, dt=1e-3)
        yield at_most(f"loads to {error:.0e}", error, 3e-8)
        yield at_most(f"stays to {report.residual:.0e}", report.residual, 1e-12, report.clean)


@row(40, "a closed loop of 100 links", "solved as one system: lengths, momentum and energy hold")
def _loop() -> Findings:
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
        yield "one system", "elimination" in w.explain()
    yield at_most(f"lengths to {report.residual:.0e}", report.residual, 1e-12)
    yield at_most(f"energy {drift:.0e}", drift, 1e-12)
    yield at_most(f"momentum {lost:.0e}", lost, 1e-12)


@row(41, "trees with branches", "elimination equals a dense solution to 1e-12")
def _trees() -> Findings:
    rng = np.random.default_rng(0)
    n = 100
    pairs = np.array([(rng.integers(i), i) for i in range(1, n)])
    x, mass = rng.normal(size=(n, 2)), np.exp(rng.uniform(0, np.log(1000), n))
    v, h = 0.2 * rng.normal(size=(n, 2)), 1e-3
    with world(Particles(x, velocity=v, mass=mass), [Distance(pairs)], substeps=1, solver=Direct()) as w:
        w.step(h)
        found = w.position
    # The reference is one Newton step of all links, with gradients at the prediction and directions at the start.
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
    yield at_most(f"{error:.0e} of the moves", error, 1e-12)


@row(69, "a pinned particle moved by 10 m in a frame", "bounded, the chain recovers, and the energy put in is reported")
def _yank() -> Findings:
    n = 10
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    hand = Pin([0])
    with world(Particles(x), [Gravity(9.81), Distance(links(n)), hand, Drag(1.0)], iterations=4) as w:
        w.step(1 / 60)
        hand.target = (10.0, 0.0)
        put = w.step(1 / 60).energy_change
        w.run(8.0)
        far = float(np.abs(w.position - [10.0, 0.0]).max())
        yield f"{put:.3g} J put in", put > 1.0
        yield at_most(f"residual {w.last.residual:.0e} in the end", w.last.residual, 1e-12, finite(w) and far < 1.05)
