"""Links that carry their loads: what they bear at rest, they pull without being stretched."""

from typing import TYPE_CHECKING, Any

from ...device import ti
from ...features.learning import gain, steady

if TYPE_CHECKING:
    from ...features.feature import Scene

WINDOW = 64  # substeps over which is averaged what is missing
SLOW = 2.0  # substeps that it takes to learn the load of k particles, per k^2
STILL = 1.0  # of the violation that would bear its load: how far corners may go, to each other, in a window
MOST = 0.5  # of its size: the violation that would bear the largest load


class KnownLoad:
    """The loads F that the constraints of a batch know, on the device; without solver.loads it costs nothing.

    One pass per substep holds a load by a violation C = W h^2 F, as a spring of stiffness 1 / (W h^2) would, and a net of such
    springs sags. What is known needs none: the first pass gives lam = -(C / W + h^2 F). F is learnt by and by, which is integral
    control: over a window, violations at the start of substeps would push C / (W h^2) on average, and if that is what they did in
    the window before to within a fifth, F += gain of it.

    With L, an eigenvalue of the pass, a mode has s^2 + L s + L (1 + K / s) = 0, with time in substeps, and K the share that is
    learnt in each: stable where K < L. For k links that hang in a chain the least is L = 0.62 / k^2, and K = 1 / (SLOW k^2), with
    k = F / (m g) of the link of a body that bears most. Contacts, of which the sound is taken out, need less. What moves learns
    nothing. Where constraints contradict each other their loads grow, up to MOST.

    learns: whether the constraints of the batch do: those that are rigid, on a fixed number of corners, straight, and relaxed by
    themselves. in_state: what it has in the exact state, by name.
    """

    def __init__(self, scene: "Scene", name: str, batch: Any):
        self.learns, self.in_state = scene.slots.loads and batch.learns_loads, {}
        if self.learns:
            self._memory, self.weights, self.bears = scene.memory, scene.own_weight, scene.slots.bears
            self.load = scene.memory.field(f"{name}.load", batch.count, state=True)  # [N]
            self.missing = scene.memory.field(f"{name}.missing", batch.count, state=True)  # of it in this window, summed up [N]
            self.earlier = scene.memory.field(f"{name}.earlier", batch.count, state=True)  # on average in the window before [N]
            self.given = scene.memory.field(f"{name}.given", batch.count, state=True)  # as a multiplier, in this substep [kg m]
            self.body = scene.memory.field(f"{name}.body", batch.count, kind=ti.i32, values=scene.slots.body(batch))
            self.in_state = {"load": self.load, "missing": self.missing, "earlier": self.earlier, "given": self.given}

    def forget(self, some: Any) -> None:
        """Forget the loads of some constraints, a mask (m,)."""
        for field in self.in_state.values():
            values = self._memory.read(field)
            values[: len(some)][some] = 0.0
            self._memory.write(field, values)

    @ti.func
    def give(self, c, share, h, h2_effective):
        """The multiplier that constraint c knows; and note `share`, what its violation at the start asks for beside."""
        self.missing[c] = self.missing[c] + share / (h * h)
        lam = -h2_effective * self.load[c]
        self.given[c] = lam
        return lam

    @ti.func
    def let_go(self, c):
        """Forget the load of constraint c, which is slack or broken."""
        self.load[c] = self.missing[c] = self.earlier[c] = self.given[c] = ti.cast(0, self.load.dtype)

    @ti.func
    def weigh(self, c, most, own):
        """As a window ends: how many particles the body of constraint c bears.

        most: what 1 N accelerates a corner of c by, at most; own: what forces do. Without these it bears any number, and learns
        nothing.
        """
        pull = ti.abs(self.load[c] + self.missing[c] / WINDOW) * most
        if pull > 0:
            ti.atomic_max(self.bears[self.body[c]], ti.select(own > 0, pull / own, ti.math.inf))

    @ti.func
    def learn(self, c, give, size, moved):
        """Then: what constraint c knows from now on.

        give: what it gives way by for 1 N; size: its own; moved: how far its corners went to each other in the last substep.
        """
        load, mean = self.load[c], self.missing[c] / WINDOW
        if steady(mean, self.earlier[c]) and WINDOW * moved < STILL * give * ti.abs(load + mean):
            k = self.bears[self.body[c]]
            share = gain(1.0, SLOW * k * k, WINDOW)
            load, mean = load + share * mean, (1 - share) * mean
            load = ti.max(-MOST * size / give, ti.min(load, MOST * size / give))
        self.load[c], self.earlier[c], self.missing[c] = load, mean, 0 * mean
