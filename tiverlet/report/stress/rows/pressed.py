"""Rows about contacts under load: masses of 1 : 1e6, towers, bodies of polygons, and walls that close."""

import numpy as np

from ....colliders import Box, HalfSpace
from ....constraints import Distance, ShapeMatch
from ....contact import Contact, Polygons
from ....forces import Drag, Gravity
from ....particles import Particles
from ....shapes import ball
from ....step.step_report import COMPRESSED
from .row import Findings, at_most, excused, finite, row, summary, world

G = 9.81


@row(121, "head-on collisions of masses 1 : 1e3 and 1 : 1e6, e = 0, 0.5, 1", "the velocities of the closed form")
def _ratios() -> Findings:
    ratio, errors = np.array([1e3, 1e6, 1e-3, 1e-6]), []
    x = np.array([[-0.3, k] for k in range(4)] + [[0.3, k] for k in range(4)])
    v = np.repeat([[2.0, 0], [-1.0, 0]], 4, axis=0)
    start = Particles(x, velocity=v, mass=np.r_[np.ones(4), ratio], radius=0.1)
    middle = (2 - ratio) / (1 + ratio)
    for e in (0.0, 0.5, 1.0):
        with world(start, [Contact(restitution=e)]) as w:
            w.run(0.4)
            want = np.r_[middle - 3 * e * ratio / (1 + ratio), middle + 3 * e / (1 + ratio)]
            errors.append(float(np.abs(w.velocity[:, 0] - want).max()))
    yield at_most(f"{max(errors):.0e} m/s", max(errors), 1e-12)


@row(122, "towers of 2 and 10 discs, each or the top one 1e3 and 1e6 times as heavy, on a floor",
     "stand, and each contact bears what is above it; overlap small or flagged")  # fmt: skip
def _towers() -> Findings:
    for name, masses, limit in (
        ("1 under 1e3", [1.0, 1e3], 1e-8),
        ("1 under 1e6", [1.0, 1e6], 1e-3),
        ("9 under 1e3", [1.0] * 9 + [1e3], 2e-6),
        ("9 under 1e6", [1.0] * 9 + [1e6], 5e-2),
        ("10 to the k", list(10.0 ** np.arange(7)), 5e-3),
    ):
        n = len(masses)
        x = np.stack([np.full(n, 0.5), 0.5 + np.arange(float(n))], axis=1)
        with world(Particles(x, mass=masses, radius=0.5), [Gravity(G), Drag(4.0), Contact(), Box((0, 0), (1, 99))]) as w:
            reports = [w.step(1 / 60) for _ in range(300)]
            energy = max(r.energy for r in reports) - (reports[0].energy - reports[0].energy_change)
            energy /= G * float(np.dot(masses, x[:, 1]))
            yield at_most(f"{name}: energy {energy:+.0e} m g L", energy, 0.0, finite(w))
            overlap = max(r.overlap for r in reports)
            yield f"{name}: overlap {overlap:.2g}", all(excused(r, "overlap", 2 * COMPRESSED) for r in reports)
            c, h = w.contacts, 1 / 60 / reports[-1].substeps
            bears = G * np.cumsum(masses[::-1])[: n - 1]
            got = np.sort(c.impulse[(c.pairs >= 0).all(axis=1)])[-(n - 1) :] / h / (-np.expm1(-4 * h) / (4 * h))
            error = float(np.abs(got / np.sort(bears) - 1).max()) if len(got) == n - 1 else np.inf
            yield at_most(f"{name}: loads to {error:.0e}", error, limit)


def plates(width: float, height: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of plates above each other, and their loops."""
    corner = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2 * [width, height]
    middle = np.stack([np.zeros(count), height * (0.5 + 1.01 * np.arange(count))], axis=1)
    return (middle[:, None] + corner).reshape(-1, 2), np.arange(4 * count).reshape(-1, 4)


def stacked(ratio: float) -> Findings:
    """Stack plates of 1 : 1 ... 1 : 100, of which the top one is `ratio` times as heavy, on a floor."""
    gains, lowest, told = [], [], []
    for height in (1.0, 0.1, 0.01):
        x, loops = plates(1.0, height, 3)
        mass = np.repeat([1.0, 1.0, ratio], 4)
        floor = HalfSpace((0, 1), friction=0.5)
        with world(Particles(x, mass=mass), [Gravity(G), ShapeMatch(loops), Polygons(loops, friction=0.5), floor]) as w:
            reports = [w.step(1 / 60) for _ in range(120)]
            first = reports[0].energy - reports[0].energy_change
            supply = G * float(mass @ x[:, 1])
            gains.append((max(r.energy for r in reports) - first) / supply if finite(w) else np.inf)
            lowest.append(-float(w.position[:, 1].min()) / height)
            told.append(all(excused(r, "overlap", 2 * COMPRESSED) for r in reports))
    yield at_most(f"1 : {ratio:g}: energy {max(gains):+.0e} m g L", max(gains), 0.0)
    yield at_most(f"1 : {ratio:g}: {max(lowest):.0e} of a height in the floor", max(lowest), 0.0)
    yield f"1 : {ratio:g}: overlap excused: {told}", all(told)


@row(
    123, "bodies of Polygons, 1 : 1 ... 1 : 100, under one 1e3 times as heavy", "no energy, they rest on each other and the floor"
)
def _bodies() -> Findings:
    return stacked(1e3)


@row(127, "the same under one 1e6 times as heavy", "the same",
     known="bodies of Polygons under a mass of 1 : 1e6 are pressed through each other and into the floor")  # fmt: skip
def _crushed() -> Findings:
    return stacked(1e6)


@row(124, "planes that close on loose discs, links and a cluster", "no faster than 100 times the planes, or named",
     known="what cannot be met gives way too late: links and clusters are thrown between closing planes")  # fmt: skip
def _closing() -> Findings:
    ring, holds = ball((0, 1), 0.4, rings=3), {}
    for name, made in (
        ("links", lambda: [Distance(ring.links)]), ("cluster", lambda: [ShapeMatch([np.arange(len(ring.position))])]),
        ("discs", lambda: []),
    ):  # fmt: skip
        lid = HalfSpace((0, -1), -1.6)
        start = Particles(ring.position, mass=0.1, radius=0.03)
        room = [lid, HalfSpace((0, 1)), Box((-0.6, -9), (0.6, 9)), Contact()]
        with world(start, [Gravity(G), *made(), *room], precision="f32") as w:
            fastest = 0.0
            for k in range(240):
                lid.offset = min(-0.02, -1.6 + 0.01 * (k + 1))
                w.step(1 / 60)
                fastest = max(fastest, float(np.abs(w.velocity).max()))
            holds[f"{name}: {fastest:.2g} m/s"] = fastest <= 60.0
    yield from summary(f"{len(holds)} scenes", holds)
