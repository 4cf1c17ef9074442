"""Impacts of bodies on walls: where what a wall strikes is linked to other particles."""

from typing import TYPE_CHECKING, Any

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene

# Passes over the constraints, at most, beside those of every substep: where a system solves them, and where blows go from link to
# link. Of those, most have little to do.
FEW, MANY = 8, 32
MET = 2.0**-9  # of the first push: a velocity that is missed by less is met
LIGHTEST = 2.0**-7  # a particle is taken for this part, at least, of the mass that it has to stop
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

    open: for each pass beyond those of every substep, whether it is needed.
    """

    def __init__(self, scene: "Scene", batches: "list[Batch]"):
        system = scene.slots.system
        self.passes = FEW if system else MANY
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
        if self.struck[i] == HELD and n.dot(self.normal[i]) < 0:
            self.target[i] = ti.min(self.target[i], 0)

    @ti.func
    def hold(self, i):
        """Push particle i, or push it on. Returns whether it was off."""
        off = False
        if self.struck[i] != 0:
            n, d = self.normal[i], self.state.d[i] - self.moved[i]
            miss = self.target[i] - d.dot(n)
            if self.struck[i] == WAITS:
                self.first_push[i] = miss
            self.struck[i] = HELD
            off = ti.abs(miss) > ti.static(MET) * self.first_push[i]
            part = 1 + 0 * miss
            if ti.static(self.exact):
                if self.last_push[i] != 0:
                    part = ti.max(ti.static(LIGHTEST), ti.min((self.last_miss[i] - miss) / self.last_push[i], 1))
            pushed = ti.max(self.pushed[i] + miss / part, 0)
            change = (pushed - self.pushed[i]) * n
            for k in ti.static(range(len(self.logs))):
                if self.log[i] == k:
                    self.logs[k].add(i, change)
            self.last_push[i], self.last_miss[i], self.pushed[i] = pushed - self.pushed[i], miss, pushed
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
