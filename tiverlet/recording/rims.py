"""Bodies of Polygons are rounded by the radii of their particles: the edges that pictures draw as thick lines."""

from typing import TYPE_CHECKING

import numpy as np

from ..contact import Polygons

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts


def rims(world: "World | Parts") -> tuple[np.ndarray, np.ndarray]:
    """Return the rounded edges of all bodies, (k, 2), and their radii, (k,) [m]: the means of their two ends."""
    loops = [np.asarray(loop) for f in world.features if isinstance(f, Polygons) for loop in f.loops]
    pairs = [np.stack([loop, np.roll(loop, -1)], axis=1) for loop in loops]
    edges = np.concatenate([np.zeros((0, 2), dtype=np.int64), *pairs])
    radius = world.particles.radius[edges].mean(axis=1)
    return edges[radius > 0], radius[radius > 0]
