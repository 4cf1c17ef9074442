"""What a scene amounts to, from plain arrays in f64: for tests, for reports, for the curious."""

import numpy as np

from .world import World


def kinetic_energy(world: World) -> float:
    """Sum of m v^2 / 2 [J]; static particles have none."""
    m = _mass(world)
    return float(0.5 * np.sum(m * np.sum(world.velocity**2, axis=1)))


def momentum(world: World) -> np.ndarray:
    """Sum of m v [kg m/s], (dim,)."""
    return _mass(world) @ world.velocity


def angular_momentum(world: World, about=None) -> np.ndarray:
    """Sum of m (x - about) x v [kg m^2/s]: (1,) in 2D, (3,) in 3D; about the origin where no point is given."""
    r = world.position - (0.0 if about is None else np.asarray(about))
    p = _mass(world)[:, None] * world.velocity
    if r.shape[1] == 2:
        return np.array([np.sum(r[:, 0] * p[:, 1] - r[:, 1] * p[:, 0])])
    return np.cross(r, p).sum(axis=0)


def center_of_mass(world: World) -> np.ndarray:
    """Of the particles that can move [m], (dim,)."""
    m = _mass(world)
    return m @ world.position / m.sum()


def strain(world: World, pairs, rest) -> np.ndarray:
    """(|x_i - x_j| - rest) / rest of each pair, (m,)."""
    i, j = np.asarray(pairs).T
    x = world.position
    return np.linalg.norm(x[i] - x[j], axis=1) / np.asarray(rest) - 1


def overlapping(position: np.ndarray, radius) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of discs or spheres that overlap, by comparing each with each: pairs (m, 2) with i < j, and depths (m,) [m]."""
    position = np.asarray(position, dtype=np.float64)
    radius = np.broadcast_to(np.asarray(radius, dtype=np.float64), (len(position),))
    pairs, depths = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0)]
    for i in range(len(position) - 1):
        depth = radius[i] + radius[i + 1 :] - np.linalg.norm(position[i + 1 :] - position[i], axis=1)
        j = np.flatnonzero(depth > 0)
        pairs.append(np.stack([np.full(len(j), i), i + 1 + j], axis=1))
        depths.append(depth[j])
    return np.concatenate(pairs), np.concatenate(depths)


def _mass(world: World) -> np.ndarray:
    p = world.particles
    return np.where(p.inv_mass > 0, p.mass, 0.0)
