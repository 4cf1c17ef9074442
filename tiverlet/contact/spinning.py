"""Friction between particles that spin: at the point of contact, with resistance to rolling and twisting."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..features.material import ROLLING, TWISTING, Table, limit_length

if TYPE_CHECKING:
    from ..features.feature import Scene


class Spinning:
    """The friction of discs or spheres that spin: how contacts change their spins s = r phi, see Spin.

    Sliding: with the arm m = (x_i - x_j) / (r_i + r_j) at the start of the substep, or at the time of impact, the surfaces of a
    pair slide past each other by u = d_i - d_j - (s_i + s_j) x m. A push P across the normal changes d_i by w_i P and s_i by
    -k_i w_i m x P, so u by (w_i (1 + k_i) + w_j (1 + k_j)) P. The moments of P about both centers and about the origin sum up to
    0, so with these arms friction conserves angular momentum, spin included.

    Rolling: the surfaces have turned against each other by rho = a_j s_i - a_i s_j, with a = r / (r_i + r_j). A moment T on i and
    -T on j changes s_i by -a_j k_i w_i f and s_j by a_i k_j w_j f, where f = T (r_i + r_j) / (r_i r_j). rho, with what is left of
    it since the pair touched, is taken back by f up to `rolling` times the push, and its part about the normal up to `twisting`
    times the push (Luding 2008). Beside a flat wall, a_j = 1 and a_i = 0, this is the law of walls.

    weight: the split masses m_i w_i. turn: pair data of rho, as far as it is held; None if nothing resists rolling. change: the
    corrections of spins, (n,).
    """

    def __init__(self, scene: "Scene", table: Table, weight: Any, turn: Any):
        self.state, self.radius, self.table, self.weight, self.turn = scene.state, scene.radius, table, weight, turn
        self.spin = scene.state.spin
        n, add = scene.count, scene.memory.field
        self.change = add("Contact.spin_change", n, width=self.spin.axes)

    @ti.func
    def arm_of(self, i, j, n, reach):
        """Return the arm m of a pair whose distance along the normal n is `reach` [m] where its push acts."""
        return reach / (self.radius.of(i) + self.radius.of(j)) * n

    @ti.func
    def arm(self, i, j, n):
        """Return the arm m after the pass: from the start of the substep, or along n if the pair did not touch there."""
        distance = self.radius.of(i) + self.radius.of(j)
        r = self.state.separation(i, j) - self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        return ti.select(r.dot(r) > distance * distance, n, r / distance)

    @ti.func
    def slip(self, i, j, m):
        """Return how far the surfaces slide past each other in this substep [m]. m: the arm."""
        moved = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        return moved - self.spin.surface(self.spin.s[i] + self.spin.s[j], m)

    @ti.func
    def split_mass(self, i, j):
        """Return the change of slip() per push across the normal, with split masses."""
        out = 1 + self.spin.inverse_inertia.of(i)
        if ti.static(self.spin.inverse_inertia.uniform):
            out *= self.weight[i] + self.weight[j]
        else:
            out = out * self.weight[i] + (1 + self.spin.inverse_inertia.of(j)) * self.weight[j]
        return out

    @ti.func
    def turned(self, i, m, push):
        """Return the change of s_i by a push across the normal, both per inverse mass [kg m]."""
        return -self.spin.inverse_inertia.of(i) * self.spin.moment(m, push)

    @ti.func
    def part(self, i, j):
        """Return a_i, the share of the radius of particle i in the sum of both radii."""
        return self.radius.of(i) / (self.radius.of(i) + self.radius.of(j))

    @ti.func
    def rolling_mass(self, i, j):
        """Return the change of rho per f, with split masses."""
        a = self.part(i, j)
        return (
            (1 - a) * (1 - a) * self.spin.inverse_inertia.of(i) * self.weight[i]
            + a * a * self.spin.inverse_inertia.of(j) * self.weight[j]
        )  # fmt: skip

    @ti.func
    def held(self, i, j, e, n, s_i, s_j, most):
        """Return the part of rho that is taken back, at most `most` [m] times each coefficient.

        rho is that of the spins s_i and s_j, and of the turn that is left from earlier substeps.
        """
        a, row = self.part(i, j), self.table.of(i, j)
        rolled = self.turn.field[e] + ((1 - a) * s_i - a * s_j)
        twist = self.spin.along(rolled, n)
        rolling, twisting = row[ROLLING] * most, row[TWISTING] * most
        return limit_length(rolled - twist, rolling, rolling) + limit_length(twist, twisting, twisting)

    @ti.func
    def resist(self, i, j, e, n, m, push, pressed):
        """Return the change of s_i by resistance to rolling and twisting, per inverse mass [kg m].

        pressed: the push along the normal. push: friction of this pair, which acts first, with split masses [kg m].
        """
        k_i, k_j, rolling_mass = self.spin.inverse_inertia.of(i), self.spin.inverse_inertia.of(j), self.rolling_mass(i, j)
        out = 0 * self.spin.s[i]
        if rolling_mass > 0:
            moment = self.spin.moment(m, push)
            s_i, s_j = self.spin.s[i] - k_i * self.weight[i] * moment, self.spin.s[j] - k_j * self.weight[j] * moment
            held = self.held(i, j, e, n, s_i, s_j, pressed * rolling_mass)
            out = -(1 - self.part(i, j)) * k_i / rolling_mass * held
        return out

    @ti.func
    def left(self, i, j, e, n, pressed):
        """Return the turn of the pair to keep at the end of a substep, as far as it can be held [m]."""
        return self.held(i, j, e, n, self.spin.s[i], self.spin.s[j], pressed * self.rolling_mass(i, j))
