"""How links are drawn with few points: as long strips, and sheets as meshes, with the colours of their strain."""

from collections import defaultdict
from itertools import combinations
from typing import Any

import numpy as np

from .strain import LEVELS, SCALE

FLAT = 0.1  # the diagonals of a cell pass each other within so much of their length
STRAIGHT = 1e-3  # a link that passes a particle within so much of its length lies on the two links to it
PIXELS = 64  # of the picture of a cell
THICK, DARK = 2.6, 55  # half the width of its lines, and what is between them
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float32)  # of a cell, in its picture


class Lines:
    """Links as strips. pairs: (m, 2), particles. Every link is in one strip, and strips are as long as they can be, so that most
    particles are there once. In a frame a strip ends where the colour changes.
    """

    def __init__(self, pairs: np.ndarray):
        self.particles, self._link = trails(pairs)

    def strips(self, level: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of a frame: the particles of all strips one after the other, (k,), where each strip begins and ends, (s + 1,), and its
        colour as u32, (s,). level: (m,), of the colour of each link; -1 for one that is not drawn.
        """
        here = np.where(self._link < 0, -1, level[self._link])  # of the line from each particle to the next
        edge = np.flatnonzero(np.diff(here, prepend=-1, append=-1))
        begin, end = edge[:-1], edge[1:]
        drawn = here[begin] >= 0 if len(begin) else np.zeros(0, dtype=bool)
        begin, end = begin[drawn], end[drawn]
        count = end - begin + 1
        ends = np.concatenate([[0], np.cumsum(count)])
        at = np.arange(ends[-1]) + np.repeat(begin - ends[:-1], count)
        return self.particles[at], ends, SCALE[here[begin]]


class Sheet:
    """Cells with four corners and both diagonals as a mesh. Its texture is a picture of a cell, with the links as lines.

    pairs: (m, 2). used: (m,), whether a link is in the mesh, or lies on two that are. triangles: (t, 3). spots: (n, 2), where the
    particles are in the texture.
    """

    def __init__(self, pairs: np.ndarray, x: np.ndarray):
        self.used, cells = _cells(pairs, x)
        self.spots, cells = _spread(cells, len(x))
        a, b, c, d = cells.T
        self.triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.uint32)
        inside = {tuple(sorted(edge)) for cell in cells.tolist() for edge in combinations(cell, 2)}
        lies = self.used  # on two others
        self.used = lies | np.array([tuple(sorted(pair)) in inside for pair in pairs.tolist()], dtype=bool)
        mine = np.flatnonzero(self.used & ~lies)
        ends = pairs[mine].T.ravel()
        self._order = np.argsort(ends, kind="stable")
        self._at, self._begin = np.unique(ends[self._order], return_index=True)
        self._link = np.concatenate([mine, mine])[self._order]
        self._count = len(x)

    def colors(self, level: np.ndarray) -> np.ndarray:
        """RGBA of all particles as u32: that of the link that is strained most."""
        out = np.full(self._count, LEVELS)
        if len(self._at):
            off = level[self._link] - LEVELS
            most = np.maximum.reduceat(2 * np.abs(off) + (off > 0), self._begin)
            out[self._at] = LEVELS + np.where(most & 1, most >> 1, -(most >> 1))
        return SCALE[out]

    def mesh(self, rr: Any) -> Any:
        """What does not change."""
        shape = rr.components.ImageFormat(width=PIXELS, height=PIXELS, color_model="L", channel_datatype="U8")
        return rr.Mesh3D.from_fields(
            triangle_indices=self.triangles, vertex_texcoords=self.spots, albedo_texture_buffer=cell().tobytes(),
            albedo_texture_format=shape,
        )  # fmt: skip


def cell() -> np.ndarray:
    """The picture of a cell, (PIXELS, PIXELS): its sides and diagonals."""
    x, y = np.meshgrid(np.arange(PIXELS) + 0.5, np.arange(PIXELS) + 0.5)
    far = np.minimum.reduce([x, PIXELS - x, y, PIXELS - y, np.abs(x - y) / np.sqrt(2), np.abs(x + y - PIXELS) / np.sqrt(2)])
    return (DARK + (255 - DARK) * np.clip(THICK + 0.5 - far, 0, 1)).astype(np.uint8)


def trails(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Walks along links that take each once: the particles on them, and the link from each to the next, -1 where a walk ends.

    A walk goes on with the same step in the numbers of particles where it can: so it goes straight along rows of a sheet, and has
    the particles in the order in which they are sent.
    """
    ways: dict[int, dict[int, int]] = defaultdict(dict)  # of each particle: the others, and the links to them
    again = []  # links between particles that have one already
    for link, (i, j) in enumerate(pairs.tolist()):
        if i == j or j in ways[i]:
            again.append(link)
        else:
            ways[i][j] = ways[j][i] = link
    particles: list[int] = []
    links: list[int] = []
    odd = [i for i in sorted(ways) if len(ways[i]) % 2]
    for start in [*odd, *sorted(ways)]:
        while ways[start]:
            i, step = start, 1
            while ways[i]:
                j = i + step if i + step in ways[i] else next(iter(ways[i]))
                particles.append(i)
                links.append(ways[i].pop(j))
                del ways[j][i]
                i, step = j, j - i
            particles.append(i)
            links.append(-1)
    for link in again:
        particles += pairs[link].tolist()
        links += [link, -1]
    return np.array(particles, dtype=np.int64), np.array(links, dtype=np.int64)


def _cells(pairs: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """Which links lie on two others, and the cells of four particles with six links, round their sides."""
    near: dict[int, set[int]] = defaultdict(set)
    for i, j in pairs.tolist():
        near[i].add(j)
        near[j].add(i)
    lies = np.zeros(len(pairs), dtype=bool)
    for link, (i, j) in enumerate(pairs.tolist()):
        both = [*(near[i] & near[j])]
        if both:
            off = np.linalg.norm(x[both] - (x[i] + x[j]) / 2, axis=1).min()
            lies[link] = off < STRAIGHT * np.linalg.norm(x[i] - x[j])
    for i, j in pairs[lies].tolist():
        near[i].discard(j)
        near[j].discard(i)
    cells = []
    for i, j in pairs[~lies].tolist():  # as a diagonal; the other one is k to l
        for k, m in combinations(sorted(near[i] & near[j]), 2):
            if m in near[k] and min(i, j) < min(k, m):
                off = np.linalg.norm(x[i] + x[j] - x[k] - x[m]) / 2
                if off < FLAT * min(np.linalg.norm(x[i] - x[j]), np.linalg.norm(x[k] - x[m])):
                    cells.append([i, k, j, m])
    return lies, cells


def _spread(cells: list[list[int]], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the picture for all particles, so that those of a cell have all four, and the cells where that is so.

    It goes from cell to cell: two corners of the next are known, and the picture is mirrored at the side between them.
    """
    of: dict[int, list[int]] = defaultdict(list)
    for c, cell in enumerate(cells):
        for i in cell:
            of[i].append(c)
    corner = np.full(count, -1)
    good = np.zeros(len(cells), dtype=bool)
    seen = np.zeros(len(cells), dtype=bool)
    for first in range(len(cells)):
        wait = [] if seen[first] else [first]
        while wait:
            c = wait.pop(0)
            if seen[c]:
                continue
            seen[c] = True
            good[c] = _fit(cells[c], corner)
            if good[c]:
                sides = zip(cells[c], [*cells[c][1:], cells[c][0]], strict=True)
                wait += [d for i, j in sides for d in of[i] if not seen[d] and j in cells[d]]
    return CORNERS[np.maximum(corner, 0)], np.array(cells, dtype=np.int64).reshape(-1, 4)[good]


def _fit(cell: list[int], corner: np.ndarray) -> bool:
    """Give the particles of a cell the corners of the picture that they do not have yet, one after the other around it."""
    for turn in (1, -1):
        for first in range(4):
            want = [(first + turn * k) % 4 for k in range(4)]
            if all(corner[i] in (-1, w) for i, w in zip(cell, want, strict=True)):
                corner[cell] = want
                return True
    return False
