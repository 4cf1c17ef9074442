"""Bodies made of loops of particles that do not overlap (2D)."""

from collections.abc import Iterable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import taichi as ti

from .. import checks
from ..feature import Batch, Scene
from ..grid import Grid, Luggage
from ..material import Table
from ..particles import Particles, Radii
from .contact import Contact

SLACK = 1 / 512  # of an edge: as much further it goes at its ends, so that bodies of the same width stand on each other
CLOSE = 1e-4  # edges whose distances differ by less are equally near: the first of them counts
TINY = 1e-30
STRETCH = 1.25  # of an edge, beyond which a contact in its middle might not be listed
VERTEX, START, END = range(3)  # what a particle is in a contact with one that it is listed with


class Polygons(Contact):
    """Bodies made of particle loops do not overlap each other, nor other particles: vertex against edge, disc against disc (2D).

    C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) >= 0 for a vertex v and the edge from a to b of another
    body, where t is where v stands beside the edge and n the outward normal. Gradients: n, -(1 - t) n, -t n.

    loops: for each body its particles in order around it, at least 3, either way round. Their radii round the rim off. What holds
    a body together is up to others (Distance, Area, ShapeMatch); it may bend, and stretch by a quarter. friction, restitution: as
    in Contact, and so are all particles that are in no loop. push_out: about the speed at which bodies that overlap part [m/s].

    A Jacobi pass: each contact wants C back, split by mass and by the number n_i of active contacts of each particle,
    p = -C / (n_v w_v + (1 - t)^2 n_a w_a + t^2 n_b w_b). That conserves momentum, and angular momentum but for the slip within a
    substep; friction at a radius is a torque that nothing takes up. Corners that face each other touch as discs, by their radii.
    A vertex that is inside of another body goes out through the edge over which it came, or the nearest that faces its own body,
    if it is not deeper than half the length of that edge: in a substep nothing should get there, and the step flags
    "tunnelling-risk" where it might. Particles that start deeper are refused.

    Bodies that cross each other without a corner of one inside of the other are not seen. Walls act on particles: a sharp corner
    of a wall passes between two of them.
    """

    measures, calms = True, False
    room = 64  # the particles of near bodies
    _on_store: Any = None

    def __init__(self, loops: Iterable, friction=0.0, restitution=0.0, *, skin="auto", push_out=1.0):
        Contact.__init__(self, friction, restitution, skin=skin, push_out=push_out)
        self.loops = [checks.indices("Polygons", f"loops[{k}]", loop, 2**31 - 1) for k, loop in enumerate(loops)]
        seen: dict[int, int] = {}
        for k, loop in enumerate(self.loops):
            if len(loop) < 3:
                raise ValueError(f"Polygons: loops[{k}] has {len(loop)} particles, but a body needs at least 3.")
            for i in loop.tolist():
                if i in seen:
                    raise ValueError(f"Polygons: particle {i} is in loops[{seen[i]}] and again in loops[{k}]; once is enough.")
                seen[i] = k

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn all loops counterclockwise, and measure them; refuse flat ones, and particles deep inside of others."""
        if particles.dim != 2:
            raise ValueError("Polygons: bodies of particle loops are for 2D worlds; these particles are in 3D.")
        n, x = particles.count, particles.position
        self._on_ends = np.full((n, 2), -1)  # the next and the one before, in the loop
        self._on_body = np.full(n, -1)
        length = np.zeros(n)  # of the longer edge
        for k, loop in enumerate(self.loops):
            checks.indices("Polygons", f"loops[{k}]", loop, n)
            area = _area(x[loop])
            extent = float(np.ptp(x[loop], axis=0).max())
            if abs(area) <= 1e-9 * extent**2:
                raise ValueError(f"Polygons: loops[{k}] encloses an area of {area:g} m^2; its particles are on a line.")
            loop = loop if area > 0 else loop[::-1]
            after = np.roll(loop, -1)
            edge = np.linalg.norm(x[after] - x[loop], axis=1)
            if (edge <= 1e-6 * extent).any():
                m = int(np.argmin(edge))
                raise ValueError(f"Polygons: particles {loop[m]} and {after[m]} of loops[{k}] are in the same place.")
            self._on_ends[loop, 0], self._on_ends[after, 1], self._on_body[loop] = after, loop, k
            length[loop] = np.maximum(length[loop], edge)
            length[after] = np.maximum(length[after], edge)
        self._check_start(particles)
        # Two particles are listed when their reaches add up: a vertex with both ends of an edge that it is beside.
        self._on_length = length
        far = 1.5 * STRETCH * length
        share = float(np.median(far[far > 0])) / 2 if self.loops else 0.0
        self._on_cover = particles.radius + np.maximum(share, far - share)
        loops = self._on_body >= 0
        self._on_reach = float(length[loops].min(initial=np.inf)) / 4
        self._on_size = 0.15 * float(np.median(self._on_cover)) if self.skin == "auto" else float(self.skin)
        self._on_finest = float(self._on_cover.min(initial=np.inf))
        self.matters = n > 0 and bool(self.loops or (particles.radius > 0).any())
        if self.matters:
            self.check_range(x)

    def _check_start(self, particles: Particles) -> None:
        """Refuse particles that start deeper inside of a body than half of the edge that is nearest."""
        x = particles.position
        for k, loop in enumerate(self.loops):
            a = x[loop]
            some = ((x >= a.min(axis=0)) & (x <= a.max(axis=0))).all(axis=1) & (self._on_body != k)
            for i in np.flatnonzero(some):
                depth, edge = _depth(x[i], a)
                if depth > edge / 2:
                    raise ValueError(
                        f"Polygons: particle {i} starts {depth:.3g} m inside of loops[{k}], deeper than half of the nearest edge "
                        f"({edge:.3g} m), so there is no telling where it came from. Move it out."
                    )

    def join(self, scene: Scene, batches: list[Batch], parallel: bool) -> Grid:
        """Declare the fields, among them the grid's, which lists particles by their reach."""
        n, p, add = scene.particles.count, scene.particles, scene.memory.field
        self.scene, self._on_state, self._on_radius, self._on_w = scene, scene.state, scene.radius, scene.state.w
        self._on_rubs, self._on_bounces = self.rubs, self.bounces
        self._on_eases = True
        self._on_move = add("Contact.move", n, width=2)
        self._on_active = add("Contact.active", n, kind=ti.i32)
        self._on_fast = add("Contact.fast", None, kind=ti.i32)
        if self.bounces:
            self._on_struck = add("Contact.struck", n, kind=ti.i32)
            self._on_kick = add("Contact.kick", n, width=2)
            self._on_lift = add("Contact.lift", n, width=2)
            self._on_hit = add("Contact.hit", None, kind=ti.i32)
        self._on_loop = add("Polygons.loop", n, width=3, kind=ti.i32, values=np.c_[self._on_ends, self._on_body])
        self._on_limit = add("Polygons.longest_edge", n, values=STRETCH * self._on_length)
        self._on_less = add("Polygons.allowed", n, state=True)
        self._on_h = add("Polygons.substep", None)
        self.table.bind(scene)
        cover: Any = SimpleNamespace(count=n, dim=2, position=p.position, radius=self._on_cover, group=p.group)
        reach = replace(scene, particles=cover, radius=Radii(scene.memory, self._on_cover))
        pairs = [f.partners(p) for f in batches]
        linked = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int32)
        # For each entry the contact of which its particle is the vertex: overlap, place on the edge (-1: discs), normal; where
        # in the list of the other particle those are in which it is the start, and the end, of the edge (-1: nowhere).
        self._on_met, self._on_back = Luggage("met", 4, lasting=False), Luggage("back", 2, lasting=False)
        self._on_slip, self._on_aim = Luggage("slip", 2, lasting=True), Luggage("aim", 2, lasting=False)
        luggage = [
            self._on_met,
            self._on_back,
            *([self._on_slip] if self.rubs else []),
            *([self._on_aim] if self.bounces else []),
        ]
        apart: Any = _Apart(self)
        self._on_grid = Grid(reach, self._on_size, linked, apart, luggage, parallel)
        return self._on_grid

    def ease(self) -> None:
        """The field is there from the start."""

    @ti.func
    def shrink(self, i):
        """Allow particle i the overlap that it has as a vertex."""
        self.look(i, False)
        less = 0 * self._on_w[i]
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            less = ti.max(less, self._on_met.field[e][0])
        self._on_less[i] = less

    @ti.func
    def grow(self, i, h):
        """Allow particle i less, and keep the length of the substep at hand."""
        if i == 0:
            self._on_h[None] = h
        self._on_less[i] = ti.max(self._on_less[i] - self.push_out * h / 2, 0)

    @ti.func
    def watch(self, i):
        """Notice particles that outrun the list or a quarter of an edge in one substep, and edges that are too long for it."""
        self._on_grid.watch(i)
        d, limit = self._on_state.d[i], ti.cast(self._on_reach, self.scene.real)
        after = self.after(i)
        if after >= 0:
            u = self._on_state.apart(after, i)
            if u.dot(u) > self._on_limit[i] ** 2:
                self._on_fast[None] = 1
        else:
            limit = ti.min(limit, self._on_radius.stride(i) if ti.static(self._on_radius.least > 0) else limit)
        if not (d.dot(d) <= limit * limit):
            self._on_fast[None] = 1

    @ti.func
    def after(self, i):
        """The next particle around the body of particle i; -1 if it has none."""
        return self._on_loop[i][0]

    @ti.func
    def before(self, i):
        """The one before."""
        return self._on_loop[i][1]

    @ti.func
    def corner(self, v, a):
        """1 if v is in front of the corner a, beside none of its edges; -1 if it is behind an inner one; 0 if beside an edge.

        A particle without edges is a corner all around.
        """
        out = 1
        if self.after(a) >= 0:
            r, u, w = self._on_state.apart(v, a), self._on_state.apart(self.after(a), a), self._on_state.apart(self.before(a), a)
            if r.dot(u) > 0 or r.dot(w) > 0:
                out = 0
            elif u.cross(w) < 0:
                out = -1
        return out

    @ti.func
    def edge(self, v, a, front, eased: ti.template()):  # type: ignore[valid-type]
        """How far v overlaps the edge from a to the next, negative where it does not, the normal, and where on the edge.

        What was in front at the start of the substep came in over this edge if it crossed it between its ends. What was behind
        already goes out over the nearest one that faces its own body, at push_out.
        """
        b = self.after(a)
        r, u = self._on_state.apart(v, a), self._on_state.apart(b, a)
        uu, t = u.dot(u), 0 * r[0]
        overlap, n = t - 1, 0 * r
        if uu > 0:
            length = ti.sqrt(uu)
            t, n = r.dot(u) / uu, ti.Vector([u[1], -u[0]]) / length
            height, cross, came, shared = r.dot(n), t, True, a
            if height < 0:
                d = self._on_state.d[a]
                r0, u0 = r - (self._on_state.d[v] - d), u - (self._on_state.d[b] - d)
                height0, t0 = r0.dot(ti.Vector([u0[1], -u0[0]])) / length, r0.dot(u0) / ti.max(u0.dot(u0), uu * SLACK)
                came = height0 >= -SLACK * length
                if height0 > 0:
                    cross = t0 + height0 / (height0 - height) * (t - t0)
            beside = -SLACK <= cross <= 1 + SLACK
            if not came and t < 0:
                beside = front < 0
                if beside:  # the nearest way out is over an inner corner
                    height, shared = -r.norm(), self.before(a)
                    n = r / ti.min(height, -uu * TINY)
            t = ti.min(ti.max(t, 0), 1)
            far = self._on_radius.of(v) + (1 - t) * self._on_radius.of(a) + t * self._on_radius.of(b)
            if beside and height < far and height >= -length / 2:
                out = far - height
                if not came:
                    back = self.inward(v)
                    came = back.dot(n) >= 0 and self.nearest(v, a, shared, height, back)
                    if ti.static(eased):
                        out = ti.min(out, self.push_out * self._on_h[None] - self.relative(v, a, b, t).dot(n))
                if came:
                    overlap = out
        return overlap, n, t

    @ti.func
    def inward(self, v):
        """The way from an outer corner v into its own body; 0 where there is none."""
        out = 0 * self._on_state.x[v]
        if self.after(v) >= 0:
            u, w = self._on_state.apart(self.after(v), v), self._on_state.apart(self.before(v), v)
            if u.cross(w) > 0:
                out = u * w.norm() + w * u.norm()
        return out

    @ti.func
    def nearest(self, v, a, shared, height, back):
        """Whether no edge of the body of a but those from a and `shared` is nearer to v, which is at `height` below 0 over them.

        Edges that face away from the body of v, which lies in the direction `back`, are no way out for it.
        """
        out = True
        for e in range(self._on_grid.first[v], self._on_grid.first[v] + self._on_grid.number[v]):
            j = self._on_grid.near[e]
            if j != a and j != shared and self._on_loop[j][2] == self._on_loop[a][2]:
                r, u = self._on_state.apart(v, j), self._on_state.apart(self.after(j), j)
                uu, faces = u.dot(u), u[1] * back[0] - u[0] * back[1] >= 0
                if uu > 0:
                    r -= ti.min(ti.max(r.dot(u) / uu, 0), 1) * u
                rest = -height - r.norm()
                if faces and (rest > -CLOSE * height or (rest >= CLOSE * height and j < a)):
                    out = False
        return out

    @ti.func
    def measure(self, i):
        """Find the contacts that particle i is the vertex of, or the first of two discs: at most one with each near particle."""
        self.look(i, True)

    @ti.func
    def look(self, i, eased: ti.template()):  # type: ignore[valid-type]
        """As measure(), with or without the overlap that is allowed."""
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j = self._on_grid.near[e]
            overlap, n, t = 0 * self._on_w[i] - 1, 0 * self._on_state.x[i], 0 * self._on_w[i]
            front = self.corner(i, j)
            if self.after(j) >= 0:
                overlap, n, t = self.edge(i, j, front, eased)
            if overlap <= 0 and i < j and front > 0:
                overlap, n = self.touch(i, j, self._on_radius.of(i) + self._on_radius.of(j))
                if overlap > 0:
                    t = 0 * t - 1
                    if self.corner(j, i) <= 0:
                        overlap = -overlap
            if ti.static(eased):
                overlap -= self._on_less[i]
            self._on_met.field[e] = ti.Vector([overlap, t, n[0], n[1]])
            back = ti.Vector([self.find(j, i), -1])
            if self.before(i) >= 0:
                back[1] = self.find(j, self.before(i))
            self._on_back.field[e] = ti.cast(back, self.scene.real)

    @ti.func
    def find(self, v, a):
        """Where a is in the list of v, counted from its begin; -1 if it is not."""
        low, end = self._on_grid.first[v], self._on_grid.first[v] + self._on_grid.number[v]
        high = end
        while low < high:
            middle = (low + high) // 2
            if self._on_grid.near[middle] < a:
                low = middle + 1
            else:
                high = middle
        out = -1
        if low < end:
            if self._on_grid.near[low] == a:
                out = low - self._on_grid.first[v]
        return out

    @ti.func
    def meeting(self, i, e, role):
        """The contact in which particle i, with the one at entry e of its list, is in a role.

        Returns the entry that keeps it (-1: there is none), its particles v, a, b, where on the edge, and the part of its move
        that is that of i: 1, -(1 - t) or -t. Two discs are an edge of which only the start is touched.
        """
        j = self._on_grid.near[e]
        at, v, a = e, i, j
        if role != VERTEX:
            back = self._on_back.field[e]
            v, a, at = j, i, ti.cast(back[0], ti.i32)
            if role == END:
                a, at = self.before(i), ti.cast(back[1], ti.i32)
            if at >= 0:
                at += self._on_grid.first[j]
        b, t, part = a, 0 * self._on_w[i], 0 * self._on_w[i] + 1
        if at >= 0:
            t = self._on_met.field[at][1]
            if t >= 0:
                b = self.after(a)
            elif role == END:
                at = -1
            t = ti.max(t, 0)
            if b < 0:
                at = -1
            if role == START:
                part = t - 1
            elif role == END:
                part = -t
        return at, v, a, b, t, part

    @ti.func
    def relative(self, v, a, b, t):
        """The displacement of v relative to the point t of the edge from a to b."""
        return self._on_state.d[v] - (1 - t) * self._on_state.d[a] - t * self._on_state.d[b]

    @ti.func
    def split(self, count: ti.template(), v, a, b, t):  # type: ignore[valid-type]
        """The mass-split weight of a contact."""
        at_a, at_b = (1 - t) * (1 - t) * count[a] * self._on_w[a], t * t * count[b] * self._on_w[b]
        return count[v] * self._on_w[v] + at_a + at_b

    @ti.func
    def count(self, i, first):
        """How many contacts particle i is in."""
        active = 0
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            for role in range(3):
                at, _, _, _, _, _ = self.meeting(i, e, role)
                if at >= 0:
                    if self._on_met.field[at][0] > 0:
                        active += 1
        self._on_active[i] = active

    @ti.func
    def relax(self, i, first, fresh):
        """What the contacts of particle i want of it."""
        total, lifts = 0 * self._on_state.x[i], 0 * self._on_state.x[i]
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            if ti.static(self._on_bounces):
                if first != 0:
                    self._on_aim.field[e] = 0 * self._on_aim.field[e]
            for role in range(3):
                at, v, a, b, t, part = self.meeting(i, e, role)
                if at >= 0:
                    met = self._on_met.field[at]
                    overlap, n = met[0], ti.Vector([met[2], met[3]])
                    if overlap > 0:
                        d = self.relative(v, a, b, t)
                        share, kick = part * self._on_w[i] / self.split(self._on_active, v, a, b, t), 0 * overlap
                        if ti.static(self._on_bounces):
                            if first != 0:
                                aim, kick, lift = self.leap(v, a, b, t, n, overlap, d.dot(n))
                                lifts += share * lift * n
                                if kick > 0:
                                    self._on_hit[None] = 1
                                    if role == VERTEX:
                                        self._on_aim.field[e] = aim * n
                        want = overlap * n
                        if ti.static(self._on_rubs):
                            want -= self.held(v, a, n, overlap + kick, self._on_slip.field[at] + d)
                        total += share * want
        self._on_move[i] = total
        if ti.static(self._on_bounces):
            if first != 0:
                self._on_lift[i] = lifts
                self._on_struck[i] = self._on_active[i]

    @ti.func
    def gather(self, i, last):
        """Move particle i as its contacts want; what bounced rises at the end of the substep."""
        if self._on_w[i] > 0:
            if self._on_active[i] > 0:
                self._on_state.shift(i, self._on_move[i])
            if ti.static(self._on_bounces):
                if last != 0:
                    self._on_state.advance(i, self._on_lift[i])

    @ti.func
    def leap(self, v, a, b, t, n, overlap, leaving):
        """Contact.bounce, for a vertex and an edge."""
        before = self._on_state.before[v] - (1 - t) * self._on_state.before[a] - t * self._on_state.before[b]
        approach, restitution = -before.dot(n), self.table.of(v, a)[2]
        aim, kick, lift = restitution * ti.max(approach, 0), 0 * overlap, 0 * overlap
        if approach > 0:
            kick = ti.max(aim - (overlap + leaving), 0)
            if overlap <= -leaving:
                lift = restitution * overlap
        return aim, kick, lift

    @ti.func
    def held(self, v, a, n, normal, slip):
        """The part of a slip that friction takes back for a normal displacement."""
        s, row = slip - slip.dot(n) * n, self.table.of(v, a)
        size = s.norm()
        if size > row[0] * normal:
            s *= row[1] * normal / size
        return s

    @ti.func
    def rebound(self, i):
        """One Jacobi pass over displacements alone: what the contacts of particle i that bounce lack."""
        total = 0 * self._on_state.x[i]
        if self._on_struck[i] > 0:
            for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
                for role in range(3):
                    at, v, a, b, t, part = self.meeting(i, e, role)
                    if at >= 0:
                        aim = self._on_aim.field[at]
                        size = aim.norm()
                        if size > 0:
                            n = aim / size
                            lack = size - self.relative(v, a, b, t).dot(n)
                            if lack > 0:
                                total += part * self._on_w[i] * lack / self.split(self._on_struck, v, a, b, t) * n
        self._on_kick[i] = total

    @ti.func
    def remember(self, i):
        """At the end of a substep: add to the slip of each contact what it has moved, as far as friction can hold it."""
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            slip = 0 * self._on_state.x[i]
            at, v, a, b, t, _ = self.meeting(i, e, VERTEX)
            if at >= 0:
                met = self._on_met.field[at]
                if met[0] > 0:
                    n = ti.Vector([met[2], met[3]])
                    slip = self.held(v, a, n, met[0], self._on_slip.field[e] + self.relative(v, a, b, t))
            self._on_slip.field[e] = slip

    @ti.func
    def overlaps(self, i):
        """For the report: contacts that particle i is the vertex of, or the first disc, and the worst overlap.

        It is relative to half of the edge, or to the radius of the smaller disc.
        """
        touching, worst = 0, ti.cast(0, ti.f64)
        self.look(i, False)
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j, met = self._on_grid.near[e], self._on_met.field[e]
            if met[0] > 0:
                size = ti.min(self._on_radius.of(i), self._on_radius.of(j))
                if met[1] >= 0:
                    size = self._on_state.apart(self.after(j), j).norm() / 2
                elif size == 0:
                    size = ti.max(self._on_radius.of(i), self._on_radius.of(j))
                worst = ti.max(worst, met[0] / size)
                touching += 1
        return touching, worst


class _Apart:
    """What the grid asks which pairs may touch: those of different bodies, as far as their groups do."""

    uniform = False

    def __init__(self, polygons: Polygons):
        self.table: Table = polygons.table
        self.loop = polygons._on_loop

    @ti.func
    def of(self, i, j):
        """The row of the table, with 0 at its end for two particles of one body."""
        row = self.table.of(i, j)
        if self.loop[i][2] >= 0 and self.loop[i][2] == self.loop[j][2]:
            row[3] = 0
        return row


def _area(loop: np.ndarray) -> float:
    after = np.roll(loop, -1, axis=0)
    v = loop - loop.mean(axis=0)
    w = after - loop.mean(axis=0)
    return float((v[:, 0] * w[:, 1] - v[:, 1] * w[:, 0]).sum()) / 2


def _depth(point: np.ndarray, loop: np.ndarray) -> tuple[float, float]:
    """How deep a point is inside of a loop, 0 outside, and the length of the nearest edge."""
    a, b = loop, np.roll(loop, -1, axis=0)
    u, r = b - a, point - a
    length = np.linalg.norm(u, axis=1)
    t = np.clip((r * u).sum(axis=1) / length**2, 0, 1)
    distance = np.linalg.norm(r - t[:, None] * u, axis=1)
    k = int(np.argmin(distance))
    above = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        right = a[:, 0] + r[:, 1] / u[:, 1] * u[:, 0] > point[0]
    return (float(distance[k]) if (above & right).sum() % 2 else 0.0), float(length[k])
