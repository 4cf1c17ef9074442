"""The world: a scene, and its step."""

import os
import weakref
from collections.abc import Iterable, Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from . import checks
from .colliders.collider import Collider
from .constraints.core.strength import BREAKS
from .contact.initial_overlap import overlapping
from .contact.pair_contact import PairContact
from .contact.rays import Hits, inside, ray
from .contact.touches import ContactEvents, joined, no_events
from .device.copies import Copies
from .device.interrupts import whole
from .features.arguments import meant
from .features.feature import Acceleration, Batch, Feature
from .features.read_only import assign_whole, read_only, structure
from .neighbours.queries import Contacts, PointSearch, near_by_all, nearest
from .particles import Particles, at_rest, in_range, spin_of
from .solvers.jacobi import Jacobi
from .solvers.solver import Solver
from .step import checkpoint, edit_scene, energy_bound, impulse
from .step.adaptive import StepController
from .step.build import Assembly, assemble, check_settings, checked_features, checked_solver
from .step.build_again import Rebuild
from .step.clock import CHANGED, Clock
from .step.diagnostics import KINETIC
from .step.edit_scene import Handle
from .step.explain import compiling, explain
from .step.runner import Runner
from .step.scale import Scale
from .step.step_report import StepReport

LIVE = ("position", "velocity", "spin", "substeps", "iterations")


class World:
    """Particles and what acts on them.

    particles: Particles. features: what acts, in any order; at most one Contact. What is not in the list costs nothing.
    substeps: substeps of a frame, or "auto" for as many as it needs (see StepController). iterations: passes over the constraints
    in each. Both may change at any time, at no compile cost.
    solver: how constraints are solved: Direct for chains, trees and loops, Jacobi, Chebyshev or ConjugateGradient for cloth. None
    takes ConjugateGradient(5) where elimination would leave many stiff links to Jacobi, such as those of cloth; else Direct for
    what hangs together like chains or beams; else Jacobi. explain() says what was chosen, and why.
    precision: "f32" (position and displacement; the digits of a coordinate end at 6e-8 of it, 1 mm at 10 km and 6 cm at 1000 km),
    "f32-compensated" (the position carries a low word, which keeps 1e-4 m at any of these), "f64". Where constraints are solved
    to rounding, positions and displacements of f32 carry what rounding takes from them: shorter substeps never make it worse.
    path: "auto", "fused" (one launch per frame, one thread) or "parallel" (one launch, a team of CPU threads; several launches on
    a GPU); the bits are the same.
    order: of the error in the substep: 2, or 4, 6 or 8 in f64 for motion without contacts, walls, damping and limits, where
    every rigid constraint is solved directly. A substep is then made of 5, 9 or 15 stages, see high_order.py.

    Raises ValueError or TypeError, naming the argument, the index and the value, before anything is compiled.
    """

    _copies: Copies | None = None

    def __init__(
        self, particles: Particles, features: Iterable[Feature] = (), *, substeps: int | str = 20, iterations: int = 1,
        solver: Solver | None = None, precision: str = "f32", path: str = "auto", order: int = 2,
    ):  # fmt: skip
        if not isinstance(particles, Particles):
            raise TypeError(f"World: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        features = checked_features(features)
        starts = [None] * len(features)
        self._build(particles, features, starts, substeps, iterations, solver, precision, path, order)
        for contact in self._runner.step.contacts:
            scene, batches = self._runner.scene, self._runner.batches
            if not contact.shrinks and overlapping(scene, batches, contact.table, particles.position):
                contact.enable_shrink()  # before anything is compiled: later, the frame would be compiled again

    @staticmethod
    def _of(
        particles: Particles, features: tuple[Feature, ...], starts: Sequence[Particles | None], copies: Copies | None = None,
        **settings,
    ) -> "World":  # fmt: skip
        """A world of features that came at different times, see _build(). copies: where it stands for many."""
        new = object.__new__(World)
        new._copies = copies
        new._build(particles, features, starts, **settings)
        return new

    def _build(self, particles, features, starts, substeps, iterations, solver, precision, path, order) -> None:
        """starts: for each feature the particles as they were when it came; None if it comes now."""
        check_settings(precision, path, order, features)
        self._requested = checked_solver(solver), path  # None where the solver is to be chosen
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
        self._watchers: list[Any] = []  # recorders: told of what the user assigns, and before and after every step
        self._undo: tuple | None = None  # the state before a step that takes long, and flags of features
        self._events: tuple[ContactEvents, ContactEvents] | None = None  # of the last frame, where the device has them no more

    @property
    def _build_options(self) -> tuple[Solver | None, str, str, int, Scale]:
        """What assemble() takes. A solver that was chosen for constraints that there are stays."""
        solver = self._requested[0] or (self._solver if self._runner.batches else None)
        return solver, self._precision, self._requested[1], self._order, self._scale

    def _install(self, particles: Particles, features: tuple[Feature, ...], parts: Assembly) -> None:
        """Take these for the parts of the world."""
        self._particles, self._features = particles, features
        self._runner, self._solver, self._scale = Runner(parts, self._clock), parts.solver, parts.scale
        self._search: PointSearch | None = None  # compiled when it is first asked
        parts.scene.residuals = self._runner.residuals

    def _rebuild(
        self, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...], extend: Mapping[Feature, Feature]
    ) -> Rebuild:
        """How it is to be built anew, of other particles and features."""
        return Rebuild(self, some, added, features, extend)

    # The step.

    def step(self, dt: float, tolerance: float | None = None, budget: float | None = None) -> StepReport:
        """Advance by dt [s], and say how it went.

        Without tolerance and budget the frame has `substeps` substeps; with substeps="auto", as many as it needs to be stable.
        tolerance: of the residual and the overlap, both relative, of phi^2 / 24 for the angle phi by which rigid constraints, and
        beads on smooth curves, turn in a substep, of (omega h)^2 / 24 in forces that differ from place to place, and of about
        (omega h)^2 A / 12 where springs vibrate by a part A of their size; the frame is made again with more substeps until they
        are met. It knows nothing of the errors of impacts, of what slides along curved walls or others, and of soft clusters.
        budget: seconds of computing that the frame may take; alone, it is spent for as many substeps as fit. The report says how
        many substeps there were, and has a flag when the aim was missed. Results of a budget depend on the speed of the machine.

        Raises ValueError for dt, tolerance or budget that is not finite and above 0. With another substep length than before,
        displacements are turned into velocities first and back after (time-corrected Verlet), so the step stays second order. But
        piles that stand by friction creep where frames differ: keep to one dt, and take as many steps of it as a clock asks for.
        A signal such as Ctrl-C is handled after the frame. One that takes seconds is undone at once if the handler raises.
        """
        self._runner.memory.check()
        dt = checks.number("World.step", "dt", dt, above=0.0)
        with whole:
            for watcher in self._watchers:
                watcher.before()
            clock = perf_counter()
            try:
                guarded = self._controller.auto or tolerance is not None or budget is not None
                if guarded or self._substeps * self._iterations > self._runner.passes_at_once:
                    self._undo = checkpoint.keep(self), checkpoint.flags(self)
                self._upload_parameters()
                self._runner.interruptible = self._undo is not None
                if guarded:
                    with self._runner.memory.compiler():
                        report = self._controller.advance(self, dt, tolerance, budget)
                else:
                    self._runner.begin(dt, self._substeps, self._iterations)
                    report = self._runner.advance(dt, self._substeps, self._iterations)
            except BaseException:
                self._broken_off()
                raise
            self._runner.arrive()
            if self._clock.exceeds(report.energy, self._runner.sheet.item(KINETIC), report.overlap):
                report = energy_bound.checked(self, report)
            report.__dict__["seconds"] = perf_counter() - clock  # which is no part of what it says
            self._last, self._clock.energy, self._undo, self._events = report, report.energy, None, None
            for watcher in self._watchers:
                watcher.after(dt, report)
        return report

    def _broken_off(self) -> None:
        """A step ended with an exception: undo it, or tell recorders that no step leads to this state."""
        undo, self._undo, self._events = self._undo, None, (none := no_events(self._particles.dim), none)
        if undo:
            checkpoint.undo(self, *undo)
            return
        for watcher in self._watchers:
            watcher.broken_off()

    def _upload_parameters(self) -> None:
        """Bring the knobs to the device. Where a force has changed, displacements become velocities first, by the old force."""
        waiting = [f for f in self._features if f.changed or f.moving]
        if waiting:
            self._clock.bound = CHANGED
            if self._runner.sleep and not all(isinstance(f, Batch) and f.drives for f in waiting):
                self._runner.wake()
            self._adapt(steps=True)
            self._upload()

    @property
    def _force_waits(self) -> bool:
        """Whether a force has changed and the device still has the old one."""
        return any(f.changed and (f.new_force or isinstance(f, Acceleration)) for f in self._features)

    def _settle_forces(self, steps: bool) -> None:
        """Where a force has changed, turn displacements into velocities by the old one, before it is overwritten, or left behind
        by a copy. steps: see _adapt()."""
        changed = [f for f in self._features if f.changed]
        if any(f.lets_go for f in changed):
            if not steps:
                self._runner.note_displacements()
            self._let_go()
        elif any(f.new_force or isinstance(f, Acceleration) for f in changed):
            with self._runner.memory.compiler():
                (self._runner.restart if steps else self._runner.restart_between)(self._iterations)

    def _let_go(self) -> None:
        """Start from the velocities of now, to which what is about to go has given its part."""
        if not self._clock.d_is_velocity:
            self._start_from(self.velocity)

    def _start_from(self, velocity: np.ndarray) -> None:
        with self._runner.memory.compiler():
            self._runner.start(velocity)
        self._clock.energy = None

    def _adapt(self, steps: bool = False) -> None:
        """Settle forces; where knobs ask for what the kernels do not have, build the world anew. steps: a frame comes next,
        before which nobody asks for residuals of the last one."""
        self._settle_forces(steps)
        if any(f.outgrown for f in self._features if f.changed):
            edit_scene.renew(self)

    def _upload(self) -> None:
        """Write what was changed in Python since the last frame."""
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
        """Step for `seconds` [s], to the nearest whole number of frames of dt [s] and at least one; returns the worst figures of
        all frames.

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
        return checkpoint.digest(self, checkpoint.keep(self))

    def explain(self) -> str:
        """What was compiled and what was left out, with fields, bytes and launches, and how long compiling took."""
        return "\n".join([explain(self), *compiling(self)])

    # State.

    @property
    def position(self) -> np.ndarray:
        """Positions [m], (n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        return read_only(self._runner.scene.state.get(self._runner.memory), assign_whole("World", "position"))

    @position.setter
    def position(self, value) -> None:
        """Move particles to (n, dim) [m]; velocities are kept, and lists are built anew."""
        value = checks.points("World", "position", value, dim=self._particles.dim, count=len(self._particles))
        in_range("World", "position", value)
        if self._runner.step.contacts:
            self._runner.step.contacts[0].check_range(value)
        self._runner.memory.check()
        with whole:
            for watcher in self._watchers:
                watcher.assigned("position", value)
            self._runner.place(value, self._iterations)
            self._runner.invalidate()

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (n, dim), a read-only copy in f64; of the order of the world.

        Assign an array to set them, as an impulse to those whose velocity it changes; others go on to the bit, also where these
        leave what they lean on, or rub another way. But where what hangs on a taut rope is sent off, and in orders above 2, all
        start from these velocities. To write back what was read changes nothing.
        """
        out = self._clock.parted
        if out is None:
            self._runner.memory.check()
            with whole, self._runner.memory.compiler():
                out = self._runner.velocity(self._iterations)
        return read_only(out.copy(), assign_whole("World", "velocity"))

    @velocity.setter
    def velocity(self, value) -> None:
        """Have particles go on with (n, dim) [m/s]."""
        value = checks.points("World", "velocity", value, dim=self._particles.dim, count=len(self._particles))
        self._runner.memory.check()
        with whole:
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
            return read_only(at_rest("spin", self._particles), assign_whole("World", "spin"))
        self._runner.memory.check()
        with whole, self._runner.memory.compiler():
            return read_only(state.spin.to_rates(self._runner.spin()), assign_whole("World", "spin"))

    @spin.setter
    def spin(self, value) -> None:
        """Have particles turn at (n,) in 2D, (n, 3) in 3D [rad/s]. ValueError where they do not spin."""
        if not self._particles.spins:
            raise ValueError("World.spin: these particles do not spin. Make them with tv.Particles(..., spin=0).")
        value = spin_of("World", value, self._particles)
        self._runner.memory.check()
        with whole:
            for watcher in self._watchers:
                watcher.assigned("spin", value)
            runner, clock, spin = self._runner, self._clock, self._runner.scene.state.spin
            with runner.memory.compiler():
                has = runner.spin()
            others = (value != spin.to_rates(has)).reshape(len(value), -1).any(axis=1)
            change = np.where(others[:, None], spin.from_rates(value) - has, 0.0)
            if not change.any():
                return
            if impulse.rubs(runner) or runner.probe:  # friction becomes another one
                seen = self.velocity
                if not impulse.steer(runner, seen, seen, change, self._iterations, has):
                    self._let_go()
            runner.wake(np.flatnonzero(others))
            s = runner.memory.read(spin.s)[: runner.n]
            runner.memory.write(spin.s, has + change if clock.d_is_velocity else s + clock.h * change)
            clock.energy = None

    @property
    def orientation(self) -> np.ndarray:
        """How far particles are turned, a read-only copy: angles (n,) in 2D [rad], unit quaternions (n, 4) (x, y, z, w) in 3D."""
        if self._particles.orientation is None:
            raise ValueError("World.orientation: nobody keeps track of it. Make particles with tv.Particles(..., orientation=0).")
        turned = self._runner.memory.read(self._runner.scene.state.spin.orientation)[: len(self._particles)]
        return read_only(turned[:, 0] if self._particles.dim == 2 else turned, structure("World", "orientation"))

    def near(self, points, radius) -> np.ndarray:
        """The particles whose centers are within `radius` [m] of points: (m, 2), rows of `points` and particles, in order.

        points: (k, dim) [m]. radius: number or (k,), at least 0. With a Contact in the world its grid is used; without, all are
        compared. In a periodic box the nearest image of each particle counts.
        """
        points = checks.points("World.near", "points", points, dim=self._particles.dim)
        radius = checks.per_item("World.near", "radius", radius, len(points), least=0.0)
        self._runner.memory.check()
        if not len(points) or not len(self._particles):
            return np.zeros((0, 2), dtype=np.int64)
        box = self._runner.scene.periodic
        points = points if box is None else box.wrap(points)
        if not self._runner.search:
            return near_by_all(self.position, points, radius, box)
        with whole:
            self._runner.list_neighbours()
            with self._runner.memory.compiler():
                self._search = self._search or PointSearch(self._runner.search)
                return self._search.near(points, radius)

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Index of, and distance [m] to, the particle whose center is nearest to each point; of equally near ones the first."""
        points = checks.points("World.nearest", "points", points, dim=self._particles.dim)
        if not len(self._particles):
            raise ValueError("World.nearest: there are no particles.")
        position, search = self.position, self._runner.search
        start = search.finest if search else 2 * float(np.abs(position).max() + np.abs(points).max(initial=1.0))
        return nearest(self.near, position, points, start, self._runner.scene.periodic)

    def ray(
        self, origin, direction, reach=np.inf, *, radius: float = 0.0, groups=None, skip=(), features: Iterable[Feature] | None =
        None,
    ) -> Hits:  # fmt: skip
        """What rays meet first: a particle, a link between two particles, or a wall; see Hits.

        origin, direction: (dim,) or (k, dim) [m], as many of both or one for all; a direction has any length above 0. reach:
        number or (k,) [m], how far a ray goes. radius: [m] of a ball that is cast instead of a line, to see whether it gets
        through; then distance is the way of its center, and point is where it touches. groups: particles of this group, or of
        these, count; None for all, () for none. skip: particles that are not there for the ray, by indices, a mask or a handle.
        Links count where both of their particles do. features: walls, and what has links, that count, such as [floor]; None for
        all, () for none.

        A particle is its disc or sphere; a point (radius 0) is met where a ray goes through it within rounding. A link is a rod
        with the smaller of the radii of its ends, so that a rope is as thick as it looks; between points it is a line, which in
        3D no ray meets without a radius. Links are all that pictures draw as lines and that are not broken, and the edges of
        Polygons, numbered from body to body. Walls are where they are at world.time: a place that was assigned since is where
        they go in the next frame. Those that are not active are not there. In a periodic box, particles are met where they are in
        it; rays do not go on in the next one.

        A ray meets what it comes into from outside. It does not meet what it starts in, so one from the center of a particle
        needs no skip; walls let out what is in them, and are met where they would hold a particle. A ray that starts on a
        surface and goes in meets it at 0. Of what is met at the same distance, particles come first, then links, then walls, in
        order.

        Raises ValueError or TypeError naming the first value that makes no sense.
        """
        self._runner.memory.check()
        return ray(self, origin, direction, reach, radius, groups, skip, features)

    def inside(self, shape: Collider, part: str = "center") -> np.ndarray:
        """The particles that are inside of a shape, in order, (m,).

        shape: a Box, Ball, Capsule, Polygon or Mesh, which need not act in the world: what it encloses, whether as a wall it
        keeps particles out or in; a HalfSpace, behind the plane; or an Sdf, where the function is negative. One that acts in a
        world is where it is at that world's time. part: what has to be inside: the "center", the "whole" disc or sphere, or any
        part of it, "touching".
        """
        self._runner.memory.check()
        return inside(self, shape, part)

    @property
    def contacts(self) -> Contacts:
        """What touches now, as arrays: discs or spheres, and vertices and edges of Polygons; with impulses of the last substep,
        where events() has those of the frame. Empty without a Contact."""
        self._runner.memory.check()
        if not self._runner.search:
            none, index = np.zeros(0), np.zeros((0, 2), dtype=np.int64)
            vectors = np.zeros((0, self._particles.dim))
            return Contacts(index, index[:, 0], none, none, vectors, vectors, none)
        contact = self._runner.step.contacts[0]
        with whole:
            self._runner.list_neighbours()
            if contact.detects and self._runner.step.launched:
                self._runner.look()  # which measures; elsewhere it makes the list, too
        return contact.found(self.position, self._clock.h or 1.0)

    def events(self, groups: Iterable | None = None) -> ContactEvents:
        """Which contacts of particles began, ended and went on in the last step, with a Contact(events=True) or with sensors.

        groups: only those between these pairs of groups, such as [(0, 1)]; None for all. They are those of one step: ask after
        each. Removing and adding particles keeps them, with the present indices; a clone has none before its first step.

        Raises RuntimeError where nothing tells of events.
        """
        self._runner.memory.check()
        if not any(isinstance(f, PairContact) and f.has_events for f in self._features):
            raise RuntimeError("World.events: nothing tells of contacts. Write tv.Contact(events=True), or give it sensors.")
        return self._all_events()[0].among(self._particles.group, groups)

    def wall_events(self) -> ContactEvents:
        """Which particles met, left and went on touching walls in the last step, of those with events=True: see events(). Pairs
        are a particle and the number of the wall in world.features.

        Raises RuntimeError where no wall tells of events.
        """
        self._runner.memory.check()
        if not any(isinstance(f, Collider) and f.events for f in self._features):
            raise RuntimeError("World.wall_events: no wall tells of them. Write, for one, tv.Box(lower, upper, events=True).")
        return self._all_events()[1]

    def _all_events(self) -> tuple[ContactEvents, ContactEvents]:
        """Those of particles, and of walls; none where nothing tells of them."""
        if self._events is not None:
            return self._events
        h, time, step = self._clock.h or 1.0, self._clock.time, self._runner.step
        pairs = none = no_events(self._particles.dim)
        walls = []
        for contact in step.contacts:
            if contact.dev.events:
                pairs = contact.dev.events.read(h, time)
        for number, f in enumerate(self._features):
            if isinstance(f, Collider) and f.dev.log:
                walls.append(f.dev.log.read(number, h, time))
        return pairs, ContactEvents(joined([none.touches, *walls])) if walls else none

    @property
    def broken(self) -> list[tuple[Feature, np.ndarray]]:
        """What broke in the last frame: features, and the indices of their constraints. Those of all frames: feature.broken."""
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
    def order(self) -> int:
        """Of the error in the substep."""
        return self._order

    @property
    def path(self) -> str:
        """ "fused" or "parallel"."""
        return self._runner.path

    @property
    def substeps(self) -> int:
        """Substeps of a frame; of the next one where they are chosen. Assign a number, or "auto"."""
        return self._controller.substeps if self._controller.auto else self._substeps

    @substeps.setter
    def substeps(self, value: int | str) -> None:
        """At least 1, or "auto", from the next frame on."""
        if isinstance(value, str) and value != "auto":
            raise ValueError(f'World: substeps = {value!r}, but it must be an integer of at least 1, or "auto".')
        self._controller.auto = value == "auto"
        if not self._controller.auto:
            self._substeps = checks.integer("World", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in a substep."""
        return self._iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        """At least 1, and what the solver allows, from the next frame on."""
        value = checks.integer("World", "iterations", value, least=1)
        self._solver.check(value)
        self._iterations = value

    @property
    def fields(self) -> dict[str, int]:
        """Every field on the device, by name, and its size [bytes]."""
        return {e.name: e.bytes for memory in self._runner.memories for e in memory.entries}

    def add(
        self,
        particles: Particles | None = None,
        features: Iterable[Feature] = (),
        *,
        extend: Mapping[Feature, Feature] | None = None,
    ) -> Handle:
        """Add particles and features, between frames. Returns a handle to the particles, see Handle.

        The new particles come after the last; features name all of them by their numbers, so a rope that is added on top of n
        particles has the links shapes.rope(...).links + n. Rest values that are not given are taken from the present positions.
        Rigid constraints that are not met there are met before the next frame, without velocity; it has the flag "moved".
        Particles that overlap others part gently, as at the start.

        extend: features of the world, and others of their kind, whose constraints or bodies they take behind their own:
        world.add(tv.Particles(more.position), extend={ropes: tv.Distance(more.links + n)}). All constraints take more but Pin,
        Path, Constraint, and a ShapeMatch whose rest is given; and so does Polygons. Each feature has kernels to compile,
        but no kernel knows how many constraints there are: the first rope that comes as a tv.Distance of its own takes seconds,
        and so does the next one; those that a Distance is extended by take milliseconds.

        What was there goes on to the bit: time, positions, velocities, multipliers, the history of springs, what pairs in contact
        remember. Where a force or a spring is added, displacements are first turned into velocities, as when a force changes.
        On a CPU it takes two to four milliseconds where particles, constraints and bodies of kinds that are there come in place,
        and ten else. Nothing is compiled: the world keeps its kernels until there are four times as many of what they work on.
        Features, masses or radii of a kind that it did not have, and the first particles that overlap others, cost the compiling
        that a new world costs, once; all worlds share what was compiled.

        Raises as World() does; the world is then as before.
        """
        with whole:
            return edit_scene.add(self, particles, features, extend)

    def remove(self, particles: Any = (), features: Iterable[Feature] = ()) -> None:
        """Remove particles and features, between frames.

        particles: a handle, indices or a Boolean mask. The others close up, in order. A constraint goes with any of its
        particles, and so do a loop, a surface, a cluster or a body of Polygons, whole; what it was part of stays, with what is
        left, in the same Python object, and costs nothing once it is empty. features: of world.features; they become free.
        One link of many is cut by its strength: make them with break_at=np.inf, and assign an array that is 1e-30 at that link,
        which breaks in the next substep in which it bears anything.

        What stays goes on to the bit, see add(). A force that goes with a particle is gone from the next substep on, as when a
        constraint breaks. Functions of the user's own that take the number of a particle or constraint get the new one.

        Raises ValueError or TypeError for what there is not; the world is then as before.
        """
        with whole:
            edit_scene.remove(self, particles, features)

    def handle(self, particles: Any) -> Handle:
        """A handle to some particles, by indices or a Boolean mask; it knows their numbers when others are removed."""
        self._runner.memory.check()
        return edit_scene.handle(self, edit_scene.chosen(self, "World.handle", particles))

    @property
    def settings(self) -> dict[str, Any]:
        """How it is computed: substeps, iterations, solver, precision, path and order, as __init__ takes them."""
        out: dict[str, Any] = {"substeps": "auto" if self._controller.auto else self.substeps, "iterations": self.iterations}
        return out | {"solver": self._solver, "precision": self._precision, "path": self._runner.path, "order": self._order}

    def clone(self, **changes) -> "World":
        """The same scene in the same state, with other substeps, iterations, solver, precision, path or order.

        Handles stay with the world that gave them.
        """
        settings = self.settings
        if unknown := set(changes) - set(settings):
            raise TypeError(f"World.clone: {sorted(unknown)[0]} cannot be changed; one of {', '.join(settings)} can.")
        self._runner.memory.check()
        self._adapt()
        copies = tuple(f.twin() for f in self._features)
        new = World._of(self._particles, copies, [f.start for f in self._features], **{**settings, **changes})
        checkpoint.transfer(self, new)
        new._runner.pass_on(self._runner.left, np.ones(len(self._particles), dtype=bool))
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
        for memory in self._runner.memories:
            memory.destroy()
        for feature in self._features:
            feature.scene, feature.once = None, frozenset()

    def __enter__(self) -> "World":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __setattr__(self, name: str, value) -> None:
        if not name.startswith("_") and name not in LIVE:
            guess = "" if hasattr(self, name) else meant(name, LIVE)
            raise AttributeError(
                f"World.{name} cannot be set{guess}. Live are {', '.join(LIVE[:-1])} and {LIVE[-1]}, and the knobs of the "
                "features; everything else is structure, fixed when the world is built."
            )
        object.__setattr__(self, name, value)

    def __reduce_ex__(self, protocol):
        raise TypeError(
            "A World holds compiled kernels and memory of the device, so it cannot be copied or pickled. Use world.clone(), or "
            "write it to a file with tv.Recorder(path, world) and read it back with tv.replay(path).world()."
        )

    def _repr_html_(self) -> str:
        from .recording.markup import of_world

        return of_world(self)

    def __repr__(self) -> str:
        names = ", ".join(map(repr, self._features))
        return f"World({self._particles!r}, [{names}], substeps={self.substeps}, iterations={self.iterations})"
