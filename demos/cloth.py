"""A cloth falls on a ball and slides, and stays without stretching or folding through it.

    python demos/cloth.py [cloth.rrd]

What to look for: folds. The ball is where it can be seen through the cloth; no particle is ever inside.
"""

import sys

import numpy as np

import tiverlet as tv

CENTER, RADIUS = np.array([0.0, 0.5, 0.0]), 0.4


def build(points: int = 31) -> tuple[tv.World, tv.shapes.Shape]:
    """Make a square of 1.4 m, inextensible along the threads and soft across them, over a ball and a ground with friction."""
    sheet = tv.shapes.cloth((-0.7, 1.05, -0.65), (1.4, 0, 0), (0, 0, 1.4), (points, points))
    features = [
        tv.Gravity(9.81),
        tv.Drag(0.3),
        tv.Distance(sheet.links),
        tv.Distance(sheet.braces, compliance=1e-2, damping=0.005),
        tv.Ball(CENTER, RADIUS, friction=0.2),
        tv.HalfSpace((0, 1, 0), friction=0.5),
    ]
    return tv.World(tv.Particles(sheet.position, mass=0.3 / points**2, radius=0.012), features, substeps=20), sheet


def main(path: str = "cloth.rrd", *, seconds: float = 3.0) -> None:
    """Drop the cloth, record, and measure."""
    world, sheet = build()
    with tv.Recorder(path, world, every=2, overwrite=True) as recorder:
        report = world.run(seconds, recorder=recorder, progress=True)
    rest = np.linalg.norm(np.diff(sheet.position[sheet.links], axis=1)[:, 0], axis=1)
    stretch = tv.measure.strain(world, sheet.links, rest)
    depth = RADIUS + 0.012 - np.linalg.norm(world.position - CENTER, axis=1)
    print(f"{path}: threads stretched by {stretch.max():.1%} at most, {1e3 * max(0, depth.max()):.3f} mm deep in the ball,")
    print(f"{1e3 * (world.last or report).seconds:.1f} ms for the last frame, flags: {', '.join(sorted(report.flags)) or 'none'}")
    if stretch.max() > 0.05 or depth.max() > 1e-4 or world.position[:, 1].min() < 0.0:
        raise SystemExit("the cloth is torn or pierced")


if __name__ == "__main__":
    main(*sys.argv[1:2])
