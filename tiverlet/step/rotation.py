"""The rotation that fits one set of points best to another."""

import numpy as np


def best_rotation(A: np.ndarray) -> np.ndarray:
    """Return the R that fits R q_i best to p_i, from A = sum_i m_i p_i q_i^T, or those of a stack (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(A)
    u[..., -1] *= np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)[..., None]
    return u @ vt
