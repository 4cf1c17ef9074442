"""Walls of any shape, by facets and by a function: against walls with closed forms."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import case
from .outlines import CUBE, CUBE_FACES, SQUARE
from .test_walls import keeps


@ti.func
def box_distance(p):
    """Return the distance to the square or cube with half sides of 1."""
    q = ti.abs(p) - 1
    return ti.max(q, 0).norm() + ti.min(q.max(), 0)


def boxes(dim: int, **options) -> dict:
    """Return the square or cube with half sides of 1, by facets and by a function."""
    facets = tv.Polygon(SQUARE, **options) if dim == 2 else tv.Mesh(CUBE, CUBE_FACES, **options)
    return {"facets": facets, "sdf": tv.Sdf(box_distance, **options)}


@ti.func
def round_room(p):
    """Return the distance to a round wall of radius 1, positive inside."""
    return 1 - p.norm()


@pytest.mark.slow
def test_what_is_far_away_changes_no_bits(world):
    # Row 85: discs rest in a round room, beads slide down a wire and discs pile up. The bits are the same with another particle
    # at 1e2 m, and with one near by and one that is added later at 1e5 m.
    ends = []
    for far in (1e2, 5.0):
        start = tv.Particles([*FEW, (far, far)], radius=0.05, pinned=[len(FEW)])
        wire = tv.Path([4, 5], [[2.0, 0.0], [2.5, -1.0], [3.0, -0.5], [4.0, -1.5]])
        w = world(
            start, [tv.Gravity(9.81), tv.Sdf(round_room), wire, tv.Contact(), tv.Box((-1, -9), (9e9, 9e9))], precision="f32"
        )
        w.run(0.5)
        if far == 5.0:
            w.add(tv.Particles([[1e5, 1e5]], radius=0.05, pinned=[0]))
        w.run(0.5)
        ends.append(w.position[: len(FEW)])
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])
    assert (1 - np.linalg.norm(ends[0][:4], axis=1)).min() == pytest.approx(0.05, abs=1e-5)


FEW = [(-0.5, 0.2), (0.0, 0.1), (0.5, 0.3), (0.1, 0.4), (2.017036, -0.207938), (2.5, -1.0)]


@pytest.mark.slow
def test_nothing_gets_out_of_a_function(world):
    room = [tv.Sdf(round_room, friction=0.3, restitution=0.8)]
    keeps(world, room, lambda x, w: 1 - np.linalg.norm(x, axis=1), lambda s: {}, room)


@pytest.mark.slow
def test_what_slides_in_a_hollow_keeps_its_energy(world):
    # A point released at the rim of a bowl of 1 m, with g = 10 m/s^2, has v^2 / 2 = 10 sin(a) when it has come down by the angle
    # a. This holds in every frame, for any number of substeps, and for a function that is not exactly a distance.
    for function in (round_room, flatter_room):
        off = []
        for substeps in (10, 20, 40, 80, 320):
            features = [tv.Gravity(10.0), tv.Sdf(function)]
            w = world(tv.Particles([(1.0, 0.0)]), features, substeps=substeps, precision="f64")
            energy = []
            for _ in range(90):
                w.step(1 / 60)
                energy.append((w.velocity[0] ** 2).sum() / 2 + 10 * w.position[0, 1])
            off.append(np.abs(energy).max())
            assert abs(np.linalg.norm(w.position) - 1) < 1e-13
        assert max(off) < 1e-3 and np.log2(off[0] / off[3]) / 3 > 1.8


def test_friction_in_a_hollow_has_its_closed_form(world):
    # Sliding down by the angle a in a bowl of 1 m: y = v^2 / 2 has y' = g (cos a - mu sin a) - 2 mu y. So
    # y = g (p cos a + q sin a - p exp(-2 mu a)) with q = (1 - 2 mu^2) / (1 + 4 mu^2), p = mu + 2 mu q.
    g, mu = 10.0, 0.1
    q = (1 - 2 * mu**2) / (1 + 4 * mu**2)
    p = mu + 2 * mu * q
    for substeps in (10, 20, 40, 80, 320):
        features = [tv.Gravity(g), tv.Sdf(round_room, friction=mu)]
        w = world(tv.Particles([(1.0, 0.0)]), features, substeps=substeps, precision="f64")
        for _ in range(60):
            w.step(1 / 60)
            angle = np.arctan2(-w.position[0, 1], w.position[0, 0])
            y = g * (p * np.cos(angle) + q * np.sin(angle) - p * np.exp(-2 * mu * angle))
            if w.velocity[0, 0] > 0 or angle < 0:
                break  # the point turns back
            assert (w.velocity[0] ** 2).sum() / 2 == pytest.approx(y, abs=2e-3 * g)
        assert angle > 2.0


@pytest.mark.slow
def test_nothing_passes_a_shell(world, briefly):
    # The shell is 4 cm thick, 1/50 of the largest displacement in a substep, 2 m. Points slide, bounce and fly on both sides.
    rng = np.random.default_rng(3)
    x = rng.uniform(-1, 1, (3000, 2))
    x = x[np.abs(np.linalg.norm(x, axis=1) - 0.7) > 0.023][:1500]
    v = rng.normal(size=x.shape)
    v *= (10.0 ** rng.uniform(-2.5, 0.3, len(x)) * 600 / np.linalg.norm(v, axis=1))[:, None]
    side = np.sign(np.linalg.norm(x, axis=1) - 0.7)
    walls = [tv.Gravity(9.81), tv.Sdf(shell, restitution=0.8)]
    w = world(tv.Particles(x, velocity=v), walls, substeps=1)
    for _ in range(20):
        w.step(1 / 600)
        assert (side * (np.linalg.norm(w.position, axis=1) - 0.7)).min() > 0.02 - 4e-6


def test_a_thin_sheet_in_a_round_room(world):
    # The sheet turns by up to 3 rad in a frame, while discs of 1 mm slide and fly on both sides of it, by up to 1 m in a substep.
    rng = np.random.default_rng(2)
    x = rng.uniform(-0.9, 0.9, (150, 2))
    x[:, 1] = np.where(np.abs(x[:, 1]) < 0.02, 0.1, x[:, 1])
    x /= np.maximum(1, np.linalg.norm(x, axis=1) / 0.95)[:, None]
    v = rng.normal(size=x.shape)
    v *= (10.0 ** rng.uniform(-5, 0, len(x)) * 600 / np.linalg.norm(v, axis=1))[:, None]
    sheet = tv.Polygon([[-3.0, 0], [3, 0]], closed=False)
    start = tv.Particles(x, velocity=v, radius=0.001)
    w = world(start, [sheet, tv.Sdf(round_room), tv.Gravity(9.81)], precision="f64", substeps=2)
    side = np.sign(x[:, 1])
    for k in range(60):
        sheet.rotation = angle = 0.0 if k < 20 else 0.02 * (k - 19) if k < 40 else 0.4 + 3.0 * (k - 39)
        w.step(1 / 300)
        assert (side * (w.position @ (-np.sin(angle), np.cos(angle)))).min() >= 0.001 - 1e-9
        assert np.linalg.norm(w.position, axis=1).max() <= 0.999 + 1e-9


@ti.func
def flatter_room(p):
    """Return 0.92 times the distance of round_room()."""
    return 0.92 * (1 - p.norm())


@ti.func
def shell(p):
    """Return the distance to a shell: a circle of 0.7 m, 4 cm thick."""
    return ti.abs(p.norm() - 0.7) - 0.02


MU, BOUNCE = 0.4, 0.5


class Stage:
    """A box of facets, and one by a function, each in its own world; both worlds are used together."""

    count = 8

    def __init__(self, dim: int, precision: str):
        self.dim, self.precision = dim, precision
        self.walls = boxes(dim, friction=MU, restitution=BOUNCE, push_out=0.5)
        self.aside = np.zeros((self.count, dim))
        self.aside[:, 0], self.aside[:, 1] = np.arange(self.count) / 2, 10.0
        self.pulls = [tv.Gravity(9.81) for _ in self.walls]
        start = tv.Particles(self.aside, radius=0.1)
        self.worlds = [
            tv.World(start, [pull, wall], precision=precision) for pull, wall in zip(self.pulls, self.walls.values(), strict=True)
        ]

    @property
    def single(self) -> bool:
        """Whether the worlds are in f32."""
        return self.precision == "f32"

    def place(self, at=0.0, turn=0.0) -> None:
        """Set where the boxes are at the end of the next frame."""
        for wall in self.walls.values():
            wall.position = np.zeros(self.dim) + at
            wall.rotation = turn if self.dim == 2 else np.array([0.0, 0, turn])

    def start(self, x, v=0.0, at=0.0, turn=0.0, substeps=20, gravity=9.81) -> None:
        """Put particles x (m, dim) with velocities v at each box at rest, and the other particles out of the way."""
        x, v = np.asarray(x)[:, : self.dim], np.broadcast_to(v, (len(x), 3))[:, : self.dim]
        self.m = len(x)
        self.place(at, turn)
        for world, pull in zip(self.worlds, self.pulls, strict=True):
            world.velocity, world.position, pull.g = 0 * self.aside, self.aside, 0.0
            world.substeps = substeps
            world.step(1e-3)
            position, velocity = self.aside.copy(), 0 * self.aside
            position[: self.m], velocity[: self.m] = x, v
            world.velocity, world.position, pull.g = velocity, position, gravity

    def step(self, dt: float) -> None:
        """Step both worlds."""
        for world in self.worlds:
            world.step(dt)

    @property
    def position(self) -> np.ndarray:
        """Positions of the particles, (2, m, dim)."""
        return np.stack([world.position[: self.m] for world in self.worlds])

    @property
    def velocity(self) -> np.ndarray:
        """Velocities of the particles, (2, m, dim)."""
        return np.stack([world.velocity[: self.m] for world in self.worlds])


@pytest.fixture(scope="module", params=[(2, "f64"), (3, "f32")], ids=lambda p: f"{p[0]}D-{p[1]}")
def stage(request, taichi):
    made = Stage(*request.param)
    yield made
    for world in made.worlds:
        world.close()


@pytest.mark.slow
def test_the_top_of_a_box_is_a_plane(stage, world):
    # Falling, bouncing, rubbing: on the seam of two triangles, near corners and in the middle, the top is the half space y > 1.
    # The last bounce before rest, (g h)^2 / 2 g high, may be there or not; friction changes less than that.
    x = np.array([[0.0, 1.3, 0], [0.3, 1.2, 0.3], [-0.5, 1.1, 0.5], [-0.9, 1.15, -0.4]])
    v = np.array([[0.5, 0, 0.5], [0.4, -1, -0.6], [0.3, 0, -0.3], [1.0, 0, 0.2]])
    stage.start(x, v)
    start = tv.Particles(x[:, : stage.dim], velocity=v[:, : stage.dim], radius=0.1)
    wall = tv.HalfSpace(np.eye(stage.dim)[1], 1.0, friction=MU, restitution=BOUNCE)
    plane = world(start, [tv.Gravity(9.81), wall], precision=stage.precision)
    for _ in range(30):
        plane.step(1 / 60)
        stage.step(1 / 60)
        for got in stage.position:
            np.testing.assert_allclose(got, plane.position, atol=2e-4 if stage.single else 9.81 / 2 / 1200**2)


@pytest.mark.slow
def test_restitution_on_every_solid(stage):
    # R16: heights h0 e^(2 n), at rest at t_rest; h = 1/600.
    want = case("R16_bounce_e0.5")["values"]
    stage.start([[0.01, 2.1, 0.02]], substeps=1)
    y = []
    for _ in range(int(600 * want["t_rest"] * 1.1)):
        stage.step(1 / 600)
        y.append(stage.position[:, 0, 1] - 1.1)
    y = np.array(y)
    assert (y >= (-1e-5 if stage.single else -1e-12)).all()
    for k in range(2):
        peaks = y[1:-1, k][(y[1:-1, k] >= y[:-2, k]) & (y[1:-1, k] > y[2:, k])]
        np.testing.assert_allclose(peaks[:4], want["heights"][:4], rtol=1e-2)
    np.testing.assert_allclose(y[-1], 0, atol=1e-5 if stage.single else 1e-9)
    assert np.abs(stage.velocity).max() < 2 * 9.81 / 600


@pytest.mark.parametrize("degrees", [20.0, 30.0])
def test_inclines_of_every_solid(stage, degrees):
    # R18 on the top of a turned box: a disc sticks if tan < mu, bit for bit, and slides with g (sin - mu cos) if not.
    a = np.radians(degrees)
    n, t = np.array([np.sin(a), np.cos(a), 0]), np.array([np.cos(a), -np.sin(a), 0])
    stage.start([0.1 * n - 0.5 * t], at=-n[: stage.dim], turn=-a, substeps=10)
    sticks = np.tan(a) < MU
    for _ in range(12 if sticks else 30):
        stage.step(1 / 60)
    if sticks:
        rest = stage.position
        for _ in range(120):
            stage.step(1 / 60)
        np.testing.assert_array_equal(stage.position, rest)
        np.testing.assert_allclose(stage.velocity, 0.0, atol=1e-3 if stage.single else 1e-9)
    else:
        way = 9.81 * (np.sin(a) - MU * np.cos(a)) * 0.5**2 / 2
        moved = (stage.position[:, 0] - (0.1 * n - 0.5 * t)[: stage.dim]) @ t[: stage.dim]
        np.testing.assert_allclose(moved, way, rtol=1e-2 if stage.single else 1e-6)


def test_a_moving_solid_carries_what_lies_on_it(stage):
    # Row 70: a table runs at 1 m/s. Friction brings a disc to its speed after v / (mu g), then holds it without creep.
    stage.start([[0.2, 1.1, 0.1]])
    for k in range(60):
        stage.place(at=np.eye(stage.dim)[0] * (k + 1) / 60)
        stage.step(1 / 60)
    slip = 1.0 / (MU * 9.81)
    np.testing.assert_allclose(stage.position[:, 0, 0] - 0.2, 1.0 - slip / 2, atol=2e-3)
    np.testing.assert_allclose(stage.velocity[:, 0, 0], 1.0, atol=2e-3 if stage.single else 1e-9)


def test_a_turning_solid_takes_along_what_sticks_to_it(world):
    # Turned from level to 10 degrees and back, so slowly that friction holds at the ends of frames, where the speed jumps: a
    # sticking disc is carried on a circle about the origin, and does not creep.
    wall = boxes(2, friction=MU)["facets"]
    before = np.array([[0.4, 1.1], [-0.6, 1.1]])
    w = world(tv.Particles(before, radius=0.1), [tv.Gravity(9.81), wall], precision="f64")
    for k in range(480):
        angle = np.radians(10.0) * (1 - np.cos(2 * np.pi * (k + 1) / 480)) / 2
        wall.rotation = angle
        w.step(1 / 60)
        if k % 120 == 119:
            c, s = np.cos(angle), np.sin(angle)
            np.testing.assert_allclose(w.position, before @ np.array([[c, s], [-s, c]]), atol=1e-9)


def test_what_starts_inside_is_let_out_gently(stage):
    # Row 48: a particle leaves at push_out by the nearest way, from shallow and deep, and gains no more velocity than that.
    stage.start([[0.7, 0, 0], [0, -0.2, 0]], gravity=0.0)
    fastest = 0.0
    for _ in range(150):
        stage.step(1 / 60)
        fastest = max(fastest, np.abs(stage.velocity).max())
    atol = 1e-5 if stage.single else 1e-9
    assert fastest <= 0.5 * (1 + 1e-3) + atol
    assert (stage.position[:, 0, 0] >= 1.1 - atol).all() and (stage.position[:, 1, 1] <= -1.1 + atol).all()


@pytest.mark.parametrize("stage", [(2, "f64")], ids=["2D-f64"], indirect=True)
def test_a_world_with_moving_solids_can_be_cloned(stage):
    stage.start([[0.2, 1.1], [0.5, 1.4]], v=(1.0, 0, 0))
    stage.place(at=np.array([0.1, 0.05]), turn=0.1)
    stage.step(1 / 60)
    stage.place(at=np.array([0.2, 0.05]), turn=0.3)
    twins = [w.clone() for w in stage.worlds]
    stage.step(1 / 60)
    for w, twin in zip(stage.worlds, twins, strict=True):
        twin.step(1 / 60)
        assert twin.hash() == w.hash()
        twin.close()


def test_a_paddle_strikes_with_the_speed_of_its_blade(world):
    # A bar turns about its middle at omega and meets a point at rest at a distance r: with e = 1 the point leaves at 2 omega r.
    paddle = tv.Polygon([[-1.0, -0.01], [1, -0.01], [1, 0.01], [-1, 0.01]], restitution=1.0, position=(0.5, 0.5), rotation=-0.4)
    w = world(tv.Particles([[1.3, 0.5]]), [paddle], precision="f64", substeps=200)
    for k in range(30):
        paddle.rotation = -0.4 + 3.0 * (k + 1) / 60
        w.step(1 / 60)
    assert np.linalg.norm(w.velocity[0]) == pytest.approx(2 * 3.0 * 0.8, rel=5e-3)


@pytest.mark.slow
def test_solids_have_the_same_bits_on_both_paths(world):
    rng = np.random.default_rng(6)
    x, v = rng.uniform(-1.4, 1.4, (200, 3)), rng.normal(size=(200, 3))
    x += np.repeat([[0.0, 2.6, 0.0], [4.0, 2.6, 0.0]], 100, axis=0)
    hashes = set()
    for path in ("fused", "launched"):
        walls = boxes(3, friction=0.4, restitution=0.3)
        walls["facets"].position, walls["sdf"].position = (0.1, 0.0, 0.0), (4.1, 0.0, 0.0)
        features = [tv.Gravity(9.81), *walls.values(), tv.Box([-3] * 3, [7, 5, 3])]
        w = world(tv.Particles(x, velocity=v, radius=0.08), features, path=path, substeps=6)
        for k in range(30):
            for wall in walls.values():
                wall.rotation = (0.02 * k, 0.0, 0.05 * k)
            w.step(1 / 60)
        hashes.add(w.hash())
    assert len(hashes) == 1


@pytest.mark.parametrize("dim", [2, 3])
def test_solids_are_drawn_where_they_are(dim):
    for name, wall in boxes(dim, position=(2.0, 1.0, 0.0)[:dim], rotation=0.3 if dim == 2 else (0.0, 0.0, 0.3)).items():
        wall.prepare(tv.Particles(np.full((1, dim), 9.0)), np.ones(1))
        strips, _ = wall.outline(np.full(dim, -1.0), np.full(dim, 4.0))
        p = strips.reshape(-1, dim) - np.array([2.0, 1.0, 0.0])[:dim]
        c, s = np.cos(0.3), np.sin(0.3)
        p[:, :2] = p[:, :2] @ np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(np.abs(p).max(axis=1), 1.0, atol=1e-9 if name != "sdf" else 0.05)
