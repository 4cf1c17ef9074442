"""Passivity: the impulses of an island do no work.

Constraints that do not move do no work: sum p . J (v0 + v) / 2 <= 0. Passes that stop early, and starts from an impact that is
over, may break that. Then all impulses of the island are multiplied by the s <= 1 for which their work is 0: with
P = sum p . J v0 and Q = sum p . J (v - v0) >= 0 the work of s p is s P + s^2 Q / 2, which is 0 at s = -2 P / Q.

An island is a set of particles that rows which press join, through particles that move. All threads find islands together: each
particle points at one of its island with a lower number, and joining two islands lets the higher root point at the lower one
(Anderson and Woll 1991), so that the root is the first particle in the end, whatever the order. Sums over an island are sums of
integers, whose unit is a part of the largest term: they have the same bits in any order.
"""

from typing import TYPE_CHECKING, Any

from ..device import runtime, ti
from ..device.number import OnDevice
from .limits import BLOCK

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .responses import Responses
    from .rows import Rows

WORK, SQUARE, LOAD = range(3)  # sums over an island: P, Q, and the impulses along normals
ALL, PRESSING, BOUNCING = range(3)  # which rows join particles
BITS = 40  # of the largest term of a sum, in units: sums of 2^22 terms fit into 63 bits
BIAS, MANTISSA, LEAST = 1023, 52, 64  # exponents of f64: of 1, its first bit, and the lowest whose unit is a normal number


class Islands:
    """The islands of one world. They are found only where some particle gains more energy than rounding explains.

    root: a particle of the island of each particle, at last the first one. sums: of the island of each root, times h^2, in
    units; largest: exponents of their largest terms. scale: s, or the time of the first impact, of each root.
    """

    n: Any = OnDevice()

    def __init__(self, scene: "Scene", rows: "Rows", bodies: "Responses", team: "Team"):
        self.rows, self.bodies, self.state, self.real = rows, bodies, scene.state, scene.real
        self.n, add = scene.count, scene.memory.field
        # One thread needs no atomic operations, which SPIR-V does not have for 64 bits and f32.
        self.serial = runtime.architecture() not in runtime.LLVM or (team.size == 1 and not team.launched)
        self.root = add("Contact.island", scene.count, kind=ti.i32)
        self.sums = add("Contact.island_sums", scene.count, width=3, kind=ti.i64)
        self.largest = rows.spread  # which is free from Rows.find_eigenvalue() on: 12 bytes a particle less
        self.scale = add("Contact.island_scale", scene.count)

    @ti.func
    def begin(self, i):
        """Let particle i be an island."""
        self.root[i], self.scale[i] = i, 2
        for k in ti.static(range(3)):
            self.sums[i][k], self.largest[i][k] = 0, LEAST

    @ti.func
    def keep_least(self, values: ti.template(), k, value):  # type: ignore[valid-type]
        """Lower values[k] to a value, unless it is lower. Returns what it was."""
        before = values[k]
        if ti.static(self.serial):
            values[k] = ti.min(before, value)
        else:
            before = ti.atomic_min(values[k], value)
        return before

    @ti.func
    def root_of(self, i):
        """Return the root of the island of particle i."""
        parent = self.root[i]
        while parent != i:
            above = self.root[parent]
            if above != parent:
                self.keep_least(self.root, i, above)
            i = parent
            parent = above
        return i

    @ti.func
    def join(self, i, which: ti.template()):  # type: ignore[valid-type]
        """Join the islands of particle i, its body, and those behind it on its rows: on all, those that press, or that bounce."""
        if ti.static(bool(self.bodies.answers)):
            self.join_two(i, self.bodies.answers.body(i))
        for row in range(self.rows.own[i], self.rows.pressed[i]):
            other, joins = self.rows.other.field[row], True
            if ti.static(which == PRESSING):
                joins = self.rows.is_set(self.rows.p.field[row]) or self.rows.hit(row) > 0
            elif ti.static(which == BOUNCING):
                joins = self.rows.impacts.blow.field[row] > 0
            if ti.static(bool(self.rows.edges)):
                if joins:
                    self.join_edge(i, other, self.rows.edges.end.field[row])
            elif joins and self.state.moves(other):
                self.join_two(i, other)

    @ti.func
    def join_edge(self, v, a, b):
        """Join the islands of vertex v, whose row it is whether it moves or not, and of the ends that can move."""
        if self.state.moves(a):
            self.join_two(v, a)
        if self.state.moves(b):
            self.join_two(v, b)

    @ti.func
    def join_two(self, i, j):
        """Join the islands of particles i and j."""
        a, b = self.root_of(i), self.root_of(j)
        while a != b:
            high, low = ti.max(a, b), ti.min(a, b)
            before = self.keep_least(self.root, high, low)
            a = low
            b = low
            if before != high:  # another thread was faster: join what it pointed at
                b = self.root_of(before)

    @ti.func
    def find_time(self, i):
        """Find the first impact of the island of particle i, as a part of the substep, in `scale`; 2 without one."""
        root = self.root_of(i)
        for row in range(self.rows.own[i], self.rows.end[i]):
            if self.rows.bounce.field[row] > 0:
                self.keep_least(self.scale, root, self.rows.time.field[row])

    @ti.func
    def time_of(self, i):
        """Return the first impact of the island of particle i, as a part of the substep; 0 without one."""
        time = self.scale[self.root_of(i)]
        return ti.select(time > 1, 0 * time, time)

    @ti.func
    def find_largest(self, block, which: ti.template()):  # type: ignore[valid-type]
        """Find the largest terms of sums. Particles of a block that follow each other are mostly of one island."""
        root, most = -1, ti.Vector.zero(ti.i32, 3)
        for i in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.n)):
            own = self.root_of(i)
            if own != root:
                self.note_largest(root, most)
                root = own
                most = ti.Vector.zero(ti.i32, 3)
            terms = self.terms(i, which)
            for k in ti.static(range(3)):
                bits = ti.bit_cast(ti.abs(terms[k]), ti.i64)
                most[k] = ti.max(most[k], ti.cast(bits >> MANTISSA, ti.i32))
        self.note_largest(root, most)

    @ti.func
    def note_largest(self, root, most):
        """Raise the exponents of the largest terms of an island to these."""
        if root >= 0:
            for k in ti.static(range(3)):
                if most[k] > self.largest[root][k]:
                    if ti.static(self.serial):
                        self.largest[root][k] = most[k]
                    else:
                        ti.atomic_max(self.largest[root][k], most[k])

    @ti.func
    def power(self, exponent):
        """Return 2^exponent in f64."""
        return ti.bit_cast(ti.cast(exponent + BIAS, ti.i64) << MANTISSA, ti.f64)

    @ti.func
    def add_up(self, block, which: ti.template()):  # type: ignore[valid-type]
        """Add the terms of the particles of a block to the sums of their islands."""
        root, sums = -1, ti.Vector.zero(ti.i64, 3)
        for i in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.n)):
            own = self.root_of(i)
            if own != root:
                self.add(root, sums)
                root = own
                sums = ti.Vector.zero(ti.i64, 3)
            terms = self.terms(i, which)
            for k in ti.static(range(3)):
                sums[k] += ti.cast(terms[k] * self.power(BITS + BIAS - 1 - self.largest[root][k]), ti.i64)
        self.add(root, sums)

    @ti.func
    def add(self, root, sums):
        """Add numbers to the sums of an island."""
        if root >= 0:
            for k in ti.static(range(3)):
                if ti.static(self.serial):
                    self.sums[root][k] = self.sums[root][k] + sums[k]
                else:
                    ti.atomic_add(self.sums[root][k], sums[k])

    @ti.func
    def total(self, root, k: ti.template()):  # type: ignore[valid-type]
        """Return a sum over an island."""
        return ti.cast(self.sums[root][k], ti.f64) * self.power(self.largest[root][k] - (BITS + BIAS - 1))

    @ti.func
    def find_scale(self, root, allowed, which: ti.template()):  # type: ignore[valid-type]
        """Find the scale of an island. allowed: work per impulse that is rounding [m]."""
        work, square, load = self.total(root, WORK), self.total(root, SQUARE), self.total(root, LOAD)
        scale = ti.cast(1, ti.f64)
        if ti.static(which == BOUNCING):
            scale = self.rows.impacts.scale_of(work, square, load)
        elif work + square / 2 > allowed * load + ti.static(2.0 ** (4 - BITS)) * square and square > 0:  # sums have BITS
            scale = ti.max(ti.min(-2 * work / square, 1), 0)
        self.scale[root] = ti.cast(scale, self.real)

    @ti.func
    def terms(self, i, which: ti.template()):  # type: ignore[valid-type]
        """Return the part of particle i in the sums of its island: the work of impulses, its square, and those along normals."""
        if ti.static(which == BOUNCING):
            return self.rows.impacts.terms(i, self.bodies)
        work, square = self.bodies.work(i)
        load = ti.cast(0, ti.f64)
        for row in range(self.rows.own[i], self.rows.end[i]):
            p, n = self.rows.p.field[row], self.rows.normal.field[row]
            load += ti.abs(self.rows.along(p, n))
            if ti.static(self.rows.bounces):  # displacements are those in the middle of the substep, and impacts are not there
                if self.rows.bounce.field[row] > 0:
                    f = self.rows.relative_kick(i, row).dot(n)
                    work += (self.rows.when[i] - 0.5) * self.rows.along(p, n) * f
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
