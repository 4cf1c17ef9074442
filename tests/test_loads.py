"""Every pair and wall knows the load that it bears, as statics says; links may know theirs, and hold it without stretch."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.contact.limits import BEYOND, MET, SLOP

G, R = 10.0, 0.5
LOADS = 2 * MET  # of a load: what passes of contacts without friction leave of it


def smooth(world, x, mass, pinned=(), high=(99.0, 99.0), **settings):
    """Return a world with smooth discs of these masses in a box: at `x`, or in a column away from the walls."""
    x = np.stack([np.full(len(mass), 5.0), R + np.arange(len(mass))], axis=1) if x is None else x
    particles = tv.Particles(x, radius=R, mass=mass, pinned=pinned)
    features = [tv.Gravity(G), tv.Contact(), tv.Box((0, 0), high, events=True)]
    return world(particles, features, precision="f64", **settings)


@pytest.mark.slow
@pytest.mark.parametrize("substeps", [1, 8])
def test_a_column_bears_what_is_above(world, substeps):
    # A contact bears the weight of all discs above it, and the ground bears all, at any substep, which may change on the way.
    mass = 2.0 + np.arange(10) % 2
    w = smooth(world, None, mass, substeps=substeps)
    w.run(10.0)
    start = w.last.energy
    for changed in (substeps, 3, 20):
        w.substeps = changed
        w.run(1.0)
        found = w.contacts
        np.testing.assert_allclose(found.impulse * 60 * changed, G * np.cumsum(mass[:0:-1])[::-1], rtol=LOADS)
        assert found.overlap.max() < SLOP * BEYOND * R and w.last.energy <= start * (1 + 1e-4)


def test_three_discs_bear_each_other_as_statics_says(world):
    # Two discs lie between walls and bear a third, of another mass: N = m g / (2 cos a) on each,
    # sin a = (half their distance) / 2 R.
    width = 2.5
    half = (width - 2 * R) / 2
    height = np.sqrt(4 * R * R - half * half)
    x = [[R, R], [width - R, R], [R + half, R + height + 0.01]]
    w = smooth(world, x, [1.0, 1.0, 3.0], high=(width, 99.0), substeps=4)
    w.run(20.0)
    np.testing.assert_allclose(w.contacts.impulse * 240, 3.0 * G / (2 * height / (2 * R)), rtol=LOADS)
    np.testing.assert_allclose(w.position[2], [R + half, R + height], atol=SLOP * BEYOND * R)


def test_each_contact_of_a_pyramid_bears_what_statics_says(world):
    # 55 discs in rows of 10 to 1, with gaps in a row and the lowest row pinned: 90 contacts. The 45 free discs give as many
    # equations, sum f n = m g. The normals are taken from the pile at rest.
    rows, apart = 10, 1.02
    up = np.sqrt(1 - (apart / 2) ** 2)
    x = np.concatenate([np.stack([apart * (np.arange(rows - r) + r / 2), np.full(rows - r, r * up)], 1) for r in range(rows)])
    mass = np.random.default_rng(0).uniform(1, 2, len(x))
    w = smooth(world, (1 + 1e-9) * x + 2.0, mass, range(rows), substeps=8)  # scaled so that none overlap at the start
    w.run(20.0)
    found, free = w.contacts, np.arange(len(x)) >= rows
    forces, c = np.zeros((len(x), 2, len(found))), np.arange(len(found))
    forces[found.pairs[:, 0], :, c] = found.normal
    forces[found.pairs[:, 1], :, c] = -found.normal
    weight = np.stack([0 * mass, G * mass], axis=1)[free]
    borne = np.linalg.solve(forces[free].reshape(weight.size, -1), weight.ravel())
    np.testing.assert_allclose(found.impulse * 480, borne, atol=LOADS * borne.max())


@pytest.mark.slow
def test_walls_bear_the_weight(world):
    # Smooth sides bear no weight: the floor bears sum f = N m g, and opposite sides bear the same.
    n, dim, rng = 3, 3, np.random.default_rng(0)
    x = np.stack(np.meshgrid(*[np.arange(n)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)[:, ::-1] * 1.05 + R
    high = np.full(dim, 1.05 * n + 0.1)
    high[1] = np.inf
    start, box = tv.Particles(x + rng.uniform(0, 0.03, x.shape), radius=R, mass=2.0), tv.Box(np.zeros(dim), high, events=True)
    w = world(start, [tv.Gravity(G), tv.Contact(friction=0.5), box], substeps=8)
    w.run(15.0)
    touches = w.wall_events().touches
    borne = (touches.impulse[:, None] * touches.normal * 60).sum(axis=0)
    weight = np.zeros(dim)
    weight[1] = 2 * len(x) * G
    np.testing.assert_allclose(borne, weight, atol=MET * weight[1])
    assert np.abs(w.velocity).max() < 1e-3


def test_what_lands_in_a_frame_is_no_load(world):
    # A column at rest on which a disc lands: velocities after the frame contain no half of the blow, so that starts, as where
    # the substep changes, add no energy.
    x = np.stack([np.full(4, 5.0), R + np.array([0, 1, 2, 3.3])], axis=1)
    w = smooth(world, x, np.ones(4), substeps=4)
    highest = w.step(1 / 60).energy
    for k in range(60):
        w.substeps = 3 + k % 3
        report = w.step(1 / 60)
        assert report.energy <= highest * (1 + 1e-4)
        highest = min(highest, report.energy)


def hung(n=10):
    """Return a chain of n links of 0.1 m that hangs from a pin, and the pairs of its links."""
    x = np.stack([np.zeros(n + 1), -0.1 * np.arange(n + 1)], axis=1)
    return tv.Particles(x, mass=0.2, pinned=[0]), np.stack([np.arange(n), np.arange(1, n + 1)], axis=1)


def hanging(world, particles, links, g=G, rate=1.0, known=True, precision="f64", **settings):
    """Return a world of links that may break, with drag: one structure for all tests of links."""
    features = [tv.Gravity(g), links, tv.Drag(rate)]
    return world(particles, features, solver=tv.Jacobi(loads=known), precision=precision, **settings)


@pytest.mark.parametrize("kind, precision, substeps", [(tv.Distance, "f64", 4), (tv.Rope, "f32", 16)])
def test_what_hangs_is_not_stretched(world, kind, precision, substeps):
    # The k-th link from below bears k m g. One pass bears it by a violation W h^2 k m g = 4 k g h^2; a known load needs none.
    particles, pairs = hung()
    links = kind(pairs, 0.1, break_at=1e3)
    w = hanging(world, particles, links, precision=precision, substeps=substeps)
    highest = max(w.step(1 / 60).energy for _ in range(900))
    rounding = 0.2 * 2.0**-24 * (60 * substeps) ** 2 if precision == "f32" else 0.0  # of positions of 1 m: m ulp / h^2
    np.testing.assert_allclose(links.load, 0.2 * G * np.arange(10, 0, -1), rtol=1e-3, atol=rounding)
    sag = 4 * 10 * G / (60 * substeps) ** 2
    stretch = np.linalg.norm(np.diff(w.position, axis=0), axis=1) - 0.1
    assert np.abs(stretch).max() < 1e-3 * sag
    # Energy never rises above the start, and known loads break links, too.
    assert highest <= -0.2 * G * 0.1 * 55 + 1e-5
    for most in (10.5, 9.5):
        links.break_at = most * 0.2 * G
        w.step(1 / 60)
        assert links.broken.tolist() == [most < 10] + 9 * [False]


def test_links_that_move_are_as_they_were(world):
    # A chain that swings through 2 rad in half a second turns by more within a window than its load explains: nothing is learnt.
    particles, pairs = hung(5)
    particles = tv.Particles(particles.position[:, ::-1], mass=0.2, pinned=[0])
    known, plain = (
        hanging(world, particles, tv.Distance(pairs, 0.1, break_at=1e3), rate=0.0, known=k, substeps=20) for k in (True, False)
    )
    for w in (known, plain):
        w.run(0.5)
    np.testing.assert_array_equal(known.position, plain.position)


def test_links_without_a_weight_to_compare_with_learn_nothing(world):
    # Ten links of 0.095 m between pins 1 m apart contradict each other: no load removes their violations C, 0.05 m in all. Their
    # pulls C / (W h^2) are equal. W = 4 w, but 2 w for links at a pin, whose violation is half of the others', 0.05 / 9.
    x = np.stack([np.linspace(0, 1, 11), np.zeros(11)], axis=1)
    links = tv.Distance(hung()[1], 0.095, break_at=1e3)
    w = hanging(world, tv.Particles(x, mass=0.2, pinned=[0, 10]), links, g=0.0)
    w.run(8.0)
    assert (w._runner.memory.read(links.dev.known.load) == 0).all()
    lengths = 0.095 + 0.05 / 9 * np.r_[0.5, np.ones(8), 0.5]
    np.testing.assert_allclose(w.position[1:, 0], np.cumsum(lengths), atol=1e-9)


def test_a_start_finds_the_loads_that_links_know(world):
    # Assigned velocities make a start: in the next substep forces act for half a kick, and so do loads. If all particles are
    # moved by the same vector, links keep their known loads. If one particle is moved, its own links drop theirs.
    particles, pairs = hung()
    links = tv.Distance(pairs, 0.1, break_at=1e3)
    w = hanging(world, particles, links, substeps=8)
    w.run(15.0)
    height = w.position[10, 1]
    for change in (lambda: setattr(w, "velocity", 0 * w.position), lambda: setattr(w, "position", w.position + [3.0, 0.0])):
        change()
        for _ in range(30):
            w.step(1 / 60)
        assert w.position[10, 1] == pytest.approx(height, abs=1e-6)
        np.testing.assert_allclose(links.load, 0.2 * G * np.arange(10, 0, -1), rtol=1e-3)
    known = w._runner.memory.read(links.dev.known.load)[:10]
    moved = w.position.copy()
    moved[10, 0] += 0.05
    w.position = moved
    forgotten = w._runner.memory.read(links.dev.known.load)[:10]
    assert forgotten[9] == 0.0 and (forgotten[:9] == known[:9]).all() and (known > 0).all()


@pytest.mark.slow
def test_loads_of_links_are_of_the_state(world):
    # One kernel, launches, clones and Worlds have the same bits; added particles leave known loads as they are.
    particles, pairs = hung()

    def made(path):
        """Return the hanging chain in a world on this path."""
        return hanging(world, particles, tv.Distance(pairs, 0.1, break_at=1e3), substeps=8, path=path)

    a, b = map(made, ("fused", "launched"))
    for w in (a, b):
        w.run(3.0)
    assert a.hash() == b.hash()
    with a.clone() as other, tv.Worlds(a, 2) as many:
        for w in (a, other, many):
            for _ in range(9):  # past the end of a window
                w.step(1 / 60)
        assert other.hash() == a.hash()
        np.testing.assert_array_equal(many.position[1], a.position)
        other.add(tv.Particles([(5.0, 5.0)]), [tv.HalfSpace((0, 1), -9.0)])
        for w in (a, other):
            w.step(1 / 60)
        np.testing.assert_array_equal(other.position[:11], a.position)
