"""Elimination: dense solutions, and where tensions are too large. For chains with known answers see test_cases.py."""

import contextlib
import re
from itertools import product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.report import CASES
from tiverlet.report.accuracy.cases.case import links

from .conftest import case, rerun, rms
from .fuzz.scenes import Structure
from .fuzz.trials import Trial
from .scenes import SCENES


def dense(x, d, w, pairs, rest):
    """Return positions and multipliers after one Newton step of all links at once: the reference for elimination.

    d: the displacements of the substep so far.
    """
    start = x - d
    now, before = x[pairs[:, 0]] - x[pairs[:, 1]], start[pairs[:, 0]] - start[pairs[:, 1]]
    length = np.linalg.norm(now, axis=1)
    G, N = np.zeros((len(pairs), *x.shape)), np.zeros((len(pairs), *x.shape))
    k = np.arange(len(pairs))
    for J, r in ((G, now / length[:, None]), (N, before / np.linalg.norm(before, axis=1)[:, None])):
        J[k, pairs[:, 0]], J[k, pairs[:, 1]] = r, -r
    A = np.einsum("jia,i,kia->jk", G, w, N)
    lam = np.linalg.solve(A, rest - length)
    return x + w[:, None] * np.einsum("k,kia->ia", lam, N), lam


def some_tree(rng, n):
    return np.array([(rng.integers(i), i) for i in range(1, n)])


def ladder():
    """Return a ladder of 30 rungs with a tail and a ring at its end: wider than a tree, and one system."""
    a, b = np.arange(30), np.arange(30) + 30
    rails = [np.stack([r[:-1], r[1:]], axis=1) for r in (a, b)]
    return np.vstack([*rails, np.stack([a, b], axis=1)[::2], [[59, 60], [60, 61], [61, 62], [62, 60]]])


@pytest.mark.parametrize("dim", [2, 3])
def test_elimination_equals_a_dense_solution(world, dim):
    # Trees, a necklace, a ladder; random masses, some static particles; several systems in a world, one Newton step.
    rng, h = np.random.default_rng(dim), 1e-3
    ring = np.stack([np.arange(100), (np.arange(100) + 1) % 100], axis=1)
    graphs = [some_tree(rng, 60), some_tree(rng, 40), ring, ladder()]
    begin = np.cumsum([0] + [g.max() + 1 for g in graphs])
    pairs = np.vstack([g + b for g, b in zip(graphs, begin, strict=False)])
    n = begin[-1]
    x, mass, pinned = rng.normal(size=(n, dim)), np.exp(rng.uniform(0, np.log(1000), n)), np.flatnonzero(rng.random(n) < 0.05)
    rest = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    w = np.where(np.isin(np.arange(n), pinned), 0, 1 / mass)
    alive = (w[pairs] > 0).any(axis=1)
    v, link = np.where(w[:, None] > 0, 0.02 * rng.normal(size=(n, dim)), 0), tv.Distance(pairs)
    start = tv.Particles(x, velocity=v, mass=mass, pinned=pinned)
    made = world(start, [link], precision="f64", solver=tv.Direct(), substeps=1)
    made.step(h)
    want, lam = dense(x + h * v, h * v, w, pairs[alive], rest[alive])
    np.testing.assert_allclose(made.position, want, atol=1e-10 * np.abs(want - x).max())
    np.testing.assert_allclose(link.load[alive], -2 * lam / h**2, atol=1e-10 * np.abs(lam).max() / h**2)
    assert made.last.residual < 1e-4 and "relaxed as by Jacobi" not in made.explain()


def test_ropes_act_where_they_must(world):
    # The right set of active ropes is the one whose multipliers all pull and whose slack ropes are all short enough; all 2^k
    # sets are tried. One Newton step from a random start, in chains of ropes and rods; chains are checked one by one.
    rng = np.random.default_rng(5)
    count, n = 6, 9
    x = np.stack([np.tile(np.arange(float(n)), count), 0.3 * rng.normal(size=count * n)], axis=1)
    x[:, 1] += np.repeat(np.arange(count), n) * 10
    v = 0.5 * rng.normal(size=x.shape)
    all_pairs = np.vstack([links(n - 1, c * n) for c in range(count)])
    ropes = np.arange(n - 1) % 2 == 0
    every = np.tile(ropes, count)
    held = [tv.Distance(all_pairs[~every]), tv.Rope(all_pairs[every])]
    w = world(tv.Particles(x, velocity=v), held, precision="f64", substeps=1, solver=tv.Direct())
    w.step(1e-3)
    slack = 0
    for c in range(count):
        ours, pairs, found = slice(c * n, (c + 1) * n), links(n - 1), 0
        start, move = x[ours], 1e-3 * v[ours]
        length, now = np.linalg.norm(np.diff(start, axis=0), axis=1), start + move
        for chosen in product([False, True], repeat=4):
            act = ~ropes
            act[ropes] = chosen
            after, lam = dense(now, move, np.ones(n), pairs[act], length[act])
            pulls = np.ones(n - 1)
            pulls[act] = -lam
            r, moved = now[:-1] - now[1:], after - now
            size = np.linalg.norm(r, axis=1)
            linear = size + ((moved[:-1] - moved[1:]) * r).sum(axis=1) / size - length
            if (pulls[ropes] >= 0).all() and (linear[~act] <= 0).all():
                np.testing.assert_allclose(w.position[ours], after, atol=1e-12)
                found, slack = found + 1, slack + int((~act).sum())
        assert found == 1
    assert 0 < slack < 4 * count


@pytest.mark.slow
def test_elimination_and_relaxation_have_the_same_limit(world):
    # A chain from rigid to soft that bends, with dashpots, of unequal masses, is eliminated. A Pin with a spring is not one
    # number, and is relaxed. They share a particle, so many passes must reach the limit of Jacobi alone.
    x, made = np.stack([0.1 * np.arange(5), 0.03 * np.arange(5) ** 2], axis=1), []
    start = tv.Particles(x, mass=1 + np.arange(5.0) % 3, pinned=[0])
    for solver, iterations in ((tv.Direct(), 60), (tv.Jacobi(), 1000)):
        held = tv.Distance(links(4), compliance=[0.0, 1e-6, 0.0, 1e-3], damping=[0.0, 1.0, 0.0, 2.0])
        bend, pin = tv.Bend([(0, 1, 2), (1, 2, 3)], compliance=1e-2), tv.Pin([4], (0.4, 0.5), compliance=1e-4)
        settings = {"precision": "f64", "iterations": iterations, "solver": solver, "substeps": 10}
        w = world(start, [tv.Gravity(9.81), held, bend, pin], **settings)
        w.run(0.3)
        made.append(w)
    np.testing.assert_allclose(made[0].position, made[1].position, atol=1e-7)
    assert re.search("6 constraints by elimination .*1 relaxed as by Jacobi .*not one number", made[0].explain())


def loaded(world, mass, *more, **options):
    """Return a world with a straight rope of 30 links between pins, and a bead in its middle that falls at 3 m/s."""
    x, v, m = np.stack([0.2 * np.arange(31), np.full(31, 2.0)], axis=1), np.zeros((31, 2)), np.full(31, 0.05)
    m[15], v[15, 1] = mass, -3.0
    start = tv.Particles(x, velocity=v, mass=m, pinned=[0, 30])
    return world(start, [tv.Gravity(9.81), tv.Distance(links(30)), *more], **options)


@pytest.mark.slow
@pytest.mark.parametrize("touches", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_plank_on_two_links_is_a_pendulum(world, touches):
    # Links of a parallelogram: the plank shifts without turning, so it moves as a point on one of them does, to rounding, and
    # wherever its center of mass is. One cluster with two rows of the system, which bear unequal loads.
    swing = np.array([np.sin(1.0), -np.cos(1.0)])
    plank = np.array([[0, 0], [1, 0], [0, -0.1], [1, -0.1], [0.3, -0.2]]) + swing
    x, mass = np.concatenate([[[0, 0], [1, 0]], plank, [[9, 0]], [[9, 0] + swing]]), [1, 1, 0.3, 1, 2, 0.1, 5, 1, 1]
    features = [tv.Gravity(9.81), tv.Distance([(0, 2), (1, 3), (7, 8)]), tv.ShapeMatch([range(2, 7)])]
    if touches:
        features.append(tv.Contact())
    w = world(tv.Particles(x, mass=mass, radius=0.01, pinned=[0, 1, 7]), features, substeps=7, precision="f64")
    for _ in range(60):
        assert w.step(1 / 60).clean
    assert np.ptp(w.position[2:7] - plank - (w.position[8] - x[8]), axis=0).max() < 1e-9
    assert w.position[2:7] - plank == pytest.approx(np.tile(w.position[8] - x[8], (5, 1)), abs=1e-9)


@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_linked_bodies_answer_an_impact_as_one(world, dim):
    # Frictionless, at the corner of the first of two bodies that a link joins: of all changes of velocity that keep lengths,
    # J dv = 0, and let the pair part at e times the speed at which it met, the one of least energy,
    #     dv = K n j,    K = W - W J^T (J W J^T)^+ J W,    j = -(1 + e) n.v / (n.K n).
    body = np.stack(np.meshgrid(*[[0.0, 0.5]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    m, e, ball = len(body), 0.5, np.full(dim, 0.3)
    x = np.concatenate([body, body + np.eye(dim)[0], [body[-1] + ball]])
    mass, radius = np.linspace(1, 3, 2 * m + 1), np.zeros(2 * m + 1)
    radius[[m - 1, 2 * m]] = np.linalg.norm(ball) / 2 * (1 - 1e-6)
    v = np.zeros_like(x)
    v[-1] = -np.arange(1.0, dim + 1)
    joint = (m // 2, m)
    bodies = tv.ShapeMatch([range(m), range(m, 2 * m)])
    w = world(
        tv.Particles(x, velocity=v, mass=mass, radius=radius), [tv.Distance([joint]), bodies, tv.Contact(restitution=e)],
        precision="f64", substeps=4,
    )  # fmt: skip
    pairs = [*np.stack(np.triu_indices(m, 1), axis=1), *(np.stack(np.triu_indices(m, 1), axis=1) + m), joint]
    J, W, n = np.zeros((len(pairs), x.size)), np.diag(np.repeat(1 / mass, dim)), np.zeros(x.size)
    for row, (i, j) in zip(J, pairs, strict=True):
        row.reshape(x.shape)[i], row.reshape(x.shape)[j] = x[i] - x[j], x[j] - x[i]
    n.reshape(x.shape)[[-1, m - 1]] = ball / np.linalg.norm(ball), -ball / np.linalg.norm(ball)
    K = W - W @ J.T @ np.linalg.pinv(J @ W @ J.T) @ J @ W
    want = v.ravel() - K @ n * ((1 + e) * (n @ v.ravel()) / (n @ K @ n))
    w.step(1e-4)
    assert w.velocity.ravel() == pytest.approx(want, abs=2e-3)  # |v| turns by v dt / 0.5 m meanwhile
    assert tv.measure.momentum(w) == pytest.approx(mass @ v, abs=1e-9)


def test_a_heavy_ball_hangs_on_a_light_chain(world):
    # Of 500 times the mass of a link: by default its chain is as long as it was. Relaxed beside its cluster, a corner of the ball
    # gave way by a quarter of a link at 20 substeps.
    rope, ball = tv.shapes.rope((0, 2), (2, 2), points=11), tv.shapes.ball((2.4, 2), 0.2)
    nearest = 11 + np.argmin(ball.position[:, 0])
    features = [tv.Gravity(9.81), tv.Distance([*rope.links, (10, nearest)]), tv.ShapeMatch([range(11, 11 + len(ball))])]
    mass = np.repeat([0.1, 50 / len(ball)], [11, len(ball)])
    w = world(tv.Particles(np.concatenate([rope.position, ball.position]), mass=mass, pinned=[0]), features)
    report = w.run(2.0)
    assert report.clean and report.residual < 1e-3


def test_what_gives_way_recovers_at_rest(world):
    # The sag at rest is M g L / (4 T), for the largest tension T that the substep can stand, which grows with 1 / h^2. It falls
    # to a quarter in half the substep.
    w = loaded(world, 5.0, tv.Drag(1.0), substeps=20, precision="f64")
    w.run(15.0)
    sag = 2.0 - w.position[15, 1]
    w.substeps = 40
    w.run(15.0)
    assert 2.0 - w.position[15, 1] == pytest.approx(sag / 4, rel=2e-2)


@pytest.mark.slow
def test_shorter_substeps_never_make_it_worse(world):
    # If the rounding errors of d, x and C were dropped, a double pendulum would be off by 6.5e-6 m at 20 substeps a frame and
    # by 2.5e-3 m at 5120. With them, the error is that of the method, of order h^2, plus about 2^-24 sqrt(frames).
    start, features = CASES["D01_double_pendulum"].build()
    w, want = world(start, features, precision="f32-compensated"), case("D01_double_pendulum")["values"]["t2.0"]["xy"]
    for substeps in (20, 80, 320, 1280, 5120):
        assert rms(rerun(w, 2.0, substeps=substeps).position[1:], want) <= 1.1e-5 * (20 / substeps) ** 2 + 1e-6, substeps


@pytest.mark.parametrize("count, heavy, substeps", [(10, 10.0, 20), (10, 3.0, 20), (20, 10.0, 40)])
def test_a_straight_rope_bears_what_its_substep_can_stand(world, count, heavy, substeps):
    # Links of masses m yield at the tension T of (omega h)^2 = 4 T h^2 / (m l) = 1. Two of them hold M where 2 T sin = M g.
    h, m, length = 1 / 60 / substeps, 0.01, 1 / count
    x, mass = np.linspace((0, 0), (1, 0), count + 1), np.full(count + 1, m)
    mass[count // 2] = heavy
    start = tv.Particles(x, mass=mass, pinned=[0, count])
    features = [tv.Gravity(9.81), tv.Distance(links(count)), tv.Drag(5.0)]
    w = world(start, features, substeps=substeps, precision="f64", solver=tv.Direct())
    energy = [w.step(1 / 60).energy for _ in range(480)]
    assert "softened" in w.last.flags and max(energy) <= 0
    across, down = w.position[count // 2]
    assert np.sin(np.arctan2(-down, across)) == pytest.approx(2 * heavy * 9.81 * h * h / (length * m), rel=0.03)


@pytest.mark.parametrize("substeps", [2, 4, 8, 20])
def test_what_gives_way_brings_in_no_energy_and_bears_again(taichi, substeps):
    # A drawbridge falls into slack ropes, which jerk at a load far above what a substep can stand. At 4 substeps its ropes
    # yield at l m / (4 h^2) = 1770 N, where 1880 N hang on them.
    scene = SCENES["a drawbridge falls into slack ropes"].structure
    with contextlib.closing(Trial(Structure(scene.particles, scene.features, {"substeps": substeps}))) as trial:
        reports = [trial.world.step(1 / 60) for _ in range(600 if substeps < 20 else 180)]
    assert max(r.energy for r in reports) < reports[0].energy - reports[0].energy_change
    assert any("softened" in r.flags for r in reports) == (substeps < 20)
    assert substeps < 8 or reports[-1].residual < 1e-3


@pytest.mark.parametrize("count, substeps", [(21, 4), (41, 20), (81, 20)])
def test_pressure_makes_columns_buckle_and_nothing_vibrate(world, count, substeps):
    # A column of bars and bends under P = 1.03 of Euler's load, pi^2 EI / L^2, and half of its own weight. Its links bear
    # (omega h)^2 up to 5. Elastica: P = (2 K / pi)^2 = 1 + k^2 / 2 + 11 k^4 / 32, deflection k L / K.
    # Hinges of 1 / 20 of L take a percent.
    L, EI = 2.0, 200.0
    load, y, k = 1.03 * np.pi**2 * EI / L**2, np.linspace(0, L, count), np.arange(count)
    mass = np.full(count, L / (count - 1) / 2)
    mass[-1] = load / 9.81
    bends = tv.Bend(np.stack([k[:-2], k[1:-1], k[2:]], axis=1), 0.0, compliance=L / (count - 1) / EI)
    start = tv.Particles(np.stack([1e-3 * np.sin(np.pi * y / L), y], axis=1), mass=mass, pinned=[0])
    features = [tv.Gravity(), tv.Distance(links(count - 1)), bends, tv.Drag(3.0), tv.Path([count - 1], [(0, -1), (0, L + 1)])]
    w = world(start, features, substeps=substeps, precision="f64")
    reports = [w.step(1 / 60) for _ in range(480)]
    assert max(r.energy for r in reports) < reports[0].energy - reports[0].energy_change and w.last.clean
    square = (np.sqrt(0.25 + 4 * 11 / 32 * (0.03 + 9.81 * L / 4 / (load / 1.03))) - 0.5) * 16 / 11
    K = np.pi / 2 * (1 + square / 4 + 9 * square**2 / 64)
    assert np.abs(w.position[:, 0]).max() == pytest.approx(np.sqrt(square) * L / K, rel=0.02)
