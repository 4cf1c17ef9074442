"""Error with shorter substeps, in every precision and order, and with substeps="auto".

    python -m tiverlet.report.accuracy.smaller_steps [case ...] [--json] [--plot FILE]

The cases are chains that are solved to rounding. Their error is of order h^2 (h^4 to h^8) until rounding dominates; rounding must
not grow with more substeps. A frame of 1/60 s has up to 5120.
"""

import argparse
import json
from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

from ...world import World
from .cases import CASES, Case
from .points import observe

SHOWN = ("D01_double_pendulum", "D02_double_pendulum_low", "D05_chain10", "R06b_pendulum_state:90", "R08_spinning_dumbbell")
SUBSTEPS = (20, 80, 320, 1280, 5120, "auto")
CURVES = (("f32", 2), ("f32-compensated", 2), ("f64", 2), ("f64", 4), ("f64", 6), ("f64", 8))
PASSES = 3  # of Newton's method in a substep, so that its error is negligible


def curve(case: Case, precision: str, order: int, substeps: Iterable[int | str] = SUBSTEPS) -> dict[str, float]:
    """Return the errors of one case, in its unit, by substeps of a frame."""
    particles, features = case.build()
    out = {}
    with World(particles, features, precision=precision, order=order, iterations=PASSES) as world:
        for n in substeps:
            world.substeps = n
            out[str(n)] = float(case.error(observe(case, world)[0]))
    return out


def named(precision: str, order: int) -> str:
    """Return a short name of a curve."""
    return precision.replace("compensated", "comp.") + (f", order {order}" if order > 2 else "")


def table(case: Case, rows: dict[str, dict[str, float]]) -> Table:
    """Return the table of one case, in at most 80 characters."""
    out = Table(title=f"{case.title}: error [{case.unit}] after {case.seconds:g} s", title_justify="left")
    out.add_column("substeps", no_wrap=True)
    for n in SUBSTEPS:
        out.add_column(str(n), justify="right", no_wrap=True)
    for name, errors in rows.items():
        out.add_row(name, *(f"{errors[str(n)]:.1e}" if str(n) in errors else "" for n in SUBSTEPS))
    return out


def plot(path: str, found: dict[str, dict[str, dict[str, float]]]) -> None:
    """Plot all cases in one picture, log-log; "auto" is a dashed horizontal line."""
    from matplotlib.figure import Figure  # type: ignore[reportMissingImports]

    figure = Figure(figsize=(4 * len(found), 4), layout="constrained")
    parts = figure.subplots(1, len(found), squeeze=False)
    for part, (name, rows) in zip(parts[0], found.items(), strict=True):
        for label, errors in rows.items():
            steps = [int(n) for n in errors if n != "auto"]
            (line,) = part.loglog(steps, [errors[str(n)] for n in steps], "o-", label=label)
            if "auto" in errors:
                part.axhline(errors["auto"], color=line.get_color(), linestyle="--", linewidth=0.7)
        part.set(title=name.partition("_")[0], xlabel="substeps of a frame", ylabel="error")
    parts[0][0].legend(fontsize="small")
    figure.savefig(path)


def main(arguments: list[str] | None = None) -> None:
    """Measure the cases and print the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m tiverlet.report.accuracy.smaller_steps", description=(__doc__ or "").split("\n", 1)[0]
    )
    parser.add_argument("cases", nargs="*", help="beginnings of names, such as D01; five chains without any")
    parser.add_argument("--json", action="store_true", help="numbers for other programs")
    parser.add_argument("--plot", metavar="FILE", help="a picture (needs matplotlib)")
    options = parser.parse_args(arguments)
    names = [n for n in CASES if n.startswith(tuple(options.cases or SHOWN))]
    if options.cases and not names:
        parser.error(f"no case begins with {' or '.join(options.cases)}")
    found = {}
    for name in names:
        found[name] = {named(*which): curve(CASES[name], *which) for which in CURVES}
        if not options.json:
            Console(width=80).print(table(CASES[name], found[name]))
    if options.json:
        print(json.dumps(found, indent=1))
    if options.plot:
        plot(options.plot, found)


if __name__ == "__main__":
    main()
