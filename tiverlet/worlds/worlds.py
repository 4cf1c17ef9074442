"""Many worlds of one structure, stepped together, none of which knows of the others."""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .. import checks
from ..device.copies import Copies
from ..device.interrupts import whole
from ..device.patches import patched
from ..device.patches.compiler import CachedLaunch
from ..features.arguments import knobs_of, meant
from ..features.feature import Batch, Feature
from ..features.read_only import assign_whole, read_only
from ..particles import in_range
from ..step import checkpoint
from ..step import frames as kernel
from ..step.diagnostics import STARTED, STEPPED, TURNS, UNSTEPPED, risks
from ..step.step import (
    BEGIN,
    END,
    FIGURES,
    FRESH,
    HALF,
    HALT,
    ITERATIONS,
    ORIGIN,
    PART,
    RESUMED,
    SHEET,
    SINCE,
    START,
    TICK,
    UNTIL,
    H,
)
from ..step.step import SUBSTEPS as STAGES
from ..world import World
from .clocks import NONE, Clocks
from .report import WorldsReport

WORK = 100_000_000  # particles and constraints, times passes, in a launch: it takes some seconds
LOGGED = 1 << 22  # figures of frames that are kept at a time


DATA = (bool, int, float, str, np.ndarray, np.generic)  # what an attribute is that differs from world to world


class Rollout(NamedTuple):
    """What worlds.rollout() returns. time: (worlds, frames) [s]. position: (worlds, frames, n, dim) [m]."""

    time: np.ndarray
    position: np.ndarray
    report: WorldsReport


class Worlds:
    """Copies of a world, or worlds that differ in numbers only, stepped in one launch.

    worlds: a World, of which there are to be `count` copies in its present state; or several Worlds of the same structure: the
    same features, solver, options and numbers of particles and constraints, with other masses, places, lengths, radii.

    Each goes on to the bit as it would alone, on any number of threads; none knows of the others: what is wrong in one is flagged
    for that one. worlds[k] is the k-th as a World of its own, in its present state. The worlds that it is made of stay as they are.

    position, velocity: (worlds, n, dim). set() gives knobs other values in each world; what is assigned to a knob of
    worlds.features is for all of them.

    Raises ValueError or TypeError for worlds of different structure, and for substeps="auto": each would take its own time.
    """

    def __init__(self, worlds: World | Iterable[World], count: int | None = None):
        sources = _checked(worlds, count)
        first = sources[0]
        if isinstance(worlds, World):
            count = checks.integer("Worlds", "count", 1 if count is None else count, least=1)
        else:
            count = len(sources)
        with whole:
            self._originals = first.features  # by which the user may know those of the copies
            sources = [world if world.path == "fused" else world.clone(path="fused") for world in sources]
            self._copies = Copies(count)
            self._world = World._of(
                first.particles, tuple(f.copy() for f in first.features), [f.start for f in first.features],
                copies=self._copies, **(first.settings | {"path": "fused"}),
            )  # fmt: skip
            self._runner = self._world._runner
            _check_structure(sources)
            self._sources = [_Source(world) for world in sources] if len(sources) > 1 else []
            self._given = _other_knobs(sources)  # by feature and knob: what each world has of it
            self._clocks = Clocks([world._clock for world in sources])
            for k, world in enumerate(sources):
                self._take(k, world)
            if len(sources) < count:
                for memory in self._runner.memories:
                    memory.choose(0)
                    memory.spread()
                self._clocks = Clocks([self._clocks.of(0)] * count)
            self._rest()
            self._waiting = [[_flags(f) for f in world.features] for world in sources]  # of each, for the first frame
            for f, *each in zip(self._world.features, *self._waiting, strict=True):
                f.changed, f.moving, f.new_force = (any(flags) for flags in zip(*each, strict=True))
        self._set: dict[int, np.ndarray] = {}  # by feature, the worlds in which set() gave it other knobs
        self._forced: set[Feature] = set()  # of these, whose forces changed
        self._last: WorldsReport | None = None
        self._start: _Start | None = None  # what reset() returns to; from the first step on

    def _take(self, k: int, world: World) -> None:
        """Give copy k what a world has."""
        runner = self._runner
        runner.memory.choose(k)
        numbers = [(grid.capacity, grid.pitch) for grid in runner.step.grids]
        runner.memory.take(world._runner.memory)
        for grid, (capacity, pitch) in zip(runner.step.grids, numbers, strict=True):
            grid.capacity_number.set(capacity)
            grid.pitch_number.set(pitch)
        self._world._clock = runner.clock = self._clocks.of(k)
        checkpoint.put_back(self._world, checkpoint.keep(world))
        self._clocks.put(k, runner.clock)

    def _rest(self) -> None:
        """No world is chosen."""
        self._runner.memory.choose(None)
        for (i, name), values in self._given.items():
            self._world.features[i].__dict__[name] = values

    @contextlib.contextmanager
    def _at(self, k: int) -> Iterator[World]:
        """Meanwhile the world stands for the k-th."""
        world, runner = self._world, self._runner
        runner.memory.choose(k)
        world._clock = runner.clock = self._clocks.of(k)
        if self._sources:
            self._sources[k].put_on(world)
        for (i, name), values in self._given.items():
            world.features[i].__dict__[name] = values[k]
        try:
            yield world
        finally:
            self._clocks.put(k, world._clock)
            self._rest()

    # The step.

    def step(self, dt: float) -> WorldsReport:
        """Advance all of them by dt [s], see World.step()."""
        dt = checks.number("Worlds.step", "dt", dt, above=0.0)
        self._runner.memory.check()
        with whole:
            return self._advance(dt, 1, 0, None, 0)

    def run(self, seconds: float, dt: float = 1 / 60, progress: bool = False) -> WorldsReport:
        """Step all of them for `seconds` [s] in frames of dt [s], many in a launch; returns the worst figures of all frames."""
        return self._frames("Worlds.run", seconds, dt, 0, None, progress)

    def rollout(self, seconds: float, dt: float = 1 / 60, every: int = 1, progress: bool = False) -> Rollout:
        """The same, with the track of all particles: where they are after each `every`-th frame, in f64."""
        every = checks.integer("Worlds.rollout", "every", every, least=1)
        frames = _frame_count("Worlds.rollout", seconds, dt)
        n, dim = len(self._world.particles), self._world.particles.dim
        size = len(self) * (frames // every) * n * dim
        if size >= 2**31:
            raise ValueError(
                f"Worlds.rollout: the track would have {size} numbers, and can have {2**31 - 1}. Keep fewer frames, with `every`, "
                "or make several rollouts."
            )
        position = np.zeros((len(self), frames // every, n, dim))
        time = self._clocks.time[:, None] + dt * every * np.arange(1, frames // every + 1)
        report = self._frames("Worlds.rollout", seconds, dt, every, position, progress)
        return Rollout(time, position, report)

    def _frames(self, who: str, seconds: float, dt: float, every: int, track: np.ndarray | None, progress: bool) -> WorldsReport:
        """Frames in launches of some of them."""
        frames = _frame_count(who, seconds, dt)
        self._runner.memory.check()
        world = self._world
        work = len(self) * world.substeps * world.iterations * self._runner.integrator.stages
        work *= 1 + len(world.particles) + sum(b.count for b in self._runner.batches)
        at_once = max(1, min(frames, WORK // work, LOGGED // (len(self) * FIGURES)))
        at_once = max(every, at_once // every * every) if every else at_once
        bar: Any = contextlib.nullcontext()
        if progress:
            from rich.progress import Progress  # noqa: PLC0415

            bar = Progress()
        worst, done = None, 0
        with bar as shown:
            task = shown.add_task(f"{len(self)} worlds", total=frames) if shown else None
            while done < frames:
                some = min(at_once, frames - done)
                with whole:
                    report = self._advance(dt, some, every, track, done // every if every else 0)
                worst, done = report if worst is None else worst.worse(report), done + some
                if shown:
                    shown.update(task, completed=done)
        assert worst
        return worst

    def _advance(self, dt: float, frames: int, every: int, track: np.ndarray | None, row: int) -> WorldsReport:
        """Frames of all of them; where knobs are on their way in the first one, that one alone comes first."""
        begun = perf_counter()
        moved, released = self._begin(dt)
        if self._start is None:
            self._start = _Start(self)
        if frames > 1 and any(f.moving for f in self._world.features) and not every:
            first = self._launch(dt, 1, 0, None, 0, moved, released, begun)
            moved, released = self._begin(dt)
            rest = self._launch(dt, frames - 1, 0, None, 0, moved, released, begun)
            report = first.worse(rest)
        else:
            report = self._launch(dt, frames, every, track, row, moved, released, begun)
        self._last = report
        return report

    def _begin(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Have all of them ready for substeps of this length, see Runner.begin(). Returns what that found of each: how far
        particles were moved, and what a shorter substep released."""
        world, runner, clocks = self._world, self._runner, self._clocks
        drags = any(f.changed for f in runner.drags)  # what the clocks have of them is of other rates
        self._upload()
        substep = dt / world.substeps
        h = substep * runner.integrator.first
        looked_at = clocks.known & (clocks.first_moved == NONE) & (clocks.h == h) & (not drags)
        ready, begins = looked_at & ~clocks.d_is_velocity, looked_at & clocks.d_is_velocity
        clocks.since[begins] = 0
        moved, released, jumped = np.zeros(len(self)), np.zeros(len(self)), np.zeros(len(self), dtype=bool)
        some = np.flatnonzero(~(ready | begins))
        for k in some:
            with self._at(k):
                runner.prepare(substep, world.iterations)
                moved[k], released[k], jumped[k] = runner.moved, runner.released, runner.jumped
        unknown = some[~clocks.known[some]]
        if len(unknown):
            energy, overlap = self._look(unknown)
            clocks.energy[unknown], clocks.known[unknown] = energy, True
            for k in unknown[(overlap > 0) & (clocks.first_moved[unknown] != NONE)]:
                with self._at(k), runner.memory.compiler():
                    runner.ease(int(clocks.first_moved[k]))
        for contact in runner.step.contacts:
            runner.memory.write_some(contact.dev.fast, 1, np.flatnonzero(jumped))
        clocks.first_moved[some] = NONE
        return moved, released

    def _look(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Energies [J] and overlaps of some, in the state in which they are."""
        clocks = self._clocks
        sheets, dates = np.zeros((len(self), SHEET)), np.zeros((len(self), kernel.DATES))
        sheets[:, H], sheets[:, START], sheets[:, END] = clocks.h, clocks.time, clocks.time
        sheets[:, TICK], sheets[:, SINCE], sheets[:, FRESH] = clocks.tick, clocks.since, clocks.d_is_velocity
        sheets[:, ORIGIN] = np.where(clocks.d_is_velocity, UNSTEPPED, np.where(clocks.started, STARTED, STEPPED))
        sheets[:, ITERATIONS] = sheets[:, UNTIL] = sheets[:, PART] = 1
        plan = np.zeros(kernel.PLAN, dtype=np.int32)
        plan[kernel.FRAMES] = plan[kernel.KEEPS] = 1
        figures = np.zeros((len(self), 1, FIGURES))
        self._go(plan, some, sheets, dates, figures, np.zeros(1))
        return figures[some, 0, 0], figures[some, 0, 2]

    def _upload(self) -> None:
        """Bring knobs to the device: those that were assigned for all, and those that were set for some."""
        world, features = self._world, self._world.features
        if not self._set and not any(f.changed or f.moving for f in features):
            return
        for f in features:
            if f.changed and f.outgrown:
                _refuse_outgrown(f)
        for i, name in [(i, name) for i, name in self._given if features[i].changed]:
            if vars(features[i])[name] is not self._given[i, name]:
                del self._given[i, name]  # assigned for all
        common, own = [_flags(f) for f in features], self._waiting if len(self._waiting) > 1 else None
        some, self._waiting, still = self._set, [], np.zeros(len(features), dtype=bool)
        self._set = {}
        all_of_them = own is not None or any(changed or moving for changed, moving, _ in common)
        for k in range(len(self)) if all_of_them else np.flatnonzero(np.any([*some.values()], axis=0)):
            flags = own[k] if own else [
                (changed or (i in some and bool(some[i][k])), moving, new_force) for i, (changed, moving, new_force) in enumerate(common)
            ]  # fmt: skip
            with self._at(k):
                for f, (f.changed, f.moving, f.new_force) in zip(features, flags, strict=True):
                    f.new_force = f.new_force or (f.changed and f in self._forced)
                world._upload_parameters()
                still |= [f.moving for f in features]
        self._forced.clear()
        for f, f.moving in zip(features, still.tolist(), strict=True):
            f.changed = f.new_force = False

    def _launch(
        self, dt: float, frames: int, every: int, track: np.ndarray | None, row: int, moved: np.ndarray, released: np.ndarray,
        begun: float,
    ) -> WorldsReport:  # fmt: skip
        """Frames in one launch, and as many more as lists have to grow."""
        world, runner, clocks = self._world, self._runner, self._clocks
        substeps, iterations, stages = world.substeps, world.iterations, runner.integrator.stages
        with runner.memory.compiler():
            for semi_iteration in runner.semi_iterations:
                semi_iteration.prepare(iterations)
        clocks.count_frame(dt, np.ones(len(self), dtype=bool))
        started = clocks.d_is_velocity & (substeps == 1)
        sheets, dates = np.zeros((len(self), SHEET)), np.zeros((len(self), kernel.DATES))
        sheets[:, H], sheets[:, START], sheets[:, TICK], sheets[:, SINCE] = clocks.h, clocks.time, clocks.tick, clocks.since
        dates[:, :3] = clocks.frame
        sheets[:, END] = dates[:, 0] + dates[:, 1] * (dates[:, 2] + 1)
        sheets[:, FRESH], sheets[:, ORIGIN] = clocks.d_is_velocity, np.where(started, STARTED, STEPPED)
        total = stages * substeps if runner.n else 0
        sheets[:, STAGES], sheets[:, ITERATIONS] = total, runner.integrator.passes(iterations)
        sheets[:, UNTIL], sheets[:, PART] = total + 1, sheets[:, ITERATIONS]
        plan = np.zeros(kernel.PLAN, dtype=np.int32)
        plan[kernel.FRAMES], plan[kernel.SUBSTEPS] = frames, substeps if runner.n else 0
        plan[kernel.EVERY], plan[kernel.ROW], plan[kernel.KEEPS] = every, row, 1
        plan[kernel.ROWS] = track.shape[1] if track is not None else 0
        figures = np.zeros((len(self), frames, FIGURES))
        flat = np.zeros(1) if track is None else track.reshape(-1)
        self._go(plan, np.arange(len(self)), sheets, dates, figures, flat)
        before = clocks.energy.copy()
        clocks.advance(substeps, frames, started)
        runner.scene.h2_effective = runner.clock.h**2 * runner.integrator.h2_factor
        return self._report(figures, before, moved, released, begun)

    def _go(
        self, plan: np.ndarray, some: np.ndarray, sheets: np.ndarray, dates: np.ndarray, figures: np.ndarray, track: np.ndarray
    ) -> None:
        """Launch frames of some, and again those that had to wait for a longer list."""
        runner, memory = self._runner, self._runner.memory
        which = some.astype(np.int32)
        memory.write(runner.frames.sheet, sheets)
        memory.write(runner.frames.dates, dates)
        while len(some):
            plan[kernel.COUNT], plan[kernel.GRAIN] = len(some), runner.frames.grain(len(some))
            which[: len(some)] = some
            CachedLaunch(runner.frames, "run", memory.compiler, plan, which, figures.reshape(-1), track)()
            if not runner.step.grids:
                return
            sheets = memory.read(runner.frames.sheet)
            some = some[sheets[some, HALT] != 0]
            for k in some:
                with self._at(k):
                    runner.sheet[:] = sheets[k]
                    sheets[k, RESUMED], sheets[k, BEGIN], sheets[k, HALF] = runner._stopped()
                    runner.grow()
                    runner.invalidate()
            memory.write(runner.frames.sheet, sheets)

    def _report(
        self, figures: np.ndarray, before: np.ndarray, moved: np.ndarray, released: np.ndarray, begun: float
    ) -> WorldsReport:
        """The worst of the figures of all frames, (worlds, frames, FIGURES)."""
        world, runner, clocks = self._world, self._runner, self._clocks
        reporter, dim, n = runner.diagnostics.report, world.particles.dim, runner.n
        energy, residual, overlap, stiff, contacts, bad, fast, reach, broken, tension, turned = np.moveaxis(
            figures[..., :11], 2, 0
        )
        stiff = np.maximum(stiff, reporter.fastest * clocks.h[:, None] ** 2)
        first = np.arange(figures.shape[1]) == 0
        every = risks(
            n, reporter.farthest, bad, reach, fast, turned, np.where(first, moved[:, None], 0.0), tension, stiff,
            np.where(first, released[:, None], 0.0), residual,
        )  # fmt: skip
        clocks.softened = every["softened"][:, -1].copy()
        wrong = bad < n
        report = WorldsReport(
            clocks.time.copy(), residual.max(1), overlap.max(1), contacts.max(1).astype(int), energy[:, -1].copy(),
            np.where(clocks.known, energy[:, -1] - before, 0.0),
            np.where(wrong.any(1), bad[np.arange(len(self)), wrong.argmax(1)], -1).astype(int), broken.sum(1).astype(int),
            np.array(TURNS)[turned.max(1).astype(int)], tension.max(1),
            {name: there.any(1) for name, there in every.items() if there.any()}, world.substeps, world.iterations,
            perf_counter() - begun,
        )  # fmt: skip
        clocks.energy, clocks.known = energy[:, -1].copy(), np.ones(len(self), dtype=bool)
        clocks.first_moved = np.full(len(self), NONE)
        if runner.grid:
            extent = figures[:, -1, 11 : 11 + dim]
            runner.grid.fit(extent.max(0))
        return report

    # Knobs and states of some.

    def set(self, feature: Feature, some: Any = None, **knobs: Any) -> None:
        """Give knobs of a feature other values in each world, from the next frame on.

        feature: one of those that the World was made of, or of worlds.features. knobs: by name, a value for each world, the first
        axis of an array, or a list. some: indices or a Boolean mask of the worlds that they are for; all by default.

        Raises ValueError or TypeError as an assignment to the knob does, and names the world.
        """
        i, f = self._feature(feature)
        chosen = self._chosen("Worlds.set", some)
        for name, values in knobs.items():
            if name not in knobs_of(type(f)):
                live = ", ".join(knobs_of(type(f))) or "nothing"
                raise AttributeError(f"Worlds.set: {name} is no knob of {f!r}{meant(name, knobs_of(type(f)))}. Live are {live}.")
            if np.ndim(values) == 0 or len(values) != len(chosen):
                has = "one value" if np.ndim(values) == 0 else f"{len(values)} values"
                raise ValueError(f"Worlds.set: {name} has {has}, but there are {len(chosen)} worlds. Give each its own.")
            knob, before = getattr(type(f), name), vars(f)[name]
            every = list(before) if (i, name) in self._given and before is self._given[i, name] else [before] * len(self)
            for k, value in zip(chosen, values, strict=True):
                try:
                    vars(f)[name] = every[k] = knob.check(f, value)
                    if f.outgrown:
                        _refuse_outgrown(f)
                except (ValueError, TypeError) as error:
                    error.add_note(f"That is what Worlds.set was given for world {k}.")
                    raise
                finally:
                    vars(f)[name] = before
            vars(f)[name] = self._given[i, name] = _stacked(every)
            mask = self._set.setdefault(i, np.zeros(len(self), dtype=bool))
            mask[chosen] = True
            if knob.force:
                self._forced.add(f)

    def reset(self, some: Any = None, position: Any = None, velocity: Any = None) -> None:
        """Return to where they were before their first step: time, positions, velocities, all that the future depends on. Knobs
        stay as they are.

        some: indices or a Boolean mask of the worlds that return; all by default. position, velocity: (some, n, dim) or (n, dim),
        where they go on from other ones.
        """
        chosen = self._chosen("Worlds.reset", some)
        self._runner.memory.check()
        with whole:
            if self._start:
                self._start.put_back(self, chosen)
            if position is not None:
                new = self.position.copy()
                new[chosen] = self._per_particle("position", position, len(chosen))
                self._place(new, chosen)
            if velocity is not None:
                v = self._per_particle("velocity", velocity, len(chosen))
                self._start_from(v, chosen)

    def _feature(self, feature: Feature) -> tuple[int, Feature]:
        for i, (ours, theirs) in enumerate(zip(self._world.features, self._originals, strict=True)):
            if feature is ours or feature is theirs:
                return i, ours
        raise ValueError(
            f"Worlds.set: {feature!r} is none of these worlds. They have {', '.join(map(repr, self._world.features))}."
        )

    def _chosen(self, who: str, some: Any) -> np.ndarray:
        """Numbers of worlds."""
        if some is None:
            return np.arange(len(self))
        some = np.asarray(some)
        if some.dtype == bool:
            if some.shape != (len(self),):
                raise ValueError(
                    f"{who}: some has shape {some.shape}, but a mask of {len(self)} worlds has shape ({len(self)},)."
                )
            return np.flatnonzero(some)
        return checks.indices(who, "some", np.atleast_1d(some), len(self))

    # State.

    def __len__(self) -> int:
        return self._copies.count

    def __getitem__(self, k: int) -> World:
        """The k-th as a World of its own, in its present state: what is done to it shows in no other."""
        with whole, self._at(range(len(self))[k]) as world:
            copies = tuple(f.copy() for f in world.features)
            for f in copies:
                f.changed = f.new_force = False
            settings = world.settings | {"path": "auto"}
            new = World._of(world.particles, copies, [f.start for f in world.features], **settings)
            checkpoint.transfer(world, new)
            return new

    def hash(self, k: int) -> str:
        """That of the k-th, see World.hash()."""
        with whole, self._at(range(len(self))[k]) as world:
            return world.hash()

    @property
    def position(self) -> np.ndarray:
        """Positions [m], (worlds, n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        state, memory = self._runner.scene.state, self._runner.memory
        out = memory.read(state.x).astype(np.float64, copy=False)
        out = out + memory.read(state.low) if state.sums else out
        return read_only(out[:, : self._runner.n], assign_whole("Worlds", "position"))

    @position.setter
    def position(self, value) -> None:
        self._runner.memory.check()
        with whole:
            self._place(self._per_particle("position", value, len(self)), np.arange(len(self)))

    def _place(self, position: np.ndarray, chosen: np.ndarray) -> None:
        """Move particles of some to (worlds, n, dim)."""
        rows = position[chosen].reshape(-1, position.shape[2])
        in_range("Worlds", "position", rows)
        for contact in self._runner.step.contacts:
            contact.check_range(rows)
        for k in chosen[~self._clocks.d_is_velocity[chosen]]:
            with self._at(k) as world, self._runner.memory.compiler():
                self._runner.restart(world.iterations)
        self._runner.scene.state.put(self._runner.memory, position)
        self._clocks.known[chosen], self._clocks.first_moved[chosen] = False, 0
        for grid in self._runner.step.grids:
            self._runner.memory.write_some(grid.stale, 1, chosen)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (worlds, n, dim), a read-only copy in f64; of the order of the worlds. Assign to set them."""
        runner, clocks = self._runner, self._clocks
        runner.memory.check()
        out = runner.memory.read(runner.scene.state.d)[:, : runner.n].astype(np.float64)
        saved = runner.memory.read(runner.grid.old_saved)[:, 0] if runner.grid else np.zeros(len(self))
        alone = ~clocks.d_is_velocity & ((saved != 0) | bool(runner.probe))
        alone[list(clocks.parted)] = True
        some = np.flatnonzero(~clocks.d_is_velocity & ~alone).astype(np.int32)
        with whole:
            if len(some):
                given = np.zeros((len(some), 4))
                for row, k in zip(given, some, strict=True):
                    runner.clock = clocks.of(k)
                    row[:] = runner.clock.h, runner.clock.time, *runner.shares()
                with runner.memory.compiler():
                    runner.frames.velocities(len(some), some, given, out.reshape(-1))
            for k in np.flatnonzero(alone):
                with self._at(k) as world:
                    out[k] = world.velocity
        return read_only(out, assign_whole("Worlds", "velocity"))

    @velocity.setter
    def velocity(self, value) -> None:
        self._runner.memory.check()
        with whole:
            self._start_from(self._per_particle("velocity", value, len(self)), np.arange(len(self)))

    def _per_particle(self, name: str, value, count: int) -> np.ndarray:
        """An array with a row for each particle of so many worlds; (n, dim) is for all of them."""
        n, dim = self._runner.n, self._world.particles.dim
        value, shape = np.asarray(value), (count, n, dim)
        if value.shape not in (shape, shape[1:]):
            raise ValueError(f"Worlds: {name} has shape {value.shape}, but it must be (worlds, n, dim) = {shape}, or (n, dim).")
        value = checks.points("Worlds", name, np.broadcast_to(value, shape).reshape(-1, dim), dim=dim, count=count * n)
        return value.reshape(shape)

    def _start_from(self, velocity: np.ndarray, chosen: np.ndarray) -> None:
        """Have some go on with these velocities, (some, n, dim)."""
        clocks, memory, state = self._clocks, self._runner.memory, self._runner.scene.state
        memory.write_some(state.d, velocity, chosen)
        if state.carries:
            memory.write_some(state.d_low, 0.0, chosen)
        clocks.d_is_velocity[chosen], clocks.known[chosen], clocks.owed[chosen] = True, False, 0.0
        for k in chosen:
            clocks.parted.pop(int(k), None)

    @property
    def substeps(self) -> int:
        """Substeps of a frame. Assign a number."""
        return self._world.substeps

    @substeps.setter
    def substeps(self, value: int) -> None:
        self._world.substeps = checks.integer("Worlds", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in a substep. Assign a number."""
        return self._world.iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        self._world.iterations = value

    @property
    def time(self) -> np.ndarray:
        """Simulated time [s], (worlds,)."""
        return self._clocks.time.copy()

    @property
    def last(self) -> WorldsReport | None:
        """The report of the last step or run; None before the first."""
        return self._last

    @property
    def features(self) -> tuple[Feature, ...]:
        """What acts on the particles. A knob that is assigned here changes in all worlds, see set()."""
        return self._world.features

    def close(self) -> None:
        """Free the memory on the device. Using the worlds afterwards raises RuntimeError."""
        self._world.close()

    def __enter__(self) -> "Worlds":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Worlds({len(self)} x {self._world!r})"


class _Start:
    """The state of all of them before their first step; one for all where they are copies of each other."""

    def __init__(self, worlds: Worlds):
        runner, self.clocks = worlds._runner, worlds._clocks.copy()
        self.values = {memory: memory.state() for memory in runner.memories}
        for state in self.values.values():
            for name, values in state.items():
                if (values == values[:1]).all():
                    state[name] = values[:1].copy()
        self.pairs: list[Any] = []  # of each, with what they remember
        if runner.grid:
            for k in range(len(worlds)):
                with worlds._at(k):
                    self.pairs.append(runner.grid.lasting_data())
                if not len(self.pairs[k][0]):
                    self.pairs[k] = None

    def put_back(self, worlds: Worlds, chosen: np.ndarray) -> None:
        """Return to it."""
        runner = worlds._runner
        for memory, state in self.values.items():
            memory.restore_some({name: v[chosen] if len(v) > 1 else v for name, v in state.items()}, chosen)
        if runner.grid:
            for field, value in ((runner.grid.old_number, 0), (runner.grid.old_saved, 1)):
                runner.memory.write_some(field, value, chosen)
            for k in chosen:
                if self.pairs[k]:
                    with worlds._at(k):
                        runner.grid.restore(*self.pairs[k])
        for grid in runner.step.grids:
            runner.memory.write_some(grid.stale, 1, chosen)
        worlds._clocks.return_to(self.clocks, chosen)


class _Source:
    """What Python knows of one of several worlds that are not copies of each other, but for the knobs."""

    def __init__(self, world: World):
        self.particles, self.inv_mass = world.particles, world._runner.scene.inv_mass
        self.features = [
            {name: v for name, v in vars(f).items() if isinstance(v, DATA) and name not in (*f.kept_by_world, *knobs_of(type(f)))}
            for f in world.features
        ]
        self.starts = [f.start for f in world.features]

    def put_on(self, world: World) -> None:
        """Have another one look like it."""
        world._particles = world._runner.scene.particles = self.particles
        world._runner.scene.inv_mass = self.inv_mass
        for f, known, start in zip(world.features, self.features, self.starts, strict=True):
            f.__dict__.update(known)
            f.start = start


def _checked(worlds: Any, count: int | None) -> list[World]:
    """The worlds that it is made of."""
    several = [worlds] if isinstance(worlds, World) else [*worlds] if isinstance(worlds, Iterable) else None
    if several is None:
        raise TypeError(
            f"Worlds: worlds = {worlds!r} is a {type(worlds).__name__}; write a World and how many, or a list of them."
        )
    if count is not None and not isinstance(worlds, World):
        raise ValueError(f"Worlds: count = {count}, but it is for copies of one World; there are {len(several)}.")
    if not several:
        raise ValueError("Worlds: worlds is empty; there must be at least one.")
    for k, world in enumerate(several):
        if not isinstance(world, World):
            raise TypeError(f"Worlds: worlds[{k}] = {world!r} is a {type(world).__name__}, not a World.")
        world._runner.memory.check()
        if world._controller.auto:
            raise ValueError(f'Worlds: worlds[{k}] has substeps = "auto", but all go through the same substeps. Give a number.')
    return several


def _refuse_outgrown(feature: Feature) -> None:
    raise ValueError(
        f"Worlds: a knob of {feature!r} asks for what these kernels do not have, such as friction where there was none. Give the "
        "World that Worlds is made of a value other than 0 first."
    )


def _flags(feature: Feature) -> tuple[bool, bool, bool]:
    """What waits in it to be uploaded."""
    return feature.changed, feature.moving, feature.new_force


def _other_knobs(worlds: list[World]) -> dict[tuple[int, str], Any]:
    """The knobs that are not the same in all of them: by the number of the feature and the name, the values."""
    out: dict[tuple[int, str], Any] = {}
    for i, alike in enumerate(zip(*(world.features for world in worlds), strict=True)):
        for name in knobs_of(type(alike[0])):
            values = [vars(f)[name] for f in alike if name in vars(f)]
            if len(values) == len(worlds) and any(not np.array_equal(v, values[0]) for v in values):
                out[i, name] = _stacked(values)
    return out


def _stacked(values: list[Any]) -> Any:
    """An array of what each world has; a list of what makes none."""
    try:
        return np.array(values)
    except ValueError:
        return values


def _check_structure(worlds: Sequence[World]) -> None:
    """Raise ValueError for a world that kernels of the first do not fit."""
    first = _structure(worlds[0])
    for k, world in enumerate(worlds[1:], 1):
        for what, ours, theirs in zip(("settings", "features", "fields", "constants"), first, _structure(world), strict=True):
            if ours != theirs:
                raise ValueError(
                    f"Worlds: worlds[{k}] has other {what} than worlds[0]: {theirs!r:.300}, and not {ours!r:.300}. They may differ in "
                    "numbers only, not in how many particles and constraints there are, or in what acts."
                )


def _structure(world: World) -> tuple:
    settings = {k: repr(v) for k, v in world.settings.items()}
    features = [(type(f).__name__, {k: repr(v) for k, v in (vars(f.dev).get("built") or {}).items()}) for f in world.features]
    fields = [(e.name, e.shape, str(e.kind)) for e in world._runner.memory.entries]
    fields += [f.indices.tobytes() for f in world.features if isinstance(f, Batch)]
    if not patched:
        return settings, features, fields, None
    from ..device.patches.sharing import Writing  # noqa: PLC0415

    return settings, features, fields, Writing(world._runner.step).key


def _frame_count(who: str, seconds: float, dt: float) -> int:
    seconds = checks.number(who, "seconds", seconds, above=0.0)
    return max(1, round(seconds / checks.number(who, "dt", dt, above=0.0)))
