"""The contract of a solver, with defaults that relax each constraint by itself."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ..device import ti
from ..features.arguments import keep, names_for_users, record_arguments, refuse_deletion, set_attribute
from ..features.feature import Batch, Scene
from ..features.unknown_names import answer_names
from .corners import corners_of
from .elimination import plan
from .system import solvable

WIDTH = 16  # default width up to which Direct takes systems


class SemiIteration:
    """Passes over constraints that are relaxed by themselves. Each constraint stores the last step of its multiplier.

    That is enough for Chebyshev's semi-iteration, heavy balls and similar methods. A method that needs sums over all constraints
    is a System.
    """

    def prepare(self, iterations: int) -> None:
        """Prepare for a frame with `iterations` passes in each substep."""

    @ti.func
    def begin(self, first):
        """Prepare for a pass; called by one thread. first: 1 in the first pass of a substep."""

    @ti.func
    def step(self, last, correction):
        """Return the step of a multiplier.

        last: its step in the last pass, 0 in the first pass. correction: of a Jacobi pass, times relaxed_by().
        """
        return correction


@answer_names
class Solver:
    """How the constraints of a world are solved.

    A solver may solve some constraints together, as a System. All others are relaxed one by one: their corrections are multiplied
    by relaxed_by() and pass through a SemiIteration if the solver has one. A new solver is one file with one subclass, named in
    solvers/__init__.py, and a row in tests/test_solvers.py.
    """

    converges = False  # whether it converges within a substep, so that tensions can be too large for the substep
    arguments: Mapping[str, Any] = MappingProxyType({})
    kept_by_world: tuple[str, ...] = ()  # attributes that a world sets
    for_users: tuple[str, ...] = ()  # see names_for_users()
    __setattr__, __delattr__, _keep, __dir__ = set_attribute, refuse_deletion, keep, names_for_users

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        record_arguments(cls)

    def check(self, iterations: int) -> None:
        """Raise ValueError if the solver cannot be used with this number of iterations."""

    def system(self, scene: Scene, batches: list[Batch], slots) -> Any:
        """Return the System of constraints that are solved together; None if there are none."""

    def semi_iteration(self, scene: Scene) -> SemiIteration | None:
        """Return the rule that makes each pass from the last one; None for Jacobi's. A solver with one sets `converges`."""

    def relaxed_by(self, scene: Scene, batches: list[Batch], split: np.ndarray) -> float:
        """Return the factor on corrections of constraints that are relaxed alone. split: (n,) mass-split weights [1/kg]."""
        return 1.0

    def remedy(self, batches: list[Batch], slots, inv_mass: np.ndarray) -> str:
        """Return the setting that lowers residuals, as the user writes it; "" where only more substeps do."""
        some = [b for b in solvable(batches) if not (b.side or b.driven)]
        alone = [b for b in some if (slots.rows(b) < 0).any()]
        if not alone:
            return ""
        count, (owner, item) = sum(b.count for b in alone), corners_of(alone)
        free = inv_mass[item] > 0
        takes_all = len(plan(count, owner[free], item[free], WIDTH).rows) == count
        return "solver=tv.Direct()" if takes_all else "solver=tv.ConjugateGradient()"

    def explain(self, batches: list[Batch], slots) -> str:
        """Return which constraints are solved in which way, for World.explain()."""
        return f"{self!r}: {sum(b.count for b in batches)} constraints, each by itself"
