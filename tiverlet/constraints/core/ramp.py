"""Rest values on their way from what they were to what they were assigned, in the course of a frame."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...device.memory import Memory


class Ramp:
    """The rest values of a batch, which go straight to their goals in a frame, as a Pin goes to its target:

        rest(s) = goal - (goal - begin) (1 - s),   s: the fraction of the frame at the end of a substep.

    A rigid constraint takes out its whole violation in one substep h. A rest value that jumped by C would be one, and would move
    corners with speeds of C / h; so they have speeds of C / dt, whatever the substep. Where nothing is on its way, begin = goal,
    which gives the bits of the goal.

    batch: the Scalar, whose tracks() say what moves. What a ramp needs on the device is `made` when rest values are assigned for
    the first time, in a `memory` of its own: until then it costs nothing. under_way: whether rest values go to others in the
    coming frame. step: how far the first of the tracks goes in this substep; low: what rounding takes from where it is then.
    """

    host_only = ("memory", "under_way")

    def __init__(self, memory: "Memory", batch: Any):
        self._memory, self._batch, self.memory = memory, batch, memory
        self.made, self.under_way, self.real = False, False, memory.real

    @property
    def waits(self) -> bool:
        """Whether the device may have other rest values than were assigned."""
        return (self._batch.changed or self.under_way) and not self._batch.driven and self._batch.count > 0

    @property
    def shape(self) -> tuple[int, int]:
        """Of what now() gives, as one array."""
        return len(self._batch.tracks()), self._batch.count

    def now(self) -> list[np.ndarray]:
        """The rest values that the device has, (m,) for each track: where a ramp begins."""
        m = self._batch.count
        return [self._memory.read(field)[..., :m].astype(np.float64) for field, _, _ in self._batch.tracks()]

    def put(self, values: list[np.ndarray]) -> None:
        """Have rest values begin elsewhere: what now() gave, of another world or another time."""
        for (field, _, _), rows in zip(self._batch.tracks(), values, strict=True):
            self._memory.write(field, rows)

    def assigned(self) -> None:
        """Knobs were assigned: find out whether rest values are others now."""
        self.under_way = self.under_way or self.made or self._off_goal()

    def _off_goal(self) -> bool:
        """Whether the device has other rest values than were assigned."""
        real = np.float32 if self._memory.real == ti.f32 else np.float64
        goals = [goal for _, goal, _ in self._batch.tracks()]
        return any((now != goal.astype(real)).any() for now, goal in zip(self.now(), goals, strict=True))

    def jump(self, some: np.ndarray) -> None:
        """Have some, a mask (m,), reach their goals before the frame: their particles are put to where they are met."""
        goals = [goal for _, goal, _ in self._batch.tracks()]
        self.put([np.where(some, goal, now) for now, goal in zip(self.now(), goals, strict=True)])

    def set_out(self) -> bool:
        """Have rest values reach their goals as the coming frame ends. Returns whether kernels have to be made for it."""
        self.under_way = self._off_goal()
        new = self.under_way and not self.made
        if new:
            self._make()
        if self.made:
            tracks = list(zip(self.now(), self._batch.tracks(), strict=True))
            goals = [goal for _, (_, goal, _) in tracks]
            self._aim([goal + difference(now, goal) for now, (_, goal, difference) in tracks], goals)
        return new

    def arrive(self) -> None:
        """Rest values are what was assigned: the frame is over, or nothing was on its way."""
        goals = [goal for _, goal, _ in self._batch.tracks()]
        self.put(goals)
        if self.made:
            self._aim(goals, goals)
            self.memory.write(self.low, np.zeros(self.shape[1]))
        self.under_way = False

    def _make(self) -> None:
        """Take room, in a world that is there already."""
        self.fields = [field for field, _, _ in self._batch.tracks()]
        self.memory, name, m = self._memory.more(), repr(self._batch), self._batch.count
        self.begin = [self.memory.field(f"{name}.rest_at_begin", m) for _ in self.fields]
        self.goal = [self.memory.field(f"{name}.rest_at_end", m) for _ in self.fields]
        self.step = self.memory.field(f"{name}.step_of_rest", m)
        self.low = self.memory.field(f"{name}.rest_low", m)
        self.memory.place()
        self.made = True

    def adopt(self, before: "Ramp") -> None:
        """Take what was made for the same batch when it had other constraints."""
        self.fields, self.memory, self.made = before.fields, before.memory, True
        self.begin, self.goal, self.step, self.low = before.begin, before.goal, before.step, before.low

    def fit(self) -> None:
        """Have a row for each constraint that there is now. Nothing is on its way."""
        for field in (*self.begin, *self.goal, self.step, self.low):
            self.memory.resize(field, self._batch.count)
        self.arrive()

    def _aim(self, begin: list[np.ndarray], goal: list[np.ndarray]) -> None:
        """Go from here to there in the coming frame."""
        for field, values in zip([*self.begin, *self.goal], [*begin, *goal], strict=True):
            self.memory.write(field, values)

    @ti.func
    def follow(self, c, frame_fraction):
        """Take the rest value of constraint c to where it is at the end of the substep."""
        for k in ti.static(range(len(self.fields))):
            way = self.goal[k][c] - self.begin[k][c]
            self.fields[k][c] = self.goal[k][c] - way * (1 - frame_fraction[1])
            if ti.static(k == 0):
                self.step[c] = way * (frame_fraction[1] - frame_fraction[0])
                now = ti.cast(self.goal[k][c], ti.f64) - ti.cast(way, ti.f64) * (1 - frame_fraction[1])
                self.low[c] = ti.cast(now - self.fields[k][c], self.real)
