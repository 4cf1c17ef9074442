"""Where each of many worlds is in time: what Clock has, as arrays."""

import numpy as np

from ..step.clock import Clock
from ..step.integrator import FREE

# As they are in a Clock.
PLAIN = "time", "tick", "since", "h", "d_is_velocity", "started", "longest", "owed", "lacked", "softened", "kinetic", "parting"
NONE = -1  # for first_moved


class Clocks:
    """Arrays with one value for each world; see Clock for what they mean.

    energy, bound: NaN where it is not known. first_moved: NONE where nothing was placed. frame: (worlds, 3). asks_drag: whether
    knobs may ask for other factors of drag than a clock and the device have.
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
        # What differs from world to world in rare cases only, or is the same for all.
        self.drag = [clock.drag for clock in clocks]
        self.asks_drag = np.zeros(self.count, dtype=bool)
        self.parted = {k: clock.parted for k, clock in enumerate(clocks) if clock.parted is not None}

    time: np.ndarray
    tick: np.ndarray
    since: np.ndarray
    h: np.ndarray
    d_is_velocity: np.ndarray
    started: np.ndarray
    longest: np.ndarray
    owed: np.ndarray
    lacked: np.ndarray
    softened: np.ndarray
    kinetic: np.ndarray
    parting: np.ndarray

    def of(self, k: int) -> Clock:
        """The clock of one world."""
        out = Clock(**{name: getattr(self, name)[k].item() for name in PLAIN})
        since, length, count = self.frame[k].tolist()
        out.frame, out.drag, out.parted = (since, length, int(count)), self.drag[k], self.parted.get(k)
        out.energy = float(self.energy[k]) if self.known[k] else None
        out.bound = None if np.isnan(self.bound[k]) else float(self.bound[k])
        out.first_moved = None if self.first_moved[k] == NONE else int(self.first_moved[k])
        return out

    @property
    def drags(self) -> np.ndarray:
        """What drag makes of the substep of each, (worlds, 5)."""
        return np.array([drag or FREE for drag in self.drag])

    def put(self, k: int, clock: Clock) -> None:
        """Take what a clock of one world says now."""
        for name in PLAIN:
            getattr(self, name)[k] = getattr(clock, name)
        self.frame[k], self.drag[k] = clock.frame, clock.drag
        self.known[k] = clock.energy is not None
        self.energy[k] = np.nan if clock.energy is None else clock.energy
        self.bound[k] = np.nan if clock.bound is None else clock.bound
        self.first_moved[k] = NONE if clock.first_moved is None else clock.first_moved
        if clock.parted is None:
            self.parted.pop(k, None)
        else:
            self.parted[k] = clock.parted

    def copy(self) -> "Clocks":
        """The same, to return to."""
        return Clocks([self.of(k) for k in range(self.count)])

    def return_to(self, other: "Clocks", some: np.ndarray) -> None:
        """Give some the times of others."""
        for name in (*PLAIN, "frame", "energy", "bound", "known", "first_moved"):
            getattr(self, name)[some] = getattr(other, name)[some]
        for k in map(int, some):
            self.asks_drag[k] |= self.drag[k] != other.drag[k]
            self.drag[k] = other.drag[k]
            self.parted.pop(k, None)
            if k in other.parted:
                self.parted[k] = other.parted[k]

    def count_frame(self, dt: float, some: np.ndarray) -> None:
        """Some worlds begin frames of this length, see Clock.counted(); the first of these has number 1."""
        new = some & (self.frame[:, 1] != dt)
        self.frame[new, 0], self.frame[new, 1], self.frame[new, 2] = self.time[new], dt, 0

    def advance(self, substeps: int, frames: int, started: np.ndarray) -> None:
        """So many frames of so many substeps have gone by for all. started: see Clock, where it is one frame."""
        for count in (self.tick, self.since):
            count[...] = (count.astype(np.int64) + substeps * frames) % 2**31
        self.frame[:, 2] += frames
        self.time = self.frame[:, 0] + self.frame[:, 1] * self.frame[:, 2]
        self.started = started & (frames == 1)
        self.lacked = np.where(self.started, self.owed, 0.0)
        self.d_is_velocity = np.zeros(self.count, dtype=bool)
        self.parted.clear()
