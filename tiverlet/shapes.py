"""Ready-made bodies as plain arrays: positions to put into Particles, and index tuples to put into constraints."""

from dataclasses import dataclass

import numpy as np

from . import checks


@dataclass(frozen=True)
class Shape:
    """position: (n, dim) [m]. links: (m, 2) indices into it."""

    position: np.ndarray
    links: np.ndarray

    def __len__(self) -> int:
        return len(self.position)


def rope(start, end, points: int) -> Shape:
    """`points` particles in a straight line from `start` to `end` [m], both included, each linked to the next."""
    checks.integer("rope", "points", points, least=2)
    start = np.asarray(start, dtype=np.float64)
    ends = checks.points("rope", "start, end", [start, checks.vector("rope", "end", end, start.size)])
    amount = np.linspace(0.0, 1.0, points)[:, None]
    i = np.arange(points - 1)
    return Shape(ends[0] * (1 - amount) + ends[1] * amount, np.stack([i, i + 1], axis=1))


def join(*shapes: Shape) -> tuple[Shape, list[slice]]:
    """One shape of several, and where the particles of each are in it."""
    starts = np.cumsum([0, *(len(s) for s in shapes)])
    position = np.concatenate([s.position for s in shapes])
    links = np.concatenate([s.links + k for s, k in zip(shapes, starts[:-1], strict=True)])
    return Shape(position, links), [slice(int(a), int(b)) for a, b in zip(starts[:-1], starts[1:], strict=True)]
