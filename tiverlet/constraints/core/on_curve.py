"""Places on a curve, on the device."""

from typing import TYPE_CHECKING

import numpy as np

from ...device import ti
from ...features.feature import FAR
from ...geometry.interpolation import interpolate
from .anchor_passes import AnchorPasses, Place

if TYPE_CHECKING:
    from ...features.feature import Scene
    from .curve import Curve

WALK = 64  # steps along the pieces of a path that a search takes at most


class OnCurve(Place):
    """Places of particles on a curve: the piece, and the distance along it.

    The curve and its particles are relative to the middle of the curve, where differences of places lose no digits: away from the
    origin they would be rounded to a digit of x, which is more than `least`, where a search ends.
    start: initial arc lengths, (m,). extent: of the curve [m]. target: of driven particles, speeds where it `moves`, else arc
    lengths; None where particles slide.
    """

    def __init__(
        self, scene: "Scene", passes: AnchorPasses, curve: "Curve", start: np.ndarray, target: np.ndarray | None, moves: bool,
        extent: float,
    ):  # fmt: skip
        dim, add, m = scene.particles.dim, scene.memory.field, len(start)
        self.name, self.corners = passes.name, passes.corners
        self.state, self.slots, self.real = scene.state, scene.slots, scene.real
        self.pieces, self.closed = len(curve.lengths), curve.closed
        middle = ((curve.a.min(axis=0) + curve.a.max(axis=0)) / 2).astype(np.float32).astype(np.float64)
        self.middle = add("Path.middle", 1, width=dim, values=middle[None])
        self.a, self.b, self.c, self.d = (
            add(f"Path.{name}", self.pieces, width=dim, values=v)
            for name, v in (("points", curve.a - middle), ("tangents", curve.b), ("second", curve.c), ("third", curve.d))
        )
        self.lengths = add("Path.lengths", self.pieces, values=curve.lengths)
        piece, rest = curve.split(start)
        self.piece = add("Path.piece", m, kind=ti.i32, values=piece, state=True, index_limit=self.pieces)
        self.rest = add("Path.rest", m, values=rest, state=True)
        self.in_state = {"piece": self.piece, "rest": self.rest}
        self.least = extent * (2.0**-22 if scene.real == ti.f32 else 2.0**-44)
        if target is None:
            self.tangent = add("Path.tangent", m, width=dim)
        else:
            self.moves = moves
            self.begin = add("Path.begin", self.pieces + 1, kind=ti.f64, values=curve.starts)
            self.source = add("Path.from", m, kind=ti.f64, values=start, state=True)
            self.target = add("Path.to", m, kind=ti.f64, values=target, state=True)
            self.in_state |= {"source": self.source, "target": self.target}

    @ti.func
    def position(self, i):
        """Return the position of particle i, with any low words, relative to the middle of the curve."""
        x = self.state.x[i] - self.middle[0]
        if ti.static(self.state.sums):
            x += self.state.low[i]
        return x

    @ti.func
    def point(self, k, r):
        """Return P and dP/dr on piece k."""
        b, c, d = self.b[k], self.c[k], self.d[k]
        return self.a[k] + r * (b + r * (c + r * d)), b + r * (2 * c + 3 * r * d)

    @ti.func
    def drive(self, c, h, frame_fraction):
        """Put the particle in its place."""
        s, length = self.source[c], self.begin[self.pieces]
        if ti.static(self.moves):
            s += self.target[c] * h
            self.source[c] = s
        else:
            s = interpolate(s, self.target[c], frame_fraction)
        if ti.static(self.closed):
            s -= ti.floor(s / length) * length
        else:
            s = ti.min(ti.max(s, 0), length)
        low, high = 0, self.pieces
        while high - low > 1:
            middle = (low + high) // 2
            if self.begin[middle] <= s:
                low = middle
            else:
                high = middle
        i = self.corners.member(c, 0)
        if ti.static(self.state.sums):
            P, T = self.point(low, s - self.begin[low])
            self.state.bring(i, ti.cast(self.middle[0], ti.f64) + P)
        else:
            P, T = self.point(low, ti.cast(s - self.begin[low], self.real))
            self.state.bring(i, self.middle[0] + P)

    @ti.func
    def find_nearest(self, x):
        """Return the piece nearest to x, and the distance along it, with pieces taken for straight lines."""
        best, piece, rest = ti.cast(ti.math.inf, self.real), 0, 0 * x[0]
        for k in range(self.pieces):
            a, end = self.a[k], self.point(k, self.lengths[k])[0]
            along = end - a
            u = ti.min(ti.max((x - a).dot(along) / along.dot(along), 0), 1)
            far = (x - a - u * along).norm_sqr()
            if far < best:
                best, piece, rest = far, k, u * self.lengths[k]
        return piece, rest

    @ti.func
    def find_foot(self, k, r, x, t, across):
        """Return where the plane through x normal to t meets the curve, or with `across` False the point nearest to x.

        The search starts at distance r along piece k. Also returns whether the curve turned away from t by more than 41 degrees,
        or the search was too long.
        """
        going, bent, previous = True, False, -1
        for _ in range(WALK):
            if going:
                P, T = self.point(k, r)
                n, length = T, self.lengths[k]
                if across:
                    n = t
                    bent = T.dot(t) < 0.75 * T.norm()
                step = (x - P).dot(n) / T.dot(n)
                if bent:
                    going = False
                elif r + step > length:
                    ahead = k + 1 if k + 1 < self.pieces else 0
                    if ahead == previous or (ti.static(not self.closed) and ahead == 0):
                        r, going = length, False
                    else:
                        previous, k, r = k, ahead, 0 * r
                elif r + step < 0:
                    ahead = k - 1 if k > 0 else self.pieces - 1
                    if ahead == previous or (ti.static(not self.closed) and k == 0):
                        r, going = 0 * r, False
                    else:
                        previous, k, r = k, ahead, self.lengths[ahead]
                else:
                    r, previous, going = r + step, -1, ti.abs(step) > self.least
        return k, r, bent or going

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """Return x - P across the curve, with P where the plane across it meets it; at an end or a bend, the nearest point."""
        i = self.corners.member(c, 0)
        x, t, C0 = self.position(i), self.tangent[c], ti.Vector.zero(self.real, self.state.dim)
        k, r = self.piece[c], self.rest[c]
        if first != 0:
            start = x - self.state.d[i]
            if fresh != 0:
                k, r = self.find_nearest(start)
            k, r, lost = self.find_foot(k, r, start, t, False)
            self.piece[c], self.rest[c] = k, r
            P, T = self.point(k, r)
            t, C0 = T / T.norm(), start - P
            self.tangent[c] = t
        k, r, bent = self.find_foot(k, r, x, t, True)
        if bent:
            k, r, lost = self.find_foot(self.piece[c], self.rest[c], x, t, False)
            self.slots.record_turn(FAR)
        P, T = self.point(k, r)
        C = x - P
        ends = ti.static(not self.closed) and ((k == 0 and r <= 0) or (k == self.pieces - 1 and r >= self.lengths[k]))
        if not (bent or ends):
            C -= C.dot(t) * t
        return C, C0

    @ti.func
    def offset_now(self, c, back):
        """Return the offset from the nearest point."""
        i = self.corners.member(c, 0)
        x = self.position(i) - back * self.state.d[i]
        k, r, lost = self.find_foot(self.piece[c], self.rest[c], x, x, False)
        P, T = self.point(k, r)
        return x - P

    @ti.func
    def offset_change(self, c):
        """Return the part of the displacement across the curve."""
        d, t = self.state.d[self.corners.member(c, 0)], self.tangent[c]
        return d - d.dot(t) * t
