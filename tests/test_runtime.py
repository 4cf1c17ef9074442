"""Causes that would end the process without an exception raise an error instead. Each case has its own process."""

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import layout, runtime, ti
from tiverlet.device import memory as fields
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


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
def test_the_host_sees_the_fields_as_kernels_do(monkeypatch, apart):
    # Fields of every kind and shape side by side: a kernel reads what the host writes, and the other way round, bit for bit. As
    # on Vulkan, f64 fields have a tree of their own (apart), which shows in nothing else.
    monkeypatch.setattr(fields, "aligned", lambda: not apart)
    if apart:
        monkeypatch.setattr(layout, "can_share", lambda: False)
    memory, rng, want = Memory(ti.f32), np.random.default_rng(0), {}
    for kind, exact in ((ti.f32, np.float32), (ti.f64, np.float64), (ti.i32, np.int32)):
        for k, (length, width) in enumerate(((None, 0), (1, 2), (7, 0), (7, 3), (1000, 4))):
            name = f"{exact.__name__}{k}"
            memory.field(name, length, width=width, kind=kind, state=True)
            want[name] = (rng.normal(size=(length or 1,) + ((width,) if width else ())) * 1e6).astype(exact)
    memory.place()
    views, entries = memory._host_views(), memory.entries
    assert len(views) == len(entries) or apart
    for first, then in ((views, {}), ({}, views)):  # by the host's views, and by kernels
        memory._views = first
        memory._load(entries, [want[e.name].astype(np.float64) for e in entries])
        memory._views = then
        for e, got in zip(entries, memory._dump(entries), strict=True):
            assert got.dtype == e.kind
            np.testing.assert_array_equal(got, want[e.name])
    memory.destroy()
    memory.destroy()
    with pytest.raises(RuntimeError, match="closed"):
        memory.state()


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


def test_a_second_start_a_reset_what_is_closed_and_what_is_missing_are_errors_not_crashes():
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
expect(RuntimeError, "already runs", tv.init)
ti.reset()
for arch in ("cuda", "metal", "vulkan"):
    try:
        tv.init(arch=arch)
    except RuntimeError as e:
        assert f'"{arch}" is not available' in str(e) and "Available: 'cpu'" in str(e) and ti.cfg is None, e
    else:
        assert tv.runtime.architecture() == arch
        ti.reset()
ti.init(arch=ti.cpu, default_fp=ti.f64, fast_math=True, log_level=ti.ERROR)
new = world(precision="f64")  # the user's own start is used as it is
new.run(1.0)
assert abs(new.position[0, 1] - (1 - 9.81 / 2)) < 1e-11 and tv.runtime.fast_math()
expect(ValueError, "fast_math=True", lambda: world(precision="f32-compensated"))
with world() as other:
    other.step(0.1)
for run in (lambda: other.step(0.1), lambda: other.position, other.hash):
    expect(RuntimeError, "closed", run)
other.close()
ti.reset()
expect(RuntimeError, "started again", lambda: new.step(0.1))
world().step(0.1)
"""
    )


@pytest.mark.slow
def test_worlds_are_capped_and_freed_with_their_memory():
    python(
        START
        + """
import gc, resource
from tiverlet.device import layout
tv.init()
point = tv.Particles([[0.0, 0.0]])
layout.MAX_TREES = 12  # the rule, without the minutes that 400 worlds take
can_share, layout.can_share = layout.can_share, lambda: False
many = [tv.World(point) for _ in range(12)]
expect(RuntimeError, "worlds are alive", lambda: tv.World(point))
layout.can_share = can_share
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
# 20 MB of fields each: nine of them at once would be 180 MB.
x, peak = np.zeros((1_000_000, 2)), []
for _ in range(14):
    tv.World(tv.Particles(x), [tv.Gravity()]).close()
    gc.collect()
    peak.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
assert peak[-1] - peak[4] < 60, peak
"""
    )


@pytest.mark.slow
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
