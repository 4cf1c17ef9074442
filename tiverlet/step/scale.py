"""The size of a world for which kernels are compiled."""

from dataclasses import dataclass

STRETCH = 4  # factor by which numbers may grow or shrink before a world compiles other kernels


@dataclass(frozen=True)
class Scale:
    """The numbers that decide how kernels are compiled. work: particles plus constraints."""

    particles: int
    work: int

    def holds(self, now: "Scale") -> bool:
        """Whether kernels for this size also serve the size `now`, so that an edit compiles nothing."""
        pairs = (self.particles, now.particles), (self.work, now.work)
        return all(max(some) <= STRETCH * max(1, min(some)) for some in pairs)
