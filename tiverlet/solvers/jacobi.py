"""Mass-split Jacobi by slots and gathers: parallel, momentum-conserving, the same bit for bit on any number of threads."""

import numpy as np

from .. import checks
from ..features.feature import Batch, Scene
from .solver import Solver
from .spectrum import largest_eigenvalue
from .system import solvable


class Jacobi(Solver):
    """Solves every constraint by itself from the same positions; every particle sums its corrections.

    A particle in n constraints gives each an n-th of its mass (mass splitting, Tonge 2012). Then corrections never sum to
    more than the whole, and unlike averaged corrections they conserve momentum.

    relaxation: factor on each correction. With one iteration per substep, stepping is stable if and only if every eigenvalue p of
    the residual polynomial has -1/3 < p < 1, p = 1 - relaxation lambda, so relaxation < 4 / (3 lambda_max). With mass splitting
    lambda_max <= 1 for any geometry. A net that is not folded up has less (a square one 0.66, cloth with shear 0.53). When the
    world is built, power iteration finds the value of the scene as it starts. A relaxation beyond the limit is refused. "auto"
    takes 1.2 / lambda_max, or 1 where constraints are soft (their stiffness would change) or are not scalar functions.
    """

    def __init__(self, relaxation: float | str = 1.0):
        if relaxation != "auto":
            relaxation = checks.number("Jacobi", "relaxation", relaxation, above=0.0)
        self.relaxation = relaxation

    def relaxed_by(self, scene: Scene, batches: list[Batch], split: np.ndarray) -> float:
        """Return the factor for this scene. Raise ValueError if stepping would be unstable."""
        if self.relaxation != "auto" and self.relaxation < 4 / 3:
            return float(self.relaxation)
        scalars = [b for b in solvable(batches) if not b.soft]
        if len(scalars) < len(batches):
            if self.relaxation == "auto":
                return 1.0
            limit, why = 4 / 3, "4/3 where constraints are soft or not one number"
        else:
            value = max(largest_eigenvalue(scene, scalars, split), 1e-3)
            if self.relaxation == "auto":
                return max(1.0, 1.2 / value)
            limit, why = (
                4 / (3 * value),
                f"4/3 / lambda_max = {4 / (3 * value):.4g} with the lambda_max = {value:.4g} of this scene",
            )
        if self.relaxation >= limit:
            raise ValueError(
                f"Jacobi: relaxation = {self.relaxation:g}, but stepping is stable only below {why} (residual polynomial "
                'p = 1 - relaxation lambda, stable for -1/3 < p < 1). Use relaxation=1.0, or "auto".'
            )
        return float(self.relaxation)

    def explain(self, batches, slots) -> str:
        """Return which constraints are solved in which way, and the relaxation."""
        factor = f", relaxation {slots.relaxation:.3g}" if self.relaxation == "auto" else ""
        return super().explain(batches, slots) + factor

    def __repr__(self) -> str:
        factor = repr(self.relaxation) if self.relaxation == "auto" else f"{self.relaxation:g}"
        return f"Jacobi(relaxation={factor})"
