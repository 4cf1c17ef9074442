"""A rotating drum: grains that spin are carried up on one side and come down the other as an avalanche.

    python demos/drum.py [drum.rrd]

What to look for: the heap leans by its angle of repose and flows at its surface only; below it turns with the drum as a block.
Grains that roll without resistance lie flatter: give `rolling` 0.
"""

import sys

import numpy as np

import tiverlet as tv

GRAINS, RADIUS, TURN = 420, 0.03, 0.8  # TURN [rad/s]


def build(rolling: float = 0.1) -> tv.World:
    """Make a drum of radius 1, about half full."""
    angle = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    grip = (0.6, 0.6, rolling)
    drum = tv.Polygon(np.stack([np.cos(angle), np.sin(angle)], axis=1), inside=True, friction=grip)
    x = 1.7 * (tv.golden(np.arange(3 * GRAINS), dim=2) - 0.5)
    x = x[np.linalg.norm(x, axis=1) < 0.9][:GRAINS]
    radius = RADIUS * (0.85 + 0.3 * tv.golden(np.arange(GRAINS)))
    grains = tv.Particles(x, radius=radius, mass=1000 * np.pi * radius**2, spin=True, orientation=0)
    return tv.World(grains, [tv.Gravity(9.81), tv.Contact(friction=grip), drum], substeps=20)


def lean(world: tv.World) -> float:
    """Return the angle of the heap's surface [degrees]: perpendicular to the line from its centre to that of the drum."""
    middle = world.position.mean(axis=0)
    return float(np.degrees(np.arctan2(middle[0], -middle[1])))


def check(world: tv.World, angle: float) -> None:
    """Check that grains are inside, and that the heap leans by a plausible angle of repose."""
    if (np.linalg.norm(world.position, axis=1) > 1.0).any():
        raise SystemExit("a grain is outside of the drum")
    if not 18 < angle < 45:
        raise SystemExit(f"the heap leans by {angle:.0f} degrees")


def main(path: str = "drum.rrd", *, seconds: float = 8.0) -> None:
    """Simulate, record, and print the results."""
    world = build()
    drum, angles = world.features[2], []
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for frame in range(round(60 * seconds)):
            if frame > 60:
                drum.rotation = TURN * (frame - 60) / 60
            report = world.step(1 / 60)
            recorder.log()
            angles.append(lean(world))
    angle = float(np.mean(angles[len(angles) // 2 :]))
    check(world, angle)
    print(f"{path}: the heap leans by {angle:.1f} degrees; flags: {', '.join(sorted(report.flags)) or 'none'}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
