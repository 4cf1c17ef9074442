"""Questions about where particles are: near points, nearest to points, touching each other."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..device import ti

if TYPE_CHECKING:
    from .neighbour_search import NeighbourSearch
    from .periodic import Periodic


@dataclass(frozen=True)
class Contacts:
    """What touches: overlaps now, or was pushed apart in the last substep.

    pairs: (m, 2), two discs or spheres i < j, or a vertex and the particle where the edge begins that it touches. ends: (m,), the
    particle where the edge ends; j for discs. place: (m,), where on the edge, 0 at its begin and 1 at its end, beyond them where
    two corners cross; 0 for discs. overlap: (m,) [m], 0 or less for what has just been pushed apart. normal: (m, dim), from j or
    the edge to i. point: (m, dim) [m], in the middle of the overlap. impulse: (m,) [N s] along the normal in the last substep;
    divided by the substep it is the force, but in the first of another length, see Touches. That of World.events() is the sum
    over the frame. i got impulse * normal, and -(1 - place) and -place of that went to j and the end of the edge.
    """

    pairs: np.ndarray
    ends: np.ndarray
    place: np.ndarray
    overlap: np.ndarray
    normal: np.ndarray
    point: np.ndarray
    impulse: np.ndarray

    def __len__(self) -> int:
        return len(self.pairs)


@ti.data_oriented
class PointSearch:
    """Particles within a distance of points, by the cells of the contact grid, which has to be sorted."""

    def __init__(self, search: "NeighbourSearch"):
        self.cells, self.state, self.dim, self.levels = search.cells, search.state, search.dim, search.cells.levels
        self.real = search.real

    @ti.func
    def visit(self, point, radius, row, number, at, out: ti.template(), fill: ti.template()):  # type: ignore[valid-type]
        """Count the particles within `radius` of a point; with `fill` write (row, particle) from `at` on."""
        for m in range(self.levels):
            scale = self.cells.scale(m)
            low = ti.floor((point - radius) * scale, ti.i32) - 1  # one more on each side for what has rounded across
            count = ti.floor((point + radius) * scale, ti.i32) + 2 - low
            for k in ti.static(self.cells.axes):
                low[k], count[k] = self.cells.around(point, radius, m, k)
            total = 1
            for k in ti.static(range(self.dim)):
                count[k] = ti.min(count[k], 1 << self.cells.shape[m][k])  # round the torus once
                total *= count[k]
            for c in range(total):
                cell, rest = low, c
                for k in ti.static(range(self.dim)):
                    cell[k] += rest % count[k]
                    rest = rest // count[k]
                for k in ti.static(self.cells.axes):
                    cell[k] = cell[k] % self.cells.count[m][k]
                b = self.cells.bucket(cell, m)
                for e in range(self.cells.edge[b + 1], self.cells.edge[b + 2]):
                    i = self.cells.sorted[e]
                    r = self.state.nearest(self.state.place(i) - point)
                    if r.dot(r) <= radius * radius:
                        if ti.static(fill):
                            out[at + number, 0], out[at + number, 1] = row, i
                        number += 1
        return number

    @ti.kernel
    def run(
        self, points: ti.types.ndarray(ti.f64, 2), radius: ti.types.ndarray(ti.f64, 1), first: ti.types.ndarray(ti.i32, 1),
        out: ti.types.ndarray(ti.i32, 2), count: ti.i32, fill: ti.i32,
    ):  # type: ignore[valid-type]  # fmt: skip
        """Without `fill`: the number for each point into `first`. With it: the pairs, from first[p] on."""
        for p in range(count):
            point = ti.Vector.zero(self.real, self.dim)
            for k in ti.static(range(self.dim)):
                point[k] = points[p, k]
            if fill == 0:
                first[p] = self.visit(point, ti.cast(radius[p], self.real), p, 0, 0, out, False)
            else:
                self.visit(point, ti.cast(radius[p], self.real), p, 0, first[p], out, True)

    def near(self, points: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """(m, 2): rows of points, and particles, in order."""
        number, none = np.zeros(len(points), dtype=np.int32), np.zeros((1, 2), dtype=np.int32)
        self.run(points, radius, number, none, len(points), 0)
        first = (np.cumsum(number) - number).astype(np.int32)
        out = np.zeros((max(1, int(number.sum())), 2), dtype=np.int32)
        self.run(points, radius, first, out, len(points), 1)
        out = out[: int(number.sum())]
        return out[np.lexsort((out[:, 1], out[:, 0]))].astype(np.int64)


def between(a: np.ndarray, b: np.ndarray, box: "Periodic | None") -> np.ndarray:
    """a - b, in a periodic box of nearest images."""
    return a - b if box is None else box.difference(a, b)


def near_by_all(position: np.ndarray, points: np.ndarray, radius: np.ndarray, box: "Periodic | None" = None) -> np.ndarray:
    """The same by comparing each point with each particle, for worlds without contacts."""
    found = ((between(position, p, box) ** 2).sum(axis=1) <= r * r for p, r in zip(points, radius, strict=True))
    rows = [np.flatnonzero(some) for some in found]
    return np.array([(k, i) for k, row in enumerate(rows) for i in row], dtype=np.int64).reshape(-1, 2)


def nearest(
    find, position: np.ndarray, points: np.ndarray, start: float, box: "Periodic | None" = None
) -> tuple[np.ndarray, np.ndarray]:
    """Index of and distance to the particle nearest to each point: look within `start`, and twice as far while there is none."""
    index = np.full(len(points), -1)
    distance = np.full(len(points), np.inf)
    left, reach = np.arange(len(points)), start
    while len(left):
        pairs = find(points[left], np.full(len(left), reach))
        length = np.linalg.norm(between(position[pairs[:, 1]], points[left][pairs[:, 0]], box), axis=1)
        order = np.lexsort((pairs[:, 1], length, pairs[:, 0]))
        rows, at = np.unique(pairs[order, 0], return_index=True)
        index[left[rows]], distance[left[rows]] = pairs[order][at, 1], length[order][at]
        left, reach = np.delete(left, rows), 2 * reach
    return index, distance
