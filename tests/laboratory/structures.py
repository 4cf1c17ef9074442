"""What hangs by ropes and bars: the strain of its links against the time of a frame, by solver, load and substeps."""

import time
from collections.abc import Iterator

import numpy as np

import tiverlet as tv
from tiverlet.report.output import Table

from ..scenes.solving import LINK, STRUCTURES, hung

HEADS = (
    "solver",
    "substeps",
    "load [links]",
    "strain",
    "worst structure",
    "ms a frame",
    "energy gained [m g L]",
    "flags, frames",
)
SOLVERS = {"default": None, "Jacobi": tv.Jacobi(), "ConjugateGradient(5)": tv.ConjugateGradient(5), "Direct": tv.Direct()}
NOTES = ["2 s of swinging; the largest strain after the first second. A load of 1 is the mass of a point between two links."]


def main(args) -> Iterator[Table]:
    """Yield a table for bars, one for ropes, and of each what is on the page of solvers."""
    tv.init(threads=1)
    for link in (tv.Distance, tv.Rope):
        some = list(rows(link, (20,) if args.quick else (4, 8, 20)))
        yield Table(f"Structures of {link.__name__}", HEADS, some, NOTES)
        yield short(link, some)


def short(link, some: list[tuple]) -> Table:
    """Return the strains at 20 substeps by solver and load, and the mean time of a frame."""
    by_solver = {name: [row for row in some if row[0] == name and row[1] == "20"] for name in SOLVERS}
    heads = [f"{link.__name__}, 20 substeps", *(f"load {row[2]}" for row in by_solver["default"]), "ms a frame"]
    times = {name: np.mean([float(row[5]) for row in found]) for name, found in by_solver.items()}
    cells = [(name, *(row[3] for row in found), f"{times[name]:.2f}") for name, found in by_solver.items()]
    return Table("Strain by load", heads, cells)


def rows(link, substeps) -> Iterator[tuple]:
    """Yield a row for each solver, number of substeps and load."""
    for n in substeps:
        for load in (1, 30, 1000):
            for name, solver in SOLVERS.items():
                worst, where, spent, gained, flags = 0.0, "", 0.0, 0.0, set()
                for dim, builds in STRUCTURES.items():
                    particles, (gravity, links) = hung(link, *builds, load=load * LINK)
                    w = tv.World(particles.make(), [gravity.make(), links], substeps=n, solver=solver)
                    pairs = links.indices
                    lengths, energy = tv.measure.strain(w, pairs, 1.0) + 1, w.step(1 / 60).energy
                    for k in range(119):
                        begin = time.process_time()
                        report = w.step(1 / 60)
                        spent += (time.process_time() - begin) / 119
                        gained = max(gained, (report.energy - energy) / (9.81 * 3.0 * w.particles.mass.sum()))
                        flags |= {(dim, k, flag) for flag in report.flags}
                        off = tv.measure.strain(w, pairs, lengths)
                        off = np.abs(off) if link is tv.Distance else np.maximum(off, 0.0)
                        if k >= 60 and off.max() > worst:
                            worst = float(off.max())
                            where = builds[int((w.position[pairs[off.argmax(), 0]][0] + 2.0) // 6.0)].__name__
                told = ", ".join(f"{f} {sum(f == g for *_, g in flags)}" for f in sorted({f for *_, f in flags}))
                yield name, str(n), str(load), f"{worst:.0e}", where, f"{1e3 * spent:.2f}", f"{gained:.0e}", told or "none"
