"""How links answer the impulses of contacts: as rows of the same stage.

Before contacts, the solver of links has found multipliers lam with A C + B + alpha' lam = 0, see Equation, or has gone part of
the way. Impulses of contacts change displacements by delta. Links answer by further multipliers mu:

    A (C + g . delta) + B + alpha' (lam + mu) = 0,    delta_i = w_i (p_i + sum n_i mu),    lam + mu within its bounds.

Bounds are those of Equation: of ropes, of drives with a largest load. Places keep them, too: what is slack does not hold against
them before it is taut, and a drive at its largest load does not hold at all.
g and n are the gradients of C at the end and at the start of the substep, or at the time of an impact. So an impulse reaches all
of a body in the substep in which it acts, and bodies on links bounce, slide and rest as wholes. What rigid links are still
violated by at the end is for places to remove, and no reason for an impulse later.

Links of a System that solves them at once are no rows: the system answers, see Elimination.answer_part(). Those of one that takes
steps answer what contacts add, as softly as its floor, see ConjugateGradient; what its steps leave is left. So do those of a
semi-iteration, see Chebyshev: a step of Jacobi after its last one would end another polynomial, which is not bounded.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import always, inline, never, ti
from ..device.number import OnDevice
from ..solvers.corners import corners_of
from .limits import CLOSE, FEW, RELAXATION

if TYPE_CHECKING:
    from ..device.memory import Memory
    from ..features.feature import Batch, Scene
    from .rows import Rows


class Links:
    """The links of one world as rows.

    Corners that can move have a slot each, see Slots: `normal` and `gradient` there, and `row_of` the link, -1 for none. The
    corners of row r are those from begin[r] to begin[r + 1], with their slot and particle. `least`, `most`: of mu, by the bounds
    of lam and by the tension that the substep can stand; then of steps of places. degree: the number of rows of each particle.
    """

    n: Any = OnDevice()

    def __init__(self, scene: "Scene", batches: "list[Batch]", rows: "Rows"):
        slots, add, system = scene.slots, scene.memory.field, scene.slots.system
        self.state, self.slots, self.rows, self.real = scene.state, slots, rows, scene.real
        self.iterates = bool(system) and system.steps > 0  # whether a system leaves violations on purpose, see ConjugateGradient
        some = [b for b in batches if not b.answers_alone]
        free = {id(b): slots.rows(b) < 0 if system and system.answers else np.ones(b.count, dtype=bool) for b in some}
        self.batches = [b for b in some if free[id(b)].any()]
        self.free = [free[id(b)] for b in self.batches]
        count = [b.count for b in self.batches]
        m, total, dim = sum(count), slots.total, scene.particles.dim
        self.n = scene.memory.number(m)
        self.first = [scene.memory.number(int(k)) for k in np.cumsum([0, *count])[:-1]]
        values = self._tables(len(scene.inv_mass))
        self.row_of = add("links.row", total, kind=ti.i32, values=values["row_of"])
        self.degree = add("links.degree", scene.count, values=values["degree"])
        self.begin, self.slot, self.particle = (
            add(f"links.{k}", len(values[k]), kind=ti.i32, values=values[k]) for k in ("begin", "slot", "particle")
        )
        self.normal, self.gradient = (add(f"links.{k}", total, width=dim) for k in ("normal", "gradient"))
        self.mu, self.step, self.stiff, self.firm, self.factor, self.alpha, self.least, self.most, self.size, self.start = (
            add(f"links.{k}", m)
            for k in ("multiplier", "step", "stiff", "firm", "factor", "alpha", "least", "most", "size", "start")
        )
        self.violation = add("links.violation", m)
        self.lack, self.uphill, self.wrong = (add(f"links.{k}", m) for k in ("lack", "uphill", "wrong"))
        self.open = add("links.open", m)  # 1 where passes are needed, else 0

    def _tables(self, n: int) -> dict[str, np.ndarray]:
        """Return the arrays of rows and their corners, by name, from the present corners. n: number of particles."""
        owner, item = corners_of(self.batches)
        place = np.concatenate([np.zeros(0, dtype=int), *(self.slots.places(b).ravel() for b in self.batches)])
        is_row = np.concatenate([np.zeros(0, dtype=bool), *self.free])
        used = (place >= 0) & is_row[owner]
        owner, item, place = owner[used], item[used], place[used]
        row_of = np.full(self.slots.total, -1)
        row_of[place] = owner
        begin = np.searchsorted(owner, np.arange(len(is_row) + 1))
        return {"row_of": row_of, "degree": np.bincount(item, minlength=n), "begin": begin, "slot": place, "particle": item}

    def reassign(self, memory: "Memory", n: int) -> None:
        """Follow constraints that moved to other particles."""
        for name, values in self._tables(n).items():
            memory.write(vars(self)[name], values)

    @ti.func
    def is_first(self, s):
        """Whether slot s is that of the first corner of its row."""
        return self.slot[self.begin[self.row_of[s]]] == s

    @ti.func
    def sum_of(self, values: ti.template(), i):  # type: ignore[valid-type]
        """Return the sum of values of the rows whose first corner is particle i."""
        out = ti.cast(0, self.real)
        if ti.static(len(self.batches) > 0):
            if self.degree[i] > 0:
                for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                    if self.row_of[s] >= 0:
                        if self.is_first(s):
                            out += values[self.row_of[s]]
        return out

    @ti.func
    def completing_work(self, i):
        """Return minus the work of the rows whose first corner is particle i in taking out what their solver left, - mu C / 2.

        It is times h^2 [kg m^2].
        """
        out = ti.cast(0, self.real)
        if ti.static(len(self.batches) > 0):
            if self.degree[i] > 0:
                for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                    r = self.row_of[s]
                    if r >= 0:
                        if self.is_first(s):
                            out += self.mu[r] * self.violation[r] / (2 * self.factor[r])
        return out

    @ti.func
    def along(self, values: ti.template(), i):  # type: ignore[valid-type]
        """Return the sum of values of the rows of particle i, times their normals there."""
        out = 0 * self.state.d[i]
        if ti.static(len(self.batches) > 0):
            if self.degree[i] > 0:
                for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                    if self.row_of[s] >= 0:
                        out += values[self.row_of[s]] * self.normal[s]
        return out

    @ti.func
    def note_open(self, batch: ti.template(), c, r):  # type: ignore[valid-type]
        """Note whether row r needs passes: as its link is relaxed alone, which passes complete, or was touched by contacts."""
        self.open[r] = ti.cast(batch.dev.equation.touched[c] != 0 or self.is_completed(batch, c), self.real)

    @ti.func
    def prepare(self, batch: ti.template(), c, r, h, h2_effective, share, fresh, bodies: ti.template()):  # type: ignore[valid-type]
        """Write row r, of constraint c of a batch, where its solver has left it."""
        if ti.static(batch.arity > 0):
            violation, A, alpha, lam, W, n, g, _turn, _moved = batch.dev.linearise(c, h, h2_effective, share, 0, fresh)
            for k in ti.static(range(batch.arity)):
                place = batch.dev.corners.places[c][k]
                if place >= 0:
                    when = self.rows.when_of(batch.dev.corners.member(c, k))
                    for a in ti.static(range(self.state.dim)):
                        self.normal[place][a] = n[k, a] + when * (g[k, a] - n[k, a])
                        self.gradient[place][a] = g[k, a]
            self.write(batch, c, r, violation, A, alpha, lam, W, bodies)
        else:
            violation, A, alpha, lam, W = batch.dev.linearise(c, h, h2_effective, share, fresh)
            for e in range(batch.dev.corners.starts[c], batch.dev.corners.starts[c + 1]):
                place = batch.dev.corners.places[e]
                if place >= 0:
                    self.normal[place], self.gradient[place] = batch.dev.start[e], batch.dev.quantity.slope(e, 0)
                    if batch.dev.use_current_gradient[c] != 0:
                        self.normal[place] = self.gradient[place]
                    change = self.gradient[place] - self.normal[place]
                    self.normal[place] = self.normal[place] + self.rows.when_of(batch.dev.corners.members[e]) * change
            self.write(batch, c, r, violation, A, alpha, lam, W, bodies)

    @ti.func
    def write(self, batch: ti.template(), c, r, violation, A, alpha, lam, W, bodies: ti.template()):  # type: ignore[valid-type]
        """Write the numbers of row r, with its normals and gradients in the slots."""
        weight, firm, size = 0 * W, 0 * W, 0 * W
        for e in range(self.begin[r], self.begin[r + 1]):
            i, n = self.particle[e], self.normal[self.slot[e]]
            split, eigenvalue = bodies.split(i), bodies.split_place(i)
            weight += split * n.dot(self.gradient[self.slot[e]])
            firm += eigenvalue * n.dot(self.gradient[self.slot[e]])
            size += split * ti.sqrt(n.dot(n))
        if ti.static(self.is_left(batch)):
            if not self.is_completed(batch, c):
                # Its solver has left it as near as its steps come, a system as soft as its floor: it answers what contacts add.
                violation *= 0
                if ti.static(self.iterates):
                    if self.begin[r] < self.begin[r + 1]:
                        alpha = ti.max(alpha, A * W * self.slots.system.floor_at(self.slot[self.begin[r]]))
        acts = W > 0 and weight > 0  # a link of a system has no corners here, and no weight
        self.stiff[r] = ti.select(acts, ti.static(RELAXATION) / ti.max(A * weight + alpha, FEW), 0 * W)
        self.firm[r] = ti.select(acts, 1 / ti.max(A * firm + alpha, FEW), 0 * W)
        self.factor[r], self.alpha[r], self.size[r] = A, alpha, size / ti.static(RELAXATION)
        self.violation[r] = violation
        low, high = batch.dev.equation.bounds(c)
        if ti.static(batch.arity > 0):
            if ti.static(batch.dev.converges):
                if acts and alpha == 0:
                    cap = self.slots.most_tense(batch.dev.geometric_stiffness(c, W))
                    low, high = ti.max(low, -cap), ti.min(high, cap)
        self.least[r], self.most[r] = low - lam, high - lam
        mu = batch.dev.equation.answered[c] * self.rows.scale[None]
        if self.is_completed(batch, c):
            mu -= lam
        mu = ti.min(ti.max(mu, self.least[r]), self.most[r])
        if not acts:
            mu = 0 * mu
        self.mu[r], self.start[r], self.step[r] = mu, mu, 0 * mu

    def is_left(self, batch: Any) -> bool:
        """Return whether a solver that takes steps leaves constraints of a batch violated, and goes on in the next substep."""
        return self.iterates or bool(batch.arity and batch.dev.semi_iterates)

    @inline
    def is_completed(self, batch, c):
        """Whether passes of contacts complete what the solver of constraint c has left: it is relaxed alone, without steps."""
        if not batch.arity:
            return always()
        return never() if batch.dev.semi_iterates else batch.dev.is_outside_systems(c)

    @ti.func
    def relax(self, r, bodies: ti.template(), beta):  # type: ignore[valid-type]
        """One pass of impulses over row r."""
        u = 0 * beta
        for e in range(self.begin[r], self.begin[r + 1]):
            i = self.particle[e]
            u += self.gradient[self.slot[e]].dot(bodies.v[i] - self.state.d[i])
        before = self.mu[r]
        y = before + beta * self.step[r]
        gap = self.violation[r] + self.factor[r] * u + self.alpha[r] * y
        new = ti.min(ti.max(y - gap * self.stiff[r], self.least[r]), self.most[r])
        miss = (new - y) * self.size[r]
        self.lack[r], self.uphill[r] = miss * miss, (y - new) * (new - before)
        self.wrong[r] = ti.abs((new - self.start[r]) * gap)
        self.mu[r], self.step[r] = new, new - before

    @ti.func
    def end_impulses(self, batch: ti.template(), c, r, bodies: ti.template()):  # type: ignore[valid-type]
        """Add mu to the multiplier of constraint c of a batch, and find what places have to remove of it."""
        u, lam, mu, weight, slight = 0 * self.mu[r], batch.dev.equation.lam[c], self.mu[r], 0 * self.mu[r], 0 * self.mu[r]
        left, rigid, reached = batch.dev.equation.left[c], True, False
        for e in range(self.begin[r], self.begin[r + 1]):
            i, g = self.particle[e], self.gradient[self.slot[e]]
            reached = reached or self.rows.begin[i] < self.rows.end[i]  # places may move it
            u += g.dot(bodies.new[i] - self.state.d[i])
            weight += self.state.w[i] * g.dot(g)
            slight += g.norm() * self.rows.kick(i).norm()
        if ti.static(batch.dev.spring.soft):
            rigid = batch.dev.spring.is_rigid(c)
        touched, holds = 0, self.least[r] < mu < self.most[r]  # else it is slack, or bears all that it or the substep can
        slack = self.bound_places(batch, c, r, lam + mu, holds)
        if rigid and self.stiff[r] > 0 and (holds or slack) and (reached or u != 0 or mu != 0 or left != 0):
            touched = 1
        if ti.static(self.is_left(batch)):
            if not self.is_completed(batch, c):  # what contacts leave of it is for its solver, as all that it leaves itself
                touched = 0
        self.violation[r] = ti.select(slack or touched != 0, left + u + self.violation[r], 0 * u)
        if self.begin[r] < self.begin[r + 1]:
            batch.dev.equation.touched[c] = touched
        if self.stiff[r] > 0:
            batch.dev.equation.take_answer(c, mu, self.start[r], weight, slight, self.rows)
            if self.is_completed(batch, c):
                batch.dev.equation.answered[c] = lam + mu
        elif self.begin[r] < self.begin[r + 1]:
            batch.dev.equation.answered[c] = 0 * mu

    @ti.func
    def bound_places(self, batch: ti.template(), c, r, lam, holds):  # type: ignore[valid-type]
        """Set the bounds of the steps of places of row r, whose multiplier is lam. Returns whether it is slack, but not soft."""
        slack = False
        self.least[r], self.most[r] = -ti.math.inf, ti.math.inf
        if ti.static(batch.dev.equation.bounded):
            low, high = batch.dev.equation.bounds(c)
            if not holds and (lam <= low or lam >= high):
                self.least[r], self.most[r] = 0, 0
                if ti.static(batch.side != 0):
                    slack = lam == 0 and low < high and batch.dev.spring.is_rigid(c)
                if slack:
                    if ti.static(batch.side > 0):
                        self.least[r] = -ti.math.inf
                    else:
                        self.most[r] = ti.math.inf
        return slack

    @ti.func
    def gap(self, r, bodies: ti.template()):  # type: ignore[valid-type]
        """Return the violation of row r after what places have moved."""
        u = self.violation[r]
        for e in range(self.begin[r], self.begin[r + 1]):
            u += self.gradient[self.slot[e]].dot(bodies.new[self.particle[e]])
        return u

    @ti.func
    def relax_place(self, r, bodies: ti.template()):  # type: ignore[valid-type]
        """One pass of places over row r."""
        u = self.factor[r] * self.gap(r, bodies)
        self.step[r] = ti.max(self.least[r], ti.min(self.most[r], -u * self.firm[r]))
        wide = ti.abs(self.step[r]) * self.size[r]
        self.lack[r] = ti.select(wide > ti.static(CLOSE) * self.rows.ahead, wide, 0 * u)
