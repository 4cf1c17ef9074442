"""Other engines on the same scenes, at the same measured quality or better.

Warp is measured as Newton, which runs on it. The engines compute what the scene has and no more: no friction, no restitution, no
damping, no sleeping, no spin.
"""

import importlib.metadata
import os
import tempfile
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from statistics import median
from typing import Any

import numpy as np

from tiverlet.colliders import Box
from tiverlet.constraints import Distance
from tiverlet.measure import overlapping
from tiverlet.report.output import Table, error_line

from . import processes, speed
from .scenes import DT, SCENES

# For each scene, the number of particles and the measure of quality.
COMPARED = {"pile": (1000, "overlap"), "settled": (1000, "overlap"), "spheres": (1000, "overlap"), "rope": (41, "residual")}
WORDS = {"overlap": "mean overlap", "residual": "worst strain"}
# Steps of a frame and iterations of each, the cheapest first.
LADDER = (
    (1, 1), (1, 5), (1, 10), (2, 10), (4, 5), (4, 10), (8, 5), (8, 10), (16, 5), (16, 10), (20, 20), (40, 20), (40, 50), (80, 50),
)  # fmt: skip
SLOWER = 30.0  # times the time of tiverlet, beyond which no further setting is tried
# Newton gets spheres, because its discs would leave their plane. Both run on one thread: Warp has one on a CPU, and pymunk is
# fastest on one.
RUN = {"pymunk": ("pile", "settled", "rope"), "newton": ("spheres", "rope")}
HEADS = ("peer", "scene", "particles", "setting", "ms", "ours [ms]", "ratio", "measure", "its", "ours", "as good")
LEGEND = (
    "setting: steps of a frame x iterations, the cheapest that is as good as ours by the one measure named (nothing else is made "
    "equal) or, if none is, the best of those tried. ratio: its time over ours, on one thread."
)


def main(args) -> Iterator[Table]:
    """Yield the table of all installed engines."""
    rows, notes = [], [LEGEND]
    with tempfile.TemporaryDirectory() as folder:
        for engine, scenes in RUN.items():
            if not find_spec(engine):
                notes.append(f"Left out: {engine}, since it is not installed.")
                continue
            for scene in (name for name in scenes if name in (args.parts or scenes)):
                for n in args.sizes or COMPARED[scene][:1]:
                    try:
                        rows.append(compared(engine, scene, n, os.path.join(folder, f"{scene}{n}"), args.quick))
                    except (RuntimeError, OSError) as error:
                        notes.append(f"Missing: {engine} on {scene}, {n} particles: {error_line(error)}")
    yield Table("Peers, at the same measured quality or better", HEADS, rows, notes)


def compared(engine: str, scene: str, n: int, cache: str, quick: bool) -> list[str]:
    """Find an engine's cheapest setting that is as good as tiverlet's, or its best; then time both in alternation."""
    frames, settles, measure = speed.frames_of(scene, n), SCENES[scene].settles, COMPARED[scene][1]
    rounds = speed.QUICK if quick else (speed.ROUNDS, speed.SECONDS)
    job: dict[str, Any] = {"engine": engine, "scene": scene, "n": n, "threads": 1}
    with processes.started("speed", job, cache) as ours:
        ours.ask()
        target = processes.quality(ours, frames, settles)[measure]
        tried: list[tuple[float, tuple[int, int]]] = []
        fast = ours.ask("run 12")
        for setting in LADDER:
            with processes.started("peers", job | {"setting": setting}) as theirs:
                theirs.ask()
                tried.append((processes.quality(theirs, frames, settles)[measure], setting))
                slow = theirs.ask("run 12") > SLOWER * fast
            if slow or tried[-1][0] <= target:
                break
        found, setting = tried[-1] if tried[-1][0] <= target else min(tried)
        with processes.started("peers", job | {"setting": setting}) as theirs:
            count = theirs.ask()["particles"]
            mine, its = map(median, speed.timed([ours, theirs], scene, n, rounds))
    return [
        f"{engine} {importlib.metadata.version(engine)}", scene, f"{count:,}", f"{setting[0]} x {setting[1]}",
        f"{1e3 * its:.3g}", f"{1e3 * mine:.3g}", f"{its / mine:.3g}", WORDS[measure], f"{found:.2e}", f"{target:.2e}",
        "yes" if found <= target else "no",
    ]  # fmt: skip


class Pymunk:
    """A scene in pymunk (Chipmunk: iterated impulses with warm start).

    Discs are circles that cannot turn, links are pin joints, the box is four segments.
    """

    def __init__(self, particles, features, setting: tuple[int, int]):
        pymunk: Any = import_module("pymunk")

        self.steps, iterations = setting
        self.space = space = pymunk.Space()
        space.iterations, space.gravity = iterations, (0, -9.81)
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
    """A scene in Newton: XPBD on Warp. Links are springs of 1e6 N/m, the box is six planes."""

    STIFF = 1e6

    def __init__(self, particles, features, setting: tuple[int, int], device: str = "cpu"):
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
        with wp.ScopedDevice(device):
            self.model = model = builder.finalize(device=device)
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


def process(job: dict[str, Any], imported: float) -> None:
    """Run the process of an engine."""
    particles, features = SCENES[job["scene"]].build(job["n"])
    links = [f for f in features if isinstance(f, Distance)]
    engines: list[Any] = []

    def restart() -> None:
        """Build the scene again."""
        engines[:] = [MODELS[job["engine"]](particles, features, job["setting"])]

    def quality() -> dict[str, float]:
        """Return the mean overlap [diameters] and the worst strain."""
        x = engines[0].position()
        return {"overlap": overlap(x, particles.radius), "residual": max((strain(x, f, particles) for f in links), default=0.0)}

    restart()
    processes.answer(lambda: engines[0].frame(), restart, quality, {"particles": len(particles)})


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
