"""The narrow phase of discs and spheres: overlaps and normals of listed pairs."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from ..features.feature import Scene
from ..features.material import TOUCH, TOUCHES
from ..neighbours.neighbour_list import PairData
from ..neighbours.queries import Contacts, between
from .candidates import DiscCandidates

if TYPE_CHECKING:
    from ..neighbours.neighbour_search import NeighbourSearch

SHRUNK = "Contact.shrunk"  # the field of how much smaller each particle is than its radius [m]
BARELY = 2.0**-100  # [m] by which a particle shrinks that is to keep its size
HELD = "Contact.held"  # the field of by how much each particle shrinks in the coming substep, instead of growing [m]
SLOWER = "Contact.slower"  # the field of how much slower than at push_out pairs of each shrunk particle part [m/s]
NONE = -2.0  # in near_contact(): the place on an edge where there is no contact
SAME_PLACE = 2.0**-80  # (distance / contact distance)^2 below which two particles count as in the same place


class DiscGeometry:
    """The geometry of pairs of discs or spheres: C(x) = |x_i - x_j| - (r_i + r_j), normal n = (x_i - x_j) / |x_i - x_j|.

    The normal points from j to i. Particles that the user put into each other shrink for a while, and grow back at push_out
    [m/s], or more slowly: see parting_speeds(), and overlap_release.shrink_left(). search: the NeighbourSearch that lists the
    pairs. impulse: the pushes of listed pairs in the last substep [kg m].
    """

    push_out: Any = OnDevice()
    late = (SHRUNK, SLOWER, HELD)

    def __init__(
        self, scene: Scene, search: "NeighbourSearch", push_out: float = 0.0, impulse: PairData | None = None,
    ):  # fmt: skip
        self.scene, self.search, self.list, self.impulse = scene, search, search.list, impulse
        self.push_out = scene.memory.number(push_out, scene.real)
        self.state, self.radius, self.real = scene.state, scene.radius, scene.real
        self.shrinks, self.store, self.senses = False, None, search.table.senses

    @ti.func
    def contact_distance(self, i, j):
        """Return the distance at which particles i and j touch [m]."""
        contact_distance = self.radius.of(i) + self.radius.of(j)
        if ti.static(self.shrinks):
            contact_distance = ti.max(contact_distance - (self.shrunk[i] + self.shrunk[j]), 0)  # rounding may make it negative
        return contact_distance

    @ti.func
    def pushes(self, i, j):
        """Return 1 if particles i and j push each other where they overlap, 0 if they do not, as for sensors."""
        out = 1
        if ti.static(self.senses):
            out = ti.cast(ti.cast(self.search.table.of(i, j)[TOUCH], ti.i32) == TOUCHES, ti.i32)
        return out

    @ti.func
    def depth(self, i, j, contact_distance):
        """Return the overlap of a pair that touches at `contact_distance` [m], without the normal; negative where apart."""
        r = self.state.separation(i, j)
        rr = r.dot(r)
        overlap = 0 * contact_distance - 1
        if rr < contact_distance * contact_distance:
            overlap = contact_distance
            if rr > contact_distance * contact_distance * ti.static(SAME_PLACE):
                overlap = contact_distance - ti.sqrt(rr)
        return overlap

    @ti.func
    def overlap(self, i, j, contact_distance):
        """Return the overlap [m] of a pair that touches at `contact_distance` [m], negative where apart, and its normal."""
        r = self.state.separation(i, j)
        rr = r.dot(r)
        overlap, n = 0 * contact_distance - 1, 0 * r
        if rr < contact_distance * contact_distance:
            if rr > contact_distance * contact_distance * ti.static(SAME_PLACE):
                length = ti.sqrt(rr)
                overlap, n = contact_distance - length, r / length
            else:
                overlap, n = contact_distance, self.fallback_normal(i, j, r)
        return overlap, n

    @ti.func
    def gap(self, i, j):
        """Return the (negative) overlap of a pair that is apart [m], and its normal."""
        r = self.state.separation(i, j)
        length = r.norm()
        return self.contact_distance(i, j) - length, r / length

    @ti.func
    def direction(self, i, j):
        """Return the normal of a pair that may be apart, 0 in the same place."""
        r = self.state.separation(i, j)
        length = r.norm()
        n = 0 * r
        if length > 0:
            n = r / length
        return n

    @ti.func
    def impact(self, i, j, contact_distance, shared, bears):
        """Return the overlap [m], 1 / shared, the normal, and the distance of a touching pair where its push acts [m].

        shared: m_i w_i + m_j w_j. bears: whether the pair bears a load, from the last substep. Spin needs the distance.

        A pair that came together in this substep has the normal of the time of impact: |r0 + s d| = contact_distance, with r0 at
        the start of the substep and d the relative displacement. The rest of d along n is the overlap. This is exact for free
        flight; the normal at the end would be off by the distance that the pair slides.

        A pair that touched before has the normal at the start, as a rigid link has. With d_(n+1) = d_n + p and x_(n+1) = x_n +
        d_(n+1), sum m x x d changes by sum m x_n x p, which is 0 for pushes along r0. So angular momentum is conserved to
        rounding, and sliding or rolling on another particle is second order. With normals at the end, a load would accelerate
        sliding particles: seven discs drawn to a point would double their angular momentum in 20 s at 20 substeps. A particle
        that slides on a straight path ends a little above the other one, so a pair that bears a load counts as touching, too.
        """
        r = self.state.separation(i, j)
        d = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j)
        start, rr = r - d, r.dot(r)
        before, near = start.dot(start), contact_distance * contact_distance * ti.static(SAME_PLACE)
        c = before - contact_distance * contact_distance
        overlap, each, n, reach = contact_distance - ti.sqrt(rr), 1 / shared, r, contact_distance
        if (c <= 0 or bears) and before > near:
            reach = ti.sqrt(before)
            n = start / reach  # next to 1 / shared: the compiler can do both in one division of a vector
        else:
            a, b = d.dot(d), start.dot(d)
            root = ti.sqrt(ti.max(b * b - a * c, 0)) - b
            if c > 0 and b < 0 and root > 0:
                s = ti.min(c / root, 1)
                n = (start + s * d) / contact_distance
                overlap = ti.max((s - 1) * d.dot(n), 0)
            elif rr > near:
                n = r / ti.sqrt(rr)
            else:
                overlap, n = contact_distance, self.fallback_normal(i, j, r)
        return overlap, each, n, reach

    @ti.func
    def fallback_normal(self, i, j, r):
        """Return a normal for two particles in the same place: opposite for (j, i), different for other pairs."""
        low, high = ti.cast(ti.min(i, j), ti.u32), ti.cast(ti.max(i, j), ti.u32)
        mixed = (low * ti.u32(2654435769)) ^ ((high + ti.u32(1)) * ti.u32(2246822519))
        n = 0 * r
        n[0], n[1] = self.on_circle(mixed * ti.u32(2654435769))
        if ti.static(self.state.dim == 3):
            z = self.fraction(mixed * ti.u32(3242174889))
            n *= ti.sqrt(1 - z * z)
            n[2] = z
        if i > j:
            n = -n
        return n

    @ti.func
    def on_circle(self, bits):
        """Return a point of the unit circle, (1 - t^2, 2 t) / (1 + t^2) on its right half for t in (-1, 1), or the opposite one.

        A cosine would have other bits on other machines, and some GPUs have no cosine in f64.
        """
        t = self.fraction(bits << ti.u32(1))
        per = (1 - 2 * ti.cast(bits >> ti.u32(31), ti.i32)) / (1 + t * t)
        return (1 - t * t) * per, 2 * t * per

    @ti.func
    def fraction(self, bits):
        """Return a number in (-1, 1): an odd multiple of 2^-23, which f32 can hold."""
        return ti.cast(2 * ti.cast(bits >> ti.u32(9), ti.i32) + 1 - 2**23, self.real) * ti.static(2.0**-23)

    @ti.func
    def overshoots(self, i):
        """Return 1 if particle i moves by more than its own size in one substep, or by NaN."""
        d, limit = self.state.d[i], self.radius.stride(i)
        return ti.select(d.dot(d) <= limit * limit, 0, 1)

    def enable_shrink(self) -> None:
        """Prepare for shrink(): declare the fields of shrunk radii, which exist only once they are needed."""
        if not self.shrinks:
            self.store = self.scene.memory.make_companion()
            self.shrunk = self.store.field(SHRUNK, self.scene.count, state=True)
            self.slower = self.store.field(SLOWER, self.scene.count, state=True)
            self.held = self.store.field(HELD, self.scene.count, state=True)
            self.store.place()
            self.shrinks = True

    @ti.func
    def shrink(self, i, first, speed):
        """Shrink particle i to remove its overlap with particles of index `first` or more, shared in proportion to the radii.

        Pairs then part at `speed` [m/s], or at push_out if that is less.
        """
        before = ti.select(first > 0, self.shrunk[i], ti.cast(0, self.real))
        less = before
        for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
            j = self.list.neighbour[e]
            if ti.max(i, j) >= first and self.pushes(i, j) != 0:
                contact_distance = self.radius.of(i) + self.radius.of(j)
                overlap, _ = self.overlap(i, j, contact_distance)
                less = ti.max(less, overlap * self.radius.of(i) / contact_distance)
        self.shrunk[i] = less
        if less > before:
            self.slower[i] = ti.max(self.push_out - speed, 0)
        elif less == 0:
            self.slower[i] = 0

    @ti.func
    def restore(self, i, h):
        """Let particle i grow back for a substep h [s], at push_out / 2 or more slowly: both particles of a pair grow."""
        if ti.static(self.shrinks):
            if self.shrunk[i] > 0:
                less = self.held[i]
                if not self.is_held(i):
                    less = -(self.push_out - self.slower[i]) * h / 2
                self.shrunk[i] = ti.max(self.shrunk[i] + less, 0)
            if self.shrunk[i] == 0:
                self.slower[i] = 0

    @ti.func
    def is_held(self, i):
        """Whether particle i must not grow, see excess(); one that cannot move, and is not asked, if any near it must not."""
        out = self.held[i] != 0
        if not self.state.w.positive(i):
            for e in range(self.list.first[i], self.list.first[i] + self.list.number[i]):
                out = out or self.held[self.list.neighbour[e]] != 0
        return out

    @ti.func
    def excess(self, i, j, n, overlap, h):
        """Return by how much particle i is to shrink again because it moves faster than push_out relative to j, BARELY or more.

        0 where it is not so fast. Where they part it is the share of i in their overlap, so that j pushes it no more. A particle
        between two others moves d / y times as fast as their contact distance d grows, where it is y away from the line between
        them. Without a limit it would be shot out, the faster the shorter the substep.
        """
        d, most = self.state.relative_displacement(self.state.d[i] - self.state.d[j], i, j), self.push_out * h
        out = 0 * overlap
        if overlap > 0 and d.dot(d) > most * most:
            out += ti.static(BARELY)
            if d.dot(n) > 0:
                out = overlap
                if self.state.w.positive(j):
                    out *= self.radius.of(i) / (self.radius.of(i) + self.radius.of(j))
        return out

    @ti.func
    def is_shrunk(self, i):
        """Whether particle i is smaller than its radius for a while."""
        out = False
        if ti.static(self.shrinks):
            out = self.shrunk[i] > 0
        return out

    @ti.func
    def push_each_other(self, i, j, margin):
        """Whether particles i and j push each other, and are less than `margin` [m] from overlapping."""
        r, distance = self.state.separation(i, j), self.contact_distance(i, j) + margin
        return r.dot(r) < distance * distance and self.pushes(i, j) != 0

    @ti.func
    def near_contact(self, i, e, near):
        """Return the place of the pair at entry e of the list of i, the normal, and the gap [m].

        The place is 0, or NONE if the gap is wider than the part `near` of the distance at which the pair touches.
        """
        j = self.list.neighbour[e]
        distance = self.contact_distance(i, j)
        is_near = self.push_each_other(i, j, near * distance)
        gap = self.state.separation(i, j).norm() - distance
        return ti.select(is_near, 0 * gap, NONE), self.direction(i, j), gap

    @ti.func
    def ends(self, i, e, t):
        """Return the particles of the pair at entry e of the list of i as those of a contact: i, and twice the other one."""
        j = self.list.neighbour[e]
        return i, j, j

    @ti.func
    def entry_of(self, i, e, role):
        """Return the entry that stores the pair at entry e of the list of particle i: e itself."""
        return e

    @ti.func
    def part_of(self, t, role):
        """Return the part of particle i in a pair: 1."""
        return 1 + 0 * t

    @ti.func
    def relative(self, d: ti.template(), v, a, b, t):  # type: ignore[valid-type]
        """Return the displacement of particle v relative to a [m]."""
        return self.state.relative_displacement(d[v] - d[a], v, a)

    @ti.func
    def add_push(self, e, push):
        """Do nothing: a pair does not keep the push of an impact of bodies."""

    @ti.func
    def worst_overlap(self, i):
        """Return the number of contacts of i with particles j > i, and their worst overlap in radii of the smaller particle."""
        touching, worst = 0, ti.cast(0, self.real)
        number = self.list.number[i]
        last = self.list.first[i] + number - 1
        for k in range(number):
            j = self.list.neighbour[last - k]
            if j < i:  # the list is sorted: so are the rest
                break
            a, b, r = self.radius.of(i), self.radius.of(j), self.state.separation(i, j)
            small = ti.select(ti.min(a, b) > 0, ti.min(a, b), ti.max(a, b))
            overlap = ((a + b) * self.pushes(i, j) - ti.sqrt(r.dot(r))) / small
            # No branch: half of the listed pairs are apart.
            touching += ti.cast(overlap > 0, ti.i32)
            worst = ti.select(overlap > worst, overlap, worst)
        return touching, ti.cast(worst, ti.f64)

    def members(self, pairs: np.ndarray) -> np.ndarray:
        """Return the particles of the contacts of these listed pairs (m, 2)."""
        return pairs

    def gradients(self, x: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Return the normal of each listed pair (m, 2) at x (n, dim) [m], and 0 for its second particle, which lists it, too."""
        r = between(x[pairs[:, 0]], x[pairs[:, 1]], self.scene.periodic)
        length = np.linalg.norm(r, axis=1)
        n = r * np.divide(1, length, out=np.zeros_like(length), where=length > 0)[:, None]
        return np.stack([n, 0 * n], axis=1)

    def candidates(self, x: np.ndarray) -> DiscCandidates:
        """Return the listed pairs as possible contacts around positions x (n, dim) [m], for the host."""
        particles, (pairs, _) = self.scene.particles, self.list.entries()
        some = (pairs[:, 0] < pairs[:, 1]) | (self.scene.inv_mass[pairs[:, 1]] == 0)
        who = pairs[some & self.search.table.pushing(particles.group, pairs)]
        radius = particles.radius.copy()
        if self.store:
            radius -= self.store.read(self.shrunk)[: len(radius)]
        return DiscCandidates(who, radius[who].sum(axis=1), self.scene.periodic)

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """Return the pairs that touch, of particles at x (n, dim) [m] after a substep h [s], for world.contacts."""
        assert self.impulse
        r = self.scene.particles.radius
        pairs, at = self.list.entries()
        push = self.list.read(self.impulse, at)
        if self.impulse.width:  # the whole impulse, on the side of its owner
            n = between(x[pairs[:, 0]], x[pairs[:, 1]], self.scene.periodic)
            push = np.abs((push * n).sum(axis=1)) / np.maximum(np.linalg.norm(n, axis=1), 1e-30)
        if self.search.has_static:
            # A static particle does not store its push, nor keep a far pair on its list. The other particle of the pair does.
            n = len(self.scene.particles)
            keys, which = np.unique(pairs.min(axis=1) * n + pairs.max(axis=1), return_inverse=True)
            pairs, most = np.stack(np.divmod(keys, n), axis=1), np.zeros(len(keys))
            np.maximum.at(most, which.ravel(), push)
            push = most
        else:
            low = pairs[:, 0] < pairs[:, 1]
            pairs, push = pairs[low], push[low]
        if self.senses:
            touch = self.search.table.pushing(self.scene.particles.group, pairs)
            pairs, push = pairs[touch], push[touch]
        d = between(x[pairs[:, 0]], x[pairs[:, 1]], self.scene.periodic)
        length = np.linalg.norm(d, axis=1)
        overlap = r[pairs].sum(axis=1) - length
        some = (overlap > 0) | (push > 0)
        pairs, overlap, j = pairs[some], overlap[some], pairs[some, 1]
        contact_distance, d, length = r[pairs].sum(axis=1), d[some], length[some]
        same = length**2 <= contact_distance**2 * SAME_PLACE
        normal = d / np.where(same, 1.0, length)[:, None]
        normal[same] = fallback_normals(pairs[same], d.shape[1])
        point = x[j] + (r[j] - overlap / 2)[:, None] * normal
        return Contacts(pairs, j, np.zeros(len(j)), overlap, normal, point, push[some] / h)


def fallback_normals(pairs: np.ndarray, dim: int) -> np.ndarray:
    """Return the normals of DiscGeometry.fallback_normal() for pairs i < j, (m, dim)."""

    def fraction(bits: np.ndarray) -> np.ndarray:
        """Turn bits into numbers between -1 and 1, never 0."""
        return (2.0 * (bits >> np.uint32(9)) + 1 - 2**23) * 2.0**-23

    low, high = pairs.astype(np.uint32).T
    mixed = (low * np.uint32(2654435769)) ^ ((high + np.uint32(1)) * np.uint32(2246822519))
    bits = mixed * np.uint32(2654435769)
    t, side = fraction(bits << np.uint32(1)), 1 - 2.0 * (bits >> np.uint32(31))
    n = np.stack([1 - t * t, 2 * t, 0 * t], axis=1)[:, :dim] * (side / (1 + t * t))[:, None]
    if dim == 3:
        z = fraction(mixed * np.uint32(3242174889))
        n *= np.sqrt(1 - z * z)[:, None]
        n[:, 2] = z
    return n
