"""A cube of jelly is squeezed to about half of its height and let go.

    python demos/jelly.py [jelly.rrd]

What to look for: it bulges where the lid does not hold it, since its volume stays; when the lid opens it jumps, trembles and
comes to rest at its old height.
"""

import sys

import numpy as np
from rich.progress import track

import tiverlet as tv

SIDE, CELLS, MASS = 1.0, 6, 50.0  # [m], cells along each edge, [kg]


def build() -> tuple[tv.World, tv.Volume]:
    """Make a cube between the floor and the lid of a box. Tetrahedra keep its volume, and soft links its shape."""
    cube = tv.shapes.truss((-SIDE / 2, 0.0, -SIDE / 2), (SIDE / 2, SIDE, SIDE / 2), (CELLS,) * 3)
    flesh = tv.Volume(cube.tetrahedra, compliance=1e-9)
    form = tv.Distance(np.concatenate([cube.links, cube.braces]), compliance=2e-3, damping=1.0)
    room = tv.Box((-SIDE, 0.0, -SIDE), (SIDE, lid(0.0), SIDE), friction=0.6)
    start = tv.Particles(cube.position, mass=MASS / len(cube))
    return tv.World(start, [tv.Gravity(9.81), form, flesh, room], substeps=40, iterations=2), flesh


def lid(time: float) -> float:
    """Return the height of the lid [m]: it comes down within a second, waits for one, and rises within a tenth."""
    return float(SIDE * (1.65 - 1.1 * tv.smoothstep(0.0, 1.0, time) * (1 - tv.smoothstep(2.0, 2.1, time))))


def each_frame(world: tv.World) -> None:
    """Move the lid; `tiverlet play jelly` repeats this."""
    room = next(f for f in world.features if isinstance(f, tv.Box))
    room.upper = (SIDE, lid((world.time + 1 / 60) % 4), SIDE)


def main(path: str = "jelly.rrd", *, seconds: float = 4.0) -> None:
    """Squeeze, release, record and measure."""
    world, flesh = build()
    top = np.flatnonzero(world.position[:, 1] > 0.99 * SIDE)
    rest, lost, wide, high, flags = flesh.rest.sum(), 0.0, 0.0, [], set()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in track(range(round(60 * seconds)), description=f"{flesh.count} tetrahedra"):
            each_frame(world)
            flags |= world.step(1 / 60).flags
            recorder.log()
            x = world.position
            volumes = flesh.rest_of(x)
            if volumes.min() <= 0:
                raise SystemExit("a tetrahedron is inside out")
            lost, wide = max(lost, float(abs(volumes.sum() / rest - 1))), max(wide, float(np.ptp(x[:, 0])))
            high.append(float(x[top, 1].mean()) / SIDE)
    print(
        f"{path}: squeezed to {min(high):.2f} of its height it is {wide / SIDE:.2f} times as wide and lost {lost:.1%} of volume;"
    )
    print(f"let go it jumps to {max(high):.2f} and ends at {high[-1]:.2f}, flags: {', '.join(sorted(flags)) or 'none'}")
    if lost > 0.03 or not 0.95 < high[-1] < 1.05 or min(high) > 0.6:
        raise SystemExit("the jelly has lost its volume or its form")


if __name__ == "__main__":
    main(*sys.argv[1:2])
