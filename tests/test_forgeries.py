"""Forged and damaged recordings: replay() or verify() names what differs, and a file does nothing but show its scene."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.device import ti
from tiverlet.device.language import NAME, NAMES
from tiverlet.features import material
from tiverlet.recording import journal, messages, reader, viewer

from .forging import FORGERIES, PARTICLES, Forgery, pictures, record


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return record(tmp_path_factory.mktemp("forged") / "a.rrd")


@pytest.fixture
def quick(read_here, built_once):
    """Read in this process and compile a scene once; these tests check neither."""


@pytest.fixture
def rewritten(original, tmp_path):
    """Return a function that saves the recording with journal entries changed by change(entry)."""

    def rewrite(change, seal=True):
        def entry(e):
            change(e)
            return e

        return Forgery(original).journal(entry, seal).save(tmp_path / "a.rrd")

    return rewrite


@pytest.mark.slow
def test_every_forged_recording_is_found(original, quick, tmp_path):
    def told(name):
        FORGERIES[name](forged := Forgery(original))
        return name, forged

    assert tv.replay(Forgery(original).save(tmp_path / "b.rrd")).verify()
    passed, count = {}, 0
    for name, forged in (*map(told, FORGERIES), *pictures(original)):
        count += 1
        try:
            verdict = tv.replay(forged.save(tmp_path / "b.rrd")).verify()
        except ValueError as e:
            assert str(e).startswith("replay: "), (name, e)
            continue
        if verdict.kind != ("incomplete" if name == "no end" else "changed"):
            passed[name] = verdict
    assert not passed and count > 90


@pytest.mark.slow
def test_the_place_of_a_change_is_named(original, rewritten, quick, tmp_path):
    def turned(e, g=5.5):
        if e["kind"] == "turned" and "0" in e["data"]["features"]:
            e["data"]["features"]["0"]["g"] = g

    with pytest.raises(ValueError, match="changed after it was recorded: entry [0-9]+, 'turned' of frame 4"):
        tv.replay(rewritten(turned, seal=False))
    verdict = tv.replay(path := rewritten(turned)).verify()
    assert not verdict and (verdict.frame, verdict.particle) == (5, 1) and "first particle 1" in str(verdict)
    assert main(["replay", str(path), "--verify"]) == 1
    # One changed coordinate of the picture.
    forged = Forgery(original)
    k, row = forged.rows(PARTICLES, "Points2D:positions")[4]
    x = forged.messages[k][2].column("Points2D:positions").to_pylist()
    x[row][1][0] = np.nextafter(np.float32(x[row][1][0]), np.float32(9))
    forged.set(k, Points2D__positions=x)
    recording = tv.replay(forged.save(tmp_path / "a.rrd"))
    with pytest.raises(ValueError, match="picture of frame 4"):
        recording.position(4)
    verdict = recording.verify()
    assert (verdict.kind, verdict.frame, verdict.particle) == ("changed", 4, 1) and "picture" in str(verdict)


@pytest.mark.slow
def test_recordings_of_other_versions_are_named(rewritten, read_here):
    def replaced(old, new, more=lambda e: None):
        def change(e):
            e.update(json.loads(json.dumps(e).replace(old, new)))
            more(e)

        return change

    with pytest.raises(ValueError, match=f"is in format 99, of tiverlet .* reads format {journal.FORMAT}"):
        tv.replay(rewritten(replaced(f'"format": {journal.FORMAT}', '"format": 99')))
    other = next(name for name in NAMES.values() if name != NAME)
    recording = tv.replay(rewritten(replaced(f'"compiler": "{NAME} ', f'"compiler": "{other} ')))
    with pytest.raises(RuntimeError, match=f"recorded with {other}, and {NAME} runs here.*TIVERLET_COMPILER={other.lower()}"):
        recording.verify()
    assert f"{other} " in recording.text and len(recording.position(6)) == 6
    minor = ".".join(map(str, ti.__version__[1:]))
    with pytest.raises(RuntimeError, match=f"frame 5 .* not as it was: taichi 0.{minor} then, 1.{minor} now"):
        change = replaced('"taichi": "1', '"taichi": "0', lambda e: e["kind"] == "turned" and e["data"]["features"].clear())
        tv.replay(rewritten(change)).world(6)


@pytest.mark.slow
def test_what_is_cut_short_says_where_it_ends(quick, tmp_path, monkeypatch):
    monkeypatch.setattr("tiverlet.recording.sink.SMALL", 0)  # many messages, as in a long recording
    original = record(tmp_path / "a.rrd")
    whole, path = original.read_bytes(), tmp_path / "b.rrd"
    at = messages.HEADER + messages.HEAD.size - 1  # in the length of the first message
    flipped = whole[:at] + b"\x7f" + whole[at + 1 :]
    for data, words in (
        (b"some text", "not an .rrd file"), (whole[:200], "before anything"), (flipped, "or damaged, .*, or a length is wrong"),
    ):  # fmt: skip
        path.write_bytes(data)
        with pytest.raises(ValueError, match=words):
            tv.replay(path)
    with pytest.raises(FileNotFoundError):
        tv.replay(tmp_path / "none.rrd")

    # Cut in the middle of every message: everything before it is read, and the text says where that ends.
    sizes = [messages.HEAD.size + len(message) for kind, message in messages.split(whole) if kind]
    ends, seen = (messages.HEADER + np.cumsum(sizes)).tolist(), set()
    for end in ends:
        path.write_bytes(whole[: end - 5])
        try:
            part = tv.replay(path)
        except ValueError as e:
            assert "before anything that can be replayed: the file is cut short" in str(e) and not seen
            continue
        seen.add(len(part.frames))
        assert not part.complete and "not complete (the file is cut short" in part.text
    assert len(seen) > 3 and max(seen) == 7
    verdict = part.verify()
    assert not verdict and (verdict.kind, verdict.frames) == ("incomplete", 7) and "the first 7 frames hold" in str(verdict)

    # A missing entry of the journal; a wrong length; no end record.
    forged = Forgery(original)
    forged.only(forged.chunks(journal.JOURNAL)[3], [])
    missing = tv.replay(forged.save(path)).verify()
    assert missing.kind == "incomplete" and 0 < missing.frames < 7 and missing.of >= 6
    assert f"the first {missing.frames} of {missing.of} frames hold" in str(missing)
    at = ends[len(ends) // 2]
    path.write_bytes(whole[:at] + messages.HEAD.pack(2, 1 << 60) + whole[at + 16 :])
    wrong = tv.replay(path)
    assert not wrong.complete and "a length is wrong" in wrong.text and wrong.verify().kind == "incomplete"
    verdict = tv.replay(Forgery(original).save(path, seal=False)).verify()
    assert verdict.kind == "incomplete" and verdict.frames == verdict.of
    # One byte is changed, or the file is cut short, at random places.
    rng = np.random.default_rng(0)
    for k, at in enumerate(rng.integers(0, len(whole), 20)):
        changed = bytearray(whole)
        changed[at] ^= int(rng.integers(1, 256))
        path.write_bytes(changed if k % 4 else whole[:at])
        try:
            recording = tv.replay(path)
            assert not recording.complete or not recording.verify(), (k, at)
        except ValueError as e:
            assert "replay: " in str(e), (k, at)


def test_a_file_calls_nothing_in_a_script_and_leaves_no_folder(original, rewritten, quick, tmp_path, monkeypatch, capsys):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "mine.py").write_text("from pathlib import Path\nfrom subprocess import run\n")

    def chosen(name):
        def change(e):
            if e["kind"] == "scene":
                e["data"]["needs"] = {name: ""}
                e["data"]["features"][0].update({"class": {"given": name}, "arguments": {"args": ["rm", str(victim)]}})

        return rewritten(change)

    def argument(e):
        if e["kind"] == "scene":
            e["data"]["needs"] = {"run": ""}
            e["data"]["features"][0]["arguments"]["acceleration"] = {"given": "run"}

    monkeypatch.chdir(tmp_path)
    chosen("run")
    assert main(["replay", "a.rrd", "--verify", "--given", "mine.py"]) == 2
    assert "only functions with @ti.func" in capsys.readouterr().err
    for function in (subprocess.run, os.remove):
        with pytest.raises(ValueError, match="no feature of this version"):
            tv.replay(chosen(function.__name__), [function]).world(0)
    with pytest.raises(ValueError, match="takes no function"):
        tv.replay(rewritten(argument), [subprocess.run]).verify()
    assert victim.read_text() == "precious"
    forged = Forgery(original)
    k, row = forged.rows("figures/energy", "Scalars:scalars")[0]
    forged.copy(k, [row], entity="figures/../../../stray")
    with pytest.raises(ValueError, match="a curve with the name '../../../stray'"):
        tv.replay(forged.save(tmp_path / "b.rrd")).export(str(tmp_path / "a.npz"))


def test_the_memory_that_a_file_asks_for_is_bounded(original, rewritten, quick):
    def shape(e):
        if e["arrays"]:
            e["arrays"][0][2] = [10**9, 10]

    def count(e):
        if e["kind"] == "assigned" or e["kind"] == "turned":
            e.update(kind="assigned", data={"name": "_runner"}, arrays=[])

    for change in (shape, count, lambda e: e.update(steps=[[1 / 60, "auto", 1, 0, 1]]), lambda e: e.update(frame=[[[]]])):
        with pytest.raises(ValueError, match="^replay: |^The state|shape"):
            tv.replay(rewritten(change)).verify()

    # Rows that claim to unpack to 70 GB, and more data than is allowed.
    forged = Forgery(original)
    message = forged.messages[forged.chunks("world/scene/particles")[0]][1]
    fields, key = reader.record(message, messages.FIELDS), bytes([messages.SIZE << 3])
    out = reader.ResultFile(os.open(os.devnull, os.O_WRONLY), 1000)
    taker = reader.Reader(out, False)
    taker.stores.append(reader.store_of(fields[1]))
    with pytest.raises(reader.Damaged, match="unpack to"):
        taker.chunk(message.replace(key + messages._varint(fields[messages.SIZE]), key + messages._varint(1 << 36), 1))
    with pytest.raises(reader.Damaged, match="MB"):
        out.put(b"x" * 1001)
    out.close()

    # A table with an entry per pair of groups, with as many groups as particles.
    n = 20_000
    assert len(material.Table("Contact", {(0, 1): 0.3}, 0.0, None).rows(np.arange(n))[1]) == 9
    with pytest.raises(ValueError, match="groups of particles"):
        material.Table("Contact", {(k, k): 0.3 for k in range(n)}, 0.0, None).rows(np.arange(n))


@pytest.mark.slow
def test_the_page_for_browsers_talks_to_this_machine_only_and_ends_when_told(original):
    port = viewer.free_port()
    words = [sys.executable, "-m", "tiverlet", "replay", str(original), "--web", "--port", str(port)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    try:
        process.stdout.readline()
        data = int(re.findall("3A([0-9]+)%2Fproxy", process.stdout.readline())[0])
        for _ in range(100):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as answer:
                    policy = answer.headers["Content-Security-Policy"]
                    assert b"<html" in answer.read().lower()
                break
            except OSError:
                time.sleep(0.2)
        assert set(re.findall("https?://[^ ;]*", policy)) == {f"http://127.0.0.1:{data}"} and "default-src 'self'" in policy
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{port}/", headers={"Host": f"evil.example:{port}"}))
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(20)
        process.stdout.close()
    assert process.returncode == 128 + signal.SIGTERM
    assert not [p for p in os.listdir("/proc") if p.isdigit() and str(original).encode() in _command(p)]


def _command(number):
    try:
        with open(f"/proc/{number}/cmdline", "rb") as file:
            return file.read()
    except OSError:
        return b""
