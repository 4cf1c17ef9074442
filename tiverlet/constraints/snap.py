"""A tidy grid."""

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import ti
from ..features.feature import Scene
from ..particles import Particles
from .core.anchored import Anchored


class Snap(Anchored):
    """Particles drawn to the nearest node of a grid, as by a spring.

    C(x) = x - node(x_n), the node nearest to the particle at the start of the substep; unit gradients. The energy
    |C|^2 / (2 compliance) is continuous where the node changes, half way between two.

    indices: (m,) particles. spacing: of the grid, number or (dim,) [m], above 0; inf leaves an axis free.
    origin: one of the nodes, number or (dim,) [m].
    compliance: number or (m,) [m/N], above 0: a rigid grid would be a Pin. damping: number or (m,) [N s/m].

    `load` is the force on each particle [N].
    """

    def __init__(self, indices, spacing, origin: ArrayLike = 0.0, *, compliance: ArrayLike, damping: ArrayLike = 0.0):
        self.setup(indices, compliance, damping)
        self.spacing, self.origin = spacing, origin

    def _compliance(self, value) -> np.ndarray:
        value = super()._compliance(value)
        if (value == 0).any():
            i = int(np.argmin(value))
            raise ValueError(f"Snap: compliance[{i}] = 0, but a rigid grid leaves nothing free; use Pin, or a small compliance.")
        return value

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Settle the grid."""
        super().prepare(particles, inv_mass)
        dim = particles.dim
        self._spacing = checks.per_item("Snap", "spacing", self.spacing, dim, infinite=True, above=0.0)
        self._origin = checks.per_item("Snap", "origin", self.origin, dim)

    def node(self, position: np.ndarray) -> np.ndarray:
        """The nodes nearest to positions (m, dim)."""
        free = np.isinf(self._spacing)
        step = np.where(free, 1.0, self._spacing)
        return np.where(free, position, self._origin + np.floor((position - self._origin) / step + 0.5) * step)

    def start_offset(self, position: np.ndarray) -> np.ndarray:
        """C at the start."""
        x = position[self.indices[:, 0]]
        return x - self.node(x)

    def bind(self, scene: Scene) -> None:
        """The node of each particle."""
        super().bind(scene)
        dim, free = scene.particles.dim, np.isinf(self._spacing)
        add, x = scene.memory.field, self.start.position[self.indices[:, 0]]
        self.dev.grid = add("Snap.grid", 2, width=dim, values=[self._origin, np.where(free, 0.0, self._spacing)])
        self.dev.node = add("Snap.node", self.count, width=dim, values=self.node(x), state=True)
        self.changed = False

    @ti.func
    def nearest(self, x):
        """The node nearest to x; x itself along axes that are free."""
        node = x
        for k in ti.static(range(self.dev.state.dim)):
            step, zero = self.dev.grid[1][k], self.dev.grid[0][k]
            if step > 0:
                node[k] = zero + ti.floor((x[k] - zero) / step + 0.5) * step
        return node

    @ti.func
    def offsets(self, c, frame_fraction, first, fresh):
        """x - node; what is remembered of the substep before is put in terms of the same node."""
        i = self.member(c, 0)
        x, start = self.dev.state.place(i), self.dev.state.place(i) - self.dev.state.d[i]
        if first != 0:
            node = self.nearest(start)
            self.dev.spring.last[c] = self.dev.spring.last[c] + (self.dev.node[c] - node)
            for k in ti.static(range(self.dev.state.dim)):
                if self.dev.grid[1][k] == 0:
                    self.dev.spring.last[c][k] = 0
            self.dev.node[c] = node
        node = self.dev.node[c]
        C = x - node
        for k in ti.static(range(self.dev.state.dim)):
            if self.dev.grid[1][k] == 0:
                C[k] = 0
        return C, start - node

    @ti.func
    def offset_now(self, c, back):
        """x - node."""
        i = self.member(c, 0)
        x = self.dev.state.place(i) - back * self.dev.state.d[i]
        return x - self.nearest(x)
