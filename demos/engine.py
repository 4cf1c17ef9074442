"""The article's engine on one page of Taichi, beside the same scene in tiverlet: time, overlap and speed of both.

    python demos/engine.py [engines.rrd]

What to look for: six snippets make an engine. At the same substeps tiverlet's discs overlap less, and come to rest.
"""

import sys
import time
from typing import Any

import numpy as np
import rerun as rr
import taichi as ti

import tiverlet as tv

N, SIZE, G, DT, SUBSTEPS, PASSES, FRAMES = 400, 8.0, 9.81, 1 / 60, 8, 4, 360
CELL, ROOM, SIDE = 0.4, 16, 22  # cells as wide as the largest disc; how many discs each has room for; cells along a side
RADIUS = tv.mix(0.1, 0.2, tv.golden(np.arange(N)))  # snippets 1 and 2: mix, and golden-ratio sampling
START = tv.mix((0.2, 0.2), (SIZE - 0.2, SIZE - 0.2), tv.golden(np.arange(N), dim=2))


def engine() -> Any:
    """Return a function that steps the article's engine by a frame, and returns the positions, (N, 2) [m]."""
    vectors: Any = [ti.Vector.field(2, ti.f32, N) for _ in range(3)]
    x, before, move = vectors
    r, touching, count = ti.field(ti.f32, N), ti.field(ti.i32, N), ti.field(ti.i32, (SIDE, SIDE))
    cell = ti.field(ti.i32, (SIDE, SIDE, ROOM))
    for field, values in ((x, START), (before, START), (r, RADIUS)):
        field.from_numpy(values.astype(np.float32))

    @ti.func
    def cell_of(p):
        return ti.cast(tv.clamp(p / CELL, 0.0, SIDE - 3.0), ti.i32) + 1

    @ti.kernel
    def substep(h: ti.f32):
        for i in x:  # snippet 4, Verlet: 2 x - x_before + a h^2
            new = 2 * x[i] - before[i] + ti.Vector([0, -G]) * h * h
            before[i], x[i] = x[i], new
        for _ in ti.static(range(PASSES)):
            for a, b in count:
                count[a, b] = 0
            for i in x:  # snippet 5, a spatial hash: atomic counters give each disc its place in a cell
                a = cell_of(x[i])
                k = ti.atomic_add(count[a], 1)
                if k < ROOM:
                    cell[a[0], a[1], k] = i
            for i in x:  # snippet 6, constraints: all at once, and averaged (Jacobi)
                total, n, a = ti.Vector([0.0, 0.0]), 0, cell_of(x[i])
                for b in ti.grouped(ti.ndrange((-1, 2), (-1, 2))):
                    for k in range(ti.min(count[a + b], ROOM)):
                        j = cell[a[0] + b[0], a[1] + b[1], k]
                        d = x[i] - x[j]
                        gap = d.norm() - r[i] - r[j]
                        if j != i and gap < 0 and d.norm() > 0:
                            total, n = total - gap / 2 * d.normalized(), n + 1
                move[i], touching[i] = total, n
            for i in x:
                x[i] = tv.clamp(x[i] + move[i] / ti.max(touching[i], 1), r[i], SIZE - r[i])

    return lambda: ([substep(DT / SUBSTEPS) for _ in range(SUBSTEPS)], x.to_numpy())[1]


def main(path: str = "engines.rrd") -> None:
    """Step both side by side, record both, and compare them."""
    features = [tv.Gravity(G), tv.Contact(), tv.Box((0, 0), (SIZE, SIZE))]
    world = tv.World(tv.Particles(START, radius=RADIUS), features, substeps=SUBSTEPS)
    steps = {"engine": engine(), "tiverlet": lambda: (world.step(DT), world.position)[1]}
    recording, ms, now, speed = rr.RecordingStream("engine"), {}, dict.fromkeys(steps, START), 0.0
    recording.save(path)
    for frame in range(FRAMES):
        recording.set_time("time", duration=frame * DT)
        for name, step in steps.items():
            begin, last = time.perf_counter(), now[name]
            now[name], spent = step(), time.perf_counter() - begin
            ms[name] = tv.approach(ms.get(name, 0.0), 1e3 * spent, 2.0, DT)  # snippet 3: exponential smoothing
            place = (now[name] + [(SIZE + 1) * (name != "engine"), 0]) * [1, -1]
            recording.log(name, rr.Points2D(place, radii=RADIUS, colors=tv.golden_colors(N)))
            speed = np.hypot(*(now[name] - last).T).max() / DT
            if frame == FRAMES - 1:
                deep = tv.measure.overlapping(now[name], RADIUS)[1].max(initial=0.0) / RADIUS.min()
                print(f"{name}: {ms[name]:.2f} ms a frame, overlap {deep:.2g} of a radius, fastest {speed:.2g} m/s")
    if speed > 0.05:
        raise SystemExit("the discs do not rest")


if __name__ == "__main__":
    main(*sys.argv[1:2])
