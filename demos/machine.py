"""A machine: a wheel that is driven turns a crank, which moves a stamp on a rail and a rocker; an arm swings on hinges.

    python demos/machine.py [machine.rrd]

What to look for: one point is driven, round and round; all else follows through rigid bodies, rods, paths and hinges with stops.
The stamp goes up and down as the formula of the slider crank says, and presses on its rail with the force that it says.
"""

import sys

import numpy as np

import tiverlet as tv

CRANK, ROD, RATE, STAMP = 0.3, 1.0, 2.0, 1.0  # lengths [m], turns per second, mass of the stamp [kg]


def stamp(time: float) -> float:
    """Return the height of the stamp [m]: the crank is at angle 2 pi RATE time, and the rod hangs from it down to the rail."""
    turn = 2 * np.pi * RATE * time
    return CRANK * np.sin(turn) - np.sqrt(ROD**2 - (CRANK * np.cos(turn)) ** 2)


def side(time: float) -> float:
    """Return the force of the stamp on its rail [N]: weight and inertia, along the slope of the rod."""
    a = (stamp(time + 1e-4) - 2 * stamp(time) + stamp(time - 1e-4)) / 1e-8
    lean = CRANK * np.cos(2 * np.pi * RATE * time)
    return STAMP * (a + 9.81) * lean / np.sqrt(ROD**2 - lean**2)


def build() -> tuple[tv.World, tv.Path]:
    """Make the machine. Particles 0 to 8 are the wheel and its hub, 9 the stamp, 10 to 12 the rocker, 13 to 16 the arm."""
    angle = 2 * np.pi * np.arange(8) / 8
    wheel = CRANK * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rocker, arm = [[1.3, 0.0], [1.52, 0.449], [1.08, -0.449]], [[1.9, 0.5], [1.9, 0.1], [1.9, -0.3], [2.2, -0.3]]
    x = np.array([*wheel, [0.0, 0.0], [0.0, stamp(0.0)], *rocker, *arm])
    drive = tv.Path([0], tv.shapes.polygon((0, 0), CRANK, 64).position, closed=True, speed=2 * np.pi * CRANK * RATE)
    rail = tv.Path([9], [[0.0, -1.5], [0.0, -0.5]], smooth=False)
    rods = [*((8, k) for k in range(8)), (0, 9), (0, 11), (10, 11), (10, 12), (13, 14), (14, 15), (15, 16)]
    features = [
        tv.Gravity(9.81), drive, rail, tv.Distance(rods), tv.ShapeMatch([np.arange(9), np.arange(10, 13)]),
        tv.AngleLimit([[13, 14, 15], [14, 15, 16]], [-0.6, 0.5], [0.6, 2.0]),
    ]  # fmt: skip
    mass, push = np.full(len(x), 0.2), np.zeros_like(x)
    mass[9], push[16, 0] = STAMP, 4.0
    start = tv.Particles(x, mass=mass, radius=0.03, pinned=[8, 10, 13], velocity=push)
    return tv.World(start, features, substeps=40, iterations=20, precision="f64"), rail


def main(path: str = "machine.rrd", *, seconds: float = 3.0) -> None:
    """Turn the wheel, and compare the stamp and its rail with the formulas."""
    world, rail = build()
    off, force = 0.0, []
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in range(round(seconds * 60)):
            report = world.step(1 / 60)
            off = max(off, abs(world.position[9, 1] - stamp(world.time)))
            force.append((-rail.load[0, 0], side(world.time - 1 / 2400)))
            recorder.log()
    load, want = np.array(force[10:]).T
    print(f"{path}: the stamp is {1e6 * off:.1f} micrometres from the formula, its rail bears up to {abs(load).max():.1f} N,")
    print(f"{abs(load - want).max():.2f} N from the formula, flags: {', '.join(sorted(report.flags)) or 'none'}")
    if off > 1e-4 or abs(load - want).max() > 0.05 * abs(want).max():
        raise SystemExit("the machine has jammed")


if __name__ == "__main__":
    main(*sys.argv[1:2])
