"""The query of World.inside(): which particles are inside of a shape."""

from typing import TYPE_CHECKING

import numpy as np

from ...colliders.collider import Collider
from ...features.arguments import knobs_of

if TYPE_CHECKING:
    from ...world import World

PARTS = {"center": 0.0, "whole": 1.0, "touching": -1.0}  # least depth of the center in the shape, in radii


def inside(world: "World", shape: Collider, part: str) -> np.ndarray:
    """Return the indices of particles inside of a shape. part: a key of PARTS. See World.inside()."""
    who = "World.inside"
    if not isinstance(shape, Collider):
        raise TypeError(
            f"{who}: shape = {shape!r} is a {type(shape).__name__}, but a Box, Ball, Capsule, HalfSpace, Polygon, Mesh or Sdf is "
            "needed, such as tv.Box(lower, upper)."
        )
    if part not in PARTS:
        raise ValueError(f"{who}: part = {part!r}, but it must be one of {', '.join(map(repr, PARTS))}.")
    _check_dimension(who, shape, world.particles.dim)
    box = world._runner.scene.periodic
    x = np.asarray(world.position) if box is None else box.wrap(world.position)
    index = np.flatnonzero(np.isfinite(x).all(axis=1))
    depth = shape.clearance(x[index]) * (1 if shape.inside else -1)
    return index[depth >= PARTS[part] * world.particles.radius[index]]


def _check_dimension(who: str, shape: Collider, dim: int) -> None:
    """Raise ValueError if the shape is for another dimension."""
    if shape.dim not in (0, dim):
        raise ValueError(f"{who}: shape = {shape!r} is for {shape.dim}D, but the particles are in {dim}D.")
    for name in ("normal", *knobs_of(type(shape))):
        value = getattr(shape, name, None)
        wanted = (1 if dim == 2 else 3) if name == "rotation" else dim
        if isinstance(value, np.ndarray) and value.size not in (wanted, 0) and value.ndim:
            raise ValueError(f"{who}: shape = {shape!r} has a {name} of {value.size} numbers, but the particles are in {dim}D.")
