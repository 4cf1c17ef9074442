"""Contacts of discs and spheres."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import inline, ti
from ..device.thread_team import Team
from ..features.feature import Batch, Knob, Scene
from ..features.material import TANGENTIAL, is_elastic, refuse_turning
from ..features.regrouping import Regrouping
from ..geometry.ordered import median
from ..neighbours.neighbour_list import PairData
from ..neighbours.neighbour_search import NeighbourSearch
from ..particles import Particles
from .answers import Answers
from .body_projection import BodyProjection
from .body_restitution import BodyRestitution
from .each_once import ROUNDS, EachOnce
from .events import EventLog
from .exclusions import excluded_pairs
from .force_share import ForceShare
from .impact_projection import ImpactProjection
from .impulses import Impulses
from .islands import Islands
from .known_loads import KnownLoads
from .limits import AHEAD, CRADLE, THROWN
from .mass_splitting import MassSplitting, lesser
from .narrow_phase import DiscGeometry
from .pair import Pair, PairSums
from .pair_contact import PairContact
from .places import Places
from .responses import FreeParticles
from .restitution import Restitution
from .rows import Rows
from .spinning import Spinning
from .velocity_projection import VelocityProjection

RELAXATION = 1.25  # below 4/3, see Contact
CARRY = 0.4  # largest share of its last push that a pair keeps; below 1/2


class Contact(PairContact):
    """Contacts of discs and spheres: no two of them overlap.

    C(x) = |x_i - x_j| - (r_i + r_j) >= 0 for all pairs, with Coulomb friction and restitution. See README.md in contact for the
    law, and for where worlds still use an older one: with constraints, and with restitution above 0.97.

    friction: Coulomb friction, a number, (static, dynamic) or (static, dynamic, rolling, twisting), or a mapping from pairs of
    groups to these: {(0, 1): 0.5}. Friction turns particles that spin. rolling, twisting: against rolling, a moment of up to
    rolling * r times the normal force with r = r_i r_j / (r_i + r_j), and against spinning about the normal (Luding 2008).
    restitution: 0 to 1, (normal, tangential), or such a mapping. A bounce keeps the square of it of the energy along the normal,
    whatever the substep. tangential: points that touch leave across the normal at -tangential times their velocity, as far as
    friction holds it; 0 grips, 1 is a super ball (Walton 1993).
    groups: the pairs of groups that touch, None for all.
    skin: how far beyond contact distance pairs are listed [m], "auto" for 0.75 of the median radius. It affects speed only, never
    the result.
    push_out: largest speed [m/s] at which two particles part that overlap; None, the default, for a quarter of the smaller radius
    in a substep. In a cluster the rim moves as many times faster as there are pairs on the way to it.
    events: whether World.events() reports which pairs met and parted.
    sensors: pairs of groups that do not touch. World.events() reports which particles of the second group, the sensors, overlap
    particles of the first group. It costs least where sensors are few.
    loads: whether pairs store the load that they bear at rest. They do, unless restitution is above 0.97, see known_loads.py.

    Two particles in the same place part in a direction computed from their indices. Linked particles (Distance, Rope, Spacer) do
    not touch, nor do particles that a chain of links holds closer than the sum of their radii, see exclusions.py.
    """

    def __init__(
        self, friction: ArrayLike | Mapping = 0.0, restitution: ArrayLike | Mapping = 0.0, *, skin: float | str = "auto",
        groups=None, push_out: float | None = None, events: bool = False, sensors=(), loads: bool = False,
    ):  # fmt: skip
        self.groups, self.sensors, self.restitution, self.friction = groups, sensors, restitution, friction
        self.skin, self.push_out, self.events, self.loads = skin, push_out, events, loads

    events = Knob(lambda f, v: checks.flag("Contact", "events", v), "Whether World.events() tells of pairs.", compiled=True)
    loads = Knob(lambda f, v: checks.flag("Contact", "loads", v), "Whether pairs know what they bear.", compiled=True)
    sensors: Any = Knob(lambda f, v: f._surface("sensors", v), "The pairs of groups of which the second senses.", built=True)
    groups: Any = Knob(lambda f, v: f._surface("groups", v), "The pairs of groups that touch; None for all.", built=True)

    can_keep_stiffness = True
    compiled_for = (*PairContact.compiled_for, "in_turn")

    @property
    def in_turn(self) -> bool:
        """Whether impacts pass on from particle to particle, see impacts.py."""
        bounces = [self.restitution, *(w.restitution for w in self.walls)]
        values = [e for v in bounces for e in (v.values() if isinstance(v, Mapping) else [v])]
        return any(float(np.ravel(e)[0]) > CRADLE for e in values)

    @property
    def solves_rows(self) -> bool:
        """Whether pairs and walls are rows, see rows.py. README.md in step says where they are not."""
        return True

    @property
    def projects(self) -> bool:
        """Whether it has a velocity projection of loaded pairs."""
        return not self.solves_rows

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Choose the skin, and refuse positions too far out for the cells."""
        if self.wanted.turns and not particles.spins:
            refuse_turning("Contact")
        self._measure(particles.radius)
        self._keep(can_touch=bool((particles.radius > 0).any()), table=self.wanted)
        if self.can_touch:
            self.check_range(particles.position)

    def _measure(self, radius: np.ndarray) -> None:
        """Store the skin [m] and the smallest radius [m] of particles with these radii (n,) [m]."""
        some = radius[radius > 0]
        auto = 0.75 * median(some) if len(some) else 1.0
        self._present_skin = auto if self.skin == "auto" else float(self.skin)
        self._ahead = (THROWN if self.in_turn else AHEAD) * median(some) if len(some) else 0.0
        self._smallest_radius = float(radius.min(initial=np.inf))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can come and go in place: not if the blocks or the neighbour search would differ."""
        dev, now = self.dev, change.now
        if not self.can_touch:
            return not bool((now.radius > 0).any())
        splits = dev.rows or (
            dev.splitting.can_regroup(dev.list.team.piece_of(now.count)) and dev.projection.can_regroup(now.mass)
        )
        return bool(splits) and bool((now.radius > 0).any()) and dev.search.can_regroup(change, now.radius)

    def regroup(self, change: Regrouping) -> None:
        """Resize the fields after particles came and went. The thread team already has the new number."""
        if not self.can_touch:
            return
        dev, n = self.dev, change.now.count
        self._measure(change.now.radius)
        self.table.regroup(self.scene, change.now.group)
        if dev.rows:
            dev.search.regroup(change, self._present_skin, change.now.radius, ahead=self._ahead)
            dev.impulses.regroup(n)
            dev.rows.ahead = self._ahead
            return
        dev.search.regroup(change, self._present_skin, change.now.radius)
        dev.splitting.regroup(n)
        dev.projection.regroup(n, dev.list.team)

    def enter(self, scene: Scene) -> None:
        """Store the scene, and fix what kernels contain."""
        super().enter(scene)
        self.dev.spins, self.dev.axes = scene.state.spins and self.dev.has_friction, scene.particles.axes

    def make_search(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields and the neighbour search, and return the search."""
        dim, dev = scene.particles.dim, self.dev
        if self.solves_rows:
            return self._make_rows(scene, batches, team)
        linked = excluded_pairs(batches, scene.particles.radius)
        dev.move = scene.memory.field("Contact.move", scene.count, width=dim)
        self.table.bind(scene)
        # The push of the pair in the last substep, per inverse mass [kg m].
        dev.push = PairData("push", 0, persistent=True, only_touching=True)
        dev.slip = PairData("slip", dim, persistent=True, ends_with_touch=True)
        dev.turn = PairData("turn", dev.axes, persistent=True, ends_with_touch=True) if dev.turns else None
        dev.slack = PairData(
            "slack", 0, persistent=True, only_touching=True
        )  # the part of the overlap that is not pushed out [m]
        dev.impulse = PairData("given", 0, persistent=True, for_reports=True)  # pushes and impacts in the last substep [kg m]
        dev.has_loads = self.has_loads
        dev.known = KnownLoads(scene) if dev.has_loads else None
        loads = dev.known.pair_data if dev.known else []
        struck, bouncing = PairData("struck", 0, persistent=False), [dev.slack] if dev.has_restitution else []
        bodies = BodyRestitution(scene, self.table) if scene.impacts and scene.impacts.pairs else None
        pair_data = [
            dev.push,
            *loads,
            *([dev.slip] if dev.has_friction else []),
            *([dev.turn] if dev.turn else []),
            *([*bouncing, struck, dev.impulse] if dev.has_restitution else []),
            *(bodies.pair_data if bodies else []),
        ]
        dev.bodies = None if dev.has_restitution else BodyProjection.made(scene, batches, self.table, 1)
        if dev.bodies:
            pair_data += dev.bodies.pair_data
        dev.events = EventLog(scene, self.table) if dev.has_events else None
        if dev.events:
            pair_data.append(dev.events.touched)
        reported = dev.events if dev.reports else None
        given = PairData("landed", 0, persistent=False)
        if self.lands and (reported or dev.has_friction):
            pair_data.append(given)
        dev.search = NeighbourSearch(scene, self._present_skin, linked, self.table, pair_data, team, dev.move)
        dev.list = dev.search.list
        dev.geometry = DiscGeometry(scene, dev.search, self.speed_of_parting, dev.impulse if dev.has_restitution else dev.push)
        if dev.events:
            dev.events.bind(dev.list, dev.geometry)
        # With restitution relax() has to clear the last impacts, so no block is skipped.
        skips = not scene.memory.compiler.few and not dev.has_restitution
        ended = [dev.push, *loads, *bouncing]
        slid = [*([dev.slip] if dev.has_friction else []), *([dev.turn] if dev.turn else [])]
        dev.splitting = MassSplitting(scene, dev.geometry, slid, skips, dev.push, ended, team, dev.known)
        if dev.known:
            dev.known.bind(dev.list, dev.geometry)
        dev.each_once = EachOnce(dev.list, dev.splitting)
        dev.forces = ForceShare(scene, sums=dev.has_friction, lasting=True)
        dev.fast = scene.memory.field("Contact.fast", None, kind=ti.i32)
        dev.restitution = None
        if dev.has_restitution:
            dev.restitution = Restitution(scene, dev.geometry, self.table, struck, dev.slack, dev.impulse, reported, bodies)
            dev.hit = dev.restitution.hit
        dev.spinning = Spinning(scene, self.table, dev.splitting.weight, dev.turn) if dev.spins else None
        dev.projection = VelocityProjection(scene, dev.geometry, dev.push, dev.splitting.weight, dev.restitution, dev.move, team)
        dev.landing = None
        if self.lands:
            dev.landing = ImpactProjection(
                scene, dev.geometry, self.table, dev.push, dev.slip, dev.splitting, dev.move, reported, given,
                dev.projection.ring, dev.restitution, dev.spinning,
            )  # fmt: skip
        dev.once = self._solves_once(scene, team)
        return dev.search

    def _make_rows(self, scene: Scene, batches: list[Batch], team: Team) -> NeighbourSearch:
        """Declare the fields of contacts that are rows, and return the neighbour search."""
        dev = self.dev
        face = 0
        for group in scene.walls:
            face = group.number_faces(scene, face)
        friction = dev.has_friction or any(w.has_friction for w in self.walls)
        bounces = dev.has_restitution or any(w.has_restitution for w in self.walls)
        self.table.bind(scene, friction or bounces)
        turns = scene.state.spins and friction and (dev.turns or any(w.turns for w in self.walls))
        dev.rows = Rows(scene, self.table, friction, bounces, self.in_turn, turns, scene.walls, team, self.push_out, self._ahead)
        dev.answers = Answers(scene, batches, dev.rows) if batches else None
        dev.responses = FreeParticles(scene, dev.rows, scene.state.spins and friction, dev.answers)
        dev.islands = Islands(scene, dev.rows, dev.responses, team)
        dev.impulses = Impulses(scene, dev.rows, dev.responses, team)
        dev.places = Places(scene, dev.rows, dev.responses, dev.impulses, team)
        linked = excluded_pairs(batches, scene.particles.radius)
        dev.events = EventLog(scene, self.table) if dev.has_events else None
        pair_data = [
            dev.rows.memory,
            *([dev.rows.touched] if bounces else []),
            *([dev.rows.borne_moment] if turns else []),
            *([dev.events.touched] if dev.events else []),
        ]
        dev.search = NeighbourSearch(
            scene, self._present_skin, linked, self.table, pair_data, team, dev.responses.push, walls=scene.walls,
            ahead=self._ahead,
        )  # fmt: skip
        dev.list = dev.search.list
        dev.geometry = DiscGeometry(scene, dev.search, 0.0, dev.rows.memory)
        if dev.events:
            dev.events.bind(dev.list, dev.geometry)
            dev.rows.events = dev.events if dev.reports else None
        dev.rows.bind(dev.list, dev.geometry)
        dev.fast = scene.memory.field("Contact.fast", None, kind=ti.i32)
        dev.bodies = dev.landing = dev.known = dev.restitution = dev.forces = dev.projection = dev.splitting = None
        dev.has_loads, dev.once = False, False
        return dev.search

    def _solves_once(self, scene: Scene, team: Team) -> bool:
        """Whether each pair is solved once, see EachOnce: not where a GPU's threads, or what rests, take other turns. What spins
        or bounces, and rigid bodies, have sums of their own; small worlds compile faster without."""
        dev = self.dev
        alike = not (dev.has_restitution or dev.spins or dev.bodies or scene.state.sleepers)
        both = not (dev.search.has_static and (dev.has_loads or dev.reports))  # static particles store nothing of a pair
        return alike and both and not team.launched and not scene.memory.compiler.few

    @property
    def once(self) -> bool:
        """Whether each pair is solved once, in rounds."""
        return self.dev.once

    def keep_stiffness(self, ratio: float) -> None:
        """Push as hard as before where the next substep is `ratio` times as long as the last one.

        A pair is a spring of stiffness r / (M h^2), with the split masses M. So M is divided by ratio^2, and what pairs pushed in
        a substep, which is proportional to h^2, is multiplied by it. M goes back by itself, see MassSplitting.split().
        """
        dev = self.dev
        self.scene.memory.write(dev.splitting.weight, self.scene.memory.read(dev.splitting.weight) / ratio**2)
        for piece in (dev.push, *([dev.known.borne] if dev.known else [])):
            dev.list.scale(piece, ratio**2)

    @property
    def conserves(self) -> bool:
        """Whether pairs leave each other with the energy that they had."""
        return is_elastic(self.friction, self.restitution)

    @property
    def strikes_bodies(self) -> bool:
        """Whether bodies of linked particles bounce as wholes: with restitution, unless friction turns particles."""
        return self.dev.has_restitution and not self.dev.spins

    @ti.func
    def is_pressed(self, i, e):
        """Whether particle i and the particle at entry e of its list press on each other."""
        if ti.static(bool(self.dev.rows)):
            return self.dev.rows.is_set(self.dev.rows.memory.field[e]) or self.dev.geometry.push_each_other(
                i, self.dev.list.neighbour[e], 0
            )
        return self.dev.push.field[e] > 0 or self.dev.geometry.push_each_other(i, self.dev.list.neighbour[e], 0)

    @ti.func
    def pressed_particle(self, j):
        """Return the particle that is pressed where an entry of a list is j: for discs, j itself."""
        return j

    @ti.func
    def touched_sleeper(self, i, e, margin):
        """Return the particle at entry e of the list of i if it sleeps and i is within `margin` [m] of it, else -1.

        A driven particle i also reaches a sleeping particle that it touched as the substep began.
        """
        j, out = self.dev.list.neighbour[e], -1
        if not self.dev.state.awake(j):
            met = self.dev.geometry.push_each_other(i, j, margin)
            if not self.dev.w.positive(i):
                r, distance = self.dev.state.separation(i, j) - self.dev.state.d[i], self.dev.geometry.contact_distance(i, j)
                met = met or r.dot(r) < distance * distance
            out = ti.select(met, j, -1)
        return out

    @ti.func
    def count(self, begin, end, now):
        """Find the touching pairs of particles begin ... end - 1, and how often their masses are split."""
        self.dev.splitting.count(begin, end, now)

    @ti.func
    def may_project(self, now):
        """Whether displacements may be projected after this substep, so that the pushes of walls have to be known."""
        out = True
        if ti.static(not (self.dev.bodies or self.dev.landing or self.dev.projection.unequal)):
            out = self.dev.projection.is_due(now)
        return out

    @ti.func
    def busy(self, begin):
        """Return 0 if no particle in the block that begins at `begin` touches another."""
        return self.dev.splitting.busy(begin)

    @ti.func
    def begin(self, i, now):
        """Begin the pass of particle i, in which pairs add up its corrections."""
        nothing = ti.Vector.zero(self.scene.real, self.dev.state.dim)
        self.dev.each_once.begin(i)
        if ti.static(self.dev.projection.unequal):
            self.dev.projection.begin_strike(i)
        self.dev.move[i] = nothing
        if ti.static(self.dev.has_loads):
            self.dev.known.carried.field[i] = nothing
        if ti.static(self.dev.geometry.shrinks):
            self.dev.geometry.held[i] = 0
        if ti.static(self.dev.has_friction):
            if now.final != 0 and now.first != 0:
                self.dev.forces.sum[i] = nothing

    @ti.func
    def relax(self, i, turn, now):
        """Compute the corrections of particle i by its pairs of this turn, and the new pushes of these pairs.

        For each pair: find the overlap and the normal; compute what this pass adds to the push along the normal, then friction;
        store the push, and give the opposite to the other particle if the pair is solved once.
        """
        own = self.begin_sums(i, now)
        for word in range(self.word_count(i, own, turn)):
            bits = self.pairs_of_turn(i, word, turn)
            while bits != 0:
                e = self.dev.list.entry(i, word, bits)
                bits &= bits - ti.u32(1)
                j, other, sign = self.dev.list.neighbour[e], -1, ti.cast(1, self.scene.real)
                if ti.static(self.dev.once):
                    other = self.dev.each_once.take_over(i, j, turn)
                    if not self.dev.w.positive(i):  # a particle that cannot move stores nothing of a pair
                        if other < 0:
                            continue
                        e, sign = other, -sign
                pair = self.measure(i, j, e, other, sign, own, now)
                self.note_overlap(pair, own, now)

                # Along the normal: the push of this substep before this pass, `known` of it by a known load, and the part added.
                before, known = self.push_before(pair, own, now)
                overlap, impact, rests = pair.overlap, ti.zero(pair.overlap), True
                if ti.static(self.dev.has_restitution):
                    impact, slack, rests = self.bounce(pair, now)
                    overlap -= self.dev.restitution.remove_slack(pair, slack, own, now)
                    if ti.static(bool(self.dev.landing)):
                        if rests and now.first != 0:
                            self.dev.landing.note(pair, now.h)
                part = self.added_push(pair, overlap, before, own)
                if ti.static(self.dev.has_restitution):
                    impact = self.dev.restitution.strike(pair, impact, own)
                    if not rests:
                        part, before = ti.zero(part), before - known
                if ti.static(bool(self.dev.bodies)):
                    if self.is_left_to_bodies(pair, now):
                        part, before = -known, known  # it pushes nothing, and has no load
                push, pressed = before + part, part + known

                # What later substeps and the user get to know of it.
                load = 0 * pair.n
                if ti.static(self.dev.has_loads):  # along the normal as the next substep starts
                    load = self.dev.known.update_load(i, j, e, part, push, now) * self.dev.geometry.direction(i, j)
                    own.carried += own.w * load
                if ti.static(self.dev.has_restitution):
                    self.dev.impulse.field[e] = self.dev.impulse.field[e] + pressed
                if ti.static(self.dev.reports):
                    self.dev.events.record(i, j, e, pair.n, pressed, now.final)

                # As a vector, with friction: what both particles get.
                want, force = part * pair.n, 0 * pair.n
                if ti.static(self.dev.has_friction):
                    want, force = self.add_friction(pair, part, pressed, impact, own, now)
                own.move += own.w * want
                self.store_push(i, e, push)
                if ti.static(self.dev.once):
                    if other >= 0:
                        self.push_back(pair, push, want, load, force, now)
        self.store_sums(i, own, turn, now)

    @ti.func
    def begin_sums(self, i, now):
        """Return the sums of particle i as its turn begins: 0, or what particles before it have added, see EachOnce.

        Also clear what its pairs note anew in each substep.
        """
        move = ti.Vector.zero(self.scene.real, self.dev.state.dim)
        lift, rubbed, forced, carried = move, move, move, move
        turned = ti.Vector.zero(self.scene.real, self.dev.axes)
        turned_by_force = turned
        excess, impacts = ti.cast(0, self.scene.real), ti.cast(0, self.scene.real)
        w, split = self.dev.w.of(i), self.dev.splitting.weight[i]
        again = ti.cast(ti.select(now.first == 0, 1, 0), self.scene.real)
        # After a start pairs go on, too, if only the substep has another length. Worlds with restitution start from the
        # velocities that users read, and need half of the push first, as C gives it alone.
        goes_on = now.fresh == 0
        if ti.static(not self.dev.has_restitution):
            goes_on = goes_on or now.span.since > 0
        carries = ti.cast(ti.select(now.first != 0 and goes_on, 1, 0), self.scene.real)
        if ti.static(self.dev.has_restitution):
            if now.first != 0:
                self.dev.restitution.clear(i, split)
        if ti.static(self.dev.projection.unequal and not self.dev.once):
            self.dev.projection.begin_strike(i)
        if ti.static(self.dev.has_friction):
            if now.final != 0 and (now.first == 0 or ti.static(self.dev.once)):
                forced = self.dev.forces.sum[i]
        if ti.static(self.dev.once):
            move = self.dev.move[i]
            if ti.static(self.dev.has_loads):
                carried = self.dev.known.carried.field[i]
            if ti.static(self.dev.geometry.shrinks):
                excess = self.dev.geometry.held[i]
        return PairSums(w, split, again, carries, move, lift, rubbed, forced, turned, turned_by_force, carried, excess, impacts)

    @inline
    def word_count(self, i, own, turn):
        """Return the number of words of pairs_of_turn()."""
        once, listed = self.dev.each_once, self.dev.list
        return once.word_count(i, turn) if self.dev.once else ti.select(own.split > 0, listed.word_count(i), 0)

    @inline
    def pairs_of_turn(self, i, word, turn):
        """Return the bits of the pairs of this turn, in one word of the list of particle i."""
        return self.dev.each_once.bits(i, word, turn) if self.dev.once else self.dev.splitting.touching(i, word)

    @ti.func
    def measure(self, i, j, e, other, sign, own, now):
        """Return the Pair of particles i and j, with its overlap, its normal and its inverse masses."""
        last, shared = self.dev.push.field[e], own.split + self.dev.splitting.weight[j]
        contact_distance, bears = self.dev.geometry.contact_distance(i, j), last > 0 and now.first != 0
        if ti.static(self.dev.has_loads):
            bears = bears or self.dev.known.load.field[e] > 0
        overlap, stiffness, n, reach = self.dev.geometry.impact(i, j, contact_distance, shared, bears)
        stiffness *= ti.static(RELAXATION)
        alone = own.w + self.dev.w.of(j)
        carry = ti.max(lesser(1 - alone * stiffness, ti.static(CARRY)), 0)
        return Pair(i, j, e, other, sign, overlap, n, reach, last, shared, alone, stiffness, carry)

    @ti.func
    def note_overlap(self, pair, own, now):
        """Note the overlap of a pair, for particles that grow back and for projections."""
        if ti.static(self.dev.geometry.shrinks):
            own.excess = ti.max(own.excess, self.dev.geometry.excess(pair.i, pair.j, pair.n, pair.overlap, now.h))
        if ti.static(self.dev.projection.unequal):
            if now.first != 0:
                borne = pair.alone * pair.last
                self.dev.projection.note_pair(pair.i, pair.j, pair.n, pair.overlap, borne)
                if pair.other >= 0:
                    self.dev.projection.note_pair(pair.j, pair.i, -pair.n, pair.overlap, borne)
        if ti.static(bool(self.dev.landing) and not self.dev.has_restitution):
            if now.first != 0:
                self.dev.landing.note(pair, now.h)

    @ti.func
    def push_before(self, pair, own, now):
        """Return the push of a pair in this substep before this pass, and the part of it that its known load gave [kg m].

        The load counts in the first pass. Later passes find it in the push.
        """
        push, known = own.again * pair.last, ti.zero(pair.overlap)
        if ti.static(self.dev.has_loads):
            if now.first != 0:
                known = self.dev.known.known_push(pair.e, now)
                push = known
        return push, known

    @ti.func
    def bounce(self, pair, now):
        """Return the impact of a pair [m], its slack [m], and whether it rests, see Restitution.bounce()."""
        bearing = pair.overlap
        if ti.static(self.dev.has_loads):  # with the overlap that would hold the known load
            per_push = ti.max((1 - pair.carry) / pair.stiffness, pair.alone)
            bearing = ti.max(pair.overlap, 0) + per_push * self.dev.known.known_push(pair.e, now)
        slack = self.dev.slack.field[pair.e]
        return self.dev.restitution.bounce(pair.i, pair.j, pair.n, bearing, slack, pair.last, now.first)

    @ti.func
    def added_push(self, pair, overlap, before, own):
        """Return what this pass adds to the push `before` of a pair, to take back an overlap: r C / M + c p_last, see Contact.

        It is no more than separates the pair alone. Contacts may take back what a known load gave, but never pull.
        """
        part = overlap * pair.stiffness + pair.carry * (own.carries * (pair.last - before))
        if ti.static(self.dev.has_loads):
            part = ti.select(overlap > 0, lesser(part, overlap / pair.alone), ti.max(part, overlap / pair.alone))
            part = ti.max(part, -before)
        else:
            part = lesser(part, overlap / pair.alone)  # no branch: it would be mispredicted
        return part

    @ti.func
    def is_left_to_bodies(self, pair, now):
        """Whether a pair is an impact that BodyProjection solves after the passes. The first pass of a substep decides."""
        struck = self.dev.bodies.struck.field[pair.e] != 0
        if now.first != 0:
            borne, place = pair.alone * pair.last, 0 * pair.alone
            struck = pair.overlap > 0 and self.dev.bodies.strikes(self.dev.geometry, pair.i, pair.j, pair.j, place, pair.n, borne)
        self.dev.bodies.note(pair.e, pair.n, struck)
        return struck

    @ti.func
    def add_friction(self, pair, part, pressed, impact, own, now):
        """Return the push of a pair with friction, and the part of friction that counts as a force, both vectors [kg m].

        part: the push along the normal that this pass adds [kg m]. Friction is bounded by `pressed`, the same with the known load
        [kg m], and by the impact [m]. own: gets the sums that only friction needs.
        """
        want, force, left = part * pair.n, 0 * pair.n, ti.zero(part)  # left: the part of the substep after the impact
        if ti.static(self.dev.has_restitution):
            if impact > 0:
                impact, left, _approach = self.dev.restitution.collision(pair.i, pair.j, pair.n, pair.overlap)
        if ti.static(self.dev.spins):
            across, turned = self.spin_friction(pair, pressed + impact / pair.shared, impact > 0)
            want += across
            if ti.static(self.dev.has_restitution):
                if impact > 0:  # friction of an impact acts from the time of impact on
                    own.lift -= (1 - left) * own.w * across
            own.turned += own.w * turned
            if now.final != 0:
                share = self.dev.forces.share_of(pair.i, pair.j, pair.n, pressed * pair.alone) * own.w
                own.forced += share * across
                own.turned_by_force += share * turned
        else:
            slip = pair.sign * self.dev.slip.field[pair.e]
            want -= self.held(pair.i, pair.j, pair.n, pressed * pair.shared + impact, slip) / pair.shared
            if now.final != 0:
                share = self.dev.forces.share_of(pair.i, pair.j, pair.n, pressed * pair.alone)
                force = share * (want - part * pair.n)
                own.forced += own.w * force
        if ti.static(self.dev.has_restitution):
            if impact > 0:
                own.rubbed += own.w * (want - part * pair.n)
        return want, force

    @ti.func
    def store_push(self, i, e, push):
        """Store the push of the pair at entry e of the list of particle i, unless i cannot move, see NeighbourSearch."""
        if self.dev.w.positive(i):
            self.dev.push.field[e] = push
            if push == 0:
                self.dev.splitting.invalidate_bound(i)

    @ti.func
    def push_back(self, pair, push, want, load, force, now):
        """Give particle j of a pair the opposite of what i gets.

        want: the push [kg m]. load: the known load [N]. force: the part of friction that counts as a force [kg m]. All vectors.
        """
        j, w = pair.j, self.dev.w.of(pair.j)
        self.dev.move[j] = self.dev.move[j] - w * want
        self.store_push(j, pair.other, push)
        if ti.static(self.dev.has_loads):
            self.dev.known.push_back(j, pair.e, pair.other, load)
        if ti.static(self.dev.geometry.shrinks):
            excess = self.dev.geometry.excess(j, pair.i, -pair.n, pair.overlap, now.h)
            self.dev.geometry.held[j] = ti.max(self.dev.geometry.held[j], excess)
        if ti.static(self.dev.has_friction):
            if now.final != 0:
                self.dev.forces.sum[j] = self.dev.forces.sum[j] - w * force

    @ti.func
    def store_sums(self, i, own, turn, now):
        """Store what particle i has summed up over its pairs."""
        self.dev.move[i] = own.move
        if ti.static(self.dev.projection.unequal):
            if now.first != 0 and turn.round == ROUNDS - 1:
                self.dev.projection.note_struck(i)
        if ti.static(self.dev.geometry.shrinks):
            self.dev.geometry.held[i] = own.excess
        if ti.static(self.dev.has_loads):
            self.dev.known.carried.field[i] = own.carried
        if ti.static(self.dev.spins):
            self.dev.spinning.change[i] = own.turned
            if now.final != 0:
                self.dev.forces.add_turn(i, own.turned_by_force, now.first)
        if ti.static(self.dev.has_friction):
            if now.final != 0:
                self.dev.forces.sum[i] = own.forced
        if ti.static(self.dev.has_restitution):
            self.dev.restitution.lift[i] = own.lift
            if ti.static(self.dev.has_friction):
                self.dev.restitution.rubbed[i] = own.rubbed
            if ti.static(bool(self.dev.restitution.bodies)):
                if now.first != 0:
                    self.dev.restitution.bodies.take_part(i, own.impacts)

    @ti.func
    def held(self, i, j, n, normal, slip):
        """Return the part of a pair's slip [m], this substep included, that friction takes back for a normal displacement."""
        moved = self.dev.state.relative_displacement(slip + (self.dev.state.d[i] - self.dev.state.d[j]), i, j)
        return self.table.held(i, j, n, normal, moved)

    @ti.func
    def spin_friction(self, pair, pressed, bounces):
        """Return how far friction between spinning particles pushes i and turns its surface, both per inverse mass [kg m].

        pressed: the push along the normal [kg m]. bounces: whether this is an impact.
        """
        i, j, e, n = pair.i, pair.j, pair.e, pair.n
        m, split_mass = self.dev.spinning.arm_of(i, j, n, pair.reach), self.dev.spinning.split_mass(i, j)
        slip = self.dev.slip.field[e] + self.dev.spinning.slip(i, j, m)
        if ti.static(self.dev.turns and self.dev.has_restitution):
            if bounces:
                slip *= 1 + self.table.of(i, j)[TANGENTIAL]
        push = -self.table.held(i, j, n, pressed * split_mass, slip) / split_mass
        turned = self.dev.spinning.turned(i, m, push)
        if ti.static(self.dev.turns):
            turned += self.dev.spinning.resist(i, j, e, n, m, push, pressed)
        return push, turned

    @ti.func
    def reaction(self, i, h, soft):
        """Return how far contact forces moved particle i in the last substep of a frame, h [s] long [m].

        It is the sum of pushes along the normals at the present places, where they have no moment, and of friction as the passes
        summed it up. The part of known loads that counts as a force already is left out: h^2 / soft of a load, as in
        KnownLoads.known_push().
        """
        total, w = 0 * self.dev.state.d[i], self.dev.w.of(i)
        if ti.static(bool(self.dev.rows)):
            total = self.dev.rows.borne[i]
        elif self.dev.splitting.weight[i] > 0:
            for word in range(self.dev.list.word_count(i)):
                bits = self.dev.list.touching_bits(i, word)
                while bits != 0:
                    e = self.dev.list.entry(i, word, bits)
                    bits &= bits - ti.u32(1)
                    j, push = self.dev.list.neighbour[e], self.dev.push.field[e]
                    r = self.dev.state.separation(i, j)
                    length = r.norm()
                    if push > 0 and length > 0:
                        n = r / length
                        share = self.dev.forces.share_of(i, j, n, push * (w + self.dev.w.of(j)))
                        if ti.static(self.dev.has_loads):
                            push -= self.dev.known.load.field[e] * h * h / soft
                        total += share * w * push * n
        if ti.static(self.dev.has_friction and not self.dev.rows):
            total += self.dev.forces.sum[i]
        return total

    @ti.func
    def apply_corrections(self, i, first):
        """Move particle i by the corrections of its pairs."""
        if self.dev.state.moves(i):  # without contact the correction is 0: no branch for that
            self.dev.state.shift(i, self.dev.move[i])
            if ti.static(self.dev.spins):
                self.dev.state.spin.s[i] = self.dev.state.spin.s[i] + self.dev.spinning.change[i]
            if ti.static(self.dev.has_restitution):
                self.dev.state.advance(i, self.dev.restitution.lift[i])
                self.dev.restitution.apply_friction(i)

    @ti.func
    def finish_substep(self, i, now):
        """At the end of a substep: store the slip of each pair, and clear the slack of parted pairs."""
        if ti.static(self.dev.has_friction):
            for word in range(self.dev.list.word_count(i)):
                bits = self.dev.splitting.sliding(i, word, now)
                while bits != 0:
                    e = self.dev.list.entry(i, word, bits)
                    bits &= bits - ti.u32(1)
                    self.store_slip(i, self.dev.list.neighbour[e], e)
        if ti.static(self.dev.has_restitution):
            self.dev.restitution.clear_slack(i, self.dev.splitting.weight[i])

    @ti.func
    def store_slip(self, i, j, e):
        """Store the slip and the turn of a pair, as far as friction can hold them: none if the pair has no push or has parted.

        Pairs that began to overlap after the pushes wait until the next substep: a list with a narrow skin may not have them yet.
        """
        overlap, n = self.dev.geometry.overlap(i, j, self.dev.geometry.contact_distance(i, j))
        slip, turn = 0 * self.dev.state.x[i], ti.Vector.zero(self.scene.real, self.dev.axes)
        if ti.static(self.dev.has_loads):
            if overlap <= 0 and self.dev.push.field[e] > 0:
                overlap, n = self.dev.geometry.gap(i, j)
        if (overlap > 0 or ti.static(self.dev.has_loads)) and self.dev.push.field[e] > 0:
            shared = self.dev.splitting.weight[i] + self.dev.splitting.weight[j]
            pressed = self.dev.push.field[e] * shared
            if ti.static(self.dev.spins):
                pressed = ti.max(overlap, pressed) / shared
                most = pressed * self.dev.spinning.split_mass(i, j)
                slip = self.dev.slip.field[e] + self.dev.spinning.slip(i, j, self.dev.spinning.arm(i, j, n))
                slip = self.table.held(i, j, n, most, slip)
                if ti.static(self.dev.turns):
                    turn = self.dev.spinning.left(i, j, e, n, pressed)
            else:
                slip = self.held(i, j, n, ti.max(overlap, pressed), self.dev.slip.field[e])
        self.dev.slip.field[e] = slip
        if ti.static(self.dev.turns):
            self.dev.turn.field[e] = turn
