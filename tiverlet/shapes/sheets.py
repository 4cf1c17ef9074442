"""Sheets: bodies of two dimensions, flat at the start."""

import numpy as np

from .. import checks
from .shape import Shape, point, quads_of


@checks.answer_arguments
def cloth(corner, along, across, points: tuple[int, int], *, shear: bool = True, bend: bool = True) -> Shape:
    """Make a sheet of points[0] x points[1] particles from `corner`, spanned by vectors `along` and `across` [m], in 2D or 3D.

    links: to the neighbours. braces: the diagonals (shear), and links over two edges (bend). faces: two triangles per cell, with
    their quads in 3D. bends: the corners along rows and columns. Particle (i, j) has the number i points[1] + j.
    """
    base = point("cloth", "corner", corner)
    u, v = (checks.vector("cloth", name, value, len(base)) for name, value in (("along", along), ("across", across)))
    if np.shape(points) != (2,):
        hint = f": ({points}, {points})" if np.ndim(points) == 0 else ""
        raise ValueError(f"cloth: points = {points!r}, but two numbers are needed, along and across{hint}.")
    rows, columns = (checks.integer("cloth", f"points[{k}]", n, least=2) for k, n in enumerate(points))
    area = u @ u * (v @ v) - (u @ v) ** 2
    if not area > 1e-12 * (u @ u) * (v @ v):
        raise ValueError("cloth: along and across span no area; they must not be parallel or 0.")
    i, j = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    position = base + i.reshape(-1, 1) * u + j.reshape(-1, 1) * v
    k = np.arange(rows * columns).reshape(rows, columns)

    def tuples(*parts):
        """Stack arrays of corners to rows, one row per constraint."""
        return np.stack([p.ravel() for p in parts], axis=1)

    links = np.concatenate([tuples(k[:-1], k[1:]), tuples(k[:, :-1], k[:, 1:])])
    braces = [np.zeros((0, 2), dtype=np.int64)]
    if shear:
        braces += [tuples(k[:-1, :-1], k[1:, 1:]), tuples(k[1:, :-1], k[:-1, 1:])]
    if bend:
        braces += [tuples(k[:-2], k[2:]), tuples(k[:, :-2], k[:, 2:])]
    faces = np.concatenate([tuples(k[:-1, :-1], k[1:, :-1], k[1:, 1:]), tuples(k[:-1, :-1], k[1:, 1:], k[:-1, 1:])])
    bends = np.concatenate([tuples(k[:-2], k[1:-1], k[2:]), tuples(k[:, :-2], k[:, 1:-1], k[:, 2:])])
    if len(base) == 2 and u[0] * v[1] < u[1] * v[0]:
        faces = faces[:, ::-1]
    quads = quads_of(faces) if len(base) == 3 else np.zeros((0, 4), dtype=np.int64)
    return Shape(position, links, np.concatenate(braces), bends, faces=faces, quads=quads)


@checks.answer_arguments
def net(corner, along, across, points: tuple[int, int]) -> Shape:
    """Make a sheet as cloth() does, with only the links between neighbours."""
    sheet = cloth(corner, along, across, points, shear=False, bend=False)
    return Shape(sheet.position, sheet.links)
