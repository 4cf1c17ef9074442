"""The World: a scene (particles and features) and its time step."""

import os
import weakref
from collections.abc import Iterable, Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from . import checks
from .colliders.collider import Collider
from .constraints.core.strength import BREAKS
from .contact.pair_contact import PairContact
from .contact.rays import Hits, inside, ray
from .contact.touches import ContactEvents, Told, joined, joined_events, no_events
from .device.copies import Copies
from .device.interrupts import deferred_signals, in_turn
from .features.feature import Acceleration, Batch, Feature
from .features.read_only import assign_whole_advice, read_only, structure_advice
from .features.unknown_names import answer_names, suggest
from .neighbours.queries import Contacts, near, nearest
from .particles import Particles, at_rest, in_range, spin_of
from .shapes import Shape
from .solvers.jacobi import Jacobi
from .solvers.solver import Solver
from .step import checkpoint, edit_scene, energy_bound, impulse, placing, violations
from .step.adaptive import StepController
from .step.build import Assembly, assemble, check_settings, checked_features, checked_solver, usual_substeps
from .step.build_again import Rebuild
from .step.clock import CHANGED, NO, Clock, exceeds, falls_short
from .step.diagnostics import KINETIC
from .step.edit_scene import Handle
from .step.explain import compiling, explain
from .step.runner import Runner
from .step.scale import Scale
from .step.step_report import StepReport

LIVE = ("position", "velocity", "spin", "substeps", "iterations")


@answer_names
@checks.answer_calls
class World:
    """A scene: particles, the features that act on them, and the time step.

    particles: Particles. features: forces, constraints, contacts and walls, in any order; at most one Contact. A feature that is
    not in the list costs nothing.
    substeps: substeps per frame; None for as many as such scenes usually need: 20, or 4 where particles and rigid clusters fall
    freely but for contacts; or "auto" for these, and more where a frame needs more; springs of omega dt > 50, dt the frame,
    are not resolved, and lose what they vibrate with (flag "energy-loss"). iterations: passes over the constraints in each
    substep. Both may change at any time, without compiling.
    solver: how constraints are solved: Direct for chains, trees and loops; Jacobi, Chebyshev or ConjugateGradient for cloth. None
    chooses ConjugateGradient where elimination would leave many stiff links to Jacobi, as in cloth; else Direct where
    constraints are connected like chains or beams; else Jacobi. explain() reports the choice and its reason.
    precision: "f32" (for position and displacement; a coordinate is resolved to 6e-8 of its value: 1 mm at 10 km and 6 cm at 1000
    km), "f32-compensated" (the position has a low word, which keeps 1e-4 m at any of these distances), "f64". Where constraints
    are solved to rounding, positions and displacements in f32 carry their rounding errors along, so that shorter substeps never
    make the result worse.
    path: "auto", "fused" (one launch per frame, one thread) or "parallel" (one launch, a team of CPU threads; several launches on
    a GPU). The results are the same bit for bit.
    order: order of the error in the substep: 2; or 4, 6 or 8 in f64, for motion without contacts, walls, damping and limits where
    every rigid constraint is solved directly. A substep then has 5, 9 or 15 stages, see tiverlet/step/README.md.

    Raises ValueError or TypeError, naming the argument, the index and the value, before anything is compiled.
    """

    _copies: Copies | None = None

    def __init__(
        self, particles: Particles, features: Iterable[Feature] = (), *, substeps: int | str | None = None, iterations: int = 1,
        solver: Solver | None = None, precision: str = "f32", path: str = "auto", order: int = 2,
    ):  # fmt: skip
        if not isinstance(particles, Particles):
            kind, ready = type(particles).__name__, hasattr(particles, "position")
            write = "write tv.Particles(shape.position)" if ready else f"{particles!r}; use tv.Particles(position)"
            raise TypeError(f"World: particles is a {kind}{'; ' if ready else ': '}{write}.")
        features = checked_features(features)
        starts = [None] * len(features)
        self._build(particles, features, starts, substeps, iterations, solver, precision, path, order)

    @staticmethod
    def _from_starts(
        particles: Particles, features: tuple[Feature, ...], starts: Sequence[Particles | None], copies: Copies | None = None,
        **settings,
    ) -> "World":  # fmt: skip
        """Return a world whose features were added at different times, see _build(). copies: set where it stands for many."""
        new = object.__new__(World)
        new._copies = copies
        new._build(particles, features, starts, **settings)
        return new

    def _build(self, particles, features, starts, substeps, iterations, solver, precision, path, order) -> None:
        """Build the world. starts: for each feature the particles as they were when it was added; None if it is added now."""
        check_settings(precision, path, order, features)
        self._requested = checked_solver(solver), path  # None: the solver is chosen
        self._solver, self._precision, self._order = self._requested[0] or Jacobi(), precision, order
        self._controller = StepController()
        self.substeps, self.iterations = substeps, iterations
        self._clock = Clock()
        parts = assemble(
            particles, features, starts, len(particles), self._requested[0], precision, path, order, copies=self._copies
        )
        self._install(particles, features, parts)
        self._handles: weakref.WeakSet[Handle] = weakref.WeakSet()
        self._last: StepReport | None = None
        self._watchers: list[Any] = []  # recorders: called at each assignment, and before and after every step
        # Iterations that the user set, where substeps and iterations of the last frame were chosen for accuracy; else 0.
        self._adapted = 0
        self._passes: int | None = None  # iterations of such a frame of a recording, which is made again; None for other frames
        self._undo: tuple | None = None  # the state before a step that takes long, and flags of features
        self._events: Told | None = None  # of the last frame, once the device has lost them
        self._ended: Told | None = None  # by edits before the last frame, of pairs and walls
        self._ending: Told | None = None  # by edits since then

    @property
    def _build_options(self) -> tuple[Solver | None, str, str, int, Scale]:
        """The options of assemble(). A solver that was chosen for the present constraints stays."""
        solver = self._requested[0] or (self._solver if self._runner.batches else None)
        return solver, self._precision, self._requested[1], self._order, self._scale

    def _install(self, particles: Particles, features: tuple[Feature, ...], parts: Assembly) -> None:
        """Make these the parts of the world."""
        self._particles, self._features, self._usual_substeps = particles, features, usual_substeps(features)
        self._runner, self._solver, self._scale = Runner(parts, self._clock), parts.solver, parts.scale
        parts.scene.residuals = self._runner.residuals

    def _rebuild(
        self, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...], extend: Mapping[Feature, Feature]
    ) -> Rebuild:
        """Return the plan to rebuild the world with other particles and features."""
        return Rebuild(self, some, added, features, extend)

    # The step.

    def step(self, dt: float, tolerance: float | None = None, budget: float | None = None) -> StepReport:
        """Advance the world by dt [s], one frame, and return its report.

        Without tolerance and budget frames of the usual length have `substeps` substeps, and others as many as keep their length:
        a late one has more of them, up to eight times `substeps`; beyond that it is flagged. With substeps="auto" it has at
        least as many as by default, and more if it would be bad. Fewer may do for a tolerance, or have to for a budget.
        tolerance: upper bound of the residual and the overlap, both relative; of phi^2 / 24, for the angle phi by which rigid
        constraints, and beads on smooth curves, turn in a substep; of (omega h)^2 / 24 for forces that vary in space; and of
        about (omega h)^2 A / 12 for springs that vibrate by a share A of their size. The frame is repeated with more substeps
        until all of these are met. It does not cover errors of impacts, of sliding along curved walls or particles, and of soft
        clusters.
        budget: seconds of computing that the frame may take. Without tolerance, it is spent on as many substeps as fit. The
        report gives the number of substeps, and has a flag if the aim was missed. Results of a budget depend on the speed of the
        machine.

        Raises ValueError for dt, tolerance or budget that is not finite and above 0. When the substep length changes,
        displacements are turned into velocities first and back after (time-corrected Verlet), so the step stays second order.
        A signal such as Ctrl-C is handled after the frame. A frame that takes seconds is undone at once if the handler raises.
        Other threads that read the world or its features wait for the end of the frame.
        """
        self._runner.memory.check()
        dt = checks.frame_length("World.step", dt)
        with deferred_signals:
            for watcher in self._watchers:
                watcher.before()
            clock = perf_counter()
            try:
                self._find_stiffened()
                guarded = self._controller.auto or tolerance is not None or budget is not None
                substeps = self.substeps if guarded else self._controller.pace.fit(dt, self.substeps)
                if guarded or substeps * self._iterations > self._runner.passes_at_once:
                    self._undo = checkpoint.keep(self), checkpoint.flags(self)
                self._upload_parameters()
                self._runner.interruptible = self._undo is not None
                if guarded:
                    with self._runner.memory.compiler():
                        report = self._controller.advance(self, dt, tolerance, budget)
                else:
                    self._runner.begin(dt, substeps, self._iterations, self._passes)
                    report = self._runner.advance(dt, substeps, self._passes or self._iterations)
                    report = self._controller.pace.checked(report, dt)
                self._adapted = self._iterations if guarded or self._passes else 0
            except BaseException:
                self._handle_failed_step()
                raise
            self._runner.end_ramps()
            if exceeds(self._clock, report.energy, self._runner.sheet.item(KINETIC), report.overlap):
                report = energy_bound.checked(self, report)
            elif self._clock.conserves != NO and falls_short(self._clock, report.energy):
                report = energy_bound.checked_for_loss(self, report)
            report.__dict__["seconds"] = perf_counter() - clock  # the report is frozen; this field is not compared
            self._last, self._clock.energy, self._undo, self._events = report, report.energy, None, None
            self._ended, self._ending = self._ending, None
            for watcher in self._watchers:
                watcher.after(dt, report)
        return report

    def _make_again(self, dt: float, substeps: int, passes: int, adapted: int) -> None:
        """Make a frame of a recording again, of so many iterations. adapted: as _adapted was after it."""
        self.substeps, self.iterations, self._passes = substeps, adapted or passes, passes if adapted else None
        try:
            self.step(dt)
        finally:
            self._passes = None

    def _handle_failed_step(self) -> None:
        """Clean up after a step that ended with an exception: undo it, or inform recorders that no step leads to this state."""
        undo, self._undo, self._events = self._undo, None, (none := no_events(self._particles.dim), none)
        if undo:
            checkpoint.undo(self, *undo)
            return
        for watcher in self._watchers:
            watcher.broken_off()

    def _find_stiffened(self) -> None:
        """Treat the particles of springs that become rigid as placed anew, so that the next step first restores their shape.

        Call it before knobs are uploaded, or the state is copied: it compares the knobs with those on the device.
        """
        waiting, clock = [f for f in self._features if f.changed and isinstance(f, Batch) and f.soft], self._clock
        first = violations.first_stiffened(waiting, self.position) if waiting else None
        if first is not None:
            clock.energy = clock.moved_mask = None
            clock.first_moved = first if clock.first_moved is None else min(first, clock.first_moved)

    def _upload_parameters(self) -> None:
        """Write the knobs to the device. Where a force has changed, first turn displacements into velocities by the old force."""
        waiting = [f for f in self._features if f.changed or f.moving]
        if waiting:
            self._clock.bound = CHANGED
            if self._runner.sleep and not all(isinstance(f, Batch) and f.is_kinematic for f in waiting):
                self._runner.wake()
            self._rebuild_for_knobs(steps=True)
            self._upload()

    @property
    def _has_new_force(self) -> bool:
        """Whether a force has changed and the device still has the old one."""
        return any(f.changed and (f.new_force or isinstance(f, Acceleration)) for f in self._features)

    @property
    def _releases_load(self) -> bool:
        """Whether a wall was switched off, and the device still has it. It is lost with the wall, also in a copy of the scene."""
        return any(f.changed and f.has_released_load for f in self._features)

    def _restart_for_new_forces(self, steps: bool) -> None:
        """Where a force has changed, keep the velocities that displacements give with the old force before it is lost.

        They are turned into velocities, unless displacements can be changed instead. The old force is lost when it is
        overwritten, or left out of a copy. steps: see _rebuild_for_knobs().
        """
        if self._releases_load:
            if not steps:
                self._runner.note_displacements()
            self._restart_with_reactions()
        elif self._has_new_force and not self._take_forces(steps):
            with self._runner.memory.compiler():
                (self._runner.restart if steps else self._runner.restart_between)(self._iterations)

    def _take_forces(self, steps: bool = False) -> bool:
        """Write changed forces to the device, and let particles go on with the velocities that they have.

        A start would do so, too, but would disturb all that rests for as long as the user steers: contacts and walls find half of
        their loads in it. Returns False, and does nothing, where a start is needed: where springs or drags change, or kernels.
        steps: see _rebuild_for_knobs().
        """
        runner, clock, changed = self._runner, self._clock, [f for f in self._features if f.changed]
        forces = [f for f in changed if isinstance(f, Acceleration)]
        if not forces or clock.d_is_velocity or not impulse.has_enough_digits(runner):
            return False
        others = any([f.new_force or f.has_released_load or f.needs_other_kernels for f in changed])
        if others or not impulse.has_same_drag(runner):
            return False
        clock.bound = CHANGED
        runner.wake()
        velocity = runner.velocity(self._iterations)
        for watcher in () if steps else self._watchers:
            watcher.before()
        for force in forces:
            force.changed = False
            force.upload()
        if not impulse.keep_velocities(runner, velocity, self._iterations):
            self._start_from(velocity if clock.velocity_override is None else clock.velocity_override)
        for watcher in () if steps else self._watchers:
            watcher.broken_off()  # no step leads to this state: the forces may change again before the next one
        return True

    def _restart_with_reactions(self) -> None:
        """Start from the present velocities, which include the reaction that is about to end."""
        if not self._clock.d_is_velocity:
            self._start_from(self.velocity)

    def _start_from(self, velocity: np.ndarray) -> None:
        with self._runner.memory.compiler():
            self._runner.start(velocity)
        self._clock.energy = None

    def _rebuild_for_knobs(self, steps: bool = False) -> None:
        """Handle changed forces, see _restart_for_new_forces(), and rebuild the world where knobs need other kernels.

        steps: whether a frame follows at once, so that residuals of the last frame are not read before it.
        """
        self._restart_for_new_forces(steps)
        if any([f.changed and isinstance(f, Collider) for f in self._features]):
            for contact in self._runner.step.contacts:  # restitution of walls decides whether these are rows
                contact.changed = contact.changed or contact.needs_other_kernels
        if any([f.needs_other_kernels for f in self._features if f.changed]):
            edit_scene.renew(self)

    def _upload(self) -> None:
        """Write to the device what was changed in Python since the last frame."""
        search = self._runner.search
        if search and search.walls and any(isinstance(f, Collider) and f.changed for f in self._features):
            search.list.invalidate()  # it lists the walls near particles
        for feature in self._features:
            if feature.moving:
                feature.moving = False
                feature.end_motion()
            if feature.changed:
                feature.changed = feature.new_force = False
                feature.upload()
        self._runner.find_ramps()

    def run(
        self, seconds: float, dt: float = 1 / 60, recorder=None, progress: bool = False, *, tolerance: float | None = None,
        budget: float | None = None,
    ) -> StepReport:  # fmt: skip
        """Step for `seconds` [s], rounded to whole frames of dt [s], at least one. Returns the worst figures of all frames.

        tolerance, budget: of each frame, see step(). recorder: a Recorder that logs each frame, or the path of one that is made
        for this run. progress: show a bar.
        """
        seconds = checks.number("World.run", "seconds", seconds, above=0.0)
        dt = checks.frame_length("World.run", dt)
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
            with deferred_signals:  # signals wait until the frame is in the file, too
                report = self.step(dt, tolerance, budget)
                worst = report if worst is None else worst.worse(report)
                if recorder is not None:
                    recorder.log()
        assert worst
        return worst

    # Other worlds.

    @in_turn
    def hash(self) -> str:
        """Return the SHA-256 of the exact state: equal if and only if two worlds of one scene continue alike, bit for bit."""
        return checkpoint.digest(self, checkpoint.keep(self))

    def explain(self) -> str:
        """Describe what was compiled and what was left out, with fields, bytes and launches, and how long compiling took."""
        return "\n".join([explain(self), *compiling(self)])

    # State.

    @property
    @in_turn
    def position(self) -> np.ndarray:
        """Positions [m], (n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        return read_only(self._runner.scene.state.get(self._runner.memory), assign_whole_advice("World", "position"))

    @position.setter
    def position(self, value) -> None:
        """Move particles to (n, dim) [m]. Velocities are kept, and neighbour lists are rebuilt."""
        value = checks.points("World", "position", value, dim=self._particles.dim, count=len(self._particles))
        self._check_places("World", value)
        self._runner.memory.check()
        with deferred_signals:
            for watcher in self._watchers:
                watcher.assigned("position", value)
            self._runner.place(value, self._iterations)
            self._runner.invalidate()

    def _check_places(self, who: str, position: np.ndarray) -> None:
        """Raise ValueError where positions, (n, dim) [m], are too far out."""
        in_range(who, "position", position)
        if self._runner.step.contacts:
            self._runner.step.contacts[0].check_range(position)

    def place(self, feature: Feature, **knobs) -> None:
        """Set knobs of a wall or a Pin, which is there at once: world.place(floor, offset=2.0), world.place(pin, target=x).

        Assigned to the feature, they are where it goes to during the next frame, at the speed that this takes. Driven particles
        are placed with their Pin.

        Raises ValueError or TypeError for what is no wall, Pin or Path of this world, and for names and values that it refuses.
        """
        self._runner.memory.check()
        with deferred_signals:
            placing.place(self, feature, knobs)

    def shift(self, by) -> None:
        """Shift the whole scene by a vector, (dim,) [m]: particles, walls, targets of pins, centers of forces; without motion.

        So a game keeps what it looks at near the origin, where f32 has most digits (floating origin). Loads, velocities, contacts
        and sleep of the next frames are as without the shift, to rounding. What was assigned to walls and targets since the last
        step is there at once.

        Raises ValueError for features that are fixed in space: Periodic, Path, Snap, and forces of your own that read positions.
        """
        self._runner.memory.check()
        by = checks.vector("World.shift", "by", by, self._particles.dim)
        with deferred_signals:
            placing.shift(self, by)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (n, dim), a read-only copy in f64, accurate to the order of the world.

        Assign an array to set them. A particle whose velocity changes gets an impulse. All others continue bit for bit, even
        where a changed particle leaves a contact, or its friction turns to another direction. But where a changed particle hangs
        on a taut rope, and in orders above 2, all particles start from the assigned velocities (a start is the first substep
        after velocities were set). Writing back the velocities that were read changes nothing.
        """
        out = self._clock.velocity_override
        if out is None:
            self._runner.memory.check()
            with deferred_signals, self._runner.memory.compiler():
                out = self._runner.velocity(self._iterations)
        return read_only(out.copy(), assign_whole_advice("World", "velocity"))

    @velocity.setter
    def velocity(self, value) -> None:
        """Set the velocities with which particles continue, (n, dim) [m/s]."""
        value = checks.points("World", "velocity", value, dim=self._particles.dim, count=len(self._particles))
        self._runner.memory.check()
        with deferred_signals:
            for watcher in self._watchers:
                watcher.assigned("velocity", value)
            seen = self.velocity
            change = value - seen
            if change.any() and not impulse.steer(self._runner, value, seen, change, self._iterations):
                self._start_from(value)

    @property
    def spin(self) -> np.ndarray:
        """Angular velocities [rad/s], (n,) in 2D, (n, 3) in 3D, a read-only copy in f64; second order. Assign to set them."""
        state = self._runner.scene.state
        if not state.spins:
            return read_only(at_rest("spin", self._particles), assign_whole_advice("World", "spin"))
        self._runner.memory.check()
        with deferred_signals, self._runner.memory.compiler():
            return read_only(state.spin.to_rates(self._runner.spin()), assign_whole_advice("World", "spin"))

    @spin.setter
    def spin(self, value) -> None:
        """Set the angular velocities, (n,) in 2D, (n, 3) in 3D [rad/s]. Raises ValueError where particles do not spin."""
        if not self._particles.spins:
            raise ValueError("World.spin: these particles do not spin. Make them with tv.Particles(..., spin=True).")
        value = spin_of("World", value, self._particles)
        self._runner.memory.check()
        with deferred_signals:
            for watcher in self._watchers:
                watcher.assigned("spin", value)
            runner, clock, spin = self._runner, self._clock, self._runner.scene.state.spin
            with runner.memory.compiler():
                has = runner.spin()
            others = (value != spin.to_rates(has)).reshape(len(value), -1).any(axis=1)
            change = np.where(others[:, None], spin.from_rates(value) - has, 0.0)
            if not change.any():
                return
            if impulse.has_friction(runner) or runner.probe:  # the change alters friction
                seen = self.velocity
                if not impulse.steer(runner, seen, seen, change, self._iterations, has):
                    self._restart_with_reactions()
            held = runner.scene.inv_mass == 0  # what turns in place wakes what lies on it, as a wall that moves does
            runner.wake(None if (others & held).any() else np.flatnonzero(others))
            s = runner.memory.read(spin.s)[: runner.n]
            runner.memory.write(spin.s, has + change if clock.d_is_velocity else s + clock.h * change)
            clock.energy = None

    @property
    @in_turn
    def orientation(self) -> np.ndarray:
        """Orientations, a read-only copy: angles (n,) in 2D [rad], unit quaternions (n, 4) (x, y, z, w) in 3D."""
        if self._particles.orientation is None:
            raise ValueError("World.orientation: nobody keeps track of it. Make particles with tv.Particles(..., orientation=0).")
        turned = self._runner.memory.read(self._runner.scene.state.spin.orientation)[: len(self._particles)]
        return read_only(turned[:, 0] if self._particles.dim == 2 else turned, structure_advice("World", "orientation"))

    def near(self, points, radius) -> np.ndarray:
        """Return which particles have their center within `radius` [m] of which points.

        Returns (m, 2): rows of an index into `points` and a particle, in order. points: (k, dim) [m]. radius: number or (k,), at
        least 0. In a periodic box the nearest image of each particle counts.
        """
        points = checks.points("World.near", "points", points, dim=self._particles.dim)
        radius = checks.per_item("World.near", "radius", radius, len(points), least=0.0)
        self._runner.memory.check()
        if not len(points) or not len(self._particles):
            return np.zeros((0, 2), dtype=np.int64)
        return near(self.position, points, radius, self._runner.scene.periodic)

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Return the particle nearest to each point, by its center, and its distance [m]; the first of equally near ones."""
        points = checks.points("World.nearest", "points", points, dim=self._particles.dim)
        if not len(self._particles):
            raise ValueError("World.nearest: there are no particles.")
        return nearest(self.position, points, self._runner.scene.periodic)

    def ray(
        self, origin, direction, reach=np.inf, *, radius: float = 0.0, groups=None, skip=(), features: Iterable[Feature] | None =
        None,
    ) -> Hits:  # fmt: skip
        """Return what each ray hits first: a particle, a link between two particles, or a wall.

        The result has distance, point, normal, particle, link, wall and met, with a row for each ray.

        origin, direction: (dim,) or (k, dim) [m], as many of both or one for all; a direction has any length above 0. reach:
        number or (k,) [m], the length of a ray. radius: [m] of a ball that is cast instead of a line, to see whether it fits
        through. Then distance is the path of the ball's center, and point is where the ball touches. groups: hit only particles
        of this group, or of these; None for all, () for none. skip: particles that the ray ignores, by indices, a mask or a
        handle. A link counts if both of its particles do. features: hit only these walls and these features' links, such as
        [floor]; None for all, () for none.

        A particle is a disc or sphere; a point (radius 0) is hit where a ray goes through it within rounding. A link is a rod
        with the smaller radius of its two ends, so that a rope is as thick as it looks. Between points a link is a line, which in
        3D only a ray with a radius can hit. Links are all features that pictures draw as lines and that are not broken, and the
        edges of Polygons, numbered from body to body. Walls are where they are at world.time: a pose assigned since then is
        reached in the next frame. Inactive walls are ignored. In a periodic box, particles are hit where they lie in the box;
        rays do not continue into the next image.

        A ray hits what it enters from outside. It does not hit the thing in which it starts, so a ray from the center of a
        particle needs no skip. A ray leaves the wall in which it starts, and hits walls where they would hold a particle. A ray
        that starts on a surface and goes inwards hits it at distance 0. At equal distances, particles come first, then links,
        then walls, in order.

        Raises ValueError or TypeError naming the first invalid value.
        """
        self._runner.memory.check()
        return ray(self, origin, direction, reach, radius, groups, skip, features)

    def inside(self, shape: Collider, part: str = "center") -> np.ndarray:
        """Return the particles inside a shape, in order, (m,).

        shape: a Box, Ball, Capsule, Polygon or Mesh: the region that it encloses, whether as a wall it keeps particles out or in;
        a HalfSpace: the region behind the plane; or an Sdf: where the function is negative. The shape need not act in the world;
        a shape that acts in a world is where it is at that world's time. part: the part of each particle that must be inside: the
        "center", the "whole" disc or sphere, or, with "touching", any part of it.
        """
        self._runner.memory.check()
        return inside(self, shape, part)

    @property
    def contacts(self) -> Contacts:
        """Present contacts of discs or spheres, and of vertices and edges of Polygons, as arrays. Empty without a Contact.

        Impulses are those of the last substep; events() has those of the frame.
        """
        self._runner.memory.check()
        if not self._runner.search:
            none, index = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
            vectors = np.zeros((0, self._particles.dim))
            return Contacts(index, index[:, 0], none, none, vectors, vectors, none, vectors)
        contact = self._runner.step.contacts[0]
        with deferred_signals:
            self._runner.list_neighbours()
            if self._runner.step.launched:
                self._runner.diagnose_state()  # measures contacts; on other paths list_neighbours() has called it
            return contact.found(self.position, self._clock.h or 1.0)

    def events(self, groups: Iterable | None = None) -> ContactEvents:
        """Return the contacts of particles that began, ended and lasted in the last step. Needs Contact(events=True) or sensors.

        groups: only contacts between these pairs of groups, such as [(0, 1)]; None for all. Events are those of one step: read
        them after each. Removing and adding particles keeps the events, with the present indices; a clone has none before its
        first step.

        Raises RuntimeError where nothing records events.
        """
        self._runner.memory.check()
        if not any(isinstance(f, PairContact) and f.has_events for f in self._features):
            raise RuntimeError("World.events: nothing tells of contacts. Write tv.Contact(events=True), or give it sensors.")
        return self._all_events()[0].among(groups)

    def wall_events(self) -> ContactEvents:
        """Return the contacts of particles with walls that began, ended and lasted in the last step, for walls with events=True.

        See events(). Pairs are a particle and the number of the wall in world.features.

        Raises RuntimeError where no wall records events.
        """
        self._runner.memory.check()
        if not any(isinstance(f, Collider) and f.events for f in self._features):
            raise RuntimeError("World.wall_events: no wall tells of them. Write, for one, tv.Box(lower, upper, events=True).")
        return self._all_events()[1]

    @in_turn
    def _all_events(self) -> Told:
        """Return the events of particles, and those of walls; no events where nothing records them."""
        if self._events is not None:
            return self._events
        h, time, step = self._clock.h or 1.0, self._clock.time, self._runner.step
        pairs = none = no_events(self._particles.dim)
        walls = []
        for contact in step.contacts:
            if contact.dev.events:
                pairs = contact.dev.events.read(self._particles.group, h, time)
        for number, f in enumerate(self._features):
            if isinstance(f, Collider) and f.dev.log:
                walls.append(f.dev.log.read(number, h, time))
        told = pairs, ContactEvents(joined([none.touches, *walls])) if walls else none
        return joined_events(told, self._ended)

    @property
    @in_turn
    def broken(self) -> list[tuple[Feature, np.ndarray]]:
        """What broke in the last frame: features, and the indices of their constraints. feature.broken has those of all
        frames."""
        self._runner.memory.check()
        out = []
        if self._last and self._last.broken:
            for f in self._runner.step.breakers:
                stamps = f.stamps()
                recent = (stamps > 0) & ((self._clock.tick - stamps) % BREAKS < self._last.substeps)
                if recent.any():
                    out.append((f, np.flatnonzero(recent)))
        return out

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._clock.time

    @property
    def last(self) -> StepReport | None:
        """The report of the last step; None before the first."""
        return self._last

    @property
    def particles(self) -> Particles:
        """The particles from which the world was built: initial state and structure."""
        return self._particles

    @property
    def features(self) -> tuple[Feature, ...]:
        """The features that act on the particles."""
        return self._features

    @property
    def precision(self) -> str:
        """The precision: "f32", "f32-compensated" or "f64"."""
        return self._precision

    @property
    def order(self) -> int:
        """The order of the error in the substep."""
        return self._order

    @property
    def path(self) -> str:
        """The path that runs: "fused" or "parallel"."""
        return self._runner.path

    @property
    def substeps(self) -> int:
        """Substeps of frames of the usual length, which others keep; with "auto", of the next frame. Assign a number, "auto", or
        None for the usual number."""
        if self._controller.auto:
            return max(self._controller.substeps, self._usual_substeps)
        return self._substeps or self._usual_substeps

    @substeps.setter
    def substeps(self, value: int | str | None) -> None:
        """Set the substeps from the next frame on: at least 1, "auto", or None."""
        if isinstance(value, str) and value != "auto":
            raise ValueError(f'World: substeps = {value!r}, but it must be an integer of at least 1, "auto" or None.')
        self._controller.auto = value == "auto"
        if not self._controller.auto:
            self._substeps = None if value is None else checks.integer("World", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in each substep."""
        return self._iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        """Set the iterations from the next frame on: at least 1, and a number that the solver allows."""
        value = checks.integer("World", "iterations", value, least=1)
        self._solver.check(value)
        self._iterations = value

    @property
    def fields(self) -> dict[str, int]:
        """The size of every field on the device [bytes], by name."""
        return {e.name: e.bytes * max(1, e.copies) for memory in self._runner.memories for e in memory.entries}

    def add(
        self,
        particles: Particles | Shape | None = None,
        features: Iterable[Feature] = (),
        *,
        extend: Mapping[Feature, Feature] | None = None,
    ) -> Handle:
        """Add particles and features, between frames. Returns a handle to the particles.

        particles: Particles, or a Shape as it is: particles of 1 kg with its radii, its links and braces rigid, its limits; in a
        world with Polygons its loops, if all particles are on them. They extend rigid features of the world.

        The handle is an array of their indices that stays right when others are removed: world.position[handle].
        The new particles come after the last. Features name all particles by their numbers, so a rope that is added to a world of
        n particles has the links shapes.rope(...).links + n. Rest values that are not given are taken from the present positions.
        Rigid constraints that these positions violate are satisfied before the next frame, without velocity; the frame has the
        flag "moved". Particles that overlap others separate gently, as at the beginning of a world.

        extend: a mapping from features of the world to others of their kind, whose constraints or bodies are appended:
        world.add(tv.Particles(more.position), extend={ropes: tv.Distance(more.links + n)}). It works for Polygons and for all
        constraints but Pin, Path, Constraint, and a ShapeMatch whose rest is given. Each feature has kernels to compile, but
        kernels do not depend on the number of constraints. So every rope that is added as a tv.Distance of its own takes seconds
        to compile; a rope that extends a Distance takes milliseconds.

        The rest of the world continues bit for bit: time, positions, velocities, multipliers, the history of springs, and the
        data of pairs in contact. Later frames of what is in contact differ by what passes leave: their number is one for all.
        Where a force or a spring is added, displacements are first turned into velocities, as when a force changes.
        On a CPU, an edit takes 2 to 4 ms in place, which needs kinds of constraints and bodies that the world has; otherwise 10
        ms. Nothing is compiled: the world keeps its kernels until they work on four times as many elements. But features, masses
        or radii of a kind that the world did not have, and the first particles that overlap others, are compiled once, as for a
        new world; all worlds share compiled kernels.

        Raises the errors of World(); the world is then unchanged.
        """
        with deferred_signals:
            return edit_scene.add(self, particles, features, extend)

    def remove(self, particles: Any = (), features: Iterable[Feature] = ()) -> None:
        """Remove particles and features, between frames.

        particles: a handle, indices or a Boolean mask. The remaining particles move up, in order. A constraint is removed with
        any of its particles, and so is a whole loop, surface, cluster or body of Polygons. Its feature stays, with the remaining
        constraints, as the same Python object; an empty feature costs nothing. features: features of world.features; they may be
        used in another world afterwards. To cut one link of many, make the links with break_at=np.inf, and assign an array that
        is 1e-30 at that link: it breaks in the next substep in which it has any load, of several that meet one after the other.

        Everything else continues bit for bit, see add(). The force of a removed constraint ends with the next substep, as when a
        constraint breaks. Functions of the user that take the number of a particle or constraint get the new number.

        Raises ValueError or TypeError for particles or features that do not exist; the world is then unchanged.
        """
        with deferred_signals:
            edit_scene.remove(self, particles, features)

    def handle(self, particles: Any) -> Handle:
        """Return a handle to some particles, by indices or a Boolean mask. It follows their numbers when others are removed."""
        self._runner.memory.check()
        return edit_scene.handle(self, edit_scene.chosen(self, "World.handle", particles))

    @property
    def settings(self) -> dict[str, Any]:
        """How the world is computed: substeps, iterations, solver, precision, path and order, as __init__ takes them."""
        out: dict[str, Any] = {"substeps": "auto" if self._controller.auto else self.substeps, "iterations": self.iterations}
        return out | {"solver": self._solver, "precision": self._precision, "path": self._runner.path, "order": self._order}

    def clone(self, **changes) -> "World":
        """Return the same scene in the same state, with other substeps, iterations, solver, precision, path or order.

        Handles stay with the world that returned them.
        """
        settings = self.settings
        if unknown := set(changes) - set(settings):
            raise TypeError(f"World.clone: {sorted(unknown)[0]} cannot be changed; one of {', '.join(settings)} can.")
        self._runner.memory.check()
        self._find_stiffened()
        self._rebuild_for_knobs()
        copies = tuple(f.copy_with_kernels() for f in self._features)
        new = World._from_starts(self._particles, copies, [f.start for f in self._features], **{**settings, **changes})
        checkpoint.transfer(self, new)
        new._runner.pass_on(self._runner.left, np.ones(len(self._particles), dtype=bool))
        new._ending = self._ending
        return new

    def report(self, seconds: float, tolerance: float | None = None, **options):
        """Measure error against run time of this scene from its present state; returns a SceneReport with the cheapest settings.

        The report shows the settings ready to paste. seconds [s]: length of the measured motion. tolerance: error at the end [m],
        by default a thousandth of the motion. options: dt [s] of a frame; substeps: those to try; progress: show a bar. Clones
        run; this world does not change. Knobs keep their present values. There is no known answer: the reference is the finest
        run, and its own error is estimated and reported.
        """
        from .report.accuracy.scene import scene_report

        return scene_report(self, seconds, tolerance, **options)

    def save(self, path: str | os.PathLike, overwrite: bool = True) -> None:
        """Write the scene and its exact state to a file that tv.load(path) reads: it continues bit for bit.

        The file is a recording of one frame, see Recorder; its name ends with .rrd. overwrite: whether an existing recording may
        be replaced. Raises ValueError for another file of this name, and the errors of Recorder.
        """
        from .recording import Recorder
        from .recording.sink import check_replaceable

        check_replaceable(path)
        Recorder(path, self, overwrite=overwrite).close()

    def close(self) -> None:
        """Free the memory on the device. Using the world afterwards raises RuntimeError."""
        for memory in self._runner.memories:
            memory.destroy()
        for feature in self._features:
            feature.scene, feature.compiled_so_far = None, frozenset()

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __setattr__(self, name: str, value) -> None:
        if not name.startswith("_") and name not in LIVE:
            guess = "." if hasattr(self, name) else suggest(name, ["World"], LIVE)
            if "world.particles" in guess:  # where to read it
                guess = "; make tv.Particles for a new world."
            raise AttributeError(
                f"World.{name} cannot be set{guess} Live are {', '.join(LIVE[:-1])} and {LIVE[-1]}, and the knobs of the "
                "features; everything else is structure, fixed when the world is built."
            )
        object.__setattr__(self, name, value)

    def __reduce_ex__(self, protocol):
        raise TypeError(
            "A World holds compiled kernels and memory of the device, so it cannot be copied or pickled. Use world.clone(), or "
            'write it to a file: world.save("world.rrd"), and read it back: tv.load("world.rrd").'
        )

    def _repr_html_(self) -> str:
        from .recording.markup import of_world

        return of_world(self)

    def __repr__(self) -> str:
        names = ", ".join(map(repr, self._features))
        return f"World({self._particles!r}, [{names}], substeps={self.substeps}, iterations={self.iterations})"
