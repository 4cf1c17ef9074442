"""Bodies of every kind of constraint, far from satisfying it: random positions, rest values up to 10 times wrong."""

from dataclasses import dataclass, field

import numpy as np

import tiverlet as tv

OCTAHEDRON = [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
HINGE, SIDES = [[0, 1, 2, 3]], [[0, 1], [0, 2], [1, 2], [0, 3], [1, 3]]


def chain(k: int, n: int = 5) -> list[list[int]]:
    """Return every k consecutive particles of a chain of n."""
    return [[*range(c, c + k)] for c in range(n - k + 1)]


BOTH = {  # number of particles, and constraints; names that end with ! take their rest values from the start
    "links": (5, {"Distance": chain(2)}),
    "net": (5, {"Distance": [[a, b] for b in range(5) for a in range(b) if b - a < 4]}),
    "ropes": (5, {"Rope": chain(2)}),
    "spacers": (5, {"Spacer": chain(2)}),
    "angles": (5, {"Bend": chain(3)}),
    "rods": (5, {"Bend": chain(3), "Distance!": chain(2)}),
    "limits": (5, {"AngleLimit": chain(3)}),
    "limbs": (5, {"AngleLimit": chain(3), "Distance!": chain(2)}),
    "triangles": (4, {"Area": chain(3, 4)}),
    "cluster": (5, {"ShapeMatch": chain(5)}),
}
SOLID = {
    "hinge": (4, {"Dihedral": HINGE}),
    "hinged": (4, {"Dihedral": HINGE, "Distance!": SIDES}),
    "tetrahedron": (4, {"Volume": chain(4, 4)}),
    "surface": (6, {"Volume ": OCTAHEDRON}),
}
BODIES = {2: BOTH | {"loop": (6, {"Area ": chain(6, 6)})}, 3: BOTH | SOLID}


@dataclass
class BadStart:
    """Two bodies of each kind, pinned at both ends, 100 m apart. All rest angles of every other body are 0.

    position: (particles, dim) [m]; size: (bodies,) [m], at least the extent of the start and of the rest values.
    """

    dim: int
    position: np.ndarray = field(init=False)
    features: list = field(default_factory=list)

    def __post_init__(self):
        rng = np.random.default_rng(1)
        kinds = [kind for kind in BODIES[self.dim].values() for _ in range(2)]
        count = np.array([n for n, _ in kinds])
        begin = np.cumsum(count) - count
        self.body, self.pinned = np.repeat(np.arange(len(kinds)), count), np.concatenate([begin, begin + count - 1])
        x = rng.uniform(0, 1, (len(self.body), self.dim))
        self.position = x + 100.0 * self.body[:, None] * np.eye(self.dim)[0]
        self.size, shape, made = np.full(len(kinds), 1.5), self.position.copy(), {}
        for k, (_, parts) in enumerate(kinds):
            for name, corners in parts.items():
                corners = np.array(corners) + begin[k]
                m, factor = 1 if name == "Volume " else len(corners), 10.0 ** rng.uniform(-1, 1, len(corners))
                if name in ("Bend", "AngleLimit", "Dihedral"):
                    least = 0.0 if self.dim == 3 and name != "Dihedral" else -2.5
                    rest = rng.uniform(least, 2.5, m) * (k % 2)
                elif name.startswith(("Area", "Volume")):
                    rest = 0.2 * factor[:m]
                    self.size[k] += 6 * rest.sum() ** (1 / 2 if name.startswith("Area") else 1 / 3)
                elif name == "ShapeMatch":
                    rest = factor
                    shape[corners[0]] = factor * rng.uniform(0, 1, (count[k], self.dim))
                    self.size[k] += 2 * factor[0]
                else:
                    rest = np.linalg.norm(x[corners[:, 0]] - x[corners[:, 1]], axis=1) * (1 if name.endswith("!") else factor)
                    self.size[k] += rest.sum()
                indices, values = made.setdefault(name.strip("!"), ([], []))
                indices += corners.tolist()
                values.append(rest)
        for name, (indices, values) in made.items():
            make, rest = getattr(tv, name.strip()), np.concatenate(values)
            if name == "AngleLimit":
                self.features.append(make(indices, rest, rest + 0.6))
            else:
                self.features.append(make(indices, shape if name == "ShapeMatch" else rest))

    def far(self, position: np.ndarray) -> np.ndarray:
        """Return how far any particle of each body is from its start, relative to the size of the body, (bodies,)."""
        moved = np.linalg.norm(position - self.position, axis=1)
        return (
            np.maximum.reduceat(np.where(np.isfinite(moved), moved, np.inf), np.flatnonzero(np.diff(self.body, prepend=-1)))
            / self.size
        )
