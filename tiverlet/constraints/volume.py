"""Volumes of tetrahedra and of closed meshes."""

from typing import Any

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.feature import Knob, Scene
from ..features.items import Items
from ..geometry.common_sense import edges_of, oriented
from ..geometry.intervals import cross
from ..particles import Particles
from .core.members import Members
from .core.outline_passes import GOAL, PRESSURE
from .core.quantity import Quantity
from .core.scalar import Scalar

LARGEST = 1e9  # [m] the squared gradient of a volume is a length to the fourth, and must stay below 3e38


class Volume(Scalar):
    """Tetrahedra, or closed surfaces of triangles, that keep their volume: flesh, balloons.

    C(x) = V(x) - pressure rest,   V = sum over faces of a . (b x c) / 6,   grad_a V = sum over the faces at a of b x c / 6.

    cells: (m, 4) indices of tetrahedra, one constraint each; or (k, 3) indices of faces, of one or several closed surfaces. Faces
    connected by edges form one surface. Each surface encloses its own volume and is one constraint, in the order of first faces.
    Corners may be given in any sense: they are reordered so that volumes are positive at the start.
    rest: volume at pressure 1, number or (m,) [m^3]; None takes the initial volumes. Live.
    pressure: factor on the rest volume, number or (m,), at least 0. Live.
    compliance: number or (m,) [m^5/N], inverse of the pressure [Pa] per m^3 of missing volume; 0 is rigid.
    damping: number or (m,) [N s/m^5]. break_at: pressure at which it bursts, number or (m,) [Pa].

    `load` is -p, with p the pressure inside [Pa]. Second order in h, see tiverlet/step/README.md. Bodies of 1e9 m and more exceed
    the range of f32.

    Raises ValueError in 2D, and for surfaces with an open edge, an edge of three faces, or only one side; the edge is named.
    """

    index_name = "cells"
    for_users = ("faces",)
    each = (*Scalar.each, "pressure")
    pressure, goal = PRESSURE, GOAL
    rest = Knob(Items("rest", least=0.0), "Volume at pressure 1 [m^3].")

    def __init__(
        self, cells, rest=None, *, pressure: ArrayLike = 1.0, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0,
        break_at=None,
    ):  # fmt: skip
        self.setup(cells, rest, compliance, damping, break_at)
        self.pressure = pressure

    def quantity_of(self, indices) -> Quantity:
        """Return Surfaces for faces (k, 3), else Tetrahedra, which have simpler kernels of their own."""
        if np.ndim(indices) == 2 and np.shape(indices)[1] == 3:
            return Surfaces(*oriented("Volume", "cells", checks.indices("Volume", "cells", indices, checks.ANY, arity=3)))
        return Tetrahedra(self.fixed(indices, 4))

    @property
    def faces(self) -> np.ndarray:
        """Faces of closed surfaces, (k, 3), as seen from outside. Raises AttributeError for tetrahedra."""
        if self.arity:
            raise AttributeError(f"{self!r} has tetrahedra and no faces; their particles are in .indices.")
        return self.listing

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Refuse 2D worlds; order the corners so that volumes are positive at the start."""
        if particles.dim != 3:
            raise ValueError("Volume: there are no volumes in a 2D world; use Area.")
        super().prepare(particles, inv_mass)

    def bind(self, scene: Scene) -> None:
        """Bind, after raising ValueError for volumes that f32 cannot represent."""
        largest = float(np.cbrt(np.abs(self.goal).max(initial=0.0)))
        if scene.real == ti.f32 and largest >= LARGEST:
            raise ValueError(f"Volume: a body of {largest:g} m is too large for f32. Use World(..., precision='f64').")
        super().bind(scene)


class Tetrahedra(Quantity):
    """Volumes of tetrahedra."""

    arity, collapses, transcends, curved, mirror = 4, 3, True, True, (0, 1, 3, 2)
    exchangeable = ((0, 1, 2, 3),)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the signed volumes, (m,) [m^3]."""
        a, b, c, d = (x[:, k] for k in range(4))
        return np.einsum("ij,ij->i", b - a, cross(c - a, d - a)) / 6

    @ti.func
    def measure(self, c, q):
        """Return the volume and its gradients."""
        a, b, e = q[1, :], q[2, :], q[3, :]
        u, v, w = b.cross(e) / 6, e.cross(a) / 6, a.cross(b) / 6
        return a.dot(u), ti.Matrix.rows([-u - v - w, u, v, w])


class Surfaces(Quantity):
    """Volumes inside closed surfaces.

    faces: (k, 3); the two faces at each edge run along it in opposite senses. surface: the surface of each face, (k,).
    On the device, `ring` lists the other two corners of the faces around each corner e, from starts[e] on.
    """

    collapses, transcends, curved = 3, True, True
    corners: Any
    starts: Any
    ring: Any

    def __init__(self, faces: np.ndarray, surface: np.ndarray):
        self.faces, self.surface = faces, surface
        bodies = [np.unique(faces[surface == k]) for k in range(int(surface.max(initial=-1)) + 1)]
        super().__init__(Members.joined("Volume", bodies))

    @property
    def listing(self) -> np.ndarray:
        """The faces, (k, 3)."""
        return self.faces

    def reversed(self, which: np.ndarray) -> "Surfaces":
        """Return these surfaces, with the faces of surface k reversed where which[k] is True."""
        return Surfaces(np.where(which[self.surface][:, None], self.faces[:, ::-1], self.faces), self.surface)

    def remapped(self, some: np.ndarray, number: np.ndarray) -> "Surfaces":
        """Return the surfaces in the mask `some`, with the new numbers of their particles."""
        stays = some[self.surface]
        return Surfaces(number[self.faces[stays]].astype(np.int32), (np.cumsum(some) - 1)[self.surface[stays]])

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return the signed volumes, (m,) [m^3]."""
        a, b, c = self._face_corners(x)
        parts = np.einsum("ij,ij->i", a, cross(b, c)) / 6
        return np.bincount(self.surface, weights=parts, minlength=self.members.count)

    def _face_corners(self, x: np.ndarray) -> np.ndarray:
        """Return the corners of each face, (3, k, 3), relative to one of the particles of its surface."""
        eye = x[self.members.indices[self.members.starts[:-1]]][self.surface][:, None]
        return np.moveaxis(x[self.faces] - eye, 1, 0)

    def gradients(self, x: np.ndarray) -> np.ndarray:
        """Return the gradients of the volumes by each corner, (total, 3)."""
        members, corner = self.members, self._corner
        a, b, c = self._face_corners(x)
        parts = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1).reshape(-1, 3) / 6
        return np.stack([np.bincount(corner, part, minlength=len(members.indices)) for part in parts.T], axis=1)

    @property
    def _corner(self) -> np.ndarray:
        """The index among the members of each corner of each face, (3 faces,)."""
        members = self.members
        most = 1 + int(members.indices.max(initial=0))
        own = members.owner.astype(np.int64) * most + members.indices  # sorted, since np.unique sorts the members
        return np.searchsorted(own, self.surface[:, None].astype(np.int64) * most + self.faces).ravel()

    def pairs(self) -> np.ndarray:
        """Return the two ends of each edge, (edges, 2)."""
        return edges_of(self.faces)[0]

    def bind(self, scene: Scene, batch: Any, equation: Any) -> "Surfaces":
        """Return the quantity for kernels, with the faces around each corner in fields, in order: their other two corners."""
        members, corner = self.members, self._corner
        others = np.stack([self.faces[:, [1, 2, 0]].ravel(), self.faces[:, [2, 0, 1]].ravel()], axis=1)
        order = np.argsort(corner, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(corner, minlength=len(members.indices)))])
        bound, add = super().bind(scene, batch, equation), scene.memory.field
        bound.starts = add("Volume.rings", len(starts), kind=ti.i32, values=starts)
        bound.ring = add("Volume.ring", len(order), width=2, kind=ti.i32, values=others[order])
        return bound

    @ti.func
    def slope(self, e, back):
        """Return the sum of b x c / 6 over the faces around a corner, relative to it, which changes nothing in a closed ring."""
        i = self.corners.members[e]
        total = 0 * self.state.d[i]
        for k in range(self.starts[e], self.starts[e + 1]):
            j, m = self.ring[k]
            b = self.state.separation(j, i) - back * (self.state.d[j] - self.state.d[i])
            c = self.state.separation(m, i) - back * (self.state.d[m] - self.state.d[i])
            total += b.cross(c)
        return total / 6
