"""The loops over particles, tile by tile: the state of a tile stays in the cache, and simple loops can be vectorized."""

from typing import TYPE_CHECKING, Any

from ..colliders.surface import ANY_DEPTH, BEYOND_ROUNDING, FRICTIONLESS
from ..contact.limits import SLOP
from ..device import inline, ti
from ..device.number import OnDevice
from ..device.thread_team import Team, block, blocks
from ..features.feature import Batch, Scene

if TYPE_CHECKING:
    from ..colliders.wall_group import WallGroup

TILE = 256  # particles that a thread takes through several loops at a time, so that their state stays in its cache
SWEEPS = 8  # rounds over the walls, for particles that several walls push
LEAVES = 1 / 16  # of a blow: a particle that leaves a wall more slowly than this after it lies on the wall
ROUNDS = 32  # further rounds, without friction and bounces


class ParticlePass:
    """Integrates particles, and applies to them the corrections of constraints, contacts and walls.

    contact and search may be None. n: number of particles. pieces: number of pieces that they are divided into, see Team. tile:
    particles in a tile. each: tiles in a piece.
    """

    n: Any = OnDevice()
    pieces: Any = OnDevice()
    tile: Any = OnDevice()
    each: Any = OnDevice()

    def __init__(self, scene: Scene, integrator: Any, batches: list[Batch], contact, search, team: Team):
        self.integrator, self.forces, self.team = integrator, integrator.forces, team
        self.state, self.n, self.real = scene.state, scene.count, scene.real
        number = scene.memory.number
        self.pieces, self.tile, self.each = map(number, self._parts(scene.particles.count, team))
        self.few = scene.memory.compiler.few
        self.whole = team.size == 1 and not team.launched  # all particles are one piece
        self.undivided = self.whole and self.few  # and one tile: no loop over tiles is compiled
        self.rows = bool(contact)  # whether contacts, and walls with them, are rows
        self.groups: list[WallGroup] = scene.walls
        walls = [] if self.rows else [group.wall for group in scene.walls]  # otherwise they keep inside what rows leave outside
        self.alone = len(walls) == 1 and scene.walls[0].single and not walls[0].needs_repeat
        self.several = len(walls) > 1 or any(not group.single for group in scene.walls)
        self.slots, self.search, self.walls, self.radius = scene.slots, search, walls, scene.radius
        self.applies_first = bool(batches) and (bool(contact) or scene.slots.refines)  # moves of constraints, before all others
        self.gathers = bool(batches) and not self.applies_first
        self.held = bool(batches)
        self.contacts = [contact] if contact else []
        self.acts = self.gathers or bool(contact or walls)
        self.impacts = [scene.impacts] if scene.impacts else []
        self.rough = any(w.has_friction or w.has_restitution for w in walls)
        self.bounces = any(w.has_restitution for w in walls)
        self.turned_by_walls = scene.state.spins and any(w.has_friction for w in walls)
        if walls:
            self.wall_displacement = scene.memory.field("thrust", scene.count, width=scene.particles.dim, state=True)
        if self.turned_by_walls:
            self.wall_turn = scene.memory.field("wall_turn", scene.count, width=scene.state.spin.axes, state=True)

    @staticmethod
    def _parts(n: int, team: Team) -> tuple[int, int, int]:
        """Return the number of pieces of n particles, of particles in a tile, and of tiles in a piece."""
        tile = min(TILE, team.piece)
        return -(-n // team.piece), tile, -(-team.piece // tile)

    def regroup(self, n: int) -> None:
        """Set the number of particles to n, after Team.regroup()."""
        self.pieces, self.tile, self.each = self._parts(n, self.team)

    @inline
    def piece_count(self, thread):
        """Return the number of pieces of a thread."""
        return 1 if self.whole else self.team.dealt_count(self.pieces, 1, thread)

    @ti.func
    def piece(self, k, thread):
        """Return the first particle of the k-th piece of a thread, and the one behind its last."""
        first, end = self.team.chunk_begin(self.n, thread), self.n
        if ti.static(not self.whole):
            first = self.team.dealt_index(k, 1, thread) * self.team.piece
            end = ti.min(first + self.team.piece, self.n)
        return first, end

    @inline
    def tile_count(self, thread):
        """Return the number of tiles of a thread."""
        return 1 if self.undivided else self.team.dealt_count(self.pieces * self.each, self.each, thread)

    @ti.func
    def tile_of(self, k, thread):
        """Return the first particle of the k-th tile of a thread, and the one behind its last."""
        first, end = self.team.chunk_begin(self.n, thread), self.n
        if ti.static(not self.undivided):
            first, end = self._tile_of(k, thread)
        return first, end

    @ti.func
    def _tile_of(self, k, thread):
        first, end = k * self.tile, self.n  # for one piece, without a division
        if ti.static(self.team.size > 1):
            tile = self.team.dealt_index(k, self.each, thread)
            piece = tile // self.each
            first, end = piece * self.team.piece + tile % self.each * self.tile, (piece + 1) * self.team.piece
        return first, ti.min(first + self.tile, end, self.n)

    @ti.func
    def integrate(self, now):
        """Integrate all particles."""
        for k in range(self.tile_count(now.thread)):
            first, end = self.tile_of(k, now.thread)
            if self.state.any_awake(first, end) != 0:
                self.advance(first, end, now)

    @ti.func
    def advance(self, first, end, now):
        """Integrate a tile of particles, in short loops that the compiler can vectorize."""
        if ti.static(self.state.starts):
            for i in range(first, end):
                self.state.x0[i] = self.state.x[i]
                if ti.static(self.state.sums):
                    self.state.low0[i] = self.state.low[i]
        if ti.static(self.state.spins):
            if now.fresh != 0:
                for i in range(first, end):
                    self.state.spin.begin(i, now.h)
        for impacts in ti.static(self.impacts):
            for i in range(first, end):
                impacts.clear(i)
            if now.s == 0:
                for i in range(first, end):
                    impacts.rigid[i] = 0
        self.integrator.advance(first, end, now)
        for c in ti.static(self.contacts):
            stale, fast = 0, 0
            for i in range(first, end):
                stale |= self.search.moved_too_far(i)
            for i in range(first, end):
                fast |= c.overshoots(i)
            c.note_motion(stale, fast)

    @ti.func
    def apply_constraints(self, now):
        """Apply the corrections of constraints to particles before contacts are solved, and check the neighbour list."""
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            self.gather(i, now)
            for c in ti.static(self.contacts):
                c.note_motion(self.search.moved_too_far(i), c.overshoots(i))
        self.team.wait()

    @ti.func
    def gather(self, i, now):
        """Apply the corrections of constraints to particle i."""
        if self.state.awake(i):
            for impacts in ti.static(self.impacts):
                d = self.state.d[i]
                self.slots.gather(i, now)
                if now.it >= now.span.iterations:
                    impacts.mark_reached(i, self.state.d[i] - d)
            if ti.static(len(self.impacts) == 0):
                self.slots.gather(i, now)

    @ti.func
    def apply_corrections(self, now):
        """Apply the corrections of constraints and contacts to particles, then those of walls."""
        if ti.static(self.acts):
            for k in range(self.tile_count(now.thread)):
                begin, end = self.tile_of(k, now.thread)
                if self.state.any_awake(begin, end) != 0:
                    self.move(begin, end, now)
        self.team.wait()

    @ti.func
    def move(self, begin, end, now):
        """Apply corrections to a tile of particles."""
        if ti.static(self.gathers):
            for i in range(begin, end):
                self.gather(i, now)
        if ti.static(len(self.walls) > 0):
            if now.final != 0:
                for i in range(begin, end):
                    if self.state.awake(i):
                        accumulate(self.wall_displacement, i, -self.state.d[i], now.first)
                if ti.static(self.turned_by_walls):
                    for i in range(begin, end):
                        if self.state.awake(i):
                            accumulate(self.wall_turn, i, -self.state.spin.s[i], now.first)
        for impacts in ti.static(self.impacts):
            if now.it >= now.span.iterations:
                for i in range(begin, end):
                    if impacts.correct_push(i, now):
                        impacts.request_pass(now)
        if ti.static(len(self.walls) > 0 and self.few):
            for i in range(begin, end):
                self.confine(i, now.h, now.frame_fraction)
        elif ti.static(len(self.walls) > 0):
            for b in range(blocks(begin, end)):
                low, high = block(b, begin, end)
                if self.near_walls(low, high) != 0:
                    for i in range(low, high):
                        self.confine(i, now.h, now.frame_fraction)
        if ti.static(self.rows and len(self.groups) > 0):
            for i in range(begin, end):
                if self.search.list.wall_number[i] > 0 or self.search.moved_too_far(i) != 0:
                    self.guard(i, now)
        for impacts in ti.static(self.impacts):
            for i in range(begin, end):
                if impacts.is_struck_now(i):
                    if now.it + 1 >= now.span.iterations:
                        impacts.correct_push(i, now)
                    impacts.request_pass(now)
        for c in ti.static(self.contacts):
            if now.checks_list != 0:
                stale = 0
                for i in range(begin, end):
                    stale |= self.search.moved_too_far(i)
                c.note_motion(stale, 0)
        if ti.static(len(self.walls) > 0):
            if now.final != 0:
                for i in range(begin, end):
                    if self.state.awake(i):
                        self.wall_displacement[i] = self.wall_displacement[i] + self.state.d[i]
                if ti.static(self.turned_by_walls):
                    for i in range(begin, end):
                        if self.state.awake(i):
                            self.wall_turn[i] = self.wall_turn[i] + self.state.spin.s[i]
                if ti.static(self.bounces):
                    for i in range(begin, end):
                        if self.state.awake(i):
                            self.forget_blow(i)

    @ti.func
    def forget_blow(self, i):
        """If particle i bounced in this substep: remove the part along the blow from the push of walls that counts as a reaction.

        A blow b at the fraction s of the substep leaves the particle -s b away from where its displacement says, see
        Surface.bounce(). The velocity already contains all of b. The push of a wall on which the particle leans meanwhile, such
        as a floor while it bounces off a side wall, is across b and stays. A particle that rests on a wall with restitution also
        bounces, by rounding errors, but it does not leave the wall.
        """
        lift = self.state.place(i) - self.state.begin(i) - self.state.d[i]
        if lift.norm() > 4 * self.state.digits(i):
            n = -lift.normalized()
            blow = self.wall_displacement[i].dot(n)
            if self.state.d[i].dot(n) > ti.static(LEAVES) * blow:
                self.wall_displacement[i] = self.wall_displacement[i] - blow * n
                if ti.static(self.turned_by_walls):
                    self.wall_turn[i] = 0 * self.wall_turn[i]

    @ti.func
    def near_walls(self, begin, end):
        """Return 0 if no wall is near any of the particles from `begin` to `end` - 1."""
        near = 0
        for i in range(begin, end):
            for group in ti.static(self.groups):
                near |= group.may_touch(i, self.radius.of(i))
        return near

    @ti.func
    def confine(self, i, h, frame_fraction):
        """Apply the corrections of walls to particle i, in turn, until none changes anything, see Collider."""
        if self.state.moves(i):
            if ti.static(self.alone):
                for f in ti.static(self.walls):
                    self.touch(f, i, self.radius.of(i), h, frame_fraction, ANY_DEPTH)
            else:
                moving, mode = True, ANY_DEPTH
                for k in range(SWEEPS + ROUNDS + 1):
                    if moving:
                        if k == SWEEPS + ROUNDS:
                            self.cancel_move(i)
                        settled = self.touch_all(i, h, frame_fraction, mode)
                        # A round with friction or bounces may return to where it began, although the particle is in a wall there.
                        moving = not (settled and (mode == FRICTIONLESS or ti.static(not self.rough)))
                        mode = ANY_DEPTH if ti.static(self.several) else BEYOND_ROUNDING
                        if settled or k + 1 >= SWEEPS:
                            mode = FRICTIONLESS

    @ti.func
    def guard(self, i, now):
        """Keep particle i inside of walls, where their rows let it out further than the slop. This gives no momentum.

        What was out before is for stage 2 to bring back, so no time passes here.
        """
        if self.state.moves(i):
            d, moving = self.state.d[i], True
            radius = ti.static(1 - 2 * SLOP) * self.radius.of(i)
            for _ in range(SWEEPS):
                if moving:
                    x = self.state.x[i]
                    for group in ti.static(self.groups):
                        self.touch_group(group, i, radius, 0 * now.h, now.frame_fraction, FRICTIONLESS)
                    moving = (self.state.x[i] != x).any()
            self.state.d[i] = d

    @ti.func
    def touch_all(self, i, h, frame_fraction, mode):
        """Apply the correction of every wall once. Returns whether none changed anything."""
        x, d = self.state.x[i], self.state.d[i]
        for group in ti.static(self.groups):
            self.touch_group(group, i, self.radius.of(i), h, frame_fraction, mode)
        return (self.state.d[i] == d).all() and (self.state.x[i] == x).all()

    @ti.func
    def touch_group(self, group: ti.template(), i, radius, h, frame_fraction, mode):  # type: ignore[valid-type]
        """Apply the corrections of the walls of a group that particle i may meet, in turn."""
        if ti.static(group.single):
            self.touch(group.wall, i, radius, h, frame_fraction, mode)
        else:
            k = -1
            while k < group.count():
                k = group.next_near(k, i, radius)
                if k < group.count():
                    group.enter(k)
                    self.touch(group.wall, i, radius, h, frame_fraction, mode)

    @ti.func
    def touch(self, wall: ti.template(), i, radius, h, frame_fraction, mode):  # type: ignore[valid-type]
        """Apply the correction of one wall, if it is switched on."""
        if ti.static(wall.dev.surface.has_switch):
            if wall.dev.surface.active[None] != 0:
                wall.confine(i, radius, h, frame_fraction, mode)
        else:
            wall.confine(i, radius, h, frame_fraction, mode)

    @ti.func
    def cancel_move(self, i):
        """Move particle i back to where it was at the start of the substep, at rest."""
        if ti.static(self.state.starts):
            if ti.static(self.state.befores):
                self.state.before[i] = self.state.before[i] - self.state.d[i]
            self.state.d[i] = ti.zero(self.state.d[i])
            self.state.restart(i)
        else:
            self.state.shift(i, -self.state.d[i])

    @ti.func
    def reaction(self, i, h, t, firm):
        """Return h^2 times the acceleration of particle i by constraints (from Slots), contacts and walls in the last substep.

        Also returns the share of the push of walls that it contains. firm: see Passes.push_reaction().
        The push of walls counts as far as it balances all other forces. So a body at rest has velocity 0, but half of a blow is
        not added to the velocity of a particle that has just bounced, nor to the other particles of its body, whose walls and
        rigid constraints count for nothing.
        """
        reaction, part = 0 * self.state.d[i], 1 + 0 * h
        if ti.static(self.held):
            reaction = self.slots.total_of(i)
        for c in ti.static(self.contacts):
            reaction += firm * c.reaction(i)
        if ti.static(len(self.walls) > 0):
            push = firm * self.wall_displacement[i]
            v = self.state.d[i] / h
            load = (h * h * self.forces.accelerate(i, self.state.place(i), v, t, self.forces.pull(t)) + reaction).norm()
            limit, size = load, push.norm()
            for group in ti.static([g for g in self.groups if g.wall.has_friction]):  # its push is load and friction together
                if ti.static(group.single):
                    limit = ti.max(limit, load * ti.sqrt(1 + group.wall.dev.surface.static() ** 2))
                elif size > limit:
                    for k in range(group.count()):
                        group.enter(k)
                        limit = ti.max(limit, load * ti.sqrt(1 + group.wall.dev.surface.static() ** 2))
            if size > limit:
                part = limit / size
            for impacts in ti.static(self.impacts):
                if impacts.reached[i] != 0:
                    part = 0 * part
            reaction += part * push
        return reaction, part

    @ti.func
    def surface_velocity(self, i, h, t, firm):
        """Return r omega of particle i at the end of the last substep: s / h plus half of what moments of forces added to it."""
        turned = 0 * self.state.spin.s[i]
        for c in ti.static(self.contacts):
            turned += c.dev.rows.turned[i]
        if ti.static(self.turned_by_walls):
            _reaction, part = self.reaction(i, h, t, firm)
            turned += part * self.wall_turn[i]
        return (self.state.spin.s[i] + firm / 2 * turned) / h


@ti.func
def accumulate(field: ti.template(), i, value, first):  # type: ignore[valid-type]
    """Add a value to the entry of particle i in a field. The first pass begins the sum."""
    if first != 0:
        field[i] = value
    else:
        field[i] = field[i] + value
