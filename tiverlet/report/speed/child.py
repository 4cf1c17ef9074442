"""The process in which a scene is timed. It prints the costs of the first step, then answers commands, one a line, in JSON.

    run K: compute K frames; returns their seconds
    restart: restore the start, and compute one frame that is not timed
    look: returns launches of a frame, counted; path, memory, flags
    quality: returns the mean overlap of the overlapping pairs [diameters], and the worst relative violation of a constraint
    copy: returns the bytes per second that a copy of a large field moves
    traffic: returns the bytes that each kernel moves in a frame, and its seconds, see counting.py

It also runs in copies of the package that lack most files, see stripped.py.
"""

import json
import sys
from time import perf_counter
from typing import Any

# Run by `python -c`, so that the import can be timed: importing this module would import the package first.
START = """
from time import perf_counter
clock = perf_counter()
import tiverlet
seconds = perf_counter() - clock
import json, sys
from tiverlet.report.speed.child import main
main(json.loads(sys.argv[1]), seconds)
"""
COUNTED = 6  # frames over which launches and bytes are averaged


def main(job: dict[str, Any], imported: float) -> None:
    """Run the process. job: scene, n, arch, threads. imported: seconds that importing tiverlet took."""
    import tiverlet as tv

    from .counting import DT, launches, traffic
    from .scenes import SCENES

    scene = SCENES[job["scene"]]
    particles, features = scene.build(job["n"])
    clock = perf_counter()
    tv.init(job["arch"], threads=job["threads"])
    started = perf_counter() - clock
    clock = perf_counter()
    world = tv.World(particles, features, substeps=scene.substeps)
    report = world.step(DT)
    first = perf_counter() - clock
    n = len(particles)
    say({"import": imported, "start": started, "first": first, "particles": n, "package": tv.__file__})
    flags = set(report.flags)
    for line in sys.stdin:
        word, *number = line.split()
        if word == "run":
            clock = perf_counter()
            for _ in range(int(number[0])):
                report = world.step(DT)
                flags |= report.flags
            say(perf_counter() - clock)
        elif word == "restart":
            world.position, world.velocity = particles.position, particles.velocity
            world.step(DT)
            say(0.0)
        elif word == "look":
            with launches() as count:
                for _ in range(COUNTED):
                    world.step(DT)
            say({
                "launches": count.total() / COUNTED, "path": world.path, "memory": sum(world.fields.values()),
                "fields": len(world.fields), "flags": sorted(flags),
            })  # fmt: skip
        elif word == "quality":
            overlap = float(world.contacts.overlap.mean()) if report.contacts else 0.0
            say({"overlap": overlap / (2 * float(particles.radius[0]) or 1.0), "residual": report.residual})
        elif word == "copy":
            say(copied())
        else:
            say(traffic(world, COUNTED))
    world.close()


def copied(size: int = 1 << 28) -> float:
    """Return the bytes per second that are read and written in a copy of a field of `size` bytes, the best of five."""
    from ...device import ti

    source, target, best = ti.field(ti.f32, size // 4), ti.field(ti.f32, size // 4), float("inf")
    for _ in range(6):  # the first one compiles
        clock = perf_counter()
        target.copy_from(source)
        ti.sync()
        best = min(best, perf_counter() - clock)
    return 2 * size / best


def say(what: Any) -> None:
    """Print one answer, a line of JSON."""
    print(json.dumps(what), flush=True)
