"""Rest values that move from old to assigned values during a frame."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...device.memory import Memory


class Ramp:
    """The rest values of a batch, which move linearly to their goals in a frame:

        rest(s) = goal - (goal - begin) (1 - s),   s: the fraction of the frame at the end of a substep.

    A rigid constraint removes its whole violation in one substep h. If a rest value jumped by C, corners would move with speeds
    of C / h. With the ramp the speeds are C / dt, whatever the substep. Without a ramp under way, begin = goal, which gives the
    bits of the goal.

    batch: the Scalar, whose tracks() list what moves. The fields of a ramp are allocated when rest values are assigned for the
    first time, in a `memory` of their own: until then a ramp costs nothing. under_way: whether rest values move in the coming
    frame. step, steps: how far the first of the tracks moves in this substep, and in this and the last one. low: what rounding
    takes from its present value.
    """

    host_only = ("memory", "under_way", "_batch", "_memory")

    def __init__(self, memory: "Memory", batch: Any):
        self._memory, self._batch, self.memory = memory, batch, memory
        self.is_allocated, self.under_way, self.real = False, False, memory.real

    @property
    def has_pending(self) -> bool:
        """Whether rest values on the device may differ from the assigned ones."""
        return (self._batch.changed or self.under_way) and not self._batch.driven and self._batch.count > 0

    @property
    def shape(self) -> tuple[int, int]:
        """The shape of now() as one array."""
        return len(self._batch.tracks()), self._batch.count

    def now(self) -> list[np.ndarray]:
        """Return the rest values on the device, (m,) for each track: where a ramp begins."""
        m = self._batch.count
        return [self._memory.read(field)[..., :m].astype(np.float64) for field, _, _ in self._batch.tracks()]

    def put(self, values: list[np.ndarray]) -> None:
        """Set the rest values on the device, as now() returned them for another world or time."""
        for (field, _, _), rows in zip(self._batch.tracks(), values, strict=True):
            self._memory.write(field, rows)

    def check_goals(self) -> None:
        """After knobs were assigned: find out whether rest values changed."""
        self.under_way = self.under_way or self.is_allocated or self._off_goal()

    def _off_goal(self) -> bool:
        """Whether rest values on the device differ from the assigned ones."""
        real = np.float32 if self._memory.real == ti.f32 else np.float64
        goals = [goal for _, goal, _ in self._batch.tracks()]
        return any((now != goal.astype(real)).any() for now, goal in zip(self.now(), goals, strict=True))

    def jump_to_goals(self, some: np.ndarray) -> None:
        """Set the rest values of constraints in the mask `some`, (m,), to their goals: their particles were placed there."""
        goals = [goal for _, goal, _ in self._batch.tracks()]
        self.put([np.where(some, goal, now) for now, goal in zip(self.now(), goals, strict=True)])

    def hold(self) -> None:
        """Let rest values stay where they are until they start to move."""
        if self.is_allocated:
            self._write_goals(self.now(), self.now())

    def start_moving(self) -> bool:
        """Start moving rest values to their goals in the coming frame. Returns whether kernels have to be compiled for it."""
        self.under_way = self._off_goal()
        new = self.under_way and not self.is_allocated
        if new:
            self._make()
        if self.is_allocated:
            tracks = list(zip(self.now(), self._batch.tracks(), strict=True))
            goals = [goal for _, (_, goal, _) in tracks]
            self._write_goals([goal + difference(now, goal) for now, (_, goal, difference) in tracks], goals)
        return new

    def finish(self) -> None:
        """Set rest values to the assigned ones: the frame is over, or nothing was under way."""
        goals = [goal for _, goal, _ in self._batch.tracks()]
        self.put(goals)
        if self.is_allocated:
            self._refer_to_goals()
            self._write_goals(goals, goals)
            self.memory.write(self.low, np.zeros(self.shape[1]))
        self.under_way = False

    def _refer_to_goals(self) -> None:
        """Make the f that springs remember refer to the goals: the last step is no part of the state, which clones read."""
        spring, m = self._batch.dev.spring, self._batch.count
        if spring.soft and not self._batch.quantity.centred:
            last = self._memory.read(spring.last)
            last[..., :m] += self.memory.read(self.step)[..., :m]
            self._memory.write(spring.last, last)
        self.memory.write(self.step, np.zeros(self.shape[1]))

    def _make(self) -> None:
        """Allocate the fields of the ramp, in a world that exists already."""
        self.fields = [field for field, _, _ in self._batch.tracks()]
        self.memory, name, m = self._memory.make_companion(), repr(self._batch), self._batch.count
        self.begin = [self.memory.field(f"{name}.rest_at_begin", m) for _ in self.fields]
        self.goal = [self.memory.field(f"{name}.rest_at_end", m) for _ in self.fields]
        self.step = self.memory.field(f"{name}.step_of_rest", m)
        self.steps = self.memory.field(f"{name}.steps_of_rest", m)
        self.low = self.memory.field(f"{name}.rest_low", m)
        self.memory.place()
        self.is_allocated = True

    def adopt(self, before: "Ramp") -> None:
        """Take over the fields of a ramp of the same batch, made when it had other constraints."""
        self.fields, self.memory, self.is_allocated = before.fields, before.memory, True
        self.begin, self.goal, self.low = before.begin, before.goal, before.low
        self.step, self.steps = before.step, before.steps

    def resize(self) -> None:
        """Resize the fields to one row for each constraint. No rest value is under way."""
        for field in (*self.begin, *self.goal, self.step, self.steps, self.low):
            self.memory.resize(field, self._batch.count)
        self.finish()

    def _write_goals(self, begin: list[np.ndarray], goal: list[np.ndarray]) -> None:
        """Set begin and end of the ramp in the coming frame."""
        for field, values in zip([*self.begin, *self.goal], [*begin, *goal], strict=True):
            self.memory.write(field, values)

    @ti.func
    def update_rest(self, c, frame_fraction):
        """Set the rest value of constraint c to its value at the end of the substep."""
        for k in ti.static(range(len(self.fields))):
            way = self.goal[k][c] - self.begin[k][c]
            self.fields[k][c] = self.goal[k][c] - way * (1 - frame_fraction[1])
            if ti.static(k == 0):
                step = way * (frame_fraction[1] - frame_fraction[0])
                self.steps[c] = self.step[c] + step
                self.step[c] = step
                now = ti.cast(self.goal[k][c], ti.f64) - ti.cast(way, ti.f64) * (1 - frame_fraction[1])
                self.low[c] = ti.cast(now - self.fields[k][c], self.real)
