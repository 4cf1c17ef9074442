"""Physical quantities of a scene, computed from plain arrays in f64: for tests and reports."""

from typing import TYPE_CHECKING, Any

import numpy as np

from .features.unknown_names import no_name
from .geometry.intervals import cross_2d
from .neighbours.queries import between
from .particles.spin import moments_of_inertia

if TYPE_CHECKING:
    from .neighbours import Periodic
    from .world import World

__all__ = [
    "angular_momentum", "center_of_mass", "kinetic_energy", "moment_sum", "momentum", "overlapping", "strain", "torque",
]  # fmt: skip


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
