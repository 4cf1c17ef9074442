"""Stage 1 of contacts: impulses.

With x' = x + d, the gap C and c0 = min(C(x), 0) of each row:

    C(x') >= c0,   p >= 0,   p (C(x') - c0) = 0,   |tangential impulse| <= friction p

Normals are those at the start of the substep, and the gap is the true one at its end: SHAKE for inequalities, which is second
order. Overlap c0 is no reason for an impulse; it is only kept from growing. So overlap stores no energy, whatever h does.

Solved by projected Jacobi with split masses: among the rows of a particle, or without friction by the largest eigenvalue of the
sum of n n^T over them. No eigenvalue of a pass exceeds RELAXATION. Passes are
accelerated (Nesterov 1983) and restarted where they go uphill (O'Donoghue and Candes 2015). They start from what rows bore in the
last substep, and stop where the mean square of what rows lack is below MET times the displacement by forces. Where anything
bounces they go on until the energy that is wrong, the sum of p C beyond loads, is below ERROR of the kinetic energy, too: in a
column of N each row lacks little, but N of them add up.

Passes start with momentum, as if they had run before: what is at rest then needs a few, and landings half as many. A few passes
at least run in each substep: through the start they continue over substeps, which brings a pile to rest.
"""

from typing import TYPE_CHECKING, Any

from ..device import at, inline, ti
from ..device.number import OnDevice
from ..features.material import limit_length
from .limits import BLOCK, FEW, FORCE, GROUP, HITS, KINETIC, LACK, LOAD, OWN, RELAXATION, ROWS, SLOW, SUMS, UPHILL, WORK, WRONG

if TYPE_CHECKING:
    from ..device.thread_team import Team
    from ..features.feature import Scene
    from .responses import Responses
    from .rows import Rows

ALONE = 1.001  # by what masses are split where a row shares its particles with none, to rounding
MET = 0.0005  # of the displacement by forces in a substep: what rows may lack. It adds up over the height of a pile
PASSES = 20  # most passes of impulses in a substep
LANDS = 0.2  # of the displacement by forces: where rows lack more after PASSES, something lands
BOUNCES = 200  # most of them where anything bounces or lands: the impulse has to reach the other end of what touches
LEAST = 6, 3  # fewest of them, without and with friction: what rests comes to rest down to rounding
MOMENTUM = 10.0  # Nesterov's theta of the first pass, after about twice as many
LEFT = 1e-7  # share of the mean square of what rows lack in the first pass that may be left, where no forces act
ERROR = 0.002  # of the kinetic energy of all: the energy that may be wrong after a bounce
ROUNDING = 0.1  # of what rows may lack: times the impulses, the work that they may do
MOVES = 8  # most passes of places in a substep
SHARE = 1.2  # of an overlap that a pass of places moves, by masses split by the largest eigenvalue; below 4/3
ROUNDS, IMPULSES, PLACES = range(3)  # kinds of passes: of impacts in turn, of stage 1, of stage 2


class Impulses:
    """Stage 1 of the contacts of one world."""

    n: Any = OnDevice()
    blocks: Any = OnDevice()

    def __init__(self, scene: "Scene", rows: "Rows", bodies: "Responses", team: "Team"):
        self.rows, self.bodies, self.team, self.state = rows, bodies, team, scene.state
        self.least = LEAST[rows.has_friction]
        self.n, self.real, self.dim, self.has_friction = scene.count, scene.real, scene.particles.dim, rows.has_friction
        add = scene.memory.field
        self.blocks = scene.memory.number(-(-scene.particles.count // BLOCK))
        self.memory, self.sums = scene.memory, add("Contact.sums", max(1, self.blocks), width=len(SUMS))
        self.each: Any = add("Contact.sums_of_particles", scene.count, width=len(SUMS)) if team.launched else None
        self.groups: Any = (
            add("Contact.sums_of_groups", -(-max(1, self.blocks) // GROUP), width=len(SUMS)) if team.launched else None
        )
        # Of the passes: how far the next one extrapolates, with Nesterov's theta; what rows may lack, and what they lack in
        # impacts; and work per impulse that is rounding [m].
        self.beta, self.theta, self.tolerance, self.landing, self.allowed = (
            add(f"Contact.{name}", None) for name in ("beta", "theta", "tolerance", "landing", "allowed")
        )
        # Whether another pass follows, its number, whether any particle gains energy or is moved, and whether anything bounces.
        self.going, self.turn, self.gains, self.strikes = (
            add(f"Contact.{name}", None, kind=ti.i32) for name in ("going", "turn", "gains", "strikes")
        )
        # Whether systems answer to second order, see RowPass.bend_systems(): 0: not yet, 1: from the next pass on, 2: they do.
        self.has_systems = bool(bodies.answers) and bool(bodies.answers.systems)
        self.bending: Any = add("Contact.bending", None, kind=ti.i32) if self.has_systems else None
        # Rounds, passes of impulses and of places that a substep of a frame took at most.
        self.most = add("Contact.most", None, width=3, kind=ti.i32)
        self.last_h2 = add("Contact.last_h2", None, state=True)  # h^2 of what rows bore [s^2]; 0 before the first substep

    def regroup(self, n: int) -> None:
        """Adapt to a new number of particles."""
        self.blocks = -(-n // BLOCK)
        self.memory.resize(self.sums, max(1, self.blocks))

    @inline
    def struck(self):
        """Return 1 if anything bounces in the substep, else 0."""
        return at(self.strikes, None) if self.rows.bounces else 0

    @ti.func
    def note_turn(self, k: ti.template(), turn):  # type: ignore[valid-type]
        """Note how many passes of a kind this substep took so far."""
        self.most[None][k] = ti.max(self.most[None][k], turn)

    @ti.func
    def note(self, i, k: ti.template(), value):  # type: ignore[valid-type]
        """Note a sum over the block that begins at particle i; on the launched path, over particle i."""
        if ti.static(self.team.launched):
            self.each[i][k] = value
        else:
            self.sums[i // BLOCK][k] = value

    @ti.func
    def add_up(self, b, k: ti.template()):  # type: ignore[valid-type]
        """Add up what the particles of block b have noted."""
        out = ti.cast(0, self.real)
        for i in range(b * BLOCK, ti.min((b + 1) * BLOCK, self.n)):
            out += self.each[i][k]
        self.sums[b][k] = out

    @ti.func
    def begin(self, now, h2):
        """Begin a substep. h2: what an acceleration of 1 m/s^2 adds to a displacement in it [s^2]. One thread calls it."""
        before = self.last_h2[None]
        scale = ti.cast(0, self.real)
        if before > 0:
            scale = h2 / before
        self.last_h2[None] = h2
        self.rows.h[None], self.rows.scale[None], self.rows.whole[None] = now.h, scale, h2 / (now.h * now.h)
        self.rows.frame_fraction[None] = [now.frame_fraction[0], now.frame_fraction[1]]
        self.rows.turn_shares[None] = self.rows.spin_shares()
        self.going[None], self.strikes[None] = 1, 0

    @ti.func
    def prepare(self, i, part):
        """Compute the effective masses of a part of the rows of particle i, and give particles what these rows bore."""
        p_own, m_own = 0 * self.state.d[i], self.no_moment()
        share, kept, pressed, struck = self.rows.share[i], self.rows.kept[i], self.rows.pressed[i], self.struck()
        if ti.static(not self.has_friction):
            share = self.rows.eigenvalue[i]
        w_own, across_own = self.bodies.split(i), self.bodies.split_tangential(i)
        weight = ti.cast(0, self.real)
        if ti.static(self.rows.bounces):
            if struck != 0:
                weight = self.weight(i)
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            other, n = self.rows.other.field[row], self.rows.normal.field[row]
            w, across, most, e = w_own, across_own, share, self.bodies.split_place(i)
            if row < pressed:
                for k in ti.static(range(self.rows.ends)):
                    j, c = self.rows.pressed_on(row, k), self.rows.part(row, k)
                    w += c * self.bodies.split(j)
                    across += c * self.bodies.split_tangential(j)
                    e += c * self.bodies.split_place(j)
                    if self.state.moves(j):
                        most = ti.max(most, self.rows.share[j] if ti.static(self.has_friction) else self.rows.eigenvalue[j])
            step, move = ti.cast(RELAXATION, self.real), ti.cast(SHARE, self.real)
            if most < ALONE:  # a row that shares its particles with none that it could disturb is solved in one pass
                step, move = 1, 1
            self.rows.firm.field[row] = move / e
            p = self.rows.p.field[row]
            if ti.static(self.has_friction):
                self.rows.stiff.field[row] = [step / w, step / across]
                if self.rows.friction.field[row][1] < self.rows.friction.field[row][0]:
                    self.rows.bound_friction(row, n, self.slip(i, row, n, self.state.d, False), self.slight(i, row))
                p = self.cone(row, ti.max(p.dot(n), 0), p - p.dot(n) * n, n)
            else:
                self.rows.stiff.field[row] = step / w
                p = ti.max(p, 0)
            self.rows.p.field[row] = p
            if ti.static(self.rows.bounces):
                if struck != 0 and self.rows.bounce.field[row] == 0:  # it aims at nothing: here stands what it bears at first
                    self.rows.target.field[row] = self.rows.along(p, n)
                    self.rows.slight.field[row] = self.weight_on(row, weight, pressed)
            v = self.rows.vector(p, n)
            p_own += v
            if ti.static(self.bodies.spins):
                m_own += self.bodies.spin.moment(n, v)
            self.send(row, n, v, part == OWN and row < kept)
            if ti.static(self.rows.turns):
                self.prepare_turn(i, row, other)
                m_own += self.give_turn(row, other, part == OWN and row < kept)
        self.take(i, part, p_own, m_own)

    @ti.func
    def prepare_turn(self, i, row, other):
        """Compute the effective masses of a row against rolling and twisting."""
        arms = self.rows.arms.field[row]
        each = self.rows.share[i] * arms[1] * arms[1] * self.bodies.turning_compliance(i)
        if row < self.rows.pressed[i]:
            each += self.rows.share[other] * arms[0] * arms[0] * self.bodies.turning_compliance(other)
        step = ti.cast(RELAXATION, self.real)
        self.rows.turn_stiff.field[row] = [step / ti.max(2 * each, FEW), step / ti.max(each, FEW)]

    @ti.func
    def give_turn(self, row, other, gives):
        """Give the other particle of a row its moment. Returns that of its own."""
        arms, f = self.rows.arms.field[row], self.rows.f.field[row]
        if gives:
            self.bodies.moment[other] = self.bodies.moment[other] + arms[0] * f
        return -arms[1] * f

    @ti.func
    def relax_turn(self, i, row, other, n, load, beta):
        """One pass over the moment of a row, which resists rolling and twisting by up to a part of the load. Returns how far it
        goes uphill."""
        arms, stiff, most = self.rows.arms.field[row], self.rows.turn_stiff.field[row], self.rows.rolling.field[row] * load
        turn = arms[1] * self.bodies.s[i]
        if row < self.rows.pressed[i]:
            turn -= arms[0] * self.bodies.s[other]
        before = self.rows.f.field[row]
        y = before + beta * self.rows.f_step.field[row]
        twist, about = self.bodies.spin.along(turn, n), self.bodies.spin.along(y, n)
        new = limit_length(y - about - stiff[0] * (turn - twist), most[0], most[0])
        new += limit_length(about - stiff[1] * twist, most[1], most[1])
        self.rows.f.field[row], self.rows.f_step.field[row] = new, new - before
        return (y - new).dot(new - before)

    @ti.func
    def no_moment(self):
        """Return a moment of 0."""
        return ti.Vector.zero(self.real, 3 if self.dim == 3 else 1)

    @ti.func
    def cone(self, row, normal, across, n):
        """Return the impulse of a row in Coulomb's cone that is next to the one with these parts along the normal and across it.

        Impulses of impacts in turn have friction, too.
        """
        size, most = across.dot(across), self.rows.friction_bound(row, across, n) * (normal + self.rows.hit(row))
        if size > most * most:
            across *= most / ti.sqrt(size)
        return normal * n + across

    @ti.func
    def slip(self, i, row, n, d: ti.template(), at_end: ti.template()):  # type: ignore[valid-type]
        """Return the slip of a row of particle i, across its normal, where particles move by d [m]."""
        other, pressed = self.rows.other.field[row], self.rows.pressed[i]
        t = self.rows.relative(d[i], d, i, other, row, pressed)
        t -= t.dot(n) * n
        if ti.static(self.bodies.spins):
            s = self.bodies.new_s[i] if ti.static(at_end) else self.bodies.spin.s[i]
            if row < pressed:
                s += self.bodies.new_s[other] if ti.static(at_end) else self.bodies.spin.s[other]
            t -= self.bodies.spin.surface(s, n)
        return t

    @ti.func
    def slight(self, i, row):
        """Return by how much forces move the particles of a row of particle i [m]."""
        out = self.rows.kick(i).norm()
        if row < self.rows.pressed[i]:
            for k in ti.static(range(self.rows.ends)):
                out += self.rows.kick(self.rows.pressed_on(row, k)).norm()
        return out

    @ti.func
    def take(self, i, part, p, m):
        """Add impulses of sum p and moments of sum m to those of particle i; after its own rows, compute its answer."""
        p += self.bodies.push[i]
        if ti.static(self.bodies.spins):
            m += self.bodies.moment[i]
        if part == OWN and ti.static(not self.rows.edges):
            self.bodies.answer(i, p, m)
        else:
            self.bodies.push[i] = p
            if ti.static(self.bodies.spins):
                self.bodies.moment[i] = m

    @ti.func
    def send(self, row, n, p, gives):
        """Let what a row presses on have an impulse p: edges gather it, a particle is given it if the row `gives`."""
        if ti.static(bool(self.rows.edges)):
            self.rows.edges.gone.field[row] = p
        elif gives:
            self.bodies.give(self.rows.other.field[row], n, p)

    @ti.func
    def gather(self, i):
        """Compute the answer of particle i to the impulses of its rows and of those of its edges."""
        self.bodies.answer(i, self.bodies.push[i] + self.rows.edges.gather(i), self.no_moment())

    @ti.func
    def relax(self, i, part):
        """One pass over a part of the rows of particle i. Returns what they lack, how far they go uphill, what they
        bear, and wrong()."""
        beta = self.beta[None]
        v, p_own, m_own = self.bodies.v[i], 0 * self.state.d[i], self.no_moment()
        s_own = self.no_moment()
        if ti.static(self.bodies.spins):
            s_own = self.bodies.s[i]
        kept, pressed, struck = self.rows.kept[i], self.rows.pressed[i], self.struck()
        lack, uphill, load, wrong = ti.Vector.zero(self.real, 4)
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            other, n = self.rows.other.field[row], self.rows.normal.field[row]
            u, s = self.rows.relative(v, self.bodies.v, i, other, row, pressed), s_own
            if ti.static(self.bodies.spins):
                if row < pressed:
                    s += self.bodies.s[other]
            un = u.dot(n)
            t = u - un * n
            # The true gap at the end, less that at the start where it was negative.
            gap = self.rows.gap.field[row] + un + self.rows.rise(u.dot(u) - un * un, un, self.rows.bend.field[row])
            if ti.static(bool(self.rows.edges)):
                if row < pressed and self.rows.edges.place.field[row] >= 0:
                    gap = self.rows.edges.gap(row, u, self.bodies.v)
            if ti.static(self.rows.bounces):
                if self.rows.bounce.field[row] > 0:
                    gap = un - self.rows.target.field[row]
            before, stiff = self.rows.p.field[row], self.rows.stiff.field[row]
            y = before + beta * self.rows.step.field[row]
            new, hit = y, self.rows.hit(row)
            if ti.static(self.has_friction):
                if ti.static(self.bodies.spins):
                    t -= self.bodies.spin.surface(s, n)
                if ti.static(self.rows.turns):
                    t -= self.rows.across.field[row]
                yn = y.dot(n)
                normal = ti.max(yn - gap * stiff[0], -self.rows.most_taken(row))
                new = self.cone(row, normal, y - yn * n - stiff[1] * t, n)
                miss = (normal - yn) / stiff[0]
                lack += miss * miss
                uphill += (y - new).dot(new - before)
                load += ti.abs(normal)
                wrong += self.wrong(row, normal, gap, struck)
            else:
                new = ti.max(y - gap * stiff, -self.rows.most_taken(row))
                miss = (new - y) / stiff
                lack += miss * miss
                uphill += (y - new) * (new - before)
                load += ti.abs(new)
                wrong += self.wrong(row, new, gap, struck)
            self.rows.p.field[row] = new
            self.rows.step.field[row] = new - before
            p = self.rows.vector(new, n)
            p_own += p
            if ti.static(self.bodies.spins):
                m_own += self.bodies.spin.moment(n, p)
            self.send(row, n, p, part == OWN and row < kept)
            if ti.static(self.rows.turns):
                uphill += self.relax_turn(i, row, other, n, self.rows.along(new, n) + hit, beta)
                m_own += self.give_turn(row, other, part == OWN and row < kept)
        if ti.static(bool(self.bodies.answers)):
            if part == OWN:
                lack += self.bodies.answers.links.sum_of(self.bodies.answers.links.lack, i)
                uphill += self.bodies.answers.links.sum_of(self.bodies.answers.links.uphill, i)
                wrong += self.bodies.answers.links.sum_of(self.bodies.answers.links.wrong, i)
        self.take(i, part, p_own, m_own)
        return ti.Vector([lack, uphill, load, wrong] if ti.static(self.rows.bounces) else [lack, uphill, load])

    @ti.func
    def wrong(self, row, p, gap, struck):
        """Return the energy of impacts that is wrong by what a row lacks, times h^2 [kg m^2]. struck: whether anything bounces.

        p: what it presses with. Its work would be 0 with a gap of 0. A load does none, nor what forces change of it, as in
        Rows.steady_change(): else a heap would be solved as if all of it were struck, wherever a grain bounces on it.
        """
        out = 0 * p
        if ti.static(self.rows.bounces):
            if p != 0 and struck != 0:
                impact = ti.abs(p)
                if self.rows.bounce.field[row] == 0:
                    change = ti.abs(p - self.rows.target.field[row])
                    impact = ti.max(change - self.rows.steady_change(impact, self.rows.slight.field[row]), 0)
                out = impact * ti.abs(gap)
        return out

    @ti.func
    def gain(self, block):
        """Return the energy that impulses give to bodies of a block, without those from which they take some, times h^2 [J s^2].

        Particles that follow each other are mostly of one body, and of one island: what pushes one corner down lifts another one.
        """
        out, of_body, body = ti.cast(0, self.real), ti.cast(0, ti.f64), -1
        for i in range(block * BLOCK, ti.min((block + 1) * BLOCK, self.n)):
            own = self.bodies.body(i)
            if own != body:
                out += ti.cast(ti.max(of_body, 0), self.real)
                body, of_body = own, 0 * of_body
            work, square = self.bodies.work(i)
            of_body += work + square / 2 - self.rows.work_of_others(i)
        return out + ti.cast(ti.max(of_body, 0), self.real)

    @ti.func
    def force(self, i):
        """Return the sum over the own rows of particle i of the square of what forces add to its displacement [m^2].

        That counts up to where LANDS of it is what places can part in a substep. What lacks more could end behind a thin body.
        """
        out, kick = ti.cast(0, self.real), self.rows.kick(i)
        for row in range(self.rows.own[i], self.rows.end[i]):
            most = self.rows.most_parting(self.rows.size_at(i, row), -1 + 0 * out) / LANDS
            out += ti.min(kick.dot(kick), most * most)
        return out

    @ti.func
    def start_passes(self):
        """Before the first pass: no extrapolation, and what rows may lack. One thread calls it."""
        rows, force = self.total(ROWS), self.total(FORCE)  # the sum over rows of the squared displacement by forces
        met, lands = ti.static(MET * MET) * force + self.total(LOAD), ti.static(LANDS * LANDS) * force
        self.beta[None], self.theta[None], self.tolerance[None], self.landing[None] = 0, ti.static(MOMENTUM), met, lands
        self.going[None], self.turn[None] = ti.cast(rows > 0, ti.i32), 0
        if ti.static(self.has_systems):
            self.bending[None] = 0

    @ti.func
    def momentum(self):
        """Return how far the next pass extrapolates, and the theta after it (Nesterov)."""
        theta = self.theta[None]
        ahead = (1 + ti.sqrt(1 + 4 * theta * theta)) / 2
        return (theta - 1) / ahead, ahead

    @ti.func
    def decide(self):
        """Decide after a pass whether another one follows, and how far it extrapolates. One thread calls it."""
        lack, uphill = self.total(LACK), self.total(UPHILL)
        turn = self.turn[None] + 1
        if turn == 1:
            self.tolerance[None] = ti.max(self.tolerance[None], ti.static(LEFT) * lack)
        self.turn[None] = turn
        self.note_turn(IMPULSES, turn)
        most = ti.select(lack > self.landing[None], BOUNCES, PASSES)
        goes_on = turn < most and lack > self.tolerance[None]
        if ti.static(self.rows.bounces and not self.rows.impacts):  # else rounds have done it
            if self.strikes[None] != 0 and self.total(WRONG) > ti.static(ERROR) * self.total(KINETIC):
                goes_on = turn < BOUNCES
        goes_on = (goes_on or turn < self.least) and self.total(ROWS) > 0
        if ti.static(self.has_systems):
            before = self.bending[None]
            bending = 2 * ti.min(before, 1)
            if before == 0 and not goes_on and self.total(ROWS) > 0:
                bending, goes_on = 1, True
            self.bending[None] = bending
            uphill = ti.select(bending == 1, 1 + 0 * uphill, uphill)  # what rows lack has another zero from here on
        beta, ahead = self.momentum()
        if uphill > 0:
            beta, ahead = 0 * beta, 1 + 0 * ahead
        self.beta[None], self.theta[None] = beta, ahead
        self.going[None] = ti.cast(goes_on, ti.i32)

    @ti.func
    def start_places(self):
        """Before the first pass of stage 2. One thread calls it."""
        self.beta[None], self.theta[None] = 0, 1
        self.going[None], self.turn[None] = ti.cast(self.total(ROWS) > 0, ti.i32), 0

    @ti.func
    def decide_places(self):
        """Decide after a pass of stage 2 whether it moves anything, and whether another one follows. One thread calls it."""
        turn = self.turn[None] + 1
        self.beta[None], self.theta[None] = self.momentum()
        moves = ti.cast(self.total(LACK) > 0, ti.i32)
        self.note_turn(PLACES, turn)
        self.going[None], self.turn[None], self.gains[None] = ti.select(turn < MOVES, moves, 0), turn, moves

    @ti.func
    def check_work(self):
        """Find whether any particle gains energy beyond rounding. One thread calls it."""
        allowed = ti.static(ROUNDING) * ti.sqrt(self.tolerance[None] / ti.max(self.total(ROWS), 1))
        self.allowed[None] = allowed
        self.gains[None] = ti.cast(self.total(WORK) > allowed * self.total(LOAD), ti.i32)

    @ti.func
    def check_hits(self):
        """Find whether anything bounces. One thread calls it."""
        hits = ti.cast(self.total(HITS) > 0, ti.i32)
        self.strikes[None], self.going[None], self.turn[None] = hits, hits, 0
        self.tolerance[None] = 0

    @ti.func
    def decide_round(self):
        """Decide after a round of impacts in turn whether another one follows, and whether any of them share particles.

        What is left where energy is lost, and is little beside all before, is left to the passes. One thread calls it.
        """
        turn = self.turn[None] + 1
        self.note_turn(ROUNDS, turn)
        work = self.total(WORK)
        done = self.tolerance[None] + work
        goes_on = work > ti.static(ERROR) * done or self.total(LACK) > 0
        self.tolerance[None] = done
        self.going[None], self.turn[None] = ti.cast(goes_on and turn < BOUNCES, ti.i32), turn
        self.gains[None] = ti.cast(self.total(UPHILL) > 0, ti.i32)

    @ti.func
    def total(self, k: ti.template()):  # type: ignore[valid-type]
        """Return a sum over all particles, from those of groups of blocks."""
        out = ti.cast(0, self.real)
        for g in range((self.blocks + (GROUP - 1)) // GROUP):
            if ti.static(self.team.launched):
                out += self.groups[g][k]
            else:
                out += self.total_of_group(g, k)
        return out

    @ti.func
    def total_of_group(self, g, k: ti.template()):  # type: ignore[valid-type]
        """Return a sum over the particles of a group of blocks."""
        out = ti.cast(0, self.real)
        for b in range(g * GROUP, ti.min((g + 1) * GROUP, self.blocks)):
            out += self.sums[b][k]
        return out

    @ti.func
    def add_up_group(self, g, k: ti.template()):  # type: ignore[valid-type]
        """Add up the sums of the blocks of group g."""
        self.groups[g][k] = self.total_of_group(g, k)

    @ti.func
    def weight(self, i):
        """Return the impulse of the forces on particle i in this substep [kg m]."""
        out, w = ti.cast(0, self.real), self.bodies.compliance(i)
        if w > 0:
            out = self.rows.kick(i).norm() / w
        return out

    @ti.func
    def weight_on(self, row, weight, pressed):
        """Return the impulse of forces that a row feels: of a particle, its `weight`, and of what its row presses on [kg m]."""
        if row < pressed:
            for k in ti.static(range(self.rows.ends)):
                weight += self.rows.part(row, k) * self.weight(self.rows.pressed_on(row, k))
        return weight

    @ti.func
    def sum_impacts(self, i, part):
        """Add up the part of the impulses on particle i that is none of a load.

        A load is what a row bore before, but for what forces may change in a substep and a small part; an impact passes.
        """
        p_own, m_own = 0 * self.state.d[i], self.no_moment()
        scale, weight, pressed = self.rows.scale[None], self.weight(i), self.rows.pressed[i]
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            n = self.rows.normal.field[row]
            p, before = self.rows.p.field[row], self.rows.memory.field[self.rows.entry.field[row]]
            size, borne = self.rows.along(p, n), ti.max(scale * self.rows.along(before, n), 0)
            load, slight = size, self.weight_on(row, weight, pressed)
            if not self.rows.is_steady(ti.abs(size - borne), size, slight):
                load = ti.static(SLOW) * slight
            if ti.static(self.rows.bounces):
                if self.rows.when[i] > 0:  # in an island with an impact, what is more than before came of that
                    load = borne
                if self.rows.bounced(row):
                    load = 0
            if ti.static(bool(self.rows.edges)):
                self.rows.edges.gone.field[row] = 0 * n
            if size > load:
                impact = (1 - load / size) * self.rows.vector(p, n)
                p_own += impact
                if ti.static(self.bodies.spins):
                    m_own += self.bodies.spin.moment(n, impact)
                self.send(row, n, impact, part == OWN and row < self.rows.kept[i])
        self.bodies.push[i] = self.bodies.push[i] + p_own
        if ti.static(self.bodies.spins):
            self.bodies.moment[i] = self.bodies.moment[i] + m_own

    @ti.func
    def excess(self, u, limit):
        """Return the part of u by which it is longer than `limit`."""
        size, most, out = u.norm(), limit.norm(), 0 * u
        if size > most:
            out = (1 - most / size) * u
        return out

    @ti.func
    def remember(self, i, final):
        """At the end: store what the rows of particle i bear, and note what touches for events.

        `borne` is how far what bears moves the particle. Velocities contain half of it, see Verlet.velocity_after(). With forces
        it changes the motion by no more than all that happened in the substep: what lies still under a blow of something heavy is
        told to lie still, though its rows take different parts of the blow for a load. What sleeps keeps it.
        """
        if final != 0 and self.state.awake(i):
            w, kick = self.bodies.compliance(i), self.rows.kick(i)
            push = w * self.bodies.push[i]
            change = self.bodies.new[i] - self.bodies.base(i) - self.bodies.answer_of_constraints(i)
            self.rows.borne[i] = change - push - self.excess(change - push + kick, change + kick)
            if ti.static(self.bodies.spins):
                turn = self.bodies.new_s[i] - self.bodies.spin.s[i]
                blow = -(w * self.bodies.spin.inverse_inertia[i]) * self.bodies.moment[i]
                self.rows.turned[i] = turn - blow - self.excess(turn - blow, turn)
        for row in range(self.rows.begin[i], self.rows.end[i]):
            e, p = self.rows.entry.field[row], self.rows.p.field[row]
            if ti.static(self.has_friction):
                f, n = self.rows.friction.field[row], self.rows.normal.field[row]
                if f[1] < f[0]:
                    slip = self.slip(i, row, n, self.bodies.new, True)
                    self.rows.note_slip(row, p + self.rows.hit(row) * n, n, slip, self.slight(i, row))
            if ti.static(self.rows.bounces):
                n = self.rows.normal.field[row]
                load, size = self.rows.scale[None] * self.rows.along(self.rows.memory.field[e], n), self.rows.along(p, n)
                bounces = self.rows.bounced(row)
                self.rows.given.field[e] = size + self.rows.hit(row)
                self.rows.touched.field[e] = ti.cast(not bounces and (self.rows.gap.field[row] == 0 or size > 0), ti.i32)
                if bounces or size <= 0:  # impacts in turn leave friction, and what is taken back of them
                    p = 0 * p
                elif self.rows.when[i] > 0 and size > load:  # the rest came of the impact
                    p *= ti.max(load, 0) / size
            self.rows.memory.field[e] = self.rows.marked(i, row, p)
            if ti.static(self.rows.turns):
                f = self.rows.f.field[row]
                if ti.static(self.rows.bounces):
                    if self.rows.bounced(row):
                        f = 0 * f
                self.rows.borne_moment.field[e] = f
        if ti.static(bool(self.rows.events)):
            for row in range(self.rows.own[i], self.rows.pressed[i]):
                n = self.rows.normal.field[row]
                p = self.rows.along(self.rows.p.field[row], n) + self.rows.hit(row)
                if p > 0:
                    self.rows.events.record(i, self.rows.other.field[row], self.rows.entry.field[row], n, p, final)
                    if ti.static(bool(self.rows.impacts)):
                        self.rows.events.note_speed(self.rows.entry.field[row], self.rows.impacts.approach.field[row])
        if ti.static(len(self.rows.logging) > 0):
            for row in range(self.rows.pressed[i], self.rows.end[i]):
                self.rows.log_wall(i, row)
