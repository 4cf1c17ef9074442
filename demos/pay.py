"""What each feature costs: the same particles, and one feature more per row.

    python demos/pay.py

What to look for: what is not in the scene takes no memory and no time. Times are medians; compare them with each other only.
"""

import numpy as np
from rich.console import Console
from rich.table import Table

import tiverlet as tv

N = 4000


def rows():
    """Yield name, particles and features of each row; every row has all features of the row above."""
    spots = np.stack([np.arange(N) % 63, np.arange(N) // 63], axis=1) * 0.025
    i = np.arange(0, N - 1, 2)
    pairs = np.stack([i, i + 1], axis=1)
    adds = [
        ("nothing: straight lines", lambda: []),
        ("+ Gravity", lambda: [tv.Gravity(9.81)]),
        ("+ Drag", lambda: [tv.Drag(0.1)]),
        ("+ Box", lambda: [tv.Box((-0.1, -0.1), (1.7, 3.0))]),
        (f"+ Distance, {len(pairs)} rigid links", lambda: [tv.Distance(pairs)]),
        ("+ Contact", lambda: [tv.Contact()]),
    ]
    for k in range(len(adds)):
        yield adds[k][0], tv.Particles(spots, radius=0.01), [f for _, make in adds[: k + 1] for f in make()]


def main() -> None:
    """Print the table."""
    table = Table(title=f"{N} particles in 2D, f32, 20 substeps, one thread")
    for name in ("scene", "fields", "bytes per particle", "ms per frame"):
        table.add_column(name, justify="left" if name == "scene" else "right")
    fields = 0
    for name, particles, features in rows():
        with tv.World(particles, features, path="fused") as world:
            times = [world.step(1 / 60).seconds for _ in range(60)][5:]
            if len(world.fields) < fields:
                raise SystemExit("a scene with more features has fewer fields")
            fields = len(world.fields)
            size = sum(world.fields.values()) / N
            table.add_row(name, str(fields), f"{size:.0f}", f"{1e3 * float(np.median(times)):.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
