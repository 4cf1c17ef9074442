"""Files of recordings: their content, what remains when they are cut, changed or unfinished, and the commands."""

import json
import os
import pathlib
import pickle
import re
import resource
import signal
import struct
import subprocess
import tempfile

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.device import ti
from tiverlet.device.language import NAME, NAMES
from tiverlet.recording import journal, messages, reader, recorder, rrd, viewer

from .conftest import python
from .forging import Forgery


@pytest.fixture(scope="module")
def falling(tmp_path_factory):
    """Return the path of a small recording."""
    path = tmp_path_factory.mktemp("falling") / "a.rrd"
    gravity = tv.Gravity(9.81)
    with (
        tv.World(tv.Particles(np.eye(3), velocity=(1, 2, 3)), [gravity], substeps=2) as world,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr("tiverlet.recording.recorder.SMALL", 0)  # many messages, as in a long recording
        with tv.Recorder(path, world, every=2) as recorder:
            for frame in range(20):
                if frame == 11:
                    gravity.g = 5.0
                world.step(1 / 60)
                recorder.log()
                recorder.flush()
    return path


def rewrite(path, to, change, seal=True):
    """Copy a recording with entries changed by change(text) -> text; `seal` renews the checksums."""
    return Forgery(path).journal(lambda entry: json.loads(change(json.dumps(entry))), seal).save(to)


def test_a_file_ends_while_a_child_keeps_its_pipe_and_with_a_name_of_any_length(tmp_path, monkeypatch):
    # A child made by fork holds a copy of the pipe's end for writing, as dup() makes one. 255 bytes are the most of a file name.
    pipe, kept = os.pipe, []

    def copied():
        out, into = pipe()
        kept.append(os.dup(into))
        return out, into

    monkeypatch.setattr("tiverlet.recording.sink.REST", 0.1)
    path = tmp_path / ("a" * 251 + ".rrd")
    with tv.World(tv.Particles([[0.0, 0.0]]), [tv.Gravity()], substeps=2) as w:
        for _ in range(2):
            with monkeypatch.context() as patch:
                patch.setattr(os, "pipe", copied)
                recorder = tv.Recorder(path, w, overwrite=True)
            w.run(1 / 60, recorder=recorder)
            recorder.close()
            assert not recorder._sink._copy.is_alive()
            assert tv.replay(path).complete
    assert os.listdir(tmp_path) == [path.name]
    for end in kept:
        os.close(end)


def test_frames_are_asked_for_by_number(falling):
    recording = tv.replay(falling)
    for wrong in ("a", None, 1.5, True, [1]):
        for ask in (recording.world, recording.position):
            with pytest.raises(ValueError, match="but the number of a frame is needed"):
                ask(wrong)
    with pytest.raises(TypeError, match="frame"):  # the call is wrong, not the file
        recording.world()  # type: ignore[call-arg]


def test_what_was_recorded_reads_back(falling, tmp_path):
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
    recording.export(str(tmp_path / "a.npz"))
    with np.load(tmp_path / "a.npz") as out:
        assert out["position"].shape == (11, 3, 3) and (out["position"][-1] == recording.position(20)).all()
    recording.export(str(tmp_path / "a.csv"))
    table = (tmp_path / "a.csv").read_text().splitlines()
    assert table[0] == "frame,time,particle,x,y,z,radius" and len(table) == 34
    assert [np.float32(v) for v in table[-1].split(",")[3:6]] == recording.position(20)[2].tolist()
    recording.export(str(tmp_path / "a.xyz"))
    lines = (tmp_path / "a.xyz").read_text().splitlines()
    assert len(lines) == 11 * 5 and lines[50] == "3"
    assert lines[51] == f'Properties=species:S:1:pos:R:3:radius:R:1 Time={float(recording.times[-1])!r} Frame=20 pbc="F F F"'
    assert [[np.float32(v) for v in line.split()[1:4]] for line in lines[52:]] == recording.position(20).tolist()
    with pytest.raises(ValueError, match="no frame 3; the nearest is"):
        recording.world(3)
    with pytest.raises(ValueError, match="xyz can be written"):
        recording.export("a.txt")


@pytest.mark.slow
def test_damage_is_named(falling, tmp_path, read_here):
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

    # Cut in the middle of every message: everything before it is read, and the text says where that ends.
    ends, at = [], reader.HEADER
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
        assert not part.complete and "not complete (the file is cut short" in part.text
    assert seen and max(seen) == 11
    verdict = part.verify()
    assert not verdict and (verdict.kind, verdict.frames) == ("incomplete", 11) and "the first 11 frames hold" in str(verdict)

    # A missing entry of the journal; and a wrong length.
    forged = Forgery(falling)
    (k,) = forged.chunks(journal.JOURNAL)[6:7]
    forged.only(k, [])
    missing = tv.replay(forged.save(tmp_path / "c.rrd")).verify()
    assert missing.kind == "incomplete" and 0 < missing.frames < 11 and missing.of >= 10
    assert f"the first {missing.frames} of {missing.of} frames hold" in str(missing)
    at = ends[len(ends) // 2]
    path.write_bytes(whole[:at] + struct.pack("<QQ", 2, 1 << 60) + whole[at + 16 :])
    wrong = tv.replay(path)
    assert not wrong.complete and "a length is wrong" in wrong.text and wrong.verify().kind == "incomplete"


def test_tampering_is_found(falling, tmp_path, read_here):
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

    other = next(name for name in NAMES.values() if name != NAME)

    def compiled(text):
        return text.replace(f'"compiler": "{NAME} ', f'"compiler": "{other} ')

    recording = tv.replay(rewrite(falling, tmp_path / "e.rrd", compiled))
    with pytest.raises(RuntimeError, match=f"recorded with {other}, and {NAME} runs here.*TIVERLET_COMPILER={other.lower()}"):
        recording.verify()
    assert f"{other} " in recording.text and len(recording.position(12)) == len(tv.replay(falling).position(12))

    minor = ".".join(map(str, ti.__version__[1:]))
    with pytest.raises(RuntimeError, match=f"frame 12 .* not as it was: taichi 0.{minor} then, 1.{minor} now"):
        tv.replay(rewrite(falling, tmp_path / "d.rrd", elsewhere)).world(12)

    # One changed coordinate of the picture.
    forged = Forgery(falling)
    k, row = forged.rows("world/scene/particles", "Points3D:positions")[4]
    x = forged.messages[k][2].column("Points3D:positions").to_pylist()
    x[row][1][0] = np.nextafter(np.float32(x[row][1][0]), np.float32(9))
    forged.set(k, Points3D__positions=x)
    recording = tv.replay(forged.save(tmp_path / "e.rrd"))
    with pytest.raises(ValueError, match="picture of frame 8"):
        recording.position(8)
    verdict = recording.verify()
    assert (verdict.kind, verdict.frame, verdict.particle) == ("changed", 8, 1) and "picture" in str(verdict)


def test_a_killed_process_leaves_what_was_flushed(tmp_path, read_here):
    code = f"""
import os, signal, sys
import numpy as np
sys.path.insert(0, {str(tmp_path)!r})
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
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (2000, 3))), [tv.Gravity()], substeps=1)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))  # bytes in a file, as if the disk were full
    try:
        with pytest.raises(OSError, match="writing .*full.rrd failed at frame [0-9]+ .File too large.*can be replayed"):
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
    assert recording.verify().kind == "incomplete" and recording.verify().frames > 3
    with pytest.raises(OSError, match="nothing could be written to /dev/full .No space left"):
        tv.Recorder("/dev/full", w)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with pytest.raises(OSError, match="nothing could be written"):
            tv.Recorder(tmp_path / "none.rrd", w)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not (tmp_path / "none.rrd").exists() and not w._watchers
    with pytest.raises(IsADirectoryError, match="cannot be written"):
        tv.Recorder(tmp_path, w)


@pytest.mark.parametrize("name", ["film.mp4", "a.csv", "run.1"])
def test_recordings_have_their_own_ending(world, tmp_path, name):
    # Else the .rrd file that a film's name stands for is opened by no player, and by no viewer.
    w, path = world(tv.Particles(np.eye(2)), [tv.Gravity(1.0)]), tmp_path / name
    for attempt in (lambda: w.run(0.1, recorder=path), lambda: tv.Recorder(path, w, overwrite=True)):
        with pytest.raises(ValueError, match=f"{name} ends in .* Write '.*{name.partition('.')[0]}.rrd'; of that, tv.replay"):
            attempt()
    assert w.time == 0 and not [*tmp_path.iterdir()]
    assert main(["run", "hello", "--out", str(path)]) == 2


def test_the_advice_for_who_pickles_a_world_works(world, tmp_path, monkeypatch, read_here):
    w = world(tv.Particles(np.eye(2), velocity=(0.1, 0.2)), [tv.Gravity(1.0)])
    w.run(0.1)
    with pytest.raises(TypeError, match="cannot be copied or pickled") as said:
        pickle.dumps(w)
    monkeypatch.chdir(tmp_path)
    write, read = re.findall(r"\w+\.\w+\(\"world.rrd\"\)", str(said.value))
    eval(write, {"tv": tv, "world": w})
    with eval(read, {"tv": tv}) as again:
        assert again.hash() == w.hash() and again.time == w.time


def test_nothing_is_overwritten_unasked(falling, world, tmp_path, read_here):
    w = world(tv.Particles(np.eye(2)), [tv.Gravity(1.0)])
    path, other = tmp_path / "a.rrd", tmp_path / "thesis.rrd"
    path.write_bytes(falling.read_bytes())
    other.write_text("years of work")
    for target, what in ((path, "a.rrd exists. Choose"), (other, "thesis.rrd exists, and is no recording. Choose")):
        with pytest.raises(FileExistsError, match=f"{what} another name, or replace it: .*overwrite=True"):
            tv.Recorder(target, w)
    with tv.replay(path).world(20) as again, pytest.raises(FileExistsError):
        tv.Recorder(path, again)
    with tv.Recorder(tmp_path / "b.rrd", w) as first:
        with pytest.raises(FileExistsError):
            tv.Recorder(tmp_path / "b.rrd", w)
        w.step(0.1)
        first.log()
    assert len(tv.replay(tmp_path / "b.rrd").frames) == 2
    assert path.read_bytes() == falling.read_bytes() and other.read_text() == "years of work"
    with pytest.raises(ValueError, match="Give at least"):
        tv.Recorder(path, w, budget=1000, overwrite=True)
    assert path.read_bytes() == falling.read_bytes()  # the file is replaced only when there is something to replace it
    assert main(["run", "hello", "--out", str(other)]) == 2 and other.read_text() == "years of work"
    with tv.Recorder(path, w, overwrite=True):
        assert not tv.replay(path).complete
        assert list(tv.replay(path).frames) == [0]
    assert tv.replay(path).complete and not w._watchers
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.rrd", "b.rrd", "thesis.rrd"]


@pytest.mark.parametrize("how", ["removed", "replaced"])
def test_a_file_that_is_gone_is_noticed(world, tmp_path, monkeypatch, how):
    w = world(tv.Particles(np.eye(2)), [tv.Gravity(1.0)])
    monkeypatch.setattr(recorder, "CHECK_INTERVAL", 0.0)
    recording = tv.Recorder(tmp_path / "a.rrd", w)
    recording.log()
    if how == "removed":
        (tmp_path / "a.rrd").unlink()
        with pytest.raises(FileNotFoundError, match="at frame 2 .the file was removed or replaced.. What was recorded is lost"):
            recording.log()
    else:
        with tv.Recorder(tmp_path / "a.rrd", w, overwrite=True):
            with pytest.raises(FileNotFoundError, match="removed or replaced"):
                recording.close()
        assert tv.replay(tmp_path / "a.rrd").complete
    assert not w._watchers


@pytest.mark.slow
def test_what_ends_other_programs_is_an_error(tmp_path):
    # Without HOME Taichi ends the process; in a forked child it hangs at the end; ti.reset destroys the fields.
    code = f"""
import os, sys
assert "HOME" not in os.environ
import tiverlet as tv
from tiverlet.device import ti
world = tv.World(tv.Particles([[0.0, 0.0]]), [tv.Gravity()])
recorder = tv.Recorder({str(tmp_path / "f.rrd")!r}, world)
pid = os.fork()
if pid == 0:
    for call in (recorder.log, recorder.flush, lambda: world.step(0.1), lambda: tv.Recorder("b.rrd", world)):
        try:
            call()
        except RuntimeError as e:
            assert "fork" in str(e), e
        else:
            raise AssertionError(call)
    recorder.close()
    sys.exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 7
world.step(0.1)
recorder.log()
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
    assert list(tv.replay(tmp_path / "f.rrd").frames) == [0, 1]


@pytest.mark.slow
def test_a_budget_is_kept_and_said(world, tmp_path, read_here):
    w = world(tv.Particles(np.random.default_rng(0).uniform(0, 1, (500, 2))), [tv.Gravity()], substeps=1)
    with pytest.raises(ValueError, match="Give at least"):
        tv.Recorder(tmp_path / "a.rrd", w, budget=1000)
    assert not (tmp_path / "a.rrd").exists()
    sizes = []
    with pytest.warns(UserWarning, match=r"budget = 500000 bytes, the picture has one of [48] frames. All steps are in the file"):
        with tv.Recorder(tmp_path / "b.rrd", w, budget=500_000) as recording:
            for _ in range(400):
                w.step(1 / 60)
                recording.log()
                sizes.append((tmp_path / "b.rrd").stat().st_size)
    assert max(sizes) < 500_000 and (tmp_path / "b.rrd").stat().st_size < 500_000
    recording = tv.replay(tmp_path / "b.rrd")  # the whole run is in the file
    assert {*range(0, 401, 8)} <= {*recording.frames.tolist()} and len(recording.frames) < 110
    assert recording.verify() and recording.complete
    frames, values = recording.curves["energy"]
    assert {*range(8, 401, 8)} <= {*frames.tolist()} and len(frames) < 110 and np.isfinite(values).all()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.rrd"]
    whole = (tmp_path / "b.rrd").read_bytes()  # the file was rewritten; a part of it reads like a part of any other file
    for share in (0.25, 0.5, 0.8, 0.999):
        (tmp_path / "cut.rrd").write_bytes(whole[: int(share * len(whole))])
        part = tv.replay(tmp_path / "cut.rrd")
        assert not part.complete and "the file is cut short" in part.text and len(part.frames) <= len(recording.frames)
    assert part.verify().kind == "incomplete" and part.verify().frames == len(part.frames)

    # The file also holds what the user does in each step. Where not even that fits, the recording ends, with a warning.
    gravity = w.features[0]
    with pytest.warns(UserWarning, match="do not fit in it after frame [0-9]+, where the recording ends"):
        with tv.Recorder(tmp_path / "c.rrd", w, budget=240_000) as recording:
            for k in range(1500):
                gravity.g = 9.0 + 0.001 * k
                w.step(1 / 60)
                recording.log()
    assert (tmp_path / "c.rrd").stat().st_size < 240_000
    recording = tv.replay(tmp_path / "c.rrd")
    assert recording.complete and recording.verify() and 50 < recording.frames[-1] < 1500


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_frames_are_taken_out_so_that_the_rest_shows_the_same(stride):
    # A viewer shows the last row up to a frame: for frames that are kept, the same row before and after.
    for frames in ([], [0], list(range(41)), [0, 3, 5, 6, 17], [7], [0, 8, 9, 16, 39, 40]):
        gone = messages.droppable(np.array(frames, dtype=np.int64), stride)
        rest = [frame for frame, drop in zip(frames, gone, strict=True) if not drop]
        for kept in range(0, 41, stride):
            seen = [max([k for k in rows if k <= kept], default=None) for rows in (frames, rest)]
            assert seen[0] == seen[1]
        assert len(rest) <= 40 // stride + 3 or len(frames) < 10


@pytest.mark.slow
def test_command_line(falling, tmp_path, monkeypatch, capsys, read_here):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.rrd"
    path.write_bytes(falling.read_bytes())
    assert main(["replay", str(path), "--verify"]) == 0 and "all 11 frames come out" in capsys.readouterr().out
    anew = f"from tiverlet.__main__ import main\nraise SystemExit(main(['replay', {str(path)!r}, '--verify']))"
    assert "all 11 frames come out" in python(anew).stdout  # in a process in which Taichi does not run yet
    wrong = rewrite(falling, tmp_path / "b.rrd", lambda text: text.replace('"g": 5.0', '"g": 5.5'))
    assert main(["replay", str(wrong), "--verify"]) == 1 and "first particle 0" in capsys.readouterr().out
    assert main(["replay", str(path), "--export", "csv"]) == 0 and (tmp_path / "a.csv").exists()
    assert main(["replay", "none.rrd"]) == 2 and "none.rrd" in capsys.readouterr().err

    # A script that records nothing itself, and whose function has to be given to verify().
    (tmp_path / "mine.py").write_text("""
import sys
from tiverlet.device import ti
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
    step = tv.World.step
    assert main(["run", "mine.py", "5", "--out", "mine.rrd"]) == 3
    assert "6 frames (0 ... 5)" in capsys.readouterr().out and tv.World.step is step
    assert main(["replay", "mine.rrd", "--verify"]) == 2 and "given=[swing]" in capsys.readouterr().err
    assert main(["replay", "mine.rrd", "--verify", "--given", "mine.py"]) == 0
    assert main(["run", "nobody"]) == 2 and "no demo of that name" in capsys.readouterr().err

    # Errors of a script have their traceback; it finds the modules beside it. What was recorded before is kept.
    (tmp_path / "beside.py").write_text("steps = 2")
    (tmp_path / "fails.py").write_text("""
import beside
import tiverlet as tv

with tv.World(tv.Particles([[0.0, 1.0]]), substeps=2) as world:
    for _ in range(beside.steps):
        world.step(1 / 60)
    float("x")
""")
    assert main(["run", "fails.py"]) == 1
    told = capsys.readouterr()
    assert "fails.rrd: 3 frames" in told.out and 'line 8, in <module>\n    float("x")' in told.err and "runpy" not in told.err
    for words in (["play", "fails.py"], ["replay", "mine.rrd", "--verify", "--given", "fails.py"]):
        with pytest.raises(SystemExit) as end:
            main(words)
        assert end.value.code == 1 and "could not convert" in capsys.readouterr().err
    for number in ("-1", "65536", "x"):
        with pytest.raises(SystemExit) as end:
            main(["play", "fails.py", "--port", number])
        assert end.value.code == 2 and "is no number from 0 to 65535" in capsys.readouterr().err
    assert main(["run", "fails.py", "--out", "none/a.rrd"]) == 2 and "The folder of none/a.rrd" in capsys.readouterr().err


@pytest.mark.parametrize("frames", [0, 3])
def test_a_world_without_particles_is_recorded(tmp_path, frames):
    # Entries of an empty world's journal may have no bytes at all.
    world = tv.World(tv.Particles(np.zeros((0, 3))), [tv.Gravity()])
    with tv.Recorder(tmp_path / "a.rrd", world) as recorder:
        for _ in range(frames):
            world.step(1 / 60)
            recorder.log()
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify() and len(recording.frames) == frames + 1 and recording.position(0).shape == (0, 3)


def test_names_and_frames_of_pictures(falling, tmp_path, monkeypatch):
    taken = []
    monkeypatch.setattr(viewer, "launch", lambda *words, **options: subprocess.Popen(["true"], start_new_session=True))
    monkeypatch.setattr(viewer, "_save_when_steady", lambda process, port, frame, name, view: taken.append((frame, name)))
    assert viewer.picture(str(falling), str(tmp_path / "100%.png")) == [str(tmp_path / "100%.png")] and taken[0][0] == 20
    viewer.picture(str(falling), str(tmp_path / "50%_%03d.png"), [0, 4])
    assert [pathlib.Path(name).name for _, name in taken[1:]] == ["50%_000.png", "50%_004.png"]
    with pytest.raises(ValueError, match="no frame 5; the nearest is"):
        viewer.picture(str(falling), str(tmp_path / "a.png"), [5])
    with pytest.raises(ValueError, match="need a name with %d"):
        viewer.picture(str(falling), str(tmp_path / "a.png"), [2, 4])


def test_a_picture_that_is_told_to_end_ends_its_viewer(falling, tmp_path, monkeypatch):
    started = []

    def start(*words, **options):
        started.append(subprocess.Popen(["sleep", "60"], start_new_session=True))
        return started[0]

    monkeypatch.setattr(viewer, "launch", start)
    monkeypatch.setattr(viewer, "_save_when_steady", lambda *words: os.kill(os.getpid(), signal.SIGTERM))
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end:
        viewer.picture(str(falling), str(tmp_path / "a.png"))
    assert end.value.code == 128 + signal.SIGTERM and started[0].poll() is not None
    assert signal.getsignal(signal.SIGTERM) is before


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


def balls(world, x):
    """Return a world of balls on a gate, and the gate."""
    gate = tv.HalfSpace((0, 1), active=True)
    return world(tv.Particles(x, radius=0.1), [tv.Gravity(9.81), gate, tv.Contact(friction=0.5)], precision="f64"), gate


@pytest.mark.slow
def test_what_is_removed_from_a_pile_that_moves_is_recorded(world, tmp_path, read_here):
    # Contacts of a removed particle leave their part in the velocities of the others, in an array of the clock, until the next
    # step.
    w, _ = balls(world, [(0, 0.1), (0.3, 0.1), (0.25, 0.3)])
    with tv.Recorder(tmp_path / "removed.rrd", w) as recorder:
        for frame in range(6):
            if frame == 4:
                w.remove([0])
            w.step(1 / 60)
            recorder.log()
    assert tv.replay(tmp_path / "removed.rrd").verify()


@pytest.mark.slow
def test_two_edits_between_two_frames_leave_walls_and_frames_in_the_picture(world, tmp_path, read_here):
    # An outlet removes after log(), and an inlet adds before the next step: a scene ends before a frame of it was drawn. The next
    # scene has walls from its first frame on, and no later frame begins another.
    w, _ = balls(world, [(0, 0.1)])
    with tv.Recorder(tmp_path / "edits.rrd", w) as recorder:
        for frame in range(1, 7):
            if frame in (2, 3):
                w.add(tv.Particles([(0.3 * frame, 0.5)], radius=0.1))
            w.step(1 / 60)
            recorder.log()
            if frame == 2:
                w.remove([1])
    recording = tv.replay(tmp_path / "edits.rrd")
    assert recording.frames.tolist() == list(range(7)) and recording.verify()
    contents = rrd.read(str(tmp_path / "edits.rrd"), rows=True)
    rows = [(contents.entities[number], frame) for _, _, number, frame, *_ in contents.rows.tolist()]
    walls = sorted((frame, entity) for entity, frame in rows if "/walls/" in entity)
    assert walls == [(0, "world/scene/walls/1"), (2, "world/scene/scene1/walls/1"), (3, "world/scene/scene3/walls/1")]


@pytest.mark.slow
@pytest.mark.parametrize("rebuilt", [False, True])
def test_edits_of_a_world_whose_gate_was_just_opened_are_recorded(world, tmp_path, read_here, rebuilt):
    # The balls lie at rest on the gate and fall from it by g t^2 / 2: in f64 to rounding, whatever is added or removed at once.
    w, gate = balls(world, [(0, 0.1), (0.3, 0.1), (0.6, 0.1)])
    with tv.Recorder(tmp_path / "gate.rrd", w) as recorder:
        for frame in range(12):
            if frame == 3:
                gate.active = False
                w.remove([2])
                if rebuilt:
                    w.add(features=[tv.HalfSpace((0, 1), -9.0)])
            w.step(1 / 60)
            recorder.log()
    np.testing.assert_allclose(w.position[:, 1], 0.1 - 9.81 * (9 / 60) ** 2 / 2, rtol=0, atol=1e-12)
    assert tv.replay(tmp_path / "gate.rrd").verify()


@pytest.mark.slow
def test_a_recording_begins_while_a_knob_asks_for_other_kernels(world, tmp_path, read_here):
    start = tv.Particles([(0, 0.1), (0.19, 0.1), (0.5, 0.1)], radius=0.1, velocity=(1.0, 0.0))
    contact, link = tv.Contact(), tv.Distance([[1, 2]])
    w = world(start, [tv.Gravity(), contact, link], solver=tv.Jacobi())
    w.step(1 / 60)
    contact.friction, link.compliance = 0.3, 1e-3
    with tv.Recorder(tmp_path / "knob.rrd", w) as recorder:
        w.step(1 / 60)
        recorder.log()
        contact.friction = link.compliance = 0.0
        w.step(1 / 60)
        recorder.log()
    # Kernels keep what knobs do not ask for. This shows in bits and in the state's fields: of a world that continues from a
    # recording, of a recording that begins only then, and of a clone.
    clone, again = w.clone(), tv.replay(tmp_path / "knob.rrd")
    assert again.verify() and again.world(2).hash() == w.hash()
    with tv.Recorder(tmp_path / "off.rrd", w) as recorder:
        w.run(0.1, recorder=recorder)
    again, end = tv.replay(tmp_path / "off.rrd"), w.hash()
    assert again.verify() and again.world(int(again.frames[-1])).hash() == end
    clone.run(0.1)
    assert clone.hash() == end
    # A new world has only what the knobs of the same features ask for.
    w.close()
    world(start, w.features, solver=tv.Jacobi()).step(1 / 60)
    assert not (contact.has_friction or link.soft)
