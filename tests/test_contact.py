"""Contacts: what overlaps parts gently, what rests stays where it is, and flags tell of what does not."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, SLOP


def smooth(world, start, wide=(99.0, 99.0), g=9.81, rate=0.0, low=(0.0, 0.0), precision="f32", **settings):
    """Build a world of discs without friction in a box; all such worlds share one structure."""
    features = [tv.Gravity(g), tv.Drag(rate), tv.Contact(push_out=settings.pop("push_out", 1.0)), tv.Box(low, wide)]
    return world(start, features, precision=precision, **settings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*near pairs per particle")
@pytest.mark.parametrize("dim", [2, 3])
def test_overlap_parts_at_push_out_without_velocity(world, dim):
    # Positions part at push_out, whatever the depth, until what is left is the overlap in which contacts rest. What is in the
    # same place parts along a normal that is made from the indices, equal and opposite (rows 16 and 48). Two that overlap; then,
    # far from each other, ten in a row, each in the next one by a fifth, 2 and 30 in the same place, and one 1 cm beside the
    # middle between two pinned ones, which would have a speed without limit, were it as fast as overlap parts.
    speed, slop, a = 0.25, SLOP * BEYOND * 0.1, np.eye(dim)[1]

    def overlapping(x, pinned):
        w = world(tv.Particles(x, radius=0.1, pinned=pinned), [tv.Contact(push_out=0.0)], precision="f64", substeps=10)
        w.run(0.05)
        np.testing.assert_array_equal(w.position, x)  # at push_out = 0 nothing parts
        w.features[0].push_out = speed
        return w

    w = overlapping([0 * a, 0.05 * a, 9 * a], [2])
    for _ in range(2):  # at the start, and after the user has placed them so
        w.position, w.velocity = w.particles.position, np.zeros((3, dim))
        w.run(0.2)
        assert 0.8 * speed < (np.linalg.norm(w.position[1] - w.position[0]) - 0.05) / 0.2 < 1.3 * speed  # as passes overshoot
        w.run(1.0)
        assert 0.2 - slop <= np.linalg.norm(w.position[1] - w.position[0]) <= 0.2 + 1e-12
        np.testing.assert_array_equal(w.velocity, 0)
    row, twins, crowd, wedge = slice(10), slice(10, 12), slice(12, 42), slice(42, 45)
    x = np.concatenate([np.arange(10)[:, None] * 0.16 * a, np.zeros((32, dim)), [0 * a, 0.3 * a, 0.15 * a]])
    x[:, 0] = np.repeat([50.0, 100.0, 150.0, 200.0, 199.99], [10, 2, 30, 2, 1])
    w = overlapping(x, [42, 43])
    found = w.contacts
    normal = found.normal[(found.pairs == (10, 11)).all(axis=1)]
    assert len(normal) == 1 and np.linalg.norm(normal) == pytest.approx(1.0, rel=1e-12)
    w.step(1 / 60)
    apart, fastest = w.position[10] - w.position[11], 0.0
    np.testing.assert_allclose(apart / np.linalg.norm(apart), normal[0], atol=1e-9)
    for _ in range(90):
        before = w.position[row]
        w.step(1 / 60)
        fastest = max(fastest, np.ptp(60 * (w.position[row] - before), axis=0).max())
        assert np.abs(w.velocity[wedge]).max() < 1e-6
        # Neighbours part at `speed`. Across a cluster of N particles, speeds add up to `speed` times its width in particles.
        assert np.linalg.norm(w.velocity[crowd], axis=1).max() <= speed * 2 * np.ceil(30 ** (1 / dim))
    assert speed / 2 < fastest < 9 * speed and w.last.overlap < 3 * SLOP  # each pair at push_out
    assert np.linalg.norm(w.position[44] - w.position[42:44], axis=1).min() > 0.2 - slop - 1e-6
    for some in (row, twins, crowd):
        assert np.abs((w.position[some] - x[some]).mean(axis=0)).max() < 1e-9


def test_a_column_of_60_stands(world):
    x = np.stack([np.full(60, 0.1), 0.1 + 0.2001 * np.arange(60)], axis=1)
    w = smooth(world, tv.Particles(x, radius=0.1), (0.2, 20), substeps=2)
    for substeps in (2, 8):
        w.position, w.velocity, w.substeps = x, 0 * x, substeps
        report = w.run(2.0)  # a load needs as many passes as there are discs to reach the floor
        assert report.clean and report.overlap < (0.05 if substeps == 2 else SLOP * BEYOND)


def test_outrunning_the_contacts_is_flagged(world):
    # At v h / r = 0.5 the pair is caught; above 1 it may pass through, which is flagged. Those that come from 0.22 m to behind
    # each other in a substep, and are further apart at its end than what rows look ahead, are met on the way.
    r, h = 0.1, 1 / 600
    start = tv.Particles([[-0.55, 0.0], [0.55, 0.0]], radius=r)
    w = smooth(world, start, g=0.0, low=(-99.0, -99.0), push_out=0.25, substeps=10)
    for ratio, flagged in ((0.5, False), (0.9, False), (1.0, False), (2.0, True), (5.0, True)):
        v = ratio * r / h
        w.position, w.velocity = w.particles.position, [[v, 0], [-v, 0]]
        report = w.run(0.1)
        assert ("tunnelling-risk" in report.flags) == flagged
        if not flagged:
            assert w.position[0, 0] < w.position[1, 0]
    w.substeps = 4
    for speed in (53.0, 55.0, 57.0):
        w.position, w.velocity = [(0, 0), (0.22, 0.01)], [(speed, 0), (-speed, 0)]
        assert "tunnelling-risk" in w.step(1 / 60).flags
        assert w.position[0, 0] < w.position[1, 0] and np.abs(w.velocity[:, 0]).max() < 1.0


@pytest.mark.parametrize(("part", "flags"), [(0.045, set()), (0.055, {"compressed"})])
def test_an_overlap_above_a_twentieth_of_a_radius_is_flagged(world, part, flags):
    x = [(0.0, 0.0), (0.2 - 0.1 * part, 0.0)]
    w = smooth(world, tv.Particles(x, radius=0.1), g=0.0, low=(-99.0, -99.0), push_out=1e-3, substeps=4)
    assert w.step(1 / 60).flags == flags


def test_overlap_that_rounding_makes_is_flagged(world):
    # At 1e5 m f32 tells places 8 mm apart, which no substep makes less.
    near = tv.Particles([[1e5 + 0.1, 0.1], [1e5 + 0.126, 0.1]], radius=0.02)
    report = smooth(world, near, (1e5 + 1, 20), push_out=0.0).step(1 / 60)
    assert report.flags == {"compressed"} and "are rounded to 0.0078 m in f32" in report.notes[0]


@pytest.mark.slow
def test_a_lasting_overlap_is_flagged_and_the_advice_ends_it(world):
    # Masses of 1, 1000 and 1e5 kg on each other: at 4 substeps they would rest a third of a radius in each other, without a word.
    x, radius, mass = [(0, 0.1), (0, 0.45), (0.05, 0.8)], [0.1, 0.25, 0.1], [1.0, 1e3, 1e5]
    start = tv.Particles(np.add(x, (0.3, 0)), radius=radius, mass=mass)
    w = smooth(world, start, (0.6, 9), push_out=None, substeps=4)
    for _ in range(6):
        w.run(1.0)
        report = w.step(1 / 60)
        if report.clean:
            break
        assert report.flags == {"compressed"} and report.overlap > 0.05
        w.substeps = int(report.notes[0].partition("Use up to ")[2].partition(" substeps")[0])
    assert w.substeps > 20 and report.overlap < 0.05
