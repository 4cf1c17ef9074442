"""The patches of Taichi shorten compilation without changing a bit, and do not affect what users compile."""

import io
import os
import pathlib
import shutil
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.patches import chosen, timing
from tiverlet.device.patches.compiler import BRIEF, LEAN, UNSEARCHED, Compiler
from tiverlet.step import build

from .conftest import ARCH, PATCHED, compiled, python

ROOT = str(pathlib.Path(__file__).parents[1])

ROPES = """
import numpy as np
import tiverlet as tv
from tests.fuzz.functions import compared
def made():
    x = 2 * tv.golden(np.arange(12), dim=2) - 1
    links = tv.Distance(np.arange(12).reshape(6, 2), compliance=1e-4)
    with tv.World(tv.Particles(x, velocity=-2 * x), [tv.Gravity(9.81), tv.Force(compared), links], substeps=5) as w:
        reports = [w.step(1 / 60) for _ in range(24)]
        return [(r.energy, r.residual, r.time) for r in reports], w.hash()
"""


@pytest.mark.skipif(not PATCHED, reason="how Taichi names its files")
def test_what_a_plain_script_compiles_is_kept_for_its_next_start(tmp_path):
    # Taichi writes its cache when its program ends, which what lives on at the end of the process must not prevent.
    script = "import tiverlet as tv\nworld = tv.World(tv.Particles([(0.0, 1.0)]), [tv.HalfSpace((0, 1))])\nworld.step(1 / 60)\n"
    python(script, TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path))
    assert any(tmp_path.glob("*.tic"))


@pytest.mark.skipif(not PATCHED, reason="how Taichi names its files")
@pytest.mark.slow
def test_a_killed_process_and_two_at_once_leave_a_cache_that_works(tmp_path):
    # A process that is killed while it reads or writes the cache leaves its lock. One of 70 s is of the dead, one of 50 s need
    # not be. Two processes that compile the same at once, and one after them, have the same bits.
    code, lock = ROPES + "print(made())\n", tmp_path / "ticache.lock"

    def run(_=None) -> str:
        return python(code, PYTHONPATH=ROOT, TI_OFFLINE_CACHE_FILE_PATH=str(tmp_path)).stdout

    for age, stays in ((50, True), (70, False)):
        lock.touch()
        os.utime(lock, (0.0, time.time() - age))
        first = run()
        assert lock.exists() == stays != any(tmp_path.glob("*.tic"))
    shutil.rmtree(tmp_path)
    tmp_path.mkdir()
    with ThreadPoolExecutor() as pool:
        assert {*pool.map(run, range(2))} == {first}
    kept = {path.name for path in tmp_path.glob("*.tic")}
    assert run() == first and kept == {path.name for path in tmp_path.glob("*.tic")} != set()


def test_a_patch_that_needs_another_one_is_off_without_it():
    assert chosen("") == chosen("1") == chosen("-sources") | {"sources", "calls"} == chosen("-sharing") | {"sharing", "loops"}
    assert chosen("0") == set() and chosen("-calls,-launches") == chosen("") - {"calls", "launches"}
    with pytest.raises(ImportError, match="'-call', but .* like \"-calls,-launches\"; their names are passes, sources"):
        chosen("-call")


@pytest.mark.slow
@pytest.mark.parametrize("off", ["0", "-sources,-launches", "-sharing,-statements"])
def test_the_bits_do_not_depend_on_the_patches(off):
    # In another process without all or some patches (as for versions other than 1.7.4): the same hash and the same reports, also
    # of comparisons and choices of all kinds, of which ours make one statement each. Contacts would compile for half a minute.
    space: dict = {}
    exec(ROPES, space)
    here = space["made"]()
    code = ROPES + "from tiverlet.device.patches import PATCHES, enabled\nassert enabled < {*PATCHES}\nprint(made())\n"
    plain = python(code, TIVERLET_PATCHES=off, PYTHONPATH=ROOT).stdout
    assert repr(here) == plain.strip() and len({energy for energy, *_ in here[0]}) > 20


@pytest.mark.slow
def test_what_the_user_compiles_is_compiled_as_ever():
    # parts() assigns a vector to a variable that holds a number. Taichi's analysis finds that the variable is never read; without
    # it, LLVM ends the process. Only frames with such functions are analysed, which takes ten times as long with contacts.
    python(
        """
from tiverlet.device import ti
import tiverlet as tv
@ti.func
def parts(x):
    return x.norm(), -100.0 * x, x
@ti.func
def spring(x):
    _, force, _ = parts(x)
    return force
@ti.func
def plain(x):
    return -100.0 * x
@ti.func
def doubtful(x):
    far = x[0] > 2.0
    far = 3
    return -100.0 * x
@ti.func
def wrong(x):
    return x.no_such_name
tv.init()
@ti.kernel
def own() -> ti.f32:
    _, force, _ = parts(ti.Vector([1.0, 2.0]))
    return force[1]
mine = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(spring)], substeps=10)
same = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(plain)], substeps=10)
odd = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(doubtful)], substeps=10)
ours = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Gravity()], substeps=10)
bad = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(wrong)])
for w in (ours, same, mine, odd, ours, same, mine, odd):
    w.step(0.01)
    assert ti.cfg.cfg_optimization and ti.cfg.cache_loop_invariant_global_vars and ti.cfg.default_fp == ti.f32
assert [w._runner.memory.compiler.thorough for w in (ours, same, mine, odd)] == [False, False, True, True]
assert same.hash() == mine.hash() == odd.hash()
assert abs(mine.position[0, 0] - 0.980067) < 1e-4  # cos(omega t), omega = 10 / s
for _ in range(2):
    try:
        bad.step(0.01)
    except ti.TaichiCompilationError as e:
        assert "no_such_name" in str(e) and "^^^" in str(e), e  # the place, drawn as Taichi draws it
    else:
        raise SystemExit("no error")
    assert ti.cfg.cfg_optimization
assert own() == -200.0
""",
        TI_OFFLINE_CACHE="0",
    )


@pytest.mark.slow
@pytest.mark.skipif(ARCH != "cpu" or not PATCHED, reason="of the patches of Taichi on a CPU")
def test_how_kernels_are_compiled_changes_no_bit(world, monkeypatch):
    # Kernels of large worlds, of small ones, which call long functions, and those into which these are copied: of walls with
    # events, which have code of their own, and of a chain with limited angles.
    x, made = np.stack([0.09 * np.arange(12), 0.5 + 0.01 * (np.arange(12) % 2)], axis=1), []
    for settings, calls in ((LEAN, True), (BRIEF, True), (UNSEARCHED, False)):
        monkeypatch.setattr(build, "_passes", lambda *_, settings=settings: settings)
        monkeypatch.setattr(Compiler, "calls", calls)
        rods = [tv.Capsule((0.2 * k, 0.0), (0.2 * k, 0.4), 0.02, friction=0.3, events=True) for k in (1, 3)]
        links = tv.Distance([[0, 1], [1, 2], [2, 3], [3, 4]]), tv.AngleLimit([[0, 1, 2], [1, 2, 3]], 0, 1)
        w = world(tv.Particles(x, velocity=x * (9, 0) - (5, 3), radius=0.01), [tv.Gravity(), *links, *rods], substeps=8)
        reports = [w.step(1 / 60) for _ in range(12)]
        made.append(([(r.energy, r.residual) for r in reports], w.hash()))
    assert made[0] == made[1] == made[2] and len(set(made[0][0])) > 1


def test_who_waits_is_told_what_for(world, monkeypatch):
    # On a terminal, a line is shown while LLVM works. Afterwards explain() says how long that took, and for which features. The
    # times add up to the total.
    shown = io.StringIO()
    monkeypatch.setattr(shown, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys, "stderr", shown)
    monkeypatch.setattr(timing, "LONG", 0.0)

    @ti.func
    def pull(x):
        return -1.2345 * x

    w = world(tv.Particles([[0.0, 0.0], [1.0, 0.0]], radius=0.4), [tv.Force(pull), tv.Box((-9, -9), (9, 9))])
    assert "fused" not in w._runner.memory.compiler.times.kernels
    w.step(1 / 60)
    assert "compiling fused: Box, Force" in shown.getvalue()
    times, (line,) = w._runner.memory.compiler.times, [row for row in w.explain().splitlines() if row.startswith("Compiled in")]
    total = sum(times.kernels.values())
    assert f"Compiled in {total:.2f} s: " in line and times.kernels["fused"] > 0.5 * total
    assert {"Box", "report"} < times.features.keys() and 0 < sum(times.features.values()) < total
    assert "Nothing was compiled for it" in w.clone().explain()
    other = w.clone()
    other.step(1 / 60)
    assert "Nothing was compiled for it" in other.explain()
    w.add(features=[tv.Drag(0.123)])  # rebuilds the world, which keeps its times
    assert w._runner.memory.compiler.times.kernels["fused"] == times.kernels["fused"]


@pytest.mark.slow
def test_no_frame_of_a_game_waits_for_what_a_repeated_frame_needs(world):
    # A soft ring on a floor: under "auto", frame 34 is repeated with shorter substeps, and walls stop what links move meanwhile.
    ring = tv.shapes.polygon((0, 1.0), 0.35, 24)
    features = [tv.Gravity(), tv.Distance(ring.links, compliance=1e-4, damping=0.1), tv.Area(ring.loops, compliance=1e-3)]
    floor = tv.Polygon([(-1, 0), (30, 0), (30, -1), (-1, -1)], friction=0.5)
    w = world(tv.Particles(ring.position, mass=0.05, radius=0.04), [*features, floor], substeps="auto")
    w.step(1 / 60)
    with compiled() as names:
        tries = max(w.step(1 / 60).tries for _ in range(60))
    assert tries > 1 and set(names) <= {"to_velocity"}
