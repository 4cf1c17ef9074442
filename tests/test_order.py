"""Substeps of order 4, 6 and 8."""

import re

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case, order, pendulums, rerun, rms

HIGH = (4, 6, 8)


def chain(world, name, **settings):
    x, mass, pairs = pendulums(name)
    features = [tv.Gravity(case(name)["params"]["g"]), tv.Distance(pairs)]
    return world(tv.Particles(x, mass=mass, pinned=[0]), features, **{"precision": "f64", **settings})


def reference(name, t):
    values = case(name)["values"][f"t{t}"]
    xy = np.array(values["xy"])
    return np.array(values.get("nodes_1based", np.arange(len(xy)) + 1)), xy


@pytest.mark.slow
@pytest.mark.parametrize("high", HIGH)
def test_orders_and_the_error_of_a_good_peer(world, high):
    # MuJoCo 4.0 with RK4 in joint coordinates, RMS error of positions: D01 at t = 2 with 60 and 240 steps/s: 2.2e-6, 2.5e-8 m;
    # D05 at t = 0.5 with 60, 240 and 1200 steps/s: 1.4e-3, 2.9e-6, 6.2e-8 m. Here rods are constraints, with at most as many
    # substeps.
    for name, t, rates, peer in (
        ("D01_double_pendulum", 2.0, (30, 60, 120, 240), {60: 2.2e-6, 240: 2.5e-8}),
        ("D05_chain10", 0.5, (120, 240, 480, 1200), {240: 2.9e-6, 1200: 6.2e-8}),
    ):
        w, (at, want) = chain(world, name, order=high), reference(name, t)
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
    for high in HIGH:
        w = world(start, [tv.Force(pull), tv.Distance([(1, 2)])], precision="f64", order=high)
        errors, across = [], []
        for n in (100, 200, 400):
            w.velocity, w.position, w.substeps = [(0, np.sqrt(3.0), 0), (0, 0, 0), (0, 0, speed)], start.position, n
            w.run(2 * np.pi, dt=2 * np.pi)
            errors.append(np.abs(w.velocity[0] - [0, np.sqrt(3.0), 0]).max())
            across.append(abs(w.velocity[2] @ (w.position[2] - [9, 0, 0])))
        assert order(errors[: 2 if high == 8 else 3]) > high - 0.5, errors
        assert max(across) < 1e-9 and np.linalg.norm(w.velocity[2]) == pytest.approx(speed, rel=1e-7)


def test_springs_follow_a_moving_rest_value(world):
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
def test_springs_are_forces(world):
    # A chain of soft and rigid links converges with order 6 to the limit of order 2. A mass below its spring of length l:
    # l = 1 + g / k + (1 - g / k) cos(omega t), with omega^2 = k = 400.
    k = np.arange(6)
    x = np.concatenate([np.stack([0.3 * np.arange(7), 0.0 * np.arange(7)], axis=1), [(0, 5), (0, 3)]])
    pairs = np.vstack([np.stack([k, k + 1], axis=1), [(7, 8)]])
    compliance = np.array([1e-3, 2e-3, 0, 0, 5e-3, 1e-3, 1 / 400])
    rest = np.array([0.3] * 6 + [1.0])

    def build(**settings):
        links = tv.Distance(pairs, rest, compliance=compliance)
        return world(tv.Particles(x, pinned=[0, 7]), [tv.Gravity(9.81), links], precision="f64", solver=tv.Direct(), **settings)

    best = rerun(build(order=8), 1.0, dt=1.0, substeps=600).position
    sag = 9.81 / 400
    assert 5 - best[8, 1] == pytest.approx(1 + sag + (1 - sag) * np.cos(20.0), abs=1e-11)
    w = build(order=6)
    assert order([rms(rerun(w, 1.0, dt=1.0, substeps=n).position, best) for n in (80, 160, 320)]) > 5.5
    plain = build()
    errors = [rms(rerun(plain, 1.0, dt=1.0, substeps=n).position, best) for n in (1000, 2000)]
    assert 3.5 < errors[0] / errors[1] < 4.5 and errors[1] < 1e-3
    assert "stiff-force" in rerun(w, 1.0, dt=1.0, substeps=8).last.flags


def test_motion_can_be_turned_round(world):
    # A composition of reversible stages is reversible: it returns to the start to rounding, whatever the error was in between.
    w = chain(world, "D05_chain10", order=4)
    start = w.particles.position
    w.substeps = 50
    w.run(0.5, dt=0.1)
    w.velocity = -w.velocity
    w.run(0.5, dt=0.1)
    np.testing.assert_allclose(w.position, start, atol=1e-9)


def test_energy_neither_grows_nor_falls(world):
    # Symplectic: over 200 s the energy error stays within four times that of the first ten seconds.
    w = chain(world, "D02_double_pendulum_low", order=4, substeps=5)
    p = case("D02_double_pendulum_low")["params"]

    def energy():
        mass = w.particles.mass
        return (0.5 * mass[:, None] * w.velocity**2).sum() + p["g"] * (mass[1:] * w.position[1:, 1]).sum()

    start, seen = energy(), []
    for _ in range(200):
        w.run(1.0, dt=1 / 10)
        seen.append(abs(energy() - start))
    assert max(seen) < 4 * max(seen[:10]) + 1e-10 and max(seen) < 1e-5


def test_another_length_of_substep_keeps_the_order(world):
    name, t = "D01_double_pendulum", 2.0
    w, (at, want) = chain(world, name, order=4), reference(name, t)
    errors = []
    for n in (1, 2, 4):
        rerun(w, 0.5, dt=0.5, substeps=20 * n)
        w.substeps = 7 * n
        w.run(1.5, dt=0.25)
        errors.append(rms(w.position[at], want))
    assert order(errors) > 3.5, errors
    w.substeps = "auto"
    w.run(0.1)
    copy = w.clone()
    assert copy.order == 4 and copy.hash() == w.hash() and "order 4, 5 stages" in copy.explain()
    copy.close()


@pytest.mark.parametrize(
    "feature, why",
    [
        (tv.Drag(1.0), "depends on velocities"),
        (tv.Wind((1, 0), 1.0), "depends on velocities"),
        (tv.Contact(), "one-sided"),
        (tv.HalfSpace((0, 1), 0.0), "one-sided"),
        (tv.Rope([(0, 1)]), "one-sided"),
        (tv.Distance([(0, 1)], compliance=1e-3, damping=1.0), "damping"),
        (tv.Distance([(0, 1)], break_at=1.0), "can break"),
        (tv.ShapeMatch([[0, 1, 2]]), "not one number"),
        (tv.Area([[0, 1, 2, 3]]), "any number of corners"),
    ],
)
def test_what_has_no_such_order_is_refused(feature, why):
    particles = tv.Particles([(0, 0), (1, 0), (0, 1), (1, 1)], radius=0.1)
    with pytest.raises(ValueError, match=re.escape(f"order = 4, but {feature!r} ") + f".*{why}"):
        tv.World(particles, [feature], precision="f64", order=4)


def test_settings_without_such_an_order_are_refused():
    particles = tv.Particles(np.random.default_rng(0).normal(size=(30, 3)))
    with pytest.raises(ValueError, match="order = 3, but it must be one of 2, 4, 6, 8"):
        tv.World(particles, order=3)
    with pytest.raises(ValueError, match='precision="f64"'):
        tv.World(particles, order=4)
    with pytest.raises(ValueError, match="one thread only"):
        tv.World(particles, precision="f64", path="parallel", order=4)
    i, j = np.triu_indices(30, 1)
    for solver in (None, tv.Jacobi()):  # every particle is linked with every other
        with pytest.raises(ValueError, match="relaxes Distance .435 of them"):
            tv.World(particles, [tv.Distance(np.stack([i, j], 1))], precision="f64", solver=solver, order=4)


def test_springs_that_turn_far_in_a_stage_are_told_of(world):
    # Springs of 1e6 N/m between all of seven particles, stretched to twice their length: the particles fly through each other at
    # some 1000 m/s, which no substep of 0.8 ms resolves, and gain energy. A spring that turns by 0.01 of a turn sets no flag, nor
    # does a spring of length 0, whose force is linear, when it passes through its other end.
    crowd, two = 0.7 * tv.golden(range(7), dim=2), [(0, 0), (1, 0)]
    every = np.stack(np.triu_indices(7, 1), axis=1)
    wild, swing, through = (
        world(tv.Particles(x, pinned=[0]), [tv.Distance(pairs, rest, compliance=soft)], precision="f64", order=6, substeps=20)
        for x, pairs, rest, soft in ((crowd, every, 0.3, 1e-6), (two, [(0, 1)], 0.5, 1e-3), (two, [(0, 1)], 0.0, 1e-3))
    )
    assert "turned" in wild.step(1 / 60).flags
    for w in (swing, through):
        assert not any("turned" in w.step(1 / 60).flags for _ in range(20))
