"""Surroundings: what every wall shares, from the first touch to the bounce."""

from typing import Any

import numpy as np

from .. import checks
from ..device import at, ti
from ..device.memory import Memory
from ..features.feature import Feature, Knob, Scene
from ..features.material import friction_of, restitution_of

SWEEPS = 8  # rounds over the walls, for particles that several of them push
ROUNDS = 32  # more of them, without friction and bounces
# How a wall confines: as it comes; only what is further out than rounding; of that, without friction and bounces.
FIRST, AGAIN, GENTLY = range(3)
TOUCH = 2.0**-20  # of the size of a wall: a start that is no deeper inside than this counts as on the surface


class Wall(Feature):
    """Each particle by itself is kept on one side, with the last word in every iteration.

    A wall's confine() finds how deep a particle is, and calls press(). One-sided: what entered in this substep is taken back
    whole, at any speed, whether it flew in or constraints, contacts, friction or a bounce off another wall took it there. Depth
    from before (a bad start) is left at `push_out` [m/s], and gives no more velocity than that.

    Where one correction may lead into a wall again (several walls, a box in whose corners particles bounce), corrections take
    turns until none changes anything: SWEEPS rounds as they come, then ROUNDS without friction and bounces, which are projections
    of the displacement and give no energy. What is still not free then, in a wedge, stays where it was at the start of the
    substep. Walls that move towards each other may leave no room at all: then the last of them in the list has its way.

    friction: Coulomb, a number or (static, dynamic). The tangential displacement relative to the wall is taken back, up to
    friction times the normal displacement that the wall gave, so neither coefficient depends on h. What sticks goes back to
    where it was at the start of the substep, to the bit, so it does not creep.
    restitution: 0 ... 1. The moment of the impact within the substep is solved for, with the acceleration in it; the particle
    leaves at restitution times its velocity then, and is placed where it would be at the end of the substep.
    """

    friction = Knob(lambda f, v: _friction(f, v), "A number, or (static, dynamic).")
    restitution = Knob(lambda f, v: restitution_of(repr(f), "restitution", v), "0 to 1.", device="restitution")
    push_out = Knob(lambda f, v: checks.number(repr(f), "push_out", v, least=0.0), "[m/s].", compiled=True)
    compiled_for = ("rubs", "bounces")
    sweeps = False  # needs the exact position at the start of the substep
    repeats = False  # one confine() may leave a particle that rubs or bounces where it has to be confined again
    poses = False  # has a pose(when) to be worked out once for each substep, before any confine()

    def surface(self, friction: Any, restitution: Any, push_out: float) -> None:
        """Check and keep the arguments that all walls have."""
        self.friction, self.restitution, self.push_out = friction, restitution, push_out

    @property
    def static(self) -> Any:
        """The coefficient of static friction, for kernels."""
        return at(at(self.dev.friction, None), 0)

    @property
    def dynamic(self) -> Any:
        """The coefficient of dynamic friction, for kernels."""
        return at(at(self.dev.friction, None), 1)

    @property
    def rubs(self) -> bool:
        """Whether there is friction, or was when kernels were compiled."""
        return friction_of(repr(self), "friction", self.friction)[0] > 0 or "friction" in vars(self.dev)

    @property
    def bounces(self) -> bool:
        """Whether there is restitution, or was when kernels were compiled."""
        return self.restitution > 0 or "restitution" in vars(self.dev)

    def bind(self, scene: Scene) -> None:
        """Keep the state at hand."""
        self.scene = scene
        self.dev.state = scene.state
        self.dev.real = scene.real
        self.dev.rubs, self.dev.bounces = self.rubs, self.bounces
        if self.dev.rubs:
            both = friction_of(repr(self), "friction", self.friction)
            self.dev.friction = scene.memory.field(f"{self!r}.friction", None, width=2, values=both)
        if self.dev.bounces:
            self.dev.restitution = scene.memory.field(f"{self!r}.restitution", None, values=self.restitution)

    def upload(self) -> None:
        """Write friction and restitution."""
        write = self.scene.memory.write
        if self.dev.rubs:
            write(self.dev.friction, friction_of(repr(self), "friction", self.friction))
        if self.dev.bounces:
            write(self.dev.restitution, self.restitution)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """For pictures of a scene between two corners: line strips (m, k, dim), and half their width [m], 0 for a thin line."""
        return np.zeros((0, 2, len(low))), 0.0

    @ti.func
    def near(self, i, radius):
        """0 where confine() has nothing to do for particle i, if that can be told without a branch, for several at once."""
        return 1

    @ti.func
    def confine(self, i, radius, h, when, turn):
        """Move particle i out of the wall, with self.press. turn: FIRST, AGAIN or GENTLY."""

    @ti.func
    def lifted(self, i):
        """Whether particle i is not where its displacement says, because it has bounced in this substep; and by how much."""
        lift = 0 * self.dev.state.d[i]
        if ti.static(self.dev.state.befores):
            lift = self.dev.state.place(i) - self.dev.state.begin(i) - self.dev.state.d[i]
        return lift.norm() > 4 * self.dev.state.digits(i), lift

    @ti.func
    def way(self, i, moved):
        """From where particle i was at the start of the substep to where it is, as seen from a wall that moved by `moved`."""
        out = self.dev.state.d[i] - moved
        if ti.static(self.dev.state.befores):
            high, lift = self.lifted(i)
            if high:
                out += lift
        return out

    @ti.func
    def press(self, i, depth, sunk, n, moved, h, turn):
        """Take particle i out of a wall that it entered by `depth` [m], along the normal n; the wall itself moved by `moved`.

        sunk: how deep it was at the start of the substep, 0 or less outside [m]. turn: FIRST, AGAIN or GENTLY.
        What comes as close as the last digits of the position can tell touches: it does not sink, or slip, by these digits.
        Returns how the position was shifted.
        """
        d = self.dev.state.d[i] - moved
        shift = 0 * d
        leaving = d.dot(n)
        close = self.dev.state.digits(i)
        if depth > -close:
            depth = ti.max(depth, ti.min(-leaving, close))
        if depth > ti.select(turn == FIRST, 0, close):
            move = ti.max(depth - ti.max(sunk - self.push_out * h, 0), 0)
            # Normal displacement after the substep; what has bounced may be moved further than that is to tell.
            after = ti.min(leaving + move, ti.max(ti.abs(leaving), self.push_out * h))
            rise = 0 * depth
            if ti.static(self.dev.bounces):
                # Where the last bounce has put it back on a straight way, that way began at a height of `gap`.
                gap = -depth - leaving
                if gap >= 0 and leaving < 0 and turn != GENTLY:
                    rise, after = self.bounce(gap, leaving, (self.dev.state.before[i] - moved).dot(n), after)
            change = (after - leaving) * n
            if ti.static(self.dev.state.leans):
                self.dev.state.lean[i] = self.dev.state.lean[i] + change
            shift = (move + rise) * n
            stuck = False
            if ti.static(self.dev.rubs):
                if turn != GENTLY:
                    slip = d - leaving * n
                    size, given = slip.norm(), after - leaving
                    if size > self.static * given:
                        slip *= self.dynamic * given / size
                    else:
                        high, _lift = self.lifted(i)
                        stuck = rise == 0 and not high
                    change -= slip
                    shift -= slip
            self.dev.state.d[i] = self.dev.state.d[i] + change
            if ti.static(self.dev.state.befores):
                blow = change  # which is no acceleration
                if rise == 0:
                    blow -= (after - leaving) * n
                self.dev.state.before[i] = self.dev.state.before[i] + blow
            if ti.static(self.dev.rubs):
                if stuck:
                    self.dev.state.restart(i)
            if not stuck:
                self.dev.state.advance(i, shift)
        return shift

    @ti.func
    def bounce(self, gap, leaving, before, after):
        """What is above the wall at the end of the substep, and the normal displacement that carries the velocity then.

        In units of the substep, the height is gap + v s + k s^2 / 2, with k the acceleration and v = leaving - k / 2; the impact
        is at its root s. A bounce that would end below the wall has come to rest.
        """
        k = leaving - before
        v = leaving - k / 2
        root = ti.sqrt(ti.max(v * v - 2 * k * gap, 0)) - v
        rise = 0 * gap
        if root > 0:
            s = ti.min(2 * gap / root, 1)
            out = -self.restitution * (v + k * s)
            height = (1 - s) * (out + k / 2 * (1 - s))
            if height > 0 and out > 0:
                rise = height
                after = out + k * (1 - s) - k / 2
        return rise, after


def _friction(wall: Wall, value: Any) -> Any:
    friction_of(repr(wall), "friction", value)
    return tuple(float(v) for v in value) if isinstance(value, (tuple, list)) else float(value)


class Track:
    """A point of a wall that goes where it is sent during a frame, in a straight line."""

    def __init__(self, memory: Memory, name: str, value: np.ndarray, kind=None):
        self._memory = memory
        self.ends = memory.field(name, 2, width=len(value), kind=kind, values=[value, value], state=True)

    def aim(self, value: np.ndarray) -> None:
        """Go to `value` during the next frame."""
        self._memory.write(self.ends, [self._memory.read(self.ends)[1], value])

    def settle(self) -> None:
        """Stay where the last frame ended."""
        self._memory.write(self.ends, [self._memory.read(self.ends)[1]] * 2)

    @ti.func
    def at(self, when):
        """Where it is at the fraction `when` of the frame; what stands is where it stands, to the bit."""
        a, b = self.ends[0], self.ends[1]
        return ti.select(a == b, a, a * (1 - when) + b * when)

    @ti.func
    def step(self, when):
        """How far it goes in a substep."""
        return (self.ends[1] - self.ends[0]) * (when[1] - when[0])
