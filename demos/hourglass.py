"""An hourglass: a thousand grains with friction run through a neck, with a ball in their way.

    python demos/hourglass.py [hourglass.rrd]

What to look for: grains heap up at an angle, none gets out, and what has fallen stays where it lies. They do not spin, so with
much more friction they would build an arch over the neck and stay up.
"""

import sys

import numpy as np

import tiverlet as tv

NECK, TOP, WIDTH = 0.36, 2.0, 1.2


def build(grains: int = 1000) -> tv.World:
    """Make two funnels of rods, neck to neck, with the upper one filled."""
    spots = tv.golden(np.arange(4 * grains), dim=2) * [2 * WIDTH, TOP] + [-WIDTH, 0.1]
    inside = np.abs(spots[:, 0]) < NECK / 2 + (WIDTH - NECK / 2) * spots[:, 1] / TOP - 0.12
    position = spots[inside][:grains]
    glass = [
        tv.Capsule((side * NECK / 2, 0.0), (side * WIDTH, end), 0.02, friction=0.1) for side in (-1, 1) for end in (TOP, -TOP)
    ]
    features = [
        tv.Gravity(9.81),
        tv.Contact(friction=0.2),
        tv.Ball((0.0, -1.0), 0.15, friction=0.3),
        tv.Box((-WIDTH, -TOP), (WIDTH, TOP + 1), friction=0.5),
        *glass,
    ]
    return tv.World(tv.Particles(position, radius=0.018 + 0.008 * tv.golden(np.arange(len(position)))), features, substeps=20)


def check(world: tv.World) -> None:
    """Check that every grain is in the glass, and that they have run through."""
    x = world.position
    edge = NECK / 2 + (WIDTH - NECK / 2) * np.abs(x[:, 1]) / TOP
    if not np.isfinite(x).all() or (np.abs(x[:, 0]) > edge + 0.05).any():
        raise SystemExit("a grain is outside of the glass")
    if not 0.9 < (x[:, 1] < 0).mean():
        raise SystemExit("the grains are stuck in the neck")


def main(path: str = "hourglass.rrd", *, seconds: float = 6.0) -> None:
    """Simulate, record, and print the results."""
    world = build()
    with tv.Recorder(path, world, every=2, overwrite=True) as recorder:
        report = world.run(seconds, recorder=recorder, progress=True)
    check(world)
    fallen = float((world.position[:, 1] < 0).mean())
    print(f"{path}: {len(world.particles)} grains, {fallen:.0%} through the neck, worst overlap {report.overlap:.2f} radii,")
    print(f"{1e3 * (world.last or report).seconds:.1f} ms for the last frame, flags: {', '.join(sorted(report.flags)) or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
