"""What must hold in a scene, by brute force in NumPy and by the documentation."""

from typing import Any

import numpy as np

import tiverlet as tv
from tiverlet.constraints.core.angle import Angle
from tiverlet.constraints.core.scalar import Scalar
from tiverlet.features.feature import Batch
from tiverlet.measure import overlapping

from .functions import SDF
from .scenes import Structure, plain

WALLS = ("Box", "HalfSpace", "Ball", "Capsule", "Polygon", "Mesh", "Sdf")
PULLS = ("Gravity", "Drag", "Wind", "Attractor", "Force", "PairForce")
TETHERS = ("Pin", "Path", "Snap")
PASSIVE = ("Gravity", "Drag", *WALLS, "Distance", "Rope", "Spacer", "Bend", "AngleLimit", "Dihedral", "Constraint",
           "Area", "Volume", "ShapeMatch", "Snap", "Contact", "Polygons", "Periodic", "Sleep")  # fmt: skip
EPS = {"f32": 2.0**-23, "f32-compensated": 2.0**-23, "f64": 2.0**-52}


def segment(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the distances of points (n, dim) to a segment."""
    d = b - a
    t = np.clip((p - a) @ d / max(d @ d, 1e-300), 0, 1)
    return np.linalg.norm(p - a - t[:, None] * d, axis=1)


def polygon(p: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """Return the signed distance to a closed outline, positive outside."""
    ends = np.roll(vertices, -1, axis=0)
    away = np.min([segment(p, a, b) for a, b in zip(vertices, ends, strict=True)], axis=0)
    inside = np.zeros(len(p), dtype=bool)
    for a, b in zip(vertices, ends, strict=True):
        crosses = (a[1] > p[:, 1]) != (b[1] > p[:, 1])
        at = a[0] + (p[:, 1] - a[1]) * (b[0] - a[0]) / (b[1] - a[1] if b[1] != a[1] else 1.0)
        inside ^= crosses & (p[:, 0] < at)
    return np.where(inside, -away, away)


def convex(p: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return a bound on the signed distance to a convex mesh: exact inside and beside faces, too small beside edges."""
    out = []
    for a, b, c in vertices[faces]:
        n = np.cross(b - a, c - a)
        n = n / np.linalg.norm(n)
        n = n if (vertices.mean(axis=0) - a) @ n < 0 else -n
        out.append((p - a) @ n)
    return np.max(out, axis=0)


def gap(wall: Any, p: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return how far particles are from a wall in its current pose, negative inside, (n,)."""
    if wall.one_way is not None or wall.active is False:  # any particle may be inside
        return np.full(len(p), np.inf)
    name = type(wall).__name__
    if name == "Box":
        return np.minimum((p - wall.lower).min(axis=1), (wall.upper - p).min(axis=1)) - r
    if name == "HalfSpace":
        return p @ wall.normal - wall.offset - r
    if name == "Ball":
        d = np.linalg.norm(p - wall.center, axis=1)
        return wall.radius - r - d if wall.inside else d - wall.radius - r
    if name == "Capsule":
        return segment(p, wall.a, wall.b) - wall.radius - r
    place, rotation = wall.current_pose(p.shape[1])
    p = (p - place) @ rotation
    if name == "Sdf":
        return SDF[plain(wall.function).__name__](p) - wall.radius - r
    d = polygon(p, wall.vertices) if name == "Polygon" else convex(p, wall.vertices, wall.faces)
    return (-d if wall.inside else d) - wall.radius - r


def excluded(features: list[Any], particles: Any) -> set[tuple[int, int]]:
    """Return the pairs that may overlap, because constraints fix their relative place."""
    out = set()
    for f in features:
        if isinstance(f, Batch) and not f.is_kinematic and f.count and (particles.inv_mass[f.indices] > 0).any():
            out |= {(min(a, b), max(a, b)) for a, b in f.excluded_pairs(particles).tolist()}
    return out


def overlap(contact: Any, features: list[Any], particles: Any, free: np.ndarray, x: np.ndarray) -> tuple[int, float]:
    """Return the number of overlapping pairs, and the worst overlap in radii of the smaller particle."""
    box = next((f for f in features if isinstance(f, tv.Periodic)), None)
    r, group, out = particles.radius, particles.group, excluded(features, particles)
    allowed = None if contact.table.touching is None else {tuple(sorted(p)) for p in contact.table.touching}
    deep = []
    for (i, j), depth in zip(*(a.tolist() for a in overlapping(x, r, periodic=box)), strict=True):
        grouped = allowed is None or tuple(sorted((int(group[i]), int(group[j])))) in allowed
        if grouped and (i, j) not in out and (free[i] or free[j]):
            deep.append(depth / (min(r[i], r[j]) or max(r[i], r[j])))
    return len(deep), max(deep, default=0.0)


def in_walls(features: list[Any], particles: Any, free: np.ndarray, x: np.ndarray) -> float:
    """Return how deep particles are in walls at most, in their radii."""
    some = (free > 0) & (particles.radius > 0)
    walls = [f for f in features if type(f).__name__ in WALLS]
    return max((-(gap(f, x, particles.radius)[some] / particles.radius[some]).min(initial=0.0) for f in walls), default=0.0)


def shapeless(f: Any, x: np.ndarray) -> np.ndarray:
    """Return which constraints on angles have corners without an angle: nothing acts on these."""
    if not isinstance(getattr(f, "quantity", None), Angle):
        return np.zeros(f.count, dtype=bool)
    q = f.placed(x)
    legs = np.diff(q, axis=1) if f.arity == 3 else q[:, 1:] - q[:, :1]
    if f.arity == 4:  # an edge, and the heights of two wings over it
        e = legs[:, :1] / np.maximum(np.linalg.norm(legs[:, :1], axis=2, keepdims=True), 1e-300)
        legs[:, 1:] -= e * (legs[:, 1:] * e).sum(axis=2, keepdims=True)
    return np.linalg.norm(legs, axis=2).min(axis=1, initial=np.inf) < 1e-6 * f.start.size


def rigid(features: list[Any], free: np.ndarray, x: np.ndarray) -> tuple[float, bool, float]:
    """Return the worst relative violation of rigid scalar constraints, whether it covers all constraints, and its sensitivity.

    The sensitivity is the change of violations if all coordinates changed by the size of the scene: times the precision, it
    bounds the effect of rounding.
    """
    worst, whole, steepest, reach = 0.0, True, 0.0, float(np.abs(x).max(initial=0.0))
    for f in features:
        if not isinstance(f, Batch) or getattr(f, "is_kinematic", False) or not f.count:
            continue
        if not isinstance(f, Scalar) or not f.arity or f.quantity.collapses or (f.compliance > 0).any():
            whole = False
        if isinstance(f, Scalar) and (f.driven or (f.side and (f.load > 0).any())):  # a slack constraint that still pulls counts
            whole = False
        if not isinstance(f, Scalar) or f.driven:
            continue
        C = f.violation(x)
        C = np.maximum(f.side * C, 0) if f.side else np.abs(C)
        start = f.rest_of(f.start.position)
        unit = f.quantity.unit or (float(np.abs(start).mean()) if np.any(start) else f.start.size)
        size = np.full(f.count, unit) if f.quantity.unit else np.where(f.goal != 0, np.abs(f.goal), unit)
        some = (f.compliance == 0) & ~f.broken & ~f.immovable(free) & ~shapeless(f, x)
        worst = max(worst, float((C / size)[some].max(initial=0.0)))
        if f.arity and f.count:
            slope = np.linalg.norm(f.gradients(x), axis=-1).reshape(f.count, -1).sum(axis=1)
            steepest = max(steepest, float((slope / size)[some].max(initial=0.0)))
    return worst, whole, steepest * reach


def passive(structure: Structure) -> bool:
    """Whether nothing in a structure brings in energy."""
    driven = any({"speed", "at"} & set(f.args) for f in structure.features if f.name == "Path")
    args = structure.particles.args
    held = "pinned" in args or np.isinf(args.get("mass", 1.0)).any() or any(f.name in TETHERS for f in structure.features)
    driven = driven or (held and bool(np.any(args.get("spin", 0.0))))  # pinned particles that spin are rollers
    driven = driven or any(np.any(f.args.get("surface_velocity", 0.0)) for f in structure.features)  # belts
    return not driven and all(f.name in (*PASSIVE, "Path", "Pin") for f in structure.features)


def closed(structure: Structure) -> bool:
    """Whether nothing outside of a structure acts on it."""
    mass = structure.particles.args.get("mass", 1.0)
    held = "pinned" in structure.particles.args or np.isinf(mass).any()
    return not held and not any(f.name in (*PULLS, *WALLS, *TETHERS) for f in structure.features)


INNER = ("Distance", "Rope", "Winch", "Spacer", "Bend", "Motor", "AngleLimit", "Dihedral", "Area", "Volume", "ShapeMatch")


def central(structure: Structure) -> bool:
    """Whether nothing has a moment about the origin, at the start or at the end of a substep. Contacts may have one."""
    return closed(structure) and all(f.name in INNER for f in structure.features)


def spin(m: np.ndarray, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the angular momentum, by pairs of axes."""
    a, b = np.triu_indices(x.shape[1], 1)
    return m @ (x[:, a] * v[:, b] - x[:, b] * v[:, a])


def unfit(f: Any, inv_mass: np.ndarray, x: np.ndarray) -> float:
    """Return the worst misfit of rigid clusters, relative to their radii.

    The misfit is the largest distance of a movable particle from its place in the best-fitting rotated cluster (Kabsch 1976).
    """
    worst = 0.0
    for c in range(f.count):
        who = f.members_of(c)
        w = inv_mass[who]
        if f.compliance[c] > 0 or f.broken[c] or not (w > 0).any():
            continue
        heavy = 1e6 * (1 / w[w > 0]).sum()
        m = np.where(w > 0, 1 / np.where(w > 0, w, 1.0), heavy)
        q, p = f.shape_of(c), x[who]
        q, p = (a - m @ a / m.sum() for a in (q, p))
        u, s, vt = np.linalg.svd((m[:, None] * p).T @ q)
        if s[-2] < 1e-6 * s[0]:  # its rotation is not unique
            continue
        u[:, -1] *= np.sign(np.linalg.det(u @ vt))
        worst = max(worst, float(np.linalg.norm(p - q @ (u @ vt).T, axis=1)[w > 0].max()) / f._radius[c])
    return worst


def feasible(features: list[Any], particles: Any, free: np.ndarray, x: np.ndarray, eps: float) -> bool:
    """Whether a start violates nothing rigid."""
    if rigid(features, free, x)[0] > 1e-6 + 1e3 * eps:
        return False
    built = bool(np.array_equal(x, particles.position))
    periodic = any(isinstance(f, tv.Periodic) for f in features)
    for f in features:
        name = type(f).__name__
        if name in WALLS and (periodic or (gap(f, x, particles.radius)[free > 0] < -1e-6 * particles.size).any()):  # images
            return False
        if name == "Contact" and overlap(f, features, particles, free, x)[0]:
            return False
        if name == "Polygons":
            return False
        collapses = isinstance(f, Scalar) and f.quantity.collapses
        if not built and isinstance(f, Batch) and (not isinstance(f, Scalar) or collapses) and (f.compliance == 0).any():
            return False
        if collapses and (np.abs(f.violation(x)) > 1e-9 * np.abs(f.goal)).any():
            return False
    return True


def height(features: list[Any], particles: Any, free: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Return the largest difference of the potential of gravity [J] between two corners."""
    out, m = 0.0, np.where(free > 0, particles.mass, 0.0)
    for f in features:
        if type(f).__name__ == "Gravity":
            g = np.abs(np.asarray(f.kernel_values()["g"]))
            out += float(m.sum() * (g @ (high - low)))
    return out
