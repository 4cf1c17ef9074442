"""A frame that is launched phase by phase: takes the place of a Step in frame() if no kernel runs a whole frame."""

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from ..contact.impulses import BOUNCES, IMPULSES, MOVES, PLACES, ROUNDS
from ..device.language import template
from .span import LISTS, MOST, Moment, Span

if TYPE_CHECKING:
    from .runner import Runner

Phase = Callable[[Moment], None]  # one of Step
FEW = 2  # rounds of impacts, passes of places, and times the fewest passes of impulses, that are launched without being asked for
MANY = {ROUNDS: BOUNCES, IMPULSES: BOUNCES, PLACES: MOVES}  # most of them in a substep


class Launcher:
    """Launches the phases of frame(), as on a GPU. Neither the device nor the host waits for the other.

    Phases of one half of a pass share one launch. Phases that the scene does not need are skipped. If the neighbour list is
    stale, all later launches of the frame do nothing. The host then has the list rebuilt, and launches again from there, see
    Runner._launch(). So it is where a substep needs more passes of contacts than were launched.

    taken: how many rounds of impacts, and passes of impulses and of places, a substep of the last frame took at most. few: how
    many of each are launched at most without asking for more, which no substep at rest needs.
    """

    def __init__(self, runner: "Runner"):
        self.runner, step = runner, runner.step
        self.halves, self.newton_steps, self.finishes = step.halves, step.newton_steps, step.finishes
        self.has_pair_forces, self.lists_pairs = step.has_pair_forces, bool(step.listed_forces)
        self.systems, self.steps = bool(step.constraints.systems), step.constraints.steps
        self.rows, self.impacts = step.contact_pass.rows, step.impacts
        self.has_impacts, self.looks = step.has_impacts, step.looks
        self.few = {ROUNDS: FEW, IMPULSES: FEW * self.rows.impulses.least if self.rows else 0, PLACES: FEW}
        self.taken = dict(MANY)
        self.needs_more = True  # whether extra passes of this substep may be needed, see BodyImpacts
        self.waiting: list[Phase] = []  # phases of one moment, for the next launch
        self.now: Any = None  # the moment of the waiting phases
        # Phases that are one launch, or part of one, where the scene needs them.
        self.integrate = self.phase(step.integrate)
        self.drive = self.phase(step.drive, bool(step.drivers))
        self.solve_constraints = self.phase(step.solve_constraints, bool(step.batches))
        self.update_multipliers = self.phase(step.update_multipliers, self.systems)
        self.apply_constraints = self.phase(step.apply_constraints, step.particles.applies_first)
        self.apply_corrections = self.phase(step.apply_corrections, step.particles.acts)

    @property
    def step(self) -> Any:
        """The phases, in the kernels of the present lists."""
        return self.runner.step

    def phase(self, phase: Phase, needed: bool = True) -> Phase:
        """Return a function that adds a phase to the waiting ones."""
        return partial(self.put, phase=phase) if needed else lambda now: None

    def flush(self) -> None:
        """Launch the waiting phases."""
        if self.waiting:
            names, now, span = template(" ".join(phase.__name__ for phase in self.waiting)), self.now, self.now.span
            self.waiting = []
            self.step.phases(
                names, span.h64, span.start, span.tick, span.fresh, span.owed, now.s, span.substeps,
                span.iterations, now.half, now.newton,
            )  # fmt: skip

    def put(self, now: Moment, phase: Phase) -> None:
        """Add a phase to those that wait for the next launch. If these belong to another moment, launch them first."""
        if self.waiting and (self.now.s, self.now.half, self.now.newton) != (now.s, now.half, now.newton):
            self.flush()
        self.waiting.append(phase)
        self.now = now

    def moment(self, span: Span, s: int) -> Moment:
        """Return the Moment of substep s, with the values that the host needs."""
        return Moment(span, s, resumed=span.resumed if s == span.begin else 0)

    def pass_of(self, now: Moment, half: int) -> Moment:
        """Return the Moment of one half of a pass."""
        return now.of(half // self.halves, half < self.halves, half=half)

    def takes_part(self, now: Moment) -> bool:
        """Always true. Handles signals between two substeps."""
        self.runner.raise_signals()
        return True

    def halted(self) -> int:
        """Return 0: where the frame has stopped, launches do nothing."""
        return 0

    def runs_half(self, now: Moment, half: int, regular: bool) -> bool:
        """Whether this half of a pass is run. If bodies may bounce off walls, the host has to wait for the answer."""
        if regular:
            return True
        it = half // self.halves - now.span.iterations
        if it == 0 and half % self.halves == 0:
            self.needs_more = True  # each extra pass is requested by the one before, so after one that is not needed none is
        if self.needs_more:
            self.flush()
            self.needs_more = bool(self.runner.memory.read(self.impacts.open)[it])
        return self.needs_more

    def evaluate_pair_forces(self, now: Moment) -> None:
        """Add the first phases of a substep. The frame may stop here until lists are rebuilt."""
        if self.lists_pairs:
            self.put(now, self.step.ask_for_pairs)
        self.put(now, self.step.sum_pair_forces)

    def update_neighbours(self, now: Moment, half: int) -> None:
        """Add the check of the neighbour list. The frame may stop here until the list is rebuilt, or islands are woken."""
        if half and not half % self.halves:
            self.runner.raise_signals()
        if self.runner.search:
            self.put(self.pass_of(now, half), self.step.ask_for_list)
        if self.looks and now.s < now.span.substeps:
            self.put(self.pass_of(now, half), self.step.look_for_sleepers)
            self.put(self.pass_of(now, half), self.step.ask_to_wake)

    def solve_systems(self, now: Moment) -> None:
        """Add the phases that solve systems. Each iteration of an iterative system is a launch of its own."""
        if not self.systems:
            return
        self.put(now, self.step.start_systems if self.steps else self.step.solve_systems)
        for _ in range(self.steps):
            self.flush()
            self.put(now, self.step.iterate_systems)
        if self.steps:
            self.flush()

    def needs_newton_step(self, now: Moment) -> bool:
        """Whether there is only one pass. The host reads no result; if all systems are met, a second Newton step does nothing."""
        return now.span.iterations == 1 and now.it == 0

    def solve_contacts(self, now: Moment) -> None:
        """Add the phases that solve contacts, if there are any. Passes over rows are launches; some do nothing.

        If they were too few, the frame stops, and resumes with more of them.
        """
        if not (self.rows and now.it == 0):
            return
        what = now.span.what if now.resumed and now.half == now.span.half else LISTS
        if what == LISTS:
            self.put(now, self.step.start_events)
            self.put(now, self.step.find_rows)
        if self.rows.in_turn and what <= ROUNDS:
            self.repeat(now, self.step.strike, ROUNDS)
            self.put(now, self.step.ask_for_rounds)
            self.put(now, self.step.begin_impulses)
        if what <= IMPULSES:
            self.repeat(now, self.step.relax_impulses, IMPULSES)
            self.put(now, self.step.ask_for_impulses)
            self.put(now, self.step.finish_impulses)
        self.repeat(now, self.step.relax_places, PLACES)
        self.put(now, self.step.ask_for_places)

    def repeat(self, now: Moment, phase: Phase, what: int) -> None:
        """Launch as many passes as a substep took in the last frame. Where that is many, ask whether they are enough.

        Then launch each time as many as there were before: an answer takes the host as long as a few launches, and at most half
        of them do nothing for it.
        """
        done, more = 0, self.passes(what)
        self.flush()  # also without any pass: the same phases share a launch then, and no kernel is compiled later
        while more:
            for _ in range(more):
                self.flush()
                self.put(now, phase)
            self.flush()
            done += more
            more = min(done, MANY[what] - done) if self.taken[what] > self.few[what] else 0
            if more and not self.runner.memory.read(self.rows.impulses.going).any():
                return

    def passes(self, what: int) -> int:
        """Return how many passes of a kind are launched at once in a substep."""
        return min(self.taken[what], self.few[what])

    @property
    def passes_launched(self) -> int:
        """The number of launches of passes over rows in a substep."""
        in_turn = self.passes(ROUNDS) + 1 if self.rows.in_turn else 0
        return in_turn + self.passes(IMPULSES) + self.passes(PLACES)

    def launch_more(self, what: int) -> None:
        """After a frame stopped because a substep takes more passes than were launched: ask from now on."""
        self.taken[what] = MANY[what]

    def learn(self, data: Any) -> None:
        """After a frame: take from its sheet how many passes a substep took."""
        for what in self.taken:
            self.taken[what] = int(data[MOST + what])

    def finish_substep(self, now: Moment) -> None:
        """Add the phase finish_substep, after the last pass."""
        self.put(self.now if self.waiting else now, self.step.finish_substep)

    def diagnose(self, now: Moment) -> None:
        """Launch the diagnostics, the last launch of a frame."""
        self.flush()
        self.runner.measure(now.span.end, now.span.state_origin)
