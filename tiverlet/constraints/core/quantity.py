"""What a constraint that is one number holds: the number f, of the corners of each of its constraints."""

from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti

if TYPE_CHECKING:
    from ...features.feature import Scene

TOGETHER = 10_000  # rows whose values are found at a time


class Quantity:
    """The contract of f in C(x) = f(x) - rest: a length, an angle, an area; and what most of them do.

    A new one says values() and measure(), and how it differs from a plain number: unwrap() and difference() where some values
    mean the same, `curved` and reach() where its gradient is right only near by. Kernels call what bind() returns. Of outlines
    (arity 0) f is a polynomial of degree dim in the corners, and they give slope() in place of measure(), see OutlinePasses.

    members: FixedSize or VariableSize, the particles of each constraint.
    """

    arity = 0  # corners of each constraint; 0: as many as each needs
    apart = False  # whether f is how far two particles are from each other
    exchangeable: tuple[tuple[int, ...], ...] = ()  # groups of corners that may swap
    unit: float | None = None  # what residuals are relative to; None: the rest value
    precise = False  # whether exactly() measures to all the digits that positions have
    ends = False  # whether gradients end at f = 0
    curved = False  # whether f is so curved that Newton's step from afar means nothing
    collapses = 0  # the power of a length that f is, where gradients vanish with the size of the body; else 0
    transcends = False  # takes angles, cube roots or exponentials, which SPIR-V has for f32 only
    centred = False  # whether f is counted from something that moves with the rest value
    state: Any  # on the device, as what follows
    real: Any
    corners: Any
    rest: Any
    drive: Any
    ramp: Any

    def __init__(self, members: Any):
        self.members = members

    @property
    def listing(self) -> Any:
        """The particles of each, as the user gives them."""
        return self.members.listing

    def pairs(self) -> np.ndarray:
        """Pairs of particles that may overlap, (k, 2)."""
        return self.members.pairs()

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "Quantity":
        """That of the constraints in the mask `some`, by the new numbers of their particles."""
        new = copy(self)
        new.members = self.members.remapped(some, number)
        return new

    def values(self, x: np.ndarray) -> np.ndarray:
        """f, (m,), of corners x (m, arity, dim) [m]; of outlines, of all positions (n, dim)."""
        raise NotImplementedError

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Its gradients by each corner, (m, arity, dim); of outlines (total, dim)."""
        return differences(self.values, x)

    def difference(self, f: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """How far f is from a goal, (m,)."""
        return f - goal

    def bind(self, scene: "Scene", batch: Any, equation: Any) -> Any:
        """The same for the kernels of a batch, whose corners and rest values its equation has."""
        bound = copy(self)
        bound.state, bound.real = scene.state, scene.real
        bound.corners, bound.rest, bound.drive, bound.ramp = equation.corners, equation.rest, equation.drive, equation.ramp
        return bound

    def frame(self, corners: Any) -> Any:
        """What gives measure() its corners: relative to the first of each constraint, unless f says otherwise."""
        return corners

    @ti.func
    def measure(self, c, q):
        """f of constraint c and its (arity, dim) gradients at corners q (arity, dim), which are relative to corner 0."""
        return 0.0, q

    @ti.func
    def remeasure(self, c, q):
        """The same where it is not for a pass, which solvers take most of their time for."""
        return self.measure(c, q)

    @ti.func
    def slope(self, e, back):
        """Of outlines: the gradient by corner e, at x - back d."""
        return ti.Vector.zero(self.real, 1)

    @ti.func
    def unwrap(self, f, other):
        """Of the values that mean the same as f, the one nearest to `other`; more than one only for angles."""
        return f

    @ti.func
    def excess(self, c, f):
        """Where it is `precise`: f - rest of constraint c to all digits."""
        return f - self.rest[c]

    @ti.func
    def exactly(self, c):
        """f - rest of constraint c in f64."""
        return ti.cast(0, ti.f64)

    @ti.func
    def reach(self, q):
        """How far a corner may move before f is no longer what its gradient says, with corners q: about the size of the body."""
        return ti.cast(1, self.real)

    @ti.func
    def start_substep(self, c, now, start, fresh):
        """Before the first pass of a substep: keep what measure() needs of its start, from corners now and at the start."""

    @ti.func
    def direction_reliable(self, f, f0):
        """Whether directions at f (now) and f0 (at the start) are clear enough to tell a turn of 41 degrees."""
        return True


@ti.func
def rest_exactly(quantity: ti.template(), c):  # type: ignore[valid-type]
    """The rest value of constraint c in f64. In f32, one that moves would jerk, with rounding / h^2."""
    rest = ti.cast(quantity.rest[c], ti.f64)
    if ti.static(bool(quantity.drive)):
        rest = quantity.drive.target[c]
    if ti.static(quantity.ramp.made):
        rest += quantity.ramp.low[c]
    return rest


def differences(values: Callable, x: np.ndarray) -> np.ndarray:
    """Gradients of values(x) by each corner of x (m, arity, dim), central differences. values: takes all of x several times, one
    behind the other; few rows take as long as one."""
    step, m = 1e-6 * (float(np.ptp(x, axis=1).max(initial=0.0)) or 1.0), len(x)
    flat = x.reshape(m, x.shape[1] * x.shape[2])
    out, each = np.zeros_like(flat), max(1, TOGETHER // max(1, 2 * m))
    for first in range(0, flat.shape[1] if m else 0, each):
        some = np.arange(first, min(first + each, flat.shape[1]))
        ends, k = np.tile(flat, (2, len(some), 1, 1)), np.arange(len(some))
        ends[0, k, :, some] += step
        ends[1, k, :, some] -= step
        up, down = values(ends.reshape(-1, *x.shape[1:])).reshape(2, len(some), m)
        out[:, some] = ((up - down) / (2 * step)).T
    return out.reshape(x.shape)
