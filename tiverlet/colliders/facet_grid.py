"""Grid of the facets of a fixed shape: cells that list the facets near them, built once in NumPy, of any length."""

import numpy as np

from ..geometry.places import places_between

CELLS = 1024  # cell budget of a small shape; larger shapes have 8 cells for each facet
ENTRIES = 256  # of lists for each facet, at most; beyond, cells are made larger


class FacetGrid:
    """Cells around facets, corners (m, k, dim) [m], which may be touched from `most_distance` [m] away.

    Every facet closer than `reach` to a cell is in the list of that cell: list[begin[b] : begin[b + 1]] with b = bucket[cell],
    axis 0 fastest. Cells that are further away have b = -1 - rings instead, with `rings` cells and reach between them and any
    facet. Cells deep inside a closed shape have the last b, whose list holds all facets.
    """

    def __init__(self, corners: np.ndarray, most_distance: float, closed: bool):
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        m, _, dim = corners.shape
        extent = float((high - low).max())
        self.cell = max(most_distance / 3, extent / max(CELLS, 8 * m) ** (1 / dim))
        while True:
            self.reach = (most_distance + self.cell / 2) * (1 + 1e-3)
            self.shape = np.ceil((high - low + 2 * self.reach) / self.cell).astype(int)
            span = ((np.ptp(corners, axis=1) + 2 * self.reach) / self.cell + 1).prod(axis=1)
            if self.shape.prod() <= 8 * max(CELLS, 8 * m) and span.sum() <= ENTRIES * max(CELLS, m):
                break
            self.cell *= 1.2
        self.origin = low - self.reach
        facet, cell = self._pairs(corners)
        order = np.argsort(cell, kind="stable")  # stable: facets stay in order
        facet, cell = facet[order], cell[order]
        used, counts = np.unique(cell, return_counts=True)
        bucket = np.full(int(self.shape.prod()), -1)
        bucket[used] = np.arange(len(used))
        near = bucket >= 0
        bucket[~near] = -1 - self._rings(near)[~near]
        if closed:
            inside = self._winding(corners) > 0
            bucket[inside & ~near] = len(used)
        self.bucket = bucket
        self.begin = np.concatenate([[0], np.cumsum(counts), [len(facet) + m]])
        self.list = np.concatenate([facet, np.arange(m)])

    def _pairs(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of facets and cells within reach, or slightly more: by the facet's box, then by its plane."""
        first = np.floor((corners.min(axis=1) - self.reach - self.origin) / self.cell).astype(int)
        last = np.floor((corners.max(axis=1) + self.reach - self.origin) / self.cell).astype(int)
        first, last = np.clip(first, 0, self.shape - 1), np.clip(last, 0, self.shape - 1)
        edges = np.diff(corners, axis=1)
        flat = corners.shape[2] == 2
        normal = np.stack([edges[:, 0, 1], -edges[:, 0, 0]], axis=1) if flat else np.cross(edges[:, 0], edges[:, 1])
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        box = corners.min(axis=1), corners.max(axis=1)
        facets, cells = [], []
        for facet, at in places_between(first, last):
            middle = self.origin + (at + 0.5) * self.cell
            off = np.abs(((middle - corners[facet, 0]) * normal[facet]).sum(axis=1))
            half = self.cell / 2 * np.abs(normal).sum(axis=1)[facet]
            some = off <= (self.reach + half) * (1 + 1e-9)
            gap = np.maximum(np.maximum(box[0][facet] - middle, middle - box[1][facet]) - self.cell / 2, 0)
            some &= (gap**2).sum(axis=1) <= (self.reach * (1 + 1e-9)) ** 2
            facets.append(facet[some])
            cells.append(self._flat(at[some]))
        return np.concatenate(facets), np.concatenate(cells)

    def _flat(self, at: np.ndarray) -> np.ndarray:
        return at @ np.concatenate([[1], np.cumprod(self.shape)[:-1]])

    def _rings(self, near: np.ndarray) -> np.ndarray:
        """Return the number of cells between each cell and the nearest one that has a list, along the axis with most."""
        grid = near.reshape(self.shape[::-1])
        rings = np.where(grid, -1, 0)
        reached, k = grid, 0
        while not reached.all():
            grown = np.pad(reached, 1)
            for axis in range(grown.ndim):
                ahead, behind = np.roll(grown, 1, axis), np.roll(grown, -1, axis)
                grown = grown | ahead | behind
            grown = grown[tuple(slice(1, -1) for _ in self.shape)]
            rings[grown & ~reached] = k
            reached, k = grown, k + 1
        return rings.ravel()

    def _winding(self, corners: np.ndarray) -> np.ndarray:
        """Return the winding number of the facets around the middle of each cell: signed crossings of a ray towards -x."""
        _, arity, dim = corners.shape
        # Middles are shifted slightly off the cell pattern, so that no ray meets a corner or an edge.
        shift = self.cell * np.array([0.0, 0.0137, 0.0091][:dim])
        local = (corners - self.origin - shift) / self.cell - 0.5  # in cells, from the middle of cell 0
        first = np.maximum(np.ceil(local[..., 1:].min(axis=1)).astype(int), 0)
        last = np.minimum(np.floor(local[..., 1:].max(axis=1)).astype(int), self.shape[1:] - 1)
        facet, ray = (np.concatenate(some) for some in zip(*places_between(first, last), strict=True))
        c = local[facet]
        if dim == 2:
            weight = (ray[:, 0] - c[:, 0, 1]) / (c[:, 1, 1] - c[:, 0, 1])
            x, sign = c[:, 0, 0] + weight * (c[:, 1, 0] - c[:, 0, 0]), np.sign(c[:, 0, 1] - c[:, 1, 1])
        else:
            u, v, r = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0], ray - c[:, 0, 1:]
            area = u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1]
            area = np.where(area == 0, np.inf, area)
            s, t = (r[:, 0] * v[:, 2] - r[:, 1] * v[:, 1]) / area, (u[:, 1] * r[:, 1] - u[:, 2] * r[:, 0]) / area
            hit = np.isfinite(area) & (s >= 0) & (t >= 0) & (s + t <= 1)
            x, sign = c[:, 0, 0] + s * u[:, 0] + t * v[:, 0], np.where(hit, -np.sign(area), 0.0)
        change = np.zeros((*(self.shape[::-1][:-1]), self.shape[0] + 1), dtype=int)
        at = np.clip(np.floor(x).astype(int) + 1, 0, self.shape[0])
        np.add.at(change, (*(ray[:, k] for k in range(dim - 2, -1, -1)), at), sign.astype(int))
        return np.cumsum(change[..., :-1], axis=-1).ravel()
