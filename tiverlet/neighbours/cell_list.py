"""A spatial hash over an unbounded domain, for particles of any sizes.

The hash folds space onto a torus of cells: cell (a, b, ...) goes to bucket (a mod A, b mod B, ...), with A, B powers of two
of at least 4. The three cells around a particle along each axis thus fall into different buckets. So every bucket is read
once and every pair is found once, even where distant cells share a bucket: the distance test excludes particles of those cells.
Cells of a row are adjacent in memory. Particles are sorted by counting, so no cell has a capacity. On a GPU the counters are
atomic, and the order within a cell differs from run to run: no result may depend on it.

Particles whose sizes differ by more than a factor of two are stored in separate tables (levels), with cells of their size. Level
0 holds the largest particles; each further level holds sizes down to half of those before. The size of a particle is its radius
plus half of its reach, the extra distance at which it must be found. The search goes through a particle's own level and the
coarser levels, where its neighbours are in the 3^dim cells around it. Smaller neighbours find the particle by their own search.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import runtime, ti
from ..device.number import OnDevice
from ..device.prefix_sum import Sums
from .images import GRADIENT

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene

FARTHEST = 1 << 22  # cells from the origin: beyond it, f32 cannot distinguish adjacent cells
LEVELS = 14  # at most; the last level holds all smaller particles, down to points


class CellList:
    """The tables of cells, one for each level of particle sizes.

    radius: (n,) [m]. reach: (n,) [m]. skin [m]. A search finds pairs up to a distance of the sum of their radii, plus the larger
    of their reaches, plus the skin.
    """

    host_only = ("_axis_bits", "_lengths")

    n: Any = OnDevice()  # number of particles
    buckets: Any = OnDevice()  # number of buckets in all tables
    level_0_scale: Any = OnDevice()  # cells per meter at level 0

    def __init__(self, scene: "Scene", radius: np.ndarray, reach: np.ndarray, skin: float, team: "Team", scratch: Any):
        self.team = team
        # Positions in sorted order, while a list is built: the search then reads memory sequentially.
        self.sorted_position = scratch
        self.memory = scene.memory
        dim, add = scene.particles.dim, scene.memory.field
        self.n, self.dim, self.state, self.real = scene.count, dim, scene.state, scene.real
        self.serial = not team.launched  # on a CPU, counting on one thread is faster than atomic counters on several
        level = levels_of(radius, reach)
        self.levels = int(level.max(initial=0)) + 1
        self.sizes, self.bits, offsets = self._size_tables(radius, reach, skin, level)
        self.level_0_scale = scene.memory.number(float(1 / self.sizes[0]), scene.real)
        self.buckets = scene.memory.number(int(offsets[-1]))
        self.images, self._lengths = scene.state.images, np.full(dim, np.inf)
        self.axes, self.sheared = (self.images.axes, self.images.sheared) if self.images else ((), False)
        if self.images:
            self._lengths = scene.periodic.lengths
        self._axis_bits = self.choose_axis_bits(np.array(scene.particles.extent))
        self.sums = Sums(self.buckets + 2, team)
        self.edge = add("grid.edge", self.sums.room, kind=ti.i32)
        self.sorted = add("grid.sorted", scene.particles.count, kind=ti.i32)
        if self.state.compensated:
            self.sorted_low = add("grid.place_low", scene.count, width=dim)
        self.axis_bits = add("grid.shape", self.levels, width=dim, kind=ti.i32, values=self._axis_bits)
        if self.images:
            self.cells_per_axis = add("grid.cells", self.levels, width=dim, kind=ti.i32, values=self.count_cells(self._axis_bits))
        if self.levels > 1:
            self.level = add("grid.level", scene.count, kind=ti.i32, values=level)
            self.level_scale = add("grid.cells_per_meter", self.levels, values=1 / self.sizes)
            self.offset = add("grid.offset", self.levels, kind=ti.i32, values=offsets[:-1])

    def _size_tables(self, radius, reach, skin: float, level) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cell sizes [m] and log2 of bucket numbers, (levels,), and the first bucket of each table, (levels + 1,)."""
        finer, longest = (np.array([v[level >= m].max(initial=0.0) for m in range(self.levels)]) for v in (radius, reach))
        own = finer if self.levels == 1 else np.array([radius[level == m].max(initial=0.0) for m in range(self.levels)])
        # Slightly larger, so that rounding in floor(x * scale) does not lose a neighbour.
        sizes = (own + finer + longest + skin) * (1 + 2.0**-12)
        counts = np.bincount(level, minlength=self.levels)
        bits = np.maximum(2 * self.dim, np.ceil(np.log2(np.maximum(2 * counts, 1)))).astype(int)
        return sizes, bits, np.concatenate([[0], np.cumsum(1 << bits)])

    def can_regroup(self, radius: np.ndarray, reach: np.ndarray) -> bool:
        """Whether particles of these sizes need as many tables as there are, and fit into the memory."""
        level = levels_of(radius, reach)
        return int(level.max(initial=0)) + 1 == self.levels and self.memory.has_room(4 * (len(radius) + 4**self.dim) + 2)

    def remove_particles(self, number: np.ndarray) -> None:
        """Delete removed particles from the sorted cells and renumber the others. number: (n,) new indices, or -1 if removed."""
        order, edge = self.memory.view(self.sorted), self.memory.view(self.edge)
        new = number[order[: len(number)]]
        gone = np.flatnonzero(new < 0)
        order[: len(new) - len(gone)] = new[new >= 0]
        edge -= np.searchsorted(gone, edge).astype(edge.dtype)

    def regroup(self, radius: np.ndarray, reach: np.ndarray, skin: float, extent: np.ndarray) -> bool:
        """Adapt the tables to particles in a box of size `extent`, (dim,) [m]. Returns whether the cells are the same."""
        level, memory = levels_of(radius, reach), self.memory
        memory.resize(self.sorted, len(radius))
        sizes, bits, offsets = self._size_tables(radius, reach, skin, level)
        if self.levels > 1:
            memory.write(self.level, level)
        if np.array_equal(sizes, self.sizes) and np.array_equal(bits, self.bits):
            return True
        self.sizes, self.bits, self.level_0_scale, self.buckets = sizes, bits, float(1 / sizes[0]), int(offsets[-1])
        self.sums.room = self.buckets + 2
        memory.resize(self.edge, self.sums.room)
        if self.levels > 1:
            memory.write(self.level_scale, 1 / sizes)
            memory.write(self.offset, offsets[:-1])
        self._axis_bits = np.zeros((0, self.dim))
        self.fit(extent)
        return False

    def choose_axis_bits(self, extent: np.ndarray) -> np.ndarray:
        """Return log2 of the buckets of each table along each axis, (levels, dim): 2 at least, more where cells are many."""
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
        """Shape the tables for particles in a box of size `extent`, (dim,) [m], for speed only. Returns whether any changed."""
        axis_bits = self.choose_axis_bits(extent)
        changed = not np.array_equal(axis_bits, self._axis_bits)
        if changed:
            self._axis_bits = axis_bits
            self.memory.write(self.axis_bits, axis_bits)
            if self.images:
                self.memory.write(self.cells_per_axis, self.count_cells(axis_bits))
        return changed

    def count_cells(self, axis_bits: np.ndarray) -> np.ndarray:
        """Return the number of cells of each table along periodic axes, (levels, dim); 1 along other axes.

        Cells are not smaller than the search needs. A number above that of the buckets is a multiple of it, so that the three
        cells around the end of the box fall into different buckets.
        """
        most = np.where(np.isfinite(self._lengths), self._lengths, 0.0) / self.sizes[:, None]
        fitting, buckets = np.minimum(most, 2.0**30), 2.0**axis_bits
        each = np.where(fitting < buckets, 1.0, buckets)
        return np.maximum(1, np.floor(fitting / each) * each).astype(int)

    @ti.func
    def level_of(self, i):
        """Return the level of particle i."""
        m = 0
        if ti.static(self.levels > 1):
            m = self.level[i]
        return m

    @ti.func
    def cell_of(self, i, m):
        """Return the cell of particle i at level m."""
        x = self.state.exact(i)
        cell = ti.floor(x * self.scale(m), ti.i32)
        for k in ti.static(self.axes):
            cell[k] = self.images.cell(x, k, 0, self.cells_per_axis[m][k])
        return cell

    @ti.func
    def scale(self, m):
        """Return the cells per meter at level m."""
        scale = ti.cast(self.level_0_scale, self.real)
        if ti.static(self.levels > 1):
            scale = self.level_scale[m]
        return scale

    @ti.func
    def bucket(self, cell, m):
        """Return the bucket of a cell at level m. Axis 0 varies fastest."""
        bits = self.axis_bits[m]
        b = cell[self.dim - 1] & ((1 << bits[self.dim - 1]) - 1)
        for k in ti.static(range(self.dim - 2, -1, -1)):
            b = (b << bits[k]) | (cell[k] & ((1 << bits[k]) - 1))
        if ti.static(self.levels > 1):
            b += self.offset[m]
        return b

    @ti.func
    def bucket_of(self, i):
        """Return the bucket of particle i, at its own level."""
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
            # Filling a bucket from its end moves its counter from the end to the begin; the next bucket's begin is its end. The
            # loop starts at the last particle, so that on one thread each bucket is in order and little is left to sort.
            i = self.n - 1 - back
            k = add_to(self.edge, self.bucket_of(i) + 1, -1, self.serial) - 1
            self.sorted[k] = i
            self.sorted_position[k] = self.state.x[i]
            if ti.static(self.state.compensated):
                self.sorted_low[k] = self.state.low[i]
        self.team.wait()

    @ti.func
    def separation(self, i, k):
        """Return the vector from the k-th sorted particle to particle i [m], like State.separation() for two indices."""
        r = self.state.x[i] - self.sorted_position[k]
        if ti.static(self.state.compensated and len(self.axes) > 0):
            far = ti.cast(self.state.x[i], ti.f64) - ti.cast(self.sorted_position[k], ti.f64)
            r = ti.cast(self.state.nearest(far + (self.state.low[i] - self.sorted_low[k])), self.real)
        elif ti.static(self.state.compensated):
            r += self.state.low[i] - self.sorted_low[k]
        elif ti.static(len(self.axes) > 0):
            r = self.state.nearest(r)
        return r

    @ti.func
    def row_of_cells(self, i, cell, m, r):
        """Return row r of the 3^(dim - 1) rows of three cells around a cell at level m, for particle i.

        Returned are the first bucket of the whole row of the table, the coordinate along axis 0 of the first of the three cells,
        the number of pieces into which the three fall, and the cells in each piece: 3, or 1 where the torus wraps between cells.
        """
        at, rest, turn, parts, mask = cell, r, 0, 3, (1 << self.axis_bits[m][0]) - 1
        for k in ti.static(range(1, self.dim)):
            side = rest % 3
            at[k] += side - 1
            rest = rest // 3
            if ti.static(k in self.axes):
                count = self.cells_per_axis[m][k]
                if side >= count:  # an axis with one or two cells: all have been read
                    parts = 0
                if at[k] < 0 or at[k] >= count:
                    way = ti.select(at[k] < 0, -1, 1)
                    at[k] -= way * count
                    if ti.static(self.sheared and k == GRADIENT):
                        turn = way
        if ti.static(self.sheared):
            at[0] = self.images.cell(self.state.exact(i), 0, turn, self.cells_per_axis[m][0])
        low, span = at[0] - 1, 1
        at[0] = 0
        if ti.static(0 in self.axes):
            count = self.cells_per_axis[m][0]
            low = ti.select(low < 0, low + count, low)
            if low + 2 < count and (low & mask) + 2 <= mask and parts > 0:
                span, parts = 3, 1
            parts = ti.min(parts, count)
            if ti.static(self.sheared):
                # With few cells, the next row is a neighbour on both sides, at two offsets.
                if self.cells_per_axis[m][GRADIENT] < 3 and parts > 0:
                    span, parts = 1, ti.min(count, mask + 1)
        elif (low & mask) + 2 <= mask:
            span, parts = 3, parts // 3
        return self.bucket(at, m), low, parts, span

    @ti.func
    def position_in_row(self, cell, m):
        """Return the position of a cell's bucket in its row. The cell may lie beyond the end of the box, where it wraps."""
        if ti.static(0 in self.axes):
            cell = ti.select(cell < self.cells_per_axis[m][0], cell, cell - self.cells_per_axis[m][0])
        return cell & ((1 << self.axis_bits[m][0]) - 1)


def levels_of(radius: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return the level of each particle, (n,), numbered without gaps."""
    size = radius + reach / 2
    if not len(size) or (size == size[0]).all():
        return np.zeros(len(size), dtype=int)
    with np.errstate(divide="ignore"):
        level = np.minimum(np.floor(np.log2(size.max() / size)), most_levels() - 1).astype(int)
    return (np.cumsum(np.bincount(level) > 0) - 1)[level]


def most_levels() -> int:
    """Return LEVELS, or 1 on SPIR-V, where lists to which both particles of a pair write lack entries (1.7.4, Vulkan)."""
    return LEVELS if runtime.architecture() in runtime.LLVM else 1


@ti.func
def add_to(field: ti.template(), at, by, serial: ti.template()):  # type: ignore[valid-type]
    """Add to a counter and return its old value. serial: one thread counts, so no atomic operations are needed."""
    old = field[at]
    if ti.static(serial):
        field[at] = old + by
    else:
        old = ti.atomic_add(field[at], by)
    return old
