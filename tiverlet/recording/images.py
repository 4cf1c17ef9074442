"""What pictures show of a periodic box: each body where its middle is in the box, and no link across the whole of it."""

from typing import TYPE_CHECKING

import numpy as np

from ..neighbours import Periodic
from .surfaces import bodies

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts


class InBox:
    """Where particles of a world are drawn. Bodies stay whole, so they may reach out of the box."""

    def __init__(self) -> None:
        self._known: tuple = (None, None)
        self._body = self._count = np.zeros(0, dtype=np.int64)

    def places(self, world: "World", x: np.ndarray) -> np.ndarray:
        """Of particles at x (n, dim) [m]; x itself where the world has no periodic box."""
        box = box_of(world)
        if box is None or not len(x):
            return x
        if self._known != (id(world.particles), world.features):  # bodies change where particles or features come or go
            self._known = id(world.particles), world.features
            _, self._body, self._count = np.unique(bodies(world), return_inverse=True, return_counts=True)
        finite = np.where(np.isfinite(x), x, 0.0)
        middle = np.stack([np.bincount(self._body, v) for v in finite.T], axis=1) / self._count[:, None]
        return x - box.away(box.boxes(middle))[self._body]


def box_of(world: "World | Parts") -> Periodic | None:
    """The periodic box, if there is one."""
    return next((f for f in world.features if isinstance(f, Periodic)), None)


def torn(box: Periodic | None, r: np.ndarray) -> np.ndarray:
    """Which differences of places (m, dim), as they are drawn, lead to an image further off than the nearest, (m,)."""
    return np.zeros(len(r), dtype=bool) if box is None else np.any(np.abs(r) > box.lengths / 2, axis=1)
