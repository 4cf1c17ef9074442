"""A hundred figures tumble down the stairs.

    python demos/stairs.py [stairs.rrd]

What to look for: rows fall forward, slide over each other and heap up at the foot; no limb goes much further than a joint does,
and nobody ends up in the stairs.
"""

import sys
from itertools import combinations

import numpy as np
from rich.progress import track

import tiverlet as tv

STEPS, STEP, WIDE, FLOOR, TALL = 10, 0.45, 5.0, 3.5, 1.2  # how many steps, depth and height of each [m]; lengths [m]
INF = float("inf")


def stairs() -> tuple[np.ndarray, np.ndarray]:
    """Return treads and risers from a landing down to the floor at y = 0, as vertices and faces."""
    x = np.array([-2 * STEP, *np.repeat(STEP * np.arange(STEPS), 2), STEP * (STEPS - 1) + FLOOR])
    y = np.repeat(STEP * np.arange(STEPS, -1, -1), 2)
    vertices = np.stack([np.tile(x, 2), np.tile(y, 2), np.repeat([-WIDE / 2, WIDE / 2], len(x))], axis=1)
    a, b = np.arange(len(x) - 1), np.arange(len(x) - 1) + len(x)
    return vertices, np.concatenate([np.stack([a, b, a + 1], axis=1), np.stack([a + 1, b, b + 1], axis=1)])


def build(rows: int = STEPS) -> tuple[tv.World, tv.AngleLimit, tv.Distance]:
    """Make ten figures on each of the lowest `rows` steps, leaning forward, with a push."""
    lean, sway = tv.golden(np.arange(10 * rows)), tv.golden(7 * np.arange(10 * rows)) - 0.5
    dolls = []
    for k in range(10 * rows):
        step, seat = STEPS - 1 - k // 10, k % 10
        feet = (STEP * (step - 0.5), STEP * (STEPS - step) + 0.06, 0.48 * (seat - 4.5) + 0.1 * sway[k])
        dolls.append(tv.shapes.ragdoll(feet, TALL).turned(-0.15 - 0.1 * lean[k]))
    body, _ = tv.shapes.join(*dolls)
    joints = tv.AngleLimit(body.limits, body.lower, body.upper, compliance=1e-3, damping=0.2)
    bones = tv.Distance(np.concatenate([body.links, body.braces]))
    features = [
        tv.Gravity(9.81), tv.Drag(0.1), bones, joints,
        tv.Contact(friction=0.2, groups=list(combinations(range(len(dolls)), 2))),  # no contacts within a figure
        tv.Mesh(*stairs(), closed=False, friction=0.2),
        tv.Box((-2 * STEP, -INF, -WIDE / 2), (STEP * (STEPS - 1) + FLOOR, INF, WIDE / 2)),
    ]  # fmt: skip
    start = tv.Particles(
        body.position,
        mass=1.0 + 20 * body.radius,
        radius=body.radius,
        velocity=(1.5, 0, 0),
        group=np.repeat(np.arange(len(dolls)), 16),
    )
    return tv.World(start, features, substeps=20, solver=tv.ConjugateGradient(10)), joints, bones


def main(path: str = "stairs.rrd", *, seconds: float = 3.5) -> None:
    """Simulate, record, and check every joint."""
    world, joints, bones = build()
    over, off, deep, flags, radius = 0.0, 0.0, 0.0, set(), world.particles.radius
    with tv.Recorder(path, world, every=2, overwrite=True) as recorder:
        for _ in track(range(round(60 * seconds)), description=f"{len(radius) // 16} figures"):
            report = world.step(1 / 60)
            recorder.log()
            flags |= report.flags
            x = world.position
            over, off = max(over, joints.violation(x).max()), max(off, np.abs(bones.violation(x)).max())
            ground = STEP * np.clip(STEPS - np.ceil(x[:, 0] / STEP), 0, STEPS)
            deep = max(deep, (ground + radius - x[:, 1]).max())
    low = float((x.reshape(-1, 16, 3).mean(axis=1)[:, 1] < 2 * STEP).mean())
    print(f"{path}: joints at most {np.degrees(over):.0f} degrees over their limits, bones off by {1e3 * off:.0f} mm at worst,")
    print(f"{1e3 * max(deep, 0):.1f} mm deep in the stairs, {low:.0%} are down, flags: {', '.join(sorted(flags)) or 'none'}")
    if over > 0.4 or off > 0.02 or deep > 1e-3 or low < 0.5:
        raise SystemExit("somebody has broken a bone, is in the stairs, or is still up there")


if __name__ == "__main__":
    main(*sys.argv[1:2])
