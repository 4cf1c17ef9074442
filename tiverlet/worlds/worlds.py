"""Many worlds of one structure, stepped together and independent of each other."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from .. import checks
from ..constraints.core.scalar import Scalar
from ..device import runtime
from ..device.copies import Copies
from ..device.interrupts import deferred_signals
from ..device.patches.compiler import CachedLaunch
from ..features.arguments import knobs_of
from ..features.feature import Feature
from ..features.read_only import assign_whole_advice, read_only
from ..features.unknown_names import answer_names, suggest
from ..step import checkpoint, energy_bound, impulse
from ..step import frames as kernel
from ..step.clock import CHANGED, energy_floor, energy_limit, exceeds, falls_short, initial_margin, is_as_long
from ..step.diagnostics import ENERGY, EXTENT, KINETIC, OVERLAP, SOFTENED, STARTED, STEPPED, TURNS, UNSTEPPED, risks
from ..step.integrator import decay, shares_of
from ..world import World
from .clocks import NONE, Clocks
from .knobs import Knobs
from .report import WorldsReport
from .structure import check_structure, with_equal_kernels

WORK = 30_000_000  # particles and constraints, times passes, in a launch of about a second
LOGGED = 1 << 22  # figures of frames that are kept per launch, at most
LIVE = ("position", "velocity", "substeps", "iterations")
DATA = (bool, int, float, str, np.ndarray, np.generic)  # types of attributes that may differ from world to world


class Rollout(NamedTuple):
    """The result of worlds.rollout(). time: (worlds, frames) [s]. position: (worlds, frames, n, dim) [m]."""

    time: np.ndarray
    position: np.ndarray
    report: WorldsReport


@answer_names
@checks.answer_calls
class Worlds:
    """Copies of a world, or worlds that differ in numbers only, stepped in one launch.

    worlds: a World, to be copied `count` times in its present state; or several Worlds of the same structure: the same features,
    solver, options and numbers of particles and constraints, with other masses, positions, lengths, radii.

    Each world continues bit for bit as it would alone, on any number of threads. Worlds do not influence each other: an error in
    one is flagged for that one. worlds[k] is world k as a World of its own, in its present state. The original worlds do not
    change.

    position, velocity: (worlds, n, dim). set() gives knobs a value per world. Assigning to a knob of worlds.features sets it in
    all worlds.

    Raises ValueError or TypeError for worlds of different structure, and for substeps="auto", which would differ between worlds.
    """

    def __init__(self, worlds: World | Iterable[World], count: int | None = None):
        sources = _checked(worlds, count)
        first = sources[0]
        if isinstance(worlds, World):
            count = checks.integer("Worlds", "count", 1 if count is None else count, least=1)
        else:
            count = len(sources)
        with deferred_signals:
            self._originals = first.features  # the user may name features by these
            sources = with_equal_kernels(sources)
            self._copies = Copies(count)
            self._world = World._from_starts(
                first.particles, tuple(f.copy_with_kernels() for f in first.features), [f.start for f in first.features],
                copies=self._copies, **(first.settings | {"path": "fused"}),
            )  # fmt: skip
            self._runner = self._world._runner
            check_structure(sources)
            self._fastest = np.array([world._runner.step.integrator.fastest for world in sources])
            self._sources = [_Source(world) for world in sources] if len(sources) > 1 else []
            self._clocks = Clocks([world._clock for world in sources])
            for k, world in enumerate(sources):
                self._take(k, world)
            if len(sources) < count:
                for memory in self._runner.memories:
                    memory.choose(0)
                    memory.copy_to_all()
                self._clocks = Clocks([self._clocks.of(0)] * count)
            self._knobs = Knobs(self._world.features, sources, count)
            self._runner.memory.choose(None)
            self._knobs.show(None)
        self._copies.closed = True
        self._last: WorldsReport | None = None
        self._start: _Start | None = None  # the state for reset(); set by the first step

    def _take(self, k: int, world: World) -> None:
        """Copy the state of a world to copy k."""
        runner = self._runner
        runner.memory.choose(k)
        numbers = [(search.list.capacity, search.list.pitch) for search in runner.step.searches]
        runner.memory.copy_from(world._runner.memory)
        for search, (capacity, pitch) in zip(runner.step.searches, numbers, strict=True):
            search.list.capacity_number.set(capacity)
            search.list.pitch_number.set(pitch)
        self._world._clock = runner.clock = self._clocks.of(k)
        checkpoint.put_back(self._world, checkpoint.keep(world))
        self._clocks.put(k, runner.clock)

    @contextlib.contextmanager
    def _open(self) -> Iterator[None]:
        """Make fields those of all worlds, and delay signals, while the context lasts."""
        with deferred_signals, self._copies.all():
            self._runner.memory.check()
            self._knobs.take_assigned()
            yield

    @property
    def _kernels(self) -> kernel.Frames:
        """The kernels for many worlds; other objects after a list has grown."""
        assert self._runner.frames
        return self._runner.frames

    @contextlib.contextmanager
    def _as_world(self, k: Any) -> Iterator[World]:
        """Make the internal world stand for world k while the context lasts."""
        world, runner, k = self._world, self._runner, int(k)
        runner.memory.choose(k)
        world._clock = runner.clock = self._clocks.of(k)
        runner.set_multipliers_per_newton()
        if self._sources:
            self._sources[k].put_on(world)
        with self._knobs.flagged(k):
            try:
                yield world
            finally:
                self._clocks.put(k, world._clock)
                runner.memory.choose(None)

    # The step.

    def step(self, dt: float) -> WorldsReport:
        """Advance all worlds by dt [s], see World.step()."""
        return self._frames(1, checks.frame_length("Worlds.step", dt))

    def run(self, seconds: float, dt: float = 1 / 60, progress: bool = False) -> WorldsReport:
        """Step all worlds for `seconds` [s], rounded to whole frames of dt [s], with many frames per launch.

        Returns the worst figures of all frames. progress: show a bar.
        """
        return self._frames(_frame_count("Worlds.run", seconds, dt), dt, progress=progress)

    def rollout(self, seconds: float, dt: float = 1 / 60, every: int = 1, progress: bool = False) -> Rollout:
        """Run as run() does, and record the positions of all particles after each `every`-th frame, in f64."""
        every = checks.integer("Worlds.rollout", "every", every, least=1)
        frames = _frame_count("Worlds.rollout", seconds, dt)
        n, dim = len(self._world.particles), self._world.particles.dim
        size = len(self) * (frames // every) * n * dim
        if size >= 2**31:
            raise ValueError(
                f"Worlds.rollout: the track would have {size} numbers, and can have {2**31 - 1}. Keep fewer frames, with "
                "`every`, or make several rollouts."
            )
        position = np.zeros((len(self), frames // every, n, dim))
        report = self._frames(frames, dt, every, position, progress)
        since, length, count = self._clocks.frame.T[:, :, None]
        time = since + length * (count - frames + every * np.arange(1, frames // every + 1))
        return Rollout(time, position, report)

    def _frames(
        self, frames: int, dt: float, every: int = 0, track: np.ndarray | None = None, progress: bool = False
    ) -> WorldsReport:  # fmt: skip
        """Step frames, several per launch. track: where the positions after each `every`-th frame go, see rollout()."""
        world = self._world
        pace, work = world._controller.pace, len(self) * world.substeps * world.iterations * self._runner.integrator.stages
        work *= 1 + len(world.particles) + sum(b.count for b in self._runner.batches)
        at_once = max(1, min(frames, WORK // work, LOGGED // (len(self) * kernel.FIGURES)))
        bar: Any = contextlib.nullcontext()
        if progress:
            from rich.progress import Progress  # noqa: PLC0415

            bar = Progress()
        worst, done = None, 0
        with bar as shown:
            task = shown.add_task(f"{len(self)} worlds", total=frames) if shown else None
            while done < frames:
                with self._open():
                    substeps = pace.fit(dt, world.substeps)
                    moved, released = self._begin(dt, substeps)
                    # A target moves during one frame, then the host ends the motion: launch that frame alone. The host stiffens
                    # soft links between frames, too.
                    alone = self._runner.ramping or self._knobs.any_moves or (self._clocks.softest > 1).any() or pace.off
                    some = 1 if alone else min(at_once, frames - done)
                    report = self._launch(dt, substeps, some, moved, released, every, track, done)
                worst, done = report if worst is None else worst.worse(report), done + some
                if shown:
                    shown.update(task, completed=done)
        assert worst
        return worst

    def _begin(self, dt: float, substeps: int) -> tuple[np.ndarray, np.ndarray]:
        """Prepare all worlds for substeps of a frame of dt [s], see Runner.begin().

        Returns how far particles of each world were moved, and what a shorter substep released, (worlds,) each.
        """
        world, runner, clocks = self._world, self._runner, self._clocks
        for drag in runner.drags:
            clocks.needs_drag |= self._knobs.has_changed(drag)
        self._upload()
        h = dt / substeps * runner.integrator.first
        ready = (clocks.first_moved == NONE) & is_as_long(h, clocks.h) & ~clocks.needs_drag
        ready &= (clocks.softest == 1) & (clocks.iterations == world.iterations)
        moved, released, jumped = np.zeros(len(self)), np.zeros(len(self)), np.zeros(len(self), dtype=bool)
        some = np.flatnonzero(~ready)
        with runner.memory.compiler():
            for k in some:
                with self._as_world(k):
                    runner.prepare(dt, substeps, world.iterations)
                    moved[k], released[k], jumped[k] = runner.moved, runner.released, runner.jumped
        unknown = np.flatnonzero(~clocks.known)
        if len(unknown):
            origin = np.where(clocks.d_is_velocity, UNSTEPPED, np.where(clocks.started, STARTED, STEPPED))
            figures = self._launch_worlds(unknown, clocks.time, origin, 0, 1)[unknown, 0]
            margin = initial_margin(runner.scene.inv_mass, figures[:, EXTENT : EXTENT + world.particles.dim], h)
            clocks.begin(unknown, figures[:, ENERGY], figures[:, OVERLAP], margin)
        for contact in runner.step.contacts:
            runner.memory.write_some(contact.dev.fast, 1, np.flatnonzero(jumped))
        clocks.first_moved[some], clocks.needs_drag[some] = NONE, False
        self._start = self._start or _Start(self)
        return moved, released

    def _upload(self) -> None:
        """Write knobs to the device: those assigned for all worlds, and those set for some."""
        waiting = self._knobs.waiting
        if not waiting.any():
            return
        with self._as_world(0):
            self._knobs.check_kernels()
        self._take_forces(np.flatnonzero(waiting))
        if self._knobs.upload_to_all():
            self._clocks.bound[waiting] = CHANGED
            self._runner.find_ramps()
            return
        for k in np.flatnonzero(self._knobs.waiting):
            with self._as_world(k) as world:
                world._find_stiffened()
                world._upload_parameters()

    def _take_forces(self, some: np.ndarray) -> None:
        """Write forces to the device that have changed in the worlds `some`, and keep velocities, as World._take_forces() does.

        It does nothing where some world needs a start for it.
        """
        runner, clocks, knobs, forces = self._runner, self._clocks, self._knobs, self._knobs.changed_forces()
        h, drag = clocks.h[some], clocks.drags[some]
        if not forces or runner.sleep or runner.probe or (clocks.d_is_velocity | clocks.overridden)[some].any():
            return
        values, rates = [], np.zeros(len(self))
        for k in range(len(self)):
            with knobs.shown(k):
                values.append([f.kernel_values() for f in forces])
                rates[k] = sum(f.rate for f in runner.drags)
        same = [clocks.drag[k] == (decay(float(rates[k]), float(clocks.h[k])) if runner.drags else None) for k in some]
        if not all(same) or (drag[:, 0] < impulse.WEAK).any():
            return
        want = self._velocities()[some]
        for i, f in enumerate(forces):
            for name in values[0][i]:
                runner.memory.write(vars(f.dev)[name], np.array([each[i][name] for each in values])[:, None])
        seen = self._velocities()[some]
        those = self._displacements(some, (seen != want).any(axis=2))
        change = np.abs(want - seen).max(axis=(1, 2), initial=0.0)
        found = those.give(want, lambda: self._velocities()[some], impulse.factor(h, drag), seen, change)
        self._start_from(want[~found], some[~found])
        knobs.note_uploaded(forces)
        clocks.bound[some], clocks.needs_drag[some] = CHANGED, False

    def _displacements(self, some: np.ndarray, moves: Any) -> impulse.Displacements:
        """Return the displacements of the particles in the mask `moves`, (some, n), that can move, of the worlds `some`."""
        memory, n = self._runner.memory, self._runner.n
        inv_mass = [self._sources[k].inv_mass for k in some] if self._sources else self._runner.scene.inv_mass
        return impulse.Displacements(
            self._runner, moves & (np.asarray(inv_mass) > 0), lambda field: memory.read(field)[some, :n],
            lambda field, v: memory.write_some(field, v, some),
        )  # fmt: skip

    def _launch(
        self, dt: float, substeps: int, frames: int, moved: np.ndarray, released: np.ndarray, every: int = 0,
        track: np.ndarray | None = None, before: int = 0,
    ) -> WorldsReport:  # fmt: skip
        """Launch frames, again for worlds that waited for a longer list. before: frames already on the track."""
        world, runner, clocks = self._world, self._runner, self._clocks
        runner.start_ramps()
        iterations, stages = world.iterations, runner.integrator.stages
        with runner.memory.compiler():
            for semi_iteration in runner.semi_iterations:
                semi_iteration.prepare(iterations)
        begun = perf_counter()
        clocks.count_frame(dt)
        started = clocks.d_is_velocity & (substeps * stages == 1)
        since, length, count = clocks.frame.T
        figures = self._launch_worlds(
            np.arange(len(self)), since + length * (count + 1), np.where(started, STARTED, STEPPED),
            substeps if runner.n else 0, iterations, frames, every, track, before,
        )  # fmt: skip
        runner.end_ramps()
        clocks.advance(substeps, iterations, frames, started)
        with np.errstate(all="ignore"):  # energies may be infinite, which flags report
            self._last = self._report(figures, moved, released, dt, substeps, perf_counter() - begun)
        return self._last

    def _launch_worlds(
        self, some: np.ndarray, end: np.ndarray, origin: np.ndarray, substeps: int, iterations: int, frames: int = 1,
        every: int = 0, track: np.ndarray | None = None, before: int = 0,
    ) -> np.ndarray:  # fmt: skip
        """Launch frames of the worlds `some`, and relaunch those that stopped for a longer list.

        end, origin: of the first frame of each world, see Span. every, track, before: of the track, see rollout(). Returns the
        figures, (worlds, frames, FIGURES).
        """
        runner, memory, integrator = self._runner, self._runner.memory, self._runner.integrator
        sheets = kernel.sheets(self._clocks, end, origin, integrator.stages * substeps, integrator.passes(iterations))
        dates = np.zeros((len(self), kernel.DATES))
        dates[:, :3] = self._clocks.frame
        memory.write(self._kernels.sheet, sheets)
        memory.write(self._kernels.dates, dates)
        plan = np.zeros(kernel.PLAN, dtype=np.int32)
        plan[kernel.FRAMES], plan[kernel.SUBSTEPS], plan[kernel.KEEPS] = frames, substeps, 1
        plan[kernel.EVERY], plan[kernel.BEFORE], plan[kernel.ROWS] = every, before, 0 if track is None else track.shape[1]
        figures = np.zeros((len(self), frames, kernel.FIGURES))
        flat, which = np.zeros(1) if track is None else track.reshape(-1), some.astype(np.int32)
        while len(some):
            plan[kernel.COUNT], plan[kernel.GRAIN] = len(some), self._kernels.grain(len(some))
            which[: len(some)] = some
            with self._knobs.shown(0):  # kernels depend on whether there is friction, which is the same in all worlds
                CachedLaunch(self._kernels, "run", memory.compiler, plan, which, figures.reshape(-1), flat)()
            if not runner.step.searches:
                break
            sheets = memory.read(self._kernels.sheet)
            some = some[sheets[some, kernel.HALT] != 0]
            for k in some:
                with self._as_world(k):
                    runner.sheet[:] = sheets[k]
                    sheets[k, [kernel.RESUMED, kernel.BEGIN, kernel.HALF]] = runner.take_halt()[:3]
                    runner.grow()
                    runner.invalidate()
            memory.write(self._kernels.sheet, sheets)
        return figures

    def _report(
        self, figures: np.ndarray, moved: np.ndarray, released: np.ndarray, dt: float, substeps: int, seconds: float
    ) -> WorldsReport:
        """Make the report from the figures of all frames, (worlds, frames, FIGURES)."""
        world, runner, clocks = self._world, self._runner, self._clocks
        before, n = clocks.energy, runner.n
        energy, residual, overlap, stiff, contacts, bad, fast, reach, broken, tension, turned = np.moveaxis(
            figures[..., :KINETIC], 2, 0
        )
        stiff = np.maximum(stiff, (self._fastest * clocks.h**2)[:, None])
        first = np.arange(figures.shape[1]) == 0
        pressed = np.column_stack([clocks.overlap, overlap[:, :-1]])
        every: dict[str, Any] = risks(
            n, runner.diagnostics.report.farthest, bad, reach, fast, overlap, pressed, turned,
            np.where(first, moved[:, None], 0.0), tension, figures[..., SOFTENED], stiff,
            np.where(first, released[:, None], 0.0), residual,
        ) | self._flag_energies(figures)  # fmt: skip
        every["substeps-capped"] = np.full((len(self), 1), world._controller.pace.late(dt) > 0)
        wrong = bad < n
        clocks.energy, clocks.known[:] = energy[:, -1].copy(), True
        for search in runner.step.searches:
            search.fit(figures[:, -1, EXTENT : EXTENT + world.particles.dim].max(0))
        return WorldsReport(
            clocks.time.copy(), residual.max(1), overlap.max(1), contacts.max(1).astype(int), clocks.energy.copy(),
            clocks.energy - before, np.where(wrong.any(1), bad[np.arange(len(self)), wrong.argmax(1)], -1).astype(int),
            broken.sum(1).astype(int), np.array(TURNS)[turned.max(1).astype(int)], tension.max(1),
            {name: there.any(1) for name, there in every.items() if there.any()}, substeps, world.iterations,
            seconds,
        )  # fmt: skip

    def _flag_energies(self, figures: np.ndarray) -> dict[str, np.ndarray]:
        """Return which worlds gained energy without work, and in which frames, (worlds, frames), and which have lost some by the
        last frame that nothing took, (worlds, 1), see energy_bound.py."""
        clocks, energy = self._clocks, figures[..., ENERGY]
        gain, lost = np.empty_like(energy), np.zeros((len(self), 1), dtype=bool)
        for k in range(energy.shape[1]):
            exceeds(clocks, energy[:, k], figures[:, k, KINETIC], figures[:, k, OVERLAP].copy())
            gain[:, k] = energy[:, k] - energy_limit(clocks.bound, clocks.kinetic, energy[:, k])
        out = gain > 0
        for k in np.flatnonzero(out.any(1)):
            with self._as_world(k) as world:
                out[k] = energy_bound.spurious_gain(world, gain[k], figures[k])
        loss = energy_floor(clocks.bound, clocks.kinetic, energy[:, -1]) - energy[:, -1]
        for k in np.flatnonzero(falls_short(clocks, energy[:, -1])):
            with self._as_world(k) as world:
                lost[k] = energy_bound.spurious_loss(world, loss[k], figures[k, -1])
        return {energy_bound.GAIN: out, energy_bound.LOST: lost}

    # Knobs and states of chosen worlds.

    def set(self, feature: Feature, some: Any = None, **knobs: Any) -> None:
        """Set knobs of a feature to a value per world, from the next frame on.

        feature: one of worlds.features, or of the original World. knobs: by name, a value for each world, as a list or along the
        first axis of an array. some: indices or a Boolean mask of these worlds; all by default.

        Raises the ValueError or TypeError of an assignment to the knob, with a note that names the world.
        """
        i = self._feature(feature)
        chosen = self._chosen("Worlds.set", some)
        self._knobs.set(i, chosen, knobs)

    def reset(self, some: Any = None, position: Any = None, velocity: Any = None) -> None:
        """Return to the state before the first step: time, positions, velocities, and all else on which the future depends.

        Knobs keep their values. some: indices or a Boolean mask of the worlds that return; all by default. position, velocity:
        (some, n, dim) or (n, dim), to replace those of that state.
        """
        chosen = self._chosen("Worlds.reset", some)
        if position is not None:
            position = self._in_range(self._per_particle("position", position, len(chosen)))
        if velocity is not None:
            velocity = self._per_particle("velocity", velocity, len(chosen))
        with self._open():
            if self._start:
                self._start.put_back(self, chosen)
            if position is not None:
                new = self._runner.scene.state.get(self._runner.memory)
                new[chosen] = position
                self._place(new, chosen)
            if velocity is not None:
                self._set_velocities(velocity, chosen)

    def _feature(self, feature: Feature) -> int:
        """Return the number of a feature."""
        for i, (ours, theirs) in enumerate(zip(self._world.features, self._originals, strict=True)):
            if feature is ours or feature is theirs:
                return i
        raise ValueError(
            f"Worlds.set: {feature!r} is none of these worlds. They have {', '.join(map(repr, self._world.features))}."
        )

    def _chosen(self, who: str, some: Any) -> np.ndarray:
        """Return the numbers of the worlds `some`, checked."""
        if some is None:
            return np.arange(len(self))
        some = np.asarray(some)
        if some.dtype == bool:
            if some.shape != (len(self),):
                raise ValueError(
                    f"{who}: some has shape {some.shape}, but a mask of {len(self)} worlds has shape ({len(self)},)."
                )
            return np.flatnonzero(some)
        chosen = checks.indices(who, "some", np.atleast_1d(some), len(self), things="worlds")
        if len(np.unique(chosen)) < len(chosen):
            raise ValueError(f"{who}: some names a world twice: {some.tolist()}. Name each once.")
        return chosen

    # State.

    def __len__(self) -> int:
        return self._copies.count

    def __getitem__(self, k: int) -> World:
        """Return world k as a World of its own, in its present state. Changing it does not change these worlds."""
        if not -len(self) <= k < len(self):
            raise IndexError(f"Worlds: world {k}, but there are {len(self)} (0 ... {len(self) - 1}).")
        k = range(len(self))[k]
        with self._open(), self._as_world(k) as world:
            self._knobs.check_kernels()
            return world.clone(path="auto")

    def each(self, ask: Callable[[World], Any], some: Any = None) -> list[Any]:
        """Call a function on each world, and return its results in order: for example lambda world: world.features[1].load.

        The function gets one World after the other to read: positions, velocities, features, contacts, in their present state. It
        must not step, change or keep the World; worlds[k] is for that. some: indices or a Boolean mask of the worlds; all by
        default.
        """
        out = []
        with self._open():
            for k in self._chosen("Worlds.each", some):
                with self._as_world(k) as world:
                    out.append(ask(world))
        return out

    def hash(self, k: int) -> str:
        """Return the hash of world k, see World.hash()."""
        with self._open(), self._as_world(range(len(self))[k]) as world:
            return world.hash()

    @property
    def position(self) -> np.ndarray:
        """Positions [m], (worlds, n, dim), a read-only copy in f64. Assign an array to move particles; velocities are kept."""
        with self._open():
            return read_only(self._runner.scene.state.get(self._runner.memory), assign_whole_advice("Worlds", "position"))

    def view(self, name: str = "position") -> np.ndarray:
        """Return the positions [m] of all worlds, (worlds, n, dim), as a view of device memory.

        It is not copied, has the precision of the device, and always shows the present state. Read-only, and valid until close().
        On a GPU it is a copy.

        name: "position", or "displacement", that of the last substep (before a start, the first substep after velocities were
        set, it is the velocity). "position" lacks its low word in "f32-compensated", and in "f32" where links are solved
        directly. Other packages read it without a copy, too: jnp.from_dlpack(worlds.view()), torch.from_dlpack(worlds.view());
        they must not write to it.
        """
        state = self._runner.scene.state
        known = {"position": state.x, "displacement": state.d}
        if name not in known:
            raise ValueError(f"Worlds.view: name = {name!r}, but it must be one of {', '.join(map(repr, known))}.")
        with self._open():
            return read_only(
                self._runner.memory.view(known[name])[:, : self._runner.n], assign_whole_advice("Worlds", "position")
            )

    @position.setter
    def position(self, value) -> None:
        """Move particles of all worlds to (worlds, n, dim), or to (n, dim) in each [m]. Velocities are kept."""
        value = self._in_range(self._per_particle("position", value, len(self)))
        with self._open():
            self._place(value, np.arange(len(self)))

    def _in_range(self, position: np.ndarray) -> np.ndarray:
        """Return positions (worlds, n, dim) [m], checked."""
        self._world._check_places("Worlds", position.reshape(-1, position.shape[2]))
        return position

    def _place(self, position: np.ndarray, chosen: np.ndarray) -> None:
        """Move the particles of the chosen worlds. position: (worlds, n, dim)."""
        bound = any(isinstance(b, Scalar) for b in self._runner.batches)
        for k in chosen if bound else chosen[~self._clocks.d_is_velocity[chosen]]:
            with self._as_world(k) as world, self._runner.memory.compiler():
                self._runner.restart(world.iterations)
                self._runner.forget_loads(position[k])
        self._runner.scene.state.put(self._runner.memory, position)
        self._clocks.known[chosen], self._clocks.first_moved[chosen] = False, 0
        self._runner.invalidate(chosen)

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s], (worlds, n, dim), a read-only copy in f64, accurate to the order of the world. Assign to set them."""
        with self._open():
            return read_only(self._velocities(), assign_whole_advice("Worlds", "velocity"))

    def _velocities(self, links: bool = True, touches: bool = True) -> np.ndarray:
        """Return the velocities of all worlds.

        links, touches: whether reactions of rigid constraints, and of contacts and walls, are included.
        """
        runner, clocks = self._runner, self._clocks
        out = runner.memory.read(runner.scene.state.d)[:, : runner.n].astype(np.float64)
        saved = runner.memory.read(runner.search.list.old_saved)[:, 0] if runner.search else np.zeros(len(self))
        alone = ~clocks.d_is_velocity & ((saved != 0) | bool(runner.probe))
        for k in np.flatnonzero(clocks.overridden):
            out[k] = clocks.velocity_override[k]
        there = clocks.d_is_velocity | clocks.overridden
        alone &= ~there
        some = np.flatnonzero(~there & ~alone).astype(np.int32)
        if len(some):
            rigid, soft = shares_of(clocks.h[some], clocks.started[some], clocks.lacked[some], clocks.drags[some])
            given = np.stack([clocks.h[some], clocks.time[some], rigid * links, soft, rigid * touches], axis=1)
            with runner.memory.compiler(), self._knobs.shown(0):
                self._kernels.velocities(len(some), some, given, out.reshape(-1))
            for path in runner.paths:
                turned = out[some]
                path.point_along(turned, clocks.frame[some, 1], some)
                out[some] = turned
        for k in np.flatnonzero(alone):
            with self._as_world(k) as world, runner.memory.compiler():
                out[k] = runner.velocity(world.iterations, links=links, touches=touches)
        return out

    @velocity.setter
    def velocity(self, value) -> None:
        """Set the velocities with which particles continue, (worlds, n, dim), or (n, dim) for each world [m/s]."""
        with self._open():
            self._set_velocities(self._per_particle("velocity", value, len(self)), np.arange(len(self)))

    def _per_particle(self, name: str, value, count: int) -> np.ndarray:
        """Return an array with a row per particle of `count` worlds; (n, dim) is repeated for all of them."""
        n, dim = self._runner.n, self._world.particles.dim
        if hasattr(value, "__dlpack__") and not isinstance(value, np.ndarray):  # from PyTorch, JAX and others
            value = np.from_dlpack(value)
        value, shape = np.asarray(value), (count, n, dim)
        if value.shape not in (shape, shape[1:]):
            raise ValueError(f"Worlds: {name} has shape {value.shape}, but it must be (worlds, n, dim) = {shape}, or (n, dim).")
        value = checks.points("Worlds", name, np.broadcast_to(value, shape).reshape(-1, dim), dim=dim, count=count * n)
        return value.reshape(shape)

    def _set_velocities(self, velocity: np.ndarray, chosen: np.ndarray) -> None:
        """Give chosen worlds these velocities, (chosen, n, dim), see World.velocity."""
        clocks, runner = self._clocks, self._runner
        seen = self._velocities()[chosen]
        change = velocity - seen
        moved = change.any(axis=(1, 2))
        drag = clocks.drags[chosen]
        steered = moved & ~clocks.d_is_velocity[chosen] & (not runner.probe) & (drag[:, 0] >= impulse.WEAK)
        if steered.any():
            some, memory = chosen[steered], runner.memory
            clocks.velocity_override[some] = None
            want, seen, change, drag = velocity[steered], seen[steered], change[steered], drag[steered]
            had, free = (self._velocities(touches=touches)[some] for touches in (True, False))
            bare = self._velocities(links=False, touches=False)[some] if runner.batches else free
            those = self._displacements(some, change.any(axis=2))
            with self._knobs.shown(0):
                friction = impulse.has_friction(runner)
                pulled = impulse.pulled(runner, len(some), lambda field: memory.read(field)[some])
            share, found = those.steer(
                want, change, seen, had, bare, free, pulled, friction, lambda: self._velocities()[some], clocks.h[some], drag
            )
            for k, parts in zip(some[found], share[found], strict=True) if runner.scene.state.spins else ():
                with self._as_world(k):
                    impulse.restore_turn(runner, 0, parts)
            steered[steered] = found
            clocks.known[some] = False
            for i in np.flatnonzero(found):
                clocks.velocity_override[some[i]] = want[i]
        fresh = moved & ~steered
        self._start_from(velocity[fresh], chosen[fresh])

    def _start_from(self, velocity: np.ndarray, chosen: np.ndarray) -> None:
        """Start chosen worlds from these velocities, (chosen, n, dim)."""
        clocks, memory, state = self._clocks, self._runner.memory, self._runner.scene.state
        for k in chosen[~clocks.d_is_velocity[chosen]] if state.spins else ():
            with self._as_world(k), memory.compiler():
                memory.write(state.spin.s, self._runner.spin())
        memory.write_some(state.d, velocity, chosen)
        if state.carries:
            memory.write_some(state.d_low, 0.0, chosen)
        clocks.d_is_velocity[chosen], clocks.known[chosen], clocks.owed[chosen] = True, False, 0.0
        clocks.velocity_override[chosen] = None

    @property
    def substeps(self) -> int:
        """Substeps per frame. Assign a number."""
        return self._world.substeps

    @substeps.setter
    def substeps(self, value: int) -> None:
        """Set the substeps of all worlds from the next frame on: at least 1."""
        self._world.substeps = checks.integer("Worlds", "substeps", value, least=1)

    @property
    def iterations(self) -> int:
        """Passes over the constraints in each substep. Assign a number."""
        return self._world.iterations

    @iterations.setter
    def iterations(self, value: int) -> None:
        """Set the iterations of all worlds from the next frame on: at least 1, and a number that the solver allows."""
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
        """The features that act on the particles. A knob assigned here changes in all worlds, see set()."""
        return self._world.features

    @property
    def fields(self) -> dict[str, int]:
        """The size of every field on the device for all worlds [bytes], by name."""
        return self._world.fields

    def close(self) -> None:
        """Free the memory on the device. Using the worlds afterwards raises RuntimeError."""
        self._world.close()

    def explain(self) -> str:
        """Describe what one world consists of, as World.explain() does, and the memory of all worlds."""
        bytes_in_all = sum(self.fields.values())
        with self._open(), self._as_world(0) as world:
            said = world.explain()
        return (
            f"{len(self)} worlds, all frames of each on one thread: {bytes_in_all} bytes, {bytes_in_all // len(self)} per world. "
            f"Each: {said}"
        )

    def __setattr__(self, name: str, value: Any) -> None:
        if not name.startswith("_") and name not in LIVE:
            guess = "." if hasattr(self, name) else suggest(name, ["Worlds"], LIVE)
            raise AttributeError(f"Worlds.{name} cannot be set{guess} Live are {', '.join(LIVE)}, and knobs by set().")
        object.__setattr__(self, name, value)

    def __reduce_ex__(self, protocol):
        raise TypeError(
            "Worlds hold compiled kernels and memory of the device, so they cannot be copied or pickled. Make new ones: "
            "tv.Worlds([worlds[k] for k in range(len(worlds))])."
        )

    def __enter__(self) -> "Worlds":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Worlds({len(self)} x {self._world!r})"


class _Start:
    """The state of all worlds before their first step; stored once where the worlds are equal copies."""

    def __init__(self, worlds: Worlds):
        runner, self.clocks = worlds._runner, worlds._clocks.copy()
        self.values = checkpoint.state(worlds._world, pairs=False)
        for name, values in self.values.items():
            if (values == values[:1]).all():
                self.values[name] = values[:1].copy()
        self.pairs: list[Any] = []  # pairs of each world with their data; one for all if the worlds are copies
        for k in range(len(worlds) if worlds._sources else 1) if runner.search else ():
            with worlds._as_world(k):
                self.pairs.append(runner.search.list.persistent_data())

    def put_back(self, worlds: Worlds, chosen: np.ndarray) -> None:
        """Return the chosen worlds to it."""
        runner = worlds._runner
        state = {name: values[chosen] if len(values) > 1 else values for name, values in self.values.items()}
        for memory in runner.memories:
            memory.restore(state, chosen)
        if runner.search:
            for field, value in ((runner.search.list.old_number, 0), (runner.search.list.old_saved, 1)):
                runner.memory.write_some(field, value, chosen)
            for k in chosen:
                pairs = self.pairs[k if len(self.pairs) > 1 else 0]
                if len(pairs[0]):
                    with worlds._as_world(k):
                        runner.search.list.restore(*pairs)
        for log in runner.logs:
            runner.memory.write_some(log.counter, 0, chosen)
        runner.invalidate(chosen)
        for k in chosen[worlds._clocks.softness[chosen] != self.clocks.softness[chosen]]:
            with worlds._as_world(k):
                runner.set_softness(float(self.clocks.softness[k]))
        worlds._clocks.return_to(self.clocks, chosen)
        if runner.drags:
            runner.memory.write_some(runner.integrator.decay, [[self.clocks.drag[k]] for k in chosen], chosen)


class _Source:
    """The host's data of one of several different worlds, without its knobs."""

    def __init__(self, world: World):
        self.particles, self.inv_mass = world.particles, world._runner.scene.inv_mass
        self.features = [
            {name: v for name, v in vars(f).items() if isinstance(v, DATA) and name not in (*f.kept_by_world, *knobs_of(type(f)))}
            for f in world.features
        ]
        self.starts = [f.start for f in world.features]

    def put_on(self, world: World) -> None:
        """Give another world this data."""
        world._particles = world._runner.scene.particles = self.particles
        world._runner.scene.inv_mass = self.inv_mass
        for f, known, start in zip(world.features, self.features, self.starts, strict=True):
            f.__dict__.update(known)
            f.start = start


def _checked(worlds: Any, count: int | None) -> list[World]:
    """Return the worlds from which a Worlds is made, checked."""
    if runtime.architecture() not in runtime.LLVM:
        raise ValueError(
            f"Worlds: they need an architecture for which LLVM compiles, not {runtime.architecture()}. Use tv.init(arch='cpu')."
        )
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


def _frame_count(who: str, seconds: float, dt: float) -> int:
    seconds = checks.number(who, "seconds", seconds, above=0.0)
    return max(1, round(seconds / checks.frame_length(who, dt)))
