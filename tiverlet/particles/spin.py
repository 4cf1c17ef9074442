"""Spin: the rotation of particles, as a world keeps it on the device."""

from typing import Any

import numpy as np

from ..device import ti
from ..device.memory import Memory
from ..device.number import Number
from ..features.regrouping import Regrouping
from .particles import Particles, at_rest


class Spin:
    """The rotation of particles, as State is their translation.

    s = r phi is the distance that the surface of a particle turned in the last substep [m], with phi the angle (2D) or the
    rotation vector (3D). It is a displacement as d is; before a start (the first substep after velocities were set) it is a
    velocity, r omega. inverse_inertia: k = m r^2 / I, 2 for discs, 5/2 for spheres. With s and k, the laws of friction contain no
    radius. An impulse h p [kg m] at the point -r n from the center changes d by p / m and s by -k n x p / m. The surface there
    moves by d - s x n, which changes by (1 + k) p / m across n.

    Only contacts and walls turn a particle. Between these s is constant, which is exact.

    axes: 1 in 2D, 3 in 3D. orients: whether orientations are tracked.
    """

    def __init__(self, memory: Memory, particles: Particles, inv_mass: np.ndarray, number: Number):
        n, self.dim, self.real = particles.count, particles.dim, memory.real
        self.axes, self.radius = particles.axes, particles.radius
        self.s = memory.field("spin", number, width=self.axes, values=self.from_rates(particles.spin), state=True)
        self.inverse_inertia = memory.field("spin_share", number, values=inverse_inertias(particles, inv_mass))
        self.orients = particles.orientation is not None
        if self.orients:
            width = 1 if self.dim == 2 else 4
            turned = np.asarray(particles.orientation).reshape(n, width)
            self.orientation = memory.field("orientation", number, width=width, kind=ti.f64, values=turned, state=True)
            self.inverse_radius = memory.field("inverse_radius", number, values=inverse(particles.radius))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether particles can be added and removed in place."""
        return (change.now.orientation is not None) == self.orients

    def regroup(self, memory: Memory, change: Regrouping) -> None:
        """Set spin and orientation of added particles, see State.regroup()."""
        now, first = change.now, change.kept
        self.radius = now.radius
        memory.write(self.inverse_inertia, inverse_inertias(now, change.inv_mass))
        memory.write_from(self.s, first, self.from_rates(now.spin)[first:])
        if self.orients:
            memory.write(self.inverse_radius, inverse(now.radius))
            memory.write_from(self.orientation, first, np.asarray(now.orientation).reshape(now.count, -1)[first:])

    def set_inverse_mass(self, memory: Memory, particles: Particles, inv_mass: np.ndarray) -> None:
        """Write other inverse masses of the same particles."""
        memory.write(self.inverse_inertia, inverse_inertias(particles, inv_mass))

    def from_rates(self, rates: Any) -> np.ndarray:
        """Convert angular velocities [rad/s] to r omega [m/s], (n, axes)."""
        return self.radius[:, None] * np.asarray(rates).reshape(-1, self.axes)

    def to_rates(self, surface: np.ndarray) -> np.ndarray:
        """Convert r omega [m/s] to angular velocities [rad/s]: (n,) in 2D, (n, 3) in 3D."""
        r = self.radius[:, None]
        out = np.divide(surface, r, out=np.zeros_like(surface), where=r > 0)
        return out[:, 0] if self.axes == 1 else out

    @ti.func
    def surface(self, s, n):
        """Return s x n: rotation moves a surface point at r n by this much more, and one at -r n by this much less."""
        out = ti.Vector.zero(self.real, self.dim)
        if ti.static(self.dim == 2):
            out = ti.Vector([-s[0] * n[1], s[0] * n[0]])
        else:
            out = s.cross(n)
        return out

    @ti.func
    def moment(self, n, p):
        """Return n x p."""
        out = ti.Vector.zero(self.real, self.axes)
        if ti.static(self.dim == 2):
            out[0] = n[0] * p[1] - n[1] * p[0]
        else:
            out = n.cross(p)
        return out

    @ti.func
    def along(self, s, n):
        """Return the part of s about the axis n; 0 in 2D."""
        out = 0 * s
        if ti.static(self.dim == 3):
            out = s.dot(n) * n
        return out

    @ti.func
    def energy(self, i):
        """Return I phi^2 / 2 of particle i per mass [m^2], f64."""
        k, s, out = self.inverse_inertia[i], self.s[i] * ti.cast(1, ti.f64), ti.cast(0, ti.f64)
        if k > 0:
            out = 0.5 * s.dot(s) / k
        return out

    @ti.func
    def begin(self, i, h):
        """At a start, turn the velocity of the surface into its displacement."""
        self.s[i] = h * self.s[i]

    @ti.func
    def end(self, i, h):
        """Turn the displacement of the surface into its velocity."""
        self.s[i] = self.s[i] / h

    @ti.func
    def update_orientation(self, i):
        """Update the orientation at the end of a substep. In 3D q' = (phi / |phi| sin |phi| / 2, cos |phi| / 2) q."""
        phi = self.inverse_radius[i] * self.s[i]
        if ti.static(self.dim == 2):
            self.orientation[i] = self.orientation[i] + ti.cast(phi, ti.f64)
        else:
            angle = phi.norm()
            if angle > 0:
                u, c, q = phi * (ti.sin(angle / 2) / angle), ti.cos(angle / 2), self.orientation[i]
                v, v0, q0 = ti.cast(u, ti.f64), ti.cast(c, ti.f64), ti.Vector([q[0], q[1], q[2]])
                turned = v0 * q0 + q[3] * v + v.cross(q0)  # type: ignore[operator]
                out = ti.Vector([turned[0], turned[1], turned[2], v0 * q[3] - v.dot(q0)])  # type: ignore[operator]
                self.orientation[i] = out / out.norm()


def inverse(radius: np.ndarray) -> np.ndarray:
    """Return 1 / r of each particle [1/m], 0 for points."""
    return np.divide(1, radius, out=np.zeros(len(radius)), where=radius > 0)


def inverse_inertias(particles: Particles, inv_mass: np.ndarray) -> np.ndarray:
    """Return k = m r^2 / I of each particle, 0 for points and for particles that cannot move."""
    inertia = at_rest("inertia", particles) if particles.inertia is None else np.asarray(particles.inertia)
    return np.where((particles.radius > 0) & (inv_mass > 0), 1 / inertia, 0.0)


def moments_of_inertia(particles: Particles) -> np.ndarray:
    """Return the moments of inertia [kg m^2], (n,); 0 for particles that cannot move or have infinite inertia."""
    if particles.inertia is None:
        return np.zeros(particles.count)
    there = (particles.inv_mass > 0) & np.isfinite(particles.inertia)
    mass = np.where(there, particles.mass, 0.0)
    return mass * particles.radius**2 * np.where(there, particles.inertia, 0.0)
