"""Pictures of frames drawn in software: faces lit from above, particles as discs, links and walls as lines.

They need no graphics driver and some hundredths of a second each, where the viewer takes two seconds. They show less: neither
strain nor contacts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from ... import checks
from ..bodies import rims
from ..images import box_of, crosses_box
from ..layout import CAMERA, eye_axes
from ..scene import Parts
from ..surfaces import lit
from ..walls import EDGE, OPEN, WALL, outline, walled
from .geometry import Geometry

WIDE, MARGIN = 640, 0.04  # width [pixels]; share of it left free on each side
FINE = 2  # factor of oversampling in each direction, for smooth edges
STEP = 16  # sizes are multiples of so many pixels, as video requires
TALL = (0.3, 1.2)  # least and most ratio of height to width
DOT, LINE = 3, 1.5  # [pixels] diameter of a particle without radius, half the width of a line
# Background, inactive walls, surfaces of walls.
THEMES = {
    "dark": ((13, 16, 17), OPEN, WALL),
    "light": ((250, 250, 250), (200, 203, 210), np.array([[190, 194, 205]], dtype=np.uint8)),
}


@dataclass(frozen=True)
class Look:
    """How pictures look.

    size: width and height [pixels]; None for the height takes that of the scene. camera: angles of the eye in 3D [rad]: how far
    it stands to the right of the front, and above the horizon. theme: one of THEMES.
    """

    size: tuple[int, int | None] = (WIDE, None)
    camera: tuple[float, float] = CAMERA
    theme: str = "dark"

    @staticmethod
    def checked(size: Any, camera: Any, theme: Any, dim: int) -> "Look":
        """Return a look from the arguments of Replay.export(), or raise ValueError or TypeError."""
        who = "replay"
        wide: Any = WIDE
        tall: Any = None
        if size is not None:
            wide, tall = size if isinstance(size, (tuple, list)) and len(size) == 2 else (size, None)
            for name, value in (("the width", wide), *([("the height", tall)] if tall is not None else [])):
                if checks.integer(who, f"{name} in size", value, least=STEP) % 2:
                    raise ValueError(f"{who}: size = {size}, but films have even numbers of pixels; write {value + 1}.")
        if camera is not None and dim != 3:
            raise ValueError(f"{who}: camera = {camera}, but a {dim}D scene is seen from the front; leave it out.")
        if camera is not None:
            camera = checks.vector(who, "camera", camera, 2)
            checks.number(who, "camera[1]", camera[1].item(), least=-np.pi / 2, most=np.pi / 2)
        if theme not in THEMES:
            raise ValueError(f"{who}: theme = {theme!r}, but it must be one of {', '.join(map(repr, THEMES))}.")
        return Look((wide, tall), CAMERA if camera is None else tuple(camera.tolist()), theme)


class View:
    """Maps points of a scene between two corners [m] to pixels, in parallel projection."""

    def __init__(self, low: np.ndarray, high: np.ndarray, up: np.ndarray, look: Look):
        self.look = look
        if len(low) == 2:
            self._axes = np.array([[1.0, 0], [0, up[1]], [0, 0]])
        else:
            self._axes = eye_axes(up, look.camera)
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(len(low), -1)
        at = (self._axes @ corners)[:2]
        self._low, size = at.min(axis=1), np.maximum(np.ptp(at, axis=1), 1e-9 * np.abs(at).max() + 1e-30)
        wide, tall = look.size
        if tall is None:
            wide, tall = (STEP * max(1, round(wide * s / STEP)) for s in (1.0, np.clip(size[1] / size[0], *TALL)))
        self.size, self.line = (wide, tall), FINE * wide / WIDE  # line: pixels of the canvas per pixel of DOT and LINE
        room = FINE * (1 - 2 * MARGIN) * np.array(self.size)
        self.scale = float((room / size).min())  # pixels per meter
        self._begin = FINE * np.array(self.size) / 2 - self.scale * size / 2

    def place(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pixels, (n, 2), and the coordinate towards the eye [m], (n,)."""
        right, above, near = self._axes @ x.T
        across = self._begin[0] + self.scale * (right - self._low[0])
        down = FINE * self.size[1] - self._begin[1] - self.scale * (above - self._low[1])
        return np.stack([across, down], axis=1), near


def extent(parts: Parts, frames: Sequence[np.ndarray] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two corners [m] around particles in all frames and around walls of finite size."""
    r, x = parts.particles.radius[:, None], np.array(frames)
    low, high = ((x.astype(np.float64) + s * r).reshape(-1, x.shape[-1]) for s in (-1, 1))
    low, high = low.min(axis=0, initial=np.inf), high.max(axis=0, initial=-np.inf)
    return walled(parts.features, low, high)


def means(hues: np.ndarray, corners: np.ndarray) -> list[tuple[int, ...]]:
    """Return the mean colours of the corners (m, k) of faces or lines."""
    return [tuple(hue) for hue in hues[corners].mean(axis=1).astype(int).tolist()]


class Sketch:
    """Draws frames of a scene. view: the view of all frames. extent: two corners [m] between which walls are drawn."""

    def __init__(self, parts: Parts, geometry: Geometry, view: View, extent: tuple[np.ndarray, np.ndarray]):
        self._parts, self._view, self._extent = parts, view, extent
        self._triangles, self._up = geometry.around[geometry.corners], geometry.up
        self._flat = parts.particles.dim == 2

    def frame(self, x: np.ndarray, geometry: Geometry) -> Any:
        """Return the picture of a frame. x: positions [m]. geometry: links and colours of the frame, see Stretch.geometries."""
        view, self._hues = self._view, geometry.hues
        wide, tall = view.size
        canvas = Image.new("RGB", (FINE * wide, FINE * tall), THEMES[view.look.theme][0])
        draw = ImageDraw.Draw(canvas)
        x = x.astype(np.float64)
        things = [*self._walls(), *self._faces(x), *self._rims(x), *self._links(x, geometry.links)]
        things += self._discs(x, np.union1d(geometry.bare, geometry.loose))
        for _, kind, places, hue, width in sorted(things, key=lambda thing: thing[0]) if not self._flat else things:
            if kind == "face":
                draw.polygon(places, fill=hue)
            elif kind == "line":
                draw.line(places, fill=hue, width=width)
            else:
                draw.ellipse(places, fill=hue)
        return canvas.reduce(FINE)

    def _mesh(self, x: np.ndarray, triangles: np.ndarray, depth: Callable, hues: np.ndarray) -> list[tuple]:
        """Return triangles to draw. depth: reduces the depths of three corners to that of the triangle."""
        at, near = self._view.place(x)
        places, nearness = at[triangles].reshape(-1, 6).tolist(), depth(near[triangles], axis=1).tolist()
        return [(d, "face", p, hue, 0) for d, p, hue in zip(nearness, places, means(hues, triangles), strict=True)]

    def _faces(self, x: np.ndarray) -> list[tuple]:
        hues = self._hues if self._flat else np.rint(lit(self._hues, self._triangles, x, self._up))
        return self._mesh(x, self._triangles, np.mean, hues)

    def _rims(self, x: np.ndarray) -> list[tuple]:
        """Return the rounded edges of bodies: bands, and discs at their corners."""
        edges, radius = rims(self._parts)
        at, _ = self._view.place(x)
        a, b = at[edges[:, 0]], at[edges[:, 1]]
        along = (b - a) / np.maximum(np.linalg.norm(b - a, axis=1), 1e-30)[:, None]
        out = (self._view.scale * radius)[:, None] * np.stack([along[:, 1], -along[:, 0]], axis=1)
        bands = np.concatenate([a + out, b + out, b - out, a - out], axis=1).tolist()
        faces = [(0.0, "face", band, hue, 0) for band, hue in zip(bands, means(self._hues, edges), strict=True)]
        return faces + self._discs(x, edges[:, 0])

    def _links(self, x: np.ndarray, links: np.ndarray) -> list[tuple]:
        at, near = self._view.place(x)
        pairs = links[~crosses_box(box_of(self._parts), x[links[:, 0]] - x[links[:, 1]])]
        width = round(2 * self._view.line * LINE)
        places, nearness = at[pairs].reshape(-1, 4).tolist(), near[pairs].mean(axis=1).tolist()
        return [(d, "line", p, hue, width) for d, p, hue in zip(nearness, places, means(self._hues, pairs), strict=True)]

    def _discs(self, x: np.ndarray, some: np.ndarray) -> list[tuple]:
        at, near = self._view.place(x)
        radii = np.maximum(self._view.scale * self._parts.particles.radius, self._view.line * DOT / 2)[:, None]
        boxes, hues = np.concatenate([at - radii, at + radii], axis=1), self._hues.astype(int)
        return [(near[i], "disc", boxes[i].tolist(), tuple(hues[i].tolist()), 0) for i in some.tolist()]

    def _walls(self) -> list[tuple]:
        out, (_, off, solid) = [], THEMES[self._view.look.theme]
        for shape in filter(None, (outline(f, *self._extent) for f in self._parts.features)):
            if len(shape.faces):
                hues = np.repeat(solid if shape.active else solid // 2, len(shape.vertices), axis=0)
                shades = np.rint(lit(hues, shape.faces, shape.vertices, self._up))
                out += self._mesh(shape.vertices, shape.faces, np.min, shades)  # np.min puts bodies on the wall in front of it
            width = max(round(2 * self._view.scale * shape.radius), round(self._view.line * LINE))
            for strip in shape.strips:
                at, near = self._view.place(np.asarray(strip))
                out.append((float(near.min()), "line", at.ravel().tolist(), EDGE if shape.active else off, width))
        return out
