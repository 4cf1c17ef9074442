"""A number of the places of a few particles: what it is, how it changes with them, and where its corners are."""

import warnings
from typing import Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import Batch, Scene
from ...particles import Particles
from ...tools import distinct


class Number(Batch):
    """f(x) of each constraint of a batch, and its gradients: on the device from `measure`, in NumPy from `rest_of`.

    On the device f is measured at corners relative to the first, now and at the start of the substep, x - d.
    """

    index_name = "pairs"
    exchangeable: tuple[tuple[int, ...], ...] | None = None  # groups of corners that may swap; None: all of them

    def lay(self, indices) -> None:
        """Keep the particles of each constraint."""
        self.indices = checks.indices(repr(self), self.index_name, indices, checks.ANY, arity=self.arity)
        self._warn_duplicates()

    def fit(self, particles: Particles) -> None:
        """Check the particles of each constraint against those that there are."""
        checks.indices(repr(self), self.index_name, self.indices, particles.count, arity=self.arity)

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """f at the given positions, (m,): the rest value when none is given."""
        raise NotImplementedError

    def slopes(self, position: np.ndarray) -> np.ndarray:
        """grad_k f of every constraint, (m, arity, dim), by central differences: each constraint on particles of its own."""
        twin: Any = self.copy()
        vars(twin)["indices"] = np.arange(self.indices.size).reshape(self.indices.shape)
        x = position[self.indices]
        step = 1e-6 * (float(np.ptp(x, axis=1).max(initial=0.0)) or 1.0)
        out = np.zeros_like(x)
        for k in range(self.arity):
            for a in range(x.shape[2]):
                ends = np.stack([x, x])
                ends[:, :, k, a] += [[step], [-step]]
                up, down = (twin.rest_of(end.reshape(-1, x.shape[2])) for end in ends)
                out[:, k, a] = (up - down) / (2 * step)
        return out

    def closeness(self, position: np.ndarray) -> np.ndarray:
        """What makes C a share of the size of its constraint, (m,): 1 / length for links, 0 for what has no extent."""
        x = position[self.indices]
        size = np.linalg.norm(x - x[:, :1], axis=2).max(axis=1, initial=0.0)
        size *= np.sqrt((self.slopes(position) ** 2).sum(axis=(1, 2)) / 2)
        return np.divide(1, size, out=np.zeros(self.count), where=size > 0)

    def _warn_duplicates(self) -> None:
        ordered = self.indices.copy()
        for group in [range(self.arity)] if self.exchangeable is None else self.exchangeable:
            ordered[:, group] = np.sort(ordered[:, group], axis=1)
        unique, _, counts = distinct(ordered)
        if len(unique) < len(ordered):
            first = tuple(int(v) for v in unique[int(np.argmax(counts > 1))])
            warnings.warn(
                f"{self!r}: {len(ordered) - len(unique)} of the {self.index_name} are duplicates, the first of them {first}. "
                "They act together: the same result where rigid, stiffer by their number where compliant.",
                stacklevel=5,
            )

    def bind(self, scene: Scene) -> None:
        """The type of its numbers."""
        super().bind(scene)
        self.dev.real = scene.real

    @ti.func
    def measure(self, c, q):
        """f and its (arity, dim) gradients at corners q (arity, dim), which are relative to corner 0."""
        return 0.0, q

    @ti.func
    def near(self, f, other):
        """Of the values that mean the same as f, the one nearest to `other`; more than one only for angles."""
        return f

    @ti.func
    def excess(self, c, f, rest):
        """f - rest."""
        return f - rest

    @ti.func
    def distinct(self, f, f0):
        """Whether the direction is clear enough at f and f0, now and at the start, for a turn of 41 degrees to mean something."""
        return True

    @ti.func
    def begin(self, c, fresh):
        """Before the first pass of a substep: what `measure` has to remember of its start."""

    @ti.func
    def corners(self, c, back):
        """Corners of constraint c relative to the first, at x - back d: near the origin, so nothing is lost in f32."""
        i = self.member(c, 0)
        q = ti.Matrix.zero(self.dev.real, self.arity, self.dev.state.dim)
        for k in ti.static(range(1, self.arity)):
            j = self.member(c, k)
            r = self.dev.state.apart(j, i) - back * (self.dev.state.d[j] - self.dev.state.d[i])
            for a in ti.static(range(self.dev.state.dim)):
                q[k, a] = r[a]
        return q

    @ti.func
    def ends(self, c):
        """Corners of constraint c, as above, now and at the start of the substep."""
        i = self.member(c, 0)
        now = ti.Matrix.zero(self.dev.real, self.arity, self.dev.state.dim)
        start = now
        for k in ti.static(range(1, self.arity)):
            j = self.member(c, k)
            r, moved = self.dev.state.apart(j, i), self.dev.state.d[j] - self.dev.state.d[i]
            for a in ti.static(range(self.dev.state.dim)):
                now[k, a], start[k, a] = r[a] - 0 * moved[a], r[a] - moved[a]
        return now, start

    @ti.func
    def value(self, c, back):
        """f at x - back d."""
        f, _ = self.measure(c, self.corners(c, back))
        return f
