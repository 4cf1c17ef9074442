"""How frames get to the device: launches, lists that grow, and kernels that are made anew for it."""

import copy
from typing import Any

import numpy as np

from ..contact.velocity_projection import EVERY, PASSES
from ..device.interrupts import whole
from ..device.patches.compiler import Quick
from ..step_report import StepReport
from .access import Access
from .diagnostics import STARTED, STEPPED, UNSTEPPED
from .step import CAME, END, GIVE, HALT, HANDS, REBOUNDS, H

LONG = 10_000_000  # particles and constraints, times passes, in a launch: it takes about a second


class Launches(Access):
    """What a World launches: a frame in one kernel or phase by phase, the survey after it, and the list where it does not fit."""

    _batches: list[Any]
    _since: int
    _started: bool
    _undo: Any

    def _make(self) -> None:
        """The kernels that are launched in every frame."""
        compiler, sheet = self._memory.compiler, self._survey.sheet
        self._frames = Quick(self._sub, "fused", compiler, sheet)
        self._sums = Quick(self._survey, "measure", compiler, sheet)
        self._sheet, self._given = sheet.data, sheet.data[H:]
        self._plain, self._told = vars(self._sub), self._survey.report  # Taichi looks at attributes in Python whenever we do
        self._passes = max(1, LONG // (1 + len(self._particles) + sum(b.count for b in self._batches)))  # in a launch

    def _renew(self) -> None:
        """Kernels that know of a new field; Taichi compiles them for each Substep anew."""
        self._sub = copy.copy(self._sub)
        self._survey = self._survey.of(self._sub)
        self._make()

    def _fused(self, substeps: int, iterations: int, end: float, came: int) -> None:
        """All substeps and the survey in one launch, resumed where the neighbour list had to grow; a long frame in several."""
        self._plain["team"].muster(self._sheet[HANDS])
        begin = it0 = resumed = 0
        until, part, some = substeps + 1, iterations, self._passes
        if substeps * iterations > some:
            until, part = max(1, some // iterations), min(iterations, some) if self._order == 2 else iterations
        while True:
            GIVE(
                self._given, 0, self._h, self._time, end, self._tick, self._since, self._fresh, substeps, iterations,
                begin, it0, resumed, 0, came, until, part,
            )  # fmt: skip
            self._frames()
            if self._sheet[HALT]:
                resumed, begin, it0 = (int(v) for v in self._sheet[HALT:HANDS])
                self._memory.write(self._sub.halt, 0)
                self._grow()
                continue
            if begin == substeps or (until > substeps and part == iterations):
                return
            if part < iterations:  # go on with this substep
                resumed, begin, it0, part = 1, until - 1, part * self._sub.halves, min(iterations, part + some)
            else:
                resumed, begin, it0, part = 0, until, 0, min(iterations, some) if self._order == 2 else iterations
                until = min(substeps + 1, until + max(1, some // iterations))
            self._heed_signals()

    def _heed_signals(self) -> None:
        """In a long frame: call the handlers of signals that came. What they raise undoes the frame, see World.step."""
        if self._undo:
            whole.heed()

    def _parallel(self, n: int, iterations: int) -> None:
        """A few launches per substep."""
        h, relaxes = self._h, self._batches or self._grid or self._sub.walls
        for s in range(n):
            self._heed_signals()
            fresh = int(self._fresh and s == 0)
            stale = self._sub.predicted(h, self._time, self._tick, self._since, fresh, s, n)
            for it in range(iterations if relaxes else 0):
                if it:
                    self._heed_signals()
                if stale:
                    self._list()
                if self._sub.steps:
                    self._sub.opened(h, s, n, it, fresh)
                    for _ in range(self._sub.steps):
                        self._sub.iterated()
                    state = self._sub.collected(h, s, n, it, fresh)
                else:
                    state = self._sub.relaxed(h, s, n, it, fresh)
                if self._sub.halves == 2:
                    if state & 1:
                        self._list()
                    state = self._sub.met(h, s, n, it, fresh)
                if self._sub.bounces:
                    rounds = REBOUNDS if it == 0 and state & 2 else 0
                    while rounds and self._sub.rebounded():
                        rounds -= 1
                    state = self._sub.gathered(h, s, n, it)
                stale = state & 1
            if self._sub.concludes:
                self._sub.remembered(h, self._tick + s)
            if self._sub.calms and (self._since + s) % EVERY == EVERY - 1:
                for k in range(PASSES):
                    self._sub.calmed(k)

    def _list(self) -> None:
        """Build the neighbour list, growing it until everything fits."""
        assert self._grid
        if not self._sub.launched:
            self._grid.age()
            self._look()  # whose kernel is there anyway, and lists
            return
        with self._memory.compiler():
            while self._sub.listed() > self._grid.capacity:
                self._grow()

    def _grow(self) -> None:
        """More room for near pairs, and kernels that know of it. Nothing is lost: what did not fit was counted."""
        assert self._grid
        self._grid.grow()
        self._renew()

    def _ease(self, first: int) -> None:
        """Let particles part gently that the user put into each other, from number `first` on."""
        contact = self._sub.contacts[0]
        if not contact.dev.eases:
            contact.ease()
            self._renew()
        self._sub.shrunk(first)

    def _look(self) -> None:
        """Survey the state where no frame did."""
        came = UNSTEPPED if self._fresh else STARTED if self._started else STEPPED
        if not self._sub.launched:
            self._fused(0, 1, self._time, came)
            return
        if self._grid and self._memory.read(self._grid.stale)[0]:
            self._list()
        self._sheet[H], self._sheet[END], self._sheet[CAME] = self._h, self._time, came
        self._sums()

    def _report(self, substeps: int = 1, iterations: int = 1) -> StepReport:
        """What the survey found."""
        report, extent = self._told(self._time, self._h, substeps, iterations, self._energy)
        if self._grid:
            self._grid.fit(extent)
        return report

    def _residuals(self, batch) -> np.ndarray:
        """What the last substep left of each violation in a batch."""
        self._memory.check()
        if not self._h:
            raise RuntimeError(f"{batch!r}.residual: there is none before the world has been stepped.")
        with self._memory.compiler():
            return self._survey.residuals(batch, self._h, self._started)
