"""How large a world is, as far as its kernels are made for it."""

from dataclasses import dataclass

STRETCH = 4  # times more or fewer of them, for which a world keeps its kernels


@dataclass(frozen=True)
class Scale:
    """How many there are of what kernels work on, which decides how they are made. work: particles and constraints."""

    particles: int
    work: int

    def holds(self, now: "Scale") -> bool:
        """Whether what was made for this is still good, so that what comes and goes compiles nothing."""
        pairs = (self.particles, now.particles), (self.work, now.work)
        return all(max(some) <= STRETCH * max(1, min(some)) for some in pairs)
