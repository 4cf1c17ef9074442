"""What every solver answers, and the answers of one that does nothing special."""

from typing import Any

import numpy as np

from ..arguments import Noted
from ..feature import Batch, Scene


class Solver(Noted):
    """How the constraints of a world are solved.

    A solver may take constraints out of the relaxation and solve them together: system() then returns an object of the kind of
    direct.System. What is left is relaxed one by one, by the factor relaxed_by(), and is sped up over the passes of a substep
    where `accelerates`.
    """

    accelerates = False
    converges = False  # within a substep, so that tensions can be too large for it

    def check(self, iterations: int) -> None:
        """Raise ValueError where so many iterations make no sense."""

    def condition(self, iterations: int) -> float:
        """The condition number that the passes of a substep are made for, where they are accelerated."""
        return 1.0

    def system(self, scene: Scene, batches: list[Batch], slots) -> Any:
        """What is solved together, on the device; None for nothing."""

    def relaxed_by(self, scene: Scene, batches: list[Batch], split: np.ndarray) -> float:
        """The factor on each correction of what is relaxed by itself."""
        return 1.0

    def explain(self, batches: list[Batch], slots) -> str:
        """What is solved how."""
        return f"{self!r}: {sum(b.count for b in batches)} constraints, each by itself"
