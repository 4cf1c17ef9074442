"""The narrow phase of bodies made of loops of particles: vertices and edges (2D)."""

from typing import Any, NamedTuple

import numpy as np

from ..device import called, ti
from ..device.number import Number, OnDevice
from ..features.feature import Scene
from ..features.material import Table
from ..neighbours.neighbour_list import PairData
from ..neighbours.neighbour_search import NeighbourSearch
from ..neighbours.queries import Contacts
from .candidates import NONE, EdgeCandidates
from .narrow_phase import DiscGeometry

# Lengths relative to an edge.
SLACK = 1 / 512  # extension of an edge at its ends, so that bodies of the same width stand on each other
STRETCH = 1.25  # longest edge, relative to its first length, for which all contacts in its middle are listed
BEYOND = 1 / 4  # how far beyond the end of an edge a contact may be
REACH = 1.35  # from one end of an edge to the farthest contact: |(1 + BEYOND, 1 / 2)|

CLOSE = 1e-4  # edges whose relative distances differ by less are equally near: the first one counts
TILT = 1 / 16  # sine of the angle by which edges that lie on each other may lean, as bodies deform
TINY = 1e-30

RATE = 0.4  # at which the usual depth of a contact approaches its depth, see PolygonGeometry.share()
DISCS = -1  # the place on an edge where there is no edge: two discs touch
OVER_EDGE = 1  # what tips_cross() returns if the way out is over the edge of the second corner
VERTEX, START, END = range(3)  # the role of a particle in a contact with a listed particle


class Outline(NamedTuple):
    """Bodies as arrays. Particles in no body have -1.

    ends: (n, 2), the next and the previous particle around the body. body: (n,), the number of the body. length: (n,) [m], of the
    longer of the two edges of each particle.
    """

    ends: np.ndarray
    body: np.ndarray
    length: np.ndarray

    @property
    def longest(self) -> np.ndarray:
        """The edge length up to which the neighbour list is complete, (n,) [m]."""
        return STRETCH * self.length

    @property
    def reach(self) -> np.ndarray:
        """How far from each particle a contact of its edges may be, (n,) [m]."""
        return REACH * self.longest


class PolygonGeometry:
    """The geometry of bodies made of loops of particles: vertices beside, over or inside of edges, and the parts of particles.

    C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) of a vertex v and the edge from a to b of another body,
    or C of two discs, see DiscGeometry, of which one may be a corner. push_out: speed at which overlap from the start ends [m/s].
    """

    push_out: Any = OnDevice()
    step: Any = OnDevice()  # how far a vertex may move in a substep without missing an edge [m]

    def __init__(self, scene: Scene, outline: Outline, push_out: float):
        n, add = scene.count, scene.memory.field
        self.scene, self.state, self.radius, self.w, self.real = scene, scene.state, scene.radius, scene.state.w, scene.real
        self.outline, self.push_out = outline, scene.memory.number(push_out, scene.real)
        self.loop = add("Polygons.loop", n, width=3, kind=ti.i32, values=np.c_[outline.ends, outline.body])
        self.longest = add("Polygons.longest_edge", n, values=outline.longest)
        self.step = scene.memory.number(self._stride(outline), scene.real)
        self.tie = 2.0**-16 if scene.real == ti.f32 else 2.0**-44  # what is so near to the end of an edge is at it, by rounding
        self.allowed = add("Polygons.allowed", n, state=True)  # overlap [m]
        self.slower = add("Polygons.slower", n, state=True)  # than at push_out its allowed overlap ends [m/s]
        self.in_state = {"allowed": self.allowed, "slower": self.slower}
        # Particle 0 writes h. It may sleep, so with Sleep h is part of the state.
        self.h = add("Polygons.substep", None, state=bool(scene.state.sleepers))
        # manifold: for each entry the contact of which its particle is the vertex: overlap, place on the edge (DISCS without an
        # edge) and normal. back: the offsets, in the other particle's list, of the contacts in which this particle is the start,
        # and the end, of the edge; -1 without one.
        self.manifold, self.back = (
            PairData("met", 4, False, is_transferred=False),
            PairData("back", 2, False, is_transferred=False),
        )
        # How far the contact alone may be pushed out in this substep [m].
        self.push_limit = PairData("most", 0, False, is_transferred=False)
        self.impulse = PairData("given", 0, persistent=True, for_reports=True)  # pushes and impacts in the last substep [kg m]
        # The depth, averaged over substeps with the latest weighing most [m].
        self.usual_depth = PairData("usual", 0, persistent=True)
        self.carried = [self.manifold, self.back, self.push_limit, self.impulse, self.usual_depth]

    @staticmethod
    def _stride(outline: Outline) -> float:
        """Return a quarter of the shortest edge [m]."""
        return float(outline.length[outline.body >= 0].min(initial=np.inf)) / 4

    def set_outline(self, outline: Outline) -> None:
        """Write other bodies, of the present particles, to the device."""
        self.outline, self.step, memory = outline, self._stride(outline), self.scene.memory
        memory.write(self.loop, np.c_[outline.ends, outline.body])
        memory.write(self.longest, outline.longest)

    def bind(self, search: NeighbourSearch, known: Any) -> None:
        """Store the neighbour list of a search whose pairs `EdgePairTable` selects, and the KnownLoads of contacts, or None."""
        self.list, self.discs, self.known = search.list, DiscGeometry(self.scene, search), known

    @ti.func
    def after(self, i):
        """Return the next particle around the body of particle i; -1 if it is in no body."""
        return self.loop[i][0]

    @ti.func
    def before(self, i):
        """Return the previous particle around the body of particle i; -1 if it is in no body."""
        return self.loop[i][1]

    @ti.func
    def corner(self, v, a):
        """Return 1 if v is in front of the corner a, beside none of its edges; -1 if behind an inner corner; 0 if beside an edge.

        A particle without edges is a corner on all sides.
        """
        out = 1
        if self.after(a) >= 0:
            r, u, w = (
                self.state.separation(v, a),
                self.state.separation(self.after(a), a),
                self.state.separation(self.before(a), a),
            )
            if r.dot(u) > 0 or r.dot(w) > 0:
                out = 0
            elif u.cross(w) < 0:
                out = -1
        return out

    @ti.func
    def edge(self, v, a, front, moved, usual):
        """Return the overlap of v with the edge that begins at a, the normal, the place on the edge, and the largest push.

        The overlap [m] is negative without contact. The largest push is how far v may be pushed out in this substep [m].

        A vertex came in over the edge if it was in front of it at the start of the substep, and crossed it between its ends. One
        that was behind came in over it if the contact was as deep in the last substep: then it pushes like a spring. Or else if
        the vertex goes deeper in this substep by as much as it was behind, as after rounding: then it leaves no faster than it
        came.

        Any other vertex that was behind leaves at push_out, over the nearest edge that faces its own body, if it is inside of the
        body. It may be outside: where a corner slides off the end of an edge, that end is behind the line of an edge beside the
        corner. If it were pushed out by its depth C, bodies would gain m (C / h)^2 / 2.

        front: what corner(v, a) returned. moved: as in detect(). usual: the usual depth of the contact, 0 if there was none in
        the last substep [m]; the depth was usual / RATE at most.
        """
        b = self.after(a)
        r, u = self.state.separation(v, a), self.state.separation(b, a)
        uu, t = u.dot(u), 0 * r[0]
        overlap, n, most = t - 1, 0 * r, ti.cast(ti.math.inf, self.real)
        if uu > 0:
            length = ti.sqrt(uu)
            t, n = r.dot(u) / uu, ti.Vector([u[1], -u[0]]) / length
            height, cross, came, shared, passed = r.dot(n), t, True, a, False
            if height < 0:
                came = height >= -SLACK * length
                if moved != 0:
                    d = self.state.d[a]
                    r0, u0 = r - (self.state.d[v] - d), u - (self.state.d[b] - d)
                    height0, t0 = r0.dot(ti.Vector([u0[1], -u0[0]])) / length, r0.dot(u0) / ti.max(u0.dot(u0), uu * SLACK)
                    came = -height0 <= ti.max(height0 - height, usual / RATE)
                    if height0 > 0:
                        cross = t0 + height0 / (height0 - height) * (t - t0)
                        passed = -SLACK <= cross <= 1 + SLACK
            beside, tips = -SLACK <= cross <= 1 + SLACK, 0
            if height < 0 and height >= -length / 2 and -BEYOND <= t <= 1 + BEYOND and not passed:
                at_end = t > 0.5
                tips = self.tips_cross(v, ti.select(at_end, b, a)) * ti.select(at_end, -1, 1)
            if tips == OVER_EDGE:
                beside = True
            else:
                if not came and t < 0:
                    beside = front < 0
                    if beside:  # the shortest way out is over an inner corner
                        height, shared = -r.norm(), self.before(a)
                        n = r / ti.min(height, -uu * TINY)
                t = ti.min(ti.max(t, 0), 1)
            contact_distance = self.radius.of(v) + (1 - t) * self.radius.of(a) + t * self.radius.of(b)
            if beside and height < contact_distance and height >= -length / 2:
                out, back = contact_distance - height, 0 * r
                if moved != 0:
                    out -= self.allowed[v]
                if height < 0 and tips != OVER_EDGE:
                    back = self.inward(v)
                    came = came and back.dot(n) >= 0
                if not came:
                    if moved != 0:
                        most = self.push_out * self.h[None] - self.relative(self.state.d, v, a, b, t).dot(n)
                        out = ti.select(most > 0, out, ti.min(out, most))
                    if tips == OVER_EDGE:
                        came = True
                    elif back.dot(n) >= 0:
                        tie = ti.cast(ti.static(self.tie), self.real)
                        aside = ti.min(ti.max(t, tie), 1 - tie) - t
                        came = self.inside(r + aside * u, a) and self.nearest(v, a, shared, height, back)
                if came:
                    overlap = out
        return overlap, n, t, most

    @called
    @ti.func
    def tips_cross(self, v: ti.i32, c: ti.i32) -> ti.i32:
        """Return whether the bodies of corners v and c cross there although neither corner is inside of the other body, and how.

        Each corner has then passed between the edges of the other corner: it is behind one edge and in front of the next, and
        both edges of the corner cross the latter. The shortest way out is over the edge that v is behind, or over the edge that c
        is behind. Returns 0 without a crossing. Otherwise 1 if v is behind the edge from c to the next particle, -1 if it is
        behind the edge that ends at c; twice that number if the way over the edge of v is shorter.
        """
        out = 0
        if self.after(v) >= 0 and self.after(c) >= 0:
            r = self.state.separation(v, c)
            p, q = self.state.separation(self.after(v), v), self.state.separation(self.before(v), v)
            a, b = self.state.separation(self.after(c), c), self.state.separation(self.before(c), c)
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
    def inside(self, p, a):
        """Whether the point x_a + p is inside of the body of a: a ray from it along +x crosses the loop an odd number of times.

        The sides of single edges do not decide it: where edges meet at less than 90 degrees, a point behind one may be in front
        of the next.
        """
        out, k, r = False, a, -p
        going = True
        while going:
            k = self.after(k)
            s = self.state.separation(k, a) - p
            up = s[1] > 0
            if (r[1] > 0) != up and (r.cross(s) > 0) == up:
                out = not out
            r, going = s, k != a
        return out

    @ti.func
    def inward(self, v):
        """Return a vector from an outer corner v into its own body; 0 at inner corners and without a body."""
        out = 0 * self.state.x[v]
        if self.after(v) >= 0:
            u, w = self.state.separation(self.after(v), v), self.state.separation(self.before(v), v)
            if u.cross(w) > 0:
                out = u * w.norm() + w * u.norm()
        return out

    @ti.func
    def nearest(self, v, a, shared, height, back):
        """Whether no edge of the body of a is nearer to v than those from a and `shared`. height: of v over them, below 0 [m].

        Edges that face away from the body of v are no way out for v, and are skipped. back: the direction of that body from v.
        """
        out = True
        for e in range(self.list.first[v], self.list.first[v] + self.list.number[v]):
            j = self.list.neighbour[e]
            if j != a and j != shared and self.loop[j][2] == self.loop[a][2]:
                r, u = self.state.separation(v, j), self.state.separation(self.after(j), j)
                uu, faces = u.dot(u), u[1] * back[0] - u[0] * back[1] >= 0
                if uu > 0:
                    r -= ti.min(ti.max(r.dot(u) / uu, 0), 1) * u
                rest = -height - r.norm()
                if faces and (rest > -CLOSE * height or (rest >= CLOSE * height and j < a)):
                    out = False
        return out

    @called
    @ti.func
    def detect(self, i: ti.i32, moved: ti.i32):
        """Find the contacts in which particle i is the vertex, or one of two discs: at most one with each listed particle.

        moved: 1 in the first pass of a substep, 2 in later ones: by how particles moved in it, less the allowed overlap. 0
        otherwise: by present positions and the nearest edges. Then d may be a velocity, as it is at a start (before the first
        substep after velocities were set).
        """
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j = self.list.neighbour[e]
            if self.after(i) < 0 and self.after(j) < 0:
                overlap, n = self.discs.overlap(i, j, self.radius.of(i) + self.radius.of(j))
                if ti.static(bool(self.known)):
                    if overlap <= 0 and moved != 0 and self.known.load.field[e] > 0:
                        overlap, n = self.discs.gap(i, j)
                if moved != 0:
                    overlap -= self.allowed[ti.min(i, j)]
                self.manifold.field[e] = ti.Vector([overlap, ti.cast(DISCS, self.real), n[0], n[1]])
                self.update_usual_depth(i, j, e, moved)
            else:
                overlap, n, t = 0 * self.w.of(i) - 1, 0 * self.state.x[i], 0 * self.w.of(i)
                front = self.corner(i, j)
                if self.after(j) >= 0:
                    overlap, n, t, self.push_limit.field[e] = self.edge(i, j, front, moved, self.usual_depth.field[e])
                    if overlap > 0:
                        if self.find(i, self.after(j)) < 0:
                            overlap = -overlap  # the end of a long edge is not on the list of i: momentum would be lost
                if overlap <= 0 and front > 0 and self.keeps(i, j):
                    overlap, n = self.discs.overlap(i, j, self.radius.of(i) + self.radius.of(j))
                    if overlap > 0:
                        if self.tips_cross(i, j) != 0:
                            overlap = -overlap
                    if moved != 0:
                        overlap -= self.allowed[i]
                    if overlap > 0:
                        t = 0 * t + DISCS
                        if self.corner(j, i) <= 0:
                            overlap = -overlap
                if ti.static(bool(self.known)):
                    if overlap <= 0 and moved != 0 and self.known.load.field[e] > 0:
                        overlap, n, t = self.gap(i, j, e, front)
                self.manifold.field[e] = ti.Vector([overlap, t, n[0], n[1]])
                self.update_usual_depth(i, j, e, moved)
                if self.after(i) >= 0:
                    self.back.field[e] = ti.cast(ti.Vector([self.find(j, i), self.find(j, self.before(i))]), self.real)

    @ti.func
    def gap(self, v, a, e, front):
        """Return the (negative) overlap, the normal and the place of vertex v at a, if no contact was found but e bears a load.

        The gap is that to the edge from a, or to the corner a. If v is at neither any more, it is wide: the contact takes back
        what its load gave, and forgets it.
        """
        b, r, edge_radius = self.after(a), self.state.separation(v, a), self.radius.of(a)
        n, t, gap, at_edge = r, 0 * r[0], 0 * r[0], False
        wide = r.norm() + self.radius.of(v) + edge_radius
        if b >= 0:
            u = self.state.separation(b, a)
            uu = u.dot(u)
            if self.find(v, b) < 0 or uu == 0:
                self.known.load.field[e] = 0  # the end of a long edge is not on the list of v, so it would not see the contact
            else:
                t, n = r.dot(u) / uu, ti.Vector([u[1], -u[0]])
                at_edge = -SLACK <= t <= 1 + SLACK
                t = ti.min(ti.max(t, 0), 1)
                edge_radius += t * (self.radius.of(b) - edge_radius)
                wide += ti.sqrt(uu)
        if not at_edge and front > 0 and self.keeps(v, a) and self.corner(a, v) > 0:
            at_edge, n, t, edge_radius = True, r, 0 * t + DISCS, self.radius.of(a)
        n = n.normalized()
        if at_edge:
            gap = r.dot(n) - self.radius.of(v) - edge_radius + self.allowed[v]
        return ti.select(at_edge and gap >= 0, -gap, -wide), n, t

    @ti.func
    def bears(self, at):
        """Whether the contact at entry `at` pushes, or has a known load."""
        out = self.manifold.field[at][0] > 0
        if ti.static(bool(self.known)):
            out = out or self.known.load.field[at] > 0
        return out

    @ti.func
    def update_usual_depth(self, i, j, e, moved):
        """Update the usual depth of the contact of vertex i with j, at entry e, unless both sleep.

        A known load counts as the depth that would hold it. So masses are split in the same way while a load is learnt.
        """
        if moved != 0 and (self.state.awake(i) or self.state.awake(self.pressed_particle(j))):
            depth, usual = self.depth(e), self.usual_depth.field[e]
            if ti.static(bool(self.known)):
                t = self.manifold.field[e][1]
                b = self.after(j) if t > DISCS else j
                alone = self.inverse_mass(i, j, b, ti.max(t, 0))
                depth = ti.max(depth, 0) + self.known.load.field[e] * self.h[None] ** 2 * alone
            if depth <= 0:
                usual *= 0
            elif usual == 0:
                usual = depth
            elif moved == 1:
                usual += ti.static(RATE) * (depth - usual)
            self.usual_depth.field[e] = usual

    @ti.func
    def keeps(self, i, j):
        """Whether particle i, of two particles that touch as discs, stores the contact as its vertex.

        Particles in no loop are never the start or end of an edge, so they store all of their contacts. Two particles in no loop
        both store the contact of the pair. The result then says which of the two entries counts.
        """
        return (i < j) if (self.after(i) < 0) == (self.after(j) < 0) else self.after(i) < 0

    @ti.func
    def roles(self, i):
        """Return how many of the roles VERTEX, START and END particle i may have in a contact."""
        return ti.select(self.after(i) < 0, 1, 3)

    @ti.func
    def find(self, v, a):
        """Return the offset of a in the list of v, or -1 (binary search)."""
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
                out = low - self.list.first[v]
        return out

    @ti.func
    def participants(self, i, e, role):
        """Return the contact in which particle i has a role, with the particle at entry e of its list.

        Returns the entry that stores the contact (-1 without one), its particles v, a, b, the place t on the edge, and the part
        of its correction that i gets: 1, -(1 - t) or -t. Two discs count as an edge that is touched at its start.
        """
        j = self.list.neighbour[e]
        at, v, a = e, i, j
        if role != VERTEX:
            back = self.back.field[e]
            v, a, at = j, i, ti.cast(back[0], ti.i32)
            if role == END:
                a, at = self.before(i), ti.cast(back[1], ti.i32)
            if at >= 0:
                at += self.list.first[j]
        b, t, part = a, 0 * self.w.of(i), 0 * self.w.of(i) + 1
        if at >= 0:
            t = self.manifold.field[at][1]
            if t > DISCS:
                b = self.after(a)
            elif role == END:
                at = -1
            t = ti.select(t > DISCS, t, 0)
            if b < 0:
                at = -1
            if role == START:
                part = t - 1
            elif role == END:
                part = -t
        return at, v, a, b, t, part

    @ti.func
    def relative(self, d: ti.template(), v, a, b, t):  # type: ignore[valid-type]
        """Return the displacement of v relative to the point t of the edge from a to b [m]."""
        return d[v] - (1 - t) * d[a] - t * d[b]

    @ti.func
    def near_contact(self, v, e, near):
        """Return the place of the contact of vertex v at entry e, by the last detect(), the normal, and the gap [m].

        A contact that does not overlap counts where v is in front of the edge, and nearer than the part `near` of its length;
        else its place is NONE.
        """
        a, found = self.list.neighbour[e], self.manifold.field[e]
        place, n, gap = found[1], ti.Vector([found[2], found[3]]), -found[0]
        if gap >= 0:
            place = 0 * gap + NONE
            if self.after(a) >= 0:
                u, r = self.state.separation(self.after(a), a), self.state.separation(v, a)
                uu = u.dot(u)
                if uu > 0:
                    length, t = ti.sqrt(uu), r.dot(u) / uu
                    n = ti.Vector([u[1], -u[0]]) / length
                    height = r.dot(n)
                    within = ti.min(ti.max(t, 0), 1)
                    gap = height - self.radius.of(v) - (1 - within) * self.radius.of(a) - within * self.radius.of(self.after(a))
                    if -SLACK <= t <= 1 + SLACK and gap >= 0 and gap < near * length and self.find(v, self.after(a)) >= 0:
                        place = within
        return place, n, gap

    @ti.func
    def ends(self, i, e, t):
        """Return the particles v, a, b of the contact of vertex i at entry e, with the place t on the edge."""
        a = self.list.neighbour[e]
        return i, a, ti.select(t > DISCS, self.after(a), a)

    @ti.func
    def entry_of(self, i, e, role):
        """Return the entry that stores the contact in which particle i has a role, with the particle at entry e, or -1."""
        at = -1
        if role < self.roles(i):
            at, _, _, _, _, _ = self.participants(i, e, role)
        return at

    @ti.func
    def part_of(self, t, role):
        """Return the part of a particle in a contact with the place t on the edge, by its role."""
        place = ti.max(t, 0)
        return ti.select(role == VERTEX, 1 + 0 * t, ti.select(role == START, place - 1, -place))

    @ti.func
    def add_push(self, e, push):
        """Add the push of an impact to those of the contact at entry e [kg m]."""
        self.impulse.field[e] = self.impulse.field[e] + push

    @ti.func
    def inverse_mass(self, v, a, b, t):
        """Return the inverse mass of a contact whose particles have no other contact."""
        return self.w.of(v) + (1 - t) * (1 - t) * self.w.of(a) + t * t * self.w.of(b)

    @ti.func
    def split_mass(self, split: ti.template(), v, a, b, t):  # type: ignore[valid-type]
        """Return the inverse mass of a contact whose particles' masses are split. split: how often, by particle."""
        return split[v] * self.w.of(v) + (1 - t) * split[a] * self.w.of(a) + t * split[b] * self.w.of(b)

    @ti.func
    def depth(self, at):
        """Return the depth of the contact at entry `at`, or how far it may be pushed out in this substep, if that is less [m]."""
        depth = self.manifold.field[at][0]
        if self.manifold.field[at][1] > DISCS:
            depth = ti.min(depth, self.push_limit.field[at])
        return depth

    @ti.func
    def share(self, depths: ti.template(), at, v, a, b, t):  # type: ignore[valid-type]
        """Return the overlap that a pass takes back of the contact at entry `at` [m], and the inverse mass by which it is split.

        depths: S_i = sum_k p_ki a_k over the contacts k of particle i, with its parts p_ki (1, 1 - t or t) and the usual depths
        a_k. (sum_k p_ki y_k)^2 <= S_i sum_k p_ki y_k^2 / a_k, so J w J^T <= diag(sum_i p_ki w_i S_i / a_k).

        With the depths C_k of this substep in place of a_k, pushes would go as C_k^2 / S_i. A particle squeezed from both sides,
        with the eigenvalue 1, would then have 2, and oscillate for ever. With a_k += RATE (C_k - a_k) it has
        z^2 + (3 RATE - 1) z = RATE, which is stable below 1/2; a lower RATE would take damping from slow modes.

        A contact that is pushed out at push_out goes at that speed whatever else its particles bear, p <= most / (inverse mass
        alone). Otherwise a load could hold a vertex inside for ever.
        """
        overlap, depth = self.manifold.field[at][0], self.depth(at)
        shared = self.split_mass(depths, v, a, b, t) / self.usual_depth.field[at]
        if depth < overlap:
            overlap = ti.min(overlap, depth * shared / self.inverse_mass(v, a, b, t))
        return overlap, shared

    @ti.func
    def too_long(self, i):
        """Return 1 if the edge that begins at particle i is too long for the list."""
        after, out = self.after(i), 0
        if after >= 0:
            u = self.state.separation(after, i)
            if u.dot(u) > self.longest[i] ** 2:
                out = 1
        return out

    @ti.func
    def overshoots(self, i):
        """Return 1 if particle i moves by more than a quarter of the shortest edge in one substep, or a disc by its size."""
        d, limit = self.state.d[i], ti.cast(self.step, self.real)
        if self.after(i) < 0:
            limit = ti.min(limit, self.radius.stride(i) if ti.static(self.radius.discs) else limit)
        return ti.select(d.dot(d) <= limit * limit, 0, 1)

    @ti.func
    def shrink(self, i, first, speed):
        """Allow particle i the overlap that it has as a vertex in contacts with particles of index `first` or more.

        Bodies then part at `speed` [m/s], or at push_out if that is less.
        """
        self.detect(i, 0)
        before = ti.select(first > 0, self.allowed[i], 0 * self.w.of(i))
        allowed = before
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j, found = self.list.neighbour[e], self.manifold.field[e]
            if ti.max(i, j) >= first and (found[1] > DISCS or self.keeps(i, j)):
                allowed = ti.max(allowed, found[0])
        self.allowed[i] = allowed
        if allowed > before:
            self.slower[i] = ti.max(self.push_out - speed, 0)
        elif allowed == 0:
            self.slower[i] = 0

    @ti.func
    def restore(self, i, h):
        """Reduce the allowed overlap of particle i after a substep h [s], at push_out or more slowly. Particle 0 stores h."""
        if i == 0:
            self.h[None] = h
        self.allowed[i] = ti.max(self.allowed[i] - (self.push_out - self.slower[i]) * h, 0)
        if self.allowed[i] == 0:
            self.slower[i] = 0

    @ti.func
    def is_shrunk(self, i):
        """Whether particle i is allowed to overlap."""
        return self.allowed[i] > 0

    @ti.func
    def forget(self, i):
        """Clear the contacts of which particle i is the vertex: it sleeps, and no listed particle moves."""
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            self.manifold.field[e] = ti.Vector([-1, 0, 0, 0], self.real)

    @ti.func
    def pressed_particle(self, j):
        """Return the particle that moves with disc j or the edge from j: j, or the other end if j cannot move."""
        out = j
        if not self.w.positive(j) and self.after(j) >= 0:
            out = self.after(j)
        return out

    @ti.func
    def is_unchanged(self, i, e):
        """Whether the contact of vertex i at entry e of its list is unchanged: i cannot move, and the other particle sleeps."""
        out = False
        if ti.static(bool(self.state.sleepers)):
            out = not self.w.positive(i) and not self.state.awake(self.pressed_particle(self.list.neighbour[e]))
        return out

    @ti.func
    def worst_overlap(self, i):
        """Return the number of contacts in which i is the vertex, or the first disc, and their worst overlap, for the report.

        The overlap is relative to half of the edge, or to the radius of the smaller disc.
        """
        touching, worst = 0, ti.cast(0, ti.f64)
        self.detect(i, 0)
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j, found = self.list.neighbour[e], self.manifold.field[e]
            if found[0] > 0 and (found[1] > DISCS or self.keeps(i, j)):
                size = ti.min(self.radius.of(i), self.radius.of(j))
                if found[1] > DISCS:
                    size = self.state.separation(self.after(j), j).norm() / 2
                elif size == 0:
                    size = ti.max(self.radius.of(i), self.radius.of(j))
                worst = ti.max(worst, found[0] / size)
                touching += 1
        return touching, worst

    def members(self, pairs: np.ndarray) -> np.ndarray:
        """Return the vertex and the ends of the edge of the contacts of these listed pairs (m, 2), (m, 3); discs twice."""
        after = self.outline.ends[pairs[:, 1], 0]
        return np.column_stack([pairs, np.where(after < 0, pairs[:, 1], after)])

    def gradients(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Return the gradients of C of these listed pairs (m, 2) at x (n, 2) [m], for each of members(), (m, 3, 2).

        Pairs of particles in no loop are listed for both, so only the first one has a gradient.
        """
        v, a, b = self.members(pairs).T
        r, u = x[v] - x[a], x[b] - x[a]
        uu = (u**2).sum(axis=1)
        t = np.divide((r * u).sum(axis=1), uu, out=np.full(len(uu), np.inf), where=uu > 0)
        disc = np.abs(t - 0.5) > 0.5 + SLACK
        n, t = np.where(disc[:, None], r, np.stack([u[:, 1], -u[:, 0]], axis=1)), np.where(disc, 0.0, np.clip(t, 0, 1))
        length = np.linalg.norm(n, axis=1)
        n *= np.divide(1, length, out=np.zeros_like(length), where=length > 0)[:, None]
        both = np.where((self.outline.ends[pairs, 0] < 0).all(axis=1), 0.0, 1.0)
        return np.stack([np.ones(len(t)), both * (t - 1), -t], axis=1)[:, :, None] * n[:, None]

    def candidates(self, x: np.ndarray) -> EdgeCandidates:
        """Return the listed pairs as possible contacts around positions x (n, 2) [m], for the host. detect() has run at x."""
        pairs, at = self.list.entries()
        lone, allowed = self.outline.ends[:, 0] < 0, self.scene.memory.read(self.allowed)
        both = lone[pairs].all(axis=1)
        who = np.where(both, pairs.min(axis=1), pairs[:, 0])
        found, pushed = self.list.read(self.manifold, at), self.list.read(self.impulse, at) > 0
        ends, body, _ = self.outline
        radius, allowed = self.scene.particles.radius, allowed.astype(np.float64)[who]
        return EdgeCandidates(x, pairs, found, DISCS, pushed, ends, body, radius, allowed)

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """Return the contacts of the last detect(): vertices and edges, and pairs of discs, also those pushed apart since."""
        r = self.scene.particles.radius
        pairs, at = self.list.entries()
        found, push = self.list.read(self.manifold, at), self.list.read(self.impulse, at)
        after = self.outline.ends[:, 0]
        some = ((found[:, 0] > 0) | (push > 0)) & ((after[pairs] >= 0).any(axis=1) | (pairs[:, 0] < pairs[:, 1]))
        pairs, found, push = pairs[some], found[some], push[some]
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
        return Contacts(pairs, ends, t, overlap, n, point, push / h)


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

    def __init__(self, geometry: PolygonGeometry, table: Table, skin: Number):
        self.table, self.skin = table, skin
        self.loop, self.longest, self.radius, self.state = geometry.loop, geometry.longest, geometry.radius, geometry.state

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
                u, size = self.state.separation(other, c), reach + ti.max(self.radius.of(c), self.radius.of(other))
                length = u.norm()
                t, height = r.dot(u), r.cross(u) * (1 - 2 * k)
                if height >= -(length / 2 + size) * length and height <= size * length:
                    ends = (BEYOND * length + size) * length
                    if t >= -ends and t <= length * length + ends:
                        out = True
        return out
