"""The patches of Taichi shorten compilation without changing a bit, and do not affect what users compile."""

import ast
import gc
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
    linked = [tv.Distance(links, compliance=1e-4), tv.Box((-1.2, -1.2), (1.2, 1.2))]
    for features in (linked, [tv.Contact(friction=0.5)]):  # apart, since Taichi's analysis takes more than in proportion
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


@pytest.mark.slow
@pytest.mark.skipif(not (ARCH == "cpu" and sys.platform == "linux"), reason="LLVM's switches are found there")
def test_loops_are_copied_for_the_user_alone():
    # LLVM reports which loops it unrolls. It leaves our loops whose length is known only at run time as they are. In the same
    # process, it unrolls the loop of a user's kernel as usual.
    code = """
import os
from tiverlet.device import ti
import tiverlet as tv
from tiverlet.device.patches import library, llvm_switches
told = "-pass-remarks=loop-unroll"
llvm_switches.SWITCHES = (told, *llvm_switches.SWITCHES[:COUNT])
world = tv.World(tv.Particles([(0, 0.2), (0.15, 0.1)], radius=0.1), [tv.Gravity(), tv.Contact(), tv.HalfSpace((0, 1))])
world.step(1 / 60)
print(world.hash())
library.command_line().set_switches(told)
seen = ti.field(ti.f32, 100)
@ti.kernel
def add(count: ti.i32):
    for _ in range(1):
        for k in range(count):
            seen[k] += seen[count - k - 1]
os.write(2, b"theirs")
add(5)
"""
    ours, as_ever = (python(code.replace("COUNT", count), TI_OFFLINE_CACHE="0") for count in ("3", "0"))
    copies = [[part.count("by a factor of") for part in done.stderr.split("theirs")] for done in (ours, as_ever)]
    assert ours.stdout == as_ever.stdout and copies[0][0] <= 1 and copies[1][0] > 10
    assert copies[0][1] == copies[1][1] > 0


@pytest.mark.slow
@pytest.mark.skipif(not (ARCH == "cpu" and sys.platform == "linux"), reason="LLVM's switches are found there")
def test_only_frames_of_many_particles_are_worth_a_search():
    # LLVM prints its passes. Taichi asks for a search for addresses with fewer additions; by default LLVM makes a second one.
    code = """
import numpy as np
import tiverlet as tv
from tiverlet.device.patches import llvm_switches
llvm_switches.SWITCHES = ("-debug-pass=Structure", *llvm_switches.SWITCHES)
x = np.arange(COUNT)
tv.World(tv.Particles(np.stack([x, 0 * x], axis=1), radius=0.1), [tv.Contact()]).step(1 / 60)
"""
    few, many = (python(code.replace("COUNT", count), TI_OFFLINE_CACHE="0").stderr for count in ("10", "1000"))
    assert many.count("Loop Strength Reduction") == 2 * few.count("Loop Strength Reduction") > 0


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


@ti.func
def nested(x, n: ti.template()):  # type: ignore[valid-type]
    """Return (n + 1)! x by recursion. In each sum, the left call is compiled before the tree of the right call is visited."""
    out = x
    if ti.static(n > 0):
        out = nested(x, n - 1) + n * nested(x, n - 1)
    return out


@ti.func
def spring(x):
    """Return -24 x."""
    return -nested(x, 3)


def test_functions_are_parsed_once_and_hold_nothing(world):
    # x = cos(omega t), omega^2 = 24. A function that calls itself has a tree for each depth. Trees keep no results of their
    # nodes, which could refer to worlds.
    w = world(tv.Particles([[1.0, 0.0]]), [tv.Force(spring)], precision="f64", substeps=200)
    w.run(0.5)
    assert w.position[0, 0] == pytest.approx(np.cos(24**0.5 * w.time), abs=1e-5)
    kept = [tree for trees in source_cache._trees.values() for tree in trees]
    assert len(source_cache._trees[nested.func.func]) == 4
    for tree in kept:
        for node in ast.walk(tree):
            assert not {*vars(node)} - {*node._fields, *node._attributes, "decorator", "nodes", "source"}


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


def test_compiling_leaves_nothing_behind(world):
    # Afterwards no kernel counts as being compiled, and Python collects garbage again.
    w = world(tv.Particles([[0.0, 1.0], [1.0, 1.0]]), [tv.Gravity(9.81), tv.Distance([[0, 1]])])
    w.run(0.1)
    assert not source_cache.active and gc.isenabled()


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

    x, hashes = np.stack([0.09 * np.arange(12), np.full(12, 0.5)], axis=1), set()
    for settings in (LEAN, UNSEARCHED, BRIEF):
        monkeypatch.setattr(build, "_passes", lambda *_, settings=settings: settings)
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

    features = [tv.Force(pull), tv.Contact(friction=0.123), tv.Box((-9, -9), (9, 9))]
    w = world(tv.Particles([[0.0, 0.0], [1.0, 0.0]], radius=0.4), features)
    assert "fused" not in w._runner.memory.compiler.times.kernels
    w.step(1 / 60)
    assert "compiling fused: Box, Contact, Force" in shown.getvalue()
    times, (line,) = w._runner.memory.compiler.times, [row for row in w.explain().splitlines() if row.startswith("Compiled in")]
    total = sum(times.kernels.values())
    assert f"Compiled in {total:.2f} s: " in line and times.kernels["fused"] > 0.5 * total
    assert {"Contact", "Box", "neighbour list", "report"} < times.features.keys() and 0 < sum(times.features.values()) < total
    assert "Nothing was compiled for it" in w.clone().explain()
    other = w.clone()
    other.step(1 / 60)
    assert "Nothing was compiled for it" in other.explain()
    w.add(features=[tv.Drag(0.123)])  # rebuilds the world, which keeps its times
    assert w._runner.memory.compiler.times.kernels["fused"] == times.kernels["fused"]


def squares():
    """Return two squares that fall on each other and on the floor."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    particles = tv.Particles(np.concatenate([square, square + [0.5, 1.1]]), velocity=(0, -2), radius=0.02)
    loops, sides = np.arange(8).reshape(2, 4), np.stack(np.triu_indices(4, 1), axis=1)
    rough = [tv.Polygons(loops, friction=0.5), tv.HalfSpace((0, 1), -0.1)]
    return particles, [tv.Gravity(), tv.Distance(np.concatenate([sides, sides + 4])), *rough]


def arm():
    """Return a chain in 3D with limited angles at its corners and a dihedral angle along it."""
    particles = tv.Particles([[0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 1, 1], [3, 0, 1]], pinned=[0])
    angles = [tv.AngleLimit([[0, 1, 2], [1, 2, 3]], 0, 1), tv.Dihedral([[1, 2, 3, 4]], compliance=1e-2)]
    return particles, [tv.Gravity(), tv.Distance([[0, 1], [1, 2], [2, 3], [3, 4]]), *angles]


@pytest.mark.slow
@pytest.mark.parametrize("scene, precision", [(squares, "f32"), (arm, "f64")])
def test_functions_that_kernels_call_change_no_bit(monkeypatch, scene, precision):
    # Kernels that call long functions, and kernels into which these are copied, as in many copies of a world. For LEAN, which
    # takes twice as long as UNSEARCHED, see above and test_determinism.py.
    made = []
    for passes in (BRIEF, UNSEARCHED):
        monkeypatch.setattr(build, "_passes", lambda *scene, chosen=passes: chosen)
        if passes is UNSEARCHED:
            monkeypatch.setattr(Compiler, "calls", False)
        with tv.World(*scene(), substeps=8, precision=precision) as w:
            made.append(([w.step(1 / 60) for _ in range(60)], w.hash(), w._runner.memory.compiler.calls))
    (reports, digest, calls), (others, other, copies) = made
    assert reports == others and digest == other and reports[0].energy != reports[-1].energy
    assert scene is not squares or sum(r.contacts for r in reports) > 5
    assert calls == (patched and ARCH == "cpu") and not copies


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
