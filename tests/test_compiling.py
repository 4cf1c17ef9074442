"""Compiling in less time changes no bit, and nothing of what the user compiles."""

import numpy as np
import pytest

import tiverlet as tv

from .conftest import python


def scenes(dim):
    """Scenes that differ in what their kernels are made of, as arguments of World."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (60, dim))
    down = 9.81 * -np.eye(dim)[1]
    pairs = np.stack([np.arange(0, 40, 2), np.arange(1, 40, 2)], axis=1)
    rod = tv.Capsule(-2 * np.eye(dim)[0], 2 * np.eye(dim)[0], 0.2, friction=0.3, restitution=0.5)
    return {
        "contacts": (
            tv.Particles(x, radius=0.08),
            [tv.Gravity(down), tv.Contact(friction=0.5, restitution=0.2), tv.Box([-1.2] * dim, [1.2] * dim, friction=0.3)],
        ),
        "links": (tv.Particles(x, radius=0.02), [tv.Gravity(down), tv.Drag(0.2), tv.Distance(pairs, compliance=1e-4), rod]),
    }


@pytest.mark.parametrize("dim, name, precision", [(2, "contacts", "f32"), (3, "links", "f32-compensated")])
def test_the_bits_do_not_depend_on_how_kernels_are_compiled(world, dim, name, precision):
    hashes = set()
    for thorough in (False, True):
        particles, features = scenes(dim)[name]
        w = world(particles, features, precision=precision, substeps=5)
        w._memory.compiler.thorough = thorough
        for _ in range(20):
            w.step(1 / 60)
        hashes.add(w.hash())
    assert len(hashes) == 1


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
