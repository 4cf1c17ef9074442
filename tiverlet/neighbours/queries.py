"""Queries of positions: particles near points, the nearest particle to a point, particles in contact."""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from ..features.row_table import row_table
from ..features.unknown_names import answer_names
from ..geometry.bounding_tree import BoundingTree, distance_bound
from ..geometry.places import places_between

if TYPE_CHECKING:
    from .periodic import Periodic


BITS = 20  # of the number of a cell along an axis
MOST_CELLS = 1 << 19  # cells along an axis that hold particles


@answer_names
@dataclass(frozen=True)
class Contacts:
    """Contacts: pairs that overlap now, or were pushed apart in the last substep.

    pairs: (m, 2), two discs or spheres i < j, or a vertex i and the particle j at the begin of the edge that it touches. ends:
    (m,), the particle at the end of the edge; j for discs. place: (m,), the position on the edge, 0 at its begin and 1 at its
    end, outside that range where two corners cross; 0 for discs. overlap: (m,) [m], 0 or less for pairs that have just been
    pushed apart. normal: (m, dim), from j or the edge to i. point: (m, dim) [m], the middle of the overlap. impulse: (m,) [N s]
    along the normal in the last substep. tangential: (m, dim) [N s], by friction; 0 for what bounces. Divided by the substep they
    are forces, except in the first substep of another length, see Touches. Impulses of World.events() are sums over the frame.
    Particle i receives impulse * normal + tangential, particle j -(1 - place) of that, and the end of the edge -place of that.
    """

    pairs: np.ndarray
    ends: np.ndarray
    place: np.ndarray
    overlap: np.ndarray
    normal: np.ndarray
    point: np.ndarray
    impulse: np.ndarray
    tangential: np.ndarray

    def __len__(self) -> int:
        return len(self.pairs)

    def __repr__(self) -> str:
        return row_table("Contacts", {name: vars(self)[name] for name in ("pairs", "overlap", "impulse", "normal", "point")})


def between(a: np.ndarray, b: np.ndarray, box: "Periodic | None") -> np.ndarray:
    """Return a - b [m], between nearest images in a periodic box."""
    return a - b if box is None else box.difference(a, b)


def near(position: np.ndarray, points: np.ndarray, radius: np.ndarray, box: "Periodic | None" = None) -> np.ndarray:
    """Return the pairs (row of a point, particle) that are within a radius, (m, 2), sorted.

    position: (n, dim) [m]. points: (k, dim) [m]. radius: (k,) [m]. box: where the nearest image of each particle counts. Each
    point is compared with the particles in the cells around it, which are as large as the largest radius.
    """
    number, x = np.arange(len(position)), position
    if box is not None:
        (number, x), points = box.ghosts(position, float(radius.max(initial=0.0))), box.wrap(points)
    some = np.isfinite(x).all(axis=1)
    number, x = number[some], x[some]
    low, extent = x.min(axis=0, initial=np.inf), float(np.ptp(x, axis=0).max()) if len(x) else 0.0
    size = max(float(radius.max(initial=0.0)) * (1 + 2.0**-30), extent / MOST_CELLS) or 1.0
    per_cell = 1 << BITS * np.arange(x.shape[1])  # a cell's number has BITS for each axis, so those of a row are consecutive

    def cell(y: np.ndarray) -> np.ndarray:
        """Return the cells of places; those far from all particles are empty ones beside them."""
        return np.clip(np.floor((y - low) / size), -2, MOST_CELLS + 2).astype(np.int64) + 3

    cells = cell(x) @ per_cell
    order = np.argsort(cells, kind="stable")
    number, x, cells = number[order], x[order], cells[order]
    found = [np.zeros(0, dtype=np.int64)]
    for beside in product((0,), *[(-1, 0, 1)] * (x.shape[1] - 1)):
        middle = (cell(points) + beside) @ per_cell
        first, last = np.searchsorted(cells, middle - 1, "left"), np.searchsorted(cells, middle + 1, "right") - 1
        for row, at in places_between(first[:, None], last[:, None]):
            i = at[:, 0]
            within = ((x[i] - points[row]) ** 2).sum(axis=1) <= radius[row] ** 2
            found.append(row[within] * len(position) + number[i[within]])
    return np.stack(np.divmod(np.unique(np.concatenate(found)), len(position)), axis=1)


def nearest(position: np.ndarray, points: np.ndarray, box: "Periodic | None" = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the particle nearest to each point, the first of equally near ones, and its distance [m].

    position: (n, dim) [m]. points: (k, dim) [m]. box: where images count, too. Where no position is finite: -1 and inf.
    """
    number, x = np.arange(len(position)), position
    if box is not None:
        lengths = box.lengths[np.isfinite(box.lengths)]
        (number, x), points = box.ghosts(position, float(lengths.max()) / 2), box.wrap(points)
    some = np.argsort(number, kind="stable")
    some = some[np.isfinite(x[some]).all(axis=1)]
    number, x = number[some], x[some]

    def distance(q: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Return the distances of points q[i] from particles i."""
        return np.linalg.norm(points[q] - x[i], axis=1)

    length, at = BoundingTree(x, x).find_least(len(points), np.full(len(points), np.inf), distance_bound(points), distance)
    return np.append(number, -1)[at], length
