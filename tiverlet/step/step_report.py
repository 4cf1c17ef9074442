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
    is the limit of stability. tries: how often the frame was computed under "auto". seconds: run time of the frame.

    flags: words for what the user should know; the table of flags in README.md has all, with what helps. notes: one sentence for
    each flag, with the cause and a remedy.
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
