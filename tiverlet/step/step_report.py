"""The report of a frame, as the user gets it."""

import re
from dataclasses import dataclass, field
from typing import Any

from ..features.unknown_names import answer_names

UNCONVERGED = 0.05  # residual above which a frame is flagged "unconverged"
FIGURE = re.compile(r"\d[^ ,;:]*")  # notes that differ by figures only are of one kind
COMPRESSED = 0.05  # overlap from one frame to the next above which it is flagged "compressed", in radii; piles have 0.01


@answer_names
@dataclass(frozen=True)
class StepReport:
    """The report of the frame that world.step() has just finished.

    residual: worst violation of a constraint, relative to its rest value. overlap: of the worst contact, in radii of the
    smaller particle; in worlds with contacts, with walls, too. contacts: number of overlapping pairs. energy: kinetic and
    potential energy [J] in the middle of the last substep, where it has an error of second order in the substep, in worlds of
    orders above 2 too; there, world.velocity is more accurate. Forces without a potential do not count, and stiff springs
    count with the force that they exert. energy_change: since the frame before [J]. bad: index of the first particle whose
    state is not finite, or None. broken: number of constraints that broke in the frame; world.broken lists them. asleep:
    number of sleeping particles, see Sleep. turn: 26 or 41 if a constraint turned by more than that many degrees in a
    substep, else 0. tension: (omega h)^2 of the fastest vibration across a tension, where a solver converges in a substep; 4
    is the limit of stability. tries: how often the frame was computed, see StepController. seconds: run time of the frame.

    flags: words for what the user should know. notes: one sentence for each flag, with the cause and a remedy.
        "non-finite"        a position or displacement is NaN or infinite
        "out-of-range"      a coordinate is too large for the precision, or for the cells of the contact grid
        "tunnelling-risk"   a particle moved by more than its own size in one substep, so it may have passed another
        "compressed"        a contact overlaps by more than a twentieth of the radius of the smaller particle, and did so
                            when the frame began
        "stiff-force"       a force changes too fast for the substep (omega h > 2): one that depends on position makes energy
                            grow; one that depends on velocity turns motion far too little
        "energy-gain"       the scene gained more than a tenth of its largest kinetic energy, though nothing does work on it
        "energy-loss"       a scene of springs, uniform gravity, and walls and contacts without friction and with restitution 1
                            lost more than a tenth of its largest kinetic energy: springs that the substep does not resolve are
                            damped by it. Never where anything may take energy out (damping, drag, friction, rigid constraints,
                            which lose in impacts, sleep), nor with forces that vary in space
        "softened"          a solver let constraints give way, because their tension is too large for the substep
        "unconverged"       the residual is above 0.05: a link is off by a twentieth of its length, an angle by 3 degrees
                            (or large clusters that share particles gained energy, because a substep became shorter)
        "turned"            a constraint turned by more than 41 degrees in a substep and lost its second order there; a rigid one
                            dissipates energy, a spring that the substep resolves conserves it on average
        "moved"             particles violated rigid constraints by a thousandth of their size or more; before the frame they were
                            moved to meet the constraints, without velocity
        "substeps-capped"   more substeps were needed, but there are at most 4096, or the budget was spent
        "stuck"             neither more substeps nor more iterations bring the residual or the overlap to the tolerance
    """

    time: float
    substeps: int
    iterations: int
    residual: float = 0.0
    overlap: float = 0.0
    contacts: int = 0
    energy: float = 0.0
    energy_change: float = 0.0
    flags: frozenset[str] = frozenset()
    notes: tuple[str, ...] = field(default=(), repr=False)
    bad: int | None = None
    broken: int = 0
    asleep: int = 0
    turn: int = 0
    tension: float = 0.0
    tries: int = 1
    seconds: float = field(default=0.0, compare=False, repr=False)

    @staticmethod
    def of(figures: dict[str, Any]) -> "StepReport":
        """Return a report with these fields, all of them, by name.

        Takes a third of the constructor's time: a frozen dataclass sets its fields one by one, around its own write protection.
        """
        new = object.__new__(StepReport)
        new.__dict__.update(figures)
        return new

    def __str__(self) -> str:
        """The figures, and the notes below them."""
        return "\n".join([repr(self), *(f"    {note}" for note in self.notes)])

    def _repr_html_(self) -> str:
        from ..recording.markup import of_report

        return of_report(self)

    @property
    def clean(self) -> bool:
        """Whether there are no flags."""
        return not self.flags

    def worse(self, other: "StepReport") -> "StepReport":
        """Return the later of two reports, with the worst figures of both."""
        first, last = (self, other) if self.time <= other.time else (other, self)
        notes = {FIGURE.sub("", note): note for note in sorted(first.notes + last.notes, key=_badness)}
        return StepReport(
            last.time, max(first.substeps, last.substeps), max(first.iterations, last.iterations),
            max(first.residual, last.residual), max(first.overlap, last.overlap), max(first.contacts, last.contacts),
            last.energy, first.energy_change + last.energy_change, first.flags | last.flags,
            tuple(notes.values()),
            last.bad if first.bad is None else first.bad,
            first.broken + last.broken, last.asleep, max(first.turn, last.turn), max(first.tension, last.tension),
            max(first.tries, last.tries), max(first.seconds, last.seconds),
        )  # fmt: skip


def _badness(note: str) -> float:
    """Return the first figure of a note, by which notes of one kind are compared."""
    found = FIGURE.search(note)
    try:
        return float(found.group()) if found else 0.0
    except ValueError:
        return 0.0
