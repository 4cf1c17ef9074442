"""Queries of positions: particles near points, the nearest particle to a point, particles in contact."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..features.row_table import row_table
from ..features.unknown_names import answer_names

if TYPE_CHECKING:
    from .neighbour_search import NeighbourSearch
    from .periodic import Periodic


@answer_names
@dataclass(frozen=True)
class Contacts:
    """Contacts: pairs that overlap now, or were pushed apart in the last substep.

    pairs: (m, 2), two discs or spheres i < j, or a vertex i and the particle j at the begin of the edge that it touches. ends:
    (m,), the particle at the end of the edge; j for discs. place: (m,), the position on the edge, 0 at its begin and 1 at its
    end, outside that range where two corners cross; 0 for discs. overlap: (m,) [m], 0 or less for pairs that have just been
    pushed apart. normal: (m, dim), from j or the edge to i. point: (m, dim) [m], the middle of the overlap. impulse: (m,) [N s]
    along the normal in the last substep. Divided by the substep it is the force, except in the first substep of another length,
    see Touches. Impulses of World.events() are sums over the frame. Particle i receives impulse * normal, particle j
    -(1 - place) of that, and the end of the edge -place of that.
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

    def __repr__(self) -> str:
        return row_table("Contacts", {name: vars(self)[name] for name in ("pairs", "overlap", "impulse", "normal", "point")})


@ti.data_oriented
class PointSearch:
    """The search for particles within a distance of points, by the cells of contacts. The cells must be sorted."""

    def __init__(self, search: "NeighbourSearch"):
        self.cells, self.state, self.dim, self.levels = search.cells, search.state, search.dim, search.cells.levels
        self.real = ti.f64 if self.state.compensated else search.real

    @ti.func
    def visit(self, point, radius, row, number, at, out: ti.template(), fill: ti.template()):  # type: ignore[valid-type]
        """Count the particles within `radius` [m] of a point, and return `number` plus that. fill: write (row, particle), too.

        Pairs are written to `out` from row at + number on.
        """
        for m in range(self.levels):
            total, low = 1, ti.Vector.zero(ti.i32, self.dim)
            count = low
            for k in ti.static(range(self.dim)):
                low[k], count[k] = self.cells.cell_range(point, radius, m, k)
                total *= count[k]
            for c in range(total):
                cell, rest = low, c
                for k in ti.static(range(self.dim)):
                    cell[k] += rest % count[k]
                    rest = rest // count[k]
                for k in ti.static(self.cells.axes):
                    cell[k] = cell[k] % self.cells.cells_per_axis[m][k]
                b = self.cells.bucket(cell, m)
                for e in range(self.cells.edge[b + 1], self.cells.edge[b + 2]):
                    i = self.cells.sorted[e]
                    r = self.state.nearest(self.state.exact(i) - point)
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
        """Write the number of particles near each point to `first`; or, with `fill`, write pairs to `out` from first[p] on."""
        for p in range(count):
            point = ti.Vector.zero(self.real, self.dim)
            for k in ti.static(range(self.dim)):
                point[k] = points[p, k]
            if fill == 0:
                first[p] = self.visit(point, ti.cast(radius[p], self.real), p, 0, 0, out, False)
            else:
                self.visit(point, ti.cast(radius[p], self.real), p, 0, first[p], out, True)

    def near(self, points: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return the pairs (row of a point, particle) within `radius`, (m, 2), sorted. points: (k, dim) [m]. radius: (k,) [m]."""
        number, none = np.zeros(len(points), dtype=np.int32), np.zeros((1, 2), dtype=np.int32)
        self.run(points, radius, number, none, len(points), 0)
        first = (np.cumsum(number) - number).astype(np.int32)
        out = np.zeros((max(1, int(number.sum())), 2), dtype=np.int32)
        self.run(points, radius, first, out, len(points), 1)
        out = out[: int(number.sum())]
        return out[np.lexsort((out[:, 1], out[:, 0]))].astype(np.int64)


def between(a: np.ndarray, b: np.ndarray, box: "Periodic | None") -> np.ndarray:
    """Return a - b [m], between nearest images in a periodic box."""
    return a - b if box is None else box.difference(a, b)


def near_by_brute_force(
    position: np.ndarray, points: np.ndarray, radius: np.ndarray, box: "Periodic | None" = None
) -> np.ndarray:
    """Return what PointSearch.near() does, by comparing each point with each particle, for worlds without contacts."""
    found = ((between(position, p, box) ** 2).sum(axis=1) <= r * r for p, r in zip(points, radius, strict=True))
    rows = [np.flatnonzero(some) for some in found]
    return np.array([(k, i) for k, row in enumerate(rows) for i in row], dtype=np.int64).reshape(-1, 2)


def nearest(
    find, position: np.ndarray, points: np.ndarray, start: float, box: "Periodic | None" = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the particle nearest to each point, and its distance [m].

    The search begins with the radius `start` [m] and doubles it until each point has a particle. find(points, radius): pairs as
    PointSearch.near() returns them.
    """
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
