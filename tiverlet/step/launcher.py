"""A frame phase by phase, each launched: what stands for a Step where no kernel goes through a whole frame."""

from typing import TYPE_CHECKING, Any

from ..contact.velocity_projection import EVERY
from ..device.language import template
from .span import Moment, Span

if TYPE_CHECKING:
    from .runner import Runner


class Launcher:
    """Goes through frame() where each phase is launched, as on a GPU, which does not wait for the host, nor the host for it.

    Phases of one half of a pass go together in one launch. What a scene does not have is left out. Where the list of neighbours
    is stale, all that is launched behind does nothing, and the frame goes on there when the host has had it built, see run().
    """

    def __init__(self, runner: "Runner"):
        self.runner, step = runner, runner.step
        self.halves, self.newton_steps, self.has_restitution = step.halves, step.newton_steps, step.has_restitution
        self.finishes, self.projects_velocities = step.finishes, step.projects_velocities
        self.drives, self.constrains, self.touches, self.acts = map(
            bool, (step.drivers, step.batches, step.contacts, step.particles.acts)
        )
        self.has_pair_forces, self.lists_pairs = step.has_pair_forces, bool(step.listed_forces)
        self.systems, self.steps = bool(step.constraints.systems), step.constraints.steps
        self.impacts, self.has_pair_impacts = step.impacts, step.has_pair_impacts
        self.looks, self.applies_first = step.looks, step.particles.applies_first
        self.waiting: list[str] = []
        self.now: Any = None  # the half of a pass that they are in

    def flush(self) -> None:
        """Launch the phases that wait."""
        if self.waiting:
            names, now, span = template(" ".join(self.waiting)), self.now, self.now.span
            self.waiting = []
            self.runner.step.phases(
                names, span.h64, span.start, span.tick, span.since, span.fresh, span.owed, now.s, span.substeps,
                span.iterations, now.half,
            )  # fmt: skip

    def put(self, now: Moment, name: str, there: bool = True) -> None:
        """Have one more phase wait for the next launch, if the scene has it. Phases of another half of a pass are launched
        before. In the second step of Newton's method its name ends with a stroke."""
        if there:
            if self.waiting and (self.now.s, self.now.half) != (now.s, now.half):
                self.flush()
            self.waiting.append(name + "'" * now.newton)
            self.now = now

    def again(self, now: Moment) -> bool:
        """Whether the substep goes on in the middle."""
        return bool(now.span.resumed) and now.s == now.span.begin

    def moment(self, span: Span, s: int) -> Moment:
        """Substep s, as far as the host has to know of it."""
        return Moment(span, s, damps=(span.since + s) % EVERY == EVERY - 1)

    def turn(self, now: Moment, half: int) -> Moment:
        """A pass, by one of its halves."""
        return now.of(half // self.halves, half < self.halves, half=half)

    def works(self, now: Moment) -> bool:
        """Always; between two substeps signals are handled."""
        self.runner.raise_signals()
        return True

    def enters(self, now: Moment) -> bool:
        """Whether the substep begins here."""
        return now.s < now.span.substeps and not self.again(now)

    def solves(self, now: Moment) -> bool:
        """Whether there is such a substep."""
        return now.s < now.span.substeps

    leaves = solves

    def ends(self, now: Moment) -> bool:
        """Whether all are done."""
        return now.s >= now.span.substeps

    def first_half(self, now: Moment) -> int:
        """The half of a pass in which the substep begins or goes on."""
        return now.span.half if self.again(now) else 0

    def last_half(self, now: Moment) -> int:
        """The one before which it ends; one more for the list after all of them."""
        passes = now.span.iterations + (self.impacts.passes if self.impacts else 0)
        return passes * self.halves if now.s < now.span.substeps else 1

    def regular(self, now: Moment, half: int) -> bool:
        """Whether this half of a pass is one of those that every substep has."""
        return half < now.span.iterations * self.halves or now.s >= now.span.substeps

    def goes_on(self, now: Moment, half: int) -> bool:
        """Whether there is this half of a pass. The host has to ask where there are bodies that may bounce off walls."""
        if self.regular(now, half):
            return True
        it = half // self.halves - now.span.iterations
        self.flush()
        return bool(self.runner.memory.read(self.impacts.open)[it])

    def begins(self, now: Moment) -> bool:
        """Whether the substep, or what comes after all of them, begins here."""
        return not self.again(now)

    def evaluate_pair_forces(self, now: Moment) -> None:
        """The first phases of a substep; the frame may have to wait for lists."""
        self.put(now, "ask_for_pairs", self.lists_pairs)
        self.put(now, "sum_pair_forces")

    def integrate(self, now: Moment) -> None:
        """Put the phase of this name; so do those below, where the scene has it."""
        self.put(now, "integrate")

    def drive(self, now: Moment) -> None:
        """Where anything is driven."""
        self.put(now, "drive", self.drives)

    def update_neighbours(self, now: Moment, half: int) -> None:
        """Have the list checked; the frame may have to wait for a new one here."""
        if half and not half % self.halves:
            self.runner.raise_signals()
        self.put(self.turn(now, half), "ask_for_list", bool(self.runner.search))
        if self.looks and self.solves(now):
            self.put(self.turn(now, half), "look_for_sleepers")
            self.put(self.turn(now, half), "ask_to_wake")

    def solve_constraints(self, now: Moment) -> None:
        """Where there are constraints."""
        self.put(now, "solve_constraints", self.constrains)

    def solve_systems(self, now: Moment) -> None:
        """Iterations of systems are launches of their own."""
        self.put(now, "start_systems" if self.steps else "solve_systems", self.systems)
        for _ in range(self.steps):
            self.flush()
            self.put(now, "iterate_systems")
        if self.steps:
            self.flush()

    def update_multipliers(self, now: Moment) -> None:
        """Where there are systems."""
        self.put(now, "update_multipliers", self.systems)

    def apply_constraints(self, now: Moment) -> None:
        """Where they are not moved once, as the pass ends."""
        self.put(now, "apply_constraints", self.applies_first)

    def unmet(self, now: Moment) -> bool:
        """Where there is one pass: the host asks no more, and where all are met a step of Newton's method does nothing."""
        return now.span.iterations == 1

    def solve_contacts(self, now: Moment) -> None:
        """The first phase of the second half."""
        self.put(now, "solve_contacts", self.touches)

    def struck(self) -> bool:
        """Always: the host does not ask whether a pair bounces, and rounds in which none does do nothing."""
        return True

    def rebound(self, now: Moment) -> None:
        """One launch for every round."""
        self.flush()
        self.put(now, "rebound")
        self.flush()

    def push_bodies(self, now: Moment) -> None:
        """Where bodies strike each other."""
        self.put(now, "push_bodies")

    def apply_corrections(self, now: Moment) -> None:
        """The last phase of a pass."""
        self.put(now, "apply_corrections", self.acts)

    def finish_substep(self, now: Moment) -> None:
        """Once, after the last pass."""
        self.put(self.now if self.waiting else now, "finish_substep")

    def project_contact_velocities(self, now: Moment) -> None:
        """A launch for each pass."""
        self.flush()
        self.put(now.of(now.it, half=now.it * self.halves), "project_contact_velocities")

    def diagnose(self, now: Moment) -> None:
        """The last launch of a frame."""
        self.flush()
        self.runner.measure(now.span.end, now.span.state_origin)
