"""Forged recordings: verify() names whatever the viewer would show differently, though all checksums are valid."""

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
from tiverlet.features import material
from tiverlet.recording import reader, viewer

from .forging import FORGERIES, PLACES, Forgery, packed, record


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return record(tmp_path_factory.mktemp("forged") / "a.rrd")


@pytest.fixture
def quick(read_here, built_once):
    """Read in this process and compile a scene once; these tests check neither."""


@pytest.mark.slow
def test_forgeries_are_named(original, quick, tmp_path):
    assert tv.replay(Forgery(original).save(tmp_path / "b.rrd")).verify()
    passed = {}
    for name in FORGERIES:
        forged = Forgery(original)
        FORGERIES[name](forged, PLACES)
        try:
            verdict = tv.replay(forged.save(tmp_path / "b.rrd")).verify()
        except ValueError as e:
            assert str(e).startswith("replay: "), (name, e)
            continue
        if verdict.kind != ("incomplete" if name == "no end" else "changed"):
            passed[name] = verdict
    assert not passed


@pytest.mark.slow
def test_what_is_damaged_is_never_intact(original, quick, tmp_path):
    # One byte of the file is changed, or the file is cut short, at random places; and its end record is missing.
    rng, whole, path = np.random.default_rng(0), original.read_bytes(), tmp_path / "b.rrd"
    for k, at in enumerate(rng.integers(0, len(whole), 20)):
        changed = bytearray(whole)
        changed[at] ^= int(rng.integers(1, 256))
        path.write_bytes(changed if k % 4 else whole[:at])
        try:
            recording = tv.replay(path)
            assert not recording.complete or not recording.verify(), (k, at)
        except ValueError as e:
            assert "replay: " in str(e), (k, at)
    open_ended = tv.replay(Forgery(original).save(tmp_path / "c.rrd", seal=False)).verify()
    assert open_ended.kind == "incomplete" and open_ended.frames == open_ended.of


def test_a_file_calls_nothing_in_a_script(original, tmp_path, monkeypatch, capsys):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "mine.py").write_text("from pathlib import Path\nfrom subprocess import run\n")

    def chosen(name, arguments):
        def change(e):
            if e["kind"] == "scene":
                e["data"]["needs"] = {name: ""}
                e["data"]["features"][0].update({"class": {"given": name}, "arguments": arguments})
            return e

        return Forgery(original).journal(change).save(tmp_path / "a.rrd")

    def argument(e):
        if e["kind"] == "scene":
            e["data"]["needs"] = {"run": ""}
            e["data"]["features"][0]["arguments"]["acceleration"] = {"given": "run"}
        return e

    monkeypatch.chdir(tmp_path)
    chosen("run", {"args": ["rm", str(victim)]})
    assert (
        main(["replay", "a.rrd", "--verify", "--given", "mine.py"]) == 2
        and "only functions with @ti.func" in capsys.readouterr().err
    )
    for function in (subprocess.run, os.remove):
        path = chosen(function.__name__, {"args": ["rm", str(victim)]})
        with pytest.raises(ValueError, match="no feature of this version"):
            tv.replay(path, [function]).world(0)
    with pytest.raises(ValueError, match="takes no function"):
        tv.replay(Forgery(original).journal(argument).save(tmp_path / "b.rrd"), [subprocess.run]).verify()
    assert victim.read_text() == "precious"


@pytest.mark.slow
def test_what_a_file_asks_for_is_bounded(original, tmp_path):
    def told(change):
        def entry(e):
            change(e)
            return e

        return Forgery(original).journal(entry).save(tmp_path / "a.rrd")

    def shape(e):
        if e["arrays"]:
            e["arrays"][0][2] = [10**9, 10]

    def count(e):
        if e["kind"] == "assigned" or e["kind"] == "turned":
            e.update(kind="assigned", data={"name": "_runner"}, arrays=[])

    for change in (shape, count, lambda e: e.update(steps=[[1 / 60, "auto", 1, 1]]), lambda e: e.update(frame=[[[]]])):
        with pytest.raises(ValueError, match="^replay: |^The state|shape"):
            tv.replay(told(change)).verify()

    # Rows that claim to unpack to 70 GB, and more data than is allowed.
    forged = Forgery(original)
    _, fields, _ = forged.messages[forged.chunks("world/scene/particles")[0]]
    out = reader.ResultFile(os.open(os.devnull, os.O_WRONLY), 1000)
    taker = reader.Reader(out, False)
    taker.stores.append(reader.store_of(fields[1]))
    with pytest.raises(reader.Damaged, match="unpack to"):
        taker.chunk(packed({**fields, 2: 2, 3: 1 << 36, 5: b"x" * 5000}))
    with pytest.raises(reader.Damaged, match="MB"):
        out.put(b"x" * 1001)
    out.close()

    # A table with an entry per pair of groups, with as many groups as particles.
    n = 20_000
    table = material.Table("Contact", {(0, 1): 0.3}, 0.0, None).rows(np.arange(n))[1]
    assert len(table) == 9
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


def test_names_of_a_file_do_not_leave_the_folder(original, quick, tmp_path):
    forged = Forgery(original)
    forged.copy(*_first(forged, "figures/energy"), entity="figures/../../../stray")
    with pytest.raises(ValueError, match="a curve with the name '../../../stray'"):
        tv.replay(forged.save(tmp_path / "a.rrd")).export(str(tmp_path / "a.npz"))


def _first(forged, entity):
    k, row = forged.rows(entity, "Scalars:scalars")[0]
    return k, [row]
