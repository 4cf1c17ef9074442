"""The loops over the rows of contacts: stage 1, impulses, and stage 2, places."""

from typing import TYPE_CHECKING, Any

from ..constraints.core.spring import RESTARTED
from ..contact.islands import ALL, BOUNCING, PRESSING
from ..contact.limits import BLOCK, DIGIT, FORCE, GROUP, HITS, KINETIC, LACK, LOAD, OWN, ROWS, UPHILL, WORK, WRONG
from ..device import at, called, inline, ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .particle_pass import ParticlePass

OF_ROWS, OF_PASS, OF_PLACES, OF_WORK, OF_ROUND = range(5)  # which sums are added up, see RowPass.noted


class RowPass:
    """The contacts of one world as rows, see Rows."""

    n: Any = OnDevice()  # particles

    def __init__(self, scene: "Scene", contact: Any, particles: "ParticlePass", team: "Team"):
        self.particles: Any = particles
        self.team, self.state = team, scene.state
        self.n, self.real, self.dim = scene.count, scene.real, scene.particles.dim
        dev = contact.dev
        self.rows, self.bodies, self.impulses, self.places = dev.rows, dev.responses, dev.impulses, dev.places
        self.islands, self.impacts = dev.islands, dev.rows.impacts
        self.in_turn, self.edges = bool(self.impacts), bool(dev.rows.edges)
        some = [HITS, KINETIC] if self.rows.bounces else []
        passes = [LACK, UPHILL, LOAD, *([WRONG] if self.rows.bounces else [])]
        self.noted = [ROWS, FORCE, LOAD, *some], passes, [LACK], [WORK], [WORK, LACK, UPHILL]
        self.answers: Any = dev.answers
        self.answers_later = bool(dev.answers) and dev.answers.answer_later
        self.shakes = bool(dev.rows.edges and dev.answers) and dev.answers.has_clusters
        self.linked: list[Any] = []
        self.in_systems: list[Any] = []
        if dev.answers:
            self.linked = list(zip(dev.answers.links.batches, dev.answers.links.first, strict=True))
            if dev.answers.systems:
                solved = [b for b in dev.answers.batches if b.solvable_together]
                self.in_systems = [b for b in solved if (scene.slots.rows(b) >= 0).any()]

    @ti.func
    def solve(self, now):
        """Find the impulses of a substep, and correct places. On the launched path, the Launcher does this."""
        self.find_rows(now)
        if ti.static(self.in_turn):
            self.strike_all(now.thread)
        self.begin_impulses(now)
        self.solve_rows(now.thread, now.final, now.tick)

    @called
    @ti.func
    def solve_rows(self, thread: ti.i32, final: ti.i32, tick: ti.i32):
        """Stages 1 and 2."""
        while self.impulses.going[None] != 0:
            self.relax_impulses(thread)
        self.finish_impulses(thread, final, tick)
        while self.impulses.going[None] != 0:
            self.relax_places(thread)

    @inline
    def going(self):
        """Return 1 while passes go on, else 0: how often a loop of a pass runs."""
        return at(self.impulses.going, None) if self.team.launched else 1

    @ti.func
    def find_rows(self, now):
        """List the rows of contacts, and begin the passes over them."""
        h2 = self.particles.integrator.h2_rigid(now.h, now.fresh, ti.cast(now.span.owed, self.real))
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            self.impulses.begin(now, h2)
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            self.rows.clear(i)
            if ti.static(self.rows.bounces):
                self.rows.when[i] = 0
            if ti.static(self.in_turn):
                self.impacts.clear(i)
            if ti.static(self.edges):
                self.rows.edges.clear(i)
        for f, first in ti.static(self.linked):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                self.answers.links.note_open(f, c, first.now + c)
        self.team.wait()
        for k in range(self.particles.piece_count(now.thread)):
            begin, end = self.particles.piece(k, now.thread)
            row = self.rows.list.first[begin]
            for b in range((end - begin + (BLOCK - 1)) // BLOCK):
                low, high = begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)
                count, force, hits, kinetic, noise = ti.Vector.zero(self.real, 5)
                for i in range(low, high):
                    kick = self.rows.kick(i)
                    self.bodies.begin(i)
                    self.rows.begin_empty(i, row)
                    if ti.static(self.edges) or self.state.moves(i):
                        row = self.rows.find(i, begin, end, row)
                        own = ti.cast(row - self.rows.own[i], self.real)
                        noise += self.noise(i) * own
                        force += self.impulses.force(i)
                        if ti.static(bool(self.answers)):
                            links = self.answers.links.sum_of(self.answers.links.open, i) + self.answers.count_left(i)
                            own += links
                            force += links * kick.dot(kick)
                        count += own
                    if ti.static(self.rows.bounces):
                        if ti.static(self.in_turn):
                            hits += self.impacts.count(i)
                        else:
                            hits += self.rows.count_hits(i)
                        kinetic += self.bodies.kinetic(i)
                if ti.static(self.rows.bounces):
                    self.impulses.note(low, HITS, hits)
                    self.impulses.note(low, KINETIC, kinetic)
                self.impulses.note(low, ROWS, count)
                self.impulses.note(low, FORCE, force)
                self.impulses.note(low, LOAD, noise)
        self.team.wait()
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            if ti.static(self.edges):
                self.rows.edges.share(i)
            self.rows.find_eigenvalue(i)
            if ti.static(bool(self.answers)):
                self.rows.share[i] = self.rows.share[i] + self.answers.links.degree[i]
                self.rows.eigenvalue[i] = self.rows.eigenvalue[i] + self.answers.links.degree[i]
        self.add_up(now.thread, OF_ROWS)
        self.team.wait()
        if ti.static(self.rows.bounces):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                self.impulses.check_hits()
            self.team.wait()
        if ti.static(self.in_turn):
            self.begin_answers(now)

    @ti.func
    def noise(self, i):
        """Return the square of what a row of vertex i may lack by the digits of positions, where clusters place corners."""
        out = ti.cast(0, self.real)
        if ti.static(self.shakes):
            digit = ti.static(DIGIT) * self.state.digits_of_difference(i, self.rows.size(i))
            out = digit * digit
        return out

    @ti.func
    def strike(self, thread):
        """One round of impacts in turn."""
        for k in range(self.particles.piece_count(thread) * self.going()):
            begin, end = self.particles.piece(k, thread)
            for part in range(self.rows.parts(), OWN + 1):
                for i in range(begin, end):
                    self.impacts.look(i, part, self.impulses.turn[None])
        self.team.wait()
        n = self.n * self.going()
        self.look_at_bodies(thread, n)
        self.relax_rows(thread, OF_ROUND)
        self.answer_round(thread, n)
        self.add_up(thread, OF_ROUND)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread) * self.going()):
            self.impulses.decide_round()
        self.team.wait()
        shared = 1 if ti.static(self.answers_later) else self.impulses.gains[None]
        self.find_islands(thread, n * shared, BOUNCING)
        self.find_scales(thread, n * shared, self.impulses.blocks * ti.cast(n > 0, ti.i32) * shared, BOUNCING)
        ti.loop_config(serialize=self.islands.serial)
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            scale = ti.cast(2, self.real)
            if shared != 0:
                scale = self.islands.scale[self.islands.root_of(i)]
            self.impacts.apply(i, self.impulses.turn[None], scale, self.bodies)
        self.team.wait()

    @ti.func
    def look_at_bodies(self, thread, n):
        """Let the first impact of a body be that of all of its particles."""
        if ti.static(bool(self.answers)):
            ti.loop_config(serialize=self.islands.serial)
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.islands.keep_least(self.impacts.first, self.answers.body(i), self.impacts.first[i])
            self.team.wait()
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.impacts.first[i] = self.impacts.first[self.answers.body(i)]
            self.team.wait()

    @ti.func
    def answer_round(self, thread, n):
        """Let bodies answer the impulses of a round of impacts, before these are scaled."""
        if ti.static(self.answers_later):
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.answers.keep(i)
                self.bodies.new[i] = self.impacts.thrown[i] + self.bodies.compliance(i) * self.bodies.push[i]
                if (self.bodies.push[i] != 0).any():
                    self.rows.note_when(self.answers.body(i), self.impacts.first[i])
            self.team.wait()
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.rows.when[i] = self.rows.when[self.answers.body(i)]
            self.team.wait()
            self.turn_answers(thread)
            self.move_answers(thread, self.going(), False)
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.bodies.last[i] = self.bodies.new[i] + self.answers.hold(i) - self.impacts.thrown[i]
            self.team.wait()

    @ti.func
    def gather(self, thread, n):
        """Let the first n particles answer the impulses of their rows, and of those of their edges."""
        if ti.static(self.edges):
            self.team.wait()
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.impulses.gather(i)
            self.team.wait()

    @ti.func
    def gather_pushes(self, thread, n):
        """Add what rows of their edges want of the first n particles to their sums."""
        if ti.static(self.edges):
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.bodies.push[i] = self.bodies.push[i] + self.rows.edges.gather(i)
            self.team.wait()

    @called
    @ti.func
    def strike_all(self, thread: ti.i32):
        """All rounds of impacts in turn."""
        while self.impulses.going[None] != 0:
            self.strike(thread)

    @ti.func
    def begin_impulses(self, now):
        """Begin the passes of stage 1."""
        if ti.static(self.rows.bounces):
            self.aim(now.thread)
        if ti.static(not self.in_turn):
            self.begin_answers(now)
        self.turn_answers(now.thread)
        for k in range(self.particles.piece_count(now.thread)):
            begin, end = self.particles.piece(k, now.thread)
            for part in range(self.rows.parts(), OWN + 1):
                for i in range(begin, end):
                    self.impulses.prepare(i, part)
        self.gather(now.thread, self.n)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            self.impulses.start_passes()
        self.team.wait()
        self.answer(now.thread, self.n)
        for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
            self.bodies.extrapolate(i, ti.cast(0, self.real))
        self.team.wait()

    @ti.func
    def begin_answers(self, now):
        """Prepare constraints to answer impulses."""
        if ti.static(bool(self.answers)):
            fresh = now.fresh if ti.static(self.particles.integrator.half_kick) else 0
            h2_effective, share = (
                self.particles.integrator.h2_effective(now.h, fresh),
                now.frame_fraction[2],
            )
            if fresh != 0 and now.span.owed > 0:
                fresh = RESTARTED
            for system in ti.static(self.answers.systems):
                for b in range(self.team.chunk_begin(system.parts, now.thread), self.team.chunk_end(system.parts, now.thread)):
                    system.begin_answer(b)
            for f in ti.static(self.answers.alone):
                for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                    f.dev.begin_answer(c, now.h, h2_effective, fresh, self.bodies)
            self.team.wait()
            if ti.static(self.in_turn):
                self.turn_answers(now.thread)
            for f, first in ti.static(self.linked):
                for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                    self.answers.links.prepare(f, c, first.now + c, now.h, h2_effective, share, fresh, self.bodies)
            self.team.wait()

    @ti.func
    def turn_answers(self, thread):
        """Let systems and clusters answer from where they are at the time of an impact."""
        if ti.static(bool(self.answers)):
            for system in ti.static(self.answers.systems):
                for b in range(self.team.chunk_begin(system.parts, thread), self.team.chunk_end(system.parts, thread)):
                    system.turn_answer(b, self.rows)
            for f in ti.static(self.answers.alone):
                for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                    f.dev.turn_answer(c, self.bodies)
            self.team.wait()

    @ti.func
    def bend_systems(self, thread):
        """Once passes have met what rows lack: let systems answer to second order, from where impulses have moved them."""
        if ti.static(self.impulses.has_systems):
            bending = ti.cast(self.impulses.bending[None] == 1, ti.i32)
            for f in ti.static(self.in_systems):
                n = f.count * bending
                for c in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    f.dev.note_bend(c, self.bodies)
            self.team.wait()
            for f in ti.static(self.in_systems):
                n = f.count * bending
                for c in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    f.dev.bend_answer(c, self.bodies)
            self.team.wait()
            for system in ti.static(self.answers.systems):
                n = system.parts * bending
                for b in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    system.bend_part(b, self.bodies.new, self.state.d)
            self.team.wait()
            self.answer(thread, self.n * bending)

    @ti.func
    def answer(self, thread, n):
        """Let systems, clusters and places answer the impulses of a pass to n particles: all, or none where no passes go on."""
        if ti.static(self.answers_later):
            self.move_answers(thread, ti.cast(n > 0, ti.i32), False)
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.bodies.new[i] = self.bodies.new[i] + self.answers.hold(i)
            self.team.wait()

    @ti.func
    def move_answers(self, thread, going, places: ti.template()):  # type: ignore[valid-type]
        """Let systems, clusters and pins answer moves `new` of particles, by places or beyond their displacements."""
        for system in ti.static(self.answers.systems):
            n = system.parts * going
            for b in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                system.answer_part(b, self.bodies.new, self.answers.nothing if ti.static(places) else self.state.d)
        for f in ti.static(self.answers.alone):
            n = f.count * going
            for c in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                f.dev.answer(c, self.bodies.new, self.answers.nothing if ti.static(places) else self.state.d)
        self.team.wait()

    @ti.func
    def end_answers(self, thread):
        """Add answers to multipliers."""
        if ti.static(bool(self.answers)):
            for f in ti.static(self.in_systems):
                for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                    f.dev.end_answer(c, self.rows)
            self.team.wait()
            for system in ti.static(self.answers.systems):
                for b in range(self.team.chunk_begin(system.parts, thread), self.team.chunk_end(system.parts, thread)):
                    system.end_answer(b, self.bodies.new, self.state.d)
            for f in ti.static(self.answers.alone):
                for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                    f.dev.end_answer(c, self.rows)
            for f, first in ti.static(self.linked):
                for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                    self.answers.links.end_impulses(f, c, first.now + c, self.bodies)
            self.team.wait()

    @ti.func
    def aim(self, thread):
        """Find the times of impacts, and what bouncing rows aim at."""
        n = self.n * self.impulses.strikes[None]
        if ti.static(self.in_turn):
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.impacts.settle(i)
                if ti.static(self.answers_later):
                    self.answers.keep(i)
            self.team.wait()
        self.find_islands(thread, n, ALL)
        ti.loop_config(serialize=self.islands.serial)
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.islands.find_time(i)
        self.team.wait()
        ti.loop_config(serialize=self.islands.serial)
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.rows.aim(i, self.islands.time_of(i))
        self.team.wait()

    @ti.func
    def find_islands(self, thread, n, which: ti.template()):  # type: ignore[valid-type]
        """Find the islands of the first n particles, either all or none. which: of the rows that join them."""
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.islands.begin(i)
        self.team.wait()
        ti.loop_config(serialize=self.islands.serial)
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.islands.join(i, which)
        self.team.wait()

    @ti.func
    def find_scales(self, thread, n, blocks, which: ti.template()):  # type: ignore[valid-type]
        """Find the sums over islands, and their scales."""
        ti.loop_config(serialize=self.islands.serial)
        for b in range(self.team.chunk_begin(blocks, thread), self.team.chunk_end(blocks, thread)):
            self.islands.find_largest(b, which)
        self.team.wait()
        ti.loop_config(serialize=self.islands.serial)
        for b in range(self.team.chunk_begin(blocks, thread), self.team.chunk_end(blocks, thread)):
            self.islands.add_up(b, which)
        self.team.wait()
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.islands.find_scale(i, self.impulses.allowed[None], which)
        self.team.wait()

    @ti.func
    def scale_islands(self, thread):
        """Scale the impulses of islands that gain energy, if any particle does."""
        n = self.n * self.impulses.gains[None]
        blocks = self.impulses.blocks * self.impulses.gains[None]
        self.find_islands(thread, n, PRESSING)
        self.find_scales(thread, n, blocks, PRESSING)
        ti.loop_config(serialize=self.islands.serial)
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.islands.apply(i)
        self.team.wait()

    @ti.func
    def add_up(self, thread, what: ti.template()):  # type: ignore[valid-type]
        """On the launched path, where each particle has noted its own: add up sums over blocks, and those over groups."""
        if ti.static(self.team.launched):
            blocks = self.impulses.blocks * self.going()
            for b in range(self.team.chunk_begin(blocks, thread), self.team.chunk_end(blocks, thread)):
                for k in ti.static(self.noted[what]):
                    self.impulses.add_up(b, k)
            self.team.wait()
            self.add_up_groups(thread, what)

    @ti.func
    def add_up_groups(self, thread, what: ti.template()):  # type: ignore[valid-type]
        """On the launched path: add up sums over groups of blocks."""
        if ti.static(self.team.launched):
            groups = (self.impulses.blocks + (GROUP - 1)) // GROUP
            for g in range(self.team.chunk_begin(groups, thread), self.team.chunk_end(groups, thread)):
                for k in ti.static(self.noted[what]):
                    self.impulses.add_up_group(g, k)
            self.team.wait()

    @ti.func
    def relax_rows(self, thread, what: ti.template()):  # type: ignore[valid-type]
        """One pass over all rows, of a round of impacts, of impulses or of places, and note its sums."""
        for k in range(self.particles.piece_count(thread) * self.going()):
            begin, end = self.particles.piece(k, thread)
            for part in range(self.rows.parts(), OWN + 1):
                for b in range((end - begin + (BLOCK - 1)) // BLOCK):
                    low, high = begin + b * BLOCK, ti.min(begin + (b + 1) * BLOCK, end)
                    sums = ti.Vector.zero(self.real, ti.static(len(self.noted[what])))
                    for i in range(low, high):
                        sums += self.relax_particle(i, part, what)
                    if part == OWN:
                        for s in ti.static(range(len(self.noted[what]))):
                            self.impulses.note(low, self.noted[what][s], sums[s])
        self.team.wait()

    @ti.func
    def relax_particle(self, i, part, what: ti.template()):  # type: ignore[valid-type]
        """The same for a part of the rows of particle i. Returns what is noted."""
        out = ti.Vector.zero(self.real, ti.static(len(self.noted[what])))
        if ti.static(what == OF_ROUND):
            out = self.impacts.strike(i, part, self.bodies)
        elif ti.static(what == OF_PASS):
            out = self.impulses.relax(i, part)
        else:
            out[0] = self.places.relax(i, part)
        return out

    @ti.func
    def relax_impulses(self, thread):
        """One pass of stage 1."""
        if ti.static(bool(self.answers)):
            n = self.answers.links.n * self.going()
            for r in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.answers.links.relax(r, self.bodies, self.impulses.beta[None])
            self.team.wait()
        self.relax_rows(thread, OF_PASS)
        self.gather(thread, self.n * self.going())
        self.answer(thread, self.n * self.going())
        self.add_up(thread, OF_PASS)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread) * self.going()):
            self.impulses.decide()
        self.team.wait()
        self.bend_systems(thread)
        n = self.n * self.impulses.going[None]
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.bodies.extrapolate(i, self.impulses.beta[None])
        self.team.wait()

    @ti.func
    def finish_impulses(self, thread, final, tick):
        """End stage 1: take back energy that impulses gave, store what rows bear, move particles, and begin stage 2."""
        blocks = self.impulses.blocks
        for b in range(self.team.chunk_begin(blocks, thread), self.team.chunk_end(blocks, thread)):
            self.impulses.sums[b][WORK] = self.impulses.gain(b)
            for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
                self.bodies.forget_sums(i)
        self.team.wait()
        self.add_up_groups(thread, OF_WORK)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.impulses.check_work()
        self.team.wait()
        self.scale_islands(thread)
        sums = ti.cast(final != 0 or self.impulses.strikes[None] != 0, ti.i32)
        for k in range(self.particles.piece_count(thread) * sums):
            begin, end = self.particles.piece(k, thread)
            for part in range(self.rows.parts(), OWN + 1):
                for i in range(begin, end):
                    self.impulses.sum_impacts(i, part)
        self.team.wait()
        self.gather_pushes(thread, self.n * sums)
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            self.impulses.remember(i, final)
        self.team.wait()
        self.end_answers(thread)
        for i in range(self.team.chunk_begin(self.n, thread), self.team.chunk_end(self.n, thread)):
            new = self.bodies.new[i]
            if ti.static(not self.state.sums):
                new = self.particles.integrator.dithered_move(self.state.x0[i], new, tick)
            self.bodies.finish(i, new)
            self.places.begin(i)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread)):
            self.impulses.start_places()
        self.team.wait()
        for f in ti.static(self.in_systems):
            n = f.count * self.impulses.going[None]
            for c in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                f.dev.begin_places(c)
        if ti.static(len(self.in_systems) > 0):
            self.team.wait()

    @ti.func
    def relax_places(self, thread):
        """One pass of stage 2."""
        going = self.going()
        if ti.static(bool(self.answers)):
            n = self.answers.links.n * going
            for r in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.answers.links.relax_place(r, self.bodies)
            self.team.wait()
        self.relax_rows(thread, OF_PLACES)
        self.gather_pushes(thread, self.n * self.going())
        self.add_up(thread, OF_PLACES)
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, thread) * self.going()):
            self.impulses.decide_places()
        self.team.wait()
        going *= self.impulses.gains[None]
        n = self.n * going
        for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
            self.places.move(i, self.impulses.beta[None])
        self.team.wait()
        if ti.static(self.answers_later):
            self.move_answers(thread, going, True)
            for i in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                self.places.follow(i)
            self.team.wait()
            for f in ti.static(self.in_systems):
                n = f.count * going
                for c in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                    f.dev.end_places(c)
            self.team.wait()
