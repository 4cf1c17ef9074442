"""Filled bodies in 2D: the viewer has no filled areas in 2D, but lines of any width."""

from typing import TYPE_CHECKING

import numpy as np

from ..constraints import Area
from ..contact import Polygons
from ..geometry.intervals import cross_2d
from .bodies import bodies
from .strain import packed, tinted

if TYPE_CHECKING:
    from ..world import World

INSETS = np.array([0.2, 0.6, 0.9])  # positions of the lines, as shares of the way from a body's side to its centre
HALF = np.array([0.2, 0.3, 0.2])  # half of their widths; they overlap, so that no seam shows
SHADE = 0.6  # share of a body's colour, so that its particles and links stand out
STEEP = 3.0  # how far a corner moves inwards, at most, relative to its sides
MANY = 600  # most filled bodies; of more, each is too small for it to matter


def outlines(world: "World") -> list[np.ndarray]:
    """Return the particles around each body in 2D, counterclockwise."""
    found = []
    for f in world.features:
        if isinstance(f, Polygons):
            found += [np.asarray(loop) for loop in f.loops]
        elif isinstance(f, Area):
            found += [f.members_of(c) for c in range(f.count)]
    x, out = world.particles.position, {}
    for loop in found:
        a, b = x[loop], x[np.roll(loop, -1)]
        out.setdefault(tuple(sorted(loop.tolist())), loop if cross_2d(a, b).sum() > 0 else loop[::-1])
    return list(out.values())[:MANY]


def within(world: "World", loops: list[np.ndarray]) -> np.ndarray:
    """Return the number of the loop that each particle is in, (n,), or -1.

    If a body has one loop, all of its particles are in it. If it has several, only their corners are.
    """
    label, out = bodies(world), np.full(len(world.particles), -1)
    labels = np.array([label[loop[0]] for loop in loops], dtype=np.int64)
    for k, loop in enumerate(loops):
        out[label == labels[k] if (labels == labels[k]).sum() == 1 else loop] = k
    return out


class Fill:
    """Lines that fill bodies: their outlines, moved inwards step by step, and their rounded edges.

    loops: particles around each body, counterclockwise. x: their first positions, which set the widths of lines. body: for each
    link inside a body its number, (m,); the body shows their strain. rims: see rims().
    """

    def __init__(self, loops: list[np.ndarray], x: np.ndarray, body: np.ndarray, rims: tuple[np.ndarray, np.ndarray]):
        size = np.array([len(loop) for loop in loops])
        self._corner = np.concatenate(loops)
        first = np.cumsum(size) - size
        k = np.arange(len(self._corner))
        self._owner = np.repeat(np.arange(len(loops)), size)
        self._next = np.where(k + 1 == (first + size)[self._owner], first[self._owner], k + 1)
        self._before = np.empty_like(k)
        self._before[self._next] = k
        self._way = np.concatenate([[*range(a, a + n), a] for a, n in zip(first.tolist(), size.tolist(), strict=True)])
        self._ends = np.concatenate([[0], np.cumsum(size + 1)])
        p = x[self._corner]
        middle = np.stack([np.bincount(self._owner, p[:, c]) / size for c in range(2)], axis=1)
        depth = np.einsum("ij,ij->i", middle[self._owner] - p, self._inwards(p))
        self._depth = np.maximum(np.minimum.reduceat(depth, first), 0.0)
        owner = np.full(len(x), -1)
        owner[self._corner] = self._owner
        some = owner[rims[0][:, 0]] >= 0
        self._edges = rims[0][some]
        filling = np.tile(np.arange(len(loops)), len(INSETS))
        self._shown = np.concatenate([filling, owner[self._edges[:, 0]]])  # the body of each line
        self.radii = np.concatenate([(self._depth * HALF[:, None]).ravel(), rims[1][some]]).astype(np.float32)
        self._body = body

    def _inwards(self, p: np.ndarray) -> np.ndarray:
        """Return the inward normal of the side that begins at each corner."""
        along = p[self._next] - p
        length = np.linalg.norm(along, axis=1)
        return np.stack([-along[:, 1], along[:, 0]], axis=1) / np.where(length > 0, length, 1)[:, None]

    def strips(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, for a frame, the points of all lines, (k, 2) in f32, and where each line begins and ends, (s + 1,)."""
        p = x[self._corner]
        n = self._inwards(p)
        m = n[self._before]
        corner = (n + m) / np.maximum(1 + np.einsum("ij,ij->i", n, m), 2 / STEEP**2)[:, None]
        step = corner * self._depth[self._owner, None]
        points = np.concatenate([*((p + inset * step)[self._way] for inset in INSETS), x[self._edges.ravel()]])
        turns = [self._ends[:-1] + k * self._ends[-1] for k in range(len(INSETS))]
        begin = len(INSETS) * self._ends[-1]
        return points.astype(np.float32), np.concatenate([*turns, np.arange(begin, len(points) + 1, 2)])

    def colors(self, hues: np.ndarray, level: np.ndarray) -> np.ndarray:
        """Return RGBA of all lines as u32; each body has the mean of its corners.

        hues: colours of the particles, (n, 3). level: the level of the strain of each link, (m,); each body shows its worst.
        """
        totals = [np.bincount(self._owner, column) for column in hues[self._corner].T]
        mean = SHADE * np.stack(totals, axis=1) / np.bincount(self._owner)[:, None]
        return packed(tinted(mean, self._body, level))[self._shown]
