"""Particles that are held at targets, driven or by springs."""

import numpy as np

import tiverlet as tv

from .conftest import order, rerun, rms


def test_driven_pins_follow_their_targets(world):
    hand = tv.Pin([0], (0.0, 0.0))
    w = world(
        tv.Particles([[0.0, 0], [0, -1]]),
        [tv.Gravity(9.81), tv.Distance([[0, 1]]), hand],
        substeps=40,
        iterations=10,
        precision="f64",
    )
    for k in range(60):
        hand.target = [[0.01 * (k + 1), 0.0]]
        w.step(1 / 60)
        np.testing.assert_allclose(w.position[0], [0.01 * (k + 1), 0.0], atol=1e-15)
    # Row 69: ten metres in one frame. It stays bounded, the link recovers, and the work done is reported.
    hand.target = (10.0, 0.0)
    report = w.step(1 / 60)
    assert report.energy_change > 1e3 and np.isfinite(w.position).all()
    w.run(1.0)
    assert w.last.residual < 1e-3 and np.abs(w.position - [10.0, 0]).max() <= 1.1


def test_soft_pins_are_springs(world):
    # m x'' = -k (x - target): like the oscillator, along both axes; and it follows a moving target at the static distance.
    k = 100.0
    w = world(
        tv.Particles([[0.5, 0.25]]),
        [tv.Pin([0], (0.0, 0.0), compliance=1 / k)],
        iterations=3,
        precision="f64",
    )
    want = np.array([0.5, 0.25]) * np.cos(20.0)
    errors = [rms(rerun(w, 2.0, substeps=n).position[0], want) for n in (10, 20, 40)]
    assert 1.9 <= order(errors) <= 2.1
    hand = tv.Pin([0], (0.0, 0.0), compliance=1 / k, damping=20.0)
    w = world(tv.Particles([[0.0, 0.0]]), [tv.Gravity(9.81), hand], iterations=4, precision="f64")
    w.run(3.0)
    np.testing.assert_allclose(w.position[0], [0, -9.81 / k], atol=1e-7)
