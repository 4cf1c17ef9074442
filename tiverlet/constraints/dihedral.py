"""Angles between triangles."""

import numpy as np
from numpy.typing import ArrayLike

from ..device import ti
from .core.angle import SHORT, Angle


class Dihedral(Angle):
    """Bending of surfaces: two triangles with a common edge keep the angle between them. 3D only.

    C(x) = f(x) - rest, f = atan2(e . (p x q), -p . q) in (-pi, pi]: 0 where flat, pi where folded, positive where the wings fold
    towards the side of e x p. e: unit vector of the edge x_j - x_i; p, q: unit vectors at right angles to it towards the wings
    x_k and x_l, at distances P and Q from it, with feet at the fractions s and t of the edge (Bergou et al. 2006, eq. 7 ff.).

        grad_k f = e x p / P,   grad_l f = -e x q / Q,
        grad_j f = -(s grad_k f + t grad_l f),   grad_i f = -((1 - s) grad_k f + (1 - t) grad_l f)

    quads: (m, 4) particle indices: the two ends of the edge, then the two wings.
    rest: rest angle, number or (m,) [rad]; None takes the initial angles. Live.
    compliance: number or (m,) [rad/(N m)]; 0 is rigid. damping: number or (m,) [N m s/rad]. break_at: number or (m,) [N m].

    An edge or a triangle of no size has no angle: nothing acts until it has one. `load` is the moment about the edge [N m].
    """

    arity = 4
    index_name = "quads"
    exchangeable = ((0, 1), (2, 3))

    def __init__(self, quads, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None):
        self.setup(quads, rest, compliance, damping, break_at)

    def prepare(self, particles, inv_mass: np.ndarray) -> None:
        """Surfaces are in 3D."""
        if particles.dim != 3:
            raise ValueError("Dihedral: there is no angle between triangles in 2D. Use Bend(triples).")
        Angle.prepare(self, particles, inv_mass)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """The angles at the given positions."""
        x = self.placed(position)
        e, a, b = (x[:, k] - x[:, 0] for k in (1, 2, 3))
        e = e / np.maximum(np.linalg.norm(e, axis=1, keepdims=True), 1e-300)
        p, q = (r - e * (r * e).sum(axis=1, keepdims=True) for r in (a, b))
        return np.arctan2((e * np.cross(p, q)).sum(axis=1), -(p * q).sum(axis=1))

    @ti.func
    def reach(self, c, q):
        """The shortest way from an end of the edge to another corner."""
        return ti.min(q[1, :].norm(), ti.min(q[2, :].norm(), q[3, :].norm()))

    @ti.func
    def measure(self, c, q):
        """See the class."""
        edge, a, b = q[1, :], q[2, :], q[3, :]
        ee = edge.dot(edge)
        f, g = ti.cast(0, self.dev.real), ti.Matrix.zero(self.dev.real, 4, 3)
        if ee > SHORT:
            e, s, t = edge / ti.sqrt(ee), a.dot(edge) / ee, b.dot(edge) / ee
            p, r = a - s * edge, b - t * edge
            pp, rr = p.dot(p), r.dot(r)
            if pp > SHORT and rr > SHORT:
                f = ti.atan2(e.dot(p.cross(r)), -p.dot(r))
                k, l = e.cross(p) / pp, -e.cross(r) / rr  # noqa: E741
                g = ti.Matrix.rows([-((1 - s) * k + (1 - t) * l), -(s * k + t * l), k, l])
        return f, g
