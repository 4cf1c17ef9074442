"""Curves through points, by their arc length: polylines, and smooth curves as cubic splines."""

import numpy as np

PIECES = 8  # of equal length, on a smooth curve between two given points


class Curve:
    """A curve of pieces P_k(r) = a + b r + c r^2 + d r^3, 0 <= r <= length_k; r is arc length (splines: to 4th order).

    points: (k, dim) [m]. closed: the last point is connected to the first. smooth: a cubic spline, with continuous curvature and
    at open ends the slope of the cubic through four points; otherwise straight pieces.
    """

    def __init__(self, points: np.ndarray, closed: bool, smooth: bool):
        self.closed, self.smooth = closed, smooth
        through = np.concatenate([points, points[:1]]) if closed else points
        lengths = np.linalg.norm(np.diff(through, axis=0), axis=1)
        if smooth:
            through, lengths = _resample(through, lengths, closed)
            slope = _slopes(through, lengths, closed)
        else:
            slope = None
        chord = np.diff(through, axis=0) / lengths[:, None]
        self.a, self.b = through[:-1], chord
        self.c, self.d = np.zeros_like(chord), np.zeros_like(chord)
        if slope is not None:
            u, v, step = slope[:-1], slope[1:], lengths[:, None]
            self.b, self.c, self.d = u, (3 * chord - 2 * u - v) / step, (u + v - 2 * chord) / step**2
        self.lengths = lengths
        self.starts = np.concatenate([[0.0], np.cumsum(lengths)])

    @property
    def length(self) -> float:
        """Length of all pieces [m]."""
        return float(self.starts[-1])

    def split(self, s) -> tuple[np.ndarray, np.ndarray]:
        """Return piece and remainder of arc lengths s [m]; s wraps around a closed curve and is clipped at open ends."""
        s = np.asarray(s, dtype=np.float64)
        s = np.mod(s, self.length) if self.closed else np.clip(s, 0.0, self.length)
        k = np.clip(np.searchsorted(self.starts, s, side="right") - 1, 0, len(self.lengths) - 1)
        return k, s - self.starts[k]

    def at(self, s) -> np.ndarray:
        """Return points at arc lengths s [m], (m, dim)."""
        k, r = self.split(s)
        r = r[..., None]
        return self.a[k] + r * (self.b[k] + r * (self.c[k] + r * self.d[k]))

    def tangent(self, s) -> np.ndarray:
        """Return unit tangents at arc lengths s [m], (m, dim)."""
        k, r = self.split(s)
        r = r[..., None]
        way = self.b[k] + r * (2 * self.c[k] + 3 * r * self.d[k])
        return way / np.linalg.norm(way, axis=-1, keepdims=True)

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """Return arc lengths of the points of the curve nearest to x (m, dim): the best of 9 on each piece, refined."""
        s = (self.starts[:-1, None] + self.lengths[:, None] * np.linspace(0, 1, 9)).ravel()
        p = self.at(np.minimum(s, self.length * (1 - 1e-15)))
        j = np.array([int(np.argmin(((p - point) ** 2).sum(axis=1))) for point in x], dtype=np.int64)
        span = self.lengths[np.minimum(j // 9, len(self.lengths) - 1)] / 4
        low, high = s[j] - span, s[j] + span
        for _ in range(60):  # ternary search
            one, two = low + (high - low) / 3, high - (high - low) / 3
            near = ((self.at(np.stack([one, two])) - x) ** 2).sum(axis=2)
            less = near[0] < near[1]
            low, high = np.where(less, low, one), np.where(less, two, high)
        return (low + high) / 2


def _slopes(x: np.ndarray, step: np.ndarray, closed: bool) -> np.ndarray:
    """Return dP/dt of the cubic spline through x (k + 1, dim), with the steps of t (k,) between."""
    chord = np.diff(x, axis=0) / step[:, None]
    if closed:
        before = np.roll(step, 1)
        low, main, up = step, 2 * (before + step), before
        right = 3 * (step[:, None] * np.roll(chord, 1, axis=0) + before[:, None] * chord)
        m = _cyclic(low, main, up, right)
        return np.concatenate([m, m[:1]])
    if len(step) < 3:
        return _parabola(x, step)
    a, b = step[:-1], step[1:]
    right = 3 * (b[:, None] * chord[:-1] + a[:, None] * chord[1:])
    first, last = _end_slope(x, step), _end_slope(x[::-1], step[::-1]) * -1
    right[0] -= b[0] * first
    right[-1] -= a[-1] * last
    inner = _thomas(b, 2 * (a + b), a, right)
    return np.concatenate([first[None], inner, last[None]])


def _end_slope(x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the slope at the first point, of the cubic through the first four."""
    t = np.concatenate([[0.0], np.cumsum(step[:3])])
    return np.linalg.solve(np.vander(t, 4, increasing=True), x[:4])[1]


def _parabola(x: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return slopes of the polynomial through two or three points."""
    t = np.concatenate([[0.0], np.cumsum(step)])
    c = np.linalg.solve(np.vander(t, len(t), increasing=True), x)
    return sum(k * c[k] * t[:, None] ** (k - 1) for k in range(1, len(t)))  # type: ignore[return-value]


def _thomas(low, main, up, right) -> np.ndarray:
    """Solve a tridiagonal system: low[i] m[i-1] + main[i] m[i] + up[i] m[i+1] = right[i]."""
    main, right = np.array(main, dtype=float), np.array(right, dtype=float)
    for i in range(1, len(main)):
        f = low[i] / main[i - 1]
        main[i] -= f * up[i - 1]
        right[i] -= f * right[i - 1]
    right[-1] /= main[-1]
    for i in range(len(main) - 2, -1, -1):
        right[i] = (right[i] - up[i] * right[i + 1]) / main[i]
    return right


def _cyclic(low, main, up, right) -> np.ndarray:
    """Solve a tridiagonal system with corners, low[0] and up[-1], by Sherman and Morrison."""
    gamma = -main[0]
    u, v = np.zeros(len(main)), np.zeros(len(main))
    u[0], u[-1], v[0], v[-1] = gamma, up[-1], 1.0, low[0] / gamma
    shifted = np.array(main, dtype=float)
    shifted[0] -= gamma
    shifted[-1] -= up[-1] * low[0] / gamma
    both = _thomas(low, shifted, up, np.concatenate([right, u[:, None]], axis=1))
    y, q = both[:, :-1], both[:, -1]
    return y - np.outer(q, (v @ y) / (1 + v @ q))


def _resample(x: np.ndarray, step: np.ndarray, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return points on the spline through x at equal distances along it, PIECES for each step, and these distances."""
    m, nodes = _slopes(x, step, closed), np.polynomial.legendre.leggauss(5)
    chord = np.diff(x, axis=0) / step[:, None]
    c, d = (3 * chord - 2 * m[:-1] - m[1:]) / step[:, None], (m[:-1] + m[1:] - 2 * chord) / step[:, None] ** 2
    fine = np.linspace(0, 1, 4 * PIECES + 1)
    low, high = fine[:-1], fine[1:]
    t = (low[:, None] + high[:, None]) / 2 + (high - low)[:, None] / 2 * nodes[0]  # (f, 5) fractions of a step
    r = (step[:, None, None] * t)[..., None]
    speed = np.linalg.norm(m[:-1, None, None] + r * (2 * c[:, None, None] + 3 * r * d[:, None, None]), axis=3)
    parts = (speed @ nodes[1]) * (high - low) / 2 * step[:, None]
    along = np.concatenate([[0.0], np.cumsum(parts)])
    place = np.concatenate([[0.0], (np.arange(len(step))[:, None] + high).ravel()])  # in steps
    want = np.linspace(0, along[-1], PIECES * len(step) + 1)
    # Between two fine points, the cubic with the right speeds at both.
    slope = np.linalg.norm(_derivative(m, c, d, step, place), axis=1)
    k = np.clip(np.searchsorted(along, want, side="right") - 1, 0, len(along) - 2)
    u = (want - along[k]) / (along[k + 1] - along[k])
    gap, size = place[k + 1] - place[k], along[k + 1] - along[k]
    a, b = size / slope[k] / gap, size / slope[k + 1] / gap
    w = place[k] + gap * (u * u * (3 - 2 * u) + a * u * (1 - u) ** 2 - b * u * u * (1 - u))
    i = np.clip(w.astype(int), 0, len(step) - 1)
    r = ((w - i) * step[i])[:, None]
    points = x[i] + r * (m[i] + r * (c[i] + r * d[i]))
    points[0], points[-1] = x[0], x[-1]
    return points, np.full(len(points) - 1, along[-1] / (len(points) - 1))


def _derivative(m, c, d, step, place) -> np.ndarray:
    """Return dP/d(place) of the spline, at places counted in steps."""
    i = np.clip(place.astype(int), 0, len(step) - 1)
    r = ((place - i) * step[i])[:, None]
    return step[i, None] * (m[i] + r * (2 * c[i] + 3 * r * d[i]))
