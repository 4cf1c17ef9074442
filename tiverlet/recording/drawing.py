"""Draws a world: particles, links, walls, contacts, breaks."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..colliders import Box, HalfSpace
from ..constraints.core.length import is_link
from ..features.feature import Batch
from ..forces import Gravity
from .bodies import bodies, rims
from .fill import Fill, outlines, within
from .hues import BY_BODY
from .images import InBox, box_of, crosses_box
from .journal import PARTICLES
from .layout import LEGEND, SCENE, WIDE
from .lines import Lines
from .overlays import AHEAD, ARROW, LOAD, Overlays, loads
from .strain import LEVELS, SCALE, levels, packed, tinted
from .surfaces import covered, lit, triangles
from .walls import EDGE, OPEN, WALL, outline, walled

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts

POINT = -2.5  # radius of the dot for a particle without radius (negative: pixels)
MANY = 5000  # most links drawn as lines; of more, an even selection
EDGES = (150, 120, 70)  # colour of a periodic box
HELD, PINS = (225, 228, 235), 200  # colour of the marks of fixed particles; no marks if there are more of them
MARK, SPOT = (24, 26, 32), 0.5  # marks that show rotation: their colour, and the radius of a spot on a sphere, in radii
LABEL = (118, 122, 132)  # legible on black and on white
BELOW, ABOVE = 5.0, 40.0  # draw orders in 2D: before and after lines (20) and particles (30)
FEW = 1500  # most particles for drawing contacts; with more, finding them takes too much of a frame
TOUCH = 4  # particles per drawn contact; those with the largest impulses are drawn


class Drawing:
    """The picture of a world in a rerun stream. `bytes` is about the size of the logged data, uncompressed."""

    def __init__(self, world: "World", stream: Any, extent: tuple[np.ndarray, np.ndarray], overlays: Overlays):
        import pyarrow
        import rerun as rr

        self._rr, self._pa, self.world, self._stream = rr, pyarrow, world, stream
        flat = world.particles.dim == 2
        self._points: Any = rr.Points2D if flat else rr.Points3D
        self._arrows: Any = rr.Arrows2D if flat else rr.Arrows3D
        self._strips: Any = rr.LineStrips2D if flat else rr.LineStrips3D
        self._flat = flat
        self._above = {"draw_order": ABOVE} if flat else {}  # in 3D the depth decides
        point = pyarrow.list_(pyarrow.field("item", pyarrow.float32(), nullable=False), world.particles.dim)
        self._strip = pyarrow.list_(pyarrow.field("item", point, nullable=False))  # the type of rerun's line strips
        self.bytes = 0
        self.extent, self._overlays = extent, overlays
        self.low, self.high = np.full((2, world.particles.dim), [[np.inf], [-np.inf]])  # corners of everything drawn
        self.logged: dict[str, np.ndarray] = {}  # the user's quantities of particles, as logged last
        self.scenes = 0  # the number of the scene that is drawn, from 1 on
        self._in_box = InBox()
        self._touched = self._broke_before = False
        self._broke: dict[str, list[int]] = {}  # see pop_broken()

    def static(self, entity: str, *what: Any) -> None:
        """Log data that hold for all frames."""
        self._stream.log(entity, *what, static=True, strict=True)

    def _log(self, entity: str, *what: Any) -> None:
        self._stream.log(entity, *what, strict=True)

    def begin(self, scenes: int) -> None:
        """Log everything that does not change until particles or features are added or removed.

        Then all of it is logged again, under another name. scenes: the number of scenes so far, of which some may have ended
        before a frame of them was drawn.
        """
        world, p = self.world, self.world.particles
        self._paint()
        self._root = f"{SCENE}/scene{scenes - 1}" if scenes > 1 else SCENE
        if self.scenes:
            self._log(SCENE, self._rr.Clear(recursive=True))
        self.scenes = scenes
        self._contacts = len(p) <= FEW and bool(world._runner.step.contacts)
        self._broken = {k: f.broken for k, f in enumerate(world.features) if isinstance(f, Batch) and f.breaks}
        self._broke = {str(k): np.flatnonzero(gone).tolist() for k, gone in self._broken.items() if gone.any()}
        self._join()
        radii = np.where(p.radius > 0, p.radius, POINT)
        if len(self._corners):
            radii[covered(world, self._corners) & (p.inv_mass > 0)] = 0.0  # hidden by the surface
        fixed = {} if self._overlays.color.name else {"colors": self._hues}  # static colours would override those of each frame
        what = [self._points.from_fields(radii=radii, **fixed)]
        what += [self._rr.Mesh3D.from_fields(triangle_indices=self._corners.astype(np.uint32))] if len(self._corners) else []
        what += [self._strips.from_fields(radii=[-1.2])] if self._lines else []
        self.static(f"{self._root}/{PARTICLES}", *what)
        held = np.flatnonzero(p.inv_mass == 0)
        if 0 < len(held) <= PINS:
            at = self.drawn_positions(world.position)[held].astype(np.float32)
            marks = self._points.from_fields(positions=at, radii=[-3.5], colors=[HELD], **self._above)
            self._log(f"{self._root}/held", marks)  # not static, since static data cannot be cleared when the scene ends
        scale = self._overlays.scale(bool(len(self._pairs)))
        if scale:
            hues, labels = scale
            at = np.stack([WIDE * np.arange(len(hues)), np.full(len(hues), -0.6)], axis=1)
            ends = np.stack([at - [0.45 * WIDE, 0.4], at + [0.45 * WIDE, -0.4]], axis=1)
            self.static(f"{LEGEND}/scale", self._rr.LineStrips2D(ends, colors=hues, radii=[-5.0]))
            self.static(
                f"{LEGEND}/labels", self._rr.Points2D(at + [0, 0.1], colors=[LABEL], labels=labels, radii=[0], show_labels=True)
            )

    def _paint(self) -> None:
        """Take the present colours of particles, (n, 3)."""
        self._hues = self._overlays.color.colors(self.world, self.logged)

    def _join(self) -> None:
        """Collect all links: those that are part of a surface colour it, and the others are drawn as lines."""
        world = self.world
        found = links(world)
        none = np.zeros((0, 2), dtype=np.int64)
        self._pairs = np.concatenate([none, *(f.indices for _, f in found)])
        lengths = [f.rest if is_link(f) and not f.driven else np.full(f.count, np.nan) for _, f in found]
        self._rest = np.concatenate([[], *lengths])
        number, row = (np.concatenate([[], *each]).astype(np.int64) for each in (
            [np.full(f.count, k) for k, f in found], [np.arange(f.count) for _, f in found]
        ))  # fmt: skip  # of the feature, and of the link in it
        inside = np.zeros(0, dtype=np.int64)
        self._corners = np.zeros((0, 3), dtype=np.int64) if self._flat else triangles(world)
        under = np.isin(self._pairs, self._corners).all(axis=1)  # links of surfaces, which are not drawn as lines
        loops = outlines(world) if self._flat else []
        if loops:
            inside, breaks = within(world, loops), np.isin(number, list(self._broken))
            a, b = inside[self._pairs].T
            under = (a >= 0) & (a == b) & ~breaks
        some = np.flatnonzero(~under)
        some = some[:: -(-len(some) // MANY) or 1]
        self._lines = Lines(self._pairs[some]) if len(some) else None
        if not under.any():
            self._pairs, self._rest, number, row = (each[some] for each in (self._pairs, self._rest, number, row))
            some, under = np.arange(len(some)), np.zeros(len(some), dtype=bool)
        under &= ~np.isin(number, [k for k, f in found if np.any(getattr(f, "compliance", 0))])  # compliant links show no strain
        self._fill = None
        if loops:
            self._fill = Fill(loops, world.position, inside[self._pairs[under, 0]], rims(world))
            self.static(f"{self._root}/fill", self._strips.from_fields(radii=self._fill.radii, draw_order=BELOW))
        self._line_links, self._surface_links = some, under
        self._breakable_links = [(k, np.flatnonzero(number == k), row[number == k]) for k, _ in found if k in self._broken]

    def drawn_positions(self, x: np.ndarray) -> np.ndarray:
        """Return where particles at x, (n, dim) [m], are drawn: inside the periodic box, if there is one."""
        return self._in_box.drawn_positions(self.world, x)

    def frame(self, x: np.ndarray, x32: np.ndarray, changed_features: Iterable[int], broke: bool) -> None:
        """Draw a frame.

        x, x32: positions, (n, dim) [m], in full and in f32. changed_features: numbers of features with other knobs than in the
        last frame. broke: whether something broke since then.
        """
        radius, some = self.world.particles.radius[:, None], np.isfinite(x).all(axis=1)
        if some.any():
            self.low = np.minimum(self.low, (x - radius)[some].min(axis=0))
            self.high = np.maximum(self.high, (x + radius)[some].max(axis=0))
        # Log everything in one row, so that LZ4 matches the points of lines and sheets with those of the particles.
        colored = {}
        if self._overlays.color.name:
            self._paint()
            colored = {"colors": self._hues}
            self.bytes += self._hues.nbytes
        row = [self._points.from_fields(positions=x32, **colored)]
        self.bytes += x32.nbytes
        if len(self._pairs) or len(self._corners) or self._fill:
            row += self._link(x, x32)
        self._log(f"{self._root}/{PARTICLES}", *row)
        for k in changed_features:
            self._wall(k)
        self._touch(x)
        if self.world.particles.orientation is not None:
            self._mark(x)
        if self._overlays.velocities:
            way = (AHEAD * self.world.velocity).astype(np.float32)
            arrows = self._arrows.from_fields(origins=x32, vectors=way, colors=[ARROW], radii=[-0.7], **self._above)
            self._log(f"{self._root}/velocities", arrows)
            self.bytes += 2 * x32.nbytes
        if broke or self._broke_before:
            self._breaks(x)
            self._broke_before = broke

    def _mark(self, x: np.ndarray) -> None:
        """Draw how far particles have turned: a line from the centre to the rim of a disc, two dots on a sphere."""
        marks = marked(x, self.world.particles.radius, self.world.orientation)
        at = marks.astype(np.float32)
        if self._flat:
            strips = self._packed(at.reshape(-1, 2), 2 * np.arange(len(at) + 1))
            what = self._strips.from_fields(strips=strips, colors=[MARK], radii=[-1.0], draw_order=ABOVE)
        else:
            size = np.repeat(SPOT * self.world.particles.radius, 2)
            what = self._points.from_fields(positions=at.reshape(-1, 3), radii=size, colors=[MARK])
            self.bytes += at.nbytes
        self._log(f"{self._root}/marks", what)

    def _link(self, x: np.ndarray, x32: np.ndarray) -> list[Any]:
        """Return links, in the colours of strain or of their ends. Strips have rerun's own layout, which is ten times as fast."""
        r = x[self._pairs[:, 0]] - x[self._pairs[:, 1]]
        with np.errstate(divide="ignore", invalid="ignore"):
            level = levels(np.sqrt(np.einsum("ij,ij->i", r, r)) / self._rest - 1)
        if not self._overlays.strain:
            level[:] = LEVELS
        level[crosses_box(box_of(self.world), r)] = -1
        for k, mine, rows in self._breakable_links:
            level[mine[self._broken[k][rows]]] = -1
        row = []
        if len(self._corners):
            ends, under = self._pairs[self._surface_links].ravel(), np.repeat(level[self._surface_links], 2)
            shades = packed(lit(tinted(self._hues, ends, under), self._corners, x, upwards(self.world)))
            row.append(self._rr.Mesh3D.from_fields(vertex_positions=x32, vertex_colors=shades))
            self.bytes += shades.nbytes + x32.nbytes
        if self._lines:
            shown = level[self._line_links]
            by_strain = self._overlays.color is BY_BODY
            shades = SCALE[shown] if by_strain else packed(self._hues[self._pairs[self._line_links]].mean(axis=1))
            particles, ends, shades = self._lines.strips(np.where(shown < 0, -1, shades.astype(np.int64)))
            row.append(self._strips.from_fields(strips=self._packed(x32[particles], ends), colors=shades))
            self.bytes += shades.nbytes
        if self._fill:
            points, ends = self._fill.strips(x)
            shades = self._fill.colors(self._hues, level[self._surface_links])
            self._log(f"{self._root}/fill", self._strips.from_fields(strips=self._packed(points, ends), colors=shades))
            self.bytes += shades.nbytes
        return row

    def _packed(self, points: np.ndarray, ends: np.ndarray) -> Any:
        """Return strips of points (k, dim) in f32, the s-th from ends[s] to ends[s + 1], in rerun's own layout."""
        self.bytes += points.nbytes + ends.nbytes
        pa = self._pa
        listed = pa.FixedSizeListArray.from_arrays(pa.array(points.ravel()), type=self._strip.value_type)
        return pa.ListArray.from_arrays(pa.array(ends.astype(np.int32)), listed, type=self._strip)

    def _wall(self, k: int) -> None:
        """Draw a wall, a wire or a periodic box at its present place; a surface is lit from above."""
        shape = outline(self.world.features[k], *self.extent)
        if shape is None:
            return
        if len(shape.faces):
            hues = np.repeat(WALL if shape.active else WALL // 2, len(shape.vertices), axis=0)
            shades = packed(lit(hues, shape.faces, shape.vertices, upwards(self.world)))
            corners, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.uint32)
            what = self._rr.Mesh3D(vertex_positions=corners, triangle_indices=faces, vertex_colors=shades)
            self.bytes += corners.nbytes + shades.nbytes + faces.nbytes
        else:
            hue, thin = (EDGES, -0.8) if self.world.features[k] is box_of(self.world) else (EDGE if shape.active else OPEN, -1.5)
            what = self._strips(shape.strips, colors=[hue], radii=[shape.radius or thin])  # negative: pixels
            self.bytes += shape.strips.nbytes
        self._log(f"{self._root}/walls/{k}", what)

    def _touch(self, x: np.ndarray) -> None:
        """Draw the loads of contacts if requested, otherwise their points in a scene of few particles."""
        if self._overlays.forces and self.world._runner.step.contacts:
            where, radii = (a.astype(np.float32) for a in loads(self.world, x))
            what = self._strips.from_fields(strips=where, radii=radii, colors=[LOAD], **self._above)
        elif self._contacts:
            where = self._contact_points().astype(np.float32)
            what = self._points(where, radii=[-1.2], colors=[[20, 22, 28]])
        else:
            return
        if len(where) or self._touched:  # where there are none any more, an empty row clears the last ones
            self._touched = bool(len(where))
            self._log(f"{self._root}/contacts", what)
            self.bytes += where.nbytes

    def _contact_points(self) -> np.ndarray:
        """Return the points of the contacts with the largest impulses, (m, dim) [m]."""
        world = self.world
        if not world._clock.h:
            return np.zeros((0, world.particles.dim))
        found, box = world.contacts, box_of(world)
        most = np.argsort(-found.impulse, kind="stable")[: -(-len(world.particles) // TOUCH)]
        middle = found.point[np.sort(most)]
        return middle if box is None else box.wrap(middle)

    def _breaks(self, x: np.ndarray) -> None:
        """Draw a mark where a constraint broke since the last frame, and add a line to the list of events."""
        marks = [np.zeros((0, x.shape[1]))]
        for k, before in self._broken.items():
            f = self.world.features[k]
            now = f.broken  # type: ignore[attr-defined]
            new = np.flatnonzero(now & ~before)
            self._broken[k] = now
            if len(new):
                self._broke.setdefault(str(k), []).extend(new.tolist())
                marks += [x[f.members_of(c)].mean(axis=0, keepdims=True) for c in new.tolist()]  # type: ignore[attr-defined]
                named = ", ".join(map(str, new[:20].tolist())) + (" ..." if len(new) > 20 else "")
                self.event(f"{f!r} (feature {k}): {len(new)} broke: {named}", "WARN")
        at = np.concatenate(marks).astype(np.float32)
        self._log(f"{self._root}/breaks", self._points(at, radii=[-7.0], colors=[[255, 60, 60, 180]]))

    def pop_broken(self) -> dict[str, list[int]]:
        """Return the constraints that broke since the last call or had broken when the scene began, by the feature's number."""
        broke, self._broke = self._broke, {}
        return broke

    def event(self, text: str, level: str = "INFO") -> None:
        """Add a line to the list of events."""
        self._log("events", self._rr.TextLog(text, level=level))
        self.bytes += len(text)


def marked(x: np.ndarray, radius: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Return the marks of particles with these orientations, (n, 2, dim): the ends of a line, or two places on the surface."""
    if x.shape[1] == 2:
        rim = x + radius[:, None] * np.stack([np.cos(orientation), np.sin(orientation)], axis=1)
        return np.stack([x, rim], axis=1)
    u, w = orientation[:, :3], orientation[:, 3:]
    axis = np.zeros_like(u) + [1.0, 0.0, 0.0]
    turned = axis + 2 * np.cross(u, np.cross(u, axis) + w * axis)
    out = (1.02 - SPOT) * radius[:, None] * turned
    return np.stack([x + out, x - out], axis=1)


def upwards(world: "World | Parts") -> np.ndarray:
    """Return the direction against gravity, (dim,); along y without gravity."""
    dim = world.particles.dim
    up = np.zeros(dim)
    for f in world.features:
        if isinstance(f, Gravity):
            g = np.asarray(f.g, dtype=np.float64)
            up -= g if g.ndim else -g * np.eye(dim)[1]
    size = float(np.linalg.norm(up))
    return up / size if size else np.eye(dim)[1]


def view_up(world: "World | Parts", y_down: bool = False) -> np.ndarray:
    """Return the direction that points up in pictures, (dim,): against gravity in 3D; along y in 2D, or against it for y_down."""
    return upwards(world) if world.particles.dim == 3 else np.array([0.0, -1.0 if y_down else 1.0])


def links(world: "World | Parts") -> list[tuple[int, Batch]]:
    """Return the features drawn as lines between two particles, with their numbers."""
    return [(k, f) for k, f in enumerate(world.features) if isinstance(f, Batch) and f.arity == 2 and f.count]


def bounds(world: "World") -> tuple[np.ndarray, np.ndarray]:
    """Return a box around everything that will be visible: the particles and where they can get to, as far as known beforehand.

    The box includes finite walls, the ground below, and the circle around the point from which a body hangs.
    """
    x, r = InBox().drawn_positions(world, world.position), world.particles.radius[:, None]
    low = (x - r).min(axis=0, initial=np.inf) if len(x) else np.zeros(world.particles.dim)
    high = (x + r).max(axis=0, initial=-np.inf) if len(x) else np.ones(world.particles.dim)
    low, high = walled(world.features, low, high)
    for f in world.features:
        if isinstance(f, HalfSpace) and len(x):
            foot = x - np.maximum(0, x @ f.normal - f.offset)[:, None] * f.normal
            low, high = np.minimum(low, foot.min(axis=0)), np.maximum(high, foot.max(axis=0))
    body, fixed = bodies(world), world.particles.inv_mass == 0
    for k in np.unique(body[fixed]):
        held, all_of_it = x[fixed & (body == k)], x[body == k]
        reach = float(np.linalg.norm(all_of_it - held.mean(axis=0), axis=1).max())
        if np.ptp(held, axis=0).max() < 0.1 * reach:  # the body is held at nearly one point, so it can swing
            swing = held.mean(axis=0) - reach, held.mean(axis=0) + reach
            for f in world.features:
                if isinstance(f, Box):
                    swing = tuple(np.clip(corner, f.lower, f.upper) for corner in swing)
            low, high = np.minimum(low, swing[0]), np.maximum(high, swing[1])
    return low, high
