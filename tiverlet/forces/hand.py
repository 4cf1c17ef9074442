"""A hand that draws one particle to a target, such as a mouse. The particle can be changed at any time."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.arguments import shifted
from ..features.feature import Acceleration, Knob, Scene
from ..features.regrouping import Regrouping
from ..particles import Particles, in_range


def _particle(hand: "Hand", value) -> int:
    value = checks.integer("Hand", "particle", value, least=-1)
    if hand._count and value >= hand._count:
        there = f"there are {hand._count} particles (0 ... {hand._count - 1}; -1 for none)"
        raise ValueError(f"Hand: particle = {value}, but {there}.")
    return value


def _target(hand: "Hand", value) -> np.ndarray:
    value = checks.vector("Hand", "target", value, hand.dim or len(np.atleast_1d(value)))
    in_range("Hand", "target", value[None])
    return value


class Hand(Acceleration):
    """A hand or mouse that draws one particle to a target: a = -rate^2 (x - target) - 2 rate v.

    The hand is a critically damped spring. So the particle comes to a fixed target without oscillation in a few times 1 / rate,
    whatever its mass. Particles that hang on it weigh it down. The hand can take another particle at any time; a Pin with
    compliance holds many particles, and can take as many others.

    target: (dim,) [m]. It jumps at the start of a frame, where the target of a Pin glides. In a periodic box its nearest image
    counts. particle: the index, -1 for none. rate: [1/s], at least 0; the step resolves it while h times the rate is well below
    1, and is stable below 2. All are live: assign between frames, without compiling. A pinned particle stays where it is.
    """

    host_only = ("_count",)

    is_fixed_in_space = False
    uses_velocity = True
    conservative = True
    is_tool = True
    particle = Knob(_particle, "The particle that is drawn; -1: none.")
    target = Knob(_target, "Where it is drawn to [m].", place=shifted)
    rate = Knob(lambda f, v: checks.number("Hand", "rate", v, least=0.0), "How fast it gets there [1/s].")
    _count = 0

    def __init__(self, target: ArrayLike, particle: int = -1, *, rate: float = 20.0):
        self.target, self.particle, self.rate = target, particle, rate

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the knobs, with the number of particles known."""
        self._keep(_count=len(particles))
        super().prepare(particles, inv_mass)

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Take new particle indices. A removed particle (-1) is let go."""
        self._keep(_count=count)
        if self.particle >= 0:
            self.particle = int(number[self.particle])

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can come and go in place: always, because only the index of one particle is stored."""
        return True

    def regroup(self, change: Regrouping) -> None:
        """Write the new index of the particle to the device."""
        self.remap_indices(change.number, change.now.count)
        self.upload()

    def kernel_values(self) -> dict[str, Any]:
        """Return particle, target and rate, for kernels."""
        return {"particle": self.particle, "target": self.target, "rate": self.rate}

    def bind(self, scene: Scene) -> None:
        """Declare the fields, and store the state, which gives the nearest image of the target."""
        super().bind(scene)
        self.dev.state = scene.state

    def may_act_from(self, first: int) -> bool:
        """Whether its particle is one of these."""
        return self.particle >= first

    @ti.func
    def acts_on(self, i):
        """Whether i is the particle of the hand."""
        return i == self.dev.particle[None]

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return -rate^2 (x - target) - 2 rate v for the particle of the hand, 0 for others [m/s^2]."""
        out, rate = 0 * x, self.dev.rate[None]
        if self.acts_on(i):
            out = -rate * (rate * self.dev.state.nearest(x - self.dev.target[None]) + 2 * v)
        return out

    @ti.func
    def potential(self, i, x):
        """Return rate^2 |x - target|^2 / 2 for the particle of the hand, 0 for others [J/kg]."""
        out, r = 0 * x[0], self.dev.state.nearest(x - self.dev.target[None])
        if self.acts_on(i):
            out = self.dev.rate[None] ** 2 * r.dot(r) / 2
        return out
