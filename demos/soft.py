"""Soft bodies: balls that keep their area, a star that keeps its shape, and a rigid box, dropped on each other.

    python demos/soft.py [soft.rrd]

What to look for: the balls flatten where they press on each other and bulge where they can, since their area stays; the rubber
star springs back; the box of the same links tumbles without giving way.
"""

import sys

import numpy as np

import tiverlet as tv

STAR = [[0.45 * r * np.sin(t), 0.45 * r * np.cos(t)] for t, r in zip(np.arange(10) * np.pi / 5, [1.0, 0.5] * 5, strict=True)]


def build() -> tuple[tv.World, tv.Area, list[slice]]:
    """Make five balls, a star and a rigid box, inside a larger box."""
    S = tv.shapes
    balls = [S.ball((x, y), 0.35, 4) for x, y in ((-1.0, 0.4), (0.0, 0.4), (1.0, 0.4), (-0.5, 1.3), (0.55, 1.3))]
    star, box = S.blob(STAR, 0.1).moved((0.0, 2.3)), S.truss((-0.9, 2.0), (-0.4, 2.3), (5, 3)).turned(0.3)
    body, parts = S.join(*balls, star, box)
    soft = np.concatenate([b.links + p.start for b, p in zip([*balls, star], parts[:6], strict=True)])
    area = tv.Area(body.loops[:5])
    features = [
        tv.Gravity(9.81),
        tv.Distance(soft, compliance=3e-3, damping=0.02),
        area,
        tv.ShapeMatch([np.arange(p.start, p.stop) for p in parts[5:]], compliance=[5e-5, 0.0], damping=[5.0, 0.0]),
        tv.Contact(friction=0.3),
        tv.Box((-1.5, 0.0), (1.5, 4.0), friction=0.4),
    ]
    return tv.World(tv.Particles(body.position, mass=0.02, radius=0.04), features, substeps=20), area, parts


def main(path: str = "soft.rrd", *, seconds: float = 4.0) -> None:
    """Simulate, record, and check areas and shapes."""
    world, area, parts = build()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        report = world.run(seconds, recorder=recorder, progress=True)
    lost = float(np.abs(area.rest_of(world.position) / area.rest - 1).max())
    box, start = world.position[parts[6]], world.particles.position[parts[6]]
    bent = np.abs(np.linalg.norm(box - box[0], axis=1) - np.linalg.norm(start - start[0], axis=1)).max()
    print(f"{path}: areas kept to {lost:.1e}, the box to {bent:.1e} m, flags: {', '.join(sorted(report.flags)) or 'none'}")
    if not (lost < 0.02 and bent < 0.01 and np.isfinite(world.position).all()):
        raise SystemExit("a body has lost its area or its shape")


if __name__ == "__main__":
    main(*sys.argv[1:2])
