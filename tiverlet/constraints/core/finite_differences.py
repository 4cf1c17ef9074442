"""A function of a few corners and its gradient, on the device and on the host."""

from typing import Any

import numpy as np

from ...device import inline, runtime, ti
from ...device.language import Expression, undecorated
from ...device.patches.compiler import Compiler, refuse
from ...features.user_function import check_number, check_vector

STEP = 2.0**-20  # of central differences, relative to the distance between corners


@ti.data_oriented
class NumericGradient:
    """function(x_0, x_1, ...) of `arity` corners in `dim` dimensions, and its gradient: given, or by central differences.

    function, gradient: a Taichi function, and whether it takes the number of the constraint after the corners.
    fixed: 1 if the function does not change when all corners move together. The gradient of the first corner is then minus the
    sum of the others. size, as an argument: scale of the step where all corners coincide, in units of STEP [m].
    """

    def __init__(self, function: tuple, gradient: tuple | None, arity: int, dim: int, fixed: int):
        self.compiler = Compiler(ti.f64)
        self.function, self.counts = function
        self.given: Any = gradient[0] if gradient else None
        self.gradient_counts = bool(gradient and gradient[1])
        self.analytic = gradient is not None
        self.arity, self.dim, self.fixed = arity, dim, fixed
        self.unknowns = [(k, a) for k in range(fixed, arity) for a in range(dim)]
        self.number = [[(k - fixed) * dim + a + 1 if k >= fixed else -1 for a in range(dim)] for k in range(arity)]

    def __call__(self, q: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return values (m,), gradients and differences (m, arity, dim) at corners q (m, arity, dim), in f64."""
        runtime.ensure_started()
        m = len(q)
        f, g, d = np.zeros(m), np.zeros((m, self.arity, self.dim)), np.zeros((m, self.arity, self.dim))
        if m:
            with self.compiler():
                self.evaluate(np.ascontiguousarray(q), f, g, d, size)
        return f, g if self.analytic else d, d

    @ti.kernel
    def evaluate(
        self, points: ti.types.ndarray(ti.f64, 3), f: ti.types.ndarray(ti.f64, 1), g: ti.types.ndarray(ti.f64, 3),
        d: ti.types.ndarray(ti.f64, 3), size: ti.f64,
    ):  # fmt: skip
        """Compute the function, its gradient as constraints use it, and its differences."""
        for c in range(points.shape[0]):
            q = ti.Matrix.zero(ti.f64, self.arity, self.dim)
            for k, a in ti.static(ti.ndrange(self.arity, self.dim)):
                q[k, a] = points[c, k, a]
            value, slope = self.differentiate(c, q, size)
            f[c] = value
            for k, a in ti.static(ti.ndrange(self.arity, self.dim)):
                d[c, k, a] = slope[k, a]
            if ti.static(self.analytic):
                given = self.slope(c, q)
                for k, a in ti.static(ti.ndrange(self.arity, self.dim)):
                    g[c, k, a] = given[k, a]

    @ti.func
    def value(self, c, q, j, step):
        """Return function at q, moved by `step` along the unknown number (j + 1) / 2, forward for odd j and back for even."""
        # Vectors, not a matrix: Taichi 1.7.4 fails in control_flow_graph.cpp on some that are assigned whole and by elements.
        sign = ti.select(j % 2 == 1, step, -step)
        corners = [
            ti.Vector([q[k, a] + sign * ti.cast((j + 1) // 2 == self.number[k][a], ti.f64) for a in ti.static(range(self.dim))])
            for k in ti.static(range(self.arity))
        ]
        return self.checked(self.function(*self.arguments(corners, c, self.counts)))

    @inline
    def checked(self, value):
        """Return the value of the function if it is a number, else refuse it."""
        name = undecorated(self.function).__name__
        return check_number(f"Constraint({name})", name, value)

    @inline
    def checked_vectors(self, value):
        """Return the given gradient if it is a vector for each corner, else refuse it."""
        who, name = f"Constraint({undecorated(self.function).__name__})", undecorated(self.given).__name__
        several = self.arity > 1
        if several and (isinstance(value, Expression) or len(value) != self.arity):
            wanted = f"{self.arity} vectors, the gradient by each corner: return g_0, g_1, ..."
            refuse(TypeError(f"{who}: {name} must return {wanted}"))
        for one in value if several else [value]:
            check_vector(who, name, one, self.dim, "the gradient by a corner", "")
        return value

    @inline
    def arguments(self, corners, c, counts):
        """Return the arguments of a call. Quadrants accepts unpacked arguments only at the end."""
        return [*corners, c] if counts else corners

    @ti.func
    def slope(self, c, q):
        """Return the given gradient."""
        corners = [q[k, :] for k in ti.static(range(self.arity))]
        return self.rows(self.checked_vectors(self.given(*self.arguments(corners, c, self.gradient_counts))))

    @ti.func
    def rows(self, vectors: ti.template()):  # type: ignore[valid-type]
        """Return one vector, or a tuple of vectors, as a matrix."""
        g = ti.Matrix.zero(ti.f64, self.arity, self.dim)
        for k, a in ti.static(ti.ndrange(self.arity, self.dim)):
            if ti.static(self.arity == 1):
                g[k, a] = vectors[a]
            else:
                g[k, a] = vectors[k][a]
        return g

    @ti.func
    def differentiate(self, c, q, scale):
        """Return function and its central differences at q, by a loop with its only copy. scale: of the step at 0, in STEP."""
        size = 0 * q[0, 0]
        for k, a in ti.static(ti.ndrange(self.arity, self.dim)):
            size = ti.max(size, ti.abs(q[k, a]))
        if size == 0:
            size += scale
        step, f = STEP * size, 0 * size
        g = ti.Matrix.zero(ti.f64, self.arity, self.dim)
        for j in range(ti.static(2 * len(self.unknowns) + 1)):
            v = self.value(c, q, j, step)
            if j == 0:
                f = v
            for k, a in ti.static(self.unknowns):
                if (j + 1) // 2 == ti.static(self.number[k][a]):
                    g[k, a] += ti.select(j % 2 == 1, v - f, f - v) / (2 * step)
        if ti.static(self.fixed):
            for k, a in ti.static(self.unknowns):
                g[0, a] -= g[k, a]
        return f, g

    @ti.func
    def both(self, c, q, scale):
        """Return the function and its gradient."""
        if ti.static(self.analytic):
            return self.value(c, q, 0, 0 * q[0, 0]), self.slope(c, q)
        else:
            return self.differentiate(c, q, scale)
