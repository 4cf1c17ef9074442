"""Bodies of particle loops: rest, friction, conservation, and no vertex inside of another body."""

import numpy as np
import pytest

import tiverlet as tv

from .outlines import outside


def bodies(shapes):
    """Return positions, loops and links of rigid bodies from lists of corners: all corners of a body are linked in pairs."""
    loops, links, at = [], [], 0
    for corners in shapes:
        i, j = np.triu_indices(len(corners), 1)
        loops.append(at + np.arange(len(corners)))
        links.append(np.stack([i, j], axis=1) + at)
        at += len(corners)
    return np.concatenate(shapes), loops, np.concatenate(links)


def regular(sides: int, radius: float, center, turn: float = 0.0):
    """Return the corners of a regular polygon that stands on an edge where `turn` is 0."""
    a = np.arange(sides) * 2 * np.pi / sides - np.pi / 2 + np.pi / sides + turn
    return radius * np.stack([np.cos(a), np.sin(a)], axis=1) + center


def depths(points: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """Return how deep points are inside of a polygon, 0 outside, by brute force [m]."""
    return np.maximum(-outside(points, loop), 0)


def linked(world, start, links, loops, friction=0.0, restitution=0.0, g=0.0, walls=((-99, -99), (999, 99)), floor=0.0, **more):
    """Return a world of linked bodies in a box; friction and restitution are compiled even where they are 0: one structure."""
    push_out = {"push_out": more.pop("push_out")} if "push_out" in more else {}
    polygons = tv.Polygons(loops, friction=0.5, restitution=0.5, **push_out)
    features = [tv.Distance(links), polygons, tv.Gravity(g), tv.Box(*walls, friction=0.5)]
    w = world(start, features, **({"precision": "f64", "solver": tv.Jacobi()} | more))
    polygons.friction, polygons.restitution, features[3].friction = friction, restitution, floor
    return w


def rigid(world, x, loops, g=10.0, restitution=0.0, friction=0.5, low=(-99, 0), high=(99, np.inf), held=None, **settings):
    """Return a world of rigid bodies on a floor, with friction and restitution, which may be 0: one structure.

    The last particle is pinned where nothing comes. held: what is rigid, if not the loops.
    """
    start = {name: settings.pop(name) for name in ("velocity", "pinned") if name in settings}
    radius, mass, n = settings.pop("radius", 0.0), settings.pop("mass", 0.25), len(x)
    pinned, v = [*start.get("pinned", ()), n], np.vstack([np.zeros_like(x) + start.get("velocity", 0.0), [(0.0, 0.0)]])
    particles = tv.Particles(
        np.vstack([x, [(low[0] + 0.5, low[1] + 19.0)]]), velocity=v, radius=np.append(np.zeros(n) + radius, np.max(radius)),
        mass=np.append(np.full(n, mass), 1.5 * mass), pinned=pinned,
    )  # fmt: skip
    features = [tv.Gravity(g), tv.Polygons(loops, friction=0.5, restitution=0.6), tv.ShapeMatch(loops if held is None else held)]
    features.append(tv.Box(low, high, friction=0.5, restitution=0.6))
    w = world(particles, features, precision="f64", **settings)
    features[1].restitution = features[3].restitution = restitution
    features[1].friction = features[3].friction = friction
    return w


def dropped(columns, rows, size=1.0):
    """Return boxes of 0.7 to 1 times `size`, in the air at random angles: positions and loops."""
    rng, shapes = np.random.default_rng(0), []
    for k, row in np.ndindex(columns, rows):
        half = size * rng.uniform(0.7, 1.0) / np.sqrt(2)
        shapes.append(regular(4, half, (size * (1.5 * k + 1), size * (1.5 * row + 1)), rng.uniform(0, 6.28)))
    x, loops, _ = bodies(shapes)
    return x, loops


@pytest.mark.slow
def test_boxes_stand_on_each_other_and_on_slopes(world):
    # Three boxes of exactly the same width, corners on corners, are at rest. The lower ones carry more and give way more: a
    # Jacobi pass gives links the compliance D h^2, while contacts of corners are resolved. On slopes of 20 and 30 degrees, pinned
    # triangles, a box sticks if tan < mu, and slides with g (sin - mu cos) if not (R18).
    mu, side = 0.45, 0.2
    shapes = [regular(4, side / np.sqrt(2), (0.0, (k + 0.5) * side)) for k in range(3)]
    pinned = []
    for x, degrees in ((2.0, 20.0), (6.0, 30.0), (10.0, 0.0)):
        a = np.radians(degrees)
        t, n = np.array([np.cos(a), -np.sin(a)]), np.array([np.sin(a), np.cos(a)])
        top = np.array([x, 1.5])
        shapes.append(np.array([top, [x, -1.0], [x + 3 * t[0], -1.0], top + 3 * t]))
        pinned += list(range(4 * len(shapes) - 4, 4 * len(shapes)))
        shapes.append(regular(4, side / np.sqrt(2), top + t + side / 2 * n, -a))
    x, loops, links = bodies(shapes)
    start = tv.Particles(x, pinned=pinned, mass=np.where(np.isin(np.arange(len(x)), pinned), 2.0, 1.0))
    w = linked(world, start, links, loops, mu, g=9.81, walls=((-99, 0), (99, 99)), floor=0.5, substeps=20)
    w.run(0.7)
    start = w.position
    w.run(0.3)
    got = w.position
    stack = got[:12].reshape(3, 4, 2)
    np.testing.assert_allclose(w.velocity[:12], 0, atol=1e-6)
    heights = np.diff(np.sort(stack[:, :, 1], axis=1).reshape(3, 2, 2).mean(axis=2), axis=1)[:, 0]
    assert 0 < side - heights[2] < side - heights[1] < side - heights[0] < 40 * 9.81 / 1200**2
    gaps = [stack[k, :, 1].max() - stack[k + 1, :, 1].min() for k in range(2)]
    np.testing.assert_allclose(gaps, 0, atol=9.81 / 1200**2)
    np.testing.assert_allclose(stack[:, :, 0].mean(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(got[16:20], start[16:20], atol=1e-6)
    a = np.radians(30.0)
    way = 9.81 * (np.sin(a) - mu * np.cos(a)) * (1.0**2 - 0.7**2) / 2
    assert np.linalg.norm((got - start)[24:28].mean(axis=0)) == pytest.approx(way, rel=0.02)
    assert w.last.clean and w.last.overlap < 1e-3 and np.abs(start - x)[12:20].max() < 1e-4
    # The impulses on each slope add up to m g h cos per substep, and those on the level block to m g h.
    found, body = w.contacts, np.repeat(np.arange(9), 4)
    for k, degrees in ((4, 20), (6, 30), (8, 0)):
        load = found.impulse[(body[found.pairs] == k).any(axis=1)].sum() * 1200
        assert load == pytest.approx(4 * 9.81 * np.cos(np.radians(degrees)), rel=1e-3)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_impulses_are_what_momentum_changes_by(world):
    # A point of 1 kg meets a free edge at a quarter of its length: the gradients are 1, -3/4 and -1/4, so the impulse is
    # (1 + e) u / (w_v + 9/16 w_a + 1/16 w_b). Another point meets a pinned edge, and a small square a large one, corners on edge.
    # In each substep a body receives the sum of impulse times normal, by its shares.
    e, u = 0.5, 3.0
    shapes = [regular(4, np.sqrt(0.5), (4.0 * k, 0.0)) for k in range(2)]
    shapes += [regular(4, np.sqrt(0.5), (8.0, 0.0)), regular(4, np.sqrt(0.125), (9.0, 0.1))]
    loops = [4 * k + np.arange(4) for k in range(4)]
    far, _, links = bodies([regular(6, 0.3, (20.0, 0.0)), regular(3, 0.4, (30.0, 0.0))])
    x = np.concatenate([*shapes, [[0.6, 0.25], [4.6, 0.1]], far])
    mass = np.r_[1.0, 2.0, 3.0, 4.0, np.ones(23)]
    v = np.zeros_like(x)
    v[12:18, 0] = -u
    start = tv.Particles(x, velocity=v, mass=mass, pinned=range(4, 8))
    w = linked(world, start, links + 18, loops, restitution=e, substeps=1)
    body, total = np.r_[np.repeat(np.arange(4), 4), 4, 5, np.full(9, 6)], np.zeros((7, 2))
    before = v
    for _ in range(60):
        w.step(1 / 600)
        found = w.contacts
        each = np.zeros_like(x)
        shares = ((found.pairs[:, 0], 1 + 0 * found.place), (found.pairs[:, 1], found.place - 1), (found.ends, -found.place))
        for who, share in shares:
            np.add.at(each, who, (share * found.impulse)[:, None] * found.normal)
        change = mass[:, None] * (w.velocity - before)
        np.testing.assert_allclose(each[start.inv_mass > 0], change[start.inv_mass > 0], atol=1e-9)
        before = w.velocity
        np.add.at(total, body, each)
    a, b = (k for k in range(4) if x[k, 0] > 0)
    t = (0.25 - x[a, 1]) / (x[b, 1] - x[a, 1])
    blow = (1 + e) * u / (1 + (1 - t) ** 2 / mass[a] + t**2 / mass[b])
    np.testing.assert_allclose(total[4], [blow, 0], atol=1e-9)
    np.testing.assert_allclose(total[5], [(1 + e) * u, 0], atol=1e-9)
    assert total[3, 0] > u and np.abs(total[2] + total[3]).max() < 1e-9


def test_collisions_conserve_momentum_and_angular_momentum(world):
    # A spinning hexagon, a triangle and two points meet in free space, with friction and restitution and unequal masses.
    x, loops, links = bodies([regular(6, 0.3, (-0.6, 0.1)), regular(3, 0.4, (0.6, 0.0), 0.3)])
    # Points, because friction at a radius would be a torque, and no particle spins. One point is pinned far away.
    x = np.concatenate([x, [[0.0, 0.62], [0.0, -0.62], [99.0, 0.0]]])
    v = np.concatenate([np.tile([2.0, 0.0], (6, 1)), np.tile([-2.0, 0.0], (3, 1)), [[0.0, -2.0], [0.0, 2.0], [0.0, 0.0]]])
    v[:6] += 3.0 * np.stack([-(x[:6, 1] - 0.1), x[:6, 0] + 0.6], axis=1)
    mass = np.r_[np.full(6, 1.0), np.full(3, 3.0), 0.5, 0.5, 1.0]
    start = tv.Particles(x, velocity=v, mass=mass, pinned=[11])
    w = linked(world, start, links, loops, 0.4, 0.5)

    def moments(x, v):
        return np.r_[(mass[:, None] * v).sum(axis=0), (mass * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])).sum()]

    # The sum of m d is conserved, and that of x times m d, for displacements d = h v. The latter is exact but for the slip in a
    # substep, at most 4 m/s h, times the impulses, about 10 kg m/s.
    want = moments(x, v)
    for substeps in (20, 100):
        w.position, w.velocity, w.substeps = start.position, start.velocity, substeps
        turned = 0
        for _ in range(60):
            w.step(1 / 60)
            turned = max(turned, np.abs(w.velocity[9:] - v[9:]).max())
            x, d = w.position, w._runner.scene.memory.read(w._runner.scene.state.d) * 60 * substeps
            np.testing.assert_allclose(moments(x, d)[:2], want[:2], atol=1e-10)
        assert turned > 0.5
        assert moments(x, d)[2] == pytest.approx(want[2], abs=40 / 60 / substeps)
    assert tv.measure.kinetic_energy(w) <= 0.5 * (mass * (v**2).sum(axis=1)).sum()


@pytest.mark.slow
def test_corners_of_one_width_carry_each_other(world):
    # Rigid boxes of one width, corners on corners. At so few substeps, one substep moves corners deeper than edges reach beyond
    # their ends. They stand where they were placed: contacts lack 5e-4 of the displacement by forces, g h^2, and those of a
    # stack of three add up.
    x, loops, _ = bodies([regular(4, 0.2 / np.sqrt(2), (0.0, (k + 0.5) * 0.2)) for k in range(3)])
    for substeps in (4, 2):
        w = rigid(world, x, loops, 9.81, substeps=substeps)
        assert w.run(2.0).clean
        np.testing.assert_allclose(w.position[:-1], x, atol=3 * 5e-4 * 9.81 / (60 * substeps) ** 2)


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_overlap_is_pushed_out_and_collapse_stays_finite(world):
    # A corner that starts inside of a box leaves it without velocity: what moves places gives no momentum. A loop without links
    # is pressed flat, and stays finite.
    x, loops, _ = bodies([regular(4, 0.5, (0.0, 0.0)), regular(4, 0.5, (0.6, 0.02)), regular(3, 0.3, (5.0, 1.0))])
    _, _, links = bodies([x[:4], x[4:8]])
    start = tv.Particles(np.vstack([x, [[50.0, 50.0]]]), mass=np.r_[np.ones(10), 2.0, 2.0], pinned=[11])
    w, x = linked(world, start, links, loops, walls=((-99, -0.6), (99, 99)), push_out=0.3), start.position
    for _ in range(90):
        w.step(1 / 60)
        assert np.abs(w.velocity).max() < 0.3 * 0.01
    assert depths(w.position[4:8], w.position[:4]).max() < 1e-3 and depths(w.position[:4], w.position[4:8]).max() < 1e-3
    # Overlap at a start depends on where bodies are, not on their velocities. A body thrown deeper gets no deeper than it was,
    # but for its motion in a substep. After overlap / push_out both overlap by no more than places leave, 0.009 half edges.
    found, v = [], np.zeros_like(x)
    for speed in ((0.0, 0.0), (0.0, -6.0), (-3.0, 7.0), (-6.0, 0.0)):
        v[4:8] = speed
        w.position, w.velocity = x, v
        found.append(w.contacts)
        for name in ("pairs", "ends", "place", "overlap", "normal"):
            np.testing.assert_array_equal(getattr(found[-1], name), getattr(found[0], name))
    deep = np.r_[depths(x[:4], x[4:8]), depths(x[4:8], x[:4])]
    np.testing.assert_array_equal(found[0].pairs[:, 0], np.flatnonzero(deep))
    np.testing.assert_allclose(
        found[0].overlap, sat(x[:4], x[4:8])[0], rtol=1e-9
    )  # the distance that the bodies have to move, not how deep their corners are
    begin = x[:4, 0].max() - x[4:8, 0].min()
    for _ in range(24):  # 0.1 / 0.3 s and a little more
        w.step(1 / 60)
        left = w.position[:4, 0].max() - w.position[4:8, 0].min()
        assert left < begin + 6 / 1200
    w.run(0.1)
    assert sat(w.position[:4], w.position[4:8])[0] < 0.009 * 0.5 / 2**0.5
    w.position = np.concatenate([w.position[:8], [[5.0, 0.0], [5.0, 0.0], [5.0, 0.0], [50.0, 50.0]]])
    w.features[2].g = 9.81
    w.run(0.5)
    assert np.isfinite(w.position).all()


def test_nothing_in_a_heap_stays_inside_of_what_it_bears_or_moves_on(world):
    # Boxes of 1 kg and 0.7 to 1 m, dropped at 4 substeps, so that corners are pressed into other boxes as they land. Corners
    # leave at push_out under any load. At a corner with at most 4 contacts and w = 4 / kg, which bears up to 8 boxes,
    # F h^2 (4 w + 4 w) is left. With a push that is split as the mass is, corners would stay 0.1 to 0.3 m deep. And the heap
    # comes to rest, though some corners hardly touch their neighbours. With masses split by the number of contacts, not by their
    # depth, some would keep 0.03 m/s.
    x, loops = dropped(4, 8)
    w = rigid(world, x, loops, low=(0, 0), high=(6.5, np.inf), substeps=4)
    start = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(300)) < start * (1 + 1e-12)
    assert w.contacts.overlap.max() < 8 * 10.0 / 240**2 * 32 / 2
    w.substeps = 8
    w.run(4.0)
    assert np.abs(w.velocity).max() < 0.01


def test_stacks_that_bounce_come_to_rest(world):
    # A contact rests if its particles approach no faster than its load explains, so bouncing ends. Boxes fall on each other, the
    # upper one narrower, bounce and then lie still. Otherwise they would keep 0.05 m/s.
    x, loops, _ = bodies([np.array([[-s, 0], [s, 0], [s, 2 * s], [-s, 2 * s]]) + [0, y] for s, y in ((0.5, 0.2), (0.45, 1.9))])
    w = rigid(world, x, loops, restitution=0.6, substeps=8)
    gaps = [w.position[4:8, 1].min() - w.position[:4, 1].max() for _ in range(60) if w.step(1 / 60)]
    met = int(np.argmax(np.array(gaps) < 0.01))
    assert max(gaps[met:]) > 0.03  # [m], after they have met
    w.run(4.0)
    assert np.abs(w.velocity).max() < 1e-4  # what passes leave of gravity in a frame, 5e-4 g / 60 Hz
    # In a heap each corner's bounce feeds the next one's, unless approach speeds that two substeps of forces explain count as
    # rest. Otherwise some 20 of 48 boxes keep hopping at 0.1 m/s. A column of eight boxes still sways, which no impact does.
    x, loops = dropped(6, 8)
    w = rigid(world, x, loops, restitution=0.6, low=(0, 0), high=(9.5, np.inf), substeps=4)
    w.run(30.0)
    assert np.abs(w.velocity[:, 1]).max() < 0.01 and np.abs(w.velocity).max() < 0.2


@pytest.mark.slow
def test_discs_among_boxes_come_to_rest_without_overlap(world):
    # A body that is squeezed from both sides has the eigenvalue 1 of a pass where masses are split by the usual depth of
    # contacts. Split by the depth of this substep it is 2, and half of the bodies oscillate from substep to substep at 0.1 m/s.
    # At rest no vertex is deeper inside of another body than 1 % of an edge, and no disc deeper than 2 % of its radius.
    x, loops = dropped(4, 3, 0.55)
    k, n = np.arange(24), len(x)
    discs = np.stack([0.3 + 0.45 * (k % 8), 3.2 + 0.45 * (k // 8)], axis=1)
    x, radius = np.concatenate([x, discs]), np.repeat([0.02, 0.15], [n, 24])
    w = rigid(world, x, loops, 9.81, low=(-0.2, 0), high=(4.2, 20), radius=radius, mass=1.0, substeps=8)
    first = w.step(1 / 60).energy
    assert max(w.step(1 / 60).energy for _ in range(1500)) < first * (1 + 1e-6)
    assert np.abs(w.velocity).max() < 0.01 > w.contacts.overlap.max() / 0.15
    for loop in loops:
        others = np.setdiff1d(np.arange(n), loop)
        assert depths(w.position[others], w.position[loop]).max() < 0.01 * 0.55 * 0.7 / np.sqrt(2)
        assert outside(w.position[n:-1], w.position[loop]).min() > 0.15 * 0.98


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_edges_that_are_too_long_keep_momentum(world):
    # Loops that hold nothing together, pulled apart to many times their size: one end of an edge may be too far for the list.
    # Then a vertex must not push the other end alone.
    x = np.stack(np.divmod(np.arange(12), 4)[::-1], axis=1) * 0.3
    v = [(1.3, -1.3), (6.4, 1.0), (-5.4, 3.6), (13.0, 9.5), (-7.0, -12.7), (-6.2, 0.4), (-23.3, -2.2), (-12.5, -7.3),
         (-5.4, -3.2), (4.1, 10.4), (-1.3, 13.7), (-6.7, 3.5)]  # fmt: skip
    loops = [range(6), range(6, 12)]
    x, v = np.vstack([x, [(50, 50), (51, 50)]]), np.vstack([v, np.zeros((2, 2))])
    start = tv.Particles(x, velocity=v, mass=np.append(np.ones(13), 2.0), pinned=[13])
    w = linked(world, start, [[12, 13]], loops, restitution=0.9)
    for _ in range(2):
        w.step(1 / 60)
        np.testing.assert_allclose(w.velocity[:12].sum(axis=0), v.sum(axis=0), atol=1e-10)
    assert np.abs(w.velocity[:12] - v[:12]).max() > 0.1


def test_bad_loops_are_named():
    square = regular(4, 0.5, (0.0, 0.0))
    particles = tv.Particles(np.concatenate([square, [[0.0, 0.01], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]]]))
    deep = tv.Particles(np.concatenate([regular(8, 0.5, (0.0, 0.0)), [[0.0, 0.01]]]))
    for make, words in (
        (lambda: tv.Polygons([[0, 1]]), r"loops\[0\] has 2 particles"),
        (lambda: tv.Polygons([[0, 1, 2], [2, 3, 4]]), r"particle 2 is in loops\[0\] and again in loops\[1\]"),
        (lambda: tv.Polygons([[0, 1, 1]]), r"particle 1 is in loops\[0\] and again in loops\[0\]"),
        (lambda: tv.World(particles, [tv.Polygons([[0, 1, 9]])]), r"loops\[0\]\[2\] = 9, but there are 8"),
        (lambda: tv.World(particles, [tv.Polygons([[5, 6, 7]])]), r"loops\[0\] encloses 0 m"),
        (
            lambda: tv.World(tv.Particles(tv.shapes.box((0, 0), (1, 1)).position), [tv.Polygons([range(4)])]),
            r"not in order .*shape.loops\[0\] \+ n",
        ),
        (lambda: tv.World(deep, [tv.Polygons([range(8)])]), r"particle 8 starts 0.452 m inside of loops\[0\]"),
        (lambda: tv.World(tv.Particles(np.zeros((3, 3))), [tv.Polygons([[0, 1, 2]])]), "for 2D worlds"),
        (lambda: tv.World(particles, [tv.Polygons([[0, 1, 2]]), tv.Contact()]), "more than one Contact"),
    ):
        with pytest.raises(ValueError, match=words):
            make()


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_discs_beside_wide_bodies_list_what_they_may_touch(world):
    # Two discs are neighbours by their own radii, however long the edges of bodies elsewhere are. Cells and the skin follow the
    # radii, too. A disc is listed with both ends of an edge that is within its radius plus the skin, and few others.
    discs = np.stack(np.divmod(np.arange(100), 10), axis=1) * 0.25 + [0.0, 1.5]
    body = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.46], [0.0, 1.46]])
    start = tv.Particles([*body, *discs], radius=np.r_[np.zeros(4), np.full(100, 0.1)])
    w = world(start, [tv.Polygons([range(4)])], path="launched")  # with a kernel of its own for the list
    search = w._runner.search
    skin = (0.75 + 0.15) * 0.1  # and how far ahead pairs are rows
    assert search.skin == pytest.approx(skin) and search.finest == pytest.approx(2 * 0.1 + skin, rel=1e-3)
    w._runner.list_neighbours()
    pairs, _ = search.list.entries()
    both = pairs[(pairs >= 4).all(axis=1)]
    apart = np.linalg.norm(start.position[both[:, 0]] - start.position[both[:, 1]], axis=1)
    assert (apart < 0.2 + search.skin).all()
    listed, some = {tuple(p) for p in pairs.tolist()}, 0
    for a in range(4):
        b = (a + 1) % 4
        t = np.clip((discs - body[a]) @ (body[b] - body[a]) / ((body[b] - body[a]) ** 2).sum(), 0, 1)
        for k in np.flatnonzero(np.linalg.norm(discs - body[a] - t[:, None] * (body[b] - body[a]), axis=1) < 0.175):
            assert {(k + 4, a), (k + 4, b), (a, k + 4), (b, k + 4)} <= listed
            some += 1
    assert 8 <= some and len(pairs) - len(both) < 12 * some, (some, len(pairs) - len(both))


def sat(a: np.ndarray, b: np.ndarray) -> tuple[float, np.ndarray]:
    """Return how deep two convex counterclockwise loops overlap (negative where apart), and the direction in which b leaves a."""
    best = (np.inf, np.zeros(2))
    for p, q, sign in ((a, b, 1.0), (b, a, -1.0)):
        u = np.roll(p, -1, axis=0) - p
        normal = np.stack([u[:, 1], -u[:, 0]], axis=1) / np.linalg.norm(u, axis=1)[:, None]
        depth = -((q[None] - p[:, None]) * normal[:, None]).sum(axis=2).min(axis=1)
        k = int(np.argmin(depth))
        best = min(best, (float(depth[k]), sign * normal[k]), key=lambda found: found[0])
    return best


@pytest.mark.slow
def test_corners_that_cross_part_over_the_nearer_edge(world):
    # Two sharp corners have passed each other: no vertex is inside of the other body, but edges cross. Two wedges part soonest
    # over one of their edges (separating axes), and contacts have to find it. They conserve momentum, and angular momentum but
    # for an impulse of 0.2 kg m/s times the slip in a substep, 0.2 m/s h.
    rng, shapes = np.random.default_rng(5), []
    while len(shapes) < 30:
        tips = []
        for side in (-1.0, 1.0):
            half, lean, length = rng.uniform(0.15, 0.6), rng.uniform(-0.5, 0.5), rng.uniform(0.5, 1.0)
            angle = side * np.pi / 2 + lean + np.array([-half, half])
            tips.append(np.concatenate([[[0.0, 0.0]], length * np.stack([np.cos(angle), np.sin(angle)], axis=1)]))
        a, b = tips[0], tips[1] + rng.uniform(-0.06, 0.06, 2)
        inside = max(depths(a, b).max(), depths(b, a).max())
        if inside == 0 and sat(a, b)[0] > 1e-3:
            shapes += [a + [2.0 * len(shapes), 0.0], b + [2.0 * len(shapes), 0.0]]
    x, loops, links = bodies(shapes)
    mass = rng.uniform(0.5, 2.0, len(x))
    x, mass = np.vstack([x, [[500.0, 90.0]]]), np.r_[mass, 1.0]
    w = linked(world, tv.Particles(x, mass=mass, pinned=[len(x) - 1]), links, loops, push_out=0.2, substeps=10)
    found = w.contacts
    body = np.repeat(np.arange(len(shapes)), 3)
    want = [sat(shapes[k], shapes[k + 1]) for k in range(0, len(shapes), 2)]
    assert (body[found.pairs[:, 0]] // 2 == np.arange(len(want))).all()
    np.testing.assert_allclose(found.overlap, [depth for depth, _ in want], rtol=1e-9)
    sign = np.where(body[found.pairs[:, 0]] % 2 == 1, 1.0, -1.0)[:, None]  # where the vertex belongs to the second body
    np.testing.assert_allclose(sign * found.normal, [n for _, n in want], atol=1e-9)
    for _ in range(60):
        w.step(1 / 60)
        y, d = w.position, mass[:, None] * w._runner.scene.memory.read(w._runner.scene.state.d) * 600
        moments = np.c_[d, y[:, 0] * d[:, 1] - y[:, 1] * d[:, 0]][:-1].reshape(-1, 6, 3).sum(axis=1)
        np.testing.assert_allclose(moments[:, :2], 0, atol=1e-12)
        np.testing.assert_allclose(moments[:, 2], 0, atol=0.2 * 0.2 / 600)
        assert np.abs(w.velocity).max() < 0.2 * 0.01  # places give no momentum
    half = np.linalg.norm(x[1:-1] - x[:-2], axis=1).max() / 2
    assert max(sat(y[loops[k]], y[loops[k + 1]])[0] for k in range(0, len(shapes), 2)) < 0.009 * half


@pytest.mark.parametrize("gap", [0.0, 1e-2])
def test_what_slides_over_level_tiles_keeps_its_speed(world, gap):
    # A box, a hexagon, a disc and a point slide at 1 m/s over 4 pinned squares of 1 m, with gaps between, without friction, each
    # over squares of its own. The foremost corner meets the side of the next square a slop below its top. The disc also touches
    # corners, whose normals lean: a blow between two of them takes (gap / radius)^2 / 2 of the speed, and a substep has its part.
    sides, lines = regular(4, np.sqrt(0.5), (0.0, -0.5)), []
    box, hexagon = regular(4, 0.56, (0.0, 0.56 / np.sqrt(2))), regular(6, 0.4, (0.0, 0.4 * np.sin(np.pi / 3)))
    for k, body in enumerate((box, hexagon, [(0.0, 0.3)], [(0.0, 0.0)])):
        lines.append([*(sides + (j * (1 + gap), -9.0 * k) for j in range(4)), np.array(body) + (0.0, -9.0 * k)])
    x, loops, _ = bodies([shape for line in lines for shape in line])
    moves = np.concatenate([np.full(len(shape), k % 5 == 4) for k, shape in enumerate(s for line in lines for s in line)])
    loops = [loop for loop in loops if len(loop) > 1]
    radius = np.where(np.arange(len(x)) == len(x) - 18, 0.3, 0.0)
    begin: dict = dict(velocity=moves[:, None] * [1.0, 0.0], radius=radius, pinned=np.flatnonzero(~moves))
    held = [loop for loop in loops if moves[loop[0]]]
    w = rigid(world, x, loops, 9.81, friction=0.0, low=(-99, -99), held=held, **begin)
    start, moves = w.particles, np.append(moves, False)
    most = np.where(start.radius[moves] > 0, 1.5e-3 + 3 * (gap / 0.3) ** 2 / 2, 1e-3)
    for substeps in (8, 60):
        w.position, w.velocity, w.substeps = start.position, start.velocity, substeps
        for _ in range(150):
            w.step(1 / 60)
            assert (np.abs(w.velocity[moves, 0] - 1.0) < most).all()
        assert np.abs(w.position - start.position)[moves, 1].max() < 0.005 * 0.5 and w.last.clean


@pytest.mark.slow
def test_a_hub_that_is_tied_to_all_corners_is_no_stray_particle(world):
    # A wheel with its hub inside, in one rigid cluster or by spokes, rolls along the floor: its middle stays a radius above it. A
    # plank, whose hub is near to its edges, falls freely.
    angle = np.pi / 6 * np.arange(12)
    wheel = np.concatenate([[[0.0, 0.3]], [0.0, 0.3] + 0.3 * np.stack([np.sin(angle), -np.cos(angle)], axis=1)])
    plank = np.array([[0.0, 0.0], [-2.0, -0.1], [2.0, -0.1], [2.0, 0.1], [-2.0, 0.1]]) + [0.0, 9.0]
    x, rolls = np.concatenate([wheel, plank]), dict(velocity=(1.0, 0.0))
    loops, clusters = [np.arange(1, 13), np.arange(14, 18)], [np.arange(13), np.arange(13, 18)]
    w = rigid(world, x, loops, held=clusters, **rolls)
    assert w.run(0.5).clean and w.last.contacts == 0
    np.testing.assert_allclose(w.position[13:-1], plank + (0.5, -10.0 * 0.5**2 / 2), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(w.position[1:13] - w.position[0], axis=1), 0.3, rtol=0.02)
    assert w.position[0, 0] > 0.2
    spokes = [(0, k) for k in range(1, 13)] + [(k, k % 12 + 1) for k in range(1, 13)]
    start = tv.Particles(np.vstack([wheel, [(50.0, 50.0)]]), mass=np.append(np.ones(13), 2.0), pinned=[13], **rolls)
    w = linked(world, start, spokes, loops[:1], g=9.81, walls=((-99, 0), (99, 99)), floor=0.5, iterations=8)
    assert w.run(0.5).clean and w.last.contacts == 0
    np.testing.assert_allclose(np.linalg.norm(w.position[1:13] - w.position[0], axis=1), 0.3, rtol=0.02)
    with pytest.raises(ValueError, match="particle 0 starts 0.29 m inside of loops"):
        world(tv.Particles(wheel), [tv.Polygons(loops[:1]), tv.ShapeMatch(loops[:1])])
    with pytest.warns(UserWarning, match=r"no constraint holds loops\[0\] \(1 such in all\)"):
        world(tv.Particles(wheel[1:]), [tv.Polygons([np.arange(12)]), tv.Pin([3, 4], compliance=1.0)])
