"""Contacts with known loads hold them without overlap, as statics says, and drop them at once on release."""

from typing import Any

import numpy as np
import pytest

import tiverlet as tv

G, R = 10.0, 0.5


def heap(n, dim=2):
    """Return n^dim discs or spheres near the columns of a lattice, and the width of their box [m]."""
    rng = np.random.default_rng(0)
    x = np.stack(np.meshgrid(*[np.arange(n)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)[:, ::-1] * 1.05 + R
    return x + rng.uniform(0, 0.03, x.shape), 1.05 * n + 0.1


def pile(world, n=5, dim=2, friction: object = 0.5, spin=None, loads=True, restitution=0.0, **settings):
    """Return a world with a heap in a box."""
    x, width = heap(n, dim)
    return boxed(world, x, width, friction, spin, loads, restitution, restitution, **settings)


def boxed(
    world, x, width, friction: object = 0.5, spin=None, loads=True, restitution=0.0, walls=0.0, v=0.0, g=G, held=None, **settings
):
    """Return a world with discs or spheres in a box, and one pinned particle at `held` (out of the way by default).

    Friction and restitution are set after the build, so that the worlds share compiled kernels.
    """
    above = np.full(x.shape[1], width / 2)
    above[1] = 500.0
    x, v = np.vstack([x, above if held is None else held]), np.vstack([np.broadcast_to(v, x.shape), 0 * above])
    low, high = np.zeros(x.shape[1]), np.full(x.shape[1], width)
    high[1] = np.inf
    rough: Any = friction if spin is not None else 0.5
    bounces = x.shape[1] == 2 and spin is None and "precision" not in settings  # the cases that share compiled kernels
    contact = tv.Contact(friction=rough, restitution=0.5 if bounces else restitution, loads=loads)
    box = tv.Box(low, high, friction=rough, restitution=0.5 if bounces else walls, events=bounces)
    start = tv.Particles(x, velocity=v, radius=R, spin=spin, mass=np.append(np.ones(len(x) - 1), 1.5), pinned=[len(x) - 1])
    w = world(start, [tv.Gravity(g), contact, box], **({"substeps": 8, "precision": "f64"} | settings))
    contact.friction = box.friction = friction  # type: ignore[assignment]
    contact.restitution, box.restitution = restitution, walls
    return w


def overlap(w):
    """Return the mean overlap of the contacts, in diameters."""
    return np.maximum(w.contacts.overlap, 0.0).mean() / (2 * R)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings, most",
    [({}, 1e-6), ({"dim": 3, "n": 3, "precision": "f32"}, 1e-6), ({"substeps": 2}, 1e-5),
     ({"spin": 0.0, "friction": (0.5, 0.5, 0.1, 0.0)}, 1e-6)],
)  # fmt: skip
def test_a_pile_at_rest_hardly_overlaps(world, settings, most):
    # Without known loads the k-th contact overlaps by 2 k g h^2: 1e-4 of a diameter on average at 8 substeps here, 2e-3 at 2. The
    # two cases that share kernels with such a world check this.
    w = pile(world, **settings)
    start, highest = w.step(1 / 60).energy, -np.inf
    for _ in range(900):
        highest = max(highest, w.step(1 / 60).energy)
    assert highest <= start * (1 + 1e-6)
    assert overlap(w) < most
    if settings.keys() <= {"substeps"}:
        without = pile(world, loads=False, **settings)
        without.run(15.0)
        assert most < 0.05 * overlap(without)
        # Velocities count the pushes of contacts as forces. Otherwise they would be half of what gravity adds in a substep.
        assert np.abs(without.velocity).max() < 1e-9
    speed = np.linalg.norm(w.velocity, axis=1).max()
    assert speed < (1e-3 if w.precision == "f32" or "spin" in settings else 1e-4)


def smooth(world, x, mass, pinned=(), high=(99.0, 99.0), **settings):
    """Return a world with smooth discs of these masses in a box: at `x`, or in a column away from the walls."""
    x = np.stack([np.full(len(mass), 5.0), R + np.arange(len(mass))], axis=1) if x is None else x
    x, pinned = np.vstack([x, [(5.0, 90.0)]]), [*pinned, len(x)]  # a pinned particle, as in all worlds here
    particles = tv.Particles(x, radius=R, mass=np.append(mass, 1.5), pinned=pinned)
    # Built with friction and restitution, which are then set to 0: the worlds share compiled kernels.
    contact = tv.Contact(friction=0.5, restitution=0.5, loads=True)
    box = tv.Box((0, 0), high, friction=0.5, restitution=0.5, events=True)
    w = world(particles, [tv.Gravity(G), contact, box], precision="f64", **settings)
    contact.friction = box.friction = contact.restitution = box.restitution = 0.0
    return w


def test_a_column_bears_what_is_above(world):
    # A contact bears the weight of all discs above it, and the ground bears all. Loads are exact to rounding; nothing overlaps.
    mass = 2.0 + np.arange(10) % 2
    w = smooth(world, None, mass, substeps=8)
    w.run(20.0)
    found, h = w.contacts, 1 / 480
    np.testing.assert_allclose(found.impulse / h, G * np.cumsum(mass[:0:-1])[::-1], rtol=1e-7)
    assert np.abs(found.overlap).max() < 1e-9
    assert np.abs(w.velocity).max() < 1e-8


@pytest.mark.slow
def test_a_load_is_learnt_where_it_is_steady_and_lost_where_it_is_let_go(world):
    # A disc of 1 kg bears one of 99 kg. The part of the pair's load that is not known is learnt if it was the same in the
    # previous window of 128 substeps. Nothing is learnt in the first window, before which nothing was missing. Then each window
    # leaves 1 - 128 / (64 + 0.3 k^2) of that part, k = 99, and the overlap of the pair is proportional to it.
    def known(w):
        """Return the known load of the pair [N]."""
        pairs, values = w._runner.search.list.persistent_data()
        return values["load"][(pairs == (0, 1)).all(axis=1)].sum()

    w = smooth(world, None, [1.0, 99.0], substeps=128)
    knew = [known(w) for _ in range(3) if w.step(128 / 480)]
    assert knew[:2] == [0.0, 0.0] and knew[2] > 0.0
    w.run(12 * 128 / 480, dt=128 / 480)
    left = [w.contacts.overlap[0] for _ in range(3) if w.step(128 / 480)]
    np.testing.assert_allclose(np.array(left[1:]) / left[:-1], 1 - 128 / (64 + 0.3 * 99**2), rtol=1e-3)
    # A pair loses its load in the first substep in which nothing pushes it, however near the discs still are.
    assert known(w) > 0.0
    w.velocity, w.substeps = [[0.0, 0.0], [0.0, 1.0], [0.0, 0.0]], 8
    w.step(8 / 480)
    assert known(w) == 0.0 and 1.0 < np.linalg.norm(w.position[1] - w.position[0]) < 1.02


@pytest.mark.slow
def test_what_is_known_holds_at_any_substep(world):
    # A load is a force: loads that were learnt in a second at 200 substeps a frame bear a column of 50 at 2 substeps. Contacts
    # alone would overlap by 2 k g h^2 there, 7e-2 of a diameter at the ground. A pile of 25 with friction stands at 1 substep.
    n = 50
    w = smooth(world, None, 1.0 + 0.1 * (np.arange(n) % 2), substeps=200)
    w.run(1.0)
    w.substeps = 2
    w.run(20.0)
    assert np.abs(w.contacts.overlap).max() < 1e-4 * 2 * R
    assert (w.velocity**2).sum() / (2 * n * G * R) < 1e-6
    w = pile(world, precision="f32")
    w.run(6.0)
    w.substeps = 1
    w.run(6.0)
    assert overlap(w) < 1e-4 and np.abs(w.velocity).max() < 0.01


def test_three_discs_bear_each_other_as_statics_says(world):
    # Two discs lie between walls and bear a third, of another mass: N = m g / (2 cos a) on each,
    # sin a = (half their distance) / 2 R.
    width = 2.5
    half = (width - 2 * R) / 2
    height = np.sqrt(4 * R * R - half * half)
    x = [[R, R], [width - R, R], [R + half, R + height + 0.01]]
    w = smooth(world, x, [1.0, 1.0, 3.0], high=(width, 99.0), substeps=4)
    w.run(20.0)
    np.testing.assert_allclose(w.contacts.impulse * 240, 3.0 * G / (2 * height / (2 * R)), rtol=1e-6)
    np.testing.assert_allclose(w.position[2], [R + half, R + height], atol=1e-8)


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
    np.testing.assert_allclose(found.impulse * 480, borne, rtol=1e-6)
    assert np.abs(found.overlap).max() < 1e-9


def test_the_floor_bears_the_weight(world):
    # Walls without friction bear no weight: the floor bears sum f = N m g, and both sides bear the same. In f32 the last digit of
    # a position would be 1e-4 of that.
    x, width = heap(6)
    w = boxed(world, x, width)
    w.features[2].friction = 0.0  # type: ignore[attr-defined]
    w.run(15.0)
    touches = w.wall_events().touches
    floor, left, right = (touches.impulse[touches.normal @ n > 0.5].sum() * 60 for n in ((0, 1), (1, 0), (-1, 0)))
    assert floor == pytest.approx(36 * G, rel=1e-4)
    assert left == pytest.approx(right, abs=36 * G * 1e-4)


def test_loads_are_gone_with_what_bore_them(world):
    # When the ground goes, all discs fall. The discs above get the loads of at most one more substep, k g h. Rows of five and
    # four lie in each other's gaps, where they are stable. Of heaps from a square lattice without friction, one in fifty keeps
    # creeping.
    rows = [(R + 1.02 * i + 0.51 * (k % 2), R + k) for k in range(5) for i in range(5 - k % 2)]
    w = boxed(world, np.array(rows), 5.1, 0.0, None, True, 0.0)
    start = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(600)) <= start * (1 + 1e-6) and overlap(w) < 1e-6
    box = w.features[2]
    box.lower = (0.0, -100.0)  # type: ignore[attr-defined]
    v = [w.velocity[:-1] for _ in range(30) if w.step(1 / 60)]
    assert np.abs(v[-1][:, 1] - v[0][:, 1] + G * 29 / 60).max() < 5 * G / 480
    assert np.ptp(v[-1][:, 1]) < 2 * (1 + 2 + 3 + 4) * G / 480  # from all contacts of a column
    # A disc that is moved away by assignment falls as it would alone: no load acts on it.
    w = pile(world)
    w.run(10.0)
    x = w.position.copy()
    x[12] = [2.5, 30.0]
    w.position = x
    w.step(1 / 60)
    np.testing.assert_allclose(w.position[12], [2.5, 30.0 - G / 60**2 / 2], atol=1e-4)
    # A disc that is removed leaves the others to fall on the discs below.
    w = pile(world)
    w.run(10.0)
    top = w.position[24, 1]
    w.remove([9])
    speed = max(np.abs(w.velocity[:, 1]).max() for _ in range(60) if w.step(1 / 60))
    assert top - w.position[23, 1] > 0.9 and speed < 1.1 * np.sqrt(2 * G * 1.0)
    w.run(10.0)
    assert overlap(w) < 1e-6


def test_pairs_that_bounce_learn_where_they_rest(world):
    # A pair that bounces decides by its overlap whether it rests. A pair with a known load counts the overlap that would hold it.
    # Nothing overlaps in a heap, nor at the foot of a column at 2 substeps a frame, where it would be 2 k g h^2 = 0.026 m without
    # loads.
    w = pile(world, restitution=0.5)
    start = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(900)) <= start * (1 + 1e-6)
    assert overlap(w) < 1e-6 and np.abs(w.velocity).max() < 1e-6
    n = 20
    column = np.stack([np.full(n, 5.0), R + np.arange(n)], axis=1)
    w = boxed(world, column, 10.0, 0.0, restitution=0.5, walls=0.5, substeps=2)
    w.run(40.0)
    np.testing.assert_allclose(w.contacts.impulse * 120, G * np.arange(n - 1, 0, -1), rtol=1e-7)
    assert np.abs(w.contacts.overlap).max() < 1e-9 and np.abs(w.velocity).max() < 1e-8


def test_what_bounces_knows_no_load(world):
    # Bit for bit: a gas without forces; a gas that falls and bounces on walls in the substep in which pairs are struck, too; and
    # a ball that falls on a pinned one, for the 1.5 s until it rests. The ball leaves at e times its speed, so it rises to e^2 of
    # its height.
    rng = np.random.default_rng(0)
    gas = np.stack(np.meshgrid(1.5 * np.arange(6), 1.5 * np.arange(6)), axis=-1).reshape(-1, 2) + 1.0
    ball, speed = np.array([[5.0, 3.5]]), rng.normal(size=gas.shape)
    for x, held, v, gravity, e, substeps in (
        (gas, None, speed, 0.0, 0.8, 20), (gas, None, speed, G, 1.0, 2), (ball, [5.0, 2.0], 0.0, G, 0.6, 20)
    ):  # fmt: skip
        settings = {"walls": 1.0, "v": v, "g": gravity, "held": held, "substeps": substeps}
        known, plain = (boxed(world, x, 9.5, 0.0, None, loads, e, **settings) for loads in (True, False))
        heights = []
        for _ in range(90):
            known.step(1 / 60), plain.step(1 / 60)
            np.testing.assert_array_equal(known.position, plain.position)
            heights.append(known.position[0, 1] - 3.0)
    assert max(heights[20:]) == pytest.approx(e * e * 0.5, rel=0.01)
    known.run(10.0)
    assert abs(known.contacts.overlap[0]) < 1e-9 and known.contacts.impulse[0] * 1200 == pytest.approx(G, rel=1e-6)


@pytest.mark.slow
def test_loads_are_of_the_state(world):
    # Clones and Worlds have the same bits, and loads may be switched on later. For all paths see test_determinism.py.
    a = pile(world, precision="f32")
    a.run(4.0)
    with a.clone() as other, tv.Worlds(a, 2) as many:
        for w in (a, other, many):
            w.step(1 / 60)
        assert other.hash() == a.hash()
        np.testing.assert_array_equal(many.position[1], a.position)
    late = pile(world, loads=False)
    late.run(10.0)
    before = overlap(late)
    late.features[1].loads = True  # type: ignore[attr-defined]
    late.run(10.0)
    assert overlap(late) < 1e-2 * before
    with pytest.raises(TypeError, match="loads"):
        tv.Contact(loads="yes")  # type: ignore[arg-type]


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
        features = [tv.Gravity(G), tv.Distance(pairs, 0.1), tv.Drag(1.0)]
        return world(particles, features, solver=tv.Jacobi(loads=True), substeps=8, path=path)

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
