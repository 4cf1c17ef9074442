"""Chebyshev acceleration of mass-split Jacobi: it converges with the root of the condition number, without global sums."""

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Scene
from .solver import SemiIteration, Solver

LIMIT = 1.29  # kappa <= LIMIT k^2: T_k > 3, so that the residual polynomial stays above -1/3


class Chebyshev(Solver):
    """Makes the passes of a substep steps of the Chebyshev semi-iteration (Golub and Varga 1961; Wang 2015 for cloth).

    With corrections z of Jacobi, eigenvalues between 1 / kappa and 1, and k passes,

        d_0 = z_0 / theta,   d_j = rho_j rho_(j-1) d_(j-1) + (2 rho_j / delta) z_j,   rho_j = T_j(sigma) / T_(j+1)(sigma)

    with theta = (1 + 1 / kappa) / 2, delta = (1 - 1 / kappa) / 2, sigma = theta / delta. Each multiplier needs one number of
    memory and no sum over all constraints. So results are the same bit for bit on any number of threads, and a pass costs as much
    as a Jacobi pass.

    kappa: the condition number for which the passes are made. Stepping is stable when kappa <= 1.29 k^2 for k iterations; a
    larger kappa is refused. None takes half of the limit, which leaves room for nonlinearity. Use 4 iterations or more; one
    iteration is Jacobi. Ropes, spacers and constraints that are not scalar functions are relaxed as by Jacobi beside it.
    """

    converges = True

    def __init__(self, kappa: float | None = None):
        self.kappa = None if kappa is None else checks.number("Chebyshev", "kappa", kappa, above=1.0)

    def check(self, iterations: int) -> None:
        """Raise ValueError if stepping with `iterations` passes would be unstable."""
        if self.kappa is not None and self.kappa > LIMIT * iterations**2:
            need = int(np.ceil(np.sqrt(self.kappa / LIMIT)))
            raise ValueError(
                f"Chebyshev: kappa = {self.kappa:g} with iterations = {iterations}, but stepping is stable only for kappa <= "
                f"1.29 iterations^2 = {LIMIT * iterations**2:.4g}. Use iterations={need} or more, or kappa=None."
            )

    def condition(self, iterations: int) -> float:
        """Return the condition number for which `iterations` passes are made."""
        return self.kappa or max(LIMIT / 2 * iterations**2, 1.1)

    def semi_iteration(self, scene: Scene) -> "ChebyshevPasses":
        """Return the passes with their weights on the device."""
        return ChebyshevPasses(self, scene)

    def __repr__(self) -> str:
        return "Chebyshev()" if self.kappa is None else f"Chebyshev(kappa={self.kappa:g})"


class ChebyshevPasses(SemiIteration):
    """The weights of the passes, on the device: those of a pass follow from those of the last pass."""

    host_only = ("solver",)

    def __init__(self, solver: Chebyshev, scene: Scene):
        self.solver, self.memory, self.real = solver, scene.memory, scene.real
        self.weights = scene.memory.field("chebyshev.weights", None, width=3, kind=ti.f64)  # of last step, of correction; rho
        self.kappa = scene.memory.field("chebyshev.condition", None, kind=ti.f64)

    def prepare(self, iterations: int) -> None:
        """Write the condition number for `iterations` passes."""
        self.memory.write(self.kappa, self.solver.condition(iterations))

    @ti.func
    def begin(self, first):
        """Compute rho_j from rho_(j-1), by T_(j+1) = 2 sigma T_j - T_(j-1)."""
        delta = (1 - 1 / self.kappa[None]) / 2
        sigma = (1 - delta) / delta
        rho = self.weights[None][2]
        if first != 0:
            self.weights[None] = ti.Vector([0, 1 / (1 - delta), 1 / sigma], ti.f64)
        else:
            now = 1 / (2 * sigma - rho)
            self.weights[None] = ti.Vector([now * rho, 2 * now / delta, now], ti.f64)

    @ti.func
    def step(self, last, correction):
        """Return d_j."""
        return ti.cast(self.weights[None][0], self.real) * last + ti.cast(self.weights[None][1], self.real) * correction
