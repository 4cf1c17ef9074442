"""Bodies made of loops of particles that do not overlap (2D)."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ..device import ti
from ..device.thread_team import Team
from ..features.feature import Batch, Scene
from ..neighbours.neighbour_list import Luggage
from ..neighbours.neighbour_search import Grid
from ..particles import Particles
from ..tools import median
from .contact import Contact
from .loops import checked, laid, refuse_deep
from .polygon_narrow_phase import DISCS, REACH, VERTEX, Apart, Rim

STRETCH = 1.25  # of an edge, beyond which a contact in its middle might not be listed
SKIN = 0.15  # of the longer edge of a vertex


class Polygons(Rim):
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

    Two sharp corners may pass each other, so that neither is inside of the other body but their edges cross. They part over that
    of their edges which is nearer, C as above with t beyond the end of the edge. Other bodies that cross each other without a
    corner of one inside of the other, such as two bars, are not seen. Walls act on particles: a sharp corner of a wall passes
    between two of them.
    """

    measures, calms = True, False
    room = 64  # the particles of near bodies
    groups: Any = None  # all touch

    def __init__(self, loops: Iterable, friction=0.0, restitution=0.0, *, skin="auto", push_out=1.0):
        Contact.__init__(self, friction, restitution, skin=skin, push_out=push_out)
        self.loops = checked(loops)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn all loops counterclockwise, and measure them; refuse flat ones, and particles deep inside of others."""
        if particles.dim != 2:
            raise ValueError("Polygons: bodies of particle loops are for 2D worlds; these particles are in 3D.")
        n, x = particles.count, particles.position
        self.dev.ends, self.dev.body, length = laid(self.loops, x)
        refuse_deep(self.loops, self.dev.body, x, 0)
        # A vertex is listed with both ends of an edge that it is beside, or a quarter of it beyond, and behind by half of it.
        self.dev.length, self.dev.reach = length, REACH * STRETCH * length
        loops = self.dev.body >= 0
        self.dev.step = float(length[loops].min(initial=np.inf)) / 4
        sizes = np.where(loops, SKIN * length, 0.75 * particles.radius)
        auto = median(sizes[sizes > 0]) if (sizes > 0).any() else 1.0
        self.dev.size = auto if self.skin == "auto" else float(self.skin)
        self.dev.finest = float((particles.radius + self.dev.reach / 2).min(initial=np.inf))
        matters = n > 0 and bool(self.loops or (particles.radius > 0).any())
        self._keep(matters=matters, table=self.wanted)
        if self.matters:
            self.check_range(x)

    def admit(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out, or inside of bodies."""
        super().admit(particles, first)
        refuse_deep(self.loops, self.dev.body, particles.position, first)

    def renumber(self, number: np.ndarray, count: int) -> None:
        """Bodies stay as long as all of their particles do."""
        whole = [loop for loop in self.loops if (number[loop] >= 0).all()]
        self._keep(loops=[number[loop].astype(np.int32) for loop in whole])
        self.arguments = {**self.arguments, "loops": self.loops}

    def join(self, scene: Scene, batches: list[Batch], team: Team) -> Grid:
        """Declare the fields, among them the grid's, which lists particles by their reach."""
        n, add = scene.particles.count, scene.memory.field
        self.scene, self.dev.state, self.dev.radius, self.dev.w = scene, scene.state, scene.radius, scene.state.w
        self.dev.rubs, self.dev.bounces = self.rubs, self.bounces
        self.dev.eases, self.dev.store, self.dev.skips = True, None, False
        self.dev.move = add("Contact.move", n, width=2)
        self.dev.active = add("Contact.active", n, kind=ti.i32)
        self.dev.bond = add("Contact.bond", n, width=2, state=True)
        self.dev.before = add("Contact.before", n, width=2)
        self.dev.fast = add("Contact.fast", None, kind=ti.i32)
        if self.bounces:
            self.dev.struck = add("Contact.struck", n, kind=ti.i32)
            self.dev.kick = add("Contact.kick", n, width=2)
            self.dev.lift = add("Contact.lift", n, width=2)
            self.dev.hit = add("Contact.hit", None, kind=ti.i32)
        self.dev.loop = add("Polygons.loop", n, width=3, kind=ti.i32, values=np.c_[self.dev.ends, self.dev.body])
        self.dev.limit = add("Polygons.longest_edge", n, values=STRETCH * self.dev.length)
        self.dev.less = add("Polygons.allowed", n, state=True)
        self.dev.h = add("Polygons.substep", None)
        self.table.bind(scene, asked=True)
        pairs = [f.partners(f.start) for f in batches]
        linked = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int32)
        # For each entry the contact of which its particle is the vertex: overlap, place on the edge (-1: discs), normal; where
        # in the list of the other particle those are in which it is the start, and the end, of the edge (-1: nowhere).
        self.dev.met, self.dev.back = Luggage("met", 4, False, kept=False), Luggage("back", 2, False, kept=False)
        self.dev.slip, self.dev.aim = Luggage("slip", 2, lasting=True), Luggage("aim", 2, lasting=False)
        self.dev.given = Luggage("given", 0, lasting=True)  # pushes and blows in the last substep [kg m]
        luggage = [self.dev.met, self.dev.back, self.dev.given, *([self.dev.slip] if self.rubs else [])]
        luggage += [self.dev.aim] if self.bounces else []
        apart: Any = Apart(self)
        self.dev.grid = Grid(scene, self.dev.size, linked, apart, luggage, team, self.dev.move, self.dev.reach)
        return self.dev.grid

    def ease(self) -> None:
        """The field is there from the start."""

    @ti.func
    def shrink(self, i, first):
        """Allow particle i the overlap that it has as a vertex, as far as particles from number `first` on have to do with it."""
        self.look(i, False)
        less = ti.select(first > 0, self.dev.less[i], 0 * self.dev.w.of(i))
        for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
            j, met = self.dev.grid.near[e], self.dev.met.field[e]
            if ti.max(i, j) >= first and (met[1] > DISCS or self.tells(i, j)):
                less = ti.max(less, met[0])
        self.dev.less[i] = less

    @ti.func
    def grow(self, i, h):
        """Allow particle i less, and keep the length of the substep at hand."""
        if i == 0:
            self.dev.h[None] = h
        self.dev.less[i] = ti.max(self.dev.less[i] - self.push_out * h, 0)

    @ti.func
    def overshoots(self, i):
        """1 if particle i crosses a quarter of an edge in one substep."""
        d, limit = self.dev.state.d[i], ti.cast(self.dev.step, self.scene.real)
        if self.after(i) < 0:
            limit = ti.min(limit, self.dev.radius.stride(i) if ti.static(self.dev.radius.least > 0) else limit)
        return ti.select(d.dot(d) <= limit * limit, 0, 1)

    @ti.func
    def measure(self, i, first):
        """Find the contacts of particle i, see look(), and note an edge that is too long for the list."""
        if first != 0:
            for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                self.dev.given.field[e] = 0
                if ti.static(self.dev.bounces):
                    self.dev.aim.field[e] = 0 * self.dev.aim.field[e]
        self.dev.active[i] = self.look(i, True)
        after = self.after(i)
        if after >= 0:
            u = self.dev.state.apart(after, i)
            if u.dot(u) > self.dev.limit[i] ** 2:
                self.heed(0, 1)

    @ti.func
    def split(self, count: ti.template(), v, a, b, t):  # type: ignore[valid-type]
        """The mass-split weight of a contact."""
        at_a, at_b = (1 - t) * (1 - t) * count[a] * self.dev.w.of(a), t * t * count[b] * self.dev.w.of(b)
        return count[v] * self.dev.w.of(v) + at_a + at_b

    @ti.func
    def alone(self, v, a, b, t):
        """The weight of a contact that is the only one."""
        return self.dev.w.of(v) + (1 - t) * (1 - t) * self.dev.w.of(a) + t * t * self.dev.w.of(b)

    @ti.func
    def count(self, begin, end):
        """How many contacts some particles are in. What is in no loop knows them from look()."""
        for i in range(begin, end):
            if self.after(i) >= 0:
                active = 0
                for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                    for role in range(3):
                        at, _, _, _, _, _ = self.meeting(i, e, role)
                        if at >= 0:
                            if self.dev.met.field[at][0] > 0:
                                active += 1
                self.dev.active[i] = active

    @ti.func
    def relax(self, i, first, fresh, final):
        """What the contacts of particle i want of it."""
        total, lifts, bond = 0 * self.dev.state.x[i], 0 * self.dev.state.x[i], 0 * self.dev.state.x[i]
        begin, roles = self.dev.grid.first[i], self.roles(i)
        for e in range(begin, begin + ti.select(self.dev.active[i] > 0, self.dev.grid.number[i], 0)):
            for role in range(roles):
                at, v, a, b, t, part = self.meeting(i, e, role)
                if at >= 0:
                    met = self.dev.met.field[at]
                    overlap, n = met[0], ti.Vector([met[2], met[3]])
                    if overlap > 0:
                        d, shared = self.relative(self.dev.state.d, v, a, b, t), self.split(self.dev.active, v, a, b, t)
                        share, kick = part * self.dev.w.of(i) / shared, 0 * overlap
                        back = overlap  # what is taken back of the position and of the displacement
                        if ti.static(self.dev.bounces):
                            if first != 0:
                                aim, kick, lift = self.leap(v, a, b, t, n, overlap, d.dot(n))
                                if kick > 0:
                                    lifts += share * (overlap + lift) * n
                                    back = 0 * overlap
                                    self.dev.hit[None] = 1
                                    if role == VERTEX:
                                        self.dev.aim.field[e] = aim * n
                        if role == VERTEX:
                            self.dev.given.field[e] = self.dev.given.field[e] + back / shared
                        want = back * n
                        if ti.static(self.dev.rubs):
                            want -= self.held(v, a, n, overlap + kick, self.dev.slip.field[at] + d)
                        total += share * want
                        if final != 0:
                            came = -self.relative(self.dev.before, v, a, b, t).dot(n)
                            bond += self.steady(came, overlap * self.alone(v, a, b, t) / shared) * share * want
        self.dev.move[i] = total
        if final != 0:
            self.sum_up(i, bond, first)
        if ti.static(self.dev.bounces):
            if first != 0:
                self.dev.lift[i] = lifts
                self.dev.struck[i] = self.dev.active[i]

    @ti.func
    def push_bond(self, i):
        """Nothing is left for the end of a frame: all of it is known from the passes."""

    @ti.func
    def bond(self, i):
        """Pushes, and friction."""
        return self.dev.bond[i]

    @ti.func
    def gather(self, i, first):
        """Move particle i as its contacts want; what bounced goes where it is at the end of the substep."""
        if self.dev.w.of(i) > 0:
            if self.dev.active[i] > 0:
                self.dev.state.shift(i, self.dev.move[i])
            if ti.static(self.dev.bounces):
                if first != 0:
                    self.dev.state.advance(i, self.dev.lift[i])

    @ti.func
    def leap(self, v, a, b, t, n, overlap, leaving):
        """Contact.bounce, for a vertex and an edge."""
        before = self.dev.state.before[v] - (1 - t) * self.dev.state.before[a] - t * self.dev.state.before[b]
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
        total = 0 * self.dev.state.x[i]
        if self.dev.struck[i] > 0:
            for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                for role in range(self.roles(i)):
                    at, v, a, b, t, part = self.meeting(i, e, role)
                    if at >= 0:
                        aim = self.dev.aim.field[at]
                        size = aim.norm()
                        if size > 0:
                            n = aim / size
                            lack = size - self.relative(self.dev.state.d, v, a, b, t).dot(n)
                            if lack > 0:
                                shared = self.split(self.dev.struck, v, a, b, t)
                                self.dev.hit[None] = 1
                                total += part * self.dev.w.of(i) * lack / shared * n
                                if role == VERTEX:
                                    self.dev.given.field[e] = self.dev.given.field[e] + lack / shared
        self.dev.kick[i] = total

    @ti.func
    def part_ways(self, i):
        """Change the displacement of particle i, and the one before the substep with it."""
        self.dev.state.d[i] = self.dev.state.d[i] + self.dev.kick[i]
        self.dev.state.before[i] = self.dev.state.before[i] + self.dev.kick[i]

    @ti.func
    def remember(self, i):
        """At the end of a substep: add to the slip of each contact what it has moved, as far as friction can hold it."""
        if ti.static(self.dev.rubs):
            for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                slip = 0 * self.dev.state.x[i]
                at, v, a, b, t, _ = self.meeting(i, e, VERTEX)
                if at >= 0:
                    met = self.dev.met.field[at]
                    if met[0] > 0:
                        n = ti.Vector([met[2], met[3]])
                        slip = self.held(v, a, n, met[0], self.dev.slip.field[e] + self.relative(self.dev.state.d, v, a, b, t))
                self.dev.slip.field[e] = slip

    @ti.func
    def overlaps(self, i):
        """For the report: contacts that particle i is the vertex of, or the first disc, and the worst overlap.

        It is relative to half of the edge, or to the radius of the smaller disc.
        """
        touching, worst = 0, ti.cast(0, ti.f64)
        self.look(i, False)
        for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
            j, met = self.dev.grid.near[e], self.dev.met.field[e]
            if met[0] > 0 and (met[1] > DISCS or self.tells(i, j)):
                size = ti.min(self.dev.radius.of(i), self.dev.radius.of(j))
                if met[1] > DISCS:
                    size = self.dev.state.apart(self.after(j), j).norm() / 2
                elif size == 0:
                    size = ti.max(self.dev.radius.of(i), self.dev.radius.of(j))
                worst = ti.max(worst, met[0] / size)
                touching += 1
        return touching, worst
