"""Ctrl-C: a frame is complete or undone, wherever the signal arrives."""

import os
import signal
import sys
import threading

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import interrupts
from tiverlet.step import checkpoint

pytestmark = pytest.mark.usefixtures("read_here")


def frames_of(world, dt=1 / 60):
    """Return how many frames a world has made."""
    return round(world.time / dt)


def pile():
    """Discs that touch, on a rope that breaks. Two overlap, as in worlds of recordings, which so have the same kernels."""
    x = np.array([*([0.3 * k, 0.3 + 0.29 * (k % 2)] for k in range(6)), [2.0, 2.0], [2.3, 2.0]])
    links = tv.Distance([(k, k + 1) for k in range(5)], break_at=2.0)
    features = [tv.Gravity(9.81), tv.Contact(), tv.HalfSpace((0, 1), 0.0), links, tv.Pin([0])]
    return tv.World(tv.Particles(x, radius=0.16), features, substeps=4, iterations=3, path="fused")


@pytest.fixture(scope="module")
def piled():
    with pile() as world:
        yield world


@pytest.fixture
def w(piled):
    """One world for all tests, since compiling it takes longer than everything else."""
    start, passes = checkpoint.keep(piled), piled._runner.passes_at_once
    yield piled
    checkpoint.put_back(piled, start)
    piled.substeps, piled.iterations, piled._runner.passes_at_once = 4, 3, passes


@pytest.mark.slow
def test_a_signal_waits_for_the_end_of_the_frame(w, tmp_path):
    w.substeps = "auto"
    pin = w.features[-1]
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:

        def everything():
            pin.target = [[0.01 * frames_of(w), 0.3]]
            w.position = w.position
            w.step(1 / 60)
            recorder.log()

        everything()  # compiles
        place, came = 0, 0
        lines = [0]

        def watch(frame, event, arg):
            if "tiverlet" in frame.f_code.co_filename:
                lines[0] += event == "line"
                if lines[0] == place and event == "line":
                    lines[0] += 1
                    signal.raise_signal(signal.SIGINT)
                return watch

        while came == place // 83:  # every 83rd of the executed lines, until there are no more
            place, lines[0] = place + 83, 0
            try:
                sys.settrace(watch)
                everything()
            except KeyboardInterrupt:
                came += 1
            finally:
                sys.settrace(None)
        assert came > 10 and lines[0] < place  # no signal was lost
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.complete and recording.verify()
    with recording.world(int(recording.frames[-1])) as again:
        assert frames_of(again) <= frames_of(w)


@pytest.mark.slow
def test_long_frames_in_several_launches_have_the_same_bits(w):
    # Of 12 passes each. For a team, the code between two passes is the same whatever features there are; a rope stands for all.
    chain, start = [tv.Gravity(), tv.Distance([(0, 1)])], tv.Particles([[0, 0], [1, 0]], pinned=[0])
    with (
        tv.World(start, [f.copy() for f in chain], iterations=3, substeps=4, path="parallel") as team,
        tv.World(start, chain, order=4, precision="f64") as precise,
    ):
        for some, passes in ((w, 1), (w, 5), (team, 5), (precise, 5)):
            begin, out = checkpoint.keep(some), []
            for at_once in (some._runner.passes_at_once, passes):
                checkpoint.put_back(some, begin)
                some._runner.passes_at_once = at_once
                out.append([(some.step(1 / 60).residual, some.hash()) for _ in range(6)])
            assert out[0] == out[1]


@pytest.mark.slow
@pytest.mark.parametrize("endless", [{"substeps": 2_000_000_000}, {"iterations": 2_000_000_000}])
def test_an_endless_frame_is_undone(w, endless):
    pin = w.features[-1]
    w.run(0.1)
    start, before = checkpoint.keep(w), pin.target
    pin.target = [[0.05, 0.35]]
    w.run(0.1)
    expected = w.hash()
    checkpoint.put_back(w, start)
    pin.target = before
    pin.target = [[0.05, 0.35]]
    for name, value in endless.items():
        setattr(w, name, value)
    w._runner.passes_at_once = 10_000  # as in a large scene
    timer = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        w.step(1 / 60)
    timer.join()
    w.substeps, w.iterations = 4, 3
    w.run(0.1)
    assert w.hash() == expected


def test_a_handler_that_raises_nothing_is_called_after_the_frame(w):
    seen = []
    before = signal.signal(signal.SIGTERM, lambda *_: seen.append(frames_of(w)))
    try:
        with interrupts.deferred_signals:
            signal.raise_signal(signal.SIGTERM)
            w.step(1 / 60)
            assert not seen
        assert seen == [1]
        thread = threading.Thread(target=w.step, args=(1 / 60,))  # a thread has no signal to wait for
        thread.start(), thread.join()
        assert frames_of(w) == 2
    finally:
        signal.signal(signal.SIGTERM, before)


def test_a_step_that_fails_is_recorded_as_it_is(w, tmp_path):
    with tv.Recorder(tmp_path / "a.rrd", w) as recorder:
        w.run(0.05, recorder=recorder)
        w._runner.__dict__["report"] = lambda *_: 1 / 0
        with pytest.raises(ZeroDivisionError):
            w.step(1 / 60)
        del w._runner.__dict__["report"]
        w.run(0.05, recorder=recorder)
        end = w.hash()
    recording = tv.replay(tmp_path / "a.rrd")
    assert recording.verify()
    with recording.world(6) as again:
        assert again.hash() == end


@pytest.mark.slow
def test_another_thread_that_looks_on_changes_nothing_and_sees_whole_frames(w):
    def go_on(look=None):
        """Return where the particles are after each frame, while another thread looks on."""
        checkpoint.put_back(w, start)
        w.substeps, done, seen = 400, threading.Event(), []

        def watch():
            while not done.is_set():
                seen.append(look())

        thread = threading.Thread(target=watch) if look else None
        places = [w.position]
        if thread:
            thread.start()
        for _ in range(50):
            w.velocity = w.velocity + [0.01, 0.02]
            w.step(1 / 60)
            places.append(w.position)
        done.set()
        if thread:
            thread.join()
        return places, seen

    start = checkpoint.keep(w)
    alone, _ = go_on()
    for look in (lambda: w.near([(0.5, 0.5)], 1.0), lambda: w.contacts, lambda: w.ray((0.5, 2.5), (0, -1)), lambda: w.velocity):
        beside, seen = go_on(look)
        np.testing.assert_array_equal(beside, alone)
        assert len(seen) > 5
    frames = {x.tobytes() for x in alone}
    assert all(x.tobytes() in frames for x in go_on(lambda: w.position)[1])
