"""The response of a wall to a particle inside of it: the particle is moved out, with friction and restitution."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import at, inline, ti
from ..features.material import limit_length, refuse_turning

if TYPE_CHECKING:
    from ..features.feature import Scene
    from .collider import Collider
    from .wall_log import WallLog

# How a collider confines. ANY_DEPTH: at any depth. BEYOND_ROUNDING: only deeper than rounding. FRICTIONLESS: as
# BEYOND_ROUNDING, without friction and bounces.
ANY_DEPTH, BEYOND_ROUNDING, FRICTIONLESS = range(3)
TOUCH = 2.0**-20  # of the size of a wall: a start no deeper inside than this counts as on the surface
SLOW = 8.0  # a linked particle does not bounce if it approaches by less than this times what forces and links of a substep add
NEAR = 1 / 64  # of its displacement: a particle that starts closer to a surface than this lies on it, and may slide along it
ALONG = 0.9  # cosine of the largest angle by which a surface turns along a displacement that counts as a slide: 26 degrees
PUSH_OUT = 1.0  # [m/s] at which particles leave walls, and each other, that give no speed
ON = 1e-3  # of its distance from the middle of a wall: a particle no deeper inside than this lies on the wall


def speed_of_parting(push_out: float | None) -> float:
    """Return at which speed what overlaps parts, where contacts are no rows [m/s]. push_out: as it was given."""
    return PUSH_OUT if push_out is None else push_out


class Surface:
    """The response of the surface of one collider on the device: friction, restitution, push_out; Collider defines them.

    fields: the values of the wall that kernels read, by name. poses: the Pose of a wall that may turn; else none. log: of events,
    or None.
    """

    host_only = ("fields", "_memory")
    push_out: Any
    friction: Any
    restitution: Any
    rolling: Any
    one_way: Any
    velocity: Any
    active: Any

    def __init__(self, scene: "Scene", wall: "Collider", log: "WallLog | None"):
        self.log: Any = log
        self.has_log = log is not None
        self._memory, self.state, self.real = scene.memory, scene.state, scene.real
        self.has_friction, self.has_restitution, self.turns = wall.has_friction, wall.has_restitution, wall.turns
        self.has_switch, self.is_one_way, self.has_velocity = wall.has_switch, wall.one_way is not None, wall.has_surface_velocity
        self.impacts: Any = scene.impacts
        # A particle with spin and friction bounces alone, since the extra passes do not change its spin.
        self.has_impacts = bool(scene.impacts) and not (scene.state.spins and self.has_friction)
        self.has_impacts = self.has_impacts and (self.has_restitution or scene.impacts.stops)
        self.log_number = self.impacts.add_log(log) if self.has_impacts else -1
        self.poses: list[Any] = []
        self.spins, self.radius = scene.state.spins and self.has_friction, scene.radius
        self.spin: Any = scene.state.spin if scene.state.spins else None
        if self.turns and not scene.state.spins:
            refuse_turning(repr(wall))
        if self.has_velocity and not self.has_friction:
            raise ValueError(f"{wall!r}: surface_velocity moves nothing without friction. Give friction above 0 too.")
        self.fields: dict[str, Any] = {}
        for name, value in self._values(wall).items():
            kind, width = ti.i32 if name == "active" else None, np.size(value) if np.ndim(value) else 0
            self.fields[name] = scene.memory.field(f"{wall!r}.{name}", None, width=width, kind=kind, values=value)
        vars(self).update(self.fields)

    def _values(self, wall: "Collider") -> dict[str, Any]:
        """Return the values of the wall that kernels read, by name."""
        rub, bounce = wall.coefficients, wall.bounce
        out: dict[str, Any] = {"push_out": -1.0 if wall.push_out is None else wall.push_out}
        if self.has_friction:
            out["friction"] = rub[:2]
        if self.has_restitution:
            out["restitution"] = bounce.normal
        if self.turns:
            out["rolling"] = rub.rolling, rub.twisting, bounce.tangential
        if self.is_one_way:
            out["one_way"] = wall.one_way
        if self.has_velocity:
            out["velocity"] = wall.velocity_of_surface(self.state.dim)
        if self.has_switch:
            out["active"] = float(wall.active)
        return out

    def upload(self, wall: "Collider") -> None:
        """Write the present values of the wall to the device, as far as kernels read them."""
        for name, value in self._values(wall).items():
            self._memory.write(self.fields[name], value)

    @property
    def was_active(self) -> bool:
        """Whether the wall was present in the last frame."""
        return not self.has_switch or bool(self._memory.read(self.active))

    @inline
    def most_parting(self, h):
        """Return how far a particle that was inside moves out in a substep at most [m]."""
        speed = at(self.push_out, None)
        return ti.select(speed < 0, ti.cast(PUSH_OUT, self.real), speed) * h

    @inline
    def static(self):
        """Return the coefficient of static friction."""
        return at(at(self.friction, None), 0)

    @inline
    def dynamic(self):
        """Return the coefficient of dynamic friction."""
        return at(at(self.friction, None), 1)

    @ti.func
    def bounced(self, i):
        """Whether particle i is not where its displacement says, because it bounced in this substep; and the offset [m]."""
        lift = 0 * self.state.d[i]
        if ti.static(self.state.lifts):
            lift = self.state.place(i) - self.state.begin(i) - self.state.d[i]
        return lift.norm() > 4 * self.state.digits(i), lift

    @ti.func
    def path(self, i, moved):
        """Return the path of particle i since the start of the substep, relative to a wall that moved by `moved`."""
        out = self.state.d[i] - moved
        if ti.static(self.state.lifts):
            high, lift = self.bounced(i)
            if high:
                out += lift
        return out

    @ti.func
    def starts_on(self, i, start_depth, first, depth, n, size):
        """Whether particle i started on the surface of a convex wall that it may have passed, although it was inside there.

        It was inside by rounding only, with the normal `first`, and is not inside on the same side at the end, at this depth with
        the normal n. size: of the lengths from which the start is computed [m].
        """
        close = self.state.digits(i) + ti.static(self.state.two_digits) * size
        return start_depth < close and (depth <= 0 or n.dot(first) < 0)

    @ti.func
    def lets_through(self, i, n, start_depth, contact_distance):
        """Whether particle i passes a one-way wall.

        It passes if its normal n does not point to the side on which particles are held. It also passes if it is on its way
        through, that is, if it was further inside at the start of the substep than a particle that lies on the wall.
        n: in the frame in which one_way is given. contact_distance: of its center from the middle of the wall [m].
        """
        out = False
        if ti.static(self.is_one_way):
            on = 4 * self.state.digits(i) + ti.static(ON) * contact_distance
            out = n.dot(self.one_way[None]) <= 0 or start_depth > on
        return out

    @ti.func
    def push(self, i, depth, start_depth, n, moved, h, mode, slides):
        """Move particle i out of a wall that it entered by `depth` [m], along the normal n; the wall itself moved by `moved`.

        start_depth: depth at the start of the substep, 0 or less outside [m]. mode: ANY_DEPTH, BEYOND_ROUNDING or FRICTIONLESS.
        slides: whether n is the normal at the start of a displacement along a curved surface. The displacement then changes as
        much as the position; otherwise the particle would pass walls that follow displacements.
        A particle within rounding of the surface touches it, so that it does not sink, or slip, by the last digits of its
        position. Returns the shift of the position.
        """
        if ti.static(self.has_velocity):
            velocity = self.velocity[None]
            moved += h * (velocity - velocity.dot(n) * n)
        d = self.state.d[i] - moved
        shift = 0 * d
        leaving = d.dot(n)
        close = self.state.digits_along(i, n, self.radius.of(i))
        if depth > -close:
            depth = ti.max(depth, ti.min(-leaving, close))
        if self.is_deferred(i):
            depth = ti.min(depth, 0)
        if depth > ti.select(mode == ANY_DEPTH, 0, close):
            move = ti.max(depth - ti.max(start_depth - self.most_parting(h), 0), 0)
            # Normal displacement after the substep. A particle that bounced may be moved further than its displacement changes.
            after = leaving + move
            if not slides:
                after = ti.min(after, ti.max(ti.abs(leaving), self.most_parting(h)))
            rise, left = 0 * depth, 1 + 0 * depth
            if ti.static(self.has_restitution or self.has_impacts):
                # After an earlier bounce in this substep, the straight path to the present position begins at the height `gap`.
                # What strikes a wall on which it starts may be inside of it by rounding; what rests there does not approach it.
                gap, before = -depth - leaving, (self.state.before[i] - moved).dot(n)
                if gap < 0 and gap >= -close and -before > ti.abs(before - leaving):
                    gap = 0 * gap
                strikes = gap >= 0 and leaving < 0 and mode != FRICTIONLESS
                if self.is_linked(i):
                    if strikes:
                        end = leaving + move
                        if self.defer_impact(i, n, moved, leaving, before, ti.min(end, 0)):
                            move, after = ti.max(end, 0), leaving  # what was inside before comes out without momentum
                        elif self.is_answered(i, n):
                            after = leaving
                elif strikes:
                    if ti.static(self.has_restitution):
                        rise, after, left = self.bounce(gap, leaving, before, after)
            if ti.static(self.has_log):
                self.log.record(i, depth, n, after - leaving, -leaving, moved, h, rise > 0)
            change = (after - leaving) * n
            shift = (move + rise) * n
            stuck = False
            if ti.static(self.spins):
                if mode < FRICTIONLESS:
                    high, _lift = self.bounced(i)
                    held, rests = self.apply_spin_friction(i, n, d - leaving * n, after - leaving, rise > 0)
                    stuck = rests and rise == 0 and not high
                    change -= held
                    shift -= left * held  # from the impact on
            elif ti.static(self.has_friction):
                if mode < FRICTIONLESS:
                    slip = d - leaving * n
                    size, support = slip.norm(), after - leaving
                    if size > self.static() * support:
                        slip *= self.dynamic() * support / size
                    else:
                        high, _lift = self.bounced(i)
                        stuck = rise == 0 and not high
                    change -= slip
                    shift -= slip
            self.state.d[i] = self.state.d[i] + change
            if ti.static(self.state.lifts):
                impact = change  # an impact is no acceleration
                if rise == 0:
                    impact -= (after - leaving) * n
                self.state.before[i] = self.state.before[i] + impact
            if ti.static(self.has_friction):
                if stuck:
                    self.state.restart(i)
            if not stuck:
                self.state.advance(i, shift)
        return shift

    @ti.func
    def is_linked(self, i):
        """Whether particle i is linked, so that it does not bounce alone, see BodyImpacts."""
        out = False
        if ti.static(self.has_impacts):
            out = self.impacts.is_linked(i)
        return out

    @ti.func
    def is_deferred(self, i):
        """Whether particle i is left inside of the wall until BodyImpacts pushes it."""
        out = False
        if ti.static(self.has_impacts):
            out = self.impacts.is_struck_now(i)
        return out

    @ti.func
    def is_answered(self, i, n):
        """Whether linked particle i has its impulse from a wall with the normal n: what is left moves it without momentum."""
        out = False
        if ti.static(self.has_impacts):
            out = self.impacts.answers(i, n)
        return out

    @ti.func
    def defer_impact(self, i, n, moved, leaving, before, after):
        """Whether linked particle i is left where it is in this pass, since it strikes the wall, and BodyImpacts pushes it.

        It is to leave with the restitution times its normal displacement before the substep. Without restitution it is to have
        the normal displacement `after`, with which it stays on the wall.
        """
        out = False
        if ti.static(self.has_impacts):
            bounces, target = ti.static(self.impacts.stops), after
            if ti.static(self.has_restitution):
                if self.restitution[None] > 0:
                    bounces, target = True, -self.restitution[None] * before
            bounces = bounces and -before > ti.static(SLOW) * ti.abs(before - leaving)
            static = dynamic = 0 * target
            if ti.static(self.has_friction):
                static, dynamic = self.static(), self.dynamic()
            self.impacts.cancel_bounce(i, n)
            if bounces:
                out = self.impacts.record_impact(i, n, moved, target, leaving, static, dynamic, self.log_number)
        return out

    @ti.func
    def apply_spin_friction(self, i, n, across, support, bounces):
        """Return what friction removes from the displacement `across` the normal of a spinning particle, and whether it rests.

        A particle rests where it neither slides nor rolls. support: the normal displacement from the wall. The spin is updated.
        The displacement of the contact point, d - s x n, is removed. Where the wall resists rolling, by up to a moment of rolling
        r N, both are solved for together. A particle that sticks stops as long as that moment holds it; one that rolls on does so
        against it.
        """
        k, s = self.spin.inverse_inertia[i], self.spin.s[i]
        most, least = self.static() * support, self.dynamic() * support
        slip = across - self.spin.surface(s, n)
        if ti.static(self.turns):
            if bounces:
                slip *= 1 + self.rolling[None][2]
        held = limit_length(slip / (1 + k), most, least)
        if ti.static(self.turns):
            row = self.rolling[None]
            if row[0] > 0 and not bounces:
                rolls = s - self.wall_turn(i)
                rolls -= self.spin.along(rolls, n)
                still = limit_length(across, most, least)
                moment = self.spin.moment(n, still)
                rolls += k * moment
                resisted = limit_length(rolls, k * row[0] * support, k * row[0] * support)
                held = still
                if (resisted != rolls).any():
                    held = limit_length((across - self.spin.surface(s - resisted, n)) / (1 + k), most, least)
                s -= resisted
            if row[1] > 0:
                twist = self.spin.along(s - self.wall_turn(i), n)
                s -= limit_length(twist, k * row[1] * support, k * row[1] * support)
        s += k * self.spin.moment(n, held)
        self.spin.s[i] = s
        left = across - held
        return held, left.dot(left) <= ti.static(2.0**-40) * slip.dot(slip) + ti.static(2.0**-80) * across.dot(across)

    @ti.func
    def wall_turn(self, i):
        """Return how far the surface of particle i would turn if it turned with the wall [m]."""
        out = 0 * self.spin.s[i]
        for pose in ti.static(self.poses):
            out = self.radius.of(i) * pose.spin[None]
        return out

    @ti.func
    def bounce(self, gap, leaving, before, after):
        """Return the height above the wall after a bounce, the normal displacement then, and the rest of the substep.

        The normal displacement is the one with the velocity at the end of the substep. The rest is the part after the impact: all
        of the substep where there is no bounce.
        In units of the substep, the height is gap + v s + k s^2 / 2, with k the acceleration and v = leaving - k / 2; the impact
        is at its root s. A bounce that would end below the wall has come to rest.
        """
        k = leaving - before
        v = leaving - k / 2
        root = ti.sqrt(ti.max(v * v - 2 * k * gap, 0)) - v
        rise, left = 0 * gap, 1 + 0 * gap
        if root > 0:
            s = ti.min(2 * gap / root, 1)
            out = -self.restitution[None] * (v + k * s)
            height = (1 - s) * (out + k / 2 * (1 - s))
            if height > 0 and out > 0:
                rise, left = height, 1 - s
                after = out + k * (1 - s) - k / 2
        return rise, after, left
