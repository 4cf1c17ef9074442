"""Areas of triangles and of closed loops."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.feature import Knob, Scene
from ..features.items import Items
from ..geometry.intervals import cross, cross_2d
from ..particles import Particles
from .core.members import Members, rows
from .core.outline_passes import GOAL, PRESSURE
from .core.quantity import Quantity
from .core.scalar import Scalar


class Area(Scalar):
    """Triangles, or closed loops of any length in 2D, that keep their area: cells, soft bodies, cushions.

    C(x) = A(x) - pressure rest.
    In 2D A is the signed area, by the shoelace formula, and grad_k A = (x_(k+1) - x_(k-1)) / 2, turned by -90 degrees; a body
    that is inside out turns back. In 3D A = |n| / 2 of a triangle, n = (b - a) x (c - a), with grad_b A = (c - a) x n / (2 |n|)
    and so on. A triangle without area has no gradient in 3D: the constraint does not act on it, and its residual is 1.

    loops: (m, 3) indices of triangles, or in 2D a sequence of index sequences, around each area in either sense; or one of them.
    rest: area at pressure 1, number or (m,) [m^2]; None takes the initial areas. Live.
    pressure: factor on the rest area, number or (m,): above 1 inflates, at least 0. Live.
    compliance: number or (m,) [m^3/N], inverse of the pressure (N/m in 2D) per m^2 of missing area; 0 is rigid.
    damping: number or (m,) [N s/m^3], of a dashpot parallel to the spring. break_at: load at which it bursts, number or (m,)
    [N/m].

    `load` is the tension that keeps the area [N/m]; -load is the pressure inside. Second order in h, see tiverlet/step/README.md.
    Raises ValueError for loops of fewer than 3 or repeated particles, and for loops of more than 3 in 3D, where they enclose no
    area.
    """

    index_name = "loops"
    each = (*Scalar.each, "pressure")
    pressure, goal = PRESSURE, GOAL
    rest = Knob(Items("rest", least=0.0), "Area at pressure 1 [m^2].")

    def __init__(
        self, loops, rest=None, *, pressure: ArrayLike = 1.0, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0,
        break_at=None,
    ):  # fmt: skip
        self.setup(loops, rest, compliance, damping, break_at)
        self.pressure = pressure

    def quantity_of(self, indices) -> Quantity:
        """Return Triangles where all loops have 3 corners, else Loops. Triangles have simpler kernels of their own."""
        loops = checks.rows("Area", "loops", indices, "a sequence of index sequences")
        if all(np.ndim(loop) == 1 and len(loop) == 3 for loop in loops):
            return Triangles(self.fixed(indices, 3))
        return Loops(Members.joined("Area", rows("Area", "loops", indices, 3)))

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Refuse loops in 3D; order the corners of each area so that it is positive at the start."""
        if not self.arity and particles.dim != 2:
            raise ValueError("Area: loops of more than 3 particles enclose no definite area in 3D; use triangles, or Volume.")
        super().prepare(particles, inv_mass)


class Triangles(Quantity):
    """Areas of triangles."""

    arity, collapses, curved, mirror = 3, 2, True, (2, 1, 0)
    exchangeable = ((0, 1, 2),)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the areas of the triangles, (m,) [m^2]; signed in 2D."""
        a, b, c = x[:, 0], x[:, 1], x[:, 2]
        if x.shape[2] == 2:
            return cross_2d(b - a, c - a) / 2
        return np.linalg.norm(cross(b - a, c - a), axis=1) / 2

    @ti.func
    def measure(self, c, q):
        """Return the area and its gradients."""
        a, b = q[1, :], q[2, :]
        f = 0 * a[0]
        u, v = 0 * a, 0 * b
        if ti.static(q.m == 2):
            f = (a[0] * b[1] - a[1] * b[0]) / 2
            u, v = ti.Vector([b[1], -b[0]]) / 2, ti.Vector([-a[1], a[0]]) / 2
        else:
            n = a.cross(b)
            largest = ti.max(ti.abs(n[0]), ti.max(ti.abs(n[1]), ti.abs(n[2])))
            if largest > 0:  # normalised first: squares of areas would exceed the range of f32
                n /= largest
                size = n.norm()
                f = largest * size / 2
                u, v = b.cross(n / size) / 2, (n / size).cross(a) / 2
        return f, ti.Matrix.rows([-u - v, u, v])


class Loops(Quantity):
    """Areas of closed loops in 2D."""

    collapses, curved = 2, True
    sides: Any  # on the device: the neighbours of each corner, (total, 2)

    def reversed(self, which: np.ndarray) -> "Loops":
        """Return these loops, with the order of corners reversed where `which` (m,) is True."""
        return Loops(Members.joined("Area", [self.members.row(k)[:: -1 if w else 1] for k, w in enumerate(which)]))

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the areas, (m,) [m^2], by the shoelace formula."""
        indices, starts = self.members.indices, self.members.starts
        if not self.members.count:
            return np.zeros(0)
        r = x[indices] - np.repeat(x[indices[starts[:-1]]], np.diff(starts), axis=0)
        s = r[self.after]
        return np.add.reduceat(cross_2d(r, s), starts[:-1]) / 2

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of the areas by each corner, (total, 2)."""
        sides = x[self.neighbours]
        across = sides[:, 1] - sides[:, 0]
        return np.stack([across[:, 1], -across[:, 0]], axis=1) / 2

    @property
    def after(self) -> np.ndarray:
        """The next corner around the loop of each corner, (total,)."""
        starts = self.members.starts
        out = np.arange(1, len(self.members.indices) + 1)
        out[starts[1:] - 1] = starts[:-1]
        return out

    @property
    def neighbours(self) -> np.ndarray:
        """The particles before and after each corner, (total, 2)."""
        before = np.empty_like(self.after)
        before[self.after] = np.arange(len(before))
        indices = self.members.indices
        return np.stack([indices[before], indices[self.after]], axis=1)

    def pairs(self) -> np.ndarray:
        """Return the pairs of particles that are neighbours along a loop, (total, 2)."""
        indices = self.members.indices
        return np.stack([indices, indices[self.after]], axis=1)

    def bind(self, scene: Scene, batch: Any, equation: Any) -> "Loops":
        """Return the quantity for kernels, with the neighbours of each corner in a field."""
        bound, sides = super().bind(scene, batch, equation), self.neighbours
        bound.sides = scene.memory.field("Area.sides", len(sides), width=2, kind=ti.i32, values=sides)
        return bound

    @ti.func
    def slope(self, e, back):
        """Return half the vector from the previous corner to the next one, turned by -90 degrees."""
        i, j = self.sides[e]
        r = self.state.separation(j, i) - back * (self.state.d[j] - self.state.d[i])
        return ti.Vector([r[1], -r[0]]) / 2
