"""Impacts of bodies on walls and on each other: where what is struck is linked to other particles."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene

# Passes over the constraints, at most, beside those of every substep: where a system solves them, and where blows go from link to
# link. Of those, most have little to do.
FEW, MANY = 8, 32
MET = 2.0**-9  # of the first push: a velocity that is missed by less is met
LIGHTEST = 2.0**-7  # a particle is taken for this part, at least, of the mass that it has to stop
CAREFUL = 0.55  # the same where impacts of pairs may change each other's: projections converge by steps of less than 1 / 0.5
FELT = 2.0**-20  # of the square of a displacement: a change that is less is no blow
WAITS, HELD = 1, 2  # what is struck is so in the pass in which it meets the wall, and in those after that


def can_have_impacts(scene: "Scene", batches: "list[Batch]") -> bool:
    """Whether there can be passes beside those of every substep. Particles bounce alone in stages of higher orders; where passes
    are steps of a semi-iteration, which are as many as it was made for; and beside clusters, outlines and places, whose
    violations nobody notes: taken out all at once, those that contacts leave shook heaps for ever."""
    noted = all(b.arity > 1 for b in batches)
    return bool(batches) and noted and scene.order == 2 and not scene.slots.semi_iteration


class BodyImpacts:
    """A linked particle that strikes a wall leaves it with -e times its normal velocity, and takes along what it is linked to.

    A wall that turns one particle round has only begun: links take back what it gave. In a substep with such an impact there are
    more passes, at most FEW or MANY, until both hold: constraints are met, as far as a pass meets them, and what was struck has
    the normal displacement t = -e d_n, with d_n that before the substep. So the impact is at the start of the substep, and
    positions and displacements stay one. In each pass the sum p >= 0 of all pushes on the particle is corrected,

        p' = max(p + (t - d.n) / s, 0),    s = (miss_last - miss) / push_last,    miss = t - d.n

    where constraints are solved exactly: s is what they left of the last push, the secant of the particle's part of the mass, and
    two or three passes do. Elsewhere s = 1, for what a pass leaves is on its way; what the last leaves is lost. All impacts of a
    substep together are Newton's law for a rigid body. It neither takes nor gives energy at e = 1, which is kept to O(h) in an
    impact, for a body turns in a substep. Friction holds the tangential displacement by up to its coefficient times p.

    The first of these passes only notes what the passes of every substep left of violations. The others leave that: taken out all
    at once it would be speed. Contacts wait for the next substep. What comes nearer by no more than SLOW substeps of forces and
    links add does not bounce, see Surface.

    Two particles that strike each other, of which one is linked at least, are the same with the displacement of one relative to
    the other, in the direction of their impact, of which each takes its share by mass. Both sides work out the same, before
    either moves. A particle has one impact of this kind in a substep, on a wall or another; in others it bounces alone.

    open: for each pass beyond those of every substep, whether it is needed. pairs: whether particles strike each other.
    """

    def __init__(self, scene: "Scene", batches: "list[Batch]", pairs: bool):
        system = scene.slots.system
        self.passes = FEW if system and not pairs else MANY
        self.lightest = CAREFUL if pairs else LIGHTEST
        self.spreads = not system  # from link to link; a system takes all at once
        self.exact = bool(scene.slots.exact and (not system or system.left_out(batches) == 0))
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.state = scene.state
        self.rigid = add("impacts.rigid", n, kind=ti.i32)  # whether a rigid constraint holds it
        self.struck = add("impacts.struck", n, kind=ti.i32)  # WAITS, HELD, or 0
        self.normal, self.moved = add("impacts.normal", n, width=dim), add("impacts.wall_moved", n, width=dim)
        self.coefficients = add("impacts.friction", n, width=2)
        self.target, self.pushed, self.first_push = (add(f"impacts.{k}", n) for k in ("target", "pushed", "first_push"))
        self.last_push, self.last_miss = add("impacts.last_push", n), add("impacts.last_miss", n)
        self.held = add("impacts.held", n, width=dim)  # by friction
        self.logs: list[Any] = []  # of walls that tell of events
        self.log = add("impacts.log", n, kind=ti.i32)  # of the wall, by its number, or -1
        self.stirred = add("impacts.stirred", n, kind=ti.i32, state=True)  # whether a blow of the last substep has reached it
        self.open = add("impacts.open", self.passes + 1, kind=ti.i32)
        self.pairs = pairs
        if pairs:
            self.partner = add("impacts.partner", n, kind=ti.i32)  # or -1, for a wall
            self.ready = add("impacts.ready", n, kind=ti.i32)  # whether it has struck nothing, as a round of bounces begins
            self.change = add("impacts.change", n, width=dim)

    def enter(self, log: Any) -> int:
        """The number of a log; -1 for None."""
        if log is None:
            return -1
        self.logs.append(log)
        return len(self.logs) - 1

    @ti.func
    def linked(self, i):
        """Whether rigid constraints hold particle i."""
        return self.rigid[i] != 0

    @ti.func
    def link(self, batch: ti.template(), c):  # type: ignore[valid-type]
        """In the first pass: note whom constraint c holds, if it is rigid. Springs take no part in a blow: it is over before."""
        holds = batch.dev.spring.is_rigid(c)
        if ti.static(batch.breaks):
            holds = holds and batch.dev.strength.holds(c)
        if holds:
            for k in ti.static(range(batch.arity)):
                self.rigid[batch.dev.corners.member(c, k)] = 1

    @ti.func
    def waits(self, i):
        """Whether particle i was struck in this pass."""
        return self.struck[i] == WAITS

    @ti.func
    def clear(self, i):
        """As a substep begins."""
        self.struck[i] = self.stirred[i] = self.rigid[i] = 0

    @ti.func
    def close(self):
        """As a substep begins: no pass is needed but those of every substep."""
        for k in range(ti.static(self.passes + 1)):
            self.open[k] = 0

    @ti.func
    def ask(self, now):
        """Have more passes, once those of every substep are done."""
        if now.it + 1 >= now.span.iterations:
            self.open[now.it + 1 - now.span.iterations] = 1

    @ti.func
    def wanted(self, now):
        """Whether the pass is needed, beyond those of every substep."""
        return self.open[now.it - now.span.iterations] != 0

    @ti.func
    def notes(self):
        """Whether this is the first of them, which only notes what constraints leave."""
        return self.open[0] != 0 and self.open[1] == 0

    @ti.func
    def goes_on(self):
        """Whether this is a later one."""
        return self.open[1] != 0

    @ti.func
    def stir(self, i, change):
        """The displacement of particle i changed by so much in such a pass."""
        if change.norm_sqr() > ti.static(FELT) * self.state.d[i].norm_sqr():
            self.stirred[i] = 1

    @ti.func
    def reaches(self, batch: ti.template(), c):  # type: ignore[valid-type]
        """Whether anything of a blow has reached constraint c, which is rigid."""
        out = batch.dev.spring.is_rigid(c)
        if ti.static(self.spreads):
            near = False
            for k in ti.static(range(batch.arity)):
                near = near or self.stirred[batch.dev.corners.member(c, k)] != 0
            out = out and near
        return out

    @ti.func
    def strike(self, i, n, moved, target, static, dynamic, log):
        """A wall with the normal n that itself moved by `moved` is to take particle i to the normal displacement `target`, as it
        sees it, and to note that in this log. Returns whether that can wait for another pass: not where particle i has struck a
        wall before in this substep, nor in the last pass."""
        out = self.struck[i] == 0 and self.open[ti.static(self.passes - 1)] == 0
        if out:
            self.struck[i] = WAITS
            if ti.static(self.pairs):
                self.partner[i] = -1
            self.normal[i], self.moved[i], self.target[i] = n, moved, target
            self.pushed[i] = self.last_push[i] = 0 * target
            self.coefficients[i] = [static, dynamic]
            self.held[i] = ti.zero(n)
            self.log[i] = log
        return out

    @ti.func
    def calm_between(self, i, n):
        """A wall with the normal n presses particle i, too: if it faces the one that i has struck, i does not bounce off that,
        for what one of them gives, the other would make more."""
        if self.struck[i] == HELD and self.by_wall(i) and n.dot(self.normal[i]) < 0:
            self.target[i] = ti.min(self.target[i], 0)

    @ti.func
    def hold(self, i):
        """Push particle i, which struck a wall, or push it on. Returns whether it was off."""
        off = False
        if self.struck[i] != 0 and self.by_wall(i):
            n, d = self.normal[i], self.state.d[i] - self.moved[i]
            off, push = self.missing(i, d.dot(n))
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
            self.stirred[i] = 1
            if ti.static(self.state.keeps_wall_push):
                self.state.wall_push[i] = self.state.wall_push[i] + change
        return off

    @ti.func
    def missing(self, i, has):
        """Whether the normal displacement that particle i has is off, and what it is to be pushed by now, of what it noted."""
        miss = self.target[i] - has
        if self.struck[i] == WAITS:
            self.first_push[i] = miss
        self.struck[i] = HELD
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
        """Whether what particle i struck is a wall."""
        out = True
        if ti.static(self.pairs):
            out = self.partner[i] < 0
        return out

    @ti.func
    def prepare(self, i):
        """As a round of bounces of pairs begins, in which nobody is struck before the next loop."""
        self.ready[i] = ti.cast(self.struck[i] == 0, ti.i32)

    @ti.func
    def meets(self, i, j):
        """Whether particle i has struck particle j in this substep, and is left to passes to come."""
        return self.struck[i] != 0 and self.partner[i] == j

    @ti.func
    def strike_other(self, i, j, n, target):
        """Particles i and j strike each other, as both find in the same round, and are to leave at `target` along n, from j to i.
        Returns whether that can wait for another pass, as strike() does."""
        out = (self.linked(i) or self.linked(j)) and self.ready[i] != 0 and self.ready[j] != 0
        if out and self.state.w.positive(i):
            self.struck[i] = WAITS
            self.partner[i] = j
            self.normal[i], self.target[i] = n, target
            self.pushed[i] = self.last_push[i] = 0 * target
        return out

    @ti.func
    def work_out(self, i):
        """What particle i, which struck another, is pushed by; nobody moves before the next loop. Returns whether it was off, and
        the push, relative to the other one."""
        off, push = False, 0 * self.target[i]
        if self.struck[i] != 0 and not self.by_wall(i):
            j, n, w = self.partner[i], self.normal[i], self.state.w.of(i)
            off, push = self.missing(i, self.state.slid(self.state.d[i] - self.state.d[j], i, j).dot(n))
            self.change[i] = w / (w + self.state.w.of(j)) * push * n
        return off, push

    @ti.func
    def push(self, i):
        """Then it is."""
        if self.struck[i] != 0 and not self.by_wall(i):
            self.state.shift(i, self.change[i])
            self.stirred[i] = 1
