"""How frames are run on the device: in one launch, which resumes after lists have grown and kernels were made for them."""

import copy
import functools
from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..constraints.path import Path
from ..constraints.pin import Pin
from ..device.interrupts import deferred_signals
from ..device.memory import Rows, numbers_of
from ..device.patches.compiler import CachedLaunch
from ..particles.spin import moments_of_inertia
from . import high_order, settling, softness, violations
from .clock import Clock, initial_margin, is_as_long
from .diagnostics import BARE, EXTENT, STARTED, STEPPED, UNSTEPPED
from .frames import Frames
from .impulse import factor_of
from .integrator import FREE, decay, h2_effective_of, h2_rigid_of, shares_of
from .launcher import Launcher
from .span import ACTIVE_THREADS, BEFORE, END, ENDLESS, GIVE, HALT, LISTS, MOST, ORIGIN, H, Span
from .step import frame
from .step_report import StepReport

NONE = np.zeros(0, dtype=np.int64)
KEPT = 100_000  # particles up to which the array for velocities is kept; above, allocating it costs next to nothing
LONG = 10_000_000  # (particles + constraints) x passes in one launch at most: it takes about a second


@functools.lru_cache(16)  # read several times between two frames
def _shares(h: float, started: bool, lacked: float, drag: tuple[float, ...]) -> tuple[float, float]:
    firm, soft = shares_of(h, started, lacked, np.array(drag))
    return float(firm), float(soft)


class Runner:
    """Advances the parts of a world frame by frame.

    A frame is one launch, resumed if the neighbour list had to grow, or some launches for each substep, see Launcher.
    """

    def __init__(self, parts: Any, clock: Clock):
        self.memory, self.scene, self.batches, self.search = parts.memory, parts.scene, parts.batches, parts.search
        self.step, self.diagnostics, self.path, self.solver = parts.step, parts.diagnostics, parts.path, parts.solver
        self.frames: Frames | None = parts.frames
        self.clock = clock
        self.left: np.ndarray | None = None  # displacements of the last substep, if they became velocities between frames
        self.moved = 0.0  # the longest move of a particle to meet its constraints before the coming frame [m]
        self.jumped = False  # whether any such move was longer than the radius of its particle
        self.sleepers, self.sleep = parts.scene.state.sleepers, parts.step.sleep
        self.released = 0.0  # the violation that a shorter substep would turn into energy, relative to the constraint's size
        self.ramping: list[Any] = []  # batches whose rest values change in the coming frame
        self.ramps: list[Any] = []  # the memories of ramps
        self.structure: Any = None  # a digest of all that kernels can read of constraints, once computed
        self.interruptible = False  # whether a frame is undone if a signal handler raises in the middle of it
        # Copied here because every frame reads them, and Taichi checks each attribute read of an object with kernels.
        step = self.step
        self.n, self.launched, self.team, self.integrator = step.n, step.launched, step.team, step.integrator
        self.driven = [b for b in self.batches if b.driven]
        self.springs: list[Any] = [b for b in self.batches if isinstance(b, Scalar) and b.soft and not b.dev.equation.forces]
        self.paths = [f for f in step.drivers if isinstance(f, Path)]
        self.logs: list[Any] = [*(c.dev.events for c in step.contacts if c.dev.events), *step.wall_logs]  # of events
        self.semi_iterations, self.drags = step.constraints.semi_iterations, step.integrator.forces.drags
        self._immovable: int | None = None
        self.probe = high_order.Probe(step) if self.scene.order > 2 else None
        self.passes_at_once = self._passes_at_once()
        self.asks_velocities = any(wall.has_switch for wall in step.walls)
        self.asks_release = any(isinstance(f, Pin) for f in step.drivers)
        self.bounces = any(f.has_restitution for f in (*step.walls, *step.contacts))
        self.solves_rows = bool(step.contacts)
        self.launcher = Launcher(self)
        self._prepare()

    def _prepare(self) -> None:
        """Make the launches of every frame."""
        self.sheet = self.diagnostics.sheet
        if self.sleep:
            self.sleep = self.step.sleep = self.sleep.of(self.step)
            self._settle = CachedLaunch(self.sleep, "settle", self.memory.compiler, self.sleep.sheet)
        self._fused = CachedLaunch(self.step, "fused", self.memory.compiler, self.sheet)
        if self.frames:
            self.frames = self.frames.of(self.step)
            self._fused = self.frames.launch_one(self.sheet)
        self._measure = CachedLaunch(self.diagnostics, "measure", self.memory.compiler, self.sheet)
        self._velocity: CachedLaunch | None = None  # made when velocities are first read
        self._spin: CachedLaunch | None = None  # made when spins are first read
        self._release: CachedLaunch | None = None  # made when a Pin first lets particles go
        self._turned = np.zeros(4)
        self._to_velocity = CachedLaunch(self.step, "to_velocity", self.memory.compiler, self._turned)
        self._data, self._given, self._reporter = self.sheet.data, self.sheet.data[H:], self.diagnostics.report

    def renew(self) -> None:
        """Make kernels that include a new field. Taichi compiles kernels for each Step, so the Step is copied."""
        self.step = copy.copy(self.step)
        self.diagnostics = self.diagnostics.of(self.step)
        self._prepare()

    def _passes_at_once(self) -> int:
        """The largest number of passes over the constraints in one launch."""
        return max(1, LONG // (1 + self.n + sum(b.count for b in self.batches)))

    def regroup(self) -> None:
        """Take the new number of particles, after the parts were edited in place."""
        self.n, self._immovable = self.step.n, None
        self.passes_at_once = self._passes_at_once()
        self.diagnostics.report.regroup()
        if self.sleep:
            self.sleep.regroup()

    @property
    def immovable(self) -> int:
        """How many particles cannot move; pins that take others change nothing of that."""
        if self._immovable is None:
            out = self._immovable = self.n - int(np.count_nonzero(self.scene.inv_mass))
            return out
        return self._immovable

    # Frames.

    def begin(self, dt: float, substeps: int, iterations: int, passes: int | None = None) -> None:
        """Prepare a frame of dt [s]. If the substep has another length than the last one, displacements become velocities, and
        the frame is a start."""
        if self.prepare(dt, substeps, iterations, passes):
            clock, placed = self.clock, self.clock.first_moved is not None
            if clock.energy is None:
                clock.forget_bound()
                self.diagnose_state(bare=not placed)
                if self.sleep:
                    with self.memory.compiler():
                        self.sleep.compile(clock)
                if self.asks_velocities:  # compile the kernel now; switching a wall off will need it
                    self._velocities()
                    self.asks_velocities = False
                if self.asks_release:
                    self._compile_release()
                    self.asks_release = False
                if placed:
                    report = self.report()
                    if not clock.tick:
                        extent = self._data[EXTENT : EXTENT + self.step.dim]
                        clock.begin_with(report.energy, initial_margin(self.scene.inv_mass, extent, clock.h))
                    self.set_initial_figures(report.energy, report.overlap)
                else:
                    clock.energy = float(self._data[0])
            self.placed()

    def prepare(self, dt: float, substeps: int, iterations: int, passes: int | None = None) -> bool:
        """The first half of begin(). Returns whether the second half is needed: the state has changed and must be diagnosed."""
        adapts, passes = passes is not None, passes or iterations
        h, clock, self.released, self.jumped = self.length(dt, substeps), self.clock, 0.0, False
        drag = self._drag(h)
        if h == clock.h and drag == clock.drag and not clock.d_is_velocity and clock.first_moved is None:
            if max(clock.softness, clock.part_softness) > 1 or passes != clock.iterations:
                with self.memory.compiler():
                    softness.keep(self, h, dt, passes, adapts)
            return clock.energy is None
        keeps = self.solves_rows and clock.first_moved != 0
        asleep = self._sleeping() if keeps and not clock.d_is_velocity and clock.first_moved is None else None
        if asleep is None:
            self.wake()
        with self.memory.compiler():
            self._jump()
            if h != clock.h or drag != clock.drag:
                softens = softness.acts(self, h, passes) and not self.springs  # springs have a start of their own
                self.restart(iterations, h if softens else None)
            self.moved, first = 0.0, clock.first_moved if self.scene.slots else None
            if first is not None:
                for b in self.driven:
                    b.start_at(self.scene.state.get(self.memory), first)
                self._note_moved(settling.settle(self, first, h, dt))  # before what is violated passes for what passes have left
            if h != clock.h or drag != clock.drag:
                if self.scene.slots and self.scene.slots.system and clock.h:
                    self.scene.slots.system.stiffen((h / clock.h) ** 2)
                less = settling.relieve(self, h, dt) if self._relieves(h, dt, keeps, adapts) else 1.0
                if less < 1:
                    self._forget_system()
                softness.keep(self, h, dt, passes, adapts, less)
                if asleep is not None and keeps:
                    self._sleep_on(*asleep, h / clock.h)
                elif asleep is not None:
                    self.wake()
            if first is not None:
                bare = first < self.n and not any((b.indices >= first).any() for b in self.batches)
                if not bare:  # particles added without constraints do not concern it
                    self._forget_system()
            self.set_substep(h, drag)
        return True

    def length(self, dt: float, substeps: int) -> float:
        """Return the length of a substep in a frame of dt [s]: the last one, where they differ by rounding alone."""
        h, last = dt / substeps * self.integrator.first, self.clock.h
        return last if is_as_long(h, last) else h

    def _relieves(self, h: float, dt: float, keeps: bool, adapts: bool) -> bool:
        """Whether what longer substeps have left settles before substeps h [s].

        Not so after a late frame, nor where violations are what drives lag behind, unless `adapts`.
        """
        slots, clock = self.scene.slots, self.clock
        if not slots or h >= softness.NEAR * clock.longest or keeps or self.probe or clock.first_moved is not None:
            return False
        return adapts or (dt == clock.frame[1] and not (self.driven or self.ramping))

    def _forget_system(self) -> None:
        """Let a system forget what it has learnt from earlier positions."""
        if system := self.scene.slots.system:
            left = violations.left(self.batches, self.scene.state.get(self.memory)) if system.steps else []
            self.released = max(self.released, *(float(share.max()) for _, share in left), 0.0)
            system.forget(left)

    def _drag(self, h: float) -> list[float] | None:
        """The factors of drag for substeps h [s]; None without drag."""
        return decay(sum(f.rate for f in self.drags), h) if self.drags else None

    def set_softness(self, times: float) -> None:
        """Make links `times` as soft as passes make them, see softness.py."""
        if times != 1 or self.clock.softness != 1:
            self.scene.slots.soften(self.memory, self.scene.inv_mass, self.batches, times)
        self.clock.softness = times

    def renew_softness(self) -> None:
        """Make links as soft as they were before an edit, which has bound them anew."""
        times, self.clock.softness = self.clock.softness, 1.0
        if self.scene.slots:
            self.set_softness(times)

    @property
    def linked(self) -> bool:
        """Whether there are constraints."""
        return any(b.count for b in self.batches)

    def _sleeping(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the particles that sleep, and their displacements; None if they have to wake where substeps change, since these
        are not all of their state."""
        if not self.sleep or self.scene.state.spins or self.linked:
            return None
        who = np.flatnonzero(self.memory.read(self.sleepers.asleep))
        return who, self.memory.read(self.scene.state.d)[who]

    def _sleep_on(self, who: np.ndarray, d: np.ndarray, ratio: float) -> None:
        """Scale what the last substep has left of the sleeping particles `who`, with displacements d, to one of `ratio` times the
        length. For them the coming frame is no start."""
        memory = self.memory
        memory.write_rows(who, (self.scene.state.d, d * ratio))
        left = [self.step.particles.wall_displacement] if self.step.particles.walls else []
        for field in left + [c.dev.rows.borne for c in self.step.contacts]:
            memory.write_rows(who, (field, memory.rows(who, field)[0] * ratio**2))

    def _note_moved(self, removed: tuple[np.ndarray, float] | None) -> None:
        """Note how far particles were moved to meet their constraints, (n,) [m], and the violation that was removed, if any."""
        if removed is not None:
            way, share = removed
            seen = float(way.max()) if share > violations.SEEN else 0.0
            self.moved, self.clock.moved_mask = max(self.moved, seen), None
            self.jumped = self.jumped or (bool((way > self.scene.particles.radius).any()) and seen > 0)
            self.invalidate()

    def set_initial_figures(self, energy: float, overlap: float) -> None:
        """The second half of begin(), with the energy [J] and the overlap of the initial state of the frame."""
        self.clock.energy, self.clock.overlap, self.clock.parting = energy, overlap, overlap > 0

    def placed(self) -> None:
        """The end of begin(): particles that were placed have been dealt with."""
        if self.jumped:
            for contact in self.step.contacts:  # the report must say that they may have passed other particles
                self.memory.write(contact.dev.fast, 1)
        self.clock.first_moved = self.clock.moved_mask = None

    def advance(self, dt: float, substeps: int, iterations: int) -> StepReport:
        """Run one frame, after begin()."""
        self.start_ramps()
        for semi_iteration in self.semi_iterations:
            with self.memory.compiler():
                semi_iteration.prepare(iterations)
        clock = self.clock
        span, started = clock.next_frame(dt), clock.d_is_velocity and substeps * self.integrator.stages == 1
        if not (self.sleep and self.sleep.rests):
            self.run(substeps if self.n else 0, iterations, span[0] + span[1] * span[2], STARTED if started else STEPPED)
        clock.advance(substeps, iterations, span, started)
        self.left = None
        if self.sleep:
            self.settle(dt)
        self.set_multipliers_per_newton()
        report, self.moved, self.released = self.report(substeps, iterations), 0.0, 0.0
        return report

    def set_multipliers_per_newton(self) -> None:
        """Set the factors by which loads follow from the multipliers of the last substep."""
        factor = self.integrator.h2_factor
        self.scene.multipliers_per_newton = factor * h2_rigid_of(self.clock), factor * h2_effective_of(self.clock)

    def find_ramps(self) -> None:
        """After knobs were uploaded: find the batches with new rest values."""
        self.ramping = [b for b in self.batches if b.ramp and b.ramp.under_way]

    def _jump(self) -> None:
        """Set new rest values at once in bodies of which a particle was placed; elsewhere they change during the frame."""
        if self.ramping and self.clock.first_moved is not None:
            tied = violations.tied(self.scene, self.batches, self.clock.first_moved)
            for b in self.ramping:
                b.ramp.jump_to_goals(np.bincount(b.owner, tied[b.indices.ravel()], minlength=b.count) > 0)

    def start_ramps(self) -> None:
        """Start the ramps of assigned rest values, which they reach during the coming frame."""
        if self.ramping:
            new = [b.ramp.memory for b in self.ramping if b.ramp.start_moving()]
            self.ramping = [b for b in self.ramping if b.ramp.under_way]
            if new:
                self.ramps, self.structure = [*self.ramps, *new], None
                self.renew()

    def end_ramps(self) -> None:
        """End the ramps of rest values, after a frame that will not be repeated."""
        for b in self.ramping:
            b.ramp.finish()
        self.ramping = []

    def settle(self, dt: float) -> None:
        """After a frame of dt [s]: find slow particles, and put islands to sleep."""
        sleep, clock = self.sleep, self.clock
        if sleep.rests and not sleep.watches:
            return
        sleep.begin(dt, clock)
        self._settle()
        with self.memory.compiler():
            sleep.rests = sleep.finish(dt, clock)

    def wake(self, particles: np.ndarray | None = None) -> None:
        """Wake all sleeping particles, or the islands of some particles."""
        if self.sleep:
            self.sleep.rests = False
            self.sleepers.wake(particles)

    def set_substep(self, h: float, drag: list[float] | None) -> None:
        """Set the substep h [s], and the factors of drag for it."""
        if drag and drag != self.clock.drag:
            self.memory.write(self.integrator.decay, drag)
        self.clock.h, self.clock.drag = h, drag

    def place(self, position: np.ndarray, iterations: int) -> None:
        """Set positions, (n, dim) [m], and keep velocities."""
        with self.memory.compiler():
            self.restart(iterations)
            self.forget_loads(position)
            moved = (self.scene.state.get(self.memory) != position).any(axis=1)
            self.scene.state.put(self.memory, position)
        clock, known = self.clock, moved if self.clock.first_moved is None else self.clock.moved_mask
        clock.energy, clock.first_moved, clock.moved_mask = None, 0, None if known is None else known | moved
        if (moved | (self.scene.inv_mass == 0)).all():  # what is violated now no pass has left
            with self.memory.compiler():
                self.set_softness(1.0)

    def forget_loads(self, position: np.ndarray) -> None:
        """Before positions are set: forget the loads of constraints and contacts that the new positions change."""
        violations.forget(self.scene, self.batches, position)
        if self.springs:
            self._forget_springs(self.scene.state.get(self.memory), position)

    def _forget_springs(self, before: np.ndarray, now: np.ndarray) -> None:
        """Let springs whose particles were moved from `before` to `now`, (n, dim), start with the forces that they have now."""
        moved = (before != now).any(axis=1)
        for b in self.springs if moved.any() else []:
            offset = self.memory.read(b.dev.equation.spring.offset)
            offset[: b.count][np.bincount(b.owner, moved[b.indices.ravel()], minlength=b.count) > 0] = 0.0
            self.memory.write(b.dev.equation.spring.offset, offset)

    def restart(self, iterations: int, softened: float | None = None) -> None:
        """Turn displacements into velocities, so that the next substep is a start from the present state. iterations: of the
        substep, for velocities of higher order. softened: its length [s], if links are to bear their loads in it as before.

        d / h of a particle at rest stands for -g h / 2 without its support. Without restitution the next substep stops it all the
        same. With restitution it would leave at e g h / 2, which a shorter substep does not take for rest. So in worlds with
        restitution, but for those of rows, the velocities are those that users read. Links that are softer than rigid ones do not
        stop it either: they supply the kick of one substep, half of which the velocities lack then.
        """
        clock = self.clock
        if not clock.d_is_velocity:
            if clock.velocity_override is not None or softened or (self.bounces and not self.solves_rows):
                held, seen = (self.scene.inv_mass == 0)[:, None], clock.velocity_override
                lacking = softened if softened and seen is None else 0.0
                seen = self.velocity(iterations, links=1 - lacking / clock.h) if seen is None else seen
                self.start(np.where(held, self.memory.read(self.scene.state.d)[: self.n] / clock.h, seen))
                clock.owed = (clock.drag or FREE)[3] * lacking
            elif self.probe:
                self.memory.write(self.scene.state.d, high_order.velocity(self.probe, clock, self.memory, iterations))
            else:
                self._turned[:] = clock.h, clock.time, self.shares()[1], iterations == 1 and not self.semi_iterations
                self._to_velocity()
                clock.owed = (clock.drag or FREE)[3] * clock.h
            clock.d_is_velocity, clock.velocity_override = True, None

    def start(self, velocity: np.ndarray) -> None:
        """Make the next substep a start from these velocities, (n, dim), and the present spins; with memory.compiler()."""
        clock, state = self.clock, self.scene.state
        if state.spins and not clock.d_is_velocity:
            self.memory.write(state.spin.s, self.spin())
        state.start(self.memory, velocity)
        clock.d_is_velocity, clock.owed, clock.velocity_override = True, 0.0, None

    def restart_between(self, iterations: int) -> None:
        """Call restart() between frames, and keep the data from which residuals of the last substep are computed."""
        noted = {b: self.memory.scratch(b) for b in self.batches}
        self.note_displacements()
        self.restart(iterations)
        for b, rows in noted.items():
            self.memory.put_scratch(b, rows)

    def note_displacements(self) -> None:
        """Store displacements that are about to become velocities."""
        if self.batches and not self.clock.d_is_velocity:
            self.left = self.memory.read(self.scene.state.d)[: self.n]

    def pass_on(self, left: np.ndarray | None, some: np.ndarray) -> None:
        """Keep the stored displacements of particles in the mask `some`, which come first now."""
        if left is not None:
            self.left = np.zeros((self.n, left.shape[1]), dtype=left.dtype)
            self.left[: np.count_nonzero(some)] = left[some]

    def compile_for_repeats(self) -> None:
        """Compile what frames may need that are repeated with other substeps, so that no frame of a game waits for it later."""
        slots = self.scene.slots
        if slots and slots.sags_anywhere and not (self.springs or self.probe):
            with self.memory.compiler():
                self._velocities()

    def velocity(
        self,
        iterations: int,
        first: int = 0,
        end: int | None = None,
        just_added: bool = False,
        links: float = 1.0,
        touches: bool = True,
    ) -> np.ndarray:
        """Velocities as the user sees them, to the order of the world, of particles `first` to `end` - 1, (end - first, dim).

        just_added: whether these were just added, and touch nothing yet. links: the share of reactions of rigid constraints that
        counts. touches: whether reactions of contacts and walls count.
        """
        clock = self.clock
        if clock.d_is_velocity:
            out = self.memory.read(self.scene.state.d).astype(np.float64)
        elif self.probe:
            out = high_order.velocity(self.probe, clock, self.memory, iterations)
        else:
            if not just_added:
                self._list_again()
            out = self._velocities(first, end, links, touches)
            for path in self.paths if len(out) == self.n else ():
                path.point_along(out, clock.frame[1])
            return out
        return out[first : self.n if end is None else end]

    def _velocities(self, first: int = 0, end: int | None = None, links: float = 1.0, touches: bool = True) -> np.ndarray:
        """Launch the kernel that computes velocities from displacements."""
        launch = self._with_room(self._velocity, "velocities", 7, self.scene.state.dim, self.n)
        self._velocity = launch if self.n <= KEPT else None
        given, out = launch.arrays
        end = self.n if end is None else end
        firm, soft = self.shares()
        given[:] = self.clock.h, self.clock.time, firm * links, soft, first, end, firm * touches
        launch()
        return out[first:end].copy()

    def _with_room(self, launch: CachedLaunch | None, kernel: str, numbers: int, axes: int, rows: int) -> CachedLaunch:
        """The launch of a kernel with so many arguments, and an array of so many rows; `launch` itself if it is large enough."""
        if launch is not None and len(launch.arrays[1]) >= rows:
            return launch
        room = np.zeros((1 << rows.bit_length(), axes))
        return CachedLaunch(self.step, kernel, self.memory.compiler, np.zeros(numbers), room)

    def _list_again(self) -> None:
        """After a state was restored: build the neighbour list, which the reactions of contacts need."""
        if self.search and self.search.list.saved:
            self.list_neighbours()

    def release(self, released: Rows, want: np.ndarray | None = None, taken: Rows = NONE, had: np.ndarray = NONE) -> float:
        """Let particles that were driven go on with velocities `want`, (k, dim) [m/s]; None: as they were driven.

        Those among them that cannot move now stay as they are. taken: the particles that are driven instead. had: (n,) the
        inverse masses before. Returns by how much the energy changes, beside that of spins and pair forces [J].
        """
        clock, now, before = self.clock, self.scene.inv_mass[released], had[taken]
        first, k = len(now), len(now) + len(before)
        self._list_again()
        self._release = launch = self._with_room(self._release, "release", 8, 2 + self.scene.state.dim, k)
        given, rows = launch.arrays
        rows[:first, 0], rows[:first, 1] = numbers_of(released), now
        rows[first:k, 0], rows[first:k, 1] = numbers_of(taken), before
        if want is not None:
            rows[:first, 2:] = want
        firm, soft = self.shares()
        given[:] = clock.h, clock.time, firm, soft, factor_of(clock), want is not None, first, k
        launch()
        return given.item(0)

    def _compile_release(self) -> None:
        """Compile release() where a Pin drives particles without links: it may take others, and no frame must wait for it then.

        For pins of linked particles the world is rebuilt, see edit_in_place.grabbing().
        """
        pins = [f.members.rows for f in self.step.drivers if isinstance(f, Pin)]
        linked = np.concatenate([NONE, *(b.indices.ravel() for b in self.batches)])
        elastic = self.memory.elastic and not (self.sleep or self.launched or self.probe)
        if elastic and not all(np.isin(rows, linked).any() for rows in pins):
            self._release = self._with_room(None, "release", 8, 2 + self.scene.state.dim, 2 * sum(map(len, pins)))
            self.release(NONE)

    def spin(self) -> np.ndarray:
        """Surface velocities r omega, (n, axes) [m/s], of the same order as velocity()."""
        clock, spin = self.clock, self.scene.state.spin
        if clock.d_is_velocity:
            return self.memory.read(spin.s).astype(np.float64)[: self.n]
        self._list_again()
        launch = self._with_room(self._spin, "spins", 4, spin.axes, self.n)
        self._spin = launch if self.n <= KEPT else None
        given, out = launch.arrays
        given[:] = clock.h, clock.time, *self.shares()
        launch()
        return out[: self.n].copy()

    def torque(self) -> np.ndarray:
        """Moments of contacts and walls in the last substep, (n, axes) [N m]: I alpha, from r omega = s / h + r alpha h / 2."""
        clock, particles = self.clock, self.scene.particles
        if not self.scene.state.spins or clock.d_is_velocity:
            return np.zeros((self.n, particles.axes))
        half = self.spin() - self.memory.read(self.scene.state.spin.s)[: self.n] / clock.h
        r = particles.radius
        return np.divide(moments_of_inertia(particles), r, out=np.zeros(len(r)), where=r > 0)[:, None] * half * (2 / clock.h)

    def shares(self) -> tuple[float, float]:
        """The shares of rigid and of soft constraints in velocities after the last substep, see shares_of()."""
        return _shares(self.clock.h, self.clock.started, self.clock.lacked, tuple(self.clock.drag or FREE))

    # Launches.

    def run_no_time(self, h: float) -> None:
        """Run one pass of a substep h [s] that does not end, in an endless frame, from displacements that are velocities.

        So no target comes nearer, nothing breaks, and there are no events.
        """
        clock = self.clock
        for semi_iteration in self.semi_iterations:
            semi_iteration.prepare(1)
        self.set_substep(h, self._drag(h))
        clock.d_is_velocity, clock.owed, clock.tick = True, 0.0, (clock.tick + 1) % 2**31
        span = Span(h, clock.time, clock.time, clock.tick, True, 0.0, STEPPED, ENDLESS * self.integrator.stages, 2)
        if self.launched:
            with self.memory.compiler():
                self._launch(span)
            return
        self.team.rejoin(self._data[ACTIVE_THREADS])
        while True:
            GIVE(
                self._given, 0, h, span.start, span.end, span.tick, True, 0.0, span.substeps, span.iterations,
                span.begin, span.half, span.resumed, 0, STEPPED, span.until, span.part,
            )  # fmt: skip
            self._fused()
            if not self._data[HALT]:
                return
            span.resumed, span.begin, span.half = self.take_halt()[:3]
            self.grow()

    def run(self, substeps: int, iterations: int, end: float, state_origin: int) -> None:
        """Run all substeps of a frame, and the diagnostics."""
        clock, stages = self.clock, self.integrator.stages * substeps
        passes = self.integrator.passes(iterations)
        if self.launched:
            span = Span(clock.h, clock.time, end, clock.tick, clock.d_is_velocity, clock.owed, state_origin, stages, passes)
            span.until, span.part = stages + 1, passes
            with self.memory.compiler():
                self._launch(span)
            return
        self.team.rejoin(self._data[ACTIVE_THREADS])
        begin = half = resumed = 0
        until, part, some = stages + 1, passes, self.passes_at_once
        splits = self.integrator.stages == 1
        if stages * passes > some:
            until, part = max(1, some // passes), min(passes, some) if splits else passes
        while True:
            GIVE(
                self._given, 0, clock.h, clock.time, end, clock.tick, clock.d_is_velocity, clock.owed, stages,
                passes, begin, half, resumed, 0, state_origin, until, part,
            )  # fmt: skip
            self._fused()
            if self._data[HALT]:
                resumed, begin, half = self.take_halt()[:3]
                self.grow()
                self.wake_called(stages, passes, begin, half)
                continue
            if begin == stages or (until > stages and part == passes):
                return
            if part < passes:  # go on with this substep
                resumed, begin, half, part = 1, until - 1, part * self.step.halves, min(passes, part + some)
            else:
                resumed, begin, half, part = 0, until, 0, min(passes, some) if splits else passes
                until = min(stages + 1, until + max(1, some // passes))
            self.raise_signals()

    def wake_called(self, substeps: int, passes: int, s: int, half: int) -> None:
        """Wake the islands for which the frame stopped in substep s."""
        if self.sleep and self.memory.read(self.sleepers.calls)[0]:
            clock = self.clock
            with self.memory.compiler():
                self.sleep.wake_called(clock.h, clock.time, clock.tick, clock.d_is_velocity, s, substeps, passes, max(0, half))

    def take_halt(self) -> tuple[int, int, int, int]:
        """Return where the frame stopped (resumed, begin, half, what of Span), and clear the stop, for the host to handle."""
        self.memory.write(self.step.halt, 0)
        resumed, begin, half, what = (int(v) for v in self._data[HALT:MOST])
        return (0, begin, 0, what) if half == BEFORE else (resumed, begin, half, what)

    def _launch(self, span: Span) -> None:
        """Launch a frame phase by phase. At the end, the host reads one result: whether the frame waits for something."""
        try:
            self._launch_phases(span)
            while self.step.searches and self._data[HALT]:
                span.resumed, span.begin, span.half, span.what = self.take_halt()
                if span.what == LISTS:
                    self.list_neighbours()
                    self.wake_called(span.substeps, span.iterations, span.begin, span.half)
                else:
                    self.launcher.launch_more(span.what)
                self._launch_phases(span)
            if span.until > span.substeps > 0 and self.launcher.rows:
                self.launcher.learn(self._data)
        except BaseException:  # as signals raise
            self.launcher.waiting.clear()
            if self.step.searches:
                self.memory.write(self.step.halt, 0)
            raise

    def _launch_phases(self, span: Span) -> None:
        """Launch the phases of a frame. Where no report tells it, ask whether it stopped."""
        frame(self.launcher, span)
        self.launcher.flush()
        if self.step.searches and span.until <= span.substeps:
            self.sheet[HALT:MOST] = self.memory.read(self.step.halt).ravel()

    def measure(self, end: float, state_origin: int) -> None:
        """Launch the diagnostics alone."""
        self._data[H], self._data[END], self._data[ORIGIN] = self.clock.h, end, state_origin
        self._measure()

    def raise_signals(self) -> None:
        """In a long frame: call the handlers of pending signals. If one raises, the frame is undone, see World.step."""
        if self.interruptible:
            deferred_signals.raise_pending()

    def diagnose_state(self, bare: bool = False) -> None:
        """Diagnose a state that no frame has diagnosed. bare: compute only its energy, in a third of the time."""
        clock = self.clock
        origin = UNSTEPPED if clock.d_is_velocity else STARTED if clock.started else STEPPED
        self.run(0, 1, clock.time, origin + BARE if bare else origin)

    def list_neighbours(self) -> None:
        """Build the lists, growing them until everything fits."""
        if not self.launched:
            self.invalidate()
            self.diagnose_state()  # its kernel is compiled anyway, and builds lists
            return
        with self.memory.compiler():
            for k, search in enumerate(self.step.searches):
                while self.step.build_list(k) > search.list.capacity:
                    self.grow()

    def grow(self) -> None:
        """Grow the lists that are too short, and make kernels for them. No pair is lost: pairs that did not fit were counted."""
        lists = [search.list for search in self.step.searches]
        short = [each for each in lists if self.memory.read(each.need)[0] > each.capacity]
        if any([each.grow() for each in short]):
            self.renew()

    def invalidate(self, some: np.ndarray | None = None) -> None:
        """Mark neighbour lists as stale; with many copies of a world, those of some copies."""
        for search in self.step.searches:
            if some is None:
                search.list.invalidate()
            else:
                self.memory.write_some(search.list.stale, 1, some)

    def report(self, substeps: int = 1, iterations: int = 1) -> StepReport:
        """The StepReport of the last diagnostics."""
        clock = self.clock
        asleep = int(self.memory.read(self.sleepers.count)[0]) if self.sleepers else 0
        report, extent = self._reporter(
            clock.time, clock.h, substeps, iterations, clock.energy, clock.overlap, self.moved, self.released, asleep
        )
        for search in self.step.searches:
            search.fit(extent)
        return report

    def residuals(self, batch) -> np.ndarray:
        """The violations that the last substep left in a batch, relative, from the displacements of that substep."""
        self.memory.check()
        if not self.clock.h:
            raise RuntimeError(f"{batch!r}.residual: there is none before the world has been stepped.")
        d, left = self.scene.state.d, self.left if self.clock.d_is_velocity else None
        with self.memory.compiler():
            now = None if left is None else self.memory.read(d)
            if left is not None:
                self.memory.write(d, left)
            out = self.diagnostics.residuals(batch, self.clock.h, self.clock.started)
            if now is not None:
                self.memory.write(d, now)
            return out

    @property
    def memories(self) -> list[Any]:
        """All trees of fields: the first one, and those of lists and ramps that were added later."""
        return [self.memory, *(search.list.store for search in self.step.searches if search.list.store), *self.ramps]
