"""Bodies: particles that constraints and loops join."""

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
