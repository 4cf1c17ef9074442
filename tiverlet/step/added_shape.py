"""A Shape that is added to a world as it is: the constraints that need no choice."""

from typing import Any

import numpy as np

from ..constraints.angle_limit import AngleLimit
from ..constraints.distance import Distance
from ..contact.polygons import Polygons
from ..features.feature import Batch, Feature
from ..shapes import Shape


def features(world: Any, shape: Shape) -> tuple[list[Feature], dict[Feature, Feature]]:
    """Return the features of a shape, and those by which features of the world are extended.

    links and braces are a rigid Distance, limits an AngleLimit. Loops around all particles become bodies of a Polygons.
    """
    n = len(world.particles)
    found: list[Feature] = []
    pairs = np.concatenate([shape.links, shape.braces])
    if len(pairs):
        found.append(Distance(pairs + n))
    if len(shape.limits):
        found.append(AngleLimit(shape.limits + n, shape.lower, shape.upper))
    extend = {}
    for more in list(found):
        like = [f for f in world.features if _takes(f, more)]
        if like:
            extend[like[0]] = more
            found.remove(more)
    bodies = [f for f in world.features if isinstance(f, Polygons)]
    if bodies and shape.loops and len(np.unique(np.concatenate(shape.loops))) == len(shape):
        loops = [loop + n for loop in shape.loops]
        extend[bodies[0]] = Polygons(**{**bodies[0].arguments, "loops": loops})  # type: ignore[arg-type]
    return found, extend


def _takes(feature: Feature, more: Feature) -> bool:
    """Whether a feature is rigid, does not break, and is of the same kind."""
    if not (isinstance(feature, Batch) and type(feature) is type(more)):
        return False
    return not (np.any(getattr(feature, "compliance", 0)) or feature.breaks or feature.driven)
