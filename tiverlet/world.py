"""The world: a scene, and its step."""

import copy
from collections.abc import Iterable
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from rich.progress import track

from . import checks, runtime, snapshot
from .assembly import assemble, check_settings, checked_features, checked_solver
from .breaking import BREAKS
from .calm import EVERY, PASSES
from .explain import explain
from .feature import Acceleration, Feature
from .particles import Particles, in_range
from .queries import Contacts, Search, near_by_all, nearest
from .solvers.solver import Solver
from .substep import REBOUNDS, decay
from .survey import StepReport


class World:
    """Particles and what acts on them.

    particles: Particles. features: what acts, in any order; at most one Contact. What is not in the list costs nothing.
    substeps: substeps of a frame. iterations: passes over the constraints in it. Both may change at any time, at no compile cost.
    solver: how constraints are solved: Jacobi (None), Direct for chains, trees and loops, Chebyshev or ConjugateGradient for
    cloth.
    precision: "f32" (position and displacement), "f32-compensated" (the position carries a low word, for coordinates far from the
    origin), "f64".
    path: "auto", "fused" (one launch per frame, one thread) or "parallel"; the bits are the same.

    Raises ValueError or TypeError, naming the argument, the index and the value, before anything is compiled.
    """

    def __init__(
        self, particles: Particles, features: Iterable[Feature] = (), *, substeps: int = 20, iterations: int = 1,
        solver: Solver | None = None, precision: str = "f32", path: str = "auto",
    ):  # fmt: skip
        if not isinstance(particles, Particles):
            raise TypeError(f"World: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        check_settings(precision, path)
        self._particles, self._features = particles, checked_features(features)
        self._solver, self._precision = checked_solver(solver), precision
        self.substeps, self.iterations = substeps, iterations
        parts = assemble(particles, self._features, self._solver, precision, path)
        self._memory, self._scene, self._batches = parts.memory, parts.scene, parts.batches
        self._grid, self._sub, self._survey, self._path = parts.grid, parts.substep, parts.survey, parts.path
        parts.scene.residuals = self._residuals
        self._time, self._tick, self._h = 0.0, 0, 0.0
        self._since = 0  # substeps since the last start
        self._frame = (0.0, 0.0, 0)  # when frames of the present length began, their length, their number
        self._fresh, self._started = True, False  # d holds velocities; the last substep was the first after a start
        self._placed = True  # by the user, and not looked at yet
        self._drag: list[float] | None = None
        self._energy: float | None = None
        self._last: StepReport | None = None
        self._search: Search | None = None  # compiled when it is first asked

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
            self._since = (self._since + self.substeps) % 2**31
            self._pass(dt)
            self._started, self._fresh = self._fresh and self.substeps == 1, False
            _, phi1, phi2, *_ = self._drag or decay(0.0, self._h)
            self._scene.hh = self._h**2 * (phi2 if self._started else phi1)
            report = self._look()
        change = report.energy - self._energy  # type: ignore[operator]
        self._energy = report.energy
        self._last = replace(report, energy_change=change, seconds=perf_counter() - clock)
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
        if self._fresh:
            self._since = 0
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
        if self._sub.hurries:
            self._sub.slots.kappa[None] = self._solver.condition(self.iterations)
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
            clock = self._time, self._tick, self._since
            self._sub.fused(self._h, *clock, fresh, self.substeps, self.iterations, begin, it0, skip)
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
                if self._sub.steps:
                    self._sub.opened(h, s, n, it, fresh)
                    for _ in range(self._sub.steps):
                        self._sub.iterated()
                    state = self._sub.collected(h, s, n, it, self.iterations, fresh)
                else:
                    state = self._sub.relaxed(h, s, n, it, self.iterations, fresh)
                stale, struck = state & 1, state & 2
            if self._sub.concludes:
                for _ in range(REBOUNDS if struck else 0):
                    self._sub.rebounded()
                self._sub.remembered(h, self._tick + s)
            if self._sub.calms and (self._since + s) % EVERY == EVERY - 1:
                for k in range(PASSES):
                    self._sub.calmed(k)

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

    def _residuals(self, batch) -> np.ndarray:
        """What the last substep left of each violation in a batch."""
        self._memory.check()
        if not self._h:
            raise RuntimeError(f"{batch!r}.residual: there is none before the world has been stepped.")
        with runtime.literals(self._scene.real):
            return self._survey.residuals(batch, self._h, self._started)

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
        """The pairs of discs or spheres that overlap now, as arrays. Empty without a Contact; Polygons keep no impulses (NaN)."""
        x, r = self.position, self._particles.radius
        pairs, push = np.zeros((0, 2), dtype=np.int64), np.zeros(0)
        if self._grid:
            self._list()
            pairs, at = self._grid.pairs()
            push = self._grid.read(self._sub.contacts[0]._on_push, at) if self._sub.calms else np.full(len(pairs), np.nan)
        d = x[pairs[:, 0]] - x[pairs[:, 1]]
        length = np.linalg.norm(d, axis=1)
        overlap = r[pairs].sum(axis=1) - length
        some = overlap > 0
        normal = d[some] / np.where(length > 0, length, 1.0)[some, None]
        return Contacts(pairs[some], overlap[some], normal, push[some] / (self._h or 1.0))

    @property
    def broken(self) -> list[tuple[Feature, np.ndarray]]:
        """What broke in the last frame: features, and the indices of their constraints. Those of all frames: feature.broken."""
        out = []
        if self._last and self._last.broken:
            for f in self._sub.breakers:
                stamps = f.stamps()
                recent = (stamps > 0) & ((self._tick - stamps) % BREAKS < self._last.substeps)
                if recent.any():
                    out.append((f, np.flatnonzero(recent)))
        return out

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
        value = checks.integer("World", "iterations", value, least=1)
        self._solver.check(value)
        self._iterations = value

    @property
    def fields(self) -> dict[str, int]:
        """Every field on the device, by name, and its size [bytes]."""
        return {e.name: e.bytes for memory in self._memories for e in memory.entries}

    def hash(self) -> str:
        """SHA-256 of the exact state: equal if and only if two worlds of the same scene will go on alike, bit for bit."""
        return snapshot.digest(self)

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
        settings = {"substeps": self.substeps, "iterations": self.iterations, "solver": self._solver}
        settings |= {"precision": self._precision, "path": self._path}
        if unknown := set(changes) - set(settings):
            raise TypeError(f"World.clone: {sorted(unknown)[0]} cannot be changed; one of {', '.join(settings)} can.")
        self._memory.check()
        new = World(self._particles, [f.copy() for f in self._features], **{**settings, **changes})
        snapshot.transfer(self, new)
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
