"""Impacts that pass on from particle to particle, as in Newton's cradle, for pairs and walls that are nearly elastic.

They come before the passes of stage 1, in rounds. In a round, each row finds when it meets next. Rows that come before all others
of both of their bodies bounce, at the same time where they share bodies, and what they throw may meet something in the next
round. A body is a particle, or all that constraints connect. A row that was open bounces at its restitution e. One that touched
passes everything on, and keeps the part e of what separates it after all rounds: the mean of elastic and plastic impact with the
weights e and 1 - e (Smith et al. 2012, Reflections on simultaneous impact).

Rows that bounce at the same time and share bodies get impulses s p, p = (1 + e) / 2 c m with their closing speeds c and the
masses m of their particles. With the changes u that the impulses p and the answers of bodies make, at the time of the impact,

    s = 2 sum (1 + e) / 2 p c / sum m u^2,

for which energy is kept at e = 1. For free particles alone s = 2, and more where they are part of something heavier.

The passes begin at the displacements that these impulses give, and aim at them. They find what rests and friction, and may take
back what impulses gave too much of.
"""

from typing import TYPE_CHECKING, Any

from ..device import ti
from .limits import APART, FEW, NEAR, NEVER, OWN, SLOP, SLOW, TOGETHER
from .meeting import meeting

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .rows import Rows


class Impacts:
    """The impacts of one world in which rows bounce one after the other.

    Columns by row: `restitution`; `joined`, see begin(); `open` the gap at the start, `arc` its curvature and `way` the vector
    from its center, or the normal of a plane; `time` of the next impact, a part of the substep, or NEVER; `facing` the normal
    then; `closing` the approach [m]; `blow` the impulse of a round before it is scaled, and `hit` the sum of all [kg m];
    `approach` the largest [m]; `belt` how far the surface of a wall moves along itself [m].
    By particle: `thrown` the displacement after impacts and answers, and `shift` what is added to its start so that this leads to
    where it is [m]; `since` the time of the last impact, `first` that of the next, `turn` the round of the last, 0 without one.
    """

    def __init__(self, scene: "Scene", rows: "Rows"):
        self.rows: Any = rows
        self.state, self.real, self.dim = scene.state, scene.real, scene.particles.dim
        self.restitution, self.joined = rows.column("restitution"), rows.column("joined", kind=ti.i32)
        self.open, self.arc, self.way = rows.column("open"), rows.column("arc"), rows.column("way", self.dim)
        self.time, self.facing, self.closing = rows.column("next"), rows.column("facing", self.dim), rows.column("closing")
        self.blow, self.hit, self.approach = rows.column("blow"), rows.column("hit"), rows.column("approach")
        self.belts = any(group.wall.has_surface_velocity for group in rows.walls)
        self.belt: Any = rows.column("belt", self.dim) if self.belts else None
        add = scene.memory.field
        self.thrown, self.shift = (add(f"Contact.{name}", scene.count, width=self.dim) for name in ("thrown", "shift"))
        self.since = add("Contact.since", scene.count)
        self.first, self.turn = add("Contact.first_impact", scene.count), add("Contact.struck_in", scene.count, kind=ti.i32)

    @ti.func
    def clear(self, i):
        """Before rows are listed: particle i was not struck."""
        self.shift[i], self.since[i], self.turn[i], self.first[i] = 0 * self.shift[i], 0, 0, NEVER
        self.thrown[i] = self.state.d[i]

    @ti.func
    def begin(self, row, e, gap, arc, way, radius, bears):
        """Write a row. e: restitution; gap, arc, way: at the start; radius: the smaller one; bears: whether it bore a load.

        What bears a load or is nearer than the slop goes on together, unless it meets by itself.
        """
        joined = ti.select(gap <= ti.static(SLOP) * radius, NEAR, APART)
        if joined == NEAR and bears:
            joined = TOGETHER
        self.restitution.field[row], self.joined.field[row] = e, joined
        self.open.field[row], self.arc.field[row], self.way.field[row] = gap, arc, way
        self.time.field[row], self.blow.field[row], self.hit.field[row], self.approach.field[row] = NEVER, 0, 0, 0

    @ti.func
    def part(self, row):
        """Return (1 + e) / 2 of a row in a round of impacts; e is 1 where it touched at the start."""
        return (1 + ti.select(self.joined.field[row] == TOGETHER, 1, self.restitution.field[row])) / 2

    @ti.func
    def blur(self, i, row, u):
        """Return how much of a relative displacement u of a row may be rounding [m]."""
        size = self.state.place(i).norm()
        if row < self.rows.pressed[i]:
            size = ti.abs(1 / self.arc.field[row])
        return self.rows.rounding * (u.norm() + size * ti.static(2.0**-7))

    @ti.func
    def path(self, i, row):
        """Return the relative displacement u of a row, its shift, since when they hold, and the displacement f by forces."""
        other, pressed = self.rows.other.field[row], self.rows.pressed[i]
        u, f = self.rows.relative(self.thrown[i], self.thrown, i, other, row, pressed), self.rows.relative_kick(i, row)
        shift, now = self.shift[i] + 0 * u, self.since[i]
        if row < pressed:
            shift -= self.shift[other]
            now = ti.max(now, self.since[other])
        elif ti.static(self.belts):
            u += self.belt.field[row]
        return u, shift, now, f

    @ti.func
    def plan(self, i, row, at_first: ti.template()):  # type: ignore[valid-type]
        """Find the next impact of a row: its time, normal and approach. at_first: before any impact.

        What comes back within the substep rests, and so does what is no faster than forces make it, unless e = 1 and the row
        bears no load of its own.
        """
        e, s = self.restitution.field[row], ti.cast(NEVER, self.real)
        if e > 0:
            u, shift, now, f = self.path(i, row)
            kick, other = self.state.kick(i), self.rows.other.field[row]
            slight = kick.norm()
            if row < self.rows.pressed[i]:
                if self.state.moves(other):
                    slight = ti.max(slight, self.state.kick(other).norm())
            v, blur = u + (now - 0.5) * f, self.blur(i, row, u)
            moved = shift + now * u - (now * (1 - now) / 2) * f
            after, n = meeting(self.open.field[row], self.arc.field[row], self.way.field[row], moved, v, f, 1 - now, blur)
            closing, then, least = -(v + f * after).dot(n), now + after, blur
            rests = e < 1
            if ti.static(at_first):
                rests = rests or self.joined.field[row] == TOGETHER
            if rests:
                least += ti.static(SLOW) * ti.max(self.rows.whole[None], 1) * slight
            returns = e * closing <= ti.max(-f.dot(n), 0) * (1 - then) / 2
            if after >= 0 and (then - 1) * closing <= blur and closing > least and not returns:
                s = ti.min(then, 1)
                self.facing.field[row], self.closing.field[row] = n, closing
        self.time.field[row] = s

    @ti.func
    def count(self, i):
        """Return how many rows of particle i meet in this substep, as it begins. What touches goes on together."""
        out = ti.cast(0, self.real)
        for row in range(self.rows.begin[i], self.rows.end[i]):
            self.plan(i, row, True)
            meets = self.time.field[row] <= 1
            if self.joined.field[row] != APART:
                self.joined.field[row] = ti.select(meets, APART, TOGETHER)
            elif not meets and self.restitution.field[row] > 0:
                self.begin_later(i, row)
            if meets:
                out += 1
        return out

    @ti.func
    def look(self, i, part, turn):
        """Find the first impact of particle i among a part of its rows, and tell the other particles of theirs.

        A row that touched at the start takes part once one of its particles was struck. turn: the last round.
        """
        first = self.first[i]
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            last, other = self.turn[i], self.rows.other.field[row]
            if row < self.rows.pressed[i]:
                last = ti.max(last, self.turn[other])
            if last > 0 and last == turn:
                self.plan(i, row, False)
            if last > 0 or self.joined.field[row] != TOGETHER:
                s = self.time.field[row]
                first = ti.min(first, s)
                if part == OWN and row < self.rows.kept[i]:
                    self.first[other] = ti.min(self.first[other], s)
        self.first[i] = first

    @ti.func
    def strike(self, i, part, bodies: ti.template()):  # type: ignore[valid-type]
        """Find the impulses of the rows of particle i that meet before all others of both particles.

        Returns their work, that of rows without loss, and how many of them may share a particle.
        """
        p_own = 0 * self.state.d[i]
        work, kept, shared = ti.Vector.zero(self.real, 3)
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            blow, s, other, last = 0 * work, self.time.field[row], self.rows.other.field[row], self.turn[i]
            if s <= 1:
                first, w = self.first[i], bodies.compliance(i)
                if row < self.rows.pressed[i]:
                    last = ti.max(last, self.turn[other])
                    if self.state.moves(other):
                        first = ti.min(first, self.first[other])
                        w += bodies.compliance(other)
                if s <= first + self.rows.rounding and (last > 0 or self.joined.field[row] != TOGETHER):
                    n = self.facing.field[row]
                    blow = self.part(row) * self.closing.field[row] / (w * n.dot(n))  # n is 1 long to rounding
                    p = blow * n
                    if (p_own != 0).any() or (bodies.push[i] != 0).any():
                        shared += 1
                    p_own += p
                    some = self.part(row) * blow * self.closing.field[row]
                    work += some
                    keeps = self.restitution.field[row] == 1
                    if ti.static(self.rows.has_friction):
                        keeps = keeps and self.rows.friction.field[row][0] == 0
                    if keeps:
                        kept += some
                    if part == OWN and row < self.rows.kept[i]:
                        if (bodies.push[other] != 0).any():
                            shared += 1
                        bodies.push[other] = bodies.push[other] - p
            self.blow.field[row] = blow
        if ti.static(self.rows.divided):
            if part == OWN:  # of those that lower pieces have, too
                foreign = 0 * work
                for row in range(self.rows.begin[i], self.rows.own[i]):
                    foreign += ti.cast(self.blow.field[row] > 0, self.real)
                shared += ti.max(foreign - 1, 0)
        bodies.push[i] = bodies.push[i] + p_own
        return ti.Vector([work, kept, shared])

    @ti.func
    def change(self, i, bodies: ti.template()):  # type: ignore[valid-type]
        """Return how far the impulses of a round move particle i before they are scaled, with what answers [m]."""
        if ti.static(bool(bodies.answers)):
            return bodies.last[i]
        return bodies.compliance(i) * bodies.push[i]

    @ti.func
    def terms(self, i, bodies: ti.template()):  # type: ignore[valid-type]
        """Return the part of particle i in the sums over what bounces together: the work of rows, the energy that their impulses
        take from motion in first order, and twice that which they give in second order.

        The first two are the same at e = 1, unless rows are jammed: then what closes them is an error of second order.
        """
        work, taken, given = ti.Vector.zero(ti.f64, 3)
        for row in range(self.rows.own[i], self.rows.end[i]):
            work += self.part(row) * self.blow.field[row] * self.closing.field[row]
        w, change = bodies.compliance(i), self.change(i, bodies)
        if (change != 0).any():
            taken = -change.dot(self.thrown[i] + (self.first[i] - 0.5) * self.state.kick(i)) / w
            given = change.dot(change) / w
        return ti.Vector([work, taken, given], ti.f64)

    @ti.func
    def scale_of(self, work, taken, given):
        """Return the scale of what bounces together, from its sums; 0 where it is jammed."""
        scale = 0 * work
        if given > self.rows.rounding * work:
            scale = 2 * ti.max(ti.min(work, taken), 0) / given
        return scale

    @ti.func
    def apply(self, i, turn, scale, bodies: ti.template()):  # type: ignore[valid-type]
        """Let particle i bounce off what it meets in this round."""
        change, s = scale * self.change(i, bodies), self.first[i]
        for row in range(self.rows.begin[i], self.rows.end[i]):
            blow = scale * self.blow.field[row]
            if self.blow.field[row] > 0 and blow == 0:  # bodies are jammed
                self.time.field[row] = NEVER
            if blow > 0:
                before, then = self.hit.field[row], self.time.field[row]
                self.hit.field[row] = before + blow
                self.rows.normal.field[row] = self.facing.field[row]
                self.approach.field[row] = ti.max(self.approach.field[row], self.closing.field[row])
                if before > 0:  # the time of all of them, for what forces do between
                    then = (before * self.rows.time.field[row] + blow * then) / (before + blow)
                self.rows.time.field[row] = ti.max(then, ti.static(FEW))
        if (change != 0).any():
            self.thrown[i] = self.thrown[i] + change
            self.shift[i] = self.shift[i] - s * change
            self.since[i], self.turn[i] = s, turn
        if ti.static(bool(bodies.answers)):
            bodies.answers.scale(i, scale)
        bodies.push[i] = 0 * change
        self.first[i] = NEVER

    @ti.func
    def settle(self, i):
        """After all rounds: note which rows of particle i bounced, and where others are by then."""
        for row in range(self.rows.begin[i], self.rows.end[i]):
            hit, struck = self.hit.field[row], self.turn[i]
            if row < self.rows.pressed[i]:
                struck = ti.max(struck, self.turn[self.rows.other.field[row]])
            if hit > 0:
                u, _shift, _now, f = self.path(i, row)
                leaves = (u + (self.rows.time.field[row] - 0.5) * f).dot(self.rows.normal.field[row])
                self.rows.bounce.field[row] = ti.cast(leaves >= -self.blur(i, row, u), self.real)
            if struck > 0 and self.rows.bounce.field[row] == 0:
                self.begin_later(i, row)

    @ti.func
    def aim(self, i, row):
        """Set what a row aims at that bounced, in the middle of the substep: what was open keeps the speed at which it parts,
        what touched e of it."""
        u, _shift, _now, f = self.path(i, row)
        n, e = self.rows.normal.field[row], self.restitution.field[row]
        later = (self.rows.time.field[row] - 0.5) * f.dot(n)
        if self.joined.field[row] != TOGETHER:
            e = 1 + 0 * e
        self.rows.target.field[row] = ti.max(e * (u.dot(n) + later), 0) - later

    @ti.func
    def begin_later(self, i, row):
        """Write the gap and the normal of a row as they are when its particles were struck.

        Passes change displacements as if for the whole substep. From the time s on, a change of d changes the gap by 1 - s of it.
        So the row has the normal at that time, the part 1 - s of its curvature, and the gap for which it ends with the true gap
        at the end, over 1 - s, if passes do nothing. Overlap is no reason for an impulse.
        """
        arc = self.arc.field[row]
        u, shift, s, f = self.path(i, row)
        n, bend, gap, sign = self.way.field[row] + 0 * u, 0 * arc, self.open.field[row], ti.select(arc < 0, -1, 1)
        way, end = shift + s * u - (s * (1 - s) / 2) * f, shift + u
        before = gap
        if arc == 0:
            before += n.dot(way)
            gap += n.dot(end)
        else:
            c, reach = gap * (2 / arc - gap), ti.abs(1 / arc - gap)
            gap = sign * (c + 2 * n.dot(end) + end.dot(end)) / ((n + end).norm() + reach)
            n += way
            before = sign * (n.norm() - reach)
            bend = sign / n.norm()
            n *= bend
            bend *= 1 - s
        un = u.dot(n)
        gap -= ti.min(before, 0)
        if ti.abs(gap) <= self.blur(i, row, u):
            gap = 0
        self.rows.normal.field[row], self.rows.bend.field[row] = n, bend
        self.rows.gap.field[row] = gap / ti.max(1 - s, self.rows.rounding) - un - self.rows.rise(u.dot(u) - un * un, un, bend)
