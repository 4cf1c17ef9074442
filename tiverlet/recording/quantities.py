"""Quantities of particles: those that every world has, and those that users log."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from .curves import CURVES

if TYPE_CHECKING:
    from ..world import World

UNITS = {"speed": "m/s", "spin": "rad/s", "load": "N", "mass": "kg", "radius": "m"}


def load(world: "World") -> np.ndarray:
    """Return the sum of the normal forces of contacts on each particle, (n,) [N], without those of walls.

    An edge of Polygons shares its load between its ends.
    """
    found, count = world.contacts, len(world.particles)
    h, place = world._clock.h, np.clip(found.place, 0, 1)
    if not h:
        return np.zeros(count)
    corner = np.concatenate([found.pairs[:, 0], found.pairs[:, 1], found.ends])
    shares = np.concatenate([np.ones(len(place)), 1 - place, place])
    return np.bincount(corner, shares * np.tile(found.impulse / h, 3), count)


QUANTITIES: dict[str, Callable[["World"], np.ndarray]] = {
    "speed": lambda world: np.linalg.norm(world.velocity, axis=1),
    "spin": lambda world: np.linalg.norm(world.spin.reshape(len(world.particles), -1), axis=1),
    "load": load,
    "mass": lambda world: world.particles.mass,
    "radius": lambda world: world.particles.radius,
    "group": lambda world: world.particles.group,
}


def is_name(name: str) -> bool:
    """Whether a quantity may have this name, which becomes part of a path in recordings and exports."""
    return name.isprintable() and "\\" not in name and not {"", ".", ".."} & {*name.split("/")}


def checked_quantities(given: dict[str, Any], count: int) -> dict[str, Any]:
    """Check the user's quantities; return them as floats and arrays (count,) in f64."""
    taken = {name for _, curves in CURVES.values() for name in curves}
    out: dict[str, Any] = {}
    for name, value in given.items():
        array = np.asarray(value)
        if name in taken:
            raise ValueError(f"Recorder.log: {name} is the name of a curve of every recording; choose another.")
        if not is_name(name):
            raise ValueError(
                f"Recorder.log: {name!r} is no name of a quantity. Write words, or a path of them such as 'arm/angle'."
            )
        if array.dtype.kind not in "biuf" or array.shape not in ((), (count,)):
            raise ValueError(
                f"Recorder.log: {name} has the shape {array.shape} and the type {array.dtype}, but a number, or one for each of "
                f"the {count} particles, is needed."
            )
        out[name] = float(array) if array.ndim == 0 else array.astype(np.float64)
    return out
