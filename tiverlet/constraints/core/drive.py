"""Rest values that move by themselves: what turns hinges and winds ropes up."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Batch, Scene

LARGEST = 1e30  # what stands for infinity on the device, whose compilers take numbers to be finite
STALL = 0.25  # of its size: a violation that no spring bears, from where on the rest value waits for the constraint to follow
APART = 0.45  # of a period: further away, a value is nearer to the next one that means the same


def largest_load(batch: "Batch", name: str, value: Any) -> np.ndarray:
    """The largest load as the user gives it, checked: (m,), infinite for any."""
    return checks.per_item(repr(batch), name, value, batch.count, least=0.0, infinite=True)


class Drive:
    """The moving rest values of a batch on the device, and the largest loads against which they move.

    In a substep h the rest value goes `pace` h towards `goal`, or for ever where the drive is `endless` (pace then has a sign).
    With a time to `settle` it nears the goal at no more than distance / settle: a body that has to be stopped by a limited load
    would else go past the goal, and come back as fast, for ever. The multiplier is clamped to

        |lam| <= largest h^2

    that is, below the largest load the constraint is what it would be with that rest value, and at the largest load it is a force
    of that size. Then the rest value slips: it is never further away than where the multiplier reaches the limit,
    |f - rest| <= largest h^2 (W + alpha'), so that nothing is wound up that would be given back once the load is gone.

    where, of a rigid constraint, h^2 is what a load of 1 N is by its multiplier in this substep: h h / 2 in a start from given
    velocities, and h (h + h_old) / 2 where these lack half of its last kick, see Integrator.h2_rigid().

    The rest value is kept in f64, where slow motion is not lost in rounding. start: where it begins, (m,). largest: (m,), or None
    where all are infinite, which costs nothing. period: of the values that mean the same, 0 for none. settle: [s]. in_state: what
    it has in the exact state, by name.
    """

    def __init__(
        self, scene: "Scene", name: str, start: np.ndarray, goal: np.ndarray, pace: np.ndarray, largest: Any,
        endless: bool, period: float, settle: float,
    ):  # fmt: skip
        add, m = scene.memory.field, len(start)
        self._memory, self.real = scene.memory, scene.real
        self.endless, self.period, self.settle, self.capped = endless, period, settle, largest is not None
        self.target = add(f"{name}.target", m, kind=ti.f64, values=start, state=True)
        self.goal = add(f"{name}.goal", m, kind=ti.f64, values=np.clip(goal, -LARGEST, LARGEST))
        self.pace = add(f"{name}.pace", m, kind=ti.f64, values=pace)
        self.step = add(f"{name}.step_of_rest", m)
        self.in_state = {"target": self.target}
        if largest is not None:
            self.largest = add(f"{name}.largest", m, values=np.minimum(largest, LARGEST))
            self.most = add(f"{name}.largest_multiplier", m, state=True)
            self.h2_rigid = add(f"{name}.h2_rigid", None)
            self.in_state["most"] = self.most

    def upload(self, goal: np.ndarray, pace: np.ndarray, largest: np.ndarray) -> None:
        """Write new values to the device, as far as kernels read them."""
        self._memory.write(self.goal, np.clip(goal, -LARGEST, LARGEST))
        self._memory.write(self.pace, pace)
        if self.capped:
            self._memory.write(self.largest, np.minimum(largest, LARGEST))

    def values(self) -> np.ndarray:
        """Where the rest values are now, (m,)."""
        return self._memory.read(self.target)

    def rates(self, h: float) -> np.ndarray:
        """How fast they go in a substep h, where nothing holds them up, (m,)."""
        pace = self._memory.read(self.pace)
        if self.endless:
            return pace
        way = self._memory.read(self.goal) - self.values()
        if self.period > 0:
            way -= self.period * np.round(way / self.period)
        return np.clip(way / (h + self.settle), -np.abs(pace), np.abs(pace))

    def slips(self, lam: ti.Field) -> np.ndarray:
        """Which of the multipliers, a field, are the largest there may be, (m,): forces, which no longer hold anything."""
        most = self._memory.read(self.most) if self.capped else np.inf
        return np.abs(self._memory.read(lam)) >= most

    def put(self, values: np.ndarray) -> None:
        """Have them go on from elsewhere."""
        self._memory.write(self.target, values)

    @ti.func
    def near(self, value, other):
        """Of the values that mean the same, the one nearest to `other`."""
        if ti.static(self.period > 0):
            value -= self.period * ti.round((value - other) * ti.static(1 / self.period))
        return value

    @ti.func
    def advance(self, c, f, side: ti.template(), W, alpha, lam, h, h2_effective, size):  # type: ignore[valid-type]
        """The rest value at the end of a substep that starts at f.

        side, W: see Equation. alpha: compliance. lam: the multiplier of the last substep. size: of the constraint.
        """
        old, pace = self.target[c], self.pace[c]
        lag = ti.cast(f, ti.f64) - old
        lag = self.near(lag, 0 * lag)
        start = ti.cast(f, ti.f64) - lag  # where the rest value is, next to f
        if ti.static(self.capped):
            most = self.largest[c] * ti.select(alpha == 0, self.h2_rigid[None], h2_effective)
            self.most[c] = most
            slack = ti.cast(W * most, ti.f64) + ti.cast(alpha * (most / h2_effective), ti.f64)
            if lag > slack:
                start = ti.cast(f, ti.f64) - slack
            elif ti.static(side == 0) and lag < -slack:
                start = ti.cast(f, ti.f64) + slack
        way = pace * h
        if ti.static(not self.endless):
            reach, way = ti.abs(pace) * h, self.near(self.goal[c] - start, 0 * start)
            if ti.static(self.settle > 0):
                way *= h / (h + ti.static(self.settle))
            way = ti.max(-reach, ti.min(reach, way))
        stall = ti.cast(STALL * size + alpha / h2_effective * ti.abs(lam), ti.f64)
        if ti.static(self.period > 0):
            stall = ti.min(stall, ti.static(APART * self.period))
        lag = ti.cast(f, ti.f64) - start
        if (lag > stall and way < 0) or (ti.static(side == 0) and lag < -stall and way > 0):
            way = 0 * way
        start = self.near(start + way, 0 * start)
        if not ti.math.isnan(start):  # else it is where it was when f was a number
            self.target[c] = start
        self.step[c] = ti.cast(way, self.real)
        return ti.cast(self.target[c], self.real)

    @ti.func
    def clamp_force(self, c, force):
        """A force, at most the largest."""
        if ti.static(self.capped):
            force = ti.max(-self.largest[c], ti.min(self.largest[c], force))
        return force

    @ti.func
    def clamp(self, c, lam):
        """A multiplier, at most the largest."""
        if ti.static(self.capped):
            lam = ti.max(-self.most[c], ti.min(self.most[c], lam))
        return lam
