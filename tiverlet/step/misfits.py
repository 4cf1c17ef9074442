"""Checks of features beside Periodic and Sleep: what exceeds half a periodic box, walls across it, and what cannot sleep."""

import numpy as np

from ..colliders import Box, HalfSpace
from ..colliders.collider import Collider
from ..constraints import Area, Constraint, ShapeMatch, Volume
from ..constraints.core.length import is_link
from ..contact import Contact, Polygons
from ..features.feature import Acceleration, Batch, Feature
from ..forces import PairForce
from ..neighbours.periodic import AXES, Periodic
from ..particles import Particles


def refuse_misfits(box: Periodic, particles: Particles, features: tuple[Feature, ...]) -> None:
    """Raise ValueError for features that do not fit into a periodic box, such as those that reach two images of a particle."""
    for feature in features:
        if isinstance(feature, Polygons):
            raise ValueError("Periodic: Polygons do not know of images. Use Contact, for bodies made of discs.")
        if isinstance(feature, Contact):
            box.refuse("Contact", "two particles touch", 2 * float(particles.radius.max(initial=0.0)), "radii")
        if isinstance(feature, PairForce):
            if feature.radius is None:
                raise ValueError(
                    "Periodic: a PairForce without a radius has no end, and every particle has images without end. "
                    f"Give PairForce(..., radius={box.shortest / 2:g}) or less."
                )
            box.refuse(repr(feature), "pairs act", feature.radius, "a radius")
        if isinstance(feature, Collider):
            _refuse_wall(box, feature)
        if is_link(feature) and feature.count:
            box.refuse(repr(feature), f"link {int(feature.goal.argmax())} holds particles", feature.goal.max(), "links", True)
        if isinstance(feature, Batch) and isinstance(feature, (Area, Constraint, ShapeMatch, Volume)) and feature.arity != 1:
            _refuse_torn(box, feature)


def _refuse_wall(box: Periodic, wall: Collider) -> None:
    """Raise ValueError for a wall across a periodic axis, or an obstacle in a sheared box."""
    along: list[int] = []
    if isinstance(wall, Box):
        along = [k for k in box.axes if np.isfinite([wall.lower[k], wall.upper[k]]).any()]
        remedy = "-inf and inf leave a side of a Box open"
    elif isinstance(wall, HalfSpace):
        along = [k for k in box.axes if wall.normal[k] != 0]
        remedy = "let gravity have the slope instead"
    elif box.sheared:
        raise ValueError(f"Periodic: {wall!r} stands still, but a sheared box has images that slide. Leave one of them out.")
    if along:
        raise ValueError(f"Periodic: {wall!r} stops what goes along {AXES[along[0]]}, which is periodic; {remedy}.")


def _refuse_torn(box: Periodic, batch: Batch) -> None:
    """Raise ValueError for a body whose particles are on different sides of the box: bodies use unwrapped positions."""
    x, owner = batch.start.position[batch.indices.ravel()], batch.owner
    first = x[np.searchsorted(owner, np.arange(batch.count))] if batch.count else x
    far = np.abs(x - first[owner]) > box.lengths / 2
    if far.any():
        e, k = (int(v) for v in np.argwhere(far)[0])
        raise ValueError(
            f"Periodic: {batch!r}: particle {batch.indices.ravel()[e]} of number {owner[e]} is more than half a box from its "
            f"first one along {AXES[k]}. Give unwrapped positions, which keep a body together; it may reach out of the box."
        )


def refuse_restless(features: tuple[Feature, ...], order: int) -> None:
    """Raise ValueError for features and orders that Sleep does not support."""
    for f in features:
        if isinstance(f, Acceleration) and f.pairwise:
            raise ValueError(f"Sleep: {f!r} reaches through space, from one island to the next. Leave one of both out.")
        if getattr(f, "shear", 0.0):
            raise ValueError("Sleep: in a sheared Periodic box nothing comes to rest. Leave it out.")
    if order > 2:
        raise ValueError(f"Sleep: order = {order} is for motion without contacts; Sleep is for order 2.")
