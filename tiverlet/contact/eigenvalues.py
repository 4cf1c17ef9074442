"""Eigenvalues of small symmetric matrices, on the device."""

from ..device import ti


@ti.func
def largest(tensor):
    """Return the largest eigenvalue of a symmetric 2 x 2 matrix, or an upper bound for 3 x 3 (Wolkowicz and Styan 1980)."""
    n = ti.static(tensor.n)
    mean = tensor.trace() / n
    for k in ti.static(range(n)):
        tensor[k, k] -= mean
    return mean + ti.static(((n - 1) / n) ** 0.5) * tensor.norm()
