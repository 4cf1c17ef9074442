"""Beads on wires, against closed forms."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.constraints.core.curve import Curve

from .conftest import case, order, rerun, rms


def cycloid(t, a=0.5):
    """Return the curve on which all beads take the same time; its lowest point is at t = 0."""
    return np.stack([a * (t + np.sin(t)), -a * (1 + np.cos(t))], axis=-1)


def circle(n):
    """Return n points on the unit circle, counterclockwise from the lowest one."""
    t = 2 * np.pi * np.arange(n) / n
    return np.stack([np.sin(t), -np.cos(t)], axis=1)


def wires(world, x, wire, ring, g, **settings):
    """Return a world of an open and a closed wire."""
    return world(tv.Particles(x), [tv.Gravity(g), wire, ring], precision="f64", **settings)


def test_beads_slide_as_pendulums_do(world):
    # On a cycloid of radius a, the arc length from the bottom is 4 a sin(t / 2) and oscillates with exactly sqrt(g / (4 a)). On a
    # ring, R06b, and ten thousand substeps that keep the energy; a bead at the top of the ring stays in balance.
    g, a, seconds = 9.81, 0.5, 2.0
    t = np.array([0.2, 0.9, 1.6, 2.3])
    later = 2 * np.arcsin(np.sin(t / 2) * np.cos(np.sqrt(g / (4 * a)) * seconds))
    v = case("R06b_pendulum_state")["values"]["90deg_t5"]
    wire, ring = tv.Path(np.arange(4), cycloid(np.linspace(-3, 3, 201))), tv.Path([4, 5], circle(96), closed=True)
    x = np.concatenate([cycloid(t), [[1.0, 0], [0, 1]]])
    w = wires(world, x, wire, ring, g)
    errors = [rms(rerun(w, seconds, substeps=n).position[:4], cycloid(later)) for n in (10, 20, 40)]
    assert errors[1] <= 3e-6 and w.last.clean and 1.9 <= order(errors) <= 2.1
    assert w.last.energy == pytest.approx(g * x[:, 1].sum(), abs=1e-4)
    errors = [rms(rerun(w, 5.0, substeps=n).position[4], [v["x"], v["y"]]) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[2] <= 4e-6
    assert ring.load[1] == pytest.approx([0, 9.81], abs=1e-4)
    energy = [w.step(1 / 60).energy for _ in range(250)]
    assert np.ptp(energy) <= 2e-5
    assert ring.length == pytest.approx(2 * np.pi, rel=1e-7)


@pytest.mark.slow
def test_beads_off_their_curve_are_moved_there(world):
    # At once and without velocity, as all that starts off its rigid constraints, with the flag.
    wire, ring = tv.Path([0, 1], [[0, 0], [2, 0]]), tv.Path([2], circle(96), closed=True)
    with pytest.warns(UserWarning, match=r"particle 0 starts 1 m off the curve, and is moved to \(0.5, 0.0\)"):
        w = wires(world, [[0.5, 1.0], [1.0, 0.0], [0.0, -1.0]], wire, ring, 0.0, substeps=1)
    w.step(1 / 60)
    assert w.last.flags == {"moved"} and "up to 1 m" in w.last.notes[0] and w.last.energy == 0
    np.testing.assert_array_equal(w.position[:2], [[0.5, 0.0], [1.0, 0.0]])
    assert w.step(1 / 60).clean and not w.velocity.any()


def test_driven_beads_follow_their_path(world):
    # At a constant speed around a square with corners, whatever load hangs on the bead; and to given arc lengths, evenly.
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    belt = tv.Path([0, 1], square, closed=True, smooth=False, speed=[1.0, -2.0])
    lift = tv.Path([3], [[5, 0], [5, 2]], at=0.5)
    turn = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = tv.Path([5], np.stack([9 + np.cos(turn), np.sin(turn)], axis=1), closed=True, speed=2.0)
    features = [tv.Gravity(9.81), tv.Distance([[0, 2], [3, 4]]), belt, lift, ring]
    start = tv.Particles([[0.0, 0], [0.5, 0], [0, -1], [5, 0], [5, -1], [10, 0]])
    w = world(start, features, precision="f64")
    for k in range(1, 7):
        w.run(0.5)
        s = 0.5 * k
        np.testing.assert_allclose(w.position[:2], belt.place([s % 4, (0.5 - 2 * s) % 4]), atol=1e-10)
        # Velocities belong to the end of the substep. Those of half a substep before point elsewhere by omega h / 2 = 8e-4.
        np.testing.assert_allclose(w.velocity[5], 2.0 * np.array([-np.sin(2 * s), np.cos(2 * s)]), atol=1e-6)
    assert w.position[3] == pytest.approx([5, 0.5])
    lift.at = 1.5
    for speed in (60.0, 0.0):
        w.step(1 / 60)
        assert w.position[3] == pytest.approx([5, 1.5]) and w.velocity[3] == pytest.approx([0, speed])
    belt.speed = 0.0
    at = w.position[0]
    w.run(0.1)
    np.testing.assert_array_equal(w.position[0], at)


@pytest.mark.parametrize("precision", ["f32", pytest.param("f32-compensated", marks=pytest.mark.slow)])
def test_a_ring_is_the_same_everywhere(world, precision):
    # A free bead keeps its energy, and a driven one its place, however far away the ring is. A substep rounds the pull of the
    # wire by up to a digit e of x, a share v h / (2 R) of it along the wire: n substeps change the energy by less than n e / R.
    v, R, n = 0.3, 0.5, 2400
    for away in (0.0, 10.0, 100.0, 1000.0 if precision == "f32-compensated" else -100.0):
        ring = R * circle(32) + away
        slides, goes = tv.Path([0], ring, closed=True), tv.Path([1], ring, closed=True, speed=1.0)
        w = world(tv.Particles(ring[[8, 0]], velocity=(0, v)), [slides, goes], precision=precision, substeps=20)
        flags = {flag for _ in range(n // 20) for flag in w.step(1 / 60).flags}
        digit = 2.0**-24 * (R if precision == "f32-compensated" else abs(away) + R)
        assert not flags and w.last.energy == pytest.approx(v * v / 2, rel=n * digit / R + 1e-3), away
        np.testing.assert_allclose(w.position[1], goes.place([n / 1200]).ravel(), atol=4 * digit, err_msg=str(away))


def test_curves_are_of_fourth_order_and_pass_through_their_points():
    # Splines are parametrized by arc length, polylines go straight.
    errors, s = [], np.linspace(0, 2 * np.pi, 500, endpoint=False)
    for n in (16, 32, 64):
        errors.append(np.abs(Curve(circle(n), True, True).at(s) - np.stack([np.sin(s), -np.cos(s)], axis=1)).max())
    assert order(errors) >= 3.8
    c = Curve(np.array([[0, 0], [3, 4.0], [3, 5]]), False, False)
    np.testing.assert_allclose(c.at([0, 2.5, 5, 5.5, 99]), [[0, 0], [1.5, 2], [3, 4], [3, 4.5], [3, 5]])
    np.testing.assert_allclose(c.nearest(np.array([[1.5 + 0.8, 2 - 0.6]])), 2.5, atol=1e-6)
    for k in (2, 3, 4):  # curves of few points
        c = Curve(np.outer(np.arange(k), [1, 2]), False, True)
        np.testing.assert_allclose(c.at([5**0.5 * (k - 1) / 2]), [[(k - 1) / 2, k - 1]])


LINE = [[0, 0], [1, 0]]


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: tv.Path([0], [*LINE, [1, 0]]), r"points\[1\] and the next are the same"),
        (lambda: tv.Path([0], LINE, closed=True), "2 points make no closed"),
        (lambda: tv.Path([0], LINE, speed=1, at=0), "exclude each other"),
        (lambda: tv.Path([0], LINE, speed=1, compliance=1), "take no compliance"),
        (lambda: tv.Path([3, 3], LINE), "particle 3 is named twice"),
        (lambda: tv.World(tv.Particles(np.zeros((1, 3))), [tv.Path([0], LINE)]), r"points has shape \(2, 2\)"),
    ],
)
def test_wrong_paths_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
