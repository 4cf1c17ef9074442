"""Constraints that are one number, C = f - rest: how a substep fulfils them, from soft to rigid."""

import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device import ti
from ...features.feature import FAR, Batch, Knob, Scene
from ...features.regrouping import Regrouping
from ...geometry.ordered import distinct
from .drive import Drive
from .known_load import KnownLoad
from .members import FixedSize
from .outline import Outline
from .quantity import Quantity
from .ramp import Ramp
from .spring import Spring, stiff
from .step_limit import TRUST, StepLimit
from .strength import Strength, strength_of

if TYPE_CHECKING:
    from ...particles import Particles

RESOLVED = 4.0  # alpha' / W: from where on the substep resolves a spring
LOST = 0.015  # violation at the start of a substep, relative to the size, from where on its direction would bring in energy


class Scalar(Batch):
    """Constraints C(x) = f(x) - rest = 0, >= 0 or <= 0, soft or rigid; f is its `quantity`. One formula for all:

        theta = s^4 / (1 + s^4), s^2 = (omega h)^2 = w h^2 / alpha     0: resolved by the step, 1: rigid
        C*    = (1 - theta) (C_(n+1) + 2 C_n + C_(n-1)) / 4 + theta C_(n+1)
        dlam  = -(A C + B + alpha' lam) / (A W + alpha'),  A = (1 - theta)/4 + theta,  alpha' = alpha / h^2
        dx_j  = w_j dlam grad_j C(x_n)

    W = sum_j n_j w_j grad_j C(x_(n+1)) . grad_j C(x_n) is the mass-split weight: particle j belongs to n_j constraints, and
    gives each an n_j-th of its mass (Tonge 2012), which keeps the sum of all corrections stable and conserves momentum.
    The direction is that at the start of the step, x_n (SHAKE, Ryckaert 1977): second order and no loss of energy. When a
    constraint turns by more than 41 degrees in a step, or has no direction at x_n, the current direction takes its place; but
    springs that the step resolves, alpha' >= RESOLVED W, keep that of x_n, and are Verlet's kick. With the current one, a spring
    that goes through length 0 would get the push of the other side a step too early, each time, and gain energy.

    In the first substep after a start (`fresh`) the force acts for half a kick, alpha' = alpha / (h^2 / 2), and C* is made of
    C_(n+1) and C_n.
    With drag, alpha' = alpha / (phi h^2) with the factor phi that the exact solution gives every other acceleration.

    Rest values that are assigned are reached in the course of the next frame, see Ramp; at once where particles are placed. Where
    f is curved (angles, areas, volumes), steps of rigid constraints are limited, see StepLimit.
    """

    index_name = "pairs"
    measures: type[Quantity] = Quantity  # f, of a fixed number of corners
    quantity: Quantity  # the f of its constraints
    side = 0  # 0: C = 0;  1: C <= 0, pulls when f > rest;  -1: C >= 0, pushes when f < rest
    rest: Any  # a Knob in each constraint: (m,) array
    compliance = Knob(lambda f, v: checks.per_item(repr(f), "compliance", v, f.count, least=0.0), "Of springs.", force=True)
    damping = Knob(lambda f, v: checks.per_item(repr(f), "damping", v, f.count, least=0.0), "Of the dashpot.", force=True)
    break_at = Knob(strength_of, "Load beyond which a constraint breaks, (m,); None for never.")
    compiled_for = ("soft", "damped", "breaks", "limited", "cusp", "capped")

    each = ("rest", "compliance", "damping", "break_at")
    rest_name = "rest"
    uploads_all = True
    _scene_sized = False  # whether any of its constraints, which has no size of its own, has that of the whole scene
    grows = True

    def setup(self, indices, rest, compliance, damping, break_at=None) -> None:
        """Keep the arguments of __init__; what depends on the particles is checked in prepare()."""
        self.keep_indices(indices)
        self._rest_given = rest
        self.break_at, self.compliance, self.damping = break_at, compliance, damping

    def keep_indices(self, indices) -> None:
        """Keep the particles of each constraint."""
        self.hold(self.quantity_of(indices))
        self._warn_duplicates()

    def quantity_of(self, indices) -> Quantity:
        """f of these particles, given as the user gives them."""
        return self.measures(self.fixed(indices, self.measures.arity))

    def fixed(self, indices, arity: int) -> FixedSize:
        """The same number of particles for each constraint, checked."""
        return FixedSize(type(self).__name__, checks.indices(repr(self), self.index_name, indices, checks.ANY, arity=arity))

    def hold(self, quantity: Quantity) -> None:
        """Take this f, and act on its particles."""
        self._keep(quantity=quantity, members=quantity.members, arity=getattr(quantity.members, "arity", 0))

    def check_indices(self, particles: "Particles") -> None:
        """Check the particles of each constraint against those that there are."""
        self.members.check(repr(self), self.index_name, particles.count)

    def _warn_duplicates(self) -> None:
        if not self.arity:
            return
        ordered = self.indices.copy()
        for group in self.quantity.exchangeable:
            ordered[:, group] = np.sort(ordered[:, group], axis=1)
        unique, _, counts = distinct(ordered)
        if len(unique) < len(ordered):
            first = tuple(int(v) for v in unique[int(np.argmax(counts > 1))])
            warnings.warn(
                f"{self!r}: {len(ordered) - len(unique)} of the {self.index_name} are duplicates, the first of them {first}. "
                "They act together: the same result where rigid, stiffer by their number where compliant.",
                stacklevel=5,
            )

    @property
    def transcends(self) -> bool:
        """Whether it takes angles, cube roots or exponentials."""
        return self.quantity.transcends

    @property
    def cusp(self) -> bool:
        """Whether any rest value is an f at which gradients end (f = 0), or was when kernels were compiled: directions mean
        nothing there."""
        return self.quantity.ends and bool((self.goal == 0).any()) or vars(self.dev).get("cusp", False)

    @property
    def reweighs(self) -> bool:
        """Whether residual_of() needs reduce_block(), as for outlines."""
        return self.arity == 0

    @property
    def listing(self) -> Any:
        """The particles of each constraint, as the user gives them."""
        return self.quantity.listing

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep these constraints, by the new numbers of their particles."""
        self.hold(self.quantity.remapped(some, number))

    def excluded_pairs(self, particles: "Particles") -> np.ndarray:
        """All corners of a constraint may overlap, but of outlines only neighbours."""
        return self.quantity.pairs()

    def values(self, x: np.ndarray) -> np.ndarray:
        """f of corners x (m, arity, dim), (m,); of outlines, of all positions (n, dim)."""
        return self.quantity.values(x)

    def hold_all(self, listing: Any) -> None:
        """Act on these particles, given as the user gives them."""
        self.hold(self.quantity_of(listing))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether none of its particles goes or gets another number, and no length of it is that of the whole scene."""
        return not (self.indices >= change.first).any() and not self._scene_sized

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """f at the given positions, (m,): the rest value when none is given."""
        return self.values(self.placed(position) if self.arity else position)

    def placed(self, position: np.ndarray) -> np.ndarray:
        """Where the corners of each constraint are, (m, arity, dim); in a periodic box the images nearest to the first."""
        x = position[self.indices]
        return x if self.periodic is None else x[:, :1] + self.periodic.difference(x, x[:, :1])

    @property
    def goal(self) -> np.ndarray:
        """What f is to be, (m,)."""
        return self.rest

    def tracks(self) -> list[tuple[Any, np.ndarray, Callable]]:
        """What moves when rest values are assigned: fields, what they are to be, and how far values are from others."""
        return [(self.dev.rest, self.goal, self.quantity.difference)]

    @property
    def ramp(self) -> Ramp | None:
        """The ramp of rest values, while the batch is bound."""
        return vars(self.dev).get("ramp")

    def violation(self, position: np.ndarray) -> np.ndarray:
        """C at the given positions, (m,), with the rest values of the state: where a ramp is under way, those from which it
        begins."""
        rest = self.ramp.now()[0] if self.ramp and self.ramp.under_way else self.goal
        return self.quantity.difference(self.rest_of(position), rest)

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """grad_k f of every constraint at the given positions, (m, arity, dim); of outlines (total, dim)."""
        return self.quantity.gradients(self.placed(position) if self.arity else position)

    def inverse_size(self, position: np.ndarray) -> np.ndarray:
        """What makes C a share of the size of its constraint, (m,): 1 / length for links, 0 for what has no extent."""
        squares = self.gradients(position) ** 2
        if self.arity:
            x = self.placed(position)
            size = np.linalg.norm(x - x[:, :1], axis=2).max(axis=1, initial=0.0)
            size *= np.sqrt(squares.sum(axis=(1, 2)) / 2)
        elif self.count:
            x, starts, owner = position[self.indices], self.members.starts, self.owner
            size = np.maximum.reduceat(np.linalg.norm(x - x[starts[owner]], axis=1), starts[:-1])
            size *= np.sqrt(np.bincount(owner, squares.sum(axis=1), minlength=self.count) / 2)
        else:
            size = np.zeros(0)
        return np.divide(1, size, out=np.zeros(self.count), where=size > 0)

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check indices against the number of particles and settle the rest values."""
        self.check_indices(particles)
        if "rest" not in self.__dict__:
            if self._rest_given is None:
                self.__dict__["rest"] = self.rest_of(particles.position)
            else:
                self.rest = self._rest_given

    def review(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Warn of constraints that are violated between particles that cannot move."""
        stuck = self.idle(inv_mass)
        if stuck.any():
            C = self.violation(particles.position)
            wrong = stuck & (
                np.abs(C if self.side == 0 else np.maximum(self.side * C, 0)) > 1e-6 * np.maximum(np.abs(self.goal), 1e-6)
            )
            if wrong.any():
                k = int(np.argmax(wrong))
                at = tuple(int(i) for i in self.members_of(k))
                warnings.warn(
                    f"{self!r}: {self.index_name}[{k}] = {at} is off by {C[k]:g}, but its particles cannot move "
                    f"({int(wrong.sum())} such in all). They are skipped.",
                    stacklevel=3,
                )

    @property
    def soft(self) -> bool:
        """Whether any constraint of the batch has compliance, or had when kernels were compiled."""
        return bool((self.compliance > 0).any()) or self._built("spring", "soft")

    @property
    def damped(self) -> bool:
        """Whether any has a dashpot."""
        return self.soft and bool((self.damping > 0).any()) or self._built("spring", "damped")

    @property
    def breaks(self) -> bool:
        """Whether a load can break constraints of the batch."""
        return self.break_at is not None or self._built("strength", "breaks")

    @property
    def _strictly(self) -> bytes | None:
        """The compliances in a world of higher order, which is built for these values, though its kernels are not; else None."""
        return self.compliance.tobytes() if self.scene and self.scene.order > 2 else None

    def acts_as_force(self, scene: Scene) -> np.ndarray:
        """Which constraints act as forces, (m,): soft ones in substeps of an order above 2. See high_order.py."""
        return (self.compliance > 0) & (scene.order > 2)

    def relaxed_alone(self, scene: Scene) -> np.ndarray:
        """Which constraints no system takes, (m,): those that act as forces, rigid ones at a cusp, and drives with a limited
        load."""
        if self.driven:
            return self.acts_as_force(scene) | np.isfinite(self.largest)
        return self.acts_as_force(scene) | (self.cusp & (self.goal == 0) & (self.compliance == 0))

    @property
    def outgrown(self) -> bool:
        """Whether the world has to be built anew: others than before are to be relaxed alone, or compliances differ in a world of
        higher order. A world is what its knobs say, not how they came there."""
        if not (self.scene and self.acts):
            return super().outgrown
        others = self.solvable_together and bool((self._alone != self.relaxed_alone(self.scene)).any())
        return super().outgrown or others or self._made_for != self._strictly

    def drive_of(self, scene: Scene) -> Drive:
        """What moves the rest values of a driven batch."""
        raise NotImplementedError

    def course(self) -> tuple[Any, Any]:
        """Of a driven batch: where rest values go to, and how fast, (m,) each."""
        raise NotImplementedError

    @property
    def largest(self) -> Any:
        """Of a driven batch: the largest loads, (m,)."""
        raise NotImplementedError

    @property
    def capped(self) -> bool:
        """Whether any load of a drive is limited, or was when kernels were compiled."""
        return self.driven and bool(np.isfinite(self.largest).any()) or self._built("drive", "capped")

    def start_at(self, position: np.ndarray, first: int) -> None:
        """Of a driven batch: particles from number `first` on were placed at `position`, (n, dim)."""

    @property
    def limited(self) -> bool:
        """Whether steps have to be limited, see StepLimit, or had to be when kernels were compiled: f is curved, and any
        constraint rigid."""
        return self.quantity.curved and bool((self.compliance == 0).any()) or self._built("limit", "acts")

    @property
    def solvable_together(self) -> bool:
        """Whether constraints of the batch can be solved together with others: few corners, and a direction everywhere."""
        return self.arity > 0 and not self.quantity.collapses

    @property
    def learns_loads(self) -> bool:
        """Whether rigid constraints of the batch can know their loads: few corners, an f that neither is curved nor collapses, no
        drive."""
        return self.arity > 0 and not (self.driven or self.quantity.curved or self.quantity.collapses)

    def bind(self, scene: Scene) -> None:
        """Declare rest values, multipliers, springs and strengths; and, for solvers, which rows of a system constraints are."""
        super().bind(scene)
        self._alone, self._made_for = self.relaxed_alone(scene), self._strictly
        self.dev.forces = bool(self.acts_as_force(scene).any())
        start = self.rest_of(self.start.position) if self.count else np.zeros(0)
        scale = self.quantity.unit or (float(np.abs(start).mean()) if np.any(start) else self.start.size)
        self._scene_sized = not self.quantity.unit and not np.any(start)
        self.dev.scale = scene.memory.number(scale, scene.real)
        name, m, add = repr(self), self.count, scene.memory.field
        self.dev.rest = add(f"{name}.rest", m, values=self.goal, state=self.driven)
        if self.driven:
            self.dev.drive = self.drive_of(scene)
        self.dev.lam = add(f"{name}.multiplier", m, state=True)
        compliance, damping = self.compliance if self.soft else None, self.damping if self.damped else None
        self.dev.spring = Spring(scene, name, compliance, damping, start)
        self.dev.strength = Strength(scene, name, self)
        self.changed = False
        rows = scene.slots.rows(self)
        self.dev.limit = StepLimit(scene, name, self)
        self._scene_sized |= self.dev.limit.scene_sized
        self.dev.in_system, self.dev.outside = bool((rows >= 0).any()), bool((rows < 0).any())
        if self.dev.in_system:
            self.dev.row = add(f"{name}.row", m, kind=ti.i32, values=rows)
        self.dev.cusp, self.dev.ramp = self.cusp, Ramp(scene.memory, self)
        self.dev.converges = self.solvable_together and (self.dev.in_system or bool(scene.slots.semi_iteration))
        if self.dev.converges:
            self.dev.inverse_size = add(f"{name}.close", m, values=self.inverse_size(self.start.position))
        self.dev.steps = bool(
            self.dev.converges and scene.slots.semi_iteration and self.dev.outside and not (self.side or self.driven)
        )
        if self.dev.steps:
            self.dev.step = add(f"{name}.step", m)
        self.dev.known = KnownLoad(scene, name, self)
        if not self.arity:
            self.dev.outline = Outline(scene, self)
        self.dev.quantity = self.quantity.bind(scene, self)

    def upload(self) -> None:
        """Write new stiffnesses and strengths; rest values go to new ones in the coming frame."""
        if self.acts:
            if self.driven:
                self.dev.drive.upload(*self.course(), self.largest)
            else:
                self.dev.ramp.assigned()
            self.dev.spring.upload(self.compliance, self.damping)
            self.dev.strength.upload(self.break_at)

    @property
    def load(self) -> np.ndarray:
        """The force in each constraint during the last substep [N], (m,); positive where it pulls (f above rest).

        More exactly the force along grad f: newtons where f is a length, N m where it is an angle. In f32, rounding of positions
        is felt as about m ulp(x) / h^2, 1 N for 1 kg some 10 m from the origin at 1200 substeps/s; use f64 where that matters.
        """
        if not self.count:
            return np.zeros(0)
        if self.scene is None:
            raise RuntimeError(f"{self!r}.load: there is none before a world has been stepped with it.")
        if not self.acts:
            return np.zeros(self.count)
        scale = 1 / self.scene.h2_effective if self.scene.h2_effective else 0.0
        return -scale * self.scene.memory.read(self.dev.lam)[: self.count].astype(np.float64)

    @property
    def sagging(self) -> np.ndarray:
        """The multipliers of the last substep without known loads, (m,): what violations bear."""
        known = self.dev.known
        lam = self.scene.memory.read(self.dev.lam)[: self.count].astype(np.float64)
        return lam - self.scene.memory.read(known.given)[: self.count] if known.learns else lam

    def forget_loads(self, some: np.ndarray) -> None:
        """Forget the known loads of some constraints, a mask (m,): their particles were put elsewhere."""
        if self.dev.known.learns:
            self.dev.known.forget(some)

    @ti.func
    def measure(self, c, q):
        """f and its (arity, dim) gradients at corners q (arity, dim), which are relative to corner 0."""
        return self.dev.quantity.measure(q)

    @ti.func
    def unwrap(self, f, other):
        """Of the values that mean the same as f, the one nearest to `other`; more than one only for angles."""
        return self.dev.quantity.unwrap(f, other)

    @ti.func
    def excess(self, c, f):
        """f - rest, to all digits where f is `precise`."""
        C = f - self.dev.rest[c]
        if ti.static(self.dev.quantity.precise):
            C = self.dev.quantity.excess(self.member(c, 0), self.member(c, 1), f, self.dev.rest[c])
        return C

    @ti.func
    def exactly(self, c):
        """C in f64, to all the digits that positions have."""
        return self.dev.quantity.exactly(self.member(c, 0), self.member(c, 1), self.dev.rest[c])

    @ti.func
    def direction_reliable(self, f, f0):
        """Whether directions at f (now) and f0 (at the start) are clear enough to tell a turn of 41 degrees."""
        return True

    @ti.func
    def start_substep(self, c, fresh):
        """Before the first pass of a substep: keep what measure() needs of its start."""

    @ti.func
    def corners(self, c, back):
        """Corners of constraint c relative to the first, at x - back d: near the origin, so nothing is lost in f32."""
        i = self.member(c, 0)
        q = ti.Matrix.zero(self.dev.real, self.arity, self.dev.state.dim)
        for k in ti.static(range(1, self.arity)):
            j = self.member(c, k)
            r = self.dev.state.apart(j, i) - back * self.dev.state.slid(self.dev.state.d[j] - self.dev.state.d[i], j, i)
            for a in ti.static(range(self.dev.state.dim)):
                q[k, a] = r[a]
        return q

    @ti.func
    def corners_now_and_start(self, c):
        """Corners of constraint c, as above, now and at the start of the substep."""
        i = self.member(c, 0)
        now = ti.Matrix.zero(self.dev.real, self.arity, self.dev.state.dim)
        start = now
        for k in ti.static(range(1, self.arity)):
            j = self.member(c, k)
            r, moved = self.dev.state.apart(j, i), self.dev.state.slid(self.dev.state.d[j] - self.dev.state.d[i], j, i)
            for a in ti.static(range(self.dev.state.dim)):
                now[k, a], start[k, a] = r[a] - 0 * moved[a], r[a] - moved[a]
        return now, start

    @ti.func
    def value(self, c, back):
        """f at x - back d."""
        f = ti.cast(0, self.dev.real)
        if ti.static(self.arity > 0):
            f, _ = self.measure(c, self.corners(c, back))
        else:
            f = self.dev.outline.value(c, back)
        return f

    @ti.func
    def bounded(self, value):
        """`value` where the constraint acts on its side, else 0."""
        if ti.static(self.side != 0):
            value = ti.max(self.side * value, 0) * self.side
        return value

    @ti.func
    def equation(self, c, f, f0, w, W, h, h2_effective, first, fresh):
        """A C + B + alpha' lam, A, alpha', lam and W (0 where it is broken), from f at the end and at the start, and w."""
        if ti.static(self.dev.strength.breaks):
            if not self.dev.strength.holds(c):
                W = 0
        if ti.static(self.dev.forces):
            if not self.dev.spring.is_rigid(c):
                W = 0
        C, A = self.excess(c, f), ti.cast(1, self.dev.real)
        B, alpha = ti.cast(0, self.dev.real), ti.cast(0, self.dev.real)
        lam = self.dev.lam[c]
        if first != 0:
            lam = 0
        if ti.static(self.dev.spring.soft):
            if W > 0:
                A, now, last = self.dev.spring.law(c, h, w, fresh)
                alpha = self.dev.spring.alpha[c] / h2_effective
                if first != 0:
                    f_last = self.unwrap(self.dev.spring.before(c, f0, fresh), f0)
                    B = now * self.bounded(self.violation_then(c, f0, 1)) + last * self.bounded(self.violation_then(c, f_last, 2))
                    self.dev.spring.history[c] = B
                    self.dev.spring.last[c] = f0
                else:
                    B = self.dev.spring.history[c]
            elif first != 0:  # it has no direction now, and may get one in a later pass
                self.dev.spring.history[c] = 0
                self.dev.spring.last[c] = f0
        return A * C + B + alpha * lam, A, alpha, lam, W

    @ti.func
    def violation_then(self, c, f, ago: ti.template()):  # type: ignore[valid-type]
        """f - rest with the rest value of `ago` substeps ago."""
        C = f - self.dev.rest[c]
        if ti.static(self.driven or self.dev.ramp.made):
            C += ago * self.step_of_rest(c)
        return C

    @ti.func
    def step_of_rest(self, c):
        """How far the rest value goes in this substep."""
        step = ti.cast(0, self.dev.real)
        if ti.static(self.driven):
            step = self.dev.drive.step[c]
        else:
            step = self.dev.ramp.step[c]
        return step

    @ti.func
    def clamped(self, c, lam):
        """A multiplier, limited to the largest load of a drive."""
        if ti.static(self.driven):
            lam = self.dev.drive.clamp(c, lam)
        return lam

    @ti.func
    def postpone(self, c, f0, W, share, first):
        """What of the violation is left for later substeps, see StepLimit. share: of the frame, that the substep is; 0 where none
        is."""
        out = ti.cast(0, self.dev.real)
        if first != 0:
            C = f0 - self.dev.rest[c]
            if ti.static(self.driven):  # the way that the drive goes in this substep is not postponed
                C += self.dev.drive.step[c]
            if self.dev.spring.is_rigid(c):
                out = self.dev.limit.postpone(c, self.bounded(C), W * ti.abs(self.dev.lam[c]), self.residual_scale(c), share)
            self.dev.limit.postponed[c] = out
        elif share > 0:
            out = self.dev.limit.postponed[c]
        return out

    @ti.func
    def linearise(self, c, h, h2_effective, share, first, fresh):
        """What every solver knows of constraint c in a pass; of the state it writes nothing but the memory of soft constraints.

        Returns the violation A C + B + alpha' lam, A, alpha', lam, the mass-split weight W (0: no corner can move), directions n
        and gradients g, both (arity, dim), how far it turned, see Slots.note_turn (n is g where too far), and C_(n+1) - C_n.
        """
        if first != 0:
            self.start_substep(c, fresh)
        now, start = self.corners_now_and_start(c)
        f, g = self.measure(c, now)
        f0, n = self.measure(c, start)
        f0 = self.unwrap(f0, self.dev.rest[c])
        f = self.unwrap(f, f0)
        w = ti.cast(0, self.dev.real)  # sum of w |grad|^2; then with split masses: of g . n, g . g, n . n
        both, here, there = ti.cast(0, self.dev.real), ti.cast(0, self.dev.real), ti.cast(0, self.dev.real)
        for k in ti.static(range(self.arity)):
            i = self.member(c, k)
            gg, split = g[k, :].dot(g[k, :]), self.dev.slots.split[i]
            w += self.dev.w.of(i) * gg
            both += split * g[k, :].dot(n[k, :])
            here += split * gg
            there += split * n[k, :].dot(n[k, :])
        turn = self.dev.slots.turn(both, ti.sqrt(here * there))
        lost = turn == FAR
        if self.has_cusp(c):
            lost, turn = True, 0
        if ti.static(self.dev.converges):
            if self.dev.spring.is_rigid(c):
                lost = lost or ti.abs(self.bounded(f0 - self.dev.rest[c])) * self.dev.inverse_size[c] > LOST
        if lost:
            resolved = False
            if ti.static(self.dev.spring.soft):
                resolved = self.dev.spring.alpha[c] >= RESOLVED * here * h2_effective
            if resolved:
                both = ti.max(both, here / RESOLVED)  # positive, and small beside alpha'
            else:
                n, both = g, here
        if ti.static(self.driven):
            if first != 0:
                alpha = ti.cast(0, self.dev.real)
                if ti.static(self.dev.spring.soft):
                    alpha = self.dev.spring.alpha[c]
                self.dev.rest[c] = self.dev.drive.advance(
                    c, f0, self.side, ti.max(here, both), alpha, self.dev.lam[c], h, h2_effective, self.residual_scale(c), fresh
                )
            f0 = self.unwrap(f0, self.dev.rest[c])
            f = self.unwrap(f, f0)
        violation, A, alpha, lam, W = self.equation(c, f, f0, w, both, h, h2_effective, first, fresh)
        if ti.static(self.dev.limit.acts):
            violation -= A * self.postpone(c, f0, W, share, first)
        return violation, A, alpha, lam, W, n, g, turn * ti.cast(self.direction_reliable(f, f0), ti.i32), f - f0

    @ti.func
    def has_cusp(self, c):
        """Whether constraint c is rigid and at a cusp: its directions mean nothing from one pass to the next."""
        out = False
        if ti.static(self.dev.cusp):
            out = self.dev.rest[c] == 0 and self.dev.spring.is_rigid(c)
        return out

    @ti.func
    def multiplier_of(self, c, violation, A, alpha, lam, W):
        """The multiplier after a Jacobi pass."""
        new = lam
        if W > 0:
            new = lam - self.dev.slots.relaxation * violation / (A * W + alpha)
            if ti.static(self.side != 0):
                new = -self.bounded(-new)
            new = self.clamped(c, new)
        return new

    @ti.func
    def jacobi_update(self, c, violation, A, alpha, lam, W, turn):
        """The same; where it changes, how far the constraint turned is noted."""
        new = self.multiplier_of(c, violation, A, alpha, lam, W)
        if new != lam:
            self.dev.slots.note_turn(turn)
        return new

    @ti.func
    def removed(self, c, violation, A, alpha, lam, W):
        """The size of the violation that a Jacobi pass would remove."""
        size = ti.cast(0, self.dev.real)
        if W > 0:
            new = self.multiplier_of(c, violation, A, alpha, lam, W)
            size = ti.abs(new - lam) * (A * W + alpha) / self.dev.slots.relaxation
        return size

    @ti.func
    def motion(self, c, n, together):
        """Of constraint c along n: the motion u in this substep, the mass-split weight W, the largest move of a corner by a
        multiplier of 1, and the largest motion of a corner, squared.

        Motions are relative to the first corner; u is relative to the rest value, where that moves.
        together: 1 where masses are split among all constraints, though some are solved together.
        """
        u, W, longest, fastest = (
            ti.cast(0, self.dev.real),
            ti.cast(0, self.dev.real),
            ti.cast(0, self.dev.real),
            ti.cast(0, self.dev.real),
        )
        for k in ti.static(range(self.arity)):
            i = self.member(c, k)
            j, split = self.member(c, 0), self.dev.slots.split[i]
            move = self.dev.state.slid(self.dev.state.d[i] - self.dev.state.d[j], i, j)
            if together != 0:
                split = self.dev.w.of(i) * (self.dev.slots.begin[i + 1] - self.dev.slots.begin[i])
            u += n[k, :].dot(move)
            W += split * n[k, :].dot(n[k, :])
            longest = ti.max(longest, self.dev.w.of(i) * n[k, :].norm())
            fastest = ti.max(fastest, move.norm_sqr())
        if ti.static(self.driven):
            u -= self.dev.drive.step[c]
        return u, W, longest, fastest

    @ti.func
    def limit_step(self, c, lam, new, n, share, together):
        """The multiplier `new`, or one that only takes out motion where StepLimit asks for it; and whether it is that."""
        far = False
        if self.dev.spring.is_rigid(c):
            u, W, longest, fastest = self.motion(c, n, together)
            reach, size = self.dev.quantity.reach(self.corners(c, 0)), self.residual_scale(c)
            new, far = self.dev.limit.limit(c, lam, new, u, W, longest, fastest, reach, size, share)
        return new, far

    @ti.func
    def reduce_block(self, b, h, h2_effective, first, fresh):
        """See Outline."""
        self.dev.outline.reduce_block(b)

    @ti.func
    def scatter_corner(self, e, h, h2_effective, first, fresh):
        """See Outline."""
        self.dev.outline.scatter_corner(e)

    @ti.func
    def relax(self, c, h, h2_effective, frame_fraction, first, fresh):
        """One Jacobi correction of constraint c."""
        if ti.static(self.dev.ramp.made):
            if first != 0:
                self.dev.ramp.follow(c, frame_fraction)
        if ti.static(self.arity == 0):
            self.dev.outline.relax(c, h, h2_effective, frame_fraction, first, fresh)
        else:
            self.relax_corners(c, h, h2_effective, frame_fraction, first, fresh)

    @ti.func
    def relax_corners(self, c, h, h2_effective, frame_fraction, first, fresh):
        """Move each corner by w_j dlam grad_j C. Where c belongs to a system, dlam comes from there: c tells it what it is about,
        and leaves w_j grad_j C."""
        share = frame_fraction[1] - frame_fraction[0]
        violation, A, alpha, lam, W, n, g, turn, moved = self.linearise(c, h, h2_effective, share, first, fresh)
        step = ti.cast(1, self.dev.real)
        if ti.static(self.dev.in_system):
            if self.dev.row[c] >= 0:
                self.tell_system(c, violation, A, alpha, lam, W, n, g, turn, moved, share)
        if ti.static(self.dev.outside):
            if self.outside_systems(c):
                if ti.static(self.dev.known.learns):
                    if first != 0:
                        violation += self.known_violation(c, violation - moved, W, h, h2_effective)
                step = self.relax_alone(c, violation, A, alpha, lam, W, n, turn, share, first)
        for k in ti.static(range(self.arity)):
            self.push(c, k, self.dev.w.of(self.member(c, k)) * step * n[k, :])

    @ti.func
    def tell_system(self, c, violation, A, alpha, lam, W, n, g, turn, moved, share):
        """Fill in the row of constraint c, from what linearise() returns. share: of the frame, that the substep is."""
        row, start, weight, new = self.dev.row[c], lam, W, lam
        if ti.static(self.dev.limit.acts):
            if W > 0:
                new = self.multiplier_of(c, violation, A, alpha, lam, W)
                new, far = self.limit_step(c, lam, new, n, share, 1)
                if far:  # its step is fixed, and the others follow: a row without a weight has the step -start
                    start, weight = lam - new, 0 * W
        self.dev.slots.system.set_row(row, violation, A, alpha, start, weight, self.geometric_stiffness(c, weight))
        if ti.static(self.dev.slots.system.limits_steps):
            u, split, longest, _ = self.motion(c, n, 0)
            spare, most = ti.math.inf + 0 * u, ti.math.inf + 0 * u
            if split > 0 and self.dev.spring.is_rigid(c):
                spare = 2 * (violation - moved) ** 2 / split
                if ti.static(self.dev.limit.acts):
                    most = TRUST * self.dev.quantity.reach(self.corners(c, 0)) / longest
            self.dev.slots.system.limit_row(row, u, spare, most, lam - new)
        for k in ti.static(range(self.arity)):
            self.dev.slots.system.set_gradient(self.dev.places[c][k], self.member(c, k), g[k, :])
        acts = violation != 0
        if ti.static(self.side != 0):  # one that is slack has a direction, but does nothing along it
            acts = self.side * violation > 0 or lam != 0
        if acts:
            self.dev.slots.note_turn(turn)

    @ti.func
    def relax_alone(self, c, violation, A, alpha, lam, W, n, turn, share, first):
        """Take the step of the multiplier of constraint c, which belongs to no system. Returns the step."""
        new = self.jacobi_update(c, violation, A, alpha, lam, W, turn)
        if ti.static(self.dev.quantity.collapses > 0):
            move = ti.cast(0, self.dev.real)
            for k in ti.static(range(self.arity)):
                w = self.dev.w.of(self.member(c, k))
                move += w * w * n[k, :].dot(n[k, :])
            new = self.dev.limit.limit_collapse(lam, new, self.dev.rest[c], self.corners(c, 0).norm_sqr(), move)
        step = new - lam
        if ti.static(self.dev.steps):
            last, wanted = self.dev.step[c], new
            if first != 0:
                last = 0
            if not self.has_cusp(c):  # there the last step had another direction
                wanted = lam + self.dev.slots.semi_iteration.step(last, step)
            step = self.dev.slots.limited(wanted, self.geometric_stiffness(c, W / 2)) - lam  # W has masses that are split by two
            new = lam + step
        if ti.static(self.dev.limit.acts):
            if W > 0:
                new, _ = self.limit_step(c, lam, new, n, share, 0)
                new = self.clamped(c, new)
                step = new - lam
        if ti.static(self.dev.steps):
            self.dev.step[c] = step
        self.dev.lam[c] = new
        if ti.static(self.dev.known.learns):
            if new == 0 and (W == 0 or ti.static(self.side != 0)):
                self.dev.known.let_go(c)
        return step

    @ti.func
    def known_violation(self, c, start, W, h, h2_effective):
        """The violation that would ask for the load that constraint c knows. start: the violation at the start of the substep."""
        out = 0 * start
        if W > 0 and self.dev.spring.is_rigid(c) and not self.has_cusp(c):
            missing = self.dev.slots.relaxation * start / W
            if ti.static(self.side != 0):
                missing = ti.select(self.side * (missing + h2_effective * self.dev.known.load[c]) > 0, missing, 0 * missing)
            out = -self.dev.known.give(c, missing, h, h2_effective) * W / self.dev.slots.relaxation
        return out

    @ti.func
    def weigh_load(self, c):
        """As a window ends: see KnownLoad.weigh()."""
        _, g = self.measure(c, self.corners(c, 0))
        _, _, most, _ = self.motion(c, g, 0)
        own = ti.cast(0, self.dev.real)
        for k in ti.static(range(self.arity)):
            own = ti.max(own, self.dev.known.weights.field[self.member(c, k)])
        self.dev.known.weigh(c, most, own)

    @ti.func
    def learn_load(self, c, h):
        """After that: see KnownLoad.learn()."""
        _, g = self.measure(c, self.corners(c, 0))
        _, W, _, fastest = self.motion(c, g, 0)
        self.dev.known.learn(c, h * h * W, self.residual_scale(c), ti.sqrt(fastest))

    @ti.func
    def geometric_stiffness(self, c, W):
        """(omega h)^2 of the fastest transverse vibration under a multiplier of 1: 4 w / l in a chain of links l, where W = 2
        w."""
        return 2 * W * self.dev.inverse_size[c]

    @ti.func
    def outside_systems(self, c):
        """Whether constraint c belongs to no system."""
        out = True
        if ti.static(self.dev.in_system):
            out = self.dev.row[c] < 0
        return out

    @ti.func
    def update_multiplier(self, c, first):
        """Add what the system has found to the multiplier."""
        if ti.static(self.dev.in_system):
            row = self.dev.row[c]
            if row >= 0:
                step = ti.cast(self.dev.slots.system.step[row], self.dev.real)
                if first != 0:
                    self.dev.lam[c] = step
                else:
                    self.dev.lam[c] = self.dev.lam[c] + step

    @ti.func
    def push_spring_force(self, c, h):
        """h^2 w_j F grad_j C with F = -(1 - theta) (C / alpha + damping dC/dt).

        Rigid links find their force in the next substep, but for the load that they know.
        """
        if ti.static(self.arity == 0):
            self.dev.outline.push_spring_force(c, h)
        else:
            f, g = self.measure(c, self.corners(c, 0))
            f = self.unwrap(f, self.dev.rest[c])
            f0, w = f, ti.cast(0, self.dev.real)
            if ti.static(self.dev.spring.damped):
                f0, _ = self.measure(c, self.corners(c, 1))
            for k in ti.static(range(self.arity)):
                w += self.dev.w.of(self.member(c, k)) * g[k, :].dot(g[k, :])
            force = self.spring_force(c, f, self.unwrap(f0, f), w, h)
            for k in ti.static(range(self.arity)):
                self.push(c, k, h * h * self.dev.w.of(self.member(c, k)) * force * g[k, :])

    @ti.func
    def spring_force(self, c, f, f0, w, h):
        """F of push_spring_force(), from f now and a substep ago."""
        force = ti.cast(0, self.dev.real)
        if ti.static(self.dev.spring.soft):
            alpha = self.dev.spring.alpha[c]
            if w > 0 and alpha > 0 and self.dev.strength.holds(c):
                resolved = ti.cast(1, self.dev.real)
                if ti.static(not self.dev.forces):
                    resolved -= stiff(alpha, h, w)
                C = self.bounded(f - self.dev.rest[c])
                force = -resolved * C / alpha
                if ti.static(self.dev.spring.damped):
                    if ti.static(self.side == 0) or C != 0:
                        force -= resolved * self.dev.spring.damping[c] * (f - f0) / h
                if ti.static(self.driven):
                    force = self.dev.drive.clamp_force(c, force)
        if ti.static(self.dev.known.learns):
            if self.dev.spring.is_rigid(c):
                force = -self.dev.known.load[c]
        return force

    @ti.func
    def push_reaction(self, c, firm, soft):
        """Push scale w_j lam grad_j C, by the scale `firm` where c is rigid, and `soft` where not, see Batch."""
        pull = self.dev.lam[c] * ti.select(self.dev.spring.is_rigid(c), firm, soft)
        if ti.static(self.dev.known.learns):
            if self.dev.spring.is_rigid(c):
                pull += (soft - firm) * self.dev.known.given[c]
        if ti.static(self.arity == 0):
            self.dev.outline.push_reaction(c, pull)
        else:
            _, g = self.measure(c, self.corners(c, 0))
            for k in ti.static(range(self.arity)):
                self.push(c, k, self.dev.w.of(self.member(c, k)) * pull * g[k, :])

    @ti.func
    def break_overloaded(self, c, h2_effective, tick):
        """Break constraint c if its load in this substep was too large; it acts no more from the next one on."""
        self.dev.strength.test(c, ti.abs(self.dev.lam[c]), h2_effective, tick)

    @ti.func
    def residual_of(self, c, h, h2_effective, frame_fraction, fresh):
        """The violation that is left, relative to the rest value (to the batch's mean f where that is 0). W is made of the
        current gradients alone: it cancels, unless the multiplier is bounded."""
        left = ti.cast(0, self.dev.real)
        if ti.static(self.arity == 0):
            left = self.dev.outline.violation_left(c, h, h2_effective, fresh)
        else:
            f, g = self.measure(c, self.corners(c, 0))
            f = self.unwrap(f, self.dev.rest[c])
            w, W = ti.cast(0, self.dev.real), ti.cast(0, self.dev.real)
            for k in ti.static(range(self.arity)):
                i, gg = self.member(c, k), g[k, :].dot(g[k, :])
                w += self.dev.w.of(i) * gg
                W += self.dev.slots.split[i] * gg
            violation, A, alpha, lam, W = self.equation(c, f, f, w, W, h, h2_effective, 0, fresh)
            left = self.removed(c, violation, A, alpha, lam, W)
            if ti.static(self.dev.quantity.collapses > 0):
                if g.norm_sqr() == 0 and self.dev.strength.holds(c):
                    left = ti.abs(self.bounded(f - self.dev.rest[c]))
        return left / self.residual_scale(c)

    @ti.func
    def energy(self, c, back, h2_effective, residual):
        """Elastic energy [J] at x - back d: F C / 2, which is C^2 / (2 alpha) once solved.

        See Spring.solved() and Spring.energy(). h2_effective: F = -lam / h2_effective; 0 where there was no substep yet.
        """
        out = ti.cast(0, ti.f64)
        if ti.static(self.dev.spring.soft):
            alpha = self.dev.spring.alpha[c]
            if alpha > 0 and self.dev.strength.holds(c):
                C = self.bounded(self.unwrap(self.value(c, back), self.dev.rest[c]) - self.dev.rest[c])
                out = ti.cast(C, ti.f64) * C / (2 * alpha)
                if ti.static(not self.dev.forces):
                    out *= self.dev.spring.solved(
                        ti.abs(self.dev.lam[c]) * alpha, h2_effective, residual * self.residual_scale(c)
                    )
                    force = ti.cast(self.dev.lam[c], ti.f64)
                    if h2_effective > 0:
                        force /= h2_effective
                    out = self.dev.spring.energy(c, self.weight(c), h2_effective, out, force * force * alpha / 2)
        return out

    @ti.func
    def weight(self, c):
        """The sum of w |grad f|^2."""
        w = ti.cast(0, self.dev.real)
        if ti.static(self.arity == 0):
            w = self.dev.outline.weight(c)
        else:
            _, g = self.measure(c, self.corners(c, 0))
            for k in ti.static(range(self.arity)):
                w += self.dev.w.of(self.member(c, k)) * g[k, :].dot(g[k, :])
        return w

    @ti.func
    def residual_scale(self, c):
        """What the residual of constraint c is relative to."""
        size = self.dev.scale.now
        if ti.static(not self.dev.quantity.unit):
            if self.dev.rest[c] != 0:
                size = ti.abs(self.dev.rest[c])
        return size
