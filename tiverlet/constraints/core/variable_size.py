"""Constraints on any number of particles: how their corners lie in memory, and how they are summed."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import FAR, Batch, Scene
from ...particles import Particles
from .scalar import Scalar

BLOCK = 32  # corners that one thread sums up: the order of all sums is fixed by it, not by the threads


def rows(who: str, name: str, value: Any, least: int) -> list[np.ndarray]:
    """A sequence of index sequences of any lengths (or a single one), each of at least `least` distinct particles."""
    value = checks.rows(who, name, value, "a sequence of index sequences")
    if len(value) and np.ndim(value[0]) == 0:
        value = [value]
    out = []
    for k, row in enumerate(value):
        row = checks.indices(who, f"{name}[{k}]", row, checks.ANY)
        if len(row) < least:
            raise ValueError(f"{who}: {name}[{k}] has {len(row)} particles, but at least {least} are needed.")
        twice = np.flatnonzero(np.bincount(np.unique(row, return_inverse=True)[1]) > 1)
        if len(twice):
            raise ValueError(f"{who}: {name}[{k}] names particle {np.unique(row)[twice[0]]} twice; its members must differ.")
        out.append(row)
    return out


class Ragged(Batch):
    """m constraints of the same kind, each on as many particles as it needs; its `arity` is 0.

    The corners of all constraints lie one after the other in `indices` (total,); constraint c owns starts[c] to starts[c + 1].
    A pass has three loops, so that one constraint on a hundred thousand particles is as parallel as many small ones:

        weigh(b)   sums over at most BLOCK corners of one constraint: self.dev.block[b] = first corner, last + 1, constraint
        relax(c)   adds up its blocks, self.dev.blocks[c] to self.dev.blocks[c + 1], in order, and solves
        spread(e)  gives corner e its move, with self.give(e, move)

    The same loops run before kick(), and weigh() before miss() where it `reweighs`.
    """

    starts: np.ndarray  # (m + 1,)

    def layout(self, members: Sequence[np.ndarray]) -> None:
        """Keep the corners of each constraint."""
        sizes = np.array([len(r) for r in members], dtype=np.int64)
        self.starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        self.indices = np.concatenate([*members, np.zeros(0, dtype=np.int32)]).astype(np.int32)
        self.indices.flags.writeable = False

    @property
    def count(self) -> int:
        """The number of constraints."""
        return len(self.starts) - 1

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (total,)."""
        return np.repeat(np.arange(self.count), np.diff(self.starts))

    @property
    def listing(self) -> list[np.ndarray]:
        """The particles of each."""
        return [self.members_of(k) for k in range(self.count)]

    def members_of(self, c: int) -> np.ndarray:
        """The particles of constraint c."""
        return self.indices[self.starts[c] : self.starts[c + 1]]

    def idle(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return np.bincount(self.owner, weights=inv_mass[self.indices] > 0, minlength=self.count) == 0

    def spared(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Constraints stay as long as all of their particles do, and their corners with them."""
        some = np.bincount(self.owner, weights=number[self.indices] < 0, minlength=self.count) == 0
        return some, some[self.owner]

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the particles of these constraints, by their new numbers."""
        self.layout([number[self.members_of(k)] for k, stays in enumerate(some) if stays])

    def known_particles(self, particles: Particles, name: str) -> None:
        """Refuse corners that do not exist."""
        wrong = np.flatnonzero(self.indices >= particles.count)
        if len(wrong):
            k = int(self.owner[wrong[0]])
            checks.indices(repr(self), f"{name}[{k}]", self.members_of(k), particles.count)

    def bind(self, scene: Scene) -> None:
        """Declare the corners, their slots, and the blocks."""
        self.scene = scene
        self.dev.state, self.dev.slots, self.dev.w = scene.state, scene.slots, scene.state.w
        self.dev.real, self.dev.dim = scene.real, scene.state.dim
        self.corner_count = len(self.indices)
        sizes = np.diff(self.starts)
        parts = -(-sizes // BLOCK)
        first = np.concatenate([[0], np.cumsum(parts)])
        self.blocks = int(first[-1])
        owner = np.repeat(np.arange(self.count), parts)
        begin = self.starts[owner] + BLOCK * (np.arange(self.blocks) - first[owner])
        end = np.minimum(begin + BLOCK, self.starts[owner + 1])
        name, add = repr(self), scene.memory.field
        self.dev.members = add(f"{name}.members", self.corner_count, kind=ti.i32, values=self.indices)
        self.dev.owner = add(f"{name}.owner", self.corner_count, kind=ti.i32, values=self.owner)
        self.dev.starts = add(f"{name}.starts", self.count + 1, kind=ti.i32, values=self.starts)
        self.dev.block = add(f"{name}.block", self.blocks, width=3, kind=ti.i32, values=np.stack([begin, end, owner], axis=1))
        self.dev.blocks = add(f"{name}.blocks", self.count + 1, kind=ti.i32, values=first)
        self.dev.places = add(f"{name}.slots", self.corner_count, kind=ti.i32, values=scene.slots.places(self))

    @ti.func
    def give(self, e, move):
        """Write the move of corner e into its slot; a particle that cannot move has none."""
        place = self.dev.places[e]
        if place >= 0:
            self.dev.slots.move[place] = move

    @ti.func
    def hub(self, c):
        """The particle relative to which corners of constraint c are given, so that nothing is lost in f32."""
        return self.dev.members[self.dev.starts[c]]

    @ti.func
    def arm(self, e, i0, back):
        """Corner e relative to particle i0, at x - back d."""
        i = self.dev.members[e]
        return self.dev.state.apart(i, i0) - back * (self.dev.state.d[i] - self.dev.state.d[i0])


class Content(Scalar, Ragged):
    """Constraints on what a closed line or surface holds, from its gradients alone: give slope(e, back) = grad_e f.

    f is a polynomial of degree dim in the corners and the same after a translation. So dim f = sum_e (x_e - x_0) . grad_e f
    (Euler), and the law of Scalar needs no more.
    """

    reweighs = True

    def lay(self, members: Sequence[np.ndarray]) -> None:
        """Keep the corners of each constraint."""
        self.layout(members)

    def fit(self, particles: Particles) -> None:
        """Refuse corners that do not exist."""
        self.known_particles(particles, self.index_name)

    def bind(self, scene: Scene) -> None:
        """What Scalar needs, and the sums of each block."""
        super().bind(scene)
        name, dim, add = repr(self), scene.state.dim, scene.memory.field
        self.dev.sums = add(f"{name}.sums", self.blocks, width=8)
        self.dev.start = add(f"{name}.gradient", self.corner_count, width=dim)
        self.dev.change = add(f"{name}.change", self.count)
        self.dev.astray = add(f"{name}.turned", self.count, kind=ti.i32)

    @ti.func
    def slope(self, e, back):
        """The gradient of f with respect to corner e, at x - back d."""
        return 0 * self.dev.state.d[0]

    @ti.func
    def weigh(self, b, h, hh, first, fresh):
        """Of a block: f and f0, w |grad|^2; mass-split along both, current, start; its squared size, and of what it moves."""
        begin, end, c = self.dev.block[b]
        i0 = self.hub(c)
        sums = ti.Vector.zero(self.dev.real, 8)
        for e in range(begin, end):
            i = self.dev.members[e]
            g, n = self.slope(e, 0), self.slope(e, 1)
            sums[0] += self.arm(e, i0, 0).dot(g)
            sums[1] += self.arm(e, i0, 1).dot(n)
            sums[2] += self.dev.w.of(i) * g.dot(g)
            sums[3] += self.dev.slots.split[i] * g.dot(n)
            sums[4] += self.dev.slots.split[i] * g.dot(g)
            sums[5] += self.dev.slots.split[i] * n.dot(n)
            sums[6] += self.arm(e, i0, 0).norm_sqr()
            sums[7] += self.dev.w.of(i) * self.dev.w.of(i) * ti.max(g.dot(g), n.dot(n))
            self.dev.start[e] = n
        self.dev.sums[b] = sums

    @ti.func
    def total(self, c):
        """f, f0, the sum of w |grad|^2, the mass-split weight, how far it turned, and the last two sums."""
        sums = ti.Vector.zero(self.dev.real, 8)
        for b in range(self.dev.blocks[c], self.dev.blocks[c + 1]):
            sums += self.dev.sums[b]
        turn = self.dev.slots.turn(sums[3], ti.sqrt(sums[4] * sums[5]))
        W = sums[3]
        if turn == FAR:
            W = sums[4]
        return sums[0] / self.dev.dim, sums[1] / self.dev.dim, sums[2], W, turn, sums[6], sums[7]

    @ti.func
    def relax(self, c, h, hh, when, first, fresh):
        """Find dlam."""
        f, f0, w, W, turn, extent, move = self.total(c)
        violation, A, alpha, lam, W = self.equation(c, f, f0, w, W, h, hh, first, fresh)
        new, left = self.answer(violation, A, alpha, lam, W, turn)
        new = self.tempered(c, lam, new, extent, move)
        self.dev.lam[c], self.dev.change[c], self.dev.astray[c] = new, new - lam, turn == FAR

    @ti.func
    def spread(self, e, h, hh, first, fresh):
        """Move each corner by w_j dlam grad_j C."""
        c = self.dev.owner[e]
        n = self.dev.start[e]
        if self.dev.astray[c] != 0:
            n = self.slope(e, 0)
        self.give(e, self.dev.w.of(self.dev.members[e]) * self.dev.change[c] * n)

    @ti.func
    def kick(self, c, h):
        """As in Scalar."""
        f, f0, w, W, turn, extent, move = self.total(c)
        self.dev.change[c], self.dev.astray[c] = h * h * self.force(c, f, f0, w, h), 1

    @ti.func
    def bond(self, c, firm, soft):
        """As in Scalar."""
        pull = self.dev.lam[c] * ti.select(self.dev.spring.is_rigid(c), firm, soft)
        for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
            self.give(e, self.dev.w.of(self.dev.members[e]) * pull * self.slope(e, 0))

    @ti.func
    def miss(self, c, h, hh, when, fresh):
        """The violation that is left, relative to the rest value."""
        f, f0, w, W, turn, extent, move = self.total(c)
        violation, A, alpha, lam, W = self.equation(c, f, f0, w, W, h, hh, 0, fresh)
        new, left = self.answer(violation, A, alpha, lam, W, turn)
        if w == 0:  # collapsed, or static
            for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
                if self.dev.w.of(self.dev.members[e]) > 0 and self.dev.strength.holds(c):
                    left = ti.abs(f - self.dev.rest[c])
        return left / self.extent(c)

    @ti.func
    def value(self, c, back):
        """f at x - back d, by Euler's theorem."""
        f, i0 = ti.cast(0, self.dev.real), self.hub(c)
        for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
            f += self.arm(e, i0, back).dot(self.slope(e, back))
        return f / self.dev.dim
