"""Reads a recording: its picture, a world that continues from any frame, and a check of both."""

import contextlib
import functools
import inspect
import numbers
import os
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import checks
from ..device import runtime
from ..device.language import NAMES
from ..features.unknown_names import answer_names
from ..shapes import Shape
from ..step import checkpoint
from ..step.clock import Clock
from . import journal, rrd, scene
from .curves import CURVES, own_name
from .journal import Entry
from .overlays import Overlays
from .redraw import Redraw, compare
from .scene import plain

if TYPE_CHECKING:
    from ..world import World


@dataclass(frozen=True)
class Verdict:
    """The result of verify(); true if the recording is complete and every frame comes out as recorded.

    kind: "intact"; "changed" if something in the file does not follow from the steps; "incomplete" if nothing was changed, but
    part of the recording is missing. frames: how many frames hold. of: how many are known. frame: the first that differs.
    particle: the first particle that differs, where that shows; it may show only in a later frame. text: the verdict as a
    sentence.
    """

    kind: str
    frames: int
    of: int
    frame: int | None = None
    particle: int | None = None
    text: str = field(default="", repr=False)

    def __bool__(self) -> bool:
        return self.kind == "intact"

    def __str__(self) -> str:
        return self.text


class SceneFrames(NamedTuple):
    """A scene of a recording: its entry in the journal, and the numbers of the frames that show it.

    knobs: those that the user set, (frame, number of the feature, knobs). broken: constraints that broke, (frame, number of the
    feature, numbers of the constraints). Both hold from that frame on.
    """

    entry: Entry
    frames: list[int]
    knobs: list[tuple[int, int, dict[str, Any]]]
    broken: list[tuple[int, int, np.ndarray]]


@contextlib.contextmanager
def _clear_errors(path: Any) -> Iterator[None]:
    """Within this context, the errors that a damaged file causes in Python become one ValueError that names the file."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError, AssertionError) as e:
        raise ValueError(f"replay: {path} is damaged, or was not written by a Recorder: {e!r}.") from e


def _with_clear_errors(function):
    """Turn the errors that a damaged file causes in a method into one clear ValueError."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def guarded(self, *args, **kwargs):
        """Call the method; errors caused by a damaged file become a ValueError that names the file."""
        signature.bind(self, *args, **kwargs)  # a call with wrong arguments raises its own TypeError
        with _clear_errors(self.path):
            return function(self, *args, **kwargs)

    return guarded


@answer_names
@checks.answer_calls
class Replay:
    """A recording read from a file. See replay()."""

    def __init__(self, path: str, given: Mapping[str, Any]):
        self.path, self._given = path, given
        self._contents = contents = rrd.read(path)
        self._entries, gap, self._later = journal.read(path, contents)
        first = self._entries[0]
        self._drawn, self.curves = _pictures(contents, self._entries), _curves(contents)
        self.scene: dict[str, Any] = first.data
        shown = [e for e in self._entries if e.kind == "frame" and e.frame in self._drawn]
        self._frames = {e.frame: e for e in shown}
        self.frames = np.array([e.frame for e in shown], dtype=np.int64)
        self.times = np.array([e.data["time"] for e in shown], dtype=np.float64)
        ends = self._entries[-1].kind == "end"
        self._gap = gap or contents.why or ("" if ends else "the recording was not closed")  # why the recording is not complete
        self.complete = not self._gap
        self.text = self._describe()

    def _describe(self) -> str:
        s = {name: plain(str(value)) for name, value in self.scene["environment"].items()}
        out = f"{self.path}: {len(self.frames)} frames"
        if len(self.frames):
            out += f" (0 ... {self.frames[-1]}), {self.times[-1]:.6g} s"
        out += f", recorded with tiverlet {s['tiverlet']} and {_compiler(s)} {s['taichi']}"
        out += f" on {s['arch']} ({s['machine']}, {s['system']})"
        if not self.complete:
            last = f"it ends with frame {self.frames[-1]}" if len(self.frames) else "it has no frame"
            out += f". It is not complete ({plain(self._gap)}): {last}"
        return f"{out}."

    def _repr_html_(self) -> str:
        from .markup import of_replay

        return of_replay(self)

    def __repr__(self) -> str:
        return f"Replay({self.path!r}, {len(self.frames)} frames{'' if self.complete else ', not complete'})"

    def _entry(self, frame: int) -> Entry:
        if isinstance(frame, bool) or not isinstance(frame, numbers.Integral):
            raise ValueError(f"replay: frame = {frame!r} is a {type(frame).__name__}, but the number of a frame is needed.")
        if frame not in self._frames:
            near = self.frames[np.argmin(np.abs(self.frames - frame))] if len(self.frames) else None
            raise ValueError(f"replay: {self.path} has no frame {frame}; the nearest is {near}. All are in .frames.")
        return self._frames[frame]

    def position(self, frame: int) -> np.ndarray:
        """Return positions as drawn [m], (n, dim), in f32. world(frame).position has all digits."""
        entry, number = self._entry(frame), self._drawn[frame]
        dim = self._entries[0].arrays["position"].shape[1]
        x = np.zeros((0, dim), dtype=np.float32) if number < 0 else self._contents.values(number).reshape(-1, dim)
        if zlib.crc32(x.tobytes()) != entry.data["crc"]:
            raise ValueError(f"replay: the picture of frame {frame} in {self.path} is not what was recorded. See .verify().")
        return x

    @property
    @_with_clear_errors
    def overlays(self) -> Overlays:
        """What the Recorder was asked to draw."""
        return Overlays.of(self.scene["overlays"])

    @property
    def quantities(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """The arrays given to log(), by name: the frames (m,) and the values (m, n).

        Numbers given to log() are in .curves. Frames with another number of particles than the first are left out.
        """
        names = dict.fromkeys(name for e in self._entries if e.kind == "logged" for name in e.arrays)
        found = {name: self.logged(name) for name in names}
        kept = {name: [row for row in rows if len(row[1]) == len(rows[0][1])] for name, rows in found.items()}
        return {name: (np.array([k for k, _ in rows]), np.array([v for _, v in rows])) for name, rows in kept.items()}

    def logged(self, name: str) -> list[tuple[int, np.ndarray]]:
        """Return the frames and the values of a quantity of particles that was logged, or computed for its colours."""
        return [(e.frame, e.arrays[name]) for e in self._entries if e.kind == "logged" and name in e.arrays]

    @_with_clear_errors
    def world(self, frame: int) -> "World":
        """Return a world in the exact state of a frame, computed from the nearest earlier state and compared with the recording.

        Raises RuntimeError if the computation does not lead to the recorded state, as may happen on another machine.
        """
        goal = self._entries.index(self._entry(frame))
        start = max(k for k, e in enumerate(self._entries[: goal + 1]) if e.kind == "state")
        world = None
        try:
            for world, entry in self._run(start, goal):
                if entry.kind == "frame":
                    self._compare(world, entry)
            assert world
            return world
        except BaseException:
            if world:
                world.close()
            raise

    @_with_clear_errors
    def verify(self) -> Verdict:
        """Compute and draw everything again from the first frame on, and compare hashes, states and every row of the picture.

        Taken from the journal, not computed: knobs and arrays that the user set, particles and features that the user added or
        removed, the state at the start, the environment, the text of explain(), and computing times. The summary page and the
        curves have to match these. In a world with contacts, data carried by pairs of particles is part of the hash of states and
        of the end, but not of the hash of frames; a change of it shows in the next frame. Raises RuntimeError if the recording
        was made with the other compiler, see device/README.md.
        """
        recorded, here = _compiler(self.scene["environment"]), _compiler({"compiler": runtime.compiler()})
        if recorded != here and recorded in NAMES.values():
            raise RuntimeError(
                f"replay: {self.path} was recorded with {recorded}, and {here} runs here, which makes other machine code: frames "
                f"would not come out bit for bit. Set TIVERLET_COMPILER={recorded.lower()} before Python starts. Frames that are "
                "read, .position(), .curves and .export(), are as they were recorded."
            )
        contents = rrd.read(self.path, rows=True)
        if [row[3] for row in contents.journal()] != [row[3] for row in self._contents.journal()]:
            raise ValueError(f"replay: {self.path} has changed since it was read; read it again.")
        redraw, wrong, world = Redraw(self.scene), None, None
        known = sum(e.kind == "frame" for e in self._entries) + (self._later or 0)
        try:
            for world, entry in self._run(1, len(self._entries) - 1):
                off, why, same = None, None, True
                redraw.watch(world)
                if entry.kind == "frame":
                    drawn, x32, why = redraw.frame(entry)
                    same = drawn["hash"] == entry.data["hash"] and drawn["time"] == entry.data["time"]
                    off = _differing(x32, self._shown(entry.frame, x32.shape))
                    if same and off is not None:
                        why = f"the picture of frame {entry.frame} shows particle {off} where it was not; the state is as it was."
                        return self._changed(redraw.frames - 1, known, entry.frame, off, why)
                    same = same and drawn["crc"] == entry.data["crc"]
                elif entry.kind == "state":
                    now, then = checkpoint.keep(world), _recorded_checkpoint(entry, world)
                    same = checkpoint.digest(world, now) == checkpoint.digest(world, then)
                    changed = (k for k, v in now.values.items() if k in then.values and len(v) == len(world.particles))
                    found = (_differing(now.values[k], then.values[k]) for k in changed)
                    off = next((i for i in found if i is not None), None)
                else:
                    why = redraw.apply(entry)
                    same = entry.kind != "end" or "hash" not in entry.data or world.hash() == entry.data["hash"]
                if same and wrong is None and why:
                    return self._changed(redraw.frames, known, entry.frame, None, f"frame {entry.frame}: {why}.")
                if not same and wrong is None:
                    wrong = entry.frame
                if off is not None:
                    break
            redraw.send()
        finally:
            if world:
                world.close()
        if wrong is not None:
            before = sum(frame < wrong for frame in self._frames)
            return self._changed(before, known, wrong, off, self._mismatch(wrong, entry.frame, off))
        dim = self._entries[0].arrays["position"].shape[1]
        result = compare(contents, redraw, f"tiverlet_{dim}d", self.complete)
        if isinstance(result, tuple):
            frame, what = result
            where = "" if frame is None else f"frame {frame}: "
            return self._changed(sum(k < frame for k in self._frames) if frame else 0, known, frame, None, f"{where}{what}.")
        if not contents.sealed:
            return self._changed(result, known, None, None, f"{contents.why}, though its frames hold.")
        if self.complete:
            return Verdict("intact", result, known, text=f"{self.path}: all {result} frames come out as recorded, bit for bit.")
        hold = f"the first {result} of {known} frames hold" if result < known else f"the first {result} frames hold"
        return Verdict("incomplete", result, known, text=f"{self.path}: {hold}; the rest is not there ({plain(self._gap)}).")

    def _shown(self, frame: int, shape: tuple) -> np.ndarray | None:
        number = self._drawn.get(frame, -1)
        x = None if number < 0 else self._contents.values(number)
        return x if x is None or x.size != np.prod(shape) else x.reshape(shape)

    def _changed(self, frames: int, known: int, frame: int | None, particle: int | None, why: str) -> Verdict:
        return Verdict("changed", frames, known, frame, particle, f"{self.path}: {plain(why)}")

    def _mismatch(self, frame: int, seen: int, particle: int | None) -> str:
        where = "" if particle is None else f", first particle {particle}" + (f" (seen in frame {seen})" if seen != frame else "")
        return f"frame {frame} does not come out as recorded{where}. {self._why()}"

    def _why(self) -> str:
        then, now = self.scene["environment"], scene.environment()
        other = [plain(f"{name} {then[name]} then, {now[name]} now") for name in now if name in then and then[name] != now[name]]
        if other:
            return f"What is not as it was: {', '.join(other)}."
        return "Versions and machine are those of the recording, so the file was changed, or a function of the scene was."

    def _begin(self, start: int) -> "World":
        """Make a world in the state of entry `start`."""
        state, base = self._entries[start], max(k for k in range(start) if self._entries[k].kind == "scene")
        source = self._entries[base]
        before = [values for e in self._entries[base:start] if e.kind == "turned" for values in self._knob_values(e)]
        once = state.data.get("once", [[] for _ in source.data["features"]])
        world = scene.rebuild(source.data, source.arrays, self._given, before, once)
        _set_controller(world, [e.data["now"] for e in self._entries[: start + 1] if "now" in e.data][-1])
        _install(world, state)
        return world

    def _run(self, start: int, end: int) -> Iterator[tuple["World", Entry]]:
        """Apply the entries from `start` (a state) to `end`; yield the world after each. The caller closes the last world.

        Where particles or features were added or removed, a new scene begins, and its state is taken as recorded.
        """
        world = self._begin(start)
        yield world, self._entries[start]
        for k in range(start + 1, end + 1):
            self._apply(world, self._entries[k])
            if self._entries[k].kind == "scene":
                world.close()
                world = self._begin(k + 1)
            yield world, self._entries[k]

    def _apply(self, world: "World", entry: Entry) -> None:
        """Make the steps of an entry, then apply the change that it records."""
        settings, effort = world.settings, world._controller.memory
        for dt, substeps, passes, adapted, count in entry.steps:
            substeps, passes = (checks.integer("replay", "substeps", n, least=1) for n in (substeps, passes))
            for _ in range(count):
                world._make_again(dt, substeps, passes, adapted)
        world.substeps, world.iterations, world._controller.memory = settings["substeps"], settings["iterations"], effort
        if entry.kind == "turned":
            for k, values in self._knob_values(entry):
                scene.set_knobs(world.features[k], values)
        elif entry.kind == "taken":
            _install(world, entry)
        elif entry.kind == "assigned":
            if entry.data["name"] not in ("position", "velocity", "spin"):
                raise ValueError(f"replay: {self.path} says that {plain(entry.data['name'])!r} was assigned.")
            setattr(world, entry.data["name"], entry.arrays["value"])
        if "now" in entry.data:
            _set_controller(world, entry.data["now"])

    def _knob_values(self, entry: Entry) -> list[scene.KnobValues]:
        return [
            (int(k), {name: scene.decode(v, entry.arrays) for name, v in values.items()})
            for k, values in entry.data["features"].items()
        ]

    def motion(self) -> Iterator[dict[str, np.ndarray]]:
        """Compute everything again, and yield what the picture does not hold, for each frame drawn: its motion.

        "velocity" (n, dim) [m/s]; "spin" (n,) or (n, 3) [rad/s] where particles spin; "orientation", (n,) [rad] or quaternions
        (n, 4), where it is tracked. All in f64. Raises RuntimeError if a frame does not come out as recorded.
        """
        for world in self.worlds():
            names = ("velocity", *(n for n in ("spin", "orientation") if getattr(world.particles, n) is not None))
            yield {name: np.asarray(getattr(world, name)) for name in names}

    def worlds(self) -> Iterator["World"]:
        """Compute everything again, and yield the world at each frame drawn; it is closed afterwards.

        Raises RuntimeError if a frame does not come out as recorded.
        """
        world = None
        try:
            for world, entry in self._run(1, len(self._entries) - 1):
                if entry.kind == "frame" and entry.frame in self._frames:
                    self._compare(world, entry)
                    yield world
        finally:
            if world:
                world.close()

    def _compare(self, world: "World", entry: Entry) -> None:
        """Raise RuntimeError if a world is not in the state of a frame."""
        if journal.brief(checkpoint.digest(world, checkpoint.keep(world, pairs=False))) != entry.data["hash"]:
            raise RuntimeError(f"replay: frame {entry.frame} of {self.path} does not come out as recorded. {self._why()}")

    @property
    @_with_clear_errors
    def scenes(self) -> list[SceneFrames]:
        """The scenes, and the frames that show them. One begins where particles or features were added or removed."""
        out, knobs, broken = [], [], []
        for e in self._entries:
            if e.kind == "scene":
                out.append(SceneFrames(e, [], [], []))
                knobs, broken = [], []
            elif e.kind == "turned":
                knobs += self._knob_values(e)
            elif e.kind == "frame":
                broken += [(int(k), np.array(rows, dtype=np.int64)) for k, rows in e.data.get("broke", {}).items()]
                if e.frame in self._frames:
                    out[-1].frames.append(e.frame)
                    out[-1].knobs.extend((e.frame, *change) for change in knobs)
                    out[-1].broken.extend((e.frame, *change) for change in broken)
                    knobs, broken = [], []
        return out

    @_with_clear_errors
    def parts(self, entry: Entry) -> scene.Parts:
        """Return particles and features of a scene, by its entry, for inspection without a world."""
        return scene.parts(entry.data, entry.arrays)

    def export(
        self, path: str | os.PathLike, shape: Shape | None = None, *, motion: bool = False, size: int | tuple[int, int] | None =
        None, camera: tuple[float, float] | None = None, theme: str | None = None, color: Any = None,
    ) -> list[str]:  # fmt: skip
        """Write the recording for other programs, in the format of the ending of `path`. Returns the names of the files.

            .npz          positions [m], times [s], masses [kg], radii [m] and curves, for numpy
            .csv          positions and radii, a row for each particle in each frame
            .xyz          extended XYZ for OVITO and ASE: positions and radii
            .glb, .gltf   an animated mesh, y up, with its walls, for Blender and browsers
            .obj          a file for each frame, named a_0000.obj, a_0001.obj ..., or by a %d in the name
            .pvd          a file for each frame for ParaView, a_0000.vtu ..., with radii, masses, links and faces
            .usd, .usda, .usdc  Universal Scene Description: faces, links, points and walls, y up
            .gif, .webp, .mp4  a film in the scene's own time, 25 pictures a second

        shape: the shape that the particles were made from; meshes and films then use its faces, with their quads, and its texture
        coordinates; else faces are those of the picture. Features with the user's functions contribute no faces and links.
        motion: whether .npz, .csv, .xyz, .pvd and .usd also hold velocities [m/s], spins [rad/s] and orientations, and spheres
        turn in .glb. The picture does not have them, so all is computed again, see motion().
        color: as in Recorder; None for the colours of the recording. A quantity that was not recorded is computed again; where
        it is a colour in .glb, it is that of the last frame. .csv, .npz, .obj and .xyz have no colours.
        Of films: size, their width and height [pixels], or the width alone; camera, the angles [rad] of the eye to the right of
        the front and above the horizon in 3D; theme, "dark" or "light".

        Raises ValueError for what a format does not take, such as added or removed particles, and for a shape of other particles;
        RuntimeError if motion does not come out as recorded; FileNotFoundError if the folder is missing; ImportError for .mp4
        without ffmpeg and tiverlet[export], and for .usd without tiverlet[usd].
        """
        from . import exports  # imported late, since it imports rerun

        motion = checks.flag("replay", "motion", motion)
        return exports.export(
            self, os.fspath(path), shape=shape, motion=motion or None, size=size, camera=camera, theme=theme, color=color
        )


@checks.answer_arguments
def replay(path, given: Iterable[Any] | Mapping[str, Any] = ()) -> Replay:
    """Read a recording that a Recorder has written.

        recording = tv.replay("rope.rrd")
        recording.position(60)                 # as drawn
        world = recording.world(60)            # continues from frame 60, bit for bit
        print(recording.verify())              # computes everything again and compares

    given: the user's own functions and classes in the scene, or a mapping from their names. Only world() and verify() need them.
    The file holds their source to be read, in scene["needs"]; loading a file runs no code from it.

    .frames: the numbers of the frames in the file. .times [s]. .curves: (frames, values) of each figure by name, including the
    user's own; .quantities: the arrays given to log(). .complete: whether the recording was closed; after a crash, everything
    that was flushed is there. .text: a description of the file, and where it ends.

    A file may come from an untrusted source: another process reads it, with limits on memory and time, and the result is checked
    before it is used.

    Raises FileNotFoundError, and ValueError if the file is no recording of tiverlet, has another format, or was changed after it
    was written; the message names the place.
    """
    names = given if isinstance(given, Mapping) else {thing.__name__: thing for thing in given}
    with _clear_errors(path):
        return Replay(os.fspath(path), dict(names))


def load(path, given: Iterable[Any] | Mapping[str, Any] = ()) -> "World":
    """Return the world that world.save(path) has written, or that of the last frame of any recording, see replay()."""
    recording = replay(path, given)
    return recording.world(int(recording.frames[-1]))


def _compiler(environment: dict[str, Any]) -> str:
    """Return the name of the compiler in an environment of a recording."""
    return plain(str(environment["compiler"])).partition(" ")[0]


def _set_controller(world: "World", settings: list) -> None:
    """Set substeps, iterations and the controller's memory as recorded."""
    world.substeps, world.iterations, world._controller.memory = *settings[:2], tuple(settings[2])


def _install(world: "World", entry: Entry) -> None:
    """Set the state that an entry records."""
    checkpoint.install(world, _recorded_checkpoint(entry, world), entry.data["flags"])
    world._runner.scene.multipliers_per_newton = tuple(entry.data["reach"])
    numbers_only = {name: rows for name, rows in entry.arrays.items() if rows.dtype.kind == "f"}  # integers may be indices
    checkpoint.put_working_fields(world, numbers_only)


def _recorded_checkpoint(entry: Entry, world: "World") -> checkpoint.Checkpoint:
    values = {k: value for k, value in entry.arrays.items() if k != journal.PARTED and not k.startswith(checkpoint.WORKING)}
    clock = Clock.of(entry.data["clock"] | {"_parted": entry.arrays.get(journal.PARTED)})
    kept = checkpoint.Checkpoint(values, clock, world._controller.memory)
    checkpoint.check(world, kept, entry.data["flags"])
    return kept


def _pictures(contents: rrd.Contents, entries: list[Entry]) -> dict[int, int]:
    """Return the number of the row that holds the positions of each frame, as the viewer selects it; -1 without particles."""
    rows: dict[tuple[str, int], tuple[bytes, int]] = {}
    for k, (entity, frame, ident, *_) in enumerate(contents.numbers.tolist()):
        key = (contents.entities[entity], frame)
        rows[key] = max(rows.get(key, (b"", 0)), (ident, k))
    scenes, out, empty = 0, {}, False
    for e in entries:
        if e.kind == "scene":
            scenes, empty = scenes + 1, not len(e.arrays["position"])
        elif e.kind == "frame":
            root = journal.SCENE if scenes == 1 else f"{journal.SCENE}/scene{scenes - 1}"
            if empty:  # rerun writes no row without points
                out[e.frame] = -1
            elif (key := (f"{root}/{journal.PARTICLES}", e.frame)) in rows:
                out[e.frame] = rows[key][1]
    return out


def _curves(contents: rrd.Contents) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return frames and values of each figure, by name."""
    found: dict[str, dict[int, int]] = {}
    for k, (entity, frame, *_) in enumerate(contents.numbers.tolist()):
        name = contents.entities[entity]
        if name.startswith("figures/"):
            found.setdefault(name[len("figures/") :], {})[frame] = k
    out, known = {}, {end: list(curves) for end, curves in CURVES.values()}
    for end, rows in found.items():
        frames, own = sorted(rows), own_name(end)
        values = np.array([contents.values(rows[frame]) for frame in frames])
        names = known.get(end, [end]) if own is None else [own]
        for name, column in zip(names, values.reshape(len(frames), -1).T, strict=False):
            out[name] = np.array(frames), column
    return dict(sorted(out.items()))


def _differing(now: np.ndarray, then: np.ndarray | None) -> int | None:
    """Return the first row whose bits differ."""
    if then is None or not len(now):
        return None
    if now.shape != then.shape or now.dtype != then.dtype:
        return 0
    bits = [np.ascontiguousarray(a).view(np.uint8).reshape(len(a), -1) for a in (now, then)]
    rows = (bits[0] != bits[1]).any(axis=1)
    return int(np.argmax(rows)) if rows.any() else None
