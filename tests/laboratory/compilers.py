"""Compare the two compilers, Taichi and Quadrants, with the patches of device/patches and without.

Each way has its own process with an empty cache; a second process finds the kernels of the first there. Processes alternate, so
that other load on the machine affects all of them alike.
"""

import json
import tempfile
from collections.abc import Iterator
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table

from .processes import started
from .scenes import DT, SCENES

VARIANTS = {
    "Taichi": {"TIVERLET_COMPILER": "taichi"},
    "Taichi, no patches": {"TIVERLET_COMPILER": "taichi", "TIVERLET_PATCHES": "0"},
    "Quadrants": {"TIVERLET_COMPILER": "quadrants"},
    "Quadrants, no patches": {"TIVERLET_COMPILER": "quadrants", "TIVERLET_PATCHES": "0"},
}
SIZES = (1000, 10_000, 100_000)
TURNS = 3  # of the processes; medians count. Without patches a process compiles for a minute, so it runs once, for starts only
FALLING, SETTLED = (10, 40), (400, 430)  # frames that are timed
SMALL = 20_000  # discs up to which settled frames are timed, too


def main(args) -> Iterator[Table]:
    """Yield the table of starts, frames and memory by compiler; Quadrants only if it is installed."""
    ways = [way for way in VARIANTS if way.startswith("Taichi") or find_spec("quadrants")]
    found: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    for turn in range(1 if args.quick else TURNS):
        for way in ways if turn == 0 else [way for way in ways if "no patches" not in way]:
            with tempfile.TemporaryDirectory() as cache:
                sizes = args.sizes or (SIZES[:1] if args.quick else SIZES)
                cold, warm = (measured(way, cache, some) for some in ((), sizes if turn == 0 and "no patches" not in way else ()))
                starts = {"import": warm["import"], "first step, cold": cold["first"], "first step, warm": warm["first"]}
                found[way].append(starts | {k: v for k, v in {**cold, **warm}.items() if k not in ("import", "first")})
    rows = []
    for name in found[ways[0]][0]:
        cells = [[one[name] for one in found[way] if name in one] for way in ways]
        rows.append((name, *(f"{median(cell):.3g}" if cell else "" for cell in cells)))
    yield Table("Compilers: a pile of 1000 discs, 1 thread; s, us, ms and MB", ("", *ways), rows)


def measured(way: str, cache: str, sizes: tuple[int, ...]) -> dict[str, float]:
    """Return the figures that a process of one way measures."""
    with started("compilers", {"sizes": sizes}, cache, **({"TIVERLET_PATCHES": "1"} | VARIANTS[way])) as talker:
        return talker.ask()


def process(job: dict[str, Any], imported: float) -> None:
    """Run the process: measure import, first step, frames and memory, and print them as JSON."""
    import resource

    out: dict[str, Any] = {"import": imported}
    tv.init(threads=1)
    clock = perf_counter()
    particles, features = SCENES["pile"].build(1000)
    with tv.World(particles, features, substeps=8) as world:
        world.step(DT)
        out["first"] = perf_counter() - clock
    with tv.World(tv.Particles(np.zeros((1, 2))), [tv.Gravity()], substeps=1) as world:
        times = []
        for _ in range(1000):
            clock = perf_counter()
            world.step(DT)
            times.append(perf_counter() - clock)
    out["frame of one particle [us]"] = 1e6 * median(times)
    for n in job["sizes"]:
        particles, features = SCENES["pile"].build(n)
        with tv.World(particles, features, substeps=8) as world:
            for name, (begin, end) in (("falling", FALLING), ("settled", SETTLED)):
                if name == "falling" or n <= SMALL:
                    world.run(begin * DT - world.time, DT)
                    clock = perf_counter()
                    world.run((end - begin) * DT, DT)
                    out[f"{n:,} discs, {name} [ms a frame]"] = 1e3 * (perf_counter() - clock) / (end - begin)
    out["memory [MB]"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps(out), flush=True)
