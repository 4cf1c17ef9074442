"""The baselines of accuracy: the article's scheme and textbook XPBD, on the same scenes, written for speed.

Each is one serial kernel for all substeps of a frame, in f64, without a report.
"""

import math
from collections.abc import Sequence
from struct import Struct
from typing import Any

import numpy as np

from ...constraints import Distance
from ...device import runtime, ti
from ...device.memory import Memory
from ...device.patches.compiler import CachedLaunch
from ...features.feature import Feature
from ...forces import Drag, Gravity
from ...particles import Particles
from ...step.span import integer

KINDS = (Gravity, Drag, Distance)  # supported features
STIFFNESS = 0.5  # share of a violation that the article's scheme corrects per pass
GIVE = Struct("4d").pack_into  # the substep, the factor of drag on velocities, substeps, whether it is a start


@ti.data_oriented
class Baseline:
    """A chain or net of links under gravity, with drag. Replaces a World where errors are measured."""

    name = ""
    soft = False  # whether it supports compliance
    advance: Any  # advances by a frame: (h, exp(-rate h), substeps, fresh)

    def __init__(self, particles: Particles, features: Sequence[Feature]):
        runtime.ensure_started()
        self.particles, self.substeps = particles, 20
        links: Any = [f for f in features if type(f) is Distance]
        for link in links:
            link.prepare(particles, particles.inv_mass)
        self.pairs = np.concatenate([f.indices for f in links] or [np.zeros((0, 2), dtype=int)])
        self.rest, self.alpha = (np.concatenate([getattr(f, k) for f in links] or [[]]) for k in ("rest", "compliance"))
        self.rate = sum(f.rate for f in features if isinstance(f, Drag))
        pulls: Any = [f.g for f in features if isinstance(f, Gravity)]
        down = np.eye(particles.dim)[1]
        self.g = sum((-g * down if np.ndim(g) == 0 else np.asarray(g) for g in pulls), np.zeros(particles.dim))
        self.n, self.m, self.dim = len(particles), len(self.pairs), particles.dim
        self.memory = Memory(ti.f64)
        add = self.memory.field
        self.x, self.v, self.before = (add(k, self.n, width=self.dim) for k in ("position", "velocity", "before"))
        self.w = add("inv_mass", self.n, values=particles.inv_mass)
        self.pair = add("pairs", self.m, width=2, kind=ti.i32, values=self.pairs)
        self.length, self.give = add("rest", self.m, values=self.rest), add("compliance", self.m, values=self.alpha)
        self.pull = add("g", None, width=self.dim, values=self.g)
        self.memory.place()
        self.pull[None] = self.g
        given: Any = np.zeros(4)
        self.given, self.quick = given.data, CachedLaunch(self, "frame", self.memory.compiler, given)
        self.restart()

    @classmethod
    def refuses(cls, features: Sequence[Feature]) -> str:
        """Return why the baseline cannot run a scene; empty if it can."""
        for f in features:
            if type(f) not in KINDS:
                return f"knows no {type(f).__name__}"
            if isinstance(f, Distance) and f.soft and not cls.soft:
                return "its stiffness is no number of newtons per metre"
            if isinstance(f, Distance) and (f.damping > 0).any():
                return "knows no dashpots"
        return ""

    @ti.func
    def relax(self, c, part, give):
        """Correct the share `part` of the violation of link c. give: its compliance / h^2."""
        i, j = self.pair[c][0], self.pair[c][1]
        r = self.x[i] - self.x[j]
        length = r.norm()
        sum = self.w[i] + self.w[j]
        if length > 0 and sum > 0:
            step = part * (self.length[c] - length) / (sum + give) * r / length
            self.x[i] += self.w[i] * step
            self.x[j] -= self.w[j] * step

    @ti.kernel
    def frame(self, given: ti.types.ndarray(ti.f64, 1)):  # type: ignore[valid-type]
        """Advance by a frame with the arguments packed by step()."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.advance(given[0], given[1], integer(given, 2), integer(given, 3))

    def restart(self) -> None:
        """Restore the start."""
        moves = (self.particles.inv_mass > 0)[:, None]
        self.memory.write(self.x, self.particles.position)
        self.memory.write(self.v, self.particles.velocity * moves)
        self.fresh = True

    def step(self, dt: float) -> None:
        """Advance by a frame of dt [s]."""
        mine = vars(self)  # skips Taichi's attribute checks, as in a World
        h = dt / mine["substeps"]
        GIVE(mine["given"], 0, h, math.exp(-mine["rate"] * h), mine["substeps"], mine["fresh"])
        mine["quick"]()
        mine["fresh"] = False

    @property
    def position(self) -> np.ndarray:
        """Positions [m]."""
        return self.memory.read(self.x)[: self.n]

    @property
    def velocity(self) -> np.ndarray:
        """Velocities [m/s]."""
        return self.memory.read(self.v)[: self.n]

    @property
    def energy(self) -> float:
        """Kinetic and potential energy [J]."""
        moves = self.particles.inv_mass > 0
        m, x = np.where(moves, self.particles.mass, 0.0), self.position
        stretch = np.linalg.norm(x[self.pairs[:, 0]] - x[self.pairs[:, 1]], axis=1) - self.rest
        elastic = np.divide(stretch**2, 2 * self.alpha, out=np.zeros(self.m), where=self.alpha > 0)
        return float(0.5 * m @ (self.velocity**2).sum(axis=1) - m @ (x @ self.g) + elastic.sum())

    @property
    def residual(self) -> float:
        """The worst violation of a rigid link, relative."""
        x, hard = self.position, (self.alpha == 0) & (self.rest > 0)
        length = np.linalg.norm(x[self.pairs[:, 0]] - x[self.pairs[:, 1]], axis=1)
        return float(np.abs(length[hard] / self.rest[hard] - 1).max(initial=0.0))

    def close(self) -> None:
        """Free the memory."""
        self.memory.destroy()

    def __enter__(self):
        return self

    def __exit__(self, *exc) -> None:
        self.close()


@ti.data_oriented
class Article(Baseline):
    """The article's scheme: position Verlet, started with x_(-1) = x_0 - v h. Each link in turn is corrected by half."""

    name = "article"

    @ti.func
    def advance(self, h, keep, substeps, fresh):
        """Compute all substeps. `before` is the position one substep earlier."""
        for s in range(substeps):
            for i in range(self.n):
                if s == 0 and fresh != 0:
                    self.before[i] = self.x[i] - h * self.v[i]
                if self.w[i] > 0:
                    d = (self.x[i] - self.before[i]) * keep + h * h * self.pull[None]
                    self.before[i] = self.x[i]
                    self.x[i] += d
            for c in range(self.m):
                self.relax(c, STIFFNESS, 0.0)
        for i in range(self.n):
            self.v[i] = (self.x[i] - self.before[i]) / h


@ti.data_oriented
class Xpbd(Baseline):
    """XPBD with small steps (Macklin et al. 2019): semi-implicit Euler, one Gauss-Seidel pass, compliance over h^2."""

    name, soft = "XPBD", True

    @ti.func
    def advance(self, h, keep, substeps, fresh):
        """Compute all substeps, with one pass each, in which multipliers start at 0."""
        for s in range(substeps):
            for i in range(self.n):
                self.before[i] = self.x[i]
                if self.w[i] > 0:
                    self.v[i] = self.v[i] * keep + h * self.pull[None]
                    self.x[i] += h * self.v[i]
            for c in range(self.m):
                self.relax(c, 1.0, self.give[c] / (h * h))
            for i in range(self.n):
                self.v[i] = (self.x[i] - self.before[i]) / h


BASELINES: dict[str, type[Baseline]] = {b.name: b for b in (Article, Xpbd)}
