"""Clusters of particles with a shape at rest: their arrays and fields, and the sums over their particles."""

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import Knob, Scene
from ...particles import Particles
from . import rotation
from .spring import Spring, stiff
from .strength import Strength, strength_of
from .variable_size import Ragged, rows

HEAVY = 1024  # masses of the cluster: what a particle that cannot move weighs in it


class Clusters(Ragged):
    """The half of ShapeMatch that does not move anything: shapes, stiffnesses, and moments about the places at the start."""

    each = ("compliance", "damping", "creep", "yield_strain", "break_at")
    index_name = "clusters"
    compliance = Knob(lambda f, v: f._setting("compliance", v), "Inverse stiffness [m/N], (m,).", force=True)
    damping = Knob(lambda f, v: f._setting("damping", v), "Of the dashpots [N s/m], (m,).", force=True)
    creep = Knob(lambda f, v: f._setting("creep", v), "Rate of flow [1/s], (m,).")
    yield_strain = Knob(lambda f, v: f._setting("yield_strain", v), "Strain without flow, (m,).")
    break_at = Knob(strength_of, "Load beyond which a constraint breaks, (m,); None for never.")
    compiled_for = ("soft", "transcends", "breaks")

    def setup(self, clusters, rest, compliance, damping, creep, yield_strain, break_at) -> None:
        """Keep the arguments of __init__; what depends on the particles is checked in prepare()."""
        self.layout(rows(repr(self), "clusters", clusters, 1))
        self._rest = None if rest is None else checks.points(repr(self), "rest", rest)
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
        self.known_particles(particles, "clusters")
        rest = particles.position
        if self._rest is not None:
            rest = checks.points(repr(self), "rest", self._rest, dim=particles.dim, count=particles.count)
        q = rest[self.indices]
        m = np.where(np.isfinite(particles.mass), particles.mass, 1.0)[self.indices]
        total = np.bincount(self.owner, weights=m, minlength=self.count)
        center = np.stack([np.bincount(self.owner, weights=m * x, minlength=self.count) / total for x in q.T], axis=1)
        self._shape = q - center[self.owner]
        square = np.bincount(self.owner, weights=m * (self._shape**2).sum(axis=1), minlength=self.count)
        self._radius = np.sqrt(square / total)

    def renumber(self, number: np.ndarray, count: int) -> None:
        """Particles that come later have a place in the shape of all, which no cluster uses."""
        super().renumber(number, count)
        if self._rest is not None:
            rest = np.zeros((count, self._rest.shape[1]))
            rest[number[number >= 0]] = self._rest[number >= 0]
            self._rest = rest
            self.arguments = {**self.arguments, "rest": rest}

    def partners(self, particles: Particles) -> np.ndarray:
        """Particles of a cluster that are near each other may overlap; the rest cannot meet unless it is soft."""
        near = [_near(self.members_of(c), particles) for c in range(self.count)]
        return np.concatenate([*near, np.zeros((0, 2), dtype=np.int32)])

    def bind(self, scene: Scene) -> None:
        """Shapes, rotations, sums; for soft clusters multipliers and the memory of the averaged constraint."""
        super().bind(scene)
        name, dim, m, add = repr(self), scene.state.dim, self.count, scene.memory.field
        self.dev.plastic = self.transcends
        w = scene.inv_mass[self.indices]
        mass = np.bincount(self.owner, weights=np.divide(1, w, where=w > 0, out=np.zeros_like(w)), minlength=m)
        self.dev.mass = add(f"{name}.mass", m, values=mass)
        self.dev.size = add(f"{name}.radius", m, values=np.maximum(self._radius, 1e-6 * self.start.size))
        self.dev.shape = add(f"{name}.shape", self.corner_count, width=dim, values=self._shape, state=self.dev.plastic)
        turn = rotation.identity(dim)
        self.dev.pull = add(f"{name}.multiplier", self.corner_count, width=dim, state=True)
        self.dev.strength = Strength(scene, name, self)
        self.dev.turn = add(f"{name}.turn", m, width=len(turn), kind=ti.f64, values=[turn] * m, state=True)
        self.dev.pose = add(f"{name}.pose", m, width=dim * dim, kind=ti.f64)
        self.dev.place = add(f"{name}.place", m, width=dim, kind=ti.f64)

        def moment(what, width):
            return add(f"{name}.{what}", self.blocks, width=width, kind=ti.f64)

        self.dev.total = moment("total", 0)
        self.dev.p, self.dev.q, self.dev.s = moment("p", dim), moment("q", dim), moment("s", dim)
        self.dev.K, self.dev.X = moment("K", dim * dim), moment("X", dim * dim)
        compliance, damping = (self.compliance, self.damping) if self.soft else (None, None)
        self.dev.spring = Spring(scene, name, compliance, damping, np.zeros((self.corner_count, dim)))
        if self.dev.spring.soft:
            self.dev.v, self.dev.U = moment("v", dim), moment("U", dim * dim)
            self.dev.fit = add(f"{name}.fit", m, width=dim * dim, kind=ti.f64)
            self.dev.middle = add(f"{name}.middle", m, width=dim, kind=ti.f64)
            self.dev.mean = add(f"{name}.mean", m, width=dim, kind=ti.f64)
        if self.dev.plastic:
            self.dev.creep = add(f"{name}.creep", m, values=self.creep)
            self.dev.yield_size = add(f"{name}.yield", m, values=self.yield_strain * self._radius)
        self.changed = False

    @ti.func
    def arm(self, e, i0, back):
        """Corner e relative to particle i0, at x - back d; in f64, so that places at the start and predicted ones differ by d."""
        i = self.dev.members[e]
        move = ti.cast(self.dev.state.d[i], ti.f64) - ti.cast(self.dev.state.d[i0], ti.f64)
        return ti.cast(self.dev.state.apart(i, i0), ti.f64) - back * move

    @ti.func
    def law(self, c, h, hh, fresh):
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
                give = alpha * mass / hh
        return rigid, soft, now, last, give

    @ti.func
    def share(self, e, A, give):
        """mu of corner e in a pass: its mass, times what a violation of 1 moves it."""
        i = self.dev.members[e]
        w, mu = self.dev.w.of(i), ti.cast(HEAVY * self.dev.mass[self.dev.owner[e]], ti.f64)
        if w > 0:
            mu = 1 / ti.cast(A * self.dev.slots.split[i] + give * w, ti.f64)
        return mu

    @ti.func
    def weight(self, e, c):
        """The mass of corner e in a fit."""
        w, mu = self.dev.w.of(self.dev.members[e]), ti.cast(HEAVY * self.dev.mass[c], ti.f64)
        if w > 0:
            mu = ti.cast(1, ti.f64) / w
        return mu

    @ti.func
    def weigh(self, b, h, hh, first, fresh):
        """The moments of a block about the places s at the start: of shapes q, predicted places p, and of what else pulls."""
        begin, end, c = self.dev.block[b]
        i0 = self.hub(c)
        rigid, soft, now, last, give = self.law(c, h, hh, fresh)
        total, p1, q1, s1 = ti.cast(0, ti.f64), 0 * self.dev.place[0], 0 * self.dev.place[0], 0 * self.dev.place[0]
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
                v = mu * last * self.dev.spring.last[e]
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
        total, p, q, s = ti.cast(0, ti.f64), 0 * self.dev.place[0], 0 * self.dev.place[0], 0 * self.dev.place[0]
        K = p.outer_product(p)
        X = 0 * K
        for b in range(self.dev.blocks[c], self.dev.blocks[c + 1]):
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
        for j in ti.static(range(self.dev.dim)):
            for k in ti.static(range(self.dev.dim)):
                field[c][self.dev.dim * j + k] = R[j, k]

    @ti.func
    def kept(self, field: ti.template(), c):
        """Read a matrix."""
        return ti.Matrix(
            [[field[c][self.dev.dim * j + k] for k in ti.static(range(self.dev.dim))] for j in ti.static(range(self.dev.dim))]
        )


def _near(members: np.ndarray, particles: Particles) -> np.ndarray:
    """Pairs of members less than 3 radii apart."""
    x, r = particles.position[members], particles.radius[members]
    out = []
    for k in range(len(members) - 1):
        near = ((x[k + 1 :] - x[k]) ** 2).sum(axis=1) < (1.5 * (r[k + 1 :] + r[k])) ** 2
        j = members[k + 1 :][near]
        out.append(np.stack([np.full(len(j), members[k]), j], axis=1))
    return np.concatenate([*out, np.zeros((0, 2))]).astype(np.int32)
