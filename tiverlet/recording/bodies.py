"""Bodies: particles that constraints and loops join, and their rounded edges."""

from typing import TYPE_CHECKING

import numpy as np

from ..contact.loops import flat
from ..contact.polygons import Polygons
from ..features.feature import Batch
from ..solvers.corners import components

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts


def bodies(world: "World | Parts") -> np.ndarray:
    """Return the body of each particle, (n,): the lowest number among the particles that constraints and loops join to it."""
    who, what, count = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], 0
    for f in world.features:
        if isinstance(f, Batch) and f.count:
            who.append(f.indices.ravel())
            what.append(count + f.owner)
            count += f.count
        elif isinstance(f, Polygons) and len(f.loops):
            corner, _, owner = flat(list(f.loops))
            who.append(corner)
            what.append(count + owner)
            count += len(f.loops)
    return components(len(world.particles), np.concatenate(who), np.concatenate(what))


def rims(world: "World | Parts") -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of Polygons with a radius, (k, 2), and their radii, (k,) [m]: the means of their two ends."""
    loops = [np.asarray(loop) for f in world.features if isinstance(f, Polygons) for loop in f.loops]
    pairs = [np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops]
    edges = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    radius = world.particles.radius[edges].mean(axis=1)
    return edges[radius > 0], radius[radius > 0]
