"""Orders 2, 4, 6 and 8 of links: errors against references, and no loss of energy. See test_cases.py for the default."""

import re
from itertools import product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.report import CASES

from .conftest import case, figures, order, rerun, rms

FRAME = 1 / 60
DOUBLE, CHAIN = "D01_double_pendulum", "D05_chain10"


def hang(world, name, **settings):
    """Return a world with the scene of a case; test_cases.py tests the order and the error of each with the defaults."""
    particles, features = CASES[name].build()
    return world(particles, features, **{"precision": "f64", **settings})


def reference(name, t):
    """Return the particles whose places are known at t [s], and these places."""
    values = case(name)["values"][f"t{t}"]
    xy = np.array(values["xy"])
    return np.array(values.get("nodes_1based", np.arange(len(xy)) + 1)), xy


@pytest.mark.parametrize("change", [0, 1 / 4], ids=["even", "in turns"])
def test_passes_are_second_order_where_the_substep_changes_too(world, change):
    # Jacobi with enough passes, beside an elimination in test_cases.py; in each second frame the substep is shorter by a fifth.
    (at, want), w, errors = reference(DOUBLE, 2.0), hang(world, DOUBLE, solver=tv.Jacobi(), iterations=30), []
    for n in (20, 40, 80):
        w.velocity, w.position = w.particles.velocity, w.particles.position
        for k in range(120):
            w.substeps = n + int(k % 2 * n * change)
            w.step(FRAME)
        errors.append(rms(w.position[at], want))
    assert 1.85 <= order(errors) <= 2.15 and errors[0] <= figures(DOUBLE, 2.0, 20)["SHAKE-direct"]


def test_velocities_of_a_spring_are_second_order(world):
    # An elastic pendulum that swings: what is read has the pull of the spring up to the time of the positions.
    w, want = hang(world, "S04_spring_pendulum"), case("S04_spring_pendulum")["values"]["t5.0"]["v"]
    speeds = [rms(rerun(w, 5.0, substeps=n).velocity[1], want) for n in (20, 40, 80)]
    assert 1.9 <= order(speeds) <= 2.1


def test_a_free_rod_spins_for_ever(world):
    # With PBD's direction, 60 % of the spin would be lost in these times.
    x, across = np.array([[0.25, 0, 0], [-0.75, 0, 0]]), np.array([[0, 0.25, 0], [0, -0.75, 0]])
    w = world(tv.Particles(x, mass=[3.0, 1.0]), [tv.Distance([[0, 1]])], substeps=1, precision="f64", solver=tv.Jacobi())

    def angle(h):
        """Return by how much the rod turns in the next substep."""
        (a, b), _ = np.diff(w.position, axis=0)[0, :2], w.step(h)
        c, d = np.diff(w.position, axis=0)[0, :2]
        return np.arctan2(a * d - b * c, a * c + b * d)

    for (omega, h), iterations in product([(50.0, 1e-3), (100.0, 1 / 1200)], (1, 3)):
        w.iterations = iterations
        w.velocity, w.position = omega * across, x
        w.run(10 * h, dt=h)
        first, _, last = angle(h), w.run(1.0, dt=h), angle(h)
        assert abs(last / first - 1) <= 1e-12
        if iterations > 1:
            assert first == pytest.approx(np.arcsin(omega * h), rel=1e-12)  # the known angle of a tangential start
        # One pass leaves a constant (omega h)^6 / 2 of the length.
        assert abs(tv.measure.strain(w, [[0, 1]], [1.0])[0]) <= (1e-14 if iterations > 1 else 0.51 * (omega * h) ** 6)
        assert not w.last.flags


@pytest.mark.slow
@pytest.mark.parametrize("high", (4, 6, 8))
def test_orders_and_the_error_of_a_good_peer(world, high):
    # MuJoCo 4.0 with RK4 in joint coordinates, RMS error of positions: D01 at t = 2 with 60 and 240 steps/s: 2.2e-6, 2.5e-8 m;
    # D05 at t = 0.5 with 60, 240 and 1200 steps/s: 1.4e-3, 2.9e-6, 6.2e-8 m. Here rods are constraints, with at most as many
    # substeps.
    for name, t, rates, peer in (
        (DOUBLE, 2.0, (30, 60, 120, 240), {60: 2.2e-6, 240: 2.5e-8}),
        (CHAIN, 0.5, (120, 240, 480, 1200), {240: 2.9e-6, 1200: 6.2e-8}),
    ):
        w, (at, want) = hang(world, name, order=high), reference(name, t)
        errors = np.array([rms(rerun(w, t, dt=t, substeps=round(n * t)).position[at], want) for n in rates])
        assert all(errors[rates.index(n)] < limit for n, limit in peer.items()), errors
        clear = errors[errors > 1e-11][:3]  # errors that are above rounding
        assert len(clear) < 2 or order(clear) > high - 0.5, errors
        assert w.last.clean and w.last.residual < 1e-12
        w.close()


@pytest.mark.slow
def test_velocities_have_the_order_too(world):
    # A Kepler ellipse, e = 0.5, from its pericentre: it returns after T = 2 pi with the velocity (0, sqrt(3)). And a conical
    # pendulum, whose rod has to remove the velocity along it: v stays at right angles to the rod, and as fast as at the start.
    tilt, g = 0.7, 9.81

    @ti.func
    def pull(x):
        out = ti.Vector([0.0, -g, 0.0])
        if x[0] < 5.0:
            out = -x / x.norm() ** 3
        return out

    speed = np.sqrt(g / np.cos(tilt)) * np.sin(tilt)
    start = tv.Particles([(0.5, 0, 0), (9, 0, 0), (9 + np.sin(tilt), -np.cos(tilt), 0)], pinned=[1])
    w = world(start, [tv.Force(pull), tv.Distance([(1, 2)])], precision="f64", order=6)
    errors, across = [], []
    for n in (100, 200, 400):
        w.velocity, w.position, w.substeps = [(0, np.sqrt(3.0), 0), (0, 0, 0), (0, 0, speed)], start.position, n
        w.run(2 * np.pi, dt=2 * np.pi)
        errors.append(np.abs(w.velocity[0] - [0, np.sqrt(3.0), 0]).max())
        across.append(abs(w.velocity[2] @ (w.position[2] - [9, 0, 0])))
    assert order(errors) > 5.5, errors
    assert max(across) < 1e-9 and np.linalg.norm(w.velocity[2]) == pytest.approx(speed, rel=1e-7)


@pytest.mark.slow
def test_high_orders_of_springs(world):
    # A mass on a spring, omega^2 = 400, whose rest length begins to grow evenly, by u t: its length is
    # l_0 + u t - u sin(omega t) / omega. Without rigid links no pass is taken, which would move the rest length.
    spring = tv.Distance([[0, 1]], 1.0, compliance=1 / 400)
    start, dt, errors = tv.Particles([[0.0, 0], [1.0, 0]], pinned=[0]), 0.1, []
    w = world(start, [tv.Gravity(0.0), spring], precision="f64", order=4)
    for w.substeps in (2, 4, 8):
        w.position, w.velocity, spring.rest = start.position, 0 * start.position, 1.0
        w.step(dt)
        spring.rest = 1.3
        w.step(dt)
        errors.append(abs(w.position[1, 0] - (1.3 - 3.0 * np.sin(20 * dt) / 20)))
    assert order(errors) > 3.7 and errors[-1] < 1e-5, errors


@pytest.mark.slow
def test_order_4_is_reversible_keeps_its_energy_and_its_order_where_substeps_change(world):
    # A composition of reversible stages is reversible: it returns to the start to rounding, whatever the error was in between.
    w = hang(world, CHAIN, order=4, substeps=50)
    start = w.particles.position
    w.run(0.5, dt=0.1)
    w.velocity = -w.velocity
    w.run(0.5, dt=0.1)
    np.testing.assert_allclose(w.position, start, atol=1e-9)

    # Symplectic: over 200 s the energy error stays within four times that of the first ten seconds.
    w = hang(world, "D02_double_pendulum_low", order=4, substeps=5)
    mass, g = w.particles.mass, case("D02_double_pendulum_low")["params"]["g"]

    def energy():
        return (0.5 * mass[:, None] * w.velocity**2).sum() + g * (mass[1:] * w.position[1:, 1]).sum()

    begin, seen = energy(), []
    for _ in range(200):
        w.run(1.0, dt=1 / 10)
        seen.append(abs(energy() - begin))
    assert max(seen) < 4 * max(seen[:10]) + 1e-10 and max(seen) < 1e-5

    w, (at, want) = hang(world, DOUBLE, order=4), reference(DOUBLE, 2.0)
    errors = []
    for n in (1, 2, 4):
        rerun(w, 0.5, dt=0.5, substeps=20 * n)
        w.substeps = 7 * n
        w.run(1.5, dt=0.25)
        errors.append(rms(w.position[at], want))
    assert order(errors) > 3.5, errors
    assert "order 4, 5 stages" in w.explain()


def test_what_has_no_high_order_is_refused():
    four = tv.Particles([(0, 0), (1, 0), (0, 1), (1, 1)], radius=0.1)
    for feature, why in (
        (tv.Drag(1.0), "depends on velocities"),
        (tv.Wind((1, 0), 1.0), "depends on velocities"),
        (tv.Contact(), "one-sided"),
        (tv.HalfSpace((0, 1), 0.0), "one-sided"),
        (tv.Rope([(0, 1)]), "one-sided"),
        (tv.Distance([(0, 1)], compliance=1e-3, damping=1.0), "damping"),
        (tv.Distance([(0, 1)], break_at=1.0), "can break"),
        (tv.ShapeMatch([[0, 1, 2]]), "not one number"),
        (tv.Area([[0, 1, 2, 3]]), "any number of corners"),
        (tv.Motor([[0, 1, 2]], 1.0), "moves on its own"),
    ):
        with pytest.raises(ValueError, match=re.escape(f"order = 4, but {feature!r} ") + f".*{why}"):
            tv.World(four, [feature], precision="f64", order=4)
    many = tv.Particles(np.random.default_rng(0).normal(size=(30, 3)))
    every = [tv.Distance(np.stack(np.triu_indices(30, 1), 1))]
    for features, settings, why in (
        ([], {"order": 3}, "order = 3, but it must be one of 2, 4, 6, 8"),
        ([], {"order": 4, "precision": "f32"}, 'precision="f64"'),
        ([], {"order": 4, "path": "parallel"}, "one thread only"),
        (every, {"order": 4}, "relaxes Distance .435 of them"),  # every particle is linked with every other
        (every, {"order": 4, "solver": tv.Jacobi()}, "relaxes Distance .435 of them"),
    ):
        with pytest.raises(ValueError, match=why):
            tv.World(many, features, **{"precision": "f64", **settings})
