"""Bodies placed off their rigid constraints are moved to where these are met, without a gain of energy."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.report.accuracy.cases.case import links

N, M, G = 20, 0.05, 9.81


def row(n: int = N) -> np.ndarray:
    """Return n + 1 particles, 1 / n apart."""
    return np.stack([np.arange(n + 1) / n, np.zeros(n + 1)], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [tv.Jacobi(), tv.Direct()], ids=str)
def test_links_of_other_lengths_bring_no_energy(world, solver):
    # Rest lengths 17 % too short, 0.05 % too short and 10 % too long. A pass would turn such a violation into C^2 / (2 W h^2), up
    # to 1 800 J at 200 substeps. From one pin the row whips with the energy error of SHAKE, of order h^2: 8e-4 J at 20 substeps.
    # Between two pins, a tenth too long, it has no direction to give way in, and bulges first.
    for pins, factors in (([0], (0.83, 0.9995, 1.1)), ([0, N], (1.1,))):
        held = tv.Distance(links(N), 1 / N)
        w = world(tv.Particles(row(), mass=M, pinned=pins), [tv.Gravity(G), held], solver=solver, precision="f64")
        for factor in factors:
            held.rest = factor / N
            for substeps in (20, 200):
                w.substeps, w.velocity, w.position = substeps, np.zeros((N + 1, 2)), row()
                first = w.step(1 / 60)
                reports = [w.step(1 / 60) for _ in range(20)]
                assert not any("moved" in r.flags for r in reports) and ("moved" in first.flags) == (abs(factor - 1) > 2e-3)
                gain = max(r.energy for r in [first, *reports]) - (first.energy - first.energy_change)
                assert gain < 1e-3 * (20 / substeps) ** 2 + 1e-7 and max(r.residual for r in reports) < 0.1


def test_loads_that_passes_bear_stay(world):
    # One pass of Jacobi holds a hanging chain by violations D F h^2. Assigning the same positions again must not remove them.
    x = row(8)[:, ::-1] * [1, -1]
    features = [tv.Gravity(G), tv.Drag(20.0), tv.Distance(links(8))]
    w = world(tv.Particles(x, mass=M, pinned=[0]), features, solver=tv.Jacobi(), precision="f64", substeps=4)
    w.run(4.0)
    hung, sag = w.position, x[-1, 1] - w.position[-1, 1]
    w.position = hung
    report = w.step(1 / 60)
    assert sag > 5e-3 and np.abs(w.position - hung).max() < 0.05 * sag and "moved" not in report.flags


@pytest.mark.slow
def test_springs_that_become_rigid_bring_no_energy(world):
    # At rest on springs: a weight on a link; one at the end of an arm; a square of a soft cluster that hangs on two links. What a
    # spring of 0.01 m/N has given way by is 0.1 m, which a pass would take out in one substep: up to 4e6 J. They go to where they
    # are met, as if they were placed, and stay there, but for what passes leave of a cluster under its own weight, about 2 g h^2,
    # and of a link that bears it, with 4 g h^2.
    square = np.array([(2, 4), (2.5, 4), (2.5, 4.5), (2, 4.5)])
    x = np.concatenate([[(-3, 5), (-3, 4), (-6, 5), (-5, 5), (-4, 5)], square, [(2, 5), (2.5, 5)]])
    links = tv.Distance([[0, 1], [3, 4], [8, 9], [7, 10]], compliance=[0.01, 0, 0, 0])
    soft = [links, tv.Bend([[2, 3, 4]], compliance=0.02), tv.ShapeMatch([[5, 6, 7, 8]], compliance=0.01)]
    start = tv.Particles(x, pinned=[0, 2, 3, 9, 10])
    for substeps in (2, 200):
        features = [f.copy() for f in soft]
        w = world(start, [*features, tv.Gravity(G), tv.Drag(8.0)], precision="f64", substeps=20)
        w.run(6.0)
        assert w.position[1, 1] == pytest.approx(4 - 0.01 * G, abs=1e-6)
        w.substeps, h = substeps, 1 / 60 / substeps
        for f in features:
            f.compliance = 0.0
        reports = [w.step(1 / 60) for _ in range(10)]
        assert ["moved" in r.flags for r in reports] == [True] + [False] * 9 and reports[0].flags == {"moved"}
        np.testing.assert_allclose(w.position[[1, 4]], [(-3, 4), (-4, 5)], atol=1e-4)
        end = w.position[5:9]
        sides = np.linalg.norm(end - np.roll(end, 1, axis=0), axis=1)
        np.testing.assert_allclose(sides, 0.5, atol=1e-4 + 3 * G * h * h)
        assert end[:, 1].min() == pytest.approx(4.0, abs=1e-4 + 8 * G * h * h)
        assert np.abs(w.velocity).max() < 0.01 + G * h / 8


@pytest.mark.slow
def test_a_lattice_that_becomes_rigid_gains_no_energy(world):
    # All clusters of a lattice together are one rigid body. Soft ones that hang from a corner and turn about it go to their rigid
    # shape with the velocities that they have: their energy is m g y there, and the kinetic energy before, at most. Passes would
    # make up to 4e5 J of 87.
    g = np.stack(np.divmod(np.arange(15), 3), axis=1)
    clusters = [[3 * i + j + k for k in (0, 1, 3, 4)] for i in range(4) for j in range(2)]
    x, shapes = 0.2 * g, tv.ShapeMatch(clusters, compliance=2e-4, damping=0.2)
    w = world(tv.Particles(x, pinned=[14]), [tv.Gravity(G), shapes], substeps=2)
    w.run(15 / 60)
    kinetic, arm, q = tv.measure.kinetic_energy(w), w.position - x[14], x - x[14]
    shapes.compliance = 0.0
    reports = [w.step(1 / 60) for _ in range(8)]
    before = reports[0].energy - reports[0].energy_change
    turn = np.angle(((arm[:, 0] + 1j * arm[:, 1]) * (q[:, 0] - 1j * q[:, 1])).sum())  # that fits best about the corner
    height = x[14, 1] + np.sin(turn) * q[:14, 0] + np.cos(turn) * q[:14, 1]
    assert before == pytest.approx(kinetic + G * height.sum(), rel=0.01)
    assert ["moved" in r.flags for r in reports] == [True] + [False] * 7
    assert max(r.energy for r in reports) < before + 0.01 * abs(before)


def test_what_is_placed_has_no_speed(world):
    # A floor that is raised during a frame throws a disc up at 6 m/s; one that is there at once does not.
    for place in (False, True):
        floor, hand = tv.HalfSpace((0, 1), 0.0), tv.Pin([1], [(3.0, 3.0)])
        w = world(tv.Particles([(0.0, 0.3), (3.0, 3.0)], radius=0.1), [tv.Gravity(0.0), floor, hand], precision="f64")
        w.step(1 / 60)
        if place:
            w.place(floor, offset=0.1)
            w.place(hand, target=[(5.0, 3.0)])
            np.testing.assert_allclose(w.position[1], (5.0, 3.0))
        else:
            floor.offset, hand.target = 0.3, [(5.0, 3.0)]
        w.step(1 / 60)
        speed = np.abs(w.velocity).max(axis=1)
        assert (speed < 1e-9).all() if place else (speed > [5.0, 100.0]).all()
    with pytest.raises(TypeError, match="has no knob height; it has .*offset"):
        w.place(floor, height=1.0)
    with pytest.raises(ValueError, match="no wall, Pin or Path"):
        w.place(w.features[0], g=1.0)
    box = tv.Box((0.0, 0.0), (1.0, 1.0))  # both corners pass the place of the other one
    w = world(tv.Particles([(0.5, 0.5)], radius=0.1), [box])
    w.shift((5.0, 0.0))
    w.place(box, lower=(1.0, 0.0), upper=(2.0, 1.0))
    with pytest.raises(ValueError, match="goes from 3 to 2 m"):
        w.place(box, lower=(3.0, 0.0), upper=(2.0, 1.0))
    np.testing.assert_array_equal([box.lower, box.upper], [(1, 0), (2, 1)])
    w = world(tv.Particles([(0.5, 0.5)]), [tv.Periodic((0, 0), (1, 1))])
    with pytest.raises(ValueError, match="Periodic.* is fixed in space. Remove it"):
        w.shift((1.0, 0.0))


@pytest.mark.parametrize("e", [0.0, 1.0])
def test_a_shift_before_other_substeps_changes_nothing(world, e):
    # Planks on links are as stiff after a change of substeps as their energy allows, which a shift changes by m g . by.
    plank, by, rng = np.array([[0, 0], [0.3, 0], [0.3, 0.06], [0, 0.06]]), np.array([0.75, 0.25]), np.random.default_rng(3)
    x = np.concatenate([*(plank + [0.4 * j + 0.1, 1.2] for j in range(5)), [[0, 1.2], [2.1, 1.2]]])
    rows = [np.arange(4) + 4 * j for j in range(5)]
    links = np.c_[[20, *(r[1] for r in rows)], [*(r[0] for r in rows), 21]]
    start = tv.Particles(x, mass=np.r_[np.full(20, 0.25), 1, 1], radius=0.02, pinned=[20, 21])
    floor = tv.HalfSpace((0, 1), 0.9, restitution=e)
    w = world(start, [tv.Gravity(9.81), tv.ShapeMatch(rows), tv.Distance(links), floor], precision="f64", substeps=20)
    for _ in range(40):
        n = int(rng.integers(2, 41))
        with w.clone() as shifted:
            shifted.shift(by)
            w.substeps = shifted.substeps = n
            for one in (w, shifted):
                one.step(1 / 60)
            np.testing.assert_allclose(shifted.position - by, w.position, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_shifted_scene_goes_on_as_it_was(world, tmp_path):
    # Walls, pins that drive and draw, forces: everything but the origin stays. In f64, 1000 m away, positions agree to the digits
    # that are left there. A recording goes on.
    by, rope = np.array([-1024.0, -256.0]), tv.shapes.rope((1.0, 3.0), (2.0, 3.0), 6)
    x = np.vstack([rope.position, [(0.3, 0.1), (3.5, 0.6), (2.2, 2.5)]])
    ball, features = tv.Ball((3.4, 0.2), 0.3), [
        tv.Gravity(9.81), tv.Distance(rope.links), tv.Pin([0], [(1.0, 3.0)]), tv.Pin([5], [(2.1, 3.0)], compliance=1e-3),
        tv.Capsule((2, 1), (2.5, 1.2), 0.1), tv.HalfSpace((0.0, 1.0), 0.0, friction=0.4), tv.Attractor((2.0, 8.0), 0.5),
    ]  # fmt: skip
    w = world(tv.Particles(x, radius=0.1), [ball, *features], precision="f64", substeps=8)
    w.run(0.3)
    ball.center = (3.42, 0.2)  # a wall that moves on
    w.step(1 / 60)
    with w.clone() as twin, tv.Recorder(tmp_path / "shift.rrd", twin) as recorder:
        twin.shift(by)
        np.testing.assert_array_equal(twin.position, w.position + by)
        for _ in range(20):
            for one in (w, twin):
                one.features[0].center = one.features[0].center + [0.001, 0.0]
                assert not one.step(1 / 60).flags
            recorder.log()
        np.testing.assert_allclose(twin.position - by, w.position, atol=1e-9)
        np.testing.assert_allclose(twin.velocity, w.velocity, atol=1e-8)
    assert tv.replay(tmp_path / "shift.rrd").verify()
