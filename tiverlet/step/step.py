"""The step from top to bottom, and its kernels.

frame() and substep() define the order of the phases for every path. On the fused and the parallel path, Taichi compiles them into
one kernel: `do` is a Step, and one launch makes a whole frame, on one CPU thread or a team of threads. On the launched path, as
on a GPU, Python runs the same lines: `do` is a Launcher (launcher.py), and each phase is a launch. Higher orders differ only in
the integrator.
"""

from typing import TYPE_CHECKING, Any

from ..contact.impulses import IMPULSES, PLACES, ROUNDS
from ..device import called, runtime, ti
from ..device.number import OnDevice, read_all
from ..device.thread_team import LEAST, Team
from ..features.feature import Batch, Scene
from ..neighbours.strays import Strays
from .break_pass import BreakPass
from .constraint_pass import ConstraintPass
from .contact_pass import ContactPass
from .particle_pass import ParticlePass
from .span import ACTIVE_THREADS, BEFORE, FIRST, HALT, LISTS, MOST, Moment, Span, integer, span_on

if TYPE_CHECKING:
    from ..colliders.collider import Collider


@ti.pyfunc
def frame(do, span):
    """One frame: its substeps, then the report. The last round of the loop is for the neighbour list that diagnose() needs."""
    for s in range(span.begin, span.until):
        now = do.moment(span, s)
        if do.takes_part(now):
            substep(do, now)
            if s >= span.substeps and do.halted() == 0:
                do.diagnose(now)


@ti.pyfunc
def substep(do, now):
    """One substep, or its rest where the frame had stopped in it.

    In scenes with constraints and contacts a pass has two halves, constraints and then contacts. Each half begins with a valid
    neighbour list. Constraints may take a second Newton step in the first half.
    """
    if ti.static(do.has_pair_forces):
        if now.resumed == 0:
            do.evaluate_pair_forces(now)
    if now.s < now.span.substeps and now.resumed == 0 and do.halted() == 0:
        do.integrate(now)
        do.drive(now)
    for half in range(now.resumed * now.span.half, last_half(do, now)):
        regular = is_regular(do, now, half)
        if regular:
            do.update_neighbours(now, half)
        if now.s < now.span.substeps and do.halted() == 0 and do.runs_half(now, half, regular):
            this_pass = do.pass_of(now, half)
            if half % do.halves == 0:
                for k in range(do.newton_steps):
                    if k == 0 or do.needs_newton_step(this_pass):
                        do.solve_constraints(this_pass.newton_step(k))
                        do.solve_systems(this_pass.newton_step(k))
                        do.update_multipliers(this_pass.newton_step(k))
                        do.apply_constraints(this_pass.newton_step(k))
            if half % do.halves == do.halves - 1:
                if regular:
                    do.solve_contacts(this_pass)
                do.apply_corrections(this_pass)
    if ti.static(do.finishes):
        if now.s < now.span.substeps and now.span.part == now.span.iterations and do.halted() == 0:
            do.finish_substep(now)


@ti.pyfunc
def last_half(do, now):
    """The half of a pass before which the substep ends. The round after all substeps has one half, for the list."""
    halves = now.span.part * do.halves
    if ti.static(do.has_impacts):
        if now.span.part == now.span.iterations:
            halves += do.impacts.passes * do.halves
    if now.s >= now.span.substeps:
        halves = 1
    return halves


@ti.pyfunc
def is_regular(do, now, half):
    """Whether every substep has this half of a pass; bodies that struck walls add further ones."""
    out = True
    if ti.static(do.has_impacts):
        out = half // do.halves < now.span.iterations or now.s >= now.span.substeps
    return out


@ti.data_oriented
class Step:
    """The phases as loops on the device, and the kernels of one world.

    Every thread of the team runs each phase on its own share, see Team. Without a team, loops are serial inside the fused kernel,
    and Taichi spreads the outermost loops of other kernels over threads.
    """

    host_only = ("walls",)

    diagnostics: Any  # computes the report of a frame; set after construction
    sleep: Any = None  # the SleepPass, in worlds with Sleep
    n: Any = OnDevice()  # number of particles

    def __init__(
        self, scene: Scene, integrator: Any, batches: list[Batch], drivers: list[Batch], contact: Any, search: Any,
        walls: "list[Collider]", team: Team,
    ):  # fmt: skip
        self.scene, self.state, self.slots, self.team = scene, scene.state, scene.slots, team
        self.n, self.dim, self.real, self.numbers = scene.count, scene.particles.dim, scene.real, scene.memory.numbers
        self.integrator, self.search, self.walls, self.drivers, self.batches = integrator, search, walls, drivers, batches
        self.posed = [group for group in scene.walls if group.poses]
        self.wall_logs: list[Any] = [w.dev.log for w in walls if w.dev.log]
        self.sheared = bool(scene.state.images and scene.state.images.sheared)
        self.breakers: list[Any] = [b for b in batches if b.breaks]
        self.break_pass = BreakPass(scene, self.breakers, team)
        self.launched = team.launched
        # Loop iterations per piece of work in short loops: Taichi gives each CPU thread at least LEAST iterations.
        self.stride = LEAST if self.launched and runtime.architecture() == "cpu" else 1
        self.particles = ParticlePass(scene, integrator, batches, contact, search, team)
        self.constraints = ConstraintPass(scene, integrator, batches, team, self.stride)
        self.contact_pass = ContactPass(scene, contact, self.particles, team)
        self.contacts = self.particles.contacts
        self.halves = 2 if batches and contact else 1  # of a pass; each begins with a valid list
        self.impacts: Any = scene.impacts
        self.has_impacts = bool(scene.impacts)
        self.newton_steps = 2 if scene.slots and scene.slots.refines else 1  # most of them in a pass
        self.orients = self.state.spins and self.state.spin.orients
        keeps = self.contact_pass.remembers or bool(self.breakers)
        self.finishes = keeps or self.orients or bool(self.wall_logs)
        self.hashes = bool(search)
        self.sleepers = scene.state.sleepers
        self.looks = bool(search) and bool(self.sleepers)  # for contacts between awake and sleeping particles
        apart = search and search.finds_all_neighbours and not self.launched and not scene.memory.compiler.few
        self.strays: Any = Strays(scene, search, team) if apart else None
        self.pair_forces: list[Any] = integrator.forces.pairwise
        self.has_pair_forces = bool(self.pair_forces)
        self.listed_forces = [f for f in self.pair_forces if f.dev.search]
        self.searches = [*([search] if search else []), *(f.dev.search for f in self.listed_forces)]
        if self.searches:
            self.halt = scene.memory.field("halt", None, width=4, kind=ti.i32)
            if self.launched:
                team.halt = self.halt

    @ti.kernel
    def fused(self, sheet: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Run all substeps of a frame and its diagnostics in one launch; with 0 substeps, only the diagnostics."""
        ti.loop_config(serialize=self.team.size == 1)
        for thread in range(self.team.loop_length):
            if thread % LEAST == 0:
                self.run(integer(sheet, FIRST) + thread // LEAST, sheet)

    @ti.func
    def run(self, thread, sheet: ti.template()):  # type: ignore[valid-type]
        """Run one thread's share of a frame.

        All threads of a team take the same branches: the values that branches depend on are written only while the others wait.
        """
        read_all(self.numbers)
        frame(self, span_on(sheet, thread))
        if thread == 0:
            self.write_halt(sheet)
            if ti.static(self.team.size > 1):
                sheet[ACTIVE_THREADS] = self.team.active_threads[None]

    @ti.kernel
    def phases(
        self, names: ti.template(), h64: ti.f64, start: ti.f64, tick: ti.i32, fresh: ti.i32,  # type: ignore[valid-type]
        owed: ti.f64, s: ti.i32, substeps: ti.i32, iterations: ti.i32, half: ti.i32, newton: ti.i32,
    ):  # fmt: skip
        """Run some phases of a substep, by their names. It returns nothing, because the host would have to wait for a result."""
        now = self.pass_of(self.moment(Span(h64, start, start, tick, fresh, owed, 0, substeps, iterations), s), half)
        for phase in ti.static(self.named(names)):
            phase(now.newton_step(newton))

    def named(self, names: str) -> list[Any]:
        """The phases with these names, in order."""
        return [getattr(self, name) for name in names.split()]

    @ti.func
    def moment(self, span, s):
        """The Moment of substep s of a frame; s = span.substeps is the round after the last substep."""
        h, last, time, frame_fraction = self.integrator.times(span, s)
        tick, fresh, final = span.tick + s, ti.select(s == 0, span.fresh, 0), ti.cast(s == span.substeps - 1, ti.i32)
        return Moment(span, s, h, last, time, tick, frame_fraction, fresh, final, ti.select(s == span.begin, span.resumed, 0))

    @ti.func
    def pass_of(self, now, half):
        """The Moment of one half of a pass; halves are counted through all passes of the substep."""
        it = half // self.halves
        first = ti.cast(it == 0, ti.i32)
        another = it + 1 < now.span.iterations or self.has_impacts  # a further pass may follow
        checks_list = ti.select(another, 1, now.final)
        return now.of(it, first, checks_list, half)

    @ti.func
    def takes_part(self, now):
        """Whether this thread takes part in the substep. All threads must call it."""
        return self.team.takes_part(now.thread) and self.halted() == 0

    @ti.func
    def runs_half(self, now, half, regular):
        """Whether this half of a pass is run: always if it is regular, else only if bodies struck walls."""
        out = True
        if ti.static(self.has_impacts):
            if not regular:
                out = self.impacts.needs_pass(self.pass_of(now, half))
        return out

    @ti.func
    def evaluate_pair_forces(self, now):
        """Compute the forces between pairs of particles at the present positions, before any particle moves."""
        self.list_pairs(now)
        if self.halted() == 0:
            self.sum_pair_forces(now)

    @ti.func
    def list_pairs(self, now):
        """Rebuild the stale neighbour lists of pair forces. If a list has no room for all pairs, the frame stops."""
        self.look_for_motion(now)
        for f in ti.static(self.listed_forces):
            if f.dev.list.stale[None] != 0:
                f.dev.search.build(now.thread)
                if f.dev.list.need[None] > f.dev.list.capacity:
                    self.halt[None] = [1, now.s, BEFORE, LISTS]  # all write the same
        self.team.wait()

    @ti.func
    def look_for_motion(self, now):
        """Mark the lists of pair forces that are stale."""
        for f in ti.static(self.listed_forces):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                if f.dev.search.moved_too_far(i) != 0:
                    f.dev.list.stale[None] = 1
        self.team.wait()

    @ti.func
    def ask_for_pairs(self, now):
        """On the launched path: stop the frame so that the host rebuilds stale lists of pair forces, see ask_for_list()."""
        self.look_for_motion(now)
        for f in ti.static(self.listed_forces):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                if f.dev.list.stale[None] != 0:
                    self.halt[None] = [1, now.s, BEFORE, LISTS]

    @ti.func
    def sum_pair_forces(self, now):
        """Sum the forces between pairs of particles, with valid lists."""
        for f in ti.static(self.pair_forces):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                f.evaluate(i)
        self.team.wait()

    @ti.func
    def integrate(self, now):
        """Move every particle by its displacement and forces, and pose moving walls for this substep."""
        if ti.static(self.integrator.springs_pull):
            self.constraints.move_rest_values(now.thread, now.frame_fraction[0])
            self.constraints.spring_forces(now.thread, now.h, 0 * now.h, 0)
            if now.s % self.integrator.stages == self.integrator.longest + 1:
                self.constraints.note_turns(now.thread)
        for group in ti.static(self.posed):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                group.pose(now.frame_fraction, now.s == 0)
        for log in ti.static(self.wall_logs):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                whole, start = self.integrator.h2_effective(now.h, 0), self.integrator.h2_effective(now.h, now.fresh)
                log.begin(now.s + 1, ti.select(now.span.owed > 0, 0 * now.h, whole / start - 1))
            n = self.n * ti.cast(now.s == 0, ti.i32)
            for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                log.open(i)
        if ti.static(self.sheared):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                self.state.images.advance_shear(now.h)
            self.team.wait()
        if ti.static(self.has_impacts):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                self.impacts.clear_requests(now)
        self.particles.integrate(now)
        self.team.wait()
        self.team.check_waits(now.thread)

    @ti.func
    def drive(self, now):
        """Put driven particles at their targets."""
        for f in ti.static(self.drivers):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                f.dev.place.drive(c, now.h, now.frame_fraction[1])
                if ti.static(self.state.befores):  # impacts see the velocity with which the particle is driven
                    self.state.before[f.dev.corners.member(c, 0)] = self.state.d[f.dev.corners.member(c, 0)]
                if ti.static(self.integrator.uses_velocity):  # no reaction is counted if the particle is released
                    self.integrator.free[f.dev.corners.member(c, 0)] = self.state.d[f.dev.corners.member(c, 0)]
                for k in ti.static(self.contacts):
                    k.note_motion(self.search.moved_too_far(f.dev.corners.member(c, 0)), k.overshoots(f.dev.corners.member(c, 0)))
            self.team.wait()

    @ti.func
    def update_neighbours(self, now, half):
        """Rebuild the neighbour list if it is stale. If it has no room for all pairs, the frame stops."""
        if ti.static(self.hashes):
            self.rebuild_stale(now, half)
        if ti.static(self.looks):
            if now.s < now.span.substeps and self.halted() == 0 and self.sleepers.count[None] > 0:
                self.look_for_sleepers(self.pass_of(now, half))
                if self.sleepers.calls[None] != 0:
                    self.halt[None] = [1, now.s, half, LISTS]

    @ti.func
    def rebuild_stale(self, now, half):
        """Rebuild the neighbour list of contacts if it is stale. If it has no room, the frame stops before this half."""
        if self.halted() == 0 and self.is_stale() != 0:
            if ti.static(bool(self.strays)):
                self.strays.keep_list(now.thread)
            if self.is_stale() != 0:
                self.list_particles(now.thread)
                if self.search.list.need[None] > self.search.list.capacity:
                    self.halt[None] = [1, now.s, half, LISTS]  # all write the same

    @called
    @ti.func
    def list_particles(self, thread: ti.i32):
        """Build the neighbour list."""
        self.search.build(thread)

    @ti.func
    def look_for_sleepers(self, now):
        """Mark sleeping particles that are touched. The frame stops to wake them before contacts are solved."""
        n = ti.select(self.sleepers.count[None] > 0, self.n, 0)
        for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
            self.sleep.call_touched(i, self.halves - 1 - now.half % self.halves)
        self.team.wait()

    @ti.func
    def ask_to_wake(self, now):
        """On the launched path: stop the frame if sleeping particles were marked."""
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            if self.sleepers.calls[None] != 0:
                self.halt[None] = [1, now.s, now.half, LISTS]

    @ti.func
    def ask_for_list(self, now):
        """On the launched path: stop the frame if the list is stale, so that the host rebuilds it, see Team."""
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            if self.is_stale() != 0:
                self.halt[None] = [1, now.s, now.half, LISTS]

    @ti.func
    def solve_constraints(self, now):
        """Every constraint writes the moves that it wants to its slots, or its row to the system that solves it."""
        self.constraints.solve(now)

    @ti.func
    def solve_systems(self, now):
        """Solve systems of coupled constraints: chains, cloth."""
        if ti.static(len(self.constraints.systems) > 0):
            kick = ti.cast(1, self.real)
            if ti.static(self.integrator.half_kick):
                if now.fresh != 0:
                    kick = self.integrator.h2_rigid(now.h, now.fresh, ti.cast(now.span.owed, self.real)) / (now.h * now.h)
            self.solve_each(now.thread, now.newton, kick)

    @called
    @ti.func
    def solve_each(self, thread: ti.i32, newton: ti.i32, kick: ti.f32):
        """Solve each system, in the Newton step `newton`. kick: how many kicks rigid constraints supply: 1, except at a start."""
        self.constraints.solve_systems(thread, newton, kick)

    @ti.func
    def start_systems(self, now):
        """On the launched path: start the iterative systems."""
        self.constraints.start_systems(now.thread)

    @ti.func
    def iterate_systems(self, now):
        """On the launched path: one iteration of the iterative systems."""
        self.constraints.iterate_systems(now.thread)

    @ti.func
    def update_multipliers(self, now):
        """Add the steps that systems computed to the multipliers."""
        self.constraints.update_multipliers(now)

    @ti.func
    def apply_constraints(self, now):
        """Move particles as constraints want, before contacts are solved or the next Newton step is taken."""
        if ti.static(self.particles.applies_first):
            self.particles.apply_constraints(now)

    @ti.func
    def needs_newton_step(self, now):
        """Whether any system needs a second Newton step.

        With several iterations it does not: every pass is a Newton step. In the extra passes of BodyImpacts walls come first.
        """
        out = False
        if ti.static(self.newton_steps > 1):
            out = now.span.iterations == 1 and now.it == 0 and self.slots.system.any_unmet[None] != 0
        return out

    @ti.func
    def solve_contacts(self, now):
        """Solve every pair in contact."""
        self.contact_pass.solve(now)

    @ti.func
    def start_events(self, now):
        """On the launched path: begin the events of contacts that are rows."""
        self.contact_pass.begin_events(now)

    @ti.func
    def find_rows(self, now):
        """On the launched path: list the rows of contacts."""
        self.contact_pass.rows.find_rows(now)
        if ti.static(not self.contact_pass.rows.in_turn):
            self.contact_pass.rows.begin_impulses(now)

    @ti.func
    def ask_for_passes(self, now, what: ti.template()):  # type: ignore[valid-type]
        """On the launched path: stop the frame if more passes are needed than were launched, so that the host launches them."""
        ti.loop_config(serialize=True)
        for _ in range(self.team.one(1, now.thread)):
            if self.contact_pass.rows.impulses.going[None] != 0:
                self.halt[None] = [1, now.s, now.half, what]

    @ti.func
    def ask_for_rounds(self, now):
        """The same for rounds of impacts in turn."""
        self.ask_for_passes(now, ROUNDS)

    @ti.func
    def ask_for_impulses(self, now):
        """The same for passes of impulses."""
        self.ask_for_passes(now, IMPULSES)

    @ti.func
    def ask_for_places(self, now):
        """The same for passes of places."""
        self.ask_for_passes(now, PLACES)

    @ti.func
    def strike(self, now):
        """On the launched path: one round of impacts in turn."""
        self.contact_pass.rows.strike(now.thread)

    @ti.func
    def begin_impulses(self, now):
        """On the launched path: begin the passes of impulses."""
        self.contact_pass.rows.begin_impulses(now)

    @ti.func
    def relax_impulses(self, now):
        """On the launched path: one pass of impulses."""
        self.contact_pass.rows.relax_impulses(now.thread)

    @ti.func
    def finish_impulses(self, now):
        """On the launched path: end the passes of impulses."""
        self.contact_pass.rows.finish_impulses(now.thread, now.final, now.tick)

    @ti.func
    def relax_places(self, now):
        """On the launched path: one pass of places."""
        self.contact_pass.rows.relax_places(now.thread)

    @ti.func
    def apply_corrections(self, now):
        """Move particles as contacts and constraints want; walls have the last word."""
        self.particles.apply_corrections(now)

    @ti.func
    def finish_substep(self, now):
        """Break overloaded constraints, store what friction and restitution need, and turn orientations. In the last
        substep of a frame, walls close their logs of events.

        At a start loads act for half a kick, and rigid constraints also supply the kick that velocities lack: see
        Integrator.h2_rigid().
        """
        h2_effective = self.integrator.h2_effective(now.h, now.fresh)
        h2_rigid = self.integrator.h2_rigid(now.h, now.fresh, ti.cast(now.span.owed, self.real))
        if ti.static(bool(self.breakers)):
            self.break_pass.run(now, h2_rigid, h2_effective)
        self.contact_pass.finish(now)
        if ti.static(self.orients):
            for i in range(self.team.chunk_begin(self.n, now.thread), self.team.chunk_end(self.n, now.thread)):
                if self.state.awake(i):
                    self.state.spin.update_orientation(i)
        for log in ti.static(self.wall_logs):
            n = self.n * now.final
            for i in range(self.team.chunk_begin(n, now.thread), self.team.chunk_end(n, now.thread)):
                log.close(i)
        self.team.wait()

    @ti.func
    def diagnose(self, now):
        """Reduce the state to the figures of the frame's report."""
        self.diagnostics.reduce_blocks(now.thread, now.span.h64, now.span.state_origin)
        self.diagnostics.sum_up(now.thread, now.span.h64, now.span.end, now.span.state_origin, now.span.sheet)
        self.team.reset_wait_count()

    @ti.func
    def is_stale(self):
        """1 if the neighbour list has to be rebuilt."""
        out = 0
        if ti.static(self.hashes):
            out = self.search.list.stale[None]
        return out

    @ti.func
    def write_halt(self, sheet: ti.template()):  # type: ignore[valid-type]
        """Write to the sheet whether and where the frame stopped, and for what, and how many passes a substep took at most."""
        if ti.static(len(self.searches) > 0):
            for k in ti.static(range(4)):
                sheet[HALT + k] = self.halt[None][k]
            if ti.static(bool(self.contact_pass.rows)):
                for k in ti.static(range(3)):
                    sheet[MOST + k] = self.contact_pass.rows.impulses.most[None][k]
                if self.halted() == 0:
                    self.contact_pass.rows.impulses.most[None] = [0, 0, 0]

    @ti.func
    def halted(self):
        """1 if the frame has stopped and waits for the host."""
        out = 0
        if ti.static(len(self.searches) > 0):
            out = self.halt[None][0]
        return out

    @ti.kernel
    def build_list(self, k: ti.template()) -> ti.i32:  # type: ignore[valid-type]
        """Build the k-th neighbour list outside of a frame. Returns the largest number of entries that a block needs."""
        self.searches[k].build(0)
        return self.searches[k].list.need[None]

    @ti.kernel
    def to_velocity(self, given: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Turn displacements into velocities, for a start with another h or another state. given: h, t, soft, and alone, see
        Passes.push_spring_force().

        Springs count with their force at x_n. Rigid links do not count: the next substep corrects the part of v_n along them, and
        across them d / h + h a / 2 is the velocity of RATTLE, so no order of accuracy is lost.
        """
        if ti.static(self.particles.whole):
            if given[0] > 0:  # Taichi wakes no threads for loops inside a branch
                self.turn_to_velocity(given[0], given[1], given[2], given[3])
        else:
            self.turn_to_velocity(given[0], given[1], given[2], given[3])

    @ti.func
    def turn_to_velocity(self, h64, t64, soft64, alone):
        """Overwrite displacements with velocities, after a substep h at time t."""
        h, t, soft = ti.cast(h64, self.real), ti.cast(t64, self.real), ti.cast(soft64, self.real)
        if ti.static(self.constraints.springs):
            if ti.static(self.team.size == 1):
                self.constraints.spring_forces(0, h, soft, alone)
            else:
                for thread in range(self.team.loop_length):
                    if thread % LEAST == 0:
                        self.constraints.spring_forces(thread // LEAST, h, soft, alone)
        for i in range(self.n):
            force = 0 * self.state.d[i]
            if ti.static(self.constraints.springs):
                force = self.slots.total_of(i)
            self.state.d[i] = self.integrator.velocity_after(i, h, t, force)
            if ti.static(self.state.carries):
                self.state.d_low[i] = ti.zero(self.state.d[i])
        if ti.static(self.state.spins):
            for i in range(self.n):
                self.state.spin.end(i, h)

    @ti.kernel
    def spins(self, given: ti.types.ndarray(ti.f64, 1), out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Write surface velocities r omega to `out`, (n, axes). given: h, t, firm, soft, as in velocities()."""
        if ti.static(self.particles.whole):
            if given[0] > 0:  # Taichi wakes no threads for loops inside a branch
                self.write_spins(given, out)
        else:
            self.write_spins(given, out)

    @ti.func
    def write_spins(self, given: ti.template(), out: ti.template()):  # type: ignore[valid-type]
        """Body of spins()."""
        self.write_reactions(given[0], given[2], given[3])
        for i in range(self.n):
            h, time, firm = ti.cast(given[0], self.real), ti.cast(given[1], self.real), ti.cast(given[2], self.real)
            v = self.particles.surface_velocity(i, h, time, firm)
            for k in ti.static(range(self.state.spin.axes)):
                out[i, k] = v[k]

    @ti.kernel
    def velocities(self, given: ti.types.ndarray(ti.f64, 1), out: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Write velocities as the user sees them to `out`, (n, dim). given: h, t, the shares `firm` and `soft` of
        Passes.push_reaction, the first particle, the one behind the last, and `firm` for contacts and walls.

        With the forces of constraints at x_n, along the directions at x_n, velocities are second order. They have the momentum
        and the angular momentum of the motion, sum m x_n x (x_n - x_(n-1)) / h plus what external forces add in h / 2. Springs
        enter with their force at x_n, so that a start from these velocities neither pumps nor brakes them.
        """
        if ti.static(self.particles.whole):
            if given[0] > 0:  # Taichi wakes no threads for loops inside a branch
                self.write_velocities(given, out)
        else:
            self.write_velocities(given, out)

    @ti.func
    def write_velocities(self, given: ti.template(), out: ti.template()):  # type: ignore[valid-type]
        """Body of velocities()."""
        self.write_reactions(given[0], given[2], given[3])
        for i in range(integer(given, 4), integer(given, 5)):
            v = self.velocity_of(i, given[0], given[1], given[6])
            for k in ti.static(range(self.dim)):
                out[i, k] = v[k]

    @ti.kernel
    def release(self, given: ti.types.ndarray(ti.f64, 1), rows: ti.types.ndarray(ti.f64, 2)):  # type: ignore[valid-type]
        """Let driven particles go on with a velocity, as impulse.let_go() does, and sum up by how much the energy changes.

        given: h, t, the shares `firm` and `soft` of Passes.push_reaction, impulse.factor(), whether rows have velocities, the
        number of particles that go on, and that number with those that are driven from now on. The change of energy [J] replaces
        the first. rows: the index of a particle; its inverse mass, 0 for a particle that stays driven; the velocity with which it
        goes on, else it is that of its displacement.
        """
        if given[0] > 0:  # Taichi wakes no threads for loops inside a branch
            self.write_reactions(given[0], given[2], given[3])
            change, scale = ti.cast(0, ti.f64), 1 / given[0]
            for k in range(integer(given, 7)):
                i, w = ti.cast(rows[k, 0], ti.i32), rows[k, 1]
                if w > 0:
                    sign = ti.cast(-1, ti.f64)
                    if k < integer(given, 6):
                        self.keep_velocity(i, k, given, rows)
                        sign = -sign
                    energy, _kinetic = self.diagnostics.energy_per_mass(i, self.state.place(i), scale, ti.cast(0.5, self.real))
                    change += sign * energy / w
            given[0] = change

    @ti.func
    def keep_velocity(self, i, k, given: ti.template(), rows: ti.template()):  # type: ignore[valid-type]
        """Lengthen the displacement of particle i to that of its velocity, in row k of release().

        The law is that of Displacements.lengthen() on the host, see impulse.py.
        """
        d = self.state.d[i]
        v = self.velocity_of(i, given[0], given[1], given[2])
        more = ti.Vector.zero(ti.f64, self.dim)
        for a in ti.static(range(self.dim)):
            want = ti.cast(d[a] / ti.cast(given[0], self.real), ti.f64)
            if given[5] > 0:
                want = rows[k, 2 + a]
            more[a] = given[4] * (want - v[a])
        new = ti.cast(d, ti.f64) + more
        if ti.static(self.state.carries):
            new += ti.cast(self.state.d_low[i], ti.f64)
        self.state.d[i] = ti.cast(new, self.real)
        if ti.static(self.state.carries):
            self.state.d_low[i] = ti.cast(new - ti.cast(self.state.d[i], ti.f64), self.real)
        if ti.static(self.integrator.uses_velocity):
            self.integrator.free[i] = ti.cast(ti.cast(self.integrator.free[i], ti.f64) + more, self.real)

    @ti.func
    def write_reactions(self, h64, firm64, soft64):
        """Write the accelerations by constraints to their slots."""
        self.constraints.reactions(ti.cast(h64, self.real), ti.cast(firm64, self.real), ti.cast(soft64, self.real))

    @ti.func
    def velocity_of(self, i, h64, t, firm64):
        """The velocity of particle i, once write_reactions() has filled the slots."""
        h, time, firm = ti.cast(h64, self.real), ti.cast(t, self.real), ti.cast(firm64, self.real)
        reaction, _part = self.particles.reaction(i, h, time, firm)
        return self.integrator.velocity_after(i, h, time, reaction)
