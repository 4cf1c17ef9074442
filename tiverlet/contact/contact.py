"""Particles that do not overlap."""

import warnings
from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..device.patches.compiler import FEW
from ..device.thread_team import BLOCK, Team
from ..features.feature import Batch, Knob, Scene
from ..features.material import Table
from ..neighbours.neighbour_list import WORD, Luggage, lowest
from ..neighbours.neighbour_search import FARTHEST, Grid
from ..particles import Particles
from ..tools import median
from .mass_splitting import Splitting, lesser
from .velocity_projection import Calm

RELAXATION = 1.25  # below 4/3, see Contact
CARRY = 0.4  # of its last push that a pair keeps, at most; below 1/2
UPTAKE = 1 / 8  # of the slack of a pair, what a substep takes back


class Contact(Splitting):
    """Discs and spheres do not overlap.

    C(x) = |x_i - x_j| - (r_i + r_j) >= 0 for all pairs, grad_i C = n = (x_i - x_j) / |x_i - x_j|.

    friction: Coulomb, a number or (static, dynamic), or a mapping from pairs of groups to these: {(0, 1): 0.5}. restitution:
    0 to 1, or such a mapping. groups: the pairs of groups that touch, None for all. skin: how far beyond touching pairs are
    listed [m], "auto" for 0.75 of the median radius; speed only, never the result. push_out: particles that overlap at the
    start, or after positions were assigned, part at this speed [m/s] at most: they act as if they were small enough to fit, and
    grow back.

    A Jacobi pass: each pair wants C back along the current n, split by mass, p = C / (m_i w_i + m_j w_j), which conserves
    momentum. A particle has its mass split m times, where m bounds the eigenvalues of S, the sum of n n^T over its overlapping
    pairs: then sum w J J^T <= diag(sum w m) for the rows J of its pairs, and no eigenvalue of a pass exceeds 1. m is 3 for a disc
    among six neighbours (counting pairs gives 6) and 4 for a sphere among twelve. With friction tangents are taken back too;
    n n^T and t t^T sum up to the count, which is taken then, and for up to two pairs. m grows at once, and falls slowly: if it
    followed pairs that just touch, the stiffness of what is around them would jump whenever they part, and keep them going.

    Pushes are over-relaxed by r = 5/4, and a pair that overlapped in the last substep keeps a part of what it got. With M =
    m_i w_i + m_j w_j, p = r C / M + c p_last, but no more than what parts the pair alone, C / (w_i + w_j). For a mode with
    eigenvalue L of a pass, stepping has the characteristic polynomial (z - 1)^2 (z - c) + r L z (2 z - 1), stable if and only if
    c < 1/2 and r L < 4 (1 + c) / 3. A load is held by (1 - c) / r of the overlap; c = 0.4, or less where p would pass that bound
    at rest. So the k-th contact below the top of a stack overlaps by 2 k g h^2. Sound that is left in a pile is taken out now and
    then, see velocity_projection.py.

    Particles that are in the same place part in a direction made from their indices, another one for each pair. Linked particles
    (Distance, Rope, Spacer) do not touch.

    Friction wants back the slip s of a pair, up to friction times the overlap: what a pair has moved across its normal since it
    touched, kept as long as it touches (Cundall and Strack 1979). Restitution gives the pair the normal velocity -e times the one
    that it had before the substep, from the moment on when it met. Neither depends on h. Particles do not spin.

    What is struck by several in one substep bounces off one after the other. Of the pairs that were struck, those take their turn
    that come first for both of their particles; then the next ones, on the new ways. Each blow is between two, so it keeps
    momentum, and energy if e = 1, however many there are.

    Pushes act like springs, which give back what they took. So among pairs that bounce they are only for overlap that came to be
    while they acted, or in the substep in which the pair comes to rest. What a blow leaves of an overlap is slack: a third one
    threw the pair together while no spring was there, and to push it out would make energy. Slack is taken back of the positions
    alone, an eighth in each substep. A pair with slack rests unless it is thrown together by more than that in a substep, or e is
    1; otherwise it bounces again, or is let go on its way out.
    """

    def __init__(self, friction=0.0, restitution=0.0, *, skin: float | str = "auto", groups=None, push_out=1.0):
        self.groups, self.restitution, self.friction = groups, restitution, friction
        self.skin, self.push_out = skin, push_out

    friction = Knob(lambda f, v: f._surface("friction", v), "Of all pairs, or by pairs of groups.")
    restitution = Knob(lambda f, v: f._surface("restitution", v), "Of all pairs, or by pairs of groups.")
    groups: Any = Knob(lambda f, v: f._surface("groups", v), "The pairs of groups that touch; None for all.", compiled=True)
    skin = Knob(lambda f, v: _skin(v), "How far beyond touching pairs are listed [m].", compiled=True)
    push_out = Knob(lambda f, v: checks.number("Contact", "push_out", v, least=0.0), "[m/s].", compiled=True)
    compiled_for = ("rubs", "bounces", "uniform")
    table: Table  # bound to one world
    matters = True
    room = 0  # entries of the list for each particle, at first, if that is more than discs have
    measures = False  # looks at all contacts once in each pass, before they are counted
    calms = True  # knows which of them bear a load, see velocity_projection.py

    def _surface(self, name: str, value):
        """Check what pairs are like, with what was said so far."""
        if name == "groups" and value is not None:
            value = checks.rows("Contact", name, value, "a list of pairs of groups, such as [(0, 1)],")
        elif isinstance(value, list):
            value = tuple(value)
        given = {"friction": 0.0, "restitution": 0.0, "groups": None} | vars(self) | {name: value}
        Table("Contact", given["friction"], given["restitution"], given["groups"])
        return value

    @property
    def wanted(self) -> Table:
        """What pairs are to be like."""
        return Table("Contact", self.friction, self.restitution, self.groups)

    @property
    def uniform(self) -> bool:
        """Whether all pairs are alike."""
        return self.wanted.uniform

    @property
    def rubs(self) -> bool:
        """Whether any pair has friction, or had when kernels were compiled."""
        return self.wanted.rubs or vars(self.dev).get("rubs", False)

    @property
    def bounces(self) -> bool:
        """Whether any pair has restitution, or had when kernels were compiled."""
        return self.wanted.bounces or vars(self.dev).get("bounces", False)

    def upload(self) -> None:
        """Write friction and restitution."""
        if self.scene:
            self.table.upload(self.scene, self.wanted)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Choose the skin, and refuse positions too far out for cells to be told apart."""
        self.dev.eases, self.dev.store = False, None
        radius = particles.radius
        some = radius[radius > 0]
        auto = 0.75 * median(some) if len(some) else 1.0
        self.dev.size = auto if self.skin == "auto" else float(self.skin)
        self.dev.finest = float(radius.min(initial=np.inf))
        self._keep(matters=len(some) > 0, table=self.wanted)
        if self.matters:
            self.check_range(particles.position)

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of particles that cannot touch."""
        if not self.matters and particles.count:
            warnings.warn(f"{self!r}: all radii are 0, so nothing touches; give tv.Particles a radius.", stacklevel=3)

    def admit(self, particles: Particles, first: int) -> None:
        """Refuse positions too far out."""
        if self.matters:
            self.check_range(particles.position)

    def spared(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Its fields are those of the particles."""
        return (number >= 0,)

    def check_range(self, position: np.ndarray) -> None:
        """Raise where coordinates are too large for the cells."""
        cell = 2 * self.dev.finest + self.dev.size
        far = np.abs(position) >= FARTHEST * cell
        if far.any():
            i, k = np.unravel_index(int(np.argmax(far)), far.shape)
            raise ValueError(
                f"Contact: position[{i}, {k}] = {position[i, k]:g} m is {abs(position[i, k]) / cell:.2g} cells of {cell:g} m "
                f"from the origin, but f32 tells only {FARTHEST} apart. Shift the scene towards the origin."
            )

    def join(self, scene: Scene, batches: list[Batch], team: Team) -> Grid:
        """Declare the fields, among them the grid's."""
        n, dim = scene.particles.count, scene.particles.dim
        pairs = [b.partners(b.start) for b in batches]
        linked = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int32)
        self.scene = scene
        self.dev.state = scene.state
        self.dev.radius = scene.radius
        self.dev.move = scene.memory.field("Contact.move", n, width=dim)
        self.dev.split = scene.memory.field("Contact.split_mass", n, state=True)
        self.dev.press = scene.memory.field("Contact.press", n, width=dim, state=True)
        self.dev.before = scene.memory.field("Contact.before", n, width=dim, state=True)
        if self.rubs:
            self.dev.bond = scene.memory.field("Contact.bond", n, width=dim, state=True)
        self.dev.block = min(BLOCK, team.piece)
        self.dev.skips = n >= FEW and not self.bounces  # in relax() what bounces forgets the last blow
        if self.dev.skips:
            self.dev.some = scene.memory.field("Contact.some_touch", -(-n // self.dev.block), kind=ti.i32)
        self.dev.fast = scene.memory.field("Contact.fast", None, kind=ti.i32)
        self.dev.rubs, self.dev.bounces = self.rubs, self.bounces
        if self.bounces:
            self.dev.struck = scene.memory.field("Contact.struck", n)
            self.dev.kick = scene.memory.field("Contact.kick", n, width=dim)
            self.dev.lift = scene.memory.field("Contact.lift", n, width=dim)
            self.dev.left = scene.memory.field("Contact.left", n)
            self.dev.partner = scene.memory.field("Contact.partner", n, kind=ti.i32)
            self.dev.first = scene.memory.field("Contact.first", n, kind=ti.i32)
            self.dev.hit = scene.memory.field("Contact.hit", None, kind=ti.i32)
        self.table.bind(scene)
        # What parted the pair in the last substep, per inverse mass [kg m].
        self.dev.push = Luggage("push", 0, lasting=True, marked=True)
        self.dev.slip = Luggage("slip", dim, lasting=True)
        self.dev.blow = Luggage("blow", 0, lasting=False)
        luggage = [self.dev.push, *([self.dev.slip] if self.rubs else [])]
        if self.bounces:
            self.dev.slack = Luggage("slack", 0, lasting=True)  # of the overlap, what no push is for
            self.dev.given = Luggage("given", 0, lasting=True)  # pushes and blows in the last substep [kg m]
            luggage += [self.dev.slack, self.dev.blow, self.dev.given]
        self.dev.grid = Grid(scene, self.dev.size, linked, self.table, luggage, team, self.dev.move)
        self.dev.calm = Calm(self, -(-n // team.piece))
        return self.dev.grid

    @ti.func
    def overshoots(self, i):
        """1 if particle i crosses more than its own size in one substep."""
        d, limit = self.dev.state.d[i], self.dev.radius.stride(i)
        return ti.select(d.dot(d) <= limit * limit, 0, 1)

    @ti.func
    def heed(self, stale, fast):
        """Write down what was noticed; threads that all write to the same place would wait for each other."""
        if stale != 0:
            if self.dev.grid.stale[None] == 0:
                self.dev.grid.stale[None] = 1
        if fast != 0:
            if self.dev.fast[None] == 0:
                self.dev.fast[None] = 1

    @ti.func
    def relax(self, i, first, fresh, final):
        """What the pairs of particle i want of it."""
        total, w = ti.Vector.zero(self.scene.real, self.dev.state.dim), self.dev.state.w.of(i)
        lift, bond = total, total
        if ti.static(self.dev.bounces):
            if first != 0:
                self.dev.struck[i] = self.dev.split[i]
                for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                    self.dev.blow.field[e] = 0
                    self.dev.given.field[e] = 0
        if self.dev.split[i] > 0:
            for word in range(self.dev.grid.words(i)):
                bits = self.touching(i, word)
                while bits != 0:
                    e = self.dev.grid.first[i] + word * WORD + lowest(bits)
                    bits &= bits - ti.u32(1)
                    j = self.dev.grid.near[e]
                    shared, last = self.dev.split[i] + self.dev.split[j], self.dev.push.field[e]
                    overlap, each, n = self.meet(i, j, self.far(i, j), shared)
                    each *= ti.static(RELAXATION)
                    paid, given, rests, alone = overlap, ti.zero(overlap), True, w + self.dev.state.w.of(j)
                    if ti.static(self.dev.bounces):
                        given, slack, rests = self.bounce(i, j, n, overlap, self.dev.slack.field[e], last, first)
                        if first != 0:
                            back = ti.static(UPTAKE) * ti.min(slack * each, slack / alone)
                            lift += w * back * n
                            self.dev.slack.field[e] = slack - alone * back
                        paid -= slack
                    part, push = paid * each, ti.zero(overlap)
                    if first == 0:
                        push = last
                    elif fresh == 0:
                        part += ti.max(ti.min(1 - alone * each, ti.static(CARRY)), 0) * last
                    part = lesser(part, paid / alone)  # without a branch: it would be taken at random
                    if ti.static(self.dev.bounces):
                        if given > 0:
                            self.dev.blow.field[e] = 1
                            if self.dev.hit[None] == 0:
                                self.dev.hit[None] = 1
                        if not rests:
                            part = ti.zero(part)
                        self.dev.given.field[e] = self.dev.given.field[e] + part
                    push += part
                    want = part * n
                    if ti.static(self.dev.rubs):
                        want -= self.rub(i, j, n, part * shared + given, self.dev.slip.field[e]) / shared
                    total += w * want
                    if ti.static(self.dev.rubs):
                        if final != 0:
                            came = -(self.dev.before[i] - self.dev.before[j]).dot(n)
                            bond += self.steady(came, part * alone) * w * (want - part * n)
                    self.dev.push.field[e] = push
        self.dev.move[i] = total
        if ti.static(self.dev.rubs):
            if final != 0:
                self.sum_up(i, bond, first)
        if ti.static(self.dev.bounces):
            self.dev.lift[i] = lift

    @ti.func
    def push_bond(self, i):
        """Along the normals at the present places, where pushes have no moment. Friction is known from the passes."""
        total, w = 0 * self.dev.press[i], self.dev.state.w.of(i)
        if self.dev.split[i] > 0:
            for word in range(self.dev.grid.words(i)):
                bits = ti.select(word == 0, self.dev.grid.touching[i], self.dev.grid.whole(i, word))
                while bits != 0:
                    e = self.dev.grid.first[i] + word * WORD + lowest(bits)
                    bits &= bits - ti.u32(1)
                    j, push = self.dev.grid.near[e], self.dev.push.field[e]
                    r = self.dev.state.apart(i, j)
                    length = r.norm()
                    if push > 0 and length > 0:
                        n = r / length
                        came = -(self.dev.before[i] - self.dev.before[j]).dot(n)
                        total += self.steady(came, push * (w + self.dev.state.w.of(j))) * w * push * n
        self.dev.press[i] = total

    @ti.func
    def bond(self, i):
        """Pushes, and friction."""
        total = self.dev.press[i]
        if ti.static(self.dev.rubs):
            total += self.dev.bond[i]
        return total

    @ti.func
    def bounce(self, i, j, n, overlap, slack, last, first):
        """The displacement that takes a pair that was struck in this substep from coming together to leaving, 0 for others; its
        slack; and whether it rests, so that it is pushed apart, as it was in the last substep."""
        given, here, a = self.leap(i, j, n)
        rests, e = True, self.table.of(i, j)[2]
        if e > 0:
            deep = ti.select(last > 0, overlap, ti.select(e < 1, slack, 0))  # nothing that is elastic rests where nothing pulls
            if last == 0:
                slack = ti.max(slack, overlap - ti.max(here, 0))
            if a > 0:
                rests = deep > 0 and (first == 0 or given <= deep)
            elif a < 0:
                rests = deep > 0 or overlap <= here
        if rests or a < 0 or first == 0:
            given = 0 * given
        if not rests:
            slack = ti.select(given > 0, ti.max(overlap - given, 0), 0)
        return given, ti.min(slack, overlap), rests

    @ti.func
    def leap(self, i, j, n):
        """What takes a pair from coming together to leaving; how far it comes together in this substep, and without forces."""
        a = -(self.dev.state.before[i] - self.dev.state.before[j]).dot(n)
        here = -(self.dev.state.d[i] - self.dev.state.d[j]).dot(n)
        return here + self.table.of(i, j)[2] * ti.max(a, 0), here, a

    @ti.func
    def rebound(self, i):
        """The first of the pairs of particle i that were struck and still come together, and what it does to i."""
        first, partner, most, w = -1, -1, 0 * self.dev.struck[i], self.dev.state.w.of(i)
        if self.dev.struck[i] > 0:
            for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                if self.dev.blow.field[e] > 0:
                    j = self.dev.grid.near[e]
                    overlap, _each, n = self.meet(i, j, self.far(i, j), self.dev.struck[i])
                    given, here, a = self.leap(i, j, n)
                    if overlap > 0 and a > 0 and given > 0:
                        left = ti.select(overlap < here, overlap / here, 1)
                        if left > most or (left == most and earlier(i, j, partner)):
                            first, partner, most = e, j, left
                            self.dev.kick[i] = w / (w + self.dev.state.w.of(j)) * given * n
                            if self.dev.hit[None] == 0:
                                self.dev.hit[None] = 1
        self.dev.first[i] = first
        self.dev.partner[i] = partner
        self.dev.left[i] = most

    @ti.func
    def part_ways(self, i):
        """Let particle i bounce off its partner, if it is the partner's partner."""
        j = self.dev.partner[i]
        if j >= 0:
            if self.dev.partner[j] == i or self.dev.state.w.of(j) == 0:
                e, kick = self.dev.first[i], self.dev.kick[i]
                self.dev.given.field[e] = self.dev.given.field[e] + kick.norm() / self.dev.state.w.of(i)
                self.dev.state.d[i] = self.dev.state.d[i] + kick
                self.dev.state.before[i] = self.dev.state.before[i] + kick
                self.dev.state.advance(i, self.dev.left[i] * kick)

    @ti.func
    def rub(self, i, j, n, normal, slip):
        """The part of a pair's slip, with the present displacements, that friction takes back for a normal displacement."""
        s = slip + self.dev.state.d[i] - self.dev.state.d[j]
        s -= s.dot(n) * n
        row, size = self.table.of(i, j), s.norm()
        if size > row[0] * normal:
            s *= row[1] * normal / size
        return s

    @ti.func
    def gather(self, i, first):
        """Move particle i as its pairs want."""
        if self.dev.state.w.of(i) > 0:  # what touches nothing moves by 0, without a branch
            self.dev.state.shift(i, self.dev.move[i])
            if ti.static(self.dev.bounces):
                self.dev.state.advance(i, self.dev.lift[i])

    @ti.func
    def remember(self, i):
        """At the end of a substep: add to each pair's slip what it has moved, as far as friction can hold it; a pair that parted
        has no slack. What came to overlap after pairs were pushed, which a list with a narrow skin may not know yet, waits."""
        if ti.static(self.dev.rubs):
            for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                j = self.dev.grid.near[e]
                overlap, n = self.touch(i, j, self.far(i, j))
                slip = 0 * self.dev.state.x[i]
                if overlap > 0 and self.dev.push.field[e] > 0:
                    pressed = self.dev.push.field[e] * (self.dev.split[i] + self.dev.split[j])
                    slip = self.rub(i, j, n, ti.max(overlap, pressed), self.dev.slip.field[e])
                self.dev.slip.field[e] = slip
        if ti.static(self.dev.bounces):
            if self.dev.split[i] > 0:
                for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
                    if self.dev.slack.field[e] > 0:
                        j = self.dev.grid.near[e]
                        overlap, _n = self.touch(i, j, self.far(i, j))
                        if overlap <= 0:
                            self.dev.slack.field[e] = 0


def _skin(value):
    return value if isinstance(value, str) and value == "auto" else checks.number("Contact", "skin", value, above=0.0)


@ti.func
def earlier(i, j, k):
    """Whether (i, j) comes before (i, k) among pairs that are struck at the same time: an order of all pairs, whichever is i."""
    a, b = ti.min(i, j), ti.min(i, k)
    return a < b or (a == b and ti.max(i, j) < ti.max(i, k))
