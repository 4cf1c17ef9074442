"""The patches of Taichi shorten compilation without changing a bit, and do not affect what users compile."""

import inspect
import io
import re
import sys
import tempfile
from typing import Any

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.patches import patched, source_cache, timing
from tiverlet.device.patches.compiler import BRIEF, LEAN, UNSEARCHED, Compiler
from tiverlet.step import build

from .conftest import ARCH, compiled, python

PILE = """
import contextlib
import numpy as np
import tiverlet as tv
from tiverlet.device import thread_team
def reports(apart=False):
    x = 2 * tv.golden(np.arange(60), dim=2) - 1
    particles = tv.Particles(x, velocity=-2 * x, radius=0.06)
    links = np.stack([np.arange(0, 20, 2), np.arange(1, 20, 2)], axis=1)
    linked = [tv.Distance(links, compliance=1e-4)]
    for features in (linked, [tv.Contact()]):  # apart, since Taichi's analysis takes more than in proportion
        launched = apart and features is not linked
        with thread_team.launching() if launched else contextlib.nullcontext():
            w = tv.World(particles, [tv.Gravity(9.81), *features], substeps=5, path="parallel" if launched else "auto")
        with w:
            yield [w.step(1 / 60) for _ in range(24)], w.hash()
"""


@pytest.mark.slow
def test_the_bits_do_not_depend_on_the_patches():
    # Taichi without patches, in another process (as for versions other than 1.7.4): the same hashes and the same reports. There
    # every phase of contacts is a kernel of its own, as on a GPU: Taichi would analyse all of them in one for 23 s, not 6.
    space: dict = {}
    exec(PILE, space)
    made = list(space["reports"]())
    code = PILE + "from tiverlet.device.patches import compiler\nassert not compiler.patched\nprint(repr([*reports(True)]))\n"
    alone = python(code, TIVERLET_PATCHES="0").stdout
    for pattern in (r"'[0-9a-f]{64}'", r"(?:energy|residual|overlap|contacts|time)=[^,]*"):
        assert re.findall(pattern, repr(made)) == re.findall(pattern, alone)
    assert sum(r.contacts for r in made[1][0]) > 100 and len(re.findall("StepReport", alone)) == 48


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
def test_statements_are_those_that_taichi_makes():
    # Taichi's cache names a kernel by its statements. With `active` replaced, our functions take no kernel for tiverlet's, and
    # Taichi makes all statements itself, except those of statements.py. The names must be the same.
    code = """
import os
import taichi as ti
import tiverlet as tv
from tiverlet.device.patches import compiler, source_cache, syntax_cache
compiler.patched = False
if os.environ["ALONE"]:
    source_cache.active = syntax_cache.active = []
@ti.func
def spring(x):
    out = 0 * x
    for k in ti.static(range(2)):
        out[k] = -30.0 * x[k]
        if ti.static(k == 0):
            continue
    a, b = x[0], x[1]
    n, tall = 3, ti.Vector([b, -a])
    while n > 1 and a < 1e3 or not b >= a:
        n -= 1
        if n == 2:
            break
        out += 0.25 * tall / (1 + abs(a)) ** n - ti.cast(n << 1, float) * ti.min(a, 2)
    return out * min(ti.math.dot(x, x), 3) + tall.yx * (1.0 if a > b else ti.u32(7) % 4)
world = tv.World(tv.Particles([[0.0, 0.0], [1.0, 0.0]]), [tv.Force(spring)])
world.step(1 / 60)
print(world.hash())
ti.reset()  # which writes the cache
print(*sorted(name for name in os.listdir(os.environ["TI_OFFLINE_CACHE_FILE_PATH"]) if name.endswith(".tic")))
"""
    with tempfile.TemporaryDirectory() as folder:
        said = [
            python(code, ALONE=alone, TI_OFFLINE_CACHE="1", TI_OFFLINE_CACHE_FILE_PATH=f"{folder}/cache{alone}").stdout
            for alone in ("", "1")
        ]
    assert said[0].splitlines()[-2:] == said[1].splitlines()[-2:] and said[0].count(".tic") == 2, said


TABLE = np.array([0.0, 2.0])  # kernels also compare it at compile time


def compared(x: ti.f32, out: ti.types.ndarray(ti.f64, 1)):
    """Write results of comparisons and choices of all kinds to `out`."""
    i, v, u = ti.cast(x, ti.i32), ti.Vector([x, 2 * x]), ti.cast(ti.abs(ti.cast(x, ti.i32)), ti.u32)
    for k in ti.static(range(2)):
        if ti.static(TABLE[k] > 1.5):
            out[k] = 1
    if ti.static(np.int64(2) == 2) and TABLE[1] > 1.5:
        out[2] = 1
    larger, same = v > 1.0, v == v
    out[3], out[4], out[5] = larger[0], larger.any(), same.all()
    out[6], out[7], out[8], out[9] = x != x, 0 < x < 2, x >= 1, not x < 1
    out[10], out[11] = (x > 1) + (x > 0.5), (x > 0) * 3.0 - (x > 1)
    out[12], out[13], out[14] = ti.select(x > 1, 1.0, 2.0), ti.select(not x > 1, 1.0, 2.0), ti.select(i, 3.0, 4.0)
    chosen = ti.select(v > 1.0, v, 0 * v)
    out[15], out[16], out[17] = chosen[0], chosen[1], u > -1
    out[18], out[19], out[20] = (x > 1) != (x > 2), (i > 1) << 3, (x > 1) == (x > 2)


def test_comparisons_are_what_taichi_makes_of_them(world):
    # Ours are one statement each, see statements.py; Taichi's have branches. NaN is not less than any number, and NumPy's
    # booleans count as booleans.
    w = world(tv.Particles(np.zeros((1, 2))))
    ours, theirs = ti.kernel(compared), ti.kernel(compared)
    for x in (0.7, 3.0, -1.5, np.nan):
        out = np.zeros((2, 21))
        with w._runner.memory.compiler():
            ours(x, out[0])
        theirs(x, out[1])
        np.testing.assert_array_equal(*out)


def test_functions_are_cut_out_of_their_files_as_python_does_it():
    modules = [module for name, module in sys.modules.items() if name.startswith("tiverlet")]
    owners = {o for m in modules for o in vars(m).values() if inspect.isclass(o) and o.__module__.startswith("tiverlet")}
    made = [f.func.func for o in owners for f in vars(o).values() if hasattr(getattr(f, "func", None), "func")]
    assert len(made) > 300
    for function in made:
        lines, first = source_cache._cut_out(function.__code__)
        want = inspect.getsourcelines(function)
        assert ("".join(lines).rstrip(), first) == ("".join(want[0]).rstrip(), want[1]), function


@pytest.mark.skipif(ARCH != "cpu" or not patched, reason="of the patches of Taichi on a CPU")
def test_long_kernels_are_compiled_without_a_search_to_the_same_bits(world, monkeypatch):
    # Walls with events have code of their own; others share it by kind.
    rods = [tv.Capsule((0.2 * k, 0.0), (0.2 * k, 1.0), 0.02, friction=0.3, events=True) for k in range(4)]
    hourglass = [tv.Gravity(), tv.Contact(), tv.Ball((9.0, 9.0), 1.0), tv.Box((-9, -9), (9999, 99)), *rods]

    def passes(n: int, features: list) -> Any:
        """Return the passes with which kernels for n particles are compiled."""
        x = np.stack([np.arange(n), np.arange(n) % 7], axis=1) + 0.5
        with tv.World(tv.Particles(x, radius=0.1), [f.copy() for f in features]) as w:
            return w._runner.memory.compiler.passes

    assert passes(999, hourglass) is BRIEF
    assert passes(1000, hourglass) is passes(3999, hourglass) is UNSEARCHED
    assert passes(4000, hourglass) is passes(1000, hourglass[2:4]) is LEAN

    # Kernels that call long functions, and those into which these are copied, as in many copies of a world, give the same bits.
    x, hashes = np.stack([0.09 * np.arange(12), np.full(12, 0.5)], axis=1), set()
    for settings in (LEAN, BRIEF, UNSEARCHED):
        monkeypatch.setattr(build, "_passes", lambda *_, settings=settings: settings)
        if settings is UNSEARCHED:
            monkeypatch.setattr(Compiler, "calls", False)
        w = world(tv.Particles(x, velocity=x * (9, 0) - (5, 3), radius=0.01), [tv.Gravity(), rods[1].copy(), rods[3].copy()])
        w.run(0.2)
        hashes.add(w.hash())
    assert len(hashes) == 1


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
def test_functions_that_kernels_call_change_no_bit(monkeypatch):
    # As above, for functions of constraints: a chain in 3D with limited angles and a dihedral angle.
    angles = [tv.AngleLimit([[0, 1, 2], [1, 2, 3]], 0, 1), tv.Dihedral([[1, 2, 3, 4]], compliance=1e-2)]
    start, made = tv.Particles([[0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 1, 1], [3, 0, 1]], pinned=[0]), []
    for passes, calls in ((BRIEF, patched and ARCH == "cpu"), (UNSEARCHED, False)):
        monkeypatch.setattr(build, "_passes", lambda *scene, chosen=passes: chosen)
        if not calls:
            monkeypatch.setattr(Compiler, "calls", False)
        features = [tv.Gravity(), tv.Distance([[0, 1], [1, 2], [2, 3], [3, 4]]), *(f.copy() for f in angles)]
        with tv.World(start, features, substeps=8, precision="f64") as w:
            assert w._runner.memory.compiler.calls == calls
            made.append(([w.step(1 / 60) for _ in range(60)], w.hash()))
    assert made[0] == made[1] and made[0][0][0].energy != made[0][0][-1].energy


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
