"""A case: a scene with a known answer, and the error of a run."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from ....constraints import Distance
from ....features.feature import Feature
from ....measure import angular_momentum
from ....particles import Particles
from ....solvers import Chebyshev, ConjugateGradient, Direct, Jacobi
from ....step.step_report import StepReport

if TYPE_CHECKING:
    from ....world import World

Limits = tuple[float, float]  # of errors in f64 and in f32
FRAME = 1 / 60
SLACK = 10.0  # the largest multiple of an error that its limit may be
EFFORTS = (5, 10, 20, 40, 80, 160, 320, 640)  # substeps of a frame

# How a world is stepped: name -> (solver, iterations).
METHODS = {
    "Jacobi": (Jacobi(), 1),
    "Jacobi x 10": (Jacobi(), 10),
    "Direct": (Direct(), 1),
    "Direct x 3": (Direct(), 3),
    "Chebyshev x 10": (Chebyshev(), 10),
    "CG x 20": (ConjugateGradient(20), 1),
}


@cache
def _file() -> dict[str, dict]:
    text = resources.files("tiverlet.report.accuracy.cases").joinpath("cases.json").read_text()
    return {c["id"]: c for c in json.loads(text)["cases"]}


def known(name: str) -> dict:
    """Return an entry of cases.json: parameters, values, formula and their uncertainty."""
    return _file()[name]


def entries() -> list[str]:
    """Return the names of all entries of cases.json."""
    return list(_file())


@dataclass
class Run:
    """The data of a run from which its error is computed."""

    world: "World"
    times: list[float] = field(default_factory=list)  # of the ends of frames [s]
    seen: list[np.ndarray] = field(default_factory=list)  # results of Case.watch, after each frame
    reports: list[StepReport] = field(default_factory=list)


@dataclass(frozen=True)
class Case:
    """A scene with a known answer, built only through public names.

    name: the name of its entry in cases.json, with a suffix if the entry has several cases.
    build: () -> particles, and new features at each call.
    seconds: when the error is measured [s], a whole number of frames of `frame` [s].
    error: Run -> error in `unit`. watch: World -> an array to store after every frame, for errors of whole runs.
    size: the error in `unit` beyond which a run counts as diverged: that of a run unrelated to the answer.
    methods: names in METHODS, the best first. efforts: substeps of a frame to try.
    fit: the efforts whose substep is short enough for an order of convergence; empty for all.
    order: the order in f64 of all methods that show one; None if the error does not come from the step.
    limit: the largest errors allowed with the first method at `at` substeps, in f64 and in f32; at most SLACK times what is
    reached or the uncertainty of the answer, so that they see it get worse.
    trusted: the uncertainty of the answer, in `unit`.
    known: what is wrong in the engine, where the case fails by a fault that is known; once it does not, it fails by that.
    momentum: World -> a conserved array and its natural size; None if there is none. conserves: whether energy is conserved.
    """

    name: str
    title: str
    build: "Callable[[], Scene]"
    seconds: float
    error: Callable[[Run], float]
    limit: Limits
    size: float = 1.0
    unit: str = "m"
    frame: float = FRAME
    watch: "Callable[[World], np.ndarray] | None" = None
    methods: tuple[str, ...] = ("Jacobi",)
    efforts: tuple[int, ...] = EFFORTS
    fit: tuple[int, ...] = ()
    at: int = 20
    order: float | None = 2.0
    trusted: float = 1e-12
    known: str = ""
    momentum: "Callable[[World], tuple[np.ndarray, float]] | None" = None
    conserves: bool = True

    @property
    def frames(self) -> int:
        """The number of frames of a run."""
        return round(self.seconds / self.frame)


Scene = tuple[Particles, Sequence[Feature]]


def rms(position, reference) -> float:
    """Return the root mean square distance [m]."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(position) - np.asarray(reference)) ** 2, axis=-1))))


def ends_at(index, reference) -> Callable[[Run], float]:
    """Return the error measure of final positions: the rms distance of particles `index` from `reference`.

    Only as many coordinates as `reference` has are compared.
    """
    want = np.asarray(reference, dtype=np.float64)
    return lambda run: rms(run.world.position[index][..., : want.shape[-1]], want)


def spin(world: "World") -> tuple[np.ndarray, float]:
    """Return the angular momentum about the origin, and sum m |x| |v|."""
    m = np.where(world.particles.inv_mass > 0, world.particles.mass, 0.0)
    size = m @ (np.linalg.norm(world.position, axis=1) * np.linalg.norm(world.velocity, axis=1))
    return angular_momentum(world), float(size)


def upright(world: "World") -> tuple[np.ndarray, float]:
    """Return the angular momentum about the vertical through the origin, which gravity conserves, and sum m |x| |v|."""
    p, size = spin(world)
    return p[1:2], size


def sideways(world: "World") -> tuple[np.ndarray, float]:
    """Return the horizontal momentum, which gravity conserves, and sum m |v|."""
    m = world.particles.mass
    return m @ np.delete(world.velocity, 1, axis=1), float(m @ np.linalg.norm(world.velocity, axis=1))


def single(position, velocity: Any = 0.0, *features: Feature) -> Scene:
    """Build a scene of one particle."""
    return Particles([position], velocity=velocity), list(features)


def pendulum(position, velocity: Any = 0.0, *forces: Feature, mass: float = 1.0, rest=None, **link) -> Scene:
    """Build a scene of one particle on a link from the origin."""
    x, v = np.zeros((2, len(position))), np.zeros((2, len(position)))
    x[1], v[1] = position, velocity
    return Particles(x, velocity=v, mass=mass, pinned=[0]), [*forces, Distance([[0, 1]], rest, **link)]


def links(n: int, first: int = 0) -> np.ndarray:
    """Return the pairs of a chain of n links, from particle `first` on."""
    k = np.arange(n) + first
    return np.stack([k, k + 1], axis=1)
