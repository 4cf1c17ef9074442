"""Walls of every shape: no particle is inside, none passes, and all walls obey one law."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti

from .conftest import compiled
from .outlines import CUBE, CUBE_FACES, SQUARE


@ti.func
def round_rod(p):
    """Return the distance to a disc, or to a rod along z."""
    return ti.Vector([p[0] - 0.2, p[1]]).norm() - 0.5


def scenes(dim):
    """Return walls by name, each with a function for how far a point is outside of it."""
    e = np.eye(dim)
    a, b = -0.6 * e[0], 0.6 * e[0] + 0.2 * e[1]

    def rod(x):
        t = np.clip((x - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        return np.linalg.norm(x - (a + t[:, None] * (b - a)), axis=1) - 0.15

    n = np.array([1.0, 2.0, 0.5][:dim])
    return {
        "box": (lambda **k: tv.Box([-1.0] * dim, [1.0] * dim, **k), lambda x: 1 - np.abs(x).max(axis=1)),
        "plane": (lambda **k: tv.HalfSpace(n, -0.5, **k), lambda x: x @ n / np.linalg.norm(n) + 0.5),
        "ball": (lambda **k: tv.Ball(0 * e[0], 0.5, **k), lambda x: np.linalg.norm(x, axis=1) - 0.5),
        "bowl": (lambda **k: tv.Ball(0 * e[0], 1.5, True, **k), lambda x: 1.5 - np.linalg.norm(x, axis=1)),
        "rod": (lambda **k: tv.Capsule(a, b, 0.15, **k), rod),
        "hollow": (
            lambda **k: tv.Polygon(SQUARE, True, **k) if dim == 2 else tv.Mesh(CUBE, CUBE_FACES, True, **k),
            lambda x: 1 - np.abs(x).max(axis=1),
        ),
        "sdf": (lambda **k: tv.Sdf(round_rod, **k), lambda x: np.linalg.norm(x[:, :2] - [0.2, 0], axis=1) - 0.5),
    }


def one_of(world, dim, name, start, before, **settings):
    """Return a world with walls of all shapes, of which only this one is switched on: one structure for all."""
    walls = {key: make(active=key == name) for key, (make, _) in scenes(dim).items()}
    w = world(start, [*before, *walls.values()], **settings)
    return w, walls[name], scenes(dim)[name][1]


ALONE = [("rod", 2, 0.0), ("hollow", 2, 0.0), ("sdf", 2, 0.7), *((n, 3, 0.7) for n in ("box", "plane", "ball", "bowl", "hollow"))]


@pytest.mark.slow
@pytest.mark.parametrize("name, dim, restitution", ALONE)
def test_no_particle_is_ever_inside(world, name, dim, restitution):
    # Rows 45 and 46, for walls alone, which take no turns. Particles are thrown at up to v h / r = 100, with and without
    # restitution, and never inside after a step.
    make, outside = scenes(dim)[name]
    rng = np.random.default_rng(1)
    x = rng.uniform(-0.9, 0.9, (400, dim))
    x = x[outside(x) > 0.06][:150]
    aim = rng.uniform(-0.3, 0.3, x.shape) - x
    h, r = 1 / 600, 0.05
    speed = 10.0 ** rng.uniform(-2, 2, len(x)) * r / h
    v = aim / np.linalg.norm(aim, axis=1)[:, None] * speed[:, None]
    w = world(
        tv.Particles(x, velocity=v, radius=r), [tv.Gravity(9.81), make(restitution=restitution)], precision="f64", substeps=1
    )
    for _ in range(30):
        report = w.step(h)
        assert (outside(w.position) >= r - 1e-9).all()
        assert report.energy <= 0.5 * (v**2).sum() + 9.81 * len(x) * 3


SLOPE = np.array([[1.0, 0.3], [-1.0, 0.3]]) / np.hypot(1.0, 0.3)


# Walls that take turns, or that throw a particle back into themselves, as functions of friction and restitution; how far outside
# of them a point is; and how they move with a time s.
TIGHT = {
    "box": (
        lambda **k: [tv.Box((-1.0, -1.0), (1.0, 1.0), **k)],
        lambda x, w: np.minimum(x - w.lower, w.upper - x).min(axis=1),
        lambda s: {"lower": (-1 + 0.3 * np.sin(s), -1 + 0.2 * np.sin(2 * s)), "upper": (1 - 0.2 * np.sin(3 * s), 1.0)},
    ),
    "corner": (
        lambda **k: [tv.HalfSpace((0.0, 1.0), -0.5, **k), tv.HalfSpace((1.0, 0.0), -0.5, **k)],
        lambda x, w: np.minimum(x[:, 1] - w.offset, x[:, 0] + 0.5),
        lambda s: {"offset": -0.5 + 0.4 * np.sin(s)},
    ),
    "wedge": (  # of 33 degrees
        lambda **k: [tv.HalfSpace(n, -0.5, **k) for n in SLOPE],
        lambda x, w: (x @ SLOPE.T).min(axis=1) + 0.5,
        lambda s: {},
    ),
    "bowl": (
        lambda **k: [tv.Ball((0.0, 0.0), 1.0, True, **k)],
        lambda x, w: 1 - np.linalg.norm(x - w.center, axis=1),
        lambda s: {"center": (0.5 * np.sin(s), 0.5 * np.sin(2 * s))},
    ),
    "rod": (  # turning
        lambda **k: [tv.Capsule((-0.8, 0.0), (0.8, 0.0), 0.02, **k)],
        lambda x, w: np.linalg.norm(x - np.clip(x @ w.b / (w.b @ w.b), -1, 1)[:, None] * w.b, axis=1) - 0.02,
        lambda s: {"a": (-0.8 * np.cos(s), -0.8 * np.sin(s)), "b": (0.8 * np.cos(s), 0.8 * np.sin(s))},
    ),
    "hollow": (
        lambda **k: [tv.Polygon(SQUARE, True, **k)],
        lambda x, w: 1 - np.abs(x @ np.array([[c := np.cos(w.rotation), -(s := np.sin(w.rotation))], [s, c]])).max(axis=1),
        lambda s: {"rotation": 0.7 * s},
    ),
}


TURNS = ("box", "corner", "wedge", "bowl")


@pytest.mark.slow
@pytest.mark.parametrize("name", TIGHT)
def test_nothing_gets_out_whatever_takes_it_there(world, name):
    make, outside, moves = TIGHT[name]
    bounce = 1.0 if name in ("box", "bowl") else 0.8
    # Walls that take turns anyway are in worlds of one structure, in which the others are switched off.
    walls = {key: TIGHT[key][0](friction=0.3, restitution=bounce, active=key == name) for key in TURNS}
    mine = walls[name] if name in TURNS else make(friction=0.3, restitution=bounce)
    keeps(world, mine, outside, moves, [wall for some in walls.values() for wall in some] if name in TURNS else mine)


def keeps(world, walls, outside, moves, there):
    """Check rows 80 and 81: no particle is outside after a substep, and free ones gain no energy.

    v h = 0.02 ... 100 half widths, friction, bounces, rods, links that draw particles to anchors on either side, 1 and 8
    iterations, standing and moving walls.
    """
    rng, r, m, h = np.random.default_rng(4), 0.05, 30, 1 / 60
    x = rng.uniform(-0.9, 0.9, (2000, 2))
    x = x[outside(x, walls[0]) > r + 0.01][: 3 * m]
    x = np.concatenate([x, rng.uniform(-2.5, 2.5, (m, 2))])
    free, rods, drawn = slice(0, m), np.arange(m, 2 * m).reshape(-1, 2), np.arange(2 * m, 3 * m)
    ties = tv.Distance(np.stack([drawn, drawn + m], axis=1), rng.uniform(0.05, 1, m), compliance=1e-5)
    start = tv.Particles(x, radius=r, pinned=drawn + m)
    w = world(start, [tv.Distance(rods), ties, *there], precision="f64", substeps=1, solver=tv.Jacobi())
    for iterations in (1, 8):
        w.iterations = iterations
        for speed in (0.02, 1.0, 100.0):
            v = rng.normal(size=x.shape) * speed / h
            w.velocity, w.position = v, x
            most = (v[free] ** 2).sum(axis=1)
            for _ in range(8):
                w.step(h)
                assert outside(w.position[: 3 * m], walls[0]).min() >= r - 1e-12, (iterations, speed)
                assert ((w.velocity[free] ** 2).sum(axis=1) <= most * (1 + 1e-9)).all(), (iterations, speed)
        for k in range(30 if moves(0.0) else 0):
            for knob, value in moves(0.2 * (k + 1)).items():
                setattr(walls[0], knob, value)
            w.step(h)
            assert outside(w.position[: 3 * m], walls[0]).min() >= r - 1e-12, iterations
        for knob, value in moves(0.0).items():
            setattr(walls[0], knob, value)
        w.position = 9.0 * x  # out of the way of a wall that comes back
        w.step(h)


@pytest.mark.parametrize("dim", [2, 3])
def test_points_stay_in_corners_far_from_the_origin(world, dim, briefly):
    # Points, which have no radius, fly into the corners of a triangle or a tetrahedron. Far out, the rounding of their positions
    # is larger than that of the wall. A point on one face, and behind it by rounding, must still be stopped by the next face.
    # Otherwise 267 of 2000 leave a triangle at 100 m, and 2 a tetrahedron at the origin.
    if dim == 2:
        corners, faces = np.array([[-3.0, -3], [3, -3], [0, 3]]), np.array([[0, 1], [1, 2], [2, 0]])
    else:
        corners = np.array([[3.0, 3, 3], [3, -3, -3], [-3, 3, -3], [-3, -3, 3]])
        faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    edges = corners[faces[:, 1:]] - corners[faces[:, :1]]
    normal = np.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1) if dim == 2 else np.cross(edges[:, 0], edges[:, 1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    normal *= np.sign((corners.mean(axis=0) - corners[faces[:, 0]]).dot(normal.T).diagonal())[:, None]  # inward
    rng, n = np.random.default_rng(0), 2000
    v = rng.normal(size=(n, dim))
    v *= rng.uniform(10, 300, (n, 1)) / np.linalg.norm(v, axis=1, keepdims=True)
    for far in (0.0, 10.0, 100.0, 1000.0):
        middle = (far * np.array([1.0006, 1.00042, 0.9997])[:dim]).astype(np.float32).astype(float)
        args = {"position": middle, "inside": True}
        wall = tv.Polygon(corners, **args) if dim == 2 else tv.Mesh(corners, faces, **args)
        w = world(tv.Particles(np.tile(middle, (n, 1))), [wall], precision="f32", substeps=20)
        w.velocity = v
        for _ in range(10):
            w.step(0.1)
            depth = -((w.position[:, None] - middle - corners[faces[:, 0]]) * normal).sum(axis=2).min(axis=1)
            assert depth.max() <= 1e-5 + 1e-6 * far, (far, int(depth.argmax()))


def test_discs_far_from_the_origin_lie_on_the_floor(world):
    # At x = 1e4 m an f32 has steps of 1 mm, the radius, but not the height above the floor: C = y - r = 0 at rest.
    x = np.array([(1e4, 0.006), (0.0, 0.006)])
    w = world(tv.Particles(x, radius=1e-3), [tv.Gravity(), tv.HalfSpace((0, 1))], precision="f32-compensated", substeps=20)
    w.run(0.5)
    np.testing.assert_allclose(w.position[:, 1], 1e-3, rtol=1e-6)


def test_what_lies_on_a_ball_or_a_rod_is_not_thrown_through_it(world):
    # In f32 a disc on a wall is inside of it by rounding, up to 4 ulp of its coordinates and of its way, 5 m in a substep here.
    n, middle = 100, np.array([1.3, 1.3])
    angle = np.arange(n) * 0.0628
    out = np.concatenate([np.stack([np.cos(angle), np.sin(angle)], axis=1), np.tile([(0, 1), (0, -1)], (n // 2, 1))])
    foot = np.tile(middle, (2 * n, 1))
    foot[n:] += np.stack([np.linspace(4.1, 5.9, n), np.zeros(n)], axis=1)
    walls = [tv.Ball(middle, 0.1), tv.Capsule(middle + [4, 0], middle + [6, 0], 0.1)]
    w = world(tv.Particles(foot + 0.15 * out, velocity=-out, radius=0.05), walls, substeps=8)
    w.run(0.1)
    w.velocity, w.substeps = -300.0 * out, 1
    for _ in range(2):
        w.step(1 / 60)
        np.testing.assert_allclose(((w.position - foot) * out).sum(axis=1), 0.15, atol=1e-5)


def test_a_rod_of_no_length_is_a_ball(world):
    # The ends of the rod meet in this substep. A disc at v h = 1 m, ten times as far as the rod is thick, stops above its middle.
    rod = tv.Capsule((-1, 0), (1, 0), 0.05)
    w = world(tv.Particles([(0.0, 0.5)], velocity=(0, -60.0), radius=0.05), [rod], substeps=1)
    rod.a = rod.b = (0.0, 0.0)
    w.step(1 / 60)
    np.testing.assert_allclose(w.position[0], (0, 0.1), atol=1e-6)


def test_a_rod_stops_what_comes_in_at_a_grazing_angle_as_a_plane_does(world):
    # Along the axis the top of a rod is flat: paths and impulses are those on a half-space, at angles down to 3e-4.
    dim, angles = 3, np.array([0.3, 0.1, 0.03, 0.01, 3e-3, 3e-4])
    x, v = np.zeros((6, dim)), np.zeros((6, dim))
    x[:, 0], x[:, 1] = 3.0 * np.arange(6) - 8.0, 0.01
    v[:, 0], v[:, 1] = 10.0 * np.cos(angles), -10.0 * np.sin(angles)
    up, end = np.eye(dim)[1], 50.0 * np.eye(dim)[0]
    paths, given = [], []
    for wall in (tv.HalfSpace(up, events=True), tv.Capsule(-end - up, end - up, 1.0, events=True)):
        w = world(tv.Particles(x, velocity=v, radius=0.0), [tv.Gravity(9.81 * -up), wall], substeps=4, precision="f64")
        for _ in range(20):
            w.step(1 / 60)
            paths.append(w.position)
            touches = w.wall_events().touches
            given.append(np.bincount(touches.pairs[:, 0], touches.impulse, 6))
    np.testing.assert_allclose(paths[20:], paths[:20], rtol=0, atol=1e-12)
    np.testing.assert_allclose(given[20:], given[:20], rtol=0, atol=1e-9)


def test_a_ball_stops_what_would_fly_through_it(world):
    # v h = 20 diameters of the ball: a point is caught on the side that it came from; with restitution 1 it goes back.
    x, v = np.array([[-2.0, 0, 0], [-2.0, 0.3, 0]]), np.array([[1200.0, 0, 0]] * 2)
    for restitution in (0.0, 1.0):
        ball = tv.Ball([0.0] * 3, 0.5, restitution=1.0)
        w = world(tv.Particles(x, velocity=v, radius=0.0), [ball], precision="f64", substeps=1)
        ball.restitution = restitution
        w.step(1 / 60)
        assert (np.linalg.norm(w.position, axis=1) >= 0.5 - 1e-9).all() and w.position[0, 0] <= -0.5 + 1e-9
        if restitution:  # reflected about the normal where it met the ball: v' = v - 2 (v . n) n
            n = np.array([-0.8, 0.6, 0])
            np.testing.assert_allclose(w.velocity[0], -v[0], atol=1e-9)
            np.testing.assert_allclose(w.velocity[1], v[1] - 2 * (v[1] @ n) * n, atol=1e-6)
        else:  # the rest of the way to the ball stays in the displacement: caught again, and at rest
            w.step(1 / 60)
            assert w.position[0, 0] <= -0.5 + 1e-9 and abs(w.velocity[0, 0]) < 1e-9


@pytest.mark.parametrize("name", scenes(2))
def test_walls_that_are_switched_off_are_not_there(world, name):
    # Through a wall that is off a particle goes straight, x = x0 + v t; a wall that is on lets nothing in. Switching compiles
    # nothing where the wall was made with a switch.
    inside = scenes(2)[name][1](np.zeros((1, 2)))[0] < 0.2
    x, v = np.array([[0.9, 0.88] if inside else [0.0, 0.0]]), np.array([[-3.0, -3.1]])
    start = tv.Particles(x, velocity=v, radius=0.05)
    w, wall, outside = one_of(world, 2, name, start, [tv.Gravity(0.0)], precision="f64", substeps=4)
    names = []
    for on in (True, False, True):
        with compiled() as more:
            wall.active = on
            w.step(1 / 60)
            w.velocity, w.position = v, x
            for k in range(1, 60):
                w.step(1 / 60)
                assert not on or outside(w.position)[0] >= 0.05 - 1e-9
        names += more if w.time > 1 else []
        straight = np.abs(w.position - (x + v * k / 60)).max() < 1e-12
        assert wall.active is on and straight != on
    with w.clone() as twin:
        assert names == [] and [f.active for f in twin.features[1:]] == [key == name for key in scenes(2)]


def test_a_wall_without_a_switch_can_be_switched_off_too(world):
    # The world is rebuilt for it, once: the particle falls from rest at 0.2 m for t = 0.5 s, by g t^2 / 2.
    floor = tv.HalfSpace((0, 1))
    w = world(tv.Particles([[0.0, 0.2]], radius=0.2), [tv.Gravity(9.81), floor], precision="f64")
    w.run(0.1)
    assert w.position[0, 1] == 0.2 and "HalfSpace.active" not in w.fields
    floor.active = False
    w.run(0.5)
    assert w.position[0, 1] == pytest.approx(0.2 - 9.81 * 0.5**2 / 2, abs=1e-9)
    floor.active, w.velocity, w.position = True, [[0.0, 0.0]], [[0.0, 0.2]]
    w.run(0.1)
    w.remove(features=[floor])
    w.run(0.5)
    assert w.position[0, 1] == pytest.approx(0.2 - 9.81 * 0.5**2 / 2, abs=1e-9)
    with pytest.raises(TypeError, match="active = 0 is a int, but True or False"):
        floor.active = 0


def test_moving_balls_and_rods_carry_what_they_meet(world):
    ball = tv.Ball((-1.0, 0.0), 0.3)
    rod = tv.Capsule((3.0, -1.0), (3.0, 1.0), 0.1)
    w = world(tv.Particles([[0.0, 0.0], [2.0, 0.0]], radius=0.2), [ball, rod], precision="f64", substeps=10)
    for k in range(60):
        ball.center = (-1.0 + 0.02 * (k + 1), 0.0)
        rod.a, rod.b = (3.0 - 0.02 * (k + 1), -1.0), (3.0 - 0.02 * (k + 1), 1.0)
        w.step(1 / 60)
    assert w.position[0, 0] == pytest.approx(0.2 + 0.5, abs=1e-9) and w.position[1, 0] == pytest.approx(1.8 - 0.3, abs=1e-9)
    np.testing.assert_allclose(w.velocity[:, 0], [1.2, -1.2], atol=1e-6)


def test_friction_on_every_wall_holds_and_slides(world):
    # On a plane, on top of a rod, and in a box, of which one is switched on: a horizontal velocity v is lost after
    # v^2 / (2 mu g).
    for on in range(3):
        walls = [
            tv.HalfSpace((0, 1), 0.0, friction=0.5, active=on == 0),
            tv.Capsule((-9, -1), (9, -1), 1.0, friction=0.5, active=on == 1),
            tv.Box((-9, 0), (9, 9), friction=0.5, active=on == 2),
        ]
        w = world(tv.Particles([[0.0, 0.1]], velocity=(2.0, 0.0), radius=0.1), [tv.Gravity(9.81), *walls], precision="f64")
        w.run(1.0)
        assert w.position[0, 0] == pytest.approx(4 / (2 * 0.5 * 9.81), rel=1e-3)
        np.testing.assert_allclose(w.velocity, 0.0, atol=1e-9)


def test_bad_walls_are_named():
    for make, words in (
        (lambda: tv.Ball((0, 0), 0.0), "radius = 0, but it must be above 0"),
        (lambda: tv.Capsule((0, 0), (1, 0), -1.0), "radius = -1"),
        (lambda: tv.World(tv.Particles([[0.0, 0.0]], radius=2.0), [tv.Ball((0, 0), 1.0, inside=True)]), "does not fit inside"),
        (lambda: tv.World(tv.Particles([[0.0, 0.0, 0.0]]), [tv.Ball((0, 0), 1.0)]), r"center has shape \(2,\)"),
        (lambda: tv.Box((0, 0), (1, 1), friction=-1), r"friction \(static\) = -1"),
    ):
        with pytest.raises(ValueError, match=words):
            make()


def test_a_conveyor_takes_along_what_lies_on_it(world):
    # Row 70: a long rod runs along its own axis at 1 m/s. Friction brings a disc to its speed after v / (mu g), then holds it.
    belt = tv.Capsule((-50.0, -1.0), (50.0, -1.0), 1.0, friction=0.4)
    w = world(tv.Particles([[0.0, 0.1]], radius=0.1), [tv.Gravity(9.81), belt], precision="f64")
    for k in range(90):
        shift = (k + 1) / 60
        belt.a, belt.b = (-50.0 + shift, -1.0), (50.0 + shift, -1.0)
        w.step(1 / 60)
    slip = 1.0 / (0.4 * 9.81)  # until then the disc has moved v t / 2 instead of v t
    assert w.position[0, 0] == pytest.approx(1.5 - slip / 2, abs=2e-3) and w.velocity[0, 0] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes(2))
@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_moved_between_substeps_stays_outside_too(world, name, dim):
    # Links made 1.5 times too long, in all directions, are met before the first substep; a taut link, before a shorter substep.
    # Both move particles without a substep, and must not put any behind a wall. This brings no speed: v <= C / 1 s.
    outside = scenes(dim)[name][1]
    rng = np.random.default_rng(3)
    x = rng.uniform(-0.9, 0.9, (600, dim))
    x = x[outside(x) > 0.011]
    near = x[np.argsort(outside(x))[:40]]
    way = rng.normal(size=near.shape)
    there = near + 0.1 * way / np.linalg.norm(way, axis=1)[:, None]
    fits = outside(there) > 0.011
    position = np.concatenate([near[fits], there[fits]])
    k = np.arange(fits.sum())
    links = tv.Distance(np.stack([k, k + len(k)], 1), rest=0.15)
    w, *_ = one_of(world, dim, name, tv.Particles(position, radius=0.01), [links], substeps=4)
    report = w.step(1 / 60)
    assert outside(w.position).min() > 0.01 - 1e-6
    assert np.abs(np.linalg.norm(w.position[k] - w.position[k + len(k)], axis=1) - 0.15).max() < 1e-3
    assert report.energy < 1e-3  # of particles of 1 kg without forces, so none is faster than 0.045 m/s


def test_what_comes_near_a_rod_does_not_touch_it(world):
    # A ball that flies 10 cm along a rod and 2 cm towards it, to 3 cm above it, has not met it yet.
    rod = tv.Capsule((-1.0, 0.0), (1.0, 0.0), 0.1, restitution=0.8, friction=0.5)
    start, v, h = np.array([[0.0, 0.25]]), np.array([[6.0, -1.2]]), 1 / 60
    w = world(tv.Particles(start, velocity=v, radius=0.1), [rod], substeps=1, precision="f64")
    w.step(h)
    np.testing.assert_allclose(w.position, start + h * v, atol=1e-12)
    np.testing.assert_allclose(w.velocity, v, atol=1e-12)


@pytest.mark.parametrize("path", ["auto", "launched"])
@pytest.mark.parametrize("substeps", [1, 8])
def test_a_bounce_is_no_load(world, path, substeps):
    # From rest at a height H, v = -g (t - T), where T is the time of the last apex, and apexes are 2 sqrt(2 H / g) apart. A
    # bounce in the last substep of a frame must not count as a load: velocities would be g h / 2 too fast, and an elastic ball
    # whose velocity is written back would gain 0.4 J a second. Many balls side by side bounce everywhere in a substep.
    heights = np.linspace(0.3, 1.2, 32)
    start = tv.Particles(np.stack([np.arange(32), 0.1 + heights], axis=1), radius=0.1)
    w = world(start, [tv.Gravity(), tv.HalfSpace((0, 1), 0, restitution=1.0)], substeps=substeps, precision="f64", path=path)
    half = np.sqrt(2 * heights / 9.81)
    for back in (False, True):
        w.position, w.velocity = start.position, start.velocity
        begun = w.time
        for _ in range(120):
            if back:
                w.velocity = w.velocity
            w.step(1 / 60)
            since = (w.time - begun + half) % (2 * half) - half
            np.testing.assert_allclose(w.velocity[:, 1], -9.81 * since, atol=1e-11)


def test_what_lies_on_a_floor_is_carried_while_it_bounces_off_a_side(world):
    # x is the triangle wave between the sides, y the radius. With the load of the floor in it, v_y is 0 in every frame.
    w = world(
        tv.Particles([[0.5, 0.1], [0.3, 0.1]], velocity=[[2.9, 0], [0, 0]], radius=0.1),
        [tv.Gravity(), tv.Box((0, 0), (1.0, 2.0), restitution=1.0)], substeps=2, precision="f64",
    )  # fmt: skip
    bounces = 0
    for _ in range(240):
        before = w.velocity[0, 0]
        w.step(1 / 60)
        bounces += before * w.velocity[0, 0] < 0
        np.testing.assert_allclose(np.abs(w.velocity), [[2.9, 0], [0, 0]], atol=1e-9)
    assert bounces > 10


def test_what_slides_and_bounces_at_once_is_read_to_second_order(world):
    # Friction below the limit of grip: sliding, v = v0 - mu g t, on a floor that also has restitution.
    w = world(
        tv.Particles([[0, 0.1]], velocity=(3.0, 0), radius=0.1),
        [tv.Gravity(), tv.HalfSpace((0, 1), 0, friction=0.2, restitution=0.5)], substeps=2, precision="f64",
    )  # fmt: skip
    for _ in range(60):
        w.step(1 / 60)
        np.testing.assert_allclose(w.velocity[0], [3 - 0.2 * 9.81 * w.time, 0], atol=1e-11)


@ti.func
def hollow(p):
    return 1.0 - ti.math.length(p)


@pytest.mark.slow
def test_what_slides_on_a_function_does_so_as_on_a_ball(world):
    # Both are second order: the curvature of a function along the path is that of the circle, up to its differences.
    ends = []
    for wall in (tv.Sdf(hollow), tv.Ball((0, 0), 1.0, True)):
        w = world(tv.Particles([(0.6, -0.65)], radius=0.1), [tv.Gravity(9.81), wall, tv.Contact()], substeps=8, precision="f64")
        w.run(1.0)
        ends.append(w.position)
    np.testing.assert_allclose(*ends, atol=1e-6)
