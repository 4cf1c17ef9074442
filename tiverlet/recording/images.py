"""Pictures of a periodic box: each body is drawn where its centre is inside the box, and no link crosses the whole box."""

from typing import TYPE_CHECKING

import numpy as np

from ..neighbours import Periodic
from .bodies import bodies

if TYPE_CHECKING:
    from ..world import World
    from .scene import Parts


class InBox:
    """Computes where particles of a world are drawn. Bodies stay whole, so they may extend beyond the box."""

    def __init__(self) -> None:
        self._known: tuple = (None, None)
        self._body = self._count = np.zeros(0, dtype=np.int64)

    def drawn_positions(self, world: "World", x: np.ndarray) -> np.ndarray:
        """Return where particles at x (n, dim) [m] are drawn; x itself if the world has no periodic box."""
        box = box_of(world)
        if box is None or not len(x):
            return x
        if self._known != (id(world.particles), world.features):  # bodies change when particles or features are added or removed
            self._known = id(world.particles), world.features
            _, self._body, self._count = np.unique(bodies(world), return_inverse=True, return_counts=True)
        finite = np.where(np.isfinite(x), x, 0.0)
        middle = np.stack([np.bincount(self._body, v) for v in finite.T], axis=1) / self._count[:, None]
        return x - box.away(box.boxes(middle))[self._body]


def box_of(world: "World | Parts") -> Periodic | None:
    """Return the periodic box, or None."""
    return next((f for f in world.features if isinstance(f, Periodic)), None)


def crosses_box(box: Periodic | None, r: np.ndarray) -> np.ndarray:
    """Whether each difference of drawn positions (m, dim) leads to an image farther off than the nearest one, (m,)."""
    return np.zeros(len(r), dtype=bool) if box is None else np.any(np.abs(r) > box.lengths / 2, axis=1)
