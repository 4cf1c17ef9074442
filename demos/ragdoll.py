"""Figures fall down the stairs, with elbows and knees that bend one way only.

    python demos/ragdoll.py [ragdoll.rrd]

What to look for: limbs go no further than joints do, and nobody ends up in the stairs.
"""

import sys

import numpy as np

import tiverlet as tv

STEPS = [(0.0, 2.4), (1.6, 2.4)] + [(1.6 + 0.4 * ((k + 1) // 2), 2.4 - 0.3 * (k // 2 + 1)) for k in range(15)]


def build() -> tuple[tv.World, tv.AngleLimit, tv.Distance]:
    """Make three figures at the top of the stairs, each leaning further than the one before, with a push."""
    dolls = [tv.shapes.ragdoll((0.45 + 0.5 * k, 2.5 + 0.05 * k), 1.2).turned(-0.15 * k) for k in range(3)]
    body, parts = tv.shapes.join(*dolls)
    stairs = [*STEPS, (STEPS[-1][0] + 3.0, STEPS[-1][1]), (STEPS[-1][0] + 3.0, -0.6), (0.0, -0.6)]
    joints = tv.AngleLimit(body.limits, body.lower, body.upper, compliance=1e-3, damping=0.2)
    bones = tv.Distance(np.concatenate([body.links, body.braces]))
    group = np.concatenate([np.full(p.stop - p.start, k) for k, p in enumerate(parts)])
    features = [
        tv.Gravity(9.81), tv.Drag(0.2), bones, joints, tv.Contact(friction=0.4, groups=[(0, 1), (0, 2), (1, 2)]),
        tv.Polygon(stairs, friction=0.5), tv.Box((0.0, -0.6), (stairs[-3][0], 5.0)),
    ]  # fmt: skip
    start = tv.Particles(body.position, mass=1.0 + 20 * body.radius, radius=body.radius, velocity=(1.2, 0), group=group)
    return tv.World(start, features, substeps=30, iterations=2, solver=tv.ConjugateGradient(5)), joints, bones


def main(path: str = "ragdoll.rrd", *, seconds: float = 5.0) -> None:
    """Simulate, record, and check every joint."""
    world, joints, bones = build()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        report = world.run(seconds, recorder=recorder, progress=True)
    over = float(np.maximum(joints.violation(world.position), 0).max())
    stretch = float(np.abs(bones.violation(world.position)).max())
    print(f"{path}: joints at most {np.degrees(over):.1f} degrees over their limits, bones off by {1e3 * stretch:.1f} mm,")
    print(f"the lowest foot at {world.position[:, 1].min():.2f} m, flags: {', '.join(sorted(report.flags)) or 'none'}")
    if over > 0.2 or stretch > 0.02 or world.position[:, 0].max() < 2.5:
        raise SystemExit("somebody has broken a bone, or is still up there")


if __name__ == "__main__":
    main(*sys.argv[1:2])
