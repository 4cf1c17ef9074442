"""A wall along a polygon."""

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..geometry.intervals import cross_2d
from ..geometry.places import places_between
from .facets import Facets, facet_normals
from .moving import Moving


class Polygon(Moving):
    """Particles stay outside of a polygon, or inside; or on their own side of an open line (2D).

    C(x) = dist(x, outline) - (R + r) >= 0, grad C the direction from the nearest point of the outline.

    vertices: (m, 2) [m], in order, either way round; outlines may be concave. inside: keep particles in. closed: False for a
    line from the first vertex to the last, a thin wall with two sides. radius: R [m], by which the outline is thickened; it must
    be above 0 for a line and points (particles of radius 0). position, rotation: pose of the vertices; live.
    friction, restitution, push_out, active, events, surface_velocity, one_way: see tiverlet/colliders/README.md.

    Nothing passes, at any speed of the particle or of the wall. Raises ValueError for edges of no length, and for a closed
    outline that has no area or intersects itself.
    """

    dim = 2
    shares_code = True

    def __init__(
        self, vertices, inside: bool = False, *, closed: bool = True, radius: float = 0.0, position: ArrayLike = 0.0, rotation:
        ArrayLike = 0.0, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float | None = None, active: bool |
        None = None, events: bool = False, surface_velocity=None, one_way=None,
    ):  # fmt: skip
        vertices = checks.points("Polygon", "vertices", vertices, dim=2)
        self.set_sides(closed, inside, "an open line")
        self.radius = radius
        if self.closed and len(vertices) > 1 and (vertices[0] == vertices[-1]).all():
            vertices = vertices[:-1]  # a loop whose last vertex repeats the first
        if len(vertices) < (3 if self.closed else 2):
            raise ValueError(f"Polygon: vertices has shape {vertices.shape}, but at least {3 if self.closed else 2} are needed.")
        m = len(vertices) if self.closed else len(vertices) - 1
        i, j = np.arange(m), (np.arange(m) + 1) % len(vertices)
        size = np.abs(vertices).max()
        short = np.linalg.norm(vertices[j] - vertices[i], axis=1) <= 1e-9 * size
        if short.any():
            k = int(np.argmax(short))
            raise ValueError(f"Polygon: vertices[{i[k]}] and vertices[{j[k]}] are the same point; leave one out.")
        if self.closed:
            _check_simple(vertices, i, j)
            v = vertices - vertices.mean(axis=0)
            area = float(cross_2d(v[i], v[j]).sum()) / 2
            if abs(area) <= 1e-12 * size**2:
                raise ValueError(f"Polygon: vertices enclose an area of {area:g} m^2; closed = False makes a line of them.")
            if (area < 0) != self.inside:
                i, j = j, i
        self.vertices = vertices
        self.vertices.flags.writeable = False
        self.position, self.rotation = position, rotation
        self.set_surface(friction, restitution, push_out, active, events, one_way, 2, surface_velocity=surface_velocity)
        along = vertices[j] - vertices[i]
        along /= np.linalg.norm(along, axis=1)[:, None]
        features = np.stack([i, j], axis=1)
        wings = np.concatenate([i, j]), np.concatenate([along, -along])
        facing = np.zeros_like(vertices)
        normal = facet_normals(vertices[features])
        np.add.at(facing, i, normal)
        np.add.at(facing, j, normal)
        facing[i] = np.where(np.linalg.norm(facing[i], axis=1)[:, None] > 1e-9, facing[i], normal)
        facing /= np.maximum(np.linalg.norm(facing, axis=1)[:, None], 1e-9)
        self.facets = Facets(vertices[features], features, wings, facing, self.closed, self.inside)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the polygon."""
        loop = np.concatenate([self.vertices, self.vertices[:1]]) if self.closed else self.vertices
        return self.placed(loop)[None], self.radius


def _check_simple(vertices: np.ndarray, i: np.ndarray, j: np.ndarray) -> None:
    """Raise ValueError for the first two edges that cross or touch, other than neighbours at their joint."""
    a, b, m = vertices[i], vertices[j], len(vertices)
    low, high = np.minimum(a, b), np.maximum(a, b)
    order = np.argsort(low[:, 0], kind="stable")
    # Edges that begin, along x, before another one ends.
    ends = np.searchsorted(low[order, 0], high[order, 0], side="right")
    for p, after in places_between(np.arange(m)[:, None] + 1, ends[:, None] - 1):
        q = after[:, 0]
        p, q = np.minimum(order[p], order[q]), np.maximum(order[p], order[q])
        near = (low[p, 1] <= high[q, 1]) & (low[q, 1] <= high[p, 1])
        p, q = p[near], q[near]
        wrong = _meet(a[p], b[p], a[q], b[q])
        joined = (q - p == 1) | ((p == 0) & (q == m - 1))
        # Neighbours meet at their joint, and nowhere else unless one folds back onto the other.
        shared = np.where((q - p == 1)[:, None], a[q], a[p])
        one, two = np.where((shared == a[p]).all(1)[:, None], b[p], a[p]), np.where((shared == a[q]).all(1)[:, None], b[q], a[q])
        u, v = one - shared, two - shared
        folded = (np.abs(cross_2d(u, v)) <= 1e-12 * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)) & ((u * v).sum(1) > 0)
        wrong = np.where(joined, folded, wrong)
        if wrong.any():
            k = int(np.argmax(wrong))
            e, f = (f"{int(n)}-{int((n + 1) % m)}" for n in (p[k], q[k]))
            raise ValueError(f"Polygon: the edges {e} and {f} of vertices meet, so it has no clear inside; take them apart.")


def _meet(a, b, c, d) -> np.ndarray:
    """Whether segments a-b and c-d have a point in common."""
    s, t = np.sign(cross_2d(b - a, c - a)), np.sign(cross_2d(b - a, d - a))
    u, v = np.sign(cross_2d(d - c, a - c)), np.sign(cross_2d(d - c, b - c))
    flat = (s == 0) & (t == 0)  # all four points on one line: the segments meet, since their boxes overlap
    return ((s != t) & (u != v)) | flat
