"""The engine on a GPU: what runs there, with which bits, how fast, how often the host waits. Eight minutes on a bare machine.

The architecture is TIVERLET_ARCH, else CUDA or Metal, else the CPU with frames that are launched phase by phase as on a GPU,
which tries the whole script. Every row has a process of its own, and only so many seconds.
"""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.device import runtime, ti
from tiverlet.report.output import Table, machine

from ..launches import launches, launching
from .peers import Newton, overlap
from .processes import ROOT
from .scenes import DT, SCENES, scattered

BUDGET, EACH = 460.0, 75.0  # [s] for everything, and for one process
TESTS = "tests/test_free_motion.py tests/test_pins.py tests/test_contact.py tests/test_rows.py".split()
SIZES, QUICK = (10_000, 100_000, 1_000_000, 10_000_000), (100, 400)
START = perf_counter()
MANY, DISCS = 1000, 60  # worlds in one launch, and discs in each
SETTINGS = (4, 10), (8, 2)  # of Newton: steps of a frame, iterations of each


def grains(n: int, dim: int = 2):
    """Build discs with radii of 1 : 2.8, or spheres of 1 : 2, that fall from a lattice into a box, with friction and spin."""
    side, most = int(np.ceil(round(n ** (1 / dim), 9))), 2.8 if dim == 2 else 2.0
    i = np.arange(n)
    radius = 0.1 * most ** scattered(7 * i + 1)
    at = [i % side, i // side] if dim == 2 else [i % side, i // side**2, i // side % side]
    x = 2.05 * radius.max() * (np.stack(at, axis=1) + 0.5)
    wide = 2.05 * radius.max() * side
    box = tv.Box([0] * dim, [2 * wide if k == 1 else wide for k in range(dim)], friction=0.3)
    return tv.Particles(x, radius=radius, mass=radius**dim, spin=True), [tv.Gravity(9.81), box, tv.Contact(friction=0.3)]


def boxes(n: int):
    """Build towers of boxes as bodies of four particles each."""
    one, count = tv.shapes.box((0, 0), (1, 1)), max(1, n // 4)
    pile, _ = tv.shapes.join(*(one.moved((1.5 * (k // 8), 0.5 + k % 8)) for k in range(count)))
    loops = [np.asarray(one.loops[0]) + 4 * k for k in range(count)]
    return tv.Particles(pile.position), [tv.Gravity(9.81), tv.HalfSpace((0, 1)), tv.ShapeMatch(loops), tv.Polygons(loops)]


def falling(n: int):
    """Build points in a box, which touch nothing but its walls."""
    return tv.Particles(scattered(np.arange(2 * n)).reshape(n, 2)), [tv.Gravity(9.81), tv.Box((0, 0), (1, 1))]


BUILD: dict[str, tuple[Callable[[int], Any], int]] = {  # scene, substeps
    "points in a box": (falling, 4), "discs 1 : 2.8": (grains, 4), "spheres 1 : 2": (lambda n: grains(n, 3), 4),
    "cloth": (SCENES["cloth"].build, 20), "discs, ropes, balls": (SCENES["mixed"].build, 8), "boxes": (boxes, 4),
}  # fmt: skip


def architecture() -> str:
    """Return the architecture to run on."""
    there = runtime.available()
    return os.environ.get("TIVERLET_ARCH") or next((arch for arch in ("cuda", "metal") if arch in there), "cpu")


def main(args) -> Iterator[Table]:
    """Yield the tables until the time is over."""
    end, arch = perf_counter() + BUDGET, architecture()
    tables = {"bits": _bits, "speed": _speed, "peers": _peers, "worlds": _worlds, "tests": _tests}
    info = subprocess.run([sys.executable, "-m", "tiverlet", "info"], cwd=ROOT, capture_output=True, text=True, timeout=EACH)
    said = [(line,) for line in info.stdout.splitlines() if line.strip()]
    yield Table(f"{machine()}: {arch}", ("python -m tiverlet info",), said, [])
    for name in args.parts or tables:
        yield tables[name](args, arch, end)


def _asked(job: dict[str, Any], end: float) -> Any:
    """Return what a process answers, or a text that says why it does not."""
    seconds = min(EACH, end - perf_counter())
    if seconds < 5:
        return "no time left"
    code = "import json, sys; from tests.laboratory.gpu import process; process(json.loads(sys.argv[1]))"
    words = [sys.executable, "-P", "-c", code, json.dumps(job | {"seconds": seconds})]
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        ran = subprocess.run(words, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return f"took more than {seconds:.0f} s"
    return json.loads(ran.stdout) if ran.returncode == 0 else " ".join(ran.stderr.split())[-100:]


def _bits(args, arch: str, end: float) -> Table:
    """Compare the bits of two runs, and those of the CPU."""
    rows = []
    for name in BUILD:
        jobs = [{"part": "bits", "scene": name, "n": 400, "arch": a} for a in (arch, arch, "fused")]
        out = [_asked(job, end) for job in jobs]
        if not all(isinstance(one, list) for one in out):
            rows.append((name, *(one if isinstance(one, str) else "ran" for one in out)))
            continue
        (hashes, flags), (again, _), (host, _) = out
        same = sum(np.cumprod([a == b for a, b in zip(hashes, host, strict=True)]))
        rows.append((name, "the same" if hashes == again else "differ", f"{same} of {len(host)}", flags or "none"))
    return Table("Bits of 400 particles in 30 frames", ("scene", "two runs", "frames as on the CPU", "flags"), rows, [])


def _speed(args, arch: str, end: float) -> Table:
    """Time frames, and count launches and answers."""
    rows, notes = [], ["share: of the time in which the device copies positions and displacements once in each substep"]
    for n in args.sizes or (QUICK if args.quick else SIZES):
        for name in BUILD:
            if n > 100_000 and name in ("cloth", "discs, ropes, balls", "boxes"):
                continue
            found = _asked({"part": "speed", "scene": name, "n": n, "arch": arch}, end)
            rows.append((name, f"{n:,}", *(found if isinstance(found, list) else (found, *[""] * 7))))
    heads = "ms a frame", "particle-substeps a second", "share", "launches", "answers", "overlap", "flags", "first frame [s]"
    return Table("Falling, 4 to 20 substeps", ("scene", "particles", *heads), rows, notes)


def _peers(args, arch: str, end: float) -> Table:
    """Time Warp's example_dem, 65 536 spheres with springs and dashpots, and Newton's XPBD, beside tiverlet on their scenes."""
    n, rows = 1000 if args.quick else 100_000, []
    jobs = [("dem", "warp", {}), ("dem", "tiverlet", {"substeps": 4}), ("dem", "tiverlet", {"substeps": 16})]
    jobs += [("pile", "newton", {"setting": setting}) for setting in SETTINGS]
    jobs += [("pile", "tiverlet", {"substeps": k}) for k in (1, 4)]
    for scene, engine, setting in jobs:
        found: Any = "not installed"
        if engine == "warp" and arch != "cuda":
            found = "captures a CUDA graph"
        elif engine == "tiverlet" or find_spec(engine):
            found = _asked({"part": "peers", "scene": scene, "engine": engine, "n": n, "arch": arch, **setting}, end)
        shown = ", ".join(f"{key} {value}" for key, value in setting.items()) or "64 substeps"
        rows.append((scene, engine, shown, *(found if isinstance(found, list) else (found, "", ""))))
    heads = "scene", "engine", "setting", "ms a frame", "mean overlap [radii]", "frames"
    return Table("Beside Warp and Newton", heads, rows, ["overlap: at the end of up to 60 frames"])


def _worlds(args, arch: str, end: float) -> Table:
    """Time many worlds in one launch."""
    count = 10 if args.quick else MANY
    found = _asked({"part": "worlds", "n": count, "arch": arch}, end)
    return Table(f"{count} worlds of {DISCS} discs", ("ms a frame of all",), [(str(found),)], [])


def _tests(args, arch: str, end: float) -> Table:
    """Run a part of the tests on the device."""
    test = [sys.executable, "-m", "pytest", "-o", "addopts=", "-q", "-m", "not slow", "-p", "no:cacheprovider"]
    stress = f"import sys, tiverlet; tiverlet.init(arch={arch!r}); from tiverlet.__main__ import main; main(sys.argv[1:])"
    runs = {file: [*test, file] for file in TESTS}
    runs["stress"] = [sys.executable, "-c", stress, "stress", "--workers", "1", *map(str, range(1, 21))]
    rows, options = [], {"cwd": ROOT, "env": os.environ | {"TIVERLET_ARCH": arch}, "capture_output": True, "text": True}
    for name in [TESTS[0], "stress"] if args.quick else runs:
        try:
            ran: Any = subprocess.run(runs[name], **options, timeout=max(1, end - perf_counter()))  # type: ignore[call-overload]
            rows.append((name, (ran.stdout.split("\n\n")[-1].strip().splitlines() or [ran.stderr[-100:]])[-1]))
        except subprocess.TimeoutExpired:
            rows.append((name, "no time left"))
    return Table("Tests, and the first 20 rows of stress", ("what", "result"), rows, [])


def process(job: dict[str, Any]) -> None:
    """Run the job of a row: print its answer as JSON. What libraries print goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    tv.init(arch="cpu" if job["arch"] == "fused" else job["arch"])
    parts = {"bits": _hashes, "speed": _timed, "peers": _beside, "worlds": _together}
    print(json.dumps(parts[job["part"]](job)), file=answers, flush=True)


def _made(job: dict[str, Any]) -> tv.World:
    """Build the world of a job: on a CPU launched phase by phase, but for the fused one."""
    build, substeps = BUILD[job["scene"]]
    particles, features = build(job["n"])
    path = {"fused": "fused", "cpu": "parallel"}.get(job["arch"], "auto")
    with launching() if job["arch"] == "cpu" else contextlib.nullcontext():
        return tv.World(particles, features, substeps=substeps, path=path)


def _hashes(job: dict[str, Any]) -> Any:
    """Return the hashes of 30 frames, and all flags."""
    world, hashes, flags = _made(job), [], set()
    for _ in range(30):
        flags |= world.step(DT).flags
        hashes.append(world.hash())
    return [hashes, ", ".join(sorted(flags))]


def _timed(job: dict[str, Any]) -> Any:
    """Return the cells of a row of the table of speed."""
    clock = perf_counter()
    world = _made(job)
    world.step(DT)
    first, end = perf_counter() - clock, clock + job["seconds"] - 10
    times, flags = [], set()
    with launches() as count:
        while len(times) < 120 and perf_counter() < end or not times:
            clock = perf_counter()
            report = world.step(DT)
            times.append(perf_counter() - clock)
            flags |= report.flags
    n, ms, frames = len(world.position), 1e3 * median(times), len(times)
    state = 2 * 4 * world.position.shape[1] * n  # bytes of positions and displacements in f32
    share = 2 * state * world.substeps / _copy_rate(state) / median(times)
    return [
        f"{ms:.3g}", f"{n * world.substeps / median(times):.2e}", f"{100 * share:.2g} %", f"{count.total() / frames:.0f}",
        f"{count.answers / frames:.2f}", f"{report.overlap:.2g}", ", ".join(sorted(flags)) or "none", f"{first:.1f}",
    ]  # fmt: skip


def _beside(job: dict[str, Any]) -> Any:
    """Return the time of a frame of an engine, and its mean overlap at the end."""
    if job["scene"] == "dem":
        x, frame, read = _example_dem(job)
        radius = np.full(len(x), 0.1)
    else:
        particles, features = SCENES["pile"].build(job["n"])
        radius = particles.radius
        frame, read = _frames(tv.World(particles, features, substeps=job["substeps"])) if "substeps" in job else _newton(job)
    frame()
    read()
    begin, frames = perf_counter(), 0
    while frames < 60 and perf_counter() - START < job["seconds"] - 15 or not frames:
        frame()
        frames += 1
    end = read()
    return [f"{(perf_counter() - begin) / frames * 1e3:.3g}", f"{2 * overlap(end, radius):.2g}", f"{frames}"]


def _frames(world: tv.World) -> tuple[Callable[[], Any], Callable[[], np.ndarray]]:
    """Return functions that advance a world by a frame, and return its positions."""
    return lambda: world.step(DT), lambda: world.position


def _newton(job: dict[str, Any]) -> tuple[Callable[[], Any], Callable[[], np.ndarray]]:
    """Return the same for Newton."""
    engine = Newton(*SCENES["pile"].build(job["n"]), tuple(job["setting"]), "cuda" if job["arch"] == "cuda" else "cpu")
    return engine.frame, engine.position


def _example_dem(job: dict[str, Any]) -> tuple[np.ndarray, Callable[[], Any], Callable[[], np.ndarray]]:
    """Return the start of Warp's example_dem, (n, 3), and the same for it or for tiverlet: heavy friction, thrown along z."""
    grid = np.array(np.meshgrid(np.linspace(0, 32, 32), np.linspace(0, 64, 64), np.linspace(0, 32, 32))).T * 0.2 + (0, 0.5, 0)
    x = (grid + np.random.default_rng(42).random(size=grid.shape) * 0.01).reshape(-1, 3)
    if job["engine"] == "tiverlet":
        particles = tv.Particles(x, velocity=(0, 0, 15.0), mass=1 / 64, radius=0.1)
        ground = tv.HalfSpace((0, 1, 0), friction=1.0)
        return x, *_frames(tv.World(particles, [tv.Gravity(9.8), ground, tv.Contact(friction=1.0)], substeps=job["substeps"]))
    example: Any = import_module("warp.examples.core.example_dem").Example(None)
    return x, example.step, lambda: example.x.numpy().astype(float)


def _copy_rate(size: int) -> float:
    """Return how many bytes a second the device reads and writes in a copy of this many bytes."""
    n = max(1, size // 4)
    a, b = ti.field(ti.f32, n), ti.field(ti.f32, n)

    @ti.kernel
    def copy():
        """Copy a to b."""
        for i in a:
            b[i] = a[i]

    times = []
    for _ in range(12):
        clock = perf_counter()
        copy()
        ti.sync()
        times.append(perf_counter() - clock)
    return 8 * n / median(times[2:])


def _together(job: dict[str, Any]) -> Any:
    """Return how long a frame of all worlds takes."""
    particles, features = grains(DISCS)
    with tv.World(particles, features, substeps=4) as one, tv.Worlds(one, job["n"]) as many:
        many.step(DT)
        clock = perf_counter()
        many.run(10 * DT, DT)
        return f"{100 * (perf_counter() - clock):.3g}"
