"""Replay: a recording leads to the same bits again, wherever it goes on from, and says so where it does not."""

import json
import pathlib
import re
import resource
import struct

import numpy as np
import pytest
import taichi as ti

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.recording import journal, rrd, scene, viewer

from .conftest import python

S = tv.shapes


@ti.func
def swirl(x, v):
    """A force."""
    return -0.1 * x - 0.01 * v


def spacing(a, b):
    """A constraint."""
    return (a - b).norm()


@ti.func
def bowl(p):
    """A distance to a circle."""
    return 3.0 - p.norm()


USERS = [swirl, spacing, bowl]


def flat(precision="f32", **settings):
    """A scene with everything that there is in 2D but Polygons."""
    rope, blob, ball = S.rope((-1, 1), (0, 1), 6), S.cloth((0.3, 0.2), (0.4, 0), (0, 0.4), (3, 3)), S.ball((1.2, 0.6), 0.3, 2)
    body, (a, b, c) = S.join(rope, blob, ball)
    more = np.array([[-1.5, 0.3], [-1.4, 0.3], [-1.2, 0.35], [-1.0, 0.3], [-0.8, 0.3], [-0.6, 0.32], [-0.4, 0.3], [-0.2, 0.31]])
    position, n = np.concatenate([body.position, more]), len(body)
    features = [
        tv.Gravity(9.81), tv.Drag(0.1), tv.Wind((0.3, 0.0), 0.2), tv.Attractor((0.0, 3.0), 0.5), tv.Force(swirl),
        tv.Distance(rope.links[:3], compliance=1e-4, damping=0.01, break_at=50.0), tv.Rope(rope.links[3:], length=0.21),
        tv.Distance(blob.links + b.start), tv.Bend(blob.bends[:2] + b.start, compliance=0.1), tv.Spacer([(n, n + 1)], 0.05),
        tv.AngleLimit([(n + 1, n + 2, n + 3)], -0.5, 0.5), tv.Area([i.tolist() for i in ball.loops], pressure=1.1),
        tv.Area(blob.faces[:3] + b.start, compliance=1e-3), tv.ShapeMatch([np.arange(c.start, c.stop)], compliance=1e-3),
        tv.Pin([0], compliance=1e-4), tv.Pin([n + 4], (-0.8, 0.3)), tv.Path([n + 5], [(-1, 0.3), (0, 0.4), (1, 0.3)], at=0.4),
        tv.Path([n + 6], [(-0.5, 0.3), (0.5, 0.2)], smooth=False), tv.Snap([n + 7], 0.1, compliance=0.01),
        tv.Constraint(spacing, [(n + 2, n + 3)], rest=0.2), tv.Contact(friction={(0, 1): 0.3}, groups=[(0, 1), (0, 0)]),
        tv.Box((-2, 0), (2, np.inf), friction=(0.4, 0.3)), tv.HalfSpace((0.1, 1), -0.5), tv.Ball((0.5, -0.2), 0.3),
        tv.Capsule((1.5, 0.1), (1.8, 0.3), 0.05), tv.Polygon([(-2, -1), (2, -1), (2, 4), (-2, 4)], inside=True), tv.Sdf(bowl),
    ]  # fmt: skip
    particles = tv.Particles(
        position, mass=0.1 + 0.01 * np.arange(len(position)), radius=0.03, group=np.arange(len(position)) % 2, velocity=(0.2, 0)
    )
    return tv.World(particles, features, substeps=4, precision=precision, **settings)


def solid(precision="f64", **settings):
    """What there is in 3D only, with a solver of its own."""
    tetrahedron = np.array([[0, 0.5, 0], [0.5, 0.5, 0], [0, 1.0, 0], [0, 0.5, 0.5], [0.6, 1.0, 0.6]])
    vertices = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], dtype=float)
    features = [
        tv.Gravity((0, -9.81, 0)), tv.Distance([(0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (1, 4)], compliance=1e-5),
        tv.Volume([(0, 1, 2, 3)], compliance=1e-4), tv.Dihedral([(0, 1, 2, 3)], compliance=0.1),
        tv.Mesh(vertices, [(0, 2, 1), (0, 3, 2)], closed=False, restitution=0.3), tv.Contact(),
    ]  # fmt: skip
    settings = {"solver": tv.ConjugateGradient(7), "substeps": 5, **settings}
    return tv.World(tv.Particles(tetrahedron, radius=0.05, pinned=[4]), features, precision=precision, **settings)


def bodies(precision="f32-compensated", **settings):
    """Polygons, and a chain that is solved directly."""
    angle = np.arange(4) * np.pi / 2
    square = 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    position = np.concatenate([square, square + [0.1, 0.5]])
    links = np.concatenate([np.stack(np.triu_indices(4, 1), axis=1) + k for k in (0, 4)])
    loops = (np.arange(4) + k for k in (0, 4))
    features = [tv.Gravity(), tv.Distance(links), tv.Polygons(loops, friction=0.3), tv.HalfSpace((0, 1), -0.3)]
    settings = {"solver": tv.Direct(width=3), "substeps": 6, **settings}
    return tv.World(tv.Particles(position), features, precision=precision, **settings)


def swing(precision):
    """Small, with what a state has beyond positions: contacts with friction, a spring, targets on their way."""
    rope = S.rope((0, 0), (1, 0), 5)
    features = [
        tv.Gravity(9.81), tv.Distance(rope.links, compliance=1e-4), tv.Box((-2, -0.2), (2, 2), friction=0.3),
        tv.Contact(friction=0.4), tv.Pin([0], (0.0, 0.0)),
    ]  # fmt: skip
    x = np.concatenate([rope.position, [[0.5, 0.07], [0.62, 0.09]]])
    return tv.World(tv.Particles(x, radius=0.05), features, substeps=4, precision=precision)


def race(precision):
    """In 3D: drag, a bead that is driven, a link that breaks."""
    x = np.array([[0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 0, 2]], dtype=float)
    bead = tv.Path([0], [(0, 1, 0), (1, 1, 1), (2, 1, 0)], at=0.0)
    features = [tv.Gravity(9.81), tv.Drag(0.2), tv.Distance([(1, 2), (2, 3)], break_at=[np.inf, 2.0]), bead]
    return tv.World(tv.Particles(x, pinned=[1]), features, substeps=4, precision=precision)


def drive(world: tv.World, recorder: tv.Recorder, frames: int = 12) -> None:
    """Step and record, and do everything in between that a user can do."""
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
    """The hash at the end, from a frame on."""
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
            with scene.rebuild(entry.data, entry.arrays, {f.__name__: f for f in USERS}, []) as again:
                assert repr(again) == repr(world)
                assert repr(again.settings["solver"]) == repr(world.settings["solver"])
                assert [type(f) for f in again.features] == [type(f) for f in world.features]
                again.features[0].upload(), world.features[0].upload()
                mine, theirs = (w._memory._dump(w._memory.entries) for w in (world, again))
                for field, a, b in zip(world._memory.entries, mine, theirs, strict=True):
                    np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert seen == set(scene.PUBLIC)


@pytest.mark.parametrize("build, precision", [(swing, "f32"), (race, "f32-compensated"), (race, "f64")])
def test_round_trip(build, precision, tmp_path):
    path = tmp_path / "a.rrd"
    with build(precision) as world, tv.Recorder(path, world) as recorder:
        drive(world, recorder)
        end = world.hash()
    recording = tv.replay(path)
    assert recording.complete and list(recording.frames) == [*range(12)]
    verdict = recording.verify()
    assert verdict and verdict.frames == 12, verdict
    assert go_on(recording, 6) == end


def test_an_empty_world_is_replayed(tmp_path):
    with tv.World(tv.Particles(np.zeros((0, 3))), [tv.Gravity()]) as world, tv.Recorder(tmp_path / "e.rrd", world) as recorder:
        for _ in range(3):
            world.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "e.rrd")
    assert list(recording.frames) == [0, 1, 2, 3] and recording.position(3).shape == (0, 3) and recording.verify()


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


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """The file of a small recording, and the energy curve."""
    path = tmp_path_factory.mktemp("falling") / "a.rrd"
    gravity = tv.Gravity(9.81)
    with tv.World(tv.Particles(np.eye(3), velocity=(1, 2, 3)), [gravity], substeps=2) as world:
        with tv.Recorder(path, world, every=2) as recorder:
            for frame in range(20):
                if frame == 11:
                    gravity.g = 5.0
                world.step(1 / 60)
                recorder.log()
                recorder.flush()
    return path


def rewrite(path, to, change, seal=True):
    """Copy a recording with entries changed by change(number, text) -> text; sealed with new checksums, or not."""
    import rerun as rr

    stream = rr.RecordingStream("tiverlet_3d")
    stream.save(to)
    with rrd.chunks(str(path)) as (chunks, _):
        rows = [
            row for c in chunks if c.entity_path == f"/{journal.JOURNAL}"
            for row in zip(*(rrd.rows(c, name) for name in ("text", "blob", "checksum")), strict=True)
        ]  # fmt: skip
        stream.send_chunks([c for c in chunks if c.entity_path != f"/{journal.JOURNAL}"])
    mark = ""
    for text, blob, old in rows:
        text = change(text)
        mark = journal.checksum(mark, text, blob.tobytes()) if seal else old
        stream.log(journal.JOURNAL, rr.AnyValues(text=text, blob=blob, checksum=mark))
    stream.disconnect()
    return to


def test_what_was_recorded_reads_back(falling, tmp_path):
    recording = tv.replay(falling)
    assert list(recording.frames) == list(range(0, 21, 2)) and recording.times[-1] == pytest.approx(20 / 60)
    assert recording.position(20).dtype == np.float32
    with recording.world(20) as world:
        np.testing.assert_array_equal(recording.position(20), world.position.astype(np.float32))
        assert world.time == recording.times[-1] and world.features[0].g == 5.0
    # x = t, y = 2 t - g t^2 / 2 without step errors
    np.testing.assert_allclose(recording.position(10)[0], [1 + 1 / 6, 2 / 6 - 9.81 / 72, 3 / 6], rtol=1e-6)
    assert list(recording.curves["energy"][0]) == list(range(2, 21, 2))
    np.testing.assert_allclose(recording.curves["momentum/x"][1], 3.0, rtol=1e-6)
    recording.export(str(tmp_path / "a.npz"))
    with np.load(tmp_path / "a.npz") as out:
        assert out["position"].shape == (11, 3, 3) and (out["position"][-1] == recording.position(20)).all()
    recording.export(str(tmp_path / "a.csv"))
    table = (tmp_path / "a.csv").read_text().splitlines()
    assert table[0] == "frame,time,particle,x,y,z" and len(table) == 34
    assert [np.float32(v) for v in table[-1].split(",")[3:]] == recording.position(20)[2].tolist()
    with pytest.raises(ValueError, match="no frame 3; the nearest is"):
        recording.world(3)
    with pytest.raises(ValueError, match="csv can be written"):
        recording.export("a.txt")


def test_damage_is_named(falling, tmp_path):
    whole = falling.read_bytes()
    path = tmp_path / "b.rrd"

    path.write_bytes(b"not an rrd, but some text")
    with pytest.raises(ValueError, match="not an .rrd file"):
        tv.replay(path)
    with pytest.raises(FileNotFoundError):
        tv.replay(tmp_path / "none.rrd")
    path.write_bytes(whole[:200])
    with pytest.raises(ValueError, match="cut short before anything"):
        tv.replay(path)

    # Cut in the middle of every message: what comes before it is read, and it is said where that ends.
    ends, at = [], rrd.HEADER
    while at < len(whole) and (kind := struct.unpack_from("<QQ", whole, at))[0]:
        at += 16 + kind[1]
        ends.append(at)
    seen = set()
    for end in ends:
        path.write_bytes(whole[: end - 5])
        try:
            part = tv.replay(path)
        except ValueError as e:
            assert "cut short before anything" in str(e) and not seen
            continue
        seen.add(len(part.frames))
        assert not part.complete and "not closed: it " in part.text
    assert seen and max(seen) == 11
    assert part.verify()


def test_tampering_is_found(falling, tmp_path):
    def turn(text):
        entry = json.loads(text)
        if entry["kind"] == "turned" and entry["data"]["features"]["0"]:
            entry["data"]["features"]["0"]["g"] = 5.5
        return json.dumps(entry)

    with pytest.raises(ValueError, match="changed after it was recorded: entry [0-9]+, 'turned' of frame 10"):
        tv.replay(rewrite(falling, tmp_path / "a.rrd", turn, seal=False))
    verdict = tv.replay(rewrite(falling, tmp_path / "b.rrd", turn)).verify()
    assert not verdict and (verdict.frame, verdict.particle) == (12, 0) and "first particle 0" in str(verdict)

    def older(text):
        return text.replace(f'"format": {journal.FORMAT}', '"format": 99')

    with pytest.raises(ValueError, match=f"is in format 99, of tiverlet .* reads format {journal.FORMAT}"):
        tv.replay(rewrite(falling, tmp_path / "c.rrd", older))

    def elsewhere(text):
        return re.sub(r'"g": 5.0', '"g": 5.5', text.replace('"taichi": "1', '"taichi": "0'))

    with pytest.raises(RuntimeError, match="frame 12 .* not as it was: taichi 0.7.4 then, 1.7.4 now"):
        tv.replay(rewrite(falling, tmp_path / "d.rrd", elsewhere)).world(12)

    # One coordinate of the picture: its bytes are in the file as they are, since LZ4 finds nothing to save in them.
    whole, x = bytearray(falling.read_bytes()), tv.replay(falling).position(8)
    at = whole.find(x[1].tobytes())
    if at >= 0:
        whole[at] ^= 1
        (tmp_path / "e.rrd").write_bytes(whole)
        recording = tv.replay(tmp_path / "e.rrd")
        with pytest.raises(ValueError, match="picture of frame 8"):
            recording.position(8)
        verdict = recording.verify()
        assert not verdict and (verdict.frame, verdict.particle) == (8, 1) and "picture" in str(verdict)


def test_a_killed_process_leaves_what_was_flushed(tmp_path):
    code = f"""
import os, signal, sys
import numpy as np
sys.path.insert(0, {str(tmp_path)!r})
import tiverlet as tv
tv.init(threads=1)
rope = tv.shapes.rope((0, 0), (1, 0), 30)
w = tv.World(tv.Particles(rope.position, pinned=[0]), [tv.Gravity(), tv.Distance(rope.links)], path="parallel")
recorder = tv.Recorder({str(tmp_path / "k.rrd")!r}, w)
for k in range(30):
    w.step(1 / 60)
    recorder.log()
    if k == 24:
        recorder.flush()
os.kill(os.getpid(), signal.SIGKILL)
"""
    assert python(code, check=False).returncode == -9
    recording = tv.replay(tmp_path / "k.rrd")
    assert not recording.complete and recording.frames[-1] >= 25 and "not closed: it ends with frame" in recording.text
    assert recording.verify()


def test_a_full_disk_is_an_error_and_loses_nothing_that_was_written(world, tmp_path):
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (2000, 3))), [tv.Gravity()], substeps=1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))  # bytes in a file, as if the disk were full
    try:
        with pytest.raises(OSError, match="writing failed at frame [0-9]+ .File too large.*can be replayed"):
            with tv.Recorder(tmp_path / "full.rrd", w) as recorder:
                for _ in range(40):
                    w.step(1 / 60)
                    recorder.log()
                    recorder.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not w._watchers
    recording = tv.replay(tmp_path / "full.rrd")
    assert not recording.complete and 3 < len(recording.frames) < 20
    assert recording.verify()
    with pytest.raises(OSError, match="writing failed"):
        with tv.Recorder("/dev/full", w):
            pass
    with pytest.raises(IsADirectoryError, match="cannot be written"):
        tv.Recorder(tmp_path, w)


def test_a_budget_is_kept_and_said(world, tmp_path):
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (500, 2))), [tv.Gravity()], substeps=1)
    with pytest.raises(ValueError, match="Give at least"):
        tv.Recorder(tmp_path / "a.rrd", w, budget=1000)
    assert not (tmp_path / "a.rrd").exists()
    with pytest.warns(UserWarning, match=r"of 401 frames are drawn: from frame [0-9]+ on one of 2, .*All steps are in the file"):
        with tv.Recorder(tmp_path / "b.rrd", w, budget=500_000) as recorder:
            w.run(400 / 60, recorder=recorder)
    assert (tmp_path / "b.rrd").stat().st_size < 500_000
    recording = tv.replay(tmp_path / "b.rrd")
    assert 60 < len(recording.frames) < 300 and recording.frames[-1] > 150
    assert recording.verify()


def test_command_line(falling, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.rrd"
    path.write_bytes(falling.read_bytes())
    assert main(["replay", str(path), "--verify"]) == 0 and "all 11 frames come out" in capsys.readouterr().out
    wrong = rewrite(falling, tmp_path / "b.rrd", lambda text: text.replace('"g": 5.0', '"g": 5.5'))
    assert main(["replay", str(wrong), "--verify"]) == 1 and "first particle 0" in capsys.readouterr().out
    assert main(["replay", str(path), "--export", "csv"]) == 0 and (tmp_path / "a.csv").exists()
    assert main(["replay", "none.rrd"]) == 2 and "none.rrd" in capsys.readouterr().err

    # A script that records nothing itself, and whose function has to be given to verify().
    (tmp_path / "mine.py").write_text("""
import sys
import taichi as ti
import tiverlet as tv

@ti.func
def swing(x):
    return -10.0 * x

if __name__ == "__main__":
    assert sys.argv[1:] == ["5"]
    with tv.World(tv.Particles([[0.0, 1.0]]), [tv.Force(swing)], substeps=2) as world:
        for _ in range(int(sys.argv[1])):
            world.step(1 / 60)
    raise SystemExit(3)
""")
    assert main(["run", "mine.py", "5", "--out", "mine.rrd"]) == 3
    assert "6 frames (0 ... 5)" in capsys.readouterr().out and not hasattr(tv.World.step, "__wrapped__")
    assert main(["replay", "mine.rrd", "--verify"]) == 2 and "given=[swing]" in capsys.readouterr().err
    assert main(["replay", "mine.rrd", "--verify", "--given", "mine.py"]) == 0
    assert main(["run", "nobody"]) == 2 and "no demo of that name" in capsys.readouterr().err


def test_a_picture_without_a_window(falling, tmp_path):
    places = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
    if not any(pathlib.Path(place).glob("*.json") for place in places):
        pytest.skip("no Vulkan driver here; apt-get install mesa-vulkan-drivers")
    one, other = viewer.picture(str(falling), str(tmp_path / "%d.png"), [0, 20], scene=True)
    first, last = (viewer.pixels_of(png).astype(int) for png in (one, other))
    assert first.shape == last.shape and first.shape[0] > 300
    assert (np.abs(first - last).max(axis=2) > 60).sum() > 50  # particles have moved, on a background that has not
    assert (np.abs(first - last).max(axis=2) < 20).mean() > 0.5


def test_moving_targets_move_evenly(world):
    pin, path = tv.Pin([0], (0.0, 0.0)), tv.Path([1], [(0, 1), (10, 1)], smooth=False, at=0.0)
    w = world(tv.Particles([[0.0, 0.0], [0.0, 1.0]]), [pin, path], substeps=4, precision="f64")
    for k in range(1, 4):
        pin.target, path.at = [[0.1 * k, 0.0]], 0.2 * k
        w.step(0.1)
        np.testing.assert_allclose(w.position, [[0.1 * k, 0], [0.2 * k, 1]], atol=1e-12)
        np.testing.assert_allclose(w.velocity, [[1, 0], [2, 0]], atol=1e-9)  # all along the frame
