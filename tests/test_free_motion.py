"""Motion without constraints, against closed forms."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case, order, rerun


def test_projectile(world):
    p, want = case("R02_projectile")["params"], case("R02_projectile")["values"]
    e, a = np.radians(p["elevation_deg"]), np.radians(p["azimuth_deg"])
    v = p["speed"] * np.array([np.cos(e) * np.cos(a), np.sin(e), np.cos(e) * np.sin(a)])
    w = world(
        tv.Particles([[0, p["y0"], 0]], velocity=v),
        [tv.Gravity((0, -p["g"], 0))],
        substeps=7,
        precision="f64",
    )
    for _ in range(20):
        w.step(want["t_flight"] / 20)
    np.testing.assert_allclose(w.position[0], [want["x_end"], 0, want["z_end"]], atol=1e-11)
    assert np.linalg.norm(w.velocity[0]) == pytest.approx(want["impact_speed"], rel=1e-12)
    w = world(tv.Particles([[0, p["y0"], 0]], velocity=v), [tv.Gravity(p["g"])], substeps=3, precision="f64")
    w.run(want["t_apex"], dt=want["t_apex"])
    assert w.position[0, 1] == pytest.approx(want["apex_height"], rel=1e-13)


def test_linear_drag_is_exact_and_wind_carries(world):
    p, want = case("R03_linear_drag")["params"], case("R03_linear_drag")["values"]
    start = tv.Particles([[0, 0]], velocity=(p["vx0"], p["vy0"]))
    w = world(start, [tv.Gravity(p["g"]), tv.Drag(p["k"])], substeps=3, precision="f64")
    w.run(p["T"])
    np.testing.assert_allclose(w.position[0], [want["x"], want["y"]], atol=1e-11)
    np.testing.assert_allclose(w.velocity[0], [want["vx"], want["vy"]], atol=1e-11)
    # Wind u: drag relative to the air. x' = u + (v0 - u) exp(-k t); the rates of several drags add up.
    u, k, t = np.array([3.0, -1.0]), 2.5, 1.25
    w = world(start, [tv.Wind(u, 1.5), tv.Wind(u, 0.75), tv.Drag(0.25)], substeps=2, precision="f64")
    mean = u * 2.25 / 2.5
    w.run(t, dt=t / 10)
    v0 = np.array([p["vx0"], p["vy0"]])
    np.testing.assert_allclose(w.velocity[0], mean + (v0 - mean) * np.exp(-k * t), atol=1e-11)
    np.testing.assert_allclose(w.position[0], mean * t + (v0 - mean) * (1 - np.exp(-k * t)) / k, atol=1e-11)


def test_velocity_reads_back_as_it_was_set(world):
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    w = world(tv.Particles(x), [tv.Gravity(9.81)], precision="f64")
    w.step(0.01)
    w.velocity = v
    np.testing.assert_array_equal(w.velocity, v)
    w.position = x
    np.testing.assert_array_equal(w.position, x)
    np.testing.assert_array_equal(w.velocity, v)
    with pytest.raises(ValueError, match="read-only"):
        w.position[0] = 0.0


def test_changing_steps_gravity_and_drag_stay_exact(world):
    # A piecewise constant acceleration and rate, and random frames: exact, since every change restarts from the velocity.
    # v' = a - k v: v = a / k + (v0 - a / k) exp(-k t).
    rng = np.random.default_rng(1)
    gravity, drag = tv.Gravity(9.81), tv.Drag(0.5)
    x = np.array([[1.0, 2.0]])
    free = world(tv.Particles(x, velocity=(3, 4)), [gravity], substeps=4, precision="f64")
    braked = world(tv.Particles(x, velocity=(3, 4)), [gravity.copy(), drag], substeps=4, precision="f64")
    a, time = np.array([0, -9.81]), 0.0
    state = {free: (x[0], np.array([3.0, 4.0])), braked: (x[0], np.array([3.0, 4.0]))}
    for k in range(100):
        dt = rng.uniform(1e-3, 0.1)
        substeps, time = int(rng.integers(1, 9)), time + dt
        if k % 10 == 9:
            a = rng.normal(size=2) * 10
            gravity.g = braked.features[0].g = a
            drag.rate = rng.uniform(0.1, 3)
        for w, (x, v) in state.items():
            w.substeps = substeps
            w.step(dt)
            rate = drag.rate if w is braked else 0
            if rate:
                mean, left = a / rate, np.exp(-rate * dt)
                x, v = x + mean * dt + (v - mean) * (1 - left) / rate, mean + (v - mean) * left
            else:
                x, v = x + v * dt + a * dt**2 / 2, v + a * dt
            state[w] = x, v
            np.testing.assert_allclose(w.position[0], x, atol=1e-10)
            np.testing.assert_allclose(w.velocity[0], v, atol=1e-10)
            assert w.time == pytest.approx(time, rel=1e-15)


def test_f32_keeps_six_digits(world):
    # The golden dither: without it, rounding d += g h^2 to one side costs 5e-6 in a fall.
    p = case("R01_free_fall_dt0.001")["params"]
    heights = np.array([0.0, 1.0, 3.3, 10.0])
    start = np.stack([np.zeros(4), heights], axis=1)
    w = world(tv.Particles(start, velocity=(0, p["v0"])), [tv.Gravity(p["g"])], substeps=20)
    w.run(2.0)
    drop = p["v0"] * 2.0 - p["g"] * 2.0**2 / 2
    assert np.abs(w.position[:, 1] - heights - drop).max() <= 2e-6 * abs(drop)
    assert not w.last.flags
    # x + d with a constant d rounds the same way each time: without the dither, up to h / (2 d) ulp(x) = 1.5e-4 of the way.
    v = np.array([0.5, 0.3, -0.7, 0.123])
    start = np.stack([np.full(4, 1.1), np.full(4, -3.0)], axis=1)
    w = world(tv.Particles(start, velocity=np.stack([v, -v], axis=1)))
    w.run(5.0)
    np.testing.assert_allclose(w.position - start, 5 * np.stack([v, -v], axis=1), rtol=2e-6)
    w = world(tv.Particles([[0.0, 5.0]]), [tv.Gravity(9.81), tv.Drag(20.0)])
    w.run(4.0)
    np.testing.assert_allclose(5.0 - w.position[0, 1], 9.81 / 20 * (4 - (1 - np.exp(-80)) / 20), rtol=2e-6)


def test_users_forces_oscillate_as_verlet_does_and_keep_all_digits(world):
    # x_n = x0 cos(n phi), the closed form of the discrete oscillator with half a kick at the start.
    k = case("R04_oscillator_k100_dt0.1")["params"]["k"]

    @ti.func
    def spring(x):
        return -k * x

    for dt in ("0.01", "0.1"):
        p, want = case(f"R04_oscillator_k100_dt{dt}")["params"], case(f"R04_oscillator_k100_dt{dt}")["values"]
        w = world(tv.Particles([[p["x0"], 0.0]]), [tv.Force(spring)], substeps=round(0.1 / p["dt"]), precision="f64")
        w.run(p["T"], dt=0.1)
        assert abs(w.position[0, 0] - want["x_verlet_T"]) <= 1e-9
        assert not w.last.flags

    @ti.func
    def push(x, v, t):
        return ti.Vector([0.1, 0.3 * t])

    # m x'' = (0.1, 0.3 t): x = 0.05 t^2 / m, exactly, as literals have all digits; y = 0.05 t^3 / m to second order.
    w = world(tv.Particles([[0.0, 0.0]], mass=2.0), [tv.Force(push)], substeps=4, precision="f64")
    w.run(1.0, dt=0.25)
    assert w.position[0, 0] == pytest.approx(0.025, rel=1e-14)
    assert w.position[0, 1] == pytest.approx(0.025, rel=1e-2)


def test_kepler_orbits_are_second_order_and_keep_their_energy(world):
    states, orbits = case("R09_kepler")["values"]["states"], ("e0", "e0.5")
    s, ends = ([states[f"{e}_{t}"] for e in orbits] for t in ("start", "t10"))
    start = tv.Particles([(k["x"], k["y"]) for k in s], velocity=[(k["vx"], k["vy"]) for k in s])
    w = world(start, [tv.Attractor((0, 0), 1.0)], precision="f64")
    want, errors = [(k["x"], k["y"]) for k in ends], []
    for substeps in (10, 20, 40):
        rerun(w, 10.0, dt=0.1, substeps=substeps)
        errors.append(np.linalg.norm(w.position - want, axis=1))
    assert all(1.9 <= order(each) <= 2.1 for each in np.transpose(errors))
    assert w.last.energy == pytest.approx(-1.0, abs=2e-5)  # -1 / 2 for each
    assert tv.measure.angular_momentum(w)[0] == pytest.approx(sum(k["x"] * k["vy"] for k in s), abs=1e-6)
