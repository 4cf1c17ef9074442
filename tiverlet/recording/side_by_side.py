"""WorldsRecorder: records some of many worlds in one file, each in a view of its own."""

import weakref
from collections.abc import Iterable
from typing import Any

import numpy as np

from .. import checks
from ..device import interrupts
from ..features.unknown_names import answer_names
from ..world import World
from ..worlds.worlds import Worlds
from . import scene
from .hues import Coloring
from .overlays import Overlays
from .sink import Sink, checked_place, file_error

MOST = 64  # most views in a recording
FEW = 9  # views by default


@answer_names
@checks.answer_calls
class WorldsRecorder:
    """Writes some of many worlds to an .rrd file as a grid of views, all at the same scale and time.

        with tv.WorldsRecorder("four.rrd", worlds, [0, 250, 500, 999]) as recorder:
            for _ in range(300):
                worlds.step(1 / 60)
                recorder.log()

    path: the file; its folder must exist. worlds: the worlds to record. chosen: the numbers of up to 64 of them; the first nine
    by default. every: log only one of so many frames. overwrite: whether an existing file may be replaced. strain, forces,
    velocities, color: what is drawn, as in Recorder; colours (n, 3) are those of each world. If worlds are reset, the time of the
    recording continues.

    The file is a picture only: it holds no states to continue from, and tv.replay refuses it. To get states, record one world by
    itself, bit for bit the same: make tv.Recorder(path, worlds[k]), and step that world. Open the file with `rerun four.rrd`.

    Raises ValueError and OSError if the file cannot be made, FileExistsError if it exists already, and OSError if it cannot be
    written any further.
    """

    def __init__(
        self, path, worlds: Worlds, chosen: Iterable[int] | None = None, every: int = 1, overwrite: bool = False, *,
        strain: bool = True, forces: bool = False, velocities: bool = False, color: Any = None,
    ):  # fmt: skip
        if not isinstance(worlds, Worlds):
            hint = "; one World is for tv.Recorder(path, world)" if isinstance(worlds, World) else ""
            raise TypeError(f"WorldsRecorder: worlds = {worlds!r} is a {type(worlds).__name__}, not a tv.Worlds{hint}.")
        self.worlds, (self.path, title) = worlds, checked_place("WorldsRecorder", path)
        numbers = range(min(FEW, len(worlds))) if chosen is None else chosen
        self.chosen = checks.indices("WorldsRecorder", "chosen", np.asarray([*numbers]), len(worlds), things="worlds").tolist()
        if not 0 < len(self.chosen) <= MOST or len({*self.chosen}) < len(self.chosen):
            raise ValueError(f"WorldsRecorder: chosen = {self.chosen}, but it must be 1 to {MOST} numbers, each once.")
        self.every = checks.integer("WorldsRecorder", "every", every, least=1)
        (count,) = worlds.each(lambda world: len(world.particles), self.chosen[:1])
        color = Coloring.checked("WorldsRecorder", color, count)
        overlays = Overlays.checked("WorldsRecorder", color, strain=strain, forces=forces, velocities=velocities)
        self.frames = self._calls = 0
        self._before = self._last = 0.0  # [s] the total time before the last reset; the time of the last frame
        with interrupts.deferred_signals:
            self._open(title, overlays, overwrite)

    def _open(self, title: str, overlays: Overlays, overwrite: bool) -> None:
        from .drawing import bounds, links, view_up

        def known(world: World) -> tuple:
            """Return the corners of a world's view, the direction up, and the title of its colour scale."""
            return bounds(world), view_up(world), overlays.title(bool(links(world)))

        each, self._ups, titles = zip(*self.worlds.each(known, self.chosen), strict=True)
        self._title, corners = titles[0], np.array(each)  # (worlds, 2, dim)
        self._extent = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
        dim = corners.shape[2]
        opens = self._layout(*self._extent)
        self._sink = Sink(self.path, f"tiverlet_worlds_{dim}d", opens, title, overwrite)
        self._closing = weakref.finalize(self, self._sink.close)  # runs also when the process ends
        with self._sink.beginning("WorldsRecorder"):
            below = iter([_Below(f"worlds/{k}", self._sink.stream) for k in self.chosen])
            self._views = self.worlds.each(lambda world: _View(world, next(below), self._extent, overlays), self.chosen)
            self._draw()
            self._sink.flush()

    def __enter__(self) -> "WorldsRecorder":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    @interrupts.deferred_signals
    def log(self) -> None:
        """Write the present frame, if it is one of `every`."""
        if self._sink.forked() or self._sink.stream is None:
            raise RuntimeError("WorldsRecorder: this recording is closed, or of another process; make a new one.")
        self._calls += 1
        if self._calls % self.every == 0:
            self._draw()
        self._sink.keep_up(sum(view.drawing.bytes for view in self._views))
        self._fail()

    def _draw(self) -> None:
        time = float(self.worlds.time[self.chosen].max())
        self._before += self._last if time < self._last else 0.0
        self._last = time
        stream, views = self._sink.stream, iter(self._views)
        stream.set_time("frame", sequence=self._calls)
        stream.set_time("time", duration=self._before + time)
        self.worlds.each(lambda world: next(views).frame(world), self.chosen)
        self.frames += 1

    def _layout(self, low: np.ndarray, high: np.ndarray) -> Any:
        """Return the layout of the viewer. low, high: corners of the visible region [m]."""
        from .layout import grid, legend_view, scene_view, unit

        scale = unit(*self._extent)
        views = [
            scene_view(scale * low, scale * high, up, f"worlds/{k}/world", f"World {k}")
            for k, up in zip(self.chosen, self._ups, strict=True)
        ]
        return grid(views, legend_view(self._title, f"worlds/{self.chosen[0]}/legend") if self._title else None)

    def _fail(self) -> None:
        if error := self._sink.error:
            self._closing()
            raise file_error(error, f"WorldsRecorder: writing {self.path} failed at frame {self._calls}")

    @interrupts.deferred_signals
    def close(self) -> None:
        """Finish the file. Calling it twice does nothing."""
        if self._sink.forked() or self._sink.stream is None:
            return
        from .picture import framed

        low = np.min([view.drawing.low for view in self._views], axis=0)
        high = np.max([view.drawing.high for view in self._views], axis=0)
        self._sink.finish(self._layout(*framed(self._extent, low, high)))
        self._closing()
        self._fail()


class _View:
    """One world among others: a Drawing under entities of its own."""

    def __init__(self, world: World, stream: "_Below", extent: tuple[np.ndarray, np.ndarray], overlays: Overlays):
        from .drawing import Drawing, upwards, view_up
        from .layout import SCENE, transform, unit, upright

        dim = world.particles.dim
        self.drawing = Drawing(world, stream, extent, overlays)
        self._known: list[Any] = [None for _ in world.features]
        self._broken = 0
        turn = [upright(upwards(world))] if dim == 3 else []
        self.drawing.static(SCENE, transform(view_up(world), unit(*extent)), *turn)
        self.drawing.begin(1)

    def frame(self, world: World) -> None:
        """Draw the world's present state."""
        self.drawing.world = world
        now = [scene.knobs(f) for f in world.features]
        changed = [i for i, (new, old) in enumerate(zip(now, self._known, strict=True)) if old is None or not _equal(new, old)]
        self._known = now
        broken = sum(int(f.broken.sum()) for f in world.features if getattr(f, "breaks", False))  # type: ignore[attr-defined]
        x = self.drawing.drawn_positions(world.position)
        self.drawing.frame(x, x.astype(np.float32), changed, broken != self._broken)
        self._broken = broken


class _Below:
    """A rerun stream that puts all entities under one root."""

    def __init__(self, root: str, stream: Any):
        self._root, self._stream = root, stream

    def log(self, entity: str, *what: Any, **options: Any) -> None:
        """Log under the root, as rerun's stream does."""
        self._stream.log(f"{self._root}/{entity}", *what, **options)


def _equal(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(value, other[name]) for name, value in one.items())
