"""The search for neighbours: how the neighbour list is built.

For each particle, the list holds all others closer than the sum of radii plus a skin, sorted by index. It also holds pairs with
data other than 0 at any distance: a pair that touched in the last substep may touch in the next, although the list was rebuilt in
between. The list is valid until a particle has moved by half the skin. No sum over the list depends on when it was built, on the
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
from ..features.material import TOUCH
from ..features.regrouping import Regrouping
from ..geometry.ordered import distinct
from .cell_list import CellList, add_to
from .images import FLOW, GRADIENT
from .neighbour_list import MOVED, STALE, WALL, NeighbourList
from .pair_data import PairData

if TYPE_CHECKING:
    from ..features.feature import Scene

COUNT, FILL = range(2)  # whether a scan of the cells around a particle counts neighbours or lists them


def _in_both_orders(linked: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of n particles in both orders, each once and sorted, and where the pairs of each particle begin, (n + 1,)."""
    both = distinct(np.concatenate([linked, linked[:, ::-1]]))[0]
    return both, np.searchsorted(both[:, 0], np.arange(n + 1))


class NeighbourSearch:
    """The search that fills `list`, the neighbour list, from `cells`, a hash of cells.

    skin: by how much particles may come nearer before the list is stale [m]. ahead: the gap up to which valid lists have all
    pairs [m]; pairs are listed up to the sum of both. linked: (m, 2) pairs that are never listed. table: the contact distance of
    each pair, see Table. pair_data: the data of each pair. scratch: a field of vectors, (n,), for use while the list is built.
    reach: (n,) extra distance, beyond its radius, at which a particle must be found [m], see CellList. radius: (n,) [m], where it
    differs from that of the particles.
    """

    host_only = ("_excluded_pairs", "_extent", "_piece", "_scene")

    skin: Any = OnDevice()  # the gap up to which pairs are listed [m]
    sure: Any = OnDevice()  # the gap up to which all pairs are on a valid list [m]
    too_far: Any = OnDevice()  # the square of the displacement beyond which the list is stale [m^2]
    farthest: Any = OnDevice()  # the largest distance of listed pairs [m]
    n: Any = OnDevice()  # number of particles
    has_own_compile_time = True  # see Feature

    def __init__(
        self, scene: "Scene", skin: float, linked: np.ndarray, table: Any, pair_data: list[PairData], team: Team, scratch: Any,
        reach: np.ndarray | None = None, radius: np.ndarray | None = None, walls: Sequence[Any] = (),
        ahead: float = 0.0,
    ):  # fmt: skip
        self.walls = list(walls)  # whose faces are listed, too
        n, dim, add = scene.particles.count, scene.particles.dim, scene.memory.field
        self.n, self.memory, self.real, self.team = scene.count, scene.memory, scene.real, team
        self.sums = Sums(n, team, capped=True)  # on the launched path it has a room of its own
        # Entries of a list that is sorted without branches. Compiling that takes an eighth of the compile time.
        network_size = 1 if scene.memory.compiler.few else 8 if dim == 2 else 16
        rooms = self.sums.room if team.launched else scene.count
        self.list = NeighbourList(scene.memory, scene.count, rooms, pair_data, team, network_size, len(walls) > 0)
        self.network = sorting_network(network_size)
        self.dim, self.state, self.radius = dim, scene.state, scene.radius
        self.table = table
        number, real = scene.memory.number, scene.real
        radius = scene.particles.radius if radius is None else radius
        reach = 0 * radius if reach is None else reach
        self.sheared = bool(self.state.images and self.state.images.sheared)
        self._scene = scene
        margins = self._margins(skin, ahead, radius, reach)
        self.skin, self.sure, self.too_far = (number(value, real) for value in margins)
        self._extent: Sequence[float] = [-1.0] * dim
        self._piece: int = team.piece  # when owners of pair data were last settled
        self.cells = CellList(scene, radius, reach, margins[0], team, scratch)
        self.several_levels = self.cells.levels > 1
        # Whether a particle finds all neighbours in the 3^dim cells around it, even after it has moved far (see Strays).
        self.finds_all_neighbours = not self.several_levels and not self.state.images and not reach.any()
        self.counts_first = self.several_levels or team.launched  # neighbours are counted before they are listed
        self.serial = not self.counts_first or (team.size == 1 and not team.launched)  # one thread writes each list, in order
        self.list.blocks = number(self._blocks(n))
        self.position_at_build = add("grid.built_at", scene.count, width=dim)
        if self.sheared:
            self.strain_at_build = add("grid.built_strain", None, kind=ti.f64)
            self.farthest = number(float(self.cells.sizes.max()), real)
        self.has_excluded = len(linked) > 0
        if self.has_excluded:
            self._excluded_pairs, begin = _in_both_orders(linked, n)
            self.excluded = add("grid.linked", len(self._excluded_pairs), kind=ti.i32, values=self._excluded_pairs[:, 1])
            self.excluded_begin = add("grid.linked_begin", n + 1, kind=ti.i32, values=begin)

    def __repr__(self) -> str:
        return repr(self.list)

    def _margins(self, skin: float, ahead: float, radius: np.ndarray, reach: np.ndarray) -> tuple[float, float, float]:
        """Return `skin`, `sure` and `too_far`; sheared images are the nearest only within half of the box height."""
        far = skin + ahead
        if self.sheared:
            half = float(self._scene.periodic.lengths[GRADIENT]) / 2
            far = min(far, half - 2 * radius.max(initial=0.0) - reach.max(initial=0.0))
        skin = max(0.0, far - ahead)
        return skin + ahead, ahead + (1 - 2 * STALE) * skin, (STALE * skin) ** 2

    def _blocks(self, n: int) -> int:
        """Return the number of blocks of a list of n particles."""
        return max(1, -(-n // self.team.piece)) if self.team.size > 1 and not self.counts_first else 1

    def can_regroup(self, change: Regrouping, radius: np.ndarray, reach: np.ndarray | None = None) -> bool:
        """Whether particles can be added and removed in place. radius, reach: of the particles there are now, (n,) [m]."""
        reach = 0 * radius if reach is None else reach
        n, store = change.now.count, self.list.store
        room = store is not None and store.has_room(self.list.room + (self.list.network_size + 1) * (n + 1))
        finds_all = not self.several_levels and not self.state.images and not reach.any()
        same = not self.team.launched and finds_all == self.finds_all_neighbours
        return room and same and self.cells.can_regroup(radius, reach)

    def regroup(
        self, change: Regrouping, skin: float, radius: np.ndarray, reach: np.ndarray | None = None, ahead: float = 0.0
    ) -> None:
        """Adapt the list to added and removed particles, after the team was adapted.

        The list is kept without the pairs of removed particles, unless skin or cells change. Added particles are not listed: they
        count as strays that moved too far. Where the old list is saved, restore() must give the pair data to the next list.
        """
        n, stale = change.now.count, int(self.memory.view(self.list.stale)[0])
        reach = 0 * radius if reach is None else reach
        if change.has_removed and not self.list.saved:
            self.list.remove_particles(change.number)
            self.cells.remove_particles(change.number)
        margins = self._margins(skin, ahead, radius, reach)
        stays = self.finds_all_neighbours and not self.list.saved and stale != 1 and margins[0] == self.skin
        self.skin, self.sure, self.too_far = margins
        stays &= self.cells.regroup(radius, reach, margins[0], np.array(change.now.extent))
        if self.sheared:
            self.farthest = float(self.cells.sizes.max())
        self.sums.room = n
        if self.list.blocks != self._blocks(n):
            room = self.list.room  # the old list uses this memory
            self.list.blocks = self._blocks(n)
            self.list.allocate(room)
        before, self._piece = self._piece, self.team.piece
        if self.list.movable is not None and self.team.size > 1 and not self.list.saved:
            pieces = change.kept_indices // before, np.arange(change.kept) // self._piece
            self.list.settle_owners((pieces[0] != pieces[1]).nonzero()[0])
        if self.has_excluded:
            begin = self.memory.view(self.excluded_begin)[change.first]
            self.memory.resize(self.excluded_begin, n + 1)
            self.memory.write_from(self.excluded_begin, change.first, np.full(n + 1 - change.first, begin))
        came = n - change.kept
        if came:
            self.memory.write_from(self.position_at_build, change.kept, np.full((came, self.dim), np.nan))
        self.memory.write(self.list.stale, (MOVED if came else stale) if stays else 1)

    def can_exclude(self, linked: np.ndarray) -> bool:
        """Whether exclude() can take these pairs, (m, 2): kernels are compiled either with excluded pairs or without."""
        return self.has_excluded == (len(linked) > 0)

    def exclusions_differ(self, linked: np.ndarray, change: Regrouping) -> bool:
        """Whether the excluded pairs `linked`, (m, 2), differ from the present ones, among particles that remain."""
        if not self.has_excluded:
            return False
        before, now = change.number[self._excluded_pairs], _in_both_orders(linked, change.now.count)[0]
        stay = before[(before >= 0).all(axis=1)]
        return not np.array_equal(stay, now[(now < change.kept).all(axis=1)])

    def exclude(self, linked: np.ndarray) -> None:
        """Exclude these pairs, (m, 2), from the list; can_exclude() must allow it. Particles are numbered as they are now."""
        if self.has_excluded:
            self._excluded_pairs, begin = _in_both_orders(linked, len(self.memory.view(self.excluded_begin)) - 1)
            self.memory.resize(self.excluded, len(self._excluded_pairs))
            self.memory.write(self.excluded, self._excluded_pairs[:, 1])
            self.memory.write(self.excluded_begin, begin)

    @property
    def finest(self) -> float:
        """Size of the smallest cells [m]."""
        return float(self.cells.sizes.min())

    def fit(self, extent: Sequence[float]) -> None:
        """Shape the hash for the extent of the particles, (dim,) [m], if it has changed by an eighth. Affects speed only."""
        for new, old in zip(extent, self._extent, strict=True):
            if not abs(new - old) <= old / 8:
                self._extent = extent
                if self.cells.fit(np.asarray(extent)):
                    self.list.invalidate()
                return

    @ti.func
    def moved_too_far(self, i):
        """Return 1 if particle i has moved by half the skin since the list was built, so that the list is stale."""
        r, limit = self.state.x[i] - self.position_at_build[i], self.too_far
        if ti.static(self.sheared):
            # The mean strain is not counted as motion. It moves listed pairs apart by at most strain * farthest.
            strain = ti.cast(self.state.images.strain[None] - self.strain_at_build[None], self.real)
            r[FLOW] -= strain * self.position_at_build[i][GRADIENT]
            left = ti.max(self.skin - self.sure - ti.abs(strain) * self.farthest, 0) / 2
            limit = left * left
        return ti.select(r.dot(r) <= limit, 0, 1)  # 1 for NaN

    @ti.func
    def build(self, thread):
        """Rebuild the list: sort the particles into cells, then list the neighbours of each. `thread`: see Team."""
        self.list.save_old_list(thread)
        self.cells.sort(thread)
        if ti.static(self.counts_first):
            self.count_and_fill(thread)
        else:
            for k in range(self.team.dealt_count(self.list.blocks, 1, thread)):
                self.fill_block(self.team.dealt_index(k, 1, thread))
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.position_at_build[i] = self.state.x[i]
        self.team.wait()
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.list.stale[None] = 0
            if ti.static(self.sheared):
                self.strain_at_build[None] = self.state.images.strain[None]
            if self.list.need[None] <= self.list.capacity:
                self.list.old_saved[None] = 0
        self.team.wait()

    @ti.func
    def fill_block(self, block):
        """List the neighbours of a block of particles, for one level of cells; those without room are only counted."""
        start, room = block * self.list.pitch, self.list.capacity
        size = (self.n + self.list.blocks - 1) // self.list.blocks
        used = 0
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.list.first[i] = start + ti.min(used, room)
            begin = used
            used = self.scan(i, FILL, start, ti.min(used, MOST))
            self.list.number[i] = ti.max(ti.min(used, room) - begin, 0)
            if ti.static(len(self.walls) > 0):
                begin = used
                used = self.scan_walls(i, FILL, start, used)
                self.list.wall_number[i] = ti.max(ti.min(used, room) - begin, 0)
        for i in range(block * size, ti.min((block + 1) * size, self.n)):
            self.finish_entries(i)
        ti.atomic_max(self.list.need[None], used)

    @ti.func
    def count_and_fill(self, thread):
        """Count the neighbours of all particles, then list them: on a GPU, and where there are several levels of cells.

        On a GPU each particle has a thread. With several levels, the finer particle of a pair finds it and lists it for both.
        Pairs that do not fit are only counted.
        """
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.list.number[i] = 0
        self.team.wait()
        if ti.static(self.team.launched):  # loops must be at the top of a kernel, or serial
            self.scan_all(COUNT, thread)
            self.make_room(thread)
            self.scan_all(FILL, thread)
        else:
            for what in range(FILL + 1):  # a loop at run time, so that scan_all() is compiled once
                self.scan_all(what, thread)
                if what == COUNT:
                    self.make_room(thread)
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if ti.static(len(self.walls) > 0):
                end = self.list.number[i]
                if self.list.need[None] <= self.list.capacity:
                    end = self.scan_walls(i, FILL, self.list.first[i], end)
                self.list.wall_number[i] = end - self.list.number[i]
            self.finish_entries(i)

    @ti.func
    def scan_all(self, what: ti.template(), thread):  # type: ignore[valid-type]
        """Scan the cells around all particles. what: COUNT or FILL."""
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            if what == COUNT or self.list.need[None] <= self.list.capacity:
                used = self.scan(i, what, self.list.first[i], 0)
                if what == COUNT:
                    if ti.static(len(self.walls) > 0):  # room behind the entries of particles
                        used = self.scan_walls(i, COUNT, 0, used)
                    add_to(self.list.number, i, used, self.serial)
                elif ti.static(not self.several_levels):
                    self.list.number[i] = used
        self.team.wait()

    @ti.func
    def make_room(self, thread):
        """Compute where the entries of each particle begin, from the counted neighbours."""
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
    def finish_entries(self, i):
        """Sort the entries of particle i, and transfer the data of its pairs from the old list."""
        self.sort_entries(self.list.first[i], self.list.number[i])
        self.list.transfer_pair_data(i)

    @ti.func
    def scan(self, i, what: ti.template(), start, used):  # type: ignore[valid-type]
        """Find the neighbours of particle i in the cells around it, at its own level and the coarser ones.

        The list begins at `start` and has `used` entries; the new number of entries is returned. what: COUNT or FILL, where
        neighbours are counted first.
        """
        own = self.cells.level_of(i)
        for m in range(own + 1):
            cell = self.cells.cell_of(i, m)
            for r in range(ti.static(3 ** (self.dim - 1))):
                base, low, parts, span = self.cells.row_of_cells(i, cell, m, r)
                for part in range(parts):
                    b = base + self.cells.position_in_row(low + part, m)
                    for e in range(self.cells.edge[b + 1], self.cells.edge[b + span + 1]):
                        j = self.cells.sorted[e]
                        listed = self.is_list_member(i, j, self.cells.separation(i, e))
                        if ti.static(not self.counts_first):
                            # No branch, which the CPU could not predict. The next entry overwrites one that is not listed.
                            self.list.neighbour[start + ti.min(used, self.list.capacity)] = j
                        elif (what != COUNT or m < own) and listed != 0:
                            at, theirs = used, 0
                            if ti.static(self.several_levels):  # scans of other particles write to this list, too
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
            if ti.static(len(self.walls) > 0):
                if j >= WALL:
                    continue
            if self.is_list_member(i, j, self.state.separation(i, j)) == 0:
                if ti.static(not self.counts_first):
                    self.list.neighbour[start + ti.min(used, self.list.capacity)] = j
                elif what != COUNT:
                    at = used
                    if ti.static(self.several_levels):
                        at = add_to(self.list.number, i, 1, self.serial)
                    self.list.neighbour[start + at] = j
                used += 1
        return used

    @ti.func
    def scan_walls(self, i, what, start, used):
        """Find the faces of walls that are near particle i, or bore something on it. Arguments as those of scan()."""
        if self.state.w[i] > 0:
            for group in ti.static(self.walls):
                k = -1
                while k < group.count():
                    k = self.next_wall(group, k, i)
                    if k < group.count():
                        group.enter(k)
                        begin, end = group.wall.near_sides(i, self.radius.of(i) + ti.cast(self.skin, self.real))
                        for place in range(begin, end):
                            side = group.wall.side_at(place)
                            face = WALL + group.face(k, side)
                            listed = group.wall.least_gap(side, i, self.radius.of(i)) < ti.cast(self.skin, self.real)
                            for old in range(self.list.old_first[i], self.list.old_first[i] + self.list.old_number[i]):
                                listed = listed or self.list.old_neighbour[old] == face
                            if listed:
                                if what != COUNT:
                                    self.list.neighbour[start + ti.min(used, self.list.capacity)] = face
                                used += 1
        return used

    @ti.func
    def next_wall(self, group: ti.template(), last, i):  # type: ignore[valid-type]
        """Return the first wall of a group behind the wall `last` that is near particle i or on its old list; `count` if none."""
        out = group.next_within(last, i, self.radius.of(i) + ti.cast(self.skin, self.real))
        if ti.static(bool(group.tree)):
            for old in range(self.list.old_first[i], self.list.old_first[i] + self.list.old_number[i]):
                k = group.wall_of(self.list.old_neighbour[old] - WALL)
                if k > last and k < out:
                    out = k
        return out

    @ti.func
    def is_list_member(self, i, j, r):
        """Return 1 if a pair with difference r [m] belongs on the list: near, movable, not excluded."""
        far = self.table.cutoff(self.radius, i, j) + ti.cast(self.skin, self.real)
        yes = ti.cast(r.dot(r) < far * far, ti.i32) & ti.cast(i != j, ti.i32)
        if yes != 0:
            yes = ti.cast(self.state.w[i] + self.state.w[j] > 0, ti.i32)
        if ti.static(not self.table.uniform):
            if yes != 0:
                yes = ti.cast(self.table.of(i, j)[TOUCH] > 0, ti.i32)
        if ti.static(self.has_excluded):
            if yes != 0:
                for e in range(self.excluded_begin[i], self.excluded_begin[i + 1]):
                    if self.excluded[e] == j:
                        yes = 0
        return yes

    @ti.func
    def sort_entries(self, begin, count):
        """Sort `count` entries from `begin` on by index, which makes every sum over the list independent of the cells."""
        if ti.static(self.several_levels or self.list.network_size == 1):
            sort(self.list.neighbour, begin, count, self.serial)
        elif count > ti.static(self.list.network_size):
            sort(self.list.neighbour, begin, count, self.serial)
        else:
            # Where particles close in space have close indices, the entries are already sorted, which exchange() tests first.
            exchange(self.list.neighbour, begin, count, self.network, self.list.network_size)
