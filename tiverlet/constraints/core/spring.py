"""Springs of constraints: one law from soft to rigid, for every constraint that has a spring. Equation defines the symbols."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ...device import always, at, inline, ti

if TYPE_CHECKING:
    from ...features.feature import Batch, Scene

RESTARTED = 2  # `fresh` at a start from velocities that displacements were turned into, see Equation.spring_force()
FIRM = 0.99  # theta from which on a spring is rigid in an impact
SOFTEST = 1e24  # the largest compliance, of a spring that does nothing: beyond it, compliance / h^2 may overflow in f32


@ti.pyfunc
def stiff_at(ratio):
    """Return theta for ratio = alpha / (w h^2), see stiff()."""
    return 1 / (1 + ratio * ratio)


@ti.func
def stiff(alpha, h, w):
    """Return theta = s^4 / (1 + s^4), s^2 = w h^2 / alpha: 0 where the step resolves the spring, 1 where it is rigid."""
    return stiff_at(alpha / (h * h * w))  # 1 / s^2; s^4 would overflow in f32


@ti.pyfunc
def late_share(alpha, w, h2_effective, late):
    """Return the share of `late` that a spring makes up for in a start: 1 where stiff, 0 where resolved.

    `late` is what a rigid constraint makes up for in a start. Velocities lack half a kick, h_old F / 2, of rigid constraints, and
    theta of that of springs, see Equation.spring_force(). Of what is missing at the end of the start, lam = -C* h^2 / (2 alpha)
    finds theta s / (1 + theta s), with s = w h^2 / (2 alpha). Here h^2 / 2 = h2_effective, and h h_old / 2 = late.
    """
    ratio = alpha / (w * h2_effective)
    theta = stiff_at(ratio / 2)
    return stiff_at(ratio / 2 * (h2_effective / late) ** 2) * theta / (theta + ratio)


def bears_nothing(batch: "Batch") -> bool:
    """Whether a batch has no load, because no world moves its particles. Raise RuntimeError before a world has it."""
    if batch.count and batch.scene is None:
        raise RuntimeError(f"{batch!r}.load: there is none before a world has been stepped with it.")
    return not (batch.count and batch.acts)


def per_newton(multipliers: tuple[float, float], compliance: np.ndarray, weights: Callable[[], np.ndarray]) -> np.ndarray:
    """Return the factors from multipliers of the last substep to forces, (m,); 0 before the first substep.

    multipliers: those of the Scene, per newton. weights: returns w of each constraint, see stiff(); called only where springs
    differ from rigid constraints.
    """
    h2_rigid, h2_effective = multipliers
    late, soft, share = h2_rigid - h2_effective, compliance > 0, np.ones(len(compliance))
    if late > 0 and soft.any():
        w = weights()
        some = soft & (w > 0)
        share[soft] = 0.0
        share[some] = late_share(compliance[some], w[some], h2_effective, late)
    stands_for = h2_effective + share * late
    return np.divide(1, stands_for, out=np.zeros(len(compliance)), where=stands_for > 0)


class Spring:
    """The springs of a batch on the device: compliance, damping, and what soft constraints remember of earlier substeps.

    compliance: (m,), or None where all constraints are rigid, which costs nothing. damping: (m,), or None without dashpots.
    start: C (or f) at the start, one row for each number or vector that is remembered. restarts: whether there is an `offset` for
    the next start, see Equation.spring_force().
    in_state: its fields in the exact state, by name.
    """

    host_only = ("_memory",)

    def __init__(
        self, scene: "Scene", name: str, compliance: np.ndarray | None, damping: np.ndarray | None, start: np.ndarray,
        restarts: bool = False,
    ):  # fmt: skip
        add, width = scene.memory.field, start.shape[1] if start.ndim == 2 else 0
        self._memory, self.real, self.slots = scene.memory, scene.real, scene.slots
        self.soft, self.damped, self.in_state = compliance is not None, damping is not None, {}
        if compliance is not None:
            self.alpha = add(f"{name}.compliance", len(compliance), values=compliance)
            self.last = add(f"{name}.last", len(start), width=width, values=start, state=True)
            self.history = add(f"{name}.history", len(start), width=width, state=bool(scene.state.sleepers))
            self.in_state = {"last": self.last} | ({"history": self.history} if scene.state.sleepers else {})
            if restarts:
                self.offset = self.in_state["offset"] = add(f"{name}.offset", len(start), state=True)
        if damping is not None:
            self.damping = add(f"{name}.damping", len(damping), values=damping)

    def upload(self, compliance: np.ndarray, damping: np.ndarray) -> None:
        """Write new values to the device, as far as kernels read them."""
        if self.soft:
            self._memory.write(self.alpha, compliance)
        if self.damped:
            self._memory.write(self.damping, damping)

    @inline
    def is_rigid(self, c):
        """Whether constraint c has no compliance."""
        return at(self.alpha, c) == 0 if self.soft else always()

    @ti.func
    def multiplier_per_newton(self, c, w, h2_rigid, h2_effective):
        """Return the multiplier of 1 N in constraint c. w: see stiff()."""
        late = h2_rigid - h2_effective
        share = ti.cast(1, self.real)
        if ti.static(self.soft):
            if self.alpha[c] > 0:
                share = 0 * share
                if late > 0 and w > 0:
                    share = late_share(self.alpha[c], w, h2_effective, late)
        return h2_effective + share * late

    @ti.func
    def bearing_share(self, borne, h2_effective, left):
        """Return F C / 2 relative to C^2 / (2 alpha): the share of a violation that bears the load.

        The part that the solver leaves, `left`, bears no load. The spring is then as soft as it was solved: F = C / (alpha + the
        compliance that this adds). With 1 / alpha the energy would include some that nothing supplied.
        borne: alpha |lam|. The part alpha |lam| / h2_effective bears the load. h2_effective is 0 before the first substep.
        """
        out, gone = ti.cast(1, self.real), left * h2_effective  # may underflow to 0
        if h2_effective > 0 and gone > 0:
            out = borne / (borne + gone)
        return out

    @ti.func
    def energy(self, c, w, h2_effective, stored, borne):
        """Return the energy [J] of constraint c: `stored` where the substep resolves it, `borne` where it is stiff.

        stored: from the violation in the middle of a substep. borne: alpha F^2 / 2 with the load F. w: see stiff().
        A link that turns by phi in a substep is shorter in the middle of it, by phi^2 / 8 of its length. A stiff spring stores no
        energy for that. theta = O(h^4), so the energy stays second order.
        """
        theta = ti.cast(0, self.real)
        if h2_effective > 0:
            theta = stiff(self.alpha[c], ti.sqrt(h2_effective), w)
        return stored + theta * (borne - stored)

    @ti.func
    def force_change(self, c, grown, h, w, W):
        """Return how much h^2 times the force of constraint c has changed since the start of the last substep h, where it acted.

        grown: growth of its violation since. w: see stiff(). W: its weight with split masses.
        Without this, velocities would get half a kick by the force of a substep ago, which pumps: 1 + (omega h)^2 / 2 times v. In
        a substep alpha + W h^2 / 4 takes the place of alpha, see law(). A stiff spring keeps the force that it had.
        """
        alpha = self.alpha[c]
        return -(1 - self.stiff(c, h, w)) * grown / (alpha / (h * h) + W / 4)

    @ti.func
    def last_value(self, c, present, fresh):
        """Return the remembered value of the last substep; at a start `present`, since the memory may be NaN."""
        return ti.select(fresh != 0, present, self.last[c])

    @ti.func
    def law(self, c, h, w, fresh):
        """Return the coefficients of C_(n+1), C_n, C_(n-1) in C* + alpha c dC/dt: central if resolved, backward if stiff."""
        rigid, gamma = self.stiff(c, h, w), ti.cast(0, self.real)
        if ti.static(self.damped):
            gamma = self.damping[c] * self.alpha[c] / h
        A = (1 + 3 * rigid) / 4 + gamma * (1 + rigid) / 2
        now, last = (1 - rigid) / 2 - gamma * rigid, (1 - rigid) / 4 - gamma * (1 - rigid) / 2
        if fresh != 0:
            A, now, last = rigid + gamma, 1 - rigid - gamma, 0 * rigid
        return A, now, last

    @ti.func
    def stiff(self, c, h, w):
        """Return stiff() of constraint c, with the stiffness that it has, see softness.py."""
        return stiff(self.alpha[c], h, self.slots.softened(w))
