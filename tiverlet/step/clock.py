"""The time of a world, and whether its displacements hold velocities."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from .step_report import StepReport

# Names in recordings.
NAMES = {
    "_time": "time", "_tick": "tick", "_h": "h", "_fresh": "d_is_velocity", "_iterations": "iterations",
    "_frame": "frame", "_drag": "drag", "_started": "started", "_owed": "owed", "_lacked": "lacked",
    "_parted": "velocity_override", "_placed": "first_moved", "_energy": "energy", "_bound": "bound",
    "_kinetic": "kinetic", "_overlap": "overlap", "_parting": "parting", "_softness": "softness", "_longest": "longest",
    "_part_softness": "part_softness",
}  # fmt: skip

RATE = 16  # frames in a row that are another rate: a quarter of a second at 60 a second
OTHER = 1.5  # times as long, or as short, as the frames so far: one of another rate, if it is not alone
LATE = 8  # times as many substeps as were set, at most, in a frame that is late: a stalled program must not stall for more
EQUAL = 2.0**-50  # substeps that differ by less, relatively, are of one length: 1 / 60 / 20 and 1 / 30 / 40
SHARE = 0.1  # of the largest kinetic energy: the gain, or the loss, that is allowed
DIGITS = 1e-5  # of the energy: the gain, or the loss, that rounding may cause
CHANGED = -np.inf  # the bound while work is done on the scene in the coming frame: earlier energies do not count
SQUEEZED = 0.1  # overlap [radii] from which particles that were pressed together may push themselves apart
MET = 1e-6  # relative violation that counts as rounding
PARTED = 0.01  # overlap [radii] down to which particles placed into each other push themselves apart
PACE = 3  # values of a Pace, which say nothing of the present state
NO, YES, UNKNOWN = range(3)  # whether a scene conserves energy


def is_as_long(h: Any, last: Any) -> Any:
    """Whether substeps of h and of `last` [s] are of one length but for rounding. Numbers or arrays."""
    return abs(h - last) <= EQUAL * h


def energy_limit(bound: Any, kinetic: Any, energy: Any) -> Any:
    """The most energy that a passive scene can have [J], see energy_bound.py. Numbers or arrays."""
    return bound + SHARE * kinetic + DIGITS * abs(energy)


def energy_floor(bound: Any, kinetic: Any, energy: Any) -> Any:
    """The least energy of a scene that conserves energy [J], see energy_bound.py. Numbers or arrays."""
    return bound - SHARE * kinetic - DIGITS * abs(energy)


def exceeds(clock: Any, energy: Any, kinetic: Any, overlap: Any) -> Any:
    """Record total and kinetic energy [J] and overlap [radii] after a frame. Returns whether the energy exceeds its bound.

    clock: a Clock and numbers, or Clocks and arrays.
    """
    bound = clock.bound
    several = isinstance(bound, np.ndarray)
    if several or clock.parting or bound is None or bound == CHANGED:
        choose, largest = (np.where, np.fmax) if several else (_choose, max)
        unknown, changed = np.isnan(bound) if several else bound is None, bound == CHANGED
        before = energy if clock.energy is None else clock.energy
        bound = choose(unknown, largest(before, energy), choose(changed, energy, bound))
        clock.kinetic = choose(unknown | changed, 0.0, clock.kinetic)
        clock.conserves = choose(unknown | changed, UNKNOWN, clock.conserves)
        parting = clock.parting | (changed & (overlap > SQUEEZED))
        clock.bound, clock.parting = choose(parting, largest(bound, energy), bound), parting & (overlap > PARTED)
    clock.kinetic, clock.overlap = (np.fmax if several else max)(clock.kinetic, kinetic), overlap
    return energy > energy_limit(clock.bound, clock.kinetic, energy)


def falls_short(clock: Any, energy: Any) -> Any:
    """Return whether the energy [J] is below that of a scene that conserves it, as this one does as far as is known.

    clock: a Clock and a number, or Clocks and an array. Call it after exceeds().
    """
    short = energy < energy_floor(clock.bound, clock.kinetic, energy)
    return short & (clock.parting == 0) & (clock.conserves != NO)


def _choose(some: Any, yes: Any, no: Any) -> Any:
    return yes if some else no


def initial_margin(inv_mass: np.ndarray, extent: np.ndarray, h: Any) -> Any:
    """The kinetic energy that initial violations may become [J]: settling.py leaves up to MET of the extent (..., dim)
    [m], and a substep of h [s] removes it. Numbers or arrays."""
    return (MET * np.linalg.norm(extent, axis=-1) / h) ** 2 * (1 / inv_mass[inv_mass > 0]).sum() / 2


@dataclass
class Pace:
    """The length that substeps keep: that of the first frame, of dt [s], after the user has set so many of them.

    A loop that measures dt has frames of any length. If their number stayed, the stiffness of what passes hold would change with
    dt^2 from frame to frame, and with it the energy that this stores. Frames of another length come singly, or some in a row;
    RATE of them are another rate. A first frame sets the length until a second one is about as long, as programs start unevenly.

    off: how many frames in a row were longer, if below 0 shorter, by more than OTHER; RATE while one alone sets the length.
    """

    substeps: int = 0
    dt: float = 0.0
    off: int = 0

    def fit(self, dt: float, substeps: int) -> int:
        """Return how many substeps a frame of dt [s] has where so many are set, at most LATE times as many."""
        if self.substeps != substeps:
            self.substeps, self.dt, self.off = substeps, dt, RATE
        elif side := (dt > OTHER * self.dt) - (OTHER * dt < self.dt):
            self.off = RATE if self.off == RATE else self.off + side if side * self.off >= 0 else side
            if abs(self.off) == RATE:
                self.dt, self.off = dt, RATE
        else:
            self.off = 0
        return max(1, min(round(substeps * dt / self.dt), LATE * substeps))

    def late(self, dt: float) -> float:
        """Return how many times too long the substeps of a frame of dt [s] are for want of more of them; else 0."""
        times = dt / self.dt / LATE
        return times if times > 1 + 1 / (2 * LATE * self.substeps) else 0.0

    def checked(self, report: StepReport, dt: float) -> StepReport:
        """Return the report of a frame of dt [s], with a flag if its substeps are too long."""
        if not (times := self.late(dt)):
            return report
        note = (
            f"The frame of {dt:.3g} s is {dt / self.dt:.3g} times as long as those with {self.substeps} substeps, so each of its "
            f"{report.substeps} is {times:.3g} times as long. Take several frames of at most {LATE * self.dt:.3g} s."
        )
        return replace(report, flags=report.flags | {"substeps-capped"}, notes=(*report.notes, note))


@dataclass
class Clock:
    """The time of a world, and the state that goes with it.

    time: simulated [s]. tick: number of substeps so far, modulo 2^31. h: the last substep [s].
    d_is_velocity: whether displacements hold velocities, so that the next substep is a start. started: whether the last substep
    was a start. iterations: of the last frame. softness, longest: how many times as soft as passes make them links are, 1 or
    more, and the longest of the substeps that are about as long as this one [s], see softness.py. part_softness: the first for
    the softest part of a system that gave way in a longer substep. frame: when frames of the present length began [s], their
    length [s], their number. drag: its factors for h, see integrator.decay(). owed: the kick by rigid constraints that velocities
    before a start lack, as a time [s]. lacked: `owed` of the last substep if it was a start, else 0. velocity_override:
    velocities, valid until the next step, after constraints that contribute to them were removed or velocities were assigned; a
    start before the next step takes these. first_moved: the first particle that the user placed since the last frame; None if
    there is none. moved_mask: which of the particles from there on moved, (n,); None: all may have.
    energy: at the end of the last frame [J]; None if unknown. bound, kinetic, parting: the energy that must not be exceeded [J],
    None if unknown; the largest kinetic energy since then [J]; whether particles that were placed into each other still part;
    see energy_bound.py. overlap: of the worst contact at the end of the last frame [radii]. conserves: NO, YES or
    UNKNOWN, see energy_bound.conserves(). It follows from the features, and is not recorded; nor is moved_mask, which is None
    after a frame.
    """

    time: float = 0.0
    tick: int = 0
    h: float = 0.0
    d_is_velocity: bool = True
    started: bool = False
    iterations: int = 1
    softness: float = 1.0
    longest: float = 0.0
    part_softness: float = 1.0
    frame: tuple[float, float, int] = (0.0, 0.0, 0)
    drag: list[float] | None = None
    owed: float = 0.0
    lacked: float = 0.0
    velocity_override: np.ndarray | None = None
    first_moved: int | None = 0
    moved_mask: np.ndarray | None = None
    energy: float | None = None
    bound: float | None = None
    kinetic: float = 0.0
    overlap: float = 0.0
    parting: bool = False
    conserves: int = UNKNOWN

    def copy(self) -> "Clock":
        """A clock with the same values."""
        return replace(self)

    def put_back(self, kept: "Clock") -> None:
        """Take all values of an earlier clock."""
        for field in fields(self):
            setattr(self, field.name, getattr(kept, field.name))

    def named(self) -> dict[str, Any]:
        """Its values, by their names in recordings."""
        return {name: getattr(self, own) for name, own in NAMES.items()}

    @staticmethod
    def of(named: dict[str, Any]) -> "Clock":
        """The clock with these values, by their names in recordings."""
        if set(named) != set(NAMES):
            raise ValueError("The state is not one of this scene: it has other fields.")
        return Clock(**{own: named[name] for name, own in NAMES.items()})

    def forget_bound(self) -> None:
        """Forget the bound after the state was changed, unless work is done on the scene in the coming frame anyway."""
        if self.bound != CHANGED:
            self.bound = None

    def begin_with(self, energy: float, more: float) -> None:
        """Set the bound to the initial energy plus `more` [J], unless work is done on the scene in the coming frame."""
        if self.bound != CHANGED:
            self.bound, self.kinetic, self.conserves = float(energy + more), 0.0, UNKNOWN

    def next_frame(self, dt: float) -> tuple[float, float, int]:
        """When frames of this length began, their length, and their number with the coming one. Counting frames of equal length,
        instead of summing dt, adds no rounding errors."""
        since, length, count = self.frame
        return (since, dt, count + 1) if dt == length else (self.time, dt, 1)

    def advance(self, substeps: int, iterations: int, frame: tuple[float, float, int], started: bool) -> None:
        """Advance by so many substeps of so many passes, which made one frame."""
        self.tick = (self.tick + substeps) % 2**31
        self.iterations, self.started, self.d_is_velocity, self.velocity_override = iterations, started, False, None
        self.lacked = self.owed if started else 0.0
        self.frame, self.time = frame, frame[0] + frame[1] * frame[2]

    @property
    def hashed(self) -> list[Any]:
        """The values that the next frames depend on, for the hash."""
        later: list[Any] = [] if self.softness == 1 else [self.softness, self.longest]
        later += [] if self.velocity_override is None else [np.asarray(self.velocity_override, dtype=np.float64).tobytes()]
        return [self.time, self.tick, self.h, self.d_is_velocity, *later]

    def is_valid(self, particles: int, dim: int) -> bool:
        """Whether these values are valid for a world of so many particles."""
        if self.velocity_override is not None and (
            np.shape(self.velocity_override) != (particles, dim) or not np.isfinite(self.velocity_override).all()
        ):
            return False
        right = [type(k) is int and 0 <= k < 2**31 for k in (self.tick, self.iterations)]
        right += [type(some) is bool for some in (self.d_is_velocity, self.started, self.parting)]
        energies = self.energy or 0, self.bound or 0, self.kinetic
        soft = self.softness, self.part_softness
        right += [type(v) in (int, float) for v in (self.time, self.h, *soft, self.longest, *self.frame, *energies)]
        right += [self.first_moved is None or 0 <= self.first_moved <= particles, len(self.frame) == 3, min(soft) >= 1]
        return all(right) and (self.drag is None or [type(v) for v in self.drag] == [float] * 5)
