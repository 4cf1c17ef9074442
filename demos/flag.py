"""A flag on a pole, in a wind that turns, rises and falls, with eddies in it.

    python demos/flag.py [flag.rrd]

What to look for: folds run from the pole to the fly, faster than the flag as a whole swings round; when the wind drops, the flag
sinks. Its threads hardly give way.
"""

import sys

import numpy as np
from rich.progress import track

import tiverlet as tv
from tiverlet.device import ti

LONG, HIGH, TOP, POINTS = 1.5, 1.0, 2.4, (37, 25)  # length, width and upper edge of the flag [m], its particles
MASS, RATE = 0.3 / (POINTS[0] * POINTS[1]), 3.0  # of a particle [kg]; rate of the drag by the wind [1/s]


@ti.func
def eddies(x, v, t):
    """Return the force of eddies, in addition to the wind [N]: waves of air across the wind that travel with it."""
    long, short = ti.sin(4.0 * x[0] + 2.0 * x[1] - 22.0 * t), ti.sin(9.0 * x[0] - 3.0 * x[1] - 41.0 * t)
    return MASS * RATE * ti.Vector([0.0, ti.sin(5.0 * x[0] - 20.0 * t), 3.0 * long + 2.0 * short])


def wind(time: float) -> np.ndarray:
    """Return the velocity of the air [m/s]."""
    turn, speed = 0.5 * np.sin(0.9 * time), 7.0 + 3.0 * np.sin(1.7 * time) * np.sin(0.6 * time)
    return speed * np.array([np.cos(turn), 0.0, np.sin(turn)])


def build() -> tuple[tv.World, tv.shapes.Shape]:
    """Make inextensible threads and a weave that is soft across them, pinned along the pole."""
    sheet = tv.shapes.cloth((0.05, TOP - HIGH, 0.0), (LONG, 0, 0), (0, HIGH, 0), POINTS)
    features = [
        tv.Gravity(9.81),
        tv.Wind(wind(0.0), RATE),
        tv.Force(eddies),
        tv.Distance(sheet.links),
        tv.Distance(sheet.braces, compliance=0.1, damping=0.002),
        tv.Capsule((0, 0, 0), (0, TOP + 0.1, 0), 0.03),
        tv.HalfSpace((0, 1, 0)),
    ]
    held = np.flatnonzero(sheet.position[:, 0] < 0.06)
    return tv.World(tv.Particles(sheet.position, mass=MASS, radius=0.01, pinned=held), features, substeps=30), sheet


def each_frame(world: tv.World) -> None:
    """Set the wind for the next frame; `tiverlet play flag` calls this too."""
    air = next(f for f in world.features if isinstance(f, tv.Wind))
    air.velocity = wind(world.time + 1 / 60)


def heading(vector: np.ndarray) -> float:
    """Return the direction of a vector, seen from above [rad]."""
    return float(np.arctan2(vector[2], vector[0]))


def main(path: str = "flag.rrd", *, seconds: float = 6.0) -> None:
    """Simulate, record, and compare the directions of flag and wind."""
    world, sheet = build()
    rest = np.linalg.norm(np.diff(sheet.position[sheet.links], axis=1)[:, 0], axis=1)
    stretch, apart, flags = 0.0, 0.0, set()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in track(range(round(60 * seconds)), description=f"{len(sheet)} particles"):
            each_frame(world)
            flags |= world.step(1 / 60).flags
            recorder.log()
            stretch = max(stretch, float(tv.measure.strain(world, sheet.links, rest).max()))
            apart = max(apart, abs(heading(world.position.mean(axis=0)) - heading(wind(world.time))))
    print(f"{path}: threads were stretched by {stretch:.1%} at most, and the flag pointed within {np.degrees(apart):.0f} degrees")
    print(f"of where the wind blew, flags: {', '.join(sorted(flags)) or 'none'}")
    if stretch > 0.05 or apart > 0.3 or not np.isfinite(world.position).all():
        raise SystemExit("the flag is torn, or does not follow the wind")


if __name__ == "__main__":
    main(*sys.argv[1:2])
