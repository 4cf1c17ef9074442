"""The clocks of many worlds, as arrays; see Clock."""

import numpy as np

from ..step.clock import Clock
from ..step.integrator import FREE

# Attributes with the same name and meaning in Clock.
PLAIN = (
    "time", "tick", "since", "h", "d_is_velocity", "started", "iterations", "softness", "softened", "owed", "lacked",
    "kinetic", "overlap", "parting",
)  # fmt: skip
NONE = -1  # first_moved where no particle was placed
NO, YES, UNKNOWN = range(3)  # whether a world conserves energy


class Clocks:
    """The values of a Clock for each of many worlds, as arrays; see Clock for their meaning.

    energy, bound: NaN where unknown. first_moved: NONE where no particle was placed. frame: (worlds, 3). needs_drag: whether
    knobs may need drag factors other than those in the clock and on the device. conserves: NO, YES or UNKNOWN.
    """

    def __init__(self, clocks: list[Clock]):
        self.count = len(clocks)
        for name in PLAIN:
            setattr(self, name, np.array([getattr(clock, name) for clock in clocks]))
        self.frame = np.array([clock.frame for clock in clocks], dtype=np.float64)
        self.energy = np.array([np.nan if clock.energy is None else clock.energy for clock in clocks], dtype=np.float64)
        self.known = np.array([clock.energy is not None for clock in clocks])
        self.bound = np.array([np.nan if clock.bound is None else clock.bound for clock in clocks], dtype=np.float64)
        self.first_moved = np.array([NONE if clock.first_moved is None else clock.first_moved for clock in clocks])
        # Lists, since these values rarely differ from world to world.
        self.drag = [clock.drag for clock in clocks]
        self.needs_drag = np.zeros(self.count, dtype=bool)
        self.conserves = np.full(self.count, UNKNOWN)
        self.velocity_override = {
            k: clock.velocity_override for k, clock in enumerate(clocks) if clock.velocity_override is not None
        }

    time: np.ndarray
    tick: np.ndarray
    since: np.ndarray
    h: np.ndarray
    d_is_velocity: np.ndarray
    started: np.ndarray
    iterations: np.ndarray
    softness: np.ndarray
    softened: np.ndarray
    owed: np.ndarray
    lacked: np.ndarray
    kinetic: np.ndarray
    overlap: np.ndarray
    parting: np.ndarray

    def of(self, k: int) -> Clock:
        """Return the clock of world k."""
        out = Clock(**{name: getattr(self, name)[k].item() for name in PLAIN})
        since, length, count = self.frame[k].tolist()
        out.frame, out.drag, out.velocity_override = (since, length, int(count)), self.drag[k], self.velocity_override.get(k)
        out.energy = float(self.energy[k]) if self.known[k] else None
        out.bound = None if np.isnan(self.bound[k]) else float(self.bound[k])
        out.first_moved = None if self.first_moved[k] == NONE else int(self.first_moved[k])
        return out

    @property
    def drags(self) -> np.ndarray:
        """The drag factors of each world's substep, (worlds, 5), see integrator.decay()."""
        return np.array([drag or FREE for drag in self.drag])

    def put(self, k: int, clock: Clock) -> None:
        """Store the values of a clock for world k."""
        for name in PLAIN:
            getattr(self, name)[k] = getattr(clock, name)
        self.frame[k], self.drag[k] = clock.frame, clock.drag
        self.known[k] = clock.energy is not None
        self.energy[k] = np.nan if clock.energy is None else clock.energy
        self.bound[k] = np.nan if clock.bound is None else clock.bound
        self.first_moved[k] = NONE if clock.first_moved is None else clock.first_moved
        if clock.velocity_override is None:
            self.velocity_override.pop(k, None)
        else:
            self.velocity_override[k] = clock.velocity_override

    def copy(self) -> "Clocks":
        """Return a copy, for return_to()."""
        return Clocks([self.of(k) for k in range(self.count)])

    def return_to(self, other: "Clocks", some: np.ndarray) -> None:
        """Set the worlds in `some` to the values of other clocks."""
        for name in (*PLAIN, "frame", "energy", "bound", "known", "first_moved"):
            getattr(self, name)[some] = getattr(other, name)[some]
        for k in map(int, some):
            self.needs_drag[k] |= self.drag[k] != other.drag[k]
            self.drag[k] = other.drag[k]
            self.velocity_override.pop(k, None)
            if k in other.velocity_override:
                self.velocity_override[k] = other.velocity_override[k]

    def count_frame(self, dt: float, some: np.ndarray) -> None:
        """Begin frames of length dt [s] in the worlds in the mask `some`, see Clock.next_frame(); the first is number 1."""
        new = some & (self.frame[:, 1] != dt)
        self.frame[new, 0], self.frame[new, 1], self.frame[new, 2] = self.time[new], dt, 0

    def advance(self, substeps: int, iterations: int, frames: int, started: np.ndarray) -> None:
        """Advance all worlds by `frames` frames of so many substeps and passes. started: as in Clock, for one frame."""
        for count in (self.tick, self.since):
            count[...] = (count.astype(np.int64) + substeps * frames) % 2**31
        self.frame[:, 2] += frames
        self.time = self.frame[:, 0] + self.frame[:, 1] * self.frame[:, 2]
        self.iterations = np.full(self.count, iterations)
        self.started = started & (frames == 1)
        self.lacked = np.where(self.started, self.owed, 0.0)
        self.d_is_velocity = np.zeros(self.count, dtype=bool)
        self.velocity_override.clear()
