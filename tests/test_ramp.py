"""Assigned rest values: how they are reached in the next frame, and what energy that costs."""

import numpy as np
import pytest

import tiverlet as tv

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
    # Positions and rest lengths that fit each other are assigned together: nothing moves.
    w.position, link.rest = [[0, 0], [0.3, 0]], 0.3
    assert w.step(DT).energy == pytest.approx(0, abs=1e-9) and not w.last.flags


def test_a_rope_that_was_drawn_in_is_slack(world):
    # As above, but a rope does not stop a particle that comes in: the next frame takes it as far.
    rope = tv.Rope([[0, 1]])
    w = pendulum(world, rope, substeps=50, precision="f64")
    w.step(DT)
    rope.rest = 0.9 * L
    assert w.step(DT).energy == pytest.approx(M * (0.1 * L / DT) ** 2 / 2, rel=1e-4)
    w.step(DT)
    assert w.position[1, 0] == pytest.approx(0.8 * L, rel=1e-5)


@pytest.mark.slow
def test_a_muscle_does_the_work_of_its_load(world):
    # A hanging mass is drawn up by a in n frames, evenly. The work is m g a, but for the kinetic energy m u^2 / 2 of the last
    # frame, which the next frame takes back. The link changes its length at the speed of each frame, never faster.
    n, a, g = 20, 0.1, 9.81
    link, start = tv.Distance([[0, 1]]), tv.Particles([[0.0, 0], [0, -L]], mass=M, pinned=[0])
    w = world(start, [tv.Gravity(g), link], substeps=200, solver=tv.Jacobi(), precision="f64")
    before = w.step(DT).energy
    speeds = []
    for k in range(n):
        link.rest = L - a * (k + 1) / n
        w.step(DT)
        speeds.append(abs(w.velocity[1, 1]))
    # Velocities are between that of the last substep, u, and that of the next, whose mean over a half step is 0.
    assert max(speeds) <= a / (n * DT) * (1 + 1e-6) + g * DT / 200
    assert w.step(DT).energy - before == pytest.approx(M * g * a, rel=1e-6)


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
    with w.clone() as twin:
        np.testing.assert_array_equal(twin.velocity, w.velocity)


@pytest.mark.slow
def test_what_comes_while_a_rest_value_changes_begins_at_its_own(world):
    # And what was there goes on as in a clone without the new links.
    links, x = tv.Distance([[0, 1], [1, 2]]), np.array([(0.0, 0), (0.5, 0), (1, 0)])
    w = world(tv.Particles(x, mass=M), [links], solver=tv.Jacobi())
    w.step(DT)
    links.rest = 0.45
    with w.clone() as twin:
        w.add(tv.Particles(x + [0, 20.0], mass=M), extend={links: tv.Distance([[3, 4], [4, 5]], 0.5)})
        w.step(DT)
        twin.step(DT)
        np.testing.assert_allclose(w.position[:3], twin.position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(w.position[3:], x + [0, 20.0], rtol=0, atol=1e-5)
