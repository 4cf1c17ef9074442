"""Scenes of which users of other engines complain in public, each with its right value. The thread is named at each."""

import numpy as np
import pytest

import tiverlet as tv

G = 9.81


def turned(before: np.ndarray, after: np.ndarray) -> float:
    """Return the angle from one vector in the plane to another [rad]."""
    return float(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after))


def capstan_fall(ratio: float, friction: float, bead: float, turns: int, hang: int, t: float) -> float:
    """Return how far the heavy end of a rope over half a drum falls: bead by bead, m a = dT + m g_t - mu N along the drum.

    Bead k bends the rope by pi / turns, the first and the last by half of it, and N = (T + T') sin(bend / 2) + m g_n.
    """

    def lack(a):
        T = (1.0 + bead * (hang - 1)) * (G + a)
        for k in range(turns + 1):
            at, half = np.pi * (1 - k / turns), np.pi / turns / (2 if 0 < k < turns else 4)
            c, s = np.cos(half), np.sin(half)
            T = (bead * (a - G * np.cos(at) + friction * G * np.sin(at)) + T * (c + friction * s)) / (c - friction * s)
        return (ratio + bead * (hang - 1)) * (G - a) - T

    low, high = 0.0, G * (lack(0.0) > 0)
    for _ in range(60):
        low, high = ((low + high) / 2, high) if lack((low + high) / 2) > 0 else (low, (low + high) / 2)
    return low * t * t / 2


@pytest.mark.slow
def test_a_rope_on_a_drum_holds_and_slips_by_the_capstan_equation(world):
    # google-deepmind/mujoco#454: friction on a drum far too low. T' / T = exp(mu pi) = 2.57: 1 kg holds 2.2 kg, but not 2.9 kg.
    turns, hang, r, bead = 60, 12, 0.51, 1e-3
    link, at = 2 * r * np.sin(np.pi / turns / 2), np.pi * (1 - np.arange(turns + 1) / turns)
    down = link * np.arange(1, hang + 1)
    sides = [np.stack([np.full(hang, x), -some], axis=1) for x, some in ((-r, down[::-1]), (r, down))]
    x = np.concatenate([sides[0], r * np.stack([np.cos(at), np.sin(at)], axis=1), sides[1]])
    links = [(i, i + 1) for i in range(len(x) - 1)]
    for ratio, friction, substeps in ((2.2, 0.3, 20), (2.9, 0.3, 20), (2.9, 0.3, 60), (2.0, 0.0, 20)):
        mass = np.full(len(x), bead)
        mass[[0, -1]] = 1.0, ratio
        features = [tv.Gravity(G), tv.Distance(links), tv.Ball((0, 0), 0.5, friction=0.3), tv.Contact()]
        w = world(tv.Particles(x, mass=mass, radius=0.01), features, substeps=substeps)
        features[2].friction = friction
        w.run(0.3)
        assert "creeps" not in w.explain()
        right = capstan_fall(ratio, friction, bead, turns, hang, 0.3)
        assert x[-1, 1] - w.position[-1, 1] == pytest.approx(right, rel=0.04 if substeps == 20 else 0.015, abs=1e-5)
    drum = tv.Ball((0, 0), 0.5, friction=0.3)  # without contacts it creeps, which is told
    assert f"{drum!r}: what constraints hold creeps under loads" in world(w.particles, [tv.Distance(links), drum]).explain()


@pytest.mark.slow
def test_a_top_precesses_without_nutation(world):
    # jrouwe/JoltPhysics#803: tops fall over where gyroscopic forces are left out. Steady precession of a heavy top at the angle
    # theta: I1 cos(theta) W^2 - I3 w3 W + M g L = 0.
    tilt, spin, M, L, R = 0.5, 100.0, 1.0, 1.0, 0.3
    at = np.arange(12) * np.pi / 6
    I1, I3 = M * (R * R / 2 + L * L), M * R * R
    b, a = I3 * spin, I1 * np.cos(tilt)
    W = (b - np.sqrt(b * b - 4 * a * M * G * L)) / (2 * a)
    ring = np.stack([R * np.cos(at), R * np.sin(at), np.full(12, L)], axis=1)
    c, s = np.cos(tilt), np.sin(tilt)
    x = np.concatenate([[[0.0, 0.0, 0.0]], ring @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])])
    v = np.cross(W * np.array([0, 0, 1]) + (spin - W * c) * np.array([s, 0, c]), x)
    for substeps, error in ((4, 2e-3), (20, 1e-4), (60, 2e-5)):
        start = tv.Particles(x, velocity=v, mass=M / 12, pinned=[0])
        w = world(start, [tv.Gravity((0, 0, -G)), tv.ShapeMatch([range(13)])], precision="f64", substeps=substeps)
        w.run(2.0)
        center = w.position[1:].mean(axis=0)
        assert np.arctan2(center[1], center[0]) == pytest.approx(2 * W, abs=error)
        assert np.arccos(center[2]) == pytest.approx(tilt, abs=error)


def boxes(world, x, substeps):
    """Return a world of boxes on a floor."""
    loops = np.arange(len(x)).reshape(-1, 4)
    floor, polygons = tv.HalfSpace((0, 1), friction=2.0), tv.Polygons(loops, friction=0.6)
    features = [tv.Gravity(G), floor, polygons, tv.ShapeMatch(loops)]
    return world(tv.Particles(x, mass=0.25), features, substeps=substeps, precision="f64")


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [4, 20, 60])
def test_boxes_fall_to_the_side_of_their_center(world, substeps):
    # dimforge/rapier#934: a box stays on its edge. Turned about a corner that friction holds, it falls as a compound pendulum.
    box = np.array([[-0.2, 0.0], [0.0, 0.0], [0.0, 0.6], [-0.2, 0.6]])
    turns = np.array([0.3, 0.33])  # atan(W / H) = 0.3217
    c, s = np.cos(turns), np.sin(turns)
    x = np.concatenate([box @ np.array([[c[k], -s[k]], [s[k], c[k]]]) + (10 * k, 0) for k in (0, 1)])
    w = boxes(world, x, substeps)
    w.run(0.6)
    for k in (0, 1):
        one, at = x[4 * k : 4 * k + 4] - (10 * k, 0), w.position[4 * k : 4 * k + 4]
        # J theta'' = -m g (x cos - y sin) of its middle, by the midpoint rule: 3,000 steps are right to 1e-8.
        mean, J, angle, speed, dt = one.mean(axis=0), 0.25 * (one * one).sum(), 0.0, 0.0, 2e-4
        for _ in range(3_000):
            half = angle + dt / 2 * speed
            speed -= dt * G * (mean[0] * np.cos(half) - mean[1] * np.sin(half)) / J
            angle = half + dt / 2 * speed
        assert turned(one[2] - one[1], at[2] - at[1]) == pytest.approx(angle, abs=2e-5)
        assert np.abs(at[1] - (10 * k, 0)).max() < 1e-6


@pytest.mark.slow
def test_bricks_hang_over_by_the_harmonic_series_and_no_further(world):
    # The same thread: what overhangs. n bricks of width 1 m hang over by at most 1/2, 1/4, 1/6 ... m, from the top.
    for share, stays in ((0.95, True), (1.05, False)):
        x, at = [], 0.0
        for k in range(5):
            x += [(at + a, 0.25 * k + b) for a, b in ((-0.5, 0), (0.5, 0), (0.5, 0.25), (-0.5, 0.25))]
            at += share / (2 * max(4 - k, 1))
        w = boxes(world, np.array(x), 4)
        w.run(3.0)
        moved = np.abs(w.position - x).max()
        assert moved < 1e-4 if stays else moved > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_ball_rolls_over_level_walls_as_over_one(world, restitution):
    # appsinacup/godot-rapier-physics#625, liabru/matter-js#970: it hops at the seams between level tiles, or at those within one.
    # One that lies in them by half a percent does not either.
    for spins, way, deep, substeps in ((False, 1, 0.0, 4), (True, -1, 0.0, 20), (False, -1, 5e-4, 60)):
        start = tv.Particles([[2.75, 0.1 - deep]], velocity=(3.0 * way, 0), radius=0.1, spin=-30.0 * way * spins)
        top = np.stack([np.linspace(0.5, 0.0, 4), np.zeros(4)], axis=1)
        tile = np.concatenate([[[0.0, -0.2], [0.5, -0.2]], top])
        tiles = [tv.Polygon(tile + (0.5 * k, 0.0), friction=0.6, restitution=0.5) for k in range(12)]
        w, high = world(start, [tv.Gravity(G), tv.Contact(), *tiles], substeps=substeps), 0.0
        for each in tiles:
            each.friction, each.restitution = 0.6 * spins, restitution
        for _ in range(50):
            w.step(1 / 60)
            high = max(high, w.position[0, 1] - 0.1)
        assert high < 1e-7
        assert abs(w.velocity[0, 0]) == pytest.approx(3.0, rel=2.5e-3 if substeps == 4 else 3e-4)
