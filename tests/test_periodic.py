"""Periodic boxes and Lees-Edwards shear: against explicit images, closed forms and conservation laws."""

from itertools import product

import numpy as np
import pytest

import tiverlet as tv
from tiverlet import measure
from tiverlet.device import ti

DT = 1 / 60


@ti.func
def soft(r):
    """Return a repulsion that ends smoothly at 0.5 m: F = 40 (1 - 2 |r|)^2 r / |r|."""
    s = r.norm()
    return 40.0 * (1.0 - 2.0 * s) ** 2 * r / s


@ti.func
def soft_energy(r):
    return 20.0 / 3.0 * (1.0 - 2.0 * r.norm()) ** 3


def by_images(a, b, length, axes, offset=0.0):
    """Return |a_i - b_j| to the nearest of all images around, computed one by one, (len(a), len(b)) [m]."""
    length = np.asarray(length, dtype=float)

    def folded(x):
        x = np.array(x, dtype=float)
        for k in sorted(axes, reverse=True):  # y before x: a turn along y shifts x
            turns = np.floor(x[:, k] / length[k])
            x[:, k] -= turns * length[k]
            x[:, 0] -= turns * offset * (k == 1)
        return x

    a, b = folded(a), folded(b)
    out = np.full((len(a), len(b)), np.inf)
    steps = [range(-2, 3) if k == 0 and k in axes else range(-1, 2) if k in axes else (0,) for k in range(len(length))]
    for step in product(*steps):
        image = b + np.array(step) * length
        image[:, 0] += step[1] * offset
        out = np.minimum(out, np.linalg.norm(a[:, None] - image, axis=2))
    return out


MIXED = (0.3, 0.1, 0.04)
BOXES = {  # lengths, axes, shear, radii; several sizes of cells wherever that makes other kernels
    "2D, sheared": ((8.0, 7.0), (0, 1), 1.5, MIXED),
    "2D, sheared, one cell": ((3.0, 1.35), (0, 1), -5.0, MIXED),
    "2D, sheared, more cells than buckets": ((300.0, 160.0), (0, 1), 0.3, MIXED),
    "3D, sheared": ((4.0, 3.0, 2.5), (0, 1, 2), 2.0, (0.3,)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BOXES])
def test_contacts_and_queries_find_the_nearest_image(world, name):
    length, axes, shear, radii = BOXES[name]
    length, rng = np.array(length), np.random.default_rng(0)
    dim, n = len(length), 60
    x = rng.uniform(-2, 3, (n, dim)) * np.where(np.isin(np.arange(dim), axes), length, length / 5)
    if name.endswith("buckets"):
        x = rng.integers(-3, 4, (n, dim)) * length + rng.uniform(-1.2, 1.2, (n, dim))  # around a corner of the box
    radius, v = rng.choice(radii, n), rng.normal(size=(n, dim))
    v[:, 0] += shear * x[:, 1]
    box = tv.Periodic(np.zeros(dim), length, axes, shear=shear)
    w = world(tv.Particles(x, velocity=v, radius=radius), [tv.Contact(0.4, 0.6), box], substeps=4, precision="f64")
    found = 0
    for _ in range(8):
        report = w.step(DT)
        distance = by_images(w.position, w.position, length, axes, box.offset)
        depth = np.triu(radius[:, None] + radius - distance, 1)
        there = set(map(tuple, np.argwhere(depth > 1e-4).tolist()))
        contacts = w.contacts  # of the frame's list, and of one built anew
        assert {tuple(p) for p, d in zip(contacts.pairs.tolist(), contacts.overlap, strict=True) if d > 1e-4} == there
        assert report.contacts >= len(there)
        pairs, deep = measure.overlapping(w.position, radius, 0.0, box)
        assert {tuple(p) for p, d in zip(pairs.tolist(), deep, strict=True) if d > 1e-4} == there
        found += len(there)
    assert found > 10 and np.isclose(box.strain, shear * 8 * DT)
    points, reach = rng.uniform(-3, 3, (15, dim)) * length, rng.uniform(0.1, 0.45, 15) * length.min()
    distance = by_images(points, w.position, length, axes, box.offset)
    np.testing.assert_array_equal(w.near(points, reach), np.argwhere(distance <= reach[:, None]))
    index, near = w.nearest(points)
    np.testing.assert_array_equal(index, distance.argmin(axis=1))
    np.testing.assert_allclose(near, distance.min(axis=1), atol=1e-11 * length.max())
    inside = box.wrap(w.position)[:, list(axes)]
    assert (inside >= -1e-9).all() and (inside < length[list(axes)] + 1e-9).all()
    np.testing.assert_allclose(w.position - box.wrap(w.position), box.away(box.boxes(w.position)), atol=1e-9)
    # Positions that are not finite have no image, and no warning is issued.
    nowhere = np.array([[np.inf, 1.0, 0.0], [1.0, 1e300, 0.0], [np.nan, 0.0, 0.0]])[:, :dim]
    assert not np.isfinite(box.difference(nowhere, points[:3])).all(axis=1)[[0, 2]].any()


@pytest.mark.slow
def test_a_collision_across_the_boundary_is_that_with_the_image(world):
    # Two discs, one at the top and one at the bottom of the box. Without a box, the second disc is its own image, a box higher:
    # faster by shear times that height, and farther by the strain so far. They meet after t: |r + t u| = 0.5. There the impulse
    # along the normal is m (1 + e) u_n, and across it friction stops the slip or is mu times that.
    length, shear, mu, e = np.array([5.0, 4.0]), 0.8, 0.4, 0.6
    x, v, m = np.array([[1.0, 3.7], [1.3 - 1.28 * shear, 0.4]]), np.array([[0.2, 0.5], [-0.1, -0.4]]), np.array([1.0, 2.0])
    # Far from them particles of other sizes stay in the flow: one structure with the test above.
    more, flow = np.array([[2.5, 1.0], [2.5, 2.0]]), np.array([[shear, 0.0], [2 * shear, 0.0]])
    start = tv.Particles([*x, *more], velocity=[*v, *flow], radius=[0.25, 0.25, 0.1, 0.04], mass=[*m, 1, 1])
    w = world(start, [tv.Contact(mu, e), tv.Periodic((0, 0), length, shear=shear)], precision="f64")
    w.run(1 / 3)
    image, faster = np.array([0.0, length[1]]), np.array([shear * length[1], 0.0])
    r, u = x[0] - x[1] - image, v[0] - v[1] - faster
    a, b, c = u @ u, r @ u, r @ r - 0.5**2
    t = (-b - np.sqrt(b * b - a * c)) / a
    n, reduced = (r + t * u) / 0.5, m.prod() / m.sum()
    slip, push = u - (u @ n) * n, -reduced * (1 + e) * (u @ n)
    drag = -slip * min(reduced, mu * push / np.linalg.norm(slip))
    after = v + np.array([[1.0], [-1.0]]) * (push * n + drag) / m[:, None]
    assert 0.2 < t < 0.3
    np.testing.assert_allclose(w.velocity, [*after, *flow], atol=1e-11)
    np.testing.assert_allclose(w.position[:2], x + t * v + (w.time - t) * after, atol=1e-11)


LOOP = [[0, 1, 2, 3]]


@pytest.mark.slow
def test_soft_bodies_pass_the_boundary_as_if_there_were_none(world):
    # Members of a body that is given whole are the nearest images of each other. In the larger box they never reach the boundary.
    square, found = np.array([[0.0, 0], [0.6, 0], [0.6, 0.6], [0, 0.6]]), []
    for size in (2, 200):
        edges, bends = [[0, 1], [1, 2], [2, 3], [3, 0]], tv.Bend([[0, 1, 2], [2, 3, 0]], 1.7, compliance=1e-2)
        features = [tv.Area(LOOP, pressure=1.2, compliance=1e-4), tv.Distance(edges, compliance=1e-4), bends]
        box = tv.Periodic((0, 0), (size, size))
        w = world(tv.Particles(square + 1.2, velocity=(2.0, 1.0)), [box, *features], precision="f64")
        w.run(0.8)
        found.append(w.position)
    np.testing.assert_allclose(*found, atol=1e-10)


@pytest.mark.slow
def test_forces_between_images_are_those_of_brute_force_and_keep_energy(world):
    rng, length, n = np.random.default_rng(2), np.array([4.0, 3.0]), 60
    x, v = (rng.uniform(0, 1, (n, 2)) + rng.integers(-2, 3, (n, 2))) * length, rng.normal(size=(n, 2))
    box, force = tv.Periodic((0, 0), length), tv.PairForce(soft, 0.5, potential=soft_energy)
    w = world(tv.Particles(x, velocity=0 * v), [box, force], substeps=1, precision="f64")
    h = 1e-3  # one substep from rest: x = x0 + h^2 a / 2
    w.step(h)
    r = box.difference(x[:, None], x)
    s = np.linalg.norm(r, axis=2)
    np.testing.assert_allclose(s, by_images(x, x, length, (0, 1)), atol=1e-12)
    near = (s < 0.5) & (s > 0)
    a = (np.where(near, 40 * (1 - 2 * s) ** 2 / np.where(near, s, 1), 0)[..., None] * r).sum(axis=1)
    np.testing.assert_allclose(w.position - x, h * h / 2 * a, rtol=0, atol=1e-13)
    w.velocity, w.position, w.substeps = v, x, 50
    w.step(1e-9)
    energy, momentum = w.last.energy, measure.momentum(w)
    w.run(1.0)
    # Order 2: h = 3e-4 s and omega is about 15 / s, so the error is (omega h)^2 = 2e-5 of the energy that oscillates.
    np.testing.assert_allclose(w.last.energy, energy, rtol=2e-4)
    np.testing.assert_allclose(measure.momentum(w), momentum, atol=1e-10)


def strain(w):
    """Return the shear strain of the first feature of a world, a box."""
    return w.features[0].strain


@pytest.mark.slow
def test_a_shear_is_live_and_each_of_many_worlds_has_its_own(world):
    box = tv.Periodic((0, 0), (4, 3))
    w = world(tv.Particles([[0.5, 0.5]], radius=0.1), [box, tv.PairForce(soft, 0.5)], precision="f64")
    w.step(DT)
    assert box.strain == 0
    box.shear = 2.0
    w.step(DT)
    assert np.isclose(box.strain, 2 * DT) and np.isclose(box.offset, 2 * DT * 3)
    with tv.Worlds(w, 3) as many:
        many.set(many.features[0], shear=[0.5, 1.0, -1.0])
        many.step(DT)
        np.testing.assert_allclose(many.each(strain), (2 + np.array([0.5, 1.0, -1.0])) * DT, rtol=1e-12)


@pytest.mark.slow
def test_obstacles_meet_images(world):
    # Discs of radius 0.1 fly around the box, 4 m long, until they meet an obstacle that reaches 0.5 m from its centre, and back:
    # from x = 3 m they fly 1.9 m of their 4 m to the image of the obstacle, at 5.5 - 0.6 = 4.9 m, and 2.1 m back.
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    obstacles = [
        tv.Ball((1.5, 1.0), 0.5, restitution=1.0), tv.Capsule((1.5, 2.7), (1.5, 3.3), 0.5, restitution=1.0),
        tv.Polygon(square + (1.5, 5.0), restitution=1.0),
    ]  # fmt: skip
    x = np.concatenate([[(3.0, y), (11.0, y - 6.0)] for y in (1.0, 3.0, 5.0)])
    w = world(tv.Particles(x, velocity=(2.0, 0.0), radius=0.1), [tv.Periodic((0, 0), (4, 6)), *obstacles], precision="f64")
    w.run(2.0)
    np.testing.assert_allclose(w.position, x - (0.2, 0.0), atol=1e-9)
    np.testing.assert_allclose(w.velocity, np.tile([-2, 0], (6, 1)), atol=1e-9)


@pytest.mark.slow
def test_f32_with_low_words_is_as_good_a_hundred_boxes_away(world):
    # Particles a hundred boxes from each other: f32 resolves their positions to 3e-5 m, with low words to 1e-9 m.
    x = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 0.8 + 0.4
    rng = np.random.default_rng(4)
    v, away, found = rng.normal(size=x.shape), 400.0 * rng.integers(-1, 2, x.shape), []
    for start in (x, x + away):
        features = [tv.Periodic((0, 0), (4, 4)), tv.Contact()]
        w = world(tv.Particles(start, velocity=v, radius=0.15), features, substeps=4, precision="f32-compensated")
        w.run(0.3)
        found.append(w.position - (start - x))
    assert np.abs(found[0] - x - v * 0.3).max() > 0.1  # particles have collided
    np.testing.assert_allclose(found[1], found[0], atol=2e-6)
    # Ten million radii from the origin one f32 has steps of a radius: cells must read both words, and points keep their digits.
    corner, radius = 3e5, 0.03
    box = tv.Periodic((corner, corner), (corner + 1, corner + 1))
    w = world(tv.Particles(corner + rng.uniform(0, 1, (300, 2)), radius=radius), [box, tv.Contact()], precision="f32-compensated")
    away = np.linalg.norm(box.difference(w.position[:, None], w.position), axis=-1)
    np.testing.assert_array_equal(w.contacts.pairs, np.argwhere(np.triu(away < 2 * radius, 1)))
    points = corner + np.random.default_rng(5).uniform(0, 1, (99, 2))
    distance = np.linalg.norm(box.difference(points[:, None], w.position), axis=-1)
    np.testing.assert_array_equal(w.near(points, radius), np.argwhere(distance <= radius))
    np.testing.assert_array_equal(w.nearest(points)[0], distance.argmin(axis=1))


def test_lengths_are_refused_while_it_runs(world):
    # From half a box on, another image is nearer, so that nothing can meet the link: 1 m in a box of 1.5 m.
    links, ropes = tv.Distance([[0, 1]], 0.5), tv.Rope([[0, 1]], 0.7)
    box = tv.Periodic((0, 0), (1.5, 4))
    w = world(tv.Particles([[0.1, 0.1], [0.6, 0.1]]), [box, links, ropes], solver=tv.Jacobi())
    w.step(1 / 60)
    for feature, name in ((links, "Distance"), (ropes, "Rope")):
        for length in (0.75, 1.0):
            with pytest.raises(ValueError, match=f"Periodic: along x .* but {name}: link 0 .*longer than {2 * length:g} m"):
                feature.rest = length
    assert links.rest == 0.5 and ropes.rest == 0.7 and w.step(1 / 60).clean
    links.rest = 0.74


def box(width, height, *more, **options):
    return tv.Periodic((0, 0), (width, height), *more, **options)


@pytest.mark.parametrize(("make", "words"), [
    (lambda: [box(1, np.inf)], "is no length"),
    (lambda: [tv.Periodic((0, 0), (1, 1, 1))], "two corners"),
    (lambda: [box(1, 1, ())], "leaves nothing periodic"),
    (lambda: [box(1, 1, (2,))], "axes"),
    (lambda: [tv.Periodic((0, 0, 0), (1, 1, 1))], "2D"),
    (lambda: [box(9, 9), box(9, 9)], "more than one Periodic"),
    (lambda: [box(9, 4), tv.Rope([[0, 1]], 2.5)], "link 0"),
    (lambda: [box(9, 4), tv.PairForce(soft)], "radius=2"),
    (lambda: [box(9, 4), tv.PairForce(soft, 2.1)], "pairs act"),
    (lambda: [box(9, 4, (0,)), tv.HalfSpace((0.1, 1))], "gravity have the slope"),
    (lambda: [box(9, 4, (0,), shear=1.0)], "x and y"),
    (lambda: [box(9, 4, shear=1.0), tv.Ball((1, 1), 0.5)], "slide"),
    (lambda: [box(9, 4), tv.Polygons(LOOP)], "Polygons"),
    (lambda: [box(1.5, 4), tv.Area(LOOP)], "unwrapped"),
    (lambda: [box(1.5, 4), tv.ShapeMatch(LOOP)], "unwrapped"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(make, words):
    with pytest.raises(ValueError, match=words):
        tv.World(tv.Particles([[0.0, 0], [1, 0], [1, 1], [0, 1]], radius=0.2), make())
