"""The scenes of the matrix: each feature in the smallest one in which all of its options do something.

Options that are numbers for each constraint are tried side by side: copies of one mechanism, 3 m apart, one for each option.
"""

from collections.abc import Callable, Iterable

import numpy as np

import tiverlet as tv

from ..fuzz import functions
from ..fuzz.scenes import Call, Set, Structure
from ..rows import outward
from ..rows import radius as from_origin
from ..scenes.scene import c
from .functions import attract, attraction, drift, up
from .scene import Promise, Run, Scene, kept

G, INF = 9.81, np.inf
SCENES: dict[str, Scene] = {}
ROUND = np.array([[-1.0, 0], [0, 1], [1, 0], [0, -1]])  # of a circle
SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
TETRA = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]])
TRIPLE = np.array([[-1.0, 0], [0, 0], [1, 0]])  # a hinge: frame, hub and arm
WINGS = np.array([[0.0, 0, 0], [0, 0, 1], [-1, 0, 0.5], [1, 0, 0.5]])  # the same in space: both ends of the axis, frame and arm


def scene(frames: int = 20, turns: dict[int, list[Set]] | None = None, without: dict[str, str] | None = None, **settings):
    """Add a scene: a function that returns particles, features and promises."""

    def add(make: Callable[[], tuple[Call, list[Call], list[Promise]]]) -> Callable:
        particles, features, promises = make()
        made = Structure(particles, tuple(features), {"path": "fused"} | settings)
        SCENES[make.__name__.replace("_", " ")] = Scene(made, promises, frames, turns or {}, without or {})
        return make

    return add


def weak(of: str, k: int, m: int) -> Promise:
    """Return the promise that of feature k only constraint m breaks."""
    return kept(of, "break_at", says="only the weak one breaks", least=1,
                figure=lambda r: np.flatnonzero(r.broken[k]).tolist() == [m])  # fmt: skip


def copies(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of copies, 3 m apart, (count k, dim), and their numbers, (count, k)."""
    at = points + 3.0 * np.arange(count)[:, None, None] * np.eye(points.shape[1])[0]
    return at.reshape(-1, points.shape[1]), np.arange(count * len(points)).reshape(count, -1)


# Links


@scene(frames=30)
def links():
    # Pendulums let go at the height of their pins: under 3 m g sin(phi), after half a second 20 N.
    x, pairs = copies(np.array([[0.0, 0], [1, 0]]), 5)
    link = c.Distance(pairs, [1, 1, 1.2, 1, 1], compliance=[0, 0.01, 0.01, 0.01, 0], damping=[0, 0, 0, 5, 0],
                      break_at=[INF] * 4 + [8])  # fmt: skip
    promises = [
        kept("Distance", "pairs", says="a rigid link keeps its length", figure=lambda r: np.ptp(r.length(0)), most=1e-3),
        kept("Distance", "compliance", says="a soft one stretches", figure=lambda r: r.length(1).max(), least=1.05),
        kept("Distance", "rest", says="springs differ by their rest lengths", figure=lambda r: r.length(2)[1:].max(), least=1.25),
        kept("Distance", "damping", says="a damped spring stretches less",
             figure=lambda r: r.length(3).max() - r.length(1).max(), most=-0.01),
        weak("Distance", 1, 4),
    ]  # fmt: skip
    return c.Particles(x, pinned=pairs[:, 0], radius=0.02), [c.Gravity(G), link], promises


def thrown(of: str) -> list[Promise]:
    """Return promises of what falls on four of a kind, from pairs of particles: rigid, soft, soft and damped, weak."""
    return [
        kept(of, "compliance", says="a soft one throws back", figure=lambda r: r.v[:, 3, 1].max(), least=1.0),
        kept(of, "damping", says="a damped one does so less",
             figure=lambda r: r.v[:, 5, 1].max() - r.v[:, 3, 1].max(), most=-0.5),
        weak(of, 1, 3),
    ]  # fmt: skip


@scene(frames=30)
def ropes():
    # What falls by 0.3 m has 2.4 m/s when its rope is taut: v sqrt(m k) = 77 N on a spring of 1000 N/m.
    x, pairs = copies(np.array([[0.0, 0], [0, -0.5]]), 4)
    rope = c.Rope(pairs, 0.8, compliance=[0, 1e-3, 1e-3, 1e-3], damping=[0, 0, 20, 0], break_at=[INF, INF, INF, 50])
    promises = [
        kept("Rope", "pairs", "length", says="a rope is as long as given at most",
             figure=lambda r: r.length(0).max(), most=0.801),
        kept("Rope", "pairs", says="it bears what hangs on it", figure=lambda r: r.loads[1][-1, 0], least=9.7, most=9.9),
        *thrown("Rope"),
    ]  # fmt: skip
    return c.Particles(x, pinned=pairs[:, 0], radius=0.02), [c.Gravity(G), rope], promises


@scene(frames=30)
def spacers():
    x, pairs = copies(np.array([[0.0, 0], [0, 1]]), 4)
    spacer = c.Spacer(pairs, 0.7, compliance=[0, 1e-3, 1e-3, 1e-3], damping=[0, 0, 20, 0], break_at=[INF, INF, INF, 50])
    promises = [
        kept("Spacer", "pairs", "length", says="what falls is held off", figure=lambda r: r.length(0).min(), least=0.699),
        kept("Spacer", "pairs", says="and presses", figure=lambda r: r.loads[1][-1, 0], least=-9.9, most=-9.7),
        *thrown("Spacer"),
    ]  # fmt: skip
    return c.Particles(x, pinned=pairs[:, 0], radius=0.02), [c.Gravity(G), spacer], promises


# Angles


def beams(of: str, where: str, k: int) -> list[Promise]:
    """Return promises of five beams that carry a weight: stiff, soft, soft and bent up, soft and damped, weak. k: feature."""
    arm = {3: lambda r, m: r.x[:, 3 * m + 2, 1], 4: lambda r, m: r.x[:, 4 * m + 3, 1]}[k]
    return [
        kept(of, where, says="a rigid beam stays", figure=lambda r: np.abs(arm(r, 0)).max(), most=2e-3),
        kept(of, "compliance", says="a soft one sags", figure=lambda r: arm(r, 1).min(), most=-0.03),
        kept(of, "rest", says="one that is bent up sags less", figure=lambda r: arm(r, 2).min() - arm(r, 1).min(), least=0.03),
        kept(of, "damping", says="a damped one swings less", figure=lambda r: arm(r, 3).min() - arm(r, 1).min(), least=0.005),
        weak(of, 2, 4),
    ]  # fmt: skip


BEAM = {"compliance": [0, 0.01, 0.01, 0.01, 0], "damping": [0, 0, 0, 2, 0], "break_at": [INF] * 4 + [5]}


@scene()
def bends():
    x, t = copies(TRIPLE, 5)
    features = [c.Gravity(G), c.Distance(t[:, 1:]), c.Bend(t, [0, 0, 0.2, 0, 0], **BEAM)]
    return c.Particles(x, pinned=t[:, :2].ravel(), radius=0.02), features, beams("Bend", "triples", 3)


@scene()
def dihedrals():
    x, q = copies(WINGS, 5)
    rest = np.array([0, 0, 0.2, 0, 0])
    probe = tv.Dihedral(q, 0.0)
    probe.prepare(tv.Particles(x), np.ones(len(x)))
    up = x.copy()
    up[q[:, 3], 1] += 0.1
    sign = np.sign(probe.rest_of(up))  # of an angle that lifts the arm
    features = [c.Gravity(G), c.Distance(np.concatenate([q[:, [0, 3]], q[:, [1, 3]]])), c.Dihedral(q, rest * sign, **BEAM)]
    return c.Particles(x, pinned=q[:, :3].ravel(), radius=0.02), features, beams("Dihedral", "quads", 4)


@scene()
def angle_limits():
    # Arms fall to the lower stop at 0.4 rad, the last one is thrown to the upper one at 0.3 rad.
    x, t = copies(TRIPLE, 5)
    v = np.zeros_like(x)
    v[t[4, 2], 1] = 4.0
    limit = c.AngleLimit(t, -0.4, [1, 1, 1, 1, 0.3], compliance=[0, 0.01, 0.01, 0, 0], damping=[0, 0, 2, 0, 0],
                         break_at=[INF, INF, INF, 5, INF])  # fmt: skip
    promises = [
        kept("AngleLimit", "triples", "lower", says="an arm stops", figure=lambda r: r.x[:, 2, 1].min(), least=-np.sin(0.402)),
        kept("AngleLimit", "compliance", says="a soft stop yields", figure=lambda r: r.x[:, 5, 1].min(), most=-np.sin(0.43)),
        kept("AngleLimit", "damping", says="a damped one less",
             figure=lambda r: r.x[:, 8, 1].min() - r.x[:, 5, 1].min(), least=0.003),
        weak("AngleLimit", 2, 3),
        kept("AngleLimit", "upper", says="what flies up stops",
             figure=lambda r: r.x[:, 14, 1].max(), least=0.2, most=np.sin(0.302)),
    ]  # fmt: skip
    start = c.Particles(x, velocity=v, pinned=t[:, :2].ravel(), radius=0.02)
    return start, [c.Gravity(G), c.Distance(t[:, 1:]), limit], promises


# Bodies


def blown(of: str, where: str, area: Callable[[np.ndarray], float], size: int, k: int, unit: float) -> list[Promise]:
    """Return promises of bodies of `size` particles: rigid, soft, larger, inflated, damped and weak."""

    def measured(r: Run, m: int) -> np.ndarray:
        return np.array([area(x[m * size : (m + 1) * size]) for x in r.x]) / unit

    return [
        kept(of, where, says="a rigid body keeps its size", figure=lambda r: np.abs(measured(r, 0) - 1).max(), most=2e-3),
        kept(of, "compliance", says="a soft one does not", figure=lambda r: np.ptp(measured(r, 1)), least=0.02),
        kept(of, "rest", says="it grows to its rest size", figure=lambda r: measured(r, 2).max(), least=1.1),
        kept(of, "pressure", says="one under pressure grows", figure=lambda r: measured(r, 3).max(), least=1.15),
        kept(of, "damping", says="damping halts it",
             figure=lambda r: np.ptp(measured(r, 4)[5:]) - np.ptp(measured(r, 1)[5:]), most=-0.01),
        weak(of, k, 5),
    ]  # fmt: skip


def shoelace(x: np.ndarray) -> float:
    """Return the area of an outline in 2D, or of a triangle in space."""
    if x.shape[1] == 3:
        return float(np.linalg.norm(np.cross(x[1] - x[0], x[2] - x[0])) / 2)
    y = np.roll(x, -1, axis=0)
    return float(abs((x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1]).sum()) / 2)


def tetrahedron(x: np.ndarray) -> float:
    """Return the volume of a tetrahedron."""
    return float(abs(np.dot(x[1] - x[0], np.cross(x[2] - x[0], x[3] - x[0]))) / 6)


def outwards(x: np.ndarray, bodies: np.ndarray, speed: float) -> np.ndarray:
    """Return velocities by which bodies (m, k) swell, the first one turns, and that have a sum."""
    v, r = np.zeros_like(x), x[bodies] - x[bodies].mean(axis=1, keepdims=True)
    v[bodies] = speed * r
    v[bodies[0], :2] = speed * r[0][:, [1, 0]] * np.array([-1.0, 1.0])
    return v + 0.1


def inflated(alpha: float, damping: float, rest: float, most: float) -> dict:
    """Return options of six bodies of the size 1 in units of `rest`."""
    return {
        "rest": rest * np.array([1, 1, 1.1, 1, 1, 1]), "pressure": [1, 1, 1, 1.1, 1, 1],
        "compliance": [0, alpha, alpha, alpha, alpha, alpha], "damping": [0, 0, 0, 0, damping, 0],
        "break_at": [INF] * 5 + [most],
    }  # fmt: skip


@scene()
def areas():
    x, loops = copies(SQUARE, 6)
    features = [c.Area(loops, **inflated(1e-2, 10.0, 1.0, 1.0))]
    return c.Particles(x, velocity=outwards(x, loops, 0.5), radius=0.02), features, blown("Area", "loops", shoelace, 4, 0, 1.0)


@scene()
def areas_in_space():
    x, loops = copies(TETRA[:3], 6)
    features = [c.Area(loops, **inflated(1e-2, 10.0, 0.5, 0.5))]
    return c.Particles(x, velocity=outwards(x, loops, 0.5), radius=0.02), features, blown("Area", "loops", shoelace, 3, 0, 0.5)


@scene()
def volumes():
    x, cells = copies(TETRA, 6)
    features = [c.Volume(cells, **inflated(1e-3, 100.0, 1 / 6, 2.0))]
    return (
        c.Particles(x, velocity=outwards(x, cells, 0.5), radius=0.02),
        features,
        blown("Volume", "cells", tetrahedron, 4, 0, 1 / 6),
    )


@scene()
def surfaces():
    x, bodies = copies(TETRA, 6)
    features = [c.Volume(np.concatenate([body[FACES] for body in bodies]), **inflated(1e-3, 100.0, 1 / 6, 2.0))]
    return (
        c.Particles(x, velocity=outwards(x, bodies, 0.5), radius=0.02),
        features,
        blown("Volume", "cells", tetrahedron, 4, 0, 1 / 6),
    )


@scene(without={"polygons": "its rest shape has a row for each particle"})
def clusters():
    # Six squares: rigid and turning; soft; soft with a larger rest shape; damped; plastic; turning until it breaks.
    x, bodies = copies(SQUARE, 6)
    v, r = outwards(x, bodies, 2.0), x[bodies] - x[bodies].mean(axis=1, keepdims=True)
    v[bodies[5]] = 4 * r[5][:, ::-1] * (-1, 1) + 0.1
    rest = x.copy()
    rest[bodies[2]] = x[bodies[2]].mean(axis=0) + 1.2 * r[2]
    match = c.ShapeMatch(bodies, rest, compliance=[0, 2e-3, 2e-3, 2e-3, 2e-3, 0], damping=[0, 0, 0, 20, 0, 0],
                         creep=[0, 0, 0, 0, 20, 0], yield_strain=[0, 0, 0, 0, 0.02, 0], break_at=[INF] * 5 + [5])  # fmt: skip

    def size(r, m):
        return r.apart(4 * m, 4 * m + 2) / np.sqrt(2)

    promises = [
        kept("ShapeMatch", "clusters", says="a rigid one keeps its shape",
             figure=lambda r: np.abs(size(r, 0) - 1).max(), most=1e-3),
        kept("ShapeMatch", "compliance", says="a soft one swells", figure=lambda r: size(r, 1).max(), least=1.03),
        kept("ShapeMatch", "rest", says="it grows to its rest shape", figure=lambda r: size(r, 2).max(), least=1.2),
        kept("ShapeMatch", "damping", says="damping halts it",
             figure=lambda r: np.ptp(size(r, 3)[8:]) - np.ptp(size(r, 1)[8:]), most=-0.01),
        kept("ShapeMatch", "creep", "yield_strain", says="a plastic one swings less and stays larger",
             figure=lambda r: size(r, 4)[8:].mean() - size(r, 1)[8:].mean(), least=0.003),
        weak("ShapeMatch", 0, 5),
    ]  # fmt: skip
    return c.Particles(x, velocity=v, mass=np.where(np.arange(24) % 4 == 1, 2.0, 1.0), radius=0.02), [match], promises


# Drives


def turned(r: Run, m: int) -> np.ndarray:
    """Return the angle of the arm of hinge m [rad], (frames + 1,)."""
    hub, arm = (3 * m + 1, 3 * m + 2) if r.x.shape[2] == 2 else (4 * m, 4 * m + 3)
    d = r.x[:, arm] - r.x[:, hub]
    return np.unwrap(np.arctan2(d[:, 1], d[:, 0]))


def lifts(k: int, hinges: str = "hinges") -> list[Promise]:
    """Return promises of arms that carry 9.81 N m: lifted, too heavy, lifted softly, damped, broken off. k: of the motor."""
    return [
        kept("Motor", hinges, "speed", says="the motor lifts its arm at its speed",
             figure=lambda r: turned(r, 0)[-1] / (2 * r.reports[-1].time), least=0.98, most=1.02),
        kept("Motor", "torque", says="a weak one does not lift what needs more", figure=lambda r: turned(r, 1).max(), most=1e-4),
        kept("Motor", "torque", says="it never exerts more",
             figure=lambda r: np.abs(r.loads[k][:, 1]).max(), most=5.0 * (1 + 1e-4)),
        kept("Motor", "torque", says="it exerts all that it can", figure=lambda r: np.abs(r.loads[k][0, 1]), least=4.9),
        kept("Motor", "compliance", says="a soft one lags behind",
             figure=lambda r: (turned(r, 2) - turned(r, 0)).min(), most=-0.05),
        kept("Motor", "damping", says="a damped one less", figure=lambda r: (turned(r, 3) - turned(r, 2)).max(), least=0.02),
        weak("Motor", k, 4),
    ]  # fmt: skip


DRIVE = {"torque": [INF, 5, INF, INF, INF], "compliance": [0, 0, 0.02, 0.02, 0], "damping": [0, 0, 0, 1, 0],
         "break_at": [INF] * 4 + [5]}  # fmt: skip


@scene()
def motors():
    x, t = copies(TRIPLE, 5)
    features = [c.Gravity(G), c.Distance(t[:, 1:]), c.Motor(t, 2.0, **DRIVE)]
    return c.Particles(x, pinned=t[:, :2].ravel(), radius=0.02), features, lifts(2)


@scene()
def motors_in_space():
    x, q = copies(WINGS, 5)
    probe = tv.Dihedral(q, 0.0)
    probe.prepare(tv.Particles(x), np.ones(len(x)))
    up = x.copy()
    up[q[:, 3], 1] += 0.1
    links = np.concatenate([q[:, [0, 3]], q[:, [1, 3]]])
    features = [c.Gravity(G), c.Distance(links), c.Motor(q, 2.0 * np.sign(probe.rest_of(up)), **DRIVE)]
    return c.Particles(x, pinned=q[:, :3].ravel(), radius=0.02), features, lifts(2)


@scene()
def servos():
    x, t = copies(TRIPLE, 3)
    motor = c.Motor(t, [4, 4, 0], angle=0.3, torque=[INF, 5, 12])
    promises = [
        kept("Motor", "angle", says="a servo goes to its angle", figure=lambda r: turned(r, 0)[-1], least=0.28, most=0.301),
        kept("Motor", "torque", says="a weak one cannot", figure=lambda r: turned(r, 1).max(), most=1e-4),
        kept("Motor", "torque", says="none exerts more",
             figure=lambda r: (np.abs(r.loads[2][:, 1:]) / (5, 12)).max(), most=1 + 1e-4),
        kept("Motor", "speed", says="a brake holds what it can", figure=lambda r: np.abs(turned(r, 2)).max(), most=2e-3),
    ]  # fmt: skip
    return c.Particles(x, pinned=t[:, :2].ravel(), radius=0.02), [c.Gravity(G), c.Distance(t[:, 1:]), motor], promises


@scene()
def motors_of_free_bodies():
    x, t = copies(TRIPLE, 2)
    features = [c.Distance(np.concatenate([t[:, :2], t[:, 1:]])), c.Motor(t, 3.0, torque=[INF, 0.5])]
    promises = [
        kept("Motor", "torque", says="none exerts more", figure=lambda r: np.abs(r.loads[1][:, 1]).max(), most=0.5 * (1 + 1e-4)),
        kept("Motor", "hinges", "speed", says="it folds the body", figure=lambda r: turned(r, 0)[-1], least=0.2),
    ]  # fmt: skip
    return c.Particles(x, velocity=(0.3, 0.1), mass=np.array([1, 2, 3] * 2), radius=0.02), features, promises


@scene()
def winches():
    # Weights of 9.81 N: wound up; too heavy; up to a stop; paid out to a stop; wound up softly, and damped; torn off.
    x, pairs = copies(np.array([[0.0, 0], [0, -1]]), 8)
    winch = c.Winch(pairs, [-0.5, -0.5, -0.5, 0.5, -0.5, -0.5, -0.5, 0], length=[1, 1, 1, 1, 1, 1, 1, 0.9],
                    shortest=[0.1, 0.1, 0.9, 0.1, 0.1, 0.1, 0.1, 0.1], longest=[INF, INF, INF, 1.1, INF, INF, INF, INF],
                    force=[INF, 5] + [INF] * 6, compliance=[0, 0, 0, 0, 0.01, 0.01, 0, 0.01],
                    damping=[0, 0, 0, 0, 0, 10, 0, 0], break_at=[INF] * 6 + [5, INF])  # fmt: skip

    def ends(m):
        return lambda r: r.length(m)[-1]

    promises = [
        kept("Winch", "pairs", "speed", says="it winds up", figure=lambda r: (1 - ends(0)(r)) / (0.5 * r.reports[-1].time),
             least=0.98, most=1.02),
        kept("Winch", "force", says="a weak one does not lift what needs more",
             figure=lambda r: r.x[:, 3, 1].max(), most=-1 + 1e-4),
        kept("Winch", "force", says="it never pulls more", figure=lambda r: r.loads[1][:, 1].max(), most=5 * (1 + 1e-4)),
        kept("Winch", "force", says="it pulls all that it can", figure=lambda r: r.loads[1][:, 1].max(), least=4.9),
        kept("Winch", "shortest", says="it stops", figure=ends(2), least=0.899, most=0.901),
        kept("Winch", "longest", says="it stops", figure=ends(3), least=1.099, most=1.101),
        kept("Winch", "compliance", says="a soft one lags behind",
             figure=lambda r: (r.length(4) - r.length(0)).max(), least=0.05),
        kept("Winch", "damping", says="a damped one less", figure=lambda r: (r.length(4) - r.length(5)).max(), least=0.01),
        weak("Winch", 1, 6),
        kept("Winch", "length", says="a shorter spring pulls at once", figure=lambda r: r.x[:, 15, 1].max(), least=-0.999),
    ]  # fmt: skip
    return c.Particles(x, pinned=pairs[:, 0], radius=0.02), [c.Gravity(G), winch], promises


# Anchors


@scene(turns={k: [Set(1, "target", [[0.05 * k, 0.0]]), Set(2, "target", [[3.0 + 0.05 * k, 0.0], [6.0 + 0.05 * k, 0.0]])]
              for k in range(1, 11)})  # fmt: skip
def pins():
    x = np.array([[0.0, 0], [3, 0], [6, 0], [0, -1], [9, 0]])
    features = [c.Gravity(G), c.Pin([0], [[0.0, 0]]), c.Pin([1, 2], compliance=1e-3, damping=[0, 20]), c.Distance([[0, 3]]),
                c.Pin([4], compliance=0.1)]  # fmt: skip
    promises = [
        kept("Pin", "indices", "target", says="a driven particle is at its target", most=1e-6,
             figure=lambda r: np.abs(r.x[1:, 0, 0] - 0.05 * np.clip(np.arange(len(r.x) - 1), 0, 10)).max()),
        kept("Pin", "compliance", says="a soft pin lags behind",
             figure=lambda r: np.abs(r.x[1:, 1, 0] - r.x[1:, 0, 0] - 3).max(), least=0.01),
        kept("Pin", "compliance", says="one that is softer sags", figure=lambda r: r.x[:, 4, 1].min(), most=-0.1),
        kept("Pin", "damping", says="a damped one rests",
             figure=lambda r: np.abs(r.v[-3:, 2, 0]).max() - np.abs(r.v[-3:, 1, 0]).max(), most=0.0),
    ]  # fmt: skip
    return c.Particles(x, radius=0.02), features, promises


@scene()
def snaps():
    # Nodes half a metre apart along x, with one at x = 0.1: what starts at 0.3 is drawn to 0.1, what starts at 0.4 to 0.6.
    x = np.array([[0.3, 0.0], [0.4, 1.0], [0.3, 2.0], [0.3, 3.0]])
    snap = c.Snap([0, 1, 2, 3], (0.5, INF), (0.1, 0.0), compliance=[0.01, 0.01, 0.01, 1.0], damping=[0, 0, 5, 0])
    promises = [
        kept("Snap", "indices", "origin", says="it is drawn to the nearest node",
             figure=lambda r: r.x[:, 0, 0].min(), least=-0.11, most=0.0),
        kept("Snap", "spacing", says="the next one to the other", figure=lambda r: r.x[:, 1, 0].max(), least=0.7, most=0.81),
        kept("Snap", "spacing", says="along a free axis it is free",
             figure=lambda r: np.abs(r.v[-1, :4, 1] - 0.2).max(), most=1e-5),
        kept("Snap", "damping", says="damping halts it", figure=lambda r: r.x[:, 2, 0].min() - r.x[:, 0, 0].min(), least=0.05),
        kept("Snap", "compliance", says="a soft one draws less", figure=lambda r: r.x[:, 3, 0].min(), least=0.2),
    ]  # fmt: skip
    return c.Particles(x, velocity=(0, 0.2), radius=0.02), [snap], promises


@scene()
def beads():
    # On a smooth ring, on a corner of 6 degrees, and on two soft wires.
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 17)[:-1]])
    x = np.array([[1.0, 0], [3, 0], [6, 0], [8, 0]])
    features = [
        c.Gravity(G), c.Path([0], ring, closed=True),
        c.Path([1], [[2.0, 0.1], [3.2, -0.02], [4.6, -0.3]], smooth=False),
        c.Path([2, 3], [[5.0, 0], [9.0, 0]], compliance=0.01, damping=[0, 10]),
    ]  # fmt: skip
    promises = [
        kept("Path", "indices", "points", "closed", says="a bead stays on its ring and falls along it",
             figure=lambda r: np.abs(np.linalg.norm(r.x[:, 0], axis=1) - 1).max() + (r.x[-1, 0, 1] > -0.2), most=2e-3),
        kept("Path", "smooth", says="a bead on a polyline is on it", most=1e-3,
             figure=lambda r: np.abs(np.interp(r.x[:, 1, 0], [2, 3.2, 4.6], [0.1, -0.02, -0.3]) - r.x[:, 1, 1]).max()),
        kept("Path", "compliance", says="a soft wire sags", figure=lambda r: r.x[:, 2, 1].min(), most=-0.1),
        kept("Path", "damping", says="a damped one less", figure=lambda r: r.x[:, 3, 1].min() - r.x[:, 2, 1].min(), least=0.02),
    ]  # fmt: skip
    return c.Particles(x + [[0, 0], [0, 0], [0, 0], [0, 0]], radius=0.02), features, promises


@scene(turns={5: [Set(2, "at", 0.3)], 8: [Set(1, "speed", -0.5)]})
def driven_beads():
    x = np.array([[0.0, 0], [3, 0], [0, -1]])
    features = [
        c.Gravity(G),
        c.Path([0], [[0.0, 0], [2, 0]], speed=0.5),
        c.Path([1], [[3.0, 0], [5, 0]], at=0.0),
        c.Distance([[0, 2]]),
    ]
    promises = [
        kept("Path", "speed", says="a bead is driven",
             figure=lambda r: r.x[8, 0, 0] / r.reports[7].time, least=0.4999, most=0.5001),
        kept("Path", "at", says="another one goes where it is told", figure=lambda r: r.x[-1, 1, 0], least=3.29999, most=3.30001),
    ]  # fmt: skip
    return c.Particles(x, radius=0.02), features, promises


@scene()
def own_constraints():
    # half of a squared distance, from 0.5 m^2: fixed; at most and at least as much; soft, damped, weak.
    x, pairs = copies(np.array([[0.0, 0], [1, 0]]), 6)
    v = np.zeros_like(x)
    v[pairs[4, 1]] = v[pairs[5, 1]] = (-1, 0)
    features = [
        c.Gravity(G),
        c.Constraint(functions.moment, pairs[:4], None, unit=2.0, compliance=[0, 0.01, 0.01, 0], damping=[0, 0, 5, 0],
                     break_at=[INF, INF, INF, 5]),
        c.Constraint(functions.moment, pairs[4:5], 0.5, side=1),
        c.Constraint(functions.moment, pairs[5:], 0.5, side=-1),
    ]  # fmt: skip
    promises = [
        kept("Constraint", "function", "indices", "rest", says="what is rigid stays",
             figure=lambda r: np.ptp(r.length(0)), most=1e-3),
        kept("Constraint", "compliance", says="what is soft stretches", figure=lambda r: r.length(1).max(), least=1.03),
        kept("Constraint", "damping", says="damped, less", figure=lambda r: r.length(2).max() - r.length(1).max(), most=-0.01),
        weak("Constraint", 1, 3),
        kept("Constraint", "unit", says="the residual is in this unit",
             figure=lambda r: r.features[1].quantity.unit, least=2, most=2),
        kept("Constraint", "side", says="one side may shrink", figure=lambda r: r.length(4).min() - r.length(4).max(), most=-0.1),
        kept("Constraint", "side", says="but not grow", figure=lambda r: r.length(4).max(), most=1.001),
        kept("Constraint", "side", says="the other may not shrink", figure=lambda r: r.length(5).min(), least=0.999),
    ]  # fmt: skip
    return c.Particles(x, velocity=v, pinned=pairs[:, 0], radius=0.02), features, promises


@scene()
def a_bead_on_a_formula():
    wire = c.Constraint(from_origin, [0], 1.0, gradient=outward, origin=(2.0, 1.0))
    promises = [
        kept("Constraint", "gradient", "origin", says="a bead stays on a circle about (2, 1) and falls", most=2e-3,
             figure=lambda r: np.abs(np.linalg.norm(r.x[:, 0] - (2, 1), axis=1) - 1).max() + (r.x[-1, 0, 1] > 0.8)),
    ]  # fmt: skip
    return c.Particles([[3.0, 1], [0, 0]], radius=0.02), [c.Gravity(G), wire], promises


# Forces


@scene()
def gravity():
    fall = [kept("Gravity", "g", says="a parabola", most=1e-4, figure=lambda r: np.abs(
        r.x[-1] - r.x[0] - r.v[0] * r.reports[-1].time - np.array([1, -5]) * r.reports[-1].time ** 2 / 2).max())]  # fmt: skip
    return c.Particles([[0.0, 0], [1, 0]], velocity=[[1.0, 2], [0, 0]], radius=0.02), [c.Gravity((1.0, -5.0))], fall


@scene()
def drag():
    halt = [kept("Drag", "rate", says="speed falls as exp(-2 t)",
         figure=lambda r: r.v[-1, 0, 0] / np.exp(-2 * r.reports[-1].time),
                 least=0.999, most=1.001)]  # fmt: skip
    return c.Particles([[0.0, 0], [1, 1]], velocity=[[1.0, 0], [0, 0]], radius=0.02), [c.Drag(2.0)], halt


@scene()
def wind():
    blows = [kept("Wind", "velocity", "rate", says="speed tends to that of the air", least=0.999, most=1.001,
                  figure=lambda r: r.v[-1, 0, 0] / (3 * (1 - np.exp(-2 * r.reports[-1].time))))]  # fmt: skip
    return c.Particles([[0.0, 0], [1, 1]], radius=0.02), [c.Wind((3.0, 0.0), 2.0)], blows


@scene()
def attractors():
    # A circle of 1 m about a Plummer sphere: v^2 = strength r^2 / (r^2 + softening^2)^(3/2).
    speed = np.sqrt(9.0 / 1.25**1.5)
    promises = [
        kept("Attractor", "center", "strength", "softening", says="an orbit is a circle", most=0.02,
             figure=lambda r: np.abs(np.linalg.norm(r.x[:, 0] - (0.5, 0), axis=1) - 1).max()),
    ]  # fmt: skip
    start = c.Particles([[1.5, 0.0], [0.5, 2.0]], velocity=[[0, speed], [0, 0]], radius=0.02)
    return start, [c.Attractor((0.5, 0.0), 9.0, softening=0.5)], promises


@scene(turns={10: [Set(1, "particle", 1)], 12: [Set(1, "target", (2.0, 0.5))]})
def a_hand():
    # It holds a weight, which sags by g / rate^2 = 0.0245 m, and takes another one.
    promises = [
        kept("Hand", "target", "particle", "rate", says="what is held sags",
             figure=lambda r: r.x[10, 0, 1], least=-0.03, most=-0.01),
        kept("Hand", "particle", says="what is let go falls", figure=lambda r: r.x[-1, 0, 1], most=-0.1),
        kept("Hand", "target", says="what is taken is drawn", figure=lambda r: r.v[-1, 1, 1], least=-0.5),
    ]  # fmt: skip
    return c.Particles([[0.0, 0], [2, 1]], radius=0.02), [c.Gravity(G), c.Hand((0.0, 0.0), 0, rate=20.0)], promises


@scene()
def own_forces():
    # drift: m x'' = (1, -v_y, ...) + t e_x + i e_y
    promises = [
        kept("Force", "function", says="x = t^2 / 2 + t^3 / 6", most=1e-3, figure=lambda r: np.abs(
            r.x[-1, 0, 0] - r.reports[-1].time**2 / 2 - r.reports[-1].time**3 / 6)),
        kept("Force", "function", says="the second one rises", figure=lambda r: r.x[-1, 1, 1] - r.x[0, 1, 1], least=0.03),
    ]  # fmt: skip
    return c.Particles([[0.0, 0], [1, 1]], radius=0.02), [c.Force(drift)], promises


@scene()
def pair_forces():
    promises = [
        kept("PairForce", "function", says="a pair falls together", figure=lambda r: r.apart(0, 1).min(), most=0.95),
        kept("PairForce", "radius", says="what is further away does not", figure=lambda r: np.abs(r.v[:, 2:4]).max(), most=0.0),
        kept("PairForce", "potential", says="energy is told, and kept",
             figure=lambda r: np.ptp(r.energy) / abs(r.energy[0]), most=0.01),
    ]  # fmt: skip
    return (
        c.Particles([[0.0, 0], [1, 0], [9, 0], [12, 0]], radius=0.02),
        [c.PairForce(attract, 2.0, potential=attraction)],
        promises,
    )


# Walls. Three particles meet each: one falls and bounces, and two lie on it. Then it is off.

MATERIAL = {"friction": (0.5, 0.3), "restitution": 0.6, "active": True, "events": True}
OFF = {15: [Set(1, "active", False)]}


def wall(of: str, options: dict, *more: Call, dim: int = 2, x=(), v=(), promises: Iterable[Promise] = ()):
    """Return the scene of a wall, feature 1, whose top is at y = 0, with more walls, and particles at x of velocities v."""
    at, way = np.zeros((3, dim)), np.zeros((3, dim))
    at[:, 0], at[:, 1] = [-0.6, -0.2, 0.6], [0.3, 0.1, 0.1]
    if len(x):
        at, way = np.concatenate([at, x]), np.concatenate([way, v])
    made = Call(of, options | MATERIAL | {"surface_velocity": np.eye(dim)[0]})
    return c.Particles(at, velocity=way, radius=0.1), [c.Gravity(G), made, *more], [
        kept(of, *options, says="what is on it stays above", figure=lambda r: r.x[1:16, :3, 1].min(), least=0.05),
        kept(of, "restitution", says="what falls bounces", figure=lambda r: r.v[:16, 0, 1].max(), least=0.6),
        kept(of, "friction", "surface_velocity", says="what lies on it is carried along", figure=lambda r: r.v[15, 1, 0],
             least=0.15, most=1.001),
        kept(of, "events", says="it tells of meetings", figure=lambda r: sum(p == (0, 1) for p in r.walls), least=1),
        kept(of, "active", says="what is off lets through", figure=lambda r: r.x[-1, 1, 1], most=-0.01),
        *promises,
    ]  # fmt: skip


def one_way(of: str, *options: str) -> Promise:
    """Return the promise of a platform at y = 0: particle 3 comes from below and passes, 4 comes from above and lands."""
    return kept(of, "one_way", *options, says="what comes from below passes, what comes from above lands", least=0.04,
                figure=lambda r: min(r.x[:, 3, 1].max(), r.x[:, 4, 1].min()))  # fmt: skip


def carried(of: str) -> list[Promise]:
    """Return the promises of a box of 2 m that is lifted and turned, with a particle at either end."""
    return [
        kept(of, "inside", says="what is inside stays", figure=lambda r: np.abs(r.x[:, :2, :2]).max(), most=1.5),
        kept(of, "position", says="a box lifts what is in it", figure=lambda r: (r.x[-1] - r.x[0])[:2, 1].mean(), least=0.15),
        kept(of, "rotation", says="one end is lifted more", figure=lambda r: r.x[-1, 1, 1] - r.x[-1, 0, 1], least=0.1),
    ]  # fmt: skip


ABOVE, SPEEDS, ENDS = [[10.0, -0.3], [12.0, 0.4]], [[0.0, 4.0], [0, 0]], [[-0.8, -0.9], [0.8, -0.9]]
CARRY = {k: [Set(1, "position", np.array([0.0, 0.02 * k])), Set(1, "rotation", 0.01 * k)] for k in range(3, 15)}
CARRY_IN_SPACE = {
    k: [Set(1, "position", np.array([0.0, 0.02 * k, 0.0])), Set(1, "rotation", np.array([0, 0, 0.01 * k]))] for k in range(3, 15)
}


@scene(turns=OFF, frames=25)
def half_spaces():
    return wall("HalfSpace", {"normal": (0.0, 1.0), "offset": 0.0})


@scene(turns=OFF, frames=25, without={"polygons": "a wall is around all that there is"})
def boxes():
    return wall("Box", {"lower": (-2.0, 0.0), "upper": (2.0, 3.0)})


@scene(turns=OFF, frames=25)
def balls():
    return wall("Ball", {"center": (0.0, -20.0), "radius": 20.0})


@scene(without={"polygons": "a wall is around all that there is"})
def a_hollow():
    # Without friction: energy is constant.
    slides = kept("Ball", "inside", says="what is in a hollow slides to and fro in it", most=0.901,
                  figure=lambda r: np.linalg.norm(r.x[:, 0], axis=1).max() + (r.x[-1, 0, 1] > -0.2))  # fmt: skip
    return c.Particles([[0.9, 0.0], [-0.5, 0.0]], radius=0.1), [c.Gravity(G), c.Ball((0.0, 0.0), 1.0, inside=True)], [slides]


@scene(turns=OFF, frames=25)
def capsules():
    platform = c.Capsule((9.0, -0.05), (13.0, -0.05), 0.05, one_way=(0.0, 1.0))
    rod = {"a": (-2.0, -0.5), "b": (2.0, -0.5), "radius": 0.5}
    return wall("Capsule", rod, platform, x=ABOVE[:2], v=SPEEDS[:2], promises=[one_way("Capsule")])


@scene(turns=OFF, frames=25)
def polygons_as_walls():
    slab = {"vertices": np.array([[-2.0, -1.0], [2, -1], [2, 0], [-2, 0]])}
    line = c.Polygon([[9.0, -0.05], [13.0, -0.05]], closed=False, radius=0.05, one_way=(0.0, 1.0))
    return wall("Polygon", slab, line, x=ABOVE, v=SPEEDS, promises=[one_way("Polygon", "closed", "radius")])


@scene(turns=CARRY, without={"polygons": "a wall is around all that there is"})
def a_box_that_is_carried():
    box = c.Polygon([[-1.0, -1], [1, -1], [1, 1], [-1, 1]], inside=True, position=(0.0, 0.0), rotation=0.0, friction=0.5)
    return c.Particles(ENDS, radius=0.1), [c.Gravity(G), box], carried("Polygon")


@scene(turns=OFF, frames=25)
def meshes():
    block = tv.shapes.box((0, -0.5, 0), (4, 1, 4))
    corners = np.array([[9.0, -0.05, -2], [13, -0.05, -2], [13, -0.05, 2], [9, -0.05, 2]])
    sheet = c.Mesh(corners, [[0, 1, 2], [0, 2, 3]], closed=False, radius=0.05, one_way=(0.0, 1.0, 0.0))
    x, v = (np.pad(a, ((0, 0), (0, 1))) for a in (ABOVE, SPEEDS))
    shape = {"vertices": block.position, "faces": block.faces}
    return wall("Mesh", shape, sheet, dim=3, x=x, v=v, promises=[one_way("Mesh", "closed", "radius")])


@scene(turns=CARRY_IN_SPACE)
def a_room_that_is_carried():
    room = tv.shapes.box((0, 0, 0), (2, 2, 2))
    mesh = c.Mesh(room.position, room.faces, inside=True, position=(0.0, 0.0, 0.0), rotation=(0.0, 0.0, 0.0), friction=0.5)
    return c.Particles(np.pad(ENDS, ((0, 0), (0, 1))), radius=0.1), [c.Gravity(G), mesh], carried("Mesh")


@scene(turns=OFF | {5: [Set(1, "position", np.array([0.0, 0.953])), Set(1, "rotation", 0.002)]}, frames=25)
def distance_functions():
    form = {"function": functions.ground, "gradient": up, "radius": 0.05, "position": (0.0, 0.95), "rotation": 0.0}
    lifted = kept("Sdf", "position", "rotation", says="it lifts what is on it", figure=lambda r: r.x[8, 2, 1], least=0.1035)
    return wall("Sdf", form, promises=[lifted])


def let_out(of: str, i: int, axis: int = 1) -> Promise:
    """Return the promise that particle i leaves a wall slowly, at 0.3 m/s."""
    return kept(of, "push_out", says="what is inside comes out, slowly", least=0.2, most=0.3 * (1 + 1e-3),
                figure=lambda r: abs(r.x[1, i, axis] - r.x[0, i, axis]) / r.reports[0].time)  # fmt: skip


@scene(without={"polygons": "a wall is around all that there is"})
def what_starts_in_walls():
    # Each by 0.04 m: in a floor, on top of four pads, and beyond the side of a box.
    x = np.array([[0.0, 0.06], [4, 1.56], [8, 1.56], [12, 1.56], [16, 1.56], [29.94, 3]])
    slow = {"push_out": 0.3}
    square = np.array([[-1.0, -0.5], [1, -0.5], [1, 0.5], [-1, 0.5]])
    walls = [
        Call("HalfSpace", {"normal": (0.0, 1.0)} | slow), Call("Ball", {"center": (4.0, 1.0), "radius": 0.5} | slow),
        Call("Capsule", {"a": (7.0, 1.0), "b": (9.0, 1.0), "radius": 0.5} | slow),
        Call("Polygon", {"vertices": square, "position": (12.0, 1.0)} | slow),
        Call("Sdf", {"function": functions.pillar, "position": (14.0, 1.0)} | slow),
        Call("Box", {"lower": (-30.0, -30.0), "upper": (30.0, 30.0)} | slow),
    ]  # fmt: skip
    names = [call.name for call in walls]
    promises = [let_out(of, i, axis=0 if of == "Box" else 1) for i, of in enumerate(names)]
    return c.Particles(x, radius=0.1), walls, promises


@scene()
def what_starts_in_a_mesh():
    block = tv.shapes.box((0, -0.5, 0), (4, 1, 4))
    mesh = c.Mesh(block.position, block.faces, push_out=0.3)
    return c.Particles([[0.0, 0.06, 0.0]], radius=0.1), [mesh], [let_out("Mesh", 0)]


# Contacts


@scene()
def discs_meet():
    # Head on; slanted, with friction; two that do not touch; one passes a sensor; two that overlap: passes overshoot their speed.
    x = np.array([[0.0, 0], [0.3, 0], [3, 0], [3.25, 0.1], [6, 0], [6.3, 0], [9, 0], [9.3, 0], [12, 0], [12.18, 0]])
    v = np.zeros_like(x)
    v[::2, 0], v[2, 1], v[8] = 1.0, 1.0, 0.0
    group = [0, 0, 1, 0, 1, 1, 0, 2, 0, 0]
    contact = c.Contact({(0, 1): (0.6, 0.4)}, {(0, 0): 0.5}, groups=[(0, 0), (0, 1)], sensors=[(0, 2)], events=True, push_out=0.3,
                        skin=0.05, loads=True)  # fmt: skip
    promises = [
        kept("Contact", "restitution", says="half of the speed",
             figure=lambda r: r.v[-1, 1, 0] - r.v[-1, 0, 0], least=0.49, most=0.51),
        kept("Contact", "friction", says="friction turns the way", figure=lambda r: r.v[-1, 3, 1], least=0.05),
        kept("Contact", "groups", says="others pass", figure=lambda r: np.abs(r.v[:, 4, 0] - 1).max(), most=1e-5),
        kept("Contact", "sensors", says="a sensor passes and tells", most=1e-5,
             figure=lambda r: np.abs(r.v[:, 6, 0] - 1).max() + ((6, 7) not in r.met)),
        kept("Contact", "push_out", says="what overlaps parts slowly",
             figure=lambda r: (r.apart(8, 9)[1] - 0.18) / r.reports[0].time,
             least=0.25, most=0.3 * 1.3),
        kept("Contact", "events", says="pairs tell",
             figure=lambda r: ((0, 1) in r.met) + ((2, 3) in r.met) - ((4, 5) in r.met), least=2),
    ]  # fmt: skip
    return c.Particles(x, velocity=v, group=group, radius=0.1), [contact], promises


@scene()
def balls_roll_on_balls():
    # Two that turn fall on balls that are held; one of them is thrown at a held one, whose spin drives it.
    x = np.array([[0.0, 0, 0], [0.02, 0.21, 0.0], [3, 0, 0], [3, 0.25, 0]])
    w = np.array([[0.0, 0, 0], [0, 20, 5], [0, 0, 10], [0, 0, 0]])
    contact = c.Contact((0.6, 0.5, 0.1, 0.1), (0.3, 0.2))
    promises = [
        kept(
            "Contact",
            "friction",
            says="spin about the normal is braked",
            figure=lambda r: r.spins[-1, 1, 1],
            most=19.7,
        ),
        kept("Contact", "friction", says="a roller drives what is on it", figure=lambda r: r.v[-1, 3, 0], most=-0.02),
        kept("Contact", "restitution", says="a ball bounces", figure=lambda r: r.v[:, 3, 1].max(), least=0.05),
    ]
    return c.Particles(x, spin=w, pinned=[0, 2], radius=0.1), [c.Gravity(G), contact], promises


@scene()
def a_cradle():
    x = np.array([[0.0, 0], [0.3, 0], [0.5, 0], [0.7, 0]])
    hit = kept("Contact", "restitution", says="the last one goes on", figure=lambda r: r.v[-1, 3, 0], least=0.999, most=1.001)
    return c.Particles(x, velocity=[[1.0, 0], [0, 0], [0, 0], [0, 0]], radius=0.1), [c.Contact(restitution=1.0)], [hit]


@scene()
def loops():
    # A square slides on a held one, one falls on another and bounces, and two overlap by a corner.
    x, bodies = copies(SQUARE, 6)
    x[bodies[1]] += (-3.0, 1.04)
    x[bodies[3]] += (-2.9, 1.2)
    x[bodies[5]] += (-2.05, 0.9)
    v = np.zeros_like(x)
    v[bodies[1], 0] = 1.0
    features = [
        c.Gravity(G), c.ShapeMatch(bodies[[1, 3, 5]]),
        c.Polygons(bodies, {(0, 0): 0.5}, {(0, 1): 0.5}, push_out=0.3, skin=0.1, loads=True),
    ]  # fmt: skip
    group = np.repeat([0, 0, 0, 1, 0, 0], 4)
    promises = [
        kept("Polygons", "loops", says="what lies on another stays on it",
             figure=lambda r: r.x[:, bodies[1], 1].min(), least=1.03),
        kept("Polygons", "friction", says="it is braked", figure=lambda r: r.v[-1, bodies[1], 0].mean(), most=0.3),
        kept("Polygons", "restitution", says="another one bounces",
             figure=lambda r: r.v[:, bodies[3], 1].mean(axis=1).max(), least=0.1),
        kept("Polygons", "push_out", says="what overlaps parts slowly", least=0.0, most=0.4,
             figure=lambda r: r.v[1, bodies[5]].max()),
    ]  # fmt: skip
    held = bodies[[0, 2, 4]].ravel()
    return c.Particles(x, velocity=v, group=group, pinned=held, radius=0.02), features, promises


# Boxes that repeat


@scene()
def a_link_across_the_end_of_a_box():
    x = np.array([[0.3, 0.5], [3.7, 0.5], [2.0, 1.0]])
    features = [c.Gravity(1.0), c.Distance([[0, 1]]), c.Periodic((0.0, 0.0), (4.0, 9.0), axes=[0])]
    promises = [
        kept("Periodic", "low", "high", says="the link is 0.6 m long", most=1e-3,
             figure=lambda r: np.abs(np.linalg.norm(r.x[:, 0] + (4, 0) - r.x[:, 1], axis=1) - 0.6).max()),
        kept("Periodic", "axes", says="what falls goes on", least=-1e-3, most=1e-3,
             figure=lambda r: r.x[-1, :2, 1].mean() - 0.5 - r.reports[-1].time / 2 + r.reports[-1].time ** 2 / 2),
        kept("Periodic", "low", "high", says="positions in the box",
             figure=lambda r: r.features[2].wrap(r.x[-1])[:, 0].max(), most=4.0),
    ]  # fmt: skip
    return c.Particles(x, velocity=[[-1.0, 0], [-1, 1], [5, 0]], radius=0.02), features, promises


@scene()
def a_sheared_box():
    x = np.array([[0.5, 0.3], [0.5, 5.7], [2, 2]])
    features = [c.PairForce(attract, 2.0), c.Periodic((0.0, 0.0), (6.0, 6.0), shear=1.0)]
    promises = [
        kept("Periodic", "shear", says="images move along",
             figure=lambda r: r.features[1].strain / r.reports[-1].time, least=0.9999, most=1.0001),
        kept("Periodic", "shear", says="a pair is drawn along by the image that moves",
             figure=lambda r: r.v[-1, 0, 0], most=-0.1),
    ]  # fmt: skip
    return c.Particles(x, radius=0.02), features, promises


@scene(frames=30)
def sleepers():
    # One rests on a floor and falls asleep, is struck after 0.3 s, and wakes.
    x = np.array([[0.0, 0.1], [1.0, 0.1]])
    promises = [
        kept("Sleep", "time", says="nothing falls asleep at once", figure=lambda r: r.reports[1].asleep, most=0),
        kept(
            "Sleep", "speed", "time", says="what rests falls asleep", figure=lambda r: max(p.asleep for p in r.reports), least=1
        ),
        kept("Sleep", "speed", says="what is struck wakes", figure=lambda r: r.v[-1, 0, 0], most=-0.3),
    ]
    start = c.Particles(x, velocity=[[0.0, 0], [-2, 0]], radius=0.1)
    return start, [c.Gravity(G), c.HalfSpace((0.0, 1.0)), c.Contact(), c.Sleep(0.05, 0.1)], promises
