"""A point that moves to a given place during a frame."""

from typing import TYPE_CHECKING

import numpy as np

from ..device import ti
from ..geometry.interpolation import interpolate

if TYPE_CHECKING:
    from ..device.memory import Memory


class Track:
    """A point of a wall that moves to a given place during a frame, in a straight line.

    in_state: its fields in the exact state, by name.
    """

    host_only = ("_memory",)

    def __init__(self, memory: "Memory", name: str, value: np.ndarray, kind=None):
        self._memory = memory
        self.ends = memory.field(name, 2, width=len(value), kind=kind, values=[value, value], state=True)
        self.in_state = {"ends": self.ends}

    def set_target(self, value: np.ndarray) -> None:
        """Move to `value` during the next frame."""
        self._memory.write(self.ends, [self._memory.read(self.ends)[1], value])

    def end_motion(self) -> None:
        """Stay where the last frame ended."""
        self._memory.write(self.ends, [self._memory.read(self.ends)[1]] * 2)

    @property
    def now(self) -> np.ndarray:
        """The place where the last frame ended, (dim,)."""
        return self._memory.read(self.ends)[1].astype(np.float64)

    @ti.func
    def at(self, frame_fraction):
        """Return the place at this fraction of the frame."""
        return interpolate(self.ends[0], self.ends[1], frame_fraction)

    @ti.func
    def step(self, frame_fraction):
        """Return the motion in a substep."""
        return (self.ends[1] - self.ends[0]) * (frame_fraction[1] - frame_fraction[0])
