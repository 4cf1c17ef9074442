"""Constraints on a function that the user gives."""

import inspect
from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..device.language import undecorated
from ..features.feature import Knob, Scene
from ..features.items import Items
from ..particles import Particles
from ..tools import golden
from .core.finite_differences import NumericGradient
from .core.quantity import Quantity
from .core.scalar import Scalar

APPROACH, TRIED, NEAR = 12, 3, 1e-3  # steps towards f = 0; pairs of places that are tried there, and how near, in sizes
# A relative difference between the given gradient and finite differences that rounding does not explain.
GRADIENT_TOLERANCE = 1e-4


class Function(Quantity):
    """The user's function f, in the given unit.

    derivative: f and its gradients. size: of the scene part that f acts on [m]. All but the unit are known only once there are
    particles.
    """

    host_only = ("_size",)
    foreign = True
    size: Any  # on the device

    def __init__(self, members: Any, unit: float | None, derivative: Any = None, origin: Any = None, size: float = 0.0):
        super().__init__(members)
        self.unit, self.derivative, self.origin = unit, derivative, origin
        self._size = size

    def bind(self, scene: Scene, batch: Any, equation: Any) -> "Function":
        """Return the quantity for kernels, with a number for the step of finite differences."""
        bound = super().bind(scene, batch, equation)
        bound.size = scene.memory.number(self._size, ti.f64)
        return bound

    @ti.func
    def measure(self, c, q):
        """Return the function and its gradient; both are 0 where either is not finite."""
        f, g = self.derivative.both(c, ti.cast(q, ti.f64), self.size.now)
        total = f
        for k, a in ti.static(ti.ndrange(self.corners.arity, self.state.dim)):
            total += g[k, a] * g[k, a]
        good = not (ti.math.isnan(total) or ti.math.isinf(total))
        n = ti.Matrix.zero(self.real, self.corners.arity, self.state.dim)
        for k, a in ti.static(ti.ndrange(self.corners.arity, self.state.dim)):
            n[k, a] = ti.select(good, ti.cast(g[k, a], self.real), 0)
        return ti.select(good, ti.cast(f, self.real), 0), n


class Constraint(Scalar):
    """The user's own constraint, soft or rigid: C(x) = function(x_0, x_1, ...) - rest = 0, or <= 0, or >= 0.

    function: takes the corners as vectors [m], as many as the constraint has. It may take one more argument, the number of the
    constraint, to read parameters from Taichi fields. It returns one number. It is in Taichi's language: arithmetic, ti.sqrt and
    its like, v.norm(), a.cross(b), if and for; decorated with @ti.func or not. Python numbers that it reads are compiled as
    constants.
    indices: (m, arity) particle indices, or (m,) for constraints on one particle each: [[0, 1]] is a pair, [0, 1] are two.
    rest: number or (m,); None takes the initial values of function. Live.
    gradient: takes the arguments of function, returns its gradient by each corner, as many vectors. None: central differences.
    side: 0 for C = 0; 1 for function at most rest; -1 for function at least rest.
    origin: the corners are relative to this point [m]. None: relative to the first corner, which is exact in f32 at any place,
    and conserves momentum; for a single corner, (0, ..., 0). Put it near the scene where coordinates are large.
    unit: what the reported residual is relative to; None: the rest value, or the mean initial |function| where that is 0.
    compliance: [F m / N] for a function in units of F; 0 is rigid. damping, break_at: see Distance.

        def bead(x):  # on a circle of 2 m around the origin
            return x.norm()

        tv.Constraint(bead, [0], rest=2.0)

    Differences are taken in f64 in every world, which keeps the order two; compiling takes longer than with a gradient.
    A given gradient is compared with differences when the world is built: ValueError names the corner and the axis.
    Where function or gradient are not finite, or the gradient is 0, the constraint does not act. A rest value of a rigid one
    needs to be where function is smooth, or 0 where function is nowhere negative.
    """

    host_only = ("_derivative", "_measured", "_size", "_unit")
    index_name = "indices"
    can_extend = False  # the function may read the number of a constraint
    _size = 0.0  # of the part of the scene that it acts on [m]
    _measured: tuple[Any, Any] = (None, None)  # positions, and values and gradients there
    rest = Knob(Items("rest"), "What function should be.")

    @property
    def is_fixed_in_space(self) -> bool:  # type: ignore[override]
        """Whether it holds particles somewhere, not to each other."""
        return self.arity == 1

    def __init__(
        self, function, indices, rest: ArrayLike = 0.0, *, gradient=None, side: int = 0, origin=None, unit=None, compliance:
        ArrayLike = 0.0, damping: ArrayLike = 0.0, break_at=None,
    ):  # fmt: skip
        self.name = getattr(function, "__name__", "?")
        indices = np.asarray(indices)
        if indices.ndim == 1:
            indices = indices[:, None]
        self.arity = indices.shape[1] if indices.ndim == 2 else 0
        self.function = self._check_function("function", function)
        self.gradient = None if gradient is None else self._check_function("gradient", gradient)
        if side not in (-1, 0, 1):
            raise ValueError(f"{self!r}: side = {side!r}, but it must be 0 (equal), 1 (at most) or -1 (at least).")
        self.side = side
        self.origin: Any = origin
        self._unit = None if unit is None else checks.number(repr(self), "unit", unit, above=0.0)
        self.setup(indices, rest, compliance, damping, break_at)

    def quantity_of(self, indices) -> Quantity:
        """Return the user's function of these corners, in the given unit."""
        return Function(self.fixed(indices, self.arity), self._unit)

    def __repr__(self) -> str:
        return f"Constraint({self.name})"

    def _check_function(self, name: str, function) -> Any:
        """Check the function. Returns it for kernels, and whether it takes the number of the constraint."""
        if not callable(function):
            raise TypeError(f"Constraint: {name} = {function!r} is not a function.")
        plain = undecorated(function)
        names = list(inspect.signature(plain).parameters)
        if self.arity and len(names) not in (self.arity, self.arity + 1):
            raise TypeError(
                f"{self!r}: {name} takes {names}, but each constraint has {self.arity} corners. It must take one vector for "
                "each, and may take the number of the constraint after them."
            )
        if plain.__name__ == "<lambda>":
            raise TypeError(f"{self!r}: {name} is a lambda, which Taichi cannot read. Use def.")
        return function if plain is not function else ti.func(function), len(names) > self.arity

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices and the gradient, and set the rest values."""
        self.check_indices(particles)
        words = None
        if self.origin is not None or self.arity == 1:
            origin = np.zeros(particles.dim) if self.origin is None else self.origin
            origin = checks.vector(repr(self), "origin", origin, particles.dim)
            self._keep(origin=origin)
            high = origin.astype(np.float32).astype(np.float64)
            words = [high.tolist(), (origin - high).tolist()]
        mine = self.indices.ravel()  # only its own particles, so that no other particle changes a bit of the result
        extent = float(np.ptp(particles.position[mine], axis=0).max()) if len(mine) else 0.0
        self._keep(_size=extent or float(particles.radius[mine].max(initial=0.0)) or 1.0)
        self._keep(_measured=(None, None))
        self._derivative = NumericGradient(self.function, self.gradient, self.arity, particles.dim, int(self.origin is None))
        self.hold(Function(self.members, self._unit, self._derivative, words, self._size))
        Scalar.prepare(self, particles, inv_mass)
        values, gradients = self.measured(particles.position)
        self._keep(_measured=(particles.position, (values, gradients)))
        if not np.isfinite(values).all():
            i = int(np.argmin(np.isfinite(values)))
            raise ValueError(f"{self!r}: the function is {values[i]} for {self.index_name}[{i}] at its initial position.")
        if self.count:
            self.quantity.has_cusp_at_zero = self._is_nowhere_negative(particles.position)
        if self.gradient is not None and self.count:
            self._check_gradient(particles.position)

    def _is_nowhere_negative(self, position: np.ndarray) -> bool:
        """Whether f is not below 0 on either side of where Newton's method finds f = 0: a kink or a flat minimum."""
        q = self._corners(position)
        for _ in range(APPROACH):
            f, g, _ = self._derivative(q, self._size)
            square = (g**2).sum(axis=(1, 2))
            share = np.divide(f, square, out=np.zeros(self.count), where=np.isfinite(f + square) & (square > 0))
            q = q - share[:, None, None] * np.where(share[:, None, None] != 0, g, 0.0)
        for k in range(1, TRIED + 1):
            e = NEAR * self._size * (golden(np.arange(1, q.size + 1) + 1000 * k).reshape(q.shape) - 0.5)
            if any((self._derivative(near, self._size)[0] < 0).any() for near in (q + e, q - e)):
                return False
        return True

    def _check_gradient(self, position: np.ndarray) -> None:
        """Compare the gradient with differences, here and at three places near by: two of four must agree, for kinks."""
        wrong, found = np.zeros((self.count, self.arity, position.shape[1]), dtype=int), []
        for k in range(4):
            q = self._corners(position)
            q = q + k * 0.01 * self._size * (golden(np.arange(1, q.size + 1) + 1000 * k).reshape(q.shape) - 0.5)
            _, given, differences = self._derivative(q, self._size)
            size = np.abs(differences).max(axis=(1, 2), keepdims=True)
            off = ~(np.abs(given - differences) <= GRADIENT_TOLERANCE * size + 1e-9 * np.abs(given))
            wrong += off & np.isfinite(differences)
            found.append((given, differences))
        if (wrong > 2).any():
            c, k, a = (int(v) for v in np.unravel_index(int(np.argmax(wrong)), wrong.shape))
            given, differences = found[1]
            raise ValueError(
                f"{self!r}: gradient is wrong for corner {k} along {'xyz'[a]}: {given[c, k, a]:g} near {self.index_name}[{c}], "
                f"but differences of function give {differences[c, k, a]:g}. Correct it, or leave gradient out."
            )

    def _corners(self, position: np.ndarray) -> np.ndarray:
        """Return the corners that function takes, (m, arity, dim)."""
        q = position[self.indices]
        return q - (q[:, :1] if self.origin is None else self.origin)

    def inverse_size(self, position: np.ndarray) -> np.ndarray:
        """Return what Scalar does. One corner has no extent; its distance from the origin, or the rest value, stands for it."""
        if self.arity > 1:
            return super().inverse_size(position)
        size = np.linalg.norm(self._corners(position)[:, 0], axis=1) * np.linalg.norm(self.gradients(position)[:, 0], axis=1)
        size = np.maximum(size, np.abs(self.goal))
        return np.divide(1, size, out=np.zeros(self.count), where=size > 0)

    def measured(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values of function, (m,), and its gradients, (m, arity, dim)."""
        known, found = self._measured  # Taichi cannot launch kernels while the world's fields are being declared
        return found if position is known else self._derivative(self._corners(position), self._size)[:2]

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Return the values of function, (m,)."""
        return self.measured(position)[0]

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """Return the gradients of function, (m, arity, dim)."""
        return self.measured(position)[1]
