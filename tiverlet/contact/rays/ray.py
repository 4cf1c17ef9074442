"""The query of World.ray(): what rays meet first."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...colliders.collider import Collider
from ...features.feature import Feature
from ...features.row_table import row_table
from ...features.unknown_names import answer_names
from ...geometry.bounding_tree import BoundingTree, ray_entry_bound
from ...geometry.intervals import ball, capsule, entry, rounding
from ...geometry.nearest import closest_segment_point, surface_normal
from ...neighbours.queries import between
from ...particles import in_range

if TYPE_CHECKING:
    from ...world import World

WHO = "World.ray"


@answer_names
@dataclass(frozen=True)
class Hits:
    """What each of k rays meets first: a particle, a link or a wall. For one ray, given as (dim,), the first axis is left out.

    distance: (k,) from the origin [m], inf for a miss. point: (k, dim), on the surface [m]. normal: (k, dim), a unit vector out
    of the surface, towards the side of the origin. Both are NaN for a miss.
    particle: (k,), the index of the particle. link: (k, 2), the number of the feature in world.features, and the number of the
    link in it. wall: (k,), the number of the feature. Each is -1 if the ray meets something else, or nothing.
    """

    distance: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    particle: np.ndarray
    link: np.ndarray
    wall: np.ndarray

    @property
    def met(self) -> np.ndarray:
        """Whether each ray meets anything, Boolean (k,)."""
        return self.distance < np.inf

    def __len__(self) -> int:
        return len(self.distance)

    def __repr__(self) -> str:
        names, one = ("distance", "particle", "link", "wall", "normal", "point"), np.ndim(self.distance) == 0
        return row_table("Hits", {name: np.asarray([vars(self)[name]] if one else vars(self)[name]) for name in names})


def ray(
    world: "World", origin: Any, direction: Any, reach: Any, radius: Any, groups: Any, skip: Any,
    features: Iterable[Feature] | None,
) -> Hits:  # fmt: skip
    """Return the first Hits of rays. See World.ray()."""
    single, origin, direction = _rays(origin, direction, world.particles.dim)
    most = checks.per_item(WHO, "reach", reach, len(origin), least=0.0, infinite=True)
    radius = checks.number(WHO, "radius", radius, least=0.0)
    some, box = _taken(world, features), world._runner.scene.periodic
    x = np.asarray(world.position) if box is None else box.wrap(world.position)
    seen = _seen(world, x, groups, skip)
    k, dim = origin.shape
    best, normal = most.copy(), np.full((k, dim), np.nan)
    particle, link, wall = np.full(k, -1), np.full((k, 2), -1), np.full(k, -1)
    there = np.zeros(k, dtype=bool)

    def meet(rods: Rods) -> tuple[np.ndarray, np.ndarray]:
        """Update the nearest hits by these rods. Returns the mask of rays that meet one first so far, and which rod."""
        distance, which = rods.first(origin, direction, best)
        nearer = (which >= 0) & ((distance < best) | ~there)
        best[nearer], there[nearer] = distance[nearer], True
        at = origin[nearer] + distance[nearer, None] * direction[nearer]
        normal[nearer] = rods.normal(at, direction[nearer], which[nearer])
        return nearer, which[nearer]

    index = np.flatnonzero(seen)
    nearer, which = meet(Rods(world.particles.radius[index] + radius, x[index]))
    particle[nearer] = index[which]
    pairs, number = _rods(world, some, seen)
    ends = x[pairs[:, 0]] + between(x[pairs[:, 1]], x[pairs[:, 0]], box)
    nearer, which = meet(Rods(world.particles.radius[pairs].min(axis=1) + radius, x[pairs[:, 0]], ends))
    particle[nearer], link[nearer] = -1, number[which]
    for f, feature in enumerate(world.features):
        if f in some and isinstance(feature, Collider) and feature.was_active and k:
            distance, out = feature.cast(origin, direction, radius)
            nearer = (distance < np.inf) & ((distance < best) | ((distance == best) & ~there))
            best[nearer], normal[nearer], there[nearer] = distance[nearer], out[nearer], True
            particle[nearer], link[nearer], wall[nearer] = -1, -1, f
    distance = np.where(there, best, np.inf)
    at = np.where(there, best, np.nan)[:, None]
    point = origin + at * direction - radius * normal
    found = (distance, point, normal, particle, link, wall)
    return Hits(*(array[0] if single else array for array in found))


class Rods:
    """The shapes of particles and links for rays: m rods with round ends from a to b, (m, dim) [m], of a radius (m,) [m].

    Without b they are discs or spheres around a. Rods are convex, so a ray that starts inside of one does not enter it again.
    """

    def __init__(self, radius: np.ndarray, a: np.ndarray, b: np.ndarray | None = None):
        self._discs = b is None
        b = a if b is None else b
        self._a, self._b, self._radius = a, b, radius
        reach = radius[:, None]
        self._tree = BoundingTree(np.minimum(a, b) - reach, np.maximum(a, b) + reach)

    def first(self, origin: np.ndarray, direction: np.ndarray, most: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far each ray goes until it enters a rod, (k,) [m], within most (k,) [m], and which rod, -1 for none."""

        def value(q: np.ndarray, i: np.ndarray) -> np.ndarray:
            """Return the distance at which ray q[.] enters rod i[.]."""
            o, d, a, b, radius = origin[q], direction[q], self._a[i], self._b[i], self._radius[i]
            way = ball(o, d, a, radius) if self._discs else capsule(o, d, a, b, radius)
            return entry(way, rounding(o, a, b))

        return self._tree.find_least(len(origin), most, ray_entry_bound(origin, direction, 0.0), value)

    def normal(self, point: np.ndarray, direction: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Return unit normals (k, dim) at points (k, dim) on the surface of rods, met by rays in these directions."""
        a, b = self._a[which], self._b[which]
        return surface_normal(point, closest_segment_point(point, a, b)[0], direction, b - a, rounding(point, a, b))


def _rays(origin: Any, direction: Any, dim: int) -> tuple[bool, np.ndarray, np.ndarray]:
    """Return whether it is one ray, and the checked origins and unit directions, (k, dim)."""
    (one_x, x), (one_d, d) = _places("origin", origin, dim), _places("direction", direction, dim)
    k = len(d) if one_x else len(x)
    if not one_d and len(d) != k:
        raise ValueError(f"{WHO}: there are {k} origins and {len(d)} directions; give as many of both, or one for all.")
    in_range(WHO, "origin", x)
    size = np.abs(d).max(axis=1, keepdims=True)
    if (size == 0).any():
        where = "" if one_d else f"[{int(np.argmin(size))}]"
        raise ValueError(f"{WHO}: direction{where} = 0 has no direction; give a vector of any length above 0, such as (0, -1).")
    d = d / size  # so that the square neither overflows nor vanishes
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return one_x and one_d, np.broadcast_to(x, (k, dim)), np.broadcast_to(d, (k, dim))


def _places(name: str, value: Any, dim: int) -> tuple[bool, np.ndarray]:
    """Return whether `value` is one vector, and its vectors, (k, dim)."""
    array = checks.plain(WHO, name, value)
    if array.ndim == 1:
        return True, checks.vector(WHO, name, array, dim)[None]
    return False, checks.points(WHO, name, array, dim=dim)


def _taken(world: "World", features: Iterable[Feature] | None) -> set[int]:
    """Return the numbers of the features that rays may meet."""
    if features is None:
        return set(range(len(world.features)))
    numbers = {id(f): k for k, f in enumerate(world.features)}
    some = checks.rows(WHO, "features", features, "a list of features of the world")
    for k, f in enumerate(some):
        if id(f) not in numbers:
            raise ValueError(f"{WHO}: features[{k}] = {f!r} does not act in this world; take them from world.features.")
    return {numbers[id(f)] for f in some}


def _seen(world: "World", x: np.ndarray, groups: Any, skip: Any) -> np.ndarray:
    """Return the mask of particles that rays can meet, Boolean (n,)."""
    seen = np.asarray(np.isfinite(x).all(axis=1))
    if groups is not None:
        wanted = np.atleast_1d(checks.plain(WHO, "groups", groups))
        if wanted.size and (wanted.dtype.kind not in "iu" or wanted.ndim != 1):
            raise TypeError(f"{WHO}: groups = {groups!r}, but a group (an integer), a list of groups or None is needed.")
        seen = seen & np.isin(world.particles.group, wanted)
    some = np.atleast_1d(checks.plain(WHO, "skip", skip))
    if some.dtype == bool:
        if some.shape != seen.shape:
            raise ValueError(f"{WHO}: skip has shape {some.shape}, but a mask of shape {seen.shape} is needed.")
        return seen & ~some
    seen[checks.indices(WHO, "skip", some, len(seen))] = False
    return seen


def _rods(world: "World", some: set[int], seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return links of which both particles can be met: pairs (m, 2), and the numbers of feature and link (m, 2)."""
    pairs, numbers = [np.zeros((0, 2), dtype=np.int64)], [np.zeros((0, 2), dtype=np.int64)]
    for f in sorted(some):
        ends, which = world.features[f].rods()
        pairs.append(ends)
        numbers.append(np.stack([np.full(len(ends), f), which], axis=1))
    both, number = np.concatenate(pairs), np.concatenate(numbers)
    there = seen[both].all(axis=1)
    return both[there], number[there]
