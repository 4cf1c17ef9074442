"""Surfaces of bodies, for pictures."""

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from ..constraints import Area, Dihedral, ShapeMatch, Volume
from ..contact import Polygons
from ..features.feature import Batch
from ..geometry.intervals import cross_2d
from ..shapes.shape import surface_of
from .lines import cells

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts

LIGHT, DARKEST = np.array([0.45, 0.35, 0.82]), 0.3  # direction of the light, added to up; brightness of faces edge-on to it
SHADES = 15
MOST = 200_000  # most links that are searched for triangles


def triangles(world: "World | Parts") -> np.ndarray:
    """Return triangles of particles that cover bodies, (t, 3). They may overlap.

    They come from loops, volumes, dihedral angles, and links that are the sides of triangles.
    """
    x, found = np.asarray(world.particles.position), [np.zeros((0, 3), dtype=np.int64)]
    flat = world.particles.dim == 2
    links = [np.zeros((0, 2), dtype=np.int64)]
    for f in world.features:
        if isinstance(f, Polygons) or (isinstance(f, Area) and flat):
            loops = f.loops if isinstance(f, Polygons) else [f.members_of(c) for c in range(f.count)]
            found += [clipped(np.asarray(loop), x) for loop in loops]
        elif isinstance(f, Area):
            found.append(f.indices.reshape(-1, 3))
        elif isinstance(f, Volume):
            listing = np.asarray(f.listing)
            found.append(surface_of(listing) if listing.shape[-1] == 4 else listing)
        elif isinstance(f, Dihedral):
            a, b, c, d = f.indices.T
            found += [np.stack([a, b, c], axis=1), np.stack([b, a, d], axis=1)]
        elif isinstance(f, Batch) and f.arity == 2 and f.count and not f.breaks:
            links.append(f.indices)
    within = [f.indices.ravel() for f in world.features if isinstance(f, Volume)]  # also particles below the skin
    done = np.unique(np.concatenate([*found, *within], axis=None))
    pairs = np.concatenate(links)
    pairs = pairs[~np.isin(pairs, done).all(axis=1)]
    if 0 < len(pairs) <= MOST:
        used = np.zeros(len(pairs), dtype=bool)
        if not flat:
            used, sheet = cells(pairs, x)
            found += [sheet[:, :3], sheet[:, [0, 2, 3]]]
        found.append(cliques(pairs[~used]))
    if flat:
        done = np.unique(np.concatenate(found))
        for f in world.features:
            clusters = [f.members_of(c) for c in range(f.count)] if isinstance(f, ShapeMatch) else []
            found += [hull(cluster, x) for cluster in clusters if not np.isin(cluster, done).all() and len(cluster) > 2]
    out = np.concatenate(found)
    a, b, c = (x[k] for k in out.T)
    sides = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    return out[doubled(b - a, c - a) > 1e-3 * sides]  # without degenerate triangles


def covered(world: "World | Parts", corners: np.ndarray) -> np.ndarray:
    """Return which particles are part of a surface, Boolean (n,): its corners, and in 2D all of a body that keeps its shape."""
    out = np.zeros(len(world.particles), dtype=bool)
    out[corners.ravel()] = True
    for f in world.features:
        if isinstance(f, ShapeMatch) and world.particles.dim == 2 and f.count:
            out[f.indices[(np.bincount(f.owner) > 2)[f.owner]]] = True
    return out


def doubled(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return twice the areas between vectors, (m,)."""
    uu, vv, uv = (np.einsum("ij,ij->i", *pair) for pair in ((u, u), (v, v), (u, v)))
    return np.sqrt(np.maximum(uu * vv - uv * uv, 0))


def normals(x: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return normals at particles, (n, 3), each as long as twice the area of its triangles."""
    a, b, c = (x[k] for k in triangles.T)
    across, corner = np.cross(b - a, c - a), triangles.ravel()
    return np.stack([np.bincount(corner, np.repeat(column, 3), len(x)) for column in across.T], axis=1)


def lit(hues: np.ndarray, triangles: np.ndarray, x: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return colours (n, 3) of particles at x on a surface that is lit from the eye's side and above.

    triangles: (t, 3). up: the direction against gravity.
    """
    normal, light = normals(x, triangles), LIGHT + up
    size = np.sqrt(np.einsum("ij,ij->i", normal, normal))
    bright = np.abs(normal @ (light / np.linalg.norm(light))) / np.where(size > 0, size, 1)
    return hues * (DARKEST + (1 - DARKEST) * np.rint(SHADES * bright) / SHADES)[:, None]  # few shades compress well


def cliques(pairs: np.ndarray) -> np.ndarray:
    """Return all triples of particles that are linked to each other, (t, 3)."""
    near: dict[int, set[int]] = defaultdict(set)
    for i, j in pairs.tolist():
        near[min(i, j)].add(max(i, j))
    out = [(i, j, k) for i in list(near) for j in near[i] for k in near[i] & near.get(j, set())]
    return np.array(sorted(out), dtype=np.int64).reshape(-1, 3)


def clipped(loop: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return triangles that fill a loop in 2D, (k - 2, 3), by ear clipping."""
    q = x[loop]
    if cross_2d(q, np.roll(q, -1, axis=0)).sum() < 0:
        loop = loop[::-1]
    left, out = loop.tolist(), []
    while len(left) > 3:
        corner = np.array([left[-1:] + left[:-1], left, left[1:] + left[:1]]).T
        a, b, c = x[corner[:, 0]], x[corner[:, 1]], x[corner[:, 2]]
        turn = cross_2d(b - a, c - b)
        for k in np.argsort(-turn, kind="stable").tolist():
            others = x[[i for i in left if i not in corner[k]]]
            sides = [cross_2d(v - u, others - u) for u, v in ((a[k], b[k]), (b[k], c[k]), (c[k], a[k]))]
            if turn[k] <= 0 or not (np.array(sides) > 0).all(axis=0).any():
                break
        out.append(corner[k].tolist())
        left.pop(k)
    return np.array([*out, left], dtype=np.int64)


def hull(cluster: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return triangles that fill the convex hull of particles in 2D, (t, 3), as a fan (Andrew 1979)."""
    order = cluster[np.lexsort(x[cluster].T[::-1])].tolist()
    ring: list[int] = []
    for way in (order, order[::-1]):
        side: list[int] = []
        for i in way:
            while len(side) > 1 and cross_2d(x[side[-1:]] - x[side[-2]], x[[i]] - x[side[-2]])[0] <= 0:
                side.pop()
            side.append(i)
        ring += side[:-1]
    return np.array([[ring[0], *pair] for pair in zip(ring[1:-1], ring[2:], strict=True)], dtype=np.int64).reshape(-1, 3)
