"""The contracts of the shapes that moving colliders hold."""

from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..device import ti

if TYPE_CHECKING:
    from ..features.feature import Scene
    from ..particles import Particles


class HostShape(Protocol):
    """A shape in a frame of its own, for questions of the host. who: the collider that holds it. radius: with what the shape is
    thickened by [m]."""

    def check(self, who: str, particles: "Particles", radius: float) -> None:
        """Raise ValueError for particles that it is no wall for."""
        ...

    def on_device(self, scene: "Scene", who: str, radius: float) -> "Shape":
        """The same in a world."""
        ...

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """How far points (k, dim) are from it [m], negative inside of it, (k,)."""
        ...

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """As Collider.cast()."""
        ...


class Shape:
    """What particles stay outside of, on the device, in a frame of its own; radius: what it is thickened by [m].

    guesses: strike() may miss a touch, so that ends of ways are looked at: a place is free or astray(). slides: nothing bounces,
    so what slides on it may be pushed along the normal at the start of its way.
    """

    guesses = False
    slides = False

    @ti.func
    def strike(self, a, e, contact_distance, close, limit):
        """The first touch of a particle, whose center must stay at `contact_distance` from the shape, on its way from a to a + e.

        close: what rounding amounts to. limit: how far a start that is inside may be pushed out.
        Returns the fraction of the way (2 for none), the depth at a + e below the plane that touches there, and its normal.
        """
        return 0 * contact_distance + 2, 0 * contact_distance, 0 * e

    @ti.func
    def rounding(self, q):
        """What it amounts to around a point q of the shape's frame [m]."""
        return 0 * q[0]

    @ti.func
    def astray(self, q, contact_distance, close):
        """Whether a particle with its center at q, in the shape's frame, is inside of it."""
        return False
