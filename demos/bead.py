"""Beads on wires: a race down three curves, the clock of Huygens, and a roller coaster in 3D.

    python demos/bead.py [bead.rrd]

What to look for: of the beads that start together, the one on the cycloid arrives first; on a cycloid, beads that start at
different heights reach the bottom together; and the one on the closed loop comes back to where it was, without friction.
"""

import sys

import numpy as np

import tiverlet as tv

A, G = 0.5, 9.81  # radius of the rolling circle [m], gravity [m/s^2]


def cycloid(t) -> np.ndarray:
    """Return points of a cycloid, lowest at t = 0; the arc length from there is 4 A sin(t / 2)."""
    return np.stack([A * (t + np.sin(t)), -A * (1 + np.cos(t)), 0 * t], axis=-1)


def build() -> tuple[tv.World, np.ndarray]:
    """Make three wires between the same two points, one wire with four beads, and a loop."""
    t = np.linspace(-3.0, 0.0, 60)
    start, end = cycloid(t[0]), cycloid(t[-1])
    straight = tv.shapes.rope(start, end, 3).position
    quarter = np.stack([1 - np.cos((t + 3) * np.pi / 6), np.sin((t + 3) * np.pi / 6), 0 * t], axis=1)
    wires = [line + [0, 0, z] for line, z in ((cycloid(t), 0.0), (straight, -0.3), (start + (end - start) * quarter, -0.6))]
    clock = cycloid(np.linspace(-3.0, 3.0, 120)) + [0, 0, 0.6]
    heights = np.array([0.4, 1.0, 1.7, 2.4])
    k = 2 * np.pi * np.arange(80) / 80
    loop = np.stack([3.2 + 0.9 * np.cos(k), 0.35 * np.sin(2 * k) - 0.6, 0.9 * np.sin(k)], axis=1)
    beads = np.concatenate([[w[0] for w in wires], cycloid(heights) + [0, 0, 0.6], loop[:1]])
    paths = [*(tv.Path([i], w) for i, w in enumerate(wires)), tv.Path([3, 4, 5, 6], clock), tv.Path([7], loop, closed=True)]
    speed = np.zeros_like(beads)
    speed[7, 2] = 3.0
    return tv.World(tv.Particles(beads, velocity=speed, radius=0.04), [tv.Gravity(G), *paths], substeps=10), heights


def main(path: str = "bead.rrd") -> None:
    """Run the race, and compare with the formulas."""
    world, heights = build()
    arrival, first = np.full(3, np.inf), None
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for frame in range(240):
            report = world.step(1 / 120)
            first = report.energy if first is None else first
            here = world.position[:3, 0] > -1e-2
            arrival[here & np.isinf(arrival)] = world.time
            if frame == 119:
                s = np.sin(heights / 2) * np.cos(np.sqrt(G / (4 * A)) * world.time)
                off = np.abs(world.position[3:7] - cycloid(2 * np.arcsin(s)) - [0, 0, 0.6]).max()
            recorder.log()
    print(f"{path}: down the cycloid, the straight and the elliptic wire in {', '.join(f'{t:.3f}' for t in arrival)} s,")
    print(f"beads on the cycloid {1e6 * off:.1f} micrometres from the formula after 1 s")
    if not (arrival[0] < arrival[1:].min() and off < 1e-4 and "turned" not in report.flags):
        raise SystemExit("a bead is not where it should be")


if __name__ == "__main__":
    main(*sys.argv[1:2])
