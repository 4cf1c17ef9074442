"""A bounding volume hierarchy over boxes, for many queries at once."""

from collections.abc import Callable

import numpy as np

CHILDREN = 4  # children of a node, and boxes in a leaf
FEW_PAIRS = 1 << 13  # pairs of a query and a box up to which comparing all pairs takes less time than building a tree
FEW_QUERIES = 2  # queries for which no tree pays, for any number of boxes
CHUNK = 1 << 14  # queries that descend the tree together
TINY = 1e-300  # replaces 0 as a component of a direction: a ray beside a slab stays beside it
SLACK = 2.0**-40  # of the largest coordinate: boxes are enlarged by so much, for rounding

Answer = tuple[np.ndarray, np.ndarray]


class BoundingTree:
    """A tree of boxes from low to high, (m, dim) each, none of them empty.

    Boxes are sorted along a Morton curve through the ranks of their middles. Ranks keep the curve even where one box is far away.
    Four boxes make a leaf, and four nodes make a node of the level above. All queries descend together, each with its own stack,
    and visit the nearest child first.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray):
        slack = SLACK * max(np.abs(low).max(initial=0.0), np.abs(high).max(initial=0.0))
        self.low, self.high, self.count = low - slack, high + slack, len(low)
        self._first = -1  # index of the first leaf; -1 until the tree is built

    def find_least(self, queries: int, most: np.ndarray, bound: Callable, value: Callable) -> Answer:
        """Return for each query the least value of all boxes up to most[q], and its box; (inf, -1) where there is none.

        bound(q, low, high): a lower bound of the values in larger boxes (k, ..., dim) for queries q (k,); inf where these hold
        none. value(q, b): the value of query q[i] and box b[i]. Of equal values, the box with the lower index is returned.
        """
        if not self.count or not queries:
            return np.full(queries, np.inf), np.full(queries, -1)
        compare_all = queries <= FEW_QUERIES or queries * self.count <= FEW_PAIRS
        step = max(1, FEW_PAIRS // self.count) if compare_all else CHUNK
        chunks = [np.arange(q, min(q + step, queries)) for q in range(0, queries, step)]
        if not compare_all and self._first < 0:
            self._build()
        search = self._compare_all if compare_all else self._descend
        answers = [search(q, most[q], bound, value) for q in chunks]
        return np.concatenate([a for a, _ in answers]), np.concatenate([b for _, b in answers])

    def _compare_all(self, some: np.ndarray, most: np.ndarray, bound: Callable, value: Callable) -> Answer:
        """Answer queries by comparing each with all boxes."""
        with np.errstate(over="ignore"):
            near = bound(some, self.low[None], self.high[None])
        values = np.full(near.shape, np.inf)
        q, b = np.nonzero((near <= most[:, None]) & (near < np.inf))
        values[q, b] = value(some[q], b)
        at = values.argmin(axis=1)
        best = values[np.arange(len(some)), at]
        found = (best <= most) & (best < np.inf)
        return np.where(found, best, np.inf), np.where(found, at, -1)

    def _build(self) -> None:
        """Build the tree: sort the boxes and make the nodes from the leaves up. Missing children are NaN, which no query hits."""
        dim = self.low.shape[1]
        depth = 0
        while CHILDREN ** (depth + 1) < self.count:
            depth += 1
        order = np.argsort(_morton(self.low / 2 + self.high / 2), kind="stable")
        self._items = np.full(CHILDREN ** (depth + 1), -1)
        self._items[: self.count] = order
        low, high = (np.full((len(self._items), dim), np.nan) for _ in range(2))
        low[: self.count], high[: self.count] = self.low[order], self.high[order]
        lows, highs = [], []
        for _ in range(depth + 1):
            low = np.fmin.reduce(low.reshape(-1, CHILDREN, dim), axis=1)
            high = np.fmax.reduce(high.reshape(-1, CHILDREN, dim), axis=1)
            lows.append(low)
            highs.append(high)
        self._low, self._high = np.concatenate(lows[::-1]), np.concatenate(highs[::-1])
        self._first, self._depth = (CHILDREN**depth - 1) // (CHILDREN - 1), depth

    def _descend(self, some: np.ndarray, most: np.ndarray, bound: Callable, value: Callable) -> Answer:
        """Answer queries by descending the tree."""
        best, found = most.astype(float), np.full(len(some), -1)
        room = (CHILDREN - 1) * self._depth + 2
        node, least = np.zeros((len(some), room), dtype=np.int32), np.full((len(some), room), -np.inf)
        top = np.ones(len(some), dtype=np.int32)
        going = np.arange(len(some))
        while len(going):
            top[going] -= 1
            here, enough = node[going, top[going]], least[going, top[going]] <= best[going]
            leaf = here >= self._first
            rows = going[leaf & enough]
            if len(rows):
                self._search_leaf(rows, here[leaf & enough], some, best, found, value)
            rows, here = going[~leaf & enough], here[~leaf & enough]
            if len(rows):
                children = CHILDREN * here[:, None] + np.arange(1, CHILDREN + 1)
                with np.errstate(invalid="ignore", over="ignore"):
                    near = bound(some[rows], self._low[children], self._high[children])
                    near = np.where(near <= best[rows, None], near, np.inf)
                order = np.argsort(-near, axis=1, kind="stable")
                for k in range(CHILDREN):
                    pick = order[:, k]
                    at = np.arange(len(rows))
                    wanted = near[at, pick] < np.inf
                    r, at, pick = rows[wanted], at[wanted], pick[wanted]
                    node[r, top[r]], least[r, top[r]] = children[at, pick], near[at, pick]
                    top[r] += 1
            going = going[top[going] > 0]
        return np.where(found >= 0, best, np.inf), found

    def _search_leaf(self, rows, here, some, best, found, value) -> None:
        """Compare each row's query with the boxes of one leaf, and update `best` and `found`."""
        items = self._items[CHILDREN * (here - self._first)[:, None] + np.arange(CHILDREN)]
        there = items >= 0
        values = np.full(items.shape, np.inf)
        values[there] = value(np.broadcast_to(some[rows][:, None], items.shape)[there], items[there])
        least = values.min(axis=1)
        number = np.where(values == least[:, None], np.where(there, items, self.count), self.count).min(axis=1)
        before = found[rows]
        better = (least < best[rows]) | ((least == best[rows]) & ((before < 0) | (number < before)))
        better &= least < np.inf
        best[rows[better]], found[rows[better]] = least[better], number[better]


def ray_entry_bound(origin: np.ndarray, direction: np.ndarray, extra: float, exits: bool = False) -> Callable:
    """Return a bound for rays: the distance to a box that is enlarged by `extra` [m].

    exits: instead minus the distance to the end of the box, for boxes in which rays start.
    """
    inverse = 1.0 / np.where(np.abs(direction) < TINY, TINY, direction)
    extra = extra + SLACK * np.abs(origin).max(axis=1)

    def bound(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the bounds in boxes (k, b, dim): rays enter the last slab of them, and leave the first one."""
        o, i, e = origin[q][:, None], inverse[q][:, None], extra[q][:, None, None]
        one, two = (low - e - o) * i, (high + e - o) * i
        enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
        if exits:
            return np.where((enter <= 0) & (leave >= 0), -leave, np.inf)
        return np.where((enter <= leave) & (leave >= 0), np.maximum(enter, 0.0), np.inf)

    return bound


def distance_bound(points: np.ndarray) -> Callable:
    """Return a bound for points: their distance from a box."""

    def bound(q: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the distances from points to boxes [m]."""
        x = points[q][:, None]
        off = np.maximum(np.maximum(low - x, x - high), 0.0)
        distance = np.sqrt((off * off).sum(axis=-1))
        return np.where(distance >= 0, distance, np.inf)

    return bound


def _morton(middle: np.ndarray) -> np.ndarray:
    """Return the Morton codes of points (m, dim), whose order follows a space-filling curve: interleaved bits of ranks."""
    out = np.zeros(len(middle), dtype=np.int64)
    ranks = [np.unique(middle[:, k], return_inverse=True)[1].ravel() for k in range(middle.shape[1])]
    bits = min(62 // middle.shape[1], len(middle).bit_length())
    for k, rank in enumerate(ranks):
        rank = rank * ((1 << bits) - 1) // max(1, int(rank.max()))
        for b in range(bits):
            out |= ((rank >> b) & 1) << (b * middle.shape[1] + k)
    return out
