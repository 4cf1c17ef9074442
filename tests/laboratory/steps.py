"""Error with shorter substeps, in every precision and order, and with substeps="auto".

The cases are chains that are solved to rounding. Their error is of order h^2 (h^4 to h^8) until rounding dominates; rounding must
not grow with more substeps. A frame of 1/60 s has up to 5120.
"""

from collections.abc import Iterator

import tiverlet as tv
from tiverlet.report.accuracy.cases import CASES, Case
from tiverlet.report.accuracy.points import observe
from tiverlet.report.output import Table

SHOWN = ("D01_double_pendulum", "D02_double_pendulum_low", "D05_chain10", "R06b_pendulum_state:90", "R08_spinning_dumbbell")
SUBSTEPS = (20, 80, 320, 1280, 5120, "auto")
CURVES = (("f32", 2), ("f32-compensated", 2), ("f64", 2), ("f64", 4), ("f64", 6), ("f64", 8))
PASSES = 3  # of Newton's method in a substep, so that its error is negligible


def main(args) -> Iterator[Table]:
    """Yield a table for each case."""
    for name in (n for n in CASES if n.startswith(tuple(args.parts or SHOWN))):
        case, steps = CASES[name], SUBSTEPS[:3] if args.quick else SUBSTEPS
        rows = [
            (precision + (f", order {order}" if order > 2 else ""), *(f"{e:.1e}" for e in curve(case, precision, order, steps)))
            for precision, order in CURVES
        ]
        yield Table(f"{case.title}: error [{case.unit}] after {case.seconds:g} s", ("substeps", *map(str, steps)), rows)


def curve(case: Case, precision: str, order: int, substeps: tuple[int | str, ...]) -> list[float]:
    """Return the errors of one case, in its unit, for each number of substeps of a frame."""
    particles, features = case.build()
    out = []
    with tv.World(particles, features, precision=precision, order=order, iterations=PASSES) as world:
        for world.substeps in substeps:
            out.append(float(case.error(observe(case, world)[0])))
    return out
