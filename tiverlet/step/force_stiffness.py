"""How fast particles move in forces that differ from place to place: what no constraint tells."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.number import OnDevice

if TYPE_CHECKING:
    from .step import Step


@ti.data_oriented
class ForceStiffness:
    """(omega h)^2 of the particle with most of it, at most, by how forces changed along its last move d, and of others past it:

        h^2 (|a(x) - a(x - d)| / |d| + sum_j (w_i + w_j) |F(r) - F(r - u)| / |u|),    r = x_i - x_j, u = d_i - d_j

    Two bodies that orbit, or collide, have just this, whatever else there is and however they fly. The flag "stiff-force" goes
    by the motion that dominates, see Diagnostics. This has a kernel of its own, which is compiled when it is first asked.
    """

    n: Any = OnDevice()  # particles

    def __init__(self, step: "Step"):
        self.n, self.state, self.real = step.scene.count, step.state, step.real
        self.forces, self.pair_forces = step.integrator.forces, step.pair_forces

    def __bool__(self) -> bool:
        return bool(self.forces.uneven or self.pair_forces)

    def __call__(self, h: float, time: float) -> float:
        """After a substep h [s] that ended at a time [s]."""
        out = np.zeros(1)
        self.measure(h, time, out)
        return out.item() * h * h

    @ti.kernel
    def measure(self, h64: ti.f64, t64: ti.f64, out: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """The largest omega^2."""
        for i in range(self.n):
            if self.state.w.positive(i):
                most = ti.cast(self.of(i, ti.cast(h64, self.real), ti.cast(t64, self.real)), ti.f64)
                if most > out[0]:  # few are, and the others need not wait for each other
                    ti.atomic_max(out[0], most)

    @ti.func
    def of(self, i, h, t):
        """omega^2 of particle i."""
        d = self.state.d[i]
        dd, change = d.norm_sqr(), self.forces.change_along(i, self.state.place(i), d, h, t)
        out = ti.select(dd > 0, change.norm() / ti.sqrt(dd), 0 * dd)
        for f in ti.static(self.pair_forces):
            out += f.stiffness(i)
        return out
