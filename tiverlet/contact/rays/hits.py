"""What rays have met."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hits:
    """What each of k rays meets first: a particle, a link or a wall. Of one ray, given as (dim,), all is without the first axis.

    distance: (k,) from the origin [m], inf where nothing is met. point: (k, dim), on the surface [m]. normal: (k, dim), unit, out
    of what is met, towards the side of the origin. Both are NaN where nothing is met.
    particle: (k,) its index. link: (k, 2), the number of the feature in world.features and that of the link in it. wall: (k,) the
    number of the feature. All are -1 where it is something else, or nothing.
    """

    distance: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    particle: np.ndarray
    link: np.ndarray
    wall: np.ndarray

    @property
    def met(self) -> np.ndarray:
        """Whether there is anything, Boolean (k,)."""
        return self.distance < np.inf

    def __len__(self) -> int:
        return len(self.distance)
