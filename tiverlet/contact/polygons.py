"""Contacts of bodies made of loops of particles (2D)."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..colliders.body_impacts import FINE
from ..device import record, ti
from ..device.thread_team import Team
from ..features.extending import extended
from ..features.feature import Batch, Feature, Knob, Scene
from ..features.material import Table
from ..features.regrouping import Regrouping
from ..geometry import rotation
from ..geometry.ordered import median
from ..neighbours.neighbour_list import PairData
from ..neighbours.neighbour_search import NeighbourSearch
from ..particles import Particles
from .body_projection import BodyProjection
from .exclusions import excluded_pairs
from .force_share import ForceShare
from .known_loads import WINDOW, KnownLoads
from .loops import checked, flat, laid, refuse_deep
from .pair_contact import PairContact
from .polygon_narrow_phase import VERTEX, EdgePairTable, Outline, PolygonGeometry
from .wall_loads import WallLoads

SKIN = 0.15  # skin of a vertex, relative to its longer edge
SLOW = 2.0  # a contact rests if this many substeps of forces account for its speed
AIM = 2.0**-40  # [m] the least displacement with which a contact leaves after an impact, so that its normal can be told from it


@record
class BodyContact:
    """A contact of two bodies in a pass, solved by a particle that has a role in it.

    at: the entry of the neighbour list that stores it. v, a, b, t: vertex v touches the edge from a to b at t. n: the normal.
    d: the displacement of v relative to the edge [m]. overlap: C [m], and by split masses shared [1/kg].
    part: of the correction that the particle gets, see PolygonGeometry.participants(). share: the same, as moves [1].
    e, role: the entry of the particle's own list, and its role.
    """

    def __init__(self, at, v, a, b, t, n, d, overlap, shared, part, share, e, role):
        self.at, self.v, self.a, self.b, self.t, self.n = at, v, a, b, t, n
        self.d, self.overlap, self.shared, self.part, self.share = d, overlap, shared, part, share
        self.e, self.role = e, role


@record
class BodySums:
    """What a particle sums up over its contacts in a pass.

    move: its correction [m]. lift: that of its position only, by impacts [m]. forced: the part of `move` that counts as a force,
    see ForceShare [m]. parts: its parts in impacts of bodies.
    """

    def __init__(self, move, lift, forced, parts):
        self.move, self.lift, self.forced, self.parts = move, lift, forced, parts


class Polygons(PairContact):
    """Contacts of bodies made of particle loops, and of other particles: vertex against edge, disc against disc (2D).

    C(x) = (x_v - (1 - t) x_a - t x_b) . n - (r_v + (1 - t) r_a + t r_b) >= 0 for a vertex v and the edge from a to b of another
    body. t is the place of v along the edge, n the outward normal. Gradients: n, -(1 - t) n, -t n.

    loops: for each body its particles in order around it, at least 3, either way round. Their radii round the rim. Other
    constraints (Distance, Area, ShapeMatch) hold a body together; it may bend, and stretch by a quarter. Rigid are ShapeMatch,
    and as many links as it takes: the sides, and diagonals from one corner. With more links the solver is Jacobi, under which
    towers sway and may buckle.
    friction, restitution: as in Contact. Particles in no loop touch as in Contact. Bodies of rigid links and rigid clusters that
    meet at restitution > 0 leave by the laws of Newton and Coulomb for rigid bodies, see PolygonRestitution. With 0 they go on
    together, see BodyProjection.
    skin: how far beyond contact distance pairs are listed [m], "auto" for the median of 0.15 of the longer edge of each vertex,
    and of 0.75 of the radius of each disc in no loop.
    push_out: about the speed at which bodies that overlap part [m/s].
    loads: whether contacts store the load that they bear at rest, and bodies bear it without giving way; see known_loads.py.

    Jacobi pass: each contact takes C back, split by mass, p = -C / (m_v w_v + (1 - t) m_a w_a + t m_b w_b), with m_i = S_i / a.
    a is the usual depth of the contact in the last few substeps. S_i sums the usual depths of all contacts of particle i, each
    times the part of i in it, 1, 1 - t or t. By Cauchy's inequality no eigenvalue of a pass exceeds 1. A contact that is hardly
    deep takes hardly a part of the mass. If masses were split by the number of contacts instead, a contact that opens and closes
    would change the stiffness of its neighbours, and heaps would never rest. The pass conserves momentum, and angular momentum
    but for the slip within a substep; friction at a radius is a torque that nothing takes up.

    Corners that face each other touch as discs, by their radii. A vertex inside of another body leaves through the edge over
    which it came, or else through the nearest edge that faces its own body, if it is not deeper than half the length of that
    edge. In a substep nothing should get that deep, and the step flags "tunnelling-risk" where it might. Particles that start
    deeper are refused.

    Two sharp corners may pass each other, so that neither is inside of the other body but their edges cross. They part over the
    nearer of these edges, with C as above and t beyond the end of the edge. Other bodies that cross without a corner of one
    inside of the other, such as two bars, are not detected. Walls act on particles: a sharp corner of a wall passes between two
    of them.
    """

    host_only = ("loops",)

    detects = True
    _after: Any = None  # the copy with the bodies after a planned edit, see can_regroup()
    neighbours_per_particle = 64  # the particles of near bodies

    def __init__(
        self, loops: Iterable, friction: ArrayLike | Mapping = 0.0, restitution: ArrayLike | Mapping = 0.0, *, skin: float | str =
        "auto", push_out: float = 1.0, loads: bool = False,
    ):  # fmt: skip
        self.restitution, self.friction, self.skin, self.push_out, self.loads = restitution, friction, skin, push_out, loads
        self.loops = checked(loops)

    loads = Knob(lambda f, v: checks.flag("Polygons", "loads", v), "Whether contacts know what they bear.", compiled=True)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn all loops counterclockwise and measure them. Refuse flat loops, and positions too far out."""
        if particles.dim != 2:
            raise ValueError("Polygons: bodies of particle loops are for 2D worlds; these particles are in 3D.")
        if particles.spins:
            raise ValueError("Polygons: it does not turn particles that spin. Leave out spin, or use tv.Contact for discs alone.")
        x = particles.position
        self.dev.outline = Outline(*laid(self.loops, x))
        sizes = np.where(self.dev.outline.body >= 0, SKIN * self.dev.outline.length, 0.75 * particles.radius)
        auto = median(sizes[sizes > 0]) if (sizes > 0).any() else 1.0
        self._present_skin = auto if self.skin == "auto" else float(self.skin)
        self._smallest_radius = float((particles.radius + self.dev.outline.reach / 2).min(initial=np.inf))
        can_touch = particles.count > 0 and bool(self.loops or (particles.radius > 0).any())
        self._keep(can_touch=can_touch, table=self.wanted)
        if self.can_touch:
            self.check_range(x)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn as PairContact.review() does, and of bodies that nothing holds. Refuse particles that start deep inside bodies."""
        super().review(particles, inv_mass)
        refuse_deep(self.loops, particles.position, 0, self._left_out)
        loose = self._loose(inv_mass)
        if len(loose):
            k = int(loose[0])
            checks.warn(
                f"{self!r}: no constraint holds loops[{k}] ({len(loose)} such in all), so its corners move one by one. Add "
                f"tv.ShapeMatch(loops), or links."
            )  # fmt: skip

    def _left_out(self, i: int, loop: np.ndarray) -> bool:
        """Whether constraints tie particle i to all corners of a loop, so that it touches none of them."""
        tied = [np.zeros(0, dtype=np.int32)]
        for b in self.ties:
            who = b.indices.ravel()
            tied.append(who[np.isin(b.owner, b.owner[who == i])])
        return bool(np.isin(loop, np.concatenate(tied)).all())

    def _loose(self, inv_mass: np.ndarray) -> np.ndarray:
        """Return the loops with a particle that moves, of which no constraint has two particles."""
        body, count = self.dev.outline.body, len(self.loops)
        held = np.bincount(body[(body >= 0) & (inv_mass > 0)], minlength=count) == 0
        for b in self.ties:
            own = body[b.indices.ravel()]
            keys, times = np.unique((b.owner * (count + 1) + own)[own >= 0], return_counts=True)
            held[keys[times > 1] % (count + 1)] = True
        return np.flatnonzero(~held)

    def check_added(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out, and added particles deep inside of bodies."""
        bodies = self._after or self
        PairContact.check_added(bodies, particles, first)
        refuse_deep(bodies.loops, particles.position, first)

    def release(self) -> None:
        """Unbind from the world, and drop a planned edit."""
        super().release()
        self._after = None

    @property
    def indices(self) -> np.ndarray:
        """The particles of all bodies, one after the other, (total,)."""
        return np.concatenate([*self.loops, np.zeros(0, dtype=np.int32)])

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Take new particle indices (-1 for removed ones). A body remains if all of its particles do."""
        if self.loops:
            corner, begin, owner = flat(self.loops)
            new, whole = number[corner].astype(np.int32), np.bincount(owner, number[corner] < 0) == 0
            self._hold([new[begin[k] : begin[k + 1]] for k in np.flatnonzero(whole).tolist()])

    def check_extension(self, more: Feature) -> None:
        """Raise unless `more` is a Polygons with the same settings."""
        if not isinstance(more, Polygons):
            raise TypeError(f"World.add: extend: {self!r} cannot take {more!r}, which is of another kind. Add it to features.")
        for name, value in more.arguments.items():
            if name != "loops" and repr(value) != repr(self.arguments.get(name)):
                raise ValueError(f"World.add: extend: {more!r} has a {name} of its own, but all bodies have that of {self!r}.")

    def extend(self, more: "Polygons") -> None:
        """Append the bodies of `more`."""
        both = [*self.loops, *more.loops]
        self._hold(checked(both) if np.isin(more.indices, self.indices).any() else both)

    def _hold(self, loops: list[np.ndarray]) -> None:
        """Store these bodies, in the arguments too."""
        self._keep(loops=loops)
        self.arguments = {**self.arguments, "loops": loops}

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles and bodies can come and go in place. If so, plan the edit for regroup().

        Not in a world with Sleep, or if the groups or the neighbour search would differ.
        """
        if not self.can_touch or self.scene.state.sleepers:
            return False
        came, now = change.now.position[change.kept :], change.now
        after: Any = self.copy()
        start = now.placed(change.regrouped_rows(self.start.position, came))
        after.remap_indices(change.number, now.count)
        if self in change.extensions:
            start = extended(after, change.extensions[self], start, now, self.periodic)
        after.start = start
        after.prepare(start, change.inv_mass.copy())
        self._after = after
        reach = after.dev.outline.reach
        return after.can_touch and self.dev.search.can_regroup(change, now.radius, reach)

    def regroup(self, change: Regrouping) -> None:
        """Carry out the planned edit. The thread team already has the new number of particles."""
        dev, after = self.dev, self._after
        self.start, self._present_skin, self._smallest_radius, self._after = (
            after.start, after._present_skin, after._smallest_radius, None,
        )  # fmt: skip
        self._hold(after.loops)
        dev.outline = after.dev.outline
        dev.geometry.set_outline(dev.outline)
        dev.edge_pair_table.skin = self._present_skin
        self.table.regroup(self.scene, change.now.group)
        dev.search.regroup(change, self._present_skin, change.now.radius, dev.outline.reach)

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the edges (k, 2) of all bodies, and their numbers (k,), counted from body to body. Rays meet them."""
        if not self.loops:
            return PairContact.rods(self)
        ends = np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=1) for loop in self.loops])
        return ends, np.arange(len(ends))

    def make_search(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields and the neighbour search, and return the search."""
        n, add, dev = scene.count, scene.memory.field, self.dev
        dev.forces = ForceShare(scene)
        dev.geometry = PolygonGeometry(scene, dev.outline, self.push_out)
        dev.move = add("Contact.move", n, width=2)
        dev.depths = add("Contact.depths", n)  # S_i: the usual depths of the contacts of i, see PolygonGeometry.share()
        dev.fast = add("Contact.fast", None, kind=ti.i32)
        self.table.bind(scene, asked=True)
        dev.slip = PairData("slip", 2, persistent=True)
        if dev.has_restitution:
            dev.restitution = PolygonRestitution(scene, dev.geometry, self.table)
            dev.hit = dev.restitution.hit
        dev.rows = None
        dev.bodies = None if dev.has_restitution else BodyProjection.made(scene, batches, self.table, 3)
        linked = excluded_pairs(batches, scene.particles.radius, dev.outline.body)
        dev.known = KnownLoads(scene, dev.has_friction) if self.has_loads else None
        # What contacts push along n and across it in the last pass, beside their known loads [kg m].
        dev.part = PairData("part", 2, False, is_transferred=False) if dev.known else None
        pair_data = [
            *(dev.bodies.pair_data if dev.bodies else []),
            *dev.geometry.carried,
            *([*dev.known.pair_data, dev.part] if dev.known else []),
            *([dev.slip] if dev.has_friction else []),
            *(dev.restitution.pair_data if dev.has_restitution else []),
        ]
        dev.edge_pair_table = EdgePairTable(dev.geometry, self.table, scene.memory.number(self._present_skin, scene.real))
        dev.search = NeighbourSearch(
            scene, self._present_skin, linked, dev.edge_pair_table, pair_data, team, dev.move, dev.outline.reach
        )
        dev.list = dev.search.list
        dev.geometry.bind(dev.search, dev.known)
        if dev.known:
            dev.known.bind(dev.list, dev.geometry)
        return dev.search

    def make_wall_loads(self) -> WallLoads:
        """Declare the fields of the loads with which walls hold particles, and return them. Called if it `has_loads`."""
        return WallLoads(self.scene, self.dev.known)

    @property
    def strikes_bodies(self) -> bool:
        """Whether bodies held by constraints bounce as wholes: with restitution."""
        return self.dev.has_restitution

    @property
    def bodies(self) -> list[np.ndarray]:  # type: ignore[override]
        """The particles of each body, which sleep and wake together."""
        return self.loops

    @ti.func
    def reaction(self, i, h, soft):
        """Return how far contact forces moved particle i in the last substep of a frame, h [s] long [m]. It needs a list. soft:
        see Passes.push_reaction()."""
        return self.dev.forces.sum[i]

    @ti.func
    def shrink(self, i, first, speed):
        """Allow the overlap that particle i has with particles of index `first` or more; pairs part at up to `speed` [m/s]."""
        self.dev.geometry.shrink(i, first, speed)

    @ti.func
    def restore(self, i, h):
        """Reduce the overlap that particle i is allowed, after a substep h [s]."""
        self.dev.geometry.restore(i, h)

    @ti.func
    def is_shrunk(self, i):
        """Whether particle i is allowed to overlap for a while."""
        return self.dev.geometry.is_shrunk(i)

    @ti.func
    def detect(self, i, first):
        """Find the contacts of particle i, and set the flag if its edge is too long for the list."""
        if self.dev.state.awake(i):
            if first != 0:
                for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                    if not self.dev.geometry.is_unchanged(i, e):
                        self.dev.geometry.impulse.field[e] = 0
                        if ti.static(self.dev.has_restitution):
                            self.dev.restitution.aim.field[e] = 0 * self.dev.restitution.aim.field[e]
            self.note_motion(0, self.dev.geometry.too_long(i))
        if ti.static(not self.dev.state.sleepers):
            self.dev.geometry.detect(i, 2 - first)
        elif self.dev.state.awake(i) or self.has_moving_neighbour(i):
            self.dev.geometry.detect(i, 2 - first)
        else:
            self.dev.geometry.forget(i)

    @ti.func
    def has_moving_neighbour(self, i):
        """Whether any particle on the list of i moves."""
        out = False
        for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
            j = self.dev.list.neighbour[e]
            d = self.dev.state.d[j]
            if self.dev.state.awake(j) and (self.dev.w.positive(j) or d.dot(d) > 0):
                out = True
        return out

    @ti.func
    def is_pressed(self, i, e):
        """Whether particle i, as a vertex, presses on the edge or disc at entry e of its list, by the last detect()."""
        return self.dev.geometry.impulse.field[e] > 0 or self.dev.geometry.manifold.field[e][0] > 0

    @ti.func
    def pressed_particle(self, j):
        """Return the particle that a vertex presses on where its entry is j, see PolygonGeometry.pressed_particle()."""
        return self.dev.geometry.pressed_particle(j)

    @ti.func
    def touched_sleeper(self, i, e, margin):
        """Return the sleeping particle at entry e of the list of i that i touches by the last detect(), or -1.

        A driven particle i also reaches a sleeping particle that it touched in the substep before. Edges ignore `margin`.
        """
        j, out = self.dev.list.neighbour[e], -1
        for role in range(self.dev.geometry.roles(i)):
            at, v, a, b, t, part = self.dev.geometry.participants(i, e, role)
            if at >= 0:
                other = j if role != VERTEX else self.dev.geometry.pressed_particle(j)
                met = self.dev.geometry.manifold.field[at][0] > 0
                if not self.dev.w.positive(i):
                    met = met or self.dev.geometry.impulse.field[at] > 0
                if met and not self.dev.state.awake(other):
                    out = other
        return out

    @ti.func
    def count(self, begin, end, now):
        """Sum the usual depths of the contacts of particles begin ... end - 1; for restitution also their parts."""
        for i in range(begin, end):
            if self.dev.state.awake(i):
                depths, parts = 0 * self.dev.w.of(i), 0 * self.dev.w.of(i)
                for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                    for role in range(self.dev.geometry.roles(i)):
                        at, _, _, _, _, part = self.dev.geometry.participants(i, e, role)
                        if at >= 0:
                            if self.dev.geometry.bears(at):
                                depths += abs(part) * self.dev.geometry.usual_depth.field[at]
                                parts += abs(part)
                self.dev.depths[i] = depths
                if ti.static(self.dev.has_restitution):
                    if now.first != 0:
                        self.dev.restitution.split[i] = parts

    @ti.func
    def relax(self, i, now):
        """Compute the corrections of particle i by its contacts.

        For each contact in which it has a role: find the overlap; compute what this pass takes back along the normal, then across
        it by friction; note what later substeps get to know of it.
        """
        if ti.static(bool(self.dev.known)):
            if now.first != 0 and (now.span.since + now.s) % WINDOW == 0:
                self.dev.known.motion.end_window(i, now, WINDOW)
        move, parts = 0 * self.dev.state.x[i], 0 * self.dev.w.of(i)
        lift, forced = move, move
        own = BodySums(move, lift, forced, parts)
        begin, roles = self.dev.list.first[i], self.dev.geometry.roles(i)
        for e in range(begin, begin + ti.select(self.dev.depths[i] > 0, self.dev.list.number[i], 0)):
            for role in range(roles):
                at, v, a, b, t, part = self.dev.geometry.participants(i, e, role)
                if at >= 0:
                    found = self.dev.geometry.manifold.field[at]
                    n = ti.Vector([found[2], found[3]])
                    if self.dev.geometry.bears(at):
                        overlap, shared = self.dev.geometry.share(self.dev.depths, at, v, a, b, t)
                        d = self.dev.geometry.relative(self.dev.state.d, v, a, b, t)
                        share = part * self.dev.w.of(i) / shared
                        contact = BodyContact(at, v, a, b, t, n, d, overlap, shared, part, share, e, role)
                        back, pressed, missing, alone, as_bodies = self.take_back(contact, own, now)
                        want = back * n
                        if ti.static(self.dev.has_friction):
                            want = self.rub(contact, want, pressed, missing, alone, as_bodies, now)
                        if ti.static(bool(self.dev.known)):
                            if role == VERTEX:
                                self.dev.part.field[e] = ti.Vector([n.dot(want), n[0] * want[1] - n[1] * want[0]]) / shared
                        own.move += share * want
                        if now.final != 0:
                            own.forced += self.part_by_forces(contact, pressed) * share * want
        self.store_sums(i, own, now)

    @ti.func
    def take_back(self, contact, own, now):
        """Return what this pass takes back of the overlap of a contact, from position and displacement [m], and more about it.

        That is the overlap that would hold the load as masses are split [m], what an impact lacks of its displacement [m], the
        inverse mass of the contact alone, or 0 without known loads, and whether it is left to an impact of whole bodies.
        """
        at, v, a, b, t, n = contact.at, contact.v, contact.a, contact.b, contact.t, contact.n
        back, pressed, known, alone = contact.overlap, contact.overlap, 0 * contact.overlap, 0 * contact.overlap
        bearing, leaving, missing, as_bodies = contact.overlap, contact.d.dot(n), 0 * contact.overlap, False
        if ti.static(bool(self.dev.known)):
            known, alone = self.dev.known.known_push(at, now), self.dev.geometry.inverse_mass(v, a, b, t)
            given = -ti.select(now.first != 0, known, self.dev.geometry.impulse.field[at]) * contact.shared
            back = ti.max(contact.overlap, given)  # it may give back what it was given, but never pulls
            known *= ti.cast(now.first, self.scene.real)  # later passes find what the first one has left
            bearing, pressed = ti.max(bearing + known * alone, 0), ti.max(pressed + known * contact.shared, 0)
            leaving -= known * alone
        if ti.static(self.dev.has_restitution):
            if now.first != 0:
                aim, lack, lift = self.dev.restitution.target(at, v, a, b, t, n, bearing, leaving)
                if lack > 0:
                    missing, pressed = lack, bearing
                    back = 0 * back - known * contact.shared  # what bounces has no load
                    as_bodies = self.begin_impact(contact, aim, bearing + lift, own)
                elif self.dev.restitution.parts_by_itself(at, v, a, b, t, n):
                    back = 0 * back
        if ti.static(bool(self.dev.bodies)):
            as_bodies = self.strikes_as_body(contact, now)
            if as_bodies:
                back = -known * contact.shared  # what strikes has no load
        if ti.static(not self.dev.known):
            if contact.role == VERTEX and not self.dev.geometry.is_unchanged(v, contact.e):
                e = contact.e
                self.dev.geometry.impulse.field[e] = self.dev.geometry.impulse.field[e] + back / contact.shared
        return back, pressed, missing, alone, as_bodies

    @ti.func
    def begin_impact(self, contact, aim, lift, own):
        """Begin the impact of a contact, which leaves with `aim` [m] and is lifted [m]. Returns whether it is one of bodies."""
        v, a, b, t, n = contact.v, contact.a, contact.b, contact.t, contact.n
        as_bodies = self.dev.restitution.by_bodies(v, a, b)
        if as_bodies:
            own.parts += abs(contact.part)
            aim = self.dev.restitution.undisturbed(v, a, b, t, n)
        else:
            self.dev.hit[None] = 1
            own.lift += contact.share * lift * n
        if contact.role == VERTEX:
            self.dev.restitution.begin(contact.e, ti.max(aim, ti.static(AIM)) * n)
        return as_bodies

    @ti.func
    def strikes_as_body(self, contact, now):
        """Whether a contact is left to BodyProjection in this substep; decided in the first pass."""
        v, a, b, t, n = contact.v, contact.a, contact.b, contact.t, contact.n
        out = self.dev.bodies.struck.field[contact.at] != 0
        if now.first != 0:
            usual = self.dev.geometry.usual_depth.field[contact.at]
            out = self.dev.bodies.strikes(self.dev.geometry, v, a, b, t, n, usual)
        if contact.role == VERTEX:
            self.dev.bodies.note(contact.e, n, out)
        return out

    @ti.func
    def rub(self, contact, want, pressed, missing, alone, as_bodies, now):
        """Return the correction of a contact [m] with friction. Known friction is in the displacement already."""
        slip = self.dev.slip.field[contact.at] + contact.d
        if ti.static(bool(self.dev.known)):
            if now.first != 0:
                along = self.dev.known.known_friction(contact.at, now) * rotation.across(contact.n)
                slip -= ti.select(missing > 0, alone, contact.shared) * along
                want -= contact.shared * along
        if not as_bodies:
            want -= self.table.held(contact.v, contact.a, contact.n, pressed + missing, slip)
        return want

    @ti.func
    def part_by_forces(self, contact, pressed):
        """Return which part of the push of a contact counts as a force, see ForceShare."""
        v, a, b, t = contact.v, contact.a, contact.b, contact.t
        approach = -self.dev.geometry.relative(self.dev.forces.before, v, a, b, t).dot(contact.n)
        pushed = pressed * self.dev.geometry.inverse_mass(v, a, b, t) / contact.shared
        return self.dev.forces.share(approach, pushed)

    @ti.func
    def store_sums(self, i, own, now):
        """Store what the contacts of particle i sum up to."""
        self.dev.move[i] = own.move
        if now.final != 0:
            self.dev.forces.add(i, own.forced, now.first)
        if ti.static(self.dev.has_restitution):
            if now.first != 0:
                self.dev.restitution.lift[i] = own.lift
                self.dev.restitution.take_part(i, own.parts)

    @ti.func
    def store_pushes(self, i, now):
        """Store the pushes and loads of the contacts of which particle i is the vertex, after all particles have read them."""
        for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
            if self.dev.geometry.bears(e) and not self.dev.geometry.is_unchanged(i, e):
                j, part, push = self.dev.list.neighbour[e], self.dev.part.field[e], self.dev.geometry.impulse.field[e]
                if now.first != 0:
                    push += self.dev.known.known_push(e, now)
                push += part[0]
                self.dev.geometry.impulse.field[e] = push
                load = self.dev.known.update_load(i, j, e, part[0], push, now)
                if ti.static(self.dev.has_friction):
                    self.learn_friction(i, e, part[1], load > 0, now)

    @ti.func
    def learn_friction(self, i, e, part, bears, now):
        """Learn what friction holds at entry e of vertex i, of which a pass added `part`. bears: whether the contact has a load.

        What is learnt is taken from the slip, so that friction holds as much as before, and bodies stay where they are. If the
        slip went back instead, friction that bodies brought on each other as they came to rest would grow until they slide.
        """
        before = self.dev.known.friction.load.field[e]
        learnt = self.dev.known.update(self.dev.known.friction, i, self.dev.list.neighbour[e], e, part, bears, now) - before
        if bears and learnt != 0:
            at, v, a, b, t, _ = self.dev.geometry.participants(i, e, VERTEX)
            if at >= 0:
                found = self.dev.geometry.manifold.field[e]
                _, shared = self.dev.geometry.share(self.dev.depths, e, v, a, b, t)
                along = rotation.across(ti.Vector([found[2], found[3]]))
                self.dev.slip.field[e] = self.dev.slip.field[e] + learnt * now.h * now.h * shared * along

    @ti.func
    def apply_corrections(self, i, first):
        """Move particle i by its corrections. A particle that bounced is placed where it is at the end of the substep."""
        if self.dev.state.moves(i):
            if self.dev.depths[i] > 0:
                self.dev.state.shift(i, self.dev.move[i])
            if ti.static(self.dev.has_restitution):
                if first != 0:
                    self.dev.state.advance(i, self.dev.restitution.lift[i])

    @ti.func
    def finish_substep(self, i, now):
        """Update the slip of each contact at the end of a substep, as far as friction can hold it, and its last push."""
        if ti.static(bool(self.dev.known)):
            self.dev.known.carried.field[i] = self.carried_by(i)
        if ti.static(self.dev.has_friction):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                slip = 0 * self.dev.state.x[i]
                at, v, a, b, t, _ = self.dev.geometry.participants(i, e, VERTEX)
                if at >= 0:
                    found = self.dev.geometry.manifold.field[at]
                    if self.dev.geometry.bears(at):
                        n, d = ti.Vector([found[2], found[3]]), self.dev.geometry.relative(self.dev.state.d, v, a, b, t)
                        overlap, shared = self.dev.geometry.share(self.dev.depths, at, v, a, b, t)
                        moved = self.dev.slip.field[e] + d
                        if ti.static(bool(self.dev.known)):
                            along = shared * self.dev.known.known_friction(at, now) * rotation.across(n)
                            overlap = ti.max(overlap + self.dev.known.known_push(at, now) * shared, 0)
                            slip = self.table.held(v, a, n, overlap, moved - along) + along
                        else:
                            slip = self.table.held(v, a, n, overlap, moved)
                self.dev.slip.field[e] = slip
        if ti.static(self.dev.has_restitution):
            for e in range(self.dev.list.first[i], self.dev.list.first[i] + self.dev.list.number[i]):
                aim, pushed = self.dev.restitution.aim.field[e], self.dev.geometry.impulse.field[e]
                self.dev.restitution.last.field[e] = ti.select(aim.dot(aim) > 0, 0 * pushed, pushed)

    @ti.func
    def carried_by(self, i):
        """Return the acceleration of particle i by the known loads of its contacts [m/s^2]."""
        total, begin = 0 * self.dev.state.x[i], self.dev.list.first[i]
        for e in range(begin, begin + self.dev.list.number[i]):
            for role in range(self.dev.geometry.roles(i)):
                at, _, _, _, _, part = self.dev.geometry.participants(i, e, role)
                if at >= 0:
                    found = self.dev.geometry.manifold.field[at]
                    total += part * self.dev.known.force(at, ti.Vector([found[2], found[3]]))
        return self.dev.w.of(i) * total


class PolygonRestitution:
    """Restitution of vertices and edges: a contact leaves with -e times its normal velocity at impact, see under_force().

    Where constraints hold the bodies, passes beside the regular ones of the substep push them, see BodyImpacts. The pushes
    (p_n, p_t) of a contact along its normal and its tangent, in kg m, become

        p_n' = max(p_n + (aim - d.n) / K_nn, 0),

    with the inverse masses K of BodyImpacts.inverse_mass(); with friction both together, see rub(). Each vertex computes the
    pushes of its contacts, and then all particles of a contact take their parts of them.
    """

    def __init__(self, scene: Scene, geometry: PolygonGeometry, table: Table):
        n, add = scene.count, scene.memory.field
        self.geometry, self.table, self.state = geometry, table, scene.state
        self.split = add("Contact.struck", n)  # how often the mass of each particle is split: its parts in all contacts
        self.d_change = add("Contact.d_change", n, width=2)
        self.lift = add("Contact.lift", n, width=2)  # moves the position only
        self.hit = add("Contact.hit", None, kind=ti.i32)
        self.aim = PairData("aim", 2, persistent=False)  # the displacement with which each contact leaves, times its normal [m]
        self.last = PairData("pushed", 0, persistent=True)  # push of the last substep, 0 after an impact [kg m]
        # Of impacts of bodies: the sums of their pushes, the pushes of this pass, and of the last one what it was to change and
        # what it did, with the first normal push [kg m, m].
        self.push, self.step, self.noted = (
            PairData(name, width, persistent=False, is_transferred=False)
            for name, width in (("body_push", 2), ("body_step", 2), ("body_noted", 3))
        )
        self.pair_data = [self.aim, self.last, self.push, self.step, self.noted]
        self.impacts: Any = scene.impacts  # a BodyImpacts, where bodies bounce as wholes, or None

    @ti.func
    def approach(self, v, a, b, t, n):
        """Return how far vertex v and the edge from a to b came together in the last substep [m]."""
        return -self.geometry.relative(self.state.before, v, a, b, t).dot(n)

    @ti.func
    def undisturbed(self, v, a, b, t, n):
        """Return e times the approach before the substep [m]: for bodies, whose turn under_force() would take for a force."""
        return self.table.of(v, a)[2] * ti.max(self.approach(v, a, b, t, n), 0)

    @ti.func
    def parts_by_itself(self, at, v, a, b, t, n):
        """Whether a contact that bounces overlaps though it does not approach and bore no load in the last substep.

        It was left so by an impact, or found late, when corners passed each other. A push would be an impact of its own.
        """
        return self.table.of(v, a)[2] >= 1 and self.approach(v, a, b, t, n) <= 0 and self.last.field[at] == 0

    @ti.func
    def by_bodies(self, v, a, b):
        """Whether extra passes make the impact of vertex v on the edge from a to b."""
        out = False
        if ti.static(bool(self.impacts)):
            out = self.impacts.is_linked(v) or self.impacts.is_linked(a) or self.impacts.is_linked(b)
        return out

    @ti.func
    def begin(self, e, aim):
        """Store the displacement with which the contact at entry e leaves, times its normal [m]."""
        self.aim.field[e] = aim
        self.push.field[e], self.step.field[e] = 0 * aim, 0 * aim
        self.noted.field[e] = 0 * self.noted.field[e]

    @ti.func
    def take_part(self, i, parts):
        """Store the sum of the parts of particle i in impacts of bodies."""
        if ti.static(bool(self.impacts)):
            self.impacts.parts[i] = parts

    @ti.func
    def target(self, at, v, a, b, t, n, overlap, leaving):
        """Return the displacement with which a contact leaves, what it lacks of it, and how far it gets in this substep [m].

        leaving: the present displacement along n [m]. Unless e is 1, a contact rests if it would leave by no more than its
        overlap before the substep and its push in the last substep: then it came no faster than its load brings it. Unless e is
        1, it also rests where SLOW substeps of forces gave it its speed. Otherwise heaps would hop on: each corner returns what
        the bounce of another one took.
        """
        approach, restitution = self.approach(v, a, b, t, n), self.table.of(v, a)[2]
        aim, missing, lift = restitution * ti.max(approach, 0), 0 * overlap, 0 * overlap
        held = self.last.field[at] * self.geometry.inverse_mass(v, a, b, t)
        fast = approach > ti.static(SLOW) * (-leaving - approach)
        if approach > 0 and (restitution >= 1 or (fast and (held == 0 or aim > overlap + leaving + held))):
            missing = ti.max(aim - (overlap + leaving), ti.static(AIM))  # more overlap than that would become speed
            if overlap <= -leaving:
                lift = restitution * overlap
            given, left = under_force(0 * overlap, 0 * overlap, -leaving, approach, overlap, restitution)
            if given > 0:
                aim, missing, lift = given + leaving, given, left * given - overlap
        return aim, missing, lift

    @ti.func
    def choose(self, i):
        """Compute one Jacobi pass over displacements only: what the bouncing contacts of particle i lack."""
        total = 0 * self.state.x[i]
        if self.split[i] > 0:
            begin = self.geometry.list.first[i]
            for e in range(begin, begin + self.geometry.list.number[i]):
                for role in range(self.geometry.roles(i)):
                    at, v, a, b, t, part = self.geometry.participants(i, e, role)
                    if at >= 0:
                        aim = self.aim.field[at]
                        size = aim.norm()
                        if size > 0 and not self.by_bodies(v, a, b):
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
        """Change the displacement of particle i, and its displacement before the substep."""
        self.state.d[i] = self.state.d[i] + self.d_change[i]
        self.state.before[i] = self.state.before[i] + self.d_change[i]

    @ti.func
    def inverse_mass(self, v, a, b, t, n, m):
        """Return BodyImpacts.inverse_mass() of the contact of vertex v with the edge from a to b, for directions n and m."""
        edge = (1 - t) * self.impacts.inverse_mass(a, n, m) + t * self.impacts.inverse_mass(b, n, m)
        if ti.static(self.impacts.clusters):
            if self.impacts.in_cluster(a) and self.impacts.in_cluster(b) and self.impacts.body[a] == self.impacts.body[b]:
                arm = (1 - t) * self.impacts.arm[a] + t * self.impacts.arm[b]
                edge = n.dot(self.impacts.cluster_response(self.impacts.body[a], arm, m))
        return self.impacts.inverse_mass(v, n, m) + edge

    @ti.func
    def push_body(self, i, now):
        """In an extra pass: compute the pushes of the contacts of vertex i. Returns whether any of them was off."""
        off = False
        if self.impacts.parts[i] > 0:
            for e in range(self.geometry.list.first[i], self.geometry.list.first[i] + self.geometry.list.number[i]):
                at, v, a, b, t, _ = self.geometry.participants(i, e, VERTEX)
                aim = self.aim.field[e]
                size = aim.norm()
                if at >= 0 and size > 0:
                    if self.by_bodies(v, a, b):
                        off = self.correct(e, v, a, b, t, aim / size, size, now) or off
        return off

    @ti.func
    def correct(self, e, v, a, b, t, n, aim, now):
        """Correct the push of the contact at entry e, of vertex v on the edge from a to b. Returns whether it was off."""
        d, along = self.geometry.relative(self.state.d, v, a, b, t), rotation.across(n)
        last, noted = self.push.field[e], self.noted.field[e]
        bend = self.impacts.path_bend(v, n) - (1 - t) * self.impacts.path_bend(a, n) - t * self.impacts.path_bend(b, n)
        if ti.static(self.impacts.clusters):
            if noted[0] == 0:  # Newton's law holds for tangents, see ClusterImpact
                approach = self.approach(v, a, b, t, n)
                if approach > 0:
                    aim = ti.max(aim * (1 - bend / approach), ti.static(AIM))
                    self.aim.field[e] = aim * n
        lack = aim + bend - d.dot(n)
        give = self.inverse_mass(v, a, b, t, n, n)
        if ti.static(self.impacts.exact):
            if noted[1] != 0 and not (self.impacts.in_cluster(v) and self.impacts.in_cluster(a) and self.impacts.in_cluster(b)):
                give *= self.impacts.part_left(noted[2] - lack, noted[1])
        push = ti.Vector([ti.max(last[0] + lack / give, 0), 0 * lack])
        if ti.static(self.table.has_friction):
            push = self.rub(last, push[0], lack, d.dot(along), give, v, a, b, t, n, along)
        step = push - last
        first = ti.select(noted[0] == 0, step[0], noted[0])
        off = ti.max(abs(step[0]), abs(step[1])) > ti.static(FINE) * first
        if not (off and self.impacts.has_next_pass(now)):
            step *= 0  # no pass would follow, in which constraints take it up
        self.noted.field[e] = ti.Vector([first, give * step[0], lack])
        self.push.field[e], self.step.field[e] = last + step, step
        self.geometry.impulse.field[e] = self.geometry.impulse.field[e] + step[0]
        return off

    @ti.func
    def rub(self, last, smooth, lack, slip, give, v, a, b, t, n, along):
        """Return the pushes along n and across it, where friction takes back the slip as far as it can.

        last: the pushes before. smooth: the push along n without friction. The two equations of a contact are solved together:
        an impulse across n also turns bodies, and so changes the velocity along n.
        """
        both, across = self.inverse_mass(v, a, b, t, n, along), self.inverse_mass(v, a, b, t, along, along)
        row, det = self.table.of(v, a), give * across - both * both
        out = ti.Vector([smooth, 0 * smooth])
        if det > 0:
            stick = last + ti.Vector([across * lack + both * slip, -both * lack - give * slip]) / det
            if stick[0] > 0 and abs(stick[1]) <= row[0] * stick[0]:
                out = stick
            else:
                mu = ti.math.sign(stick[1]) * row[1]
                slides = give + mu * both
                if slides > give / 2:
                    out[0] = ti.max((lack + give * last[0] + both * last[1]) / slides, 0)
                out[1] = mu * out[0]
        return out

    @ti.func
    def apply_push(self, i):
        """Give particle i its parts of what push_body() found. Clusters take it up in the next pass."""
        if self.impacts.parts[i] > 0:
            total, begin = 0 * self.state.x[i], self.geometry.list.first[i]
            for e in range(begin, begin + self.geometry.list.number[i]):
                for role in range(self.geometry.roles(i)):
                    at, v, a, b, t, part = self.geometry.participants(i, e, role)
                    if at >= 0:
                        aim, step = self.aim.field[at], self.step.field[at]
                        size = aim.norm()
                        if size > 0 and self.by_bodies(v, a, b):
                            n = aim / size
                            total += part * self.state.w.of(i) * (step[0] * n + step[1] * rotation.across(n))
            if self.impacts.in_cluster(i):
                self.impacts.change[i] = total
            else:
                self.state.shift(i, total)
            self.impacts.reached[i] = 1


@ti.func
def under_force(impact, left, closing, approach, overlap, e):
    """Return the impact of a pair in a substep in which a force acts, and the fraction of the substep after the impact.

    The impact is the change of displacement from approach to separation [m]. Returns `impact` and `left` if no force acts, or
    if the pair would not be free of overlap at the end.

    In units of the substep, the pair approaches by `closing`, of which forces added f = closing - approach. At time s it has
    moved by u s + f s^2 / 2, u = closing - f / 2, with the velocity u + f s. It meets at s = 2 gap / (u + sqrt(u^2 + 2 f gap)),
    gap = closing - overlap. It leaves at e times its velocity at that time, and falls back by f (1 - s)^2 / 2. So energy is
    conserved at e = 1, whatever s is: a change J of the velocity at s changes the energy of d and x at the end by
    J (J / 2 - u - f s).
    """
    f, gap = closing - approach, closing - overlap
    u = closing - f / 2
    if f != 0 and gap > 0 and u > 0:
        s = ti.min(2 * gap / (u + ti.sqrt(ti.max(u * u + 2 * f * gap, 0))), 1)
        met = closing + (s - 0.5) * f
        if e * met > ti.max((1 - s) * f / 2, 0):
            impact, left = (1 + e) * met, 1 - s
    return impact, left
