"""The report on speed: its figures are consistent. No test here checks how fast anything is."""

import contextlib
import io
import json
import pathlib
import types
from dataclasses import replace

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.__main__ import main
from tiverlet.device import ti
from tiverlet.report import speed
from tiverlet.report.speed import (
    SCENES,
    SpeedReport,
    c_baseline,
    child,
    counting,
    measure,
    peers,
    processes,
    scenes,
    stripped,
    waits,
    worlds,
)

from .conftest import python


@pytest.fixture(scope="module")
def kept(taichi):
    """Return a folder for what child processes compile, beside the cache of the tests: a second run compiles nothing again."""
    return pathlib.Path(ti.cfg.offline_cache_file_path, "speed")


class Forked:
    """A process that gets one question and gives one answer, forked from one that has imported tiverlet.

    The same question returns the first answer again, as where nothing is left to compile: only seconds would differ.
    """

    answers: dict[str, str] = {}

    def __init__(self, code, job, cache):
        keeps = {"TI_OFFLINE_CACHE": "1", "TI_OFFLINE_CACHE_FILE_PATH": cache}
        before = f"import os, sys, warnings\nwarnings.simplefilter('default')\nos.environ.update({keeps})"
        # ti.reset() stores compiled kernels; a forked process does not at its end
        after = "from tiverlet.device import ti\nti.reset()"
        self.code = f"{before}\nsys.argv[1:] = [{json.dumps(job)!r}]\n{code}\n{after}\n"

    def said(self):
        if self.code not in self.answers:
            self.answers[self.code] = python(self.code).stdout
        return self.answers[self.code]

    def ask(self):
        return json.loads(self.said())

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass


@pytest.fixture(scope="module")
def forked(process):
    """Start a new interpreter only for the scene, which gets many questions: each import takes a second of CPU time."""
    with pytest.MonkeyPatch.context() as patch:
        made = processes.started
        patch.setattr(processes, "started", lambda code, *job: (made if code == child.START else Forked)(code, *job))
        yield


@pytest.fixture(scope="module")
def report(kept, forked):
    """Return a quick report on one scene of one size, and on another scene by a stripped copy of the package.

    A cold start is one only where nobody compiled the same before.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measure, "BLOCK", 1 << 22)
        patch.setattr(waits, "QUICK", 2)
        patch.setattr(measure.Session, "cache", lambda session: str(kept))
        whole = speed(["pile"], sizes=[41], threads=[1], quick=True, peers=False, absent=False, waits=True)
        patch.setattr(measure.Session, "point", lambda session, name, n: [])
        rope = speed(["rope"], sizes=[41], threads=[1], quick=True, peers=False, yardstick=False, waits=False)
    return replace(whole, absent=rope.absent)


@pytest.mark.slow
def test_figures_are_positive_and_belong_together(report):
    (r,) = report.runs
    assert (r.scene, r.particles, r.threads) == ("pile", 41, 1)
    assert r.substeps == SCENES[r.scene].substeps and r.path == "fused" and not r.flags
    assert r.launches == 1
    assert r.rate * r.seconds == pytest.approx(41 * r.substeps, rel=1e-12)
    assert set(r.traffic) == set(r.times) and r.bytes == sum(r.traffic.values()) and min(r.times.values()) > 0
    assert min(r.seconds, r.rounds, r.bytes, r.memory, r.imported, r.cold, r.warm) > 0
    assert report.share(r) == pytest.approx(r.rate * r.bytes / report.copy[1])
    assert report.scaling(r) is None and report.growth(r.scene, 1) is None
    assert 0 < r.overlap < 0.05 and r.residual == 0
    assert not report.missing


def test_a_scene_of_links_has_a_residual(monkeypatch, capsys):
    # The answers of a scene's process, line by line, computed in this process.
    monkeypatch.setattr(tv, "init", lambda arch, threads: None)
    monkeypatch.setattr("sys.stdin", io.StringIO("restart\nrun 12\nquality\nlook\n"))
    child.main({"scene": "rope", "n": 41, "arch": "cpu", "threads": 1}, 0.5)
    start, restart, seconds, quality, look = map(json.loads, capsys.readouterr().out.splitlines())
    assert start["import"] == 0.5 and start["particles"] == 41 and min(start["first"], seconds) > 0 == restart
    assert 0 < quality["residual"] < 1e-4 and quality["overlap"] == 0
    assert look["launches"] == 1 and look["path"] == "fused" and not look["flags"]


@pytest.mark.slow
def test_edits_are_timed(report):
    assert {w.act for w in report.waits} == {*waits.FIRST, *waits.AIMS} and {w.particles for w in report.waits} == {400}
    assert all(w.cold >= 0 and w.warm >= 0 and w.aim == waits.AIMS.get(w.act) for w in report.waits)
    assert "take another in hand" in str(report)
    (heads, rows) = next(table[1:] for table in report.tables() if table[0].startswith("Waits"))
    assert heads[-2:] == ("pymunk", "newton") and all(row[-2:] == ("not there",) * 2 for row in rows)


@pytest.mark.parametrize("engine", [waits.pymunks, waits.newtons])
def test_edits_of_other_engines_are_timed(engine):
    pytest.importorskip(engine.__name__.removesuffix("s"))
    assert {*engine(100, 3)} <= {*waits.FIRST, *waits.AIMS}


@pytest.mark.slow
def test_pile_in_c_does_the_same(report):
    # Two schemes for one scene: ours overlaps less, since its contacts are no springs.
    pile = report.run("pile", 41, 1)
    if pile.yardstick is None:
        assert any(note.startswith("Left out: the yardstick") for note in report.notes)
        pytest.skip("no C compiler")
    assert pile.ratio == pytest.approx(pile.yardstick / pile.seconds) and pile.ratio > 0
    assert 0 < pile.overlap < 5 * pile.yardstick_overlap


def test_yardstick_starts_where_the_scene_does(tmp_path):
    # pile.c has the scene's lattice, jitter and box: nothing overlaps at first, and its source has the same numbers.
    x = scenes.pile(1000)[0].position
    assert x.min() >= 0.5 and np.ptp(x, axis=0).max() < 1.1 * 31 + 0.05
    jitter = x - 0.5 - 1.1 * np.stack([np.arange(1000) % 32, np.arange(1000) // 32], axis=1)
    assert jitter.min() >= 0 and jitter.max() < 0.05 + 1e-12 and abs(jitter.mean() - 0.025) < 1e-3
    program, how = c_baseline.build(tmp_path)
    if program is None:
        pytest.skip(how)
    with c_baseline.started(program, 1000, 8, 1) as talker:
        assert talker.ask("quality")["overlap"] == 0
        assert talker.ask("run 2") > 0


def test_yardstick_is_left_out_without_a_compiler(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    program, why = c_baseline.build(tmp_path)
    assert program is None and "no C compiler" in why
    session = measure.Session("cpu", [1], True)
    session.folder = str(tmp_path)
    session.compile()
    assert session.program is None and session.notes == [f"Left out: the yardstick pile.c, since {why}."]


@pytest.mark.slow
def test_round_trip_and_tables(report, tmp_path):
    again = SpeedReport.of_json(report.json())
    assert again == report and again.markdown() == report.markdown()
    assert json.loads(report.json())["runs"][0]["scene"] == "pile"
    text, table = str(report), report.markdown()
    for part in ("pile", "rope", "Mps/s", "warm [s]", "a count and not a measurement"):
        assert part in text and part in table
    with pytest.raises(KeyError):
        report.run("pile", 42, 1)


@pytest.mark.slow
def test_plots(report, tmp_path):
    pytest.importorskip("matplotlib")
    names = [pathlib.Path(path).name for path in report.plot(tmp_path)]
    assert names == ["speed.png", "start.png", "memory.png"] and all((tmp_path / name).stat().st_size > 5000 for name in names)


def test_bytes_are_those_of_the_fields(world):
    # Free fall in f32 and 2D, per substep: x and d (8 bytes each) are read and written, the inverse mass (4) is read if masses
    # differ; and once for all particles g (8) and the counts of each kind (4 each).
    for mass, more in ((1.0, 0), (np.arange(1.0, 301.0), 4)):
        w = world(tv.Particles(np.zeros((300, 2)), mass=mass), [tv.Gravity(9.81)], substeps=5)
        w.step(counting.DT)
        assert counting.traffic(w, 2)["integrate"][0] == 5 * (300 * (4 * 8 + more) + 8 + 4 * 6)


def test_launches_are_counted(world):
    w = world(tv.Particles([[0.0, 0], [1, 0]]), [tv.Gravity(1.0), tv.Distance([[0, 1]])], path="launched", substeps=5)
    w.step(0.01)
    with counting.launches() as count:
        w.step(0.01)
    assert count == {"integrate solve_constraints apply_corrections": 5, "measure": 1}
    w.step(0.01)
    assert count.total() == 6  # launches after the block are not counted


def test_scenes_are_sound():
    for name, scene in SCENES.items():
        for n in scene.quick:
            particles, features = scene.build(n)
            assert 0.5 * n <= len(particles) <= 2 * n + 60, name
            assert sum(isinstance(f, tv.Contact) for f in features) == (particles.radius.any() > 0)
            if particles.radius.any():  # nothing overlaps, not counting links
                x, r = particles.position, particles.radius[0]
                far = np.linalg.norm(x[:, None] - x[None], axis=2) + 10 * np.eye(len(x))
                assert far.min() > 2 * r
                box = next(f for f in features if isinstance(f, tv.Box))
                assert (x >= np.array(box.lower) + r - 1e-9).all() and (x <= np.array(box.upper) - r + 1e-9).all()


@pytest.mark.slow
def test_what_is_stripped_runs_and_has_the_same_fields(report):
    # The copy has two features and the parts that the package itself needs.
    (absent,) = report.absent
    assert absent.fields[0] == absent.fields[1] and absent.bytes[0] == absent.bytes[1] and absent.launches == (1, 1)
    assert absent.ratio > 0 and SpeedReport.of_json(report.json()) == report


def test_a_copy_lacks_what_is_not_needed(tmp_path):
    bare = pathlib.Path(stripped.copy(str(tmp_path), frozenset({"gravity", "distance"}))) / "tiverlet"
    there = {f.stem for part in stripped.FOLDERS for f in (bare / part).glob("*.py")} - {"__init__"}
    assert {"gravity", "distance"} <= there and not there & {"contact", "drag", "wind", "sdf", "mesh", "shape_match", "bend"}


def test_quality_of_peers():
    x = np.array([[0.0, 0], [0.9, 0], [2.5, 0]])
    assert peers.overlap(x, np.full(3, 0.5)) == pytest.approx(0.1)
    assert peers.overlap(x * 2, np.full(3, 0.5)) == 0
    particles, (_, links) = scenes.rope(3)
    assert peers.strain(particles.position * 1.25, links, particles) == pytest.approx(0.25)
    assert peers.strain(particles.position * np.nan, links, particles) == 1e300


def test_a_peer_runs_or_is_left_out():
    session = measure.Session("cpu", [1], True)
    absent = peers.Engine("no_such_engine", ("rope",), peers.LADDER, 1)
    assert absent.missing() == "it is not installed"
    here = [p for p in peers.PEERS.values() if not p.missing()]
    session.beside("cloth", 100)
    assert not session.notes and not session.peers  # no peer runs it
    if not here:
        session.beside("rope", 11)
        assert len(session.notes) == len(peers.PEERS)


def test_misuse():
    with pytest.raises(ValueError, match="no scene 'pule'"):
        speed("pule")
    with pytest.raises(ValueError, match="sizes"):
        speed("pile", sizes=[1])
    with pytest.raises(ValueError, match="threads"):
        speed("pile", threads=[0])


def test_command(capsys):
    assert main(["report", "speed", "--list"]) == 0
    assert "a million" not in (out := capsys.readouterr().out) and all(name in out for name in SCENES)
    assert main(["report", "speed", "pule"]) == 2
    assert "no scene 'pule'" in capsys.readouterr().err
    assert main(["report", "--list"]) == 0  # without a further word: the report on errors
    assert "D01_double_pendulum" in capsys.readouterr().out


# All jobs one after the other; each redirects the output that it prints to.
TOGETHER = """
import json, os, sys
import tiverlet as tv
from tiverlet.report.speed import worlds
worlds.QUICK["pile"] = ()
out = os.dup(1)
tv.init(threads=1)
tv.init = lambda **_: None
for job in json.loads(sys.argv[1]):
    os.dup2(out, 1)
    worlds.main(job)
"""


@pytest.fixture(scope="module")
def batch(kept):
    """Return a report on few of many worlds. All parts run in one process, where they share kernels.

    Piles run only beside one of all their discs, because they compile longest. The part that counts compiled kernels runs first.
    """
    jobs, rows = {}, {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worlds, "tempfile", types.SimpleNamespace(TemporaryDirectory=lambda: contextlib.nullcontext(str(kept))))
        patch.setattr(processes, "started", lambda code, job, cache: contextlib.nullcontext(types.SimpleNamespace(
            ask=lambda: rows.get(job["part"]) or jobs.update({job["part"]: job}) or []
        )))  # fmt: skip
        worlds.worlds(threads=(1,), quick=True, peers=False)  # asks for all parts
        names = sorted(jobs, key="costs".__ne__)
        said = Forked(TOGETHER, [jobs[name] for name in names], str(kept / "worlds")).said()
        rows = dict(zip(names, map(json.loads, said.splitlines()), strict=True))
        return worlds.worlds(threads=(1,), quick=True, peers=False)


@pytest.mark.slow
def test_worlds_are_measured_or_left_out(batch):
    assert not batch.missing
    assert {note for note in batch.notes if note.startswith("Left out")} == {
        "Left out: mujoco, since it is not wanted.",
        "Left out: newton, since it is not wanted.",
    }
    parts = [part for part in worlds.PARTS.values() if part.alone]
    assert list(batch.tables) == [part.title for part in parts]
    for part in parts:
        heads, rows = batch.tables[part.title]
        assert heads == ("threads", *part.heads) and rows and all(len(row) == len(heads) and row[0] == "1" for row in rows)
    ladder = batch.tables[worlds.PARTS["ladder"].title][1]
    assert [row[1:4] for row in ladder] == [
        ("pendulum", "3", "1"),
        ("pendulum", "3", "3"),
        ("chain", "21", "3"),
    ]
    assert all(float(row[4]) > 0 for row in ladder)
    errors = [float(row[2]) for row in batch.tables[worlds.PARTS["pendulums"].title][1]]
    assert errors[0] < 5e-5 and errors[-1] < 1e-10  # of order 2, of order 8
    assert [row[7] for row in batch.tables[worlds.PARTS["costs"].title][1]] == ["1", "1"]  # kernels that one frame compiles
    assert "Double pendulums" in str(batch) and "| pendulum |" in batch.markdown() and "tables" in json.loads(batch.json())


def test_reference_of_double_pendulums():
    # The reference has the energy of its start, and half the step changes nothing.
    times = np.arange(1, 46) / 15
    x, finer = worlds.double_pendulum(times), worlds.double_pendulum(times, steps=32)
    np.testing.assert_allclose(x, finer, atol=1e-12)
    links = np.linalg.norm([x[:, 0], x[:, 1] - x[:, 0]], axis=2)
    np.testing.assert_allclose(links, 1, atol=1e-14)


def test_rate_for_an_error():
    known = [(30, 16e-4), (60, 1e-4), (120, 1e-8), (240, 2e-8)]  # the last one is rounding
    assert worlds.rate_for(1e-4, known) == pytest.approx(60)
    assert worlds.rate_for(4e-4, known) == pytest.approx(30 * 2**0.5)
    assert worlds.rate_for(256e-4, known) == pytest.approx(15)
    assert worlds.rate_for(1e-8 / 16, known) == pytest.approx(240)
