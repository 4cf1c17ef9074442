"""Impacts of rigid bodies without restitution: displacements are projected onto those with which no contact closes."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from ..geometry import rotation
from ..neighbours.neighbour_list import PairData
from .candidates import NONE
from .rigid_bodies import rigid_bodies

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene
    from ..features.material import Table

PASSES, MOST = 32, 256  # where no body has more than EQUAL times the mass of another one; and at most, see _passes()
EQUAL = 2.0
SLOW = 8.0  # a contact is struck if it closes faster than so many substeps of forces and constraints make it
NEAR = 1 / 64  # of an edge, or of the distance of two discs: contacts with a smaller gap hold what is pressed into them
TINY = 1e-30  # inverse mass of contacts of particles that cannot move
LASTS = 8  # substeps for which a wall is known that has pushed a particle
HEAVY = 2.0**20  # mass of a particle of a body that cannot move, in masses of the body


class BodyProjection:
    """The impact of bodies of rigid clusters and links: each body takes up the pushes of all of its contacts as a whole.

    A contact that stops one particle of a body, and not the body, is found by the constraints of the body one substep later. The
    body is a spring then that throws it back. So a contact of a body that closes fast pushes nothing in the pass: it is struck.
    After the last pass of the substep, pushes p of all contacts are found together. They move bodies by D = V + W x s, with s
    from their center as the substep began, and contacts by J D, so that

        p_n >= 0,    (J D)_n + c >= 0,    p_n ((J D)_n + c) = 0,    |p_t| <= friction times p_n.

    With the displacements d of this substep, c is max(gap, min((J d)_n, 0)) of a contact that was struck: it takes back the
    overlap that arose in this substep. Of other ones c is max(gap, (J d)_n, 0). Friction takes back the slip (J d)_t. So two
    bodies that meet go on together, and what leaves is not held. Contacts that are open by less than NEAR count, as the passes
    below leave slight gaps. Walls hold particles that they have pushed in the last few substeps, without friction.

    With d' = d + D, an impact changes |d'|^2 / 2, by masses, by the sum of p_n (J d')_n + p_t (J d')_t over contacts, minus
    |D|^2 / 2. None of these is above 0: contacts that push have (J d')_n = (J d)_n - c <= 0, and friction acts against the slip.
    So no impact adds energy. If contacts that opened in this substep had to stay open, such as those on the far side of a tip
    that a corner passed through, (J d')_n would be above 0, and bodies would be pushed apart.

    Passes are those of Jacobi with the masses of particles split among their contacts, p' = y - (J D(y) + c) / m, m = sum |a| S w
    over the particles of a contact, with their parts a in it and the sums S of all |a| of each. A body takes up the mean of what
    its particles would take up. That is a projection, so no eigenvalue exceeds 1 (Cauchy). Nesterov's y = p' + k / (k + 3) (p' -
    p_last) takes the error down as 1 / k^2. Of the energy of a body that falls on an equal one on the floor 2e-6 are left by 32
    passes, on one of a tenth of its mass 2e-3 by 71, of a hundredth 2e-4 by 226. What is left is struck in the next substep.

    Momentum is conserved, and angular momentum as by the pushes of a pass. What is far away keeps its bits.

    head, next: for each particle the first one of its body, and the next one in it, or -1.
    """

    host_only = ("rigid",)
    passes: Any = OnDevice()

    def __init__(self, scene: "Scene", batches: "list[Batch]", table: "Table", roles: int, bodies: list[list[int]]):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.scene, self.state, self.w, self.table, self.dim = scene, scene.state, scene.state.w, table, dim
        self.rubs = table.has_friction and not scene.state.spins  # friction of surfaces that spin waits for the next substep
        chains = _chains(bodies, scene.inv_mass)
        self.head, self.next, self.alone = self.chains = [
            add(f"bodies.{name}", n, kind=ti.i32, values=values)
            for name, values in zip(("head", "next", "alone"), chains, strict=False)
        ]
        self.mass, self.body_mass = self.masses = [
            add(f"bodies.{name}", n, values=values) for name, values in zip(("mass", "total"), chains[3:], strict=True)
        ]
        self.any_struck = add("bodies.any_struck", None, kind=ti.i32)
        self.rigid = _rigid(batches)
        self.passes = scene.memory.number(_passes(bodies, scene.inv_mass), ti.i32)
        # Of each particle: its contacts, how often its mass is split, its place from the center of its body, its move, and the
        # wall that has pushed it last: until when that counts, its plane, and its pushes y, p, and the last change of y.
        # reached: whether anything near it has moved, so that its contacts have pushes to find.
        # near: the same of the body of which it is the first, as a pass begins; bodies that move reach others.
        self.reached, self.near = (add(f"bodies.{k}", n, kind=ti.i32) for k in ("reached", "near"))
        self.number, self.split = add("bodies.contacts", n, kind=ti.i32), add("bodies.split", n)
        self.arm, self.move, self.wall_step = (add(f"bodies.{k}", n, width=dim) for k in ("arm", "move", "wall_step"))
        self.wall_ahead, self.wall_pressed = (add(f"bodies.{k}", n) for k in ("wall_ahead", "wall_pressed"))
        self.wall_normal = add("bodies.wall_normal", n, width=dim, state=True)
        self.wall_offset = add("bodies.wall_offset", n, state=True)
        self.wall_until = add("bodies.wall_until", n, kind=ti.i32, state=True)
        self.moment = add("bodies.moment", n, width=dim * dim)  # sum m s s^T of each body, at its first particle
        # Of each contact: whether it was struck, its normal, its place on an edge, its gap, and its pushes y, p, and the last
        # change of y [kg m]. listed: the contacts in which a particle has each role.
        self.struck = PairData("body_struck", 0, persistent=False)
        self.normal, self.place, self.lack, self.ahead, self.push, self.step = further = [
            PairData(f"body_{k}", width, persistent=False, is_transferred=False)
            for k, width in (("normal", dim), ("place", 0), ("lack", dim), ("ahead", dim), ("push", dim), ("step", dim))
        ]
        self.roles = roles
        self.listed = PairData("body_contacts", roles, persistent=False, is_transferred=False, kind=ti.i32)
        self.partner = PairData("body_partner", 0, persistent=False, is_transferred=False, kind=ti.i32)  # for each listed one
        self.pair_data = [self.struck, *further, self.listed, self.partner]

    @staticmethod
    def made(scene: "Scene", batches: "list[Batch]", table: "Table", roles: int) -> "BodyProjection | None":
        """Return the projection for the bodies that these constraints make, None without any."""
        bodies = rigid_bodies(batches, scene.particles.position, scene.inv_mass) if scene.order == 2 else []
        return BodyProjection(scene, batches, table, roles, bodies) if bodies else None

    def update(self, batches: "list[Batch]", everything: bool) -> None:
        """Write the bodies that constraints make, if other ones are rigid now. everything: in any case."""
        rigid = _rigid(batches)
        if not everything and rigid == self.rigid:
            return
        self.rigid = rigid
        bodies = rigid_bodies(batches, self.scene.particles.position, self.scene.inv_mass)
        for field, values in zip([*self.chains, *self.masses], _chains(bodies, self.scene.inv_mass), strict=True):
            self.scene.memory.write(field, values)
        self.passes = _passes(bodies, self.scene.inv_mass)

    @ti.func
    def strikes(self, geometry: ti.template(), v, a, b, t, n, borne):  # type: ignore[valid-type]
        """Whether a contact is an impact of a body: particle v, and the point t between a and b, with the normal n.

        borne: the overlap that bears its load [m]. What closes by less is sound.
        """
        out = False
        if self.alone[v] == 0 or self.alone[a] == 0 or self.alone[b] == 0:
            closes = -geometry.relative(self.state.d, v, a, b, t).dot(n)
            before = -geometry.relative(self.state.before, v, a, b, t).dot(n)
            out = closes > 0 and closes >= borne and before > ti.static(SLOW) * ti.abs(closes - before)
        return out

    @ti.func
    def note(self, e, n, struck):
        """Note whether the contact at entry e was struck, with the normal n."""
        self.normal.field[e] = n
        self.struck.field[e] = ti.cast(struck, self.scene.real)
        if struck and self.any_struck[None] == 0:
            self.any_struck[None] = 1

    @ti.func
    def note_wall(self, i, tick):
        """As the substep `tick` begins: store the plane of the wall that pushed particle i in the last one."""
        n = self.state.wall_normal(i)
        if (n != 0).any():
            self.wall_normal[i], self.wall_until[i] = n, tick + LASTS
            self.wall_offset[i] = self.state.x[i].dot(n)

    @ti.func
    def begin(self, i, geometry: ti.template(), tick):  # type: ignore[valid-type]
        """Find what each contact of particle i lacks, and how far the wall is. Set its move, and pushes, to 0."""
        if self.state.awake(i):
            for e in range(geometry.list.first[i], geometry.list.first[i] + geometry.list.number[i]):
                t, n, gap = geometry.near_contact(i, e, ti.static(NEAR))
                lack = 0 * n
                if t != NONE:
                    v, a, b = geometry.ends(i, e, t)
                    moved = geometry.relative(self.state.d, v, a, b, ti.max(t, 0))
                    opened = ti.max(moved.dot(n), 0)
                    if self.struck.field[e] != 0:
                        n = self.normal.field[e]
                        opened = ti.min(moved.dot(n), 0)
                        self.reached[v] = self.reached[a] = self.reached[b] = 1
                    lack = moved + (ti.max(gap, opened) - moved.dot(n)) * n
                self.struck.field[e] = 0
                self.normal.field[e], self.place.field[e], self.lack.field[e] = n, t, lack
                self.ahead.field[e] = self.push.field[e] = self.step.field[e] = 0 * n
        self.move[i] = self.wall_step[i] = ti.zero(self.move[i])
        if ti.static(self.state.keeps_wall_push):
            self.wall_ahead[i] = self.wall_pressed[i] = 0
            self.note_wall(i, tick)

    @ti.func
    def list_contacts(self, i, geometry: ti.template(), tick):  # type: ignore[valid-type]
        """List the contacts of particle i, and split its mass among them."""
        first, count, parts = geometry.list.first[i], 0, 0 * self.w.of(i)
        if self.state.awake(i):
            for e in range(first, first + geometry.list.number[i]):
                some = False
                for role in range(ti.static(self.roles)):
                    at = geometry.entry_of(i, e, role)
                    if at >= 0:
                        part = geometry.part_of(self.place.field[at], role)
                        if self.place.field[at] == NONE or part == 0:
                            at = -1
                        else:
                            some, parts = True, parts + abs(part)
                    self.listed.field[first + count][role] = at
                if some:
                    self.partner.field[first + count] = geometry.list.neighbour[e]
                    count += 1
        self.number[i] = count
        if ti.static(self.state.keeps_wall_push):
            if self.is_near_wall(i, tick):
                parts += 1
        self.split[i] = parts * self.w.of(i)

    @ti.func
    def is_near_wall(self, i, tick):
        """Whether a wall has pushed particle i lately."""
        return self.wall_until[i] > tick

    @ti.func
    def begin_body(self, i):
        """Compute the center and the moment of the body of which particle i is the first."""
        if self.head[i] == i and self.alone[i] == 0:
            center, k = ti.zero(self.move[i]), i
            S = center.outer_product(center)
            while k >= 0:
                r = self.state.separation(k, i) - (self.state.d[k] - self.state.d[i])  # as the substep began
                center += self.mass[k] / self.body_mass[i] * r
                S += self.mass[k] * r.outer_product(r)
                self.arm[k] = r
                k = self.next[k]
            S -= self.body_mass[i] * center.outer_product(center)
            for a in ti.static(range(self.dim)):
                for b in ti.static(range(self.dim)):
                    self.moment[i][self.dim * a + b] = S[a, b]
            k = i
            while k >= 0:
                self.arm[k] = self.arm[k] - center
                k = self.next[k]

    @ti.func
    def press(self, i, k, geometry: ti.template(), tick):  # type: ignore[valid-type]
        """In pass k: compute the pushes of the contacts of particle i, and of the wall on it."""
        self.find_near(i)
        first, keep = geometry.list.first[i], ti.cast(k, self.scene.real) / (k + 3)
        if k == self.passes - 1:
            keep *= 0
        for m in range(first, first + ti.select(self.reached[i] != 0, self.number[i], 0)):
            e = self.listed.field[m][0]
            if e >= 0:
                n, t = self.normal.field[e], ti.max(self.place.field[e], 0)
                v, a, b = geometry.ends(i, e, self.place.field[e])
                shared = self.split[v] + (1 - t) * self.split[a] + t * self.split[b]
                lacks = self.lack.field[e] + self.move[v] - (1 - t) * self.move[a] - t * self.move[b]
                new = self.ahead.field[e] - lacks / ti.max(shared, ti.static(TINY))
                pressed = ti.max(new.dot(n), 0)
                across = new - new.dot(n) * n
                new = pressed * n
                if ti.static(self.rubs):
                    limits, size = self.table.of(v, a), across.norm()
                    if size > limits[0] * pressed:
                        across *= limits[1] * pressed / size
                    new += across
                ahead = new + keep * (new - self.push.field[e])
                self.step.field[e] = ahead - self.ahead.field[e]
                self.push.field[e], self.ahead.field[e] = new, ahead
        if ti.static(self.state.keeps_wall_push):
            if self.reached[i] != 0 and self.split[i] > 0 and self.is_near_wall(i, tick):
                n = self.wall_normal[i]
                gap = ti.max(self.state.x[i].dot(n) - self.wall_offset[i], 0)
                new = ti.max(self.wall_ahead[i] - (self.move[i].dot(n) + gap) / self.split[i], 0)
                ahead = new + keep * (new - self.wall_pressed[i])
                self.wall_step[i] = (ahead - self.wall_ahead[i]) * n
                self.wall_pressed[i], self.wall_ahead[i] = new, ahead

    @ti.func
    def find_near(self, i):
        """If particle i is the first of its body: note whether anything near the body has moved."""
        near, k = 0, ti.select(self.head[i] == i, i, -1)
        while k >= 0:
            near |= self.reached[k]
            k = self.next[k]
        self.near[i] = near

    @ti.func
    def follow(self, i, geometry: ti.template()):  # type: ignore[valid-type]
        """Move the body of which particle i is the first by what pushes have changed in this pass."""
        if self.head[i] == i:
            total, k = ti.zero(self.move[i]), ti.select(self.near[i] != 0, i, -1)
            X = total.outer_product(total)
            while k >= 0:
                if self.split[k] > 0 or self.number[k] > 0:
                    change = self.wall_step[k]
                    for m in range(geometry.list.first[k], geometry.list.first[k] + self.number[k]):
                        for role in range(ti.static(self.roles)):
                            at = self.listed.field[m][role]
                            if at >= 0:
                                change += geometry.part_of(self.place.field[at], role) * self.step.field[at]
                    total += change
                    X += change.outer_product(self.arm[k])
                k = self.next[k]
            if (total != 0).any() or (X != 0).any():
                S = rotation.from_rows(self.moment[i])
                B = rotation.skew(rotation.turn_rate(S, rotation.axial(X)), S)
                k = i
                while k >= 0:
                    if self.w.positive(k):
                        self.move[k] = self.move[k] + total / self.body_mass[i] + B @ self.arm[k]
                    self.reached[k] = 1
                    for m in range(geometry.list.first[k], geometry.list.first[k] + self.number[k]):
                        self.reached[self.partner.field[m]] = 1
                    k = self.next[k]

    @ti.func
    def end(self, i, geometry: ti.template()):  # type: ignore[valid-type]
        """Move particle i, and report the pushes of its contacts. Returns whether it moves."""
        for m in range(geometry.list.first[i], geometry.list.first[i] + self.number[i]):
            e = self.listed.field[m][0]
            if e >= 0:
                geometry.add_push(e, self.push.field[e].dot(self.normal.field[e]))
        self.reached[i] = 0
        moves = (self.move[i] != 0).any()
        if moves:
            self.state.shift(i, self.move[i])
        return moves


def _chains(bodies: list[list[int]], inv_mass: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return of each particle the first one of its body, the next one in it or -1, and whether it is in none; its mass, and that
    of its body. A particle that cannot move counts with a large mass."""
    n = len(inv_mass)
    head, after, alone = np.arange(n), np.full(n, -1), np.ones(n, dtype=int)
    m = np.divide(1, inv_mass, out=np.ones(n), where=inv_mass > 0)
    total = m.copy()
    for body in bodies:
        head[body], after[body[:-1]], alone[body] = body[0], body[1:], 0
        m[body] = np.where(inv_mass[body] > 0, m[body], HEAVY * m[body][inv_mass[body] > 0].sum())
        total[body] = m[body].sum()
    return head, after, alone, m, total


def _passes(bodies: list[list[int]], inv_mass: np.ndarray) -> int:
    """Return the number of passes for these bodies, and for the other particles: it grows as the square root of mass ratios."""
    m = np.divide(1, inv_mass, out=np.zeros(len(inv_mass)), where=inv_mass > 0)
    for body in bodies:
        m[body[0]], m[body[1:]] = m[body].sum(), 0
    some = m[m > 0]
    return int(min(MOST, PASSES * max(1, np.sqrt(some.max() / (EQUAL * some.min()))))) if len(some) else PASSES


def _rigid(batches: "list[Batch]") -> list[bytes]:
    """Return which constraints of each batch are rigid, as bytes that can be compared."""
    return [(np.broadcast_to(getattr(b, "compliance", 1.0), b.count) == 0).tobytes() for b in batches]
