"""Clusters of particles that keep their shape."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import checks
from ..device import ti
from ..features.feature import Batch, Knob, Scene
from ..geometry.ordered import distinct
from ..particles import Particles
from .core import rotation
from .core.members import VariableSize, rows
from .core.spring import Spring, stiff
from .core.strength import Strength, strength_of

HEAVY = 1024  # masses of the cluster: what a particle that cannot move weighs in it
LEAST = 2.0**-46  # relative changes of a rotation that are rounding


class ShapeMatch(Batch):
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

    clusters = True
    each = ("compliance", "damping", "creep", "yield_strain", "break_at")
    index_name = "clusters"
    compliance: Any = Knob(lambda f, v: f._setting("compliance", v), "Inverse stiffness [m/N], (m,).", force=True)
    damping: Any = Knob(lambda f, v: f._setting("damping", v), "Of the dashpots [N s/m], (m,).", force=True)
    creep: Any = Knob(lambda f, v: f._setting("creep", v), "Rate of flow [1/s], (m,).")
    yield_strain: Any = Knob(lambda f, v: f._setting("yield_strain", v), "Strain without flow, (m,).")
    break_at: Any = Knob(strength_of, "Load beyond which a constraint breaks, (m,); None for never.")
    compiled_for = ("soft", "transcends", "breaks")

    def __init__(
        self, clusters, rest=None, *, compliance: ArrayLike = 0.0, damping: ArrayLike = 0.0, creep: ArrayLike = 0.0, yield_strain:
        ArrayLike = 0.0, break_at=None,
    ):  # fmt: skip
        self.members = VariableSize("ShapeMatch", rows("ShapeMatch", "clusters", clusters, 1))
        self._rest = None if rest is None else checks.points("ShapeMatch", "rest", rest)
        self.compliance, self.damping, self.creep, self.yield_strain = compliance, damping, creep, yield_strain
        self.break_at = break_at

    def _setting(self, name: str, value) -> np.ndarray:
        value = checks.per_item(repr(self), name, value, self.count, least=0.0)
        now = {"compliance": 1.0, "creep": 0.0} | vars(self) | {name: value}
        rigid = (now["creep"] > 0) & (now["compliance"] == 0) & np.ones(self.count, dtype=bool)
        if rigid.any():
            k = int(np.argmax(rigid))
            raise ValueError(
                f"{self!r}: creep[{k}] = {now['creep'][k]:g}, but a rigid cluster does not flow; give it compliance."
            )
        return value

    def upload(self) -> None:
        """Write new stiffnesses, rates and strengths."""
        if self.acts:
            write = self.scene.memory.write
            self.dev.spring.upload(self.compliance, self.damping)
            if self.dev.plastic:
                write(self.dev.creep, self.creep)
                write(self.dev.yield_size, self.yield_strain * self._radius)
            self.dev.strength.upload(self.break_at)

    @property
    def soft(self) -> bool:
        """Whether any cluster has compliance."""
        return bool((self.compliance > 0).any()) or self._built("spring", "soft")

    @property
    def breaks(self) -> bool:
        """Whether a load can break clusters, or could when kernels were compiled."""
        return self.break_at is not None or self._built("strength", "breaks")

    @property
    def transcends(self) -> bool:
        """Whether any cluster flows, at an exponential rate."""
        return bool((self.creep > 0).any()) or vars(self.dev).get("plastic", False)

    def prepare(self, particles: Particles, inv_mass: np.ndarray) -> None:
        """Settle the shapes at rest, each about its center."""
        self.members.check(repr(self), "clusters", particles.count)
        rest = particles.position
        if self._rest is not None:
            rest = checks.points(repr(self), "rest", self._rest, dim=particles.dim, count=particles.count)
        q = rest[self.indices]
        m = np.where(np.isfinite(particles.mass), particles.mass, 1.0)[self.indices]
        total = np.bincount(self.members.owner, weights=m, minlength=self.count)
        center = np.stack([np.bincount(self.members.owner, weights=m * x, minlength=self.count) / total for x in q.T], axis=1)
        self._shape = q - center[self.members.owner]
        square = np.bincount(self.members.owner, weights=m * (self._shape**2).sum(axis=1), minlength=self.count)
        self._radius = np.sqrt(square / total)

    @property
    def grows(self) -> bool:
        """Shapes that are given are given for all particles."""
        return self._rest is None

    def hold_all(self, listing: Any) -> None:
        """Act on these."""
        self._keep(members=VariableSize("ShapeMatch", listing))

    def shape_of(self, c: int) -> np.ndarray:
        """The shape at rest of cluster c, about its center, (k, dim)."""
        return self._shape[self.members.starts[c] : self.members.starts[c + 1]]

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Particles that come later have a place in the shape of all, which no cluster uses."""
        super().remap_indices(number, count)
        if self._rest is not None:
            rest = np.zeros((count, self._rest.shape[1]))
            rest[number[number >= 0]] = self._rest[number >= 0]
            self._rest = rest
            self.arguments = {**self.arguments, "rest": rest}

    def excluded_pairs(self, particles: Particles) -> np.ndarray:
        """Particles of a cluster that are near each other may overlap; the rest cannot meet unless it is soft."""
        sizes, out = np.diff(self.members.starts), [np.zeros((0, 2), dtype=np.int32)]
        for size in distinct(sizes)[0].tolist():
            first = self.members.starts[:-1][sizes == size]
            out.append(_near(np.asarray(self.indices)[first[:, None] + np.arange(size)], particles))
        return np.concatenate(out)

    def bind(self, scene: Scene) -> None:
        """Shapes, rotations, sums; for soft clusters multipliers and the memory of the averaged constraint."""
        super().bind(scene)
        name, dim, m, add = repr(self), scene.state.dim, self.count, scene.memory.field
        self.dev.plastic = self.transcends
        w = scene.inv_mass[self.indices]
        mass = np.bincount(self.members.owner, weights=np.divide(1, w, where=w > 0, out=np.zeros_like(w)), minlength=m)
        self.dev.mass = add(f"{name}.mass", m, values=mass)
        self.dev.size = add(f"{name}.radius", m, values=np.maximum(self._radius, 1e-6 * self.start.size))
        self.dev.shape = add(f"{name}.shape", self.corner_count, width=dim, values=self._shape, state=self.dev.plastic)
        turn = rotation.identity(dim)
        self.dev.pull = add(f"{name}.multiplier", self.corner_count, width=dim, state=True)
        self.dev.strength = Strength(scene, name, self)
        self.dev.turn = add(f"{name}.turn", m, width=len(turn), kind=ti.f64, values=[turn] * m, state=True)
        told = bool(scene.state.sleepers)  # what the report of a cluster that sleeps goes by, in a clone too
        self.dev.pose = add(f"{name}.pose", m, width=dim * dim, kind=ti.f64, state=told)
        self.dev.place = add(f"{name}.place", m, width=dim, kind=ti.f64, state=told)

        def moment(what, width):
            """A field with a row for each block, to be summed up."""
            return add(f"{name}.{what}", self.blocks, width=width, kind=ti.f64)

        self.dev.total = moment("total", 0)
        self.dev.p, self.dev.q, self.dev.s = moment("p", dim), moment("q", dim), moment("s", dim)
        self.dev.K, self.dev.X = moment("K", dim * dim), moment("X", dim * dim)
        compliance, damping = (self.compliance, self.damping) if self.soft else (None, None)
        self.dev.spring = Spring(scene, name, compliance, damping, np.zeros((self.corner_count, dim)))
        if self.dev.spring.soft:
            self.dev.v, self.dev.U = moment("v", dim), moment("U", dim * dim)
            self.dev.fit = add(f"{name}.fit", m, width=dim * dim, kind=ti.f64, state=told)
            self.dev.middle = add(f"{name}.middle", m, width=dim, kind=ti.f64)
            self.dev.mean = add(f"{name}.mean", m, width=dim, kind=ti.f64, state=told)
        if self.dev.plastic:
            self.dev.creep = add(f"{name}.creep", m, values=self.creep)
            self.dev.yield_size = add(f"{name}.yield", m, values=self.yield_strain * self._radius)
        self.changed = False

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
        scale = np.divide(1, w * self.scene.h2_effective, out=np.zeros_like(w), where=w * self.scene.h2_effective > 0)
        pull = self.scene.memory.read(self.dev.pull).astype(np.float64)
        return np.maximum.reduceat(scale * np.linalg.norm(pull, axis=1), self.members.starts[:-1])

    @ti.func
    def nothing(self) -> Any:
        """A vector of zeros; what a field has may be no number."""
        return ti.Vector.zero(ti.f64, self.dev.state.dim)

    @ti.func
    def arm(self, e, i0, back):
        """Corner e relative to particle i0, at x - back d; in f64, so that places at the start and predicted ones differ by d."""
        i = self.dev.corners.members[e]
        move = ti.cast(self.dev.state.d[i], ti.f64) - ti.cast(self.dev.state.d[i0], ti.f64)
        return ti.cast(self.dev.state.apart(i, i0), ti.f64) - back * move

    @ti.func
    def law(self, c, h, h2_effective, fresh):
        """The coefficients of C_(n+1) (the rigid part and the rest), C_n and C_(n-1), and alpha M / h^2: alpha' of a move."""
        rigid, soft = ti.cast(1, self.dev.real), ti.cast(0, self.dev.real)
        now, last, give = 0 * soft, 0 * soft, 0 * soft
        if ti.static(self.dev.spring.soft):
            alpha, mass = self.dev.spring.alpha[c], self.dev.mass[c]
            if alpha > 0 and mass > 0:
                soft, now, last = self.dev.spring.law(c, h, 1 / mass, fresh)
                if soft < 1 / 64:  # a start asks for nothing at the end where it is soft: c and R need something to go by
                    soft, now = ti.cast(1 / 64, self.dev.real), now + soft - 1 / 64
                rigid = ti.min(stiff(alpha, h, 1 / mass), soft)
                soft -= rigid
                give = alpha * mass / h2_effective
        return rigid, soft, now, last, give

    @ti.func
    def share(self, e, A, give):
        """mu of corner e in a pass: its mass, times what a violation of 1 moves it."""
        i = self.dev.corners.members[e]
        w, mu = self.dev.w.of(i), ti.cast(HEAVY * self.dev.mass[self.dev.corners.owner[e]], ti.f64)
        if w > 0:
            mu = 1 / ti.cast(A * self.dev.slots.split[i] + give * w, ti.f64)
        return mu

    @ti.func
    def weight(self, e, c):
        """The mass of corner e in a fit."""
        w, mu = self.dev.w.of(self.dev.corners.members[e]), ti.cast(HEAVY * self.dev.mass[c], ti.f64)
        if w > 0:
            mu = ti.cast(1, ti.f64) / w
        return mu

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """The moments of a block about the places s at the start: of shapes q, predicted places p, and of what else pulls."""
        begin, end, c = self.dev.corners.block[b]
        i0 = self.dev.corners.hub(c)
        rigid, soft, now, last, give = self.law(c, h, h2_effective, fresh)
        total, p1, q1, s1 = ti.cast(0, ti.f64), self.nothing(), self.nothing(), self.nothing()
        K = p1.outer_product(p1)
        X, v1, U = 0 * K, 0 * p1, 0 * K
        for e in range(begin, end):
            mu, p, q, s = self.share(e, rigid + soft, give), self.arm(e, i0, 0), self.dev.shape[e], self.arm(e, i0, 1)
            if first < 0:
                mu, s = self.weight(e, c), p
            total += mu
            p1 += mu * p
            q1 += mu * q
            s1 += mu * s
            K += (mu * q).outer_product(s)
            X += (mu * p).outer_product(s)
            if ti.static(self.dev.spring.soft):
                v = mu * last * self.dev.spring.before(e, ti.cast(self.nothing(), self.dev.real), fresh)
                if first == 0:
                    v = mu * (self.dev.spring.history[e] + give * self.dev.pull[e])
                v1 += v
                U += v.outer_product(s)
        self.dev.total[b], self.dev.p[b], self.dev.q[b], self.dev.s[b] = total, p1, q1, s1
        self.keep(self.dev.K, b, K)
        self.keep(self.dev.X, b, X)
        if ti.static(self.dev.spring.soft):
            self.dev.v[b] = v1
            self.keep(self.dev.U, b, U)

    @ti.func
    def moments(self, c):
        """Sum of mu, means of p, q and s, and the moments of q and p, about these means."""
        total, p, q, s = ti.cast(0, ti.f64), self.nothing(), self.nothing(), self.nothing()
        K = p.outer_product(p)
        X = 0 * K
        for b in range(self.dev.corners.blocks[c], self.dev.corners.blocks[c + 1]):
            total += self.dev.total[b]
            p += self.dev.p[b]
            q += self.dev.q[b]
            s += self.dev.s[b]
            K += self.kept(self.dev.K, b)
            X += self.kept(self.dev.X, b)
        p, q, s = p / total, q / total, s / total
        return total, p, q, s, K - total * q.outer_product(s), X - total * p.outer_product(s)

    @ti.func
    def keep(self, field: ti.template(), c, R):
        """Write a matrix."""
        for j in ti.static(range(self.dev.state.dim)):
            for k in ti.static(range(self.dev.state.dim)):
                field[c][self.dev.state.dim * j + k] = R[j, k]

    @ti.func
    def kept(self, field: ti.template(), c):
        """Read a matrix."""
        dim = ti.static(self.dev.state.dim)
        return ti.Matrix([[field[c][dim * j + k] for k in ti.static(range(dim))] for j in ti.static(range(dim))])

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Find where the cluster goes."""
        if self.dev.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            rigid, soft, now, last, give = self.law(c, h, h2_effective, fresh)
            mean, U = 0 * p, 0 * K
            if ti.static(self.dev.spring.soft):
                for b in range(self.dev.corners.blocks[c], self.dev.corners.blocks[c + 1]):
                    mean += self.dev.v[b] / total
                    U += self.kept(self.dev.U, b)
                U -= total * mean.outer_product(s)
            start, end, cosine = rotation.turn(K, X, U, first > 0, rigid, soft, self.dev.turn[c], LEAST, self.dev.spring.soft)
            pose = rotation.matrix(end)
            self.dev.turn[c], self.dev.place[c] = end, p - pose @ q
            self.keep(self.dev.pose, c, pose)
            self.dev.slots.note_turn(self.dev.slots.turn(cosine, 1.0))
            if ti.static(self.dev.spring.soft):
                R = rotation.matrix(start)
                if first > 0:  # in the frame of the body
                    mean = R @ mean
                self.dev.middle[c], self.dev.mean[c] = s - R @ q, mean
                self.keep(self.dev.fit, c, R)

    @ti.func
    def push_spring_force(self, c, h):
        """Find where the cluster is; scatter_corner() then adds h^2 times what its springs do now."""
        if self.dev.mass[c] > 0:
            total, p, q, s, K, X = self.moments(c)
            R = rotation.matrix(rotation.fit(K, self.dev.turn[c], LEAST))
            self.dev.place[c] = s - R @ q
            self.keep(self.dev.pose, c, R)

    @ti.func
    def push_reaction(self, c, firm, soft):
        """What moved each corner, less its moment about the present places: as what turns the cluster, of least sum m move^2.

        Moves have no moment about the places at the start. Where something cannot move, forces from outside have one.
        """
        begin, end, i0 = self.dev.corners.starts[c], self.dev.corners.starts[c + 1], self.dev.corners.hub(c)
        scale = firm
        if ti.static(self.dev.spring.soft):
            scale = ti.select(self.dev.spring.alpha[c] > 0, soft, firm)
        total, mean, pull, held = ti.cast(0, ti.f64), self.nothing(), self.nothing(), False
        S = mean.outer_product(mean)
        X = 0 * S
        for e in range(begin, end):
            held = held or self.dev.w.of(self.dev.corners.members[e]) == 0
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
            self.dev.corners.give(e, ti.cast(scale * move, self.dev.real))

    @ti.func
    def off(self, e, c):
        """C_i at the present places."""
        return self.arm(e, self.dev.corners.hub(c), 0) - self.dev.place[c] - self.kept(self.dev.pose, c) @ self.dev.shape[e]

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """Move corner e towards its place."""
        c, i = self.dev.corners.owner[e], self.dev.corners.members[e]
        w, relaxation = self.dev.w.of(i), self.dev.slots.relaxation
        if first > 0:
            self.dev.pull[e] = ti.cast(self.nothing(), self.dev.real)
        if not self.dev.strength.holds(c):
            self.dev.corners.give(e, ti.cast(self.nothing(), self.dev.real))
        elif w > 0:
            C, n = self.off(e, c), self.dev.slots.split[i] / w
            if ti.static(not self.dev.spring.soft):
                move = ti.cast(-relaxation * C / n, self.dev.real)
                if first >= 0:
                    self.dev.pull[e] = self.dev.pull[e] + move
                self.dev.corners.give(e, move)
            elif first < 0:
                self.dev.corners.give(e, ti.cast(self.spring(e, c, C, h), self.dev.real))
            else:
                rigid, soft, now, last, give = self.law(c, h, h2_effective, fresh)
                if first > 0:
                    self.look_back(e, c, h, now, last, fresh)
                C = self.wrong(e, c, C, rigid, soft, give)
                move = ti.cast(-relaxation * C / ((rigid + soft) * n + give), self.dev.real)
                self.dev.pull[e] = self.dev.pull[e] + move
                self.dev.corners.give(e, move)

    @ti.func
    def wrong(self, e, c, C, rigid, soft, give):
        """C* + alpha' lam of a soft cluster, with the soft part of C_(n+1) = C in the frame at the start."""
        back = self.kept(self.dev.fit, c) @ (self.kept(self.dev.pose, c).transpose() @ C)
        return rigid * C + soft * back + self.dev.spring.history[e] + give * self.dev.pull[e] - self.dev.mean[c]

    @ti.func
    def look_back(self, e, c, h, now, last, fresh):
        """What C_n and C_(n-1) add to the violation; and flow, where the shape is plastic."""
        R = self.kept(self.dev.fit, c)
        C = self.arm(e, self.dev.corners.hub(c), 1) - self.dev.middle[c] - R @ self.dev.shape[e]
        self.dev.spring.history[e] = now * C + last * (
            R @ self.dev.spring.before(e, ti.cast(self.nothing(), self.dev.real), fresh)
        )
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
    def break_overloaded(self, c, h2_effective, tick):
        """Let cluster c fall apart if the force on one of its particles was too large."""
        if self.dev.strength.holds(c):
            most = ti.cast(0, self.dev.real)
            for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                w = self.dev.w.of(self.dev.corners.members[e])
                if w > 0:
                    most = ti.max(most, self.dev.pull[e].norm() / w)
            self.dev.strength.test(c, most, h2_effective, tick)

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """The largest violation that is left, by where the last pass turned the cluster, relative to its radius."""
        worst, total, mean, holds = ti.cast(0, ti.f64), ti.cast(0, ti.f64), self.nothing(), self.dev.strength.holds(c)
        rigid, soft, now, last, give = self.law(c, h, h2_effective, fresh)
        for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
            total += self.weight(e, c)
            mean += self.weight(e, c) * self.off(e, c)
        for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
            if self.dev.w.of(self.dev.corners.members[e]) > 0 and holds:
                C = self.off(e, c) - mean / total  # places are relative to a particle that has moved since
                if ti.static(self.dev.spring.soft):
                    C = self.wrong(e, c, C, rigid, soft, give)
                worst = ti.max(worst, C.norm())
        return ti.cast(worst / self.dev.size[c], self.dev.real)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Sum of m |C|^2 / (2 alpha M) at x - back d, about the best fit there, of what bears loads: see Spring.solved()."""
        out = ti.cast(0, ti.f64)
        if ti.static(self.dev.spring.soft):
            alpha, mass, i0 = self.dev.spring.alpha[c], self.dev.mass[c], self.dev.corners.hub(c)
            if alpha > 0 and mass > 0 and self.dev.strength.holds(c):
                total = ti.cast(0, ti.f64)
                s, q = self.nothing(), self.nothing()
                K = s.outer_product(q)
                for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                    mu = self.weight(e, c)
                    x = self.arm(e, i0, back)
                    total += mu
                    s += mu * x
                    q += mu * self.dev.shape[e]
                    K += mu * self.dev.shape[e].outer_product(x)
                s, q = s / total, q / total
                R = rotation.matrix(rotation.fit(K - total * q.outer_product(s), self.dev.turn[c], LEAST))
                most, borne = ti.cast(0, self.dev.real), ti.cast(0, ti.f64)
                for e in range(self.dev.corners.starts[c], self.dev.corners.starts[c + 1]):
                    C = self.arm(e, i0, back) - s - R @ (self.dev.shape[e] - q)
                    if self.dev.w.of(self.dev.corners.members[e]) > 0:
                        out += C.dot(C) / (2 * alpha * mass * self.dev.w.of(self.dev.corners.members[e]))
                        most = ti.max(most, self.dev.pull[e].norm())
                        pull = ti.cast(self.dev.pull[e].norm(), ti.f64)
                        if h2_effective > 0:
                            pull /= h2_effective
                        borne += pull * pull * alpha * mass / (2 * self.dev.w.of(self.dev.corners.members[e]))
                out *= self.dev.spring.solved(most * alpha * mass, h2_effective, residual * self.dev.size[c])
                out = self.dev.spring.energy(c, 1 / mass, h2_effective, out, borne)
        return out


def _near(members: np.ndarray, particles: Particles) -> np.ndarray:
    """Pairs of members of the same cluster less than 3 radii apart. members: of clusters, (m, k)."""
    x, r = particles.position[members], particles.radius[members]
    out = [np.zeros((0, 2), dtype=np.int32)]
    for k in range(members.shape[1] - 1):
        near = ((x[:, k + 1 :] - x[:, k : k + 1]) ** 2).sum(axis=2) < (1.5 * (r[:, k + 1 :] + r[:, k : k + 1])) ** 2
        c, j = np.nonzero(near)
        out.append(np.stack([members[c, k], members[c, k + 1 + j]], axis=1))
    return np.concatenate(out).astype(np.int32)
