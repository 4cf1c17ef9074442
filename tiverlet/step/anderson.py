"""Anderson mixing: the fixed point of a map is found in fewer of its values, by a linear fit to the last ones (Anderson 1965).

With x the points, g the map, and f = g(x) - x, the next point is

    y = g(x_k) - sum_j gamma_j (g(x_k) - g(x_j)),   gamma = argmin |f_k - sum_j gamma_j (f_k - f_j)|

For linear maps that is GMRES, which needs some sqrt(kappa) values where the map alone needs kappa.
"""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .violations import Bodies

DEPTH = 8  # values that a fit uses; more are not better in f32
FARTHEST = 32.0  # times the last move: a longer jump is no extrapolation any more
DAMPING = 1e-12  # of the trace of the normal equations: what keeps them regular, beside rounding


class Anderson:
    """The last values of a map of the particles, each of whose bodies is fitted by itself."""

    def __init__(self, bodies: "Bodies"):
        self.bodies = bodies
        self._values: list[tuple[np.ndarray, np.ndarray]] = []

    def forget(self) -> None:
        """Begin anew, after a jump of the map."""
        self._values = []

    def next(self, x: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Record the value g of the map at x, both (n, dim). Returns the next point: g itself at first."""
        f, past = g - x, self._values
        self._values = [*past, (g, f)][-DEPTH:]
        if not past:
            return g
        steps = [(g - before, f - change) for before, change in past]
        A = np.array([[self._products(a, b) for _, a in steps] for _, b in steps]).transpose(2, 0, 1)
        A += (DAMPING * np.trace(A, axis1=1, axis2=2) + np.finfo(float).tiny)[:, None, None] * np.eye(len(steps))
        gamma = np.linalg.solve(A, np.array([self._products(a, f) for _, a in steps]).T[:, :, None])[self.bodies.body, :, 0]
        jump = -np.einsum("nj,jnd->nd", gamma, np.array([step for step, _ in steps]))
        far, most = self.bodies.longest(jump), FARTHEST * self.bodies.longest(f)
        share = np.divide(most, far, out=np.zeros_like(far), where=far > 0)  # 0 where a fit is not finite, too
        return g + np.where(np.isfinite(jump), np.minimum(share, 1)[self.bodies.body, None] * jump, 0.0)

    def _products(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return a . b for each body, (bodies,)."""
        return np.bincount(self.bodies.body, (a * b).sum(axis=1), self.bodies.count)
