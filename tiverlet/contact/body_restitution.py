"""Restitution of discs and spheres of bodies: all impacts of a body in a substep together, by the laws of Newton and Coulomb."""

from typing import TYPE_CHECKING

from ..colliders.body_impacts import FINE
from ..device import ti
from ..features.material import DYNAMIC, RESTITUTION, STATIC
from ..neighbours.neighbour_list import PairData

if TYPE_CHECKING:
    from ..features.feature import Scene
    from ..features.material import Table
    from .restitution import Restitution

MET = 2.0**-12  # of the first push of a pair: a smaller change counts as met, unless the inverse masses are known
AIM = 2.0**-40  # [m] the least displacement with which a contact leaves after an impact, so that its normal can be told from it


class BodyRestitution:
    """In extra passes: pushes pairs that struck each other, if constraints hold either particle, see BodyImpacts.

    A pair is to leave with the relative displacement aim n. Its push p [kg m], a vector, has a part along n and one across it:

        p_n' = max(p_n + (aim - d.n) / K_nn, 0),    p_t' = p_t - s / K_ss, at most friction times p_n',

    with the relative displacement d, its part s across n once p_n has changed, and the inverse masses K of
    BodyImpacts.inverse_mass(). A particle has any number of impacts. Both particles of a pair compute the same push before
    either moves. What links leave of a push is not known, so pushes of linked particles grow from below. Longer steps, by the
    secants of earlier ones, made heaps of elastic bodies with friction gain energy: pairs change each other's secants.

    The aim is e times the approach before the substep: what came from x with d leaves x with -e d. At e = 1 that is Verlet back
    in time, which conserves energy under gravity. The law of free discs, under_force(), would take turns for forces.

    aim: aim n [m]. push: the sum of all pushes [kg m]. step: that of this pass [kg m]. first: the normal push of the first pass
    [kg m].
    """

    def __init__(self, scene: "Scene", table: "Table"):
        dim = scene.particles.dim
        self.table, self.state, self.impacts = table, scene.state, scene.impacts
        self.aim, self.push, self.step, self.first = self.pair_data = [
            PairData(f"body_{name}", width, persistent=False, is_transferred=False)
            for name, width in (("aim", dim), ("push", dim), ("step", dim), ("first", 0))
        ]

    def bind(self, restitution: "Restitution") -> None:
        """Store the object that tells which pairs are struck, and how they leave."""
        self.restitution, self.list = restitution, restitution.list

    @ti.func
    def joins(self, i, j):
        """Whether extra passes make the impact of particles i and j."""
        return self.impacts.is_linked(i) or self.impacts.is_linked(j)

    @ti.func
    def begin(self, i, j, e, n):
        """Begin the impact of the pair at entry e of the list of particle i, with the normal n from j to i."""
        self.aim.field[e] = ti.max(self.table.of(i, j)[RESTITUTION] * self.restitution.approach(i, j, n), ti.static(AIM)) * n
        self.push.field[e] = self.step.field[e] = 0 * n
        self.first.field[e] = 0 * self.first.field[e]

    @ti.func
    def take_part(self, i, parts):
        """Store in how many impacts of bodies particle i takes part."""
        if self.state.w.positive(i):
            self.impacts.parts[i] = parts

    @ti.func
    def is_struck(self, i, e):
        """Whether the pair at entry e of the list of particle i is in an impact of bodies."""
        return self.restitution.struck.field[e] > 0 and self.joins(i, self.list.neighbour[e])

    @ti.func
    def correct(self, i, now):
        """Compute the pushes of all impacts of particle i. Returns whether any of them was off."""
        off = False
        if self.impacts.parts[i] > 0:
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.is_struck(i, e):
                    off = self.correct_pair(i, self.list.neighbour[e], e, now) or off
        return off

    @ti.func
    def correct_pair(self, i, j, e, now):
        """Compute the push of the pair at entry e of the list of particle i. Returns whether it was off."""
        aim, last, first = self.aim.field[e].norm(), self.push.field[e], self.first.field[e]
        n, speed = self.aim.field[e] / aim, 0 * aim
        bend = self.impacts.path_bend(i, n) - self.impacts.path_bend(j, n)
        d = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        if first == 0:
            if ti.static(self.impacts.clusters):  # Newton's law holds for tangents, see ClusterImpact
                approach = self.restitution.approach(i, j, n)
                if approach > 0:
                    aim = ti.max(aim * (1 - bend / approach), ti.static(AIM))
                    self.aim.field[e] = aim * n
        lack = aim + bend - d.dot(n)
        if first == 0:
            speed = lack / (1 + self.table.of(i, j)[RESTITUTION])
        both = self.impacts.response(i, n) + self.impacts.response(j, n)
        pressed = ti.max(last.dot(n) + lack / both.dot(n), 0)
        normal = pressed - last.dot(n)
        step, met = normal * n, ti.static(MET) + 0 * aim
        if ti.static(self.table.has_friction):
            step += self.rub(i, j, n, pressed, last - last.dot(n) * n, d + normal * both)
        if first == 0:
            first = ti.max(normal, ti.static(AIM))
        if self.impacts.in_cluster(i) and self.impacts.in_cluster(j):
            met = ti.static(FINE) + 0 * aim
        off = step.norm() > met * first
        if self.impacts.in_cluster(i) or self.impacts.in_cluster(j):
            if not (off and self.impacts.has_next_pass(now)):
                step *= 0  # no pass would follow, in which clusters take it up
        self.push.field[e], self.step.field[e], self.first.field[e] = last + step, step, first
        self.restitution.note_push(e, step.dot(n), speed)
        return off

    @ti.func
    def rub(self, i, j, n, pressed, held, d):
        """Return how the push across n changes, so that friction takes back the slip as far as it can.

        pressed: the push along n. held: the push across it so far. d: the relative displacement.
        """
        slip, out = d - d.dot(n) * n, 0 * d
        size, row = slip.norm(), self.table.of(i, j)
        if row[STATIC] > 0 and size > 0:
            along = slip / size
            new = held - slip / (self.impacts.inverse_mass(i, along, along) + self.impacts.inverse_mass(j, along, along))
            wanted = new.norm()
            if wanted > row[STATIC] * pressed:
                new *= row[DYNAMIC] * pressed / wanted
            out = new - held
        return out

    @ti.func
    def apply(self, i):
        """Give particle i what correct() found. Clusters take it up in the next pass."""
        if self.impacts.parts[i] > 0:
            total = 0 * self.state.x[i]
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                if self.is_struck(i, e):
                    total += self.state.w.of(i) * self.step.field[e]
            if self.impacts.in_cluster(i):
                self.impacts.change[i] = total
            else:
                self.state.shift(i, total)
            self.impacts.reached[i] = 1
