"""Two questions asked backwards: which double pendulum made this track, and how to throw a ball over a wall into a bucket.

    python demos/fit.py [fit.rrd]

What to look for: the pendulum that was fitted passes through the points that were seen, for which the fit has no more than the
track of the lower bob, with noise, and a wrong guess. Beside it the throw that was found follows its points over the wall, and
stays in the bucket; the other balls are throws of the first round of the search.
"""

import sys

import numpy as np
from rich.console import Console
from rich.table import Table

import tiverlet as tv

TRUE = {"upper": 1.0, "lower": 0.7, "mass": 0.5}  # lengths of the rods [m], mass of the lower bob [kg]; the upper has 1 kg
GUESS = {"upper": 0.8, "lower": 0.9, "mass": 1.0}
NOISE = 0.005  # standard deviation of the measured track [m]
SEEN = 2.0  # duration of the track [s]
PIN = (-2.3, 2.3)
FROM, RADIUS = (0.0, 1.0), 0.1  # start and radius of the ball [m]
BUCKET, HEIGHT = (5.08, 5.8), 0.8
THROWS, ROUNDS, ELITE = 1000, 6, 50


def pendulum(upper: float, lower: float, mass: float) -> tv.World:
    """Make a double pendulum, pulled aside."""
    return tv.World(bobs(upper, lower, mass), [tv.Gravity(), tv.Distance([[0, 1], [1, 2]])], substeps=20, precision="f64")


def bobs(upper: float, lower: float, mass: float) -> tv.Particles:
    """Make the pin and the two bobs."""
    elbow = PIN + upper * np.array([np.sin(1.2), -np.cos(1.2)])
    end = elbow + lower * np.array([np.sin(0.6), -np.cos(0.6)])
    return tv.Particles(np.array([PIN, elbow, end]), mass=[1.0, 1.0, mass], pinned=[0])


def track(worlds: tv.Worlds) -> np.ndarray:
    """Return the positions of the lower bob, 30 times a second, (worlds, frames, 2)."""
    return worlds.rollout(SEEN, every=2).position[:, :, 2]


def fit(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Fit lengths and mass by the Gauss-Newton method, from GUESS. Returns them, their standard errors, and the number of runs.

    The steps are in the logarithms, so that all parameters stay positive.
    """
    found, runs = np.array([*GUESS.values()]), 0
    for _ in range(20):
        now, slopes = tv.gradient(pendulum, dict(zip(TRUE, found.tolist(), strict=True)), track)
        runs += 2 * len(found) + 1
        jacobian = np.stack([slope.reshape(-1) for slope in slopes.values()], axis=1)
        miss = (seen - now).reshape(-1)
        step = np.linalg.lstsq(jacobian * found, miss, rcond=None)[0]
        found = found * np.exp(np.clip(step, -0.3, 0.3))
        if np.abs(step).max() < 1e-8:
            break
    spread = np.sqrt(np.mean(miss**2) * np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    return found, spread, runs


def walls() -> list[tv.HalfSpace | tv.Polygon]:
    """Make the ground, the wall, and the two sides of the bucket."""

    def block(left: float, right: float, height: float) -> tv.Polygon:
        return tv.Polygon([(left, 0.0), (right, 0.0), (right, height), (left, height)], restitution=0.6, friction=0.3)

    sides = [block(BUCKET[0] - 0.08, BUCKET[0], HEIGHT), block(BUCKET[1], BUCKET[1] + 0.08, HEIGHT)]
    return [tv.HalfSpace((0, 1), restitution=0.6, friction=0.3), block(2.9, 3.1, 2.4), *sides]


def velocities(throws: np.ndarray) -> np.ndarray:
    """Return the velocities of throws, given by speed and angle, (..., 2)."""
    speed, angle = np.moveaxis(throws, -1, 0)
    return np.stack([speed * np.cos(angle), speed * np.sin(angle)], axis=-1)


def caught(x: np.ndarray) -> np.ndarray:
    """Whether balls are in the bucket. x: (..., 2)."""
    return (x[..., 0] > BUCKET[0]) & (x[..., 0] < BUCKET[1]) & (x[..., 1] < HEIGHT)


def search() -> tuple[np.ndarray, np.ndarray, np.ndarray, list[float]]:
    """Find the throw by the cross-entropy method: the best of many random throws give the distribution of the next round.

    Impacts make the path of a ball a discontinuous function of speed and angle, so gradients do not help. Returns speed and angle
    of the most central throw among those caught last, its path, some throws of the first round, and the share of throws caught in
    each round.
    """
    random, mouth = np.random.default_rng(1), (np.mean(BUCKET), HEIGHT)
    mean, spread, first, shares = np.array([6.0, 0.8]), np.array([2.0, 0.4]), np.zeros((0, 2)), []
    throws, x, hit = np.zeros((0, 2)), np.zeros((0, 0, 2)), np.zeros(0, dtype=bool)
    ball = tv.Particles([FROM], radius=RADIUS)
    with tv.Worlds(tv.World(ball, [tv.Gravity(), *walls()], substeps=8), THROWS) as worlds:
        for _ in range(ROUNDS):
            throws = mean + spread * random.standard_normal((THROWS, 2))
            worlds.reset(velocity=velocities(throws)[:, None])
            x = worlds.rollout(4.0, every=2).position[:, :, 0]
            hit = caught(x[:, -1])
            best = np.argsort(np.linalg.norm(x - mouth, axis=2).min(axis=1) + ~hit)[:ELITE]
            mean, spread = throws[best].mean(axis=0), throws[best].std(axis=0)
            first = first if len(first) else throws[(x[:, -1, 0] > -1) & (x[:, -1, 0] < 8)][:10]
            shares.append(float(hit.mean()))
    middle = np.argmin(np.abs((throws - mean) / spread).sum(axis=1) + 1e3 * ~hit)
    return throws[middle], x[middle], first, shares


def build(fitted: np.ndarray, points: np.ndarray, throws: np.ndarray) -> tv.World:
    """Put everything into one scene: the pendulum, throws without contacts between them, and the measured points."""
    rods, n = bobs(*fitted), len(throws)
    at = np.concatenate([rods.position, np.tile(FROM, (n, 1)), points])
    velocity = np.concatenate([np.zeros((3, 2)), velocities(throws), np.zeros_like(points)])
    mass = np.concatenate([rods.mass, np.ones(n), np.full(len(points), np.inf)])
    radius = np.concatenate([[0.0, 0.07, 0.07], np.full(n, RADIUS), np.full(len(points), 0.012)])
    particles = tv.Particles(at, velocity=velocity, mass=mass, radius=radius, pinned=[0])
    return tv.World(particles, [tv.Gravity(), tv.Distance([[0, 1], [1, 2]]), *walls()], substeps=20)


def play() -> tv.World:
    """Make the pendulum and one throw, to be moved by mouse."""
    return build(np.array([*TRUE.values()]), np.zeros((0, 2)), np.array([[7.9, 1.04]]))


def main(path: str = "fit.rrd") -> None:
    """Fit, search, show, and check the results."""
    random = np.random.default_rng(0)
    with tv.Worlds(pendulum(**TRUE), 1) as worlds:
        exact = track(worlds)[0]
    seen = exact + NOISE * random.standard_normal(exact.shape)
    table = Table(title="a double pendulum by the track of its lower bob")
    for name in ("", *TRUE, "runs"):
        table.add_column(name, justify="right")
    truth = np.array([*TRUE.values()])
    table.add_row("is", *(f"{v:.4f}" for v in truth), "")
    table.add_row("guess", *(f"{v:.4f}" for v in GUESS.values()), "")
    found, _, runs = fit(exact)
    table.add_row("without noise", *(f"{v:.4f}" for v in found), f"{runs}")
    if np.abs(found / truth - 1).max() > 1e-6:
        raise SystemExit(f"without noise the fit found {found} instead of {truth}")
    found, spread, runs = fit(seen)
    told = (f"{v:.4f} ± {s:.4f}" for v, s in zip(found, spread, strict=True))
    table.add_row(f"noise of {1000 * NOISE:g} mm", *told, f"{runs}")
    if (np.abs(found - truth) > 4 * spread).any() or (spread > 0.01).any():
        raise SystemExit(f"with noise the fit found {found} instead of {truth}")
    Console().print(table)

    throw, way, others, shares = search()
    print(f"the throw: {throw[0]:.2f} m/s at {np.degrees(throw[1]):.1f} degrees, after {ROUNDS} rounds of {THROWS} worlds;")
    print(f"caught in each round: {', '.join(f'{share:.0%}' for share in shares)}")
    world = build(found, np.concatenate([seen, way[:50:2]]), np.concatenate([[throw], others]))
    with tv.Recorder(path, world, overwrite=True) as recorder:
        world.run(SEEN, recorder=recorder)
        off = float(np.linalg.norm(world.position[2] - exact[-1]))
        report = world.run(2.0, recorder=recorder)
    inside = bool(caught(world.position[3]))
    print(f"{path}: the pendulum ends {1000 * off:.1f} mm from where it was seen, flags: {', '.join(report.flags) or 'none'}")
    if off > 0.02 or not inside or shares[-1] < 0.6:
        raise SystemExit(f"the pendulum is {off} m off, the ball is at {world.position[3]}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
