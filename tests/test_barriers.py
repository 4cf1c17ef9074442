"""Walls of polygons and meshes: nothing enters or passes, which side is outside, and which shapes are refused."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .outlines import CUBE, CUBE_FACES, SQUARE, STAR, outside


@pytest.mark.parametrize("precision, inside, radius, restitution", [("f32", False, 0.0, 0.7), ("f64", True, 0.03, 0.0)])
def test_nothing_enters_a_star_or_leaves_it(world, precision, inside, radius, restitution):
    # Inner and outer corners, discs and points, up to 100 radii per substep, with and without bounces, from inside and outside.
    rng = np.random.default_rng(1)
    atol = 1e-9 if precision == "f64" else 4e-6
    side, h = -1 if inside else 1, 1 / 600
    x = rng.uniform(-1.2, 1.2, (3000, 2))
    x = x[side * outside(x, STAR) > radius + 0.01][:600]
    speed = 0.03 / h * 10.0 ** rng.uniform(-2, 2, len(x))
    aim = rng.uniform(-0.5, 0.5, x.shape) - x
    v = aim / np.linalg.norm(aim, axis=1)[:, None] * speed[:, None]
    wall = tv.Polygon(STAR, inside, restitution=restitution, friction=0.1)
    w = world(tv.Particles(x, velocity=v, radius=radius), [tv.Gravity(9.81), wall], precision=precision, substeps=1)
    energy = tv.measure.kinetic_energy(w)
    for _ in range(40):
        report = w.step(h)
        assert (side * outside(w.position, STAR) >= radius - atol).all()
        assert report.energy <= energy + 9.81 * len(x) * 3


@pytest.mark.parametrize("dim", [2, 3])
def test_nothing_passes_a_thin_sheet(world, dim):
    # Rows 45 and 46: a two-sided sheet without thickness, and discs of 1 mm at v h = 0.01 ... 1000 mm from both sides, while the
    # sheet turns by up to 3 rad per substep or stands still. The sheet is a line across a round drum; each disc stays on its
    # side.
    rng = np.random.default_rng(2)
    n = 150
    x = rng.uniform(-0.9, 0.9, (n, dim))
    x[:, 1] = np.where(np.abs(x[:, 1]) < 0.02, 0.1, x[:, 1])
    x /= np.maximum(1, np.linalg.norm(x, axis=1) / 0.95)[:, None]
    v = rng.normal(size=(n, dim))
    v *= (10.0 ** rng.uniform(-5, 0, n) * 600 / np.linalg.norm(v, axis=1))[:, None]
    if dim == 2:
        sheet = tv.Polygon([[-3.0, 0], [3, 0]], closed=False)
    else:
        corners = [[-3.0, 0, -3], [3, 0, -3], [3, 0, 3], [-3, 0, 3]]
        sheet = tv.Mesh(corners, [[0, 1, 2], [2, 0, 3]], closed=False)
    drum = tv.Ball([0.0] * dim, 1.0, inside=True)
    w = world(tv.Particles(x, velocity=v, radius=0.001), [sheet, drum, tv.Gravity(9.81)], precision="f64", substeps=2)
    side = np.sign(x[:, 1])
    for k in range(90):
        angle = 0.0 if k < 30 else 0.02 * (k - 29) if k < 60 else 0.6 + 3.0 * (k - 59)
        sheet.rotation = angle if dim == 2 else (0.0, 0.0, angle)
        w.step(1 / 300)
        up = np.zeros(dim)
        up[:2] = -np.sin(angle), np.cos(angle)
        assert (side * (w.position @ up) >= 0.001 - 1e-9).all()


def test_a_closed_line_may_bend_and_cross(world):
    # A thickened open line with corners that crosses itself: particles stay outside of it, checked by brute force.
    line = np.array([[-1.0, 0], [0, -0.3], [1, 0], [0.5, 0.8], [-0.3, -0.6]])
    rng = np.random.default_rng(5)
    x = rng.uniform(-1.2, 1.2, (400, 2))
    x = x[outside(x, line, False) > 0.08][:150]
    v = rng.normal(size=x.shape) * 10.0 ** rng.uniform(-1, 2, (len(x), 1))
    wall = tv.Polygon(line, closed=False, radius=0.02)
    w = world(tv.Particles(x, velocity=v, radius=0.03), [tv.Gravity(9.81), wall], precision="f64", substeps=2)
    for _ in range(60):
        w.step(1 / 300)
        assert (outside(w.position, line, False) >= 0.05 - 1e-9).all()


def icosphere(levels: int):
    """Return a sphere of radius 1 in 20 * 4**levels triangles: vertices, faces."""
    g = (1 + 5**0.5) / 2
    v = np.array([p for a in (-1, 1) for b in (-g, g) for p in ((a, b, 0), (0, a, b), (b, 0, a))], dtype=float)
    edge = np.linalg.norm(v[:, None] - v, axis=2)
    f = np.array([(i, j, k) for i in range(12) for j in range(i) for k in range(j) if edge[[i, j, k], [j, k, i]].max() < 2.1])
    v /= np.linalg.norm(v, axis=1)[:, None]
    for _ in range(levels):
        ends, which = np.unique(np.sort(f[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0, return_inverse=True)
        (a, b, c), (d, e, h) = f.T, len(v) + which.reshape(-1, 3).T
        middle = v[ends].mean(axis=1)
        v = np.concatenate([v, middle / np.linalg.norm(middle, axis=1)[:, None]])
        f = np.concatenate([np.stack(t, axis=1) for t in ((a, d, h), (b, e, d), (c, h, e), (d, e, h))])
    return v, f


@pytest.mark.slow
def test_a_fine_sphere_is_a_ball(world):
    # The faces of an icosphere are at most s = 1 - cos(a) inside the sphere, where a is half the angle of an edge; so are the
    # particles. After half a second of sliding, they differ from those on a ball by at most the angle of the faces.
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 3))
    x *= 0.8 / np.linalg.norm(x, axis=1)[:, None]
    start = tv.Particles(x, velocity=-2 * x, radius=0.1)
    ball = world(start, [tv.Gravity(9.81), tv.Ball((0, 0, 0), 0.5, friction=0.3)], precision="f64")
    ball.run(0.5)
    errors = []
    meshes = [icosphere(levels) for levels in (2, 4)]
    shift = np.array([5.0, 0, 0])
    both = tv.Particles(np.concatenate([x, x + shift]), velocity=np.tile(-2 * x, (2, 1)), radius=0.1)
    walls = [tv.Mesh(0.5 * v, f[:, ::-1], friction=0.3, position=k * shift) for k, (v, f) in enumerate(meshes)]
    w = world(both, [tv.Gravity(9.81), *walls], precision="f64")
    for frame in range(30):
        w.step(1 / 60)
        for k, (v, f) in enumerate(meshes):
            got = w.position[k * len(x) : (k + 1) * len(x)] - k * shift
            sag = 0.5 * (1 - np.cos(np.linalg.norm(v[f[:, 0]] - v[f[:, 1]], axis=1).max() / np.sqrt(3)))
            assert 0.6 - sag - 1e-9 <= np.linalg.norm(got, axis=1).min()
            if frame == 29:
                errors.append(np.median(np.linalg.norm(got - ball.position, axis=1)))
    assert errors[1] < 0.01 and errors[1] < errors[0] / 2.5


def test_discs_between_a_wall_that_moves_and_turns_and_a_box_are_in_neither(world):
    # Discs that are thrown into the wedges beside the box, at up to 5 m per substep, while the wall sweeps through them.
    rng = np.random.default_rng(0)
    n, r = 1000, 0.01
    x = np.stack([rng.uniform(-0.9, 0.9, n), 0.5 * rng.choice([-1, 1], n)], axis=1)
    wall, box = tv.Polygon([(-2, 0), (2, 0)], closed=False, radius=0.001), tv.Box((-1, -1), (1, 1))
    start = tv.Particles(x, velocity=rng.normal(size=(n, 2)) * 100, radius=r)
    w = world(start, [wall, box], precision="f64", substeps=1)
    for k in range(4):
        wall.position, wall.rotation = (0.1 * np.cos(k), 0.2 * np.sin(2.1 * k)), 0.1 * np.sin(1.7 * k)
        w.step(1 / 60)
        assert wall.clearance(w.position).min() >= r - 1e-12 and box.clearance(w.position).min() >= r - 1e-12


def test_orientation_is_found(world):
    # Faces in either orientation, or in mixed ones, give the same wall bit for bit.
    some = [f[::-1] if k % 3 else f for k, f in enumerate(CUBE_FACES)]
    want = tv.Mesh(CUBE, CUBE_FACES).normals
    for faces in ([f[::-1] for f in CUBE_FACES], some):
        np.testing.assert_array_equal(tv.Mesh(CUBE, faces).normals, want)
        np.testing.assert_array_equal(tv.Mesh(CUBE, faces, inside=True).normals, -want)
    # So do two cubes side by side, each in its own orientation. One cube inside of another may be a cavity.
    n, flipped = len(CUBE), [f[::-1] for f in CUBE_FACES]
    for shift, size, cavity in ((9.0, 1.0, False), (9.0, 0.5, False), (0.0, 0.5, True)):
        middle = np.mean(CUBE, axis=0)
        two = np.concatenate([CUBE, middle + size * (CUBE - middle) + [shift, 0, 0]])
        for one, other in ((CUBE_FACES, flipped), (flipped, CUBE_FACES)):
            got = tv.Mesh(two, np.concatenate([one, n + np.array(other)])).normals
            np.testing.assert_allclose(got, np.concatenate([want, -want if cavity else want]), atol=1e-15)
    assert (tv.Polygon(SQUARE[::-1]).normals.sum(axis=0) == 0).all()
    centers = tv.Polygon(STAR[::-1]).facets.corners.mean(axis=1)
    assert (outside(centers + 1e-6 * tv.Polygon(STAR[::-1]).normals, STAR) > 0).all()


def test_bad_solids_are_named():
    particles = tv.Particles([[0.0, 0.0], [2.0, 2.0]], radius=[0.1, 0.0])
    bow = [[0, 0], [1, 1], [1, 0], [0, 1]]

    @ti.func
    def twice(p):
        return 2 * (p.norm() - 0.5)

    @ti.func
    def half(p):
        return 0.5 * (p.norm() - 1.5)

    @ti.func
    def broken(p):
        return ti.sqrt(p[0])

    @ti.func
    def ball(p):
        return p.norm() - 0.5

    @ti.func
    def wrong(p):
        return -p

    for make, error, words in (
        (lambda: tv.Polygon([[0, 0], [1, 0]]), ValueError, "at least 3 are needed"),
        (lambda: tv.Polygon([[0, 0], [1, 0], [1, 0], [0, 1]]), ValueError, r"vertices\[1\] and vertices\[2\] are the same point"),
        (lambda: tv.Polygon(bow), ValueError, "edges 0-1 and 2-3 of vertices meet"),
        (lambda: tv.Polygon([[0, 0], [2, 0], [1, 0], [1, 1]]), ValueError, "edges 0-1 and 1-2 of vertices meet"),
        (lambda: tv.Polygon([[0, 0], [1, 0], [1, np.nan]]), ValueError, r"vertices\[2, 1\] = nan"),
        (lambda: tv.Polygon(SQUARE, inside=True, closed=False), ValueError, "needs an inside"),
        (lambda: tv.World(particles, [tv.Polygon(SQUARE + 5, closed=False)]), ValueError, "particle 1 has radius 0"),
        (lambda: tv.World(particles, [tv.Mesh(CUBE, CUBE_FACES)]), ValueError, "a wall for 3D, but the particles are in 2D"),
        (lambda: tv.Mesh(CUBE, [(0, 1, 3), (0, 1, 9)]), ValueError, r"faces\[1\] = \(0, 1, 9\)"),
        (lambda: tv.Mesh(CUBE, CUBE_FACES[:-1]), ValueError, r"the edge \(1, 3\) of faces\[0\] belongs to one face only"),
        (lambda: tv.Mesh(CUBE, [*CUBE_FACES, (0, 1, 3)]), ValueError, "belongs to 3 faces"),
        (lambda: tv.Mesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [(0, 1, 2)]), ValueError, r"faces\[0\] = \(0, 1, 2\) has no area"),
        (lambda: tv.Polygon(SQUARE, rotation=(0, 0, 1)), TypeError, "but a number is needed"),
        (lambda: tv.Sdf(lambda p: p), TypeError, "not a Taichi function"),
        (lambda: tv.World(particles, [tv.Sdf(twice)]), ValueError, "gradient of size 2 at"),
        (lambda: tv.World(particles, [tv.Sdf(half)]), ValueError, "gradient of size 0.5 at"),
        (lambda: tv.World(particles, [tv.Sdf(broken)]), ValueError, "must be finite everywhere"),
        (lambda: tv.World(particles, [tv.Sdf(ball, wrong)]), ValueError, "gradient is off by"),
    ):  # fmt: skip
        with pytest.raises(error, match=words):
            make()
