"""Bodies that fill an area or a volume, and rims and shells around one."""

from itertools import permutations

import numpy as np

from .. import checks
from ..tools import golden
from .shape import Shape, edges_of, point, quads_of, rims_of, single_edges, surface_of

SHAKE = 1e-7  # of the size of a body: far above rounding, far below any triangle
FLAT = 8 * SHAKE  # of it: triangles that are lower are points on a line


@checks.answer_arguments
def polygon(center, radius: float, sides: int) -> Shape:
    """Make a regular polygon of `sides` particles around `center` in 2D: a rim with its loop."""
    middle = checks.vector("polygon", "center", center, 2)
    radius = checks.number("polygon", "radius", radius, above=0.0)
    k = np.arange(checks.integer("polygon", "sides", sides, least=3))
    angle = 2 * np.pi * k / sides
    links = np.stack([k, (k + 1) % sides], axis=1)
    bends = np.stack([(k - 1) % sides, k, (k + 1) % sides], axis=1)
    return Shape(middle + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1), links, bends=bends, loops=(k,))


@checks.answer_arguments
def ball(center, radius: float, rings: int = 3) -> Shape:
    """Make a filled round body in 2D or 3D: a lattice with `rings` shells, which are bent into circles or spheres.

    2D: triangles in faces, and the rim in loops. 3D: tetrahedra, and the surface in faces. links: all edges.
    """
    middle = point("ball", "center", center)
    radius = checks.number("ball", "radius", radius, above=0.0)
    checks.integer("ball", "rings", rings, least=1)
    if len(middle) == 2:
        position, triangles = _disc(rings)
        return Shape(middle + radius * position, edges_of(triangles), faces=triangles, loops=rims_of(triangles))
    grid, cells = _lattice(np.array([2 * rings] * 3))
    grid = grid - rings
    size = np.abs(grid).max(axis=1)
    length = np.linalg.norm(grid, axis=1)
    position = middle + radius / rings * grid * (size / np.maximum(length, 1))[:, None]
    return _solid(position, cells)


def _disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and triangles of a hexagonal lattice, bent into the unit disc."""
    q, r = (v.ravel() for v in np.meshgrid(*[np.arange(-rings, rings + 1)] * 2, indexing="ij"))
    ring = np.maximum(np.abs(q + r), np.maximum(np.abs(q), np.abs(r)))
    q, r, ring = (v[ring <= rings] for v in (q, r, ring))
    number = {at: k for k, at in enumerate(zip(q.tolist(), r.tolist(), strict=True))}
    triangles = [
        [number[at] for at in corners]
        for a in range(-rings - 1, rings + 1)
        for b in range(-rings - 1, rings + 1)
        for corners in ([(a, b), (a + 1, b), (a, b + 1)], [(a + 1, b), (a + 1, b + 1), (a, b + 1)])
        if all(at in number for at in corners)
    ]
    angle = np.arctan2(r * np.sqrt(0.75), q + r / 2) % (2 * np.pi)
    sector = np.floor(angle / (np.pi / 3) + 1e-9)
    one = np.sin(angle - sector * np.pi / 3)
    along = one / np.maximum(one + np.sin((sector + 1) * np.pi / 3 - angle), 1e-300)
    angle = (sector + np.where(ring > 0, along, 0)) * np.pi / 3
    return (ring / rings)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1), np.array(triangles)


def _lattice(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a grid (from 0 in steps of 1), and its cells cut into simplices.

    The simplices are symmetric about the middle where the numbers of cells are even.
    """
    dim = len(cells)
    points = np.stack([v.ravel() for v in np.meshgrid(*[np.arange(n + 1) for n in cells], indexing="ij")], axis=1)
    corner = np.stack([v.ravel() for v in np.meshgrid(*[np.arange(n) for n in cells], indexing="ij")], axis=1)
    way = np.where(2 * corner + 1 > cells, 1, -1)  # direction away from the middle
    corner = corner + (way < 0)
    stride = np.array([int(np.prod(cells[k + 1 :] + 1)) for k in range(dim)])
    parts = []
    for order in permutations(range(dim)):  # Kuhn: from the corner nearest the middle to the farthest, axis by axis
        at = [corner]
        for axis in order:
            at.append(at[-1] + way * np.eye(dim, dtype=int)[axis])
        parts.append(np.stack([p @ stride for p in at], axis=1))
    return points, np.concatenate(parts)


def _positive(position: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Reorder the corners of simplices so that areas or volumes are positive."""
    edges = position[cells[:, 1:]] - position[cells[:, :1]]
    return np.where(np.linalg.det(edges)[:, None] < 0, np.concatenate([cells[:, 1::-1], cells[:, 2:]], axis=1), cells)


def _solid(position: np.ndarray, cells: np.ndarray) -> Shape:
    cells = _positive(position, cells)
    faces = surface_of(cells)
    return Shape(position, edges_of(cells), faces=faces, quads=quads_of(faces), tetrahedra=cells)


@checks.answer_arguments
def truss(lower, upper, cells) -> Shape:
    """Make a box between two corners [m], with `cells` cells along each axis, in 2D or 3D.

    links: along the axes. braces: the diagonals that cut each cell into triangles (in faces, with the rim in loops) or into
    tetrahedra (with the surface in faces).
    """
    low = point("truss", "lower", lower)
    high = checks.vector("truss", "upper", upper, len(low))
    if np.shape(cells) not in ((), (len(low),)):
        raise ValueError(f"truss: cells = {cells!r}, but one number, or one along each of {len(low)} axes, is needed.")
    counts = np.broadcast_to(np.asarray(cells), (len(low),))
    counts = np.array([checks.integer("truss", f"cells[{k}]", n, least=1) for k, n in enumerate(counts.tolist())])
    if not (high > low).all():
        k = int(np.argmin(high > low))
        raise ValueError(f"truss: upper[{k}] = {high[k]:g}, but it must be above lower[{k}] = {low[k]:g}.")
    grid, simplices = _lattice(counts)
    position = low + grid * (high - low) / counts
    edges = edges_of(simplices)
    straight = (grid[edges[:, 0]] != grid[edges[:, 1]]).sum(axis=1) == 1
    simplices = _positive(position, simplices)
    links, braces = edges[straight], edges[~straight]
    if len(low) == 2:
        return Shape(position, links, braces, faces=simplices, loops=rims_of(simplices))
    faces = surface_of(simplices)
    return Shape(position, links, braces, faces=faces, quads=quads_of(faces), tetrahedra=simplices)


@checks.answer_arguments
def balloon(center, radius: float, level: int = 2) -> Shape:
    """Make a hollow sphere in 3D: an icosahedron with each face cut into four, `level` times.

    faces is a closed surface; quads are for bending.
    """
    middle = checks.vector("balloon", "center", center, 3)
    radius = checks.number("balloon", "radius", radius, above=0.0)
    checks.integer("balloon", "level", level, least=0)
    g = (1 + 5**0.5) / 2
    flat = np.array([[a, b, 0] for a in (-1.0, 1.0) for b in (-g, g)])
    x = np.concatenate([flat, flat[:, [2, 0, 1]], flat[:, [1, 2, 0]]])
    near = np.abs(np.linalg.norm(x[:, None] - x[None], axis=2) - 2) < 1e-9
    faces = np.array(
        [(i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]]
    )
    out = np.einsum("ij,ij->i", x[faces[:, 0]], np.cross(x[faces[:, 1]], x[faces[:, 2]]))
    faces = np.where(out[:, None] < 0, faces[:, ::-1], faces)
    for _ in range(level):
        edges = edges_of(faces)
        halves = {tuple(e): len(x) + k for k, e in enumerate(edges.tolist())}
        x = np.concatenate([x, x[edges].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = (
            np.array([halves[min(p, q), max(p, q)] for p, q in zip(u.tolist(), v.tolist(), strict=True)])
            for u, v in ((a, b), (b, c), (c, a))
        )
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
        x /= np.linalg.norm(x, axis=1, keepdims=True)
    x = middle + radius * x / np.linalg.norm(x, axis=1, keepdims=True)
    return Shape(x, edges_of(faces), faces=faces, quads=quads_of(faces))


@checks.answer_arguments
def blob(outline, spacing: float) -> Shape:
    """Make a body of any outline in 2D, filled with particles about `spacing` [m] apart.

    outline: closed, (k, 2) [m], in either direction. Equal consecutive corners, also the last and the first, count once. The
    inside is sampled by the golden ratio and triangulated (Delaunay). faces: triangles; loops: the rim. Raises ValueError if the
    spacing is too large to follow the outline.
    """
    corners = checks.points("blob", "outline", outline, dim=2)
    spacing = checks.number("blob", "spacing", spacing, above=0.0)
    corners = corners[(corners != np.roll(corners, -1, axis=0)).any(axis=1)]
    if len(corners) < 3:
        raise ValueError(f"blob: an outline of {len(corners)} points encloses nothing; give 3 or more.")
    x, y = corners.T
    area = float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2)
    if area == 0:
        raise ValueError("blob: the outline encloses no area.")
    corners = corners if area > 0 else corners[::-1]
    rim = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, round(float(np.linalg.norm(b - a)) / spacing))
        rim.append(a + (b - a) * np.arange(n)[:, None] / n)
    rim = np.concatenate(rim)
    low, size = corners.min(axis=0), np.ptp(corners, axis=0)
    spots = low + size * golden(np.arange(int(size.prod() / (0.87 * spacing**2)) + 1), dim=2)
    spots = spots[_inside(spots, rim)]
    spots = spots[(np.linalg.norm(spots[:, None] - rim[None], axis=2) > 0.7 * spacing).all(axis=1)]
    position = np.concatenate([rim, spots])
    triangles = _delaunay(position)
    triangles = triangles[_inside(position[triangles].mean(axis=1), rim)]
    loop = np.arange(len(rim))
    want = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
    if not np.array_equal(single_edges(triangles)[1], np.unique(want, axis=0)):
        raise ValueError(f"blob: spacing = {spacing:g} is too large to follow the outline; make it smaller.")
    return Shape(position, edges_of(triangles), faces=triangles, loops=(loop,))


def _inside(points: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Return which points are within a closed outline, by counting crossings."""
    a, b = rim, np.roll(rim, -1, axis=0)
    x, y = points[:, :1], points[:, 1:]
    straddles = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    return ((straddles & (x < a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise)).sum(axis=1) % 2).astype(bool)


def _delaunay(points: np.ndarray) -> np.ndarray:
    """Return triangles with empty circumcircles (Bowyer and Watson 1981), counterclockwise, without flat ones.

    Points on a line or a circle are shaken apart, since rounding would decide about them in one way here and in another there.
    """
    n, middle, size = len(points), points.mean(axis=0), float(np.ptp(points, axis=0).max())
    shaken = points + SHAKE * size * (golden(np.arange(n), dim=2) - 0.5)
    x = np.concatenate([shaken, middle + 1e3 * size * np.array([[-1.0, -1], [1, -1], [0, 1]])])
    triangles = np.array([[n, n + 1, n + 2]])
    for k in range(n):
        a, b, c = (x[triangles[:, j]] - x[k] for j in range(3))
        lengths = [(v * v).sum(axis=1) for v in (a, b, c)]
        inside = (
            lengths[0] * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
            + lengths[1] * (c[:, 0] * a[:, 1] - c[:, 1] * a[:, 0])
            + lengths[2] * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        ) > 0
        rim, _ = single_edges(triangles[inside])
        triangles = np.concatenate([triangles[~inside], np.column_stack([rim, np.full(len(rim), k)])])
    triangles = triangles[(triangles < n).all(axis=1)]
    u, v = x[triangles[:, 1]] - x[triangles[:, 0]], x[triangles[:, 2]] - x[triangles[:, 0]]
    return triangles[u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > FLAT * size * np.maximum(np.hypot(*u.T), np.hypot(*v.T))]


@checks.answer_arguments
def pile(lower, upper, radius) -> Shape:
    """Make loose discs or spheres that fill a box without touching, ready to fall.

    radius: number, or (smallest, largest) for radii spread evenly between by the golden ratio [m].
    """
    low = point("pile", "lower", lower)
    high = checks.vector("pile", "upper", upper, len(low))
    ends = np.atleast_1d(np.asarray(radius, dtype=np.float64))
    if ends.shape not in ((1,), (2,)):
        raise ValueError(f"pile: radius has shape {ends.shape}, but a number, or the smallest and the largest, is needed.")
    small, large = checks.per_item("pile", "radius", ends if len(ends) == 2 else np.repeat(ends, 2), 2, above=0.0)
    if large < small:
        raise ValueError(f"pile: radius = ({small:g}, {large:g}), but the smallest comes first.")
    step = 2.02 * large
    counts = np.floor((high - low) / step).astype(int)
    if (counts < 1).any():
        k = int(np.argmin(counts))
        raise ValueError(
            f"pile: no particle of radius {large:g} fits between lower[{k}] = {low[k]:g} and upper[{k}] = {high[k]:g}."
        )
    grid = np.stack([v.ravel() for v in np.meshgrid(*[np.arange(n) for n in counts], indexing="ij")], axis=1)
    spread = golden(np.arange(len(grid)))
    # A regular lattice would stand: each particle is displaced within the space that its radius leaves free.
    radii = small + (large - small) * spread
    off = (golden(np.arange(len(grid)), dim=len(low)) - 0.5) * (1.01 * large - radii)[:, None]
    return Shape(low + (high - low - step * counts) / 2 + step * (grid + 0.5) + off, radius=radii)
