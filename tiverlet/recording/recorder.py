"""Writing a simulation to a file for the rerun viewer."""

import os
import uuid
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from ..constraints import Box, Path
from ..facets import Facets
from ..feature import Batch
from ..tools import golden_colors
from ..wall import Wall

if TYPE_CHECKING:
    from ..world import World

SCENE = "world/scene"  # the view looks at "world", so that a mirror at "world/scene" shows
PARTICLES = f"{SCENE}/particles"
POINT = -2.5  # a particle without radius is drawn as a dot of so many pixels (negative: screen units)


class Recorder:
    """Writes frames of a world to an .rrd file: positions, links, walls, and curves of the figures of each frame.

        with tv.Recorder("rope.rrd", world) as recorder:
            world.step(1 / 60)
            recorder.log()

    path: the file; its folder must exist. world: what to record. every: log only each so many frames.

    Radii, colours and the layout are written once. Positions are stored as f32. The file is complete when the block ends; of a
    process that is killed, all but about the last fifth of a second is there. Open it with `rerun rope.rrd`.
    """

    def __init__(self, path, world: "World", every: int = 1):
        import rerun as rr

        self._rr: Any = rr
        self._world = world
        self.every = checks.integer("Recorder", "every", every, least=1)
        self.path = os.fspath(path)
        folder = os.path.dirname(os.path.abspath(self.path))
        if not os.path.isdir(folder):
            raise ValueError(f"Recorder: the folder {folder} does not exist. Make it first: os.makedirs({folder!r}).")
        self.frames = self._calls = 0
        self._worst = None
        self._stream: Any = rr.RecordingStream(f"tiverlet_{world.particles.dim}d", recording_id=uuid.uuid4())
        self._open()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def _open(self) -> None:
        from .layout import CURVES, MIRROR, blueprint

        rr, world = self._rr, self._world
        low, high = _bounds(world)
        self._stream.save(self.path, default_blueprint=blueprint(low, high))
        self._stream.send_recording_name(os.path.splitext(os.path.basename(self.path))[0])
        if world.particles.dim == 2:
            self._static(SCENE, MIRROR)
        else:
            self._static(SCENE, rr.ViewCoordinates.RIGHT_HAND_Y_UP)
        p = world.particles
        colors = golden_colors(len(p))
        colors[p.inv_mass == 0] = (140, 140, 150)
        radii = np.where(p.radius > 0, p.radius, POINT)
        self._static(PARTICLES, self._points.from_fields(radii=radii, colors=colors))
        self._links = [(k, f) for k, f in enumerate(world.features) if isinstance(f, Batch) and f.arity == 2 and f.count]
        for k, _ in self._links:
            self._static(f"{SCENE}/links/{k}", self._strips.from_fields(colors=[[205, 205, 215]], radii=[-0.75]))
        for name, (title, color) in CURVES.items():
            self._static(f"figures/{name}", rr.SeriesLines(names=[title], colors=[color]))
        self._static("about", rr.TextDocument(_about(world), media_type="text/markdown"))
        self._walls: dict[int, bytes] = {}
        self._frame(0)

    @property
    def _points(self):
        return self._rr.Points2D if self._world.particles.dim == 2 else self._rr.Points3D

    @property
    def _strips(self):
        return self._rr.LineStrips2D if self._world.particles.dim == 2 else self._rr.LineStrips3D

    def _static(self, entity: str, what) -> None:
        self._stream.log(entity, what, static=True, strict=True)

    def log(self) -> None:
        """Write the present frame, if it is one of `every`."""
        if self._stream is None:
            raise RuntimeError("Recorder: this recording is closed; make a new Recorder for another file.")
        self._calls += 1
        report = self._world.last
        if report is not None:
            self._worst = report if self._worst is None else self._worst.worse(report)
        if self._calls % self.every == 0:
            self._frame(self._calls)

    def _frame(self, number: int) -> None:
        rr, world = self._rr, self._world
        self._stream.set_time("frame", sequence=number)
        self._stream.set_time("time", duration=world.time)
        x = world.position.astype(np.float32)
        self._stream.log(PARTICLES, self._points.from_fields(positions=x), strict=True)
        for k, f in self._links:
            whole = f.indices[~f.broken] if f.breaks else f.indices
            self._stream.log(f"{SCENE}/links/{k}", self._strips.from_fields(strips=x[whole]), strict=True)
        for k, f in enumerate(world.features):
            if isinstance(f, (Wall, Path)):
                self._wall(k, f)
        if number and world.last is not None:
            for name, value in _figures(world, number).items():
                self._stream.log(f"figures/{name}", rr.Scalars(value), strict=True)
        self.frames += 1

    def _wall(self, k: int, wall) -> None:
        """Walls are drawn when they have changed."""
        strips, thickness = wall.outline(*_bounds(self._world))
        key = strips.tobytes()
        if len(strips) and self._walls.get(k) != key:
            self._walls[k] = key
            radius = thickness if thickness else -1.5  # half the width in the scene, or pixels
            drawn = self._strips(strips, colors=[[120, 125, 140]], radii=[radius])
            self._stream.log(f"{SCENE}/walls/{k}", drawn, strict=True)

    def close(self) -> None:
        """Write the summary and finish the file. Calling it twice does nothing."""
        if self._stream is None:
            return
        text = _about(self._world, self._worst, self.frames)
        self._static("about", self._rr.TextDocument(text, media_type="text/markdown"))
        self._stream.disconnect()
        self._stream = None


def _figures(world: "World", number: int) -> dict[str, float]:
    r = world.last
    assert r
    out = {"residual": r.residual, "overlap": r.overlap, "energy": r.energy}
    if number > 1:  # the first frame compiles the kernels, and would dwarf all others
        out["milliseconds"] = r.seconds * 1e3
    return out


def _bounds(world: "World") -> tuple[np.ndarray, np.ndarray]:
    """A box around what will be seen: the walls where there is a finite Box, the particles where not."""
    x, r = world.position, world.particles.radius[:, None]
    low = (x - r).min(axis=0, initial=np.inf) if len(x) else np.zeros(world.particles.dim)
    high = (x + r).max(axis=0, initial=-np.inf) if len(x) else np.ones(world.particles.dim)
    for f in world.features:
        if isinstance(f, Facets) and f.turned_in:  # a container
            corners = f.placed(f.corners).reshape(-1, world.particles.dim)
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
        if isinstance(f, Box):
            low = np.where(np.isfinite(f.lower), np.minimum(low, f.lower), low)
            high = np.where(np.isfinite(f.upper), np.maximum(high, f.upper), high)
    return low, high


def _about(world: "World", worst=None, frames: int = 0) -> str:
    rows = [
        f"# {len(world.particles)} particles in {world.particles.dim}D",
        "",
        "```",
        world.explain(),
        "```",
    ]
    if worst is not None:
        rows[1:1] = [
            "", f"{frames} frames, {world.time:.4g} s simulated.", "",
            "| worst of all frames | |", "|---|---|", f"| constraint violation | {worst.residual:.2e} |",
            f"| overlap | {worst.overlap:.2e} radii |", f"| contacts | {worst.contacts} |",
            f"| flags | {', '.join(sorted(worst.flags)) or 'none'} |", *(f"\n{note}" for note in worst.notes),
        ]  # fmt: skip
    return "\n".join(rows)
