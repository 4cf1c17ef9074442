"""Rest values that move by themselves: the drives of motors and winches."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Scene

LARGEST = 1e30  # stands for infinity on the device, whose compilers assume finite numbers
STALL = 0.25  # of its size: beyond this violation, if no spring bears it, the rest value waits for the constraint
APART = 0.45  # of a period: the largest lag, since beyond half a period an equivalent value is nearer


def driven_rest(begin: str, text: str) -> property:
    """Return the property `rest` of a driven batch, which has its initial rest values in the attribute `begin`."""

    def rest(batch: Any) -> np.ndarray:
        """Return the rest values on the device, or those at which it begins, (m,)."""
        if "drive" in vars(batch.dev):
            return batch.dev.drive.values()[: batch.count]
        if begin not in vars(batch):
            raise AttributeError(f"{batch!r} has no rest before it is in a world, unless it is given.")
        return vars(batch)[begin]

    return property(rest, doc=text)


class Drive:
    """The moving rest values of a batch on the device, and the largest loads against which they move.

    In a substep h the rest value moves by `speed` h towards `goal`, or without end where the drive is `endless` (speed then has a
    sign). With a `time_constant` it nears the goal at no more than distance / time_constant. Otherwise a body that a limited load
    has to stop would overshoot, and swing back as fast, for ever. The multiplier is clamped to

        |lam| <= largest h^2

    Below the largest load the constraint acts as with that rest value; at the largest load it is a force of that size. The rest
    value then slips, so that nothing is wound up that would be released once the load is gone. It stays within the distance at
    which the multiplier reaches the limit, |f - rest| <= largest h^2 (W + alpha').

    For a rigid constraint, h^2 stands for the multiplier of a load of 1 N in this substep: h h / 2 in a start from given
    velocities, and h (h + h_old) / 2 where these velocities lack half of the last kick, see Integrator.h2_rigid().

    The rest value is kept in f64, where slow motion is not lost in rounding. batch: its course() gives goals, speeds and largest
    loads; if all of these are infinite, they cost nothing. start: the initial rest values, (m,). period: of equivalent values, 0
    for none. time_constant: [s]. in_state: its fields in the exact state, by name.
    """

    host_only = ("_memory",)

    def __init__(self, scene: "Scene", batch: Any, start: np.ndarray, endless=False, period=0.0, time_constant=0.0):
        add, m, name, (goal, speed, largest) = scene.memory.field, len(start), repr(batch), batch.course()
        self._memory, self.real = scene.memory, scene.real
        self.endless, self.period, self.time_constant, self.capped = endless, period, time_constant, batch.capped
        self.target = add(f"{name}.target", m, kind=ti.f64, values=start, state=True)
        self.goal = add(f"{name}.goal", m, kind=ti.f64, values=np.clip(goal, -LARGEST, LARGEST))
        self.speed = add(f"{name}.pace", m, kind=ti.f64, values=speed)
        self.step = add(f"{name}.step_of_rest", m)
        self.in_state = {"target": self.target}
        if self.capped:
            self.largest = add(f"{name}.largest", m, values=np.minimum(largest, LARGEST))
            self.most = add(f"{name}.largest_multiplier", m, state=True)
            self.h2_rigid = add(f"{name}.h2_rigid", None)
            self.in_state["most"] = self.most

    def upload(self, goal: np.ndarray, speed: np.ndarray, largest: np.ndarray) -> None:
        """Write new values to the device, as far as kernels read them."""
        self._memory.write(self.goal, np.clip(goal, -LARGEST, LARGEST))
        self._memory.write(self.speed, speed)
        if self.capped:
            self._memory.write(self.largest, np.minimum(largest, LARGEST))

    def values(self) -> np.ndarray:
        """Return the current rest values, (m,)."""
        return self._memory.read(self.target)

    def put(self, values: np.ndarray) -> None:
        """Continue from these rest values, (m,)."""
        self._memory.write(self.target, values)

    @ti.func
    def nearest_equivalent(self, value, other):
        """Return the value equivalent to `value` that is nearest to `other`."""
        if ti.static(self.period > 0):
            value -= self.period * ti.round((value - other) * ti.static(1 / self.period))
        return value

    @ti.func
    def advance(self, c, f, side: ti.template(), W, alpha, lam, h, h2_effective, size):  # type: ignore[valid-type]
        """Return the moved rest value at the end of a substep from f. side, W: see Equation. lam: the last multiplier."""
        old, speed = self.target[c], self.speed[c]
        lag = ti.cast(f, ti.f64) - old
        lag = self.nearest_equivalent(lag, 0 * lag)
        start = ti.cast(f, ti.f64) - lag  # the rest value, as the equivalent value nearest to f
        if ti.static(self.capped):
            most = self.largest[c] * ti.select(alpha == 0, self.h2_rigid[None], h2_effective)
            self.most[c] = most
            slack = ti.cast(W * most, ti.f64) + ti.cast(alpha * (most / h2_effective), ti.f64)
            if lag > slack:
                start = ti.cast(f, ti.f64) - slack
            elif ti.static(side == 0) and lag < -slack:
                start = ti.cast(f, ti.f64) + slack
        way = speed * h
        if ti.static(not self.endless):
            reach, way = ti.abs(speed) * h, self.nearest_equivalent(self.goal[c] - start, 0 * start)
            if ti.static(self.time_constant > 0):
                way *= h / (h + ti.static(self.time_constant))
            way = ti.max(-reach, ti.min(reach, way))
        stall = ti.cast(STALL * size + alpha / h2_effective * ti.abs(lam), ti.f64)
        if ti.static(self.period > 0):
            stall = ti.min(stall, ti.static(APART * self.period))
        lag = ti.cast(f, ti.f64) - start
        if (lag > stall and way < 0) or (ti.static(side == 0) and lag < -stall and way > 0):
            way = 0 * way
        start = self.nearest_equivalent(start + way, 0 * start)
        if not ti.math.isnan(start):  # a NaN is not stored: the rest value keeps its last number
            self.target[c] = start
        self.step[c] = ti.cast(way, self.real)
        return ti.cast(self.target[c], self.real)

    @ti.func
    def clamp_force(self, c, force):
        """Return a force, limited to the largest."""
        if ti.static(self.capped):
            force = ti.max(-self.largest[c], ti.min(self.largest[c], force))
        return force
