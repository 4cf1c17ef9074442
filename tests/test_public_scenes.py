"""Scenes of which users of other engines complain in public, each with its right value. The thread is named at each."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import rerun

G = 9.81


def turned(before: np.ndarray, after: np.ndarray) -> float:
    """Return the angle from one vector in the plane to another [rad]."""
    return float(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after))


def motion(slope, inertia, until: float, dt: float = 2e-5) -> float:
    """Return theta of J theta'' = slope(theta) - J' theta'^2 / 2 from rest, at the time `until`; inertia: theta to (J, J')."""
    angle = speed = 0.0
    for _ in range(round(until / dt)):
        J, dJ = inertia(angle)
        speed += dt * (slope(angle) - dJ * speed**2 / 2) / J
        angle += dt * speed
    return angle


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

    low, high = 0.0, G
    if lack(0.0) <= 0:
        return 0.0
    for _ in range(60):
        low, high = ((low + high) / 2, high) if lack((low + high) / 2) > 0 else (low, (low + high) / 2)
    return low * t * t / 2


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [20, 60])
def test_a_rope_on_a_drum_holds_and_slips_by_the_capstan_equation(world, substeps):
    # google-deepmind/mujoco#454: friction on a drum far too low. T' / T = exp(mu pi) = 2.57: 1 kg holds 2.2 kg, but not 2.9 kg.
    turns, hang, r, bead = 60, 12, 0.51, 1e-3
    link, at = 2 * r * np.sin(np.pi / turns / 2), np.pi * (1 - np.arange(turns + 1) / turns)
    down = link * np.arange(1, hang + 1)
    sides = [np.stack([np.full(hang, x), -some], axis=1) for x, some in ((-r, down[::-1]), (r, down))]
    x = np.concatenate([sides[0], r * np.stack([np.cos(at), np.sin(at)], axis=1), sides[1]])
    links = [(i, i + 1) for i in range(len(x) - 1)]
    for ratio, friction in ((2.2, 0.3), (2.9, 0.3), (2.0, 0.0)):
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


def boxes(world, x, friction, substeps):
    """Return a world of boxes on a floor."""
    loops = np.arange(len(x)).reshape(-1, 4)
    floor, polygons = tv.HalfSpace((0, 1), friction=2.0), tv.Polygons(loops, friction=friction)
    start = tv.Particles(x, mass=0.25)
    return world(start, [tv.Gravity(G), floor, polygons, tv.ShapeMatch(loops)], substeps=substeps, precision="f64")


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [4, 20, 60])
def test_boxes_fall_to_the_side_of_their_center(world, substeps):
    # dimforge/rapier#934: a box stays on its edge. Turned about a corner that friction holds, it falls as a compound pendulum.
    for turn in (0.3, 0.33):  # atan(W / H) = 0.3217
        c, s = np.cos(turn), np.sin(turn)
        x = np.array([[-0.2, 0.0], [0.0, 0.0], [0.0, 0.6], [-0.2, 0.6]]) @ np.array([[c, -s], [s, c]])
        w = boxes(world, x, 0.6, substeps)
        w.run(0.6)
        mean, J = x.mean(axis=0), 0.25 * (x * x).sum()
        right = motion(lambda q, m=mean: -G * (m[0] * np.cos(q) - m[1] * np.sin(q)), lambda q, J=J: (J, 0.0), 0.6)
        assert turned(x[2] - x[1], w.position[2] - w.position[1]) == pytest.approx(right, abs=2e-5)
        assert np.abs(w.position[1]).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [4, 20])
def test_bricks_hang_over_by_the_harmonic_series_and_no_further(world, substeps):
    # The same thread: what overhangs. n bricks of width 1 m hang over by at most 1/2, 1/4, 1/6 ... m, from the top.
    for share, stays in ((0.95, True), (1.05, False)):
        x, at = [], 0.0
        for k in range(5):
            x += [(at + a, 0.25 * k + b) for a, b in ((-0.5, 0), (0.5, 0), (0.5, 0.25), (-0.5, 0.25))]
            at += share / (2 * max(4 - k, 1))
        w = boxes(world, np.array(x), 0.6, substeps)
        w.run(3.0)
        moved = np.abs(w.position - x).max()
        assert moved < 1e-4 if stays else moved > 1.0


@pytest.mark.slow
def test_a_lift_that_turns_round_is_left_and_met_again(world):
    # jrouwe/JoltPhysics#530: a lift goes up at 2.4 m/s, then down. What stood on it flies on: the gap is 2 v t - g t^2 / 2, at
    # most 2 v^2 / g, and closes after 4 v / g. The substep in which the floor leaves counts as a whole: an error of v h.
    v, bodies = 2.4, 2
    for substeps in (4, 20, 60):
        y, gaps = 0.0, []
        start = tv.Particles([[k, 0.1] for k in range(bodies)], radius=0.1)
        w = world(start, [tv.Gravity(G), tv.HalfSpace((0, 1)), tv.Contact()], substeps=substeps, precision="f64")
        for k in range(150):
            y += (v if k < 60 else -v) / 60
            w.features[1].offset = y
            w.step(1 / 60)
            gaps.append(w.position[:, 1].min() - 0.1 - y)
        assert np.abs(gaps[:60]).max() < 1e-9 and np.abs(gaps[60 + 59 :]).max() < 1e-9
        assert max(gaps) == pytest.approx(2 * v * v / G, abs=1.05 * v / 60 / substeps + 2e-4)
        np.testing.assert_allclose(w.velocity, [[0, -v]] * bodies, atol=1e-9)


def test_a_ball_before_a_piston_is_as_fast_as_each_blow_makes_it(world):
    # lammps/lammps#5087, #2812: walls that move and give back. A ball between a wall and a piston at V leaves it by v + 2 V.
    V, r, x, v, t, end = 0.5, 0.05, 0.5, 3.0, 0.0, 2.0
    while True:
        wait = (2.0 - V * t - r - x) / (v + V) if v > 0 else (x - r) / -v
        if t + wait > end:
            break
        t, x, v = t + wait, x + v * wait, -(v + 2 * V) if v > 0 else -v
    x += v * (end - t)
    for substeps in (4, 20, 60):
        walls = [tv.HalfSpace((1, 0), restitution=1.0), tv.HalfSpace((-1, 0), -2.0, restitution=1.0)]
        w = world(tv.Particles([[0.5, 0.0]], velocity=(3.0, 0.0), radius=r), walls, substeps=substeps, precision="f64")
        for k in range(120):
            walls[1].offset = V * (k + 1) / 60 - 2.0
            w.step(1 / 60)
        assert w.position[0, 0] == pytest.approx(x, abs=1e-11) and w.velocity[0, 0] == pytest.approx(v, abs=2e-11)


@pytest.mark.slow
@pytest.mark.parametrize("restitution", [0.0, 0.5])
def test_a_ball_rolls_over_level_walls_as_over_one(world, restitution):
    # appsinacup/godot-rapier-physics#625, liabru/matter-js#970: it hops at the seams between level tiles. One that lies in them
    # by half a percent does not either.
    for spins, way, deep in ((False, 1, 0.0), (True, -1, 0.0), (False, -1, 5e-4)):
        for substeps in (4, 20, 60):
            start = tv.Particles([[2.75, 0.1 - deep]], velocity=(3.0 * way, 0), radius=0.1, spin=-30.0 * way * spins)
            tile = np.array([[0.0, -0.2], [0.5, -0.2], [0.5, 0.0], [0.0, 0.0]])
            tiles = [tv.Polygon(tile + (0.5 * k, 0.0), friction=0.6, restitution=0.5) for k in range(12)]
            w, high = world(start, [tv.Gravity(G), tv.Contact(), *tiles], substeps=substeps), 0.0
            for each in tiles:
                each.friction, each.restitution = 0.6 * spins, restitution
            for _ in range(50):
                w.step(1 / 60)
                high = max(high, w.position[0, 1] - 0.1)
            assert high < 1e-7
            assert abs(w.velocity[0, 0]) == pytest.approx(3.0, rel=2.5e-3 if substeps == 4 else 3e-4)


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["links on a pivot", "cluster on a hinge"])
def test_a_seesaw_weighs_a_hundred_to_one(world, hold):
    # godotengine/godot#10760: masses have no part in what joints do. A plank on a pivot, with 100 kg at 0.1 m and 1 kg at 1.9 m.
    # Discs that do not spin roll on the plank as it turns: s = s0 + r theta, J = I + sum m (H^2 / 4 + s^2), and the slope is that
    # of m g (s sin + (H / 2 + r) cos).
    plank = np.array([[-2, -0.1], [2, -0.1], [2, 0.1], [-2, 0.1]])
    x = np.concatenate([plank, [[0, 0], [-0.1, 0.19], [1.9, 0.2]]])
    m, r = np.array([2.0, 2, 2, 2, 1, 100, 1]), np.array([0, 0, 0, 0, 0, 0.09, 0.1])

    def inertia(q):
        s = x[5:, 0] + r[5:] * q
        return (m[:5, None] * x[:5] ** 2).sum() + (m[5:] * (0.01 + s * s)).sum(), (2 * m * r)[5:] @ s

    def slope(q):
        s = x[5:, 0] + r[5:] * q
        return -G * (m[5:] * (r[5:] * np.sin(q) + s * np.cos(q) - x[5:, 1] * np.sin(q))).sum()

    right = motion(slope, inertia, 0.4)
    pairs, loops = [(i, j) for j in range(5) for i in range(j)], tv.Polygons([range(4)], friction=0.9)
    if hold == "links on a pivot":
        start, features = tv.Particles(x, mass=m, radius=r, pinned=[4]), [tv.Gravity(G), loops, tv.Distance(pairs)]
    else:  # the hub on a link of length 0 to a pin inside of the plank, which the plank's edges do not touch
        start = tv.Particles([*x, x[4]], mass=[*m, 1], radius=[*r, 0], pinned=[7])
        features = [tv.Gravity(G), loops, tv.ShapeMatch([range(5)]), tv.Distance([(4, 7)])]
    w = world(start, features, precision="f64")
    for substeps in (4, 20, 60):
        rerun(w, 0.4, substeps=substeps)
        assert turned(x[1] - x[0], w.position[1] - w.position[0]) == pytest.approx(right, abs=5e-4)
