"""When two surfaces meet on parabolas."""

from ..device import ti
from .limits import NEVER


@ti.func
def meeting(gap, bend, way, moved, v, f, left, blur):
    """Return after which part of the substep a gap is closed, at most 2 if ever, and the normal then.

    gap, bend: at the start of the substep, with the vector `way` from the center of curvature, or the normal of a plane with a
    bend of 0. moved: how far it has moved since [m]; v: displacement now, per substep, f: its change by forces. left: of the
    substep. A gap of no more than `blur` is closed. In a frame with its origin in the center of curvature, |way + moved + path| =
    |1 / bend - gap| is solved for: without forces in closed form, then by Newton's method.
    """
    s, m = 0 * gap, way + 0 * v
    if bend == 0:
        gap += way.dot(moved)
        if gap > blur:
            a, b = -v.dot(way), -f.dot(way)
            root = a * a + 2 * b * gap
            s = NEVER + 0 * gap
            if root >= 0 and a + ti.sqrt(ti.max(root, 0)) > 0:
                s = 2 * gap / (a + ti.sqrt(root))
    else:
        reach, sign = ti.abs(1 / bend - gap), ti.select(bend < 0, -1, 1)
        c = gap * (2 / bend - gap) + 2 * way.dot(moved) + moved.dot(moved)
        m += moved
        if sign * c / (m.norm() + reach) > blur:
            u = v + (left / 2) * f
            b, uu = m.dot(u), u.dot(u)
            root = b * b - uu * c
            s = NEVER + 0 * gap
            if root >= 0 and uu > 0:
                if c < 0:
                    s = (ti.sqrt(root) - b) / uu
                elif b < 0:
                    s = c / (ti.sqrt(root) - b)
            if s <= 2:
                for _ in range(4):
                    path, speed = v * s + f * (s * s / 2), v + f * s
                    slope = 2 * (m + path).dot(speed)
                    if slope != 0:
                        s -= (c + 2 * m.dot(path) + path.dot(path)) / slope
        m = sign * (m + v * s + f * (s * s / 2)).normalized()
    return s, m
