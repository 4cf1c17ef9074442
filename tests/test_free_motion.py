"""Motion without constraints, against closed forms."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case


def test_wind_is_exact_and_the_rates_of_drags_add_up(world):
    # Wind u: drag relative to the air. x' = u + (v0 - u) exp(-k t).
    u, k, t, v0 = np.array([3.0, -1.0]), 2.5, 1.25, np.array([10.0, 15.0])
    start = tv.Particles([[0, 0]], velocity=v0)
    w = world(start, [tv.Wind(u, 1.5), tv.Wind(u, 0.75), tv.Drag(0.25)], substeps=2, precision="f64")
    mean = u * 2.25 / 2.5
    w.run(t, dt=t / 10)
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


def test_users_forces_keep_all_digits(world):
    @ti.func
    def push(x, v, t):
        return ti.Vector([0.1, 0.3 * t])

    # m x'' = (0.1, 0.3 t): x = 0.05 t^2 / m, exactly, as literals have all digits; y = 0.05 t^3 / m to second order.
    w = world(tv.Particles([[0.0, 0.0]], mass=2.0), [tv.Force(push)], substeps=4, precision="f64")
    w.run(1.0, dt=0.25)
    assert w.position[0, 0] == pytest.approx(0.025, rel=1e-14)
    assert w.position[0, 1] == pytest.approx(0.025, rel=1e-2)
