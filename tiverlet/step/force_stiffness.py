"""How well a substep resolves the motion of particles in forces that vary in space; constraints do not measure this."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from .step import Step


@ti.data_oriented
class ForceStiffness:
    """An upper bound on (omega h)^2 of any particle, from the change of forces along its last displacement d:

        h^2 (|a(x) - a(x - d)| / |d| + sum_j (w_i + w_j) |F(r) - F(r - u)| / |u|),    r = x_i - x_j, u = d_i - d_j

    For two bodies that orbit each other or collide this is exactly (omega h)^2, whatever else is in the scene and however they
    move together. The flag "stiff-force" is about the dominant motion of all particles instead, see Diagnostics. The kernel is
    compiled at the first call.
    """

    n: Any = OnDevice()  # particles

    def __init__(self, step: "Step"):
        self.n, self.state, self.real = step.scene.count, step.state, step.real
        self.forces, self.pair_forces = step.integrator.forces, step.pair_forces

    def __bool__(self) -> bool:
        return bool(self.forces.uneven or self.pair_forces)

    def __call__(self, h: float, time: float) -> float:
        """Return the bound after a substep h [s] that ended at `time` [s]."""
        out = np.zeros(1)
        self.measure(h, time, out)
        return out.item() * h * h

    @ti.kernel
    def measure(self, h64: ti.f64, t64: ti.f64, out: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Write the largest omega^2 of all particles to `out`."""
        for i in range(self.n):
            if self.state.w[i] > 0:
                most = ti.cast(self.of(i, ti.cast(h64, self.real), ti.cast(t64, self.real)), ti.f64)
                if most > out[0]:  # rarely true, so threads seldom wait for the atomic operation
                    ti.atomic_max(out[0], most)

    @ti.func
    def of(self, i, h, t):
        """Return omega^2 of particle i."""
        d = self.state.d[i]
        dd, change = d.norm_sqr(), self.forces.change_along(i, self.state.place(i), d, h, t)
        out = ti.select(dd > 0, change.norm() / ti.sqrt(dd), 0 * dd)
        for f in ti.static(self.pair_forces):
            out += f.stiffness(i)
        return out
