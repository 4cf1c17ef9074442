"""Queries of points and contacts against brute force."""

import numpy as np
import pytest

import tiverlet as tv


@pytest.mark.slow
@pytest.mark.parametrize("kind, dim", [("one size", 3), ("many sizes", 2), ("no contacts", 2)])
def test_near_and_nearest_equal_brute_force(world, dim, kind):
    # For particles of one size in 2D see the nearest image in test_periodic.py.
    rng = np.random.default_rng(5)
    x = 6 * tv.golden(np.arange(400), dim=dim) - 3
    radius = 10.0 ** rng.uniform(-3, -1, 400) if kind == "many sizes" else 0.05
    features = [] if kind == "no contacts" else [tv.Contact()]
    w = world(tv.Particles(x, radius=radius), features, precision="f64", path="launched")  # its list has its own kernel
    x = w.position = x + 0.01 * np.sin(7 * x)
    points = np.concatenate([rng.uniform(-3.5, 3.5, (50, dim)), x[:5], [[40.0] * dim, [1e10] * dim]])
    for reach in (0.0, 0.3, 2.0, 1e30):  # the last one has more cells than integers can count
        distance = np.linalg.norm(x[None] - points[:, None], axis=-1)
        np.testing.assert_array_equal(w.near(points, reach), np.argwhere(distance <= reach))
    index, length = w.nearest(points)
    np.testing.assert_array_equal(index, distance.argmin(axis=1))
    np.testing.assert_allclose(length, distance.min(axis=1), atol=1e-14)
    assert w.near(np.zeros((0, dim)), 1.0).shape == (0, 2)
    with pytest.raises(ValueError, match=r"radius\[0\] = -1"):
        w.near(points, -1.0)
    with pytest.raises(ValueError, match="points has shape"):
        w.nearest(np.zeros((3, 5 - dim)))


@pytest.mark.slow
def test_neighbours_ten_million_radii_from_the_origin(world):
    # One f32 has steps of a radius there. Positions have two words, so the cells must read both, and points keep their digits.
    rng = np.random.default_rng(0)
    corner, radius = 3e5, 0.03
    box = tv.Periodic((corner, corner), (corner + 1, corner + 1))
    x = corner + rng.uniform(0, 1, (300, 2))
    w = world(tv.Particles(x, radius=radius), [tv.Contact(), box], precision="f32-compensated")
    w._runner.list_neighbours()

    def distances(a, b):
        r = a[:, None] - b
        return np.linalg.norm(box.difference(r, 0 * r), axis=-1)

    i, j = w._runner.search.list.entries()[0].T
    listed = np.zeros((len(x), len(x)), dtype=bool)
    listed[i, j] = True
    near = distances(w.position, w.position) < 2 * radius + 0.999 * w._runner.search.skin
    assert (listed >= near & ~np.eye(len(x), dtype=bool)).all()
    points = corner + rng.uniform(0, 1, (100, 2))
    distance = distances(points, w.position)
    np.testing.assert_array_equal(w.near(points, radius), np.argwhere(distance <= radius))
    np.testing.assert_array_equal(w.nearest(points)[0], distance.argmin(axis=1))


def test_contacts_are_arrays(world):
    rng = np.random.default_rng(6)
    x, radius = rng.uniform(-1, 1, (300, 3)), rng.uniform(0.02, 0.2, 300)
    w = world(tv.Particles(x, radius=radius), [tv.Contact()], precision="f64", path="launched")  # see above
    pairs, depth = tv.measure.overlapping(x, radius)
    contacts = w.contacts
    np.testing.assert_array_equal(contacts.pairs, pairs)
    np.testing.assert_allclose(contacts.overlap, depth, rtol=1e-12)
    d = x[pairs[:, 0]] - x[pairs[:, 1]]
    np.testing.assert_allclose(contacts.normal, d / np.linalg.norm(d, axis=1)[:, None], rtol=1e-12)
    assert len(world(tv.Particles(x, radius=radius)).contacts) == 0


@pytest.mark.slow
def test_contacts_of_a_pinned_particle_that_another_has_left(world):
    # A pair with stored data stays on the list of the moving particle, however far that is; the pinned particle stores nothing.
    start = tv.Particles([(0.0, 0.0), (0.15, 0.0), (0.0, 0.3)], radius=0.1, pinned=[0], velocity=[(0, 0), (400.0, 0), (0, 0)])
    w = world(start, [tv.Contact(friction=0.5, restitution=1.0)], substeps=1)
    for _ in range(3):
        w.step(1 / 60)
        found = w.contacts
        assert (found.pairs[:, 0] < found.pairs[:, 1]).all()
    assert tv.measure.kinetic_energy(w) > 0
