"""Compiling in less time changes no bit, and nothing of what the user compiles."""

import numpy as np

import tiverlet as tv

from .conftest import python


def test_the_bits_do_not_depend_on_how_kernels_are_compiled(world):
    x = 2 * tv.golden(np.arange(60), dim=2) - 1
    particles = tv.Particles(x, velocity=-2 * x, radius=0.06)
    links = np.stack([np.arange(0, 20, 2), np.arange(1, 20, 2)], axis=1)
    linked = [tv.Distance(links, compliance=1e-4), tv.Box((-1.2, -1.2), (1.2, 1.2))]
    for features in (linked, [tv.Contact(friction=0.5)]):  # apart, since Taichi's analysis takes more than in proportion
        worlds = [world(particles, [tv.Gravity(9.81), *(f.copy() for f in features)], substeps=5) for _ in range(2)]
        worlds[1]._memory.compiler.thorough = True
        reports = [[w.step(1 / 60) for _ in range(24)] for w in worlds]
        assert worlds[0].hash() == worlds[1].hash() and reports[0] == reports[1]
    assert sum(r.contacts for r in reports[0]) > 100


def test_what_the_user_compiles_is_compiled_as_ever():
    # parts() leaves a vector in a variable that is a number. Without Taichi's analysis, which finds that nobody reads it, LLVM
    # ends the process.
    python(
        """
import taichi as ti
import tiverlet as tv
@ti.func
def parts(x):
    return x.norm(), -100.0 * x, x
@ti.func
def spring(x):
    _, force, _ = parts(x)
    return force
@ti.func
def wrong(x):
    return x.no_such_name
tv.init()
@ti.kernel
def own() -> ti.f32:
    _, force, _ = parts(ti.Vector([1.0, 2.0]))
    return force[1]
mine = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(spring)], substeps=10)
ours = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Gravity()], substeps=10)
bad = tv.World(tv.Particles([[1.0, 0.0]]), [tv.Force(wrong)])
for w in (ours, mine, ours, mine):
    w.step(0.01)
    assert ti.cfg.cfg_optimization and ti.cfg.cache_loop_invariant_global_vars and ti.cfg.default_fp == ti.f32
assert mine._memory.compiler.thorough and not ours._memory.compiler.thorough
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
