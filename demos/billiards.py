"""Billiards: a cue ball with side and back spin, a break, and balls that slide, roll and come to rest.

    python demos/billiards.py [billiards.rrd]

What to look for: the cue ball slides first and then rolls, at 5/7 of its speed had it started without spin; after the break it
follows through, because it still rolls forward; balls slow down as felt resists rolling, and all come to rest.
"""

import sys

import numpy as np

import tiverlet as tv

RADIUS, MASS = 0.0286, 0.17
LENGTH, WIDTH = 2.54, 1.27
SPEED, SLIDING, ROLLING = 6.0, 0.2, 0.01


def build() -> tv.World:
    """Make fifteen balls in a triangle, on a table with cushions, and a cue ball that was hit above its centre."""
    rows = [(row, k - row / 2) for row in range(5) for k in range(row + 1)]
    rack = np.array([(0.75 * LENGTH + row * np.sqrt(3) * 1.002 * RADIUS, 2.004 * k * RADIUS) for row, k in rows])
    x = np.zeros((16, 3))
    x[0, :2], x[1:, :2] = (0.25 * LENGTH, 0.004), rack
    x[:, 2] = RADIUS
    velocity, spin = np.zeros((2, 16, 3))
    velocity[0, 0] = SPEED
    spin[0] = (0.0, 1.4 * SPEED / RADIUS, 20.0)  # forward, faster than rolling, and sideways
    felt = tv.HalfSpace((0, 0, 1), friction=(SLIDING, SLIDING, ROLLING, 0.02), restitution=0.5)
    cushions = tv.Box((0, -WIDTH / 2, -0.1), (LENGTH, WIDTH / 2, 0.1), friction=0.14, restitution=0.75)
    balls = tv.Particles(x, velocity=velocity, mass=MASS, radius=RADIUS, spin=spin, orientation=0)
    return tv.World(balls, [tv.Gravity((0, 0, -9.81)), tv.Contact(friction=0.06, restitution=0.95), felt, cushions], substeps=8)


def check(world: tv.World) -> None:
    """Check that all balls lie at rest on the table, and that the rack is broken."""
    x = world.position
    if (np.abs(x[:, 2] - RADIUS) > 1e-3).any() or (x[:, :2] < [RADIUS - 1e-5, -WIDTH / 2]).any() or (x[:, 0] > LENGTH).any():
        raise SystemExit("a ball has left the table")
    if np.abs(world.velocity).max() > 0.05:
        raise SystemExit("a ball still rolls")
    if np.ptp(x[1:, 0]) < 0.5:
        raise SystemExit("the rack was not broken")


def main(path: str = "billiards.rrd", *, seconds: float = 20.0) -> None:
    """Simulate, record, and print the results."""
    world = build()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        report = world.run(seconds, recorder=recorder, progress=True)
    check(world)
    print(f"{path}: all at rest after {seconds:g} s; flags: {', '.join(sorted(report.flags)) or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
