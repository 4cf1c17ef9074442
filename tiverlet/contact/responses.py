"""How bodies answer impulses. Contacts need nothing else of a body."""

from typing import TYPE_CHECKING, Any

from ..device import at, inline, ti

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .answers import Answers
    from .rows import Rows


class Responses:
    """Particles under impulses: an impulse p [kg m] changes d by w p, and at -r n from the center s by -k w n x p. What holds
    them answers, too, see Answers.

    w: inverse mass. k = m r^2 / I, see Spin. Particles that are pinned, driven or asleep keep their displacement.

    v, s: displacements under the present impulses, which contacts read [m]. new, new_s: those under the impulses that a pass
    computes; last, last_s: those of the pass before. push, moment: sums of impulses [kg m], 0 between passes.
    """

    def __init__(self, scene: "Scene", rows: "Rows", spins: bool, answers: "Answers | None"):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.answers: Any = answers
        self.has_clusters = bool(answers) and answers.has_clusters
        self.rows = rows
        self.state, self.spins, self.real, self.dim = scene.state, spins, scene.real, dim
        self.v, self.last, self.push = (add(f"Contact.{name}", n, width=dim) for name in ("v", "v_last", "push"))
        self.new = add("Contact.v_new", n, width=dim)
        if spins:
            axes, self.spin = scene.particles.axes, scene.state.spin
            self.s, self.new_s, self.last_s, self.moment = (
                add(f"Contact.{name}", n, width=axes) for name in ("s", "s_new", "s_last", "moment")
            )

    @inline
    def compliance(self, i):
        """Return by how much a unit impulse along a normal moves particle i [1/kg]."""
        w = at(self.state.w, i)
        return ti.select(self.state.sleepers.awake(i), w, 0 * w) if self.state.sleepers else w

    @ti.func
    def mobility(self, i):
        """Return by how much a unit impulse on particle i moves it at most, with the body that it belongs to [1/kg]."""
        w = self.compliance(i)
        if ti.static(self.has_clusters):
            if w > 0:
                w = self.answers.mobility[i]
        return w

    @ti.func
    def split(self, i):
        """Return the same, with masses split among the rows of the body [1/kg]."""
        if ti.static(not self.rows.has_friction):
            return self.split_place(i)
        w = self.compliance(i)
        if ti.static(self.has_clusters):
            if w > 0:
                w = self.answers.shared[i]
        return self.rows.share[i] * w

    @ti.func
    def split_place(self, i):
        """Return the same for places, which have no friction [1/kg]."""
        return self.rows.eigenvalue[i] * self.mobility(i)

    @ti.func
    def split_tangential(self, i):
        """Return the same for tangential impulses at the point of contact of particle i [1/kg]."""
        out = self.split(i)
        if ti.static(self.spins):  # moments against rolling share the spin
            out += self.rows.share[i] * (self.compliance(i) * self.rows.turn_shares[None] * self.spin.inverse_inertia[i])
        return out

    @ti.func
    def turning_compliance(self, i):
        """Return by how much a unit moment over the radius turns the surface of particle i [1/kg]."""
        return self.compliance(i) * self.spin.inverse_inertia[i]

    @inline
    def body(self, i):
        """Return the first particle of the body of particle i."""
        return self.answers.body(i) if self.answers else i

    @ti.func
    def begin(self, i):
        """Begin a substep: no impulses."""
        self.v[i] = self.state.d[i]
        self.new[i] = self.state.d[i]
        self.last[i] = self.state.d[i]
        self.push[i] = 0 * self.state.d[i]
        if ti.static(bool(self.answers)):
            self.answers.begin_particle(i)
        if ti.static(self.spins):
            s = self.spin.s[i]
            self.s[i], self.new_s[i], self.last_s[i], self.moment[i] = s, s, s, 0 * s

    @ti.func
    def give(self, i, n, p):
        """Give particle i the opposite of an impulse p at the other particle of a pair with the normal n."""
        self.push[i] = self.push[i] - p
        if ti.static(self.spins):
            self.moment[i] = self.moment[i] + self.spin.moment(n, p)

    @ti.func
    def forget_sums(self, i):
        """Set the sums of impulses of particle i to 0."""
        self.push[i] = 0 * self.push[i]
        if ti.static(self.spins):
            self.moment[i] = 0 * self.moment[i]

    @inline
    def base(self, i):
        """Return the displacement of particle i before the passes, after impacts in turn, which keep energy [m]."""
        return at(self.rows.impacts.thrown, i) if self.rows.impacts else at(self.state.d, i)

    @ti.func
    def answer(self, i, p, m):
        """Compute the displacements of particle i under impulses whose sum is p, with moments of sum m [kg m]."""
        w = self.compliance(i)
        if ti.static(bool(self.answers)):
            p += self.answers.links.along(self.answers.links.mu, i)
        self.new[i] = self.base(i) + w * p
        if ti.static(bool(self.answers)):
            if ti.static(self.answers.answer_later):
                self.new[i] = self.new[i] + self.answers.beyond(i)
        if ti.static(self.spins):
            self.new_s[i] = self.spin.s[i] - (w * self.spin.inverse_inertia[i]) * m

    @ti.func
    def answer_of_constraints(self, i):
        """Return how far constraints move particle i in answer to passes over contacts [m]."""
        out = 0 * self.state.d[i]
        if ti.static(bool(self.answers)):
            out += self.compliance(i) * self.answers.links.along(self.answers.links.mu, i)
            if ti.static(self.answers.answer_later):
                out += self.answers.beyond(i)
        return out

    @ti.func
    def extrapolate(self, i, beta):
        """Let contacts read displacements further along the last step of the passes, by beta of it (Nesterov)."""
        new = self.new[i]
        self.v[i] = new + beta * (new - self.last[i])
        self.last[i] = new
        if ti.static(self.spins):
            s = self.new_s[i]
            self.s[i] = s + beta * (s - self.last_s[i])
            self.last_s[i] = s
        self.forget_sums(i)

    @ti.func
    def work(self, i):
        """Return m v0 . (v - v0) and m (v - v0)^2 of particle i, times h^2 [kg m^2].

        The work of its impulses is the first and half of the second.
        """
        work, square = ti.cast(0, ti.f64), ti.cast(0, ti.f64)
        d, w = self.base(i), self.compliance(i)
        if w > 0:
            change = self.new[i] - d
            work += d.dot(change) / w
            square += change.dot(change) / w
            if ti.static(bool(self.answers)):  # links that turn do no work, nor do those that rows complete
                work += self.answers.links.completing_work(i) - d.dot(self.answer_of_constraints(i)) / w
            if ti.static(self.spins):
                k, s = self.spin.inverse_inertia[i], self.spin.s[i]
                if k > 0:
                    turn = self.new_s[i] - s
                    work += s.dot(turn) / (w * k)
                    square += turn.dot(turn) / (w * k)
        return work, square

    @ti.func
    def kinetic(self, i):
        """Return m d^2 of particle i at the start of the passes, twice its kinetic energy times h^2 [kg m^2]."""
        out, w = ti.cast(0, self.real), self.compliance(i)
        if w > 0:
            out = self.state.d[i].dot(self.state.d[i]) / w
        return out

    @ti.func
    def scale(self, i, scale):
        """Multiply the impulses on particle i by a number."""
        d = self.base(i)
        self.new[i] = d + scale * (self.new[i] - d)
        if ti.static(bool(self.answers)):
            self.answers.scale(i, scale)
        if ti.static(self.spins):
            s = self.spin.s[i]
            self.new_s[i] = s + scale * (self.new_s[i] - s)

    @ti.func
    def finish(self, i, step):
        """Move particle i as impulses want, from where it was at the start. step: its new displacement, with a dither in f32."""
        if self.state.moves(i):
            new, d, base = self.new[i], self.state.d[i], self.base(i)
            moved = (new != d).any()
            if ti.static(bool(self.rows.impacts)):
                moved = moved or self.rows.impacts.turn[i] > 0
            if moved:
                self.state.d[i] = new
                if ti.static(self.state.carries):
                    self.state.d_low[i] = 0 * new
                if ti.static(self.state.sums):
                    self.state.restart(i)
                else:
                    self.state.x[i] = self.state.x0[i] + step
                if ti.static(self.rows.bounces):  # impacts act from their time on
                    if self.rows.when[i] > 0:
                        change = self.compliance(i) * self.push[i]
                        if ti.static(bool(self.answers)):
                            if self.answers.holds(i):  # bodies answer with all of their particles
                                change = new - base
                        if ti.static(bool(self.rows.impacts)):
                            self.state.advance(i, self.rows.impacts.shift[i] - self.rows.when[i] * change)
                        else:
                            self.state.advance(i, -self.rows.when[i] * change)
            if ti.static(self.spins):
                self.spin.s[i] = self.new_s[i]
