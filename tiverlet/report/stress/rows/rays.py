"""Rows about rays: without direction, along walls, from surfaces, and in very small and very large scenes."""

import numpy as np

from ....colliders import Ball, Box, Capsule, HalfSpace, Mesh, Polygon
from ....particles import Particles
from .row import INF, Findings, at_most, row, summary, world

FLOORS = (Box((-9, 0), (9, 9)), HalfSpace((0, 1)), Polygon([(-9, -1), (9, -1), (9, 0), (-9, 0)]), Capsule((-9, -1), (9, -1), 1.0))
SIZES = (1e-6, 1e-3, 1.0, 1e3, 1e6)


@row(91, "rays along a wall, from its surface, from inside of it", "in at 0, along and out never")
def _along() -> Findings:
    holds = {}
    for wall in FLOORS:
        for name, height, way, far in (
            ("along", 0.1, (1, 0), INF), ("from the surface, along", 0.0, (1, 0), INF), ("from inside, out", -0.5, (0, 1), INF),
            ("from the surface, out", 0.0, (0, 1), INF), ("from the surface, in", 0.0, (0, -1), 0.0), ("down", 1.0, (0, -1), 1.0),
        ):  # fmt: skip
            if isinstance(wall, Capsule) and name == "from the surface, along":
                continue  # the ray would follow the seam between its round end and its side
            distance, _ = wall.cast(np.array([[0.0, height]]), np.array([way], dtype=float), 0.0)
            holds[f"{wall!r}: {name}"] = bool(np.where(distance < 8, distance, INF)[0] == far)  # other sides are further away
    yield from summary(f"{sum(holds.values())} of {len(holds)} as they should", holds)


@row(92, "rays in scenes of 1e-6 ... 1e6 m, and 1e6 of their size away", "within 1e-12 of the largest length in f64, 5e-9 in f32")
def _sizes() -> Findings:
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
    start, way = np.array([-3.0, 0.2, 0.1]), np.array([1.0, 0.0, 0.0])
    round_off = np.sqrt(1 - 0.2**2 - 0.1**2)  # half the chord of a ball of 1 m along the ray
    for precision, limit in (("f64", 1e-12), ("f32", 5e-9)):
        worst = []
        for size in SIZES:
            for away in (0.0, 1e6 * size):
                place = np.array([0.0, away, 0.0])
                features = [Ball(place, size), Mesh(size * cube, faces, position=place)]
                with world(Particles([place], radius=size), features, precision=precision) as w:
                    for what, far in (((), 3 - round_off), (features[:1], 3 - round_off), (features[1:], 2.0)):
                        hit = w.ray(size * start + place, way, groups=None if not what else (), features=what)
                        off = float(abs(hit.distance - size * far)) / (size + away)
                        worst.append((off, f"{size:g} m, {away:g} m away, {what}"))
        yield at_most(f"{precision}: off by {max(worst)[0]:.2g} ({max(worst)[1]})", max(worst)[0], limit)
