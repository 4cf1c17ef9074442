"""What each feature costs: the same particles, and one feature more per row.

    python demos/pay.py

What to look for: what is not in the scene takes no memory and no time. Times are medians; compare them with each other only.
"""

from collections.abc import Iterator
from time import process_time

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


def priced(frames: int) -> Iterator[tuple[str, int, float, float]]:
    """Yield name, fields, bytes per particle and ms of CPU time per frame (the median after five) of each row."""
    for name, particles, features in rows():
        with tv.World(particles, features, substeps=20, path="fused") as world:
            clock = [process_time()]
            for _ in range(frames):
                world.step(1 / 60)
                clock.append(process_time())
            ms = 1e3 * float(np.median(np.diff(clock)[5:])) if frames > 5 else np.nan
            yield name, len(world.fields), sum(world.fields.values()) / N, ms


def main() -> None:
    """Print the table."""
    tv.init(threads=1)
    table = Table(title=f"{N} particles in 2D, f32, 20 substeps, one thread")
    for name in ("scene", "fields", "bytes per particle", "ms per frame"):
        table.add_column(name, justify="left" if name == "scene" else "right")
    before = 0
    for name, fields, size, ms in priced(60):
        if fields < before:
            raise SystemExit("a scene with more features has fewer fields")
        before = fields
        table.add_row(name, str(fields), f"{size:.0f}", f"{ms:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
