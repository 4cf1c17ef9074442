"""Two nets: one catches a ball, the other tears under one that is eight times as heavy.

    python demos/net.py [net.rrd]

What to look for: threads break where the load is, one after the other, and the hole grows until the ball is through. The net that
holds carries what hangs in it: the loads of its threads add up to the weight.
"""

import sys

import numpy as np

import tiverlet as tv

CELLS, SIDE, STRENGTH = 20, 1.6, 12.0  # cells along a side, side [m], strength of a thread [N]
BALLS = (0.5, 4.0)  # masses of the balls [kg]


def build() -> tv.World:
    """Make two square nets in frames, side by side, and a ball above each. Threads pull and do not push."""
    k = np.arange((CELLS + 1) ** 2).reshape(CELLS + 1, CELLS + 1)
    i, j = np.divmod(k.ravel(), CELLS + 1)
    knots = np.stack([i / CELLS - 0.5, 0.0 * i, j / CELLS - 0.5], axis=1) * SIDE
    threads = np.concatenate([np.stack([k[:-1], k[1:]], -1).reshape(-1, 2), np.stack([k[:, :-1], k[:, 1:]], -1).reshape(-1, 2)])
    frame = np.flatnonzero((i % CELLS == 0) | (j % CELLS == 0))
    apart = np.array([2.0, 0.0, 0.0])
    position = np.concatenate([knots, knots + apart, [[0.03, 0.5, 0.02], [2.03, 0.5, 0.02]]])
    mass = np.concatenate([np.full(2 * k.size, 0.005), BALLS])
    radius = np.concatenate([np.full(2 * k.size, 0.015), [0.25, 0.25]])
    features = [
        tv.Gravity(9.81),
        tv.Rope(np.concatenate([threads, threads + k.size]), SIDE / CELLS, compliance=2e-4, damping=1.0, break_at=STRENGTH),
        tv.Contact(friction=0.2),
        tv.HalfSpace((0, 1, 0), -1.0, friction=0.5),
        tv.Drag(2.0),
    ]
    return tv.World(
        tv.Particles(position, mass=mass, radius=radius, pinned=np.concatenate([frame, frame + k.size])), features, substeps=20,
        iterations=4,
    )  # fmt: skip


def check(world: tv.World) -> float:
    """Check that the first net holds, and that the second is torn and its ball on the ground.

    Returns the load of the first net over the weight that it carries.
    """
    rope, n, x = next(f for f in world.features if isinstance(f, tv.Rope)), (CELLS + 1) ** 2, world.position
    whole = ~rope.broken
    first = rope.indices[:, 0] < n
    if not whole[first].all() or x[-2, 1] < -0.7:
        raise SystemExit("the first net did not hold")
    if whole[~first].all() or x[-1, 1] > -0.7:
        raise SystemExit("the second net did not tear")
    held = world.particles.pinned[rope.indices]  # threads at the frame have one pinned end
    edge = first & (held.sum(axis=1) == 1)
    a, b = x[rope.indices[edge, 0]], x[rope.indices[edge, 1]]
    steep = np.abs(a - b)[:, 1] / np.linalg.norm(a - b, axis=1)
    free = (~world.particles.pinned[:n]).sum()
    return float((rope.load[edge] * steep).sum() / (9.81 * (BALLS[0] + 0.005 * free)))


def main(path: str = "net.rrd") -> None:
    """Simulate, record, and print what tore when."""
    world, events = build(), []
    with tv.Recorder(path, world, every=2, overwrite=True) as recorder:
        for _ in range(360):
            report = world.step(1 / 60)
            recorder.log()
            events += [(world.time, report.broken)] if report.broken else []
    ratio = check(world)
    if abs(ratio - 1) > 0.02:
        raise SystemExit(f"the frame carries {ratio:.3f} of the weight")
    torn, times = sum(n for _, n in events), [t for t, _ in events]
    print(f"{path}: {torn} threads tore between {times[0]:.2f} s and {times[-1]:.2f} s;")
    print(f"the frame of the other net carries {ratio:.3f} times its weight")


if __name__ == "__main__":
    main(*sys.argv[1:2])
