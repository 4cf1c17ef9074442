"""Physical quantities of a scene, computed from plain arrays in f64: for tests and reports."""

from itertools import product
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .features.unknown_names import no_name
from .geometry.intervals import cross_2d
from .neighbours.queries import between
from .particles.spin import moments_of_inertia

if TYPE_CHECKING:
    from .neighbours import Periodic
    from .world import World

__all__ = [
    "Stress", "angular_momentum", "center_of_mass", "coordination", "granular_temperature", "kinetic_energy", "moment_sum",
    "momentum", "overlapping", "strain", "stress", "torque",
]  # fmt: skip


class Stress(NamedTuple):
    """A stress, (dim, dim) [N/m in 2D, Pa in 3D], positive where it presses, and its parts."""

    total: np.ndarray
    contact: np.ndarray
    kinetic: np.ndarray


def kinetic_energy(world: "World") -> float:
    """Return the sum of m v^2 / 2 and of I omega^2 / 2 [J]; static particles have none."""
    m, moment, spin = _mass(world), moments_of_inertia(world.particles), _spin(world)
    return float(0.5 * np.sum(m * np.sum(world.velocity**2, axis=1)) + 0.5 * np.sum(moment * np.sum(spin**2, axis=1)))


def momentum(world: "World") -> np.ndarray:
    """Return the sum of m v [kg m/s], (dim,)."""
    return _mass(world) @ world.velocity


def angular_momentum(world: "World", about=None) -> np.ndarray:
    """Return the sum of m (x - about) x v + I omega [kg m^2/s], (1,) in 2D, (3,) in 3D; about the origin if no point is given."""
    r = world.position - (0.0 if about is None else np.asarray(about))
    p = _mass(world)[:, None] * world.velocity
    return moments_of_inertia(world.particles) @ _spin(world) + moment_sum(r, p)


def moment_sum(r: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the sum of r x p of vectors (n, dim): (1,) in 2D, (3,) in 3D."""
    if r.shape[1] == 2:
        return np.array([np.sum(cross_2d(r, p))])
    return np.cross(r, p).sum(axis=0)


def torque(world: "World") -> np.ndarray:
    """Return the torque of contacts and walls on each spinning particle in the last substep [N m]: (n,) in 2D, (n, 3) in 3D."""
    out = world._runner.torque()
    return out[:, 0] if world.particles.dim == 2 else out


def center_of_mass(world: "World") -> np.ndarray:
    """Return the center of mass of particles that can move [m], (dim,). Raises ValueError if there are none."""
    m = _mass(world)
    if not m.any():
        raise ValueError("measure.center_of_mass: no particle can move. The mean position is world.position.mean(axis=0).")
    return m @ world.position / m.sum()


def strain(world: "World", pairs, rest) -> np.ndarray:
    """Return (|x_i - x_j| - rest) / rest of each pair, (m,)."""
    i, j = np.asarray(pairs).T
    x = world.position
    return np.linalg.norm(between(x[i], x[j], world._runner.scene.periodic), axis=1) / np.asarray(rest) - 1


def granular_temperature(world: "World", part=None) -> float:
    """Return the mean square of velocity fluctuations, over the dimensions [m^2/s^2], weighted with masses.

    Fluctuations are about the mean velocity, and in a sheared box about its profile. part: indices or a mask of particles; None
    for all that can move. Raises ValueError if none of them can.
    """
    some = np.arange(len(world.particles)) if part is None else part
    m = _mass(world)[some]
    if not m.any():
        raise ValueError("measure.granular_temperature: none of these particles can move.")
    return float(m @ (_fluctuations(world, some) ** 2).mean(axis=1) / m.sum())


def coordination(world: "World") -> float:
    """Return how many contacts a particle has in the mean, of those that bear a load and of particles that have one; else 0."""
    found = world.contacts
    ends = np.concatenate([found.pairs, np.where(found.ends != found.pairs[:, 1], found.ends, -1)[:, None]], axis=1)
    ends = ends[found.impulse > 0]
    ends = ends[ends >= 0]
    return len(ends) / len(np.unique(ends)) if len(ends) else 0.0


def stress(world: "World", region=None) -> Stress:
    """Return the stress of discs and spheres in a region, by Love and Weber's sum over contacts and by the motion of particles.

    P = (sum f l^T + sum m v v^T) / V, with the force f on particle i, the vector l from j to i, and velocities v about the mean.
    Of a contact counts the part of l within the region, so that P n A is the mean force through planes across n. Walls and links
    are no part of it.

    region: (lower, upper) corners of a box [m]; None for all of a box that is periodic along all axes. Raises ValueError without
    a volume, for a region in a sheared box, and beside Polygons.
    """
    box, x = world._runner.scene.periodic, world.position
    if any(contact.dev.rows.edges for contact in world._runner.step.contacts):
        raise ValueError("measure.stress: bodies of Polygons touch with their edges. Sum up world.contacts over pairs of bodies.")
    whole = box if region is None and box is not None and np.isfinite(box.lengths).all() else None
    if not whole and (region is None or (box is not None and box.sheared)):
        why = "the world has no volume" if region is None else "a region of a sheared box moves"
        raise ValueError(f"measure.stress: {why}. Give region=(lower, upper), or take a whole box that is periodic everywhere.")
    lower, upper = np.asarray((whole.low, whole.high) if whole else region, dtype=np.float64)
    found = world.contacts
    i, j = found.pairs.T
    force, way = (found.impulse[:, None] * found.normal + found.tangential) / (world._clock.h or 1.0), between(x[i], x[j], box)
    part, inside = np.ones(len(i)), np.ones(len(x), dtype=bool)
    if not whole:
        place = x if box is None else box.wrap(x)
        length = np.zeros(x.shape[1]) if box is None else np.where(np.isfinite(box.lengths), box.lengths, 0.0)
        images = np.array([*product(*[(-1, 0, 1) if repeats else (0,) for repeats in length])]) * length
        part = np.sum([_part_within(place[j] + by, way, lower, upper) for by in images], axis=0)
        inside = ((lower <= place) & (place < upper)).all(axis=1)
    v, m, volume = _fluctuations(world, inside), _mass(world)[inside], np.prod(upper - lower)
    contact, kinetic = np.einsum("c,ca,cb->ab", part, force, way) / volume, np.einsum("i,ia,ib->ab", m, v, v) / volume
    return Stress(contact + kinetic, contact, kinetic)


def _fluctuations(world: "World", some: Any) -> np.ndarray:
    """Return velocities of some particles about their mean, and about the profile of a sheared box, (k, dim) [m/s]."""
    box, m, v = world._runner.scene.periodic, _mass(world)[some], np.array(world.velocity[some])
    if box is not None:
        v[:, 0] -= box.shear * world.position[some, 1]
    return v - m @ v / (m.sum() or 1.0)


def _part_within(begin: np.ndarray, way: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the parts of the lines from `begin` along `way` (m, dim) that are within a box, (m,)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(lower - begin) / way, (upper - begin) / way]), axis=0)  # NaN: along a face, and on it
    first, last = np.nan_to_num(ends, nan=0.0, posinf=np.inf, neginf=-np.inf)
    beside = ((way == 0) & ((begin < lower) | (begin >= upper))).any(axis=1)
    out = np.minimum(last.min(axis=1, initial=1.0), 1.0) - np.maximum(first.max(axis=1, initial=0.0), 0.0)
    return np.where(beside, 0.0, np.maximum(out, 0.0))


def overlapping(
    position: np.ndarray, radius, skin: float = 0.0, periodic: "Periodic | None" = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return all pairs of discs or spheres that overlap or are less than `skin` [m] apart.

    Returns pairs (m, 2) with i < j, in order, and their overlap plus the skin, (m,) [m]. periodic: the box, in which images count
    too. It sweeps along x, an algorithm independent of the contact search of a World.
    """
    position = np.asarray(position, dtype=np.float64)
    radius = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(position),))
    if periodic is not None:
        number, image = periodic.ghosts(position, 2 * float(radius.max(initial=0.0)) + skin)
        pairs, deep = overlapping(image, radius[number], skin)
        some = (pairs < len(position)).any(axis=1)
        both, row = np.unique(np.sort(number[pairs[some]], axis=1), axis=0, return_inverse=True)
        deepest = np.zeros(len(both))
        np.maximum.at(deepest, row.ravel(), deep[some])
        return both[both[:, 0] != both[:, 1]], deepest[both[:, 0] != both[:, 1]]
    order = np.argsort(position[:, 0], kind="stable")
    x, r = position[order], radius[order]
    ends = np.searchsorted(x[:, 0], x[:, 0] + r + (r.max(initial=0.0) + skin), side="right")
    pairs, depths = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)]
    for k, end in enumerate(ends):
        depth = r[k] + r[k + 1 : end] + skin - np.linalg.norm(x[k + 1 : end] - x[k], axis=1)
        near = np.flatnonzero(depth > 0)
        pairs.append(np.stack([np.full(len(near), order[k]), order[k + 1 + near]], axis=1))
        depths.append(depth[near])
    both, deep = np.sort(np.concatenate(pairs), axis=1), np.concatenate(depths)
    order = np.lexsort((both[:, 1], both[:, 0]))
    return both[order], deep[order]


def _spin(world: "World") -> np.ndarray:
    """Return angular velocities, (n, 1) in 2D and (n, 3) in 3D [rad/s]."""
    shape = len(world.particles), world.particles.axes
    return world.spin.reshape(shape) if world.particles.spins else np.zeros(shape)


def _mass(world: "World") -> np.ndarray:
    p = world.particles
    return np.where(p.inv_mass > 0, p.mass, 0.0)


if not TYPE_CHECKING:  # type checkers know which names there are

    def __getattr__(name: str) -> Any:
        """Raise an AttributeError that says which name is meant."""
        raise no_name(__name__, name, __all__)
