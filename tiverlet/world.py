"""The world: a scene, and its step."""

import os
import weakref
from collections.abc import Iterable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from . import checks
from .contact.initial_overlap import overlapping
from .device.interrupts import whole
from .features.arguments import meant
from .features.feature import Acceleration, Feature
from .particles import Particles
from .solvers.solver import Solver
from .step import checkpoint, edit_scene, high_order
from .step.adaptive import Guard
from .step.build import Assembly, assemble, check_settings, checked_features, checked_solver
from .step.diagnostics import STARTED, STEPPED
from .step.edit_scene import Handle
from .step.explain import explain
from .step.projection import project
from .step.runner import Launches
from .step.step import FREE, decay
from .step_report import StepReport


class World(Launches):
    """Particles and what acts on them.

    particles: Particles. features: what acts, in any order; at most one Contact. What is not in the list costs nothing.
    substeps: substeps of a frame, or "auto" for as many as it needs (see Guard). iterations: passes over the constraints in each.
    Both may change at any time, at no compile cost.
    solver: how constraints are solved: Direct for chains, trees and loops, Jacobi, Chebyshev or ConjugateGradient for cloth. None
    takes Direct for what hangs together like chains, ConjugateGradient(5) for many stiff links that hang together more closely,
    and Jacobi for the rest; explain() says what was chosen, and why.
    precision: "f32" (position and displacement; the digits of a coordinate end at 6e-8 of it, 1 mm at 10 km and 6 cm at 1000 km),
    "f32-compensated" (the position carries a low word, which keeps 1e-4 m at any of these), "f64". Where constraints are solved
    to rounding, positions and displacements of f32 carry what rounding takes from them: shorter substeps never make it worse.
    path: "auto", "fused" (one launch per frame, one thread) or "parallel" (one launch, a team of CPU threads; several launches on
    a GPU); the bits are the same.
    order: of the error in the substep: 2, or 4, 6 or 8 in f64 for motion without contacts, walls, damping and limits, where
    every rigid constraint is solved directly. A substep is then made of 5, 9 or 15 stages, see high_order.py.

    Raises ValueError or TypeError, naming the argument, the index and the value, before anything is compiled.
    """

    def __init__(
        self, particles: Particles, features: Iterable[Feature] = (), *, substeps: int | str = 20, iterations: int = 1,
        solver: Solver | None = None, precision: str = "f32", path: str = "auto", order: int = 2,
    ):  # fmt: skip
        if not isinstance(particles, Particles):
            raise TypeError(f"World: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        features = checked_features(features)
        starts = [None] * len(features)
        self._build(particles, features, starts, substeps, iterations, solver, precision, path, order)
        for contact in self._sub.contacts:
            if not contact.dev.eases and contact.table.uniform and overlapping(self._scene, self._batches):
                contact.ease()  # before anything is compiled: later, the frame would be compiled again

    @staticmethod
    def _of(particles: Particles, features: tuple[Feature, ...], starts: Sequence[Particles | None], **settings) -> "World":
        """A world of features that came at different times, see _build()."""
        new = object.__new__(World)
        new._build(particles, features, starts, **settings)
        return new

    def _build(self, particles, features, starts, substeps, iterations, solver, precision, path, order) -> None:
        """starts: for each feature the particles as they were when it came; None if it comes now."""
        check_settings(precision, path, order, features)
        self._wanted, self._order = (checked_solver(solver), path), order
        self._solver, self._precision, self._batches = self._wanted[0] or Solver(), precision, []
        self._guard = Guard()
        self.substeps, self.iterations = substeps, iterations
        self._install(particles, features, assemble(particles, features, starts, len(particles), *self._asked))
        self._handles: weakref.WeakSet[Handle] = weakref.WeakSet()
        self._time, self._tick, self._h = 0.0, 0, 0.0
        self._since = 0  # substeps since the last start
        self._longest = 0.0  # [s] substep since violations were last taken out, see project()
        self._frame = (0.0, 0.0, 0)  # when frames of the present length began, their length, their number
        self._fresh, self._started = True, False  # d holds velocities; the last substep was the first after a start
        self._owed = 0.0  # [s] of the kick by rigid constraints that the velocities at the last start lacked
        self._parted: Any = None  # velocities, until the next step, where constraints were removed that have a part in them
        self._placed: int | None = 0  # the first of the particles that the user placed and that were not looked at yet
        self._drag: list[float] | None = None
        self._energy: float | None = None
        self._last: StepReport | None = None
        self._watchers: list[Any] = []  # recorders: told of what the user assigns, and before and after every step
        self._undo: tuple | None = None  # the state before a step that takes long, and flags of features

    @property
    def _asked(self) -> tuple[Solver | None, str, str, int]:
        """What assemble() takes. A solver that was chosen for constraints that there are stays."""
        solver = self._wanted[0] or (self._solver if self._batches else None)
        return solver, self._precision, self._wanted[1], self._order

    def _install(self, particles: Particles, features: tuple[Feature, ...], parts: Assembly) -> None:
        """Take these for the parts of the world."""
        self._particles, self._features = particles, features
        self._memory, self._scene, self._batches = parts.memory, parts.scene, parts.batches
        self._grid, self._sub, self._survey, self._path = parts.grid, parts.substep, parts.survey, parts.path
        self._solver = parts.solver
        self._make()
        self._search = None  # compiled when it is first asked
        parts.scene.residuals = self._residuals

    # The step.

    def step(self, dt: float, tolerance: float | None = None, budget: float | None = None) -> StepReport:
        """Advance by dt [s], and say how it went.

        Without tolerance and budget the frame has `substeps` substeps; with substeps="auto", as many as it needs to be stable.
        tolerance: of the residual and the overlap, both relative; the frame is made again with more substeps until they are met.
        budget: seconds of computing that the frame may take; alone, it is spent for as many substeps as fit. The report says how
        many substeps there were, and has a flag when the aim was missed. Results of a budget depend on the speed of the machine.

        Raises ValueError for dt, tolerance or budget that is not finite and above 0. With another substep length than before,
        displacements are turned into velocities first and back after (time-corrected Verlet), so the step stays second order.
        A signal such as Ctrl-C is handled after the frame. One that takes seconds is undone at once if the handler raises.
        """
        self._memory.check()
        dt = checks.number("World.step", "dt", dt, above=0.0)
        with whole:
            for watcher in self._watchers:
                watcher.before()
            clock = perf_counter()
            try:
                guarded = self._guard.auto or tolerance is not None or budget is not None
                if guarded or self._substeps * self._iterations > self._passes:
                    self._undo = checkpoint.keep(self), checkpoint.flags(self)
                self._heed()
                if guarded:
                    with self._memory.compiler():
                        report = self._guard.advance(self, dt, tolerance, budget)
                else:
                    self._begin(dt / self._substeps * self._plain["first"])
                    report = self._advance(dt, self._substeps, self._iterations)
            except BaseException:
                self._broken_off()
                raise
            report.__dict__["seconds"] = perf_counter() - clock  # which is no part of what it says
            # All at once, which is quicker than one after the other.
            self.__dict__.update(_last=report, _energy=report.energy, _undo=None)
            for watcher in self._watchers:
                watcher.after(dt, report)
        return report

    def _broken_off(self) -> None:
        """A step ended with an exception: undo it, or tell recorders that the state is none that steps lead to."""
        undo, self._undo = self._undo, None
        if undo:
            checkpoint.undo(self, *undo)
            return
        for watcher in self._watchers:
            watcher.broken_off()

    def _advance(self, dt: float, substeps: int, iterations: int) -> StepReport:
        """One frame from where _begin() left off."""
        sub = self._plain
        if sub["hurries"]:
            with self._memory.compiler():
                self._memory.write(self._sub.slots.kappa, self._solver.condition(iterations))
        done, frame = substeps if sub["n"] else 0, self._counted(dt)
        started, end = self._fresh and substeps == 1, frame[0] + frame[1] * frame[2]
        if sub["launched"]:
            with self._memory.compiler():
                self._parallel(done, iterations)
        else:
            self._fused(done, iterations, end, STARTED if started else STEPPED)
        self.__dict__.update(
            _tick=(self._tick + substeps) % 2**31, _since=(self._since + substeps) % 2**31,
            _started=started, _fresh=False, _parted=None, _frame=frame, _time=end,
        )  # fmt: skip
        if sub["launched"]:
            self._look()
        self._scene.hh = self._h**2 * sub["reaches"] * (self._drag or FREE)[2 if started else 1]
        return self._report(substeps, iterations)

    def _counted(self, dt: float) -> tuple[float, float, int]:
        """When frames of this length began, their length, and their number, with one more: frames of the same length are counted,
        not summed, so that they add no rounding errors."""
        since, length, count = self._frame
        return (since, dt, count + 1) if dt == length else (self._time, dt, 1)

    def _heed(self) -> None:
        """Bring the knobs to the device; where a force has changed, start anew while the device still has what it was."""
        for feature in self._features:
            if feature.changed or feature.moving:
                self._adapt()
                with self._memory.compiler():
                    self._upload()
                return

    @property
    def _force_waits(self) -> bool:
        """Whether a force has changed and the device still has what it was."""
        return any(f.changed and (f.new_force or isinstance(f, Acceleration)) for f in self._features)

    def _settle_forces(self) -> None:
        """Where a force has changed, take velocities by what it was: before that is overwritten, or left behind by a copy."""
        if self._force_waits:
            with self._memory.compiler():
                self._restart()

    def _adapt(self) -> None:
        """Settle forces; where knobs ask for what the kernels do not have, build the world anew."""
        self._settle_forces()
        if any(f.changed and f.outgrown for f in self._features):
            check_settings(self._precision, self._wanted[1], self._order, self._features)
            edit_scene.rebuild(self, np.ones(len(self._particles), dtype=bool), None, self._features)

    def _upload(self) -> None:
        """Write what was changed in Python since the last frame."""
        for feature in self._features:
            if feature.moving:
                feature.moving = False
                feature.settle()
            if feature.changed:
                feature.changed = feature.new_force = False
                feature.upload()

    def _begin(self, h: float) -> None:
        """Take h for the substep; with another one than before, displacements mean something else: start anew from velocities."""
        drag = decay(sum(f.rate for f in self._sub.drags), h) if self._plain["decays"] else None
        if h == self._h and drag == self._drag and not self._fresh and self._energy is not None and self._placed is None:
            return
        with self._memory.compiler():
            if h != self._h or drag != self._drag:
                self._longest = max(self._longest, self._h if self._placed is None else 0.0)
                self._restart()
                if h < self._longest and self._order == 2 and project(self, h, self._longest):
                    self._longest = h
            if self._fresh:
                self._since = 0
            if self._placed is not None and self._sub.slots and self._sub.slots.system:
                self._sub.slots.system.forget()
            self._set(h, drag)
            if self._energy is None:
                self._look()
                report = self._report()
                self._energy = report.energy
                if report.overlap > 0 and self._placed is not None:
                    self._ease(self._placed)
            self._placed = None

    def _set(self, h: float, drag: list[float] | None) -> None:
        if drag and drag != self._drag:
            self._memory.write(self._sub.decay, drag)
        self._h, self._drag = h, drag

    def _restart(self) -> None:
        """Turn displacements into velocities, so that the next substep starts from the state at this time."""
        if not self._fresh:
            if self._order == 2:
                self._sub.to_velocity(self._h, self._time)
                self._owed = (self._drag or FREE)[3] * self._h
            else:
                self._memory.write(self._scene.state.d, high_order.velocity(self))
            self._fresh, self._parted = True, None

    def run(
        self, seconds: float, dt: float = 1 / 60, recorder=None, progress: bool = False, *, tolerance: float | None = None,
        budget: float | None = None,
    ) -> StepReport:  # fmt: skip
        """Step for `seconds` [s] in frames of dt [s]; returns the worst figures of all frames.

        tolerance, budget: of each frame, see step(). recorder: a Recorder that logs each frame, or the path of one that is made
        for this run. progress: show a bar.
        """
        seconds = checks.number("World.run", "seconds", seconds, above=0.0)
        dt = checks.number("World.run", "dt", dt, above=0.0)
        frames: Any = range(max(1, round(seconds / dt)))
        if isinstance(recorder, (str, os.PathLike)):
            from .recording import Recorder

            with Recorder(recorder, self) as recorder:
                return self.run(seconds, dt, recorder, progress, tolerance=tolerance, budget=budget)
        if recorder is not None and not callable(getattr(recorder, "log", None)):
            kind = type(recorder).__name__
            raise TypeError(
                f"World.run: recorder = {recorder!r} is a {kind}, but a path or a tv.Recorder(path, world) is needed."
            )
        if progress:
            from rich.progress import track  # noqa: PLC0415

            frames = track(frames, description=f"{len(self._particles)} particles")
        worst = None
        for _ in frames:
            with whole:  # the frame is in the file, too
                report = self.step(dt, tolerance, budget)
                worst = report if worst is None else worst.worse(report)
                if recorder is not None:
                    recorder.log()
        assert worst
        return worst

    # Other worlds.

    def hash(self) -> str:
        """SHA-256 of the exact state: equal if and only if two worlds of the same scene will go on alike, bit for bit."""
        return checkpoint.keep(self).digest()

    def explain(self) -> str:
        """What was compiled and what was left out, with fields, bytes and launches."""
        return explain(self)

    @property
    def settings(self) -> dict[str, Any]:
        """How it is computed: substeps, iterations, solver, precision, path and order, as __init__ takes them."""
        out: dict[str, Any] = {"substeps": "auto" if self._guard.auto else self.substeps, "iterations": self.iterations}
        return out | {"solver": self._solver, "precision": self._precision, "path": self._path, "order": self._order}

    def clone(self, **changes) -> "World":
        """The same scene in the same state, with other substeps, iterations, solver, precision, path or order.

        Handles stay with the world that gave them.
        """
        settings = self.settings
        if unknown := set(changes) - set(settings):
            raise TypeError(f"World.clone: {sorted(unknown)[0]} cannot be changed; one of {', '.join(settings)} can.")
        self._memory.check()
        self._adapt()
        copies = tuple(f.copy() for f in self._features)
        new = World._of(self._particles, copies, [f.start for f in self._features], **{**settings, **changes})
        checkpoint.transfer(self, new)
        return new

    def report(self, seconds: float, tolerance: float | None = None, **options):
        """Error against run time of this scene, from its present state: a SceneReport with the cheapest settings, ready to paste.

        seconds [s]: how far ahead. tolerance: error at the end [m], by default a thousandth of the motion. options: dt [s] of a
        frame; substeps: those to try; progress: show a bar. Clones run; this world is not touched. Knobs keep their present
        values. There is no known answer: the reference is the finest run, and how far that is off is estimated and said.
        """
        from .report.accuracy.scene import scene_report

        return scene_report(self, seconds, tolerance, **options)

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
            guess = "" if hasattr(self, name) else meant(name, ("position", "velocity", "substeps", "iterations"))
            raise AttributeError(
                f"World.{name} cannot be set{guess}. Live are position, velocity, substeps and iterations, and the knobs of the "
                "features; everything else is structure, fixed when the world is built."
            )
        object.__setattr__(self, name, value)

    def __reduce_ex__(self, protocol):
        raise TypeError(
            "A World holds compiled kernels and memory of the device, so it cannot be copied or pickled. Use world.clone(), or "
            "write it to a file with tv.Recorder(path, world) and read it back with tv.replay(path).world()."
        )

    def __repr__(self) -> str:
        names = ", ".join(map(repr, self._features))
        return f"World({self._particles!r}, [{names}], substeps={self.substeps}, iterations={self.iterations})"
