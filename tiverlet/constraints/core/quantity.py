"""The number f that a constraint holds: a function of the corners of each constraint."""

from collections.abc import Callable
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ...device import ti
from .members import Members

if TYPE_CHECKING:
    from ...features.feature import Scene

TOGETHER = 10_000  # rows whose values are computed at a time


class Quantity:
    """The contract of f in C(x) = f(x) - rest (a length, an angle, an area), with defaults that suit most quantities.

    A new quantity implements values() and measure(), and overrides what differs from a plain number. unwrap() and difference():
    where several values are equivalent. `curved` and trust_radius(): where its gradient is valid only near by. Kernels call the
    object that bind() returns. For outlines (arity 0), f is a polynomial of degree dim in the corners, and slope() replaces
    measure(), see OutlinePasses.

    members: Members, the particles of each constraint.
    """

    arity = 0  # corners of each constraint; 0: a variable number
    is_distance = False  # whether f is the distance between two particles
    exchangeable: tuple[tuple[int, ...], ...] = ()  # groups of corners that may be exchanged
    unit: float | None = None  # scale of residuals; None: the rest value
    precise = False  # whether exact_excess() computes f to all digits of the positions
    has_cusp_at_zero = False  # whether gradients are discontinuous at f = 0
    curved = False  # whether f is so curved that a Newton step from afar is meaningless
    collapses = 0  # the power of a length that f is, where gradients vanish with the size of the body; else 0
    mirror: tuple[int, ...] = ()  # where it collapses: an order of the corners in which f has the other sign
    transcends = False  # needs angles, cube roots or exponentials, which SPIR-V has for f32 only
    is_angle = False  # whether f is an angle, whose load is a torque
    foreign = False  # whether f is the user's own, of which nothing is known
    origin: Any = None  # what corners are relative to, as two f32 words, so that f32 does not round it; None: the first corner
    centred = False  # whether f is measured from a value that moves with the rest value
    state: Any  # set by bind() for the device, as are the next three
    real: Any
    corners: Any
    rest: Any
    drive: Any
    ramp: Any

    def __init__(self, members: Any):
        self.members = members

    @property
    def listing(self) -> Any:
        """The particles of each constraint, as the user gives them."""
        return self.members.listing

    def pairs(self) -> np.ndarray:
        """Return pairs of particles that may overlap, (k, 2)."""
        return self.members.pairs()

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "Quantity":
        """Return the quantity of the constraints in the mask `some`, with the new numbers of their particles."""
        new = copy(self)
        new.members = self.members.remapped(some, number)
        return new

    def reversed(self, which: np.ndarray) -> "Quantity":
        """Where it `collapses`: return the quantity with f of the other sign for constraints in the mask `which`, (m,)."""
        new, rows = copy(self), self.members.indices
        new.members = Members(self.members.kind, np.where(which[:, None], rows[:, self.mirror], rows))
        return new

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return f, (m,), of corners x (m, arity, dim) [m]; for outlines, of all positions (n, dim)."""
        raise NotImplementedError(f"{type(self).__name__}.values() is missing.")

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of f by each corner, (m, arity, dim); for outlines (total, dim)."""
        return differences(self.values, x)

    def difference(self, f: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return the difference of f from a goal, (m,)."""
        return f - goal

    def bind(self, scene: "Scene", batch: Any, equation: Any) -> Any:
        """Return the quantity for the kernels of a batch, with the corners and rest values of its equation."""
        bound = copy(self)
        bound.state, bound.real = scene.state, scene.real
        bound.corners, bound.rest, bound.drive, bound.ramp = equation.corners, equation.rest, equation.drive, equation.ramp
        return bound

    @ti.func
    def measure(self, c, q):
        """Return f of constraint c, and its gradients, at corners q, (arity, dim) both, relative to corner 0 or `origin`."""
        return 0.0, q

    @ti.func
    def remeasure(self, c, q):
        """Return what measure() returns, outside of passes; passes call measure() itself, which takes most of a solver's time."""
        return self.measure(c, q)

    @ti.func
    def slope(self, e, back):
        """For outlines: return the gradient by corner e, at x - back d."""
        return ti.Vector.zero(self.real, 1)

    @ti.func
    def unwrap(self, f, other):
        """Return the value equivalent to f that is nearest to `other`. Only angles have more than one."""
        return f

    @ti.func
    def excess(self, c, f):
        """Return f - rest of constraint c, to all digits where the quantity is `precise`."""
        return f - self.rest[c]

    @ti.func
    def exact_excess(self, c):
        """Return f - rest of constraint c in f64."""
        return ti.cast(0, ti.f64)

    @ti.func
    def trust_radius(self, q):
        """Return how far a corner at q may move before the gradient no longer describes f, about the size of the body."""
        return q.norm()

    @ti.func
    def start_substep(self, c, now, start, fresh):
        """Before the first pass of a substep: store what measure() needs, from corners now and at the start."""

    @ti.func
    def is_radial(self, c):
        """Whether f - rest is like the distance from a point: a spring's force is smooth there, however far it turns."""
        return False

    @ti.func
    def direction_reliable(self, f, f0):
        """Whether directions at f (now) and f0 (at the start) are defined well enough to detect a turn of 41 degrees."""
        return True


def checked(batch: Any, quantity: Quantity) -> Quantity:
    """Return the quantity of a constraint. Raise TypeError if the class of either lacks a part without a default."""
    if not hasattr(type(batch), "rest"):
        raise TypeError(f"{batch!r}: the class has no knob `rest`. Write rest = Knob(check, text) in it, as in core/length.py.")
    kind, wanted = type(quantity), "measure" if quantity.members.arity else "slope"
    if getattr(kind, wanted) is getattr(Quantity, wanted):
        raise TypeError(f"{batch!r}: {kind.__name__}.{wanted}() is missing, see Quantity in constraints/core/quantity.py.")
    return quantity


@ti.func
def exact_rest(quantity: ti.template(), c):  # type: ignore[valid-type]
    """Return the rest value of constraint c in f64. In f32, a moving rest value would jerk by rounding / h^2."""
    rest = ti.cast(quantity.rest[c], ti.f64)
    if ti.static(bool(quantity.drive)):
        rest = quantity.drive.target[c]
    if ti.static(quantity.ramp.is_allocated):
        rest += quantity.ramp.low[c]
    return rest


def differences(values: Callable, x: np.ndarray) -> np.ndarray:
    """Return gradients of values(x) by x (m, arity, dim), by central differences. values: takes copies of x in sequence."""
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
