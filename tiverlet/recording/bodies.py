"""Bodies: particles that constraints and loops join."""

from typing import TYPE_CHECKING

import numpy as np

from ..contact.polygons import Polygons
from ..features.feature import Batch

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts


def bodies(world: "World | Parts") -> np.ndarray:
    """Return the body of each particle, (n,): the lowest number among the particles that constraints and loops join to it."""
    ends = [np.zeros((0, 2), dtype=np.int64)]
    for f in world.features:
        if isinstance(f, Batch) and f.count:
            members, owner = f.indices.ravel(), f.owner
            same = owner[1:] == owner[:-1]
            ends.append(np.stack([members[:-1][same], members[1:][same]], axis=1))
        elif isinstance(f, Polygons):
            ends += [np.stack([loop, np.roll(loop, 1)], axis=1) for loop in f.loops]
    a, b = np.concatenate(ends).T
    body = np.arange(len(world.particles))
    while True:  # take the lowest number at each link, then that particle's number: a few rounds suffice even for a chain
        low = np.minimum(body[a], body[b])
        new = body.copy()
        np.minimum.at(new, body[a], low)
        np.minimum.at(new, body[b], low)
        while (new != new[new]).any():
            new = new[new]
        if (new == body).all():
            return body
        body = new
