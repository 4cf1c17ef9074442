"""Error against work and run time of every solver: a hanging chain that falls, and a cloth.

    python -m tiverlet.report.accuracy.chains [--cloth] [--json]

The chain: a hundred links of 1 cm and 10 g, let go horizontally; root mean square error of all positions after half a second. The
reference is Direct with 3200 substeps per frame, whose error is below 1e-8 m (the tests hold it to the solution of the ODE).
The cloth: 100 x 100 particles on one edge; the median residual of half a second, which is what solvers differ in there.
Work: constraints evaluated, per simulated second, at the same charge for every solver. Times are medians per frame, without
compilation; they depend on the machine.
"""

import argparse
import json

import numpy as np
from rich.console import Console
from rich.table import Table

import tiverlet as tv

FRAME, FRAMES = 1 / 60, 30
CHAIN = [
    (tv.Jacobi(), ((20, 1), (200, 1), (800, 1), (20, 40))),
    (tv.Chebyshev(), ((20, 10), (50, 40))),
    (tv.ConjugateGradient(10), ((50, 1),)),
    (tv.ConjugateGradient(40), ((50, 1),)),
    (tv.Direct(), ((20, 1), (80, 1), (200, 1), (800, 1))),
]
CLOTH = [
    (tv.Jacobi(), ((20, 1), (20, 10), (20, 40))),
    (tv.Chebyshev(), ((20, 10), (20, 40))),
    (tv.ConjugateGradient(10), ((20, 1),)),
    (tv.ConjugateGradient(40), ((20, 1),)),
]


def chain(links: int = 100) -> tuple[tv.Particles, np.ndarray]:
    """The chain, let go horizontally."""
    k = np.arange(links + 1)
    x = np.stack([0.01 * k, 0.0 * k], axis=1)
    return tv.Particles(x, mass=0.01, pinned=[0]), np.stack([k[:-1], k[1:]], axis=1)


def cloth(n: int = 100) -> tuple[tv.Particles, np.ndarray]:
    """A square of 1 m and 1 kg, held at one edge, let go horizontally."""
    k = np.arange(n * n).reshape(n, n)
    pairs = [np.stack([k[:, :-1].ravel(), k[:, 1:].ravel()], axis=1), np.stack([k[:-1].ravel(), k[1:].ravel()], axis=1)]
    row, column = np.divmod(np.arange(n * n), n)
    x = np.stack([column, 0 * row, row], axis=1) / (n - 1)
    return tv.Particles(x, mass=1 / n**2, pinned=k[0]), np.vstack(pairs)


def run(scene: tuple[tv.Particles, np.ndarray], solver, substeps: int, iterations: int = 1, precision: str = "f64") -> dict:
    """One row: positions at the end, work and median time of a frame, residual, and flags."""
    particles, pairs = scene
    features = [tv.Gravity(9.81), tv.Distance(pairs)]
    with tv.World(particles, features, solver=solver, substeps=substeps, iterations=iterations, precision=precision) as world:
        reports = [world.step(FRAME) for _ in range(FRAMES)]
        steps = getattr(solver, "steps", 1)
        return {
            "solver": repr(solver),
            "substeps": substeps,
            "iterations": iterations,
            "visits": substeps * iterations * steps * len(pairs) / FRAME,
            "seconds": float(np.median([r.seconds for r in reports])) / FRAME,
            "residual": float(np.median([r.residual for r in reports])),
            "flags": sorted(set().union(*(r.flags for r in reports))),
            "position": world.position,
        }


def measure(with_cloth: bool = False) -> dict[str, list[dict]]:
    """All rows of the tables."""
    scene, out = chain(), {"chain": [], "cloth": []}
    want = run(scene, tv.Direct(), 3200)["position"]
    for solver, efforts in CHAIN:
        for substeps, iterations in efforts:
            row = run(scene, solver, substeps, iterations)
            row["error"] = float(np.sqrt(np.mean(np.sum((row.pop("position") - want) ** 2, axis=1))))
            out["chain"].append(row)
    for solver, efforts in CLOTH if with_cloth else []:
        for substeps, iterations in efforts:
            row = run(cloth(), solver, substeps, iterations, "f32")
            del row["position"]
            out["cloth"].append(row)
    return out


def main() -> None:
    """Print the tables."""
    summary = (__doc__ or "").split("\n", 1)[0]
    parser = argparse.ArgumentParser(prog="python -m tiverlet.report.accuracy.chains", description=summary)
    parser.add_argument("--cloth", action="store_true", help="the cloth too, which takes a minute")
    parser.add_argument("--json", action="store_true", help="numbers for other programs")
    options = parser.parse_args()
    rows = measure(options.cloth)
    if options.json:
        print(json.dumps(rows, indent=1))
        return
    for name, title in (("chain", "100 links, half a second"), ("cloth", "cloth of 100 x 100, half a second")):
        if rows[name]:
            table = Table(title=title)
            for head in ("solver", "substeps x iterations", "visits/s", "s per s", "residual", "error [m]", "flags"):
                table.add_column(head, justify="left" if head in ("solver", "flags") else "right", no_wrap=True)
            for r in rows[name]:
                error = f"{r['error']:.1e}" if "error" in r else ""
                table.add_row(
                    r["solver"], f"{r['substeps']} x {r['iterations']}", f"{r['visits']:.1e}", f"{r['seconds']:.2e}",
                    f"{r['residual']:.1e}", error, " ".join(r["flags"]),
                )  # fmt: skip
            Console(width=110).print(table)


if __name__ == "__main__":
    main()
