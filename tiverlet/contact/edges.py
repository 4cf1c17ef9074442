"""The geometry of bodies made of loops of particles: rows of a vertex and an edge (2D).

C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) for a vertex v and the edge from a to b of another body that
is counterclockwise. n is the outward normal, t the place of v along the edge. Gradients: n, -(1 - t) n, -t n. Corners that face
each other touch as discs, by their radii.

A row belongs to its vertex, and stands at the entry of the vertex for a. It is found by where particles are at the start of the
substep, and where they would be at its end:

- A vertex in front of an edge may come in over it, between its ends.
- A vertex inside of a body leaves over the nearest edge that faces its own body, if it is not deeper than half of that edge.

Edges gather the impulses of their rows: at the entries of a and b for v, `marks` has the number of the row.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..device import at, called, inline, ti
from ..device.number import Number, OnDevice
from ..features.material import DYNAMIC, RESTITUTION, STATIC, Table
from ..neighbours.pair_data import Column, PairData
from ..neighbours.queries import Contacts
from .limits import AHEAD, BEYOND, SLOP, SLOW

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .narrow_phase import DiscGeometry
    from .rows import Rows

SLACK = 1 / 512  # of twice the size of what touches: what is behind an edge by less counts as in front of it; see is_beside()

# Lengths relative to an edge.
STRETCH = 1.25  # longest edge, relative to its first length, for which all contacts in its middle are listed
PAST = 1 / 4  # how far beyond the end of an edge a contact may be
REACH = 1.35  # from one end of an edge to the farthest contact: |(1 + PAST, 1 / 2)|

CLOSE = 1e-4  # edges whose relative distances differ by less are equally near: the first one counts
TILT = 1 / 16  # sine of the angle by which edges that lie on each other may lean, as bodies deform
TINY = 1e-30
DISCS = -1  # the place on an edge where there is no edge: two discs touch
OVER_EDGE = 1  # what tips_cross() returns if the way out is over the edge of the second corner
BEGIN, END = range(2)  # of an edge


class Outline(NamedTuple):
    """Bodies as arrays. Particles in no body have -1.

    ends: (n, 2), the next and the previous particle around the body. body: (n,), the number of the body. length: (n,) [m], of the
    longer of the two edges of each particle. thinnest: (n,) [m], see loops.thinnest().
    """

    ends: np.ndarray
    body: np.ndarray
    length: np.ndarray
    thinnest: np.ndarray

    @property
    def longest(self) -> np.ndarray:
        """The edge length up to which the neighbour list is complete, (n,) [m]."""
        return STRETCH * self.length

    @property
    def reach(self) -> np.ndarray:
        """How far from each particle a contact of its edges may be, (n,) [m]."""
        return REACH * self.longest

    def size(self, radius: np.ndarray) -> np.ndarray:
        """The size of particles with these radii (n,) [m], of which slop is a part: half of `thinnest`, or the radius."""
        return np.where(self.body >= 0, self.thinnest / 2, radius)


class Edges:
    """The edges of one world.

    size: of each particle, see Outline.size() [m]. Columns by row: `end`, the particle b, or a for two discs; `place`, t, or
    DISCS; `edge`, x_b - x_a, and `arm`, x_v - (1 - t) x_a - t x_b at the start [m]; `gone`, what the row gives its edge [kg m].
    """

    stride: Any = OnDevice()  # how far a vertex may move in a substep without missing an edge [m]

    def __init__(self, scene: "Scene", outline: Outline):
        n, add = scene.count, scene.memory.field
        self.scene, self.state, self.radius, self.w, self.real = scene, scene.state, scene.radius, scene.state.w, scene.real
        self.outline = outline
        self.loop = add("Polygons.loop", n, width=3, kind=ti.i32, values=np.c_[outline.ends, outline.body])
        self.longest = add("Polygons.longest_edge", n, values=outline.longest)
        self.size = add("Polygons.size", n, values=outline.size(scene.particles.radius))
        self.stride = scene.memory.number(self._stride(outline), scene.real)
        self.tie = 2.0**-16 if scene.real == ti.f32 else 2.0**-44  # what is so near to the end of an edge is at it, by rounding
        # Of the contact of a vertex at an entry, for reports: overlap, place on the edge and normal.
        self.manifold = PairData("met", 4, False, is_transferred=False)
        # One more than the row of the contact of which the particle is the begin, and the end, of the edge; 0 without one.
        self.marks = PairData("edge_rows", 2, False, is_transferred=False, kind=ti.i32)
        self.pair_data = [self.manifold, self.marks]
        self.end, self.place = Column("row_end", kind=ti.i32), Column("row_place")
        self.edge, self.arm, self.gone = (Column(f"row_{name}", 2) for name in ("edge", "arm", "gone"))
        self.marked, self.number = Column("marked", kind=ti.i32), add("Polygons.marked", n, kind=ti.i32)  # entries with marks
        self.columns = [self.end, self.place, self.edge, self.arm, self.gone, self.marked]
        self.rows: Any = None
        self.list: Any = None
        self.discs: Any = None
        self.impulse: Any = None  # of listed pairs in the last substep [kg m]
        self.given: Any = None  # along the normal, with impacts, where pairs bounce

    @staticmethod
    def _stride(outline: Outline) -> float:
        """Return a quarter of the shortest edge [m]."""
        return float(outline.length[outline.body >= 0].min(initial=np.inf)) / 4

    def set_outline(self, outline: Outline, radius: np.ndarray) -> None:
        """Write other bodies, of the present particles, to the device."""
        self.outline, self.stride, memory = outline, self._stride(outline), self.scene.memory
        memory.write(self.loop, np.c_[outline.ends, outline.body])
        memory.write(self.longest, outline.longest)
        memory.write(self.size, outline.size(radius))

    def bind(self, rows: "Rows", listed: Any, discs: "DiscGeometry") -> None:
        """Store the rows, the neighbour list, and the geometry of discs."""
        self.rows, self.list, self.discs = rows, listed, discs
        self.impulse, self.given = rows.memory, rows.given if rows.bounces else None

    # Where particles are

    @ti.func
    def after(self, i):
        """Return the next particle around the body of particle i; -1 if it is in no body."""
        return self.loop[i][0]

    @ti.func
    def before(self, i):
        """Return the previous particle around the body of particle i; -1 if it is in no body."""
        return self.loop[i][1]

    @ti.func
    def from_to(self, j, i, start):
        """Return x_i - x_j; start: 1 at the start of the substep, 0 at present."""
        r = self.state.separation(i, j)
        if start != 0:
            r -= self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        return r

    @ti.func
    def contact_radius(self, v, a, b, t):
        """Return the distance at which vertex v touches the edge from a to b at t [m]."""
        return self.radius.of(v) + (1 - t) * self.radius.of(a) + t * self.radius.of(b)

    @ti.func
    def smaller(self, v, a):
        """Return the size of a contact of vertex v with an edge from a: the smaller one; a point has none [m]."""
        return ti.select(self.size[v] > 0, ti.min(self.size[v], self.size[a]), self.size[a])

    @ti.func
    def is_beside(self, v, a, t, length):
        """Whether vertex v is beside the edge from a, at t of its length [m].

        Edges reach beyond their ends by SLACK of what touches there, twice its size, so that bodies of the same width stand on
        each other; by a part of their own length, what falls beside a long one would stand on air.
        """
        slack = ti.static(2 * SLACK) * self.smaller(v, a)
        return -slack <= t * length and (t - 1) * length <= slack

    @called
    @ti.func
    def corner(self, v: ti.i32, a: ti.i32, start: ti.i32) -> ti.i32:
        """Return 1 if v is in front of the corner a, beside none of its edges; -1 if behind an inner corner; 0 if beside an edge.

        A particle without edges is a corner on all sides.
        """
        out = 1
        if self.after(a) >= 0:
            r, u, w = self.from_to(a, v, start), self.from_to(a, self.after(a), start), self.from_to(a, self.before(a), start)
            if r.dot(u) > 0 or r.dot(w) > 0:
                out = 0
            elif u.cross(w) < 0:
                out = -1
        return out

    @ti.func
    def covers(self, v, a, start):
        """Return the overlap of v with the edge that begins at a, the normal, and the place on the edge, by positions alone.

        The overlap [m] is negative without contact. A vertex inside of a body leaves over the nearest edge that faces its own
        body. It may be outside of it: where a corner slides off the end of an edge, that end is behind the line of an edge beside
        the corner.
        """
        b = self.after(a)
        r, u = self.from_to(a, v, start), self.from_to(a, b, start)
        uu, t = u.dot(u), 0 * r[0]
        overlap, n = t - 1, 0 * r
        if uu > 0:
            length = ti.sqrt(uu)
            t, n = r.dot(u) / uu, perp(u) / length
            height, shared, tips = r.dot(n), a, 0
            outside = height >= -ti.static(2 * SLACK) * self.smaller(v, a)
            beside = self.is_beside(v, a, t, length)
            if height < 0 and height >= -length / 2 and -PAST <= t <= 1 + PAST:
                at_end = t > 0.5
                tips = self.tips_cross(v, ti.select(at_end, b, a), start) * ti.select(at_end, -1, 1)
            if tips == OVER_EDGE:
                beside = True
            else:
                if not outside and t < 0:
                    beside = self.corner(v, a, start) < 0
                    if beside:  # the shortest way out is over an inner corner
                        height, shared = -r.norm(), self.before(a)
                        n = r / ti.min(height, -uu * TINY)
            t = ti.min(ti.max(t, 0), 1)
            distance = self.contact_radius(v, a, b, t)
            if beside and height < distance and height >= -length / 2:
                back = 0 * r
                if height < 0 and tips != OVER_EDGE:
                    back = self.inward(v, start)
                    outside = outside and back.dot(n) >= 0
                if not outside:
                    if tips == OVER_EDGE:
                        outside = True
                    elif back.dot(n) >= 0:
                        tie = ti.cast(ti.static(self.tie), self.real)
                        aside = ti.min(ti.max(t, tie), 1 - tie) - t
                        outside = self.inside(r + aside * u, a, start) and self.nearest(v, a, shared, height, back, start)
                if outside:
                    overlap = distance - height
        return overlap, n, t

    @called
    @ti.func
    def tips_cross(self, v: ti.i32, c: ti.i32, start: ti.i32) -> ti.i32:
        """Return whether the bodies of corners v and c cross there although neither corner is inside of the other body, and how.

        Each corner has then passed between the edges of the other corner: it is behind one edge and in front of the next, and
        both edges of the corner cross the latter. The shortest way out is over the edge that v is behind, or over the edge that c
        is behind. Returns 0 without a crossing. Otherwise 1 if v is behind the edge from c to the next particle, -1 if it is
        behind the edge that ends at c; twice that number if the way over the edge of v is shorter.
        """
        out = 0
        if self.after(v) >= 0 and self.after(c) >= 0:
            r = self.from_to(c, v, start)
            p, q = self.from_to(v, self.after(v), start), self.from_to(v, self.before(v), start)
            a, b = self.from_to(c, self.after(c), start), self.from_to(c, self.before(c), start)
            # Heights times edge lengths: of v over the edges of c, and of c over the edges of v.
            over_a, over_b, over_p, over_q = r.cross(a), b.cross(r), p.cross(r), r.cross(q)
            if p.cross(q) > 0 and a.cross(b) > 0 and over_a * over_b < 0 and over_p * over_q < 0:
                side, behind, front = 1, a, b
                if over_a > 0:
                    side, behind, front = -1, b, a
                own, other, turn = p, q, 1
                if over_p > 0:
                    own, other, turn = q, p, -1
                # Both corners can leave over the edges that they are behind, and the edges in front are crossed.
                leaves = turns(p, side * behind) and turns(q, side * behind) and turns(a, turn * own) and turns(b, turn * own)
                if (
                    leaves
                    and segments_cross(r, other, front)
                    and segments_cross(r, own, front)
                    and segments_cross(r, other, behind)
                ):
                    deep, deep_v = ti.min(over_a, over_b), ti.min(over_p, over_q)
                    shorter = deep_v * deep_v * behind.dot(behind) < deep * deep * own.dot(own)
                    out = ti.select(shorter, 2 * side, side)
        return out

    @ti.func
    def inside(self, p, a, start):
        """Whether the point x_a + p is inside of the body of a: a ray from it along +x crosses the loop an odd number of times.

        The sides of single edges do not decide it: where edges meet at less than 90 degrees, a point behind one may be in front
        of the next.
        """
        out, k, r = False, a, -p
        going = True
        while going:
            k = self.after(k)
            s = self.from_to(a, k, start) - p
            up = s[1] > 0
            if (r[1] > 0) != up and (r.cross(s) > 0) == up:
                out = not out
            r, going = s, k != a
        return out

    @ti.func
    def inward(self, v, start):
        """Return a vector from an outer corner v into its own body; 0 at inner corners and without a body."""
        out = 0 * self.state.x[v]
        if self.after(v) >= 0:
            u, w = self.from_to(v, self.after(v), start), self.from_to(v, self.before(v), start)
            if u.cross(w) > 0:
                out = u * w.norm() + w * u.norm()
        return out

    @ti.func
    def nearest(self, v, a, shared, height, back, start):
        """Whether no edge of the body of a is nearer to v than those from a and `shared`. height: of v over them, below 0 [m].

        Edges that face away from the body of v are no way out for v, and are skipped. back: the direction of that body from v.
        """
        out = True
        for e in range(self.list.first[v], self.list.first[v] + self.list.number[v]):
            j = self.list.neighbour[e]
            if j != a and j != shared and self.loop[j][2] == self.loop[a][2]:
                r, u = self.from_to(j, v, start), self.from_to(j, self.after(j), start)
                uu, faces = u.dot(u), u[1] * back[0] - u[0] * back[1] >= 0
                if uu > 0:
                    r -= ti.min(ti.max(r.dot(u) / uu, 0), 1) * u
                rest = -height - r.norm()
                if faces and (rest > -CLOSE * height or (rest >= CLOSE * height and j < a)):
                    out = False
        return out

    @ti.func
    def keeps(self, i, j):
        """Whether particle i, of two particles that touch as discs, stores the contact as its vertex.

        Particles in no loop are never the start or end of an edge, so they store all of their contacts.
        """
        return (i < j) if (self.after(i) < 0) == (self.after(j) < 0) else self.after(i) < 0

    @ti.func
    def find(self, v, a):
        """Return the entry of a in the list of v, or -1 (binary search)."""
        low, end = self.list.first[v], self.list.first[v] + self.list.number[v]
        high = end
        while low < high:
            middle = (low + high) // 2
            if self.list.neighbour[middle] < a:
                low = middle + 1
            else:
                high = middle
        out = -1
        if low < end:
            if self.list.neighbour[low] == a:
                out = low
        return out

    # Rows

    @ti.func
    def clear(self, i):
        """Forget the rows of the edges of particle i."""
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            self.marks.field[e] = 0 * self.marks.field[e]

    @called
    @ti.func
    def list_row(self, v: ti.i32, e: ti.i32, begin: ti.i32) -> ti.i32:
        """List the contact of vertex v at entry e if it may press. Returns the next free row."""
        scale = self.rows.scale[None]
        a = self.list.neighbour[e]
        b, row = self.after(a), begin
        moves = self.state.moves(v) or self.state.moves(a)
        if b >= 0:
            moves = moves or self.state.moves(b)
        if moves:
            borne = self.rows.is_set(self.rows.memory.field[e])
            if b >= 0 and (borne or self.reaches_edge(v, a, b)):
                row = self.list_edge(v, a, b, e, row, scale)
            if row == begin and self.keeps(v, a) and (borne or self.reaches_disc(v, a)):
                if self.corner(v, a, 1) > 0 and self.corner(a, v, 1) > 0 and self.tips_cross(v, a, 1) == 0:
                    row = self.rows.find_pair(v, a, e, row, scale)
                    if row > begin:
                        self.end.field[begin], self.place.field[begin] = a, ti.static(DISCS)
                        self.marks.field[self.find(a, v)][BEGIN] = row
            if row == begin:
                self.rows.forget(e)
        return row

    @ti.func
    def vertex_and_edge(self, v, a, b):
        """Return x_v - x_a and x_b - x_a at the end of the substep, and by how much each changes in it [m]."""
        dr = self.state.relative_displacement(self.state.d[v] - self.state.d[a], v, a)
        du = self.state.relative_displacement(self.state.d[b] - self.state.d[a], b, a)
        return self.state.separation(v, a), self.state.separation(b, a), dr, du

    @ti.func
    def reaches_edge(self, v, a, b):
        """Whether list_edge() may list vertex v at the edge from a to b: a fast test, which most entries fail."""
        r1, u1, dr, du = self.vertex_and_edge(v, a, b)
        r0, u0 = r1 - dr, u1 - du
        length, t0, t1, uu = self.longest[a], r0.dot(u0), r1.dot(u1), ti.max(u0.dot(u0), u1.dot(u1))
        top = self.radius.of(v) + ti.max(self.radius.of(a), self.radius.of(b)) + ti.static(AHEAD) * self.smaller(v, a)
        beside = ti.max(t0, t1) >= -uu / 2 and ti.min(t0, t1) <= ti.static(1 + PAST) * uu
        over = r0.cross(u0)  # height times length
        return beside and ti.select(over < 0, -over <= length * length / 2, r1.cross(u1) <= top * length)

    @ti.func
    def reaches_disc(self, v, a):
        """Whether particles v and a may touch as discs in this substep: a fast test."""
        distance, r = self.radius.of(v) + self.radius.of(a), self.state.separation(v, a)
        u = self.state.relative_displacement(self.state.d[v] - self.state.d[a], v, a)
        far = distance + ti.max(self.rows.ahead, ti.static(SLOP) * distance)
        return distance > 0 and r.dot(r) <= 2 * (far * far + u.dot(u))

    @ti.func
    def list_edge(self, v, a, b, e, row, scale):
        """List the contact of vertex v with the edge from a to b if it may press. Returns the next free row."""
        r1, u1, dr, du = self.vertex_and_edge(v, a, b)
        r0, u0 = r1 - dr, u1 - du
        uu = u0.dot(u0)
        n, t, s, lists, size = 0 * r0, 0 * uu, 0 * uu, False, self.smaller(v, a)
        p = self.rows.memory.field[e]
        if uu > 0 and u1.dot(u1) > 0:
            n, t = perp(u0).normalized(), r0.dot(u0) / uu
            height = r0.dot(n)
            if height >= 0:  # in front: it may come in between the ends
                gap = height - self.contact_radius(v, a, b, ti.min(ti.max(t, 0), 1))
                s, place = ti.cast(1, self.real), r1.dot(u1) / u1.dot(u1)
                ahead = r1.dot(perp(u1).normalized()) - self.contact_radius(v, a, b, ti.min(ti.max(place, 0), 1))
                goes = ti.max(-n.dot(self.state.d[v]), n.dot((1 - t) * self.state.d[a] + t * self.state.d[b]))
                reach = ti.min(ti.static(AHEAD) * size, self.rows.ahead)
                lists = ahead < ti.static(SLOP) * size or self.rows.is_set(p) or (gap < goes and ahead < reach)
                if lists:
                    s = ti.select(gap > ti.max(ahead, 0), gap / ti.max(gap - ahead, TINY), 0 * gap)
                    s = ti.min(s, 1)
                    for _ in range(2):  # the edge turns
                        if 0 < s < 1:
                            height = (r0 + s * dr).dot(perp(u0 + s * du).normalized())
                            left = height - self.contact_radius(v, a, b, ti.min(ti.max(t, 0), 1))
                            s = ti.min(ti.max(s + left / ti.max(gap - ahead, TINY), 0), 1)
                    r, u = r0 + s * dr, u0 + s * du
                    n, t = perp(u).normalized(), r.dot(u) / ti.max(u.dot(u), TINY)
                    lists = self.is_beside(v, a, t, u.norm()) and self.inward(v, 1).dot(n) >= 0
                    lists = lists and not self.grazes(v, a, b, r, u, n, size)
                    t = ti.min(ti.max(t, 0), 1)
            else:
                overlap, m, place = self.covers(v, a, 1)
                lists = overlap > 0 and not self.grazes(v, a, b, r0, u0, m, size)
                n, t = m, place
        at_a, at_b = -1, -1
        if lists and not self.is_doubled(v, a, b, r0, u0, dr):
            at_a, at_b = self.find(a, v), self.find(b, v)
        if at_a >= 0 and at_b >= 0:  # the end of a long edge may not be listed: momentum would be lost
            distance = self.contact_radius(v, a, b, t)
            arm = r0 - t * u0
            start = perp(u0).normalized().dot(arm) - distance
            # What bears a load and is apart by rounding touches: else a load would come and go with the last digits of positions.
            closed = ti.select(self.rows.is_set(p), self.state.digits(v), 0)
            if ti.static(self.rows.bounces):
                self.rows.bounce.field[row], self.rows.time.field[row] = 0, 1
                back = self.rows.table.of(v, a)[RESTITUTION]
                f, f_own, reach = self.kick(v, a, b, t)
                hit, when, _ = self.rows.strike(start, n, 0 * t, dr - t * du, f, f_own, back, e, reach)
                if hit:
                    self.rows.bounce.field[row], self.rows.time.field[row] = back, when
            self.rows.put(row, a, e, n, distance + ti.select(start > closed, 0, start), 0 * t, p * scale)
            self.end.field[row], self.place.field[row] = b, t
            self.edge.field[row], self.arm.field[row] = u0, arm
            if ti.static(self.rows.has_friction):
                c = self.rows.table.of(v, a)
                self.rows.friction.field[row] = [c[STATIC], c[DYNAMIC]]
            row += 1
            self.marks.field[at_a][BEGIN] = row
            self.marks.field[at_b][END] = row
        return row

    @ti.func
    def nearer_end(self, a, b, r, u):
        """Return whether x_a + r is nearer to the end b of the edge u from a, the corner there, and the way from this corner."""
        at_end, c, rest = 2 * r.dot(u) > u.dot(u), a, r
        if at_end:
            c, rest = b, r - u
        return at_end, c, rest

    @ti.func
    def is_doubled(self, v, a, b, r, u, dr):
        """Whether a corner of the edge u from a to b, which lies at vertex v, presses on the edge of v there: one row is enough.

        So two edges that lie on each other have two rows, where their ends meet, too. v is at x_a + r, and moves by dr.
        """
        out, length, slight = False, u.norm(), ti.static(SLOP) * self.smaller(v, a)
        at_end, c, rest = self.nearer_end(a, b, r, u)
        if v > c and self.after(v) >= 0:
            w = self.from_to(v, self.after(v), 1)
            if not at_end:
                w = self.from_to(self.before(v), v, 1)
            other, n = w.norm(), perp(u) / length
            reach, gap = ti.static(SLACK) * self.smaller(v, a), rest.dot(n) - self.radius.of(v) - self.radius.of(c)
            aligned = w.dot(u) < 0 and ti.abs(w.cross(u)) <= ti.static(SLACK / 2) * length * other
            beside = ti.abs(rest.dot(u)) <= reach * length and ti.abs(rest.dot(w)) <= reach * other
            out = aligned and beside and ti.abs(gap) <= reach and ti.abs(dr.dot(n)) <= slight
        return out

    @ti.func
    def grazes(self, v, a, b, r, u, n, size):
        """Whether vertex v at x_a + r, that strikes the edge u from a to b so near to its end that the slop decides over which
        edge it came in, came in over the other edge there: that towards which it moves less.

        So what slides over level pieces passes from one to the next.
        """
        at_end, c, rest = self.nearer_end(a, b, r, u)
        w = 0 * u
        if at_end:
            w = self.from_to(b, self.after(b), 1)
        else:
            w = self.from_to(self.before(a), a, 1)
        m, zone = perp(w).normalized(), ti.static(SLOP * BEYOND) * size
        d = self.state.relative_displacement(self.state.d[v] - self.state.d[c], v, c)
        near = rest.dot(rest) <= 2 * zone * zone  # as deep as the slop below both edges of a right angle
        convex = ti.select(at_end, u.cross(w), w.cross(u)) > 0
        f, _, _ = self.kick(v, c, c, 0 * size)
        return (
            near
            and convex
            and self.inward(v, 1).dot(m) >= 0
            and -d.dot(n) > ti.max(ti.static(SLOW) * ti.abs(f.dot(n)), -d.dot(m))
        )

    @ti.func
    def kick(self, v, a, b, t):
        """Return the relative kick of a contact, that of the particle which has most, and how large coordinates are, squared."""
        f, most = 0 * self.state.x[v], 0 * self.state.x[v]
        who, share = ti.Vector([v, a, b]), ti.Vector([1 + 0 * t, t - 1, -t])
        for k in ti.static(range(3)):
            if self.state.moves(who[k]):
                one = self.state.kick(who[k])
                f += share[k] * one
                if one.dot(one) > most.dot(most):
                    most = one
        place = self.state.place(v)
        return f, most, place.dot(place)

    @ti.func
    def gap(self, row, u, d: ti.template()):  # type: ignore[valid-type]
        """Return the gap of a row of an edge where the vertex has moved by u relative to it, less that at the start if it was
        negative [m]. d: displacements of particles."""
        a, b, edge = self.rows.other.field[row], self.end.field[row], self.edge.field[row]
        edge += self.state.relative_displacement(d[b] - d[a], b, a)
        return perp(edge).normalized().dot(self.arm.field[row] + u) - self.rows.gap.field[row]

    @ti.func
    def gap_now(self, v, row):
        """Return the gap of a row of an edge at present [m], 1 where the vertex is not beside it, and the normal."""
        a, b, t = self.rows.other.field[row], self.end.field[row], self.place.field[row]
        r, u = self.state.separation(v, a), self.state.separation(b, a)
        n, gap, place = perp(u).normalized(), 1 + 0 * t, r.dot(u) / ti.max(u.dot(u), TINY)
        if self.is_beside(v, a, place, u.norm()):
            gap = r.dot(n) - self.contact_radius(v, a, b, t)
        return gap, n

    @inline
    def part(self, row, k):
        """Return the part of an end of the edge of a row."""
        t = ti.max(at(self.place.field, row), 0)
        return 1 - t if k == BEGIN else t

    @ti.func
    def share(self, i):
        """Add the rows of the edges of particle i to those among which its mass is divided."""
        last = self.list.first[i]
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            if (self.marks.field[e] != 0).any():
                self.marked.field[last] = e
                last += 1
            for k in ti.static(range(2)):
                row = self.marks.field[e][k] - 1
                if row >= 0:
                    part = self.part(row, k)
                    self.rows.share[i] = self.rows.share[i] + part
                    square = ti.cast(self.rows.square(self.rows.normal.field[row]), self.real)
                    self.rows.spread[i] = self.rows.spread[i] + ti.cast(part * square, ti.i32)
        self.number[i] = last - self.list.first[i]

    @ti.func
    def gather(self, i):
        """Return the sum of impulses that the rows of its edges give to particle i [kg m]."""
        out = 0 * self.state.d[i]
        for k in range(self.list.first[i], self.list.first[i] + self.number[i]):
            e = self.marked.field[k]
            for end in ti.static(range(2)):
                row = self.marks.field[e][end] - 1
                if row >= 0:
                    out -= self.part(row, end) * self.gone.field[row]
        return out

    # Reports and sleep

    @called
    @ti.func
    def detect(self, i: ti.i32):
        """Find the contacts at present in which particle i is the vertex, or one of two discs."""
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j = self.list.neighbour[e]
            overlap, n, t = 0 * self.w[i] - 1, 0 * self.state.x[i], 0 * self.w[i]
            if self.after(j) >= 0:
                overlap, n, t = self.covers(i, j, 0)
            if overlap <= 0 and self.keeps(i, j):
                deep, m = self.discs.overlap(i, j, self.radius.of(i) + self.radius.of(j))
                if deep > 0 or self.after(j) < 0:
                    if self.corner(i, j, 0) > 0 and self.corner(j, i, 0) > 0 and self.tips_cross(i, j, 0) == 0:
                        overlap, n, t = deep, m, 0 * t + DISCS
            self.manifold.field[e] = ti.Vector([overlap, t, n[0], n[1]])

    @ti.func
    def worst_overlap(self, i):
        """Return the number of contacts in which i is the vertex, or the first disc, and their worst overlap, for the report.

        The overlap is relative to the size of what touches, or to the radius of the smaller disc.
        """
        touching, worst = 0, ti.cast(0, ti.f64)
        self.detect(i)
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j, found = self.list.neighbour[e], self.manifold.field[e]
            if found[0] > 0:
                size = ti.min(self.radius.of(i), self.radius.of(j))
                if found[1] > DISCS:
                    size = self.smaller(i, j)
                elif size == 0:
                    size = ti.max(self.radius.of(i), self.radius.of(j))
                worst = ti.max(worst, found[0] / size)
                touching += 1
        return touching, worst

    @ti.func
    def overshoots(self, i):
        """Return 1 if particle i moves by more than a quarter of the shortest edge in one substep, or a disc by its size, or if
        its edge is too long for the list."""
        d, limit, after, out = self.state.d[i], ti.cast(self.stride, self.real), self.after(i), 0
        if after < 0:
            limit = ti.min(limit, self.radius.stride(i))
        else:
            u = self.state.separation(after, i)
            if u.dot(u) > self.longest[i] ** 2:
                out = 1
        return ti.select(d.dot(d) <= limit * limit, out, 1)

    @ti.func
    def touches(self, i, j, margin):
        """Whether particles i and j touch at present, or nearly: i as the vertex at the edge from j, or as discs."""
        out = False
        if self.after(j) >= 0:
            overlap, _, _ = self.covers(i, j, 0)
            out = overlap > 0
            r, u = self.state.separation(i, j), self.state.separation(self.after(j), j)
            t, height = r.dot(u) / ti.max(u.dot(u), TINY), r.dot(perp(u).normalized())
            if self.is_beside(i, j, t, u.norm()) and 0 <= height:
                near = self.contact_radius(i, j, self.after(j), ti.min(ti.max(t, 0), 1)) + margin + SLOP * self.size[j]
                out = out or height < near
        if not out and self.radius.of(i) + self.radius.of(j) > 0:
            out = self.discs.touches(i, j, margin) and self.corner(i, j, 0) > 0
        return out

    @ti.func
    def pressed_particle(self, j):
        """Return the particle that moves with disc j or the edge from j: j, or the other end if j cannot move."""
        out = j
        if self.w[j] == 0 and self.after(j) >= 0:
            out = self.after(j)
        return out

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """Return the contacts of the last detect(): vertices and edges, and pairs of discs, also those pushed apart since."""
        r = self.scene.particles.radius
        pairs, at = self.list.entries()
        found, p = self.list.read(self.manifold, at), self.list.read(self.impulse, at)
        push, after = self.list.read(self.given, at) if self.given else p, self.outline.ends[:, 0]
        some = (found[:, 0] > 0) | (push.reshape(len(push), -1) != 0).any(axis=1) if len(push) else np.zeros(0, dtype=bool)
        pairs, found, p, push = pairs[some], found[some], p[some], push[some]
        (i, j), overlap, t, n = pairs.T, found[:, 0], found[:, 1], found[:, 2:]
        parted, no_way = overlap <= 0, (n == 0).all(axis=1)
        discs = (t <= DISCS) | (no_way & (r[i] + r[j] > 0))
        ends, t = np.where(discs, j, after[j]), np.where(discs, 0.0, t)
        edge, apart = x[ends] - x[j], x[i] - (1 - t)[:, None] * x[j] - t[:, None] * x[ends]
        straight = np.where(discs[:, None], apart, np.stack([edge[:, 1], -edge[:, 0]], axis=1))
        n = np.where(no_way[:, None], straight / np.linalg.norm(straight, axis=1)[:, None], n)
        edge_radius = (1 - t) * r[j] + t * r[ends]
        overlap = np.where(parted, r[i] + edge_radius - (apart * n).sum(axis=1), overlap)
        point = x[i] - apart + (edge_radius - overlap / 2)[:, None] * n
        across = np.zeros(n.shape)
        if p.ndim > 1:
            along = (p * n).sum(axis=1)
            across, push = p - along[:, None] * n, push if self.given else np.maximum(along, 0)
        return Contacts(pairs, ends, t, overlap, n, point, push / h, across / h)


@ti.func
def perp(u):
    """Return u turned clockwise by a right angle: outward from an edge along u."""
    return ti.Vector([u[1], -u[0]])


@ti.func
def segments_cross(r, s, q):
    """Whether the line segment from r to r + s crosses the segment from 0 to q."""
    d = s.cross(q)
    at_s, at_q = q.cross(r), s.cross(r)
    if d < 0:
        d, at_s, at_q = -d, -at_s, -at_q
    return d > 0 and 0 <= at_s <= d and 0 <= at_q <= d


@ti.func
def turns(r, s):
    """Whether s is counterclockwise from r, or nearly parallel to it (TILT)."""
    return r.cross(s) >= -TILT * r.norm() * s.norm()


class EdgePairTable:
    """The table that selects pairs for the neighbour search: vertices near edges of other bodies, and discs."""

    uniform = senses = False
    skin: Any = OnDevice()

    def __init__(self, edges: Edges, table: Table, skin: Number):
        self.table, self.skin = table, skin
        self.loop, self.longest, self.radius, self.state = edges.loop, edges.longest, edges.radius, edges.state

    @ti.func
    def cutoff(self, radius: ti.template(), i, j):  # type: ignore[valid-type]
        """Return the distance up to which particles i and j may take part in a contact [m]."""
        return radius.of(i) + radius.of(j) + ti.static(REACH) * ti.max(self.longest[i], self.longest[j])

    @ti.func
    def of(self, i, j):
        """Return the row of the table. Entry 3, whether i and j touch, is 0 within one body and where no edge is near."""
        row = self.table.of(i, j)
        if self.loop[i][2] >= 0 or self.loop[j][2] >= 0:
            if self.loop[i][2] == self.loop[j][2] or not (self.beside(i, j) or self.beside(j, i)):
                row[3] = 0
        return row

    @ti.func
    def beside(self, v, c):
        """Whether v is near an edge of c: within the skin in front of it, or behind it by up to half its length and the skin."""
        out = False
        if self.loop[c][2] >= 0:
            r, reach = self.state.separation(v, c), self.radius.of(v) + self.skin
            for k in ti.static(range(2)):
                other = self.loop[c][k]
                u = self.state.separation(other, c)
                uu, t, height = u.dot(u), r.dot(u), r.cross(u) * (1 - 2 * k)  # the last two times the length
                size = reach + ti.max(self.radius.of(c), self.radius.of(other))
                beyond = ti.max(height, -height - uu / 2, t - (1 + PAST) * uu, -t - PAST * uu, 0)
                if beyond * beyond <= size * size * uu:
                    out = True
        return out
