"""Newton's cradle, a ball that bounces, and a disc on a slope: what is exact about contacts, next to the formulas.

    python demos/cradle.py

What to look for: restitution and friction do not depend on the step. Writes cradle.rrd.
"""

import numpy as np
from rich.console import Console
from rich.table import Table

import tiverlet as tv


def build(restitution: float = 1.0) -> tv.World:
    """Make five touching balls on threads, the first of them pulled aside."""
    hang = tv.shapes.join(*(tv.shapes.rope((0.1 * k, 1.0), (0.1 * k, 0.0), points=2) for k in range(5)))[0]
    position = hang.position.copy()
    position[1] = [-np.sin(0.5), 1 - np.cos(0.5)]
    radius = np.where(np.arange(10) % 2, 0.05, 0.0)
    features = [tv.Gravity(9.81), tv.Distance(hang.links), tv.Contact(restitution=restitution)]
    return tv.World(tv.Particles(position, radius=radius, pinned=np.arange(0, 10, 2)), features)


def cradle(substeps: tuple[int, int], restitution: float) -> list[float]:
    """Return the speed of the last ball after the first has swung into the row, for each number of substeps."""
    speeds = []
    with build(restitution) as world:
        for n in substeps:
            again(world, n)
            speeds.append(0.0)
            with tv.Recorder("cradle.rrd", world, overwrite=True) as recorder:
                for _ in range(60):
                    world.step(1 / 60)
                    recorder.log()
                    speeds[-1] = max(speeds[-1], float(np.linalg.norm(world.velocity[9])))
    return speeds


def bounce(substeps: tuple[int, int], restitution: float) -> list[float]:
    """Return the height of the third bounce of a ball dropped from 1 m, for each number of substeps."""
    floor = tv.HalfSpace((0, 1), restitution=restitution)
    third = []
    with tv.World(tv.Particles([[0.0, 1.0]]), [tv.Gravity(9.81), floor], precision="f64") as world:
        for n in substeps:
            again(world, n)
            y = np.array([1.0, *(world.step(1 / 600) and world.position[0, 1] for _ in range(2000))])
            third.append(float(y[1:-1][(y[1:-1] >= y[:-2]) & (y[1:-1] > y[2:])][2]))
    return third


def slide(substeps: tuple[int, int], friction: float) -> list[float]:
    """Return how far a disc slides on level ground from a speed of 2 m/s, for each number of substeps."""
    floor = tv.HalfSpace((0, 1), friction=friction)
    start = tv.Particles([[0.0, 0.1]], radius=0.1, velocity=(2.0, 0.0))
    ways = []
    with tv.World(start, [tv.Gravity(9.81), floor]) as world:
        for n in substeps:
            again(world, n)
            world.run(2.0)
            ways.append(float(world.position[0, 0]))
    return ways


def again(world: tv.World, substeps: int) -> None:
    """Reset the world to its start, with another number of substeps."""
    world.position, world.velocity, world.substeps = world.particles.position, world.particles.velocity, substeps


def main() -> None:
    """Print each figure for two numbers of substeps, and its formula."""
    table = Table(title="contacts against formulas")
    for name in ("what", "4 substeps", "40 substeps", "formula"):
        table.add_column(name, justify="left" if name == "what" else "right")
    swung = np.sqrt(2 * 9.81 * (1 - np.cos(0.5)))
    rows = (
        ("cradle, speed of the last ball [m/s]", cradle((4, 40), 1.0), swung, 0.02),
        ("third bounce, e = 0.8 [m]", bounce((1, 10), 0.8), 0.8**6, 0.01),
        ("sliding at 2 m/s, friction 0.4 [m]", slide((4, 40), 0.4), 4 / (2 * 0.4 * 9.81), 0.03),
    )
    for name, figures, formula, limit in rows:
        table.add_row(name.replace("[", "\\["), *(f"{v:.4f}" for v in figures), f"{formula:.4f}")
        if abs(figures[1] / formula - 1) > limit:
            raise SystemExit(f"{name}: {figures[1]} instead of {formula}")
    Console().print(table)


if __name__ == "__main__":
    main()
