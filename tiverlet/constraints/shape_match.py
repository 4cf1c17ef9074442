"""Clusters of particles that keep their shape."""

import numpy as np

from ..device import ti
from .core import rotation
from .core.clusters import Clusters
from .core.spring import stiff

LEAST = 2.0**-46  # relative changes of a rotation that are rounding


class ShapeMatch(Clusters):
    """Clusters that keep their shape: rigid bodies, or soft ones that spring back (after Mueller et al. 2005).

    C_i(x) = x_i - (c + R q_i) for each particle of a cluster, with q the shape at rest, c and R where it is and how it is turned.

    Rigid, c and R are not the best fit of the predicted places, which would take spin away in every step. They are such that the
    correcting forces have no sum and no moment about the places at the start of the step, as the forces of SHAKE. For one
    cluster by itself that is the discrete rigid body of Moser and Veselov (1991): second order, momentum and angular momentum
    kept to rounding, no damping. A cluster that would turn by more than 90 degrees in a step turns by 90; above 41 it is flagged.

    Soft, each particle is drawn to its place by a spring with its part, by mass, of the stiffness of the whole: all ways in which
    a cluster of mass M can deform have the one frequency sqrt(1 / (compliance M)). From soft to rigid by the law of Scalar, with
    deformations compared in the frame of the body. Damping acts on the deformation alone, never on the motion of the whole.

    clusters: a sequence of index sequences, or (m, k), or one sequence. They may overlap. A cluster may be flat, on a line, in
    one place or inside out; it is turned, never reflected.
    rest: (n, dim) [m], the shape of all particles at rest; None takes the initial positions.
    compliance: number or (m,) [m/N]; the stiffnesses of a cluster's springs add up to 1 / compliance. 0 is rigid.
    damping: number or (m,) [N s/m], of the dashpots beside the springs, all together.
    creep: number or (m,) [1/s], plastic flow: the shape at rest goes after what exceeds yield_strain at this rate.
    yield_strain: number or (m,), how far a particle may be off its place without flow, of the cluster's radius.
    break_at: force on one of its particles beyond which a cluster falls apart, number or (m,) [N]; None for never.

    `load` is the largest force on a particle of each cluster [N], m omega^2 r where it spins freely.

    Particles that cannot move weigh as much as 1024 clusters in their own. Sums and rotations are f64 in every world: a
    rotation rounded to f32 would shake the spin by 1e-7 of the size in every step, which is much of a small displacement.
    In f32 the rounding of x, by some 2^-25 of the size, and of d, by 2^-25 of itself, changes the angular momentum sum m x x d by
    about 2^-25 of itself in every substep, at random: by 2^-25 sqrt(n) after n of them, 3e-6 after 10 s at 1200 per second.
    "f32-compensated" is without the part of x, "f64" without both (1e-11).
    """

    def __init__(
        self, clusters, rest=None, *, compliance=0.0, damping=0.0, creep=0.0, yield_strain=0.0, break_at=None
    ):  # fmt: skip
        self.setup(clusters, rest, compliance, damping, creep, yield_strain, break_at)

    @property
    def load(self) -> np.ndarray:
        """The largest force on a particle of each cluster during the last substep [N], (m,)."""
        if not self.count:
            return np.zeros(0)
        if self.scene is None:
            raise RuntimeError("ShapeMatch.load: there is none before a world has been stepped with it.")
        if not self.acts:
            return np.zeros(self.count)
        w = self.scene.inv_mass[self.indices]
        scale = np.divide(1, w * self.scene.hh, out=np.zeros_like(w), where=w * self.scene.hh > 0)
        pull = self.scene.memory.read(self.dev.pull).astype(np.float64)
        return np.maximum.reduceat(scale * np.linalg.norm(pull, axis=1), self.starts[:-1])

    @ti.func
    def relax(self, c, h, hh, when, first, fresh):
        """Find where the cluster goes."""
        if self.dev.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            rigid, soft, now, last, give = self.law(c, h, hh, fresh)
            mean, U = 0 * p, 0 * K
            if ti.static(self.dev.spring.soft):
                for b in range(self.dev.blocks[c], self.dev.blocks[c + 1]):
                    mean += self.dev.v[b] / total
                    U += self.kept(self.dev.U, b)
                U -= total * mean.outer_product(s)
            start, end, cosine = rotation.turn(K, X, U, first > 0, rigid, soft, self.dev.turn[c], LEAST, self.dev.spring.soft)
            pose = rotation.matrix(end)
            self.dev.turn[c], self.dev.place[c] = end, p - pose @ q
            self.keep(self.dev.pose, c, pose)
            self.dev.slots.note(self.dev.slots.turn(cosine, 1.0))
            if ti.static(self.dev.spring.soft):
                R = rotation.matrix(start)
                if first > 0:  # in the frame of the body
                    mean = R @ mean
                self.dev.middle[c], self.dev.mean[c] = s - R @ q, mean
                self.keep(self.dev.fit, c, R)

    @ti.func
    def kick(self, c, h):
        """Find where the cluster is; spread() then adds h^2 times what its springs do now."""
        if self.dev.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            R = rotation.matrix(rotation.fit(K, self.dev.turn[c], LEAST))
            self.dev.place[c] = s - R @ q
            self.keep(self.dev.pose, c, R)

    @ti.func
    def bond(self, c, firm, soft):
        """What moved each corner, less its moment about the present places: as what turns the cluster, of least sum m move^2.

        Moves have no moment about the places at the start. Where something cannot move, forces from outside have one.
        """
        begin, end, i0 = self.dev.starts[c], self.dev.starts[c + 1], self.hub(c)
        scale = firm
        if ti.static(self.dev.spring.soft):
            scale = ti.select(self.dev.spring.alpha[c] > 0, soft, firm)
        total, mean, pull, held = ti.cast(0, ti.f64), 0 * self.dev.place[c], 0 * self.dev.place[c], False
        S = mean.outer_product(mean)
        X = 0 * S
        for e in range(begin, end):
            held = held or self.dev.w.of(self.dev.members[e]) == 0
            m, r = self.weight(e, c), self.arm(e, i0, 0)
            total += m
            mean += m * r
            pull += m * self.dev.pull[e]
            S += m * r.outer_product(r)
            X += m * r.outer_product(ti.cast(self.dev.pull[e], ti.f64))
        mean, pull = mean / total, pull / total
        spin = rotation.spin(S - total * mean.outer_product(mean), X - total * mean.outer_product(pull))
        for e in range(begin, end):
            move = ti.cast(self.dev.pull[e], ti.f64)
            if not held:
                move -= spin @ (self.arm(e, i0, 0) - mean)
            self.give(e, ti.cast(scale * move, self.dev.real))

    @ti.func
    def off(self, e, c):
        """C_i at the present places."""
        return self.arm(e, self.hub(c), 0) - self.dev.place[c] - self.kept(self.dev.pose, c) @ self.dev.shape[e]

    @ti.func
    def spread(self, e, h, hh, first, fresh):
        """Move corner e towards its place."""
        c, i = self.dev.owner[e], self.dev.members[e]
        w, relaxation = self.dev.w.of(i), self.dev.slots.relaxation
        if first > 0:
            self.dev.pull[e] = 0 * self.dev.pull[e]
        if not self.dev.strength.holds(c):
            self.give(e, 0 * self.dev.pull[e])
        elif w > 0:
            C, n = self.off(e, c), self.dev.slots.split[i] / w
            if ti.static(not self.dev.spring.soft):
                move = ti.cast(-relaxation * C / n, self.dev.real)
                if first >= 0:
                    self.dev.pull[e] = self.dev.pull[e] + move
                self.give(e, move)
            elif first < 0:
                self.give(e, ti.cast(self.spring(e, c, C, h), self.dev.real))
            else:
                rigid, soft, now, last, give = self.law(c, h, hh, fresh)
                if first > 0:
                    self.look_back(e, c, h, now, last)
                C = self.wrong(e, c, C, rigid, soft, give)
                move = ti.cast(-relaxation * C / ((rigid + soft) * n + give), self.dev.real)
                self.dev.pull[e] = self.dev.pull[e] + move
                self.give(e, move)

    @ti.func
    def wrong(self, e, c, C, rigid, soft, give):
        """C* + alpha' lam of a soft cluster, with the soft part of C_(n+1) = C in the frame at the start."""
        back = self.kept(self.dev.fit, c) @ (self.kept(self.dev.pose, c).transpose() @ C)
        return rigid * C + soft * back + self.dev.spring.history[e] + give * self.dev.pull[e] - self.dev.mean[c]

    @ti.func
    def look_back(self, e, c, h, now, last):
        """What C_n and C_(n-1) add to the violation; and flow, where the shape is plastic."""
        R = self.kept(self.dev.fit, c)
        C = self.arm(e, self.hub(c), 1) - self.dev.middle[c] - R @ self.dev.shape[e]
        self.dev.spring.history[e] = now * C + last * (R @ self.dev.spring.last[e])
        body = R.transpose() @ C
        if ti.static(self.dev.plastic):
            size = body.norm()
            if size > self.dev.yield_size[c]:
                flow = (1 - ti.exp(-self.dev.creep[c] * h)) * (1 - self.dev.yield_size[c] / size) * body
                self.dev.shape[e] = self.dev.shape[e] + flow
                body -= flow
        self.dev.spring.last[e] = body

    @ti.func
    def spring(self, e, c, C, h):
        """h^2 times the acceleration by the spring and the dashpot of corner e, as far as the step resolves them."""
        alpha, mass = self.dev.spring.alpha[c], self.dev.mass[c]
        out = 0 * C
        if alpha > 0:
            rate = (C - self.kept(self.dev.pose, c) @ self.dev.spring.last[e]) / h
            out = -h * h * (1 - stiff(alpha, h, 1 / mass)) * (C / alpha + self.dev.spring.damping[c] * rate) / mass
        return out

    @ti.func
    def tear(self, c, hh, tick):
        """Let cluster c fall apart if the force on one of its particles was too large."""
        if self.dev.strength.holds(c):
            most = ti.cast(0, self.dev.real)
            for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
                w = self.dev.w.of(self.dev.members[e])
                if w > 0:
                    most = ti.max(most, self.dev.pull[e].norm() / w)
            self.dev.strength.test(c, most, hh, tick)

    @ti.func
    def miss(self, c, h, hh, when, fresh):
        """The largest violation that is left, by where the last pass turned the cluster, relative to its radius."""
        worst, total, mean, holds = ti.cast(0, ti.f64), ti.cast(0, ti.f64), 0 * self.dev.place[c], self.dev.strength.holds(c)
        rigid, soft, now, last, give = self.law(c, h, hh, fresh)
        for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
            total += self.weight(e, c)
            mean += self.weight(e, c) * self.off(e, c)
        for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
            if self.dev.w.of(self.dev.members[e]) > 0 and holds:
                C = self.off(e, c) - mean / total  # places are relative to a particle that has moved since
                if ti.static(self.dev.spring.soft):
                    C = self.wrong(e, c, C, rigid, soft, give)
                worst = ti.max(worst, C.norm())
        return ti.cast(worst / self.dev.size[c], self.dev.real)

    @ti.func
    def energy(self, c, back, hh, miss):
        """Sum of m |C|^2 / (2 alpha M) at x - back d, about the best fit there."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.dev.spring.soft):
            alpha, mass, i0 = self.dev.spring.alpha[c], self.dev.mass[c], self.hub(c)
            if alpha > 0 and mass > 0 and self.dev.strength.holds(c):
                total = ti.cast(0, ti.f64)
                s, q = 0 * self.dev.place[c], 0 * self.dev.place[c]
                K = s.outer_product(q)
                for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
                    mu = self.weight(e, c)
                    x = self.arm(e, i0, back)
                    total += mu
                    s += mu * x
                    q += mu * self.dev.shape[e]
                    K += mu * self.dev.shape[e].outer_product(x)
                s, q = s / total, q / total
                R = rotation.matrix(rotation.fit(K - total * q.outer_product(s), self.dev.turn[c], LEAST))
                for e in range(self.dev.starts[c], self.dev.starts[c + 1]):
                    C = self.arm(e, i0, back) - s - R @ (self.dev.shape[e] - q)
                    if self.dev.w.of(self.dev.members[e]) > 0:
                        out += C.dot(C) / (2 * alpha * mass * self.dev.w.of(self.dev.members[e]))
        return out
