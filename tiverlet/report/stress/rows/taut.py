"""Rows about scenes with more constraints than degrees of freedom, or with a load that no constraint bears to first order."""

from collections.abc import Callable, Iterable, Iterator, Sequence
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
from ....step.step_report import UNCONVERGED
from ...accuracy.cases.case import links
from .row import FRAMES, Findings, at_most, excused, row, summary, world

G, MASS = 9.81, 0.01
RULE = "energy never above what it was, no speed far above free fall, and what is not met is flagged"

Scenes = Iterator[tuple[str, Particles, Sequence[Feature], dict[str, Any]]]  # name, particles, features, options of watched()


def passive(
    number: int,
    what: str,
    criterion: str = RULE,
    *,
    gain: float = 0.0,
    speed: float = 1.0,
    softened: bool = False,
    known: str = "",
) -> Callable:
    """Return a decorator that registers the scenes that a function yields as a row.

    gain: limit of energy, as a share of m g L. speed: limit of speed, over that of free fall. softened: whether that flag must
    come. known: see Row.
    """

    def register(scenes: Callable[[], Scenes]) -> Callable[[], Scenes]:
        """Register the function."""
        row(number, what, criterion, known)(lambda: watched(scenes(), gain, speed, softened))
        return scenes

    return register


def watched(scenes: Scenes, gain: float, speed: float, softened: bool) -> Findings:
    """Run passive scenes with every number of substeps in FRAMES, and yield the worst figures, and where they are.

    Options of a scene: settings of its world (f32 by default), and
    most: the residual above which a frame must have a flag that excuses it; else 1e-2 under "auto", and UNCONVERGED.
    only: the numbers of substeps. least: that from which a residual must be excused; 2 are too few for what a rope bears.
    """
    energies, speeds, holds, seen = [], [], {}, set()
    for name, particles, features, options in scenes:
        settings = {"precision": "f32", **options}
        most, only, least = settings.pop("most", None), settings.pop("only", tuple(FRAMES)), settings.pop("least", 20)
        x = particles.position
        size = float(np.ptp(x, axis=0).max())
        supply = MASS * G * np.count_nonzero(~particles.pinned) * size
        with world(particles, features, **settings) as w:
            for n in only:
                frames, bound = FRAMES[n], most or (1e-2 if n == "auto" else UNCONVERGED)
                w.position, w.velocity, w._controller = x, particles.velocity, StepController()
                w.substeps = n
                start, most_energy, fastest, lowest, silent = None, -np.inf, 0.0, x[:, 1].min(), 0.0
                for _ in range(frames):
                    report = w.step(1 / 60)
                    start = report.energy - report.energy_change if start is None else start
                    most_energy = max(most_energy, report.energy)
                    fastest = max(fastest, float(np.linalg.norm(w.velocity, axis=1).max()))
                    lowest = min(lowest, w.position[:, 1].min())
                    if (n == "auto" or n >= least) and not excused(report, "residual", bound):
                        silent = max(silent, report.residual)
                    seen |= report.flags
                where = f"{name}, {settings['precision']}, {w._solver!r}, {n}"
                energies.append(((most_energy - start) / supply, where))
                speeds.append((fastest / np.sqrt(2 * G * max(size, x[:, 1].max() - lowest)), where))
                holds[f"{where}: residual {silent:.2g} that no flag excuses"] = silent == 0
    for figure, values, limit in (("energy {:+.1e} m g L", energies, gain), ("speed {:.2g} of free fall", speeds, speed)):
        value, where = max(values)
        yield at_most(f"{figure.format(value)} ({where})", value, limit)
    yield from summary(f"{len(holds)} runs", holds)
    yield ", ".join(sorted(seen)) or "no flag", "softened" in seen or not softened


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


@passive(71, "straight ropes of 2 to 400 points between two pins", gain=0.0, speed=2.0, softened=True)
def _taut() -> Scenes:
    for precision in ("f32", "f64"):
        for counts, only in (((2, 5, 40), tuple(FRAMES)), ((400,), (200, "auto"))):
            particles, pairs, _ = ropes(counts, LEVEL * len(counts))
            yield f"{counts[-1]} points", particles, [Gravity(G), Distance(pairs)], {"precision": precision, "only": only}
    particles, pairs, _ = ropes((5, 40), LEVEL * 2)
    for solver, passes in ((Jacobi(), 1), (Chebyshev(), 4), (ConjugateGradient(8), 1)):
        yield "Distance", particles, [Gravity(G), Distance(pairs)], {"solver": solver, "iterations": passes}


@passive(128, "straight ropes of 40 points in 2 substeps, and of 400 points in 20", gain=0.0, speed=2.0,
         known="straight ropes in too few substeps give way by many times their length, and gain energy, flagged")  # fmt: skip
def _too_taut() -> Scenes:
    for count, n in ((40, 2), (400, 20)):
        particles, pairs, _ = ropes((count,), LEVEL)
        yield f"{count} points", particles, [Gravity(G), Distance(pairs)], {"precision": "f64", "only": (n,), "least": 2}


@passive(72, "the same of Rope, upright, leaning, and 0.1 and 10 % too short", gain=0.0, speed=2.0, softened=True)
def _short() -> Scenes:
    for rest in (1.0, 0.999, 0.9):
        particles, pairs, length = ropes((40, 20, 20), [(1.0, 0.0), (0.0, 1.0), (0.7, 0.7)], rest)
        yield f"Rope {rest:g}", particles, [Gravity(G), Rope(pairs, length)], {"solver": Direct()}


def tiled() -> tuple[Particles, np.ndarray, np.ndarray, np.ndarray]:
    """Build a plate of 8 x 3 points, held on its left: particles, links, triangles and the numbers of the points."""
    x, pairs = grid(8, 3, braced=False)
    k = np.arange(24).reshape(8, 3)
    below, above = (k[:-1, :-1], k[1:, :-1], k[:-1, 1:]), (k[1:, :-1], k[1:, 1:], k[:-1, 1:])
    triangles = np.concatenate([np.stack([corner.ravel() for corner in half], axis=1) for half in (below, above)])
    return Particles(x, mass=MASS, pinned=np.arange(3)), pairs, triangles, k


@passive(74, "cantilever and plate with both diagonals, or of triangles that keep their areas", gain=5e-5, speed=2.0)
def _braced() -> Scenes:
    for (nx, ny), solver, iterations in (
        ((10, 2), Jacobi(), 1), ((10, 2), Direct(), 1), ((10, 2), Chebyshev(), 4), ((6, 6), Jacobi(), 1)
    ):  # fmt: skip
        x, pairs = grid(nx, ny)
        particles = Particles(x, mass=MASS, pinned=np.arange(ny))
        yield f"{nx} x {ny}", particles, [Gravity(G), Distance(pairs)], {"solver": solver, "iterations": iterations}
    particles, pairs, triangles, k = tiled()
    loops = np.stack([c.ravel() for c in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:])], axis=1)
    edges = Distance(pairs, compliance=1e-3)
    yield "areas", particles, [Gravity(G), edges, Area(triangles)], {"solver": Jacobi(), "only": (2, 20, 200)}
    yield "loops", particles, [Gravity(G), Distance(pairs), Area(list(loops))], {"solver": Jacobi()}


@passive(129, "a plate of rigid areas and soft links by Jacobi under auto", gain=0.0, speed=2.0,
         known="areas that one pass does not resolve grow to several times their size, flagged, also under auto")  # fmt: skip
def _areas() -> Scenes:
    particles, pairs, triangles, _ = tiled()
    features = [Gravity(G), Distance(pairs, compliance=1e-3), Area(triangles)]
    yield "areas", particles, features, {"solver": Jacobi(), "only": ("auto",)}


@passive(75, "wheel with spokes, rigid loop, complete graph of 12 in 3D, truss between pins", gain=1e-3, speed=2.0)
def _rigid() -> Scenes:
    rng = np.random.default_rng(0)
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
        yield name, Particles(x, mass=MASS, pinned=pinned), [Gravity(G), Distance(pairs)], {"solver": solver}


@passive(76, "links twice, with two lengths, and of length 0", gain=0.0, speed=2.0)
def _twice() -> Scenes:
    n = 10
    x = np.stack([0.1 * np.arange(n), np.full(n, 2.0)], axis=1)
    once, held = links(n - 1), Particles(x, mass=MASS, pinned=[0, n - 1])
    lengths = np.r_[np.full(n - 1, 0.0995), np.full(n - 1, 0.1005)]
    for solver in (Direct(), Jacobi()):
        for name, rest in (("twice", None), ("two lengths", lengths)):
            yield name, held, [Gravity(G), Distance(np.vstack([once, once]), rest)], {"solver": solver}
    at = np.vstack([x, x[:1], x[-1:]])
    hung = Particles(at, mass=MASS, pinned=[n, n + 1])
    for solver, passes in ((Direct(), 1), (Jacobi(), 1), (Chebyshev(), 4), (ConjugateGradient(8), 1)):
        zero = Distance(np.vstack([once, [[n, 0], [n - 1, n + 1]]]))
        yield "length 0", hung, [Gravity(G), zero], {"precision": "f64", "solver": solver, "iterations": passes}


@passive(77, "rigid clusters that share three points, and one with links inside", gain=8e-4, speed=2.0)
def _clusters() -> Scenes:
    x, pairs = grid(3, 5)
    k = np.arange(15).reshape(3, 5).T
    shared = ShapeMatch([k[:3].ravel(), k[2:].ravel()])
    yield "shared", Particles(x, mass=MASS, pinned=[0]), [Gravity(G), shared], {}
    beam, _ = grid(8, 2)
    yield "in a row", Particles(beam, mass=MASS, pinned=[0, 1]), [Gravity(G), ShapeMatch(np.arange(4) + 2 * k[:7, :1])], {}
    inside = [Gravity(G), ShapeMatch([np.arange(15)]), Distance(pairs)]
    yield "links inside", Particles(x, mass=MASS, pinned=[0]), inside, {}


@passive(78, "a bridge of ropes under 500 discs", gain=1e-6, speed=2.0)
def _bridge() -> Scenes:
    rng = np.random.default_rng(3)
    particles, pairs, _ = ropes((30, 30), LEVEL * 2)
    bridge = particles.position[:, :2] + np.repeat([[0.0, 0.0], [0.0, 0.3]], 30, axis=0)
    k = np.arange(500)
    discs = np.stack([0.08 + 0.085 * (k % 10), 2.45 + 0.085 * (k // 10)], axis=1) + rng.uniform(-0.01, 0.01, (500, 2))
    x, radius = np.vstack([bridge, discs]), np.r_[np.full(60, 0.012), np.full(500, 0.03)]
    scene: list[Any] = [Gravity(G), Distance(pairs), Contact(), Box((-0.5, 0.0), (1.5, 8.0))]
    yield "bridge", Particles(x, mass=MASS, radius=radius, pinned=[0, 29, 30, 59]), scene, {"most": 0.1}
