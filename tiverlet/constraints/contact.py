"""Particles that do not overlap."""

import numpy as np
import taichi as ti

from .. import checks
from ..feature import Batch, Feature, Scene
from ..grid import FARTHEST, Grid
from ..material import Table
from ..particles import Particles
from ..runtime import Memory


class Contact(Feature):
    """Discs and spheres do not overlap.

    C(x) = |x_i - x_j| - (r_i + r_j) >= 0 for all pairs, grad_i C = n = (x_i - x_j) / |x_i - x_j|.

    friction: Coulomb, a number or (static, dynamic), or a mapping from pairs of groups to these: {(0, 1): 0.5}. restitution:
    0 to 1, or such a mapping. groups: the pairs of groups that touch, None for all. skin: how far beyond touching pairs are
    listed [m], "auto" for 0.3 of the median radius; speed only, never the result. push_out: particles that overlap at the
    start, or after positions were assigned, part at this speed [m/s] at most: they act as if they were small enough to fit, and
    grow back.

    A Jacobi pass: each pair wants C back along the current n, split by mass and by the number of overlapping pairs that each
    particle has, p = -C / (n_i w_i + n_j w_j), which conserves momentum. Particles that are in the same place part in the
    direction of a golden-ratio angle made from their indices. Linked particles (Distance, Rope, Spacer) do not touch.

    Friction wants back the slip s of a pair, up to friction times the overlap: what a pair has moved across its normal since it
    touched, kept as long as it touches (Cundall and Strack 1979). Restitution gives the pair the normal velocity -e times the one
    that it had before the substep, and reflects the overlap. Neither depends on h. Particles do not spin.
    """

    def __init__(self, friction=0.0, restitution=0.0, *, skin="auto", groups=None, push_out=1.0):
        if skin != "auto":
            skin = checks.number("Contact", "skin", skin, above=0.0)
        self.skin = skin
        self.table = Table("Contact", friction, restitution, groups)
        self.push_out = checks.number("Contact", "push_out", push_out, least=0.0)

    matters = True

    @property
    def rubs(self) -> bool:
        """Whether any pair has friction."""
        return self.table.rubs

    @property
    def bounces(self) -> bool:
        """Whether any pair has restitution."""
        return self.table.bounces

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Choose the skin, and refuse positions too far out for cells to be told apart."""
        radius = particles.radius
        some = radius[radius > 0]
        auto = 0.3 * float(np.median(some)) if len(some) else 1.0
        self._on_size = auto if self.skin == "auto" else float(self.skin)
        self._on_finest = float(radius.min(initial=np.inf))
        self.matters = len(some) > 0
        if self.matters:
            self.check_range(particles.position)

    def check_range(self, position: np.ndarray) -> None:
        """Raise where coordinates are too large for the cells."""
        cell = 2 * self._on_finest + self._on_size
        far = np.abs(position) >= FARTHEST * cell
        if far.any():
            i, k = np.unravel_index(int(np.argmax(far)), far.shape)
            raise ValueError(
                f"Contact: position[{i}, {k}] = {position[i, k]:g} m is {abs(position[i, k]) / cell:.2g} cells of {cell:g} m "
                f"from the origin, but f32 tells only {FARTHEST} apart. Shift the scene towards the origin."
            )

    def join(self, scene: Scene, batches: list[Batch], parallel: bool) -> Grid:
        """Declare the fields, among them the grid's."""
        n, dim = scene.particles.count, scene.particles.dim
        pairs = [b.indices[:, [a, c]] for b in batches for a in range(b.arity) for c in range(a)]
        linked = np.concatenate(pairs) if pairs else np.zeros((0, 2), dtype=np.int32)
        self.scene = scene
        self._on_state = scene.state
        self._on_radius = scene.radius
        self._on_move = scene.memory.field("Contact.move", n, width=dim)
        self._on_active = scene.memory.field("Contact.active", n, kind=ti.i32)
        self._on_fast = scene.memory.field("Contact.fast", None, kind=ti.i32)
        self._on_eases, self._on_store = False, None
        self._on_rubs, self._on_bounces = self.rubs, self.bounces
        if self.bounces:
            self._on_struck = scene.memory.field("Contact.struck", n, kind=ti.i32)
            self._on_kick = scene.memory.field("Contact.kick", n, width=dim)
            self._on_lift = scene.memory.field("Contact.lift", n, width=dim)
            self._on_hit = scene.memory.field("Contact.hit", None, kind=ti.i32)
        self.table.bind(scene)
        self._on_grid = Grid(scene, self._on_size, linked, self.table, self.rubs, self.bounces, parallel)
        return self._on_grid

    def ease(self) -> None:
        """From now on particles may be smaller than they are; the field for it exists only once it is needed."""
        if not self._on_eases:
            self._on_store = Memory(self.scene.real)
            self._on_less = self._on_store.field("Contact.shrunk", self.scene.particles.count, state=True)
            self._on_store.place()
            self._on_eases = True

    @ti.func
    def shrink(self, i):
        """Make particle i small enough: each pair gives up its overlap in proportion to the radii."""
        less = ti.cast(0, self.scene.real)
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j = self._on_grid.near[e]
            far = self._on_radius.of(i) + self._on_radius.of(j)
            overlap, _ = self.touch(i, j, far)
            less = ti.max(less, overlap * self._on_radius.of(i) / far)
        self._on_less[i] = less

    @ti.func
    def grow(self, i, h):
        """Let particle i grow back."""
        if ti.static(self._on_eases):
            self._on_less[i] = ti.max(self._on_less[i] - self.push_out * h / 2, 0)

    @ti.func
    def far(self, i, j):
        """The distance at which particles i and j touch."""
        far = self._on_radius.of(i) + self._on_radius.of(j)
        if ti.static(self._on_eases):
            far -= self._on_less[i] + self._on_less[j]
        return far

    @ti.func
    def watch(self, i):
        """Notice particles that outrun the list, or that cross more than their own size in one substep."""
        self._on_grid.watch(i)
        d = self._on_state.d[i]
        limit = self._on_radius.stride(i)
        if not (d.dot(d) <= limit * limit):
            self._on_fast[None] = 1

    @ti.func
    def touch(self, i, j, far):
        """Overlap [m] of a pair that touches at a distance `far` (negative where apart) and its direction, from j to i."""
        r = self._on_state.apart(i, j)
        rr = r.dot(r)
        overlap, n = 0 * far - 1, 0 * r
        if rr < far * far:
            if rr > far * far * ti.static(2.0**-80):
                length = ti.sqrt(rr)
                overlap, n = far - length, r / length
            else:
                overlap, n = far, self.part(i, j, r)
        return overlap, n

    @ti.func
    def meet(self, i, j, far):
        """As touch(), but a pair that came together in this substep has the direction that it had when it met.

        |r0 + s d| = far, with r0 at the start and d the relative displacement; what is left of d along n is the overlap. This is
        exact for free flight, where the direction at the end is off by the way that a pair slides past each other.
        """
        overlap, n = self.touch(i, j, far)
        if overlap > 0:
            d = self._on_state.d[i] - self._on_state.d[j]
            r = self._on_state.apart(i, j) - d
            c = r.dot(r) - far * far
            if c > 0:
                a, b = d.dot(d), r.dot(d)
                root = ti.sqrt(ti.max(b * b - a * c, 0)) - b
                if b < 0 and root > 0:
                    s = ti.min(c / root, 1)
                    n = (r + s * d) / far
                    overlap = ti.max((s - 1) * d.dot(n), 0)
        return overlap, n

    @ti.func
    def part(self, i, j, r):
        """A direction for two particles in the same place: opposite for (j, i), different for other pairs."""
        low, high = ti.cast(ti.min(i, j), ti.u32), ti.cast(ti.max(i, j), ti.u32)
        mixed = (low * ti.u32(2654435769)) ^ ((high + ti.u32(1)) * ti.u32(2246822519))
        u = ti.cast(mixed * ti.u32(2654435769), ti.f64) / 4294967296.0
        n = 0 * r
        turn = ti.f64(6.283185307179586) * u
        if ti.static(self._on_state.dim == 2):
            n[0], n[1] = ti.cos(turn), ti.sin(turn)
        else:
            z = 2 * ti.cast(mixed * ti.u32(3242174889), ti.f64) / 4294967296.0 - 1
            across = ti.sqrt(ti.max(1 - z * z, 0))
            n[0], n[1], n[2] = across * ti.cos(turn), across * ti.sin(turn), z
        if i > j:
            n = -n
        return n

    @ti.func
    def count(self, i):
        """How many particles overlap particle i."""
        active = 0
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j = self._on_grid.near[e]
            r, far = self._on_state.apart(i, j), self.far(i, j)
            if r.dot(r) < far * far:
                active += 1
        self._on_active[i] = active

    @ti.func
    def relax(self, i, first):
        """What the pairs of particle i want of it."""
        total, lifts = 0 * self._on_state.x[i], 0 * self._on_state.x[i]
        if self._on_active[i] > 0:
            for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
                j = self._on_grid.near[e]
                overlap, n = self.meet(i, j, self.far(i, j))
                kick = 0 * overlap
                if ti.static(self._on_bounces):
                    if first != 0:
                        self._on_grid.aim[e] = 0 * n
                if overlap > 0:
                    share = self._on_state.w[i] / self.shared(i, j)
                    if ti.static(self._on_bounces):
                        if first != 0:
                            aim, kick, lift = self.bounce(i, j, n, overlap)
                            lifts += share * lift * n
                            if kick > 0:
                                self._on_grid.aim[e] = aim * n
                                self._on_hit[None] = 1
                    want = overlap * n
                    if ti.static(self._on_rubs):
                        want -= self.rub(i, j, n, overlap + kick, self._on_grid.slip[e])
                    total += share * want
        self._on_move[i] = total
        if ti.static(self._on_bounces):
            if first != 0:
                self._on_lift[i] = lifts
                self._on_struck[i] = self._on_active[i]

    @ti.func
    def shared(self, i, j):
        """The mass-split weight of a pair."""
        return self._on_active[i] * self._on_state.w[i] + self._on_active[j] * self._on_state.w[j]

    @ti.func
    def bounce(self, i, j, n, overlap):
        """How a pair should leave: the normal displacement to aim at, what it lacks after the overlap is taken back, and how far
        beyond touching it is by the end of the substep.

        It came together by a before the substep and by `here` in it, and aims at restitution * a. Where there was a gap before,
        the overlap is reflected.
        """
        restitution = self.table.of(i, j)[2]
        a = -(self._on_state.before[i] - self._on_state.before[j]).dot(n)
        here = -(self._on_state.d[i] - self._on_state.d[j]).dot(n)
        aim, kick, lift = restitution * ti.max(a, 0), 0 * overlap, 0 * overlap
        if a > 0:
            kick = ti.max(aim - (overlap - here), 0)
            if overlap <= here:
                lift = restitution * overlap
        return aim, kick, lift

    @ti.func
    def rebound(self, i):
        """One Jacobi pass over displacements alone: what the pairs of particle i that bounce lack."""
        total = 0 * self._on_state.x[i]
        if self._on_struck[i] > 0:
            for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
                aim = self._on_grid.aim[e]
                size = aim.norm()
                if size > 0:
                    j, n = self._on_grid.near[e], aim / size
                    lack = size - (self._on_state.d[i] - self._on_state.d[j]).dot(n)
                    if lack > 0:
                        shared = self._on_struck[i] * self._on_state.w[i] + self._on_struck[j] * self._on_state.w[j]
                        total += self._on_state.w[i] * lack / shared * n
        self._on_kick[i] = total

    @ti.func
    def rub(self, i, j, n, normal, slip):
        """The part of a pair's slip, with the present displacements, that friction takes back for a normal displacement."""
        s = slip + self._on_state.d[i] - self._on_state.d[j]
        s -= s.dot(n) * n
        row, size = self.table.of(i, j), s.norm()
        if size > row[0] * normal:
            s *= row[1] * normal / size
        return s

    @ti.func
    def gather(self, i, last):
        """Move particle i as its pairs want; what bounced rises at the end of the substep."""
        if self._on_state.w[i] > 0:
            if self._on_active[i] > 0:
                self._on_state.shift(i, self._on_move[i])
            if ti.static(self._on_bounces):
                if last != 0:
                    self._on_state.advance(i, self._on_lift[i])

    @ti.func
    def remember(self, i):
        """At the end of a substep: add to each pair's slip what it has moved, as far as friction can hold it."""
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j = self._on_grid.near[e]
            overlap, n = self.touch(i, j, self.far(i, j))
            slip = 0 * self._on_state.x[i]
            if overlap > 0:
                slip = self.rub(i, j, n, overlap, self._on_grid.slip[e])
            self._on_grid.slip[e] = slip

    @ti.func
    def overlaps(self, i):
        """For the report: contacts of particle i with later ones, and the worst overlap in radii of the smaller."""
        touching, worst = 0, ti.cast(0, ti.f64)
        for e in range(self._on_grid.first[i], self._on_grid.first[i] + self._on_grid.number[i]):
            j = self._on_grid.near[e]
            if j > i:
                a, b = self._on_radius.of(i), self._on_radius.of(j)
                overlap, _ = self.touch(i, j, a + b)
                if overlap > 0:
                    small = ti.min(a, b)
                    if small == 0:
                        small = ti.max(a, b)
                    worst = ti.max(worst, overlap / small)
                    touching += 1
        return touching, worst
