"""The loops over constraints: in a pass, each one reads its particles once, and writes the moves that it wants to slots."""

from typing import Any

from ..colliders.body_impacts import holding_bodies
from ..constraints.core.spring import RESTARTED
from ..device import ti
from ..device.thread_team import Team
from ..features.feature import Batch, Scene


class ConstraintPass:
    """The loops over the constraints of one world, and over the systems of constraints that are solved together."""

    def __init__(self, scene: Scene, integrator: Any, batches: list[Batch], team: Team, stride: int):
        self.integrator, self.batches, self.slots, self.team = integrator, batches, scene.slots, team
        self.systems = [scene.slots.system] if scene.slots and scene.slots.system else []
        self.impacts = [scene.impacts] if scene.impacts else []
        self.steps = max([s.steps for s in self.systems], default=0)
        self.refines = bool(scene.slots) and scene.slots.refines
        for system in self.systems:
            system.team, system.stride = team, stride
        self.semi_iterations = [scene.slots.semi_iteration] if scene.slots and scene.slots.semi_iteration else []
        self.in_systems = [b for b in batches if b.solvable_together and b.dev.in_system]
        self.holding = holding_bodies(batches)
        self.ragged = [b for b in batches if not b.arity]
        self.capped: list[Any] = [b for b in batches if b.driven and b.dev.drive.capped]
        self.real = scene.real
        self.springs = any(b.soft for b in batches)

    @ti.func
    def reduce_blocks(self, thread, h, h2_effective, first, fresh, some: ti.template(), newton=0):  # type: ignore[valid-type]
        """Compute the sums, by blocks, of constraints on any number of particles each.

        some: True for all of them, False for those whose residual needs the sums. Systems contain no such constraints, so later
        Newton steps have nothing to sum.
        """
        for f in ti.static([f for f in self.ragged if f.dev.needs_reduce_block or some]):
            n = f.dev.corners.block_count * (1 - newton)
            for b in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                if ti.static(bool(self.slots.state.sleepers) and some):
                    if f.dev.corners.awake(f.dev.corners.block[b][2]):
                        f.dev.reduce_block(b, h, h2_effective, first, fresh)
                else:
                    f.dev.reduce_block(b, h, h2_effective, first, fresh)
            self.team.wait()

    @ti.func
    def scatter_blocks(self, thread, h, h2_effective, first, fresh, newton=0):
        """Write the moves of constraints on any number of particles each to the slots of their corners."""
        for f in ti.static(self.ragged):
            n = f.dev.corners.total * (1 - newton)
            if first >= 0 and not self.acts(f):
                n = 0 * n
            for e in range(self.team.chunk_begin(n, thread), self.team.chunk_end(n, thread)):
                if f.dev.corners.awake(f.dev.corners.owner[e]):
                    f.dev.scatter_corner(e, h, h2_effective, first, fresh)
            self.team.wait()

    @ti.func
    def spring_forces(self, thread, h, soft, alone):
        """Write h^2 times the accelerations by springs at the present positions to the slots, see Passes.push_spring_force()."""
        self.reduce_blocks(thread, h, h * h, -1, 0, True)
        for f in ti.static(self.batches):
            for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                f.dev.push_spring_force(c, h, soft, alone)
        self.team.wait()
        self.scatter_blocks(thread, h, h * h, -1, 0)

    @ti.func
    def move_rest_values(self, thread, fraction):
        """Set rest values on their way to where they are at this fraction of the frame, for springs that act as forces."""
        for f in ti.static([f for f in self.batches if f.ramp and f.ramp.is_allocated]):
            for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                f.ramp.update_rest(c, ti.Vector([fraction, fraction]))
        self.team.wait()

    @ti.func
    def note_turns(self, thread):
        """Record how far springs that act as forces turned."""
        for f in ti.static(self.batches):
            if ti.static(f.soft):
                for c in range(self.team.chunk_begin(f.count, thread), self.team.chunk_end(f.count, thread)):
                    f.dev.note_spring_turn(c)

    @ti.func
    def takes_part(self, f: ti.template(), c, now):  # type: ignore[valid-type]
        """Whether constraint c of a batch is solved: in later Newton steps, only if the first step left it unmet."""
        out = f.dev.corners.awake(c)
        if ti.static(self.refines):
            if now.newton > 0:
                if ti.static(f in self.in_systems):
                    out = out and f.dev.unmet(c)
                else:
                    out = False
        for impacts in ti.static(self.impacts):
            if impacts.is_later_extra_pass() and out:
                out = impacts.is_reached(f, c)
        return out

    @ti.func
    def acts(self, f: ti.template()):  # type: ignore[valid-type]
        """Whether the constraints of a batch act in this pass: in extra passes, only those that hold bodies together."""
        out = True
        for impacts in ti.static(self.impacts):
            if ti.static(f not in self.holding):
                out = not impacts.is_extra_pass()
        return out

    @ti.func
    def solve(self, now):
        """Every constraint writes the moves that it wants to its slots, or its row to the system that solves it."""
        fresh = now.fresh if ti.static(self.integrator.half_kick) else 0
        h2_effective = self.integrator.h2_effective(now.h, fresh)
        if fresh != 0 and now.span.owed > 0:
            fresh = RESTARTED
        if ti.static(len(self.capped) > 0):
            for _ in range(self.team.one(now.first, now.thread)):
                for f in ti.static(self.capped):
                    f.dev.drive.h2_rigid[None] = self.integrator.h2_rigid(now.h, fresh, ti.cast(now.span.owed, self.real))
            self.team.wait()
        self.reduce_blocks(now.thread, now.h, h2_effective, now.first, fresh, True, now.newton)
        for semi_iteration in ti.static(self.semi_iterations):
            ti.loop_config(serialize=True)
            for _ in range(self.team.one(1, now.thread)):
                semi_iteration.begin(now.first)
            self.team.wait()
        for f in ti.static(self.batches):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                for impacts in ti.static(self.impacts):
                    if ti.static(f in self.holding):
                        if now.s == 0 and now.first != 0:
                            impacts.mark_linked(f, c, now.h)
                if self.takes_part(f, c, now):
                    if self.acts(f):
                        f.dev.relax(c, now.h, h2_effective, now.frame_fraction, now.first, fresh)
                    else:
                        f.dev.corners.rest(c)
        if ti.static(len(self.batches) > 0):
            self.team.wait()
        self.scatter_blocks(now.thread, now.h, h2_effective, now.first, fresh, now.newton)

    @ti.func
    def solve_systems(self, thread, newton, kick):
        """Compute the steps of the multipliers of each system. kick: how many kicks they supply: 1, except at a start."""
        for system in ti.static(self.systems):
            if ti.static(system.steps > 0):
                system.start(thread)
                for _ in range(system.steps):
                    system.iterate(thread)
            else:
                for b in range(self.team.chunk_begin(system.parts, thread), self.team.chunk_end(system.parts, thread)):
                    if system.takes_step(b, newton):
                        system.solve(b, kick)
                self.team.wait()

    @ti.func
    def start_systems(self, thread):
        """On the launched path: start the iterative systems."""
        for system in ti.static(self.systems):
            system.start(thread)

    @ti.func
    def iterate_systems(self, thread):
        """On the launched path: do one iteration of the iterative systems."""
        for system in ti.static(self.systems):
            system.iterate(thread)

    @ti.func
    def update_multipliers(self, now):
        """Add the steps that systems computed to the multipliers."""
        for system in ti.static(self.systems):
            if ti.static(system.steps > 0):
                system.end(now.thread)
        for f in ti.static(self.in_systems):
            for c in range(self.team.chunk_begin(f.count, now.thread), self.team.chunk_end(f.count, now.thread)):
                if self.takes_part(f, c, now):
                    f.dev.update_multiplier(c, now.first)
        if ti.static(len(self.in_systems) > 0):
            self.team.wait()

    @ti.func
    def reactions(self, h, firm, soft):
        """Write h^2 times the accelerations by constraints at the present positions to the slots, see Passes.push_reaction()."""
        for f in ti.static(self.batches):
            for c in range(f.count):
                f.dev.push_reaction(c, h, firm, soft)
