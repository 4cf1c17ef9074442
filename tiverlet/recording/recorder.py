"""Recorder: writes a simulation to a file that holds the picture, the states to continue from, and what verify() compares."""

import contextlib
import os
import weakref
from difflib import get_close_matches
from time import perf_counter
from typing import Any

import numpy as np

from .. import checks
from ..device import interrupts
from ..features.unknown_names import answer_names
from ..step.explain import explain
from ..world import World
from ..worlds.worlds import Worlds
from .hues import Coloring
from .journal import JOURNAL, flags_to_record
from .journal_writer import Journal
from .overlays import Overlays, checked_y_down
from .picture import Picture, layout
from .quantities import QUANTITIES, checked_quantities
from .scene import environment
from .sink import Sink, checked_place, file_error

SEND = 1.0  # [s] between two transfers of curve points to rerun
SHARE = 20  # an exact state is written once the pictures since the last one take so many times its bytes, uncompressed
SPARSE = 300  # frames after which an exact state is written in any case
RESERVE = 40_000  # bytes of a budget reserved for the layout and the summary


@answer_names
@checks.answer_calls
class Recorder:
    """Writes frames of a world to an .rrd file, and everything needed to compute them again, bit for bit.

        with tv.Recorder("rope.rrd", world) as recorder:
            world.step(1 / 60)
            recorder.log()

    path: the file; its folder must exist. None with live: no file. world: the world to record. every: log only one of so many
    frames. budget: the most bytes of the file. When they run short, every other frame is removed from the picture of the whole
    run, repeatedly if needed, and a warning at the end reports it; all steps stay in the file. overwrite: whether an existing
    file may be replaced; it stays as it is until the new one has its first frame.

    strain: whether links and surfaces show their strain. forces: draw the loads of contacts as lines, as wide as they are large.
    velocities: draw arrows that show the path of the next 0.05 s. color: None, by body; colours (n, 3), integers in 0 ... 255 or
    floats in 0 ... 1; a quantity ("speed", "spin", "load", "mass", "radius", "group", or a name given to log()) or a function
    of the world, alone or with the ends of its scale, ("speed", 0, 2). live: show the recording while it is made: True for a
    window, "web" for a page in the browser, "notebook" below a cell, or the address of a running viewer. y_down: whether y points
    down in the picture, as in coordinates of pixels (2D).

    The picture has positions (f32), surfaces of bodies, links, walls, contacts in scenes of up to 1500 particles, breaks, and
    curves. The file also holds the scene with all arguments, exact states to continue from, the hash of every frame drawn, every
    step, and every knob and array that the user set: see tv.replay.

    The file is complete when the block ends. If the process is killed, all but about the last second can be replayed; flush()
    writes what there is. Raises ValueError and OSError if the file cannot be made or written, FileExistsError if it exists
    already.
    """

    def __init__(
        self, path, world: World, every: int = 1, budget: int | None = None, overwrite: bool = False, *, strain: bool = True,
        forces: bool = False, velocities: bool = False, color: Any = None, live: bool | str = False, y_down: bool = False,
    ):  # fmt: skip
        import rerun as rr

        if not isinstance(world, World):
            hint = "; write tv.Recorder(path, world)" if isinstance(path, World) else ""
            hint = "; of many, tv.WorldsRecorder(path, worlds) draws some side by side" if isinstance(world, Worlds) else hint
            raise TypeError(f"Recorder: world = {world!r} is a {type(world).__name__}, but a tv.World is needed{hint}.")
        self._rr: Any = rr
        self.world = world
        self.every = checks.integer("Recorder", "every", every, least=1)
        self.budget = None if budget is None else checks.integer("Recorder", "budget", budget, least=1)
        down = checked_y_down("Recorder", world, y_down)
        coloring = Coloring.checked("Recorder", color, len(world.particles), None)
        if not coloring.function and (near := get_close_matches(coloring.name, QUANTITIES, 1, 0.8)):
            checks.warn(f"Recorder: color = {coloring.name!r} has to be given to each log(); did you mean {near[0]!r}?")
        following = coloring.following(world)
        self._overlays = Overlays.checked("Recorder", following, strain=strain, forces=forces, velocities=velocities, y_down=down)
        self._own: dict[str, Any] = {}  # the user's quantities, for the next frame that is drawn
        if path is None and not live:
            raise ValueError("Recorder: path = None is for live recordings; give a file, or live=True.")
        if live == "notebook" and path is not None:
            raise ValueError('Recorder: live="notebook" shows without a file; give path=None, or one of live=True and "web".')
        self.path, title = (os.devnull, "live") if path is None else checked_place("Recorder", path)
        self._live = live
        self.frames = self._calls = 0
        self._stride = self.every  # one of so many frames is drawn
        self._frame_bytes = 0  # about the bytes of a frame
        self._note = ""  # which frames the budget has left out
        self._full = self._closed = False  # whether the budget has ended the recording; whether close() was called
        self._open(title, overwrite)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    @interrupts.deferred_signals
    def _open(self, title: str, overwrite: bool) -> None:
        from . import viewer  # imported late, since it imports rerun and a server

        address = viewer.address(self._live) if self._live else None
        opens = layout(self.world, self._overlays)
        self._sink = Sink(self.path, f"tiverlet_{self.world.particles.dim}d", opens, title, overwrite, address)
        self._closing = weakref.finalize(self, self._sink.close)  # runs also when the process ends
        self._stream = self._sink.stream
        if self._live == "notebook":
            viewer.show_below_the_cell(self._stream)
            self._sink.show(opens, at_once=True)
        try:
            with self._sink.beginning("Recorder"):
                self._begin(title)
        except BaseException:
            if "_journal" in vars(self):
                self._journal.close()
            raise

    def _begin(self, title: str) -> None:
        """Write what holds for all frames, and the first frame."""
        world = self.world
        world._rebuild_for_knobs()  # rebuild for the present knobs first, so that the state belongs to their kernels
        explained = explain(world)
        self._picture = Picture(world, self._stream, explained, environment(), self._overlays)
        self._sent = perf_counter()
        self._picture.stamp(0)
        picture_settings = {"title": title, "explained": explained, "overlays": self._overlays.stored()}
        self._journal = Journal(world, self._write, picture_settings)
        self._note_state(self._journal.size)
        self._frame(0)
        self.flush()  # so that a process that ends early leaves a readable file
        least = self._sink.bytes + RESERVE
        if self.budget is not None and self.budget < 2 * least and not self._sink.error:
            raise ValueError(
                f"Recorder: budget = {self.budget} bytes, but the scene and its first frame take {least}. "
                f"Give at least {2 * least}."
            )

    def _write(self, text: str, blob: np.ndarray, checksum: str) -> None:
        self._stream.log(JOURNAL, self._rr.AnyValues(text=text, blob=blob, checksum=checksum), strict=True)

    @property
    def _logged(self) -> int:
        return self._picture.drawing.bytes + self._journal.bytes + 1500 * self.frames

    @property
    def bytes(self) -> int:
        """About how many bytes the file will have when it is closed."""
        return self._sink.bytes + self._logged - self._sink.flushed

    @interrupts.deferred_signals
    def log(self, **quantities) -> None:
        """Write the present frame, if it is one of `every`, and quantities of your own.

        These are numbers, which become curves, or arrays of one number per particle, (n,), for `color` and for programs that read
        the file, see tv.replay.

            recorder.log(height=float(x[:, 1].max()), heat=heat)

        Raises ValueError for any other value, and for the name of a built-in curve.
        """
        if self._full:
            return
        self._check()
        self._check_color(quantities)
        if quantities:
            self._own = checked_quantities(quantities, len(self.world.particles))
        self._calls += 1
        if self.budget is not None and self._bytes_left() < self._frame_bytes:
            self._thin()
        if self._full:
            return
        if self._calls % self._stride == 0:
            before = self._logged
            self._frame(self._calls)
            self._frame_bytes = max(self._frame_bytes, self._logged - before)
        now = perf_counter()
        if now - self._sent > SEND:
            self._picture.curves.send()
            self._sent = now
        self._sink.keep_up(self._logged)
        if self._sink.error:
            self._fail()

    @interrupts.deferred_signals
    def flush(self) -> None:
        """Wait until everything logged is in the file, where it stays even if the process is killed."""
        if self._full:
            return
        self._check()
        self._picture.curves.send()
        self._sink.flush(self._logged)

    def _check(self) -> None:
        """Raise RuntimeError if nothing can be written."""
        if self._sink.forked():
            raise RuntimeError(
                f"Recorder: {self.path} is recorded by the process that this one was forked from. Step and record there, or "
                'build the world and its Recorder in a process of its own, started by "spawn".'
            )
        if self._sink.stream is None:
            raise RuntimeError("Recorder: this recording is closed; make a new Recorder for another file.")

    def _check_color(self, quantities: dict[str, Any]) -> None:
        """Raise ValueError if log() is not given the quantity of the colours, or is given one that is computed."""
        color = self._overlays.color
        if color.function and color.name in quantities:
            raise ValueError(f"Recorder.log: {color.name} is computed for the colours of the picture; choose another name.")
        if color.name and not (color.function or self._calls or np.ndim(quantities.get(color.name, 0.0))):
            raise ValueError(
                f"Recorder: color = {color.name!r} is neither one of {', '.join(QUANTITIES)} nor given to log(). Write "
                f"recorder.log(**{{{color.name!r}: ...}}), with a number for each particle."
            )

    def _fail(self) -> None:
        error = self._sink.error
        assert error
        self._closed = True
        self._journal.close()
        self._closing()
        gone = isinstance(error, FileNotFoundError)
        rest = "What was recorded is lost" if gone else "What the file holds can be replayed"
        raise file_error(error, f"Recorder: writing {self.path} failed at frame {self._calls}", f". {rest}") from None

    def _bytes_left(self) -> int:
        """Return the free bytes of the budget, after the data that wait to be written and the end of the recording."""
        assert self.budget is not None
        return self.budget - self.bytes - RESERVE

    def _thin(self) -> None:
        """Make room for more frames: keep the picture of every other frame, until a quarter of the budget is free.

        Where no more frames can be removed, the recording ends.
        """
        assert self.budget is not None
        self.flush()
        room = self._frame_bytes
        while self._bytes_left() < room and not self._sink.error:
            self._stride, room = 2 * self._stride, max(self._frame_bytes, self.budget // 4)
            self._journal.put("thinned", {"stride": self._stride})
            self.flush()
            self._note = (
                f"Recorder: to stay within budget = {self.budget} bytes, the picture has one of {self._stride} frames. All "
                "steps are in the file; for more frames give a larger budget."
            )
            if self._calls < 2 * self._stride or not self._sink.thin(self._stride):
                break
        if self._bytes_left() < self._frame_bytes:
            self._full = True
            self._note += f" They do not fit in it after frame {self._calls}, where the recording ends."
            self._finish()

    def _note_state(self, size: int) -> None:
        """Schedule the next exact state, after one of `size` bytes was written."""
        self._bytes_between_states = SHARE * size
        self._drawn, self._last_state = self._picture.drawing.bytes, self._calls

    def _frame(self, number: int) -> None:
        world, journal, picture = self.world, self._journal, self._picture
        journal.frame = number
        picture.stamp(number)
        sparse = number - self._last_state >= SPARSE * self._stride // self.every
        due = picture.drawing.bytes - self._drawn > self._bytes_between_states or sparse
        if number and due and not world._has_new_force:  # a state does not contain the force under which it was computed
            self._note_state(journal.state())
        if self._overlays.color.function:
            self._own[self._overlays.color.name] = self._overlays.color.values(world)
        if self._own:
            numbers = {name: value for name, value in self._own.items() if isinstance(value, float)}
            arrays = {name: value for name, value in self._own.items() if not isinstance(value, float)}
            journal.put("logged", {"numbers": numbers}, arrays)
            picture.log(number, self._own)
            self._own = {}
        data, _ = picture.frame(number, journal.rounded(), journal.scenes, journal.changed_features)
        journal.frame_drawn(data)
        self.frames += 1

    @interrupts.deferred_signals
    def close(self) -> None:
        """Write the summary and finish the file. Calling it twice does nothing."""
        if self._closed or self._sink.forked():
            return
        self._closed = True
        if not self._full:
            self._finish()
        if not self._calls and self._journal.worst:
            checks.warn(
                f"Recorder: log() was never called, so {self.path} shows only the frame at the start. Call recorder.log() after "
                "each step, or give world.run(seconds, recorder=recorder)."
            )
        if self._note:
            checks.warn(self._note)

    def _finish(self) -> None:
        journal, world = self._journal, self.world
        journal.close()
        self._picture.curves.send()
        end: dict[str, Any] = {"frames": self.frames, "time": world.time}
        with contextlib.suppress(RuntimeError):  # a closed world, or one whose Taichi was restarted, has no state
            end["hash"] = world.hash()
        if "hash" in end:
            self._picture.end(journal.worst, self.frames, self._note)
        journal.put("end", {**end, "note": self._note, **flags_to_record(journal.worst)})
        self._sink.finish(self._picture.layout() if "hash" in end else None)
        self._closing()
        if self._sink.error:
            self._fail()
