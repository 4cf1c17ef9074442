"""A wall along a triangle mesh."""

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..geometry.common_sense import edges_of, oriented
from .collider import Collider
from .facets import Facets, facet_normals
from .moving import Moving

FLAT = 0.999  # cosine between faces whose common edge is not drawn
REMEDY = " Merge vertices that are in the same place, close the hole, or use closed = False for a thin sheet."


class Mesh(Moving):
    """Particles stay outside of a closed triangle mesh, or inside; or on their own side of an open sheet (3D).

    C(x) = dist(x, faces) - (R + r) >= 0, grad C the direction from the nearest point of the mesh.

    vertices: (m, 3) [m]. faces: (k, 3) vertices of each triangle, either way round: they are reordered to face outwards,
    each connected part by itself. A part inside of another one is turned with it: a cavity if it is given the other way round.
    inside: keep particles in. closed: False for a sheet, a thin wall with two sides. radius: R [m], by which the faces are
    thickened; it must be above 0 for a sheet and points (particles of radius 0). position, rotation: pose of the vertices; live.
    friction, restitution, push_out, active, events, surface_velocity, one_way: see tiverlet/colliders/README.md.

    Nothing passes, at any speed of the particle or of the wall. The cost for a particle grows with the number of faces around it,
    not with the size of the mesh. Raises ValueError for faces of no area, and for a closed mesh with an edge that does not have
    two faces.
    """

    dim = 3
    shares_code = True

    def __init__(
        self, vertices, faces, inside: bool = False, *, closed: bool = True, radius: float = 0.0, position: ArrayLike = 0.0,
        rotation: ArrayLike = 0.0, friction: ArrayLike = 0.0, restitution: ArrayLike = 0.0, push_out: float | None = None,
        active: bool | None = None, events: bool = False, surface_velocity=None, one_way=None,
    ):  # fmt: skip
        vertices = checks.points("Mesh", "vertices", vertices, dim=3)
        faces = checks.indices("Mesh", "faces", faces, len(vertices), arity=3).astype(int)
        self.set_sides(closed, inside, "a sheet")
        self.radius = radius
        if not len(faces):
            raise ValueError("Mesh: faces is empty; a wall needs at least one.")
        corners = vertices[faces]
        u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        longest = np.linalg.norm([u, v, v - u], axis=2).max(axis=0)
        flat = np.linalg.norm(np.cross(u, v), axis=1) <= 1e-9 * longest * np.maximum(longest, np.abs(vertices).max())
        if flat.any():
            k = int(np.argmax(flat))
            raise ValueError(f"Mesh: faces[{k}] = {tuple(faces[k].tolist())} has no area; leave it out.")
        if self.closed:
            faces, part = oriented("Mesh", "faces", faces, REMEDY)
            faces = np.where((_inwards(vertices[faces], part) != self.inside)[:, None], faces[:, ::-1], faces)
        self.vertices, self.faces = vertices, faces
        for array in (vertices, faces):
            array.flags.writeable = False
        self.position, self.rotation = position, rotation
        self.set_surface(friction, restitution, push_out, active, events, one_way, 3, surface_velocity=surface_velocity)
        self.facets = self._joined()

    def _joined(self) -> Facets:
        """Compute corners and edges, the directions in which the faces continue from them, and the mean normals there."""
        faces, m = self.faces, len(self.vertices)
        c = self.vertices[faces]
        normal = facet_normals(c)
        self.edges, edge, _ = edges_of(faces)
        features = np.concatenate([faces, m + edge], axis=1)
        along = self.vertices[self.edges[:, 1]] - self.vertices[self.edges[:, 0]]
        along /= np.linalg.norm(along, axis=1)[:, None]
        # From an edge, the face continues at right angles to it; from a corner, along its edges.
        opposite = c[:, [2, 0, 1]] - c
        across = opposite - (opposite * along[edge]).sum(axis=2)[:, :, None] * along[edge]
        across /= np.linalg.norm(across, axis=2)[:, :, None]
        wings = (
            np.concatenate([m + edge.ravel(), self.edges[:, 0], self.edges[:, 1]]),
            np.concatenate([across.reshape(-1, 3), along, -along]),
        )
        # The sum of normals weighted by angles distinguishes inside from outside at a corner (Baerentzen and Aanaes 2005).
        sides = c[:, [1, 2, 0]] - c
        sides /= np.linalg.norm(sides, axis=2)[:, :, None]
        angle = np.arccos(np.clip(-(sides * sides[:, [2, 0, 1]]).sum(axis=2), -1, 1))
        facing = np.zeros((m + len(self.edges), 3))
        np.add.at(facing, faces, angle[:, :, None] * normal[:, None])
        np.add.at(facing, m + edge, np.repeat(normal[:, None], 3, axis=1))
        self.creases = np.linalg.norm(facing[m:], axis=1) < 2 * np.sqrt((1 + FLAT) / 2)
        size = np.linalg.norm(facing, axis=1)
        weak = np.flatnonzero(size[features].ravel() < 1e-9)
        facing[features.ravel()[weak]] = np.repeat(normal, 6, axis=0)[weak]  # faces back to back: either normal will do
        facing /= np.maximum(np.linalg.norm(facing, axis=1), 1e-9)[:, None]
        return Facets(c, features, wings, facing, self.closed, self.inside)

    def outline(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the edges where the mesh bends."""
        return self.placed(self.vertices[self.edges[self.creases]]), self.radius

    def solid(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the faces, unless the scene is inside of the mesh."""
        return Collider.solid(self, low, high) if self.inside else (self.placed(self.vertices), np.asarray(self.faces))


def _inwards(corners: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return which faces, corners (k, 3, 3), are in parts whose normals point inwards.

    part: (k,), the connected part of each face. A part inside of another one counts as that one does: it may be a cavity.
    """
    solids = np.split(corners[np.argsort(part, kind="stable")], np.cumsum(np.bincount(part))[:-1])
    boxes = np.array([[c.min(axis=(0, 1)), c.max(axis=(0, 1))] for c in solids])
    volume = np.array([_volume(c) for c in solids])
    outer = np.arange(len(solids))
    for k, (low, high) in enumerate(boxes):
        around = np.flatnonzero((boxes[:, 0] < low).all(axis=1) & (boxes[:, 1] > high).all(axis=1))
        around = [m for m in around if abs(_winding(solids[k][0, 0], solids[m])) > 0.5]
        outer[k] = max(around, key=lambda m: abs(volume[m]), default=k)
    return (volume < 0)[outer][part]


def _volume(corners: np.ndarray) -> float:
    """Return the volume that faces, corners (k, 3, 3), enclose [m^3], negative if their normals point inwards."""
    c = corners - corners.mean(axis=(0, 1))
    volume = float(np.einsum("ij,ij->i", c[:, 0], np.cross(c[:, 1], c[:, 2])).sum()) / 6
    if abs(volume) <= 1e-12 * np.abs(c).max() ** 3:
        raise ValueError(f"Mesh: faces enclose a volume of {volume:g} m^3; closed = False makes a sheet of them.")
    return volume


def _winding(point: np.ndarray, corners: np.ndarray) -> float:
    """Return how often faces, corners (k, 3, 3), go around a point: the sum of solid angles (van Oosterom and Strackee 1983)."""
    r = corners - point
    a, b, c = r.transpose(1, 0, 2)
    p, q, s = np.linalg.norm(r, axis=2).T
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    return float(np.arctan2(triple, p * q * s + ab * s + bc * p + ca * q).sum()) / (2 * np.pi)
