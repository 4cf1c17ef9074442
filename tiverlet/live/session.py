"""A world that runs in real time while users watch it and move it by mouse."""

import copy
import os
import sys
import time
import webbrowser
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..constraints import Pin
from ..contact import Polygons
from ..features.feature import Batch
from ..forces import Hand
from ..recording.hues import Coloring
from ..recording.overlays import checked_y_down
from ..recording.scene import knobs, set_knobs
from ..recording.sink import check_replaceable
from ..step import checkpoint
from . import scene
from .parts import Parts
from .server import AHEAD, LOCAL, Server, Viewer

if TYPE_CHECKING:
    from ..recording import Recorder
    from ..world import World

DT = 1 / 60  # [s] of a frame at full speed
SLOWEST = 64
REFRESH = 0.25  # [s] between updates of pages while the scene is paused


class Session:
    """A world, its Hand, and the pages that show it.

    A frame is 1/60 s of simulated time, and frames are 1/60 s apart if the machine keeps up. At half speed a frame is half as
    long, so that slow motion is smooth and is computed more finely.
    """

    def __init__(
        self, world: "World", server: Server, *, title: str = "", record: str | os.PathLike | None = None,
        each_frame: Callable[["World"], None] | None = None, y_down: bool = False, color: Any = None,
    ):  # fmt: skip
        self.world, self.server, self.title, self.record, self.each_frame = world, server, title, record, each_frame
        if record is not None:
            check_replaceable(record)
        hands = [f for f in world.features if isinstance(f, Hand)]
        if not hands:
            hands = [Hand(np.zeros(world.particles.dim))]
            world.add(features=hands)
        self.hand = hands[0]
        self.paused, self.slower, self.steps, self.restarts = False, 1, 0, 0
        self._single_frame = False  # whether to compute one frame of a paused scene
        self._start = checkpoint.keep(world), checkpoint.flags(world)
        self._knobs = [copy.deepcopy(knobs(f)) for f in world.features]
        self._structure = _structure(world)  # at the start
        self._computed: deque[tuple[float, float]] = deque(maxlen=30)  # for each frame: its begin [s] and computing time [ms]
        self.y_down = checked_y_down("play", world, y_down)
        self.color = color
        self._parts = Parts(world, title, self.y_down, Coloring.checked("play", color, len(world.particles)))
        self._sent = 0.0
        self._holder: Viewer | None = None
        self._recorder: Recorder | None = None
        self._recording()

    def _recording(self) -> None:
        """Begin a file, if one was requested."""
        if self.record is not None:
            from ..recording import Recorder

            self._recorder = Recorder(self.record, self.world, overwrite=True, y_down=self.y_down, color=self.color)

    def close(self) -> None:
        """Finish the file, and leave the world."""
        self._parts.close()
        if self._recorder is not None:
            self._recorder.close()

    def advance(self) -> None:
        """Process the messages of pages, compute a frame, and send it."""
        heard = self._process_requests()
        if not self.paused or self._single_frame:
            self._single_frame = False
            self._step()
        elif not heard and time.monotonic() - self._sent < REFRESH:
            return
        self._show()

    def run(self, frames: int | None = None) -> None:
        """Compute frames in real time, until interrupted; or so many of them."""
        due = time.perf_counter()
        while frames is None or frames > 0:
            frames = None if frames is None else frames - 1
            self.advance()
            due = max(due + DT, time.perf_counter() - DT)  # do not catch up on lost time
            time.sleep(max(0.0, due - time.perf_counter()))

    def _step(self) -> None:
        clock = time.perf_counter()
        if self.each_frame:
            self.each_frame(self.world)
        self.world.step(DT / self.slower)
        if self._recorder is not None:
            self._recorder.log()
        self.steps += 1
        self._computed.append((clock, 1e3 * (time.perf_counter() - clock)))

    def _restart(self) -> None:
        """Return to the start, with the knobs of then, and begin the file again."""
        world = self.world
        if _structure(world) != self._structure:
            raise ValueError("There is no way back: particles or features were added or removed. Run the scene again.")
        if self._recorder is not None:
            self._recorder.close()
        for feature, then in zip(world.features, self._knobs, strict=True):
            set_knobs(feature, then)
        if any(f.needs_other_kernels for f in world.features):
            world._rebuild_for_knobs()
        checkpoint.install(world, *self._start)
        if self.hand.particle >= 0:
            self.hand.particle = -1
        self._parts.regrouped()
        self._computed.clear()
        self.restarts += 1
        self._recording()

    def _process_requests(self) -> bool:
        """Process the requests of pages; return whether there were any."""
        heard = False
        while not self.server.received.empty():
            viewer, message = self.server.received.get()
            heard = True
            try:
                self._process_request(viewer, message)
            except (ValueError, TypeError, KeyError) as e:  # an invalid request must not stop the scene
                viewer.send(scene.message(str(e)))
        return heard

    def _process_request(self, viewer: Viewer, message: dict[str, Any]) -> None:
        what = message.get("do")
        if what == "pause":
            self.paused = not self.paused
        elif what == "frame":
            self.paused = self._single_frame = True
        elif what == "restart":
            self._restart()
        elif what == "slower":
            self.slower = min(2 * self.slower, SLOWEST)
        elif what == "faster":
            self.slower = max(self.slower // 2, 1)
        elif what == "grab":
            self.hand.target, self.hand.particle = message["target"], message["particle"]
            self._holder = viewer
        elif what == "move":
            if self.hand.particle >= 0 and viewer is self._holder:
                self.hand.target = message["target"]
        elif what in ("drop", "went"):
            if self.hand.particle >= 0 and viewer is self._holder:
                self.hand.particle = -1
        elif what == "name":
            viewer.send(scene.message(scene.describe_particle(self.world, message["particle"])))

    def _figures(self) -> dict[str, Any]:
        """Return the figures of the last frame."""
        report, out = self.world.last, {"time": self.world.time, "paused": self.paused, "slower": self.slower, "step": self.steps}
        if len(self._computed) > 1:
            first, last = self._computed[0][0], self._computed[-1][0]
            out["rate"] = (len(self._computed) - 1) / max(last - first, 1e-9) * DT
            out["ms"] = float(np.median([ms for _, ms in self._computed]))
        if report:
            out |= {name: getattr(report, name) for name in ("substeps", "iterations", "residual", "overlap", "energy")}
            out["notes"] = list(report.notes)
        if self.hand.particle >= 0:
            out |= {"held": self.hand.particle, "target": np.asarray(self.hand.target).tolist()}
        return out

    def _show(self) -> None:
        """Send the frame to all pages that keep up."""
        self._sent = time.monotonic()
        ready = [viewer for viewer in self.server.viewers if viewer.waiting < AHEAD]
        if not ready:
            return
        parts, places = self._parts.current(), self._parts.drawn_positions()
        message = scene.frame(self.world, self._figures(), places, self._parts.coloring)
        for viewer in ready:
            for kind, part in parts.items():
                if viewer.known.get(kind) is not part:
                    viewer.known[kind] = part
                    viewer.send(part)
            viewer.waiting += 1
            viewer.send(message)


def _structure(world: "World") -> list[Any]:
    """Return what only adding and removing particles and features changes, to be compared."""
    p = world.particles
    out: list[Any] = [world.features, *(values.tobytes() for values in (p.mass, p.radius, p.pinned, p.group))]
    for f in world.features:
        if isinstance(f, Polygons):
            out += [loop.tobytes() for loop in f.loops]
        elif isinstance(f, Batch) and not isinstance(f, Pin):  # a knob changes the particles of a pin
            out.append(f.indices.tobytes())
    return out


@checks.answer_arguments
def play(
    world: "World", *, record: str | os.PathLike | None = None, each_frame: Callable[["World"], None] | None = None,
    title: str = "tiverlet", port: int = 0, browser: bool = True, y_down: bool = False, color: Any = None,
) -> None:  # fmt: skip
    """Run a world in real time in a page of the browser, where the user can drag its particles, until Ctrl-C.

    Drag a particle with the mouse; the page lists the keys. The world gets a Hand, unless it has one, and keeps its state
    afterwards.

    record: a file that is written meanwhile, see Recorder. It contains what the hand did, which is computed again bit for bit.
    After a restart the file begins again. each_frame: called with the world before each frame, for example to move walls. title:
    of the page. port: 0 uses a free one. browser: whether to open the page; its address is printed in any case.
    y_down: whether y points down, as in coordinates of pixels (2D). color: None, by body; or colours (n, 3), a quantity such as
    "speed", or a function of the world, as in Recorder.

    The page is served to this machine only. To watch from another machine, forward the port: ssh -L PORT:127.0.0.1:PORT host, and
    open the address there; over SSH this command is printed. In a notebook the page shows below the cell, which runs until it is
    interrupted.

    Raises ModuleNotFoundError without the package websockets: pip install 'tiverlet[play]'.
    """
    server = Server(port)
    session = None
    try:
        session = Session(world, server, title=title, record=record, each_frame=each_frame, y_down=y_down, color=color)
        _announce(server, browser)
        session.run()
    except KeyboardInterrupt:
        pass
    finally:
        if session:
            session.close()
        server.close()


def _announce(server: Server, browser: bool) -> None:
    """Print the address, and open it where possible."""
    if "ipykernel" in sys.modules:
        from IPython.display import IFrame, display  # type: ignore[import-not-found]

        display(IFrame(server.url, width="100%", height=600))
        return
    print(f"{server.url}   (Ctrl-C ends it)", flush=True)
    if os.environ.get("SSH_CONNECTION"):
        print(
            f"From your machine: ssh -L {server.port}:{LOCAL}:{server.port} this-host, then open the address there.", flush=True
        )
    elif browser and not webbrowser.open(server.url):
        print("No browser was found here: open the address in one.", flush=True)
