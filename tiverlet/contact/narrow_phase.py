"""The narrow phase of discs and spheres: overlaps and normals of listed pairs."""

from typing import TYPE_CHECKING

import numpy as np

from ..device import inline, ti
from ..features.feature import Scene
from ..features.material import TOUCH, TOUCHES
from ..neighbours.pair_data import PairData
from ..neighbours.queries import Contacts, between

if TYPE_CHECKING:
    from ..neighbours.neighbour_search import NeighbourSearch

SAME_PLACE = 2.0**-80  # (distance / contact distance)^2 below which two particles count as in the same place


class DiscGeometry:
    """The geometry of pairs of discs or spheres: C(x) = |x_i - x_j| - (r_i + r_j), normal n = (x_i - x_j) / |x_i - x_j|.

    The normal points from j to i. search: the NeighbourSearch that lists the pairs. impulse: of listed pairs in the last substep
    [kg m]. given: along the normal, with impacts, where pairs bounce.
    """

    def __init__(self, scene: Scene, search: "NeighbourSearch", impulse: PairData | None = None, given: PairData | None = None):
        self.scene, self.search, self.list, self.impulse, self.given = scene, search, search.list, impulse, given
        self.state, self.radius, self.real, self.senses = scene.state, scene.radius, scene.real, search.table.senses

    @ti.func
    def contact_distance(self, i, j):
        """Return the distance at which particles i and j touch [m]."""
        return self.radius.of(i) + self.radius.of(j)

    @ti.func
    def pushes(self, i, j):
        """Return 1 if particles i and j push each other where they overlap, 0 if they do not, as for sensors."""
        if ti.static(self.senses):
            return ti.cast(ti.cast(self.search.table.of(i, j)[TOUCH], ti.i32) == TOUCHES, ti.i32)
        return 1

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

    @ti.func
    def touches(self, i, j, margin):
        """Whether particles i and j push each other, and are less than `margin` [m] from overlapping."""
        r, distance = self.state.separation(i, j), self.contact_distance(i, j) + margin
        return r.dot(r) < distance * distance and self.pushes(i, j) != 0

    @inline
    def pressed_particle(self, j):
        """Return the particle on which a disc presses that is next to particle j: j itself."""
        return j

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

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """Return the pairs that touch, of particles at x (n, dim) [m] after a substep h [s], for world.contacts."""
        assert self.impulse
        r = self.scene.particles.radius
        pairs, at = self.list.entries()
        push, across = self.list.read(self.impulse, at), np.zeros((len(pairs), x.shape[1]))
        if self.impulse.width:  # the whole impulse, on the side of its owner
            n = between(x[pairs[:, 0]], x[pairs[:, 1]], self.scene.periodic)
            n /= np.maximum(np.linalg.norm(n, axis=1), 1e-30)[:, None]
            along = (push * n).sum(axis=1)
            across, push = (push - along[:, None] * n) * np.sign(pairs[:, 1:] - pairs[:, :1]), np.abs(along)
        if self.given:
            push = self.list.read(self.given, at)
        # A static particle does not store its push, nor keep a far pair on its list. The other particle of the pair does.
        order = np.lexsort((push, pairs.max(axis=1), pairs.min(axis=1)))
        pairs, push, across = np.sort(pairs[order], axis=1), push[order], across[order]
        last = np.ones(len(pairs), dtype=bool)
        last[:-1] = (pairs[1:] != pairs[:-1]).any(axis=1)
        pairs, push, across = pairs[last], push[last], across[last]
        if self.senses:
            touch = self.search.table.pushing(self.scene.particles.group, pairs)
            pairs, push, across = pairs[touch], push[touch], across[touch]
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
        return Contacts(pairs, j, np.zeros(len(j)), overlap, normal, point, push[some] / h, across[some] / h)


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
