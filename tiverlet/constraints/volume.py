"""Volumes of tetrahedra and of closed meshes."""

import numpy as np

from .. import checks
from ..device import ti
from ..features.feature import Knob, Scene
from ..particles import Particles
from .core.scalar import Scalar
from .core.variable_size import Content

LARGEST = 1e9  # [m] the square of a volume's gradient, a length to the fourth, has to stay below 3e38


class Volume(Scalar):
    """Tetrahedra, or closed surfaces of triangles, that keep their volume: flesh, balloons.

    C(x) = V(x) - pressure rest,   V = sum over faces of a . (b x c) / 6,   grad_a V = sum over the faces at a of b x c / 6.

    cells: (m, 4) indices of tetrahedra, one constraint each; or (k, 3) indices of faces, of one or several closed surfaces. Each
    surface that hangs together by its edges encloses a volume of its own and is one constraint, in the order of first faces.
    Corners may be given in any sense: they are turned so that volumes are positive at the start.
    rest: volume at pressure 1, number or (m,) [m^3]; None takes the initial volumes. Live.
    pressure: factor on the rest volume, number or (m,), at least 0. Live.
    compliance: number or (m,) [m^5/N], inverse of what pressure [Pa] each m^3 of missing volume makes; 0 is rigid.
    damping: number or (m,) [N s/m^5]. break_at: pressure at which it bursts, number or (m,) [Pa].

    `load` is -p, with p the pressure inside [Pa]. Second order in h, see Scalar. Bodies of 1e9 m and more leave f32.

    Raises ValueError in 2D, and for surfaces with an open edge, an edge of three faces, or only one side; the edge is named.
    """

    index_name = "cells"
    each = (*Scalar.each, "pressure")
    collapses, transcends = 3, True
    rest = Knob(lambda f, v: checks.per_item("Volume", "rest", v, f.count, least=0.0), "Volume at pressure 1 [m^3].")
    pressure = Knob(lambda f, v: checks.per_item("Volume", "pressure", v, f.count, least=0.0), "Factor on the rest volume.")

    def __new__(cls, cells=(), *args, **kwargs):
        """Tetrahedra are simpler than meshes, and have kernels of their own."""
        return object.__new__(Surfaces if np.ndim(cells) == 2 and np.shape(cells)[1] == 3 else Tetrahedra)

    def __init__(self, cells, rest=None, *, pressure=1.0, compliance=0.0, damping=0.0, break_at=None):
        self.setup(cells, rest, compliance, damping, break_at)
        self.pressure = pressure

    def __repr__(self) -> str:
        return "Volume"

    @property
    def goal(self) -> np.ndarray:
        """pressure rest."""
        return self.pressure * self.rest

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Turn the corners so that volumes are positive at the start."""
        if particles.dim != 3:
            raise ValueError("Volume: there are no volumes in a 2D world; use Area.")
        self.fit(particles)
        self.reverse(self.rest_of(particles.position) < 0)
        Scalar.prepare(self, particles, inv_mass)

    def reverse(self, which: np.ndarray) -> None:
        """Turn these inside out."""
        raise NotImplementedError

    def bind(self, scene: Scene) -> None:
        """Refuse what f32 cannot hold."""
        largest = float(np.cbrt(np.abs(self.goal).max(initial=0.0)))
        if scene.real == ti.f32 and largest >= LARGEST:
            raise ValueError(f"Volume: a body of {largest:g} m is too large for f32. Use World(..., precision='f64').")
        super().bind(scene)


class Tetrahedra(Volume):
    """Volumes of tetrahedra."""

    arity = 4

    def reverse(self, which: np.ndarray) -> None:
        """Swap two corners of each."""
        self.indices = np.where(which[:, None], self.indices[:, [0, 1, 3, 2]], self.indices)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Signed volumes."""
        a, b, c, d = (position[k] for k in self.indices.T)
        return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6

    @ti.func
    def measure(self, c, q):
        """Volume, and its gradients."""
        a, b, e = q[1, :], q[2, :], q[3, :]
        u, v, w = b.cross(e) / 6, e.cross(a) / 6, a.cross(b) / 6
        return a.dot(u), ti.Matrix.rows([-u - v - w, u, v, w])


class Surfaces(Volume, Content):
    """Volumes inside closed surfaces."""

    arity = 0

    def lay(self, members) -> None:
        """Find the surfaces, and turn the faces of each alike."""
        faces = checks.indices("Volume", "cells", members, checks.ANY, arity=3)
        self.faces, self._surface = _oriented(faces)
        self.layout([np.unique(self.faces[self._surface == k]) for k in range(int(self._surface.max(initial=-1)) + 1)])

    @property
    def listing(self) -> np.ndarray:
        """The faces."""
        return self.faces

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the faces of these surfaces too."""
        Content.select(self, some, number)
        self.faces = number[self.faces[some[self._surface]]].astype(np.int32)
        self._surface = (np.cumsum(some) - 1)[self._surface[some[self._surface]]]

    def reverse(self, which: np.ndarray) -> None:
        """Turn the faces of these around."""
        self.faces = np.where(which[self._surface][:, None], self.faces[:, ::-1], self.faces)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Signed volumes, each seen from one of its own particles."""
        eye = position[self.indices[self.starts[:-1]]][self._surface][:, None]
        a, b, c = np.moveaxis(position[self.faces] - eye, 1, 0)
        parts = np.einsum("ij,ij->i", a, np.cross(b, c)) / 6
        return np.bincount(self._surface, weights=parts, minlength=self.count)

    def partners(self, particles: Particles) -> np.ndarray:
        """The ends of an edge may overlap."""
        return np.unique(np.sort(_edges(self.faces)[:, :2], axis=1), axis=0)

    def bind(self, scene) -> None:
        """Keep the faces around each corner: the two other corners of each, in order."""
        super().bind(scene)
        key = self._surface[:, None].astype(np.int64) * (scene.particles.count + 1) + self.faces
        own = self.owner.astype(np.int64) * (scene.particles.count + 1) + self.indices  # sorted, as np.unique made them
        corner = np.searchsorted(own, key).ravel()
        others = np.stack([self.faces[:, [1, 2, 0]].ravel(), self.faces[:, [2, 0, 1]].ravel()], axis=1)
        order = np.argsort(corner, kind="stable")
        rings = np.concatenate([[0], np.cumsum(np.bincount(corner, minlength=self.corner_count))])
        add = scene.memory.field
        self.dev.rings = add("Volume.rings", self.corner_count + 1, kind=ti.i32, values=rings)
        self.dev.ring = add("Volume.ring", len(order), width=2, kind=ti.i32, values=others[order])

    @ti.func
    def slope(self, e, back):
        """Sum of b x c / 6 over the faces around a corner; b and c relative to it, which changes nothing in a closed ring."""
        i = self.dev.members[e]
        total = 0 * self.dev.state.d[i]
        for k in range(self.dev.rings[e], self.dev.rings[e + 1]):
            j, m = self.dev.ring[k]
            b = self.dev.state.apart(j, i) - back * (self.dev.state.d[j] - self.dev.state.d[i])
            c = self.dev.state.apart(m, i) - back * (self.dev.state.d[m] - self.dev.state.d[i])
            total += b.cross(c)
        return total / 6


def _edges(faces: np.ndarray) -> np.ndarray:
    """The edges of each face in its sense, and the face: (3 k, 3)."""
    f = np.arange(len(faces), dtype=faces.dtype)
    return np.concatenate([np.stack([faces[:, a], faces[:, (a + 1) % 3], f], axis=1) for a in range(3)])


def _oriented(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces, turned so that the two at each edge run along it in opposite senses, and the surface that each belongs to."""
    edges = _edges(faces)
    forward = edges[:, 0] < edges[:, 1]
    ends = np.sort(edges[:, :2], axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    unique, first, counts = np.unique(ends[order], axis=0, return_index=True, return_counts=True)
    if (counts != 2).any():
        k = int(np.argmax(counts != 2))
        edge, face = tuple(int(v) for v in unique[k]), int(edges[order[first[k]], 2])
        why = "the surface is open there" if counts[k] == 1 else "an edge of a closed surface has two"
        raise ValueError(f"Volume: edge {edge} of cells[{face}] belongs to {counts[k]} face(s); {why}.")
    one, two = order[0::2], order[1::2]
    a, b, alike = edges[one, 2], edges[two, 2], forward[one] == forward[two]
    neighbours: list[list[tuple[int, bool]]] = [[] for _ in faces]
    for p, q, same in zip(a.tolist(), b.tolist(), alike.tolist(), strict=True):
        neighbours[p].append((q, same))
        neighbours[q].append((p, same))
    surface, turned = np.full(len(faces), -1), np.zeros(len(faces), dtype=bool)
    for k in range(len(faces)):
        if surface[k] >= 0:
            continue
        surface[k] = surface.max() + 1
        queue = [k]
        while queue:
            p = queue.pop()
            for q, same in neighbours[p]:
                if surface[q] < 0:
                    surface[q], turned[q] = surface[p], turned[p] ^ same
                    queue.append(q)
                elif turned[q] != turned[p] ^ same:
                    raise ValueError(f"Volume: cells[{p}] and cells[{q}] have no common sense; the surface has only one side.")
    return np.where(turned[:, None], faces[:, ::-1], faces), surface
