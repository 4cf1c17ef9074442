"""Friction between particles that spin: at the point of contact, with resistance to rolling and twisting."""

from typing import TYPE_CHECKING, Any

from ..device import ti
from ..features.material import Table, limited

if TYPE_CHECKING:
    from ..features.feature import Scene


class Spinning:
    """What the contacts of discs or spheres do to their spins s = r phi, see Spin.

    With the arm m = (x_i - x_j) / (r_i + r_j) at the start of the substep, or where they met in it, the surfaces of a pair slide
    past each other by u = d_i - d_j - (s_i + s_j) x m. A push P across the normal changes d_i by w_i P and s_i by
    -k_i w_i m x P, so u by (w_i (1 + k_i) + w_j (1 + k_j)) P, and the moments of P about both middles and about the origin sum
    up to 0: with these arms angular momentum, spin included, is kept as friction acts.

    Rolling: by rho = a_j s_i - a_i s_j, with a = r / (r_i + r_j), surfaces have turned against each other; a moment T on i and -T
    on j changes s_i by -a_j k_i w_i f and s_j by a_i k_j w_j f, where f = T (r_i + r_j) / (r_i r_j). It is taken back, with what
    was left of it since the pair touched, by f up to `rolling` times the push; and its part about the normal up to `twisting`
    times that (Luding 2008). Beside a flat wall, a_j = 1 and a_i = 0, it is the law of walls.

    turn: what each pair has turned against each other, as far as it is held; None where nothing resists. change: the moves of
    spins, (n,).
    """

    def __init__(self, scene: "Scene", table: Table, weight: Any, turn: Any):
        self.state, self.radius, self.table, self.weight, self.turn = scene.state, scene.radius, table, weight, turn
        self.spin = scene.state.spin
        n, add = scene.count, scene.memory.field
        self.change = add("Contact.spin_change", n, width=self.spin.axes)

    @ti.func
    def arm_of(self, i, j, n, reach):
        """The arm m of a pair that is so far apart along the normal n where its push acts."""
        return reach / (self.radius.of(i) + self.radius.of(j)) * n

    @ti.func
    def arm(self, i, j, n):
        """The same, worked out again after the pass: from where the pair was at the start of the substep, or along n where it did
        not touch there."""
        distance = self.radius.of(i) + self.radius.of(j)
        r = self.state.apart(i, j) - self.state.slid(self.state.d[i] - self.state.d[j], i, j)
        return ti.select(r.dot(r) > distance * distance, n, r / distance)

    @ti.func
    def slip(self, i, j, m):
        """By how much the surfaces slide past each other."""
        moved = self.state.slid(self.state.d[i] - self.state.d[j], i, j)
        return moved - self.spin.surface(self.spin.s[i] + self.spin.s[j], m)

    @ti.func
    def split_mass(self, i, j):
        """What a push across the normal changes that by, with split masses."""
        out = 1 + self.spin.share.of(i)
        if ti.static(self.spin.share.uniform):
            out *= self.weight[i] + self.weight[j]
        else:
            out = out * self.weight[i] + (1 + self.spin.share.of(j)) * self.weight[j]
        return out

    @ti.func
    def turned(self, i, m, push):
        """What a push across the normal, per inverse mass, changes s_i by, per inverse mass."""
        return -self.spin.share.of(i) * self.spin.moment(m, push)

    @ti.func
    def part(self, i, j):
        """a_i, that of particle i in the sum of the radii."""
        return self.radius.of(i) / (self.radius.of(i) + self.radius.of(j))

    @ti.func
    def rolling_mass(self, i, j):
        """What f changes rho by, with split masses."""
        a = self.part(i, j)
        return (1 - a) * (1 - a) * self.spin.share.of(i) * self.weight[i] + a * a * self.spin.share.of(j) * self.weight[j]

    @ti.func
    def held(self, i, j, e, n, s_i, s_j, most):
        """Of rho, for such spins and with what was left of it, what is taken back: up to so much times each coefficient."""
        a, row = self.part(i, j), self.table.of(i, j)
        rolled = self.turn.field[e] + ((1 - a) * s_i - a * s_j)
        twist = self.spin.along(rolled, n)
        return limited(rolled - twist, row[4] * most, row[4] * most) + limited(twist, row[5] * most, row[5] * most)

    @ti.func
    def resist(self, i, j, e, n, m, push, pressed):
        """What resistance to rolling and twisting changes s_i by, per inverse mass, for a push `pressed` along the normal; after
        what friction, `push`, has done to the pair by itself, as its masses are split."""
        k_i, k_j, rolling_mass = self.spin.share.of(i), self.spin.share.of(j), self.rolling_mass(i, j)
        out = 0 * self.spin.s[i]
        if rolling_mass > 0:
            moment = self.spin.moment(m, push)
            s_i, s_j = self.spin.s[i] - k_i * self.weight[i] * moment, self.spin.s[j] - k_j * self.weight[j] * moment
            held = self.held(i, j, e, n, s_i, s_j, pressed * rolling_mass)
            out = -(1 - self.part(i, j)) * k_i / rolling_mass * held
        return out

    @ti.func
    def left(self, i, j, e, n, pressed):
        """At the end of a substep: what the pair has turned against each other, as far as it can be held."""
        return self.held(i, j, e, n, self.spin.s[i], self.spin.s[j], pressed * self.rolling_mass(i, j))
