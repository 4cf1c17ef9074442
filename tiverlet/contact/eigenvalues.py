"""Eigenvalues of small symmetric matrices, on the device, and the polynomials that passes apply to eigenvalues."""

import numpy as np

from ..device import ti


@ti.func
def largest(tensor):
    """Return the largest eigenvalue of a symmetric 2 x 2 matrix, or an upper bound for 3 x 3 (Wolkowicz and Styan 1980)."""
    n = ti.static(tensor.n)
    mean = tensor.trace() / n
    for k in ti.static(range(n)):
        tensor[k, k] -= mean
    return mean + ti.static(((n - 1) / n) ** 0.5) * tensor.norm()


def chebyshev(passes: int, condition: float) -> np.ndarray:
    """Return the factors of a Chebyshev semi-iteration for eigenvalues 1 / condition ... 1 (Golub and Varga 1961)."""
    rho = (condition - 1) / (condition + 1)
    out = [1.0, 2 / (2 - rho * rho)]
    while len(out) < passes:
        out.append(4 / (4 - rho * rho * out[-1]))
    return np.array(out[:passes])
