"""Motion without constraints, against closed forms."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case, order, rerun


@pytest.mark.parametrize("name", ["R01_free_fall_dt0.01", "R01_free_fall_dt0.001"])
@pytest.mark.parametrize("dim", [2, 3])
def test_free_fall_is_exact_for_any_step(world, name, dim):
    # y = y0 + v0 t - g t^2 / 2 at every step of position Verlet, with half a kick at the start.
    p, want = case(name)["params"], case(name)["values"]
    w = world(
        tv.Particles([[0, p["y0"], 0][:dim]], velocity=[0, p["v0"], 0][:dim]),
        [tv.Gravity(p["g"])],
        substeps=1,
        precision="f64",
    )
    for _ in range(p["steps"]):
        w.step(p["dt"])
    t = p["steps"] * p["dt"]
    y = p["y0"] + p["v0"] * t - p["g"] * t * t / 2
    assert abs(w.position[0, 1] - y) <= 1e-12 * p["steps"]
    assert abs(w.velocity[0, 1] - (p["v0"] - p["g"] * t)) <= 1e-11 * p["steps"]
    if p["dt"] == 0.01:
        assert abs(w.position[0, 1] - want["y_exact"]) <= 1e-12 * p["steps"]
    assert w.time == pytest.approx(t, rel=1e-15)


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


def test_changing_steps_and_gravity_stay_exact(world):
    # A piecewise constant acceleration and random frames: exact, since every change restarts from the velocity.
    rng = np.random.default_rng(1)
    gravity = tv.Gravity(9.81)
    w = world(tv.Particles([[1.0, 2.0]], velocity=(3, 4)), [gravity], substeps=4, precision="f64")
    x, v, a = np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([0, -9.81])
    for k in range(100):
        dt = rng.uniform(1e-3, 0.1)
        if k % 10 == 9:
            a = rng.normal(size=2) * 10
            gravity.g = a
        w.substeps = int(rng.integers(1, 9))
        w.step(dt)
        x, v = x + v * dt + a * dt**2 / 2, v + a * dt
        np.testing.assert_allclose(w.position[0], x, atol=1e-10)
        np.testing.assert_allclose(w.velocity[0], v, atol=1e-10)


def test_f32_free_fall_keeps_six_digits(world):
    # The golden dither: without it, rounding d += g h^2 to one side costs 5e-6 here.
    p = case("R01_free_fall_dt0.001")["params"]
    heights = np.array([0.0, 1.0, 3.3, 10.0])
    start = np.stack([np.zeros(4), heights], axis=1)
    w = world(tv.Particles(start, velocity=(0, p["v0"])), [tv.Gravity(p["g"])], substeps=20)
    w.run(2.0)
    drop = p["v0"] * 2.0 - p["g"] * 2.0**2 / 2
    assert np.abs(w.position[:, 1] - heights - drop).max() <= 2e-6 * abs(drop)
    assert not w.last.flags


def test_f32_keeps_uniform_motion_and_terminal_velocity(world):
    # x + d with a constant d rounds the same way each time: without the dither, up to h / (2 d) ulp(x) = 1.5e-4 of the way.
    v = np.array([0.5, 0.3, -0.7, 0.123])
    start = np.stack([np.full(4, 1.1), np.full(4, -3.0)], axis=1)
    w = world(tv.Particles(start, velocity=np.stack([v, -v], axis=1)))
    w.run(5.0)
    np.testing.assert_allclose(w.position - start, 5 * np.stack([v, -v], axis=1), rtol=2e-6)
    w = world(tv.Particles([[0.0, 5.0]]), [tv.Gravity(9.81), tv.Drag(20.0)])
    w.run(4.0)
    np.testing.assert_allclose(5.0 - w.position[0, 1], 9.81 / 20 * (4 - (1 - np.exp(-80)) / 20), rtol=2e-6)


def test_f32_compensated_falls_far_from_the_origin_in_tiny_steps(world):
    w = world(
        tv.Particles([[0.0, 1000.0], [-1000.0, 1000.0]]),
        [tv.Gravity(9.81)],
        substeps=100,
        precision="f32-compensated",
    )
    w.run(1.0, dt=0.01)  # h = 1e-4
    drop = 9.81 / 2
    assert np.abs(w.position[:, 1] - 1000 + drop).max() <= 1e-6 * drop  # 1e-3 is required
    assert w.position[1, 0] == -1000.0


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


@pytest.mark.parametrize("precision, limit", [("f32", 1e-6), ("f32-compensated", 1e-6), ("f64", 1e-12)])
def test_velocities_under_any_drag(world, precision, limit):
    # v = -g (1 - exp(-k t)) / k, also where exp(k h) exceeds f32, and after a change of dt.
    drag, h = tv.Drag(0.0), 1e-3
    w = world(tv.Particles([[0.0, 0.0]]), [tv.Gravity(9.81), drag], substeps=1, precision=precision)
    for z in (1e-6, 1e-3, 0.5, 20, 90, 250, 1e4):
        w.velocity, w.position, drag.rate = np.zeros((1, 2)), np.zeros((1, 2)), z / h
        t = 0.0
        for dt in (h, h, h / 2, h):
            w.step(dt)
            t += dt
            assert w.velocity[0, 1] == pytest.approx(9.81 * np.expm1(-z / h * t) * h / z, rel=limit)


def test_knobs_are_live_and_rates_may_change(world):
    drag = tv.Drag(0.0)
    w = world(tv.Particles([[0.0, 0.0]], velocity=(1, 0)), [drag], substeps=5, precision="f64")
    w.step(1.0)
    drag.rate = 2.0
    w.step(1.0)
    assert w.position[0, 0] == pytest.approx(1 + (1 - np.exp(-2)) / 2, rel=1e-12)
    assert w.velocity[0, 0] == pytest.approx(np.exp(-2), rel=1e-12)


@pytest.mark.parametrize("name", ["R04_oscillator_k100_dt0.01", "R04_oscillator_k100_dt0.1", "R04_oscillator_k10000_dt0.001"])
def test_a_users_force_oscillates_as_verlet_does(world, name):
    # x_n = x0 cos(n phi), the closed form of the discrete oscillator with half a kick at the start.
    p, want = case(name)["params"], case(name)["values"]
    k = p["k"]

    @ti.func
    def spring(x):
        return -k * x

    w = world(tv.Particles([[p["x0"], 0.0]]), [tv.Force(spring)], substeps=round(0.1 / p["dt"]), precision="f64")
    w.run(p["T"], dt=0.1)
    assert abs(w.position[0, 0] - want["x_verlet_T"]) <= 1e-9
    assert not w.last.flags


def test_literals_of_a_users_force_keep_all_digits_in_f64(world):
    @ti.func
    def push(x, v, t):
        return ti.Vector([0.1, 0.3 * t])

    # m x'' = (0.1, 0.3 t): x = 0.05 t^2 / m, exactly; y = 0.05 t^3 / m to second order.
    for path in ("auto", "launched"):
        w = world(tv.Particles([[0.0, 0.0]], mass=2.0), [tv.Force(push)], substeps=4, precision="f64", path=path)
        w.run(1.0, dt=0.25)
        assert w.position[0, 0] == pytest.approx(0.025, rel=1e-14)
        assert w.position[0, 1] == pytest.approx(0.025, rel=1e-2)


def test_forces_that_read_velocities_are_second_order(world):
    # A charge in a magnetic field, v' = omega J v, moves on a circle. With the user's own drag the error is of order 2.
    @ti.func
    def lorentz(x, v):
        return ti.Vector([3.0 * v[1], -3.0 * v[0]]) - 0.5 * v

    t, a = 2.0, -0.5 - 3.0j
    exact = (np.exp(a * t) - 1) / a  # z' = a z, z'(0) = 1, z = x + i y
    errors = []
    w = world(tv.Particles([[0.0, 0.0]], velocity=(1, 0)), [tv.Force(lorentz)], precision="f64")
    for substeps in (4, 8, 16, 32):
        rerun(w, t, dt=1 / 16, substeps=substeps)
        errors.append(abs(complex(*w.position[0]) - exact))
    assert 1.9 <= order(errors) <= 2.1 and errors[-1] < 2e-5


@pytest.mark.parametrize("e", ["e0", "e0.5"])
def test_kepler_orbits_are_second_order_and_keep_their_energy(world, e):
    states = case("R09_kepler")["values"]["states"]
    s, want = states[f"{e}_start"], states[f"{e}_t10"]
    errors = []
    for substeps in (10, 20, 40):
        w = world(
            tv.Particles([[s["x"], s["y"]]], velocity=(s["vx"], s["vy"])), [tv.Attractor((0, 0), 1.0)], substeps=substeps,
            precision="f64",
        )  # fmt: skip
        w.run(10.0, dt=0.1)
        errors.append(np.hypot(*(w.position[0] - [want["x"], want["y"]])))
    assert 1.9 <= order(errors) <= 2.1
    assert w.last.energy == pytest.approx(-0.5, abs=2e-5)
    assert tv.measure.angular_momentum(w)[0] == pytest.approx(s["x"] * s["vy"], abs=1e-6)


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
