"""Walls of any shape: polygons, meshes and functions against walls with closed forms, and against brute force."""

import numpy as np
import pytest
import taichi as ti

import tiverlet as tv

from .conftest import case

SQUARE = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
STAR = np.array([[(1.0 if k % 2 else 0.35) * f(np.pi * k / 5) for f in (np.cos, np.sin)] for k in range(10)])
CUBE = np.array([[a, b, c] for a in (-1.0, 1) for b in (-1.0, 1) for c in (-1.0, 1)])
CUBE_FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7),
    (1, 7, 3),
]  # fmt: skip


@ti.func
def box_distance(p):
    """Of the square or cube with half sides of 1."""
    q = ti.abs(p) - 1
    return ti.max(q, 0).norm() + ti.min(q.max(), 0)


def icosphere(levels: int):
    """A sphere of radius 1 in 20 * 4**levels triangles: vertices, faces."""
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


def outside(points: np.ndarray, loop: np.ndarray, closed: bool = True) -> np.ndarray:
    """Distance of points from a polygon, negative inside; by brute force."""
    a, b = loop, np.roll(loop, -1, axis=0)
    if not closed:
        a, b = a[:-1], b[:-1]
    u, r = b - a, points[:, None] - a
    t = np.clip((r * u).sum(axis=2) / (u * u).sum(axis=1), 0, 1)
    distance = np.linalg.norm(r - t[..., None] * u, axis=2).min(axis=1)
    if not closed:
        return distance
    low, high = np.minimum(a[:, 1], b[:, 1]), np.maximum(a[:, 1], b[:, 1])
    y = points[:, None, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = a[:, 0] + (y - a[:, 1]) / u[:, 1] * u[:, 0] > points[:, None, 0]
    return np.where((cross & (low <= y) & (y < high)).sum(axis=1) % 2, -distance, distance)


def boxes(dim: int, **options) -> dict:
    """The square or cube with half sides of 1, in all ways to say it."""
    facets = tv.Polygon(SQUARE, **options) if dim == 2 else tv.Mesh(CUBE, CUBE_FACES, **options)
    return {"facets": facets, "sdf": tv.Sdf(box_distance, **options)}


MU, BOUNCE, APART = 0.4, 0.5, 6.0


class Stage:
    """A world with a box of facets, and APART from it along x one by a function; each half of the particles belongs to one."""

    count = 8

    def __init__(self, dim: int, precision: str):
        self.dim, self.walls = dim, boxes(dim, friction=MU, restitution=BOUNCE, push_out=0.5)
        x = np.zeros((2 * self.count, dim))
        x[:, 0], x[:, 1] = np.arange(2 * self.count) / 2, 10.0
        features = [tv.Gravity(9.81), *self.walls.values()]
        self.world = tv.World(tv.Particles(x, radius=0.1), features, precision=precision)
        self.gravity, self.aside = features[0], x

    def place(self, at=0.0, turn=0.0) -> None:
        """Where the boxes go in the next frame."""
        for k, wall in enumerate(self.walls.values()):
            wall.position = np.eye(self.dim)[0] * k * APART + at
            wall.rotation = turn if self.dim == 2 else np.array([0.0, 0, turn])

    def start(self, x, v=0.0, at=0.0, turn=0.0, substeps=20, gravity=9.81) -> None:
        """Put particles x (m, dim) with velocities v at each box, the others out of the way, with the boxes at rest."""
        self.world.position, self.world.velocity, self.gravity.g = self.aside, 0 * self.aside, 0.0
        self.world.substeps = substeps
        self.place(at, turn)
        self.world.step(1e-3)
        x, v = np.asarray(x)[:, : self.dim], np.broadcast_to(v, (len(x), 3))[:, : self.dim]
        position, velocity = self.aside.copy(), 0 * self.aside
        self.m = len(x)
        for k in range(2):
            position[k * self.count : k * self.count + self.m] = x + np.eye(self.dim)[0] * k * APART
            velocity[k * self.count : k * self.count + self.m] = v
        self.world.position, self.world.velocity, self.gravity.g = position, velocity, gravity

    @property
    def position(self) -> np.ndarray:
        """Of the particles, relative to where their box started: (2, m, dim)."""
        x = self.world.position.reshape(2, self.count, self.dim)[:, : self.m].copy()
        x[1, :, 0] -= APART
        return x

    @property
    def velocity(self) -> np.ndarray:
        """Of the particles: (2, m, dim)."""
        return self.world.velocity.reshape(2, self.count, self.dim)[:, : self.m]


@pytest.fixture(scope="module", params=[(2, "f64"), (3, "f64"), (3, "f32")], ids=lambda p: f"{p[0]}D-{p[1]}")
def stage(request, taichi):
    made = Stage(*request.param)
    yield made
    made.world.close()


def single(stage) -> bool:
    """Whether the stage is in f32."""
    return stage.world.precision == "f32"


def test_the_top_of_a_box_is_a_plane(stage, world):
    # Falling, bouncing, rubbing: on the seam of two triangles, near corners and in the middle, it is the half space y > 1. The
    # last bounce before it rests may be counted or not: it is (g h)^2 / 2 g high, and friction makes less than that of it.
    x = np.array([[0.0, 1.3, 0], [0.3, 1.2, 0.3], [-0.5, 1.1, 0.5], [-0.9, 1.15, -0.4]])
    v = np.array([[0.5, 0, 0.5], [0.4, -1, -0.6], [0.3, 0, -0.3], [1.0, 0, 0.2]])
    stage.start(x, v)
    start = tv.Particles(x[:, : stage.dim], velocity=v[:, : stage.dim], radius=0.1)
    wall = tv.HalfSpace(np.eye(stage.dim)[1], 1.0, friction=MU, restitution=BOUNCE)
    plane = world(start, [tv.Gravity(9.81), wall], precision=stage.world.precision)
    for _ in range(30):
        plane.step(1 / 60)
        stage.world.step(1 / 60)
        for got in stage.position:
            np.testing.assert_allclose(got, plane.position, atol=2e-4 if single(stage) else 9.81 / 2 / 1200**2)


def test_restitution_on_every_solid(stage):
    # R16: heights h0 e^(2 n), at rest at t_rest; h = 1/600.
    want = case("R16_bounce_e0.5")["values"]
    stage.start([[0.01, 2.1, 0.02]], substeps=1)
    y = []
    for _ in range(int(600 * want["t_rest"] * 1.1)):
        stage.world.step(1 / 600)
        y.append(stage.position[:, 0, 1] - 1.1)
    y = np.array(y)
    assert (y >= (-1e-5 if single(stage) else -1e-12)).all()
    for k in range(2):
        peaks = y[1:-1, k][(y[1:-1, k] >= y[:-2, k]) & (y[1:-1, k] > y[2:, k])]
        np.testing.assert_allclose(peaks[:4], want["heights"][:4], rtol=1e-2)
    np.testing.assert_allclose(y[-1], 0, atol=1e-5 if single(stage) else 1e-9)
    assert np.abs(stage.velocity).max() < 2 * 9.81 / 600


@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_inclines_of_every_solid(stage, degrees):
    # R18 on the top of a turned box: it sticks if tan < mu, to the bit, and slides with g (sin - mu cos) if not.
    a = np.radians(degrees)
    n, t = np.array([np.sin(a), np.cos(a), 0]), np.array([np.cos(a), -np.sin(a), 0])
    stage.start([0.1 * n - 0.5 * t], at=-n[: stage.dim], turn=-a, substeps=10)
    if np.tan(a) < MU:
        stage.world.run(0.2)
        rest = stage.position
        stage.world.run(2.0)
        np.testing.assert_array_equal(stage.position, rest)
        np.testing.assert_allclose(stage.velocity, 0.0, atol=1e-3 if single(stage) else 1e-9)
    else:
        stage.world.run(0.5)
        way = 9.81 * (np.sin(a) - MU * np.cos(a)) * 0.5**2 / 2
        moved = (stage.position[:, 0] - (0.1 * n - 0.5 * t)[: stage.dim]) @ t[: stage.dim]
        np.testing.assert_allclose(moved, way, rtol=1e-2 if single(stage) else 1e-6)


def test_a_moving_solid_carries_what_lies_on_it(stage):
    # Row 70: a table runs at 1 m/s. Friction brings a disc up to its speed after v / (mu g), then holds it without creep.
    stage.start([[0.2, 1.1, 0.1]])
    for k in range(60):
        stage.place(at=np.eye(stage.dim)[0] * (k + 1) / 60)
        stage.world.step(1 / 60)
    slip = 1.0 / (MU * 9.81)
    np.testing.assert_allclose(stage.position[:, 0, 0] - 0.2, 1.0 - slip / 2, atol=2e-3)
    np.testing.assert_allclose(stage.velocity[:, 0, 0], 1.0, atol=2e-3 if single(stage) else 1e-9)


def test_a_turning_solid_takes_along_what_sticks_to_it(world):
    # Turned from level to 10 degrees and back, so slowly that friction holds at the ends of frames, where the speed jumps: what
    # sticks is carried on a circle about the origin, and does not creep.
    walls = list(boxes(2, friction=MU).values())
    before = np.array([[0.4, 1.1], [-0.6, 1.1]])
    both = np.concatenate([before, before + [APART, 0]])
    w = world(tv.Particles(both, radius=0.1), [tv.Gravity(9.81), *walls], precision="f64")
    walls[1].position = (APART, 0.0)
    w.position, w.velocity = both + [0, 100.0], 0 * both
    w.step(1 / 60)
    w.position, w.velocity = both, 0 * both
    for k in range(480):
        angle = np.radians(10.0) * (1 - np.cos(2 * np.pi * (k + 1) / 480)) / 2
        for wall in walls:
            wall.rotation = angle
        w.step(1 / 60)
        if k % 120 == 119:
            c, s = np.cos(angle), np.sin(angle)
            want = before @ np.array([[c, s], [-s, c]])
            np.testing.assert_allclose(w.position.reshape(2, 2, 2) - [[[0, 0]], [[APART, 0]]], [want, want], atol=1e-9)


def test_what_starts_inside_is_let_out_gently(stage):
    # Row 48: at push_out, by the nearest way, from shallow and deep; and it gives no more velocity than that.
    stage.start([[0.7, 0, 0], [0, -0.2, 0]], gravity=0.0)
    fastest = 0.0
    for _ in range(150):
        stage.world.step(1 / 60)
        fastest = max(fastest, np.abs(stage.velocity).max())
    atol = 1e-5 if single(stage) else 1e-9
    assert fastest <= 0.5 * (1 + 1e-3) + atol
    assert (stage.position[:, 0, 0] >= 1.1 - atol).all() and (stage.position[:, 1, 1] <= -1.1 + atol).all()


def test_a_world_with_moving_solids_can_be_cloned(stage):
    if (stage.dim, single(stage)) != (2, False):
        return
    stage.start([[0.2, 1.1], [0.5, 1.4]], v=(1.0, 0, 0))
    stage.place(at=np.array([0.1, 0.05]), turn=0.1)
    stage.world.step(1 / 60)
    stage.place(at=np.array([0.2, 0.05]), turn=0.3)
    twin = stage.world.clone()
    for w in (stage.world, twin):
        w.step(1 / 60)
    assert twin.hash() == stage.world.hash()
    twin.close()


def test_a_fine_sphere_is_a_ball(world):
    # The faces of an icosphere are at most s = 1 - cos(a) inside of it, with a half the angle of an edge: so are the particles,
    # and a slide of half a second parts from the ball's by the angle of the faces at most.
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


@pytest.mark.parametrize("precision, inside, radius, restitution", [("f32", False, 0.0, 0.7), ("f64", True, 0.03, 0.0)])
def test_nothing_enters_a_star_or_leaves_it(world, precision, inside, radius, restitution):
    # Inner and outer corners, discs and points, up to 100 radii in a substep, with and without bounces; from inside and outside.
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
    # Rows 45 and 46: two-sided, without thickness of its own, discs of 1 mm at v h = 0.01 ... 1000 mm, from both sides, while the
    # sheet turns by up to 3 rad in a substep or stands. Each stays on the side where it began: a line across a round drum.
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
    # An open line with corners, thickened: outside of it and of itself, by brute force.
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


def test_a_paddle_strikes_with_the_speed_of_its_blade(world):
    # A bar turns about its middle at omega and meets a point at a distance r, at rest: e = 1 sends it off with 2 omega r.
    paddle = tv.Polygon([[-1.0, -0.01], [1, -0.01], [1, 0.01], [-1, 0.01]], restitution=1.0, position=(0.5, 0.5), rotation=-0.4)
    w = world(tv.Particles([[1.3, 0.5]]), [paddle], precision="f64", substeps=200)
    for k in range(30):
        paddle.rotation = -0.4 + 3.0 * (k + 1) / 60
        w.step(1 / 60)
    assert np.linalg.norm(w.velocity[0]) == pytest.approx(2 * 3.0 * 0.8, rel=5e-3)


def test_solids_have_the_same_bits_on_both_paths(world):
    rng = np.random.default_rng(6)
    x, v = rng.uniform(-1.4, 1.4, (100, 3)), rng.normal(size=(100, 3))
    x[:, 1] += 2.6
    hashes = set()
    for path in ("fused", "parallel"):
        wall, other = boxes(3, friction=0.4, restitution=0.3).values()
        other.position = (0.5, -2.0, 0.0)
        features = [tv.Gravity(9.81), wall, other, tv.Box([-3] * 3, [3] * 3)]
        w = world(tv.Particles(x, velocity=v, radius=0.08), features, path=path, substeps=6)
        for k in range(30):
            wall.rotation = (0.02 * k, 0.0, 0.05 * k)
            w.step(1 / 60)
        hashes.add(w.hash())
    assert len(hashes) == 1


def test_orientation_is_found(world):
    # Faces either way round, some one way and some the other: the same wall, to the bit.
    some = [f[::-1] if k % 3 else f for k, f in enumerate(CUBE_FACES)]
    want = tv.Mesh(CUBE, CUBE_FACES).normals
    for faces in ([f[::-1] for f in CUBE_FACES], some):
        np.testing.assert_array_equal(tv.Mesh(CUBE, faces).normals, want)
        np.testing.assert_array_equal(tv.Mesh(CUBE, faces, inside=True).normals, -want)
    assert (tv.Polygon(SQUARE[::-1]).normals.sum(axis=0) == 0).all()
    centers = tv.Polygon(STAR[::-1]).corners.mean(axis=1)
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


@pytest.mark.parametrize("dim", [2, 3])
def test_solids_are_drawn_where_they_are(dim):
    for name, wall in boxes(dim, position=(2.0, 1.0, 0.0)[:dim], rotation=0.3 if dim == 2 else (0.0, 0.0, 0.3)).items():
        wall.prepare(tv.Particles(np.full((1, dim), 9.0)), np.ones(1))
        strips, _ = wall.outline(np.full(dim, -1.0), np.full(dim, 4.0))
        p = strips.reshape(-1, dim) - np.array([2.0, 1.0, 0.0])[:dim]
        c, s = np.cos(0.3), np.sin(0.3)
        p[:, :2] = p[:, :2] @ np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(np.abs(p).max(axis=1), 1.0, atol=1e-9 if name != "sdf" else 0.05)
