"""What a solver is asked, and the answers of one that does nothing special."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ..device import ti
from ..features.arguments import keep, record_arguments, refuse_deletion, set_attribute
from ..features.feature import Batch, Scene
from .elimination import plan_of
from .system import solvable

WIDTH = 16  # of the systems that Direct takes


class SemiIteration:
    """Passes over constraints that are relaxed by themselves, each of which knows the last step of its multiplier.

    That is all that Chebyshev's semi-iteration, heavy balls and their like need. Sums over all constraints are for a System.
    """

    def prepare(self, iterations: int) -> None:
        """Before a frame with so many passes in a substep."""

    @ti.func
    def begin(self, first):
        """Before a pass, by one thread. first: 1 in the first pass of a substep."""

    @ti.func
    def step(self, last, correction):
        """The step of a multiplier, from the last one (0 in the first pass) and the correction of a Jacobi pass, times
        relaxed_by()."""
        return correction


class Solver:
    """How the constraints of a world are solved.

    A solver may take constraints out of the relaxation and solve them together, by a System. What is left is relaxed one by one,
    by the factor relaxed_by(), and by a SemiIteration where it has one. A new solver is one file with one subclass, named in
    solvers/__init__.py, and a row in tests/test_solvers.py.
    """

    loads = False  # whether what is relaxed by itself learns the loads that it bears, see KnownLoad
    converges = False  # within a substep, so that tensions can be too large for it
    arguments: Mapping[str, Any] = MappingProxyType({})
    kept_by_world: tuple[str, ...] = ()  # attributes that a world sets
    __setattr__, __delattr__, _keep = set_attribute, refuse_deletion, keep

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        record_arguments(cls)

    def check(self, iterations: int) -> None:
        """Raise ValueError where so many iterations make no sense."""

    def system(self, scene: Scene, batches: list[Batch], slots) -> Any:
        """The System of what is solved together; None for nothing."""

    def semi_iteration(self, scene: Scene) -> SemiIteration | None:
        """How passes follow one another; None for those of Jacobi. A solver with one sets `converges`."""

    def relaxed_by(self, scene: Scene, batches: list[Batch], split: np.ndarray) -> float:
        """The factor on each correction of what is relaxed by itself."""
        return 1.0

    def remedy(self, batches: list[Batch], slots, inv_mass: np.ndarray) -> str:
        """The setting that meets constraints better, as the user writes it; "" where only more substeps do."""
        some = [b for b in solvable(batches) if not (b.side or b.driven)]
        alone = [b for b in some if (slots.rows(b) < 0).any()]
        if not alone:
            return ""
        rows = len(plan_of(alone, inv_mass, WIDTH).rows)
        return "solver=tv.Direct()" if rows == sum(b.count for b in alone) else "solver=tv.ConjugateGradient()"

    def explain(self, batches: list[Batch], slots) -> str:
        """What is solved how, for World.explain()."""
        return f"{self!r}: {sum(b.count for b in batches)} constraints, each by itself"
