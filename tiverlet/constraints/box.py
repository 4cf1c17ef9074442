"""A box with particles inside."""

import numpy as np
import taichi as ti

from .. import checks
from ..feature import Knob, Scene
from ..particles import Particles
from ..wall import Wall


def _corner(name: str):
    def check(box: "Box", value):
        value = checks.vector("Box", name, value, box.dim or len(np.atleast_1d(value)), infinite=True)
        other = box.__dict__.get("upper" if name == "lower" else "lower")
        if other is not None and len(other) == len(value):
            lower, upper = (value, other) if name == "lower" else (other, value)
            narrow = upper - lower < 2 * box.widest
            if (narrow | (upper <= lower)).any():
                k = int(np.argmax(narrow | (upper <= lower)))
                raise ValueError(
                    f"Box: along axis {k} it goes from {lower[k]:g} to {upper[k]:g} m, which does not hold a particle of "
                    f"radius {box.widest:g} m. Make upper - lower at least {2 * box.widest:g} m and above 0."
                )
        return value

    return check


class Box(Wall):
    """Particles stay inside: lower + radius <= x <= upper - radius along every axis.

    C(x) = x_k - lower_k - radius >= 0 and upper_k - x_k - radius >= 0, with unit gradients along axis k.

    lower, upper: (dim,) [m]; -inf and inf leave a side open. Live: assign to .lower or .upper between frames, and the walls move
    there during the next frame (to or from an open side they jump). friction, restitution, push_out:
    see Wall.

    One-sided: a particle cannot leave at any speed.
    """

    dim = 0
    widest = 0.0
    lower = Knob(_corner("lower"), "Lower corner [m].")
    upper = Knob(_corner("upper"), "Upper corner [m].")

    def __init__(self, lower, upper, *, friction=0.0, restitution=0.0, push_out=1.0):
        self.lower = lower
        self.upper = upper
        self.surface(friction, restitution, push_out)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the corners against the dimension and the widest particle."""
        self.dim = particles.dim
        self.widest = float(particles.radius.max(initial=0.0))
        self.lower, self.upper = self.lower, self.upper

    def bind(self, scene: Scene) -> None:
        """Corners at the start and the end of a frame."""
        Wall.bind(self, scene)
        self._on_corners = [
            scene.memory.field(f"Box.{name}", None, width=self.dim, values=value, state=True)
            for name, value in (
                ("lower_from", self.lower),
                ("lower", self.lower),
                ("upper_from", self.upper),
                ("upper", self.upper),
            )
        ]
        self._on_aim = (self.lower, self.upper)
        self.changed = False

    def upload(self) -> None:
        """Move from the last corners to the new ones."""
        for k, (old, new) in enumerate(zip(self._on_aim, (self.lower, self.upper), strict=True)):
            jump = np.isinf(old) | np.isinf(new)
            self._on_corners[2 * k][None] = list(np.where(jump, new, old))
            self._on_corners[2 * k + 1][None] = list(new)
        self._on_aim, self.moving = (self.lower, self.upper), True

    def settle(self) -> None:
        """Stay."""
        self._on_corners[0][None] = list(self.lower)
        self._on_corners[2][None] = list(self.upper)

    @ti.func
    def confine(self, i, radius, h, when, last):
        """Two planes per axis."""
        for k in ti.static(range(self.dim)):
            for s in ti.static(range(2)):
                a, b = self._on_corners[2 * s][None][k], self._on_corners[2 * s + 1][None][k]
                wall, shift = b, 0 * b
                if a != b:
                    wall = a * (1 - when[1]) + b * when[1]
                    shift = (b - a) * (when[1] - when[0])
                n = 0 * self._on_state.x[i]
                moved = n
                n[k], moved[k] = 1 - 2 * s, shift
                self.press(i, (1 - 2 * s) * (wall - self._on_state.place(i)[k]) + radius, n, moved, h, last)
