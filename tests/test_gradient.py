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


def test_a_landing_place_by_speed_and_angle():
    v, a = 7.0, 0.6
    value, derivative = tv.gradient(thrown, {"speed": v, "angle": a}, landing)
    assert isinstance(value, float) and isinstance(derivative["angle"], float)
    assert value == pytest.approx(v**2 * np.sin(2 * a) / G, rel=1e-9)
    assert derivative["speed"] == pytest.approx(2 * v * np.sin(2 * a) / G, rel=1e-8)
    assert derivative["angle"] == pytest.approx(2 * v**2 * np.cos(2 * a) / G, rel=1e-8)
    rough = tv.gradient(lambda **p: thrown(**p, precision="f32"), {"speed": v, "angle": a}, landing).derivative
    assert rough["speed"] == pytest.approx(derivative["speed"], rel=1e-3)
    assert rough["angle"] == pytest.approx(derivative["angle"], rel=1e-3)


def test_the_error_falls_by_four_with_half_the_step_until_rounding():
    a, exact = 0.6, 2 * 7.0**2 * np.cos(1.2) / G
    steps = 0.1 / 2 ** np.arange(4)
    errors = [tv.gradient(thrown, {"angle": a}, landing, step=h).derivative["angle"] - exact for h in steps]
    np.testing.assert_allclose(errors, exact * (np.sin(2 * steps) / (2 * steps) - 1), rtol=1e-5)  # as of a difference of sines
    ratios = np.divide(errors[:-1], errors[1:])
    assert (np.abs(ratios - 4) < 0.02).all()
    best, tiny = (abs(tv.gradient(thrown, {"angle": a}, landing, step=h).derivative["angle"] - exact) for h in (1e-5, 1e-12))
    assert best < 1e-7 and tiny > 100 * best


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


@pytest.mark.parametrize("k, rest, length", [(50.0, 1.0, 1.4), (400.0, 2.0, 1.7)])
def test_the_energy_of_a_spring(k, rest, length):
    def make(k, rest, length):
        particles = tv.Particles([(0, 0), (length, 0)], pinned=[0])
        return tv.World(particles, [tv.Distance([[0, 1]], rest=rest, compliance=1 / k)], precision="f64", substeps=200)

    def energy(worlds):
        return worlds.run(0.1).energy

    value, derivative = tv.gradient(make, {"k": k, "rest": rest, "length": length}, energy)
    assert value == pytest.approx(k * (length - rest) ** 2 / 2, rel=1e-3)
    assert derivative["k"] == pytest.approx((length - rest) ** 2 / 2, rel=1e-3)
    assert derivative["length"] == pytest.approx(k * (length - rest), rel=1e-3)
    assert derivative["rest"] == pytest.approx(-k * (length - rest), rel=1e-3)


def test_shapes_of_parameters_and_figures():
    def make(x, g, speed):
        velocity = np.array([[speed, 0.0], [0.0, 0.0]])
        return tv.World(tv.Particles(x, velocity=velocity), [tv.Gravity(g)], precision="f64")

    def places(worlds):
        worlds.run(0.5)
        return worlds.position

    start = np.array([[0.0, 2.0], [1.0, 3.0]])
    value, derivative = tv.gradient(make, {"x": start, "g": (0.0, -G), "speed": 0.0}, places)
    assert value.shape == (2, 2)
    assert {name: d.shape for name, d in derivative.items()} == {"x": (2, 2, 2, 2), "g": (2, 2, 2), "speed": (2, 2)}
    np.testing.assert_allclose(derivative["x"], np.einsum("ik,jl->ijkl", np.eye(2), np.eye(2)), atol=1e-9)
    np.testing.assert_allclose(derivative["g"], 0.125 * np.broadcast_to(np.eye(2), (2, 2, 2)), atol=1e-9)
    np.testing.assert_allclose(derivative["speed"], [[0.5, 0.0], [0.0, 0.0]], atol=1e-9)
    # Where a figure does not depend on a parameter, the derivative is 0 bit for bit.
    assert (derivative["x"][0, :, 1] == 0).all() and (derivative["g"][:, 0, 1] == 0).all()
    assert derivative["speed"][1, 0] == derivative["speed"][0, 1] == 0.0
    steps = {"x": np.full((2, 2), 1e-3), "speed": 0.1}
    same = tv.gradient(make, {"x": start, "g": (0.0, -G), "speed": 0.0}, places, step=steps).derivative
    np.testing.assert_allclose(same["x"], derivative["x"], atol=1e-9)


def test_a_restitution_through_an_impact():
    # Dropped from 1 m with restitution e, the point rises to e^2 m.
    def make(e):
        return tv.World(tv.Particles([[0.0, 1.0]]), [tv.Gravity(G), tv.HalfSpace((0, 1), restitution=e)], precision="f64")

    def top(worlds):
        track = worlds.rollout(1.0, dt=1 / 600)
        t, y = track.time[0], track.position[:, :, 0, 1]
        after = t > 0.5
        parabolas = [np.polyfit(t[after], one[after], 2) for one in y]
        return np.array([c - b * b / (4 * a) for a, b, c in parabolas])

    value, derivative = tv.gradient(make, {"e": 0.8}, top)
    assert value == pytest.approx(0.64, rel=0.01)
    assert derivative["e"] == pytest.approx(1.6, rel=0.01)


def test_what_is_refused():
    last = thrown()
    with pytest.raises(TypeError, match="make = .* is a World, but a function is needed"):
        tv.gradient(last, {"speed": 1.0}, landing)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must be a dict of numbers"):
        tv.gradient(thrown, {}, landing)
    with pytest.raises(TypeError, match="parameters are numbers"):
        tv.gradient(thrown, {"speed": "fast"}, landing)
    with pytest.raises(ValueError, match="speed = nan, but it must be finite"):
        tv.gradient(thrown, {"speed": np.nan}, landing)
    with pytest.raises(TypeError, match="returned 1.0, which is a float and not a World"):
        tv.gradient(lambda speed: speed, {"speed": 1.0}, landing)  # type: ignore[arg-type, return-value]
    with pytest.raises(ValueError, match="the same World twice"):
        tv.gradient(lambda speed: last, {"speed": 1.0}, landing)
    with pytest.raises(ValueError, match="step has 'pace', but parameters are speed"):
        tv.gradient(thrown, {"speed": 1.0}, landing, step={"pace": 1.0})
    for step in (0.0, -1.0, 1e-17):
        with pytest.raises(ValueError, match="lost in rounding"):
            tv.gradient(thrown, {"speed": 1.0}, landing, step=step)
    with pytest.raises(ValueError, match=r"step of speed has shape \(2,\)"):
        tv.gradient(thrown, {"speed": 1.0}, landing, step={"speed": [1.0, 2.0]})
    for wrong in (lambda worlds: 1.0, lambda worlds: np.zeros(2)):
        with pytest.raises(ValueError, match="the first axis must have 3 worlds"):
            tv.gradient(thrown, {"speed": 1.0}, wrong)
    with pytest.raises(TypeError, match="must return numbers"):
        tv.gradient(thrown, {"speed": 1.0}, lambda worlds: worlds)

    def grows(speed):
        return tv.World(tv.Particles(np.zeros((2 if speed > 1 else 1, 2))))

    with pytest.raises(ValueError, match="worlds") as caught:
        tv.gradient(grows, {"speed": 1.0}, landing)
    assert "two for each number of speed" in caught.value.__notes__[0]

    def fails(speed):
        raise ArithmeticError("no")

    with pytest.raises(ArithmeticError) as failed:
        tv.gradient(fails, {"speed": 1.0}, landing)
    assert "speed = 1.0" in failed.value.__notes__[0]
