"""The step from top to bottom, and its kernels.

frame() and substep() are the order of the phases, for every path. Taichi compiles them into one kernel, where `do` is a Step:
a whole frame in one launch, by one CPU thread or a team of them ("fused" and "parallel"). Where each phase is launched by itself,
as on a GPU, Python runs the same lines, and `do` is a Launcher (launcher.py). Higher orders differ in the integrator alone.
"""

from typing import TYPE_CHECKING, Any

from ..contact.velocity_projection import EVERY, PASSES
from ..device import called, runtime, ti
from ..device.number import OnDevice, read_all
from ..device.thread_team import LEAST, Team
from ..features.feature import Batch, Scene
from ..neighbours.strays import Strays
from .constraint_pass import ConstraintPass
from .contact_pass import ContactPass
from .particle_pass import ParticlePass
from .span import ACTIVE_THREADS, BEFORE, FIRST, HALT, Moment, Span, integer, span_on

if TYPE_CHECKING:
    from ..colliders.collider import Collider

REBOUNDS = 8  # rounds of restitution in a substep, at most


@ti.pyfunc
def frame(do, span):
    """A frame: its substeps, and what they came to. The last round is for the list that diagnose() needs."""
    for s in range(span.begin, span.until):
        now = do.moment(span, s)
        if do.works(now):
            substep(do, now)
            if do.ends(now):
                do.diagnose(now)


@ti.pyfunc
def substep(do, now):
    """A substep. Where there are constraints and contacts, a pass has two halves, and each begins with a good list. In the first,
    constraints may need a second step of Newton's method."""
    if ti.static(do.has_pair_forces):
        if do.begins(now):
            do.evaluate_pair_forces(now)
    if do.enters(now):
        do.integrate(now)
        do.drive(now)
    for half in range(do.first_half(now), do.last_half(now)):
        if do.regular(now, half):
            do.update_neighbours(now, half)
        if do.solves(now) and do.goes_on(now, half):
            turn = do.turn(now, half)
            if half % do.halves == 0:
                for k in range(do.newton_steps):
                    if k == 0 or do.unmet(now):
                        do.solve_constraints(turn.newton_step(k))
                        do.solve_systems(turn.newton_step(k))
                        do.update_multipliers(turn.newton_step(k))
                        do.apply_constraints(turn.newton_step(k))
            if half % do.halves == do.halves - 1:
                if do.regular(now, half):
                    do.solve_contacts(turn)
                if ti.static(do.has_restitution):
                    for _ in range(REBOUNDS):
                        if turn.first != 0 and do.struck() != 0:
                            do.rebound(turn)
                if ti.static(do.has_pair_impacts):
                    if not do.regular(now, half):
                        do.push_bodies(turn)
                do.apply_corrections(turn)
    if ti.static(do.finishes):
        if do.leaves(now):
            do.finish_substep(now)
    if ti.static(do.projects_velocities):
        if do.leaves(now) and now.damps != 0:
            for k in range(PASSES):
                do.project_contact_velocities(now.of(k))


@ti.data_oriented
class Step:
    """The phases as loops on the device, and the kernels of one world.

    A `thread` goes through each of them, see Team. Where there is no team, loops are serial inside the fused kernel, and Taichi
    spreads them over threads at the top of the others.
    """

    diagnostics: Any  # what sums up a frame; given once it is there
    sleep: Any = None  # the SleepPass, where there is one
    n: Any = OnDevice()  # particles

    def __init__(
        self, scene: Scene, integrator: Any, batches: list[Batch], drivers: list[Batch], contact: Any, search: Any,
        walls: "list[Collider]", team: Team,
    ):  # fmt: skip
        self.scene, self.state, self.slots, self.team = scene, scene.state, scene.slots, team
        self.n, self.dim, self.real, self.numbers = scene.count, scene.particles.dim, scene.real, scene.memory.numbers
        self.integrator, self.search, self.walls, self.drivers, self.batches = integrator, search, walls, drivers, batches
        self.posed = [w for w in walls if w.poses]
        self.wall_logs: list[Any] = [w.dev.log for w in walls if w.dev.log]
        self.sheared = bool(scene.state.images and scene.state.images.sheared)
        self.breakers: list[Any] = [b for b in batches if b.breaks]
        self.launched = team.launched
        # Iterations of a loop for each of few pieces of work: to each CPU thread Taichi gives LEAST of them, at least.
        self.stride = LEAST if self.launched and runtime.architecture() == "cpu" else 1
        self.particles = ParticlePass(scene, integrator, batches, contact, search, walls, team)
        self.constraints = ConstraintPass(scene, integrator, batches, team, self.stride)
        self.contact_pass = ContactPass(scene, contact, self.particles, team)
        self.contacts = self.particles.contacts
        self.halves = 2 if batches and contact else 1  # of a pass, each with a list that is good
        self.impacts: Any = scene.impacts
        self.has_impacts = bool(scene.impacts)
        self.has_pair_impacts = self.has_impacts and self.impacts.pairs
        self.newton_steps = 2 if scene.slots and scene.slots.refines else 1  # in a pass, at most
        self.has_restitution, self.projects_velocities = self.contact_pass.has_restitution, self.contact_pass.projects_velocities
        self.orients = self.state.spins and self.state.spin.orients
        keeps = self.contact_pass.remembers or bool(self.breakers)
        self.finishes = keeps or self.orients or bool(self.wall_logs) or bool(self.constraints.learners)
        self.hashes = bool(search)
        self.sleepers = scene.state.sleepers
        self.looks = bool(search) and bool(self.sleepers)  # for what touches those that sleep
        self.detects = any(c.detects for c in self.contacts)
        apart = search and search.lone and not self.launched and not scene.memory.compiler.few
        self.strays: Any = Strays(scene, search, team) if apart else None
        self.pair_forces: list[Any] = integrator.forces.pairwise
        self.has_pair_forces = bool(self.pair_forces)
        self.listed_forces = [f for f in self.pair_forces if f.dev.search]
        self.searches = [*([search] if search else []), *(f.dev.search for f in self.listed_forces)]
        if self.searches:
            self.halt = scene.memory.field("halt", None, width=3, kind=ti.i32)
            if self.launched:
                team.halt = self.halt

    @ti.kernel
    def fused(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """All substeps of a frame, in one launch, and what it came to; without substeps that alone."""
        ti.loop_config(serialize=self.team.size == 1)
        for thread in range(self.team.spread):
            if thread % LEAST == 0:
                self.run(integer(sheet, FIRST) + thread // LEAST, sheet)

    @ti.func
    def run(self, thread, sheet: ti.template()):  # type: ignore[valid-type]
        """What a thread does of a frame. All threads of a team take the same branches, for what they depend on is written only
        where the others wait."""
        read_all(self.numbers)
        frame(self, span_on(sheet, thread))
        if thread == 0:
            self.tell_halt(sheet)
            if ti.static(self.team.size > 1):
                sheet[ACTIVE_THREADS] = self.team.active_threads[None]

    @ti.kernel
    def phases(
        self, names: ti.template(), h64: ti.f64, start: ti.f64, tick: ti.i32, since: ti.i32, fresh: ti.i32,  # type: ignore[valid-type]
        owed: ti.f64, s: ti.i32, substeps: ti.i32, iterations: ti.i32, half: ti.i32,
    ):  # fmt: skip
        """Some phases of a substep, by their names. Nothing is returned: that would be waited for."""
        now = self.turn(self.moment(Span(h64, start, start, tick, since, fresh, owed, 0, substeps, iterations), s), half)
        for phase, k in ti.static(self.named(names)):
            phase(now.newton_step(k))

    def named(self, names: str) -> list[tuple[Any, int]]:
        """The phases of these names, one after the other, and in which step of Newton's method."""
        return [(getattr(self, name.rstrip("'")), int(name.endswith("'"))) for name in names.split()]

    @ti.func
    def moment(self, span, s):
        """Substep s of a frame; where s = span.substeps, what comes after them."""
        h, last, time, frame_fraction = self.integrator.times(span, s)
        tick, fresh, final = span.tick + s, ti.select(s == 0, span.fresh, 0), ti.cast(s == span.substeps - 1, ti.i32)
        damps = ti.cast((span.since + s) % EVERY == EVERY - 1, ti.i32)
        return Moment(span, s, h, last, time, tick, frame_fraction, fresh, damps, final)

    @ti.func
    def turn(self, now, half):
        """A pass over the constraints, by its first or second half."""
        it = half // self.halves
        first = ti.cast(it == 0, ti.i32)
        another = it + 1 < now.span.iterations or self.has_impacts  # there may be
        checks_list = ti.select(another, 1, now.final)
        return now.of(it, first, checks_list, half)

    @ti.func
    def works(self, now):
        """Whether the thread takes part in this substep; all must ask."""
        return self.team.works(now.thread) and self.halted() == 0

    @ti.func
    def again(self, now):
        """1 where the substep goes on in the middle."""
        return ti.select(now.s == now.span.begin, now.span.resumed, 0)

    @ti.func
    def enters(self, now):
        """Whether the substep begins here, with what it needs."""
        out = now.s < now.span.substeps and self.again(now) == 0
        if ti.static(len(self.listed_forces) > 0):
            out = out and self.halted() == 0
        return out

    @ti.func
    def begins(self, now):
        """Whether the substep, or what comes after all of them, begins here."""
        return self.again(now) == 0

    @ti.func
    def first_half(self, now):
        """The half of a pass in which it begins or goes on."""
        return ti.select(self.again(now) != 0, now.span.half, 0)

    @ti.func
    def last_half(self, now):
        """The one before which it ends; after all substeps there is one more for the list."""
        passes = now.span.part
        if ti.static(self.has_impacts):
            passes += ti.select(now.span.part == now.span.iterations, self.impacts.passes, 0)
        return ti.select(now.s < now.span.substeps, passes * self.halves, 1)

    @ti.func
    def regular(self, now, half):
        """Whether this half of a pass is one of those that every substep has."""
        out = True
        if ti.static(self.has_impacts):
            out = half < now.span.iterations * self.halves or now.s >= now.span.substeps
        return out

    @ti.func
    def goes_on(self, now, half):
        """Whether there is this half of a pass: beyond those of every substep, only where bodies struck walls."""
        out = True
        if ti.static(self.has_impacts):
            if not self.regular(now, half):
                out = self.impacts.wanted(self.turn(now, half))
        return out

    @ti.func
    def solves(self, now):
        """Whether there is a pass to go through, with a good list."""
        return now.s < now.span.substeps and self.halted() == 0

    @ti.func
    def leaves(self, now):
        """Whether all passes of the substep are done."""
        return now.s < now.span.substeps and now.span.part == now.span.iterations and self.halted() == 0

    @ti.func
    def ends(self, now):
        """Whether all substeps are done."""
        return now.s >= now.span.substeps and self.halted() == 0

    @ti.func
    def evaluate_pair_forces(self, now):
        """What particles do to each other where they are now, before any of them moves."""
        self.list_pairs(now)
        if self.halted() == 0:
            self.sum_pair_forces(now)

    @ti.func
    def list_pairs(self, now):
        """Build the lists of forces between particles anew where they are stale. Where one has no room for all pairs, the frame
        stops."""
        self.look_for_motion(now)
        for f in ti.static(self.listed_forces):
            if f.dev.list.stale[None] != 0:
                f.dev.search.build(now.thread)
                if f.dev.list.need[None] > f.dev.list.capacity:
                    self.halt[None] = [1, now.s, BEFORE]  # all write the same
        self.team.wait()

    @ti.func
    def look_for_motion(self, now):
        """Find out which of these lists are stale."""
        for f in ti.static(self.listed_forces):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                if f.dev.search.moved_too_far(i) != 0:
                    f.dev.list.stale[None] = 1
        self.team.wait()

    @ti.func
    def ask_for_pairs(self, now):
        """Where phases are launched: have their lists built that are stale, see ask_for_list()."""
        self.look_for_motion(now)
        for f in ti.static(self.listed_forces):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                if f.dev.list.stale[None] != 0:
                    self.halt[None] = [1, now.s, BEFORE]

    @ti.func
    def sum_pair_forces(self, now):
        """Sum up the forces between particles, with good lists."""
        for f in ti.static(self.pair_forces):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                f.evaluate(i)
        self.team.wait()

    @ti.func
    def integrate(self, now):
        """Particles move on their own. Walls go to where they are in this substep."""
        if ti.static(self.integrator.springs_pull):
            self.constraints.spring_forces(now.thread, now.h)
            if now.s % self.integrator.stages == self.integrator.longest + 1:
                self.constraints.note_turns(now.thread)
        for w in ti.static(self.posed):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                w.pose(now.frame_fraction)
        for log in ti.static(self.wall_logs):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                log.substep[None] = now.s + 1
            n = self.n * ti.cast(now.s == 0, ti.i32)
            for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                log.open(i)
        if ti.static(self.sheared):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                self.state.images.slide(now.h)
            self.team.wait()
        if ti.static(self.has_impacts):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                self.impacts.close()
        self.particles.integrate(now)
        self.team.wait()
        self.team.watch(now.thread)

    @ti.func
    def drive(self, now):
        """Driven particles go to where they are to be."""
        for f in ti.static(self.drivers):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                f.dev.place.drive(c, now.h, now.frame_fraction[1])
                if ti.static(self.state.befores):  # at the velocity with which it is driven, others meet it
                    self.state.before[f.dev.corners.member(c, 0)] = self.state.d[f.dev.corners.member(c, 0)]
                if ti.static(self.integrator.uses_velocity):  # nothing else acts on it, should it be let go
                    self.integrator.free[f.dev.corners.member(c, 0)] = self.state.d[f.dev.corners.member(c, 0)]
                for k in ti.static(self.contacts):
                    k.note_motion(self.search.moved_too_far(f.dev.corners.member(c, 0)), k.overshoots(f.dev.corners.member(c, 0)))
            self.team.wait()

    @ti.func
    def update_neighbours(self, now, half):
        """Build the list of neighbours anew where it is stale. Where it has no room for all of them, the frame stops."""
        if ti.static(self.hashes):
            if self.halted() == 0 and self.is_stale() != 0:
                if ti.static(bool(self.strays)):
                    self.strays.keep_list(now.thread)
                if self.is_stale() != 0:
                    self.list_particles(now.thread)
                    if self.search.list.need[None] > self.search.list.capacity:
                        self.halt[None] = [1, now.s, half]  # all write the same
        if ti.static(self.looks):
            if self.solves(now) and (self.sleepers.count[None] > 0 or ti.static(self.detects)):
                self.look_for_sleepers(self.turn(now, half))
                if self.sleepers.calls[None] != 0:
                    self.halt[None] = [1, now.s, half]

    @called
    @ti.func
    def list_particles(self, thread: ti.i32):
        """Build it."""
        self.search.build(thread)

    @ti.func
    def look_for_sleepers(self, now):
        """Call those that are touched; the frame stops for them to wake, before contacts are solved."""
        for c in ti.static(self.contacts):
            if ti.static(c.detects):
                n = ti.select(now.half % self.halves == self.halves - 1 or self.sleepers.count[None] > 0, self.n, 0)
                for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                    c.detect(i, now.first)
                self.team.wait()
        n = ti.select(self.sleepers.count[None] > 0, self.n, 0)
        for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
            self.sleep.look(i, self.halves - 1 - now.half % self.halves)
        self.team.wait()

    @ti.func
    def ask_to_wake(self, now):
        """Where phases are launched: have the frame stop for those that were called."""
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            if self.sleepers.calls[None] != 0:
                self.halt[None] = [1, now.s, now.half]

    @ti.func
    def ask_for_list(self, now):
        """Where phases are launched: have a list built that is stale. The frame waits for it, see Team."""
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            if self.is_stale() != 0:
                self.halt[None] = [1, now.s, now.half]

    @ti.func
    def solve_constraints(self, now):
        """Every constraint leaves the moves that it wants, or tells its system what it is about."""
        self.constraints.solve(now)

    @ti.func
    def solve_systems(self, now):
        """Chains and cloth are solved together."""
        if ti.static(len(self.constraints.systems) > 0):
            self.solve_each(now.thread, now.newton)

    @called
    @ti.func
    def solve_each(self, thread: ti.i32, newton: ti.i32):
        """Each system."""
        self.constraints.solve_systems(thread, newton)

    @ti.func
    def start_systems(self, now):
        """Where phases are launched: begin the systems that iterate."""
        self.constraints.start_systems(now.thread)

    @ti.func
    def iterate_systems(self, now):
        """Where phases are launched: one iteration of theirs."""
        self.constraints.iterate_systems(now.thread)

    @ti.func
    def update_multipliers(self, now):
        """Add the steps that systems found to the multipliers."""
        self.constraints.update_multipliers(now)

    @ti.func
    def apply_constraints(self, now):
        """Particles move as constraints want before contacts are solved, or the next step of Newton's method is taken."""
        if ti.static(self.particles.applies_first):
            self.particles.apply_constraints(now)

    @ti.func
    def unmet(self, now):
        """Whether any system is to take a second step of Newton's method. Where there are more passes, these are such steps."""
        out = False
        if ti.static(self.newton_steps > 1):
            out = now.span.iterations == 1 and self.slots.system.any_unmet[None] != 0
        return out

    @ti.func
    def solve_contacts(self, now):
        """Every pair in contact is worked out from both sides."""
        self.contact_pass.solve(now)

    @ti.func
    def struck(self):
        """1 when a pair bounces in this substep."""
        return self.contact_pass.struck()

    @ti.func
    def rebound(self, now):
        """One round of restitution."""
        self.contact_pass.rebound(now.thread)

    @ti.func
    def push_bodies(self, now):
        """Bodies that struck each other are pushed on."""
        self.contact_pass.push_bodies(now)

    @ti.func
    def apply_corrections(self, now):
        """Particles move as contacts, or constraints, want; walls have the last word."""
        self.particles.apply_corrections(now)

    @ti.func
    def finish_substep(self, now):
        """What bears too much breaks; loads become known; contacts keep what friction and restitution need; the orientation of
        what spins follows; as a frame ends, walls keep what touches them.

        At a start loads act for half a kick, and rigid constraints do what velocities lack, too: see Integrator.h2_rigid().
        """
        h2_effective = self.integrator.h2_effective(now.h, now.fresh)
        h2_rigid = self.integrator.h2_rigid(now.h, now.fresh, ti.cast(now.span.owed, self.real))
        for f in ti.static(self.breakers):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                f.dev.break_overloaded(c, h2_rigid, h2_effective, now.tick)
        self.constraints.learn(now)
        self.contact_pass.finish(now)
        if ti.static(self.orients):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                if self.state.awake(i):
                    self.state.spin.turn(i)
        for log in ti.static(self.wall_logs):
            n = self.n * now.final
            for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                log.close(i)
        self.team.wait()

    @ti.func
    def project_contact_velocities(self, now):
        """Every 32 substeps: take the sound out of loaded contacts."""
        self.damp_sound(now.thread, now.it)

    @called
    @ti.func
    def damp_sound(self, thread: ti.i32, it: ti.i32):
        """One pass of it."""
        self.contact_pass.project_velocities(thread, it)

    @ti.func
    def diagnose(self, now):
        """Sum up the figures of the frame."""
        self.diagnostics.reduce_blocks(now.thread, now.span.h64, now.span.state_origin)
        self.diagnostics.sum_up(now.thread, now.span.h64, now.span.end, now.span.state_origin, now.span.sheet)
        self.team.reset_wait_count()

    @ti.func
    def is_stale(self):
        """1 when the neighbour list has to be built anew."""
        out = 0
        if ti.static(self.hashes):
            out = self.search.list.stale[None]
        return out

    @ti.func
    def tell_halt(self, sheet: ti.template()):  # type: ignore[valid-type]
        """Write on the sheet whether, and where, the frame stopped to have the list grown, or built."""
        if ti.static(len(self.searches) > 0):
            for k in ti.static(range(3)):
                sheet[HALT + k] = self.halt[None][k]

    @ti.func
    def halted(self):
        """1 when the frame waits for a longer list."""
        out = 0
        if ti.static(len(self.searches) > 0):
            out = self.halt[None][0]
        return out

    @ti.kernel
    def listed(self, k: ti.template()) -> ti.i32:  # type: ignore[valid-type]
        """Build the k-th neighbour list where frames do not; returns the largest number of entries that a block needs."""
        self.searches[k].build(0)
        return self.searches[k].list.need[None]

    @ti.kernel
    def shrunk(self, first: ti.i32):
        """Make particles that overlap with those from number `first` on small enough to fit, from where they grow back."""
        for c in ti.static(self.contacts):
            for i in range(self.n):
                c.shrink(i, first)

    @ti.kernel
    def stopped(self, old: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Walls, where they are as a frame begins, stop what the host has moved from `old`, (n, dim), between two substeps."""
        for w in ti.static(self.posed):
            for _ in range(1):
                w.pose(ti.Vector([0, 0], self.real))
        for i in range(self.n):
            move = ti.zero(self.state.d[i])
            for k in ti.static(range(self.dim)):
                way = ti.cast(self.state.x[i][k], ti.f64) - old[i, k]
                if ti.static(self.state.sums):
                    way += self.state.low[i][k]
                move[k] = ti.cast(way, self.real)
                if ti.static(self.state.starts):
                    self.state.x0[i][k] = ti.cast(old[i, k], self.real)
                    if ti.static(self.state.sums):
                        self.state.low0[i][k] = ti.cast(old[i, k] - self.state.x0[i][k], self.real)
            if self.state.w.positive(i) and (move != 0).any():
                self.particles.stop(i, move)

    @ti.kernel
    def to_velocity(self, h64: ti.f64, t: ti.f64):
        """Turn displacements into velocities, for a start with another h or another state.

        Springs count with their force at x_n. Rigid links do not: the part of v_n along them is what the next substep corrects,
        and across them d / h + h a / 2 is what RATTLE has, so nothing is lost to second order nor to any other.
        """
        h = ti.cast(h64, self.real)
        if ti.static(self.constraints.springs):
            if ti.static(self.team.size == 1):
                self.constraints.spring_forces(0, h)
            else:
                for thread in range(self.team.spread):
                    if thread % LEAST == 0:
                        self.constraints.spring_forces(thread // LEAST, h)
        for i in range(self.n):
            force = 0 * self.state.d[i]
            if ti.static(self.constraints.springs):
                force = self.slots.total_of(i)
            self.state.d[i] = self.integrator.velocity_after(i, h, ti.cast(t, self.real), force)
            if ti.static(self.state.carries):
                self.state.d_low[i] = ti.zero(self.state.d[i])
        if ti.static(self.state.spins):
            for i in range(self.n):
                self.state.spin.end(i, h)

    @ti.kernel
    def spins(self, h64: ti.f64, t: ti.f64, firm64: ti.f64, soft64: ti.f64, out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Velocities r omega of surfaces, (n, axes), with the arguments of velocities()."""
        if ti.static(self.particles.whole):
            if h64 > 0:  # loops inside of a branch wake no threads
                self.write_spins(h64, t, firm64, soft64, out)
        else:
            self.write_spins(h64, t, firm64, soft64, out)

    @ti.func
    def write_spins(self, h64, t, firm64, soft64, out: ti.template()):  # type: ignore[valid-type]
        """To an array."""
        self.write_reactions(h64, firm64, soft64)
        for i in range(self.n):
            v = self.particles.surface_velocity(i, ti.cast(h64, self.real), ti.cast(t, self.real), ti.cast(firm64, self.real))
            for k in ti.static(range(self.state.spin.axes)):
                out[i, k] = v[k]

    @ti.kernel
    def velocities(self, given: ti.types.ndarray(ti.f64, 1), out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Velocities as the user sees them. given: h, t, firm and soft of Batch.push_reaction, of which particles: the first of
        them, and that behind the last; and firm for contacts and walls.

        With the forces of constraints at x_n along the directions there they are second order, and have the momentum and the
        angular momentum of the motion, sum m x_n x (x_n - x_(n-1)) / h and what forces from outside add in h / 2. Springs are
        asked for their force at x_n, so that a start from these velocities neither pumps nor brakes them.
        """
        if ti.static(self.particles.whole):
            if given[0] > 0:  # loops inside of a branch wake no threads
                self.write_velocities(given, out)
        else:
            self.write_velocities(given, out)

    @ti.func
    def write_velocities(self, given: ti.template(), out: ti.template()):  # type: ignore[valid-type]
        """To an array."""
        self.write_reactions(given[0], given[2], given[3])
        for i in range(integer(given, 4), integer(given, 5)):
            v = self.velocity_of(i, given[0], given[1], given[6])
            for k in ti.static(range(self.dim)):
                out[i, k] = v[k]

    @ti.func
    def write_reactions(self, h64, firm64, soft64):
        """What constraints accelerate by, to the slots."""
        self.constraints.reactions(ti.cast(h64, self.real), ti.cast(firm64, self.real), ti.cast(soft64, self.real))

    @ti.func
    def velocity_of(self, i, h64, t, firm64):
        """The velocity of one particle, once reactions() of constraints are in the slots."""
        h, time, firm = ti.cast(h64, self.real), ti.cast(t, self.real), ti.cast(firm64, self.real)
        reaction, _part = self.particles.reaction(i, h, time, firm)
        return self.integrator.velocity_after(i, h, time, reaction)
