"""The clocks of many worlds, as arrays; see Clock."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..step.clock import CHANGED, UNKNOWN, Clock
from ..step.integrator import FREE

NONE = -1
EMPTY = {"energy": np.nan, "bound": np.nan, "first_moved": NONE}  # stands for None


class Clocks:
    """The values of a Clock for each of many worlds: an array (worlds,) for each attribute; see Clock for their meaning.

    energy, bound: NaN where unknown. first_moved: NONE where no particle was placed. frame: (worlds, 3). drag, velocity_override:
    objects. known: whether the energy is known. needs_drag: whether knobs may need drag factors other than those in the clock and
    on the device.
    """

    def __init__(self, clocks: list[Clock]):
        for name, value in vars(Clock()).items():
            if name != "moved_mask":
                value = EMPTY.get(name, value)
                setattr(self, name, np.array([value] * len(clocks), dtype=object if value is None else None))
        self.known, self.needs_drag = np.zeros((2, len(clocks)), dtype=bool)
        for k, clock in enumerate(clocks):
            self.put(k, clock)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

        def __setattr__(self, name: str, value: Any) -> None: ...

    def of(self, k: int) -> Clock:
        """Return the clock of world k."""
        out = Clock()
        for name in vars(out).keys() & vars(self).keys():
            setattr(out, name, getattr(self, name)[k : k + 1].tolist()[0])
        since, length, count = out.frame
        out.frame = since, length, int(count)
        out.energy = out.energy if self.known[k] else None
        out.bound = None if np.isnan(self.bound[k]) else out.bound
        out.first_moved = None if out.first_moved == NONE else out.first_moved
        return out

    def put(self, k: int, clock: Clock) -> None:
        """Store the values of a clock for world k."""
        for name in vars(clock).keys() & vars(self).keys():
            value = getattr(clock, name)
            getattr(self, name)[k] = EMPTY.get(name) if value is None else value
        self.known[k] = clock.energy is not None

    def copy(self) -> "Clocks":
        """Return a copy."""
        new = Clocks([])
        vars(new).update({name: values.copy() for name, values in vars(self).items()})
        return new

    def return_to(self, other: "Clocks", some: np.ndarray) -> None:
        """Set the worlds in `some` to the values of other clocks. Knobs keep theirs, so drag may be another one."""
        needs = self.needs_drag[some] | [a != b for a, b in zip(self.drag[some], other.drag[some], strict=True)]
        for name, values in vars(self).items():
            values[some] = getattr(other, name)[some]
        self.needs_drag[some] = needs

    @property
    def drags(self) -> np.ndarray:
        """The drag factors of each world's substep, (worlds, 5), see integrator.decay()."""
        return np.array([drag or FREE for drag in self.drag])

    @property
    def softest(self) -> np.ndarray:
        """How many times as soft links are as passes make them, at most, (worlds,)."""
        return np.maximum(self.softness, self.part_softness)

    @property
    def overridden(self) -> np.ndarray:
        """Which worlds have a velocity_override, (worlds,)."""
        return np.array([velocity is not None for velocity in self.velocity_override])

    def begin(self, some: np.ndarray, energy: np.ndarray, overlap: np.ndarray, margin: np.ndarray) -> None:
        """Take the energy [J] and overlap [radii] of worlds in `some` whose state was changed, as Runner.begin() does.

        margin: see initial_margin().
        """
        placed, works = self.first_moved[some] != NONE, self.bound[some] == CHANGED
        first = placed & (self.tick[some] == 0)
        self.energy[some], self.known[some] = energy, True
        self.bound[some] = np.where(works, CHANGED, np.where(first, energy + margin, np.nan))
        self.kinetic[some] = np.where(first, 0.0, self.kinetic[some])
        self.conserves[some] = UNKNOWN
        self.parting[some] = np.where(placed, overlap > 0, self.parting[some])
        self.overlap[some] = overlap

    def count_frame(self, dt: float) -> None:
        """Begin frames of length dt [s], see Clock.next_frame(); the first is number 1."""
        new = self.frame[:, 1] != dt
        self.frame[new, 0], self.frame[new, 1], self.frame[new, 2] = self.time[new], dt, 0

    def advance(self, substeps: int, iterations: int, frames: int, started: np.ndarray) -> None:
        """Advance all worlds by `frames` frames of so many substeps and passes. started: as in Clock, for one frame."""
        self.tick[...] = (self.tick + substeps * frames) % 2**31
        self.frame[:, 2] += frames
        self.time = self.frame[:, 0] + self.frame[:, 1] * self.frame[:, 2]
        self.iterations[:] = iterations
        self.started = started & (frames == 1)
        self.lacked = np.where(self.started, self.owed, 0.0)
        self.d_is_velocity[:], self.velocity_override[:], self.first_moved[:] = False, None, NONE
