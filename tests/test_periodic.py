"""Periodic boxes and Lees-Edwards shear: against explicit images, shifted scenes, closed forms and conservation laws."""

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


def touching(x, radius, length, axes, offset, by=0.0):
    """Return the pairs i < j that overlap by more than `by` [m], over all images."""
    distance = by_images(x, x, length, axes, offset)
    i, j = np.nonzero(np.triu(radius[:, None] + radius - distance > by, 1))
    return set(zip(i.tolist(), j.tolist(), strict=True))


MIXED = (0.3, 0.1, 0.04)
BOXES = {  # lengths, axes, shear, radii; several sizes of cells wherever that makes other kernels
    "2D, two cells and one": ((2.4, 1.3), (0, 1), 0.0, MIXED),
    "2D, more cells than buckets": ((300.0, 160.0), (0, 1), 0.0, MIXED),
    "2D, x alone": ((5.0, 4.0), (0,), 0.0, (0.3,)),
    "2D, sheared": ((8.0, 7.0), (0, 1), 1.5, MIXED),
    "2D, sheared, one cell": ((3.0, 1.35), (0, 1), -5.0, MIXED),
    "2D, sheared, more cells than buckets": ((300.0, 160.0), (0, 1), 0.3, MIXED),
    "3D, sheared": ((4.0, 3.0, 2.5), (0, 1, 2), 2.0, (0.3,)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*BOXES])
def test_no_pair_is_missed_whichever_image_is_near(world, name):
    length, axes, shear, radii = BOXES[name]
    length, rng = np.array(length), np.random.default_rng(0)
    dim, n = len(length), 60
    x = rng.uniform(-2, 3, (n, dim)) * np.where(np.isin(np.arange(dim), axes), length, length / 5)
    if name.endswith("buckets"):
        x = rng.integers(-3, 4, (n, dim)) * length + rng.uniform(-1.2, 1.2, (n, dim))  # around a corner of the box
    radius, v = rng.choice(radii, n), rng.normal(size=(n, dim))
    v[:, 0] += shear * x[:, 1]
    box = tv.Periodic(np.zeros(dim), length, axes, shear=shear)
    w = world(tv.Particles(x, velocity=v, radius=radius), [tv.Contact(), box], substeps=4)
    found = 0
    for frame in range(8):
        w.step(DT)
        listed = set(map(tuple, w._runner.search.list.entries()[0].tolist()))  # the frame's list, however old
        there = touching(w.position, radius, length, axes, box.offset, 1e-4)
        assert there <= listed
        found += len(there)
        if frame in (0, 7):
            contacts = w.contacts
            some = contacts.overlap > 1e-4
            assert set(map(tuple, contacts.pairs[some].tolist())) == there
            pairs, depth = measure.overlapping(w.position, radius, 0.0, box)
            assert set(map(tuple, pairs[depth > 1e-4].tolist())) == there
            np.testing.assert_allclose(depth.sum(), contacts.overlap[contacts.overlap > 0].sum(), atol=1e-3)
    assert found > 10 and np.isclose(box.strain, shear * 8 * DT)


@pytest.mark.slow
@pytest.mark.parametrize("contact", [True, False])
def test_queries_find_the_nearest_image(world, contact):
    rng, length = np.random.default_rng(1), np.array([4.0, 3.0])
    x, points, radius = rng.uniform(-2, 3, (40, 2)) * length, rng.uniform(-3, 3, (15, 2)) * length, rng.uniform(0.1, 2.5, 15)
    box = tv.Periodic((0, 0), length, shear=0.7)
    w = world(tv.Particles(x, radius=0.1), [box, *([tv.Contact()] if contact else [])], precision="f64")
    w.step(DT)
    distance = by_images(points, w.position, length, (0, 1), box.offset)
    np.testing.assert_array_equal(w.near(points, radius), np.argwhere(distance <= radius[:, None]))
    index, near = w.nearest(points)
    np.testing.assert_array_equal(index, distance.argmin(axis=1))
    np.testing.assert_allclose(near, distance.min(axis=1), atol=1e-12)
    inside = box.wrap(w.position)
    assert (inside >= -1e-12).all() and (inside < length + 1e-12).all()
    np.testing.assert_allclose(w.position - inside, box.away(box.boxes(w.position)), atol=1e-12)
    # Positions that are not finite have no image, and no warning is issued.
    nowhere = np.array([[np.inf, 1.0], [1.0, -1e300], [np.nan, 0.0]])
    np.testing.assert_array_equal(np.isfinite(box.difference(nowhere, points[:3])).all(axis=1), [False, True, False])


def crowd(shift, moved, contact, shear=0.0, n=30, **settings):
    """Return discs, springs and a contact or soft force in a box that begins at `shift`; `moved` adds whole boxes."""
    rng, length = np.random.default_rng(2), np.array([4.0, 3.0])
    x, v = rng.uniform(0, 1, (n, 2)) * length, rng.normal(size=(n, 2))
    boxes = rng.integers(-2, 3, (n, 2)) if moved else np.zeros((n, 2))
    v[:, 0] += shear * (x[:, 1] + boxes[:, 1] * length[1])
    links = [[0, 1], [1, 2], [5, 6]]
    features = [tv.Periodic(shift, shift + length, shear=shear), tv.Distance(links, 0.8, compliance=1e-3, damping=1.0)]
    features += [contact] if contact else [tv.PairForce(soft, 0.5, potential=soft_energy)]
    return tv.Particles(x + shift + boxes * length, velocity=v, radius=0.15), features, settings | {"precision": "f64"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["contact", "pair force"])
def test_where_the_box_begins_and_which_image_is_followed_changes_nothing(world, kind):
    def run(shift, moved):
        contact = tv.Contact(friction=0.3, restitution=0.8) if kind == "contact" else None
        particles, features, settings = crowd(np.array(shift), moved, contact)
        w = world(particles, features, substeps=5, **settings)
        w.run(0.1)
        return w

    # For a short time only: each collision amplifies rounding tenfold.
    base, shifted, moved = run((0.0, 0.0), False), run((1.7, -2.3), False), run((0.0, 0.0), True)
    d = base.position - base.particles.position
    np.testing.assert_allclose(shifted.position - shifted.particles.position, d, atol=1e-9)
    np.testing.assert_allclose(moved.position - moved.particles.position, d, atol=1e-9)
    np.testing.assert_allclose(shifted.velocity, base.velocity, atol=1e-7)
    np.testing.assert_allclose(moved.velocity, base.velocity, atol=1e-7)
    assert np.abs(d).max() > 0.1


@pytest.mark.slow
def test_a_collision_across_the_boundary_is_that_with_the_image(world):
    # Two discs, one at the top and one at the bottom of the box. Without a box, the second disc is its own image, a box higher:
    # faster by shear times that height, and farther by the strain so far. They meet after t: |r + t u| = 0.5. There the impulse
    # along the normal is m (1 + e) u_n, and across it friction stops the slip or is mu times that.
    length, shear, mu, e = np.array([5.0, 4.0]), 0.8, 0.4, 0.6
    x, v, m = np.array([[1.0, 3.7], [1.3 - 1.28 * shear, 0.4]]), np.array([[0.2, 0.5], [-0.1, -0.4]]), np.array([1.0, 2.0])
    features = [tv.Periodic((0, 0), length, shear=shear), tv.Contact(mu, e)]
    w = world(tv.Particles(x, velocity=v, radius=0.25, mass=m), features, precision="f64")
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
    np.testing.assert_allclose(w.velocity, after, atol=1e-11)
    np.testing.assert_allclose(w.position, x + t * v + (w.time - t) * after, atol=1e-11)


def test_a_ring_around_the_box_swings_as_a_periodic_chain(world):
    # m u_j'' = k (u_(j+1) - 2 u_j + u_(j-1)): mode p has omega = 2 sqrt(k / m) sin(pi p / N). Verlet:
    # sin(Omega h / 2) = omega h / 2, so with omega h = 0.02 the relative error of the phase is 2e-5. 3 turns.
    n, p, k, m = 12, 2, 100.0, 0.5
    cells, links = np.arange(n) * 0.25, np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    u = 1e-3 * np.cos(2 * np.pi * p * np.arange(n) / n)
    omega = 2 * np.sqrt(k / m) * np.sin(np.pi * p / n)
    x = np.stack([cells + u, np.full(n, 0.5)], axis=1)
    ring = tv.Distance(links, 0.25, compliance=1 / k)
    w = world(tv.Particles(x, mass=m), [tv.Periodic((0, 0), (3, 1)), ring], substeps=100, precision="f64")
    w.step(100 * 0.02 / omega)
    w.run(3 * 2 * np.pi / omega - w.time, dt=100 * 0.02 / omega)
    want = 1e-3 * np.cos(omega * w.time) * np.cos(2 * np.pi * p * np.arange(n) / n)
    np.testing.assert_allclose(w.position[:, 0] - cells, want, atol=5e-6)
    np.testing.assert_allclose(w.position[:, 1], 0.5, atol=1e-12)


def test_a_closed_chain_with_bends_rests_as_it_was_put(world):
    # A chain straight around the box: all lengths and angles are met, also across the boundary, so only its centre moves.
    n = 16
    links = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    bends = np.stack([np.arange(n), (np.arange(n) + 1) % n, (np.arange(n) + 2) % n], axis=1)
    x = np.stack([np.arange(n) * 0.25, np.full(n, 0.5)], axis=1)
    chain = tv.Distance(links)
    w = world(
        tv.Particles(x, velocity=(1.3, 0.4)), [tv.Periodic((0, 0), (4, 1)), chain, tv.Bend(bends, compliance=1e-2)],
        precision="f64",
    )  # fmt: skip
    np.testing.assert_allclose(chain.rest, 0.25, rtol=1e-14)
    w.run(0.5)
    np.testing.assert_allclose(w.position, x + np.array([1.3, 0.4]) * w.time, atol=1e-9)
    assert w.last and w.last.clean and w.last.residual < 1e-9


@pytest.mark.slow
def test_an_elastic_gas_keeps_energy_and_momentum(world):
    n, length = 5, 6.0
    x = (np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3) + 0.5) * length / n
    v = np.random.default_rng(3).normal(size=x.shape)
    box = tv.Periodic([0] * 3, [length] * 3)
    w = world(tv.Particles(x, velocity=v, radius=0.28), [tv.Contact(restitution=1.0), box], substeps=10, precision="f64")
    energy, momentum = measure.kinetic_energy(w), measure.momentum(w)
    w.run(1.0)
    assert (np.abs(w.velocity - v).max(axis=1) > 0.1).mean() > 0.3  # particles have collided
    assert (np.abs(box.boxes(w.position)) > 0).any()
    np.testing.assert_allclose(measure.kinetic_energy(w), energy, rtol=1e-12)
    np.testing.assert_allclose(measure.momentum(w), momentum, atol=1e-11)


def test_forces_between_images_keep_energy_and_are_those_of_brute_force(world):
    particles, features, settings = crowd(np.zeros(2), True, None, n=60)
    force = features[2]
    w = world(particles, [features[0], force], substeps=50, **settings)
    w.step(1e-9)
    energy, momentum = w.last.energy, measure.momentum(w)
    x, length = w.position, np.array([4.0, 3.0])
    r = features[0].difference(x[:, None], x)
    s = np.linalg.norm(r, axis=2)
    np.testing.assert_allclose(s, by_images(x, x, length, (0, 1)), atol=1e-12)
    near = (s < 0.5) & (s > 0)
    want = (np.where(near, 40 * (1 - 2 * s) ** 2 / np.where(near, s, 1), 0)[..., None] * r).sum(axis=1)
    np.testing.assert_allclose(w._runner.memory.read(force.dev.now)[: len(x)], want, atol=1e-4)  # a substep later
    w.run(1.0)
    # Order 2: h = 3e-4 s and omega is about 15 / s, so the error is (omega h)^2 = 2e-5 of the energy that oscillates.
    np.testing.assert_allclose(w.last.energy, energy, rtol=2e-4)
    np.testing.assert_allclose(measure.momentum(w), momentum, atol=1e-10)


@pytest.mark.slow
def test_a_shear_is_live_and_survives_whatever_happens_to_the_world(world, tmp_path):
    particles, features, settings = crowd(np.zeros(2), False, tv.Contact(friction=0.2, restitution=0.1))
    w = world(particles, features, **settings)
    box = features[0]
    w.step(DT)
    assert box.strain == 0 and "Periodic.strain" not in w.fields
    box.shear = 2.0
    w.step(DT)
    with tv.Recorder(tmp_path / "shear.rrd", w) as recorder:
        for _ in range(2):
            w.step(DT)
            recorder.log()
        box.shear = -1.0
        x = w.position
        w.add(tv.Particles([[9.0, 9.0]], radius=0.15), extend={features[1]: tv.Distance([[3, 4]], compliance=1e-3)})
        w.step(DT)
        recorder.log()
    assert np.isclose(box.strain, 5 * DT) and np.isclose(box.offset, 5 * DT * 3.0)
    assert abs(features[1].rest[-1] - by_images(x[[3]], x[[4]], (4, 3), (0, 1), 6 * DT * 3.0)[0, 0]) < 1e-12
    twin, other = w.clone(), w.clone(precision="f32")
    replay = tv.replay(tmp_path / "shear.rrd")
    assert replay.verify().kind == "intact"
    again = replay.world(3)
    drawn = replay.position(3)
    body = np.unique([[0, 1, 2], [5, 6, 3], [4, 4, 4]])
    single = np.setdiff1d(np.arange(len(drawn)), body)
    np.testing.assert_allclose(drawn[single], box.wrap(w.position)[single], atol=1e-5)
    assert other.features[0].strain == box.strain
    for copy in (w, twin, again):
        copy.step(DT)
    assert twin.hash() == w.hash() == again.hash()
    for copy in (twin, other, again):
        copy.close()


def strain(w):
    """Return the shear strain of the first feature of a world, a box."""
    return w.features[0].strain


@pytest.mark.slow
def test_many_worlds_have_boxes_of_their_own():
    particles, features, settings = crowd(np.zeros(2), False, tv.Contact(), shear=0.5)
    with tv.World(particles, [features[0], features[2]], **settings) as one, tv.Worlds(one, 3) as many:
        many.step(DT)
        one.step(DT)
        np.testing.assert_array_equal(many.position[1], one.position)
        many.set(features[0], shear=[0.5, 1.0, -1.0])  # one shear for each world
        many.step(DT)
        many.step(DT)
        np.testing.assert_allclose(many.each(strain), np.array([1.5, 2.5, -1.5]) * DT, rtol=1e-12)


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


def test_a_floor_under_a_periodic_box(world):
    # Walls along other axes: a particle that slides out on the right comes in on the left, and stays on the floor.
    x = np.stack([np.arange(8) * 0.5 + 0.25, 0.2 + 0.01 * np.arange(8)], axis=1)
    walls = [tv.Box((-np.inf, 0), (np.inf, 5)), tv.HalfSpace((0, 1), 0.0)]
    w = world(tv.Particles(x, velocity=(3.0, 0.0), radius=0.2), [tv.Gravity(), tv.Periodic((0, -9), (4, 9), (0,)), *walls])
    w.run(2.0)
    np.testing.assert_allclose(w.position[:, 1], 0.2, atol=1e-3)
    np.testing.assert_allclose(w.position[:, 0] - x[:, 0], 3.0 * w.time, atol=2e-5)
    assert (w.position[:, 0] > 4).any()


LOOP = [[0, 1, 2, 3]]


@pytest.mark.parametrize(("make", "words"), [
    (lambda: tv.Periodic((0, 0), (1, 0)), "is no length"),
    (lambda: tv.Periodic((0, 0), (1, np.nan)), "high"),
    (lambda: tv.Periodic((0, 0), (1, np.inf)), "is no length"),
    (lambda: tv.Periodic((0, 0), (1, 1, 1)), "two corners"),
    (lambda: tv.Periodic((0, 0), (1, 1), ()), "leaves nothing periodic"),
    (lambda: tv.Periodic((0, 0), (1, 1), (2,)), "axes"),
    (lambda: tv.Periodic((0, 0), (1, 1), shear=np.nan), "shear"),
])  # fmt: skip
def test_boxes_that_are_none(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(("features", "words"), [
    ([tv.Periodic((0, 0, 0), (1, 1, 1))], "2D"),
    ([tv.Periodic((0, 0), (9, 0.7)), tv.Contact()], "two particles touch.*longer than 0.8"),
    ([tv.Periodic((0, 0), (9, 9)), tv.Periodic((0, 0), (9, 9))], "more than one Periodic"),
    ([tv.Periodic((0, 0), (9, 4)), tv.Distance([[0, 1]], 2.0)], "link 0"),
    ([tv.Periodic((0, 0), (9, 4)), tv.Rope([[0, 1]], 2.5)], "link 0"),
    ([tv.Periodic((0, 0), (9, 4)), tv.PairForce(soft)], "radius=2"),
    ([tv.Periodic((0, 0), (9, 4)), tv.PairForce(soft, 2.1)], "pairs act"),
    ([tv.Periodic((0, 0), (9, 4)), tv.Box((0, 0), (9, 4))], "along x, which is periodic"),
    ([tv.Periodic((0, 0), (9, 4), (0,)), tv.HalfSpace((0.1, 1))], "gravity have the slope"),
    ([tv.Periodic((0, 0), (9, 4), (0,), shear=1.0)], "x and y"),
    ([tv.Periodic((0, 0), (9, 4), shear=1.0), tv.Ball((1, 1), 0.5)], "slide"),
    ([tv.Periodic((0, 0), (9, 4)), tv.Polygons(LOOP)], "Polygons"),
    ([tv.Periodic((0, 0), (1.5, 4)), tv.Area(LOOP)], "unwrapped"),
    ([tv.Periodic((0, 0), (1.5, 4)), tv.ShapeMatch(LOOP)], "unwrapped"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(features, words):
    x = [[0.0, 0], [1, 0], [1, 1], [0, 1]]
    with pytest.raises(ValueError, match=words):
        tv.World(tv.Particles(x, radius=0.2), [f.copy() for f in features])


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


@pytest.mark.slow
def test_f32_with_low_words_is_as_good_a_hundred_boxes_away(world):
    # Particles a hundred boxes from each other: f32 resolves their positions to 3e-5 m, with low words to 1e-9 m.
    x = np.stack(np.meshgrid(np.arange(5), np.arange(5)), -1).reshape(-1, 2) * 0.8 + 0.4
    rng = np.random.default_rng(4)
    v, away = rng.normal(size=x.shape), 400.0 * rng.integers(-1, 2, x.shape)
    found = []
    for precision, start in (("f64", x), ("f32-compensated", x + away)):
        w = world(
            tv.Particles(start, velocity=v, radius=0.15), [tv.Periodic((0, 0), (4, 4)), tv.Contact()], substeps=4,
            precision=precision,
        )  # fmt: skip
        w.run(0.3)
        found.append(w.position - (start - x))
    assert np.abs(found[0] - x - v * 0.3).max() > 0.1  # particles have collided
    np.testing.assert_allclose(found[1], found[0], atol=2e-6)


def test_soft_bodies_pass_the_boundary_as_if_there_were_none(world):
    # Members of a body that is given whole are the nearest images of each other. In the larger box they never reach the boundary.
    square = np.array([[0.0, 0], [0.6, 0], [0.6, 0.6], [0, 0.6]])
    found = []
    for size in (2, 200):
        features = [tv.Area(LOOP, pressure=1.2, compliance=1e-4), tv.Distance([[0, 1], [1, 2], [2, 3], [3, 0]], compliance=1e-4)]
        box = tv.Periodic((0, 0), (size, size))
        w = world(tv.Particles(square + 1.2, velocity=(2.0, 1.0)), [box, *features], precision="f64")
        w.run(0.8)
        found.append(w.position)
    np.testing.assert_allclose(*found, atol=1e-10)
