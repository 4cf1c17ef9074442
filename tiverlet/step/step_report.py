"""What a frame came to, as the user gets it."""

from dataclasses import dataclass, field
from typing import Any

UNCONVERGED = 0.1  # residual above which a frame has the flag of that name
COMPRESSED = 0.5  # overlap above which it has that flag, in radii


@dataclass(frozen=True)
class StepReport:
    """The frame that world.step() has just finished.

    residual: worst violation of a constraint, relative to its rest value. overlap: of the worst contact, in radii of the
    smaller particle. contacts: number of overlapping pairs. energy: kinetic and potential energy [J], of what has a
    potential, half a substep ago, of springs by the force that they exert; energy_change: since the frame before [J]. bad:
    index of the first particle whose state is not finite, or None. broken: number of constraints that broke; world.broken has
    them. asleep: number of particles that sleep, see Sleep. turn: 26 or 41 where a constraint turned by more than so many degrees
    in a substep, else 0. tension: (omega h)^2 of the fastest vibration across a tension that a solver converged to; 4 is the
    limit of stability. tries: how often the frame was made, see StepController. seconds: what the frame took.

    flags: words for what the user should know; notes: one sentence for each, with the cause and a remedy.
        "non-finite"        a position or displacement is NaN or infinite
        "out-of-range"      a coordinate is too large for the precision, or for the cells of the contact grid
        "tunnelling-risk"   a particle moved by more than its own size in one substep, so it may have passed another
        "compressed"        a contact overlaps by more than half of the radius of the smaller particle
        "stiff-force"       a force changes too fast for the substep (omega h > 2): with place it makes energy grow, with
                            velocity it turns motion by far too little
        "energy-gain"       the scene has more energy than it had, by a tenth of its kinetic energy, though nothing works on it
        "softened"          a system was made to give way, because its tension is too large for the substep
        "unconverged"       the residual is above 0.1: a link is off by a tenth of its length, an angle by a tenth of a radian
                            (or large clusters that share particles gained energy, because a substep became shorter)
        "turned"            a constraint turned by more than 41 degrees in a substep and lost its second order there; it
                            takes energy out, or, as a spring that the substep resolves, keeps it on average
        "moved"             what was placed off its rigid constraints by a thousandth of their size or more went to where they are
                            met before the frame, without velocity
        "substeps-capped"   the controller would have taken more substeps, but they are at most 4096, or the budget was spent
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
        """A report of all its fields, by name, in a third of the constructor's time: that of a frozen dataclass sets them one by
        one, past what keeps others from it."""
        new = object.__new__(StepReport)
        new.__dict__.update(figures)
        return new

    def _repr_html_(self) -> str:
        from ..recording.markup import of_report

        return of_report(self)

    @property
    def clean(self) -> bool:
        """Whether nothing was flagged."""
        return not self.flags

    def worse(self, other: "StepReport") -> "StepReport":
        """The later of two reports, with the worst figures of both."""
        first, last = (self, other) if self.time <= other.time else (other, self)
        return StepReport(
            last.time, max(first.substeps, last.substeps), max(first.iterations, last.iterations),
            max(first.residual, last.residual), max(first.overlap, last.overlap), max(first.contacts, last.contacts),
            last.energy, first.energy_change + last.energy_change, first.flags | last.flags,
            tuple({n.partition(":")[0]: n for n in first.notes + last.notes}.values()),
            last.bad if first.bad is None else first.bad,
            first.broken + last.broken, last.asleep, max(first.turn, last.turn), max(first.tension, last.tension),
            max(first.tries, last.tries), max(first.seconds, last.seconds),
        )  # fmt: skip
