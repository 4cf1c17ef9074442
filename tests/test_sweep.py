"""tv.sweep: the same bits wherever and however its parts are computed, and workers that die."""

import contextlib
import functools
import importlib
import multiprocessing
import os
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest

import tiverlet as tv
from tests.conftest import python
from tests.sweeps import SECONDS, STARTS, G, ball, ends, height, pendulum, wrong


def same(a: tv.SweepResult, b: tv.SweepResult) -> bool:
    return all(a[name].tobytes() == b[name].tobytes() and a[name].dtype == b[name].dtype for name in ("end", "speed"))


@pytest.fixture(scope="module")
def here() -> tv.SweepResult:
    return tv.sweep(pendulum, STARTS, ends)


SPEEDS = np.arange(6.0)
SOME = {"speed": SPEEDS}
HEIGHTS = SPEEDS * 0.5 - G * 0.5**2 / 2  # y = v t - g t^2 / 2


@contextlib.contextmanager
def pool(count: int, start: str = "spawn"):
    with ProcessPoolExecutor(count, mp_context=multiprocessing.get_context(start)) as made:
        yield made


@pytest.mark.slow
def test_figures_are_those_of_each_world_by_itself_in_parts_of_any_size(here):
    assert list(here) == ["end", "speed", "process", "threads"] and here["end"].shape == (7, 3, 2) and here.repeated == ()
    for k in range(7):
        with pendulum(*(float(v[k]) for v in STARTS.values())) as world:
            world.run(SECONDS)
            assert here["end"][k].tobytes() == world.position.tobytes()
            assert here["speed"][k].tobytes() == world.velocity.tobytes()
    assert repr(here).startswith("SweepResult(end: (7, 3, 2) float64, speed:")
    rows = [dict(zip(STARTS, row, strict=True)) for row in zip(*STARTS.values(), strict=True)]
    assert all(same(here, tv.sweep(pendulum, rows, ends, at_once=n, progress=True)) for n in (1, 3))


@pytest.mark.slow
def test_processes_have_the_same_bits_and_share_the_cores(here, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")  # for workers of executors; workers of the sweep set their own
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    found = tv.sweep(pendulum, STARTS, ends, executor=2)  # in 4 + 3, so that both have work
    assert same(here, found) and len(set(found["process"]) - {os.getpid()}) == 2
    assert set(found["threads"]) == {max(1, cores // 2)}


@pytest.mark.slow
def test_dask_has_the_same_bits_and_survives_a_worker_that_dies(here, tmp_path):
    dask, distributed = map(importlib.import_module, ("dask.config", "distributed"))  # here, otherwise every worker imports them
    with (
        dask.set({"distributed.scheduler.allowed-failures": 0}),
        # Threads of one worker would start Taichi in any of them.
        distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=True, dashboard_address=":0") as cluster,
        distributed.Client(cluster) as client,
    ):
        found = tv.sweep(pendulum, STARTS, ends, client, at_once=2)
        assert same(here, found) and os.getpid() not in found["process"]
        assert same(here, tv.sweep(lambda **row: pendulum(**row), STARTS, lambda w: ends(w), client.get_executor(), at_once=4))
        make = functools.partial(ball, marker=str(tmp_path / "died"))
        with pytest.warns(RuntimeWarning, match=r"KilledWorker"):
            found = tv.sweep(make, SOME, height, client, at_once=3)
    np.testing.assert_allclose(found["y"], HEIGHTS, atol=1e-6)
    assert range(0, 3) in [r.numbers for r in found.repeated] and {r.by for r in found.repeated} == {"the executor"}


@pytest.mark.slow
def test_what_a_process_did_when_it_died_is_named_and_done_again(tmp_path):
    make = functools.partial(ball, marker=str(tmp_path / "died"))
    told = r"parameters 0 to 2, make\(speed=0.0\) to make\(speed=2.0\) is done again: worker process \d+ was ended by SIGKILL"
    with pytest.warns(RuntimeWarning, match=rf"{told}.* in make\(speed=2.0\), number 2"):
        found = tv.sweep(make, SOME, height, executor=1, at_once=3)
    np.testing.assert_allclose(found["y"], HEIGHTS, atol=1e-6)
    (again,) = found.repeated
    assert again.numbers == range(0, 3) and again.parameters[2] == {"speed": 2.0} and again.by == "another process"
    assert "SIGKILL" in str(again) and "done again: 1 part" in repr(found)


@pytest.mark.slow
def test_what_a_pool_loses_is_done_by_other_processes(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")  # which the pool uses
    make = functools.partial(ball, marker=str(tmp_path / "died"))
    with pool(1) as executor, pytest.warns(RuntimeWarning, match="BrokenProcessPool"):
        found = tv.sweep(make, SOME, height, executor, at_once=1)
    np.testing.assert_allclose(found["y"], HEIGHTS, atol=1e-6)
    assert found["threads"][:2].tolist() == [3, 3] and os.getpid() not in found["process"]
    # The parts that the pool computed when it broke: the one that ended it, and at most one more.
    assert range(2, 3) in [r.numbers for r in found.repeated] and len(found.repeated) <= 2
    assert {r.by for r in found.repeated} == {"another process"}
    with pool(1) as executor:
        executor.shutdown()
        with pytest.raises(RuntimeError, match="after shutdown"):  # a pool that never worked is not replaced
            tv.sweep(ball, SOME, height, executor)


@pytest.mark.slow
def test_parameters_that_end_every_worker_are_named():
    make = functools.partial(ball, marker="any", always=True)
    told = r"parameters 2, make\(speed=2.0\) could not be done, because its worker died 3 times: .*exit code 3"
    with pytest.warns(RuntimeWarning), pytest.raises(RuntimeError, match=told):
        tv.sweep(make, SOME, height, executor=1, at_once=1)


def raised(kind, *args) -> tuple[str, str]:
    """Return the message of an exception of a sweep, and its notes."""
    with pytest.raises(kind) as caught:
        tv.sweep(*args)
    return str(caught.value), "".join(caught.value.__notes__)


def test_what_functions_raise_comes_with_the_parameters():
    text, note = raised(ArithmeticError, wrong, [{"speed": 1.0}, {"speed": 2.5, "how": "raise"}], height)
    assert text == "no" and note == "sweep: raised by parameters 1, make(speed=2.5, how='raise')"
    text, note = raised(KeyError, ball, SOME, lambda worlds: {}["y"])
    assert text == "'y'" and "parameters 0 to 5, make(speed=0.0) to make(speed=5.0)" in note
    text, note = raised(TypeError, wrong, [{"speed": 1.0, "how": "a word"}], height)
    assert "make returned 'a word', a str, but a tv.World is needed" in text and "parameters 0" in note
    with ball(1.0) as one:
        text, note = raised(ValueError, lambda speed: one, SOME, height)
    assert "the same World again" in text and "parameters 1" in note
    text, note = raised(RuntimeError, wrong, [{"speed": 1.0}, {"speed": 2.5, "how": "unsendable"}], height, 1)  # in a process
    assert text == "Unsendable: one and other" and "parameters 1, make(speed=2.5, how='unsendable')" in note
    assert 'raise Unsendable("one", "other")' in note  # the line in the worker's traceback


@pytest.mark.parametrize(
    "found, words",
    [
        ([0.0] * 6, r"figures returned a list, but a dict of arrays is needed"),
        ({"y": 1.0}, r"'y' with shape \(\), but there are 6 worlds here"),
        ({"y": np.zeros((2, 6))}, r"'y' with shape \(2, 6\), but there are 6 worlds"),
        ({"y": [[0.0]] * 5 + [[0.0, 1.0]]}, "'y' with rows of different lengths"),
        ({"y": [None] * 6}, "'y' with Python objects in it"),
    ],
)
def test_figures_must_be_arrays_with_a_row_for_each_world(found, words):
    with pytest.raises((TypeError, ValueError), match=words):
        tv.sweep(ball, SOME, lambda worlds: found)


def test_figures_must_be_the_same_in_all_parts():
    lengths, told = iter((1, 2)), r"'y' with rows of shape \(2,\) for parameters 3 to 5.* but of shape \(1,\) for parameters 0"
    with pytest.raises(ValueError, match=told):
        tv.sweep(ball, SOME, lambda w: {"y": np.zeros((len(w), next(lengths)))}, at_once=3)
    names = iter("ab")
    with pytest.raises(ValueError, match=r"figures returned \['b'\] for parameters 3 to 5.*, but \['a'\] for"):
        tv.sweep(ball, SOME, lambda w: {next(names): np.zeros(len(w))}, at_once=3)


@pytest.mark.parametrize(
    "kind, words, arguments",
    [
        (TypeError, "make = 3 is a int, but a function is needed", (3, SOME, height)),
        (TypeError, "figures = None is a NoneType, but a function is needed", (ball, SOME, None)),
        (ValueError, "parameters are empty", (ball, {"speed": []}, height)),
        (ValueError, "parameters are empty", (ball, [], height)),
        (TypeError, "parameters = 3 is a int, but a dict of arrays or a list of dicts is needed", (ball, 3, height)),
        (TypeError, r"parameters\[1\] = 3 is a int, but a dict such as", (ball, [{"speed": 1.0}, 3], height)),
        (TypeError, r"\['speed'\] = 2.0 is a float, but a list .* write it into make", (ball, {"speed": 2.0}, height)),
        (TypeError, r"parameters\['speed'\] = 'abc' is a str", (ball, {"speed": "abc"}, height)),
        (TypeError, r"does not take parameters 0, make\(1=0.0\): keywords must be strings", (ball, {1: SPEEDS}, height)),
        (ValueError, "equally long, but angle has 2, length has 3", (pendulum, {"angle": [1, 2], "length": [1, 2, 3]}, height)),
        (TypeError, r"does not take parameters 0, make\(sped=0.0\): missing .*'speed'", (ball, {"sped": SPEEDS}, height)),
        (TypeError, r"does not take parameters 1, make\(\)", (ball, [{"speed": 1.0}, {}], height)),
        (ValueError, "at_once = 0, but it must be at least 1", (ball, SOME, height, None, 0)),
        (TypeError, "progress = 1 is a int", (ball, SOME, height, None, 1, 1)),
        (ValueError, "executor = 0, but it must be at least 1", (ball, SOME, height, 0)),
        (TypeError, "executor = True is a bool", (ball, SOME, height, True)),
        (TypeError, "'dask' is a str, but None, a number of processes or an object with submit", (ball, SOME, height, "dask")),
        (TypeError, "is a class, not an object, but None", (ball, SOME, height, ProcessPoolExecutor)),
        (TypeError, "threads of one process share one Taichi", (ball, SOME, height, ThreadPoolExecutor(1))),
        (TypeError, "must be sent to other processes, but .*no lambda", (lambda speed: ball(speed), SOME, height, 2)),
    ],
)  # fmt: skip
def test_arguments_are_checked_first(kind, words, arguments):
    with pytest.raises(kind, match=words):
        tv.sweep(*arguments)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="needs fork")
def test_pools_that_fork_are_refused():
    told = r'hangs after a fork. Type executor=4 .* mp_context=multiprocessing.get_context\("spawn"\)'
    with pool(1, "fork") as executor, pytest.raises(ValueError, match=told):
        tv.sweep(ball, SOME, height, executor)


def test_a_prompt_is_told_where_to_write_its_functions():
    # Processes import __main__ by its file; a prompt has none.
    code = (
        "import sys\nimport tiverlet as tv\ndel sys.modules['__main__'].__file__\n"
        "def make(k):\n    pass\ndef figures(worlds):\n    pass\n"
        "try:\n    tv.sweep(make, {'k': [1]}, figures, executor=1)\nexcept AttributeError as e:\n    print(e.__notes__)"
    )
    assert "Write them at the top of a file" in python(code).stdout


def test_futures_that_are_cancelled_are_done_by_others():
    # As when a cluster goes away: its futures are cancelled, and then it accepts no more.
    class Gone:
        def __init__(self):
            self.calls = 0

        def submit(self, *args):
            self.calls += 1
            if self.calls > 2:
                raise RuntimeError("gone")
            future: Future = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    def make(speed):  # cannot be sent to processes, so this one computes it
        return ball(speed)

    with pytest.warns(RuntimeWarning, match="is done again: CancelledError"):
        found = tv.sweep(make, SOME, height, Gone(), at_once=3)
    np.testing.assert_allclose(found["y"], HEIGHTS, atol=1e-6)
    assert [r.by for r in found.repeated] == ["this process"] * 2
