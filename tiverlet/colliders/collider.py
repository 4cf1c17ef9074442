"""The contract of all colliders: walls that particles stay outside of, or inside."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from .. import checks
from ..device import ti
from ..features.arguments import knobs_of
from ..features.feature import Feature, Knob, Scene
from ..features.flag import Flag
from ..features.material import Bounce, Coefficients, as_given, friction_of, is_elastic, restitution_of
from ..features.regrouping import Regrouping
from .surface import Surface
from .track import Track
from .wall_log import WallLog


class Collider(Feature):
    """Keeps each particle on one side of a wall, as the last correction in every iteration.

    Subclasses implement confine(), which finds how deep a particle is and calls dev.surface.push() of the Surface that each
    holds; gap() and least_gap(), by which contacts meet its faces; and for host queries, clearance() and cast(). One-sided: depth
    that was gained in this substep is removed completely, at any speed, whether it came from motion, constraints, contacts,
    friction or a bounce off another wall. Earlier depth (a bad start) is removed at `push_out` [m/s], and gives no more velocity
    than that. None, the default: 1 m/s, and among contacts a quarter of the radius in a substep, without velocity.

    tracks: its knobs that are places, and the types of their numbers, None for that of the world. Each is a Track on the device,
    by its name: an assigned place is reached in the next frame.

    Where one correction may push a particle into a wall again, corrections are repeated until none changes anything. The first
    rounds include friction and bounces; later rounds are projections of the displacement, which add no energy. A particle that is
    still not free, in a wedge, stays where it was at the start of the substep. Walls of one kind share code and act together, see
    WallGroup: kinds in the order of the first wall of each, walls of a kind in the order of the list.

    friction, restitution, push_out, active, events, one_way, surface_velocity: see tiverlet/colliders/README.md.
    """

    friction = Knob(lambda f, v: _friction(f, v), "A number, or (static, dynamic, rolling, twisting).")
    restitution = Knob(lambda f, v: _restitution(f, v), "0 to 1, or (normal, tangential).")
    active = Knob(lambda f, v: checks.flag(repr(f), "active", v), "Whether it is there.")
    push_out = Knob(lambda f, v: None if v is None else checks.number(repr(f), "push_out", v, least=0.0), "[m/s], or None.")
    events = Knob(lambda f, v: checks.flag(repr(f), "events", v), "Whether World.wall_events() tells of it.", compiled=True)
    surface_velocity = Knob(lambda f, v: _surface_velocity(f, v), "Of the surface relative to the wall, (dim,) [m/s].")
    has_friction = Flag(lambda f: f.turns or f.coefficients.static > 0, "Whether there is friction.")
    has_restitution = Flag(lambda f: f.bounce.normal > 0, "Whether there is restitution.")
    has_switch = Flag(lambda f: f._switch or not f.active, "Whether the wall can be switched off.")
    has_surface_velocity = Flag(lambda f: f.surface_velocity is not None, "Whether the surface has a velocity, if only 0.")
    turns = Flag(
        lambda f: max(f.coefficients.rolling, f.coefficients.twisting, f.bounce.tangential) > 0,
        "Whether it resists rolling, or bounces across the normal.",
    )
    compiled_for = ("has_friction", "has_restitution", "has_switch", "has_surface_velocity", "turns")
    host_only = ("widest", "_switch")
    for_users = ("clearance",)
    tracks: Mapping[str, Any] = MappingProxyType({})
    one_way: Any = None  # unit vector along which particles pass
    _switch = False  # whether `active` was given
    needs_start_position = False  # needs the exact position at the start of the substep
    needs_repeat = False  # after confine(), a particle with friction or a bounce may have to be confined again
    dim = 0  # 2 or 3; 0 while it is not known
    inside = False  # particles are kept inside of it
    closed: Any = True  # encloses a volume
    poses = False  # has a pose(frame_fraction) to be computed once for each substep, before any confine()
    shares_code = False  # walls of this very class with equal code_key differ only in what fields hold
    has_bounds = False  # it has bounds(): no particle far from these touches it

    def set_surface(
        self, friction: Any, restitution: Any, push_out: float | None, active: bool | None, events: bool = False, one_way: Any
        = None, dim: int = 0, surface_velocity: Any = None,
    ) -> None:  # fmt: skip
        """Check and store the arguments that all walls have; one_way in dim axes."""
        self.friction, self.restitution, self.push_out, self.events = friction, restitution, push_out, events
        self.surface_velocity = surface_velocity
        if one_way is not None:
            self.one_way = checks.direction(checks.vector(repr(self), "one_way", one_way, dim))
            if not self.one_way.any():
                raise ValueError(f"{self!r}: one_way = 0 has no direction; {(0, 1, 0)[:dim]} lets particles pass upwards.")
        self._switch, self.active = active is not None, True if active is None else active

    @property
    def conserves(self) -> bool:
        """Whether particles leave it with the energy that they had."""
        return is_elastic(self.friction, self.restitution)

    @property
    def does_work(self) -> bool:
        """Whether the surface moves, by which friction may add energy."""
        return self.surface_velocity is not None and bool(self.surface_velocity.any())

    @property
    def coefficients(self) -> Coefficients:
        """The coefficients of friction."""
        return friction_of(repr(self), "friction", self.friction)

    @property
    def bounce(self) -> Bounce:
        """The coefficients of restitution."""
        return restitution_of(repr(self), "restitution", self.restitution)

    @property
    def has_released_load(self) -> bool:
        """Whether the wall was present in the last frame and is switched off now, so that it ends its support."""
        return not self.active and self.was_active

    @property
    def was_active(self) -> bool:
        """Whether the wall was present in the last frame."""
        return self.active if self.scene is None else self.dev.surface.was_active

    @property
    def code_key(self) -> Any:
        """What decides the code of its kernels: walls with equal keys form a WallGroup. None, as with a log, for one alone."""
        if self.events or not vars(type(self)).get("shares_code"):
            return None
        values = (getattr(self, name) for name in ("dim", "inside", "closed", *self.compiled_for))
        return type(self), self.one_way is None, *values

    @property
    def middle(self) -> np.ndarray:
        """A point about which it is, (dim,) [m]."""
        raise NotImplementedError

    def bind(self, scene: Scene) -> None:
        """Store the state, make the surface, and declare tracks and the knobs that kernels read."""
        self.scene = scene
        self.dev.state = scene.state
        self.dev.real = scene.real
        self.dev.log = WallLog(scene, repr(self)) if self.events else None
        self.dev.surface = Surface(scene, self, self.dev.log)
        for name, kind in self.tracks.items():
            value = np.atleast_1d(getattr(self, name))
            vars(self.dev)[name] = Track(scene.memory, f"{self!r}.{name}", value, kind)
        for name, field in self._settings().items():
            vars(self.dev)[field] = scene.memory.field(f"{self!r}.{name}", None, values=getattr(self, name))
        self.changed = False

    def velocity_of_surface(self, dim: int) -> np.ndarray:
        """Return the velocity of the surface relative to the wall, (dim,) [m/s]."""
        given = self.surface_velocity
        return np.zeros(dim) if given is None else checks.vector(repr(self), "surface_velocity", given, dim)

    def _settings(self) -> dict[str, str]:
        """Return its knobs that kernels read, and the names of their fields."""
        knobs = {name: getattr(type(self), name) for name in knobs_of(type(self))}
        return {name: knob.device for name, knob in knobs.items() if knob.device}

    def upload(self) -> None:
        """Write the settings to the device, and move to the present places in the next frame."""
        self.dev.surface.upload(self)
        for name, field in self._settings().items():
            self.scene.memory.write(vars(self.dev)[field], getattr(self, name))
        for name in self.tracks:
            vars(self.dev)[name].set_target(np.atleast_1d(getattr(self, name)))
        self.moving = True

    def end_motion(self) -> None:
        """Stay at the last places."""
        for name in self.tracks:
            vars(self.dev)[name].end_motion()

    def place_of(self, name: str) -> np.ndarray:
        """Return where a track is now; outside of a world, its knob."""
        return np.asarray(getattr(self, name)) if self.scene is None else vars(self.dev)[name].now

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether the widest particle, for which the wall was checked and built, is as wide as before."""
        return change.now.radius.max(initial=0.0) == change.before.radius.max(initial=0.0)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return line strips (m, k, dim) and half their width [m], 0 if thin, for pictures of a scene between two corners."""
        return np.zeros((0, 2, len(low))), 0.0

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return vertices (v, 3) and triangles (t, 3) for pictures of a 3D scene; none where lines show more."""
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances of points (k, dim) from the wall where it is now [m], (k,), negative inside of it."""
        raise NotImplementedError

    def cast(self, origin: np.ndarray, direction: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Return how far balls of a radius [m] go until the wall stops them, and its normals there.

        origin: (k, dim) [m]. direction: (k, dim), unit. Returns the lengths (k,) [m], inf where nothing is met, and unit normals
        (k, dim), against the direction: where clearance() falls to `radius` from above. A ray that starts in a wall leaves it
        freely.
        """
        raise NotImplementedError

    @property
    def sides(self) -> int:
        """The number of its faces, each of which may press on a particle at the same time; 0 if it cannot tell gaps."""
        return 0

    bends = False  # whether its faces are curved

    @ti.func
    def bounds(self):
        """Return the corners of a box in which it stays during the frame [m]."""
        return ti.zero(self.dev.state.d[0]), ti.zero(self.dev.state.d[0])

    @ti.func
    def near_sides(self, i, reach):
        """Return from where to where side_at() has the sides that may be within `reach` of particle i during the frame."""
        return 0, self.sides

    @ti.func
    def side_at(self, place):
        """Return the side at a place of near_sides(). Sides are in order."""
        return place

    @ti.func
    def least_gap(self, face, i, radius):
        """Return a bound from below on the gap of particle i at a face, wherever the wall is in the frame [m]."""
        return 0 * radius

    @ti.func
    def gap(self, face, i, radius, frame_fraction, at_start: ti.template()):  # type: ignore[valid-type]
        """Return the gap of particle i at a face, at the start or at the end of the substep [m], and the normal.

        Behind these: the curvature of the gap [1/m], and how far the wall moves there in the substep [m]; at the start only.
        """
        return 0 * radius, ti.zero(self.dev.state.d[i]), 0 * radius, ti.zero(self.dev.state.d[i])

    @ti.func
    def in_frame_of_one_way(self, n):
        """Return a normal at the start of the substep in the frame in which one_way is given."""
        return n

    @ti.func
    def may_touch(self, i, radius):
        """Return 0 where confine() has nothing to do for particle i, if that can be computed without a branch, else 1."""
        return 1

    @ti.func
    def confine(self, i, radius, h, frame_fraction, mode):
        """Move particle i out of the wall by self.dev.surface.push(). mode: ANY_DEPTH, BEYOND_ROUNDING, or FRICTIONLESS."""


def _friction(wall: Collider, value: Any) -> Any:
    friction_of(repr(wall), "friction", value)
    return as_given(value)


def _surface_velocity(wall: Collider, value: Any) -> Any:
    dim = wall.dim or (2 if value is None else np.size(value))
    return None if value is None else checks.vector(repr(wall), "surface_velocity", value, dim)


def _restitution(wall: Collider, value: Any) -> Any:
    restitution_of(repr(wall), "restitution", value)
    return as_given(value)
