"""Frames, starts and memory of scenes, beside the pile in C.

Every figure of a scene comes from its own process: Taichi's threads are set once in a process, and only its first step is cold.
A scene is run over its first frames repeatedly, alternating with pile.c; medians count.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table, error_line

from ..launches import launches
from . import c_baseline, processes
from .scenes import DT, SCENES

FRAMES = (12, 60)  # least and largest number of timed frames in a round
WORK = 5e7  # particle-substeps of a round, within FRAMES
TURN = 1e6  # particle-substeps of a turn, which has at least 6 frames and at most a round
ROUNDS, SECONDS, QUICK = 25, 2.0, (3, 0.2)  # most rounds; seconds of own frames after which no round begins; of a quick run
COUNTED = 6  # frames over which launches are averaged
SPEED = ("scene", "particles", "threads", "ms", "Mps/s", "C [ms]", "share of C", "of 1 thread", "launches", "path")
STARTS = ("scene", "particles", "threads", "import", "cold", "warm", "bytes", "overlap", "C's", "violation", "flags")
LEGEND = (
    "ms: of a frame of 1/60 s. Mps/s: millions of particle-substeps per second. launches: kernels of a frame, counted.",
    "import, cold, warm [s]: of the package, and from tv.init to the end of the first step, without and with kernels that "
    "another process has compiled. bytes: of all fields per particle. overlap: the mean of pairs that overlap [diameters]. "
    "violation: the worst of a constraint, relative.",
)


def main(args) -> Iterator[Table]:
    """Yield the tables of speed, and of starts, memory and quality."""
    names = args.parts or list(SCENES)
    if wrong := [name for name in names if name not in SCENES]:
        raise SystemExit(f"There is no scene {wrong[0]}, but {', '.join(SCENES)}.")
    cores = sorted(args.threads or powers(os.cpu_count() or 1))
    rounds = QUICK if args.quick else (ROUNDS, SECONDS)
    speeds, starts, notes = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        program, how = c_baseline.build(folder)
        notes.append(f"pile.c: {how}." if program else f"Left out: pile.c, since {how}.")
        for name in names:
            for n in args.sizes or (SCENES[name].quick if args.quick else SCENES[name].sizes):
                single = None
                for threads in cores:
                    cache = os.path.join(folder, f"{name}{n}_{threads}")
                    try:
                        found = measured(name, n, threads, cache, program, rounds)
                    except (RuntimeError, OSError) as error:
                        notes.append(f"Missing: {name}, {n} particles: {error_line(error)}")
                        continue
                    single = single or found["seconds"]
                    speeds.append(row(SPEED, name, threads, found | {"single": single if threads > cores[0] else None}))
                    starts.append(row(STARTS, name, threads, found))
    yield Table("Speed", SPEED, speeds, notes)
    yield Table("Starts, memory, quality", STARTS, starts, LEGEND)


def measured(name: str, n: int, threads: int, cache: str, program: str | None, rounds: tuple[int, float]) -> dict[str, Any]:
    """Return the figures of a scene of one size on one number of threads. cache: an empty folder. program: pile.c, or None."""
    scene, job = SCENES[name], {"scene": name, "n": n, "threads": threads}
    with processes.started("speed", job, cache) as once:
        cold = once.ask()
    with ExitStack() as stack:
        ours = stack.enter_context(processes.started("speed", job, cache))
        both, warm = [ours], ours.ask()
        if program and scene.in_c:
            both.append(stack.enter_context(c_baseline.started(program, n, scene.in_c, threads)))
        times = timed(both, name, n, rounds)
        qualities = [processes.quality(talker, frames_of(name, n), scene.settles) for talker in both]
        look = ours.ask("look")
    found = {**warm, **look, **qualities[0], "substeps": scene.substeps, "cold": cold["first"], "seconds": median(times[0])}
    c = {"c": median(times[1]), "c_overlap": qualities[1]["overlap"]} if len(both) > 1 else {}
    return found | c | {"import": median([cold["import"], warm["import"]])}


def timed(talkers: list[processes.Talker], name: str, n: int, rounds: tuple[int, float]) -> list[list[float]]:
    """Return the seconds per frame of each process in each round."""
    frames, scene = frames_of(name, n), SCENES[name]
    group = int(np.clip(TURN // (n * scene.substeps), 6, frames))
    return processes.side_by_side(talkers, frames, group, *rounds, scene.settles)


def frames_of(name: str, n: int) -> int:
    """Return the number of frames of a round."""
    return int(np.clip(WORK // (n * SCENES[name].substeps), *FRAMES))


def row(heads: tuple[str, ...], name: str, threads: int, f: dict[str, Any]) -> list[str]:
    """Return the cells of the columns `heads`."""
    n, seconds, c, single = f["particles"], f["seconds"], f.get("c"), f.get("single")
    cells = {
        "scene": name, "particles": f"{n:,}", "threads": str(threads), "ms": f"{1e3 * seconds:.3g}", "path": f["path"],
        "Mps/s": f"{n * f['substeps'] / seconds / 1e6:.3g}", "C [ms]": f"{1e3 * c:.3g}" if c else "",
        "share of C": f"{c / seconds:.2f}" if c else "", "of 1 thread": f"{single / seconds:.2f}" if single else "",
        "launches": f"{f['launches']:.3g}", "import": f"{f['import']:.2f}", "cold": f"{f['cold']:.2f}",
        "warm": f"{f['first']:.2f}", "bytes": f"{f['memory'] / n:.0f}", "overlap": f"{f['overlap']:.1e}" if f["overlap"] else "",
        "C's": f"{f['c_overlap']:.1e}" if c else "", "violation": f"{f['residual']:.1e}" if f["residual"] else "",
        "flags": " ".join(f["flags"]),
    }  # fmt: skip
    return [cells[head] for head in heads]


def powers(cores: int) -> list[int]:
    """Return the numbers of threads 1, 2, 4, ... and all cores."""
    return sorted({*(1 << k for k in range(cores.bit_length())), cores})


def process(job: dict[str, Any], imported: float) -> None:
    """Run the process of a scene. imported: seconds that importing tiverlet took."""
    scene = SCENES[job["scene"]]
    particles, features = scene.build(job["n"])
    clock = perf_counter()
    tv.init(threads=job["threads"])
    world = tv.World(particles, features, substeps=scene.substeps)
    flags = set(world.step(DT).flags)
    first = perf_counter() - clock

    def frame() -> None:
        """Step one frame."""
        flags.update(world.step(DT).flags)

    def restart() -> None:
        """Restore the start."""
        world.position, world.velocity = particles.position, particles.velocity

    def quality() -> dict[str, float]:
        """Return the mean overlap [diameters] and the worst violation."""
        overlap = float(world.contacts.overlap.mean()) if world.last.contacts else 0.0
        return {"overlap": overlap / (2 * float(particles.radius[0]) or 1.0), "residual": world.last.residual}

    def look(word: str) -> dict[str, Any]:
        """Return launches of a frame, path, memory and flags."""
        with launches() as count:
            for _ in range(COUNTED):
                world.step(DT)
        memory = sum(world.fields.values())
        return {"launches": count.total() / COUNTED, "path": world.path, "memory": memory, "flags": sorted(flags)}

    processes.answer(frame, restart, quality, {"import": imported, "first": first, "particles": len(particles)}, look)
    world.close()
