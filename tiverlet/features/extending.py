"""How a feature takes more constraints, or bodies, behind its own."""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..particles import Particles


def extended(feature: Any, more: Any, start: "Particles", now: "Particles", box: Any) -> "Particles":
    """Give a feature that is not bound more constraints, which start now. Returns where it started: for what it had, when that
    came; for other particles, now."""
    more.periodic, more.start = box, now
    inv_mass = now.inv_mass.copy()
    more.prepare(now, inv_mass)
    more.review(now, inv_mass)
    position = np.array(now.position)
    mine = feature.indices.ravel()
    position[mine] = start.position[mine]
    feature.extend(more)
    return start.placed(position)
