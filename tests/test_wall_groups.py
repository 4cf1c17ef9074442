"""Walls of one kind share code: results as if each had its own, and a cost by those near a particle."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.colliders.collider import Collider
from tiverlet.device import layout
from tiverlet.device.memory import Memory


def grains(dim=2, n=40, seed=0):
    """Return particles that fly about in the unit box."""
    rng = np.random.default_rng(seed)
    return tv.Particles(position=rng.uniform(0.1, 0.9, (n, dim)), velocity=rng.normal(0, 2, (n, dim)), radius=0.01)


def pegs(kind, dim=2, m=9, **options):
    """Return m walls of one kind at places of their own in the unit box, of different sizes."""
    rng = np.random.default_rng(1)
    out = []
    for k in range(m):
        middle, way = rng.uniform(0.1, 0.9, dim), rng.normal(0, 0.06, dim)
        if kind == "capsule":
            out.append(tv.Capsule(middle - way, middle + way, 0.01 + 0.002 * k, **options))
        elif kind == "ball":
            out.append(tv.Ball(middle, 0.02 + 0.004 * k, **options))
        elif kind == "half-space":
            out.append(tv.HalfSpace(way, way @ np.full(dim, 0.5) / np.linalg.norm(way) - 0.3, **options))
        elif kind == "box":
            out.append(tv.Box(np.full(dim, 0.001 * k), np.full(dim, 1 - 0.002 * k), **options))
        elif kind == "polygon":
            turn = np.arange(3 + k % 4) * 2 * np.pi / (3 + k % 4)
            out.append(tv.Polygon(0.06 * np.stack([np.cos(turn), np.sin(turn)], 1), position=middle, rotation=0.3 * k, **options))
        elif kind == "mesh":
            corners = 0.08 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
            faces = [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]
            if k % 2:
                corners, faces = np.concatenate([corners, [[0.05, 0.05, 0.06]]]), [*faces[:3], (1, 2, 4), (1, 3, 4), (2, 3, 4)]
            out.append(tv.Mesh(corners, faces, position=middle, rotation=(0, 0.1 * k, 0), **options))
    return out


def moved(walls, k):
    """Move some of the walls."""
    for wall in walls[:: 2 + k]:
        if isinstance(wall, tv.Capsule):
            wall.a, wall.b = wall.a + 0.02, wall.b - 0.01
        elif isinstance(wall, tv.Ball):
            wall.center, wall.radius = wall.center - 0.02, wall.radius * 1.1
        elif isinstance(wall, tv.HalfSpace):
            wall.offset += 0.005
        elif isinstance(wall, tv.Box):
            wall.lower, wall.upper = wall.lower - 0.002, wall.upper + 0.001
        else:
            wall.position, wall.rotation = wall.position + 0.02, wall.rotation + 0.2
        if wall.has_friction:
            wall.friction = 0.1 + 0.05 * k
        wall.push_out = 0.5 + k


ROUGH: dict = {"friction": 0.3, "restitution": 0.5, "active": True}


def run(kinds, dim=2, n=40, contact=(), path="auto", **options):
    """Run a scene in which walls move, two of each kind. Returns the number of groups, positions and velocities."""
    walls = [wall for kind in kinds for wall in pegs(kind, dim, 2, **options)]
    features = [tv.Gravity((0, -9.81, 0)[:dim]), tv.Box(np.zeros(dim), np.ones(dim)), *walls, *(c.copy() for c in contact)]
    with tv.World(grains(dim, n), features, substeps=6, path=path) as world:
        for k in range(6):
            world.step(1 / 60)
            moved(walls, k % 3)
        return len(world._runner.scene.walls), world.position.copy(), world.velocity.copy()


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds, dim, more",
    [
        (("box",), 2, {}),
        (("capsule", "ball", "half-space", "polygon"), 2, ROUGH),
        (("box", "mesh"), 3, ROUGH),
        (("polygon",), 2, {"contact": [tv.Contact(friction=0.4)], "friction": 0.3}),
        (("capsule",), 2, {"n": 3000, "path": "parallel", "friction": 0.2}),
    ],
    ids=["smooth", "rough", "rough in space", "as rows", "parallel"],
)
def test_walls_that_share_code_act_as_walls_with_code_of_their_own(kinds, dim, more, monkeypatch):
    groups, *ends = run(kinds, dim, **more)
    assert groups == len(kinds) + (kinds != ("box",))  # the box around is of the kind of the smooth ones
    monkeypatch.setattr(Collider, "code_key", None)
    alone, *same = run(kinds, dim, **more)
    assert alone == 2 * len(kinds) + 1
    np.testing.assert_array_equal(ends, same)


@pytest.mark.slow
def test_members_where_the_host_has_no_access_to_fields(monkeypatch):
    # As on a GPU: kernels copy whole fields.
    ends = run(["polygon"], friction=0.3)
    monkeypatch.setattr(Memory, "_host_views", lambda memory: {})
    with layout.unshared():
        same = run(["polygon"], friction=0.3)
    np.testing.assert_array_equal(ends[1], same[1])


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_a_seam_between_facets_in_a_plane_is_no_step(dim):
    if dim == 2:
        xs = np.linspace(0, 2, 21)
        floor = tv.Polygon([*np.stack([xs, 0 * xs], 1), (2, -1), (0, -1)])
    else:
        k, j = np.meshgrid(np.arange(20), np.arange(3), indexing="ij")
        vertices = np.stack(np.meshgrid(np.linspace(0, 2, 21), 0, np.linspace(-0.4, 0.4, 4), indexing="ij"), -1).reshape(-1, 3)
        a = (4 * k + j).ravel()
        faces = np.concatenate([np.stack([a, a + 1, a + 4], 1), np.stack([a + 1, a + 5, a + 4], 1)])
        floor = tv.Mesh(vertices, faces, closed=False, radius=0.01)
    height = 0.1 + (dim == 3) * 0.01
    start, ahead = np.eye(dim)[:1] * 0.2 + np.eye(dim)[1] * height, np.eye(dim)[:1]
    features = [tv.Gravity(9.81), floor, tv.Contact()]
    with tv.World(tv.Particles(start, velocity=ahead, radius=0.1), features, substeps=10) as world:
        for _ in range(90):
            world.step(1 / 60)
            assert world.velocity[0, 0] == pytest.approx(1, abs=1e-5)
            np.testing.assert_allclose(world.velocity, ahead, atol=1e-3)  # a substep of gravity gives 16e-3
            assert abs(world.position[0, 1] - height) < 1e-3


def test_discs_at_rest_in_a_trough_of_facets_as_rows():
    # The weight of a disc that lies in a rectangular valley, on two facets of one polygon; and beside it one on a corner.
    trough = tv.Polygon([(-1, 1), (0, 0), (1, 1), (3, -1), (-3, -1)])
    features = [tv.Gravity((0, -9.81)), trough, tv.Contact()]
    with tv.World(tv.Particles([[0.001, 0.15 * np.sqrt(2)]], radius=0.15), features, substeps=10) as world:
        world.run(2)
        np.testing.assert_allclose(world.position[0], [0, 0.15 * np.sqrt(2)], atol=2e-3)
        assert np.abs(world.velocity).max() < 1e-3


@pytest.mark.slow
def test_a_wall_that_moves_meets_a_particle_at_rest_as_a_row():
    rod = tv.Capsule((-1, -1.0), (-1, 1), 0.1)
    with tv.World(tv.Particles([[0.0, 0.0], [3, 3]], radius=0.1), [rod, tv.Contact()], substeps=10) as world:
        for _ in range(60):
            rod.a, rod.b = rod.a + (0.02, 0), rod.b + (0.02, 0)
            world.step(1 / 60)
        assert world.position[0, 0] == pytest.approx(0.4, abs=1e-2)


@pytest.mark.slow
def test_the_first_frame_finds_each_of_several_walls():
    # What lies on one of two walls of one kind is borne from the first substep on.
    tile, x = np.array([[0.0, -0.2], [1.0, -0.2], [1.0, 0.0], [0.0, 0.0]]), [[0.5, 0.1], [10.5, 0.1]]
    walls = [wall for k in (0, 1) for wall in (tv.Capsule((k, -0.1), (k + 1, -0.1), 0.1), tv.Polygon(tile + (10 + k, 0)))]
    with tv.World(tv.Particles(x, radius=0.1), [tv.Gravity(9.81), tv.Contact(), *walls], substeps=4) as world:
        for _ in range(6):
            world.step(1 / 60)
            np.testing.assert_allclose(world.position, x, atol=1e-7)


def test_walls_that_differ_in_code_are_in_different_groups():
    walls = [
        *pegs("capsule", m=2), *pegs("capsule", m=2, friction=0.3), *pegs("ball", m=2), tv.Ball((0.5, 0.5), 3.0, inside=True),
        *pegs("polygon", m=2), *pegs("polygon", m=2, one_way=(0, 1)), *pegs("capsule", m=2, events=True),
    ]  # fmt: skip
    with tv.World(grains(), walls) as world:
        assert [len(group.walls) for group in world._runner.scene.walls] == [2, 2, 2, 1, 2, 2, 1, 1]


@pytest.mark.slow
def test_members_are_added_and_removed_and_keep_their_places():
    walls = pegs("capsule")
    with tv.World(grains(), walls, substeps=6) as world:
        walls[3].a = walls[3].a + 0.05
        world.step(1 / 60)
        places = [wall.dev.a.now.copy() for wall in walls]
        world.remove(features=walls[:2])
        world.add(features=pegs("ball", m=3))
        for wall, place in zip(walls[2:], places[2:], strict=True):
            np.testing.assert_array_equal(wall.dev.a.now, place)
        world.step(1 / 60)
        world.remove(features=walls[2:8])
        np.testing.assert_array_equal(walls[8].dev.a.now, places[8])
        world.step(1 / 60)


def test_clone_and_undo_keep_members():
    walls = pegs("polygon", friction=0.2)
    with tv.World(grains(), [tv.Gravity((0, -9.81)), *walls], substeps=6) as world:
        world.step(1 / 60)
        moved(walls, 1)
        world.step(1 / 60)
        with world.clone() as other:
            assert other.hash() == world.hash()
            for one in (world, other):
                moved([f for f in one.features if isinstance(f, Collider)], 0)
                one.step(1 / 60)
            assert other.hash() == world.hash()


def test_worlds_give_members_knobs_of_their_own():
    def scene():
        return tv.World(grains(), [tv.Gravity((0, -9.81)), *pegs("polygon", m=4, friction=0.2)], substeps=6)

    frictions, turns = [0.2, 0.5, 0.8], [0.3, 0.5, 0.7]
    places = pegs("polygon", m=2)[1].position + 0.01 * np.arange(3)[:, None]
    with tv.Worlds([scene() for _ in range(3)]) as many:
        for _ in range(2):
            many.set(many.features[2], friction=frictions, rotation=turns, position=places)
            many.step(1 / 60)
        for k in range(3):
            with scene() as alone:
                for _ in range(2):
                    wall = alone.features[2]
                    wall.friction, wall.rotation, wall.position = frictions[k], turns[k], places[k]
                    alone.step(1 / 60)
                np.testing.assert_array_equal(many.position[k], alone.position)


@pytest.mark.slow
def test_a_recording_with_members_is_replayed(tmp_path):
    walls = pegs("capsule", m=5, friction=0.2)
    with tv.World(grains(), [tv.Gravity((0, -9.81)), *walls], substeps=6) as world:
        with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
            for k in range(6):
                moved([f for f in world.features if isinstance(f, Collider)], k % 3)
                if k == 2:
                    world.remove(features=[walls[1]])
                if k == 4:
                    world.add(features=pegs("ball", m=2))
                world.step(1 / 60)
                recorder.log()
        recording = tv.replay(tmp_path / "a.rrd")
        assert recording.verify()
        with recording.world(6) as again:
            assert again.hash() == world.hash()


def test_the_number_of_members_is_no_part_of_the_code():
    times = []
    for m in (3, 7):
        with tv.World(grains(), pegs("capsule", m=m), precision="f64", substeps=3) as world:
            world.step(1 / 60)
            times.append(dict(world._runner.memory.compiler.times.kernels))
    assert times[0]
    assert not times[1]
