"""Beads on wires and particles on a tidy grid, against closed forms."""

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


def test_tautochrone(world):
    # On a cycloid of radius a, the arc length from the bottom is 4 a sin(t / 2) and oscillates with exactly sqrt(g / (4 a)).
    g, a, seconds = 9.81, 0.5, 2.0
    t = np.array([0.2, 0.9, 1.6, 2.3])
    later = 2 * np.arcsin(np.sin(t / 2) * np.cos(np.sqrt(g / (4 * a)) * seconds))
    wire = tv.Path(np.arange(4), cycloid(np.linspace(-3, 3, 201)))
    w = world(tv.Particles(cycloid(t)), [tv.Gravity(g), wire], precision="f64")
    errors = [rms(rerun(w, seconds, substeps=n).position, cycloid(later)) for n in (10, 20, 40)]
    assert errors[1] <= 3e-6 and w.last.clean and 1.9 <= order(errors) <= 2.1
    assert w.last.energy == pytest.approx(g * cycloid(t)[:, 1].sum(), abs=1e-4)


def test_a_bead_on_a_ring_is_a_pendulum(world):
    # R06b, and ten thousand substeps that keep the energy; a bead at the top of the ring stays in balance.
    v = case("R06b_pendulum_state")["values"]["90deg_t5"]
    ring = tv.Path([0, 1], circle(96), closed=True)
    w = world(tv.Particles([[1.0, 0], [0, 1]]), [tv.Gravity(9.81), ring], precision="f64")
    errors = [rms(rerun(w, 5.0, substeps=n).position[0], [v["x"], v["y"]]) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[2] <= 4e-6
    assert ring.load[1] == pytest.approx([0, 9.81], abs=1e-4)
    energy = [w.step(1 / 60).energy for _ in range(250)]
    assert np.ptp(energy) <= 2e-5
    assert ring.length == pytest.approx(2 * np.pi, rel=1e-7)


def test_a_bead_on_a_helix(world):
    # In 3D: s'' = g sin(slope) along a helix of that slope. A second bead is flung at the end of the wire and stays there.
    t = np.linspace(0, 8 * np.pi, 400)
    points = np.stack([np.cos(t), -0.25 * t, np.sin(t)], axis=1)
    path = tv.Path([0, 1], points)
    slope = 0.25 / np.hypot(1, 0.25)
    w = world(tv.Particles(points[[20, -5]], velocity=(0, -1, 0)), [tv.Gravity(9.81), path], precision="f64")
    errors = []
    for n in (3, 6, 12):
        w.velocity, w.position, w.substeps = [[0, 0, 0], [0, -50.0, 0]], points[[20, -5]], n
        w.run(1.0)
        along = path.curve.nearest(points[[20]])[0] + 9.81 * slope / 2
        errors.append(rms(w.position[0], path.place(np.array([along]))[0]))
    assert 1.9 <= order(errors) <= 2.1 and errors[-1] < 1e-5
    np.testing.assert_allclose(w.position[1], points[-1], atol=1e-12)
    np.testing.assert_allclose(w.velocity[1], 0, atol=1e-9)


def test_driven_along_a_path(world):
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
    w.step(1 / 60)
    assert w.position[3] == pytest.approx([5, 1.5]) and w.velocity[3] == pytest.approx([0, 60.0])
    w.step(1 / 60)
    assert w.position[3] == pytest.approx([5, 1.5]) and w.velocity[3] == pytest.approx([0, 0.0])
    belt.speed = 0.0
    at = w.position[0]
    w.run(0.1)
    np.testing.assert_array_equal(w.position[0], at)


@pytest.mark.parametrize("precision", ["f32", "f32-compensated"])
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


def test_a_soft_wire_gives_way(world):
    # Static deflection m g compliance across the wire, and free along it.
    wire = tv.Path([0], [[0, 0], [10, 0]], compliance=1e-2, damping=20.0)
    w = world(tv.Particles([[1.0, 0]], velocity=(1, 0)), [tv.Gravity(9.81), wire], precision="f64")
    w.run(2.0)
    np.testing.assert_allclose(w.position[0], [3.0, -9.81e-2], rtol=1e-6)
    assert wire.load[0] == pytest.approx([0, 9.81], abs=1e-4)


def test_snapping_to_a_grid(world):
    # Each axis of each particle oscillates about the nearest node; the last particle is free along x. Damped, they come to rest.
    x = np.array([[0.1, 0.2], [1.3, -0.7], [2.6, 0.1]])
    k = 50.0
    grid = tv.Snap([0, 1], 1.0, origin=(0.25, 0.0), compliance=1 / k)
    rows = tv.Snap([2], (np.inf, 0.5), compliance=1 / k)
    w = world(tv.Particles(x, velocity=[[0, 0], [0, 0], [1, 0]]), [grid, rows], iterations=3, precision="f64")
    node = np.array([[0.25, 0], [1.25, -1], [0, 0]])
    want = node + (x - node) * np.cos(np.sqrt(k) * 1.5)
    want[2, 0] = 2.6 + 1.5
    errors = [rms(rerun(w, 1.5, substeps=n).position, want) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[-1] <= 1e-4
    # For particles thrown across many nodes, the energy stays within 2 %. Then dampers bring them to nodes.
    w.velocity = [[20.0, 13.0], [-9.0, 4.0], [0, 8.0]]
    energy = [w.step(1 / 60).energy for _ in range(120)]
    assert np.ptp(energy) <= 0.02 * energy[0]
    calm = world(tv.Particles(w.position), [tv.Snap(np.arange(3), 0.5, compliance=1 / k, damping=10.0)])
    calm.run(3.0)
    np.testing.assert_allclose(calm.position, np.floor(calm.position / 0.5 + 0.5) * 0.5, atol=1e-5)


def test_curves():
    # Splines are of fourth order, parametrized by arc length; polylines pass through their points.
    errors = []
    for n in (16, 32, 64):
        c = Curve(circle(n), True, True)
        s = np.linspace(0, 2 * np.pi, 500, endpoint=False)
        errors.append(np.abs(c.at(s) - np.stack([np.sin(s), -np.cos(s)], axis=1)).max())
    assert order(errors) >= 3.8
    points = np.array([[0, 0], [3, 4.0], [3, 5]])
    c = Curve(points, False, False)
    np.testing.assert_allclose(c.at([0, 2.5, 5, 5.5, 99]), [[0, 0], [1.5, 2], [3, 4], [3, 4.5], [3, 5]])
    np.testing.assert_allclose(c.nearest(np.array([[1.5 + 0.8, 2 - 0.6]])), 2.5, atol=1e-6)
    for k in (2, 3, 4):  # curves of few points
        t = np.arange(k)
        np.testing.assert_allclose(
            Curve(np.stack([t, 2 * t], axis=1), False, True).at([5**0.5 * (k - 1) / 2]), [[(k - 1) / 2, k - 1]]
        )


def test_paths_that_are_refused():
    with pytest.raises(ValueError, match=r"points\[1\] and the next are the same"):
        tv.Path([0], [[0, 0], [1, 0], [1, 0]])
    with pytest.raises(ValueError, match="2 points make no closed"):
        tv.Path([0], [[0, 0], [1, 0]], closed=True)
    with pytest.raises(ValueError, match="exclude each other"):
        tv.Path([0], [[0, 0], [1, 0]], speed=1, at=0)
    with pytest.raises(ValueError, match="take no compliance"):
        tv.Path([0], [[0, 0], [1, 0]], speed=1, compliance=1)
    with pytest.raises(ValueError, match="particle 3 is named twice"):
        tv.Path([3, 3], [[0, 0], [1, 0]])
    with pytest.raises(ValueError, match=r"points has shape \(2, 2\)"):
        tv.World(tv.Particles(np.zeros((1, 3))), [tv.Path([0], [[0, 0], [1, 0]])])
    with pytest.raises(ValueError, match=r"Snap: compliance\[0\] = 0"):
        tv.Snap([0], 1.0, compliance=0.0)
    with pytest.raises(ValueError, match=r"Snap: spacing\[0\] = 0"):
        tv.World(tv.Particles([[0.0, 0]]), [tv.Snap([0], 0.0, compliance=1.0)])


def test_beads_off_their_curve_are_moved_there(world):
    # At once and without velocity, as all that starts off its rigid constraints, with the flag.
    with pytest.warns(UserWarning, match=r"particle 0 starts 1 m off the curve, and is moved to \(0.5, 0.0\)"):
        w = world(tv.Particles([[0.5, 1.0], [1.0, 0.0]]), [tv.Path([0, 1], [[0, 0], [2, 0]])], substeps=1)
    w.step(1 / 60)
    assert w.last.flags == {"moved"} and "up to 1 m" in w.last.notes[0] and w.last.energy == 0
    np.testing.assert_array_equal(w.position, [[0.5, 0.0], [1.0, 0.0]])
    assert w.step(1 / 60).clean and not w.velocity.any()
