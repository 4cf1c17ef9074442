"""Areas of triangles and of closed loops."""

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Knob
from ..particles import Particles
from .core.scalar import Scalar
from .core.variable_size import Content, rows


class Area(Scalar):
    """Triangles, or closed loops of any length in 2D, that keep their area: cells, soft bodies, cushions.

    C(x) = A(x) - pressure rest.
    In 2D A is the signed area, by the shoelace formula, and grad_k A = (x_(k+1) - x_(k-1)) / 2, turned by -90 degrees; what was
    turned inside out comes back. In 3D A = |n| / 2 of a triangle, n = (b - a) x (c - a), with grad_b A = (c - a) x n / (2 |n|)
    and so on; a triangle without area has no gradient there, is left alone, and shows as a residual of 1.

    loops: (m, 3) indices of triangles, or in 2D a sequence of index sequences, around each area in either sense; or one of them.
    rest: area at pressure 1, number or (m,) [m^2]; None takes the initial areas. Live.
    pressure: factor on the rest area, number or (m,): above 1 inflates, at least 0. Live.
    compliance: number or (m,) [m^3/N], inverse of what pressure (N/m in 2D) each m^2 of missing area makes; 0 is rigid.
    damping: number or (m,) [N s/m^3], of a dashpot beside the spring. break_at: load at which it bursts, number or (m,) [N/m].

    `load` is the tension that keeps the area [N/m]; -load is the pressure inside. Second order in h, see Scalar. Raises
    ValueError for loops of fewer than 3 or repeated particles, and for longer ones in 3D, where they enclose no area.
    """

    index_name = "loops"
    each = (*Scalar.each, "pressure")
    collapses = 2
    rest = Knob(lambda f, v: checks.per_item("Area", "rest", v, f.count, least=0.0), "Area at pressure 1 [m^2].")
    pressure = Knob(lambda f, v: checks.per_item("Area", "pressure", v, f.count, least=0.0), "Factor on the rest area.")

    def __new__(cls, loops=(), *args, **kwargs):
        """Triangles are simpler than loops, and have kernels of their own."""
        loops = checks.rows("Area", "loops", loops, "a sequence of index sequences")
        triangles = all(np.ndim(loop) == 1 and len(loop) == 3 for loop in loops)
        return object.__new__(Triangles if triangles else Loops)

    def __init__(self, loops, rest=None, *, pressure=1.0, compliance=0.0, damping=0.0, break_at=None):
        self.setup(loops, rest, compliance, damping, break_at)
        self.pressure = pressure

    def __repr__(self) -> str:
        return "Area"

    @property
    def goal(self) -> np.ndarray:
        """pressure rest."""
        return self.pressure * self.rest

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Go around each area so that it is positive at the start."""
        self.fit(particles)
        if particles.dim == 2:
            self.reverse(self.rest_of(particles.position) < 0)
        Scalar.prepare(self, particles, inv_mass)

    def reverse(self, which: np.ndarray) -> None:
        """Go around these in the other sense."""
        raise NotImplementedError


class Triangles(Area):
    """Areas of triangles."""

    arity = 3

    def reverse(self, which: np.ndarray) -> None:
        """Swap two corners."""
        self.indices = np.where(which[:, None], self.indices[:, ::-1], self.indices)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Areas of the triangles."""
        a, b, c = (position[k] for k in self.indices.T)
        if position.shape[1] == 2:
            (ux, uy), (vx, vy) = (b - a).T, (c - a).T
            return (ux * vy - uy * vx) / 2
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    @ti.func
    def measure(self, c, q):
        """Area, and its gradients."""
        a, b = q[1, :], q[2, :]
        f = 0 * a[0]
        u, v = 0 * a, 0 * b
        if ti.static(self.dev.state.dim == 2):
            f = (a[0] * b[1] - a[1] * b[0]) / 2
            u, v = ti.Vector([b[1], -b[0]]) / 2, ti.Vector([-a[1], a[0]]) / 2
        else:
            n = a.cross(b)
            largest = ti.max(ti.abs(n[0]), ti.max(ti.abs(n[1]), ti.abs(n[2])))
            if largest > 0:  # squares of areas would leave f32
                n /= largest
                size = n.norm()
                f = largest * size / 2
                u, v = b.cross(n / size) / 2, (n / size).cross(a) / 2
        return f, ti.Matrix.rows([-u - v, u, v])


class Loops(Area, Content):
    """Areas of closed loops in 2D."""

    arity = 0

    def lay(self, members) -> None:
        """Keep the loops."""
        self.layout(rows("Area", "loops", members, 3))

    def fit(self, particles: Particles) -> None:
        """Loops enclose an area in 2D only."""
        if particles.dim != 2:
            raise ValueError("Area: loops of more than 3 particles enclose no definite area in 3D; use triangles, or Volume.")
        self.known_particles(particles, "loops")

    def reverse(self, which: np.ndarray) -> None:
        """Turn the loops around."""
        self.layout([self.members_of(k)[:: -1 if w else 1] for k, w in enumerate(which)])

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Areas by the shoelace formula."""
        if not self.count:
            return np.zeros(0)
        r = position[self.indices] - np.repeat(position[self.indices[self.starts[:-1]]], np.diff(self.starts), axis=0)
        s = r[self.after]
        return np.add.reduceat(r[:, 0] * s[:, 1] - r[:, 1] * s[:, 0], self.starts[:-1]) / 2

    @property
    def after(self) -> np.ndarray:
        """The corner that comes after each, around its loop."""
        out = np.arange(1, len(self.indices) + 1)
        out[self.starts[1:] - 1] = self.starts[:-1]
        return out

    def partners(self, particles: Particles) -> np.ndarray:
        """Neighbours along a loop may overlap."""
        return np.stack([self.indices, self.indices[self.after]], axis=1)

    def bind(self, scene) -> None:
        """Keep the neighbours of each corner."""
        super().bind(scene)
        before = np.empty_like(self.after)
        before[self.after] = np.arange(len(before))
        sides = np.stack([self.indices[before], self.indices[self.after]], axis=1)
        self.dev.sides = scene.memory.field("Area.sides", self.corner_count, width=2, kind=ti.i32, values=sides)

    @ti.func
    def slope(self, e, back):
        """Half the way from the corner before to the corner after, turned by -90 degrees."""
        i, j = self.dev.sides[e]
        r = self.dev.state.apart(j, i) - back * (self.dev.state.d[j] - self.dev.state.d[i])
        return ti.Vector([r[1], -r[0]]) / 2
