"""Rows of the stiff and extreme matrix: the decorator that registers them, and helpers."""

import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ....features.feature import Feature
from ....measure import overlapping
from ....particles import Particles
from ....step.step_report import StepReport
from ....world import World

NAN, INF = float("nan"), float("inf")


@dataclass(frozen=True)
class Row:
    """A row: its number, the extreme case, the criterion, and the function that runs it: () -> Finding."""

    number: int
    what: str
    criterion: str
    attempt: Callable[[], "Finding"]


@dataclass
class Finding:
    """The result of a row: a figure in words, and whether each part of its criterion holds."""

    figure: str
    holds: dict[str, bool] = field(default_factory=dict)


ROWS: dict[int, Row] = {}


def row(number: int, what: str, criterion: str) -> Callable:
    """Return a decorator that registers a function as the row of this number."""

    def register(attempt: Callable[[], Finding]) -> Callable[[], Finding]:
        """Register the function. Raises ValueError if the number is taken."""
        if number in ROWS:
            raise ValueError(f"row {number} is there twice.")
        ROWS[number] = Row(number, what, criterion, attempt)
        return attempt

    return register


@contextmanager
def world(particles: Particles, features: Sequence[Feature] = (), **settings) -> Iterator[Any]:
    """Provide a world in f64 that is closed at the end; warnings about its structure are suppressed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = World(particles, features, **{"precision": "f64", **settings})
        try:
            yield made
        finally:
            made.close()


def rerun(w: World, seconds: float, dt: float = 1 / 60, **settings) -> StepReport:
    """Restore the start of a world and run it with other settings, without compiling. Returns the worst report of all frames."""
    w.position, w.velocity = w.particles.position, w.particles.velocity
    for name, value in settings.items():
        setattr(w, name, value)
    return w.run(seconds, dt=dt)


def refused(*attempts: tuple[Callable[[], object], str]) -> Finding:
    """Check that each attempt raises a ValueError or TypeError whose text matches its pattern."""
    holds = {}
    for attempt, pattern in attempts:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = attempt()
            if isinstance(made, World):
                made.close()
            holds[f"{pattern!r} was not refused"] = False
        except (ValueError, TypeError) as error:
            holds[f"{pattern!r} was refused with: {error}"] = re.search(pattern, str(error)) is not None
    return Finding(f"{sum(holds.values())} of {len(holds)} refused by name", holds)


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
    from ....contact import Contact

    with world(Particles(position, radius=radius), [Contact(**settings)]) as w:
        found = w.contacts.pairs
    found = np.sort(found, axis=1)
    return found[np.lexsort((found[:, 1], found[:, 0]))]


def same_pairs(position: np.ndarray, radius, **settings) -> Finding:
    """Compare the contacts of a cloud of particles with brute force."""
    found, want = contacts_of(position, radius, **settings), overlapping(position, radius)[0]
    missed = len(set(map(tuple, want)) - set(map(tuple, found)))
    return Finding(
        f"{len(found)} contacts, {missed} missed",
        {"as many as by brute force": len(found) == len(want), "the same": np.array_equal(found, want), "some": len(want) > 0},
    )
