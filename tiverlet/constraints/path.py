"""Beads on a wire."""

import warnings

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import ti
from ..features.feature import FAR, Knob, Scene
from ..particles import Particles
from .core.anchor_passes import AnchorPasses, Place
from .core.anchored import Anchored
from .core.curve import Curve

WALK = 64  # steps along the pieces of a path, at most, that a search takes


class OnCurve(Place):
    """Where particles are on a curve: the piece, and how far along it. start: their arc lengths at first, (m,). pace: of those
    that are driven, speeds, if they `move` on by themselves, or else arc lengths; None where they slide. extent: of the curve
    [m]."""

    def __init__(
        self, scene: Scene, passes: AnchorPasses, curve: Curve, start: np.ndarray, pace: np.ndarray | None, moves: bool,
        extent: float,
    ):  # fmt: skip
        dim, add, m = scene.particles.dim, scene.memory.field, len(start)
        self.name, self.state, self.slots, self.corners, self.real = (
            passes.name,
            scene.state,
            scene.slots,
            passes.corners,
            scene.real,
        )
        self.pieces, self.closed = len(curve.lengths), curve.closed
        self.a, self.b, self.c, self.d = (
            add(f"Path.{name}", self.pieces, width=dim, values=v)
            for name, v in (("points", curve.a), ("tangents", curve.b), ("second", curve.c), ("third", curve.d))
        )
        self.lengths = add("Path.lengths", self.pieces, values=curve.lengths)
        piece, rest = curve.split(start)
        self.piece = add("Path.piece", m, kind=ti.i32, values=piece, state=True, below=self.pieces)
        self.rest = add("Path.rest", m, values=rest, state=True)
        self.in_state = {"piece": self.piece, "rest": self.rest}
        self.least = extent * (2.0**-22 if scene.real == ti.f32 else 2.0**-44)
        if pace is None:
            self.tangent = add("Path.tangent", m, width=dim)
        else:
            self.moves = moves
            self.begin = add("Path.begin", self.pieces + 1, kind=ti.f64, values=curve.starts)
            self.source = add("Path.from", m, kind=ti.f64, values=start, state=True)
            self.target = add("Path.to", m, kind=ti.f64, values=pace, state=True)
            self.in_state |= {"source": self.source, "target": self.target}

    @ti.func
    def point(self, k, r):
        """P and dP/dr on piece k."""
        b, c, d = self.b[k], self.c[k], self.d[k]
        return self.a[k] + r * (b + r * (c + r * d)), b + r * (2 * c + 3 * r * d)

    @ti.func
    def drive(self, c, h, frame_fraction):
        """Put the particle where it is to be."""
        s, length = self.source[c], self.begin[self.pieces]
        if ti.static(self.moves):
            s += self.target[c] * h
            self.source[c] = s
        else:
            s = s * (1 - frame_fraction) + self.target[c] * frame_fraction
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
        P, T = self.point(low, ti.cast(s - self.begin[low], self.real))
        i = self.corners.member(c, 0)
        d = P - self.state.place(i)
        self.state.d[i] = d
        self.state.advance(i, d)

    @ti.func
    def search(self, x):
        """The piece nearest to x, and how far along it, as if it were straight."""
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
    def foot(self, k, r, x, t, across):
        """Where, from rest r on piece k on, the plane through x across t meets the curve; or else the point nearest to x.

        Also says whether the curve turned away from t by more than 41 degrees, or the way was too long.
        """
        going, bent, came = True, False, -1
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
                    if ahead == came or (ti.static(not self.closed) and ahead == 0):
                        r, going = length, False
                    else:
                        came, k, r = k, ahead, 0 * r
                elif r + step < 0:
                    ahead = k - 1 if k > 0 else self.pieces - 1
                    if ahead == came or (ti.static(not self.closed) and k == 0):
                        r, going = 0 * r, False
                    else:
                        came, k, r = k, ahead, self.lengths[ahead]
                else:
                    r, came, going = r + step, -1, ti.abs(step) > self.least
        return k, r, bent or going

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """Across the curve, from where the plane across it meets it; at an end or a bend, from the nearest point."""
        i = self.corners.member(c, 0)
        x, t, C0 = self.state.place(i), self.tangent[c], ti.Vector.zero(self.real, self.state.dim)
        k, r = self.piece[c], self.rest[c]
        if first != 0:
            start = x - self.state.d[i]
            if fresh != 0:
                k, r = self.search(start)
            k, r, lost = self.foot(k, r, start, t, False)
            self.piece[c], self.rest[c] = k, r
            P, T = self.point(k, r)
            t, C0 = T / T.norm(), start - P
            self.tangent[c] = t
        k, r, bent = self.foot(k, r, x, t, True)
        if bent:
            k, r, lost = self.foot(self.piece[c], self.rest[c], x, t, False)
            self.slots.note_turn(FAR)
        P, T = self.point(k, r)
        C = x - P
        ends = ti.static(not self.closed) and ((k == 0 and r <= 0) or (k == self.pieces - 1 and r >= self.lengths[k]))
        if not (bent or ends):
            C -= C.dot(t) * t
        return C, C0

    @ti.func
    def offset_now(self, c, back):
        """From the nearest point."""
        i = self.corners.member(c, 0)
        x = self.state.place(i) - back * self.state.d[i]
        k, r, lost = self.foot(self.piece[c], self.rest[c], x, x, False)
        P, T = self.point(k, r)
        return x - P

    @ti.func
    def offset_change(self, c):
        """What of the motion is across the curve."""
        d, t = self.state.d[self.corners.member(c, 0)], self.tangent[c]
        return d - d.dot(t) * t


class Path(Anchored):
    """Particles on a curve: free to slide without friction, or driven along it.

    C(x) = x - P(s), a vector across the curve. Free, s is where the plane across the curve at the start of the substep, through
    the predicted place, meets the curve: the force of the wire has no part along it (SHAKE). Second order, and energy is kept.
    Where the curve turns by more than 41 degrees in a substep the nearest point takes its place, and it is flagged. At the
    ends of an open curve particles stop.

    indices: (m,) particles. points: (k, dim) [m], along the curve. closed: from the last point back to the first.
    smooth: a cubic spline through the points, with continuous curvature; otherwise a polyline, with corners.
    speed: number or (m,) [m/s]; driven at this speed, positive in the order of the points. Live.
    at: number or (m,) [m]; driven to this arc length, evenly during each frame in which it changes. Live. Not with `speed`.
    compliance: number or (m,) [m/N], of a soft wire; damping: number or (m,) [N s/m], across it. Free particles only.

    `length` is that of the curve [m], `place(s)` its points, `load` the force of the wire on each particle [N].
    """

    each = ("compliance", "damping", "speed", "at")
    speed = Knob(lambda f, v: f._drive("speed", v), "Along the curve [m/s], (m,).")
    at = Knob(lambda f, v: f._drive("at", v), "Arc length at the end of the next frame [m].")

    def __init__(
        self, indices, points, *, closed: bool = False, smooth: bool = True, speed=None, at=None, compliance: ArrayLike = 0.0,
        damping: ArrayLike = 0.0,
    ):  # fmt: skip
        self.driver = "speed" if speed is not None else "at" if at is not None else ""
        self.setup(indices, compliance, damping)
        self.points = checks.points("Path", "points", points)
        self.points.flags.writeable = False
        if len(self.points) < (3 if closed else 2):
            raise ValueError(f"Path: {len(self.points)} points make no {'closed' if closed else 'open'} curve.")
        steps = np.linalg.norm(np.diff(self.points, axis=0, append=self.points[:1]), axis=1)
        if (steps[: None if closed else -1] == 0).any():
            k = int(np.argmin(steps))
            raise ValueError(f"Path: points[{k}] and the next are the same, {tuple(map(float, self.points[k]))}; leave one out.")
        self.curve = Curve(self.points, bool(closed), bool(smooth))
        if speed is not None and at is not None:
            raise ValueError("Path: speed and at exclude each other; give one of them, or none for free particles.")
        if speed is not None:
            self.speed = speed
        if at is not None:
            self.at = at

    @property
    def drives(self) -> bool:
        """Whether the particles are driven."""
        return bool(self.driver)

    def _drive(self, name: str, value) -> np.ndarray:
        if name != self.driver:
            how = f"driven by {self.driver}" if self.driver else "free to slide"
            raise ValueError(f"Path: {name} cannot be set: these particles are {how}. Make a Path with {name}=... for them.")
        return checks.per_item("Path", name, value, self.count)

    def _compliance(self, value) -> np.ndarray:
        value = super()._compliance(value)
        if self.drives and (value > 0).any():
            raise ValueError("Path: driven particles take no compliance; they go along whatever pulls at them.")
        return value

    exclusive = drives

    @property
    def length(self) -> float:
        """Length of the curve [m]."""
        return self.curve.length

    def place(self, s) -> np.ndarray:
        """Points of the curve at arc lengths s [m]."""
        return self.curve.at(s)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Driven particles cannot be moved by anything else."""
        super().prepare(particles, inv_mass)
        checks.points("Path", "points", self.points, dim=particles.dim)
        rows = self.indices[:, 0]
        self._start = self.curve.nearest(particles.position[rows])
        if self.drives:
            inv_mass[rows] = 0.0

    def review(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Warn of particles that are not on the curve."""
        x = particles.position[self.indices[:, 0]]
        off = np.linalg.norm(x - self.curve.at(self._start), axis=1)
        if not self.drives and not self.soft and (off > 1e-2 * self.length).any():
            k = int(np.argmax(off))
            at = tuple(round(float(v), 6) for v in self.curve.at(self._start[k]))
            warnings.warn(
                f"Path: particle {self.indices[k, 0]} starts {off[k]:.3g} m off the curve, which throws it. Start at {at}.",
                stacklevel=3,
            )

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """C at the start."""
        return position[self.indices[:, 0]] - self.curve.at(self._start)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """The curve, for pictures."""
        return self.curve.at(np.linspace(0, self.length * (1 - 1e-12), 4 * len(self.curve.lengths) + 1))[None], 0.0

    def place_of(self, scene: Scene, passes: AnchorPasses) -> "OnCurve":
        """Where each is on the curve."""
        extent, moves = float(np.ptp(self.points, axis=0).max()), "speed" in self.__dict__
        pace = None if not self.drives else self.speed if moves else self._start
        return OnCurve(scene, passes, self.curve, self._start, pace, moves, extent)

    def upload(self) -> None:
        """Take the new speed, or aim at the new arc lengths."""
        super().upload()
        if self.acts and self.drives:
            self.scene.memory.write(self.dev.place.target, self.speed if self.dev.place.moves else self.at)
            self.moving = not self.dev.place.moves

    def end_motion(self) -> None:
        """The next frame starts from where this one went."""
        if self.acts:
            self.scene.memory.write(self.dev.place.source, self.scene.memory.read(self.dev.place.target))
