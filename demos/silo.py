"""A silo: what the floor bears, force chains, and grains that run out of it at a steady rate.

    python demos/silo.py [silo.rrd]

What to look for: lines as wide as the loads run from wall to wall, so that the floor bears less than half of the grains' weight
once friction at the walls has been stirred up, by letting these rise a little (Janssen 1895). When a gate opens in the floor, as
much flows out each second, however high the silo is filled (Beverloo 1961).
"""

import sys

import numpy as np

import tiverlet as tv

GRAINS, RADIUS, WIDTH, GATE = 450, 0.03, 0.6, 0.36
G, SETTLED = 9.81, 4.0  # [m/s^2]; time until the gate opens [s], in whose last quarter the walls rise a little
RISE = 0.02  # speed of the rising walls [m/s]


def build() -> tv.World:
    """Make a narrow silo over a bin. The floor of the silo is a row of fixed discs."""
    floor = np.arange(-WIDTH / 2 + RADIUS / 2, WIDTH / 2, RADIUS)
    rows = int(WIDTH / (2.2 * RADIUS))
    k = np.arange(GRAINS)
    x = np.stack([2.2 * RADIUS * (k % rows + 0.5 + 0.3 * tv.golden(k)) - WIDTH / 2, 0.1 + 2.2 * RADIUS * (k // rows)], axis=1)
    radius = RADIUS * (0.8 + 0.4 * tv.golden(k))
    grip = (0.5, 0.5, 0.05)
    ground = np.stack([floor, np.full(len(floor), 0.0)], axis=1)
    start = tv.Particles(
        np.concatenate([x, ground]), radius=np.r_[radius, np.full(len(floor), RADIUS / 2)],
        mass=np.r_[1000 * np.pi * radius**2, np.ones(len(floor))], pinned=np.arange(len(x), len(x) + len(floor)), spin=True,
    )  # fmt: skip
    walls = [
        tv.Polygon(np.array([(0, 0), (0.1, 0), (0.1, 3.6), (0, 3.6)]) + (left, -0.01), friction=grip)
        for left in (-WIDTH / 2 - 0.1, WIDTH / 2)
    ]
    bin_ = tv.Box((-1.2, -1.0), (1.2, np.inf), friction=grip)
    return tv.World(start, [tv.Gravity(G), tv.Contact(friction=grip), *walls, bin_], substeps=16)


def borne(world: tv.World) -> float:
    """Return the share of the grains' weight that the floor carries."""
    p, found = world.particles, world.contacts
    held = p.pinned[found.pairs]
    pushes = found.impulse[:, None] * found.normal  # impulse on the first particle of each pair, from the second
    down = np.where(held[:, 1] & ~held[:, 0], pushes[:, 1], np.where(held[:, 0] & ~held[:, 1], -pushes[:, 1], 0.0))
    h = 1 / 60 / world.substeps
    return float(down.sum() / h / (G * p.mass[~p.pinned].sum()))


def check(share: float, rates: np.ndarray) -> None:
    """Check that the floor carries less than the weight, and that the flow is steady."""
    if not 0.2 < share < 0.75:
        raise SystemExit(f"the floor bears {share:.0%} of the weight")
    if rates.min() < 0.6 * rates.max():
        raise SystemExit(f"{rates.min()} to {rates.max()} grains run out in a second")


def main(path: str = "silo.rrd", *, seconds: float = 7.0) -> None:
    """Fill the silo, open it, record, and print the results."""
    world = build()
    walls = world.features[2:4]
    shares, out = [], []
    with tv.Recorder(path, world, every=2, overwrite=True, forces=True, color=("load", 0.0, 2000.0)) as recorder:
        for frame in range(round(60 * seconds)):
            if 45 * SETTLED <= frame < 60 * SETTLED:
                for wall in walls:
                    wall.position = (0.0, RISE * (frame + 1 - 45 * SETTLED) / 60)
            if frame == round(60 * SETTLED):
                x = world.position
                world.remove(np.flatnonzero(world.particles.pinned & (np.abs(x[:, 0]) < GATE / 2)))
            report = world.step(1 / 60)
            recorder.log()
            if 55 * SETTLED <= frame < 60 * SETTLED:
                shares.append(borne(world))
            out.append(int((world.position[:, 1] < -0.02).sum()))
    begin = round(60 * SETTLED) + 30
    rates = np.diff(out[begin::60])  # over whole seconds: in half of one some 55 grains run out, and 15 more or less are chance
    share = float(np.mean(shares))
    print(f"{path}: the floor bears {share:.0%} of the weight; {rates.mean():.0f} grains run out in a second, {rates.min()} to")
    print(f"{rates.max()}; flags: {', '.join(sorted(report.flags)) or 'none'}")
    check(share, rates)


if __name__ == "__main__":
    main(*sys.argv[1:2])
