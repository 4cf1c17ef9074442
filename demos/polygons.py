"""A pile of polygons in a hexagonal drum that turns: bodies made of loops of particles, which do not overlap.

    python demos/polygons.py [polygons.rrd]

What to look for: bodies roll and slide over each other with friction, edge on edge and corner on edge; no body is inside of
another; the drum lifts the pile until it slides.
"""

import sys

import numpy as np

import tiverlet as tv

RADIUS, SPEED = 1.5, 0.8  # radius [m] and speed [rad/s] of the drum


def build(bodies: int = 45) -> tv.World:
    """Make regular polygons of 3 to 7 corners in a hexagonal drum, held by links along the sides and from the first corner.

    These are as many links as make a body rigid, which are solved exactly.
    """
    spots = tv.golden(np.arange(4 * bodies), dim=2) * 2.2 - 1.1
    chosen: list[np.ndarray] = []
    for spot in spots:
        if len(chosen) < bodies and np.linalg.norm(spot) < 1.2 and all(np.linalg.norm(spot - c) > 0.26 for c in chosen):
            chosen.append(spot)
    position, loops, links, at = [], [], [], 0
    for k, spot in enumerate(chosen):
        corners = 3 + k % 5
        angle = 2 * np.pi * (np.arange(corners) / corners + tv.golden(k))
        position.append(spot + (0.09 + 0.03 * tv.golden(7 * k)) * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        around = np.arange(corners)
        loops.append(at + around)
        links.append(at + np.stack([around, np.roll(around, -1)], axis=1))
        links.append(at + np.stack([0 * around[2:-1], around[2:-1]], axis=1))
        at += corners
    turn = np.arange(6) * np.pi / 3
    drum = tv.Polygon(RADIUS * np.stack([np.cos(turn), np.sin(turn)], axis=1), inside=True, friction=0.5)
    features = [tv.Gravity(9.81), tv.Distance(np.concatenate(links)), tv.Polygons(loops, friction=0.4), drum]
    return tv.World(tv.Particles(np.concatenate(position), mass=0.1), features, substeps=10)


def deepest(world: tv.World) -> float:
    """Return the largest depth of a corner, or of a point a quarter or half along an edge, inside another body [m]."""
    x, worst = world.position, 0.0
    loops = next(f for f in world.features if isinstance(f, tv.Polygons)).loops
    after = np.arange(len(x))
    for loop in loops:
        after[loop] = np.roll(loop, -1)
    rim = np.concatenate([x + k / 4 * (x[after] - x) for k in range(4)])
    body = np.tile(np.repeat(np.arange(len(loops)), [len(loop) for loop in loops]), 4)
    for k, loop in enumerate(loops):
        a = x[loop]
        center = a.mean(axis=0)
        near = rim[(((rim - center) ** 2).sum(axis=1) < ((a - center) ** 2).sum(axis=1).max()) & (body != k)]
        if len(near):
            u = x[after[loop]] - a
            outward = np.stack([u[:, 1], -u[:, 0]], axis=1) / np.linalg.norm(u, axis=1)[:, None]
            height = (near @ outward.T - (a * outward).sum(axis=1)).max(axis=1)  # distance of each point from the convex body
            worst = max(worst, float(-height.min()))
    return worst


def main(path: str = "polygons.rrd", *, seconds: float = 8.0) -> None:
    """Simulate, record, and print the results."""
    world = build()
    drum = next(f for f in world.features if isinstance(f, tv.Polygon))
    worst = 0.0
    with tv.Recorder(path, world, every=2, overwrite=True) as recorder:
        for _ in range(round(60 * seconds)):
            drum.rotation += SPEED / 60
            report = world.step(1 / 60)
            worst = max(worst, deepest(world))
            recorder.log()
    outside = np.linalg.norm(world.position, axis=1).max() - RADIUS
    if worst > 0.01 or outside > 1e-4:
        raise SystemExit(f"a rim is {worst:.4f} m inside of another body, or a corner {outside:.4f} m out of the drum")
    bodies = len({tuple(loop) for f in world.features if isinstance(f, tv.Polygons) for loop in f.loops})
    print(f"{path}: {bodies} bodies, no rim more than {1e3 * worst:.1f} mm inside of another and no corner out of the drum,")
    print(f"{report.contacts} contacts and {1e3 * report.seconds:.1f} ms in the last frame")


if __name__ == "__main__":
    main(*sys.argv[1:2])
