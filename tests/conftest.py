"""One Taichi for the whole run, of the architecture TIVERLET_ARCH (cpu); worlds are closed after each test."""

import contextlib
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest
import taichi as ti
from taichi.lang import ops

import tiverlet as tv
from tiverlet.device import thread_team
from tiverlet.device.patches import source_cache
from tiverlet.report.accuracy.cases import entries, known
from tiverlet.step import build

# Taichi keeps kernels that it has compiled, by their content, and finds them when a worker comes by the same tests in the same
# order: a second run takes half of the time or less. All of them are about as large as what it keeps by default, 100 MB.
os.environ.setdefault("TI_OFFLINE_CACHE_MAX_SIZE_OF_FILES", str(512 << 20))

ARCH = os.environ.get("TIVERLET_ARCH", "cpu")
SOURCES = str(pathlib.Path(tv.__file__).parent)
# Functions of tests are compiled as ours are, in a third of the time; those of these files are a user's, as those in the pages
# and demos are, and get the whole of Taichi's analysis.
USERS = ("test_free_motion", "test_walls")
OURS = tuple(str(path) for path in pathlib.Path(__file__).parent.rglob("*.py") if path.stem not in USERS)
CASES = {name: known(name) for name in entries()}
CROSSOVER = build.CROSSOVER  # particles and constraints from which a world has a team of threads by default


@pytest.fixture(scope="session", autouse=True)
def taichi():
    tv.init(arch=ARCH)
    assign = ops.assign

    def checked(to, value):
        """Refuse, in our own kernels, what compiles only with Taichi's analysis; without it LLVM ends the process."""
        whole = not to.ptr.is_tensor() and value.ptr.is_tensor()
        truth = to.ptr.get_rvalue_type() == ti.u1 and value.ptr.get_rvalue_type() != ti.u1
        if (whole or truth) and any(place in ops.stack_info() for place in (SOURCES, *OURS)):
            raise TypeError(f"a {'vector' if whole else 'number'} is assigned to a variable that is not one:\n{ops.stack_info()}")
        return assign(to, value)

    ops.assign = checked
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
        # The cores are all taken by workers: threads of one team would wait for those of another, for three times as long as one
        # takes for all. The bits are the same; who wants a team asks for path="parallel".
        build.CROSSOVER = sys.maxsize
    home, source_cache.HOME = source_cache.HOME, source_cache.HOME + OURS
    yield
    ops.assign, source_cache.HOME, build.CROSSOVER = assign, home, CROSSOVER


@pytest.fixture
def world():
    """tv.World, for worlds that are closed when the test ends. path="launched": parallel as on a GPU, in many launches."""
    made = []

    def build(*args, **kwargs):
        launched = kwargs.get("path") == "launched"
        try:
            with thread_team.launching() if launched else contextlib.nullcontext():
                made.append(tv.World(*args, **(kwargs | {"path": "parallel"} if launched else kwargs)))
        except ValueError as e:
            if ARCH not in tv.runtime.LLVM and ARCH in str(e):  # refused because of the architecture
                pytest.skip(str(e))
            raise
        return made[-1]

    yield build
    for w in made:
        w.close()


def case(name: str) -> dict:
    """An entry of cases.json, the file of known answers in tiverlet/report/cases."""
    return CASES[name]


def pendulums(name: str):
    """The chain of a D case: position, mass, pairs; particle 0 is the anchor."""
    p = case(name)["params"]
    if name == "D06_chain100":  # "100 x 0.01", "all 90"
        p = {"theta0_deg": [90.0] * 100, "lengths": [0.01] * 100, "masses": [0.01] * 100}
    angle = np.radians(p["theta0_deg"])
    steps = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * np.array(p["lengths"])[:, None]
    k = np.arange(len(angle))
    return (
        np.vstack([[0, 0], np.cumsum(steps, axis=0)]),
        np.r_[1.0, p["masses"]],
        np.stack([k, k + 1], axis=1),
    )


def figures(name: str, t: float, substeps: int) -> dict[str, float]:
    """RMS errors [m] of the prototypes of a case at time t, by method."""
    rows = case(name)["prototype_errors"]
    return next(r["rms_error_m"] for r in rows if r["t"] == t and r["substeps_per_frame_60hz"] == substeps)


def rms(position, reference) -> float:
    """Root mean square distance [m]."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(position) - np.asarray(reference)) ** 2, axis=-1))))


def rerun(w: tv.World, seconds: float, dt: float = 1 / 60, **settings) -> tv.World:
    """Put a world back to its start and run it with other substeps or iterations, which costs no compilation."""
    w.position, w.velocity = w.particles.position, w.particles.velocity
    for name, value in settings.items():
        setattr(w, name, value)
    w.run(seconds, dt=dt)
    return w


def order(errors, factor: float = 2.0) -> float:
    """Fitted order of convergence, for errors at h, h / factor, h / factor^2, ..."""
    k = np.arange(len(errors)) * np.log(factor)
    return float(-np.polyfit(k, np.log(errors), 1)[0])


def python(code: str, *, check: bool = True, timeout: float = 120.0, **env) -> subprocess.CompletedProcess:
    """Run code in a fresh interpreter, from a file, since Taichi reads the source of kernels."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "script.py"
        path.write_text(code)
        done = subprocess.run(
            [sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning", str(path)],
            capture_output=True, text=True, timeout=timeout, env={**os.environ, **env}, cwd=folder,
        )  # fmt: skip
    if check and done.returncode:
        raise AssertionError(f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done
