"""Appending constraints or bodies to a feature."""

from typing import TYPE_CHECKING, Any

import numpy as np

from .feature import Batch

if TYPE_CHECKING:
    from ..particles import Particles


def extended(feature: Any, more: Any, start: "Particles", now: "Particles", box: Any) -> "Particles":
    """Append to an unbound feature more constraints, which start now.

    Returns the particles by which the extended feature starts. Those of its own constraints are where they were when the feature
    was added; all others are where they are now.
    """
    more.periodic, more.start = box, now
    inv_mass = now.inv_mass.copy()
    more.prepare(now, inv_mass)
    if isinstance(more, Batch):  # bodies are reviewed with all constraints, see check_added()
        more.review(now, inv_mass)
    position = np.array(now.position)
    mine = feature.indices.ravel()
    position[mine] = start.position[mine]
    feature.extend(more)
    return start.placed(position)
