"""Particles that are held at targets, rigidly or by springs, and soft wires and grids, which hold them alike."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import order, rerun, rms


def test_driven_pins_follow_their_targets(world):
    # For ten metres in one frame see row 69 of tiverlet stress.
    hand = tv.Pin([0], (0.0, 0.0))
    features = [tv.Gravity(9.81), tv.Distance([[0, 1]]), hand]
    w = world(tv.Particles([[0.0, 0], [0, -1], [3, -2]]), features, substeps=40, iterations=10, precision="f64")
    for k in range(60):
        hand.target = [[0.01 * (k + 1), 0.0]]
        w.step(1 / 60)
        np.testing.assert_allclose(w.position[0], [0.01 * (k + 1), 0.0], atol=1e-15)


def test_a_pin_that_takes_another_particle_lets_the_first_go(world):
    # Both hold copies of what they are given. The energy before the frame is that of what is free then, at rest: m g y.
    hand = tv.Pin([0], (0.0, 5.0))
    x = np.array([[0.0, 5.0], [0.0, 4.0], [3.0, 2.0]])
    features = [tv.Gravity(9.81), tv.Distance([[0, 1]]), hand]
    w = world(tv.Particles(x), features, substeps=40, iterations=10, precision="f64")
    taken = np.array([2])
    hand.indices, hand.target = taken, [(3.0, 2.0)]
    taken[:] = 1
    report = w.step(1 / 60)
    assert report.energy - report.energy_change == pytest.approx(9.81 * 9.0, rel=1e-12)
    w.run(0.2 - 1 / 60)
    np.testing.assert_allclose(w.position, x - 9.81 * 0.2**2 / 2 * np.array([[0, 1], [0, 1], [0, 0]]), atol=1e-12)
    assert hand.indices.tolist() == [[2]]


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 4])
def test_what_a_pin_drags_bears_the_impulse_of_a_frame_in_its_first_substep(world, substeps):
    # x = -a t^2 / 2 at the ends of frames, about: the speed grows by a dt where frames meet, and F h = 3 m a dt for three links.
    # In frames of one substep, F = 3 m a.
    a, dt, x = 2.0, 1 / 60, np.stack([np.arange(4.0), np.zeros(4)], axis=1)
    for share in (0.999, 1.001):
        pin = tv.Pin([0])
        links = tv.Distance([[0, 1], [1, 2], [2, 3]], break_at=share * 3 * a * substeps)
        w = world(tv.Particles(x, velocity=(-a * dt / 2, 0.0)), [pin, links], substeps=substeps, precision="f64")
        for k in range(1, 6):
            pin.target = [[-a * (k * dt) * ((k + 1) * dt) / 2, 0.0]]
            w.step(dt)
            if share > 1:
                want = a * np.array([3.0, 2.0, 1.0]) if substeps == 1 else 0.0
                assert k == 1 or links.load == pytest.approx(want, abs=1e-9)
        assert links.broken.tolist() == [share < 1, False, False]


@pytest.mark.slow
def test_soft_pins_wires_and_grids_are_springs(world):
    # m x'' = -k (x - target) about a target, across a wire, and along each axis about the nearest node. Others, with dashpots,
    # come to rest there, and under gravity at the static distance g / k, while the wire lets its bead go on.
    k, t = 100.0, 1.5
    soft = {"compliance": 1 / k, "damping": [0.0, 20.0]}
    pin = tv.Pin([0, 1], [(0.0, 0.0), (0.0, 5.0)], **soft)
    wire = tv.Path([2, 3], [[0, 10], [99, 10]], smooth=False, **soft)
    grid = tv.Snap([4, 5], 1.0, origin=(0.25, 0.0), **soft)
    rows = tv.Snap([6], (np.inf, 0.5), compliance=1 / k)
    x = np.array([[0.5, 0.25], [0.1, 5.2], [1.0, 10.3], [1.0, 9.8], [0.1, 20.2], [1.4, 19.7], [2.6, 20.1]])
    v = np.array([[0, 0], [0, 0], [0, 0], [1, 0], [0, 0], [0, 0], [1, 0.0]])
    place = np.array([[0, 0], [0, 5], [1, 10], [1, 10], [0.25, 20], [1.25, 20], [2.6, 20]])
    w = world(tv.Particles(x, velocity=v), [tv.Gravity(0.0), pin, wire, grid, rows], iterations=4, precision="f64")
    assert "Pin" in w.explain()
    want, swings = (place + (x - place) * np.cos(np.sqrt(k) * t) + v * t), [0, 2, 4, 6]
    errors = [rms(rerun(w, t, substeps=n).position[swings], want[swings]) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1 and errors[-1] <= 1e-3
    w.run(1.5)
    np.testing.assert_allclose(w.position[[1, 3, 5]], place[[1, 3, 5]] + [[0, 0], [3, 0], [0, 0]], atol=1e-6)
    w.features[0].g = (0.0, -9.81)
    w.run(3.0)
    np.testing.assert_allclose(w.position[[1, 3, 5]], place[[1, 3, 5]] + np.c_[[0, 6, 0], [-9.81 / k] * 3], atol=1e-6)
    np.testing.assert_allclose(w.velocity[[1, 5]], 0.0, atol=1e-9)  # otherwise half of what gravity adds in a substep
    assert wire.load[1] == pytest.approx([0, 9.81], abs=1e-4)


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: setattr(tv.Pin([0, 1]), "indices", [0]), "has 1 particles, but this Pin holds 2"),
        (lambda: setattr(tv.Pin([0, 1]), "indices", [1, 1]), "named twice"),
        (lambda: tv.World(tv.Particles(np.zeros((5, 2))), [tv.Pin([0, 9])]), "there are 5 particles"),
        (lambda: tv.Snap([0], 1.0, compliance=0.0), r"Snap: compliance\[0\] = 0"),
        (lambda: tv.World(tv.Particles([[0.0, 0]]), [tv.Snap([0], 0.0, compliance=1.0)]), r"Snap: spacing\[0\] = 0"),
    ],
)
def test_pins_and_grids_that_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
