"""An ordinary rigid box."""

from dataclasses import replace

import numpy as np

from .. import checks
from .shape import Shape, point
from .solids import truss


@checks.answer_arguments
def box(center, size, radius: float = 0.0) -> Shape:
    """Make a box around `center`, of this outer size [m], with edges rounded by a radius, in 2D or 3D.

        brick = tv.shapes.box((0, 1), (0.4, 0.2), radius=0.02)
        particles = tv.Particles(brick.position, radius=brick.radius)
        world = tv.World(particles, [tv.Polygons(brick.loops), tv.ShapeMatch(brick.loops)])

    size: number or (dim,) [m], above 2 radius. radius: [m] of its particles, at least 0.
    2D: four corners, with their loop. They hold all of its mass, so it takes three times the torque of a uniform plate to turn.
    3D: spheres that fill the box, so close that nothing of their size passes between them: one cluster of ShapeMatch, with
    Contact. Of radius 0: eight corners.
    links, braces, faces, tetrahedra: as in truss.
    """
    middle = point("box", "center", center)
    radius = checks.number("box", "radius", radius, least=0.0)
    sides = checks.per_item("box", "size", size, len(middle), above=2 * radius)
    half = sides / 2 - radius
    cells = np.ones(len(middle), dtype=int)
    if len(middle) == 3 and radius:
        cells = np.maximum(1, np.ceil(half / radius - 1e-9)).astype(int)
    found = truss(middle - half, middle + half, cells)
    return replace(found, radius=np.full(len(found), radius))
