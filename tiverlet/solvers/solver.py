"""What every solver answers, and the answers of one that does nothing special."""

from typing import Any

import numpy as np

from ..constraints.core.scalar import Scalar
from ..features.arguments import RecordsArguments
from ..features.feature import Batch, Scene
from .elimination import plan_of

WIDTH = 16  # of the systems that Direct takes


class Solver(RecordsArguments):
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

    def remedy(self, batches: list[Batch], slots, inv_mass: np.ndarray) -> str:
        """The setting that meets constraints better, as the user writes it; "" where only more substeps do."""
        alone = [b for b in batches if isinstance(b, Scalar) and b.joins and not b.side and (slots.rows(b) < 0).any()]
        if not alone:
            return ""
        rows = len(plan_of(alone, inv_mass, WIDTH).rows)
        return "solver=tv.Direct()" if rows == sum(b.count for b in alone) else "solver=tv.ConjugateGradient()"

    def explain(self, batches: list[Batch], slots) -> str:
        """What is solved how."""
        return f"{self!r}: {sum(b.count for b in batches)} constraints, each by itself"
