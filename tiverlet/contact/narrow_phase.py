"""Which particles touch, how deep and in which direction."""

from typing import Any

import numpy as np

from ..device import ti
from ..device.memory import Memory
from ..features.feature import Feature
from ..neighbours.queries import Contacts


class Touch(Feature):
    """The geometry of pairs. Particles that the user put into each other may be smaller than they are, for a while."""

    push_out: Any

    @ti.func
    def far(self, i, j):
        """The distance at which particles i and j touch."""
        far = self.dev.radius.of(i) + self.dev.radius.of(j)
        if ti.static(self.dev.eases):
            far -= self.dev.less[i] + self.dev.less[j]
        return far

    @ti.func
    def depth(self, i, j, far):
        """The overlap alone."""
        r = self.dev.state.apart(i, j)
        rr = r.dot(r)
        overlap = 0 * far - 1
        if rr < far * far:
            overlap = far
            if rr > far * far * ti.static(2.0**-80):
                overlap = far - ti.sqrt(rr)
        return overlap

    @ti.func
    def touch(self, i, j, far):
        """Overlap [m] of a pair that touches at a distance `far` (negative where apart) and its direction, from j to i."""
        r = self.dev.state.apart(i, j)
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
    def steady(self, came, push):
        """How much of a push is a force, which acts before and after, and not a blow, which is over.

        A blow is no more than what stops a pair that came together by `came` in the substep before. It is the same for both of a
        pair, which keeps momentum.
        """
        return ti.max(1 - ti.select(push > 0, ti.max(came, 0) / push, ti.zero(push)) ** 2, 0)

    @ti.func
    def set_out(self, i, scale):
        """At the start of the last substep of a frame: keep the displacement of particle i, `scale` times what is kept there."""
        self.dev.before[i] = scale * self.dev.state.d[i]

    @ti.func
    def sum_up(self, i, bond, first):
        """Keep what forces of a pass moved particle i by in the last substep of a frame, for its velocity."""
        if first != 0:
            self.dev.bond[i] = bond
        else:
            self.dev.bond[i] = self.dev.bond[i] + bond

    @ti.func
    def push_bond(self, i):
        """At the end of a frame: what pushes that are forces moved particle i by, where that is not known from the passes."""

    @ti.func
    def bond(self, i):
        """What forces moved particle i by in the last substep of a frame."""
        return self.dev.bond[i]

    @ti.func
    def meet(self, i, j, far, shared):
        """Overlap, 1 / shared, and direction, as in touch(), of a pair that touches.

        A pair that came together in this substep has the direction that it had when it met: |r0 + s d| = far, with r0 at the
        start and d the relative displacement; what is left of d along n is the overlap. This is exact for free flight, where
        the direction at the end is off by the way that a pair slides past each other.
        """
        r = self.dev.state.apart(i, j)
        rr = r.dot(r)
        length = ti.sqrt(rr)
        per = 1 / (shared * length)  # of all that takes time, divisions take most
        overlap = far - length
        each, n = per * length, (per * shared) * r
        if rr <= far * far * ti.static(2.0**-80):
            overlap, n = far, self.part(i, j, r)
            each = 1 / shared
        d = self.dev.state.d[i] - self.dev.state.d[j]
        r -= d
        c = r.dot(r) - far * far
        if c > 0:
            a, b = d.dot(d), r.dot(d)
            root = ti.sqrt(ti.max(b * b - a * c, 0)) - b
            if b < 0 and root > 0:
                s = ti.min(c / root, 1)
                n = (r + s * d) / far
                overlap = ti.max((s - 1) * d.dot(n), 0)
        return overlap, each, n

    @ti.func
    def part(self, i, j, r):
        """A direction for two particles in the same place: opposite for (j, i), different for other pairs."""
        low, high = ti.cast(ti.min(i, j), ti.u32), ti.cast(ti.max(i, j), ti.u32)
        mixed = (low * ti.u32(2654435769)) ^ ((high + ti.u32(1)) * ti.u32(2246822519))
        n = 0 * r
        n[0], n[1] = self.around(mixed * ti.u32(2654435769))
        if ti.static(self.dev.state.dim == 3):
            z = self.fraction(mixed * ti.u32(3242174889))
            n *= ti.sqrt(1 - z * z)
            n[2] = z
        if i > j:
            n = -n
        return n

    @ti.func
    def around(self, bits):
        """A point of the unit circle: (1 - t^2, 2 t) / (1 + t^2), on its right half for t in (-1, 1), or the opposite one. A
        cosine has other bits elsewhere, and some GPUs have none of f64."""
        t = self.fraction(bits << ti.u32(1))
        per = (1 - 2 * ti.cast(bits >> ti.u32(31), ti.i32)) / (1 + t * t)
        return (1 - t * t) * per, 2 * t * per

    @ti.func
    def fraction(self, bits):
        """In (-1, 1): an odd multiple of 2^-23, which f32 can hold."""
        return ti.cast(2 * ti.cast(bits >> ti.u32(9), ti.i32) + 1 - 2**23, self.scene.real) * ti.static(2.0**-23)

    def ease(self) -> None:
        """From now on particles may be smaller than they are; the field for it exists only once it is needed."""
        if not self.dev.eases:
            self.dev.store = Memory(self.scene.real)
            self.dev.less = self.dev.store.field("Contact.shrunk", self.scene.particles.count, state=True)
            self.dev.store.place()
            self.dev.eases = True

    @ti.func
    def shrink(self, i, first):
        """Make particle i small enough: each pair with a particle from number `first` on gives up its overlap in proportion to
        the radii."""
        less = ti.select(first > 0, self.dev.less[i], ti.cast(0, self.scene.real))
        for e in range(self.dev.grid.first[i], self.dev.grid.first[i] + self.dev.grid.number[i]):
            j = self.dev.grid.near[e]
            if ti.max(i, j) >= first:
                far = self.dev.radius.of(i) + self.dev.radius.of(j)
                overlap, _ = self.touch(i, j, far)
                less = ti.max(less, overlap * self.dev.radius.of(i) / far)
        self.dev.less[i] = less

    @ti.func
    def grow(self, i, h):
        """Let particle i grow back."""
        if ti.static(self.dev.eases):
            self.dev.less[i] = ti.max(self.dev.less[i] - self.push_out * h / 2, 0)

    @ti.func
    def overlaps(self, i):
        """For the report: contacts of particle i with later ones, and the worst overlap in radii of the smaller."""
        touching, worst = 0, ti.cast(0, ti.f64)
        number = self.dev.grid.number[i]
        last = self.dev.grid.first[i] + number - 1
        for k in range(number):
            j = self.dev.grid.near[last - k]
            if j < i:  # and so are the rest
                break
            a, b = self.dev.radius.of(i), self.dev.radius.of(j)
            overlap = self.depth(i, j, a + b)
            if overlap > 0:
                small = ti.min(a, b)
                if small == 0:
                    small = ti.max(a, b)
                worst = ti.max(worst, overlap / small)
                touching += 1
        return touching, worst

    def found(self, x: np.ndarray, h: float) -> Contacts:
        """The pairs that touch, of particles at x (n, dim) [m], for world.contacts."""
        r = self.scene.particles.radius
        pairs, at = self.dev.grid.entries()
        push = self.dev.grid.read(self.dev.given if self.dev.bounces else self.dev.push, at)
        low = pairs[:, 0] < pairs[:, 1]
        if self.dev.grid.still:  # what is static does not keep what it gives: the other one of the pair does
            back = np.lexsort(pairs[~low].T)  # (j, i) in the order of (i, j)
            push[low] = np.maximum(push[low], push[~low][back])
        pairs, push = pairs[low], push[low]
        d = x[pairs[:, 0]] - x[pairs[:, 1]]
        length = np.linalg.norm(d, axis=1)
        overlap = r[pairs].sum(axis=1) - length
        some = (overlap > 0) | (push > 0)
        pairs, overlap, j = pairs[some], overlap[some], pairs[some, 1]
        far, d, length = r[pairs].sum(axis=1), d[some], length[some]
        same = length**2 <= far**2 * 2.0**-80
        normal = d / np.where(same, 1.0, length)[:, None]
        normal[same] = parting(pairs[same], d.shape[1])
        point = x[j] + (r[j] - overlap / 2)[:, None] * normal
        return Contacts(pairs, j, np.zeros(len(j)), overlap, normal, point, push[some] / h)


def parting(pairs: np.ndarray, dim: int) -> np.ndarray:
    """What Touch.part() returns for pairs i < j, (m, dim)."""

    def fraction(bits: np.ndarray) -> np.ndarray:
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
