"""Strays: the few particles that have moved too far since the neighbour list was built, while all others have not."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..device.number import OnDevice
from ..device.thread_team import block, blocks
from .neighbour_list import MOVED, WALL

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .neighbour_search import NeighbourSearch

MOST = 256  # strays at a time at most, since all are compared with each other
SHARE = 64  # particles per stray at least, so that searching around all strays costs less than a new list


class Strays:
    """The test that keeps a stale neighbour list while the strays have no unlisted neighbour.

    Without it, a disc that flies above a heap would have the list rebuilt in every other substep. All other particles are within
    STALE of the skin of where they were when the list was built. So each stray is compared with the particles in the cells of
    that time around it, and with the other strays. For one level of cells, without periodic images. Results do not depend on when
    a list is built.
    """

    n: Any = OnDevice()  # number of particles
    max_strays: Any = OnDevice()  # number of strays for which there is room

    def __init__(self, scene: "Scene", search: "NeighbourSearch", team: "Team"):
        self.search, self.list, self.cells, self.team = search, search.list, search.cells, team
        self.state, self.real = scene.state, scene.real
        most = min(MOST, scene.particles.count // SHARE)
        self.n, self.max_strays = scene.count, scene.memory.number(most)
        self.stray = scene.memory.field("grid.strays", max(1, most), kind=ti.i32)
        self.number = scene.memory.field("grid.stray_number", None, kind=ti.i32)
        self.found_unlisted = scene.memory.field("grid.strays_met", None, kind=ti.i32)  # 1: a stray is near an unlisted particle

    @ti.func
    def keep_list(self, thread):
        """Clear the stale flag if few particles moved too far, and none of them is near an unlisted particle."""
        if self.list.stale[None] == MOVED:
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, thread)):
                self.number[None], self.found_unlisted[None] = 0, 0
            self.team.wait()
            self.find_strays(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread))
            self.team.wait()
            number = self.number[None]
            if number <= self.max_strays:
                for k in range(self.team.chunk_begin(number, thread), self.team.chunk_end(number, thread)):
                    if self.is_near_unlisted(self.stray[k], number) != 0:
                        self.found_unlisted[None] = 1  # all write the same
            self.team.wait()
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, thread)):
                if number <= self.max_strays and self.found_unlisted[None] == 0:
                    self.list.stale[None] = 0
            self.team.wait()

    @ti.func
    def find_strays(self, begin, end):
        """List the strays among particles from `begin` up to `end`, in any order. The search stops once there are too many."""
        for b in range(blocks(begin, end)):
            low, high = block(b, begin, end)
            far = 0
            for i in range(low, high):
                far |= self.search.moved_too_far(i)
            if far != 0 and self.number[None] <= self.max_strays:
                for i in range(low, high):
                    if self.search.moved_too_far(i) != 0:
                        k = ti.atomic_add(self.number[None], 1)
                        if k < self.max_strays:
                            self.stray[k] = i

    @ti.func
    def is_near_unlisted(self, i, number):
        """Return 1 if stray i is near a particle that is not on its list."""
        out, cell = 0, self.cells.cell_of(i, 0)
        for r in range(ti.static(3 ** (self.state.dim - 1))):
            base, low, parts, span = self.cells.row_of_cells(i, cell, 0, r)
            for part in range(parts):
                b = base + self.cells.position_in_row(low + part, 0)
                for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                    j = self.cells.sorted[e]
                    out |= self.is_unlisted(i, j)
        for k in range(number):
            out |= self.is_unlisted(i, self.stray[k])
        near = ti.cast(self.search.sure, self.real)
        for group in ti.static(self.search.walls):
            k = -1
            while k < group.count():
                k = group.next_within(k, i, self.search.radius.of(i) + near)
                if k < group.count():
                    group.enter(k)
                    begin, end = group.wall.near_sides(i, self.search.radius.of(i) + near)
                    for place in range(begin, end):
                        side = group.wall.side_at(place)
                        if group.wall.least_gap(side, i, self.search.radius.of(i)) < near:
                            out |= 1 - self.list.has(i, WALL + group.face(k, side))
        return out

    @ti.func
    def is_unlisted(self, i, j):
        """Return 1 if a pair belongs on the list, is nearer than any unlisted pair of a valid list can be, and is not listed."""
        near = self.search.table.cutoff(self.search.radius, i, j) + ti.cast(self.search.sure, self.real)
        r, out = self.state.separation(i, j), 0
        if r.dot(r) < near * near:
            out = self.search.is_list_member(i, j, r) & (1 - self.list.has(i, j))
        return out
