"""Passivity: the impulses of an island do no work.

Constraints that do not move do no work: sum p . J (v0 + v) / 2 <= 0. Passes that stop early, and starts from an impact that is
over, may break that. Then all impulses of the island are multiplied by the s <= 1 for which their work is 0: with
P = sum p . J v0 and Q = sum p . J (v - v0) >= 0 the work of s p is s P + s^2 Q / 2, which is 0 at s = -2 P / Q.

An island is a set of particles that rows which press join, through particles that move.
"""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .responses import FreeParticles
    from .rows import Rows

WORK, SQUARE, LOAD = range(3)  # sums over an island: P, Q, and the impulses along normals


class Islands:
    """The islands of one world. They are found only where some particle gains more energy than rounding explains.

    root: a particle of the island of each particle, the first one. sums: of the island of each root, times h^2. scale: s.
    """

    n: Any = OnDevice()

    def __init__(self, scene: "Scene", rows: "Rows", bodies: "FreeParticles"):
        self.rows, self.bodies, self.real = rows, bodies, scene.real
        self.n, add = scene.count, scene.memory.field
        self.root = add("Contact.island", scene.count, kind=ti.i32)
        self.sums = add("Contact.island_sums", scene.count, width=3, kind=ti.f64)
        self.scale = add("Contact.island_scale", scene.count)

    @ti.func
    def root_of(self, i):
        """Return the root of the island of particle i."""
        while self.root[i] != i:
            self.root[i] = self.root[self.root[i]]
            i = self.root[i]
        return i

    @ti.func
    def join(self, all_rows):
        """Find the islands, of all rows or of those that press. One thread calls it."""
        for i in range(self.n):
            self.root[i] = i
        for i in range(self.n):
            for row in range(self.rows.own[i], self.rows.pressed[i]):
                other = self.rows.other.field[row]
                if (all_rows or self.rows.is_set(self.rows.p.field[row])) and self.bodies.moves(other):
                    a, b = self.root_of(i), self.root_of(other)
                    self.root[ti.max(a, b)] = ti.min(a, b)

    @ti.func
    def find_times(self):
        """Find the first impact of each island, as a part of the substep, in `scale`; 0 without one. One thread calls it."""
        self.join(True)
        for i in range(self.n):
            self.scale[i] = 2
        for i in range(self.n):
            root = self.root_of(i)
            for row in range(self.rows.own[i], self.rows.end[i]):
                if self.rows.bounce.field[row] > 0:
                    self.scale[root] = ti.min(self.scale[root], self.rows.time.field[row])
        for i in range(self.n):
            if self.scale[i] > 1:
                self.scale[i] = 0

    @ti.func
    def find(self, allowed):
        """Find the islands and their scales. allowed: work per impulse that is rounding [m]. One thread calls it."""
        self.join(False)
        for i in range(self.n):
            self.sums[i] = [0, 0, 0]
        for i in range(self.n):
            root = self.root_of(i)
            self.sums[root] = self.sums[root] + self.sums_of(i)
        for i in range(self.n):
            work, square, load = self.sums[i][WORK], self.sums[i][SQUARE], self.sums[i][LOAD]
            scale = ti.cast(1, ti.f64)
            if work + square / 2 > allowed * load and square > 0:
                scale = ti.max(ti.min(-2 * work / square, 1), 0)
            self.scale[i] = scale

    @ti.func
    def sums_of(self, i):
        """Return the part of particle i in the sums of its island."""
        work, square = self.bodies.work(i)
        load = ti.cast(0, ti.f64)
        for row in range(self.rows.own[i], self.rows.end[i]):
            p, n = self.rows.p.field[row], self.rows.normal.field[row]
            load += self.rows.along(p, n)
            if ti.static(self.rows.bounces):  # displacements are those in the middle of the substep, and impacts are not there
                if self.rows.bounce.field[row] > 0:
                    work += (self.rows.when[i] - 0.5) * self.rows.along(p, n) * self.rows.relative_kick(i, row).dot(n)
        work -= self.rows.work_of_others(i)
        return ti.Vector([work, square, load])

    @ti.func
    def apply(self, i):
        """Multiply the impulses on particle i by the scale of its island."""
        scale = self.scale[self.root_of(i)]
        if scale < 1:
            for row in range(self.rows.begin[i], self.rows.end[i]):
                self.rows.p.field[row] = scale * self.rows.p.field[row]
                if ti.static(self.rows.turns):
                    self.rows.f.field[row] = scale * self.rows.f.field[row]
            self.bodies.scale(i, scale)
