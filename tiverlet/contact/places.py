"""Stage 2 of contacts: places.

What overlaps by more than SLOP, by its start or by what stage 1 left, is moved apart by some accelerated passes on positions
alone. That gives no momentum, so overlap stores no energy. The slop keeps contacts closed: without it grains would fall into the
gaps that open, and a pile would never rest.
"""

from typing import TYPE_CHECKING

from ..device import ti
from ..neighbours.neighbour_list import WALL
from .limits import BEYOND, OWN, SLOP

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .impulses import Impulses
    from .responses import Responses
    from .rows import Rows


class Places:
    """Stage 2 of the contacts of one world."""

    def __init__(self, scene: "Scene", rows: "Rows", bodies: "Responses", impulses: "Impulses"):
        self.rows, self.bodies, self.impulses, self.state, self.real = rows, bodies, impulses, scene.state, scene.real

    @ti.func
    def begin(self, i):
        """Begin the passes of particle i."""
        self.bodies.last[i] = 0 * self.state.d[i]
        self.bodies.push[i] = 0 * self.state.d[i]
        if ti.static(bool(self.bodies.answers)):  # how far places have moved it
            self.bodies.new[i] = 0 * self.state.d[i]
            self.bodies.answers.begin_particle(i)

    @ti.func
    def relax(self, i, part):
        """Find how far a part of the rows of particle i want to move it. Returns by how much they overlap beyond the slop [m].

        Rows of particles that have not moved since they were found apart are not tested again.
        """
        out, total = ti.cast(0, self.real), 0 * self.state.d[i]
        kept, pressed, own = self.rows.kept[i], self.rows.pressed[i], self.rows.size(i)
        again = self.impulses.turn[None] > 0
        still = again and (self.bodies.last[i] == 0).all()
        for row in range(self.rows.first(i, part), self.rows.last(i, part)):
            other = self.rows.other.field[row]
            gap, n, slop, push_out = 0 * own + 1, 0 * total, own, self.rows.push_out
            if row < pressed:
                others_still = (self.bodies.last[other] == 0).all()
                if ti.static(bool(self.rows.edges)):
                    others_still = others_still and (self.bodies.last[self.rows.edges.end.field[row]] == 0).all()
                on_edge = False
                if ti.static(bool(self.rows.edges)):
                    on_edge = self.rows.edges.place.field[row] >= 0
                    if on_edge and not (still and others_still):
                        slop = self.rows.edges.smaller(i, other)
                        gap, n = self.rows.edges.gap_now(i, row)
                        if gap < -slop:  # deeper than the middle of what it presses on: it may come out behind
                            self.rows.note_fast()
                if not (on_edge or (still and others_still)):
                    r = self.state.separation(i, other)
                    distance = self.rows.geometry.contact_distance(i, other)
                    slop = ti.min(slop, self.rows.size(other))
                    near, rr = distance - ti.static(SLOP * BEYOND) * slop, r.dot(r)
                    if rr < near * near:
                        length = ti.sqrt(rr)
                        gap, n = length - distance, r / length
                        if not length > ti.static(2.0**-40) * distance:
                            n = self.rows.geometry.fallback_normal(i, other, r)
            elif ti.static(len(self.rows.walls) > 0):
                if not still:
                    gap, n, push_out = self.rows.wall_gap(i, other - WALL)
            if gap < ti.static(-SLOP * BEYOND) * slop:
                if not again:
                    most = self.rows.most_parting(slop, push_out)
                    if ti.static(bool(self.bodies.answers)):
                        most = ti.min(most, self.bodies.answers.most_placed(i))
                        if row < pressed:
                            most = ti.min(most, self.bodies.answers.most_placed(other))
                    self.rows.gap.field[row] = gap + most
                gap -= ti.min(self.rows.gap.field[row], ti.static(-SLOP) * slop)
            else:
                gap = 0 * gap
            if ti.static(bool(self.rows.edges)):
                self.rows.edges.gone.field[row] = 0 * n
            if gap < 0:
                p = -gap * self.rows.firm.field[row] * n
                total += p
                out -= gap
                if ti.static(bool(self.rows.edges)):
                    self.rows.edges.gone.field[row] = p
                elif part == OWN and row < kept:
                    self.bodies.push[other] = self.bodies.push[other] - p
        if part == OWN:
            if ti.static(bool(self.bodies.answers)):
                out += self.bodies.answers.links.sum_of(self.bodies.answers.links.lack, i)
                if not again:
                    out += self.bodies.answers.count_left(i)
            self.bodies.v[i] = total
        else:
            self.bodies.push[i] = total
        return out

    @ti.func
    def move(self, i, beta):
        """Move particle i, and beta times as far as in the pass before."""
        w = self.bodies.compliance(i)
        if w > 0:
            push = self.bodies.v[i] + self.bodies.push[i]
            if ti.static(bool(self.bodies.answers)):
                push += self.bodies.answers.links.along(self.bodies.answers.links.step, i)
            step = w * push + beta * self.bodies.last[i]
            self.bodies.last[i] = step
            if ti.static(bool(self.bodies.answers)):
                self.bodies.new[i] = self.bodies.new[i] + step
            self.state.advance(i, step)
        self.bodies.push[i] = 0 * self.state.d[i]

    @ti.func
    def follow(self, i):
        """Move particle i as its system, cluster or place wants after a pass."""
        if self.bodies.compliance(i) > 0:
            step = self.bodies.answers.hold(i)
            self.bodies.new[i] = self.bodies.new[i] + step
            self.state.advance(i, step)
