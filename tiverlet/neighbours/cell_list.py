"""A spatial hash over an unbounded domain, for particles of any sizes.

The hash folds space onto a torus of cells, cell (a, b, ...) to bucket (a mod A, b mod B, ...) with A, B powers of two
of at least 4. The three cells around a particle along each axis thus fall into different buckets, so every bucket is read
once and every pair is seen once, however many far cells share a bucket; those are told apart by the distance itself. CellList
of a row stand side by side in memory. Counting sort; no cell has a capacity. On a GPU the counters are atomic, and the order
within a cell is another one in every run: no result may depend on it.

Particles whose sizes differ by more than a factor of two stand in tables of their own, with cells of their size: level 0 holds
the largest, each next level sizes down to half of those before. The size of a particle is its radius, and half of how much
further it has to be found. A particle looks at its own level and at the coarser ones, where
its neighbours are in the 3^dim cells around it; of the finer ones it hears when they find it.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import runtime, ti
from ..device.number import OnDevice
from ..device.prefix_sum import Sums
from ..geometry.ordered import distinct
from .images import FLOW, GRADIENT

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene

FARTHEST = 1 << 22  # cells from the origin: beyond it, f32 cannot tell a cell from the next
LEVELS = 14  # the last one holds all that are smaller, down to points


class CellList:
    """The tables. radius: (n,) [m]. reach: (n,) [m]. Pairs are looked for up to the sum of their radii, the longer of their
    reaches, and the skin [m]."""

    n: Any = OnDevice()  # particles
    buckets: Any = OnDevice()  # of the tables
    coarsest: Any = OnDevice()  # cells per meter, of level 0

    def __init__(self, scene: "Scene", radius: np.ndarray, reach: np.ndarray, skin: float, team: "Team", scratch: Any):
        self.team = team
        self.place = scratch  # of the particles as they are sorted, while a list is built: read one after the other
        self.memory = scene.memory
        dim, add = scene.particles.dim, scene.memory.field
        self.n, self.dim, self.state, self.real = scene.count, dim, scene.state, scene.real
        self.serial = not team.launched  # counting in order, on one thread, beats atomic counters in parallel on a CPU
        level = levels_of(radius, reach)
        self.levels = int(level.max(initial=0)) + 1
        self.sizes, self.bits, offsets = self._tables(radius, reach, skin, level)
        self.coarsest = scene.memory.number(float(1 / self.sizes[0]), scene.real)
        self.buckets = scene.memory.number(int(offsets[-1]))
        self.images, self._lengths = scene.state.images, np.full(dim, np.inf)
        self.axes, self.sheared = (self.images.axes, self.images.sheared) if self.images else ((), False)
        if self.images:
            self._lengths = scene.periodic.lengths
        self._shapes = self.shapes(np.array(scene.particles.extent))
        self.sums = Sums(self.buckets + 2, team)
        self.edge = add("grid.edge", self.sums.room, kind=ti.i32)
        self.sorted = add("grid.sorted", scene.particles.count, kind=ti.i32)
        if self.state.compensated:
            self.low = add("grid.place_low", scene.count, width=dim)
        self.shape = add("grid.shape", self.levels, width=dim, kind=ti.i32, values=self._shapes)
        if self.images:
            self.count = add("grid.cells", self.levels, width=dim, kind=ti.i32, values=self.counts(self._shapes))
        if self.levels > 1:
            self.level = add("grid.level", scene.count, kind=ti.i32, values=level)
            self.per_meter = add("grid.cells_per_meter", self.levels, values=1 / self.sizes)
            self.offset = add("grid.offset", self.levels, kind=ti.i32, values=offsets[:-1])

    def _tables(
        self, radius: np.ndarray, reach: np.ndarray, skin: float, level: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
        """Of each table the size of its cells [m], the bits of its number of buckets, and where it begins; and where all end."""
        finer, longest = (np.array([v[level >= m].max(initial=0.0) for m in range(self.levels)]) for v in (radius, reach))
        own = finer if self.levels == 1 else np.array([radius[level == m].max(initial=0.0) for m in range(self.levels)])
        # Rounding of floor(x * scale) must not hide a neighbour.
        sizes = (own + finer + longest + skin) * (1 + 2.0**-12)
        counts = np.bincount(level, minlength=self.levels)
        bits = np.maximum(2 * self.dim, np.ceil(np.log2(np.maximum(2 * counts, 1)))).astype(int)
        return sizes, bits, np.concatenate([[0], np.cumsum(1 << bits)])

    def can_regroup(self, radius: np.ndarray, reach: np.ndarray) -> bool:
        """Whether particles of these sizes have as many tables, which have room."""
        level = levels_of(radius, reach)
        return int(level.max(initial=0)) + 1 == self.levels and self.memory.has_room(4 * (len(radius) + 4**self.dim) + 2)

    def drop(self, number: np.ndarray) -> None:
        """Take out particles that went, where others have new numbers, -1 for these, until cells are filled anew."""
        order, edge = self.memory.view(self.sorted), self.memory.view(self.edge)
        new = number[order[: len(number)]]
        gone = np.flatnonzero(new < 0)
        order[: len(new) - len(gone)] = new[new >= 0]
        edge -= np.searchsorted(gone, edge).astype(edge.dtype)

    def regroup(self, radius: np.ndarray, reach: np.ndarray, skin: float, extent: np.ndarray) -> bool:
        """There are other particles now, see NeighbourSearch.regroup(). extent: of all of them [m]. Returns whether the cells are
        those that were filled last."""
        level, memory = levels_of(radius, reach), self.memory
        memory.resize(self.sorted, len(radius))
        sizes, bits, offsets = self._tables(radius, reach, skin, level)
        if self.levels > 1:
            memory.write(self.level, level)
        if np.array_equal(sizes, self.sizes) and np.array_equal(bits, self.bits):
            return True
        self.sizes, self.bits, self.coarsest, self.buckets = sizes, bits, float(1 / sizes[0]), int(offsets[-1])
        self.sums.room = self.buckets + 2
        memory.resize(self.edge, self.sums.room)
        if self.levels > 1:
            memory.write(self.per_meter, 1 / sizes)
            memory.write(self.offset, offsets[:-1])
        self._shapes = np.zeros((0, self.dim))
        self.fit(extent)
        return False

    def shapes(self, extent: np.ndarray) -> np.ndarray:
        """Bits of each axis of each table, (levels, dim): at least 2, the rest where there are most cells per bucket."""
        out = []
        extent = np.where(np.isfinite(self._lengths), self._lengths, extent)
        for size, bits in zip(self.sizes, self.bits.tolist(), strict=True):
            cells, of = np.nan_to_num(extent / size, nan=1.0, posinf=1e30).tolist(), [2] * self.dim
            for _ in range(bits - 2 * self.dim):
                each = [number / (1 << k) for number, k in zip(cells, of, strict=True)]
                of[each.index(max(each))] += 1
            out.append(of)
        return np.array(out)

    def fit(self, extent: np.ndarray) -> bool:
        """Shape the tables for particles that fill a box of this size [m]; affects speed only. Returns whether they changed."""
        shapes = self.shapes(extent)
        changed = not np.array_equal(shapes, self._shapes)
        if changed:
            self._shapes = shapes
            self.memory.write(self.shape, shapes)
            if self.images:
                self.memory.write(self.count, self.counts(shapes))
        return changed

    def counts(self, shapes: np.ndarray) -> np.ndarray:
        """Cells of each table along periodic axes, (levels, dim), 1 along others: no smaller than they have to be. Where there
        are more than buckets, a multiple of these, so that the three cells around the end of the box have different ones."""
        most = np.where(np.isfinite(self._lengths), self._lengths, 0.0) / self.sizes[:, None]
        fitting, buckets = np.minimum(most, 2.0**30), 2.0**shapes
        each = np.where(fitting < buckets, 1.0, buckets)
        return np.maximum(1, np.floor(fitting / each) * each).astype(int)

    @ti.func
    def level_of(self, i):
        """The level of particle i."""
        m = 0
        if ti.static(self.levels > 1):
            m = self.level[i]
        return m

    @ti.func
    def cell_of(self, i, m):
        """The cell of particle i at level m."""
        cell = ti.floor(self.state.x[i] * self.scale(m), ti.i32)
        for k in ti.static(self.axes):
            cell[k] = self.images.cell(self.state.x[i], k, 0, self.count[m][k])
        return cell

    @ti.func
    def around(self, point, radius, m, k: ti.template()):  # type: ignore[valid-type]
        """The first of the cells along periodic axis k in which particles within `radius` of a point in the box may be, and how
        many there are, with one more on each side; of a sheared box all along FLOW."""
        count, size = self.count[m][k], self.images.length[None][k]
        low = ti.floor((point[k] - radius) / size * count, ti.i32) - 1
        number = ti.floor((point[k] + radius) / size * count, ti.i32) + 2 - low
        if ti.static(self.sheared and k == FLOW):
            number = count
        return low, ti.min(number, count, 1 << self.shape[m][k])

    @ti.func
    def scale(self, m):
        """CellList per meter at level m."""
        scale = ti.cast(self.coarsest, self.real)
        if ti.static(self.levels > 1):
            scale = self.per_meter[m]
        return scale

    @ti.func
    def bucket(self, cell, m):
        """The bucket of a cell at level m; axis 0 varies fastest."""
        bits = self.shape[m]
        b = cell[self.dim - 1] & ((1 << bits[self.dim - 1]) - 1)
        for k in ti.static(range(self.dim - 2, -1, -1)):
            b = (b << bits[k]) | (cell[k] & ((1 << bits[k]) - 1))
        if ti.static(self.levels > 1):
            b += self.offset[m]
        return b

    @ti.func
    def bucket_of(self, i):
        """The bucket of particle i."""
        m = self.level_of(i)
        return self.bucket(self.cell_of(i, m), m)

    @ti.func
    def sort(self, thread):
        """Sort the particles into buckets."""
        for b in range(self.team.chunk_begin(self.buckets + 2, thread), self.team.chunk_end(self.buckets + 2, thread)):
            self.edge[b] = 0
        self.team.wait()
        ti.loop_config(serialize=self.serial)
        for i in range(self.team.one(self.n, thread)):
            add_to(self.edge, self.bucket_of(i) + 1, 1, self.serial)
        self.sums.run(self.edge, thread)
        ti.loop_config(serialize=self.serial)
        for back in range(self.team.one(self.n, thread)):
            # Filling a bucket from its end turns the end of each into its begin, and the next one's begin is its end. From the
            # last particle on, so that each bucket comes out in order (on one thread) and leaves little to sort.
            i = self.n - 1 - back
            k = add_to(self.edge, self.bucket_of(i) + 1, -1, self.serial) - 1
            self.sorted[k] = i
            self.place[k] = self.state.x[i]
            if ti.static(self.state.compensated):
                self.low[k] = self.state.low[i]
        self.team.wait()

    @ti.func
    def apart(self, i, k):
        """From the k-th of the sorted particles to particle i, as State.apart() has it."""
        r = self.state.x[i] - self.place[k]
        if ti.static(self.state.compensated and len(self.axes) > 0):
            far = ti.cast(self.state.x[i], ti.f64) - ti.cast(self.place[k], ti.f64)
            r = ti.cast(self.state.nearest(far + (self.state.low[i] - self.low[k])), self.real)
        elif ti.static(self.state.compensated):
            r += self.state.low[i] - self.low[k]
        elif ti.static(len(self.axes) > 0):
            r = self.state.nearest(r)
        return r

    @ti.func
    def row(self, i, cell, m, r):
        """Row r of the 3^(dim - 1) around a cell at level m, of particle i: its first bucket, how far along its three cells
        begin, into how many parts they fall, and how many cells stand side by side in each: 3, or 1 where the torus wraps
        between them."""
        at, rest, turn, parts, mask = cell, r, 0, 3, (1 << self.shape[m][0]) - 1
        for k in ti.static(range(1, self.dim)):
            side = rest % 3
            at[k] += side - 1
            rest = rest // 3
            if ti.static(k in self.axes):
                count = self.count[m][k]
                if side >= count:  # of two cells, or one, all are there
                    parts = 0
                if at[k] < 0 or at[k] >= count:
                    way = ti.select(at[k] < 0, -1, 1)
                    at[k] -= way * count
                    if ti.static(self.sheared and k == GRADIENT):
                        turn = way
        if ti.static(self.sheared):
            at[0] = self.images.cell(self.state.x[i], 0, turn, self.count[m][0])
        low, span = at[0] - 1, 1
        at[0] = 0
        if ti.static(0 in self.axes):
            count = self.count[m][0]
            low = ti.select(low < 0, low + count, low)
            if low + 2 < count and (low & mask) + 2 <= mask and parts > 0:
                span, parts = 3, 1
            parts = ti.min(parts, count)
            if ti.static(self.sheared):
                if self.count[m][GRADIENT] < 3 and parts > 0:  # the next row is met on both sides, at two places
                    span, parts = 1, ti.min(count, mask + 1)
        elif (low & mask) + 2 <= mask:
            span, parts = 3, parts // 3
        return self.bucket(at, m), low, parts, span

    @ti.func
    def along(self, cell, m):
        """Where in its row the bucket of a cell stands, which may be one beyond the end of the box."""
        if ti.static(0 in self.axes):
            cell = ti.select(cell < self.count[m][0], cell, cell - self.count[m][0])
        return cell & ((1 << self.shape[m][0]) - 1)


def levels_of(radius: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The level of each particle, of those that there are, (n,)."""
    size = radius + reach / 2
    if not len(size) or (size == size[0]).all():
        return np.zeros(len(size), dtype=int)
    with np.errstate(divide="ignore"):
        level = np.minimum(np.floor(np.log2(size.max() / size)), most_levels() - 1).astype(int)
    return distinct(level)[1]


def most_levels() -> int:
    """LEVELS; but one where Taichi writes SPIR-V: there (1.7.4, Vulkan in software) lists that are written to from both sides of
    their pairs lack entries."""
    return LEVELS if runtime.architecture() in runtime.LLVM else 1


@ti.func
def add_to(field: ti.template(), at, by, serial: ti.template()):  # type: ignore[valid-type]
    """Add to a counter; returns what it was. serial: one thread counts, without atomic operations, which take longer."""
    old = field[at]
    if ti.static(serial):
        field[at] = old + by
    else:
        old = ti.atomic_add(field[at], by)
    return old
