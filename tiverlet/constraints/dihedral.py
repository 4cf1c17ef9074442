"""Angles between triangles."""

import numpy as np

from ..checks import ArrayLike
from .core.angle import REST_ANGLE, DihedralAngle
from .core.scalar import Scalar


class Dihedral(Scalar):
    """Bending of surfaces: two triangles with a common edge keep the angle between them. 3D only.

    C(x) = f(x) - rest, the angle f [rad] and its gradients as in dihedral_angle(): 0 where flat, pi where folded.

    quads: (m, 4) particle indices: the two ends of the edge, then the two wings.
    rest: rest angle, number or (m,) [rad]; None takes the initial angles. Live.
    compliance: number or (m,) [rad/(N m)]; 0 is rigid. damping: number or (m,) [N m s/rad]. break_at: number or (m,) [N m].

    An edge without length or a triangle without area has no angle: the constraint exerts no moment until it has one. `load` is
    the moment about the edge [N m].
    """

    measures = DihedralAngle
    index_name = "quads"
    rest = REST_ANGLE

    def __init__(self, quads, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(quads, rest, compliance, damping, break_at)

    def prepare(self, particles, inv_mass: np.ndarray) -> None:
        """Check the indices, and refuse a 2D world: surfaces need 3D."""
        if particles.dim != 3:
            raise ValueError("Dihedral: there is no angle between triangles in 2D. Use Bend(triples).")
        super().prepare(particles, inv_mass)
