"""Contact events: contacts that began, lasted or ended in a frame, and overlaps of sensors.

Contacts come and go within a frame, so each is recorded where it is solved, in the pass and on the device. A pair that touches
has a row in a table. The row number is in the pair data `touched`, which keeps the pair on the neighbour list until the frame
ends, wherever its particles go. The table has as much room as the list, and a pair has one row, so no event can be lost. Between
frames `touched` is 1 for pairs that touched in the last substep; clones, recordings and edits keep only that.

Rows come in any order, and the host sorts them. One particle of the pair writes its row, in a fixed order, so the bits are the
same on any number of threads.
"""

from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..features.feature import Scene
from ..features.material import SENSES, TOUCH, Table
from ..neighbours.pair_data import Column, PairData
from .touches import BEFORE, NEVER, ContactEvents, Touches, span

if TYPE_CHECKING:
    from ..neighbours.neighbour_list import NeighbourList
    from .narrow_phase import DiscGeometry


class EventLog:
    """The table of contact events of one world, on the device.

    touched: pair data, on the side that writes the row. During a frame it is the row number plus 1, or 0 without a row. Between
    frames it is 1 for pairs that touched in the last substep.

    Columns: pair, the particle that writes and the other particle; when, the substeps in which the pair began to touch and
    touched last; impulse [kg m]; speed [m], the approach in a substep; normal, from the other particle; point [m].
    """

    list: "NeighbourList"
    geometry: "DiscGeometry"

    def __init__(self, scene: Scene, table: Table):
        dim, add = scene.particles.dim, scene.memory.field
        self.state, self.radius, self.table, self.senses = scene.state, scene.radius, table, table.senses
        self.can_sleep = bool(scene.state.sleepers)
        self.touched = PairData("touched", 0, persistent=True, kind=ti.i32, for_reports=True)
        self.pair, self.when = Column("events.pair", 2, ti.i32), Column("events.when", 2, ti.i32)
        self.impulse, self.speed = Column("events.impulse"), Column("events.speed")
        self.normal, self.point = Column("events.normal", dim), Column("events.point", dim)
        self.counter = add("events.rows", None, kind=ti.i32)  # the number of rows
        self.substep = add("events.substep", None, kind=ti.i32)  # the number of the substep in the frame, from 1 on
        if self.senses:
            _, rows = table.rows(scene.particles.group)
            ranks = round(len(rows) ** 0.5)
            some = (rows[:, 3].reshape(ranks, ranks) == SENSES).any(axis=1)
            self.is_sensor = add("events.is_sensor", ranks, kind=ti.i32, values=some)

    def bind(self, pairs: "NeighbourList", geometry: "DiscGeometry") -> None:
        """Store the list and the geometry, and have the columns declared with the list."""
        self.list, self.geometry = pairs, geometry
        self.columns = [self.pair, self.when, self.impulse, self.speed, self.normal, self.point]
        pairs.columns = [*pairs.columns, *self.columns]

    @ti.func
    def start(self, s, first):
        """Store the number of substep s as a pass begins, and empty the table as a frame begins. One thread calls it."""
        self.substep[None] = s + 1
        if s == 0 and first != 0:
            self.counter[None] = 0

    @ti.func
    def open(self, begin, end):
        """Open a row for each pair of particles begin ... end - 1 that touched when the last frame ended, as a frame begins."""
        number = 0
        for i in range(begin, end):
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                number += ti.cast(self.touched.field[e] != 0, ti.i32)
        if number > 0:
            row = ti.atomic_add(self.counter[None], number)
            for i in range(begin, end):
                for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                    if self.touched.field[e] != 0:
                        self.enter(row, i, e, BEFORE, BEFORE)
                        row += 1

    @ti.func
    def enter(self, row, i, e, began, last):
        """Begin a row for entry e of particle i. began, last: the substeps in which the pair began to touch, and touched last."""
        self.touched.field[e] = row + 1
        self.pair.field[row] = [i, self.list.neighbour[e]]
        self.when.field[row] = [began, last]
        self.impulse.field[row] = 0
        self.speed.field[row] = 0

    @ti.func
    def record(self, i, j, e, n, impulse, final):
        """Record that entry e of particle i, with j, touches in this pass.

        Both particles of a pair call it, unless one cannot move. Only one of them writes.
        """
        if i < j or self.state.w[j] == 0:
            self.write(i, j, e, n, impulse, final)

    @ti.func
    def write(self, i, j, e, n, impulse, final):
        """Write a touch to the row of entry e: its impulse [kg m] and, if the pair meets now, its speed, normal and point."""
        row, now = self.touched.field[e] - 1, self.substep[None]
        if row < 0:
            row = ti.atomic_add(self.counter[None], 1)
            self.enter(row, i, e, now, NEVER)
            self.place(row, i, j, n)
        began, last = self.when.field[row][0], self.when.field[row][1]
        if last < now - 1:
            approach = -self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(n)
            self.speed.field[row] = ti.max(self.speed.field[row], approach)
        if final != 0 and began == BEFORE:
            self.place(row, i, j, n)
        self.when.field[row][1] = now
        self.impulse.field[row] = self.impulse.field[row] + impulse

    @ti.func
    def place(self, row, i, j, n):
        """Write the normal and the point where the pair touches: in the middle between the two surfaces along n."""
        self.normal.field[row] = n
        way = (self.radius.of(j) - self.radius.of(i)) * n - self.state.separation(i, j)
        self.point.field[row] = self.state.place(i) + way / 2

    @ti.func
    def note_speed(self, e, speed):
        """Note the speed of an impact [m per substep] in the row of entry e, if this side has the row."""
        row = self.touched.field[e] - 1
        if row >= 0:
            self.speed.field[row] = ti.max(self.speed.field[row], speed)

    @ti.func
    def sense(self, i, final):
        """Record the particles that sensor i overlaps at the end of a substep."""
        rank = self.table.rank[i]
        if self.is_sensor[rank] != 0:
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                j = self.list.neighbour[e]
                if ti.cast(self.table.of(i, j)[TOUCH], ti.i32) == SENSES and (rank != self.table.rank[j] or i < j):
                    overlap, n = self.geometry.overlap(i, j, self.radius.of(i) + self.radius.of(j))
                    if overlap > 0:
                        self.write(i, j, e, n, 0 * overlap, final)

    @ti.func
    def sleeps(self, i, j):
        """Whether particle i, which writes the row, sleeps and j does not move, so that the pair still touches.

        Pairs of sensors do not count: their overlaps are found in every substep.
        """
        out = False
        if ti.static(self.can_sleep):
            out = not self.state.awake(i) and not self.state.moves(j) and self.geometry.pushes(i, j) != 0
        return out

    @ti.func
    def wake(self, i, substep):
        """Extend the touches of particle i, which wakes after `substep` substeps of the frame, up to that substep."""
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            row = self.touched.field[e] - 1
            if row >= 0:
                if self.when.field[row][0] == BEFORE and self.geometry.pushes(i, self.list.neighbour[e]) != 0:
                    self.when.field[row][1] = substep

    @ti.func
    def close(self, i):
        """Set `touched` to 1 or 0 for the pairs of particle i, as a frame ends."""
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            row = self.touched.field[e] - 1
            if row >= 0:
                began, last, j = self.when.field[row][0], self.when.field[row][1], self.list.neighbour[e]
                if began == BEFORE and last != self.substep[None]:
                    if self.sleeps(i, j):
                        last = self.substep[None]
                        self.when.field[row][1] = last
                    r = self.state.separation(i, j)
                    length = r.norm()
                    if length > 0:
                        self.place(row, i, j, r / length)
                    else:
                        self.place(row, i, j, self.geometry.fallback_normal(i, j, r))
                self.touched.field[e] = ti.cast(last == self.substep[None], ti.i32)

    def forget(self) -> None:
        """Empty the table, because the state is not the end of a frame that was just computed."""
        self.list.memory.write(self.counter, 0)

    def read(self, groups: np.ndarray, h: float, time: float) -> ContactEvents:
        """Return the events of the last frame, which had substeps h [s] and ended at `time` [s].

        groups: (n,), of all particles.
        """
        memory, store = self.list.memory, self.list.store
        assert store
        count, substeps = int(memory.read(self.counter)[0]), int(memory.read(self.substep)[0])
        pair, when, *values = (store.read(column.field)[:count] for column in self.columns)
        impulse, speed, normal, point = (value.astype(np.float64) for value in values)
        pairs = np.sort(pair, axis=1).astype(np.int64)
        normal[pair[:, 0] > pair[:, 1]] *= -1
        order = np.lexsort(pairs.T[::-1])
        pairs, when, impulse, speed = pairs[order], when[order], impulse[order], speed[order]
        # A pair has two rows if one of its particles was held before the frame (then the other one wrote) and moves now.
        one = np.flatnonzero((np.diff(pairs, axis=0, prepend=-1) != 0).any(axis=1))
        if len(one) < len(pairs):
            when = np.stack([np.minimum.reduceat(when[:, 0], one), np.maximum.reduceat(when[:, 1], one)], axis=1)
            impulse, speed = np.add.reduceat(impulse, one), np.maximum.reduceat(speed, one)
        times, order = span(when, substeps, h, time), order[one]
        return ContactEvents(Touches(pairs[one], groups[pairs[one]], point[order], normal[order], impulse / h, speed / h, *times))
