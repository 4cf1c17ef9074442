"""A wrecking ball swings through a wall of bricks, which then comes down.

    python demos/wrecking.py [wrecking.rrd]

What to look for: the wall stands still on its own friction until it is hit; bricks tumble and slide over each other and never end
up inside of one another; and the chain, whose links weigh a thousandth of the ball, keeps its length.
"""

import sys

import numpy as np
from rich.progress import track

import tiverlet as tv

ROWS, COLUMNS, WIDE, HIGH, ROUND = 10, 4, 0.5, 0.25, 0.025  # of the wall; size of a brick and radius of its corners [m]
TOP, LENGTH, LINKS, BALL = 5.2, 4.2, 16, 0.45  # height of the crane, length of the chain and radius of the ball [m]
HIT = 1.0  # time before which the ball does not reach the wall [s]


def wall(first: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the corners of all bricks, and the loop of each, numbered from `first` on.

    Every other row begins and ends with half a brick.
    """
    corners = []
    for row in range(ROWS):
        cut = np.arange(COLUMNS + 1.0) if row % 2 else np.array([0.0, *(np.arange(COLUMNS) + 0.5), COLUMNS])
        for a, b in zip(WIDE * cut[:-1] + ROUND, WIDE * cut[1:] - ROUND, strict=True):
            low, high = HIGH * row + ROUND, HIGH * (row + 1) - ROUND
            corners += [[a, low], [b, low], [b, high], [a, high]]
    return np.array(corners) + [0.5, 0.0], list(first + np.arange(len(corners)).reshape(-1, 4))


def build() -> tuple[tv.World, list[np.ndarray], tv.Distance]:
    """Make the wall, and a chain from the crane with the ball at its end, pulled aside."""
    chain = tv.shapes.rope((0.0, TOP), (LENGTH * np.sin(-1.1), TOP - LENGTH * np.cos(-1.1)), points=LINKS + 1)
    corners, loops = wall(first=LINKS + 1)
    links = tv.Distance(chain.links)
    sides = np.concatenate([loop[np.stack(np.triu_indices(4, 1), axis=1)] for loop in loops])
    mass, radius = np.full(LINKS + 1 + len(corners), 3.0), np.full(LINKS + 1 + len(corners), ROUND)
    mass[:LINKS], radius[:LINKS] = 1.0, 0.04
    mass[LINKS], radius[LINKS] = 1000.0, BALL
    features = [
        tv.Gravity(9.81), links, tv.Distance(sides), tv.Polygons(loops, friction=0.6), tv.Box((-4.3, 0), (6.0, TOP), friction=0.7)
    ]  # fmt: skip
    start = tv.Particles(np.concatenate([chain.position, corners]), mass=mass, radius=radius, pinned=[0])
    return tv.World(start, features, substeps=40, iterations=2), loops, links


def deepest(world: tv.World, loops: list[np.ndarray]) -> float:
    """Return the largest depth of the ball, a corner or a point along an edge inside a brick [m]; bricks are rectangles."""
    x, brick = world.position, world.position[np.array(loops)]
    rim = np.concatenate([brick + k / 4 * (np.roll(brick, -1, axis=1) - brick) for k in range(4)], axis=1).reshape(-1, 2)
    points, radius = np.concatenate([rim, x[[LINKS]]]), np.append(np.full(len(rim), ROUND), BALL)
    own = np.append(np.repeat(np.arange(len(loops)), 16), -1)
    along, across = brick[:, 1] - brick[:, 0], brick[:, 3] - brick[:, 0]
    half = np.stack([np.linalg.norm(v, axis=1) / 2 for v in (along, across)], axis=1)[:, None]
    axes = np.stack([along, across], axis=1) / (2 * half.transpose(0, 2, 1))
    beyond = np.abs(np.einsum("bkd,bpd->bpk", axes, points - brick.mean(axis=1)[:, None])) - half
    distance = np.linalg.norm(np.maximum(beyond, 0), axis=2) + np.minimum(beyond.max(axis=2), 0) - ROUND - radius
    return float(-distance[own != np.arange(len(loops))[:, None]].min())


def main(path: str = "wrecking.rrd", *, seconds: float = 5.0) -> None:
    """Simulate, record, and measure."""
    world, loops, links = build()
    corners = np.concatenate(loops)
    start, energy, moved, depth, stretch, flags = world.position, [], 0.0, 0.0, 0.0, set()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in track(range(round(60 * seconds)), description=f"{len(loops)} bricks"):
            report = world.step(1 / 60)
            recorder.log()
            flags |= report.flags
            x = world.position
            moved = max(moved, float(np.abs(x - start)[corners].max())) if world.time < HIT else moved
            energy.append(report.energy)
            depth = max(depth, deepest(world, loops))
            stretch = max(stretch, float(np.abs(links.violation(x)).max()) * LINKS / LENGTH)
    grown = float((energy - np.minimum.accumulate(energy)).max() / (energy[0] - energy[-1]))
    fallen = float((start - x)[corners, 1].mean() / start[corners, 1].mean())
    print(
        f"{path}: bricks moved {1e3 * moved:.1f} mm before they were hit, came {1e3 * depth:.1f} mm into each other at worst, and"
    )
    print(f"are down by {fallen:.0%}; a link of the chain was off by {stretch:.2%}, energy grew by {grown:.3%} of what was lost,")
    print(f"flags: {', '.join(sorted(flags)) or 'none'}")
    if moved > 0.002 or depth > 0.01 or stretch > 0.01 or grown > 0.002 or fallen < 0.3:
        raise SystemExit("the wall or the chain is not as it should be")


if __name__ == "__main__":
    main(*sys.argv[1:2])
