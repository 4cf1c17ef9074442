"""A buggy drives over hills and winds in a trailer; a gate lets both through, and does not let them back.

    python demos/buggy.py [buggy.rrd]

What to look for: motors turn both wheels at one speed, uphill and downhill, with a torque that has a limit. The winch makes its
rope shorter as evenly, so the trailer catches up. Beyond the gate the motors turn back, and push against it in vain.
"""

import sys

import numpy as np

import tiverlet as tv

WHEEL, RIM, BASE, SPOKES = 0.3, 0.04, 1.0, 24  # radii of wheels and of the particles on their rims, wheelbase [m]
SPEED, TORQUE, ROPE, WIND, SHORT = 6.0, 10.0, 2.0, 0.3, 0.8  # [rad/s], [N m] per wheel, [m], [m/s], [m]
GATE, BACK, END = 7.5, 8.0, 10.5  # place of the gate [m], time at which the motors reverse [s], end [s]


def build() -> tuple[tv.World, tv.Motor, tv.Winch]:
    """Make the buggy, its trailer, the hills and the gate.

    Each wheel is a hub, which is its first particle, and a rim. The third wheel is the trailer. The last particle is the driver.
    """
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    wheel = np.concatenate([[[0.0, 0.0]], (WHEEL - RIM) * np.stack([np.cos(angle), np.sin(angle)], axis=1)])
    hubs = np.array([[-1.5, WHEEL], [-1.5 - BASE, WHEEL], [-1.5 - BASE - ROPE, WHEEL]])
    x = np.concatenate([*(hub + wheel for hub in hubs), [hubs[:2].mean(axis=0) + [0.0, 0.5]]])
    wheels, driver = np.arange(len(x) - 1).reshape(3, -1), len(x) - 1
    front, rear, trailer = wheels[:, 0]
    hinges = [(driver, w[0], rim) for w in wheels[:2] for rim in w[1 :: SPOKES // 4]]  # four spokes share the torque
    motor = tv.Motor(hinges, -SPEED, torque=TORQUE / 4)
    winch = tv.Winch([(rear, trailer)], -WIND, shortest=SHORT)
    line = np.linspace(-5, GATE + 4, 200)
    hills = 0.12 * (1 - np.cos(2.2 * np.clip(line, 0, 4 * np.pi / 2.2)))
    features = [
        tv.Gravity(9.81), tv.ShapeMatch(wheels), tv.Distance([(front, rear), (front, driver), (rear, driver)]), motor, winch,
        tv.Polygon(np.stack([line, hills], axis=1), closed=False, friction=0.9),
        tv.Polygon([(GATE, 0.0), (GATE, 1.2)], closed=False, one_way=(1, 0)),
    ]  # fmt: skip
    mass = np.full(len(x), 0.05)
    mass[[front, rear, trailer, driver]] = 0.5, 0.5, 0.2, 1.0
    return tv.World(tv.Particles(x, mass=mass, radius=RIM), features, substeps=40), motor, winch


def main(path: str = "buggy.rrd") -> None:
    """Drive, reverse, and compare speeds, rope and torque with their settings."""
    world, motor, winch = build()
    angles, rope, load, flags = [], 0.0, 0.0, set()
    with tv.Recorder(path, world, overwrite=True) as recorder:
        for _ in range(round(60 * END)):
            flags |= world.step(1 / 60).flags
            recorder.log()
            x = world.position
            angles.append(np.arctan2(*(x[1] - x[0])[::-1]) - np.arctan2(*(x[-1] - x[0])[::-1]))
            rope = max(rope, abs(winch.rest[0] - max(ROPE - WIND * world.time, SHORT)), winch.violation(x)[0])
            load = max(load, abs(motor.load).max())
            if world.time > BACK:
                motor.speed = SPEED
    angle, behind = np.unwrap(angles), world.position[:, 0].min() - GATE - RIM
    turned = (angle[round(60 * BACK) - 1] - angle[60]) / (BACK - 61 / 60)
    print(f"{path}: wheels turn at {-turned:.3f} of {SPEED} rad/s, each spoke with at most {load:.2f} N m, the rope is off")
    print(f"by {1e3 * rope:.1f} mm, the gate {1e3 * behind:.1f} mm away, flags: {', '.join(sorted(flags)) or 'none'}")
    if abs(turned + SPEED) > 0.02 * SPEED or load > 1.001 * TORQUE / 4 or rope > 0.02 or not -1e-3 < behind < 0.1:
        raise SystemExit("the buggy has lost its way")


if __name__ == "__main__":
    main(*sys.argv[1:2])
