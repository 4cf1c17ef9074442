"""Known loads of walls: each particle of a body learns the load with which walls hold it."""

from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..features.learning import STEADY
from .known_loads import WINDOW

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .known_loads import KnownLoads


class WallLoads:
    """The loads L [N] with which walls hold particles, as vectors, friction included; for bodies on walls.

    Walls have the last word in a substep, after constraints. So what they push, constraints find in the next substep, and a body
    gives way: a box of four corners is pressed flat by 2 g h^2 on a floor. With known loads, particles are displaced by h^2 L / m
    before constraints and contacts are solved, and this displacement is undone before walls act. So constraints and contacts find
    what walls will do. L is learnt as in KnownLoads, from what walls push in a window beyond it. A particle that no wall pushes
    forgets its load at once.
    """

    def __init__(self, scene: "Scene", known: "KnownLoads"):
        n, dim, add = scene.count, scene.particles.dim, scene.memory.field
        self.memory, self.state, self.weights = scene.memory, scene.state, scene.own_weight
        self.known, self.motion = known, known.motion
        self.load = add("WallLoads.load", n, width=dim, state=True)  # [N]
        self.borne = add("WallLoads.borne", n, width=dim, state=True)  # sum of the missing part in this window [kg m]
        self.earlier = add("WallLoads.earlier", n, width=dim, state=True)  # mean missing part in the window before [N]
        self.given = add("WallLoads.given", n, width=dim)  # the displacement that is undone before walls act [m]
        self.pushed = add("WallLoads.pushed", n, width=dim)  # by walls in this substep [m]
        self.normal = add("WallLoads.normal", n, width=dim)  # of the walls at the end of a window, of any length

    def forget(self, moved: np.ndarray) -> None:
        """Forget the loads of particles in the mask `moved`, (n,)."""
        for field in (self.load, self.borne, self.earlier):
            values = self.memory.read(field)
            values[: len(moved)][moved] = 0.0
            self.memory.write(field, values)

    @ti.func
    def give(self, i, now):
        """Displace particle i by its known load."""
        given = ti.zero(self.state.x[i])
        if self.state.moves(i):
            given = self.state.w.of(i) * self.weights.integrator.h2_effective(now.h, now.fresh) * self.load[i]
            if (given != 0).any():
                self.state.shift(i, given)
        self.given[i] = given

    @ti.func
    def take_back(self, i):
        """Undo give()."""
        given = self.given[i]
        if (given != 0).any():
            self.state.shift(i, -given)

    @ti.func
    def ends_window(self, now):
        """Whether loads are learnt in this substep."""
        return (now.span.since + now.s) % WINDOW == 0

    @ti.func
    def learn(self, i, now):
        """At the end of a substep: learn the load of particle i, if walls pushed it."""
        if self.state.moves(i):
            pushed, w, load = self.pushed[i], self.state.w.of(i), self.load[i]
            missing = (pushed - self.given[i]) / w
            borne = self.borne[i] + missing
            if now.fresh != 0 and now.span.since == 0:
                borne = missing  # a start (velocities were set): forces were different before it
            if self.ends_window(now):
                mean, earlier = (borne - missing) / (WINDOW * now.h * now.h), self.earlier[i]
                if (mean - earlier).norm() < ti.static(STEADY) * mean.norm() and self.motion.is_steady(i):
                    k, own = (load + mean).norm() * w, self.weights.field[i]
                    share = self.known.share(own, k)
                    self.slide(i, -w * now.h * now.h * share * mean)
                    load, mean = load + share * mean, (1 - share) * mean
                self.earlier[i], borne = mean, missing
            if (pushed == 0).all():
                load *= 0
            self.load[i], self.borne[i] = load, borne

    @ti.func
    def slide(self, i, way):
        """Move particle i by the part of `way` along walls; its displacement stays.

        Friction holds corners where they came to rest, also where a body is bent between them. So what is learnt across the
        normal is taken from this bend. Otherwise the load would grow in each window, until the corner slides.
        """
        n = self.normal[i]
        nn = n.dot(n)
        if nn > 0:
            self.state.advance(i, way - way.dot(n) / nn * n)
