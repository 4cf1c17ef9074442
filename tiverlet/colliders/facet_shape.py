"""Facets on the device."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice
from ..features.feature import Scene
from .facet_grid import FacetGrid
from .shape import Shape
from .surface import TOUCH

if TYPE_CHECKING:
    from .facets import Facets

FAR = 1e15  # [m] the distance of a facet that another one hides
NEWTON = 16  # steps to the time of a touch; only grazing paths need more than 3


class FacetShape(Shape):
    """Facets on the device: C(x) = dist(x, facets) - (R + r) >= 0 with R the thickness that is added to them.

    grad C is the direction from the nearest point.

    The distance to one facet is convex along a straight path, so Newton's method from its start converges to the time of the
    touch without overshooting. A facet that is touched at a corner or an edge counts only where no neighbour is nearer. That is
    tested with the directions (`wings`) in which the neighbours continue, so that nothing catches on the seams of a flat surface.

    low, high: corners of the box around the facets. shape: cells of the grid along each axis.
    """

    close: Any = OnDevice()  # rounding of the largest coordinate [m]
    touch: Any = OnDevice()  # distance at which a start counts as on the surface [m]
    reach: Any = OnDevice()  # distance within which lists are complete [m]
    cell: Any = OnDevice()  # size of a cell [m]
    pieces: Any = OnDevice()  # most cells on a way
    all: Any = OnDevice()  # the bucket that holds all facets, for particles that start deep inside

    def __init__(self, facets: "Facets", scene: Scene, name: str, radius: float):
        corners, features, wings, facing = facets.corners, facets.features, facets.wings, facets.facing
        self.dim, self.closed, self.columns, self.real = corners.shape[1], facets.closed, features.shape[1], scene.real
        size, number, real = float(np.abs(corners).max()), scene.memory.number, scene.real
        self.close = number(size * (2.0**-21 if scene.real == ti.f32 else 2.0**-50), real)
        self.touch = number(TOUCH * size, real)
        self.tilt, self.slight = (2.0**-18, 2.0**-20) if scene.real == ti.f32 else (2.0**-40, 2.0**-48)
        buckets = FacetGrid(corners, float(scene.particles.radius.max(initial=0.0)) + radius, self.closed)
        self.reach, self.cell = number(buckets.reach, real), number(buckets.cell, real)
        self.shape = [number(int(cells)) for cells in buckets.shape]
        self.low, self.high = (
            [number(float(v), real) for v in end] for end in (corners.min(axis=(0, 1)), corners.max(axis=(0, 1)))
        )
        self.pieces, self.all = number(4 * int(buckets.shape.sum()) + 64), number(len(buckets.begin) - 2)
        self.beyond = self.closed and facets.inside
        order = np.argsort(wings[0], kind="stable")
        begin = np.searchsorted(wings[0][order], np.arange(len(facing) + 1))
        add = scene.memory.field
        self.points = add(f"{name}.corner", len(corners) * self.dim, width=self.dim, values=corners.reshape(-1, self.dim))
        self.normal = add(f"{name}.normal", len(corners), width=self.dim, values=facets.normals)
        self.feature = add(f"{name}.feature", features.size, kind=ti.i32, values=features.ravel())
        self.facing = add(f"{name}.facing", len(facing), width=self.dim, values=facing)
        self.wing = add(f"{name}.wing", len(order), width=self.dim, values=wings[1][order])
        self.wing_begin = add(f"{name}.wing_begin", len(begin), kind=ti.i32, values=begin)
        self.bucket = add(f"{name}.bucket", len(buckets.bucket), kind=ti.i32, values=buckets.bucket)
        self.begin = add(f"{name}.begin", len(buckets.begin), kind=ti.i32, values=buckets.begin)
        self.list = add(f"{name}.list", len(buckets.list), kind=ti.i32, values=buckets.list)

    @ti.func
    def corner(self, f, k):
        """Return corner k of facet f."""
        return self.points[f * self.dim + k]

    @ti.func
    def nearest(self, f, q):
        """Return the distance from facet f to q, its direction, and the feature nearest to q; -1 for the inside of the facet."""
        n = self.normal[f]
        r, at, over = q - self.corner(f, 0), -1, True
        least = r.dot(r)
        for k in range(ti.static(1 if self.dim == 2 else 3)):
            a = self.corner(f, k)
            u, v = self.corner(f, (k + 1) % self.dim) - a, q - a
            t, uu = v.dot(u), u.dot(u)
            if ti.static(self.dim == 2):
                over = 0 < t < uu
            elif v.dot(n.cross(u)) < 0:
                over = False
            v -= ti.min(ti.max(t / uu, 0), 1) * u
            if k == 0 or v.dot(v) < least:
                least, r, at = v.dot(v), v, self.dim + k
                if t <= 0:
                    at = k
                elif t >= uu:
                    at = (k + 1) % self.dim
        if over:
            r, at = q - self.corner(f, 0), -1
        height = r.dot(n)
        distance = ti.abs(height)
        if at >= 0:
            distance = r.norm()
            at = self.feature[f * ti.static(self.columns) + at]
            if distance > 0:
                n = r / distance
        elif height < 0:
            n = -n
        return distance, n, at

    @ti.func
    def around(self, q):
        """Return begin and end of the list of the facets around q, and the distance from q within which there are no others."""
        low, high, reach, size = self.vector(self.low), self.vector(self.high), self.reach, self.cell
        off = ti.max(low - q, q - high)
        clear = off[0]
        for k in ti.static(range(1, self.dim)):
            clear = ti.max(clear, off[k])
        bucket = -1
        if clear < reach:
            cell = ti.floor((q - low + reach) / size, ti.i32)
            where = 0
            for k in ti.static(range(self.dim - 1, -1, -1)):
                where = where * self.shape[k].now + ti.min(ti.max(cell[k], 0), self.shape[k].now - 1)
            bucket = self.bucket[where]
            clear = reach
            if bucket < 0:
                clear += (-1 - bucket) * size
        elif ti.static(self.beyond):
            bucket = self.all
        begin, end = 0, 0
        if bucket >= 0:
            begin, end = self.begin[bucket], self.begin[bucket + 1]
        return begin, end, clear

    @ti.func
    def vector(self, numbers: ti.template()):  # type: ignore[valid-type]
        """Return a vector of Numbers."""
        return ti.Vector([number.now for number in ti.static(numbers)])

    @ti.func
    def facets_near(self, q, reach):
        """Return the list of the cell of q, or of all facets where it may be too short."""
        begin, end, clear = self.around(q)
        if begin == end and clear <= reach or begin < end and self.reach < reach:
            begin, end = self.begin[self.all], self.begin[self.all + 1]
        return begin, end

    @ti.func
    def facet_gap(self, f, q, e, contact_distance, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap at q to facet f, the normal and the curvature. Beside the facet it is round about its corners."""
        distance, n, at = self.nearest(f, q)
        bend, hidden = 0 * distance, False
        if ti.static(self.closed and at_start):
            if n.dot(self.normal[f]) < 0:  # q is behind it: on its way out, or on the other side of a thin solid
                hidden = self.has_nearer(q, distance)
        if at < 0:
            if ti.static(self.closed):
                if n.dot(self.normal[f]) < 0:
                    distance, n = -distance, -n
        else:
            bend = 1 / ti.max(distance, self.touch)
            hidden = hidden or not self.is_nearest_feature(at, n)
            if ti.static(self.closed):
                hidden = hidden or n.dot(self.facing[at]) < 0
        if hidden:
            distance = ti.cast(FAR, self.real)
        return distance - contact_distance, n, bend

    @ti.func
    def has_nearer(self, q, distance):
        """Whether any facet is nearer to q than this distance."""
        out = False
        begin, end = self.facets_near(q, distance)
        for place in range(begin, end):
            another, _n, _at = self.nearest(self.list[place], q)
            if another < distance:
                out = True
        return out

    @ti.func
    def box(self):
        """Return the corners of the box around the facets."""
        return self.vector(self.low), self.vector(self.high)

    @ti.func
    def rounding(self, q):
        """Return the rounding of the largest coordinate of the corners."""
        return self.close

    @ti.func
    def find_first_touch(self, a, e, contact_distance, close, limit):
        """See Shape.find_first_touch(). From inside of a closed shape, the nearest facet lets the particle out."""
        way, s, piece, on = e.norm(), 0 * contact_distance, 0, ti.max(self.touch, 4 * close)
        best, depth, normal = 0 * contact_distance + 2, 0 * contact_distance, 0 * e
        least, outside, exit = contact_distance + way + 1, 0 * contact_distance + 1, 0 * e
        while s < 1 and s < best and piece < self.pieces:
            begin, end, clear = self.around(a + s * e)
            for place in range(begin, end):
                f, t, going = self.list[place], 0 * contact_distance, True
                for k in range(NEWTON):
                    if going:
                        distance, n, at = self.nearest(f, a + t * e)
                        out = self.normal[f]
                        if at >= 0:
                            out = self.facing[at]
                        side = n.dot(out)
                        if ti.static(self.closed):
                            if k == 0 and piece == 0 and distance < least:
                                least, outside, exit = distance, side, -n
                            on_it = distance <= self.touch
                            if not on_it and distance <= on:
                                on_it = at < 0 or not self.is_nearest_feature(at, self.normal[f])
                            if on_it:
                                # On the surface, within the particle's rounding, each touched facet uses its own normal.
                                # At a corner that holds only where neighbours rise in front of it: the particle may lie on them.
                                distance, n, at = ti.select(side < 0, -distance, distance), self.normal[f], -1
                        gap, slope = distance - contact_distance, e.dot(n)
                        if gap <= close or k == NEWTON - 1:
                            going = False
                            below = -(gap + (1 - t) * slope)
                            toward = slope < -ti.cast(self.slight, self.real) * way
                            hit = toward and t > 0 and below > 0
                            if t == 0:
                                if toward:
                                    below = ti.max(below, ti.min(-slope, close))
                                behind = ti.static(self.closed) and side < 0 and at < 0 and distance > 0
                                hit = not behind and (toward or ti.min(below, limit - slope) > 2 * close)
                            if hit and (t < best or (t == best and below > depth)):
                                if self.is_nearest_feature(at, n):
                                    best, depth, normal = t, below, n
                        elif slope < 0:
                            t -= gap / slope
                            going = t <= 1
                        else:
                            going = False
            s += (clear - contact_distance) / way
            piece += 1
        if ti.static(self.closed):
            if outside < 0 and least > on:
                below = contact_distance + least - e.dot(exit)
                best = 0 * contact_distance + 2
                if ti.min(below, limit - e.dot(exit)) > 2 * close:
                    best, depth, normal = 0 * contact_distance, below, exit
        return best, depth, normal

    @ti.func
    def is_nearest_feature(self, at, n):
        """Whether no neighbour of a feature is nearer in the direction n."""
        out = True
        if at >= 0:
            for k in range(self.wing_begin[at], self.wing_begin[at + 1]):
                if n.dot(self.wing[k]) > self.tilt:
                    out = False
        return out
