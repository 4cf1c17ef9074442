"""A tree of boxes around the walls of a group, by which a particle finds those near it."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from ..features.feature import Scene

SKIP, MEMBER, LEAST, MOST = range(4)  # of a node: the next one not below it, its wall or -1, the first and last wall below


class WallTree:
    """A binary tree of boxes in which walls stay during a frame.

    Nodes are in depth-first order, so a search goes from each to the next or skips what is below. The boxes are computed again in
    each frame; which walls are neighbours in the tree is decided once, and affects speed only.
    """

    nodes: Any = OnDevice()

    def __init__(self, scene: "Scene", name: str, middles: np.ndarray):
        rows, self.state = tree_nodes(middles), scene.state
        add, self.dim = scene.memory.field, middles.shape[1]
        self.nodes = scene.memory.number(len(rows))
        self.node = add(f"{name}.nodes", len(rows), width=4, kind=ti.i32, values=rows)
        leaf = np.empty(len(middles))
        leaf[rows[rows[:, MEMBER] >= 0, MEMBER]] = np.flatnonzero(rows[:, MEMBER] >= 0)
        self.leaf = add(f"{name}.leaves", len(middles), kind=ti.i32, values=leaf)
        # Lists that are made before the first frame find all walls.
        everywhere = np.full((len(rows), self.dim), np.inf)
        self.low = add(f"{name}.low", len(rows), width=self.dim, values=-everywhere)
        self.high = add(f"{name}.high", len(rows), width=self.dim, values=everywhere)

    @ti.func
    def put(self, member, low, high):
        """Set the box of a wall."""
        node = self.leaf[member]
        self.low[node], self.high[node] = low, high

    @ti.func
    def join(self):
        """Compute the boxes of all other nodes."""
        for k in range(self.nodes):
            node = self.nodes - 1 - k
            if self.node[node][MEMBER] < 0:
                right = self.node[node + 1][SKIP]
                self.low[node] = ti.min(self.low[node + 1], self.low[right])
                self.high[node] = ti.max(self.high[node + 1], self.high[right])

    @ti.func
    def next(self, last, low, high, none):
        """Return the first wall behind the wall `last` whose box meets that from low to high; `none` if there is none."""
        out, at = none, 0
        while at < self.nodes:
            node = self.node[at]
            if node[MOST] > last and node[LEAST] < out and self.meets(at, low, high):
                if node[MEMBER] >= 0:
                    out = node[MEMBER]
                at += 1
            else:
                at = node[SKIP]
        return out

    @ti.func
    def meets(self, at, low, high):
        """Whether the box of a node meets that from low to high; also where these are no numbers."""
        out, a, b = True, self.low[at], self.high[at]
        for k in ti.static(range(self.dim)):
            out = out and not (a[k] > high[k]) and not (b[k] < low[k])
        return out


def tree_nodes(middles: np.ndarray) -> np.ndarray:
    """Return the nodes of a balanced tree around points (m, dim) in depth-first order, (2 m - 1, 4): see SKIP."""
    rows: list[tuple[int, int, int, int]] = []

    def build(some: np.ndarray) -> None:
        """Append the nodes of some points."""
        place = len(rows)
        rows.append((place + 2 * len(some) - 1, int(some[0]) if len(some) == 1 else -1, int(some.min()), int(some.max())))
        if len(some) > 1:
            axis = int(np.argmax(np.ptp(middles[some], axis=0)))
            order = some[np.argsort(middles[some, axis], kind="stable")]
            build(order[: len(some) // 2])
            build(order[len(some) // 2 :])

    build(np.arange(len(middles)))
    return np.array(rows)
