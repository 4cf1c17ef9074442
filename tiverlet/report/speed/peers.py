"""Other engines on the same scenes, if they are installed: each in a process that answers the commands of child.py.

Warp is measured as Newton, which runs on it. The engines compute what the scene has and no more: no friction, no restitution, no
damping, no sleeping, no spin.
"""

import importlib.metadata
import importlib.util
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

from ...colliders import Box
from ...constraints import Distance
from ...measure import overlapping
from .counting import DT
from .processes import Talker, paths
from .scenes import SCENES

SIZES = {
    "pile": 1000,
    "settled": 1000,
    "spheres": 1000,
    "rope": 41,
}  # particles at which peers are compared; else the nearest measured size
MEASURE = {"pile": "overlap", "settled": "overlap", "spheres": "overlap", "rope": "residual"}
WORDS = {"overlap": "mean overlap", "residual": "worst strain"}
START = "import json, sys; from tiverlet.report.speed.peers import main; main(json.loads(sys.argv[1]))"


@dataclass(frozen=True)
class Engine:
    """Another engine. scenes: those that it can run. settings: (steps of a frame, iterations of each), the cheapest first.
    threads: the most that it can use."""

    name: str
    scenes: tuple[str, ...]
    settings: Sequence[tuple[int, int]]
    threads: int

    def missing(self) -> str:
        """Return why the engine cannot be run; empty if it can."""
        return "" if importlib.util.find_spec(self.name) else "it is not installed"

    def version(self) -> str:
        """Return the installed version."""
        return importlib.metadata.version(self.name)

    def process(self, scene: str, n: int, threads: int, setting: tuple[int, int]) -> Talker:
        """Start a process of the engine on a scene."""
        job = {"peer": self.name, "scene": scene, "n": n, "threads": threads, "setting": setting}
        return Talker([sys.executable, "-P", "-c", START, json.dumps(job)], {"PYTHONPATH": paths()})


LADDER = (
    (1, 1), (1, 5), (1, 10), (2, 10), (4, 5), (4, 10), (8, 5), (8, 10), (16, 5), (16, 10), (20, 20), (40, 20), (40, 50), (80, 50),
)  # fmt: skip
SLOWER = 30.0  # times the time of tiverlet, beyond which no further setting is tried
# Newton gets spheres, because its discs would leave their plane. Warp runs on one thread of a CPU. pymunk is fastest on one:
# on two, a pile of 1000 took 0.93 ms instead of 0.68, and one of 10 000 as long as on one.
ENGINES = (Engine("pymunk", ("pile", "settled", "rope"), LADDER, 1), Engine("newton", ("spheres", "rope"), LADDER, 1))
PEERS = {p.name: p for p in ENGINES}


class Pymunk:
    """A scene in pymunk (Chipmunk: iterated impulses with warm start).

    Discs are circles that cannot turn, links are pin joints, the box is four segments.
    """

    def __init__(self, particles, features, threads: int, setting: tuple[int, int]):
        import pymunk  # pyright: ignore[reportMissingImports]

        self.steps, iterations = setting
        self.space = space = pymunk.Space(threaded=threads > 1)
        space.threads, space.iterations, space.gravity = threads, iterations, (0, -9.81)
        space.collision_slop = 0.0  # the default leaves 0.1 m of overlap on purpose
        self.bodies = []
        for x, mass, free in zip(particles.position.tolist(), particles.mass.tolist(), particles.inv_mass > 0, strict=True):
            body = pymunk.Body(mass, float("inf")) if free else pymunk.Body(body_type=pymunk.Body.STATIC)
            body.position = tuple(x)
            self.bodies.append(body)
        circles = [pymunk.Circle(b, r) for b, r in zip(self.bodies, particles.radius.tolist(), strict=True) if r > 0]
        space.add(*self.bodies, *circles)
        for feature in features:
            if isinstance(feature, Distance):
                joints = [pymunk.PinJoint(self.bodies[i], self.bodies[j]) for i, j in feature.indices.tolist()]
                for joint in joints:
                    joint.error_bias = 0.0  # correct errors at once
                space.add(*joints)
            elif isinstance(feature, Box):
                (a, b), (c, d) = np.asarray(feature.lower).tolist(), np.asarray(feature.upper).tolist()
                corners = [(a, b), (c, b), (c, d), (a, d)]
                ends = zip(corners, corners[1:] + corners[:1], strict=True)
                # Thick segments outside of the box, so that nothing falls through.
                out = [(0, -5), (5, 0), (0, 5), (-5, 0)]
                space.add(*(
                    pymunk.Segment(space.static_body, (p[0] + o[0], p[1] + o[1]), (q[0] + o[0], q[1] + o[1]), 5.0)
                    for (p, q), o in zip(ends, out, strict=True)
                ))  # fmt: skip

    def frame(self) -> None:
        """Advance by one frame."""
        for _ in range(self.steps):
            self.space.step(DT / self.steps)

    def position(self) -> np.ndarray:
        """Return the positions of all particles [m]."""
        return np.array([tuple(b.position) for b in self.bodies])


class Newton:
    """A scene in Newton: XPBD on Warp, on the CPU. Links are springs of 1e6 N/m, the box is six planes."""

    STIFF = 1e6

    def __init__(self, particles, features, threads: int, setting: tuple[int, int]):
        newton: Any = import_module("newton")
        wp: Any = import_module("warp")

        wp.config.quiet = True
        self.steps, iterations = setting
        self.dim, n = particles.dim, len(particles)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
        x = np.zeros((n, 3))
        x[:, : self.dim] = particles.position
        mass = np.where(particles.inv_mass > 0, particles.mass, 0.0)
        builder.add_particles(list(map(tuple, x)), [(0.0, 0.0, 0.0)] * n, mass.tolist(), particles.radius.tolist())
        for feature in features:
            if isinstance(feature, Distance):
                for i, j in feature.indices.tolist():
                    builder.add_spring(i, j, self.STIFF, 0.0, 0.0)
            elif isinstance(feature, Box):
                low, high = np.asarray(feature.lower).tolist(), np.asarray(feature.upper).tolist()
                for axis in range(self.dim):
                    for sign, at in ((1.0, low[axis]), (-1.0, high[axis])):
                        normal = [sign * (k == axis) for k in range(3)]
                        builder.add_shape_plane(plane=(*normal, -sign * at), width=0.0, length=0.0)
        with wp.ScopedDevice("cpu"):
            self.model = model = builder.finalize(device="cpu")
            model.particle_mu = model.soft_contact_mu = 0.0
            if not particles.radius.any():
                model.particle_grid = None
            self.boxed = any(isinstance(f, Box) for f in features)
            self.solver = newton.solvers.SolverXPBD(model, iterations=iterations)
            self.now, self.then, self.control = model.state(), model.state(), model.control()
            self.contacts = model.contacts() if self.boxed else None

    def frame(self) -> None:
        """Advance by one frame."""
        for _ in range(self.steps):
            self.now.clear_forces()
            if self.boxed:
                self.model.collide(self.now, self.contacts)
            self.solver.step(self.now, self.then, self.control, self.contacts, DT / self.steps)
            self.now, self.then = self.then, self.now

    def position(self) -> np.ndarray:
        """Return the positions of all particles [m]."""
        return self.now.particle_q.numpy()[:, : self.dim].astype(np.float64)


MODELS: dict[str, Any] = {"pymunk": Pymunk, "newton": Newton}


def main(job: dict[str, Any]) -> None:
    """Run the process of a peer: answer commands. What the engine itself prints goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(what: Any) -> None:
        """Write one answer, a line of JSON."""
        print(json.dumps(what), file=answers, flush=True)

    particles, features = SCENES[job["scene"]].build(job["n"])

    def made():
        """Return the scene in the peer's engine."""
        return MODELS[job["peer"]](particles, features, job["threads"], job["setting"])

    engine = made()
    say({"particles": len(particles)})
    links = [f for f in features if isinstance(f, Distance)]
    for line in sys.stdin:
        word, *number = line.split()
        if word == "run":
            clock = perf_counter()
            for _ in range(int(number[0])):
                engine.frame()
            say(perf_counter() - clock)
        elif word == "restart":
            engine = made()
            engine.frame()
            say(0.0)
        else:
            x = engine.position()
            say({"overlap": overlap(x, particles.radius), "residual": max((strain(x, f, particles) for f in links), default=0.0)})


def overlap(x: np.ndarray, radius: np.ndarray) -> float:
    """Return the mean overlap of the overlapping pairs, in diameters of the first particle."""
    deep = overlapping(x, radius)[1]
    return float(deep.mean() / (2 * radius[0])) if len(deep) else 0.0


def strain(x: np.ndarray, links, particles) -> float:
    """Return the worst relative change of length of links; 1e300 if a position is not finite."""
    i, j = links.indices.T
    rest = np.linalg.norm(particles.position[i] - particles.position[j], axis=1)
    with np.errstate(all="ignore"):
        worst = float(np.abs(np.linalg.norm(x[i] - x[j], axis=1) / rest - 1).max())
    return worst if np.isfinite(worst) else 1e300
