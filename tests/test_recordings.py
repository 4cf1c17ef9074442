"""Recordings: what was recorded reads back and is replayed bit for bit, whatever happens to world, process and disk."""

import gc
import os
import pathlib
import resource
import signal
import subprocess
import tempfile

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.device import ti
from tiverlet.recording import journal, messages, rrd, scene, sink, viewer
from tiverlet.step import checkpoint

from .conftest import python

FRAME = 1 / 60


@ti.func
def swirl(x, v):
    """Return a force."""
    return -0.1 * x - 0.01 * v


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """Return the path of a small recording."""
    path, gravity = tmp_path_factory.mktemp("falling") / "a.rrd", tv.Gravity(9.81)
    with tv.World(tv.Particles(np.eye(3), velocity=(1, 2, 3)), [gravity], substeps=2) as w:
        with tv.Recorder(path, w, every=2) as recorder:
            w.run(11 * FRAME, recorder=recorder)
            gravity.g = 5.0
            w.run(9 * FRAME, recorder=recorder)
    return path


@pytest.fixture
def one(world):
    """Return a world of two particles that fall."""
    return world(tv.Particles(np.eye(2), velocity=(0.1, 0.2)), [tv.Gravity(1.0)], substeps=2)


def recorded(w, path, frames, before=lambda frame: None, after=lambda frame: None):
    """Return a recording of so many frames; before(frame) and after(frame) change the world."""
    with tv.Recorder(path, w) as recorder:
        for frame in range(1, frames + 1):
            before(frame)
            w.step(FRAME)
            recorder.log()
            after(frame)
    return tv.replay(path)


@pytest.mark.parametrize("edit", ["shift", "remove", "add", "take"])
def test_links_that_a_late_frame_softened_are_edited_and_replayed(world, tmp_path, edit):
    # A soft pin shares the first particle with the rope, so passes leave violations, and links stay soft after the late frame.
    rope = tv.shapes.rope((-1.0, 1.5), (0.5, 1.5), points=16)
    pin, links = tv.Pin([0], compliance=1e-3, damping=2.0), tv.Distance(rope.links)
    w = world(tv.Particles(rope.position, mass=0.1), [tv.Gravity(), pin, links], substeps=20)
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        for k in range(16):
            if k == (4 if edit == "shift" else 8):
                match edit:
                    case "shift":
                        w.shift((10.0, 0.1))
                    case "remove":
                        w.remove(features=[links])
                    case "add":
                        w.add(tv.Particles([(0.0, 3.0)]))
                    case "take":
                        w.remove([15])
            w.step(0.1 if k in (4, 12) else FRAME)
            recorder.log()
    assert tv.replay(tmp_path / "a.rrd").verify()


@pytest.mark.parametrize("chosen", ["auto", "tolerance", "iterations"])
def test_frames_whose_effort_is_chosen_are_replayed(world, tmp_path, read_here, chosen):
    # A linkage with a heavy end lands beside a bob on soft pins, and its frame is repeated. The substeps of such a frame alone do
    # not tell what it does: its links stiffen as fast as the energy allows.
    linkage = [(1.48 + 0.3 * (k // 2), 1.0 + 0.25 * (k % 2)) for k in range(12)]
    links = [(0, 1), (2, 3), *((k, k + 2) for k in range(2, 12)), *((k, k + 1) for k in range(4, 14, 2))]
    x, features, settings = (
        np.array([(0.55, 1.5), (1.05, 1.5), *linkage]),
        [tv.Pin([0, 1], compliance=0.01)],
        {"iterations": 3} if chosen == "iterations" else {},
    )
    mass, radius = np.repeat([0.5, 0.3, 30.0], [2, 11, 1]), np.repeat([0.1, 0.03], [2, 12])
    start = tv.Particles(x, mass=mass, radius=radius, pinned=[2, 3])
    features += [tv.Distance(links), tv.Gravity(9.81), tv.HalfSpace((0, 1))]
    substeps, given = ("auto", {}) if chosen != "tolerance" else (4, {"tolerance": 1e-3})
    w = world(start, features, substeps=substeps, precision="f64", **settings)
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        reports = []
        for _ in range(36):
            reports.append(w.step(FRAME, **given))
            recorder.log()
    assert any(r.tries > 1 for r in reports)
    verdict = tv.replay(tmp_path / "a.rrd").verify()
    assert verdict, verdict


def test_frames_times_knobs_and_curves_read_back(falling, tmp_path):
    recording = tv.replay(falling)
    assert list(recording.frames) == list(range(0, 21, 2)) and recording.times[-1] == pytest.approx(20 / 60)
    assert recording.position(20).dtype == np.float32
    with recording.world(20) as world:
        np.testing.assert_array_equal(recording.position(20), world.position.astype(np.float32))
        assert world.time == recording.times[-1] and world.features[0].g == 5.0
    # x = t, y = 2 t - g t^2 / 2 without step errors.
    np.testing.assert_allclose(recording.position(10)[0], [1 + 1 / 6, 2 / 6 - 9.81 / 72, 3 / 6], rtol=1e-6)
    assert list(recording.curves["energy"][0]) == list(range(2, 21, 2))
    np.testing.assert_allclose(recording.curves["momentum/x"][1], 3.0, rtol=1e-6)
    for wrong in ("a", None, 1.5, True, [1]):
        for ask in (recording.world, recording.position):
            with pytest.raises(ValueError, match="but the number of a frame is needed"):
                ask(wrong)
    with pytest.raises(TypeError, match="frame"):  # the call is wrong, not the file
        recording.world()  # type: ignore[call-arg]
    with pytest.raises(ValueError, match="no frame 3; the nearest is"):
        recording.world(3)


def driven(substeps):
    """Return a world whose state is more than positions: springs, a user's function, moving targets, a link that breaks."""
    rope = tv.shapes.rope((0, 1), (1, 1), points=6)
    features = [
        tv.Gravity(9.81), tv.Force(swirl), tv.Box((-2, 0), (3, 2), friction=0.3), tv.Ball((0.0, -1.0), 0.5),
        tv.Distance(np.concatenate([rope.links, [(7, 8)]]), compliance=1e-4, break_at=[np.inf] * 5 + [2.0]),
        tv.Pin([0, 7], [(0.0, 1.0), (2.5, 1.5)]), tv.Path([6], [(1.5, 1), (2, 1.5), (2.5, 1)], at=0.0),
    ]  # fmt: skip
    particles = tv.Particles([*rope.position, (1.5, 1.0), (2.5, 1.5), (2.5, 1.0)], radius=0.05)
    return tv.World(particles, features, substeps=substeps, precision="f32-compensated")


def drive(world, log, frames):
    """Step and record, and change between frames everything that a user can change."""
    gravity, _, box, ball, _, pin, path = world.features
    for frame in frames:
        if frame == 1:
            ball.center = (-0.0, -1.0)  # equal to what it was, but the hash contains its sign
        if frame == 3:
            box.lower, box.upper = (-1.9, -0.15), (2.8, 3.0)
        if frame in (3, 4):
            pin.target, path.at = pin.target + [0.05, 0.02], 0.1 * frame
        if frame == 5:
            gravity.g = (0.0, -3.0)
            world.velocity = 0.5 * world.velocity
        if frame == 7:
            world.position = world.position + 0.01
            world.substeps = "auto"
        if frame == 10:
            world.substeps = 5
        world.step(FRAME if frame < 8 else 1 / 90)
        if frame != 9:
            log()


@pytest.mark.slow
def test_all_that_a_user_changes_is_replayed_and_goes_on_from_any_frame(tmp_path, read_here, built_once):
    with driven(4) as world, tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        drive(world, recorder.log, range(12))
        end, links = world.hash(), world.features[4]
        assert links.broken.any()
    recording = tv.replay(tmp_path / "a.rrd", [swirl])
    assert recording.complete and list(recording.frames) == [*range(12)]
    verdict = recording.verify()
    assert verdict and verdict.frames == 12, verdict
    with recording.world(6) as world:
        drive(world, lambda: None, range(6, 12))
        assert world.hash() == end


def test_a_world_that_is_saved_and_loaded_continues_bit_for_bit(tmp_path, read_here):
    # While a rope swings under "auto" and gravity waits to change.
    path = tmp_path / "saved.rrd"
    saved, twin = worlds = [driven("auto"), driven("auto")]
    for world in worlds:
        world.run(0.5)
        world.features[0].g = 5.0
    for _ in range(2):  # a recording is replaced
        saved.save(path)
    loaded = tv.load(path, given=[swirl])
    assert loaded.time == saved.time and loaded.features[0].g == 5.0
    for world in (*worlds, loaded):
        world.run(0.5)
    assert loaded.hash() == saved.hash() == twin.hash()
    (tmp_path / "notes.rrd").write_text("dear diary")
    with pytest.raises(ValueError, match="is no recording, and is not replaced"):
        saved.save(tmp_path / "notes.rrd")
    with pytest.raises(FileExistsError, match="exists"):
        saved.save(path, overwrite=False)
    with tv.Recorder(tmp_path / "run.rrd", loaded) as recorder:
        loaded.run(0.1, recorder=recorder)
    assert tv.load(tmp_path / "run.rrd", given=[swirl]).hash() == loaded.hash()
    with pytest.raises(ValueError, match=r"uses swirl.*given=\[swirl\](.|\n)*-0.1 \* x"):
        tv.load(path)

    @ti.func
    def other(x, v):
        return -0.2 * x

    with pytest.warns(UserWarning, match="swirl reads otherwise"):
        tv.load(path, given={"swirl": other})


@ti.func
def length(a, b):
    """Return a distance."""
    return (a - b).norm()


@ti.func
def from_ring(x):
    """Return the distance from a ring."""
    return x.norm() - 99


@ti.func
def pull(r):
    """Return a force between two particles."""
    return -r


def catalogue(n, put):
    """Return all public features, of n elements where they take several, each with the dimension of its world; and all solvers.

    put: makes a list of rows a list, a tuple or an array.
    """
    i, h = np.arange(n), put((0.1 + np.arange(n) / 64).tolist())
    pairs, triples, quads = (put([[k + j for j in range(m)] for k in range(n)]) for m in (2, 3, 4))
    arc = put(np.stack([np.cos(6 * (i + 1) / (n + 2)), np.sin(6 * (i + 1) / (n + 2))], axis=1).tolist())
    soft, groups = {"compliance": h, "damping": h}, [(k, k + 1) for k in range(n)]
    alone = put(list(range(n)))
    rubs, faces = {pair: put([0.5, 0.25]) for pair in groups}, put([[0, k + 1, k + 2] for k in range(n - 2)])
    roof = put([(0, 0, 1), *((np.cos(3 * k / n), np.sin(3 * k / n), 0) for k in range(n - 1))])
    flat = [
        tv.Ball(put([0, 0]), 9.0, True, friction=put([0.5, 0.4])),
        tv.Box(put([-99, -9]), put([99, 9]), restitution=put([0.5, 0.0])),
        tv.Capsule(put([9, 0]), put([9, 1]), 0.1),
        tv.HalfSpace(put([0, 1]), -9, friction=0.5, surface_velocity=put([1.0, 0.0])),
        tv.Polygon(arc, closed=False, radius=0.1, position=put([20, 0])),
        tv.Sdf(from_ring),
        tv.AngleLimit(triples, h, put([3.0] * n), **soft),
        tv.Area(put([[k, k + 1, k + 2] for k in range(n)]), h, pressure=h, **soft),
        tv.Area([range(k, k + 3 + k % 2) for k in range(n)]),
        tv.Bend(triples, h, **soft, break_at=h),
        tv.Constraint(length, pairs, h, **soft),
        tv.Distance(pairs, h, **soft, break_at=h),
        tv.Motor(triples, h, angle=h, torque=h),
        tv.Path(alone, arc, speed=h),
        tv.Path(alone, arc, at=h),
        tv.Path(alone, arc, **soft),
        tv.Pin(alone, arc, **soft),
        tv.Rope(pairs, h, **soft),
        tv.ShapeMatch(put([[3 * k, 3 * k + 1, 3 * k + 2] for k in range(n)]), compliance=h, creep=h),
        tv.ShapeMatch([range(4 * k, 4 * k + 2 + k % 2) for k in range(n)]),
        tv.Snap(alone, 0.5, put([0.0, 0.25]), **soft),
        tv.Spacer(pairs, h, **soft),
        tv.Winch(pairs, h, length=h, shortest=h, longest=put([9.0] * n), force=h),
        tv.Contact(rubs, {(0, 1): put([0.5, 0.0])}, groups=put(groups[1:]), sensors=put(groups[:1])),
        tv.Contact(sensors=put(groups)),
        tv.Polygons(put([[4 * k, 4 * k + 1, 4 * k + 3, 4 * k + 2] for k in range(n)]), rubs),
        tv.Attractor(put([0, 0]), 1.0),
        tv.Drag(0.1),
        tv.Force(swirl),
        tv.Gravity(put([0, -1.0])),
        tv.Hand(put([0, 0])),
        tv.PairForce(pull),
        tv.Wind(put([1, 0]), 1.0),
        tv.Periodic(put([-50, -50]), put([50, 50]), put([0, 1])),
        tv.Sleep(),
    ]
    spatial = [
        tv.Mesh(roof, faces, closed=False, radius=0.1, position=put([20, 0, 0])),
        tv.Dihedral(quads, h, **soft),
        tv.Volume(quads, h, pressure=h, **soft),
        tv.Path(put([0]), put([(k, k * k / n, 1) for k in range(n)])),
    ]
    solvers = [tv.Jacobi(), tv.Chebyshev(), tv.ConjugateGradient(), tv.Direct()]
    return [(2, f) for f in flat] + [(3, f) for f in spatial], solvers


@pytest.mark.parametrize("put", [list, lambda rows: tuple(map(tuple, rows)) if np.ndim(rows) == 2 else tuple(rows), np.array])
@pytest.mark.parametrize("n", [3, 20])
@pytest.mark.filterwarnings("ignore::UserWarning")  # some scenes make no sense as motion
def test_what_can_be_built_can_be_read_back(world, n, put):
    # A scene that is made again from its own data has the same data: classes, arguments, knobs, of few elements and of many.
    features, solvers = catalogue(n, put)
    assert {type(thing).__name__ for thing in [*solvers, *(f for _, f in features)]} == {*scene.PUBLIC}
    given = {"swirl": swirl, "from_ring": from_ring, "length": length, "pull": pull}
    for k, (dim, feature) in enumerate(features):
        # Corners of squares, no four of them in a plane.
        x = np.random.default_rng(0).uniform(-0.1, 0.1, (4 * n, dim))
        x[:, :2] += [(j // 4 * 0.6 + j % 2 * 0.3, j % 4 // 2 * 0.3) for j in range(4 * n)]
        solver = solvers[k] if k < len(solvers) else None
        w = world(tv.Particles(x, group=np.arange(4 * n)), [feature], **({"solver": solver} if solver else {}))
        data, arrays = scene.describe(w)
        entry = journal.Entry.unpack(*journal.Entry("scene", 0, data, arrays).pack(0))
        again = scene.rebuild(entry.data, entry.arrays, {s: given[s] for s in data["needs"]}, [], [[] for _ in w.features])
        read, held = scene.describe(again)
        assert read == data, feature
        for name, array in arrays.items():
            np.testing.assert_array_equal(held[name], array)
        again.close()


def discs(world, x, **settings):
    """Return a world of discs on a gate."""
    features = [tv.Gravity(9.81), tv.HalfSpace((0, 1), active=True), tv.Contact(friction=0.5)]
    return world(tv.Particles(x, radius=0.1), features, precision="f64", **settings)


@pytest.mark.slow
def test_edits_of_a_pile_and_under_a_gate_that_opens_are_recorded(world, tmp_path, read_here):
    # Contacts of a removed disc leave their part in the velocities of the others, in an array of the clock, until the next step.
    w = discs(world, [(0, 0.1), (0.3, 0.1), (0.25, 0.3), (5, 0.1), (6, 0.1), (7, 0.1)])

    def before(frame):
        if frame in (2, 3):
            w.add(tv.Particles([(9 + frame, 0.5)], radius=0.1))
        if frame == 5:
            w.remove([0])
        if frame == 8:
            w.features[1].active = False
            w.remove([4])

    # An outlet removes after log(), an inlet adds before the next step: a scene ends before a frame of it was drawn.
    recording = recorded(w, tmp_path / "edits.rrd", 12, before, lambda frame: w.remove([6]) if frame == 2 else None)
    assert recording.frames.tolist() == list(range(13)) and recording.verify()
    # Discs at rest fall from the gate by g t^2 / 2: in f64 to rounding, whatever is removed at once.
    np.testing.assert_allclose(w.position[2:4], [(x, 0.1 - 9.81 * (5 / 60) ** 2 / 2) for x in (5, 6)], rtol=0, atol=1e-12)
    with recording.world(12) as again:
        assert again.hash() == w.hash() and again.time == recording.times[12]
    # Each scene has walls from its first frame on, and no later frame begins another.
    contents = rrd.read(str(tmp_path / "edits.rrd"), rows=True)
    rows = sorted((frame, contents.entities[number]) for _, _, number, frame, *_ in contents.rows.tolist())
    walls = [(0, ""), (2, "scene1/"), (3, "scene3/"), (5, "scene4/"), (8, "scene5/")]
    assert [row for row in rows if "/walls/" in row[1]] == [(frame, f"world/scene/{name}walls/1") for frame, name in walls]


@pytest.mark.slow
def test_the_state_of_the_step_controller_is_recorded(world, tmp_path, read_here):
    # What the controller stores about a frame that nothing improves is hashed; from a file it returns as Python numbers.
    w = discs(world, [(0.1, 0.05), (2, 2)], substeps="auto")
    recording = recorded(w, tmp_path / "stuck.rrd", 3)
    assert checkpoint.keep(w).controller[5:] != (1.0,) and recording.verify()
    with recording.world(3) as again:
        assert again.hash() == w.hash()


@pytest.mark.parametrize("frames", [0, 3])
def test_empty_worlds_and_what_is_too_far_away_for_a_picture_are_recorded(world, tmp_path, read_here, frames):
    # Entries of an empty world's journal may have no bytes at all.
    recording = recorded(world(tv.Particles(np.zeros((0, 3))), [tv.Gravity()]), tmp_path / "a.rrd", frames)
    assert recording.verify() and len(recording.frames) == frames + 1 and recording.position(0).shape == (0, 3)
    # 1e40 m exceeds f32, in which pictures are stored: NumPy issues no warning, and frames are replayed as they were.
    w = world(tv.Particles([(0.0, 0.0), (1.0, 0.0)], velocity=[(1e42, 0.0), (0.0, 0.0)]), precision="f64")
    assert recorded(w, tmp_path / "b.rrd", frames).verify() and (not frames or "out-of-range" in w.last.flags)


def test_recorders_follow_run_log_seldom_and_say_when_nothing_is_logged(one, tmp_path, read_here):
    with tv.Recorder(tmp_path / "a.rrd", one, every=3) as recorder:
        one.run(10 * FRAME, recorder=recorder)
    assert tv.replay(tmp_path / "a.rrd").frames.tolist() == [0, 3, 6, 9]
    with pytest.raises(RuntimeError, match="closed"):
        recorder.log()
    recorder.close()
    one.run(0.1, recorder=tmp_path / "b.rrd")
    assert len(tv.replay(tmp_path / "b.rrd").frames) == 7 and tv.replay(tmp_path / "b.rrd").world(6).hash() == one.hash()
    with pytest.warns(UserWarning, match=r"log\(\) was never called"), tv.Recorder(tmp_path / "c.rrd", one):
        one.run(0.1)


@pytest.mark.parametrize(
    "call, kind, text",
    [
        # Else the .rrd file that a film's name stands for is opened by no player, and by no viewer.
        (lambda w, p: w.run(0.1, recorder=p / "film.mp4"), ValueError, "film.mp4 ends in .* Write '.*film.rrd'; of that, tv.rep"),
        (lambda w, p: tv.Recorder(p / "run.1", w, overwrite=True), ValueError, "run.1 ends in .* Write '.*run.rrd'"),
        (lambda w, p: tv.Recorder(p / "no" / "c.rrd", w), ValueError, "does not exist"),
        (lambda w, p: tv.Recorder(p / "c.rrd", w, every=0), ValueError, "every = 0"),
        (lambda w, p: tv.Recorder(p / "c.rrd", w, budget=1000), ValueError, "Give at least"),
        (lambda w, p: tv.Recorder(p / "c.rrd", w, forces="yes"), TypeError, "forces = 'yes'"),  # type: ignore[arg-type]
        (lambda w, p: tv.Recorder(None, w), ValueError, "path = None is for live recordings"),
        (lambda w, p: tv.Recorder(p / "c.rrd", w, live="window"), ValueError, "live = 'window'"),
        (lambda w, p: tv.Recorder(p / "c.rrd", w, live="notebook"), ValueError, "shows without a file"),
        (lambda w, p: tv.Recorder(p, w), IsADirectoryError, "cannot be written"),
        (lambda w, p: tv.Recorder("/dev/full", w), OSError, "nothing could be written to /dev/full .No space left"),
    ],
)
def test_what_cannot_be_recorded_leaves_no_file(one, tmp_path, call, kind, text):
    with pytest.raises(kind, match=text):
        call(one, tmp_path)
    assert one.time == 0 and not [*tmp_path.iterdir()] and not one._watchers


def test_nothing_is_overwritten_unasked(falling, one, tmp_path, read_here):
    path, other = tmp_path / "a.rrd", tmp_path / "thesis.rrd"
    path.write_bytes(falling.read_bytes())
    other.write_text("years of work")
    for target, what in ((path, "a.rrd exists. Choose"), (other, "thesis.rrd exists, and is no recording. Choose")):
        with pytest.raises(FileExistsError, match=f"{what} another name, or replace it: .*overwrite=True"):
            tv.Recorder(target, one)
    with tv.Recorder(tmp_path / "b.rrd", one), pytest.raises(FileExistsError):
        tv.Recorder(tmp_path / "b.rrd", one)
    with pytest.raises(ValueError, match="Give at least"):
        tv.Recorder(path, one, budget=1000, overwrite=True)
    assert path.read_bytes() == falling.read_bytes()  # the file is replaced only when there is something to replace it
    for out, text in ((other, "years of work"), (tmp_path / "film.mp4", None)):
        assert main(["run", "hello", "--out", str(out)]) == 2 and (out.read_text() if out.exists() else None) == text
    with tv.Recorder(path, one, overwrite=True):
        assert not tv.replay(path).complete and list(tv.replay(path).frames) == [0]
    assert tv.replay(path).complete and not one._watchers
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.rrd", "b.rrd", "thesis.rrd"]


def test_a_file_that_is_removed_or_replaced_is_noticed(one, tmp_path, monkeypatch):
    monkeypatch.setattr(sink, "CHECK_INTERVAL", 0.0)
    recording = tv.Recorder(tmp_path / "a.rrd", one)
    recording.log()
    (tmp_path / "a.rrd").unlink()
    with pytest.raises(FileNotFoundError, match="at frame 2 .the file was removed or replaced.. What was recorded is lost"):
        recording.log()
    recording = tv.Recorder(tmp_path / "a.rrd", one)
    with tv.Recorder(tmp_path / "a.rrd", one, overwrite=True), pytest.raises(FileNotFoundError, match="removed or replaced"):
        recording.close()
    assert tv.replay(tmp_path / "a.rrd").complete and not one._watchers


@pytest.mark.slow
def test_a_killed_process_leaves_what_was_flushed(tmp_path, read_here):
    code = f"""
import os, signal
import numpy as np
import tiverlet as tv
tv.init(threads=1)
w = tv.World(tv.Particles(np.eye(3), velocity=(1, 2, 3)), [tv.Gravity()], substeps=2)
recorder = tv.Recorder({str(tmp_path / "k.rrd")!r}, w)
for k in range(30):
    w.step(1 / 60)
    recorder.log()
    if k == 24:
        recorder.flush()
other = tv.Recorder({str(tmp_path / "first.rrd")!r}, w)
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert python(code, check=False).returncode == -9
    assert list(tv.replay(tmp_path / "first.rrd").frames) == [0]  # the first frame is written at once
    recording = tv.replay(tmp_path / "k.rrd")
    assert not recording.complete and recording.frames[-1] >= 25 and "it ends with frame" in recording.text
    verdict = recording.verify()
    assert (verdict.kind, bool(verdict)) == ("incomplete", False) and verdict.frames >= 26


def test_a_full_disk_is_an_error_and_loses_nothing_that_was_written(world, tmp_path, read_here):
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (2000, 2))), [tv.Gravity()], substeps=1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, hard))  # bytes in a file, as if the disk were full
        with pytest.raises(OSError, match="writing .*full.rrd failed at frame [0-9]+ .File too large.*can be replayed"):
            with tv.Recorder(tmp_path / "full.rrd", w) as recorder:
                for _ in range(40):
                    w.step(FRAME)
                    recorder.log()
                    recorder.flush()
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
        with pytest.raises(OSError, match="nothing could be written"):
            tv.Recorder(tmp_path / "none.rrd", w)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not (tmp_path / "none.rrd").exists() and not w._watchers
    recording = tv.replay(tmp_path / "full.rrd")
    assert not recording.complete and 3 < len(recording.frames) < 20
    assert recording.verify().kind == "incomplete" and recording.verify().frames > 3


@pytest.mark.slow
def test_forks_and_restarts_are_errors_and_leave_the_file(tmp_path):
    # Without HOME Taichi ends the process; in a forked child it hangs at the end; ti.reset destroys the fields. A child holds a
    # copy of the end of the recorder's pipe, so the file ends without it. 255 bytes are the most of a file name.
    path = tmp_path / ("a" * 251 + ".rrd")
    code = f"""
import os, signal, time
assert "HOME" not in os.environ
import tiverlet as tv
from tiverlet.device import ti
world = tv.World(tv.Particles([[0.0, 0.0]]), [tv.Gravity()])
recorder, other = tv.Recorder({str(path)!r}, world), tv.Recorder({str(tmp_path / "b.rrd")!r}, world)
if not (pid := os.fork()):
    for call in (recorder.log, recorder.flush, lambda: world.step(0.1), lambda: tv.Recorder("c.rrd", world)):
        try:
            call()
        except RuntimeError as e:
            assert "fork" in str(e), e
        else:
            raise AssertionError(call)
    recorder.close()
    time.sleep(60)
world.step(0.1)
recorder.log()
world.run(0.1, recorder=other)
other.close()
assert os.waitpid(pid, os.WNOHANG) == (0, 0)
os.kill(pid, signal.SIGKILL)
ti.reset()
try:
    recorder.log()
except RuntimeError as e:
    print(e)
recorder.close()
"""
    home = os.environ.pop("HOME")
    try:
        assert "Taichi was started again" in python(code, fresh=True).stdout
    finally:
        os.environ["HOME"] = home
    assert list(tv.replay(path).frames) == [0, 1] and tv.replay(tmp_path / "b.rrd").complete
    assert sorted(os.listdir(tmp_path)) == [path.name, "b.rrd"]


@pytest.mark.slow
def test_a_budget_is_kept_and_said(world, tmp_path, read_here):
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (500, 2))), [tv.Gravity()], substeps=1)
    path, sizes = tmp_path / "b.rrd", []
    with pytest.warns(UserWarning, match=r"budget = 500000 bytes, the picture has one of [48] frames. All steps are in the file"):
        with tv.Recorder(path, w, budget=500_000) as recording:
            for _ in range(400):
                w.step(FRAME)
                recording.log()
                sizes.append(path.stat().st_size)
    assert max(*sizes, path.stat().st_size) < 500_000
    recording = tv.replay(path)  # the whole run is in the file
    assert {*range(0, 401, 8)} <= {*recording.frames.tolist()} and len(recording.frames) < 110
    assert recording.verify() and recording.complete
    assert {*range(8, 401, 8)} <= {*recording.curves["energy"][0].tolist()} and len(recording.curves["energy"][0]) < 110
    assert os.listdir(tmp_path) == ["b.rrd"]
    # The file also holds what the user does in each step. Where not even that fits, the recording ends, with a warning.
    with pytest.warns(UserWarning, match="do not fit in it after frame [0-9]+, where the recording ends"):
        with tv.Recorder(path, w, budget=240_000, overwrite=True) as recording:
            for k in range(1500):
                w.features[0].g = 9.0 + 0.001 * k
                w.step(FRAME)
                recording.log()
    assert path.stat().st_size < 240_000
    recording = tv.replay(path)
    assert recording.complete and recording.verify() and 50 < recording.frames[-1] < 1500


@pytest.mark.slow
def test_positions_take_most_of_a_file(world, tmp_path, read_here):
    # Positions take n * dim * 4 bytes of a frame; lines, meshes and colours 0.4 of that; a message of rows 1.5 kB, a row 100.
    sheet = tv.shapes.cloth((0, 1, 0), (1, 0, 0), (0, 0, 1), (16, 16))
    cloth = tv.Particles(sheet.position, velocity=np.random.default_rng(1).normal(0, 0.1, (256, 3)))
    features = [tv.Gravity(1.0), tv.Distance(sheet.links), tv.Distance(sheet.braces, compliance=1e-2)]
    world(cloth, features, substeps=2, solver=tv.Jacobi()).run(2.0, recorder=tmp_path / "a.rrd")
    of = [message for kind, message in messages.split((tmp_path / "a.rrd").read_bytes()) if kind == messages.CHUNK]
    of = [m for m in of if messages.rows_of(m).schema.metadata[b"rerun:entity_path"] == b"/world/scene/particles"]
    raw = 121 * 256 * 3 * 4
    assert raw < sum(map(len, of)) < 1.4 * raw + 1500 * len(of) + 100 * 121
    # A rope of 40 points: 320 bytes in a frame. Everything else (layout, curves, hashes) takes at most 1.5 times as much.
    rope = tv.shapes.rope((0, 2), (1, 2), points=40)
    start = tv.Particles(rope.position, mass=0.01, radius=0.01, pinned=[0])
    world(start, [tv.Gravity(), tv.Distance(rope.links)], substeps=8).run(5.0, recorder=tmp_path / "b.rrd")
    assert (tmp_path / "b.rrd").stat().st_size <= 2.5 * 300 * 320


@pytest.mark.slow
@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="threads are counted on Linux")
def test_threads_of_a_closed_recorder_end(one, tmp_path):
    # rerun keeps two threads for each stream, of which a file has three. Those of a recorder end when the next one closes.
    before = 0
    for k in range(4):
        one.run(FRAME, recorder=tmp_path / f"{k}.rrd")
        gc.collect()
        before = before or len(os.listdir("/proc/self/task"))
    assert len(os.listdir("/proc/self/task")) <= before


@pytest.mark.slow
def test_commands_run_replay_and_name_what_fails(falling, tmp_path, monkeypatch, capsys, read_here):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("a.rrd").write_bytes(falling.read_bytes())
    assert main(["replay", "a.rrd", "--verify"]) == 0 and "all 11 frames come out" in capsys.readouterr().out
    anew = f"from tiverlet.__main__ import main\nraise SystemExit(main(['replay', {str(tmp_path / 'a.rrd')!r}, '--verify']))"
    assert "all 11 frames come out" in python(anew).stdout  # in a process in which Taichi does not run yet
    assert main(["replay", "a.rrd", "--export", "csv"]) == 0 and pathlib.Path("a.csv").exists()
    assert main(["replay", "none.rrd"]) == 2 and "none.rrd" in capsys.readouterr().err

    # A script that records nothing itself, and whose function has to be given to verify().
    pathlib.Path("mine.py").write_text("""
import sys
from tiverlet.device import ti
import tiverlet as tv

@ti.func
def swing(x):
    return -10.0 * x

if __name__ == "__main__":
    assert sys.argv[1:] == ["5"]
    with tv.World(tv.Particles([[0.0, 1.0]]), [tv.Force(swing)], substeps=2) as world:
        world.run(int(sys.argv[1]) / 60)
    raise SystemExit(3)
""")
    step = tv.World.step
    assert main(["run", "mine.py", "5", "--out", "mine.rrd"]) == 3
    assert "6 frames (0 ... 5)" in capsys.readouterr().out and tv.World.step is step
    assert main(["replay", "mine.rrd", "--verify"]) == 2 and "given=[swing]" in capsys.readouterr().err
    assert main(["replay", "mine.rrd", "--verify", "--given", "mine.py"]) == 0
    assert main(["run", "nobody"]) == 2 and "no demo of that name" in capsys.readouterr().err

    # Errors of a script have their traceback; it finds the modules beside it. What was recorded before is kept.
    pathlib.Path("beside.py").write_text("seconds = 2 / 60")
    pathlib.Path("fails.py").write_text("""
import beside
import tiverlet as tv

with tv.World(tv.Particles([[0.0, 1.0]]), substeps=2) as world:
    world.run(beside.seconds)
    float("x")
""")
    assert main(["run", "fails.py"]) == 1
    told = capsys.readouterr()
    assert "fails.rrd: 3 frames" in told.out and 'line 7, in <module>\n    float("x")' in told.err and "runpy" not in told.err
    wrong = (["play", "fails.py"], ["replay", "mine.rrd", "--verify", "--given", "fails.py"])
    ends = [(words, 1, "could not convert") for words in wrong]
    ends += [(["play", "fails.py", "--port", k], 2, "is no number from 0 to 65535") for k in ("-1", "65536", "x")]
    for words, status, text in ends:
        with pytest.raises(SystemExit) as end:
            main(words)
        assert end.value.code == status and text in capsys.readouterr().err
    assert main(["run", "fails.py", "--out", "none/a.rrd"]) == 2 and "The folder of none/a.rrd" in capsys.readouterr().err


@pytest.mark.slow
def test_pictures_have_names_and_frames_and_end_their_viewer_when_told(falling, tmp_path, monkeypatch):
    taken, started = [], []

    def start(*words, **options):
        started.append(subprocess.Popen(["sleep", "60" if taken[2:] else "0"], start_new_session=True))
        return started[-1]

    monkeypatch.setattr(viewer, "launch", start)
    monkeypatch.setattr(viewer, "_save_when_steady", lambda process, port, frame, name, view: taken.append((frame, name)))
    assert viewer.picture(str(falling), str(tmp_path / "100%.png")) == [str(tmp_path / "100%.png")] and taken[0][0] == 20
    viewer.picture(str(falling), str(tmp_path / "50%_%03d.png"), [0, 4])
    assert [pathlib.Path(name).name for _, name in taken[1:]] == ["50%_000.png", "50%_004.png"]
    for frames, words in (([5], "no frame 5; the nearest is"), ([2, 4], "need a name with %d")):
        with pytest.raises(ValueError, match=words):
            viewer.picture(str(falling), str(tmp_path / "a.png"), frames)
    monkeypatch.setattr(viewer, "_save_when_steady", lambda *words: os.kill(os.getpid(), signal.SIGTERM))
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        viewer.picture(str(falling), str(tmp_path / "a.png"))
    assert end.value.code == 128 + signal.SIGTERM and signal.getsignal(signal.SIGTERM) is before
    assert all(process.poll() is not None for process in started)


def test_a_picture_without_a_window(falling, tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    places = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
    if not any(True for place in places for _ in pathlib.Path(place).glob("*.json")):
        pytest.skip("no Vulkan driver here; apt-get install mesa-vulkan-drivers")
    one, other = viewer.picture(str(falling), str(tmp_path / "%d.png"), [0, 20], scene=True)
    assert not list((tmp_path / "temporary").iterdir())
    first, last = (viewer.pixels_of(png).astype(int) for png in (one, other))
    assert first.shape == last.shape and first.shape[0] > 300
    assert (np.abs(first - last).max(axis=2) > 60).sum() > 50  # particles have moved on a background that has not
    assert (np.abs(first - last).max(axis=2) < 20).mean() > 0.5
