"""Rows of the stiff and extreme matrix: the decorator that registers them, and helpers."""

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ....contact import Contact
from ....features.feature import Feature
from ....measure import overlapping
from ....particles import Particles
from ....step.step_report import StepReport
from ....world import World

NAN, INF = float("nan"), float("inf")
# How many frames a passive scene runs, by substeps. Energy grows substep by substep: frames of 200 show as many of these in 2 s
# as frames of 20 in 20 s. "auto" goes up to some hundred, and everything rests or swings evenly after 4 s.
FRAMES: dict[Any, int] = {2: 600, 20: 600, 200: 120, "auto": 240}
SLACK = 10.0  # the largest multiple of what a row reaches that its limit may be: a looser one sees nothing get worse
ROUNDING = 1e-12  # limits up to this measure rounding in f64, of which another library of mathematics has another share
# What a flag excuses, of the figures of its frame, and up to where: what it names, and no more. No flag excuses energy.
EXCUSES: dict[str, dict[str, float]] = {
    "unconverged": {"residual": 1.0},  # links twice as long as they should be; beyond that nothing is held
    "softened": {"residual": 1.0},
    "turned": {"residual": 1.0},
    "stuck": {"residual": 1.0, "overlap": 1.0},
    "substeps-capped": {"residual": 1.0, "overlap": 1.0},
    "compressed": {"overlap": 1.0},  # up to the center of the smaller particle
    "tunnelling-risk": {"overlap": 2.0},  # up to the other side of it
}
Findings = Iterator[tuple[str, Any]]  # statements of what was seen, each with whether it is as it should be
Attempt = tuple[Callable[[], object], str]  # a call that must be refused, and a pattern in the text of the error


@dataclass(frozen=True)
class Row:
    """A row: its number, the extreme case, the criterion, and the function that runs it and yields its findings.

    known: what is wrong in the engine, if the row shows a fault that is known. As long as a finding does not hold, its verdict is
    "known fault"; once all hold it fails, so that the fault is struck here.
    """

    number: int
    what: str
    criterion: str
    attempt: Callable[[], Iterable[tuple[str, Any]]]
    known: str = ""


ROWS: dict[int, Row] = {}


def row(number: int, what: str, criterion: str, known: str = "") -> Callable:
    """Return a decorator that registers a function as the row of this number. Raises ValueError if the number is taken.

    known: see Row.
    """

    def register(attempt: Callable[[], Findings]) -> Callable[[], Findings]:
        """Register the function."""
        if number in ROWS:
            raise ValueError(f"row {number} is there twice.")
        ROWS[number] = Row(number, what, criterion, attempt, known)
        return attempt

    return register


def refusals(number: int, what: str, criterion: str, *attempts: Attempt) -> None:
    """Register a row of calls that must be refused."""
    row(number, what, criterion)(lambda: refused(*attempts))


@contextmanager
def world(particles: Particles, features: Sequence[Feature] = (), **settings) -> Iterator[Any]:
    """Provide a world in f64 that is closed at the end; warnings about its structure are suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with World(particles, features, **{"precision": "f64", **settings}) as made:
            yield made


def rerun(w: World, seconds: float, dt: float = 1 / 60, **settings) -> StepReport:
    """Restore the start of a world and run it with other settings, without compiling. Returns the worst report of all frames."""
    w.position, w.velocity = w.particles.position, w.particles.velocity
    for name, value in settings.items():
        setattr(w, name, value)
    return w.run(seconds, dt=dt)


def at_most(figure: str, value: Any, limit: float, also: bool = True) -> tuple[str, bool]:
    """Return the finding that a value is within its limit, and the limit within SLACK of the value, so that it sees it get worse.

    also: what else must hold for it.
    """
    if value <= limit and limit > max(SLACK * value, ROUNDING):
        return (
            f"{figure}: {value:.2g}, and its limit of {limit:.2g} is {limit / value if value > 0 else INF:.0f} times that",
            False,
        )
    return f"{figure}, limit {limit:.2g}", bool(value <= limit and also)


def excused(report: StepReport, figure: str, bound: float) -> bool:
    """Whether a figure of a report is within its bound, or a flag of the report excuses it."""
    bounds = (EXCUSES.get(flag, {}).get(figure, 0.0) for flag in report.flags)
    return getattr(report, figure) <= max([bound, *bounds])


def summary(figure: str, parts: Mapping[str, Any]) -> Findings:
    """Yield a figure for many parts of a criterion, and the names of those that do not hold."""
    yield figure, len(parts) > 0
    yield from ((name, False) for name, holds in parts.items() if not holds)


def refused(*attempts: Attempt) -> Findings:
    """Check that each attempt raises a ValueError or TypeError whose text matches its pattern."""
    wrong = []
    for attempt, pattern in attempts:
        try:
            made = attempt()
            if isinstance(made, World):
                made.close()
            wrong.append(f"{pattern!r} was not refused")
        except (ValueError, TypeError) as error:
            if not re.search(pattern, str(error)):
                wrong.append(f"{pattern!r} was refused with: {error}")
    yield f"{len(attempts) - len(wrong)} of {len(attempts)} refused by name", not wrong
    yield from ((why, False) for why in wrong)


def warned(attempt: Callable[[], object], pattern: str) -> bool:
    """Whether the attempt causes a warning that matches the pattern."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        made = attempt()
    if isinstance(made, World):
        made.close()
    return any(re.search(pattern, str(w.message)) for w in seen)


def finite(w: World) -> bool:
    """Whether all positions and velocities are finite."""
    return bool(np.isfinite(w.position).all() and np.isfinite(w.velocity).all())


def contacts_of(position: np.ndarray, radius, **settings) -> np.ndarray:
    """Return all pairs that overlap in a world, sorted by their indices."""
    with world(Particles(position, radius=radius), [Contact(**settings)]) as w:
        found = np.sort(w.contacts.pairs, axis=1)
    return found[np.lexsort((found[:, 1], found[:, 0]))]


def same_pairs(what: str, position: np.ndarray, radius) -> Findings:
    """Compare the contacts of a cloud of particles with brute force."""
    found, want = contacts_of(position, radius), overlapping(position, radius)[0]
    missed = len(set(map(tuple, want)) - set(map(tuple, found)))
    yield f"{what}{len(found)} contacts, {missed} missed", np.array_equal(found, want) and len(want) > 0
