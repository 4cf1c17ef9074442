"""Frames of many copies of a world in one launch, and many frames of each copy."""

import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import runtime, ti
from ..device.memory import Memory
from ..device.patches.compiler import CachedLaunch
from ..device.thread_team import LEAST
from .diagnostics import STEPPED
from .span import BEGIN, END, FIGURES, FIRST, FRESH, HALF, HALT, ORIGIN, RESUMED, SHEET, START, TICK, H, integer

if TYPE_CHECKING:
    from .step import Step

# The arguments of a launch: number of copies, frames of each, substeps of a frame; every how many frames one is kept on the track
# (0: none), frames before this launch, frames that the track has room for; whether figures are kept; adjacent copies that a
# thread takes at a time.
COUNT, FRAMES, SUBSTEPS, EVERY, BEFORE, ROWS, KEEPS, GRAIN = range(8)
PLAN = GRAIN + 1
DATES = 4  # per copy: when frames of the present length began [s], their length [s], their number; frames done in this launch
WRAP = 2.0**31  # substeps are counted modulo this


def sheets(clocks: Any, end: np.ndarray, origin: np.ndarray, substeps: int, passes: int) -> np.ndarray:
    """Return the sheets of frames, one row per copy, see Span. clocks: Clocks. end, origin: with a value per copy."""
    out, c = np.zeros((len(end), SHEET)), clocks
    given = (
        c.h, c.time, end, c.tick, c.d_is_velocity, c.owed, substeps, passes, 0, 0, 0, 0, origin, substeps + 1, passes
    )  # fmt: skip
    out[:, H:] = np.column_stack([np.broadcast_to(values, len(end)) for values in given])
    return out


@ti.data_oriented
class Frames:
    """The kernels that advance copies frame by frame, each copy on one thread, with their arguments and results.

    sheet: of each copy, see span.py. dates: of each copy, see DATES. next: the next copy that no thread has taken.
    """

    kernels_read = ("step", "memory", "copies", "sheet", "dates", "next", "lanes", "spread")

    def __init__(self, step: "Step", memory: Memory):
        assert memory.copies
        self.step, self.memory, self.copies = step, memory, memory.copies
        self.sheet = memory.field("frames.sheet", SHEET, kind=ti.f64)
        self.dates = memory.field("frames.dates", DATES, kind=ti.f64)
        self.next = memory.field("frames.next", None, kind=ti.i32, shared=True)
        # On a CPU, a thread that has finished takes the next copies; elsewhere each thread has one copy.
        on_cpu = runtime.architecture() == "cpu"
        self.lanes, self.spread = (runtime.cores(), LEAST) if on_cpu else (self.copies.count, 1)

    def of(self, step: "Step") -> "Frames":
        """Return a copy with the same fields, for another Step."""
        new = copy.copy(self)
        new.step = step
        return new

    def grain(self, copies: int) -> int:
        """Return how many copies, out of `copies`, a thread takes at a time.

        Several, since threads that write to the same cache line slow each other down; not too many, so that all threads end at
        about the same time.
        """
        return min(64, max(1, copies // (8 * self.lanes)))

    def launch_one(self, sheet: np.ndarray) -> Callable[[], None]:
        """Return a function that runs the frame on this sheet for the chosen copy alone, in place of Step.fused."""
        plan, which = np.zeros(PLAN, dtype=np.int32), np.zeros(1, dtype=np.int32)
        plan[COUNT] = plan[FRAMES] = plan[GRAIN] = 1
        none = np.zeros(1)
        launch = CachedLaunch(self, "run", self.memory.compiler, plan, which, none, none)

        def launched() -> None:
            """Write the sheet to the device, launch, and read the sheet back."""
            assert self.copies.chosen is not None
            which[0] = self.copies.chosen
            self.memory.write(self.sheet, sheet)
            self.memory.write(self.dates, 0.0)
            launch()
            self.memory.check()
            sheet[:] = self.memory.read(self.sheet)

        return launched

    @ti.kernel
    def run(
        self, plan: ti.types.ndarray(ti.i32, 1), which: ti.types.ndarray(ti.i32, 1), figures: ti.types.ndarray(ti.f64, 1),  # type: ignore[valid-type]
        track: ti.types.ndarray(ti.f64, 1),  # type: ignore[valid-type]
    ):  # fmt: skip
        """Run all frames of the copies listed in `which`. plan, figures, track: see COUNT ... GRAIN, and keep()."""
        for _ in range(1):
            self.next[None] = 0
        for lane in range(self.lanes * self.spread):
            if lane % self.spread == 0:
                first = ti.atomic_add(self.next[None], plan[GRAIN])
                while first < plan[COUNT]:
                    for k in range(first, ti.min(first + plan[GRAIN], plan[COUNT])):  # type: ignore[arg-type]
                        self.go_through(which[k], plan, figures, track)
                    first = ti.atomic_add(self.next[None], plan[GRAIN])

    @ti.kernel
    def velocities(
        self, count: ti.i32, which: ti.types.ndarray(ti.i32, 1), given: ti.types.ndarray(ti.f64, 2),  # type: ignore[valid-type]
        out: ti.types.ndarray(ti.f64, 1),  # type: ignore[valid-type]
    ):  # fmt: skip
        """Write the velocities, as the user sees them, of the copies listed in `which` to `out`.

        given: for each, h, t, `firm` and `soft` of Passes.push_reaction(), and `firm` for contacts and walls.
        """
        for k in range(count):
            w = which[k]
            self.copies.enter(w)
            self.step.write_reactions(given[k, 0], given[k, 2], given[k, 3])
            for i in range(self.step.n):
                v = self.step.velocity_of(i, given[k, 0], given[k, 1], given[k, 4])
                for a in ti.static(range(self.step.dim)):
                    out[(w * self.step.n + i) * self.step.dim + a] = v[a]

    @ti.func
    def go_through(self, w, plan: ti.template(), figures: ti.template(), track: ti.template()):  # type: ignore[valid-type]
        """Run the frames of copy w, up to one that has to wait for a longer list."""
        self.copies.enter(w)
        f, waits = ti.cast(self.dates[3], ti.i32), 0
        while f < plan[FRAMES] and waits == 0:
            self.step.run(integer(self.sheet, FIRST), self.sheet)
            waits = integer(self.sheet, HALT)
            if waits == 0:
                self.keep(w, f, plan, figures, track)
                self.turn_over(plan)
                f += 1
        self.dates[3] = f

    @ti.func
    def keep(self, w, f, plan: ti.template(), figures: ti.template(), track: ti.template()):  # type: ignore[valid-type]
        """Store the figures of frame f of copy w, and the positions at its end if this frame is kept on the track."""
        if plan[KEEPS] != 0:
            for k in range(FIGURES):
                figures[(w * plan[FRAMES] + f) * FIGURES + k] = self.sheet[k]
        made = plan[BEFORE] + f + 1
        if plan[EVERY] > 0 and made % ti.max(1, plan[EVERY]) == 0:
            row = w * plan[ROWS] + made // plan[EVERY] - 1
            for i in range(self.step.n):
                for a in ti.static(range(self.step.dim)):
                    x = ti.cast(self.step.state.x[i][a], ti.f64)
                    if ti.static(self.step.state.sums):
                        x += self.step.state.low[i][a]
                    track[(row * self.step.n + i) * self.step.dim + a] = x

    @ti.func
    def turn_over(self, plan: ti.template()):  # type: ignore[valid-type]
        """Write the sheet for the next frame, as Clock.advance() and Runner.run() do."""
        self.dates[2] += 1
        self.sheet[START] = self.sheet[END]
        self.sheet[END] = self.dates[0] + self.dates[1] * (self.dates[2] + 1)
        count = self.sheet[TICK] + plan[SUBSTEPS]
        self.sheet[TICK] = ti.select(count >= WRAP, count - WRAP, count)
        self.sheet[FRESH], self.sheet[ORIGIN] = 0, STEPPED
        self.sheet[BEGIN], self.sheet[HALF], self.sheet[RESUMED] = 0, 0, 0
