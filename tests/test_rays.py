"""Questions: rays and shapes against closed forms of distances, sampled densely along the rays."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.patches.compiler import CachedLaunch

NONE = -1
U = np.array([(-1, -1), (1, -1), (1, 1), (0.5, 1), (0.5, -0.5), (-0.5, -0.5), (-0.5, 1), (-1, 1)]) * 0.8  # not convex
CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.4, 0.4) for z in (-0.3, 0.3)])
HALF = np.array([0.5, 0.4, 0.3])
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = [face for a, b, c, d in SIDES for face in ((a, b, c), (a, c, d))]


@ti.func
def ring(p):
    """Return the distance to an annulus in 2D: a circle of radius 0.7 with a thickness of 0.2 to both sides."""
    return ti.abs(p.norm() - 0.7) - 0.2


@ti.func
def torus(p):
    """Return the distance to the circle of ring() turned about the y axis: a torus."""
    a = ti.sqrt(p[0] * p[0] + p[2] * p[2]) - 0.7
    return ti.sqrt(a * a + p[1] * p[1]) - 0.2


def turned(x, place, angle):
    """Return points in the frame of a shape at `place` that is turned by an angle, about z in 3D."""
    c, s = np.cos(angle), np.sin(angle)
    r = x - place
    out = r.copy()
    out[:, 0], out[:, 1] = c * r[:, 0] + s * r[:, 1], -s * r[:, 0] + c * r[:, 1]
    return out


def to_segment(x, a, b):
    """Return the distances of points to a segment."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    t = np.clip((x - a) @ (b - a) / max((b - a) @ (b - a), 1e-300), 0, 1)
    return np.linalg.norm(x - a - t[:, None] * (b - a), axis=1)


def to_loop(x, v, closed=True):
    """Return the signed distance to a polygon, negative inside (crossings of a ray); unsigned for an open line."""
    ends = np.roll(v, -1, axis=0)
    pairs = list(zip(v, ends, strict=True))[: None if closed else -1]
    out, odd = np.min([to_segment(x, a, b) for a, b in pairs], axis=0), np.zeros(len(x), dtype=bool)
    for a, b in pairs:
        between = (a[1] > x[:, 1]) != (b[1] > x[:, 1])
        with np.errstate(divide="ignore", invalid="ignore"):
            odd ^= between & (x[:, 0] < a[0] + (x[:, 1] - a[1]) / (b[1] - a[1]) * (b[0] - a[0]))
    return np.where(odd & closed, -out, out)


def to_cuboid(x, half):
    """Return the signed distance to a box about the origin, negative inside."""
    q = np.abs(x) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


PLACE, ANGLE = np.array([0.3, -0.2, 0.15]), 0.6
IN, ON = PLACE[:2], np.zeros(3)
# Walls as they are made; the knobs that move them in a frame; and C(x) of points for the moved wall.
WALLS = {
    2: [
        (lambda: tv.Box((-1, -1), (1, 1)), {"upper": (1.5, 0.9)}, lambda x: -to_cuboid(x - (0.25, -0.05), (1.25, 0.95))),
        (lambda: tv.Box((-1, -np.inf), (1, 1)), {}, lambda x: -to_cuboid(x + (0, 99), (1, 100))),
        (lambda: tv.HalfSpace((1, 3), -0.5), {"offset": -0.3}, lambda x: x @ np.array([1, 3]) / np.sqrt(10) + 0.3),
        (lambda: tv.Ball((0, 0), 0.8), {"center": (0.3, 0.1)}, lambda x: np.linalg.norm(x - (0.3, 0.1), axis=1) - 0.8),
        (lambda: tv.Ball((0, 0), 0.8, inside=True), {"center": (0.3, 0)}, lambda x: 0.8 - np.linalg.norm(x - (0.3, 0), axis=1)),
        (lambda: tv.Capsule((-1, 0), (1, 0), 0.2), {"b": (0.7, 1)}, lambda x: to_segment(x, (-1, 0), (0.7, 1)) - 0.2),
        (lambda: tv.Polygon(U), {"position": IN, "rotation": ANGLE}, lambda x: to_loop(turned(x, IN, ANGLE), U)),
        (lambda: tv.Polygon(U, radius=0.1), {"rotation": ANGLE}, lambda x: to_loop(turned(x, ON[:2], ANGLE), U) - 0.1),
        (lambda: tv.Polygon(U, inside=True), {"rotation": ANGLE}, lambda x: -to_loop(turned(x, ON[:2], ANGLE), U)),
        (lambda: tv.Polygon(U[:5], closed=False, radius=0.1), {"position": IN}, lambda x: to_loop(x - IN, U[:5], False) - 0.1),
        (lambda: tv.Sdf(ring, radius=0.05), {"position": IN}, lambda x: np.abs(np.linalg.norm(x - IN, axis=1) - 0.7) - 0.25),
    ],
    3: [
        (lambda: tv.Box((-1, -1, -1), (1, 1, 1)), {"lower": (-2, -1, -1)}, lambda x: -to_cuboid(x + (0.5, 0, 0), (1.5, 1, 1))),
        (lambda: tv.HalfSpace((0, 1, 1), -0.5), {}, lambda x: x @ np.array([0, 1, 1]) / np.sqrt(2) + 0.5),
        (lambda: tv.Ball((0, 0, 0), 0.8), {"center": (0.3, 0, 0)}, lambda x: np.linalg.norm(x - (0.3, 0, 0), axis=1) - 0.8),
        (lambda: tv.Capsule((-1, 0, 0), (1, 0, 0), 0.2), {"a": (0, 1, 1)}, lambda x: to_segment(x, (0, 1, 1), (1, 0, 0)) - 0.2),
        (
            lambda: tv.Mesh(CUBE, FACES), {"position": PLACE, "rotation": (0, 0, ANGLE)},
            lambda x: to_cuboid(turned(x, PLACE, ANGLE), HALF),
        ),
        (
            lambda: tv.Mesh(CUBE, FACES, radius=0.2), {"rotation": (0, 0, ANGLE)},
            lambda x: to_cuboid(turned(x, ON, ANGLE), HALF) - 0.2,
        ),
        (lambda: tv.Mesh(CUBE, FACES, inside=True), {"position": PLACE}, lambda x: -to_cuboid(x - PLACE, HALF)),
        (
            lambda: tv.Mesh(CUBE[:4], FACES[:2], closed=False, radius=0.1), {},
            lambda x: to_cuboid(x + (0.5, 0, 0), HALF * (0, 1, 1)) - 0.1,
        ),
        (lambda: tv.Sdf(torus), {"position": PLACE, "rotation": (0, 0, ANGLE)}, lambda x: tube(turned(x, PLACE, ANGLE))),
    ],
}  # fmt: skip


def tube(x):
    """Return the distance of torus(), in NumPy."""
    return np.hypot(np.hypot(x[:, 0], x[:, 2]) - 0.7, x[:, 1]) - 0.2


def prove(hits, origin, direction, gap, radius=0.0, tolerance=1e-9, reach=8.0, samples=400):
    """Check that each ray ends where gap(x) - radius first falls to 0 from above, and that normals are the gradient of gap."""
    d = direction / np.linalg.norm(direction, axis=1)[:, None]
    s = np.linspace(0, reach, samples)
    values = gap((origin[:, None] + s[:, None] * d[:, None]).reshape(-1, d.shape[1])).reshape(len(d), -1) - radius
    falls = (values[:, :-1] > 0) & (values[:, 1:] <= 0)
    first = np.where(falls.any(axis=1), s[1:][falls.argmax(axis=1)], np.inf)
    t = np.where(hits.distance <= reach, hits.distance, np.inf)
    assert (t <= first + tolerance).all()
    met = t < np.inf
    x = origin[met] + t[met, None] * d[met]
    n = hits.normal[met]
    # A ray may also meet something between two samples that miss it: gap is positive before the point, and not after it.
    np.testing.assert_allclose(gap(x) - radius, 0, atol=tolerance)
    assert (gap(x - 1e-5 * d[met]) > radius).all() and (gap(x + 1e-5 * d[met]) < radius + tolerance).all()
    np.testing.assert_allclose(hits.point[met], x - radius * n, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-12)
    assert ((n * d[met]).sum(axis=1) <= 1e-7).all()
    step = 1e-6
    slope = np.stack([gap(x + step * e) - gap(x - step * e) for e in np.eye(d.shape[1])], axis=1) / (2 * step)
    smooth = np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-3  # and not at an edge
    assert smooth.mean() > 0.9
    np.testing.assert_allclose(n[smooth], slope[smooth], atol=1e-4)
    assert np.isnan(hits.point[~np.isfinite(hits.distance)]).all()
    return met


def bundle(dim, k, seed, wide=2.0):
    """Return rays from all over towards the scene; their directions are of any length."""
    rng = np.random.default_rng(seed)
    origin = rng.uniform(-wide, wide, (k, dim))
    return origin, (rng.uniform(-wide / 2, wide / 2, (k, dim)) - origin) * 10.0 ** rng.uniform(-3, 3, (k, 1))


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_are_met_and_are_where_their_distance_falls_to_zero(world, dim, monkeypatch):
    # Before and after a frame in which the walls move; for rays of radius 0 and above; and for starts inside of the wall. The
    # host computes where walls are, so the frame runs without its kernel, which takes long to compile for all walls.
    monkeypatch.setattr(CachedLaunch, "__call__", lambda launch: None)
    made = [make() for make, _, _ in WALLS[dim]]
    rng = np.random.default_rng(9)
    x, r = rng.uniform(-1.5, 1.5, (500, dim)), rng.uniform(0.001, 0.2, 500)
    w = world(tv.Particles(x, radius=r, pinned=range(500)), made, precision="f64", substeps=1)
    o, d = bundle(dim, 120, 1)
    before = [w.ray(o, d, features=[wall], groups=()) for wall in made]
    for wall, (_, knobs, _) in zip(made, WALLS[dim], strict=True):
        for name, value in knobs.items():
            setattr(wall, name, value)
    for wall, was in zip(made, before, strict=True):  # knobs move nothing before the next step
        np.testing.assert_array_equal(w.ray(o, d, features=[wall], groups=()).distance, was.distance)
    w.step(0.01)
    for k, (wall, (make, knobs, gap)) in enumerate(zip(made, WALLS[dim], strict=True)):
        fine = 1e-6 if isinstance(wall, tv.Sdf) else 1e-9
        for radius in (0.0, 0.07):
            hits = w.ray(o, d, 8.0, radius=radius, features=[wall], groups=())
            met = prove(hits, o, d, gap, radius, fine)
            assert 0.02 < met.mean() and (hits.wall[met] == k).all() and (hits.wall[~met] == NONE).all()
        # The same shape outside of any world, at its new place; and which particles are inside of it.
        alone = make()
        for name, value in knobs.items():
            setattr(alone, name, value)
        np.testing.assert_allclose(alone.clearance(o), gap(o), atol=1e-12)
        np.testing.assert_allclose(wall.clearance(o), gap(o), atol=1e-12)
        depth = gap(x) if alone.inside else -gap(x)
        for part, least in (("center", 0 * r), ("whole", r), ("touching", -r)):
            np.testing.assert_array_equal(w.inside(alone, part), np.flatnonzero(depth >= least))
        assert 0 < len(w.inside(alone)) < 500


@pytest.mark.parametrize("dim", [2, 3])
def test_particles_and_links_are_met_first_come_first(world, dim):
    # Discs of many sizes, rods between them and a wall around: the least of all distances, and the thing at that distance.
    rng = np.random.default_rng(2)
    n = 40
    x, r = rng.uniform(-1.5, 1.5, (n, dim)), 10.0 ** rng.uniform(-2.5, -0.8, n)
    pairs = np.array([(i, i + 1) for i in range(0, 30, 2)])
    w = world(tv.Particles(x, radius=r), [tv.Rope(pairs), tv.Box([-3] * dim, [3] * dim)], precision="f64")
    rods = r[pairs].min(axis=1)

    def gaps(p):
        """Return the distances to all things, (n + m + 1, k): discs, rods, the wall."""
        discs = [np.linalg.norm(p - x[i], axis=1) - r[i] for i in range(n)]
        lines = [to_segment(p, x[a], x[b]) - rods[c] for c, (a, b) in enumerate(pairs)]
        return np.array([*discs, *lines, 3 - np.abs(p).max(axis=1)])

    o, d = bundle(dim, 150, 3, 2.9)
    free = gaps(o).min(axis=0) > 0
    o, d = o[free], d[free]
    for radius in (0.0, 0.02):
        clear = gaps(o).min(axis=0) > radius
        hits = w.ray(o[clear], d[clear], radius=radius)
        assert hits.met.all() and len(hits) == clear.sum()
        prove(hits, o[clear], d[clear], lambda p: gaps(p).min(axis=0), radius)
        unit = d[clear] / np.linalg.norm(d[clear], axis=1)[:, None]
        each = gaps(o[clear] + hits.distance[:, None] * unit)
        which = np.where(hits.particle >= 0, hits.particle, np.where(hits.link[:, 0] == 0, n + hits.link[:, 1], n + len(pairs)))
        np.testing.assert_allclose(each[which, np.arange(clear.sum())], radius, atol=1e-9)
        assert {*np.sign(hits.particle + 1)} == {0, 1} and (hits.link[:, 0] == 0).any() and (hits.wall == 1).any()
        kinds = (hits.particle >= 0).astype(int) + (hits.link[:, 0] >= 0) + (hits.wall >= 0)
        assert (kinds == 1).all()


def test_what_a_ray_starts_in_or_on(world):
    # A ray leaves a particle and a rod without meeting them, and meets the next thing. From a surface: inwards it meets at 0,
    # outwards and along never.
    w = world(tv.Particles([(0, 0), (3, 0), (5, 0)], radius=(0.5, 0.5, 0.25)), [tv.Distance([(0, 1)])], precision="f64")
    for start, surface, particle in ((0.0, 2.5, 1), (0.2, 2.5, 1), (1.5, 2.5, 1), (2.6, 4.75, 2), (3.0, 4.75, 2), (3.5, 4.75, 2)):
        hit = w.ray((start, 0), (7, 0))
        np.testing.assert_allclose(hit.distance, surface - start, rtol=1e-14)
        assert hit.particle == particle
    hit = w.ray((0, 0.5), (0, -1))
    assert hit.distance == 0 and hit.particle == 0 and (hit.normal == (0, 1)).all()
    assert w.ray((5, 0.25), (0, 1)).particle == NONE and not w.ray((5, 0.25), (0, 1)).met
    # A ray that bounces off a particle does not meet it again, at any angle.
    rng = np.random.default_rng(7)
    d = rng.normal(size=(200, 2))
    hits = w.ray((5, 2) + 0 * d, (0, -1.8) + 0.05 * d, features=())
    point, n = hits.point[hits.met], hits.normal[hits.met]
    unit = (point - (5, 2)) / np.linalg.norm(point - (5, 2), axis=1)[:, None]
    again = w.ray(point, unit - 2 * (unit * n).sum(axis=1)[:, None] * n, features=())
    assert len(point) > 100 and (again.particle != 2).all()


def test_a_sheet_has_two_sides():
    # A sheet without thickness; a ray that starts on it does not meet it, in any direction.
    for sheet in (
        tv.Polygon([(-1, 0), (1, 0)], closed=False),
        tv.Mesh([(-1, 0, -1), (1, 0, -1), (0, 0, 2)], [(0, 1, 2)], closed=False),
    ):
        o, d = np.zeros((6, sheet.dim)), np.zeros((6, sheet.dim))
        o[:, 1], d[:, 1] = (2, -2, 0, 0, 2, 3), (-1, 1, 1, -1, 1, -1)
        o[5, 0] = 1.5  # beside the sheet
        distance, normal = sheet.cast(o, d, 0.0)
        assert distance.tolist() == [2, 2, np.inf, np.inf, np.inf, np.inf] and normal[:2, 1].tolist() == [1, -1]
        np.testing.assert_allclose(sheet.cast(o[:5], d[:5], 0.5)[0], [1.5, 1.5, np.inf, np.inf, np.inf], atol=1e-12)


def test_points_and_thin_lines(world):
    # In 2D a ray meets a link between points, also at its joints and along axes; in 3D only a ball does. A point is met head on.
    x = np.array([(0, 0), (1, 0.3), (2, 0.1), (3, 0.7)])
    w = world(tv.Particles(x), [tv.Distance([(0, 1), (1, 2), (2, 3)])], precision="f64")
    above = np.concatenate([x, (x[:-1] + x[1:]) / 2]) + (0, 5)
    hits = w.ray(above, (0, -1))
    np.testing.assert_allclose(hits.distance, 5, rtol=1e-14)
    assert (hits.particle[:4] == range(4)).all() and (hits.link[4:, 1] == range(3)).all()
    u = x[1] - x[0]
    np.testing.assert_allclose(hits.normal[4], np.array([-u[1], u[0]]) / np.linalg.norm(u), atol=1e-14)
    assert not w.ray(x[1], (0, 1)).met and not w.ray(x[0] + 0.5 * u, (0, 1)).met  # rays that start on a link
    w = world(tv.Particles(np.c_[x, 0 * x[:, :1]]), [tv.Distance([(0, 1)])], precision="f64")
    assert not w.ray((0.5, 5, 0.01), (0, -1, 0)).met
    hit = w.ray((0.5, 5, 0.0), (0, -1, 0), radius=0.1)
    np.testing.assert_allclose(hit.normal, (-0.3 / 1.09**0.5, 1 / 1.09**0.5, 0), atol=1e-12)
    np.testing.assert_allclose(to_segment(hit.point[None, :2], x[0], x[1]), 0, atol=1e-12)


@pytest.mark.slow
def test_who_counts(world):
    # In a row: a particle of group 1, one of group 2, a link across, a particle, a wall.
    x = [(1, 0), (2, 0), (3, -1), (3, 1), (4, 0)]
    links, wall = tv.Distance([(2, 3), (0, 1)], break_at=1.0), tv.HalfSpace((-1, 0), -5.0, active=True)
    w = world(tv.Particles(x, radius=0.1, group=[1, 2, 0, 0, 0]), [links, wall], precision="f64")
    shot = (0, 0), (1, 0)

    def first(**options):
        """Return kind and number of the first thing that is met."""
        h = w.ray(*shot, **options)
        kinds = {"particle": h.particle, "link": h.link[1], "wall": h.wall}
        return next(((kind, int(k)) for kind, k in kinds.items() if k >= 0), None)

    assert first() == ("particle", 0) and first(groups=[1, 0]) == ("particle", 0) and first(groups=2) == ("particle", 1)
    assert first(groups=0) == ("link", 0) == first(skip=[0, 1]) == first(skip=np.arange(5) < 2)
    assert first(skip=[0, 1, 2]) == ("particle", 4) == first(groups=0, features=()) == first(groups=0, features=[wall])
    assert first(groups=()) == ("wall", 1) == first(groups=(), features=[wall]) and first(groups=(), features=[links]) is None
    assert first(groups=(), reach=4.99) is None and first(groups=(), reach=5.0) == ("wall", 1)
    assert first(skip=w.handle([0, 1])) == ("link", 0) and first(skip=0) == ("particle", 1)
    assert first(reach=0.89) is None and first(reach=0.9) == ("particle", 0)
    # A wall that is switched off and a link that breaks: gone from the next frame on.
    wall.active = False
    assert first(groups=()) == ("wall", 1)
    w.velocity = [(0, 0), (0, 0), (0, -300), (0, 300), (0, 0)]
    w.step(1e-4)
    assert links.broken[0] and first(groups=()) is None and first(skip=[0, 1]) == ("particle", 4)
    w.remove([0])
    assert first(skip=[0]) == ("particle", 3)


@pytest.mark.filterwarnings("ignore:.*no constraint holds loops")
def test_edges_of_polygons_are_links(world):
    body = np.array([(0, 0), (2, 0), (2, 2), (0, 2)])
    both = tv.Particles(np.concatenate([body, body + (4, 0)]), radius=0.1)
    w = world(both, [tv.Polygons([range(4), range(4, 8)])], precision="f64")
    hits = w.ray([(-1, 1), (5, 9), (3, 1), (1, 1)], [(1, 0), (0, -1), (1, 0), (0, 1)])
    np.testing.assert_allclose(hits.distance, (0.9, 6.9, 0.9, 0.9), rtol=1e-14)
    assert hits.link.tolist() == [[0, 3], [0, 6], [0, 7], [0, 2]]


def test_answers_have_the_shape_of_the_question(world):
    w = world(tv.Particles([(0, 0)], radius=1.0), precision="f64")
    one = w.ray((-3, 0), (1e-300, 0))
    assert one.distance == 2 and one.point.shape == (2,) and one.particle == 0 and one.link.shape == (2,) and bool(one.met)
    fan = w.ray((-3, 0), [(1, 0), (0, 1)])
    assert fan.distance.tolist() == [2, np.inf] and fan.met.tolist() == [True, False]
    assert fan.particle.tolist() == [0, NONE] and np.isnan(fan.point[1]).all()
    rain = w.ray([(0.0, 5), (0.6, 5), (3, 5)], (0, -1e300), reach=[4, 5, np.inf])
    np.testing.assert_allclose(rain.distance, (4, 4.2, np.inf))  # sqrt(1 - 0.6^2) = 0.8
    assert len(w.ray(np.zeros((0, 2)), (0, 1))) == 0 and len(w.ray([(0, 0)], [(0, 1)]).distance) == 1
    empty = world(tv.Particles(np.zeros((0, 3))))
    assert not empty.ray((0, 0, 0), (0, 0, 1)).met and len(empty.inside(tv.Ball((0, 0, 0), 1.0))) == 0


OTHER, FAN = tv.HalfSpace((0, 1)), (np.zeros((3, 2)), np.ones((2, 2)))


@pytest.mark.parametrize("ask, pattern", [
    (lambda w: w.ray([(0, 0), (np.inf, 0)], (1, 0)), r"origin\[1, 0\] = inf"),
    (lambda w: w.ray((1e20, 0), (1, 0)), "out of range"),
    (lambda w: w.ray((0, 0), 1.0), r"direction has shape \(\)"),
    (lambda w: w.ray(*FAN), "3 origins and 2 directions"),
    (lambda w: w.ray((0, 0), (1, 0), radius=-1.0), "radius = -1"),
    (lambda w: w.ray((0, 0), (1, 0), skip=[2]), r"skip\[0\] = 2, but there are 2 particles"),
    (lambda w: w.ray((0, 0), (1, 0), skip=[True]), r"skip has shape \(1,\), but a mask of shape \(2,\)"),
    (lambda w: w.ray((0, 0), (1, 0), groups="red"), "groups = 'red'"),
    (lambda w: w.ray((0, 0), (1, 0), features=[OTHER]), r"features\[0\] = HalfSpace does not act in this world"),
    (lambda w: w.ray((0, 0), (1, 0), features=OTHER), "features = HalfSpace is a HalfSpace, but a list"),
    (lambda w: w.inside((0, 1)), "shape = .* is a tuple, but a Box"),
    (lambda w: w.inside(tv.Box((0, 0, 0), (1, 1, 1))), "Box has a lower of 3 numbers, but the particles are in 2D"),
    (lambda w: w.inside(tv.Mesh(CUBE, FACES)), "Mesh is for 3D, but the particles are in 2D"),
    (lambda w: w.inside(tv.Ball((0, 0), 1.0), "half"), "part = 'half', but it must be one of 'center', 'whole', 'touching'"),
    (lambda w: w.near([(0, 0)], -1.0), r"radius\[0\] = -1"),
    (lambda w: w.nearest(np.zeros((3, 3))), "points has shape .* one row per point.$"),
    (lambda w: w.near((0, 0), 1.0), r"one row per point; write \[\(0.0, 0.0\)\]"),
])  # fmt: skip
def test_questions_that_make_no_sense_are_refused(world, ask, pattern):
    w = world(tv.Particles([(0, 0), (1, 0)], radius=0.1), [tv.Gravity()])
    with pytest.raises((ValueError, TypeError), match=f"World.*{pattern}"):
        ask(w)
    w.close()
    with pytest.raises(RuntimeError, match="closed"):
        w.ray((0, 0), (1, 0))
