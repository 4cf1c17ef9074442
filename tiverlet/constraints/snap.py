"""Particles drawn to a regular grid."""

import numpy as np

from .. import checks
from ..checks import ArrayLike
from ..device import ti
from ..features.feature import Feature, Scene
from ..particles import Particles
from .core.anchor_passes import AnchorPasses, Place
from .core.anchored import Anchored


class Nodes(Place):
    """The node of a grid for each particle.

    grid: the position of one node, and the spacing, 0 along free axes. node: the initial node of each particle, (m, dim).
    """

    def __init__(self, scene: Scene, passes: AnchorPasses, grid: list[np.ndarray], node: np.ndarray):
        add, (m, dim) = scene.memory.field, node.shape
        self.name, self.state, self.corners, self.spring = passes.name, scene.state, passes.corners, passes.spring
        self.grid = add("Snap.grid", 2, width=dim, values=grid)
        self.node = add("Snap.node", m, width=dim, values=node, state=True)
        self.in_state = {"node": self.node}

    @ti.func
    def nearest(self, x):
        """Return the node nearest to x; x itself along free axes."""
        node = x
        for k in ti.static(range(self.state.dim)):
            step, zero = self.grid[1][k], self.grid[0][k]
            if step > 0:
                node[k] = zero + ti.floor((x[k] - zero) / step + 0.5) * step
        return node

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """Return x - node, now and at the start. The first pass takes the new node, and refers the remembered C to it."""
        i = self.corners.member(c, 0)
        x, start = self.state.place(i), self.state.place(i) - self.state.d[i]
        if first != 0:
            node = self.nearest(start)
            self.spring.last[c] = self.spring.last[c] + (self.node[c] - node)
            for k in ti.static(range(self.state.dim)):
                if self.grid[1][k] == 0:
                    self.spring.last[c][k] = 0
            self.node[c] = node
        node = self.node[c]
        C = x - node
        for k in ti.static(range(self.state.dim)):
            if self.grid[1][k] == 0:
                C[k] = 0
        return C, start - node

    @ti.func
    def offset_now(self, c, back):
        """Return x - node, with the node nearest to x."""
        i = self.corners.member(c, 0)
        x = self.state.place(i) - back * self.state.d[i]
        return x - self.nearest(x)


class Snap(Anchored):
    """Particles drawn to the nearest node of a grid by springs.

    C(x) = x - node(x_n), the node nearest to the particle at the start of the substep; unit gradients. The energy
    |C|^2 / (2 compliance) is continuous where the node changes, half way between two nodes.

    indices: (m,) particles. spacing: of the grid, number or (dim,) [m], above 0; inf leaves an axis free.
    origin: one of the nodes, number or (dim,) [m].
    compliance: number or (m,) [m/N], above 0: a rigid grid would be a Pin. damping: number or (m,) [N s/m].

    `load` is the force on each particle [N].
    """

    host_only = ("_origin", "_spacing")

    is_fixed_in_space = True
    can_extend = True

    def __init__(self, indices, spacing, origin: ArrayLike = 0.0, *, compliance: ArrayLike, damping: ArrayLike = 0.0):
        self.setup(indices, compliance, damping)
        self.spacing, self.origin = spacing, origin

    def _compliance(self, value) -> np.ndarray:
        value = super()._compliance(value)
        if (value == 0).any():
            i = int(np.argmin(value))
            raise ValueError(f"Snap: compliance[{i}] = 0, but a rigid grid leaves nothing free; use Pin, or a small compliance.")
        return value

    def check_extension(self, more: Feature) -> None:
        """Raise TypeError unless `more` has the same grid."""
        super().check_extension(more)
        for name in ("spacing", "origin"):
            mine, other = getattr(self, name), getattr(more, name)
            if np.shape(mine) != np.shape(other) or np.any(np.asarray(mine) != other):
                raise TypeError(
                    f"World.add: extend: a Snap of {name} = {mine!r} cannot take one of {name} = {other!r}. Add it to features."
                )

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Check the indices, and expand spacing and origin to one number per axis."""
        super().prepare(particles, inv_mass)
        dim = particles.dim
        self._spacing = checks.per_item("Snap", "spacing", self.spacing, dim, infinite=True, above=0.0)
        self._origin = checks.per_item("Snap", "origin", self.origin, dim)

    def node(self, position: np.ndarray) -> np.ndarray:
        """Return the nodes nearest to positions (m, dim)."""
        free = np.isinf(self._spacing)
        step = np.where(free, 1.0, self._spacing)
        return np.where(free, position, self._origin + np.floor((position - self._origin) / step + 0.5) * step)

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """Return C at the start, (m, dim)."""
        return self.offset(position)

    def offset(self, position: np.ndarray) -> np.ndarray:
        """Return x - node, (m, dim); 0 along free axes."""
        x = position[self.indices[:, 0]]
        return x - self.node(x)

    def place_of(self, scene: Scene, passes: AnchorPasses) -> "Nodes":
        """Make the nodes of the particles, on the device."""
        free = np.isinf(self._spacing)
        x = self.start.position[self.indices[:, 0]]
        return Nodes(scene, passes, [self._origin, np.where(free, 0.0, self._spacing)], self.node(x))
