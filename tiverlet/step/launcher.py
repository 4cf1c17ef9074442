"""A frame that is launched phase by phase: takes the place of a Step in frame() if no kernel runs a whole frame."""

from typing import TYPE_CHECKING, Any

from ..contact.limits import BOUNCES, GOING, IMPULSES, MOVES, PLACES, ROUNDS
from ..device.language import template
from .span import LISTS, MOST, Moment, Span

if TYPE_CHECKING:
    from .runner import Runner

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
        self.drives, self.constrains, self.acts = map(bool, (step.drivers, step.batches, step.particles.acts))
        self.has_pair_forces, self.lists_pairs = step.has_pair_forces, bool(step.listed_forces)
        self.systems, self.steps = bool(step.constraints.systems), step.constraints.steps
        self.rows, self.impacts = step.contact_pass.rows, step.impacts
        self.looks, self.applies_first = step.looks, step.particles.applies_first
        self.few = {ROUNDS: FEW, IMPULSES: FEW * self.rows.impulses.least if self.rows else 0, PLACES: FEW}
        self.taken = dict(MANY)
        self.needs_more = True  # whether extra passes of this substep may be needed, see BodyImpacts
        self.waiting: list[str] = []
        self.now: Any = None  # the half of a pass of the waiting phases

    def flush(self) -> None:
        """Launch the waiting phases."""
        if self.waiting:
            names, now, span = template(" ".join(self.waiting)), self.now, self.now.span
            self.waiting = []
            self.runner.step.phases(
                names, span.h64, span.start, span.tick, span.since, span.fresh, span.owed, now.s, span.substeps,
                span.iterations, now.half,
            )  # fmt: skip

    def put(self, now: Moment, name: str, there: bool = True) -> None:
        """Add a phase to those that wait for the next launch, unless `there` is false.

        If waiting phases belong to another half of a pass, launch them first. In the second Newton step, the name ends with '.
        """
        if there:
            if self.waiting and (self.now.s, self.now.half) != (now.s, now.half):
                self.flush()
            self.waiting.append(name + "'" * now.newton)
            self.now = now

    def resumes(self, now: Moment) -> bool:
        """Whether the substep resumes in the middle."""
        return bool(now.span.resumed) and now.s == now.span.begin

    def moment(self, span: Span, s: int) -> Moment:
        """Return the Moment of substep s, with the values that the host needs."""
        return Moment(span, s)

    def pass_of(self, now: Moment, half: int) -> Moment:
        """Return the Moment of one half of a pass."""
        return now.of(half // self.halves, half < self.halves, half=half)

    def takes_part(self, now: Moment) -> bool:
        """Always true. Handles signals between two substeps."""
        self.runner.raise_signals()
        return True

    def begins_substep(self, now: Moment) -> bool:
        """Whether the substep begins here."""
        return now.s < now.span.substeps and not self.resumes(now)

    def has_pass(self, now: Moment) -> bool:
        """Whether this is a substep, not the round after all substeps."""
        return now.s < now.span.substeps

    def ends_substep(self, now: Moment) -> bool:
        """Whether all passes of the substep are done."""
        return now.s < now.span.substeps and now.span.part == now.span.iterations

    def ends_frame(self, now: Moment) -> bool:
        """Whether all substeps are done."""
        return now.s >= now.span.substeps

    def first_half(self, now: Moment) -> int:
        """Return the half of a pass in which the substep begins or resumes."""
        return now.span.half if self.resumes(now) else 0

    def last_half(self, now: Moment) -> int:
        """Return the half of a pass before which the substep ends. The round after all substeps has one half, for the list."""
        extra = self.impacts.passes if self.impacts and now.span.part == now.span.iterations else 0
        passes = now.span.part + extra
        return passes * self.halves if now.s < now.span.substeps else 1

    def is_regular(self, now: Moment, half: int) -> bool:
        """Whether every substep has this half of a pass; bodies that struck walls add further ones."""
        return half // self.halves < now.span.iterations or now.s >= now.span.substeps

    def runs_half(self, now: Moment, half: int) -> bool:
        """Whether this half of a pass is run. If bodies may bounce off walls, the host has to wait for the answer."""
        if self.is_regular(now, half):
            return True
        it = half // self.halves - now.span.iterations
        if it == 0 and half % self.halves == 0:
            self.needs_more = True  # each extra pass is requested by the one before, so after one that is not needed none is
        if self.needs_more:
            self.flush()
            self.needs_more = bool(self.runner.memory.read(self.impacts.open)[it])
        return self.needs_more

    def begins_round(self, now: Moment) -> bool:
        """Whether this round (a substep, or the one after all substeps) begins here instead of resuming."""
        return not self.resumes(now)

    def evaluate_pair_forces(self, now: Moment) -> None:
        """Add the first phases of a substep. The frame may stop here until lists are rebuilt."""
        self.put(now, "ask_for_pairs", self.lists_pairs)
        self.put(now, "sum_pair_forces")

    def integrate(self, now: Moment) -> None:
        """Add the phase integrate."""
        self.put(now, "integrate")

    def drive(self, now: Moment) -> None:
        """Add the phase drive, if there are driven particles."""
        self.put(now, "drive", self.drives)

    def update_neighbours(self, now: Moment, half: int) -> None:
        """Add the check of the neighbour list. The frame may stop here until the list is rebuilt, or islands are woken."""
        if half and not half % self.halves:
            self.runner.raise_signals()
        self.put(self.pass_of(now, half), "ask_for_list", bool(self.runner.search))
        if self.looks and self.has_pass(now):
            self.put(self.pass_of(now, half), "look_for_sleepers")
            self.put(self.pass_of(now, half), "ask_to_wake")

    def solve_constraints(self, now: Moment) -> None:
        """Add the phase solve_constraints, if there are constraints."""
        self.put(now, "solve_constraints", self.constrains)

    def solve_systems(self, now: Moment) -> None:
        """Add the phases that solve systems. Each iteration of an iterative system is a launch of its own."""
        self.put(now, "start_systems" if self.steps else "solve_systems", self.systems)
        for _ in range(self.steps):
            self.flush()
            self.put(now, "iterate_systems")
        if self.steps:
            self.flush()

    def update_multipliers(self, now: Moment) -> None:
        """Add the phase update_multipliers, if there are systems."""
        self.put(now, "update_multipliers", self.systems)

    def apply_constraints(self, now: Moment) -> None:
        """Add the phase apply_constraints, unless particles move only once, at the end of the pass."""
        self.put(now, "apply_constraints", self.applies_first)

    def needs_newton_step(self, now: Moment) -> bool:
        """Whether there is only one pass. The host reads no result; if all systems are met, a second Newton step does nothing."""
        return now.span.iterations == 1 and now.it == 0

    def solve_contacts(self, now: Moment) -> None:
        """Add the phases that solve contacts, if there are any. Passes over rows are launches; some do nothing.

        If they were too few, the frame stops, and resumes with more of them.
        """
        if not (self.rows and now.it == 0):
            return
        what = now.span.what if self.resumes(now) and now.half == now.span.half else LISTS
        if what == LISTS:
            self.put(now, "start_events")
            self.put(now, "find_rows")
        if self.rows.in_turn and what <= ROUNDS:
            self.repeat(now, "strike", ROUNDS)
            self.put(now, "ask_for_rounds")
            self.put(now, "begin_impulses")
        if what <= IMPULSES:
            self.repeat(now, "relax_impulses", IMPULSES)
            self.put(now, "ask_for_impulses")
            self.put(now, "finish_impulses")
        self.repeat(now, "relax_places", PLACES)
        self.put(now, "ask_for_places")

    def repeat(self, now: Moment, name: str, what: int) -> None:
        """Launch as many passes as a substep took in the last frame. Where that is many, ask whether they are enough.

        Then launch each time as many as there were before: an answer takes the host as long as a few launches, and at most half
        of them do nothing for it.
        """
        done, more = 0, self.passes(what)
        self.flush()  # also without any pass: the same phases share a launch then, and no kernel is compiled later
        while more:
            for _ in range(more):
                self.flush()
                self.put(now, name)
            self.flush()
            done += more
            more = min(done, MANY[what] - done) if self.taken[what] > self.few[what] else 0
            if more and not self.runner.memory.read(self.rows.impulses.flags)[..., GOING].any():
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

    def apply_corrections(self, now: Moment) -> None:
        """Add the last phase of a pass, if particles have corrections to apply."""
        self.put(now, "apply_corrections", self.acts)

    def finish_substep(self, now: Moment) -> None:
        """Add the phase finish_substep, after the last pass."""
        self.put(self.now if self.waiting else now, "finish_substep")

    def diagnose(self, now: Moment) -> None:
        """Launch the diagnostics, the last launch of a frame."""
        self.flush()
        self.runner.measure(now.span.end, now.span.state_origin)
