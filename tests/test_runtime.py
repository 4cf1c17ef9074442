"""Causes that would end the process without an exception raise an error instead. Each case has its own process."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import layout, runtime, ti
from tiverlet.device import memory as fields
from tiverlet.device.host_copy import offsets_in_tree
from tiverlet.device.memory import Memory
from tiverlet.step import build

from .conftest import python

START = """
import numpy as np
import tiverlet as tv
def world(**kwargs):
    return tv.World(tv.Particles([[0.0, 1.0], [1.0, 1.0]]), [tv.Gravity(9.81), tv.Distance([[0, 1]])], **kwargs)
def expect(error, words, run):
    try:
        run()
    except error as e:
        assert words in str(e), str(e)
    else:
        raise SystemExit("no error")
"""


def test_the_host_sees_the_fields_as_kernels_do():
    # Fields of every kind and shape side by side: a kernel reads what the host writes, and the other way round, bit for bit.
    memory, rng = Memory(ti.f32), np.random.default_rng(0)
    kinds = ((ti.f32, np.float32), (ti.f64, np.float64), (ti.i32, np.int32))
    want = {}
    for k in range(40):
        kind, exact = kinds[rng.integers(3)]
        length, width = [None, 1, 2, 7, 1000][rng.integers(5)], rng.integers(5)
        memory.field(f"f{k}", length, width=int(width), kind=kind)
        shape = (length or 1,) + ((width,) if width else ())
        want[f"f{k}"] = (rng.normal(size=shape) * 1e6).astype(exact)
    memory.place()
    views, entries = memory._host_views(), memory.entries
    assert len(views) == len(entries)
    for first, then in ((views, {}), ({}, views)):
        for sign in (-1, 1):
            memory._views = first
            memory._load(entries, [sign * want[e.name].astype(np.float64) for e in entries])
            memory._views = then
            for e, got in zip(entries, memory._dump(entries), strict=True):
                assert got.dtype == e.kind
                np.testing.assert_array_equal(got, sign * want[e.name])
    memory.destroy()
    with pytest.raises(RuntimeError, match="closed"):
        memory.state()


def test_f64_fields_can_stand_apart(monkeypatch):
    # As on Vulkan: f64 fields have their own tree, which shows in nothing else. The lengths would put an f64 between multiples of
    # 8.
    monkeypatch.setattr(fields, "aligned", lambda: False)
    monkeypatch.setattr(layout, "_unshared", True)
    rng = np.random.default_rng(0)
    plans = {
        "two": [(ti.i32, 3, 0), (ti.f64, 4, 0), (ti.f32, 5, 3), (ti.f64, None, 2), (ti.u32, 1, 0), (ti.i32, None, 0)],
        "wide": [(ti.f64, 3, 2), (ti.f64, None, 0)],
        "narrow": [(ti.i32, 3, 0), (ti.f32, None, 0)],
    }
    for name, plan in plans.items():
        memory, want, made = Memory(ti.f32), {}, {}
        for k, (kind, length, width) in enumerate(plan):
            value = rng.integers(0, 2**20, (length or 1,) + ((width,) if width else ())).astype(fields._NUMPY[kind])
            want[f"f{k}"] = value if kind in (ti.i32, ti.u32) else value / 7
            made[f"f{k}"] = memory.field(f"f{k}", length, width=width, kind=kind, values=want[f"f{k}"], state=True)
        memory.place()
        roots = {e.name: offsets_in_tree(e.field)[1].id for e in memory.entries}
        wide = {roots[e.name] for e in memory.entries if e.kind == np.float64}
        narrow = {roots[e.name] for e in memory.entries if e.kind != np.float64}
        assert not wide & narrow and len(wide | narrow) == (2 if name == "two" else 1)
        before = memory.state()
        for key, field in made.items():
            np.testing.assert_array_equal(memory.read(field), want[key])
            memory.write(field, 2 * want[key])
            np.testing.assert_array_equal(memory.read(field), 2 * want[key])
        memory.restore(before)
        for key, value in memory.state().items():
            np.testing.assert_array_equal(value, want[key])
        memory.destroy()
        memory.destroy()
        with pytest.raises(RuntimeError, match="closed"):
            memory.state()
        given_up = Memory(ti.f32)
        for k, (kind, length, width) in enumerate(plan):
            given_up.field(f"f{k}", length, width=width, kind=kind)
        given_up.destroy()
    Memory(ti.f32).destroy()
    after = Memory(ti.f64)  # earlier failures poisoned nothing
    last = after.field("last", 2, values=[1.5, 2.5])
    after.place()
    assert after.read(last).tolist() == [1.5, 2.5]
    after.destroy()


def test_what_spirv_lacks_is_refused(monkeypatch):
    x, k = np.eye(4, 3), np.arange(4)
    flowing = tv.ShapeMatch([k], compliance=1.0, creep=1.0)
    asked = (tv.Bend([k[:3]]), tv.AngleLimit([k[:3]], 0.0, 1.0), tv.Dihedral([k]), tv.Volume([k]), flowing)
    monkeypatch.setattr(runtime, "architecture", lambda: "vulkan")
    for feature in asked:
        with pytest.raises(ValueError, match=f"World: {feature!r} takes an angle.*, which vulkan has for f32 only"):
            tv.World(tv.Particles(x), [feature], precision="f64")
    with pytest.raises(ValueError, match='"f32-compensated" needs exact rounding, which Taichi does not have on vulkan'):
        tv.World(tv.Particles(x), precision="f32-compensated")
    for feature in (tv.ShapeMatch([k]), tv.Distance([k[:2]])):
        build.check_architecture("f64", (feature,))
    build.check_architecture("f32", asked)


def test_import_is_quiet_and_starts_nothing():
    # The import and the first world print nothing and open no socket. Every attempt to open one ends the process, in Python and
    # in the threads that it starts.
    done = python(
        """
import os, socket, sys, time
def refused(*a, **k):
    os._exit(7)
socket.socket.connect = socket.create_connection = socket.getaddrinfo = refused
import tiverlet as tv
from tiverlet.device import ti
assert ti.cfg is None, "started at import"
assert "matplotlib" not in sys.modules
assert not any(n.startswith("rerun") for n in sys.modules)
w = tv.World(tv.Particles([[0.0, 0.0]]), [tv.Gravity()])
w.step(0.1)
assert ti.cfg.fast_math == 0 and ti.cfg.default_fp == ti.f32
time.sleep(0.5)
""",
        fresh=True,
    )
    assert done.stdout == "" and done.stderr == ""


def test_a_second_start_is_an_error_not_a_crash():
    python(
        START
        + """
from tiverlet.device import ti
tv.init(threads=np.int64(2), seed=np.int32(0))
w = world()
w.step(0.1)
expect(RuntimeError, "already runs", lambda: tv.init(threads=1))
tv.init(threads=2)  # the same settings: nothing happens
w.step(0.1)
ti.init(arch=ti.cpu, log_level=ti.ERROR)
x = w.particles.position
for run in (lambda: w.step(0.1), lambda: w.position, lambda: w.velocity, w.hash, lambda: setattr(w, "position", x),
            lambda: setattr(w, "velocity", x), w.clone):
    expect(RuntimeError, "started again", run)
w.close()
new = world()
new.step(0.1)
assert new.position[0, 1] < 1
expect(RuntimeError, "already runs", tv.init)  # the user's own start is used as it is
"""
    )


def test_reset_and_close():
    python(
        START
        + """
from tiverlet.device import ti
w = world()
with world() as other:
    other.step(0.1)
for run in (lambda: other.step(0.1), lambda: other.position, other.hash):
    expect(RuntimeError, "closed", run)
other.close()
ti.reset()
expect(RuntimeError, "started again", lambda: w.step(0.1))
w2 = world()
w2.step(0.1)
"""
    )


def test_a_users_own_start_is_used_as_it_is():
    python(
        START
        + """
from tiverlet.device import ti
ti.init(arch=ti.cpu, default_fp=ti.f64, fast_math=True, log_level=ti.ERROR)
w = world(precision="f64")
w.run(1.0)
assert abs(w.position[0, 1] - (1 - 9.81 / 2)) < 1e-11
expect(ValueError, "fast_math=True", lambda: world(precision="f32-compensated"))
assert tv.runtime.fast_math()
"""
    )


def test_worlds_are_capped_and_freed():
    python(
        START
        + """
from tiverlet.device import layout
tv.init()
point = tv.Particles([[0.0, 0.0]])
layout.MAX_TREES = 12  # the rule, without the minutes that 400 worlds take
with layout.unshared():
    many = [tv.World(point) for _ in range(12)]
    expect(RuntimeError, "worlds are alive", lambda: tv.World(point))
for w in many:
    w.close()
class Broken(tv.Gravity):
    def bind(self, scene):
        scene.memory.field("half", 3)
        raise KeyError("a feature that fails half-way")
expect(KeyError, "half-way", lambda: tv.World(point, [Broken()]))
for _ in range(30):
    tv.World(point).close()
tv.World(point).step(0.1)
"""
    )


def test_memory_of_closed_worlds_is_returned():
    python(
        """
import gc
import numpy as np
import resource
import tiverlet as tv
x = np.zeros((1_000_000, 2))
peak = []
for _ in range(14):
    tv.World(tv.Particles(x), [tv.Gravity()]).close()
    gc.collect()
    peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
# 20 MB of fields each: nine of them at once would be 180 MB.
assert peak[-1] - peak[4] < 60, peak
"""
    )


def test_missing_architectures_are_errors_by_name():
    done = python(
        """
from tiverlet.device import ti
import tiverlet as tv
for arch in ("cuda", "metal", "vulkan"):
    try:
        tv.init(arch=arch)
    except RuntimeError as e:
        assert f'"{arch}" is not available' in str(e) and "Available: 'cpu'" in str(e), e
        assert ti.cfg is None
    else:
        assert tv.runtime.architecture() == arch
        ti.reset()
tv.World(tv.Particles([[0.0, 0.0]])).step(0.1)
assert tv.runtime.architecture() == "cpu"
"""
    )
    assert done.stdout == ""


def test_forked_children_and_other_threads_are_told():
    python(
        START
        + """
import os, threading
w = world()
pid = os.fork()
if pid == 0:
    try:
        expect(RuntimeError, "fork", lambda: w.step(0.1))
        expect(RuntimeError, "fork", world)
    except BaseException:
        os._exit(1)
    os._exit(0)
assert os.waitpid(pid, 0)[1] == 0
caught = []
def build():
    try:
        world()
    except RuntimeError as e:
        caught.append(str(e))
t = threading.Thread(target=build)
t.start()
t.join()
assert "thread that started Taichi" in caught[0]
t = threading.Thread(target=lambda: w.step(0.1))
t.start()
t.join()
assert w.time == 0.1
"""
    )
