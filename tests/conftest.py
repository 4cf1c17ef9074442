"""Fixtures: one Taichi runtime per test file, on the architecture TIVERLET_ARCH (cpu); worlds are closed after each test."""

import ast
import contextlib
import functools
import gc
import json
import os
import pathlib
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from typing import Any

# Set before NumPy is imported, for this process, its workers and the processes that tests start. The workers take all cores,
# and the idle threads of BLAS would take a fifth of the CPU time of a process that only imports.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest

import tiverlet as tv
from tiverlet.device import ti
from tiverlet.device.patches import enabled
from tiverlet.device.patches.compiler import BRIEF
from tiverlet.recording import reader, rrd, scene
from tiverlet.report.accuracy.cases import entries, known
from tiverlet.step import build
from tiverlet.step.clock import Pace

from .launches import launching

# Off until the first test begins: collecting tests leaves little garbage, and searching for it takes a third of the time.
gc.disable()
# Taichi caches compiled kernels by their content, which includes the numbers of the field trees made before. So every test file
# has its own Taichi runtime: a second run finds all kernels and takes a third of the time, and after an edit only what changed
# is compiled. All kernels together exceed the default limit of the cache, 100 MB.
os.environ.setdefault("TI_OFFLINE_CACHE_MAX_SIZE_OF_FILES", str(512 << 20))

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # ignored in background jobs of a shell; tests send it
    signal.signal(signal.SIGINT, signal.default_int_handler)
PATCHED = "sharing" in enabled
collect_ignore = [] if PATCHED else ["test_compiling.py", "test_sharing.py"]  # these files test the patches
# Files that take longest run first: otherwise one worker would still run one of them when the others are done.
LONG = (
    "matrix", "touching_scenes", "scenes", "advice", "cases", "walls", "knobs", "edits", "worlds", "properties", "pictures",
    "answers", "statics", "polygons", "impacts", "body_impacts", "rows", "recordings", "velocity", "guard", "reported_loads",
    "periodic", "determinism", "direct", "sharing", "bodies", "placing", "pairs", "demos", "softness", "sleep", "solvers",
    "order", "docs",
)  # fmt: skip
ARCH = os.environ.get("TIVERLET_ARCH", "cpu")
SOURCES = str(pathlib.Path(tv.__file__).parent)
# checked_assignments() holds functions of tests to the same rule as the package's. Files in USERS try what users may write.
USERS = ("test_free_motion", "test_walls")
OURS = tuple(str(path) for path in pathlib.Path(__file__).parent.rglob("*.py") if path.stem not in USERS)
CASES = {name: known(name) for name in entries()}
CROSSOVER = build.CROSSOVER  # worlds of more particles and constraints get a thread team by default


def pytest_collection_modifyitems(items):
    """Sort tests so that the files in LONG run first."""
    turn = {f"test_{name}": k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: turn.get(item.path.stem, len(LONG)))


@contextlib.contextmanager
def checked_assignments():
    """Refuse, in our own kernels, assignments that compile only with Taichi's analysis; without it LLVM ends the process."""
    from taichi.lang import ops  # noqa: PLC0415

    assign = ops.assign

    def checked(to, value):
        whole = not to.ptr.is_tensor() and value.ptr.is_tensor()
        truth = to.ptr.get_rvalue_type() == ti.u1 and value.ptr.get_rvalue_type() != ti.u1
        if (whole or truth) and any(place in ops.stack_info() for place in (SOURCES, *OURS)):
            raise TypeError(f"a {'vector' if whole else 'number'} is assigned to a variable that is not one:\n{ops.stack_info()}")
        return assign(to, value)

    ops.assign = checked
    yield
    ops.assign = assign


@contextlib.contextmanager
def compiled() -> Iterator[list[str]]:
    """Yield a list that collects the names of the kernels that are compiled inside the context."""
    from taichi.lang.kernel_impl import Kernel  # noqa: PLC0415

    names, materialize = [], Kernel.materialize

    def noted(self, key=None, args=None, arg_features=None):
        if key not in self.compiled_kernels:
            names.append(self.func.__name__)
        return materialize(self, key=key, args=args, arg_features=arg_features)

    Kernel.materialize = noted
    try:
        yield names
    finally:
        Kernel.materialize = materialize


@ti.kernel
def nothing():
    """Do nothing: Taichi reads its cache when it compiles the first kernel."""
    pass


@contextlib.contextmanager
def alone_with_what_is_kept() -> Iterator[None]:
    """Lock the cache folder, so that one worker at a time reads or writes it, for seconds at most.

    Without the lock, Taichi gives up after a quarter of a second, and compiled kernels are lost or compiled again.
    """
    folder = pathlib.Path(ti.cfg.offline_cache_file_path)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "tests.lock", "w") as file:
        if os.name == "posix":
            import fcntl  # noqa: PLC0415

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="session", autouse=True)
def process():
    """Set up a whole run: no thread teams beside other workers, and the server process that forks."""
    if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
        # Workers take all cores: threads of one team would wait for those of another, three times as long as one thread takes
        # for everything. The bits are the same; a test that needs a team passes path="parallel".
        build.CROSSOVER = sys.maxsize
    # Processes that tests start keep bytecode, as by default: compiling the package is half of the start of such a process.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    # Imported modules are no garbage; searching them again and again takes 4 % of a run that compiles nothing.
    gc.collect()
    gc.freeze()
    gc.enable()
    with checked_assignments() if PATCHED else contextlib.nullcontext():
        yield
    build.CROSSOVER = CROSSOVER
    if server.cache_info().currsize:
        with server():  # closes the pipes, so that the server ends
            pass


@pytest.fixture(scope="module", autouse=True)
def taichi(process):
    """Start a Taichi runtime for one test file, so that its kernels have the same names in the next run, whatever runs before."""
    tv.init(arch=ARCH)
    with alone_with_what_is_kept():
        nothing()
    yield
    with alone_with_what_is_kept():
        ti.reset()


@pytest.fixture
def world():
    """Return tv.World for worlds that are closed when the test ends. path="launched": parallel, in many launches, as on a GPU."""
    made = []

    def build(*args, **kwargs):
        launched = kwargs.get("path") == "launched"
        try:
            with launching() if launched else contextlib.nullcontext():
                made.append(tv.World(*args, **(kwargs | {"path": "parallel"} if launched else kwargs)))
        except ValueError as e:
            if ARCH not in tv.runtime.LLVM and ARCH in str(e):  # the architecture does not support it
                pytest.skip(str(e))
            raise
        return made[-1]

    yield build
    for w in made:
        w.close()


@pytest.fixture
def briefly(monkeypatch):
    """Compile large worlds as small ones are compiled: a third of the time, with the same bits (see test_compiling.py)."""
    monkeypatch.setattr(build, "_passes", lambda *_: BRIEF)


@pytest.fixture
def read_here(monkeypatch):
    """Read recordings in this process instead of starting one for each, which takes half a second of CPU time.

    test_forgeries.py and test_recordings.py test what the other process is for.
    """

    def read(path, rows=False):
        with open(path, "rb") as file, tempfile.TemporaryFile() as out:
            found = reader.read(file, os.dup(out.fileno()), rows, limited=False)
            if "foreign" in found:
                raise ValueError(f"replay: {path} is not an .rrd file")
            out.seek(0)
            return rrd.Contents(json.loads(json.dumps(found)), out.read())

    monkeypatch.setattr(rrd, "read", read)


@pytest.fixture
def built_once(monkeypatch):
    """Build each scene of a recording once. When the scene is read again, its world starts from another state."""
    worlds = {}
    made = scene.rebuild

    def rebuild(data, arrays, given, turned, once):
        key = json.dumps([data["particles"], data["features"], data["settings"], once])
        if key not in worlds:
            worlds[key] = made(data, arrays, given, turned, once)
            worlds[key].__dict__["close"] = lambda: None
        for feature, told in zip(worlds[key].features, data["features"], strict=True):
            scene.set_knobs(feature, {name: scene.decode(value, arrays) for name, value in told["knobs"].items()})
        return worlds[key]

    monkeypatch.setattr(scene, "rebuild", rebuild)
    yield
    for world in worlds.values():
        del world.__dict__["close"]
        world.close()


@functools.cache
def parsed() -> dict[pathlib.Path, ast.Module]:
    """Return the syntax trees of all modules of the package, by file.

    Garbage collection is off meanwhile: it would triple the time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        return {path: ast.parse(path.read_text()) for path in pathlib.Path(SOURCES).rglob("*.py")}
    finally:
        if collects:
            gc.enable()


def case(name: str) -> dict:
    """Return an entry of cases.json, the file of known answers in tiverlet/report/accuracy."""
    return CASES[name]


def figures(name: str, t: float, substeps: int) -> dict[str, float]:
    """Return the RMS errors [m] of the prototypes of a case at time t, by method."""
    rows = case(name)["prototype_errors"]
    return next(r["rms_error_m"] for r in rows if r["t"] == t and r["substeps_per_frame_60hz"] == substeps)


def rms(position, reference) -> float:
    """Return the root mean square distance [m]."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(position) - np.asarray(reference)) ** 2, axis=-1))))


def rerun(w: tv.World, seconds: float, dt: float = 1 / 60, **settings) -> tv.World:
    """Put a world back to its start and run it with other substeps or iterations, without compiling.

    The world first starts from velocities; otherwise a kernel would needlessly turn the last displacements into velocities.
    """
    w._start_from(w.particles.velocity)
    w.position = w.particles.position
    forget_pace(w)
    for name, value in settings.items():
        setattr(w, name, value)
    w.run(seconds, dt=dt)
    return w


def forget_pace(w: tv.World) -> None:
    """Let the next frame have as many substeps as are set, however long it is."""
    w._controller.pace = Pace()


def unprojected(w: tv.World) -> tv.World:
    """Leave violations of the initial positions to the passes, as violations after a knob change are.

    By default, violations of the initial positions are projected first.
    """
    w._clock.first_moved = len(w.particles)  # none of the particles
    w._clock.h = w._clock.longest = 0.0  # no earlier substep, of which a shorter one would have to remove what passes left
    return w


def order(errors, factor: float = 2.0) -> float:
    """Return the fitted order of convergence for errors at h, h / factor, h / factor^2, ..."""
    k = np.arange(len(errors)) * np.log(factor)
    return float(-np.polyfit(k, np.log(errors), 1)[0])


# Forks for each script that it runs, so that Taichi is imported once. The server itself has not started Taichi.
SERVER = """
import gc, json, os, runpy, signal, sys
import tiverlet
gc.freeze()  # or each child would look through what has been imported when it ends, which takes 0.2 s
for line in sys.stdin:
    path, timeout = json.loads(line)
    child = os.fork()
    if not child:
        signal.alarm(timeout)
        os.chdir(os.path.dirname(path))
        for number, name in enumerate((os.devnull, "stdout", "stderr")):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT), number)
        sys.argv = [path]
        runpy.run_path(path, run_name="__main__")
        break
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
STRICT = (sys.executable, "-W", "error", "-W", "ignore::DeprecationWarning")


@functools.cache
def server() -> subprocess.Popen:
    """Start the server process, which ends when its standard input is closed."""
    return subprocess.Popen([*STRICT, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def python(code: str, *, check: bool = True, timeout: int = 120, fresh: bool = False, **env) -> subprocess.CompletedProcess:
    """Run code from a file in a separate process, since Taichi reads the source of kernels.

    fresh: use a new interpreter, as is always done with environment settings. Otherwise the process is forked from one that has
    already imported tiverlet.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "script.py"
        path.write_text(code)
        if fresh or env:
            done = subprocess.run(
                [*STRICT, str(path)], capture_output=True, text=True, timeout=timeout, env={**os.environ, **env}, cwd=folder
            )
        else:
            pipes: Any = server()
            pipes.stdin.write(json.dumps([str(path), timeout]) + "\n")
            pipes.stdin.flush()
            status = int(pipes.stdout.readline())
            said = (path.with_name(name).read_text() for name in ("stdout", "stderr"))
            done = subprocess.CompletedProcess([str(path)], status, *said)
    if check and done.returncode:
        raise AssertionError(f"exit status {done.returncode}\n{done.stdout}\n{done.stderr}")
    return done
