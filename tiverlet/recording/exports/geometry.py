"""The geometry of a recording for other programs: faces, links, and single particles."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...geometry.common_sense import common_sense, edges_of
from ...geometry.intervals import cross_2d
from ...shapes import Shape
from ..drawing import links, upwards
from ..hues import BY_BODY, Coloring
from ..scene import Parts
from ..surfaces import covered, triangles


@dataclass(frozen=True)
class Geometry:
    """The surface of a scene, and everything that is not part of a surface.

    faces: particles around each face, in the same sense all over a surface. uv: the texture coordinates of each face's corners,
    (corners, 2), or (0, 2) without any. links: links outside surfaces, (m, 2). loose: particles without any face or link. bare:
    particles with a radius that no surface hides. hues: colours of particles, (n, 3). up: the direction against gravity, (dim,).
    """

    faces: tuple[np.ndarray, ...]
    uv: tuple[np.ndarray, ...]
    links: np.ndarray
    loose: np.ndarray
    bare: np.ndarray
    hues: np.ndarray
    up: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """The triangles of all faces, (t, 3), as indices into `around`; each face is a fan."""
        size = np.array([len(face) for face in self.faces], dtype=np.int64)
        if (size == 3).all():
            return np.arange(3 * len(size)).reshape(-1, 3)
        begin = np.cumsum(size) - size
        fans = [(b, b + k, b + k + 1) for b, n in zip(begin.tolist(), size.tolist(), strict=True) for k in range(1, n - 1)]
        return np.array(fans, dtype=np.int64).reshape(-1, 3)

    @property
    def texture(self) -> np.ndarray:
        """The texture coordinates of the corners of all faces, (corners, 2), 0 where a face has none; (0, 2) if no face has."""
        if not any(len(uv) for uv in self.uv):
            return np.zeros((0, 2))
        pairs = zip(self.faces, self.uv, strict=True)
        return np.concatenate([uv if len(uv) else np.zeros((len(face), 2)) for face, uv in pairs])

    @property
    def around(self) -> np.ndarray:
        """The particles of all faces, one face after the other."""
        return np.concatenate([np.zeros(0, dtype=np.int64), *self.faces])


def geometry(parts: Parts, shape: Shape | None = None, coloring: Coloring = BY_BODY) -> Geometry:
    """Return the geometry of a scene. shape: provides faces and texture coordinates for the same particles.

    Raises ValueError for a shape with another number of points.
    """
    particles = parts.particles
    if shape is not None and len(shape) != len(particles):
        raise ValueError(
            f"replay: shape has {len(shape)} points, but the recording has {len(particles)} particles. Give the one that they "
            "were made of; tv.shapes.join(...) makes one of several."
        )
    up = upwards(parts)
    if shape is None:
        every = triangles(parts)
        _, first = np.unique(np.sort(every, axis=1), axis=0, return_index=True)  # some are there several times
        found = oriented(every[np.sort(first)], particles.position, up)
        faces, uv = tuple(found), (np.zeros((0, 2)),) * len(found)
    else:
        faces, uv = shape.surface
        found = np.concatenate([np.zeros(0, dtype=np.int64), *faces])
    within = covered(parts, found)
    bare = np.flatnonzero((particles.radius > 0) & ~within)
    none = np.zeros(0, dtype=np.int64)
    return without_broken(Geometry(faces, uv, none.reshape(0, 2), none, bare, coloring.colors(parts), up), parts, {})


def without_broken(of: Geometry, parts: Parts, broken: Mapping[int, np.ndarray]) -> Geometry:
    """Return a geometry with the links that are not broken. broken: numbers of broken constraints, by the feature's number.

    Links that may break are not sides of faces, so that the faces stay.
    """
    every = np.arange(len(parts.particles))
    hidden = np.isin(every, of.around)
    left = [f.indices[~np.isin(np.arange(f.count), broken.get(parts.numbers[k], []))] for k, f in links(parts)]
    pairs = np.concatenate([np.zeros((0, 2), dtype=np.int64), *left])
    pairs = np.unique(np.sort(pairs[~hidden[pairs].all(axis=1)], axis=1), axis=0)
    return replace(of, links=pairs, loose=np.flatnonzero(~hidden & ~np.isin(every, pairs)))


def oriented(faces: np.ndarray, x: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return triangles with a consistent orientation: of two that share an edge, both have the same sense.

    In 2D, and from outside a closed surface, they are counterclockwise. An open surface has most of its normals upwards.
    """
    if x.shape[1] == 2:
        a, b, c = (x[k] for k in faces.T)
        return np.where(cross_2d(b - a, c - a)[:, None] < 0, faces[:, ::-1], faces)
    _, which, number = edges_of(faces)
    turned, pieces, _ = common_sense(faces)
    out = np.where(turned[:, None], faces[:, ::-1], faces)
    for piece in np.split(np.argsort(pieces, kind="stable"), np.cumsum(np.bincount(pieces))[:-1]) if len(faces) else []:
        closed = (number[which[piece]] == 2).all()  # it has no edge that is not shared by two triangles
        a, b, c = (x[k] - x[faces[piece[0], 0]] for k in out[piece].T)
        normal = np.cross(b - a, c - a)
        if float((a * normal).sum() if closed else (normal @ up).sum()) < 0:
            out[piece] = out[piece][:, ::-1]
    return out


def turn(up: np.ndarray) -> list[float]:
    """Return the quaternion that rotates the axis nearest to `up` to y."""
    axis = int(np.argmax(np.abs(up)))
    sign, half = np.sign(up[axis]), float(np.sqrt(0.5))
    if axis == 1:
        return [0.0, 0.0, 0.0, 1.0] if sign > 0 else [1.0, 0.0, 0.0, 0.0]
    return [0.0, 0.0, sign * half, half] if axis == 0 else [-sign * half, 0.0, 0.0, half]


def flat(x: np.ndarray) -> np.ndarray:
    """Return vectors (..., dim) in 3D; a 2D scene lies at z = 0."""
    return np.pad(x, [*[(0, 0)] * (x.ndim - 1), (0, 3 - x.shape[-1])])


def linear(hue: np.ndarray) -> np.ndarray:
    """Convert sRGB in 0 ... 255 to linear light in 0 ... 1, as glTF and USD store colours."""
    share = hue / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
