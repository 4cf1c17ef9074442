"""Neighbours: how the list of near pairs is built.

It holds, for each particle, all others closer than the sum of radii plus a skin, sorted by index, and those with which it shares
pair data other than 0, wherever they are: what touched in the last substep may do so in the next, although a list was built
in between. It stays valid until something has moved by half the skin, and no sum over it depends on when it was built, on the
hash, or on the skin.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from ..device.prefix_sum import MOST, Sums
from ..device.sorting import exchange, sort, sorting_network
from ..device.thread_team import Team
from ..features.regrouping import Regrouping
from ..geometry.ordered import distinct
from .cell_list import CellList, add_to
from .images import FLOW, GRADIENT
from .neighbour_list import MOVED, STALE, NeighbourList, PairData

if TYPE_CHECKING:
    from ..features.feature import Scene

COUNT, FILL = range(2)  # what a scan of the cells around a particle does with the neighbours that it finds


def _both(linked: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of n particles in both orders, each once, and where those of each particle begin."""
    both = distinct(np.concatenate([linked, linked[:, ::-1]]))[0]
    return both, np.searchsorted(both[:, 0], np.arange(n + 1))


class NeighbourSearch:
    """What fills `list`, the list of near pairs, from `cells`, a hash of cells.

    skin: what is listed beyond touching [m]. linked: (m, 2) pairs that are never listed. table: which pairs are near, as Table
    says it. pair_data: what each pair remembers. scratch: a field of vectors, (n,), to use while the list is built. reach: (n,)
    how much further than by its radius a particle has to be found [m], see CellList. radius: (n,) [m], where it is not that of
    the particles.
    """

    skin: Any = OnDevice()
    too_far: Any = OnDevice()  # the square of the way after which the list is stale
    farthest: Any = OnDevice()  # how far apart pairs are listed [m], at most
    n: Any = OnDevice()  # particles
    has_own_compile_time = True  # as a Feature

    def __init__(
        self, scene: "Scene", skin: float, linked: np.ndarray, table: Any, pair_data: list[PairData], team: Team, scratch: Any,
        reach: np.ndarray | None = None, radius: np.ndarray | None = None,
    ):  # fmt: skip
        n, dim, add = scene.particles.count, scene.particles.dim, scene.memory.field
        self.n, self.memory, self.real, self.team = scene.count, scene.memory, scene.real, team
        self.sums = Sums(n, team, capped=True)  # with a room of its own where the team is launched
        # Entries of a list that is sorted without branches; to compile that takes an eighth of all.
        short = 1 if scene.memory.compiler.few else 8 if dim == 2 else 16
        rooms = self.sums.room if team.launched else scene.count
        self.list = NeighbourList(scene.memory, scene.count, rooms, pair_data, team, short)
        self.network = sorting_network(short)
        self.dim, self.state, self.radius = dim, scene.state, scene.radius
        self.table = table
        number, real = scene.memory.number, scene.real
        radius = scene.particles.radius if radius is None else radius
        reach = 0 * radius if reach is None else reach
        self.sheared = bool(self.state.images and self.state.images.sheared)
        self._scene = scene
        skin = self._skin(skin, radius, reach)
        self.skin, self.too_far = number(skin, real), number((STALE * skin) ** 2, real)
        self._extent: Sequence[float] = [-1.0] * dim
        self.cells = CellList(scene, radius, reach, skin, team, scratch)
        self.several_levels = self.cells.levels > 1
        # A particle finds all others in the 3^dim cells around it, as far as they have gone since.
        self.lone = not self.several_levels and not self.state.images and not reach.any()
        self.counts = self.several_levels or team.launched  # before it lists
        self.serial = not self.counts or (team.size == 1 and not team.launched)  # one thread makes a list, in order
        self.list.blocks = number(self._blocks(n))
        self.origin = add("grid.built_at", scene.count, width=dim)
        if self.sheared:
            self.strain = add("grid.built_strain", None, kind=ti.f64)
            self.farthest = number(float(self.cells.sizes.max()), real)
        self.has_static = bool((scene.inv_mass == 0).any())  # whether there are pairs that cannot move
        self.linked = len(linked) > 0
        if self.linked:
            self._both, begin = _both(linked, n)
            self.excluded = add("grid.linked", len(self._both), kind=ti.i32, values=self._both[:, 1])
            self.excluded_begin = add("grid.linked_begin", n + 1, kind=ti.i32, values=begin)

    def __repr__(self) -> str:
        return repr(self.list)

    def _skin(self, skin: float, radius: np.ndarray, reach: np.ndarray) -> float:
        """What can be listed beyond touching [m]. In a shear, within half of the height the nearest image along y is the nearest
        one."""
        if not self.sheared:
            return skin
        return min(skin, float(self._scene.periodic.lengths[GRADIENT]) / 2 - 2 * radius.max(initial=0.0) - reach.max(initial=0.0))

    def _blocks(self, n: int) -> int:
        """Parts of the list of n particles."""
        return max(1, -(-n // self.team.piece)) if self.team.size > 1 and not self.counts else 1

    def can_regroup(self, change: Regrouping, radius: np.ndarray, reach: np.ndarray | None = None) -> bool:
        """Whether particles can come and go where it is. radius, reach: as many as there are now [m]."""
        reach = 0 * radius if reach is None else reach
        n, store = change.now.count, self.list.store
        room = store is not None and store.holds(self.list.room + (self.list.short + 1) * (n + 1))
        static = bool((change.inv_mass == 0).any()) == self.has_static
        lone = not self.several_levels and not self.state.images and not reach.any()
        return room and static and not self.team.launched and lone == self.lone and self.cells.can_regroup(radius, reach)

    def regroup(self, change: Regrouping, skin: float, radius: np.ndarray, reach: np.ndarray | None = None) -> None:
        """They came and went, and the team knows. The list stays, but for pairs of what went, unless it is another one that
        would be built now; what came is on no list, as a stray is that has gone far. Where the old list is saved, what pairs
        remember is to be given to the next list by restore()."""
        n, stale = change.now.count, int(self.memory.seen(self.list.stale)[0])
        reach = 0 * radius if reach is None else reach
        if change.has_removed and not self.list.saved:
            self.list.drop(change.number)
            self.cells.drop(change.number)
        skin = self._skin(skin, radius, reach)
        stays = self.lone and not self.list.saved and stale != 1 and skin == self.skin
        self.skin, self.too_far = skin, (STALE * skin) ** 2
        stays &= self.cells.regroup(radius, reach, skin, np.array(change.now.extent))
        if self.sheared:
            self.farthest = float(self.cells.sizes.max())
        self.sums.room = n
        if self.list.blocks != self._blocks(n):
            room = self.list.room  # where the old list stands
            self.list.blocks = self._blocks(n)
            self.list.allocate(room)
        if self.linked:
            begin = self.memory.seen(self.excluded_begin)[change.first]
            self.memory.resize(self.excluded_begin, n + 1)
            self.memory.write_from(self.excluded_begin, change.first, np.full(n + 1 - change.first, begin))
        came = n - change.kept
        if came:
            self.memory.write_from(self.origin, change.kept, np.full((came, self.dim), np.nan))
        self.memory.write(self.list.stale, (MOVED if came else stale) if stays else 1)

    def can_exclude(self, linked: np.ndarray) -> bool:
        """Whether it can leave out other pairs than it did."""
        return self.linked == (len(linked) > 0)

    def others(self, linked: np.ndarray, change: Regrouping) -> bool:
        """Whether these pairs that are left out are others than before, of particles that stay."""
        if not self.linked:
            return False
        before, now = change.number[self._both], _both(linked, change.now.count)[0]
        stay = before[(before >= 0).all(axis=1)]
        return not np.array_equal(stay, now[(now < change.kept).all(axis=1)])

    def exclude(self, linked: np.ndarray) -> None:
        """Leave out these pairs, which can_exclude() allows; its particles are those that there are now."""
        if self.linked:
            self._both, begin = _both(linked, len(self.memory.seen(self.excluded_begin)) - 1)
            self.memory.resize(self.excluded, len(self._both))
            self.memory.write(self.excluded, self._both[:, 1])
            self.memory.write(self.excluded_begin, begin)

    @property
    def finest(self) -> float:
        """The size of the smallest cells [m]."""
        return float(self.cells.sizes.min())

    def fit(self, extent: Sequence[float]) -> None:
        """Shape the hash for the extent of the particles [m], if it is another one by an eighth; affects speed only."""
        for new, old in zip(extent, self._extent, strict=True):
            if not abs(new - old) <= old / 8:
                self._extent = extent
                if self.cells.fit(np.asarray(extent)):
                    self.list.invalidate()
                return

    @ti.func
    def moved_too_far(self, i):
        """1 if the list is stale: once a particle has moved by half the skin."""
        r, limit = self.state.x[i] - self.origin[i], self.too_far
        if ti.static(self.sheared):
            # Beside what all are strained by: that takes pairs apart by no more than the strain of the farthest that are listed.
            strain = ti.cast(self.state.images.strain[None] - self.strain[None], self.real)
            r[FLOW] -= strain * self.origin[i][GRADIENT]
            left = ti.max(self.skin - ti.abs(strain) * self.farthest, 0)
            limit = ti.static(STALE**2) * left * left
        return ti.select(r.dot(r) <= limit, 0, 1)  # 1 for NaN

    @ti.func
    def build(self, thread):
        """Sort the particles into cells, then list the near ones of each. `thread`: see Team."""
        self.list.save_old_list(thread)
        self.cells.sort(thread)
        if ti.static(self.counts):
            self.pair_up(thread)
        else:
            for k in range(self.team.dealt_count(self.list.blocks, 1, thread)):
                self.fill(self.team.dealt_index(k, 1, thread))
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.origin[i] = self.state.x[i]
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.list.stale[None] = 0
            if ti.static(self.sheared):
                self.strain[None] = self.state.images.strain[None]
            if self.list.need[None] <= self.list.capacity:
                self.list.old_saved[None] = 0
        self.team.wait()

    @ti.func
    def fill(self, block):
        """One level: list the neighbours of a block of particles, one after the other. Beyond the room they are only counted."""
        start, room = block * self.list.pitch, self.list.capacity
        size = (self.n + self.list.blocks - 1) // self.list.blocks
        used = 0
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.list.first[i] = start + ti.min(used, room)
            begin = used
            used = self.scan(i, FILL, start, ti.min(used, MOST))
            self.list.number[i] = ti.max(ti.min(used, room) - begin, 0)
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.finish(i)
        ti.atomic_max(self.list.need[None], used)

    @ti.func
    def pair_up(self, thread):
        """Count, then list: on a GPU, by a thread for each particle; and for several levels, each pair that one of the two finds
        with both. What does not fit is only counted."""
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.list.number[i] = 0
        self.team.wait()
        if ti.static(self.team.launched):  # where loops are at the top of a kernel, or serial
            self.scan_all(COUNT, thread)
            self.make_room(thread)
            self.scan_all(FILL, thread)
        else:
            for what in range(FILL + 1):  # the code of it is there once
                self.scan_all(what, thread)
                if what == COUNT:
                    self.make_room(thread)
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.finish(i)

    @ti.func
    def scan_all(self, what: ti.template(), thread):  # type: ignore[valid-type]
        """COUNT the neighbours of every particle, or FILL its list."""
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if what == COUNT or self.list.need[None] <= self.list.capacity:
                used = self.scan(i, what, self.list.first[i], 0)
                if what == COUNT:
                    add_to(self.list.number, i, used, self.serial)
                elif ti.static(not self.several_levels):
                    self.list.number[i] = used
        self.team.wait()

    @ti.func
    def make_room(self, thread):
        """Where each list begins, by how many neighbours were counted."""
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.list.first[i] = self.list.number[i]
        self.team.wait()
        self.sums.run(self.list.first, thread)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.list.need[None] = self.list.first[self.n - 1]
        self.team.wait()
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.list.first[i] = self.list.first[i] - self.list.number[i]
            self.list.number[i] = 0
        self.team.wait()

    @ti.func
    def finish(self, i):
        """Put the list of particle i in order."""
        self.order(self.list.first[i], self.list.number[i])
        self.list.touching[i] = self.list.transfer_pair_data(i)

    @ti.func
    def scan(self, i, what: ti.template(), start, used):  # type: ignore[valid-type]
        """Look for neighbours in the cells around particle i, at its own level and the coarser ones. Its list begins at `start`
        and has `used` entries; returns how many it has then. what: COUNT or FILL, where they are counted first."""
        own = self.cells.level_of(i)
        for m in range(own + 1):
            cell = self.cells.cell_of(i, m)
            for r in range(ti.static(3 ** (self.dim - 1))):
                base, low, parts, span = self.cells.row(i, cell, m, r)
                for part in range(parts):
                    b = base + self.cells.along(low + part, m)
                    for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                        j = self.cells.sorted[e]
                        listed = self.listed(i, j, self.cells.apart(i, e))
                        if ti.static(not self.counts):
                            # No branch: it would be taken at random. What is not listed is written over by the next.
                            self.list.neighbour[start + ti.min(used, self.list.capacity)] = j
                        elif (what != COUNT or m < own) and listed != 0:
                            at, theirs = used, 0
                            if ti.static(self.several_levels):  # others write to this list, too
                                if m < own:
                                    theirs = add_to(self.list.number, j, 1, self.serial)
                                if what != COUNT:
                                    at = add_to(self.list.number, i, 1, self.serial)
                                    if m < own:
                                        self.list.neighbour[self.list.first[j] + theirs] = i
                            if what != COUNT:
                                self.list.neighbour[start + at] = j
                        used += listed
        for old in range(self.list.old_first[i], self.list.old_first[i] + self.list.old_number[i]):
            j = self.list.old_neighbour[old]
            if self.listed(i, j, self.state.apart(i, j)) == 0:
                if ti.static(not self.counts):
                    self.list.neighbour[start + ti.min(used, self.list.capacity)] = j
                elif what != COUNT:
                    at = used
                    if ti.static(self.several_levels):
                        at = add_to(self.list.number, i, 1, self.serial)
                    self.list.neighbour[start + at] = j
                used += 1
        return used

    @ti.func
    def listed(self, i, j, r):
        """1 if a pair, apart by r, belongs on the list: near, not both immovable, not linked."""
        far = self.table.reach(self.radius, i, j) + ti.cast(self.skin, self.real)
        yes = ti.cast(r.dot(r) < far * far, ti.i32) & ti.cast(i != j, ti.i32)
        if ti.static(self.has_static):
            if yes != 0:
                yes = ti.cast(self.state.w.of(i) + self.state.w.of(j) > 0, ti.i32)
        if ti.static(not self.table.uniform):
            if yes != 0:
                yes = ti.cast(self.table.of(i, j)[3] > 0, ti.i32)
        if ti.static(self.linked):
            if yes != 0:
                for e in range(self.excluded_begin[i], self.excluded_begin[i + 1]):
                    if self.excluded[e] == j:
                        yes = 0
        return yes

    @ti.func
    def order(self, begin, count):
        """Sort by index, which makes every sum over the list independent of the table."""
        if ti.static(self.several_levels or self.list.short == 1):
            sort(self.list.neighbour, begin, count, self.serial)
        elif count > ti.static(self.list.short):
            sort(self.list.neighbour, begin, count, self.serial)
        else:
            # Where neighbours in space are neighbours in number too, they are in order as they come.
            exchange(self.list.neighbour, begin, count, self.network, self.list.short)
