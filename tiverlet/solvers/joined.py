"""Rigid clusters that links join: in an elimination, links act on them as on bodies, with all of their mass and inertia.

A link that pushes a corner of a cluster by p moves the corner alone by w p, and the cluster takes from it what makes it the move
of a body: u = p / M + (I^-1 (r x p)) x r at every corner, r from the center. Relaxed each by itself, the two share the corner's
mass, and a heavy body stretches the chain that bears it; so rows are coupled by u instead of by w p, where two of them act on one
body, too. What the cluster adds is its own move then. It has no momentum about the positions at the start of the substep, as the
moves of clusters have none, see ClusterPasses.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import called, ti
from ..geometry import rotation
from .corners import by_batch, corners_of
from .system import solvable

if TYPE_CHECKING:
    from ..features.feature import Batch, Scene
    from .slots import Slots
    from .system import System


def joined_clusters(batches: "list[Batch]", alone: np.ndarray, scene: "Scene", answers: bool) -> np.ndarray:
    """Return the body of each particle, (n,), -1 where it is in none: a rigid cluster that only links of a system join.

    Bodies are numbered through all clusters of all batches. alone: which of the solvable constraints, numbered through, are in no
    system. What else holds a corner, and a link inside of a cluster, has to share its mass with the cluster, as by Jacobi. So
    have all where walls have the last word, since constraints do not answer contacts, see BodyImpacts.
    """
    n, links, clusters = len(scene.inv_mass), solvable(batches), [b for b in batches if b.clusters]
    body, linked = np.full(n, -1), np.zeros(n, dtype=bool)
    owner, item = corners_of(clusters)
    rigid = np.repeat([not (b.soft or b.breaks) for b in clusters], [b.indices.size for b in clusters])
    if (scene.walls and not answers) or not rigid.any():
        return body
    body[item[rigid]] = owner[rigid]
    held = np.bincount(corners_of([b for b in batches if not b.solvable_together])[1], minlength=n)
    for b, by_itself in zip(links, by_batch(links, alone), strict=True):
        inside = (b.arity > 1) & (body[b.indices] >= 0).all(axis=1) & (np.ptp(body[b.indices], axis=1) == 0)
        shares = (by_itself | inside)[b.owner]
        held += np.bincount(b.indices.ravel()[shares], minlength=n)
        linked[b.indices.ravel()[~shares]] = True
    some = body >= 0
    refused = np.bincount(body[some & linked], minlength=int(body.max()) + 1) == 0
    refused[body[some & (held != 1)]] = True
    body[some] = np.where(refused[body[some]], -1, body[some])
    return body


def couples(body: np.ndarray, item: np.ndarray) -> np.ndarray:
    """Return what couples the constraints of corners at these particles: a number for each body, and for each other particle."""
    return np.where(body[item] >= 0, len(body) + body[item], item)


class Joined:
    """The bodies of an elimination, part by part.

    part_begin, corner_begin: the first body of each part, the first corner of each body. particle, m: of each corner, its mass
    [kg]. place: the slot of its cluster's move, -1 for a pinned one. batch, number: the batch of clusters that it is in, and as
    which corner. corner_of: the corner on which the row with a slot acts, -1 where that is on no body. arm: of corners from the
    center, at the start of the substep [m]. S: sum m r r^T. push, spin: of each slot, how the body moves for a multiplier of 1 of
    its row. u: moves of corners [m]. moved, turned: of each body, what fit() found.
    """

    host_only = ("_least", "_particles")

    def __init__(
        self, scene: "Scene", system: "System", clusters: "list[Batch]", slots: "Slots", part: np.ndarray, slot: np.ndarray,
        who: np.ndarray, parts: int,
    ):  # fmt: skip
        """clusters: those with bodies. part: of each row. slot, who: of each corner of a row, its slot and particle."""
        dim, ints, reals = scene.state.dim, system.ints, system.reals
        self.state, self.real, self.dim, self.slots, self.clusters = scene.state, scene.real, dim, slots, clusters
        found = []  # part, particle, slot, batch, corner, cluster
        for k, b in enumerate(clusters):
            row = system.row(b)[b.owner]
            corner = np.flatnonzero(row >= 0)
            table = part[row], b.indices.ravel(), slots.places(b).ravel(), np.full(len(row), k), np.arange(len(row)), b.owner
            found.append(np.stack(table, axis=1)[corner])
        table = np.concatenate(found)
        table = table[np.lexsort((table[:, 4], table[:, 3], table[:, 0]))]
        begins = np.flatnonzero((np.diff(table[:, [3, 5]], axis=0, prepend=-1) != 0).any(axis=1))
        at, corner_of = np.full(len(scene.inv_mass), -1), np.full(slots.total, -1)
        at[table[:, 1]] = np.arange(len(table))
        corner_of[slot] = at[who]
        owner = np.searchsorted(begins, np.arange(len(table)), side="right") - 1
        w = scene.inv_mass[table[:, 1]]
        mass = np.divide(1, w, out=np.zeros(len(w)), where=w > 0)
        mass[w == 0] = rotation.HEAVY * np.bincount(owner, weights=mass)[owner[w == 0]]
        self._least, self._particles = 1 / np.bincount(owner, weights=mass)[owner], table[:, 1]
        self.part_begin = ints("body_part_begin", np.searchsorted(table[begins, 0], np.arange(parts + 1)))
        self.corner_begin = ints("body_corner_begin", np.append(begins, len(table)))
        self.particle, self.place, self.batch, self.number = (
            ints(f"body_{name}", table[:, k]) for k, name in enumerate(("particle", "place", "batch", "number"), 1)
        )
        self.owner, self.corner_of = ints("body_owner", owner), ints("body_corner_of", corner_of)
        self.arm, self.u = reals("body_arm", len(table), dim), reals("body_u", len(table), dim)
        self.m, self.mass = reals("body_m", len(table), values=mass), reals("body_mass", len(begins))
        self.S, self.moved = reals("body_S", len(begins), dim * dim), reals("body_moved", len(begins), dim)
        self.turned = reals("body_turned", len(begins), dim * dim)
        self.push, self.spin = reals("body_push", slots.total, dim), reals("body_spin", slots.total, dim * dim)

    def lightest(self, inv_mass: np.ndarray) -> np.ndarray:
        """Return inverse masses, (n,), with that of the whole body for its particles."""
        out = inv_mass.copy()
        out[self._particles] = self._least
        return out

    @ti.func
    def zero(self) -> Any:
        """Return a vector of zeros."""
        return ti.Vector.zero(ti.f64, self.dim)

    @called
    @ti.func
    def place_bodies(self, b: ti.i32, back: ti.f64):
        """Find the arms and the inertia of the bodies of part b at x - back d."""
        for k in range(self.part_begin[b], self.part_begin[b + 1]):
            begin, end = self.corner_begin[k], self.corner_begin[k + 1]
            i0, M, middle = self.particle[begin], ti.cast(0, ti.f64), self.zero()
            S = middle.outer_product(middle)
            for e in range(begin, end):
                m, r = self.m[e], self.state.between_before(self.particle[e], i0, back)
                self.arm[e] = r
                M += m
                middle += m * r
                S += m * r.outer_product(r)
            middle /= M
            for e in range(begin, end):
                self.arm[e] = self.arm[e] - middle
            self.mass[k] = M
            rotation.write_rows(self.S, k, S - M * middle.outer_product(middle))

    @ti.func
    def note_push(self, s, move):
        """Store how a body moves that a row with slot s pushes, so that its corner alone would move by `move`."""
        e = self.corner_of[s]
        if e >= 0:
            k = self.owner[e]
            p = self.m[e] * ti.cast(move, ti.f64)
            self.push[s] = p / self.mass[k]
            rotation.write_rows(
                self.spin, s, rotation.rigid_rotation(rotation.from_rows(self.S[k]), self.arm[e].outer_product(p))
            )

    @ti.func
    def move_for(self, s, by):
        """Return how far the corner of slot s moves for a multiplier of 1 of the row with slot `by`, on the same body."""
        return self.push[by] + rotation.from_rows(self.spin[by]) @ self.arm[self.corner_of[s]]

    @ti.func
    def own_move(self, s):
        """Return how far the cluster moves the corner of slot s so far [m]; 0 on no body."""
        out = ti.Vector.zero(self.real, self.dim)
        if self.corner_of[s] >= 0:
            out = self.slots.move[self.place[self.corner_of[s]]]
        return out

    @called
    @ti.func
    def fit(self, k: ti.i32):
        """Find the move of body k that comes closest to the moves u of its corners."""
        push = self.zero()
        X = push.outer_product(push)
        for e in range(self.corner_begin[k], self.corner_begin[k + 1]):
            push += self.m[e] * self.u[e]
            X += self.m[e] * self.arm[e].outer_product(self.u[e])
        self.moved[k] = push / self.mass[k]
        rotation.write_rows(self.turned, k, rotation.rigid_rotation(rotation.from_rows(self.S[k]), X))

    @ti.func
    def fitted(self, e):
        """Return how far the move that fit() found moves corner e [m]."""
        k = self.owner[e]
        return self.moved[k] + rotation.from_rows(self.turned[k]) @ self.arm[e]

    @ti.func
    def follow(self, b, system: ti.template()):  # type: ignore[valid-type]
        """Let the clusters of part b make the moves of its rows those of bodies."""
        for k in range(self.part_begin[b], self.part_begin[b + 1]):
            begin, end = self.corner_begin[k], self.corner_begin[k + 1]
            for e in range(begin, end):
                i = self.particle[e]
                self.u[e] = self.zero()
                for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
                    r = system.row_of[s]
                    if r >= 0:
                        self.u[e] = self.u[e] + system.step[r] * ti.cast(self.slots.move[s], ti.f64)
            self.fit(k)
            for e in range(begin, end):
                more, place = ti.cast(self.fitted(e) - self.u[e], self.real), self.place[e]
                if place >= 0:
                    self.slots.move[place] = self.slots.move[place] + more
                    for n, f in ti.static(enumerate(self.clusters)):
                        if self.batch[e] == n:
                            f.dev.pull[self.number[e]] = f.dev.pull[self.number[e]] + more

    @ti.func
    def begin_answer(self, b, system: ti.template(), moved: ti.template(), d: ti.template()):  # type: ignore[valid-type]
        """Find how the bodies of part b move with their particles, by `moved` - d."""
        for k in range(self.part_begin[b], self.part_begin[b + 1]):
            begin, end = self.corner_begin[k], self.corner_begin[k + 1]
            for e in range(begin, end):
                self.u[e] = ti.cast(moved[self.particle[e]] - d[self.particle[e]], ti.f64)
            self.fit(k)
            for e in range(begin, end):
                self.u[e] = self.u[e] - self.answered(e, system)

    @ti.func
    def end_answer(self, b, system: ti.template()):  # type: ignore[valid-type]
        """Let the clusters of part b answer, after its rows."""
        for k in range(self.part_begin[b], self.part_begin[b + 1]):
            begin, end = self.corner_begin[k], self.corner_begin[k + 1]
            for e in range(begin, end):
                self.u[e] = self.u[e] + self.answered(e, system)
            self.fit(k)
            for e in range(begin, end):
                more, place = ti.cast(self.fitted(e) - self.u[e], self.real), self.place[e]
                some = (more != 0).any()  # type: ignore[reportOptionalCall]
                if place >= 0 and some:  # else a 0 keeps its sign, as without a pass
                    self.slots.answer[place] = self.slots.answer[place] + more

    @ti.func
    def answered(self, e, system: ti.template()):  # type: ignore[valid-type]
        """Return how far rows move the particle of corner e by their answers [m]."""
        out, i = self.zero(), self.particle[e]
        for s in range(self.slots.begin[i], self.slots.begin[i + 1]):
            if system.row_of[s] >= 0:
                out += ti.cast(self.slots.answer[s], ti.f64)
        return out
