"""Replay: a recording gives the same bits again, from whichever frame it continues."""

from dataclasses import replace

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.recording import journal, scene
from tiverlet.step import checkpoint

pytestmark = pytest.mark.usefixtures("read_here")

S = tv.shapes


@ti.func
def swirl(x, v):
    """Return a force."""
    return -0.1 * x - 0.01 * v


def spacing(a, b):
    """Return the function of a constraint."""
    return (a - b).norm()


@ti.func
def bowl(p):
    """Return the distance to a circle."""
    return 3.0 - p.norm()


@ti.func
def crowding(r):
    return 0.1 * ti.max(0.0, 0.3 - r.norm()) * r


USERS = [swirl, spacing, bowl, crowding]


def flat(precision="f32", **settings):
    """Return a scene with every feature of 2D except Polygons."""
    rope, blob, ball = S.rope((-1, 1), (0, 1), 6), S.cloth((0.3, 0.2), (0.4, 0), (0, 0.4), (3, 3)), S.ball((1.2, 0.6), 0.3, 2)
    body, (a, b, c) = S.join(rope, blob, ball)
    more = np.array([[-1.5, 0.3], [-1.4, 0.3], [-1.2, 0.35], [-1.0, 0.3], [-0.8, 0.3], [-0.6, 0.32], [-0.4, 0.3], [-0.2, 0.31]])
    position, n = np.concatenate([body.position, more]), len(body)
    features = [
        tv.Gravity(9.81), tv.Drag(0.1), tv.Wind((0.3, 0.0), 0.2), tv.Attractor((0.0, 3.0), 0.5), tv.Hand((0.5, 2.0), 3),
        tv.Force(swirl), tv.PairForce(crowding, 0.3),
        tv.Distance(rope.links[:3], compliance=1e-4, damping=0.01, break_at=50.0), tv.Rope(rope.links[3:], length=0.21),
        tv.Distance(blob.links + b.start), tv.Bend(blob.bends[:2] + b.start, compliance=0.1), tv.Spacer([(n, n + 1)], 0.05),
        tv.AngleLimit([(n + 1, n + 2, n + 3)], -0.5, 0.5), tv.Winch([(n, n + 2)], -0.2, force=2.0),
        tv.Area([i.tolist() for i in ball.loops], pressure=1.1),
        tv.Area(blob.faces[:3] + b.start, compliance=1e-3), tv.ShapeMatch([np.arange(c.start, c.stop)], compliance=1e-3),
        tv.Pin([0], compliance=1e-4), tv.Pin([n + 4], (-0.8, 0.3)), tv.Path([n + 5], [(-1, 0.3), (0, 0.4), (1, 0.3)], at=0.4),
        tv.Path([n + 6], [(-0.5, 0.3), (0.5, 0.2)], smooth=False), tv.Snap([n + 7], 0.1, compliance=0.01),
        tv.Constraint(spacing, [(n + 2, n + 3)], rest=0.2), tv.Contact(friction={(0, 1): 0.3}, groups=[(0, 1), (0, 0)]),
        tv.Box((-2, 0), (2, np.inf), friction=(0.4, 0.3)), tv.Ball((0.5, -0.2), 0.3),
        tv.HalfSpace((0.1, 1), -0.5, friction=0.3, surface_velocity=(0.5, 0)),
        tv.Capsule((1.5, 0.1), (1.8, 0.3), 0.05, one_way=(0, 1)),
        tv.Polygon([(-2, -1), (2, -1), (2, 4), (-2, 4)], inside=True), tv.Sdf(bowl),
    ]  # fmt: skip
    particles = tv.Particles(
        position, mass=0.1 + 0.01 * np.arange(len(position)), radius=0.03, group=np.arange(len(position)) % 2, velocity=(0.2, 0)
    )
    return tv.World(particles, features, substeps=4, precision=precision, **settings)


def solid(precision="f64", **settings):
    """Return a scene with the features that exist in 3D only, with another solver."""
    tetrahedron = np.array([[0, 0.5, 0], [0.5, 0.5, 0], [0, 1.0, 0], [0, 0.5, 0.5], [0.6, 1.0, 0.6]])
    vertices = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], dtype=float)
    features = [
        tv.Gravity((0, -9.81, 0)), tv.Distance([(0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (1, 4)], compliance=1e-5),
        tv.Volume([(0, 1, 2, 3)], compliance=1e-4), tv.Dihedral([(0, 1, 2, 3)], compliance=0.1),
        tv.Motor([(0, 1, 2, 3)], 1.0, torque=0.5, compliance=0.1),
        tv.Mesh(vertices, [(0, 2, 1), (0, 3, 2)], closed=False, restitution=0.3), tv.Contact(loads=True),
        tv.Periodic((-9, -9, -9), (9, 9, 9), (0, 2)), tv.Sleep(0.02, time=0.3),
    ]  # fmt: skip
    settings = {"solver": tv.ConjugateGradient(7), "substeps": 5, **settings}
    return tv.World(tv.Particles(tetrahedron, radius=0.05, pinned=[4]), features, precision=precision, **settings)


def bodies(precision="f32-compensated", **settings):
    """Return a scene of Polygons and a chain that is solved directly."""
    angle = np.arange(4) * np.pi / 2
    square = 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    position = np.concatenate([square, square + [0.1, 0.5]])
    links = np.concatenate([np.stack(np.triu_indices(4, 1), axis=1) + k for k in (0, 4)])
    loops = (np.arange(4) + k for k in (0, 4))
    features = [tv.Gravity(), tv.Distance(links), tv.Polygons(loops, friction=0.3), tv.HalfSpace((0, 1), -0.3)]
    settings = {"solver": tv.Direct(width=3), "substeps": 6, **settings}
    return tv.World(tv.Particles(position), features, precision=precision, **settings)


def swing(substeps, precision="f32"):
    """Return a scene whose state is more than positions: contacts with friction, springs, a function, a moving target."""
    rope, discs = S.rope((0, 1), (1, 1), points=8), np.stack([0.11 * np.arange(6), np.full(6, 0.05)], axis=1)
    features = [
        tv.Gravity(9.81), tv.Distance(rope.links, compliance=1e-4), tv.Box((-2, 0), (2, 2), friction=0.3),
        tv.Contact(friction=0.3), tv.Force(swirl), tv.Pin([0], (0.0, 1.0)),
    ]  # fmt: skip
    particles = tv.Particles(np.concatenate([rope.position, discs]), radius=0.05)
    return tv.World(particles, features, substeps=substeps, precision=precision)


def race(substeps, precision):
    """Return a scene in 3D: drag, a driven bead, a link that breaks."""
    x = np.array([[0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 0, 2]], dtype=float)
    bead = tv.Path([0], [(0, 1, 0), (1, 1, 1), (2, 1, 0)], at=0.0)
    features = [tv.Gravity(9.81), tv.Drag(0.2), tv.Distance([(1, 2), (2, 3)], break_at=[np.inf, 2.0]), bead]
    return tv.World(tv.Particles(x, pinned=[1]), features, substeps=substeps, precision=precision)


def drive(world: tv.World, recorder: tv.Recorder, frames: int = 12) -> None:
    """Step and record, and change between frames everything that a user can change."""
    of = {type(f): f for f in world.features}
    for frame in range(frames):
        if frame == 3 and tv.Box in of:
            of[tv.Box].lower, of[tv.Box].upper = (-1.9, -0.15), (1.8, 3.0)
        if frame in (3, 4) and tv.Pin in of:
            of[tv.Pin].target = of[tv.Pin].target + [0.05, 0.02]
        if frame in (3, 4) and tv.Path in of:
            of[tv.Path].at = 0.1 * frame
        if frame == 5:
            of[tv.Gravity].g = np.eye(world.particles.dim)[1] * -3.0
            world.velocity = 0.5 * world.velocity
        if frame == 7:
            world.position = world.position + 0.01
            world.substeps = "auto"
        if frame == 10:
            world.substeps = 5
        world.step(1 / 60 if frame < 8 else 1 / 90)
        if frame != 9:
            recorder.log()


def go_on(recording, frame: int) -> str:
    """Return the hash at the end of a recording that continues from `frame`."""
    entries = recording._entries
    with recording.world(frame) as world:
        for entry in entries[entries.index(recording._frames[frame]) + 1 :]:
            recording._apply(world, entry)
        return world.hash()


def test_every_feature_is_built_again_from_its_description():
    seen = {"Jacobi", "Chebyshev"}
    for build in (flat, solid, bodies):
        with build() as world:
            world.features[0].g = np.eye(world.particles.dim)[0]  # type: ignore[attr-defined]
            data, arrays = scene.describe(world)
            seen |= {f["class"] for f in [*data["features"], data["settings"]["solver"]]}
            text, blob = journal.Entry("scene", 0, data, arrays).pack(0)
            entry = journal.Entry.unpack(text, blob)
            with scene.rebuild(entry.data, entry.arrays, {f.__name__: f for f in USERS}, [], [[]] * len(world.features)) as again:
                assert repr(again) == repr(world)
                assert repr(again.settings["solver"]) == repr(world.settings["solver"])
                assert [type(f) for f in again.features] == [type(f) for f in world.features]
                again.features[0].upload(), world.features[0].upload()
                mine, theirs = (w._runner.memory._dump(w._runner.memory.entries) for w in (world, again))
                for field, a, b in zip(world._runner.memory.entries, mine, theirs, strict=True):
                    np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert seen == set(scene.PUBLIC)


@pytest.mark.slow
@pytest.mark.parametrize("build, precision", [(swing, "f32"), (race, "f32-compensated")])
def test_round_trip(build, precision, tmp_path, built_once):
    path = tmp_path / "a.rrd"
    with build(4, precision) as world, tv.Recorder(path, world) as recorder:
        drive(world, recorder)
        end = world.hash()
    recording = tv.replay(path, [swirl])
    assert recording.complete and list(recording.frames) == [*range(12)]
    verdict = recording.verify()
    assert verdict and verdict.frames == 12, verdict
    assert go_on(recording, 6) == end


@pytest.mark.slow
def test_a_world_that_is_saved_and_loaded_continues_bit_for_bit(tmp_path):
    # While a rope swings under "auto", falls on discs, and gravity waits to change; with a function of the user's.
    path = tmp_path / "saved.rrd"
    worlds = [swing("auto"), swing("auto")]
    for world in worlds:
        world.run(0.5)
        world.features[0].g = 5.0
    saved = worlds[0]
    for _ in range(2):  # a recording is replaced
        saved.save(path)
    loaded = tv.load(path, given=[swirl])
    assert loaded.time == saved.time and loaded.features[0].g == 5.0
    for world in (*worlds, loaded):
        world.run(0.5)
    assert loaded.hash() == saved.hash() == worlds[1].hash()
    (tmp_path / "notes.rrd").write_text("dear diary")
    with pytest.raises(ValueError, match="is no recording, and is not replaced"):
        saved.save(tmp_path / "notes.rrd")
    with pytest.raises(FileExistsError, match="exists"):
        saved.save(path, overwrite=False)
    with tv.Recorder(tmp_path / "run.rrd", loaded) as recorder:
        loaded.run(0.1, recorder=recorder)
    assert tv.load(tmp_path / "run.rrd", given=[swirl]).hash() == loaded.hash()


def test_what_comes_and_goes_is_replayed(world, tmp_path):
    w = world(tv.Particles(np.eye(3), velocity=(0, 1, 0)), [tv.Gravity()], substeps=2)
    w.run(0.1)
    with tv.Recorder(tmp_path / "c.rrd", w) as recorder:
        for frame in range(6):
            if frame == 2:
                w.add(tv.Particles([[9.0, 9.0, 9.0]], mass=2.0), [tv.Drag(0.1)])
            if frame == 4:
                w.remove([0])
            w.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "c.rrd")
    assert [len(recording.position(frame)) for frame in range(7)] == [3, 3, 3, 4, 4, 3, 3]
    assert recording.verify()
    with recording.world(4) as again:
        assert [repr(f) for f in again.features] == ["Gravity", "Drag"] and again.time == recording.times[4]
        assert again.particles.mass.tolist() == [1, 1, 1, 2]
    with recording.world(6) as again:
        assert again.hash() == w.hash()
    with pytest.raises(ValueError, match="not the same in all frames"):
        recording.export("c.npz")


@pytest.mark.slow
def test_what_auto_tried_in_vain_is_replayed(world, tmp_path):
    # What the controller stores about a frame that nothing improves is hashed; from a file it returns as Python numbers.
    features = [tv.Gravity(), tv.HalfSpace((0, 1), 0), tv.Contact()]
    w = world(tv.Particles([[0.1, 0.05], [2, 2]], radius=0.1), features, substeps="auto")
    with tv.Recorder(tmp_path / "stuck.rrd", w) as recorder:
        for _ in range(3):
            w.step(1 / 60)
            recorder.log()
    kept = checkpoint.keep(w)
    assert kept.controller[5:] != (1.0,) and {type(v) for v in kept.controller} == {int, float}
    of_numpy = replace(kept, controller=tuple(np.float64(v) if type(v) is float else np.int64(v) for v in kept.controller))
    assert checkpoint.digest(w, of_numpy) == checkpoint.digest(w, kept) == w.hash()
    recording = tv.replay(tmp_path / "stuck.rrd")
    assert recording.verify()
    with recording.world(3) as again:
        assert again.hash() == w.hash()


def test_a_knob_that_is_set_to_minus_zero_is_replayed(world, tmp_path):
    # As -0.002 * k is in the first frame. It equals 0, but must be recorded, because the hash contains its sign.
    ball = tv.Ball((0, 0), 0.28)
    w = world(tv.Particles([[0, 0.5], [0.1, 0.9]], radius=0.1), [tv.Gravity(), ball])
    with tv.Recorder(tmp_path / "zero.rrd", w) as recorder:
        for k in range(3):
            ball.center = (-0.002 * k, 0)
            w.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "zero.rrd")
    assert recording.verify()
    with recording.world(3) as again:
        assert again.hash() == w.hash()


def test_user_functions_must_be_given_again(tmp_path):
    path = tmp_path / "f.rrd"
    with tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(swirl)]) as world, tv.Recorder(path, world):
        pass
    with pytest.raises(ValueError, match=r"uses swirl.*given=\[swirl\](.|\n)*-0.1 \* x"):
        tv.replay(path).world(0)

    @ti.func
    def other(x, v):
        return -0.2 * x

    with pytest.warns(UserWarning, match="swirl reads otherwise"):
        tv.replay(path, {"swirl": other}).world(0).close()


def test_moving_targets_move_evenly(world):
    pin, path = tv.Pin([0], (0.0, 0.0)), tv.Path([1], [(0, 1), (10, 1)], smooth=False, at=0.0)
    w = world(tv.Particles([[0.0, 0.0], [0.0, 1.0]]), [pin, path], substeps=4, precision="f64")
    for k in range(1, 4):
        pin.target, path.at = [[0.1 * k, 0.0]], 0.2 * k
        w.step(0.1)
        np.testing.assert_allclose(w.position, [[0.1 * k, 0], [0.2 * k, 1]], atol=1e-12)
        np.testing.assert_allclose(w.velocity, [[1, 0], [2, 0]], atol=1e-9)  # during the whole frame
