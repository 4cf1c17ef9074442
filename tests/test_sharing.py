"""Worlds of the same structure share compiled kernels, and no state."""

import inspect
import resource
import sys

import numpy as np
import pytest
import taichi as ti
from taichi.lang.kernel_impl import Kernel

import tiverlet as tv
from tiverlet.device import layout, runtime
from tiverlet.device.patches import sharing
from tiverlet.device.patches.compiler import CachedLaunch
from tiverlet.features.arguments import knobs_of
from tiverlet.step.step import Step

from .conftest import ARCH, compiled
from .outlines import CUBE, CUBE_FACES, SQUARE
from .rows import OTHERS, ROWS

pytestmark = pytest.mark.skipif(ARCH != "cpu", reason="every world has kernels of its own there")


NUMBERS = [(0.01, 1e-3, 9.81, 0.3, 12), (0.5, 1e-5, 1.6, 0.6, 9), (2.0, 0.1, -3.0, 0.2, 17)]


@pytest.mark.slow
def test_worlds_with_other_numbers_and_counts_and_clones_compile_nothing(world, monkeypatch):
    # Shared worlds have the bits that they have alone, where each world compiles its own kernels.
    def hung(mass, compliance, g, rest, points):
        rope = tv.shapes.rope((0, 0), (1, 0.2), points=points)
        links = [tv.Distance(rope.links), tv.Distance([[2, 7]], rest=rest, compliance=compliance)]
        particles = tv.Particles(rope.position, mass=mass, pinned=[0])
        return world(particles, [tv.Gravity((0, -g)), *links], substeps=5, precision="f64")

    first = hung(*NUMBERS[0])
    first.run(0.1)
    assert first.velocity.shape == (12, 2)
    with compiled() as names:
        shared = [hung(*numbers) for numbers in NUMBERS]
        for _ in range(6):
            for w in shared:
                w.step(1 / 60)
        copy = shared[1].clone()
        copy.step(1 / 60)
        shared[1].step(1 / 60)
        speeds = [w.velocity for w in shared]
    assert names == []
    assert copy.hash() == shared[1].hash() != shared[0].hash() == first.hash()
    monkeypatch.setattr(layout, "can_share", lambda: False)
    with compiled() as names:
        alone = hung(*NUMBERS[1])
        alone.run(7 / 60)
        np.testing.assert_array_equal(alone.velocity, speeds[1])
    assert names and alone.hash() == shared[1].hash()


def compliant(row, corners):
    """Return the feature of a row with every option that it can have."""
    soft = 1e-2 * (np.arange(len(corners)) % 2)
    return row.make(corners, np.full(len(corners), 0.5), compliance=soft, damping=soft, break_at=1e9)


ALL = {name: (row.points, lambda c, row=row: compliant(row, c)) for name, row in ROWS.items()}
ALL |= {name: (points, make) for name, (points, make, _) in OTHERS.items()}
WALLS = {  # with other corners, and with other numbers of facets
    "Polygon": (9 + SQUARE[:1], lambda c: tv.Polygon([*(len(c) * SQUARE), *[(-len(c), 0.0)] * (len(c) > 2)])),
    "Mesh": (
        9 + CUBE[:1],
        lambda c: tv.Mesh(
            np.concatenate([len(c) * CUBE + 99.0 * k for k in range(len(c) // 2)]),
            np.concatenate([np.array(CUBE_FACES) + 8 * k for k in range(len(c) // 2)]),
        ),
    ),
}


@pytest.mark.filterwarnings("ignore:Path")  # which warns of points off the curve
@pytest.mark.parametrize("name", ALL | WALLS)
def test_kernels_depend_on_no_number_of_anything(world, name, monkeypatch):
    # The text of a world, which decides what is compiled, is the same for two constraints and for four, with more or fewer free
    # particles, for other sizes of the scene, and before and after steps of several lengths. Steps run without their kernels,
    # which cannot write to Python objects and compile long.
    monkeypatch.setattr(CachedLaunch, "__call__", lambda launch: None)
    for kernel in ("to_velocity", "velocities"):
        monkeypatch.setattr(Step, kernel, lambda *arguments: None)
    points, make = (ALL | WALLS)[name]
    m, dim = points.shape

    def built(count, free, far):
        x = np.concatenate([*(points + far * k for k in range(count)), np.full((free, dim), 99.0) + np.arange(free)[:, None]])
        mass, options = np.arange(len(x)) + 1.0, {"substeps": 1, "precision": "f64"}
        return world(tv.Particles(x, mass=mass), [tv.Gravity(count), make(np.arange(count * m).reshape(count, m))], **options)

    def written(w):
        return [sharing.KernelInputs(part).key for part in (w._runner.step, w._runner.diagnostics)]

    one, more = built(2, 2, 0.0), built(4, 7, 20.0)
    first = written(one)
    assert written(more) == first
    for w in (one, more):
        w.step(1 / 60)
        w.substeps = 7
        w.step(1 / 50)
        assert written(w) == first
        w.add(tv.Particles(points + 200.0))
        assert written(w) == first
        w.remove([len(w.particles) - 1])
        assert written(w) == first


class Untold(np.ndarray):
    """An array whose content must not be read."""

    def refuse(self, *args, **kwargs):
        raise AssertionError("a kernel reads what an array holds")

    shape = size = property(refuse)
    __len__ = __getitem__ = __array_ufunc__ = __array_function__ = __float__ = __int__ = __bool__ = __iter__ = tolist = refuse


class Translated(Exception):
    """What ends a launch once its kernel is translated."""


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_what_is_left_out_of_the_text_is_not_read(world, monkeypatch, dim):
    # Compiled code is a function of what is read. So while kernels are translated, nothing that sharing.KernelInputs leaves out
    # may be read: attributes for the host, and the content of arrays.
    translating, materialize = [False], Kernel.materialize
    modules = [m for name, m in sys.modules.items() if name.startswith("tiverlet.") and "patches" not in name]
    for kind in {o for m in modules for o in vars(m).values() if inspect.isclass(o) and o.__module__.startswith("tiverlet.")}:
        whole = kind.__bases__ == (object,) or "__getattribute__" in vars(kind)
        if "patches" in kind.__module__ or issubclass(kind, (BaseException, np.ndarray)) or not whole:
            continue

        def read(self, name, plain=kind.__getattribute__):
            value = plain(self, name)
            if translating[0] and name in object.__getattribute__(self, "__dict__"):
                knob = name in knobs_of(type(self)) and not getattr(type(self), name).built  # see Feature.compiled()
                told = sharing.may_read(type(self), name) or knob or name.startswith("__")
                assert told, f"a kernel reads {name} of a {type(self).__name__}"
                return value.view(Untold) if isinstance(value, np.ndarray) else value
            return value

        monkeypatch.setattr(kind, "__getattribute__", read)

    def translate(self, key=None, args=None, arg_features=None):
        translating[0] = True
        try:
            materialize(self, key=key, args=args, arg_features=arg_features)
        finally:
            translating[0] = False
        raise Translated

    points, features = [np.random.default_rng(0).normal(size=(9, dim))], []
    for corners, make in (some for some in ALL.values() if some[0].shape[1] == dim):
        features.append(make(sum(map(len, points)) + np.arange(len(corners))[None]))
        points.append(corners)
    walls = [tv.Box([-9.0] * dim, [9.0] * dim), tv.HalfSpace(np.eye(dim)[1], -8.0), tv.Ball([0.0] * dim, 9.0, inside=True)]
    push = [tv.Gravity(9.81), tv.Drag(0.1), tv.Contact(friction=0.5, restitution=0.5), *walls]
    r = world(tv.Particles(np.concatenate(points), radius=0.01), [*features, *push])._runner
    monkeypatch.setattr(Kernel, "materialize", translate)
    for name, given in (("fused", r.sheet), ("to_velocity", np.zeros(2))):
        with pytest.raises(Translated), r.memory.compiler():
            getattr(r.step, name)(given)


def test_what_functions_of_the_user_know_is_part_of_the_structure(world):
    # Taichi compiles numbers and arrays from around a function into the kernel. x = cos(omega t).
    def force(strength, table):
        @ti.func
        def pull(x):
            return -strength * x * ti.static(float(table[1]))

        return tv.Force(pull)

    for strength, table in ((1.0, [5.0, 1.0]), (2.0, [5.0, 1.0]), (2.0, [5.0, 2.0]), (1.0, [5.0, 1.0])):
        w = world(tv.Particles([[1.0, 0.0]]), [force(strength, np.array(table))], substeps=50)
        w.run(0.2, dt=0.1)
        assert w.position[0, 0] == pytest.approx(np.cos(np.sqrt(strength * table[1]) * 0.2), abs=1e-5)


@pytest.mark.slow
def test_more_fields_than_taichi_has_nodes_for_are_refused(world):
    # 1024 nodes with the root. Where one more was tried, Taichi left its runtime in pieces, and the process ended later.
    for width, length, most in ((0, 3, 511), (3, 3, 255), (0, 0, 511), (3, 0, 170)):
        declared = layout.Declared(ti.f32, width, length, False)
        layout.Layout((declared,) * most).destroy()
        with pytest.raises(ValueError, match=r"need \d+ fields and components, but Taichi has room for 1024"):
            layout.Layout((declared,) * (most + 1))
    w = world(tv.Particles([(0.0, 0.0)]), [tv.Gravity()])
    w.step(0.1)
    assert w.velocity[0, 1] == pytest.approx(-0.981)


@pytest.mark.slow
def test_many_worlds_one_after_the_other_take_no_more_than_a_few():
    # Whether they are closed or garbage-collected; more than the 511 trees that Taichi has would end the process. Fields cannot
    # grow: worlds share trees and give their memory back, also where particles come and go.
    point = tv.Particles([[0.0, 0.0]])
    for _ in range(2):
        tv.World(point, [tv.Gravity()]).step(0.1)
    trees, known = runtime.trees, len(sharing._known)
    many = [tv.World(point, [tv.Gravity(float(k))]) for k in range(600)]
    for w in many:
        w.step(0.1)
    assert [w.velocity[0, 1] for w in many[:3]] == pytest.approx([0.0, -0.1, -0.2])
    assert runtime.trees <= trees + 6 and len(sharing._known) <= known + 6

    def live(k: int) -> None:
        x = 1.5 * tv.golden(np.arange(23 + k % 7), dim=2)
        w = tv.World(tv.Particles(x, radius=0.1), [tv.Gravity(), tv.Contact()], substeps=2)
        for edit in (lambda: w.add(tv.Particles(x[: 1 + k % 3] + [0, 9], radius=0.1)), lambda: w.remove([0])):
            w.step(1 / 60)
            edit()
        w.step(1 / 60)
        if k % 2:
            w.close()

    for k in range(90):
        if k == 20:
            trees, before = runtime.trees, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        live(k)
    # KiB; a world with its own tree would take 100
    assert runtime.trees == trees and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 4 << 10
