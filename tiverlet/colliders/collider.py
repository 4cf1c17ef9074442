"""The contract of all colliders: what particles stay outside of, or inside."""

from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Feature, Knob, Scene
from ..features.material import Bounce, as_given, friction_of, restitution_of
from ..features.regrouping import Regrouping
from .surface import Surface
from .wall_log import WallLog


class Collider(Feature):
    """Keeps each particle by itself on one side of a wall, with the last word in every iteration.

    Subclasses give confine(), which finds how deep a particle is and calls dev.surface.press(): that of the Surface that each
    holds; and for questions of the host, clearance() and cast(). One-sided: what entered in this substep is taken back whole, at
    any speed, whether it flew in or constraints, contacts, friction or a bounce off another wall took it there. Depth from before
    (a bad start) is left at `push_out` [m/s], and gives no more velocity than that.

    Where one correction may lead into a wall again (several walls, a box in whose corners particles bounce), corrections take
    turns until none changes anything: some rounds as they come, then more without friction and bounces, which are projections of
    the displacement and give no energy. What is still not free then, in a wedge, stays where it was at the start of the substep.
    Walls that move towards each other may leave no room at all: then the last of them in the list has its way.

    friction: Coulomb, a number or (static, dynamic). The tangential displacement relative to the wall is taken back, up to
    friction times the normal displacement that the wall gave, so neither coefficient depends on h. What sticks goes back to
    where it was at the start of the substep, to the bit, so it does not creep.
    restitution: 0 ... 1. The moment of the impact within the substep is solved for, with the acceleration in it; the particle
    leaves at restitution times its velocity then, and is placed where it would be at the end of the substep. What rigid
    links hold takes its body along, see BodyImpacts, and rests where 8 substeps of forces and links gave it its speed; on
    springs, beside ShapeMatch, Area of loops, Path or Snap, and where it spins and rubs, it bounces alone. At 0 nothing looks
    after impacts of bodies: links find in later substeps that an end was stopped, and an upright rod leaves a floor at 0.2 of its
    speed, a chain of ten links at 0.6, at any number of substeps; 1e-9 has the body stop.
    Of particles that spin, the displacement of the point that touches is taken back. friction = (static, dynamic, rolling,
    twisting) then also resists rolling, by a moment of up to rolling * radius times the normal force, and spinning about the
    normal, by up to twisting * radius times it; what these hold does not roll. restitution = (normal, tangential): in a bounce
    the point that touches leaves across the normal at -tangential times its velocity, as far as friction holds it; 0 grips, 1 is
    a super ball (Garwin 1969).
    active: whether it is there, a gate that opens and closes. With True or False given it is a switch, which costs nothing to
    turn; None is always there, and costs the compiling of another scene when it is switched off for the first time. What is
    inside of a wall that comes back is left at push_out.
    events: whether World.wall_events() tells which particles met and left it.
    one_way: a direction along which particles pass, for platforms: (0, 1) holds what comes from above, and lets through what
    comes from below. Particles are held where they touch with a normal to that side; what was inside of the wall at the start of
    the substep, however it came there, is let through until it is free. Fixed, and turned with the wall. Nothing is remembered of
    a particle but where it is. Capsule, Polygon and Mesh take it; None is a wall for both sides.

    A conveyor is a long Capsule or Polygon with friction that is moved along itself: its place is assigned before each frame.
    """

    friction = Knob(lambda f, v: _friction(f, v), "A number, or (static, dynamic, rolling, twisting).")
    restitution = Knob(lambda f, v: _restitution(f, v), "0 to 1, or (normal, tangential).")
    active = Knob(lambda f, v: checks.flag(repr(f), "active", v), "Whether it is there.")
    push_out = Knob(lambda f, v: checks.number(repr(f), "push_out", v, least=0.0), "[m/s].", compiled=True)
    events = Knob(lambda f, v: checks.flag(repr(f), "events", v), "Whether World.wall_events() tells of it.", compiled=True)
    compiled_for = ("has_friction", "has_restitution", "has_switch", "turns")
    host_only = ("widest",)
    one_way: Any = None  # unit vector along which particles pass
    _switch = False  # it was made with one
    sweeps = False  # needs the exact position at the start of the substep
    repeats = False  # one confine() may leave a particle that rubs or bounces where it has to be confined again
    dim = 0  # 2 or 3; 0 while it is not known
    inside = False  # particles are kept inside of it
    poses = False  # has a pose(frame_fraction) to be worked out once for each substep, before any confine()

    def surface(
        self, friction: Any, restitution: Any, push_out: float, active: bool | None, events: bool = False, one_way: Any = None,
        dim: int = 0,
    ) -> None:  # fmt: skip
        """Check and keep the arguments that all walls have; one_way in dim axes."""
        self.friction, self.restitution, self.push_out, self.events = friction, restitution, push_out, events
        if one_way is not None:
            self.one_way = self._direction(one_way, dim)
        self._switch, self.active = active is not None, True if active is None else active

    def _direction(self, one_way: Any, dim: int) -> np.ndarray:
        """one_way, checked, as a unit vector."""
        way = checks.vector(repr(self), "one_way", one_way, dim)
        length = float(np.linalg.norm(way))
        if length == 0:
            raise ValueError(f"{self!r}: one_way = 0 has no direction; {(0, 1, 0)[:dim]} lets particles pass upwards.")
        return way / length

    @property
    def has_friction(self) -> bool:
        """Whether there is friction, or was when kernels were compiled."""
        return self.turns or friction_of(repr(self), "friction", self.friction).static > 0 or "has_friction" in self.once

    @property
    def has_restitution(self) -> bool:
        """Whether there is restitution, or was when kernels were compiled."""
        return self._bounce.normal > 0 or "has_restitution" in self.once

    @property
    def turns(self) -> bool:
        """Whether it resists rolling, or bounces across the normal, or did when kernels were compiled."""
        rub = friction_of(repr(self), "friction", self.friction)
        return max(rub.rolling, rub.twisting, self._bounce.tangential) > 0 or "turns" in self.once

    @property
    def _bounce(self) -> Bounce:
        return restitution_of(repr(self), "restitution", self.restitution)

    @property
    def lets_go(self) -> bool:
        """Whether it bore what it no longer will."""
        return not self.active and self.stands

    @property
    def stands(self) -> bool:
        """Whether it is there, as the last frame had it."""
        return self.active if self.scene is None else self.dev.surface.stands

    @property
    def has_switch(self) -> bool:
        """Whether it can be switched off, by the kernels as they are or are to be."""
        return self._switch or not self.active or "has_switch" in self.once

    def bind(self, scene: Scene) -> None:
        """Keep the state at hand, and make the surface."""
        self.scene = scene
        self.dev.state = scene.state
        self.dev.real = scene.real
        both = friction_of(repr(self), "friction", self.friction) if self.has_friction else None
        restitution, active = self._bounce if self.has_restitution else None, self.active if self.has_switch else None
        self.dev.log = WallLog(scene, repr(self)) if self.events else None
        self.dev.surface = Surface(
            scene, repr(self), both, restitution, self.push_out, active, self.turns, self.dev.log, self.one_way
        )

    def upload(self) -> None:
        """Write friction and restitution, and whether it is there."""
        self.dev.surface.upload(friction_of(repr(self), "friction", self.friction), self._bounce, self.active)

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether the widest particle, for which it was checked and made, is as wide as before."""
        return change.now.radius.max(initial=0.0) == change.before.radius.max(initial=0.0)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """For pictures of a scene between two corners: line strips (m, k, dim), and half their width [m], 0 for a thin line."""
        return np.zeros((0, 2, len(low))), 0.0

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """For pictures of a 3D scene between two corners: vertices (v, 3) and triangles (t, 3); none where lines say more."""
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """C(x) of points (k, dim): how far they are from the wall [m], negative inside of it, (k,).

        In a world, the wall is where the last frame took it: a place that is assigned is where it goes in the next one.
        """
        raise NotImplementedError

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """How far balls of a radius [m] go until the wall stops them, and its normals there.

        origin: (k, dim) [m]. direction: (k, dim), unit. Returns the lengths (k,) [m], inf where nothing is met, and unit normals
        (k, dim), against the direction: where clearance() falls to `radius` from above. A wall lets out what starts in it.
        """
        raise NotImplementedError

    @ti.func
    def may_touch(self, i, radius):
        """0 where confine() has nothing to do for particle i, if that can be told without a branch, for several at once."""
        return 1

    @ti.func
    def confine(self, i, radius, h, frame_fraction, turn):
        """Move particle i out of the wall, with self.dev.surface.press(). turn: FIRST, AGAIN, GENTLY or AHEAD."""


def _friction(wall: Collider, value: Any) -> Any:
    friction_of(repr(wall), "friction", value)
    return as_given(value)


def _restitution(wall: Collider, value: Any) -> Any:
    restitution_of(repr(wall), "restitution", value)
    return as_given(value)
