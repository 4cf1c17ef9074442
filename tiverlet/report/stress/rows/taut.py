"""Rows about scenes with more constraints than degrees of freedom, or with a load that no constraint bears to first order."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ....colliders import Box
from ....constraints import Area, Distance, Rope, ShapeMatch
from ....contact import Contact
from ....features.feature import Feature
from ....forces import Gravity
from ....particles import Particles
from ....solvers import Chebyshev, ConjugateGradient, Direct, Jacobi
from ....step.adaptive import StepController
from ...accuracy.cases.case import links
from .row import Finding, row, world

G, MASS = 9.81, 0.01
STEPS = (2, 20, 200, "auto")
RULE = "energy never above what it was plus 1e-3 of m g times the size, no speed above free fall, what is not met is flagged"
SECONDS = 10
WHIP = 2.0  # bound of speed over that of free fall: the end of a swinging chain is faster than free fall


class Watch:
    """Runs passive scenes with every number of substeps, and keeps the worst figures."""

    def __init__(self):
        self.gain, self.speed, self.holds, self.flags = -np.inf, 0.0, {}, set()

    def run(
        self, name: str, particles: Particles, features: Sequence[Feature], most: float = 1e-2, room: float = 1e-3, steps=STEPS,
        **settings,
    ) -> None:  # fmt: skip
        """Run a scene with each number of substeps in `steps`.

        most: the residual above which a frame under "auto" must have a flag. room: the allowed gain of energy, as a share of m g
        L, if a frame is flagged "unconverged"; else 1e-3.
        """
        free = np.flatnonzero(~particles.pinned)
        x = particles.position
        size = float(np.ptp(x, axis=0).max())
        supply = MASS * G * len(free) * size
        settings = {"precision": "f32", **settings}
        with world(particles, features, **settings) as w:
            for n in steps:
                w.position, w.velocity, w._controller = x, particles.velocity, StepController()
                w.substeps = n
                start, gain, fastest, lowest, silent, flags = None, -np.inf, 0.0, x[:, 1].min(), False, set()
                for _ in range(SECONDS * 60):
                    report = w.step(1 / 60)
                    start = report.energy - report.energy_change if start is None else start
                    gain = max(gain, (report.energy - start) / supply)
                    fastest = max(fastest, float(np.linalg.norm(w.velocity, axis=1).max()))
                    lowest = min(lowest, w.position[:, 1].min())
                    silent |= n == "auto" and report.residual > most and report.clean
                    flags |= report.flags
                self.flags |= flags
                fastest /= np.sqrt(2 * G * max(size, x[:, 1].max() - lowest))
                where = f"{name}, {settings['precision']}, {w._solver!r}, {n}"
                self.holds[f"{where}: energy {gain:+.1e}"] = bool(gain <= (room if "unconverged" in flags else 1e-3))
                self.holds[f"{where}: speed {fastest:.2g} of free fall"] = bool(fastest <= WHIP)
                self.holds[f"{where}: nothing silent"] = not silent
                self.gain, self.speed = max(self.gain, gain), max(self.speed, fastest)

    def finding(self, **more: bool) -> Finding:
        """Return the worst figures of all runs. more: further parts of the criterion."""
        told = ", ".join(sorted(self.flags)) or "no flag"
        return Finding(f"energy {self.gain:+.0e}, {self.speed:.2f} of free fall; {told}", {**self.holds, **more})


def ropes(counts: Iterable[int], ends: Iterable[Sequence[float]], rest: float = 1.0) -> tuple[Particles, np.ndarray, np.ndarray]:
    """Build straight ropes between pins, side by side in 3D: particles, pairs and rest lengths."""
    x = [np.linspace((0, 2, k), (*np.add((0, 2), end), k), n) for k, (n, end) in enumerate(zip(counts, ends, strict=True))]
    first = np.cumsum([0, *map(len, x)])
    pairs = np.vstack([links(len(a) - 1) + k for a, k in zip(x, first, strict=False)])
    place = np.vstack(x)
    length = rest * np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1)
    return Particles(place, mass=MASS, pinned=np.concatenate([first[:-1], first[1:] - 1])), pairs, length


def grid(nx: int, ny: int, length: float = 0.1, braced: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a lattice in 2D and its links, with both diagonals if braced."""
    k = np.arange(nx * ny).reshape(nx, ny)
    x = np.stack(np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"), axis=2).reshape(-1, 2) * length + [0, 2]
    pairs = [(k[:-1], k[1:]), (k[:, :-1], k[:, 1:])]
    if braced:
        pairs += [(k[:-1, :-1], k[1:, 1:]), (k[:-1, 1:], k[1:, :-1])]
    return x, np.vstack([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])


def complete(n: int) -> np.ndarray:
    """Return all pairs of n particles."""
    return np.array([(i, j) for i in range(n) for j in range(i)])


LEVEL = [(1.0, 0.0)]


@row(71, "straight ropes of 2 to 400 points between two pins", f"{RULE}; 2e-2 where 400 points are flagged unconverged")
def _taut() -> Finding:
    watch = Watch()
    for precision in ("f32", "f64"):
        for counts, room in (((2, 5, 40), 1e-3), ((400,), 2e-2)):  # the longest sags by 0.9 of its length
            particles, pairs, _ = ropes(counts, LEVEL * len(counts))
            watch.run("Distance", particles, [Gravity(G), Distance(pairs)], precision=precision, room=room)
    particles, pairs, _ = ropes((5, 40), LEVEL * 2)
    for solver, passes in ((Jacobi(), 1), (Chebyshev(), 4), (ConjugateGradient(8), 1)):
        watch.run("Distance", particles, [Gravity(G), Distance(pairs)], solver=solver, iterations=passes)
    return watch.finding(flagged="softened" in watch.flags)


@row(72, "the same of Rope, upright, leaning, and 0.1 and 10 % too short", RULE)
def _short() -> Finding:
    watch = Watch()
    for rest in (1.0, 0.999, 0.9):
        particles, pairs, length = ropes((40, 20, 20), [(1.0, 0.0), (0.0, 1.0), (0.7, 0.7)], rest)
        watch.run(f"Rope {rest:g}", particles, [Gravity(G), Rope(pairs, length)], solver=Direct(), most=0.2)
    return watch.finding(flagged="softened" in watch.flags)


@row(74, "cantilever and plate with both diagonals, or of triangles that keep their areas", RULE)
def _braced() -> Finding:
    watch = Watch()
    for (nx, ny), solver, iterations in (
        ((10, 2), Jacobi(), 1), ((10, 2), Direct(), 1), ((10, 2), Chebyshev(), 4), ((6, 6), Jacobi(), 1)
    ):  # fmt: skip
        x, pairs = grid(nx, ny)
        particles = Particles(x, mass=MASS, pinned=np.arange(ny))
        watch.run(f"{nx} x {ny}", particles, [Gravity(G), Distance(pairs)], solver=solver, iterations=iterations)
    x, pairs = grid(8, 3, braced=False)
    k = np.arange(24).reshape(8, 3)
    below, above = (k[:-1, :-1], k[1:, :-1], k[:-1, 1:]), (k[1:, :-1], k[1:, 1:], k[:-1, 1:])
    triangles = np.concatenate([np.stack([corner.ravel() for corner in half], axis=1) for half in (below, above)])
    particles = Particles(x, mass=MASS, pinned=np.arange(3))
    loops = np.stack([c.ravel() for c in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:])], axis=1)
    for name, areas, compliance in (("areas", triangles, 1e-3), ("loops", list(loops), 0.0)):
        links_ = Distance(pairs, compliance=compliance)
        watch.run(name, particles, [Gravity(G), links_, Area(areas)], solver=Jacobi())
    return watch.finding()


@row(75, "wheel with spokes, rigid loop, complete graph of 12 in 3D, truss between pins", RULE)
def _rigid() -> Finding:
    watch, rng = Watch(), np.random.default_rng(0)
    a = 2 * np.pi * np.arange(16) / 16
    wheel = np.vstack([[0, 2], np.stack([0.5 * np.cos(a), 2 + 0.5 * np.sin(a)], axis=1)])
    round_ = np.stack([np.arange(16), (np.arange(16) + 1) % 16], axis=1) + 1
    spokes = np.stack([np.zeros(16, dtype=int), np.arange(16) + 1], axis=1)
    beam, braces = grid(10, 2)
    cloud = 0.3 * rng.normal(size=(12, 3)) + [0, 2, 0]
    for name, x, pairs, pinned, solver in (
        ("wheel", wheel, np.vstack([round_, spokes]), [1], None),
        ("wheel", wheel, np.vstack([round_, spokes]), [1, 9], Direct()),
        ("loop", wheel[[1, 6, 12]], complete(3), [0, 1], Direct()),
        ("graph", cloud, complete(12), [0], Jacobi()),
        ("truss", beam, braces, [0, 1, 18, 19], Jacobi()),
        ("truss", beam, braces, [0, 1, 18, 19], Direct()),
    ):
        watch.run(name, Particles(x, mass=MASS, pinned=pinned), [Gravity(G), Distance(pairs)], solver=solver)
    return watch.finding()


@row(76, "links twice, with two lengths, and of length 0", RULE)
def _twice() -> Finding:
    watch, n = Watch(), 10
    x = np.stack([0.1 * np.arange(n), np.full(n, 2.0)], axis=1)
    once = links(n - 1)
    for solver in (Direct(), Jacobi()):
        watch.run(
            "twice", Particles(x, mass=MASS, pinned=[0, n - 1]), [Gravity(G), Distance(np.vstack([once, once]))], solver=solver
        )
        rest = np.r_[np.full(n - 1, 0.0995), np.full(n - 1, 0.1005)]
        watch.run(
            "two lengths",
            Particles(x, mass=MASS, pinned=[0, n - 1]),
            [Gravity(G), Distance(np.vstack([once, once]), rest)],
            solver=solver,
        )
    at = np.vstack([x, x[:1], x[-1:]])
    hung = Particles(at, mass=MASS, pinned=[n, n + 1])
    for solver, passes in ((Direct(), 1), (Jacobi(), 1), (Chebyshev(), 4), (ConjugateGradient(8), 1)):
        zero = Distance(np.vstack([once, [[n, 0], [n - 1, n + 1]]]))
        watch.run("length 0", hung, [Gravity(G), zero], precision="f64", solver=solver, iterations=passes)
    return watch.finding()


@row(77, "rigid clusters that share three points, and one with links inside", RULE)
def _clusters() -> Finding:
    watch = Watch()
    x, pairs = grid(3, 5)
    k = np.arange(15).reshape(3, 5).T
    shared = ShapeMatch([k[:3].ravel(), k[2:].ravel()])
    watch.run("shared", Particles(x, mass=MASS, pinned=[0]), [Gravity(G), shared])
    row_, _ = grid(8, 2)
    watch.run("in a row", Particles(row_, mass=MASS, pinned=[0, 1]), [Gravity(G), ShapeMatch(np.arange(4) + 2 * k[:7, :1])])
    watch.run("links inside", Particles(x, mass=MASS, pinned=[0]), [Gravity(G), ShapeMatch([np.arange(15)]), Distance(pairs)])
    return watch.finding()


@row(78, "a bridge of ropes under 500 discs", "energy as above; nothing flies, every disc stays in the box")
def _bridge() -> Finding:
    watch, rng = Watch(), np.random.default_rng(3)
    particles, pairs, _ = ropes((30, 30), LEVEL * 2)
    bridge = particles.position[:, :2] + np.repeat([[0.0, 0.0], [0.0, 0.3]], 30, axis=0)
    k = np.arange(500)
    discs = np.stack([0.08 + 0.085 * (k % 10), 2.45 + 0.085 * (k // 10)], axis=1) + rng.uniform(-0.01, 0.01, (500, 2))
    x, radius = np.vstack([bridge, discs]), np.r_[np.full(60, 0.012), np.full(500, 0.03)]
    scene: list[Any] = [Gravity(G), Distance(pairs), Contact(), Box((-0.5, 0.0), (1.5, 8.0))]
    watch.run("bridge", Particles(x, mass=MASS, radius=radius, pinned=[0, 29, 30, 59]), scene, most=0.1)
    return watch.finding()
