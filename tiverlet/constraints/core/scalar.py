"""Constraints on one number, C = f - rest: their arguments, rest values and loads."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ... import checks
from ...device.interrupts import in_turn
from ...features.feature import Batch, Knob, Scene
from ...features.flag import BREAKS, SOFT, Flag
from ...features.items import Items
from ...features.read_only import as_read_only, assign_whole_advice
from ...features.regrouping import Regrouping
from ...geometry.ordered import distinct
from .corner_passes import CornerPasses
from .drive import Drive
from .equation import SMALLEST
from .members import Members
from .outline_passes import OutlinePasses
from .quantity import Quantity, checked
from .ramp import Ramp
from .spring import SOFTEST, bears_nothing, per_newton
from .strength import strength_of

if TYPE_CHECKING:
    from ...particles import Particles


class Scalar(Batch):
    """Constraints C(x) = f(x) - rest = 0, >= 0 or <= 0, soft or rigid; f is its `quantity`.

    This class has the host's part: arguments and reports. Equation has the law of the multiplier. CornerPasses or OutlinePasses
    have the passes of a substep.

    Assigned rest values are reached during the next frame, see Ramp; at once where particles are placed. Where f is curved
    (angles, areas, volumes), steps of rigid constraints are limited, see StepLimit.
    """

    host_only = ("_alone", "_made_for", "_rest_given", "_scene_sized")

    index_name = "pairs"
    measures: type[Quantity] = Quantity  # f, of a fixed number of corners
    quantity: Quantity  # f of the batch's constraints
    side = 0  # 0: C = 0;  1: C <= 0, pulls when f > rest;  -1: C >= 0, pushes when f < rest
    rest: Any  # a Knob in each constraint: (m,) array
    compliance = Knob(Items("compliance", least=0.0, most=SOFTEST), "Of springs.", force=True)
    damping = Knob(Items("damping", least=0.0), "Of the dashpot.", force=True)
    break_at = Knob(strength_of, "Load beyond which a constraint breaks, (m,); None for never.")
    compiled_for = ("soft", "rigid", "damped", "breaks", "limited", "cusp", "capped")
    soft, breaks = SOFT, BREAKS
    rigid = Flag(lambda f: (f.compliance == 0).any(), "Whether any constraint has no compliance.")
    damped = Flag(lambda f: f.soft and (f.damping > 0).any(), "Whether any constraint has a dashpot.")
    limited = Flag(lambda f: f.quantity.curved and (f.compliance == 0).any(), "Whether steps have to be limited, see StepLimit.")
    cusp = Flag(
        lambda f: f.quantity.has_cusp_at_zero and (f.goal == 0).any(),
        "Whether any rest value is an f where the gradient is discontinuous: no direction is defined at f = 0.",
    )
    capped = Flag(lambda f: f.driven and np.isfinite(f.course()[2]).any(), "Whether any load of a drive is limited.")

    each = ("rest", "compliance", "damping", "break_at")
    uploads_all = True
    _scene_sized = False  # whether any constraint without a size of its own takes the size of the whole scene
    can_extend = True

    def setup(self, indices, rest, compliance, damping, break_at=None) -> None:
        """Store the arguments of __init__; prepare() checks what depends on the particles."""
        self.set_listing(indices)
        if rest is not None:
            type(self).rest.check(self, rest)
        self._warn_duplicates(rest)
        self._rest_given = rest
        self.break_at, self.compliance, self.damping = break_at, compliance, damping

    def quantity_of(self, indices) -> Quantity:
        """Return f of these particles, given as the user gives them."""
        return self.measures(self.fixed(indices, self.measures.arity))

    def fixed(self, indices, arity: int) -> Members:
        """Check the indices of constraints on `arity` particles each, and return them as members."""
        return Members(type(self).__name__, checks.indices(repr(self), self.index_name, indices, checks.ANY, arity=arity))

    def hold(self, quantity: Quantity) -> None:
        """Use this f, and act on its particles."""
        self._keep(quantity=checked(self, quantity), members=quantity.members, arity=quantity.members.arity)

    def check_indices(self, particles: "Particles") -> None:
        """Raise ValueError where a constraint names a particle that does not exist."""
        self.members.check(repr(self), self.index_name, particles.count)

    def _warn_duplicates(self, rest) -> None:
        """Warn of constraints that are given twice, at the line that created them. rest: as the user gives it."""
        if not self.arity:
            return
        ordered = self.indices.copy()
        for group in self.quantity.exchangeable:
            ordered[:, group] = np.sort(ordered[:, group], axis=1)
        unique, which, counts = distinct(ordered)
        if len(unique) < len(ordered):
            first = tuple(int(v) for v in unique[int(np.argmax(counts > 1))])
            given = np.broadcast_to(0.0 if rest is None else rest, len(ordered))
            what = "They act together: the same result where rigid, stiffer by their number where compliant."
            if len(distinct(np.column_stack([which, given]))[0]) > len(unique):
                outcome = "the tightest holds" if self.side else "rigid ones contradict each other"
                what = f"Their rest values differ: {outcome}."
            twice = len(ordered) - len(unique)
            checks.warn(f"{self!r}: {twice} of the {self.index_name} are duplicates, the first of them {first}. {what}")

    @property
    def transcends(self) -> bool:
        """Whether f needs angles, cube roots or exponentials."""
        return self.quantity.transcends

    @property
    def listing(self) -> Any:
        """The particles of each constraint, as the user gives them."""
        return self.quantity.listing

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the constraints in the mask `some`, with the new numbers of their particles."""
        self.hold(self.quantity.remapped(some, number))

    def excluded_pairs(self, particles: "Particles") -> np.ndarray:
        """Return pairs that may overlap: all corners of a constraint, but only neighbours of an outline."""
        return self.quantity.pairs()

    def max_distances(self) -> tuple[np.ndarray, np.ndarray]:
        """Return rigid links and ropes that nothing drives or breaks, and their initial lengths."""
        if not self.quantity.is_distance or self.side < 0 or self.driven or self.breaks or self.soft or not self.count:
            return super().max_distances()
        return self.indices, self.rest_of(self.start.position)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Return f of corners x (m, arity, dim), (m,); for outlines, of all positions (n, dim)."""
        return self.quantity.values(x)

    def set_listing(self, listing: Any) -> None:
        """Act on these particles, given as the user gives them."""
        self.hold(self.quantity_of(listing))

    def can_regroup(self, change: Regrouping) -> bool:
        """Whether no particle of the batch goes or gets another number, and no constraint takes the size of the whole scene."""
        return not (self.indices >= change.first).any() and not self._scene_sized

    def rest_of(self, position: np.ndarray) -> np.ndarray:
        """Return f at the given positions, (m,): the rest value when none is given."""
        return self.values(self.placed(position) if self.arity else position)

    def placed(self, position: np.ndarray) -> np.ndarray:
        """Return the corners of each constraint, (m, arity, dim); in a periodic box the images nearest to the first one."""
        x = position[self.indices]
        return x if self.periodic is None else x[:, :1] + self.periodic.difference(x, x[:, :1])

    @property
    def goal(self) -> np.ndarray:
        """The value that f is to reach, (m,)."""
        return self.rest

    def tracks(self) -> list[tuple[Any, np.ndarray, Callable]]:
        """List what an assignment of rest values moves: fields, their goals, and the function for differences of values."""
        return [(self.dev.equation.rest, self.goal, self.quantity.difference)]

    @property
    def ramp(self) -> Ramp | None:
        """The ramp of rest values, while the batch is bound."""
        return self.dev.equation.ramp if "equation" in vars(self.dev) else None

    def violation(self, position: np.ndarray) -> np.ndarray:
        """Return C at the given positions, (m,), with the rest values of the state: before a ramp, those at which it begins."""
        rest = self.ramp.now()[0] if self.ramp and self.ramp.under_way else self.goal
        return self.quantity.difference(self.rest_of(position), rest)

    def gradients(self, position: np.ndarray) -> np.ndarray:
        """Return grad_k f of every constraint at the given positions, (m, arity, dim); for outlines (total, dim)."""
        return self.quantity.gradients(self.placed(position) if self.arity else position)

    def weights(self, position: np.ndarray, w: np.ndarray | None = None) -> np.ndarray:
        """Return the sum of w |grad f|^2 of every constraint at the given positions, (m,). w: (n,), None for inverse masses."""
        w, squares = (self.scene.inv_mass if w is None else w)[self.indices], (self.gradients(position) ** 2).sum(axis=-1)
        return (w * squares).sum(axis=1) if self.arity else np.bincount(self.owner, w * squares, minlength=self.count)

    def inverse_size(self, position: np.ndarray) -> np.ndarray:
        """Return the factor that makes C relative to the size of its constraint, (m,): 1 / length for links.

        A link between particles in one place counts with the mean length of the others, or else the size of the scene. Other
        constraints without extent get 0.
        """
        squares = self.gradients(position) ** 2
        if self.arity:
            x = self.placed(position)
            size = np.linalg.norm(x - x[:, :1], axis=2).max(axis=1, initial=0.0)
            if self.quantity.is_distance:
                size = np.maximum(size, self.goal)
                some = size > SMALLEST * self.start.size
                size = np.where(some, size, size[some].mean() if some.any() else self.start.size)
            size *= np.sqrt(squares.sum(axis=(1, 2)) / 2)
        elif self.count:
            x, starts, owner = position[self.indices], self.members.starts, self.owner
            size = np.maximum.reduceat(np.linalg.norm(x - x[starts[owner]], axis=1), starts[:-1])
            size *= np.sqrt(np.bincount(owner, squares.sum(axis=1), minlength=self.count) / 2)
        else:
            size = np.zeros(0)
        return np.divide(1, size, out=np.zeros(self.count), where=size > 0)

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check indices against the number of particles, and set the rest values. Areas and volumes are positive at the start."""
        self.check_indices(particles)
        if self.quantity.collapses:
            for _ in range(2):  # twice: what is flat can be negative in both senses; it keeps its order, so a clone does, too
                self.hold(self.quantity.reversed(self.rest_of(particles.position) < 0))
        if "rest" not in self.__dict__:
            if self._rest_given is None:
                rest = self.rest_of(particles.position)
                self.start_from(np.maximum(rest, 0.0) if self.quantity.collapses else rest)  # may be below 0 by rounding
            else:
                self.rest = self._rest_given

    def start_from(self, rest: np.ndarray) -> None:
        """Set initial rest values (m,) that the user has not given, without marking the batch as changed."""
        self.__dict__["rest"] = as_read_only(rest, assign_whole_advice(type(self).__name__, "rest"))

    def review(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Warn of violated constraints between particles that cannot move."""
        stuck = self.immovable(inv_mass)
        if stuck.any():
            C = self.violation(particles.position)
            off = np.abs(C if self.side == 0 else np.maximum(self.side * C, 0))
            wrong = stuck & (off > 1e-6 * np.maximum(np.abs(self.goal), 1e-6))
            if wrong.any():
                k = int(np.argmax(wrong))
                at = tuple(int(i) for i in self.members_of(k))
                checks.warn(
                    f"{self!r}: {self.index_name}[{k}] = {at} is off by {C[k]:g}, but its particles cannot move "
                    f"({int(wrong.sum())} such in all). They are skipped."
                )

    def _values(self, scene: Scene) -> bytes:
        """Return the knobs that only the plan of a world depends on: compliances, and goals of links that imply others."""
        implies = self.solvable_together and not self.driven and scene.slots.system and scene.slots.system.has_implied
        return (self.compliance.tobytes() if implies or scene.order > 2 else b"") + (self.goal.tobytes() if implies else b"")

    def acts_as_force(self, scene: Scene) -> np.ndarray:
        """Return which constraints act as forces, (m,): soft ones in substeps of an order above 2. See high_order.py."""
        return (self.compliance > 0) & (scene.order > 2)

    def relaxed_alone(self, scene: Scene, bounded: bool = False) -> np.ndarray:
        """Return which constraints are never part of a system, (m,). bounded: of one whose multipliers may have bounds.

        These are constraints that act as forces, rigid ones at a cusp, and motors with a limited load; winches, too, where
        multipliers have no bounds.
        """
        if self.driven:
            return self.acts_as_force(scene) | (np.isfinite(self.course()[2]) & (not bounded or self.arity > 2))
        return self.acts_as_force(scene) | (self.cusp & (self.goal == 0) & (self.compliance == 0))

    @property
    def needs_other_kernels(self) -> bool:
        """Whether the world has to be rebuilt: also where others than before are relaxed alone now, and see _values()."""
        if not (self.scene and self.acts):
            return super().needs_other_kernels
        others = self.solvable_together and bool((self._alone != self.relaxed_alone(self.scene)).any())
        return super().needs_other_kernels or others or self._made_for != self._values(self.scene)

    def drive_of(self, scene: Scene) -> Drive:
        """Make the Drive that moves the rest values of a driven batch."""
        raise NotImplementedError

    def course(self) -> tuple[Any, Any, Any]:
        """Return the goals and the speeds of the rest values of a driven batch, and its largest loads, (m,) each."""
        raise NotImplementedError

    def start_at(self, position: np.ndarray, first: int) -> None:
        """Adapt a driven batch after particles from number `first` on were placed at `position`, (n, dim)."""

    @property
    def solvable_together(self) -> bool:
        """Whether constraints of the batch can be solved together with others: few corners, and a direction everywhere."""
        return self.arity > 0 and not self.quantity.collapses

    def passes(self, scene: Scene) -> Any:
        """Make the passes over a few corners, or over outlines."""
        start = self.rest_of(self.start.position) if self.count else np.zeros(0)
        return (CornerPasses if self.arity else OutlinePasses)(scene, self, start)

    def bind(self, scene: Scene) -> None:
        """Declare the fields, and note for which values the world is built."""
        super().bind(scene)
        self._alone, self._made_for = self.relaxed_alone(scene), self._values(scene)
        self._scene_sized = self.dev.limit.scene_sized or self.dev.equation.scene_sized
        self.changed = False

    def upload(self) -> None:
        """Write new stiffnesses and strengths to the device. New rest values are reached during the coming frame."""
        if self.acts:
            if self.driven:
                self.dev.drive.upload(*self.course())
            else:
                self.dev.equation.ramp.check_goals()
            self.dev.spring.upload(self.compliance, self.damping)
            self.dev.strength.upload(self.break_at)

    @property
    @in_turn
    def load(self) -> np.ndarray:
        """The force in each constraint during the last substep [N], (m,); positive where it pulls (f above rest).

        More exactly it is the force along grad f: newtons where f is a length, N m where f is an angle. In f32, rounding of
        positions adds about m ulp(x) / h^2, 1 N for 1 kg some 10 m from the origin at 1200 substeps/s; use f64 where that
        matters. break_at is not affected by it, see Strength.
        """
        if bears_nothing(self):
            return np.zeros(self.count)
        memory, factors = self.scene.memory, self.scene.multipliers_per_newton
        scale = per_newton(factors, self.compliance, lambda: self.weights(self.scene.state.get(memory)))
        return -scale * self.multipliers

    @property
    def multipliers(self) -> np.ndarray:
        """The multipliers of the last substep, (m,)."""
        return self.scene.memory.read(self.dev.equation.lam)[: self.count].astype(np.float64)
