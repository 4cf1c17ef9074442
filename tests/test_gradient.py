"""Derivatives by copies of a world, against closed forms."""

import numpy as np
import pytest

import tiverlet as tv

G = 9.81


def thrown(speed=7.0, angle=0.6, precision="f64"):
    velocity = (speed * np.cos(angle), speed * np.sin(angle))
    return tv.World(tv.Particles([[0.0, 0.0]], velocity=velocity), [tv.Gravity(G)], precision=precision, substeps=4)


def landing(worlds):
    # Verlet is exact for a parabola, so a parabola fitted to the track gives the landing place.
    track = worlds.rollout(0.9)
    t, (x, y) = track.time[0], np.moveaxis(track.position[:, :, 0], 2, 0)
    down = [max(np.roots(np.polyfit(t, one, 2))) for one in y]
    return np.array([np.polyval(np.polyfit(t, one, 1), at) for one, at in zip(x, down, strict=True)])


def pendulum(length=1.3, mass=2.0, angle=1.0, other=0.0):
    x = length * np.array([np.sin(angle), -np.cos(angle)])
    particles = tv.Particles(np.array([(0, 0), x, (5, 5)]), velocity=[(0, 0), (0, 0), (other, 0)], mass=[1, mass, 1], pinned=[0])
    return tv.World(particles, [tv.Gravity(G), tv.Distance([[0, 1]])], precision="f64", substeps=40)


def quarter(worlds):
    # The time of the first passage below the pin [s].
    track = worlds.rollout(0.9)
    t, x = track.time[0], track.position[:, :, 1, 0]
    k = int((x[0] > 0).sum())
    few = slice(k - 3, k + 3)
    return np.array([np.polyval(np.polyfit(one[few], t[few], 5), 0.0) for one in x])


def test_the_period_of_a_pendulum():
    # The period is proportional to the root of the length, at any swing, and does not depend on the mass.
    value, derivative = tv.gradient(pendulum, {"length": 1.3, "mass": 2.0, "other": 0.0, "angle": 1.0}, quarter)

    def exact(angle):
        a, b = 1.0, np.cos(angle / 2)
        for _ in range(6):
            a, b = (a + b) / 2, np.sqrt(a * b)
        return np.pi / (2 * a) * np.sqrt(1.3 / G)  # a quarter of the period, by Gauss's mean

    assert value == pytest.approx(exact(1.0), rel=1e-4)
    assert derivative["length"] == pytest.approx(value / 2.6, rel=1e-4)
    assert derivative["angle"] == pytest.approx((exact(1.0 + 1e-5) - exact(1.0 - 1e-5)) / 2e-5, rel=1e-3)
    assert abs(derivative["mass"]) < 1e-8
    assert derivative["other"] == 0.0


@pytest.mark.slow
def test_a_landing_place_by_speed_and_angle():
    v, a = 7.0, 0.6
    value, derivative = tv.gradient(thrown, {"speed": v, "angle": a}, landing)
    exact = 2 * v**2 * np.cos(2 * a) / G
    assert isinstance(value, float) and isinstance(derivative["angle"], float)
    assert value == pytest.approx(v**2 * np.sin(2 * a) / G, rel=1e-9)
    assert derivative["speed"] == pytest.approx(2 * v * np.sin(2 * a) / G, rel=1e-8)
    assert derivative["angle"] == pytest.approx(exact, rel=1e-8)
    rough = tv.gradient(lambda **p: thrown(**p, precision="f32"), {"speed": v, "angle": a}, landing).derivative
    assert rough == pytest.approx(derivative, rel=1e-3)
    # The error falls by four with half the step, as of a difference of sines, until rounding.
    steps = 0.1 / 2 ** np.arange(4)
    errors = [tv.gradient(thrown, {"angle": a}, landing, step=h).derivative["angle"] - exact for h in steps]
    np.testing.assert_allclose(errors, exact * (np.sin(2 * steps) / (2 * steps) - 1), rtol=1e-5)
    best, tiny = (abs(tv.gradient(thrown, {"angle": a}, landing, step=h).derivative["angle"] - exact) for h in (1e-5, 1e-12))
    assert best < 1e-7 and tiny > 100 * best


def test_parameters_and_figures_of_any_shape():
    def make(x, g, speed):
        velocity = np.array([[speed, 0.0], [0.0, 0.0]])
        return tv.World(tv.Particles(x, velocity=velocity), [tv.Gravity(g)], precision="f64")

    def places(worlds):
        worlds.run(0.5)
        return worlds.position

    start = np.array([[0.0, 2.0], [1.0, 3.0]])
    for step in ({}, {"step": {"x": np.full((2, 2), 1e-3), "speed": 0.1}}):
        value, derivative = tv.gradient(make, {"x": start, "g": (0.0, -G), "speed": 0.0}, places, **step)
        assert value.shape == (2, 2)
        assert {name: d.shape for name, d in derivative.items()} == {"x": (2, 2, 2, 2), "g": (2, 2, 2), "speed": (2, 2)}
        np.testing.assert_allclose(derivative["x"], np.einsum("ik,jl->ijkl", np.eye(2), np.eye(2)), atol=1e-9)
        np.testing.assert_allclose(derivative["g"], 0.125 * np.broadcast_to(np.eye(2), (2, 2, 2)), atol=1e-9)
        np.testing.assert_allclose(derivative["speed"], [[0.5, 0.0], [0.0, 0.0]], atol=1e-9)
    # Where a figure does not depend on a parameter, the derivative is 0 bit for bit.
    assert (derivative["x"][0, :, 1] == 0).all() and (derivative["g"][:, 0, 1] == 0).all()
    assert derivative["speed"][1, 0] == derivative["speed"][0, 1] == 0.0


def grows(speed):
    return tv.World(tv.Particles(np.zeros((2 if speed > 1 else 1, 2))))


def fails(speed):
    raise ArithmeticError("no")


def test_what_is_refused():
    last, one = thrown(), {"speed": 1.0}
    for make, parameters, figure, step, error, says in (
        (last, one, landing, None, TypeError, "make = .* is a World, but a function is needed"),
        (thrown, {}, landing, None, ValueError, "must be a dict of numbers"),
        (thrown, {"speed": "fast"}, landing, None, TypeError, "parameters are numbers"),
        (thrown, {"speed": np.nan}, landing, None, ValueError, "speed = nan, but it must be finite"),
        (lambda speed: speed, one, landing, None, TypeError, "make returned 1.0, a float, but a tv.World is needed"),
        (lambda speed: last, one, landing, None, ValueError, "the same World again"),
        (thrown, one, landing, {"pace": 1.0}, ValueError, "step has 'pace', but parameters are speed"),
        (thrown, one, landing, 0.0, ValueError, "lost in rounding"),
        (thrown, one, landing, -1.0, ValueError, "lost in rounding"),
        (thrown, one, landing, 1e-17, ValueError, "lost in rounding"),
        (thrown, one, landing, {"speed": [1.0, 2.0]}, ValueError, r"step of speed has shape \(2,\)"),
        (thrown, one, lambda worlds: 1.0, None, ValueError, "the first axis must have 3 worlds"),
        (thrown, one, lambda worlds: np.zeros(2), None, ValueError, "the first axis must have 3 worlds"),
        (thrown, one, lambda worlds: worlds, None, TypeError, "must return numbers"),
        (grows, one, landing, None, ValueError, "worlds"),
        (fails, one, landing, None, ArithmeticError, "no"),
    ):
        with pytest.raises(error, match=says) as caught:
            tv.gradient(make, parameters, figure, step=step)  # type: ignore[arg-type]
        note = {grows: "two for each number of speed", fails: "speed=1.0"}.get(make)
        assert note is None or note in caught.value.__notes__[0]
