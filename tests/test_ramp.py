"""Assigned rest values: how they are reached in the next frame, and what energy that costs."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.step import checkpoint

DT, L, M = 1 / 60, 0.5, 0.2


def pendulum(world, *features, **options):
    """Return a world with one particle of mass M at a distance L from a pinned one, without gravity."""
    return world(tv.Particles([[0.0, 0], [L, 0]], mass=M, pinned=[0]), [tv.Gravity(0.0), *features], **options)


def test_a_link_is_drawn_in_at_the_speed_of_the_frame(world):
    # The rest length goes from L to 0.9 L in a frame, so the particle moves at u = 0.1 L / dt and has m u^2 / 2, for any number
    # of substeps. A jump would be made in one substep, with m (0.1 L / h)^2 / 2. Then the particle stands still, because a link
    # also holds.
    link = tv.Distance([[0, 1]])
    w = pendulum(world, link, solver=tv.Direct(), precision="f64")
    w.step(DT)
    length = L
    for substeps in (1, 7, 200):
        w.substeps = substeps
        w.step(DT)
        link.rest, length = 0.9 * length, 0.9 * length
        report = w.step(DT)
        assert report.energy == pytest.approx(M * (length / 9 / DT) ** 2 / 2, rel=1e-9)
        assert w.position[1, 0] == pytest.approx(length, rel=1e-12)
        assert w.step(DT).energy == pytest.approx(0, abs=1e-18) and w.position[1, 0] == pytest.approx(length, rel=1e-12)


def test_a_state_before_a_rest_value_was_assigned_knows_of_none(world):
    # Back at a state in which no rest value was on its way, by a knob that was set back in between: the same bits as the first
    # time.
    link = tv.Distance([[0, 1]], rest=L)
    w, hashes = pendulum(world, link), []
    w.step(DT)
    kept, flagged = checkpoint.keep(w), checkpoint.flags(w)
    for _ in range(2):
        w.step(DT)
        hashes.append(w.hash())
        link.rest = 0.9 * L
        w.step(DT)
        link.rest = L
        w._rebuild_for_knobs()
        checkpoint.install(w, kept, flagged)
    assert hashes[0] == hashes[1]


def test_a_rope_that_was_drawn_in_is_slack(world):
    # As above, but a rope does not stop a particle that comes in: the next frame takes it as far.
    rope = tv.Rope([[0, 1]])
    w = pendulum(world, rope, substeps=50)
    w.step(DT)
    rope.rest = 0.9 * L
    report = w.step(DT)
    assert report.energy == pytest.approx(M * (0.1 * L / DT) ** 2 / 2, rel=1e-4)
    w.step(DT)
    assert w.position[1, 0] == pytest.approx(0.8 * L, rel=1e-5)


def test_a_muscle_does_the_work_of_its_load(world):
    # A hanging mass is drawn up by a in n frames, evenly. The work is m g a, but for the kinetic energy m u^2 / 2 of the last
    # frame, which the next frame takes back. The link changes its length at the speed of each frame, never faster.
    n, a, g = 20, 0.1, 9.81
    link = tv.Distance([[0, 1]])
    w = world(
        tv.Particles([[0.0, 0], [0, -L]], mass=M, pinned=[0]), [tv.Gravity(g), link], substeps=200, solver=tv.Jacobi(),
        precision="f64",
    )  # fmt: skip
    before = w.step(DT).energy
    speeds = []
    for k in range(n):
        link.rest = L - a * (k + 1) / n
        w.step(DT)
        speeds.append(abs(w.velocity[1, 1]))
    # Velocities are between that of the last substep, u, and that of the next, whose mean over a half step is 0.
    assert max(speeds) <= a / (n * DT) * (1 + 1e-6) + g * DT / 200
    assert w.step(DT).energy - before == pytest.approx(M * g * a, rel=1e-6)


def crowd(first=0):
    """Return some constraints with rest values, apart from each other.

    These are particles, the features of particles numbered from `first` on, and a function that turns all knobs.
    """
    x = [
        (-5.0, 0), (0, 0), (0.5, 0), (1, 0), (1.5, 0.2),  # one by itself; links, stop, rope
        (9, 0), (10, 0), (10, 1), (9, 1),  # loop
    ]  # fmt: skip
    links, stops, loops, ropes = (first + np.array(rows) for rows in ([[1, 2], [2, 3]], [[1, 2, 3]], [[5, 6, 7, 8]], [[3, 4]]))
    features = [tv.Distance(links), tv.AngleLimit(stops, -0.2, 0.3), tv.Area(loops), tv.Rope(ropes)]

    def turn(features, by):
        link, stop, loop, rope = features
        link.rest, stop.upper, rope.rest, loop.pressure = 0.5 * by, by - 0.7, 0.53 * by, 2 - by

    return tv.Particles(x, mass=0.1), features, turn


@pytest.mark.slow
def test_what_a_ramp_brings_in_does_not_depend_on_the_substep(world):
    # m (C / dt)^2 / 2 for each constraint. As jumps it would be m (C / h)^2 / 2, 64 times as much at 8 times the substeps.
    particles, features, turn = crowd()
    w = world(particles, features, solver=tv.Jacobi())
    energies = []
    for substeps in (64, 512):
        w.velocity, w.position, w.substeps = np.zeros_like(particles.position), particles.position, substeps
        turn(features, 1.0)
        w.step(DT)
        turn(features, 0.95)
        energies.append(w.step(DT).energy)
    assert energies[0] > 0.01 and energies[1] == pytest.approx(energies[0], rel=0.03)


@pytest.mark.slow
def test_springs_follow_a_moving_rest_value_to_second_order(world):
    # Weights on springs with dashpots, whose rest lengths grow by 0.5 m in a frame: beside 1024 substeps, 8 are off by a few
    # thousandths of the way. If C two substeps ago counts a step of the rest length too many, dashpots pull back by it, and the
    # way is 10 % off. Velocities of a clone are those of its world, though it knows no step.
    spring = tv.Distance([[0, 1], [1, 2]], 1.0, compliance=1e-3, damping=100.0)
    start = tv.Particles([[0.0, 0], [0, -1.0], [0, -2.0]], pinned=[0])
    w, ways = world(start, [tv.Gravity(9.81), spring], precision="f64"), []
    for w.substeps in (1024, 8):
        w.position, w.velocity, spring.rest = start.position, 0 * start.position, 1.0
        w.run(0.2)
        before, spring.rest = w.position, 1.5
        w.step(DT)
        ways.append(w.position[2, 1] - before[2, 1])
    assert ways[0] < -0.3 and ways[1] == pytest.approx(ways[0], rel=5e-3)
    twin = w.clone()
    assert np.array_equal(twin.velocity, w.velocity)
    twin.close()


def test_a_rest_value_may_change_with_the_substep(world):
    # Two weights hang on springs. As their rest lengths grow from 1 to 1.5 m in a frame, they go down,
    # also where the substep gets shorter in that frame. Links are as soft as before then, and dashpots so many times slower.
    spring = tv.Distance([[0, 1], [1, 2]], 1.0, compliance=1e-3, damping=100.0)
    start = tv.Particles([[0.0, 0], [0, -1.0], [0, -2.0]], pinned=[0])
    w = world(start, [tv.Gravity(9.81), spring], precision="f64", substeps=2, solver=tv.Jacobi())
    w.run(2.0)
    low, spring.rest, w.substeps = w.position[2, 1], 1.5, 8
    w.step(DT)
    assert -0.35 < w.position[2, 1] - low < -0.05


def test_an_angle_goes_the_shorter_way(world):
    # From 3 to -3 rad it is 2 pi - 6 = 0.283 rad, at L 0.283 / dt; the other way, through 0, would be 21 times as fast.
    x = np.array([[0.0, 0], [L, 0], [L * (1 + np.cos(3.0)), L * np.sin(3.0)]])
    bend = tv.Bend([[0, 1, 2]])
    w = world(tv.Particles(x, pinned=[0, 1]), [bend, tv.Distance([[1, 2]])], substeps=50, precision="f64", solver=tv.Jacobi())
    w.step(DT)
    bend.rest = -3.0
    assert w.step(DT).energy == pytest.approx((L * (2 * np.pi - 6) / DT) ** 2 / 2, rel=1e-2)
    assert bend.rest_of(w.position) == pytest.approx(-3.0, abs=1e-3)


@pytest.mark.slow
def test_copies_edits_and_recordings_know_where_a_ramp_begins(world, tmp_path):
    particles, features, turn = crowd()
    w = world(particles, features, solver=tv.Jacobi())
    w.step(DT)
    turn(features, 0.95)
    twin, many = w.clone(), tv.Worlds(w, 2)
    for one in (w, twin, many):
        one.step(DT)
    assert w.hash() == twin.hash() == many.hash(1)
    twin.close()
    turn(many.features, 1.0)
    turn(features, 1.0)
    many.run(2 * DT)
    w.run(2 * DT)
    assert w.hash() == many.hash(0)
    many.close()
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        for k in range(3):
            turn(features, 1.0 - 0.05 * k)
            if k == 1:
                w.remove([0])
            w.step(DT)
            recorder.log()
    assert tv.replay(tmp_path / "a.rrd").verify().kind == "intact"


@pytest.mark.slow
def test_what_comes_while_a_ramp_waits_begins_at_rest_values_of_its_own(world):
    particles, features, turn = crowd()
    n, far = len(particles), particles.position + [0, 20.0]
    w = world(particles, features, solver=tv.Jacobi())
    w.step(DT)
    turn(features, 0.95)
    twin = w.clone()
    w.add(tv.Particles(far, mass=0.1), extend=dict(zip(features, crowd(n)[1], strict=True)))
    w.step(DT)
    twin.step(DT)
    np.testing.assert_allclose(w.position[:n], twin.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(w.position[n:], far, rtol=0, atol=1e-5)
    twin.close()


def test_what_is_placed_anew_has_its_rest_values_at_once(world):
    # Positions and rest lengths that fit each other are assigned together: nothing moves.
    link = tv.Distance([[0, 1]])
    w = pendulum(world, link, substeps=200)
    w.step(DT)
    w.position, link.rest = [[0, 0], [0.3, 0]], 0.3
    assert w.step(DT).energy == pytest.approx(0, abs=1e-9) and not w.last.flags
