"""Forged recordings: whatever the viewer would show otherwise, verify() names, though all checksums are right."""

import json
import os
import tempfile

import pytest

import tiverlet as tv
from tiverlet.recording import reader, rrd, scene

from . import recordings_campaign
from .forging import FORGERIES, Forgery

PLACES = recordings_campaign.PLACES


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    return recordings_campaign.record(tmp_path_factory.mktemp("forged") / "a.rrd")


@pytest.fixture
def quick(monkeypatch):
    """Read in this process, and compile a scene only once: what is looked at here is neither."""
    worlds = {}

    def read(path, rows=False):
        with open(path, "rb") as file, tempfile.TemporaryFile() as out:
            found = reader.read(file, os.dup(out.fileno()), rows, limited=False)
            out.seek(0)
            return rrd.Contents(json.loads(json.dumps(found)), out.read())

    def rebuild(data, arrays, given, turned):
        key = json.dumps([data["particles"], data["features"], data["settings"]])
        if key not in worlds:
            worlds[key] = made(data, arrays, given, turned)
            worlds[key].__dict__["close"] = lambda: None
        for feature, told in zip(worlds[key].features, data["features"], strict=True):
            scene.turn(feature, {name: scene.decode(value, arrays) for name, value in told["knobs"].items()})
        return worlds[key]

    made = scene.rebuild
    monkeypatch.setattr(rrd, "read", read)
    monkeypatch.setattr(scene, "rebuild", rebuild)
    yield
    for world in worlds.values():
        del world.__dict__["close"]
        world.close()


def test_forgeries_are_named(original, quick, tmp_path):
    assert tv.replay(original).verify()
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


def test_what_was_not_forged_is_intact(original, quick, tmp_path):
    assert tv.replay(Forgery(original).save(tmp_path / "b.rrd")).verify()
    open_ended = tv.replay(Forgery(original).save(tmp_path / "c.rrd", seal=False)).verify()
    assert open_ended.kind == "incomplete" and open_ended.frames == open_ended.of
