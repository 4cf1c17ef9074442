"""Impacts of bodies on walls, in worlds without contacts: where a struck particle is linked to other particles."""

from typing import TYPE_CHECKING, Any

from ..contact.limits import FULL, SLIPS, SLOW
from ..device import ti
from ..features.material import limit_length

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene

# Passes over the constraints, at most, beside the regular ones of every substep: FEW where a system solves them, MANY where
# impulses propagate from link to link. One or two do where a system solves them exactly, and most of MANY have little to do.
FEW, MANY = 8, 32
MET = 2.0**-9  # of the first push: a smaller error of the normal displacement counts as met
SAME = 0.99  # cosine between normals up to which what is left of a wall's depth is that of the same wall: 8 degrees
FELT = 2.0**-20  # of a squared displacement: a smaller change is no impact
# What holds a particle that can move: rigid clusters that share particles, links, or a rigid cluster that shares none.
IN_SHARED, LINKED, IN_CLUSTER = 1, 2, 3
STUCK, SLID = 1, 2
STRUCK_NOW, STRUCK_BEFORE = 1, 2  # a particle is struck: in the pass in which it meets the wall or particle, and in later passes


def holding_bodies(batches: "list[Batch]") -> "list[Batch]":
    """Return the batches whose particles take each other along in impacts: links, angles and clusters."""
    return [b for b in batches if b.arity > 1 or b.clusters]


def can_have_impacts(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether there can be extra passes: not in stages of higher orders, nor in a semi-iteration of a fixed number."""
    return bool(holding_bodies(batches)) and scene.order == 2 and not scene.slots.semi_iteration


def is_exact(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether a pass satisfies all constraints up to rounding."""
    system = scene.slots.system
    return bool(scene.slots.exact and (not system or system.count_relaxed_alone(batches) == 0))


def stops_bodies(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether walls without restitution stop bodies as wholes: where one pass more does it, and anything is rigid."""
    batches = holding_bodies(batches)
    links = [b for b in batches if not b.clusters]
    return (not links or is_exact(scene, links)) and any(b.rigid for b in batches)


class BodyImpacts:
    """A linked particle that strikes a wall leaves it with -e times its normal velocity, and takes its body along.

    A wall alone would stop the particle and not its body, whose links would take half of that back a substep later, and so on: an
    upright rod would take off at a quarter of its speed, whatever the substep. So in a substep with such an impact there are more
    passes, at most FEW or MANY, until constraints are met, as far as a pass meets them, and the struck particle has the normal
    displacement t = -e d_n, with d_n that before the substep: the impact is at its start, and positions agree with displacements.
    For e = 0, t is that with which the particle ends the substep on the wall. After each pass the sum p >= 0 of all pushes on the
    particle is corrected, p' = max(p + t - d.n, 0).

    Constraints take into account that the wall will do that: while p > 0, they have their gradients at the particle, and so its
    part in the matrix, without the direction of the normal, and without any where it sticks. So one pass suffices where they are
    solved exactly, for any body and any number of struck particles; there is another one if a particle was struck by it, came
    free, or sticks no more, and until what is left of friction, and for e > 0 of second order, is small. A wall that would have
    to pull, p < 0, does so until the next pass, in which constraints take into account that it lets go; at once, it would throw
    its particle as far as it has to hold it. What the last pass leaves is lost. All impacts of a substep together are Newton's
    law for a rigid body. At e = 1 energy is conserved to O(h) in an impact, since a body turns in a substep, and to O(h^2) if it
    is a cluster. Friction holds the tangential displacement by up to its coefficient times p: the static one where the particle
    stuck before, the dynamic one where it slid, until that would push it.

    These passes leave the violations that the regular passes left, and those of springs: removed all at once, they would become
    speed. Contacts, outlines, places, and clusters that share particles wait for the next substep. A particle that approaches by
    no more than SLOW substeps of forces and links add does not take part, see Surface.

    A rigid cluster that shares none of its particles moves as a rigid body in these passes, about those that cannot move, see
    ClusterImpact. Where there are contacts, walls are rows, and nothing of this is needed.

    rubs: whether a wall has friction. open: for each pass beyond the regular ones of every substep, whether it is needed.
    """

    def __init__(self, scene: "Scene", batches: "list[Batch]", rubs: bool):
        system, batches = scene.slots.system, holding_bodies(batches)
        self.passes = FEW if system or all(b.clusters for b in batches) else MANY
        self.spreads = not system  # from link to link; a system solves all links at once
        self.exact = is_exact(scene, [b for b in batches if not b.clusters])
        self.leaves = not self.exact  # regular passes leave violations
        self.stops, self.rubs = stops_bodies(scene, batches), rubs
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state = scene.state
        self.rigid = add("impacts.rigid", n, kind=ti.i32)  # IN_SHARED, LINKED, IN_CLUSTER, or 0
        self.struck = add("impacts.struck", n, kind=ti.i32)  # STRUCK_NOW, STRUCK_BEFORE, or 0
        self.normal, self.moved = add("impacts.normal", n, width=dim), add("impacts.wall_moved", n, width=dim)
        self.coefficients = add("impacts.friction", n, width=2)
        self.target, self.first_push = (add(f"impacts.{k}", n) for k in ("target", "first_push"))
        self.pushed = add("impacts.pushed", n, state=rubs)
        self.held = add("impacts.held", n, width=dim, state=rubs)  # by friction
        if rubs:
            # Whether friction holds it; whether it STUCK or SLID in this substep, 0 where no wall struck it.
            self.sticks, self.slides = add("impacts.sticks", n, kind=ti.i32), add("impacts.slides", n, kind=ti.i32, state=True)
            # The same of the last substep.
            self.braked, self.pushed_before = add("impacts.braked", n, width=dim), add("impacts.pushed_before", n)
            self.slid = add("impacts.slid", n, kind=ti.i32)
        self.bends = any(b.clusters for b in batches)
        if self.bends:
            self.bend = add("impacts.bend", n)  # of the path of a particle of a cluster along the normal, see ClusterImpact [m]
        self.logs: list[Any] = []  # of walls that report events
        self.log = add("impacts.log", n, kind=ti.i32)  # of the wall, by its number, or -1
        self.reached = add("impacts.stirred", n, kind=ti.i32, state=True)  # whether an impact of the last substep has reached it
        self.open = add("impacts.open", self.passes + 1, kind=ti.i32)

    def add_log(self, log: Any) -> int:
        """Return the number of a log; -1 for None."""
        if log is None:
            return -1
        self.logs.append(log)
        return len(self.logs) - 1

    @ti.func
    def is_linked(self, i):
        """Whether extra passes take particle i along with its body."""
        return self.rigid[i] >= LINKED

    @ti.func
    def in_cluster(self, i):
        """Whether a rigid cluster holds particle i, and nothing else."""
        return self.rigid[i] == IN_CLUSTER

    @ti.func
    def mark_linked(self, batch: ti.template(), c, h):  # type: ignore[valid-type]
        """At the start of a frame: mark the particles of constraint c if it is rigid for a substep h, as an impact sees it."""
        holds = batch.dev.is_firm(c, h)
        if ti.static(batch.dev.strength.breaks):
            holds = holds and batch.dev.strength.is_intact(c)
        if holds:
            if ti.static(batch.clusters):
                kind = ti.select(batch.dev.is_body(c), IN_CLUSTER, IN_SHARED)
                for e in range(batch.dev.corners.starts[c], batch.dev.corners.starts[c + 1]):
                    if self.state.w[batch.dev.corners.members[e]] > 0:
                        ti.atomic_max(self.rigid[batch.dev.corners.members[e]], kind)
            for k in ti.static(range(batch.arity)):
                ti.atomic_max(self.rigid[batch.dev.corners.member(c, k)], LINKED)

    @ti.func
    def is_struck_now(self, i):
        """Whether particle i was struck in this pass."""
        return self.struck[i] == STRUCK_NOW

    @ti.func
    def clear(self, i):
        """At the start of a substep: clear the marks of particle i, but for how the last one pushed it."""
        self.struck[i] = self.reached[i] = 0
        if ti.static(self.rubs):
            self.slid[i], self.braked[i], self.pushed_before[i] = self.slides[i], self.held[i], self.pushed[i]
            self.slides[i], self.held[i], self.pushed[i] = 0, ti.zero(self.held[i]), 0

    @ti.func
    def note_slip(self, i, d):
        """Note whether particle i, which moves by d, slides: with all of its friction, and other than by what passes lack."""
        if ti.static(self.rubs):
            across = d - self.moved[i] - (d - self.moved[i]).dot(self.normal[i]) * self.normal[i]
            bound = self.friction_bound(i, self.held[i])
            full = self.pushed[i] > 0 and self.held[i].norm() >= ti.static(1 - FULL) * bound * self.pushed[i]
            brakes = self.slid[i] == SLID and bound < self.coefficients[i][0]
            slides = full and (brakes or across.norm() > ti.static(SLIPS) * self.first_push[i])
            self.slides[i] = ti.select(slides, SLID, STUCK)

    @ti.func
    def friction_bound(self, i, held):
        """Return the coefficient of friction of particle i where friction takes `held` of its displacement."""
        brakes = self.slid[i] == SLID and not held.dot(self.braked[i]) < 0  # else it brakes no more, but holds
        return ti.select(brakes, self.coefficients[i][1], self.coefficients[i][0])

    @ti.func
    def near_enough(self, i):
        """Return the error of a displacement of particle i that counts as met: a part of its push, or rounding [m]."""
        return ti.max(ti.static(MET) * self.first_push[i], 4 * self.state.digits(i))

    @ti.func
    def clear_requests(self, now):
        """At the start of a substep: request no passes beside the regular ones; where none can follow, as if all were taken."""
        for k in range(ti.static(self.passes + 1)):
            self.open[k] = 0
        if now.span.part < now.span.iterations:
            self.open[ti.static(self.passes - 1)] = 1

    @ti.func
    def request_pass(self, now):
        """Request another pass, once the regular ones are done."""
        if now.it + 1 >= now.span.iterations:
            self.open[now.it + 1 - now.span.iterations] = 1

    @ti.func
    def needs_pass(self, now):
        """Whether this pass, beyond the regular ones, is needed."""
        return self.open[now.it - now.span.iterations] != 0

    @ti.func
    def is_extra_pass(self):
        """Whether constraints are solved in an extra pass."""
        return self.open[0] != 0

    @ti.func
    def is_first_extra_pass(self):
        """Whether constraints are solved in the first extra pass, which records the violations that the regular ones left."""
        return self.open[0] != 0 and self.open[1] == 0

    @ti.func
    def is_later_extra_pass(self):
        """Whether constraints are solved in a later extra pass."""
        return self.open[1] != 0

    @ti.func
    def mark_reached(self, i, change):
        """Mark particle i if an extra pass changed its displacement by more than rounding."""
        if change.norm_sqr() > ti.static(FELT) * self.state.d[i].norm_sqr():
            self.reached[i] = 1

    @ti.func
    def is_reached(self, batch: ti.template(), c):  # type: ignore[valid-type]
        """Whether an impact has reached constraint c."""
        out = True
        if ti.static(self.spreads and not batch.clusters):
            out = False
            for k in ti.static(range(batch.arity)):
                out = out or self.reached[batch.dev.corners.member(c, k)] != 0
        return out

    @ti.func
    def is_held(self, i):
        """Whether a wall holds the normal displacement of particle i, whatever constraints do."""
        return self.struck[i] == STRUCK_BEFORE and self.pushed[i] > 0

    @ti.func
    def held_part(self, i, g):
        """Return the part of the gradient g, of particle i, along which a wall holds the particle: all of it where it sticks."""
        part = g.dot(self.normal[i]) * self.normal[i]
        if ti.static(self.rubs):
            if self.sticks[i] != 0:
                part = g
        return ti.select(self.is_held(i), part, 0 * g)

    @ti.func
    def is_pulled(self, i):
        """Whether a wall pulls particle i until the next pass."""
        return self.struck[i] == STRUCK_BEFORE and self.pushed[i] < 0

    @ti.func
    def release(self, i):
        """Return how far particle i will move as the wall that pulls it lets go, or 0."""
        return ti.select(self.is_pulled(i), -self.pushed[i] * self.normal[i], 0 * self.normal[i])

    @ti.func
    def wall_change(self, i):
        """Return how far a wall that it struck has changed the displacement of particle i."""
        return ti.select(self.is_held(i), self.pushed[i] * self.normal[i] - self.held[i], 0 * self.normal[i])

    @ti.func
    def record_impact(self, i, n, moved, target, leaving, static, dynamic, log):
        """Record that a wall is to give particle i the normal displacement `target` instead of `leaving`, relative to the wall.

        n: normal of the wall. moved: motion of the wall. log: number of the log for the impulse. Returns whether a later pass
        does that. It does not if particle i has struck a wall before in this substep, nor in the last pass.
        """
        out = self.struck[i] == 0 and self.open[ti.static(self.passes - 1)] == 0
        if out:
            self.struck[i] = STRUCK_NOW
            self.normal[i], self.moved[i], self.target[i] = n, moved, target
            self.pushed[i], self.first_push[i] = 0 * target, target - leaving
            self.coefficients[i] = [static, dynamic]
            self.held[i] = ti.zero(n)
            if ti.static(self.rubs):
                self.sticks[i] = 0
                if self.slid[i] == 0:
                    d = self.state.d[i] - moved
                    self.slid[i] = ti.select((d - d.dot(n) * n).norm() > ti.static(SLOW) * (target - leaving), SLID, STUCK)
            if ti.static(self.bends):
                self.bend[i] = 0 * target
            self.log[i] = log
        return out

    @ti.func
    def answers(self, i, n):
        """Whether particle i has its impulse from a wall with the normal n in this substep."""
        return self.struck[i] == STRUCK_BEFORE and n.dot(self.normal[i]) > ti.static(SAME)

    @ti.func
    def cancel_bounce(self, i, n):
        """Cancel the bounce of particle i if a wall presses it from the other side: each would amplify the other's push."""
        if self.struck[i] == STRUCK_BEFORE and n.dot(self.normal[i]) < 0:
            self.target[i] = ti.min(self.target[i], 0)

    @ti.func
    def correct_push(self, i, now):
        """Push particle i, which struck a wall, to its target, or correct the push. Returns whether constraints have to follow.

        Where they are solved exactly, they have taken into account that the wall holds it, if the wall held it before.
        """
        off = False
        if ti.static(self.exact):
            off = self.is_pulled(i)
            if off:
                self.log_push(i, self.release(i))
                self.state.shift(i, self.release(i))
                self.pushed[i] = ti.zero(self.pushed[i])
        if self.in_cluster(i):
            if ti.static(self.bends):
                if self.struck[i] == STRUCK_BEFORE:  # it turns in a substep: second order is left
                    miss = self.target[i] + self.bend[i] - (self.state.d[i] - self.moved[i]).dot(self.normal[i])
                    off = (miss > 0 or self.pushed[i] > 0) and ti.abs(miss) > self.near_enough(i)
        elif self.struck[i] != 0:
            n, d, last = self.normal[i], self.state.d[i] - self.moved[i], self.pushed[i]
            miss = self.target[i] - d.dot(n)
            pushed, change = ti.max(last + miss, 0), ti.max(miss, -last) * n
            if self.struck[i] == STRUCK_NOW:  # another wall may have pushed it meanwhile
                pushed, change = self.first_push[i], miss * n
            elif ti.static(self.exact):
                if last > 0 and now.it + 1 - now.span.iterations < ti.static(self.passes):  # another pass can follow
                    pushed, change = last + miss, miss * n
            self.struck[i] = STRUCK_BEFORE
            self.pushed[i] = pushed
            off = off or (pushed > 0) != (last > 0)
            if ti.static(not self.exact) or self.target[i] > 0:
                off = off or ti.abs(miss) > self.near_enough(i)
            self.log_push(i, change)
            if ti.static(self.rubs):
                held = self.held[i] + d - d.dot(n) * n
                bound = self.friction_bound(i, held) * ti.max(pushed, 0)
                sticks = held.norm() <= bound and bound > 0
                held = limit_length(held, bound, bound)
                if self.coefficients[i][0] > 0:
                    off = off or sticks != (self.sticks[i] != 0)
                    off = off or (not sticks and (held - self.held[i]).norm() > self.near_enough(i))
                change -= held - self.held[i]
                self.sticks[i], self.held[i] = ti.cast(sticks, ti.i32), held
            self.state.shift(i, change)
            self.note_slip(i, self.state.d[i])
            self.reached[i] = 1
        return off

    @ti.func
    def log_push(self, i, change):
        """Add what a wall, which particle i struck, changed of its displacement to the events of that wall."""
        for k in ti.static(range(len(self.logs))):
            if self.log[i] == k:
                self.logs[k].add(i, change)

    @ti.func
    def mark_struck_in_cluster(self, i):
        """Mark particle i of a cluster that an impact has moved."""
        self.reached[i] = 1
        if self.struck[i] == STRUCK_NOW:
            self.struck[i] = STRUCK_BEFORE
