"""A tidy grid: a heap of discs is tossed up, and each looks for a place of its own on a grid.

    python demos/tidy.py [tidy.rrd]

What to look for: discs are drawn to the nearest node, and push each other on to the next where it is taken. Some pairs come to
rest in one cell, each as far from the node as the other.
"""

import sys

import numpy as np

import tiverlet as tv

SPACING = 0.1


def build() -> tuple[tv.World, tv.Gravity, tv.Snap]:
    """Make discs in a box. The grid is there from the start, but gravity is stronger."""
    pile = tv.shapes.pile((-1.0, 0.02), (1.0, 0.8), (0.025, 0.045))
    gravity = tv.Gravity(9.81)
    snap = tv.Snap(np.arange(len(pile)), SPACING, origin=(0.0, SPACING / 2), compliance=0.05, damping=0.4)
    features = [gravity, snap, tv.Drag(0.5), tv.Contact(friction=0.1), tv.Box((-1.2, 0.0), (1.2, 2.0))]
    return tv.World(tv.Particles(pile.position, mass=0.1, radius=pile.radius), features, substeps=12), gravity, snap


def main(path: str = "tidy.rrd") -> None:
    """Drop, toss and tidy up the discs, and count them."""
    world, gravity, snap = build()
    n = len(world.particles)
    with tv.Recorder(path, world, overwrite=True) as recorder:
        world.run(1.0, recorder=recorder)
        world.velocity = 3 * (tv.golden(np.arange(n), dim=2) - [0.5, -0.2])
        gravity.g = (0.0, 0.0)
        report = world.run(4.0, recorder=recorder, progress=True)
    x = world.position
    home = np.linalg.norm(x - snap.node(x), axis=1) < 0.15 * SPACING
    taken = len(np.unique(snap.node(x[home]).round(6), axis=0))
    print(f"{path}: {home.sum()} of {n} discs are at home, on {taken} nodes, flags: {', '.join(sorted(report.flags)) or 'none'}")
    if taken < home.sum() or home.mean() < 0.7:
        raise SystemExit("the grid is not tidy")


if __name__ == "__main__":
    main(*sys.argv[1:2])
