"""Bodies made of loops of particles that do not overlap (2D)."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..device import ti
from ..device.thread_team import Team
from ..features.extending import extended
from ..features.feature import Batch, Feature, Scene
from ..features.material import Table
from ..features.regrouping import Regrouping
from ..geometry.ordered import median
from ..neighbours.neighbour_list import PairData
from ..neighbours.neighbour_search import NeighbourSearch
from ..particles import Particles
from .exclusions import excluded_pairs
from .force_share import ForceShare
from .loops import checked, flat, laid, refuse_deep
from .pair_contact import PairContact
from .polygon_narrow_phase import VERTEX, Beside, Outline, PolygonGeometry
from .restitution import SLOW, under_force

SKIN = 0.15  # of the longer edge of a vertex


class Polygons(PairContact):
    """Bodies made of particle loops do not overlap each other, nor other particles: vertex against edge, disc against disc (2D).

    C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) >= 0 for a vertex v and the edge from a to b of another
    body, where t is where v stands beside the edge and n the outward normal. Gradients: n, -(1 - t) n, -t n.

    loops: for each body its particles in order around it, at least 3, either way round. Their radii round the rim off. What holds
    a body together is up to others (Distance, Area, ShapeMatch); it may bend, and stretch by a quarter. friction, restitution: as
    in Contact, and so are all particles that are in no loop. push_out: about the speed at which bodies that overlap part [m/s].

    A Jacobi pass: each contact wants C back, split by mass, p = -C / (m_v w_v + (1 - t) m_a w_a + t m_b w_b), with m_i = S_i / a,
    where a is how deep the contact has been in the last few substeps, and S_i the same of all contacts of particle i, each times
    the part, 1, 1 - t or t, that i has in it. By Cauchy's inequality no eigenvalue of a pass exceeds 1. A contact that is hardly
    deep takes hardly a part of the mass: by the number of contacts, one that opens and closes would change how stiff those beside
    it are, and heaps would never rest. That conserves momentum, and angular momentum but for the slip within a substep; friction
    at a radius is a torque that nothing takes up. Corners that face each other touch as discs, by their radii. A vertex that is
    inside of another body goes out through the edge over which it came, or the nearest that faces its own body, if it is not
    deeper than half the length of that edge: in a substep nothing should get there, and the step flags "tunnelling-risk" where it
    might. Particles that start deeper are refused.

    Two sharp corners may pass each other, so that neither is inside of the other body but their edges cross. They part over that
    of their edges which is nearer, C as above with t beyond the end of the edge. Other bodies that cross each other without a
    corner of one inside of the other, such as two bars, are not seen. Walls act on particles: a sharp corner of a wall passes
    between two of them.
    """

    host_only = ("loops",)

    detects = True
    _after: Any = None  # the same bodies and others, as they are planned to be
    room = 64  # the particles of near bodies

    def __init__(
        self, loops: Iterable, friction: ArrayLike | Mapping = 0.0, restitution: ArrayLike | Mapping = 0.0, *, skin: float | str =
        "auto", push_out: float = 1.0,
    ):  # fmt: skip
        self.restitution, self.friction, self.skin, self.push_out = restitution, friction, skin, push_out
        self.loops = checked(loops)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn all loops counterclockwise, and measure them; refuse flat ones, and particles deep inside of others."""
        if particles.dim != 2:
            raise ValueError("Polygons: bodies of particle loops are for 2D worlds; these particles are in 3D.")
        if particles.spins:
            raise ValueError("Polygons: it does not turn particles that spin. Leave out spin, or use tv.Contact for discs alone.")
        x = particles.position
        self.dev.outline = Outline(*laid(self.loops, x))
        sizes = np.where(self.dev.outline.body >= 0, SKIN * self.dev.outline.length, 0.75 * particles.radius)
        auto = median(sizes[sizes > 0]) if (sizes > 0).any() else 1.0
        self._listed = auto if self.skin == "auto" else float(self.skin)
        self._finest = float((particles.radius + self.dev.outline.reach / 2).min(initial=np.inf))
        matters = particles.count > 0 and bool(self.loops or (particles.radius > 0).any())
        self._keep(matters=matters, table=self.wanted)
        if self.matters:
            self.check_range(x)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Refuse particles deep inside of bodies, as they come."""
        super().review(particles, inv_mass)
        refuse_deep(self.loops, particles.position, 0)

    def check_added(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out, or inside of bodies."""
        bodies = self._after or self
        PairContact.check_added(bodies, particles, first)
        refuse_deep(bodies.loops, particles.position, first)

    def release(self) -> None:
        """Forget the world, and what was planned there."""
        super().release()
        self._after = None

    @property
    def indices(self) -> np.ndarray:
        """The particles of all bodies, one after the other, (total,)."""
        return np.concatenate([*self.loops, np.zeros(0, dtype=np.int32)])

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Bodies stay as long as all of their particles do."""
        if self.loops:
            corner, begin, owner = flat(self.loops)
            new, whole = number[corner].astype(np.int32), np.bincount(owner, number[corner] < 0) == 0
            self._hold([new[begin[k] : begin[k + 1]] for k in np.flatnonzero(whole).tolist()])

    def check_more(self, more: Feature) -> None:
        """It takes other bodies, which are to be like its own."""
        if not isinstance(more, Polygons):
            raise TypeError(f"World.add: extend: {self!r} cannot take {more!r}, which is of another kind. Add it to features.")
        for name, value in more.arguments.items():
            if name != "loops" and repr(value) != repr(self.arguments.get(name)):
                raise ValueError(f"World.add: extend: {more!r} has a {name} of its own, but all bodies have that of {self!r}.")

    def extend(self, more: "Polygons") -> None:
        """Bodies behind bodies."""
        both = [*self.loops, *more.loops]
        self._hold(checked(both) if np.isin(more.indices, self.indices).any() else both)

    def _hold(self, loops: list[np.ndarray]) -> None:
        """Have these bodies."""
        self._keep(loops=loops)
        self.arguments = {**self.arguments, "loops": loops}

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles and bodies can come and go: not where bodies sleep as one, or lists are of another make."""
        if not self.matters or self.scene.state.sleepers:
            return False
        came, now = change.now.position[change.kept :], change.now
        after: Any = self.copy()
        start = now.placed(change.joined(self.start.position, came))
        after.remap_indices(change.number, now.count)
        if self in change.more:
            start = extended(after, change.more[self], start, now, self.periodic)
        after.start = start
        after.prepare(start, change.inv_mass.copy())
        self._after = after
        reach = after.dev.outline.reach
        alike = after.matters and self.table.can_be(change.before.group, now.group)
        return alike and self.dev.search.can_regroup(change, now.radius, reach)

    def regroup(self, change: Regrouping) -> None:
        """They came and went, and the team knows."""
        dev, after = self.dev, self._after
        self.start, self._listed, self._finest, self._after = after.start, after._listed, after._finest, None
        self._hold(after.loops)
        dev.outline = after.dev.outline
        dev.geometry.become(dev.outline)
        dev.beside.skin = self._listed
        self.table.regroup(self.scene, change.now.group)
        dev.search.regroup(change, self._listed, change.now.radius, dev.outline.reach)

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Their edges, numbered from body to body."""
        if not self.loops:
            return PairContact.rods(self)
        ends = np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in self.loops])
        return ends, np.arange(len(ends))

    def join(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields, among them the neighbour list's, which is returned."""
        n, add, dev = scene.count, scene.memory.field, self.dev
        self.enter(scene)
        dev.forces = ForceShare(scene, sums=True, lasting=False)
        dev.geometry = PolygonGeometry(scene, dev.outline, self.push_out)
        dev.move = add("Contact.move", n, width=2)
        dev.depths = add("Contact.depths", n)  # of the contacts of each particle, see PolygonGeometry.share()
        dev.fast = add("Contact.fast", None, kind=ti.i32)
        self.table.bind(scene, asked=True)
        dev.slip = PairData("slip", 2, lasting=True)
        if dev.has_restitution:
            dev.restitution = PolygonRestitution(scene, dev.geometry, self.table)
            dev.hit = dev.restitution.hit
        linked = excluded_pairs(batches, scene.particles.radius)
        pair_data = [
            *dev.geometry.carried,
            *([dev.slip] if dev.has_friction else []),
            *([dev.restitution.aim, dev.restitution.last] if dev.has_restitution else []),
        ]
        dev.beside = Beside(dev.geometry, self.table, scene.memory.number(self._listed, scene.real))
        dev.search = NeighbourSearch(scene, self._listed, linked, dev.beside, pair_data, team, dev.move, dev.outline.reach)
        dev.list = dev.search.list
        dev.geometry.bind(dev.search)
        return dev.search

    @property
    def bodies(self) -> list[np.ndarray]:  # type: ignore[override]
        """The loops."""
        return self.loops

    @ti.func
    def detect(self, i, first):
        """Find the contacts of particle i, and note an edge that is too long for the list."""
        if self.dev.state.awake(i):
            if first != 0:
                for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                    if not self.dev.geometry.stays(i, e):
                        self.dev.geometry.impulse.field[e] = 0
                        if ti.static(self.dev.has_restitution):
                            self.dev.restitution.aim.field[e] = 0 * self.dev.restitution.aim.field[e]
            self.note_motion(0, self.dev.geometry.too_long(i))
        if ti.static(not self.dev.state.sleepers):
            self.dev.geometry.detect(i, 2 - first)
        elif self.dev.state.awake(i) or self.is_near(i):
            self.dev.geometry.detect(i, 2 - first)
        else:
            self.dev.geometry.forget(i)

    @ti.func
    def is_near(self, i):
        """Whether anything on the list of particle i moves."""
        out = False
        for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
            j = self.dev.list.neighbour[e]
            d = self.dev.state.d[j]
            if self.dev.state.awake(j) and (self.dev.w.positive(j) or d.dot(d) > 0):
                out = True
        return out

    @ti.func
    def presses(self, i, e):
        """Whether particle i presses, as a vertex, on what is at entry e of its list, as it was found last."""
        return self.dev.geometry.impulse.field[e] > 0 or self.dev.geometry.manifold.field[e][0] > 0

    @ti.func
    def held_by(self, j):
        """Which particle it is that a vertex presses on by particle j."""
        return self.dev.geometry.held_by(j)

    @ti.func
    def reached(self, i, e, margin):
        """Who sleeps at entry e of the list of particle i and is touched by it, as was found last; if it is driven, also who was
        in the substep before. Edges know no margin."""
        j, out = self.dev.list.neighbour[e], -1
        for role in range(self.dev.geometry.roles(i)):
            at, v, a, b, t, part = self.dev.geometry.participants(i, e, role)
            if at >= 0:
                other = j if role != VERTEX else self.dev.geometry.held_by(j)
                met = self.dev.geometry.manifold.field[at][0] > 0
                if not self.dev.w.positive(i):
                    met = met or self.dev.geometry.impulse.field[at] > 0
                if met and not self.dev.state.awake(other):
                    out = other
        return out

    @ti.func
    def count(self, begin, end, now):
        """How deep the contacts of some particles are, all together; and how many, for those that bounce."""
        for i in range(begin, end):
            if self.dev.state.awake(i):
                depths, parts = 0 * self.dev.w.of(i), 0 * self.dev.w.of(i)
                for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                    for role in range(self.dev.geometry.roles(i)):
                        at, _, _, _, _, part = self.dev.geometry.participants(i, e, role)
                        if at >= 0:
                            if self.dev.geometry.manifold.field[at][0] > 0:
                                depths += abs(part) * self.dev.geometry.usual.field[at]
                                parts += abs(part)
                self.dev.depths[i] = depths
                if ti.static(self.dev.has_restitution):
                    if now.first != 0:
                        self.dev.restitution.split[i] = parts

    @ti.func
    def relax(self, i, now):
        """What the contacts of particle i want of it."""
        first, final = now.first, now.final
        total, lifts, forced = 0 * self.dev.state.x[i], 0 * self.dev.state.x[i], 0 * self.dev.state.x[i]
        begin, roles = self.dev.list.first[i], self.dev.geometry.roles(i)
        for e in range(begin, begin + ti.select(self.dev.depths[i] > 0, self.dev.list.number[i], 0)):
            for role in range(roles):
                at, v, a, b, t, part = self.dev.geometry.participants(i, e, role)
                if at >= 0:
                    found = self.dev.geometry.manifold.field[at]
                    n = ti.Vector([found[2], found[3]])
                    if found[0] > 0:
                        overlap, shared = self.dev.geometry.share(self.dev.depths, at, v, a, b, t)
                        d = self.dev.geometry.relative(self.dev.state.d, v, a, b, t)
                        share, missing = part * self.dev.w.of(i) / shared, 0 * overlap
                        back = overlap  # what is taken back of the position and of the displacement
                        if ti.static(self.dev.has_restitution):
                            if first != 0:
                                aim, missing, lift = self.dev.restitution.target(at, v, a, b, t, n, overlap, d.dot(n))
                                if missing > 0:
                                    lifts += share * (overlap + lift) * n
                                    back = 0 * overlap
                                    self.dev.hit[None] = 1
                                    if role == VERTEX:
                                        self.dev.restitution.aim.field[e] = aim * n
                        if role == VERTEX:
                            if not self.dev.geometry.stays(i, e):
                                self.dev.geometry.impulse.field[e] = self.dev.geometry.impulse.field[e] + back / shared
                        want = back * n
                        if ti.static(self.dev.has_friction):
                            want -= self.table.held(v, a, n, overlap + missing, self.dev.slip.field[at] + d)
                        total += share * want
                        if final != 0:
                            approach = -self.dev.geometry.relative(self.dev.forces.before, v, a, b, t).dot(n)
                            pushed = overlap * self.dev.geometry.inverse_mass(v, a, b, t) / shared
                            forced += self.dev.forces.share(approach, pushed) * share * want
        self.dev.move[i] = total
        if final != 0:
            self.dev.forces.add(i, forced, first)
        if ti.static(self.dev.has_restitution):
            if first != 0:
                self.dev.restitution.lift[i] = lifts

    @ti.func
    def apply_corrections(self, i, first):
        """Move particle i as its contacts want; what bounced goes where it is at the end of the substep."""
        if self.dev.state.moves(i):
            if self.dev.depths[i] > 0:
                self.dev.state.shift(i, self.dev.move[i])
            if ti.static(self.dev.has_restitution):
                if first != 0:
                    self.dev.state.advance(i, self.dev.restitution.lift[i])

    @ti.func
    def finish_substep(self, i, now):
        """At the end of a substep: add to the slip of each contact what it has moved, as far as friction can hold it."""
        if ti.static(self.dev.has_friction):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                slip = 0 * self.dev.state.x[i]
                at, v, a, b, t, _ = self.dev.geometry.participants(i, e, VERTEX)
                if at >= 0:
                    found = self.dev.geometry.manifold.field[at]
                    if found[0] > 0:
                        n, d = ti.Vector([found[2], found[3]]), self.dev.geometry.relative(self.dev.state.d, v, a, b, t)
                        overlap, _ = self.dev.geometry.share(self.dev.depths, at, v, a, b, t)
                        slip = self.table.held(v, a, n, overlap, self.dev.slip.field[e] + d)
                self.dev.slip.field[e] = slip
        if ti.static(self.dev.has_restitution):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                aim, pushed = self.dev.restitution.aim.field[e], self.dev.geometry.impulse.field[e]
                self.dev.restitution.last.field[e] = ti.select(aim.dot(aim) > 0, 0 * pushed, pushed)


class PolygonRestitution:
    """Contacts of vertices and edges leave with -e times the normal velocity that they have as they meet, see under_force()."""

    def __init__(self, scene: Scene, geometry: PolygonGeometry, table: Table):
        n, add = scene.count, scene.memory.field
        self.geometry, self.table, self.state = geometry, table, scene.state
        self.split = add("Contact.struck", n)  # how often the mass of each particle is split: its parts in all contacts
        self.d_change = add("Contact.d_change", n, width=2)
        self.lift = add("Contact.lift", n, width=2)  # moves the position alone
        self.hit = add("Contact.hit", None, kind=ti.i32)
        self.aim = PairData("aim", 2, lasting=False)  # with which displacement each contact is to leave, along its normal
        self.last = PairData("pushed", 0, lasting=True)  # of the last substep, without impacts [kg m]

    @ti.func
    def target(self, at, v, a, b, t, n, overlap, leaving):
        """The displacement with which a contact is to leave; what it lacks of it; and how far it gets until the substep ends.

        A contact rests, unless e is 1, that is to leave by no more than it overlapped before the substep and what it was pushed
        in the last one: what is pushed as far in each substep came no faster than its load brings it. It rests, too, where SLOW
        substeps of forces brought it, or heaps would hop on and on: what one bounce takes, the next corner gives back.
        """
        before = self.state.before[v] - (1 - t) * self.state.before[a] - t * self.state.before[b]
        approach, restitution = -before.dot(n), self.table.of(v, a)[2]
        aim, missing, lift = restitution * ti.max(approach, 0), 0 * overlap, 0 * overlap
        held = self.last.field[at] * self.geometry.inverse_mass(v, a, b, t)
        fast = approach > ti.static(SLOW) * (-leaving - approach)
        if approach > 0 and (restitution >= 1 or (fast and (held == 0 or aim > overlap + leaving + held))):
            missing = ti.max(aim - (overlap + leaving), 0)
            if overlap <= -leaving:
                lift = restitution * overlap
            given, left = under_force(0 * overlap, 0 * overlap, -leaving, approach, overlap, restitution)
            if given > 0:
                aim, missing, lift = given + leaving, given, left * given - overlap
        return aim, missing, lift

    @ti.func
    def choose(self, i):
        """One Jacobi pass over displacements alone: what the contacts of particle i that bounce lack."""
        total = 0 * self.state.x[i]
        if self.split[i] > 0:
            begin = self.geometry.list.first[i]
            for e in range(begin, begin + self.geometry.list.number[i]):
                for role in range(self.geometry.roles(i)):
                    at, v, a, b, t, part = self.geometry.participants(i, e, role)
                    if at >= 0:
                        aim = self.aim.field[at]
                        size = aim.norm()
                        if size > 0:
                            n = aim / size
                            lack = size - self.geometry.relative(self.state.d, v, a, b, t).dot(n)
                            if lack > 0:
                                shared = self.geometry.split_mass(self.split, v, a, b, t)
                                self.hit[None] = 1
                                total += part * self.state.w.of(i) * lack / shared * n
                                if role == VERTEX:
                                    self.geometry.impulse.field[e] = self.geometry.impulse.field[e] + lack / shared
        self.d_change[i] = total

    @ti.func
    def apply(self, i):
        """Change the displacement of particle i, and the one before the substep with it."""
        self.state.d[i] = self.state.d[i] + self.d_change[i]
        self.state.before[i] = self.state.before[i] + self.d_change[i]
