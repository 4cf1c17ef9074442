"""Impacts of bodies on walls and on each other: where a struck particle is linked to other particles."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene

# Passes over the constraints, at most, beside the regular ones of every substep: FEW where a system solves them, MANY where
# impulses propagate from link to link. Most of the latter have little to do.
FEW, MANY = 8, 32
MET = 2.0**-9  # of the first push: a smaller error of the normal displacement counts as met
LIGHTEST = 2.0**-7  # the least share that a particle may have in the mass that its impact stops
CAREFUL = 0.55  # the same if impacts of pairs may change each other: projections converge with steps of less than 1 / 0.5
FELT = 2.0**-20  # of a squared displacement: a smaller change is no impact
STRUCK_NOW, STRUCK_BEFORE = 1, 2  # a particle is struck: in the pass in which it meets the wall or particle, and in later passes


def can_have_impacts(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether there can be passes beside the regular ones of every substep.

    Particles bounce alone in three cases: in stages of higher orders; where passes are steps of a semi-iteration, whose number is
    fixed; and beside clusters, outlines and places, whose violations are not recorded. If contacts leave such violations and they
    are removed all at once, heaps shake for ever.
    """
    noted = all(b.arity > 1 for b in batches)
    return bool(batches) and noted and scene.order == 2 and not scene.slots.semi_iteration


class BodyImpacts:
    """A linked particle that strikes a wall leaves it with -e times its normal velocity, and takes its body along.

    Links take back part of the velocity that the wall gives to a single particle. So in a substep with such an impact there are
    more passes, at most FEW or MANY, until two conditions hold. Constraints are met, as far as a pass meets them, and the struck
    particle has the normal displacement t = -e d_n, with d_n that before the substep. So the impact is at the start of the
    substep, and positions agree with displacements. In each pass the sum p >= 0 of all pushes on the particle is corrected,

        p' = max(p + (t - d.n) / s, 0),    s = (miss_last - miss) / push_last,    miss = t - d.n

    where constraints are solved exactly: s is the part of the last push that they left, the secant of the particle's part of the
    mass, and two or three passes suffice. Otherwise s = 1, since the violation that a pass leaves is still propagating; what the
    last pass leaves is lost. All impacts of a substep together are Newton's law for a rigid body. At e = 1 it neither removes nor
    adds energy; energy is conserved to O(h) in an impact, since a body turns in a substep. Friction holds the tangential
    displacement by up to its coefficient times p.

    The first of these passes only records the violations that the regular passes left. The later passes leave these violations:
    removed all at once, they would become speed. Contacts wait for the next substep. A particle that approaches by no more than
    SLOW substeps of forces and links add does not bounce, see Surface.

    Two particles that strike each other, at least one of them linked, obey the same law with the displacement of one relative to
    the other, along their normal; each takes its share of the push by mass. Both sides compute the same push before either
    moves. A particle has one impact of this kind in a substep, on a wall or on a particle; in others it bounces alone.

    open: for each pass beyond the regular ones of every substep, whether it is needed. pairs: whether particles strike each
    other.
    """

    def __init__(self, scene: "Scene", batches: "list[Batch]", pairs: bool):
        system = scene.slots.system
        self.passes = FEW if system and not pairs else MANY
        self.lightest = CAREFUL if pairs else LIGHTEST
        self.spreads = not system  # from link to link; a system solves all links at once
        self.exact = bool(scene.slots.exact and (not system or system.count_relaxed_alone(batches) == 0))
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state = scene.state
        self.rigid = add("impacts.rigid", n, kind=ti.i32)  # whether a rigid constraint holds it
        self.struck = add("impacts.struck", n, kind=ti.i32)  # STRUCK_NOW, STRUCK_BEFORE, or 0
        self.normal, self.moved = add("impacts.normal", n, width=dim), add("impacts.wall_moved", n, width=dim)
        self.coefficients = add("impacts.friction", n, width=2)
        self.target, self.pushed, self.first_push = (add(f"impacts.{k}", n) for k in ("target", "pushed", "first_push"))
        self.last_push, self.last_miss = add("impacts.last_push", n), add("impacts.last_miss", n)
        self.held = add("impacts.held", n, width=dim)  # by friction
        self.logs: list[Any] = []  # of walls that report events
        self.log = add("impacts.log", n, kind=ti.i32)  # of the wall, by its number, or -1
        self.reached = add("impacts.stirred", n, kind=ti.i32, state=True)  # whether an impact of the last substep has reached it
        self.open = add("impacts.open", self.passes + 1, kind=ti.i32)
        self.pairs = pairs
        if pairs:
            self.partner = add("impacts.partner", n, kind=ti.i32)  # the particle that was struck; -1 for a wall
            self.ready = add("impacts.ready", n, kind=ti.i32)  # whether it had struck nothing when the round of bounces began
            self.change = add("impacts.change", n, width=dim)

    def add_log(self, log: Any) -> int:
        """Return the number of a log; -1 for None."""
        if log is None:
            return -1
        self.logs.append(log)
        return len(self.logs) - 1

    @ti.func
    def is_linked(self, i):
        """Whether rigid constraints hold particle i."""
        return self.rigid[i] != 0

    @ti.func
    def mark_linked(self, batch: ti.template(), c, h):  # type: ignore[valid-type]
        """In the first pass: mark the particles that constraint c holds, if it is rigid for a substep h.

        An impact is too short for other springs to act.
        """
        holds = batch.dev.is_firm(c, h)
        if ti.static(batch.breaks):
            holds = holds and batch.dev.strength.is_intact(c)
        if holds:
            for k in ti.static(range(batch.arity)):
                self.rigid[batch.dev.corners.member(c, k)] = 1

    @ti.func
    def is_struck_now(self, i):
        """Whether particle i was struck in this pass."""
        return self.struck[i] == STRUCK_NOW

    @ti.func
    def clear(self, i):
        """At the start of a substep: clear the marks of particle i."""
        self.struck[i] = self.reached[i] = self.rigid[i] = 0

    @ti.func
    def clear_requests(self):
        """At the start of a substep: request no passes beside the regular ones."""
        for k in range(ti.static(self.passes + 1)):
            self.open[k] = 0

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
    def is_first_extra_pass(self):
        """Whether this is the first extra pass, which only records the violations that constraints leave."""
        return self.open[0] != 0 and self.open[1] == 0

    @ti.func
    def is_later_extra_pass(self):
        """Whether this is a later extra pass."""
        return self.open[1] != 0

    @ti.func
    def mark_reached(self, i, change):
        """Mark particle i if an extra pass changed its displacement by more than rounding."""
        if change.norm_sqr() > ti.static(FELT) * self.state.d[i].norm_sqr():
            self.reached[i] = 1

    @ti.func
    def is_reached(self, batch: ti.template(), c, h):  # type: ignore[valid-type]
        """Whether constraint c is rigid for a substep h, and an impact has reached it."""
        out = batch.dev.is_firm(c, h)
        if ti.static(self.spreads):
            near = False
            for k in ti.static(range(batch.arity)):
                near = near or self.reached[batch.dev.corners.member(c, k)] != 0
            out = out and near
        return out

    @ti.func
    def record_impact(self, i, n, moved, target, static, dynamic, log):
        """Record that a wall is to give particle i the normal displacement `target`, relative to the wall.

        n: normal of the wall. moved: motion of the wall. log: number of the log for the impulse. Returns whether a later pass
        does that. It does not if particle i has struck a wall before in this substep, nor in the last pass.
        """
        out = self.struck[i] == 0 and self.open[ti.static(self.passes - 1)] == 0
        if out:
            self.struck[i] = STRUCK_NOW
            if ti.static(self.pairs):
                self.partner[i] = -1
            self.normal[i], self.moved[i], self.target[i] = n, moved, target
            self.pushed[i] = self.last_push[i] = 0 * target
            self.coefficients[i] = [static, dynamic]
            self.held[i] = ti.zero(n)
            self.log[i] = log
        return out

    @ti.func
    def cancel_bounce(self, i, n):
        """Cancel the bounce of particle i off the wall that it struck, if a wall with normal n presses it from the other side.

        Otherwise each of the two walls would amplify the push of the other.
        """
        if self.struck[i] == STRUCK_BEFORE and self.by_wall(i) and n.dot(self.normal[i]) < 0:
            self.target[i] = ti.min(self.target[i], 0)

    @ti.func
    def correct_push(self, i):
        """Push particle i, which struck a wall, towards its target, or correct the push. Returns whether its displacement was
        off."""
        off = False
        if self.struck[i] != 0 and self.by_wall(i):
            n, d = self.normal[i], self.state.d[i] - self.moved[i]
            off, push = self.missing_push(i, d.dot(n))
            change, pushed = push * n, self.pushed[i]
            for k in ti.static(range(len(self.logs))):
                if self.log[i] == k:
                    self.logs[k].add(i, change)
            held = self.held[i] + d - d.dot(n) * n
            size = held.norm()
            if size > self.coefficients[i][0] * pushed:
                held *= self.coefficients[i][1] * pushed / size
            change -= held - self.held[i]
            self.held[i] = held
            self.state.shift(i, change)
            self.reached[i] = 1
            if ti.static(self.state.keeps_wall_push):
                self.state.wall_push[i] = self.state.wall_push[i] + change
        return off

    @ti.func
    def missing_push(self, i, has):
        """Return whether the normal displacement `has` of particle i is off, and the push that it needs in this pass."""
        miss = self.target[i] - has
        if self.struck[i] == STRUCK_NOW:
            self.first_push[i] = miss
        self.struck[i] = STRUCK_BEFORE
        part = 1 + 0 * miss
        if ti.static(self.exact):
            if self.last_push[i] != 0:
                part = ti.max(ti.static(self.lightest), ti.min((self.last_miss[i] - miss) / self.last_push[i], 1))
        pushed = ti.max(self.pushed[i] + miss / part, 0)
        push = pushed - self.pushed[i]
        self.last_push[i], self.last_miss[i], self.pushed[i] = push, miss, pushed
        return ti.abs(miss) > ti.static(MET) * self.first_push[i], push

    @ti.func
    def by_wall(self, i):
        """Whether particle i struck a wall, not another particle."""
        out = True
        if ti.static(self.pairs):
            out = self.partner[i] < 0
        return out

    @ti.func
    def begin_round(self, i):
        """At the start of a round of bounces of pairs: note whether particle i has struck nothing before."""
        self.ready[i] = ti.cast(self.struck[i] == 0, ti.i32)

    @ti.func
    def has_struck(self, i, j):
        """Whether particle i has struck particle j in this substep, so that extra passes push them."""
        return self.struck[i] != 0 and self.partner[i] == j

    @ti.func
    def record_pair_impact(self, i, j, n, target):
        """Record that particle i is to leave particle j with the relative displacement `target` along n, from j to i.

        It is called for both particles in the same round. Returns whether a later pass does that, as record_impact() does.
        """
        out = (self.is_linked(i) or self.is_linked(j)) and self.ready[i] != 0 and self.ready[j] != 0
        if out and self.state.w.positive(i):
            self.struck[i] = STRUCK_NOW
            self.partner[i] = j
            self.normal[i], self.target[i] = n, target
            self.pushed[i] = self.last_push[i] = 0 * target
        return out

    @ti.func
    def compute_pair_push(self, i):
        """Compute the push of particle i, if it struck another. No particle moves before push_pair().

        Returns whether its relative displacement was off, and the relative push.
        """
        off, push = False, 0 * self.target[i]
        if self.struck[i] != 0 and not self.by_wall(i):
            j, n, w = self.partner[i], self.normal[i], self.state.w.of(i)
            off, push = self.missing_push(i, self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j).dot(n))
            self.change[i] = w / (w + self.state.w.of(j)) * push * n
        return off, push

    @ti.func
    def push_pair(self, i):
        """Push particle i by what compute_pair_push() found."""
        if self.struck[i] != 0 and not self.by_wall(i):
            self.state.shift(i, self.change[i])
            self.reached[i] = 1
