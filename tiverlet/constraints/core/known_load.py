"""Links with known loads: they exert the force that they bear at rest without being stretched."""

from typing import TYPE_CHECKING, Any

from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Scene

WINDOW = 64  # substeps over which the missing load is averaged
LAG, SLOW = 64, 2.0  # substeps to learn the load of k particles: at least, and per k^2
STEADY = 0.2  # relative difference of the missing load between two windows, at most
GAIN = 0.8  # largest share of the missing load that is learnt at once
STILL = 1.0  # of the violation that would bear its load: how far corners may move, relative to each other, in a window
MOST = 0.5  # of its size: the violation that would bear the largest load


class KnownLoad:
    """The loads F that constraints of a batch know, on the device; without solver.loads it costs nothing.

    With one pass per substep, a load is borne by a violation C = W h^2 F, as by a spring of stiffness 1 / (W h^2), and a net of
    such springs sags. A known load needs no violation: the first pass gives lam = -(C / W + h^2 F). F is learnt gradually, by
    integral control. Over a window, violations at the start of substeps push by C / (W h^2) on average. If that is within a fifth
    of the average of the window before, F grows by a share of it.

    With L, an eigenvalue of the pass, a mode has s^2 + L s + L (1 + K / s) = 0, with time in substeps, and K the share that is
    learnt in each: stable where K < L. For k links that hang in a chain the least L is 0.62 / k^2, and K = 1 / (SLOW k^2), with
    k = F / (m g) of the most loaded link of a body. Contacts, whose sound is damped, need less. Moving links learn nothing. The
    loads of constraints that contradict each other grow, up to MOST.

    learns: whether constraints of the batch learn: rigid ones, on a fixed number of corners, with an f that is not curved, and
    relaxed alone. in_state: its fields in the exact state, by name.
    """

    host_only = ("_memory",)

    def __init__(self, scene: "Scene", name: str, batch: Any):
        not_flat = batch.driven or batch.quantity.curved or batch.quantity.collapses
        self.learns, self.in_state = scene.slots.loads and not not_flat, {}
        if self.learns:
            self._memory, self.weights, self.body_load = scene.memory, scene.own_weight, scene.slots.body_load
            self.load = scene.memory.field(f"{name}.load", batch.count, state=True)  # [N]
            self.missing = scene.memory.field(f"{name}.missing", batch.count, state=True)  # missing load, summed over a window
            self.earlier = scene.memory.field(f"{name}.earlier", batch.count, state=True)  # its mean in the window before [N]
            self.given = scene.memory.field(f"{name}.given", batch.count, state=True)  # as a multiplier, in this substep [kg m]
            self.body = scene.memory.field(f"{name}.body", batch.count, kind=ti.i32, values=scene.slots.body(batch))
            self.in_state = {"load": self.load, "missing": self.missing, "earlier": self.earlier, "given": self.given}

    def forget(self, some: Any) -> None:
        """Forget the loads of constraints in the mask `some`, (m,)."""
        for field in self.in_state.values():
            values = self._memory.read(field)
            values[: len(some)][some] = 0.0
            self._memory.write(field, values)

    @ti.func
    def apply_load(self, c, share, h, h2_effective):
        """Return the multiplier of the known load. share: the multiplier that is missing, as the violation at the start shows."""
        self.missing[c] = self.missing[c] + share / (h * h)
        lam = -h2_effective * self.load[c]
        self.given[c] = lam
        return lam

    @ti.func
    def drop_load(self, c):
        """Forget the load of constraint c, which is slack or broken."""
        self.load[c] = self.missing[c] = self.earlier[c] = self.given[c] = ti.cast(0, self.load.dtype)

    @ti.func
    def record_body_load(self, c, most, own):
        """At the end of a window: record how many particles the body of constraint c bears.

        most: the largest acceleration of a corner of c by 1 N; own: the acceleration by forces. Without forces the number is
        infinite, and the body learns nothing.
        """
        pull = ti.abs(self.load[c] + self.missing[c] / WINDOW) * most
        if pull > 0:
            ti.atomic_max(self.body_load[self.body[c]], ti.select(own > 0, pull / own, ti.math.inf))

    @ti.func
    def learn(self, c, violation_per_newton, size, moved):
        """After record_body_load(): update the load that constraint c knows.

        violation_per_newton: its violation under 1 N; size: of c; moved: motion of its corners relative to each other in the last
        substep.
        """
        load, mean = self.load[c], self.missing[c] / WINDOW
        is_steady = ti.abs(mean - self.earlier[c]) < STEADY * ti.abs(mean)
        if is_steady and WINDOW * moved < STILL * violation_per_newton * ti.abs(load + mean):
            k = self.body_load[self.body[c]]
            # It has to be slower than the decay of the slowest sound of the body, which takes some k^2 substeps.
            share = ti.min(WINDOW / (LAG + SLOW * k * k), GAIN)
            load, mean = load + share * mean, (1 - share) * mean
            load = ti.max(-MOST * size / violation_per_newton, ti.min(load, MOST * size / violation_per_newton))
        self.load[c], self.earlier[c], self.missing[c] = load, mean, 0 * mean
