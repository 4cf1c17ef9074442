"""A hand that draws one particle, whichever it is now."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import ti
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
    """a = -rate^2 (x - target) - 2 rate v, of one particle: a hand, a mouse, which may take another particle at any time.

    It is a critically damped spring, so the particle comes to a target at rest without swinging, in a few times 1 / rate,
    whatever its mass; where others hang on it, they weigh it down. A Pin with compliance holds many, but always the same ones.

    target: (dim,) [m], which jumps as a frame begins, where that of a Pin glides; in a periodic box its nearest image. particle:
    its number, -1 for none. rate: [1/s], at least 0; the step resolves it while h times the rate is well below 1, and is stable
    below 2. All live: assign between frames, at no compile cost. A particle that is pinned stays where it is.
    """

    uses_velocity = True
    conservative = True
    particle = Knob(_particle, "The particle that is drawn; -1: none.")
    target = Knob(_target, "Where it is drawn to [m].")
    rate = Knob(lambda f, v: checks.number("Hand", "rate", v, least=0.0), "How fast it gets there [1/s].")
    dim = _count = 0

    def __init__(self, target: ArrayLike, particle: int = -1, *, rate: float = 20.0):
        self.target, self.particle, self.rate = target, particle, rate

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the vector's length and the particle."""
        self._keep(dim=particles.dim, _count=len(particles))
        self.target, self.particle = self.target, self.particle

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Go on with the same particle; let go of one that goes."""
        self._keep(_count=count)
        if self.particle >= 0:
            self.particle = int(number[self.particle])

    def can_regroup(self, change: Regrouping) -> bool:
        """Always: it holds one particle, by its number."""
        return True

    def regroup(self, change: Regrouping) -> None:
        """Write its new number."""
        self.remap_indices(change.number, change.now.count)
        self.upload()

    def settings(self) -> dict[str, Any]:
        """Which particle, where to, how fast."""
        return {"particle": self.particle, "target": self.target, "rate": self.rate}

    def bind(self, scene: Scene) -> None:
        """The state, for images of the target."""
        super().bind(scene)
        self.dev.state = scene.state

    def may_act_from(self, first: int) -> bool:
        """Whether its particle is one of these."""
        return self.particle >= first

    @ti.func
    def acts_on(self, i):
        """One particle."""
        return i == self.dev.particle[None]

    @ti.func
    def acceleration(self, i, x, v, t):
        """-rate^2 (x - target) - 2 rate v."""
        out, rate = 0 * x, self.dev.rate[None]
        if self.acts_on(i):
            out = -rate * (rate * self.dev.state.nearest(x - self.dev.target[None]) + 2 * v)
        return out

    @ti.func
    def potential(self, i, x):
        """rate^2 |x - target|^2 / 2."""
        out, r = 0 * x[0], self.dev.state.nearest(x - self.dev.target[None])
        if self.acts_on(i):
            out = self.dev.rate[None] ** 2 * r.dot(r) / 2
        return out
