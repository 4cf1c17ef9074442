"""Every constraint, with corners at which it shows what it does: a new constraint is one row."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import tiverlet as tv


@dataclass(frozen=True)
class Row:
    """A kind of constraint, and corners at which it shows all that it can do.

    make: (corners (m, arity), rest (m,), **options) -> feature, violated by f(points) - rest.
    points: (arity, dim) [m] in general position. off: how far f is from rest, on the violated side.
    internal: moves no center of mass and turns nothing; False for constraints to the surroundings.
    bilateral: holds on both sides, so it is second order.
    largest: [m] the largest size for f32.
    like: the row that stands for this one in tests of divided batches and cloned worlds, because the same code handles the same
    fields: CornerPasses for a fixed number of corners, OutlinePasses for loops and surfaces.
    """

    make: Callable
    points: np.ndarray
    off: float
    internal: bool = True
    bilateral: bool = True
    largest: float = 1e15
    like: str = "Bend 3D"


LINK = np.array([[0.1, 0.2, -0.1], [0.7, -0.3, 0.4]])
PATH = np.array([[-0.4, 0.3, 0.1], [0.1, -0.2, 0.0], [0.6, 0.4, 0.3]])
WINGS = np.array([[0.0, -0.1, 0.0], [0.9, 0.1, 0.1], [0.3, 0.8, 0.2], [0.5, -0.6, 0.4]])


def limit(corners, rest, **options):
    """Return a limit on the angle at these corners: at most `rest`."""
    return tv.AngleLimit(corners, np.zeros(len(corners)), rest, **options)


def spread(a, b, c):
    """Return a length plus a product of lengths, of three corners."""
    return (a - b).norm() + (b - c).norm() * (c - a).norm()


def radius(x):
    """Return the distance from the origin."""
    return x.norm()


def outward(x):
    """Return the gradient of radius()."""
    return x / x.norm()


def made(function, **more):
    """Return the `make` of a row for a constraint of the user."""
    return lambda corners, rest, **options: tv.Constraint(function, corners, rest, **more, **options)


ROWS = {
    "Distance 3D": Row(tv.Distance, LINK, -0.1),
    "Rope 2D": Row(tv.Rope, LINK[:, :2], 0.1, bilateral=False),
    "Spacer 2D": Row(tv.Spacer, LINK[:, :2], -0.1, bilateral=False),
    "Bend 2D": Row(tv.Bend, PATH[:, :2], 0.3),
    "Bend 3D": Row(tv.Bend, PATH, -0.3),
    "AngleLimit 3D": Row(limit, PATH, 0.3, bilateral=False),
    "Dihedral 3D": Row(tv.Dihedral, WINGS, 0.3),
    "Area 3D": Row(tv.Area, PATH, 0.02),
    "Area of loops 2D": Row(tv.Area, WINGS[[0, 3, 1, 2], :2], 0.05, like="Volume of surfaces"),
    "Volume 3D": Row(tv.Volume, WINGS, 0.01, largest=1e9),
    "Constraint 2D": Row(made(spread), PATH[:, :2], 0.2),
    "Constraint 3D": Row(made(radius, gradient=outward), LINK[1:], 0.1, internal=False),
}

TETRA = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])


def shells(corners):
    """Return closed surfaces of four faces."""
    return tv.Volume(np.concatenate([row[TETRA] for row in np.asarray(corners)]), pressure=1.1)


# Constraints that are not one number, or that are the same in other kernels: corners, a function that makes them, and the reason
# why they are no row above. Tests of divided batches and clones run all of them.
OTHERS = {
    "Pin": (
        LINK[:1],
        lambda c: tv.Pin(c[:, 0], (0.0, 1.0, 0.0), compliance=1e-3),
        "a vector with unit gradients: none is degenerate",
    ),
    "Pin, driven": (LINK[:1], lambda c: tv.Pin(c[:, 0]), "puts particles in place, and solves nothing"),
    "Snap": (LINK[:1], lambda c: tv.Snap(c[:, 0], 0.3, compliance=1e-2), "a vector with unit gradients: none is degenerate"),
    "Path": (PATH[:1], lambda c: tv.Path(c[:, 0], PATH), "a vector across a curve; see test_paths.py for ends, corners, loops"),
    "Path, driven": (PATH[:1], lambda c: tv.Path(c[:, 0], PATH, speed=0.3), "puts particles in place, and solves nothing"),
    "Motor": (
        PATH[:, :2],
        lambda c: tv.Motor(c, 2.0, torque=0.3, compliance=1e-3),
        "its rest angle moves; see test_motors.py for what it does in degenerate places, too",
    ),
    "Motor of quads": (WINGS, lambda c: tv.Motor(c, 2.0, angle=0.1), "the same with the gradients of Dihedral"),
    "Winch": (LINK, lambda c: tv.Winch(c, -0.3, force=5.0), "its length moves; it is a Rope otherwise"),
    "ShapeMatch": (
        WINGS[:, :2],
        lambda c: tv.ShapeMatch(c, compliance=1e-3),
        "a vector for each corner; see test_bodies.py for its extremes",
    ),
    "Volume of surfaces": (WINGS, shells, "the law of Area of loops 2D with other gradients, which test_bodies.py compares"),
}
