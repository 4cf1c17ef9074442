"""The world: a scene, and its step."""

import copy
import hashlib
from collections.abc import Iterable
from dataclasses import replace
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
import taichi as ti
from rich.progress import track

from . import checks, runtime
from .constraints.contact import Contact
from .explain import explain
from .feature import Acceleration, Batch, Feature, Scene
from .particles import Particles, Radii, State, in_range
from .queries import Contacts, Search, near_by_all, nearest
from .solvers.jacobi import Jacobi, Slots
from .substep import REBOUNDS, Substep, decay
from .survey import StepReport, Survey
from .wall import Wall

T = TypeVar("T", bound=Feature)
PRECISIONS = {"f32": ti.f32, "f32-compensated": ti.f32, "f64": ti.f64}
PATHS = ("auto", "fused", "parallel")
CROSSOVER = 4000  # particles, constraints or both, from which waking threads pays


class World:
    """Particles and what acts on them.

    particles: Particles. features: what acts, in any order; at most one Contact. What is not in the list costs nothing.
    substeps: substeps of a frame. iterations: Jacobi passes of a substep. Both may change at any time, at no compile cost.
    solver: how constraints are relaxed; None for Jacobi().
    precision: "f32" (position and displacement), "f32-compensated" (the position carries a low word, for coordinates far from the
    origin), "f64".
    path: "auto", "fused" (one launch per frame, one thread) or "parallel"; the bits are the same.

    Raises ValueError or TypeError, naming the argument, the index and the value, before anything is compiled.
    """

    def __init__(
        self, particles: Particles, features: Iterable[Feature] = (), *, substeps: int = 20, iterations: int = 1,
        solver: Jacobi | None = None, precision: str = "f32", path: str = "auto",
    ):  # fmt: skip
        if not isinstance(particles, Particles):
            raise TypeError(f"World: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        _settings(precision, path)
        self._particles, self._features = particles, _features(features)
        self.substeps, self.iterations = substeps, iterations
        self._solver, self._precision = solver or Jacobi(), precision
        inv_mass = particles.inv_mass.copy()
        for feature in self._features:
            feature.prepare(particles, inv_mass)
        for feature in self._features:
            feature.review(particles, inv_mass)
        runtime.ensure_started()
        if precision == "f32-compensated" and runtime.fast_math():
            raise ValueError(
                'World: precision = "f32-compensated" needs exact rounding, but Taichi was started with fast_math=True. '
                "Use tv.init(), or ti.init(fast_math=False)."
            )
        self._path = _chosen(path, particles, self._features)
        self._time, self._tick, self._h = 0.0, 0, 0.0
        self._frame = (0.0, 0.0, 0)  # when frames of the present length began, their length, their number
        self._last: StepReport | None = None
        self._search: Search | None = None  # compiled when it is first asked
        self._fresh, self._started = (
            True,
            False,
        )  # d holds velocities; the last substep was the first after a start
        self._drag: list[float] | None = None
        self._energy: float | None = None
        self._placed = True  # by the user, and not looked at yet
        self._memory = runtime.Memory(PRECISIONS[precision])
        try:
            self._build(inv_mass)
        except BaseException:
            self._memory.abandon()
            for feature in self._features:
                feature.scene = None
            raise

    def _build(self, inv_mass: np.ndarray) -> None:
        """Declare every field in one tree, then place it."""
        memory = self._memory
        state = State(memory, self._particles, inv_mass, self._precision == "f32-compensated")
        scene = Scene(memory, state, self._particles, inv_mass)
        accelerations, walls = self._of(Acceleration), self._of(Wall)
        drivers = [f for f in self._of(Batch) if f.drives and f.count]
        batches = [f for f in self._of(Batch) if not f.drives and (inv_mass[f.indices] > 0).any()]
        contact = next((c for c in self._of(Contact) if c.matters), None)
        if contact or walls:
            scene.radius = Radii(memory, self._particles.radius)
        surfaces = [*walls, *([contact] if contact else [])]
        state.remember(memory, any(f.rubs for f in surfaces), any(f.bounces for f in surfaces))
        if batches:
            scene.slots = Slots(memory, state, batches, inv_mass, self._solver)
        parallel = self._path == "parallel"
        self._grid = contact.join(scene, batches, parallel) if contact else None
        for feature in [*accelerations, *drivers, *batches, *walls]:
            feature.bind(scene)
        self._scene, self._batches = scene, batches
        self._sub = Substep(scene, accelerations, batches, drivers, contact, self._grid, walls, parallel)
        self._survey = Survey(self._sub)
        memory.place()
        if self._grid:
            self._grid.allocate(len(self._particles) * (12 if self._particles.dim == 2 else 32) + 64)

    def _of(self, kind: type[T]) -> list[T]:
        return [f for f in self._features if isinstance(f, kind)]

    # The step.

    def step(self, dt: float) -> StepReport:
        """Advance by dt [s], in `substeps` substeps, and say how it went.

        Raises ValueError for dt that is not finite and above 0. With another substep length than before, displacements are turned
        into velocities first and back after (time-corrected Verlet), so the step stays second order.
        """
        self._memory.check()
        dt = checks.number("World.step", "dt", dt, above=0.0)
        clock = perf_counter()
        with runtime.literals(self._scene.real):
            self._begin(dt / self.substeps)
            if len(self._particles):
                (self._fused if self._path == "fused" else self._parallel)()
            self._tick = (self._tick + self.substeps) % 2**31
            self._pass(dt)
            self._started, self._fresh = self._fresh and self.substeps == 1, False
            _, phi1, phi2, *_ = self._drag or decay(0.0, self._h)
            self._scene.hh = self._h**2 * (phi2 if self._started else phi1)
            report = self._look()
        change = report.energy - self._energy  # type: ignore[operator]
        self._energy, self._last = (
            report.energy,
            replace(report, energy_change=change, seconds=perf_counter() - clock),
        )
        return self._last

    def _pass(self, dt: float) -> None:
        """Advance the clock: frames of the same length are counted, not summed, so that they add no rounding errors."""
        if dt != self._frame[1]:
            self._frame = (self._time, dt, 0)
        since, _, count = self._frame
        self._frame = (since, dt, count + 1)
        self._time = since + (count + 1) * dt

    def _begin(self, h: float) -> None:
        """Bring h and the knobs to the device; where they change what displacements mean, start anew from velocities."""
        drag = decay(sum(f.rate for f in self._sub.drags), h) if self._sub.decays else None
        turned = any(f.changed and isinstance(f, Acceleration) for f in self._features)
        if h != self._h or drag != self._drag or turned:
            self._restart()
        self._upload(h, drag)
        if self._energy is None:
            report = self._look(begin=True)
            self._energy = report.energy
            if report.overlap > 0 and self._placed:
                self._ease()
        self._placed = False

    def _upload(self, h: float, drag: list[float] | None) -> None:
        """Write what was changed in Python since the last frame."""
        if drag and drag != self._drag:
            self._sub.decay[None] = drag
        self._h, self._drag = h, drag
        for feature in self._features:
            if feature.moving:
                feature.moving = False
                feature.settle()
            if feature.changed:
                feature.changed = False
                feature.upload()

    def _restart(self) -> None:
        """Turn displacements into velocities, so that the next substep starts from the state at this time."""
        if not self._fresh:
            self._sub.to_velocity(self._h, self._time)
            self._fresh = True

    def _fused(self) -> None:
        """All substeps in one launch, resumed where the neighbour list had to grow."""
        begin = it0 = skip = 0
        while True:
            fresh = int(self._fresh)
            self._sub.fused(self._h, self._time, self._tick, fresh, self.substeps, self.iterations, begin, it0, skip)
            if not self._grid or not self._sub.halt[None][0]:
                return
            (_, begin, it0), skip = (int(v) for v in self._sub.halt[None]), 1
            self._sub.halt[None] = [0, 0, 0]
            self._grow()

    def _parallel(self) -> None:
        """A few launches per substep."""
        h, n, relaxes = self._h, self.substeps, self._batches or self._grid or self._sub.walls
        for s in range(n):
            fresh = int(self._fresh and s == 0)
            struck = 0
            stale = self._sub.predicted(h, self._time, self._tick, fresh, s, n)
            for it in range(self.iterations if relaxes else 0):
                if stale:
                    self._list()
                state = self._sub.relaxed(h, s, n, it, self.iterations, fresh)
                stale, struck = state & 1, state & 2
            if self._sub.concludes:
                for _ in range(REBOUNDS if struck else 0):
                    self._sub.rebounded()
                self._sub.remembered()

    def _list(self) -> None:
        """Build the neighbour list, growing it until everything fits."""
        assert self._grid
        with runtime.literals(self._scene.real):
            while self._sub.listed() > self._grid.capacity:
                self._grow()

    def _grow(self) -> None:
        """More room for near pairs, and kernels that know of it. Nothing is lost: what did not fit was counted."""
        assert self._grid
        self._grid.grow()
        self._renew()

    def _ease(self) -> None:
        """Let particles that the user put into each other part gently."""
        contact = self._sub.contacts[0]
        if not contact._on_eases:
            contact.ease()
            self._sub = copy.copy(self._sub)  # kernels that know of the new field; the survey has no use for it
        self._sub.shrunk()

    def _renew(self) -> None:
        """Kernels that know of a new field; Taichi compiles them for each Substep anew."""
        self._sub = copy.copy(self._sub)
        self._survey = self._survey.of(self._sub)

    def _look(self, begin: bool = False) -> StepReport:
        """Survey the state."""
        if self._grid and self._grid.stale[None]:
            self._list()
        with runtime.literals(self._scene.real):
            report, extent = self._survey.report(self._time, self._h, self.substeps, self.iterations, self._started, begin)
        if self._grid:
            self._grid.fit(extent)
        return report

    def run(self, seconds: float, dt: float = 1 / 60, recorder=None, progress: bool = False) -> StepReport:
        """Step for `seconds` [s] in frames of dt [s]; returns the worst figures of all frames.

        recorder: a Recorder that logs each frame. progress: show a bar.
        """
        seconds = checks.number("World.run", "seconds", seconds, above=0.0)
        dt = checks.number("World.run", "dt", dt, above=0.0)
        frames: Any = range(max(1, round(seconds / dt)))
        if progress:
            frames = track(frames, description=f"{len(self._particles)} particles")
        worst = None
        for _ in frames:
            report = self.step(dt)
            worst = report if worst is None else worst.worse(report)
            if recorder is not None:
                recorder.log()
        assert worst
        return worst

    # What the user reads and sets.

    @property
    def position(self) -> np.ndarray:
        """Positions [m], (n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        return self._export(self._sub.positions)

    @position.setter
    def position(self, value) -> None:
        value = checks.points("World", "position", value, dim=self._particles.dim, count=len(self._particles))
        in_range("World", "position", value)
        if self._sub.contacts:
            self._sub.contacts[0].check_range(value)
        self._memory.check()
        with runtime.literals(self._scene.real):
            self._restart()
            self._scene.state.put(self._memory, value)
        self._energy, self._placed = None, True
        if self._grid:
            self._grid.stale[None] = 1

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (n, dim), a read-only copy in f64; second order in h. Assign an array to set them."""
        return self._export(self._sub.velocities, self._h, self._time, int(self._fresh))

    @velocity.setter
    def velocity(self, value) -> None:
        value = checks.points("World", "velocity", value, dim=self._particles.dim, count=len(self._particles))
        self._memory.check()
        self._memory.write(self._scene.state.d, value)
        self._fresh, self._energy = True, None

    def _export(self, kernel, *args) -> np.ndarray:
        self._memory.check()
        out = np.zeros((max(1, len(self._particles)), self._particles.dim))
        with runtime.literals(self._scene.real):
            kernel(*args, out)
        out = out[: len(self._particles)]
        out.flags.writeable = False
        return out

    def near(self, points, radius) -> np.ndarray:
        """The particles whose centers are within `radius` [m] of points: (m, 2), rows of `points` and particles, in order.

        points: (k, dim) [m]. radius: number or (k,), at least 0. With a Contact in the world its grid is used; without, all are
        compared.
        """
        points = checks.points("World.near", "points", points, dim=self._particles.dim)
        radius = checks.per_item("World.near", "radius", radius, len(points), least=0.0)
        self._memory.check()
        if not len(points) or not len(self._particles):
            return np.zeros((0, 2), dtype=np.int64)
        if not self._grid:
            return near_by_all(self.position, points, radius)
        self._list()
        with runtime.literals(self._scene.real):
            self._search = self._search or Search(self._grid)
            return self._search.near(points, radius)

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Index of, and distance [m] to, the particle whose center is nearest to each point; of equally near ones the first."""
        points = checks.points("World.nearest", "points", points, dim=self._particles.dim)
        if not len(self._particles):
            raise ValueError("World.nearest: there are no particles.")
        position = self.position
        start = self._grid.finest if self._grid else 2 * float(np.abs(position).max() + np.abs(points).max(initial=1.0))
        return nearest(self.near, position, points, start)

    @property
    def contacts(self) -> Contacts:
        """The pairs that overlap now, as arrays. Empty without a Contact."""
        x, r = self.position, self._particles.radius
        pairs = np.zeros((0, 2), dtype=np.int64)
        if self._grid:
            self._list()
            pairs = self._grid.pairs()
        d = x[pairs[:, 0]] - x[pairs[:, 1]]
        length = np.linalg.norm(d, axis=1)
        overlap = r[pairs].sum(axis=1) - length
        some = overlap > 0
        normal = d[some] / np.where(length > 0, length, 1.0)[some, None]
        return Contacts(pairs[some], overlap[some], normal)

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._time

    @property
    def last(self) -> StepReport | None:
        """The report of the last step; None before the first."""
        return self._last

    @property
    def particles(self) -> Particles:
        """What the world was built from: initial state and structure."""
        return self._particles

    @property
    def features(self) -> tuple[Feature, ...]:
        """What acts on the particles."""
        return self._features

    @property
    def precision(self) -> str:
        """ "f32", "f32-compensated" or "f64"."""
        return self._precision

    @property
    def path(self) -> str:
        """ "fused" or "parallel"."""
        return self._path

    @property
    def substeps(self) -> int:
        """Substeps of a frame."""
        return self._substeps

    @substeps.setter
    def substeps(self, value: int) -> None:
        self._substeps = checks.integer("World", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in a substep."""
        return self._iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        self._iterations = checks.integer("World", "iterations", value, least=1)

    @property
    def fields(self) -> dict[str, int]:
        """Every field on the device, by name, and its size [bytes]."""
        return {e.name: e.bytes for memory in self._memories for e in memory.entries}

    def hash(self) -> str:
        """SHA-256 of the exact state: equal if and only if two worlds of the same scene will go on alike, bit for bit."""
        digest = hashlib.sha256(repr((self._time, self._tick, self._h, self._fresh)).encode())
        for name, values in self._state().items():
            digest.update(name.encode())
            digest.update(values.tobytes())
        return digest.hexdigest()

    def _state(self) -> dict[str, np.ndarray]:
        """Every field that the future depends on."""
        state = {k: v for memory in self._memories for k, v in memory.state().items()}
        if self._grid and self._grid.carries:
            state["Contact.pairs"], state["Contact.slips"] = self._grid.slips()
        return state

    @property
    def _memories(self) -> list[runtime.Memory]:
        """The trees of fields: one from the start, others where a list or a need has grown."""
        grown = [self._grid.store if self._grid else None, *(c._on_store for c in self._sub.contacts)]
        return [self._memory, *(m for m in grown if m)]

    def explain(self) -> str:
        """What was compiled and what was left out, with fields, bytes and launches."""
        return explain(self)

    def clone(self, **changes) -> "World":
        """The same scene in the same state, with other substeps, iterations, solver, precision or path."""
        settings = dict(
            substeps=self.substeps, iterations=self.iterations, solver=self._solver, precision=self._precision, path=self._path
        )  # fmt: skip
        if unknown := set(changes) - set(settings):
            raise TypeError(f"World.clone: {sorted(unknown)[0]} cannot be changed; one of {', '.join(settings)} can.")
        self._memory.check()
        new = World(self._particles, [f.copy() for f in self._features], **{**settings, **changes})
        new._time, new._tick, new._frame = self._time, self._tick, self._frame
        if new._precision != self._precision:
            new.position, new.velocity = self.position, self.velocity
            return new
        new._upload(self._h, self._drag)
        if any(c._on_eases for c in self._sub.contacts):
            new._sub.contacts[0].ease()
            new._renew()
        state = self._state()
        for memory in new._memories:
            memory.restore(state)
        if new._grid and new._grid.carries:
            new._grid.restore(state["Contact.pairs"], state["Contact.slips"])
            new._renew()
        for ours, theirs in zip(self._features, new._features, strict=True):
            theirs.changed, theirs.moving = ours.changed, ours.moving
        new._fresh, new._started, new._placed, new._energy = (
            self._fresh,
            self._started,
            self._placed,
            self._energy,
        )
        return new

    def close(self) -> None:
        """Free the memory on the device. Using the world afterwards raises RuntimeError."""
        for memory in self._memories:
            memory.destroy()
        for feature in self._features:
            feature.scene = None

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __setattr__(self, name: str, value) -> None:
        if not name.startswith("_") and name not in ("position", "velocity", "substeps", "iterations"):
            raise AttributeError(
                f"World.{name} cannot be set. Live are position, velocity, substeps and iterations, and the knobs of the "
                "features; everything else is structure, fixed when the world is built."
            )
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        names = ", ".join(map(repr, self._features))
        return f"World({self._particles!r}, [{names}], substeps={self.substeps}, iterations={self.iterations})"


def _features(features: Iterable[Feature]) -> tuple[Feature, ...]:
    features = tuple(features)
    for k, feature in enumerate(features):
        if not isinstance(feature, Feature):
            hint = f"; write {feature.__name__}(...)" if isinstance(feature, type) else ""
            raise TypeError(f"World: features[{k}] = {feature!r} is not a force, constraint or wall{hint}.")
        if feature.scene is not None:
            raise ValueError(
                f"World: features[{k}] = {feature!r} already acts in another world. Make a new one, or use feature.copy()."
            )
    if len({id(f) for f in features}) < len(features):
        raise ValueError("World: the same feature is listed twice.")
    if sum(isinstance(f, Contact) for f in features) > 1:
        raise ValueError("World: more than one Contact; one covers all particles.")
    return features


def _settings(precision: str, path: str) -> None:
    if precision not in PRECISIONS:
        raise ValueError(f"World: precision = {precision!r}, but it must be one of {', '.join(map(repr, PRECISIONS))}.")
    if path not in PATHS:
        raise ValueError(f"World: path = {path!r}, but it must be one of {', '.join(map(repr, PATHS))}.")


def _chosen(path: str, particles: Particles, features: tuple[Feature, ...]) -> str:
    """The path for "auto": fused on one CPU thread while waking the others would cost more than their work."""
    if path != "auto":
        return path
    if runtime.architecture() != "cpu":
        return "parallel"
    work = len(particles) + sum(f.count for f in features if isinstance(f, Batch))
    return "fused" if work < CROSSOVER or runtime.threads() == 1 else "parallel"
