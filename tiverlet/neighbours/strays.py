"""Strays: particles that went far from where they were when a neighbour list was built, while most others stayed."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..device.number import OnDevice
from ..device.thread_team import block, blocks
from .neighbour_list import MOVED, STALE

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .neighbour_search import NeighbourSearch

MOST = 256  # strays at a time, since all are compared with each other
SHARE = 64  # particles for each of them: to look around all strays is to cost less than a list


class Strays:
    """A list that is stale because few have moved too far stays, as long as none of them comes near a particle that is not on
    its list: a disc that flies above a heap has no list built in every other substep.

    All others are within STALE of the skin of where they were as the list was built, so a stray looks around in the cells of that
    time, and compares itself with the other strays. For one level of cells, without periodic images. As always, when a list is
    built shows in no result.
    """

    n: Any = OnDevice()  # particles
    most: Any = OnDevice()  # strays

    def __init__(self, scene: "Scene", search: "NeighbourSearch", team: "Team"):
        self.search, self.list, self.cells, self.team = search, search.list, search.cells, team
        self.state, self.real = scene.state, scene.real
        most = min(MOST, scene.particles.count // SHARE)
        self.n, self.most = scene.count, scene.memory.number(most)
        self.stray = scene.memory.field("grid.strays", max(1, most), kind=ti.i32)
        self.number = scene.memory.field("grid.stray_number", None, kind=ti.i32)
        self.met = scene.memory.field("grid.strays_met", None, kind=ti.i32)  # 1: one of them is near what is not on its list

    @ti.func
    def keep_list(self, thread):
        """Where few have moved too far, and none of them is near what is not on its list, that is not stale any more."""
        if self.list.stale[None] == MOVED:
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, thread)):
                self.number[None], self.met[None] = 0, 0
            self.team.wait()
            self.find(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread))
            self.team.wait()
            number = self.number[None]
            if number <= self.most:
                for k in range(self.team.chunk_begin(number, thread), self.team.chunk_end(number, thread)):
                    if self.meets(self.stray[k], number) != 0:
                        self.met[None] = 1  # all write the same
            self.team.wait()
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, thread)):
                if number <= self.most and self.met[None] == 0:
                    self.list.stale[None] = 0
            self.team.wait()

    @ti.func
    def find(self, begin, end):
        """List the strays among some particles, in any order; once there are too many, that is enough."""
        for b in range(blocks(begin, end)):
            low, high = block(b, begin, end)
            far = 0
            for i in range(low, high):
                far |= self.search.moved_too_far(i)
            if far != 0 and self.number[None] <= self.most:
                for i in range(low, high):
                    if self.search.moved_too_far(i) != 0:
                        k = ti.atomic_add(self.number[None], 1)
                        if k < self.most:
                            self.stray[k] = i

    @ti.func
    def meets(self, i, number):
        """1 if stray i is near a particle that is not on its list."""
        out, cell = 0, self.cells.cell_of(i, 0)
        for r in range(ti.static(3 ** (self.state.dim - 1))):
            base, low, parts, span = self.cells.row(i, cell, 0, r)
            for part in range(parts):
                b = base + self.cells.along(low + part, 0)
                for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                    j = self.cells.sorted[e]
                    out |= self.missing(i, j)
        for k in range(number):
            out |= self.missing(i, self.stray[k])
        return out

    @ti.func
    def missing(self, i, j):
        """1 if a pair is as near as it gets while a list is good, and belongs on the list, but is not there."""
        near = self.search.table.reach(self.search.radius, i, j) + ti.static(1 - 2 * STALE) * ti.cast(self.search.skin, self.real)
        r, out = self.state.apart(i, j), 0
        if r.dot(r) < near * near:
            out = self.search.listed(i, j, r)
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.list.neighbour[e] == j:
                    out = 0
        return out
