"""What of a world is drawn, and how: particles, links by their strain, walls, contacts, breaks."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders import Box, Mesh, Polygon
from ..colliders.collider import Collider
from ..constraints import Path
from ..constraints.distance import Link
from ..features.feature import Batch
from ..tools import golden_colors
from .journal import PARTICLES
from .layout import LEGEND, SCENE, WIDE
from .lines import Lines, Sheet
from .strain import legend, levels

if TYPE_CHECKING:
    from ..world import World

POINT = -2.5  # a particle without radius is drawn as a dot of so many pixels (negative: screen units)
MANY = 5000  # links that are drawn as lines; of more, an even selection
SHEET = 100_000  # links up to which it is asked whether they are a sheet
FEW = 1500  # particles up to which contacts are drawn; finding them would take too much of the frame beyond
TOUCH = 4  # one contact is drawn for so many particles, those that push most


class Drawing:
    """The picture of a world in a rerun stream. `bytes` is about what was logged, uncompressed."""

    def __init__(self, world: "World", stream: Any, extent: tuple[np.ndarray, np.ndarray]):
        import pyarrow
        import rerun as rr

        self._rr, self._pa, self.world, self._stream = rr, pyarrow, world, stream
        flat = world.particles.dim == 2
        self._points: Any = rr.Points2D if flat else rr.Points3D
        self._strips: Any = rr.LineStrips2D if flat else rr.LineStrips3D
        self._flat = flat
        point = pyarrow.list_(pyarrow.field("item", pyarrow.float32(), nullable=False), world.particles.dim)
        self._strip = pyarrow.list_(pyarrow.field("item", point, nullable=False))  # of rerun's lines
        self.bytes = 0
        self._extent = extent
        self.scenes = 0  # that were begun
        self._touched = self._torn = False

    def static(self, entity: str, *what: Any) -> None:
        """Log what holds for all frames."""
        self._stream.log(entity, *what, static=True, strict=True)

    def _log(self, entity: str, *what: Any) -> None:
        self._stream.log(entity, *what, strict=True)

    def begin(self) -> None:
        """What does not change until particles or features come or go; then all is drawn anew, under another name."""
        world, p = self.world, self.world.particles
        self._root = f"{SCENE}/scene{self.scenes}" if self.scenes else SCENE
        if self.scenes:
            self._log(SCENE, self._rr.Clear(recursive=True))
        self.scenes += 1
        self._contacts = len(p) <= FEW and bool(world._runner.step.contacts)
        self._broken = {k: f.broken for k, f in enumerate(world.features) if isinstance(f, Batch) and f.breaks}
        hues = golden_colors(len(p))
        hues[p.inv_mass == 0] = (140, 140, 150)
        self._join()
        what = [self._points.from_fields(radii=np.where(p.radius > 0, p.radius, POINT), colors=hues)]
        what += [self._sheet.mesh(self._rr)] if self._sheet else []
        what += [self._strips.from_fields(radii=[-1.2])] if self._lines else []
        self.static(f"{self._root}/{PARTICLES}", *what)
        if len(self._pairs):
            hues, labels = legend()
            at = np.stack([WIDE * np.arange(len(hues)), np.zeros(len(hues))], axis=1)
            ends = np.stack([at - [0.45 * WIDE, 0.4], at + [0.45 * WIDE, -0.4]], axis=1)
            self.static(f"{LEGEND}/scale", self._rr.LineStrips2D(ends, colors=hues, radii=[-5.0]))
            self.static(
                f"{LEGEND}/labels", self._rr.Points2D(at + [0, 0.5], colors=hues, labels=labels, radii=[0], show_labels=True)
            )

    def _join(self) -> None:
        """All links together: as a sheet what is one, and the others as lines."""
        world = self.world
        found = links(world)
        none = np.zeros((0, 2), dtype=np.int64)
        self._pairs = np.concatenate([none, *(f.indices for _, f in found)])
        self._rest = np.concatenate([[], *(f.rest if isinstance(f, Link) else np.full(f.count, np.nan) for _, f in found)])
        number, row = (np.concatenate([[], *each]).astype(np.int64) for each in (
            [np.full(f.count, k) for k, f in found], [np.arange(f.count) for _, f in found]
        ))  # fmt: skip  # of the feature, and of the link in it
        self._sheet = None
        rest = np.ones(len(self._pairs), dtype=bool)  # of links that are not in it
        if not self._flat and not any(k in self._broken for k, _ in found) and 0 < len(self._pairs) <= SHEET:
            start = found[0][1].start.position
            sheet = Sheet(self._pairs, start) if len(start) == len(world.particles) else None
            if sheet and len(sheet.triangles):
                self._sheet, rest = sheet, ~sheet.used
        some = np.flatnonzero(rest)
        some = some[:: -(-len(some) // MANY) or 1]
        self._lines = Lines(self._pairs[some]) if len(some) else None
        if not self._sheet:
            self._pairs, self._rest, number, row = (each[some] for each in (self._pairs, self._rest, number, row))
            some = np.arange(len(some))
        self._some = some
        self._tears = [(k, np.flatnonzero(number == k), row[number == k]) for k, _ in found if k in self._broken]

    def frame(self, x: np.ndarray, x32: np.ndarray, turned: Iterable[int], torn: bool) -> None:
        """Draw a frame. x: (n, dim), and rounded to f32. turned: features that are not as they were in the last one. torn: if
        something broke since then.
        """
        # All in one row: then LZ4 finds the points of lines and sheets among those of the particles.
        row = [self._points.from_fields(positions=x32)]
        self.bytes += x32.nbytes
        if len(self._pairs):
            row += self._link(x, x32)
        self._log(f"{self._root}/{PARTICLES}", *row)
        for k in turned:
            self._wall(k)
        if self._contacts:
            self._contact()
        if torn or self._torn:
            self._breaks(x)
            self._torn = torn

    def _link(self, x: np.ndarray, x32: np.ndarray) -> list[Any]:
        """Links, coloured by their strain; strips go to rerun in its own layout, which is ten times as fast."""
        r = x[self._pairs[:, 0]] - x[self._pairs[:, 1]]
        with np.errstate(divide="ignore", invalid="ignore"):
            level = levels(np.sqrt(np.einsum("ij,ij->i", r, r)) / self._rest - 1)
        for k, mine, rows in self._tears:
            level[mine[self._broken[k][rows]]] = -1
        row = []
        if self._sheet:
            shades = self._sheet.colors(level)
            row.append(self._rr.Mesh3D.from_fields(vertex_positions=x32, vertex_colors=shades))
            self.bytes += shades.nbytes + x32.nbytes
        if self._lines:
            particles, ends, shades = self._lines.strips(level[self._some])
            pa = self._pa
            points = pa.FixedSizeListArray.from_arrays(pa.array(x32[particles].ravel()), type=self._strip.value_type)
            strips = pa.ListArray.from_arrays(pa.array(ends.astype(np.int32)), points, type=self._strip)
            row.append(self._strips.from_fields(strips=strips, colors=shades))
            self.bytes += shades.nbytes + ends.nbytes + x32[:1].nbytes * len(particles)
        return row

    def _wall(self, k: int) -> None:
        """A wall or a path, where it is now."""
        wall = self.world.features[k]
        if isinstance(wall, (Collider, Path)):
            strips, thickness = wall.outline(*self._extent)
            radius = thickness if thickness else -1.5  # half the width in the scene, or pixels
            self._log(f"{self._root}/walls/{k}", self._strips(strips, colors=[[120, 125, 140]], radii=[radius]))
            self.bytes += strips.nbytes

    def _contact(self) -> None:
        """Where particles touch: between the two."""
        world = self.world
        middle = np.zeros((0, world.particles.dim))
        if world._clock.h:
            found = world.contacts
            most = np.argsort(-found.impulse, kind="stable")[: -(-len(world.particles) // TOUCH)]
            middle = found.point[np.sort(most)]
        if not len(middle) and not self._touched:
            return
        self._touched = bool(len(middle))
        self._log(f"{self._root}/contacts", self._points(middle.astype(np.float32), radii=[-1.2], colors=[[20, 22, 28]]))
        self.bytes += middle.nbytes // 2

    def _breaks(self, x: np.ndarray) -> None:
        """A mark where something broke since the last frame, and a line in the list of events."""
        marks = [np.zeros((0, x.shape[1]))]
        for k, before in self._broken.items():
            f = self.world.features[k]
            now = f.broken  # type: ignore[attr-defined]
            new = np.flatnonzero(now & ~before)
            self._broken[k] = now
            for c in new.tolist():
                members = f.members_of(c)  # type: ignore[attr-defined]
                marks.append(x[members].mean(axis=0, keepdims=True))
            if len(new):
                named = ", ".join(map(str, new[:20].tolist())) + (" ..." if len(new) > 20 else "")
                self.event(f"{f!r} (feature {k}): {len(new)} broke: {named}", "WARN")
        at = np.concatenate(marks).astype(np.float32)
        self._log(f"{self._root}/breaks", self._points(at, radii=[-7.0], colors=[[255, 60, 60, 180]]))

    def event(self, text: str, level: str = "INFO") -> None:
        """A line in the list of events."""
        self._log("events", self._rr.TextLog(text, level=level))
        self.bytes += len(text)


def links(world: "World") -> list[tuple[int, Batch]]:
    """The features that are drawn as lines between two particles, with their numbers."""
    return [(k, f) for k, f in enumerate(world.features) if isinstance(f, Batch) and f.arity == 2 and f.count]


def bounds(world: "World") -> tuple[np.ndarray, np.ndarray]:
    """A box around what will be seen: the walls where there is a finite Box, the particles where not."""
    x, r = world.position, world.particles.radius[:, None]
    low = (x - r).min(axis=0, initial=np.inf) if len(x) else np.zeros(world.particles.dim)
    high = (x + r).max(axis=0, initial=-np.inf) if len(x) else np.ones(world.particles.dim)
    for f in world.features:
        if isinstance(f, (Mesh, Polygon)) and f.inside:  # a container
            corners = f.placed(f.facets.corners).reshape(-1, world.particles.dim)
            low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
        if isinstance(f, Box):
            low = np.where(np.isfinite(f.lower), np.minimum(low, f.lower), low)
            high = np.where(np.isfinite(f.upper), np.maximum(high, f.upper), high)
    return low, high
