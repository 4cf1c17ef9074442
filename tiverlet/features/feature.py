"""The contract of features: every force, constraint and collider keeps it. Also the guide to writing one.

A feature is a batch of arrays and one small kernel function. It checks its arguments in Python and declares its own fields. A
feature that is not in the scene takes no memory, no kernel code and no time. Kinds of features differ in what a substep calls:

    Acceleration   acceleration(i, x, v, t) of one particle, and/or a linear drag rate
    Batch          relax(c, ...) of one constraint: reads its particles, and writes their corrections into slots. Its Passes
                   (constraints/core/passes.py), which passes() makes, do this
    Scalar         (constraints/core/scalar.py) a Batch whose constraint is one number: name a Quantity with f and its gradients.
                   Scalar adds C = f - rest, compliance, damping, mass splitting, residual and load
    Anchored       (constraints/core/anchored.py) a Batch that draws each of its particles to a Place of its own
    Collider       (colliders/collider.py) confine(i, ...) of one particle, after all other corrections

A Batch holds the particles on which it acts in an object, `members` (constraints/core/members.py).

A new constraint on k particles is one file with one Scalar subclass. The class names its Quantity (constraints/core/quantity.py)
and has an __init__ that checks its arrays. See constraints/distance.py. Arrays with one row per constraint are named in `each`.
Values that depend on initial positions are computed from `self.start`, so that a world can be rebuilt around the feature
(step/build_again.py). Methods other than __init__ set attributes by self._keep(name=value), or under a name that begins with an
underscore: from outside only Knobs can be set.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.interrupts import in_turn
from ..device.language import inside_kernel
from ..device.number import Number
from .arguments import Knob as Knob
from .arguments import keep, knobs_of, names_for_users, record_arguments, refuse_deletion, set_attribute, state_alone
from .read_only import as_read_only, assign_whole_advice
from .unknown_names import answer_names

if TYPE_CHECKING:
    from ..device.memory import Memory
    from ..particles import Particles, State
    from .regrouping import Regrouping

OF_WORLD = ("start", "periodic", "changed", "moving", "new_force")  # attributes of a feature in a world
ONE = (float, int, str, np.generic, type(None))  # types of one value for all constraints
BENT, FAR = 1, 2  # a constraint turned in a substep by more than 26 degrees, by more than 41


@dataclass
class Scene:
    """The scene to which a feature is bound: memory for its fields, particles, and shared objects."""

    host_only = ("inv_mass", "residuals", "multipliers_per_newton", "periodic")

    memory: "Memory"
    state: "State"
    particles: "Particles"
    inv_mass: np.ndarray  # (n,) after pins: 0 for particles that constraints cannot move
    radius: Any = None  # set where a feature needs radii
    slots: Any = None  # the slots into which constraints write corrections
    bounces: bool = False  # whether there are walls, and particles bounce off these or off each other
    walls: Any = ()  # the colliders, as WallGroups
    impacts: Any = None  # the BodyImpacts, where linked particles may bounce off walls
    residuals: Any = None  # batch -> the residual of each of its violations after the last substep
    order: int = 2  # of the error in h
    periodic: Any = None  # the Periodic of the world
    # [s^2] multipliers of the last substep per newton, of rigid and of soft constraints: h2_effective, see Batch.relax. That of
    # rigid constraints includes the kick that they added where the substep was a start from velocities that lacked it.
    multipliers_per_newton: tuple[float, float] = (0.0, 0.0)

    @property
    def count(self) -> Number:
        """The number of particles, for kernels, and for fields with a row per particle."""
        return self.state.number

    @property
    def real(self):
        """The Taichi type of the world's real numbers."""
        return self.memory.real


@answer_names
class Feature:
    """The base class of all features.

    arguments: the arguments of its __init__. changed: a knob waits to be uploaded. new_force: the waiting knob changes a force.
    has_released_load: the feature no longer bears the load that it had in the last frame. needs_new_state: its state begins anew
    when the world is rebuilt. moving: a target is being approached. compiled_so_far: names of compiled_for that its kernels have
    used in this world; they stay in the kernels when the world is rebuilt.
    """

    arguments: Mapping[str, Any] = MappingProxyType({})
    kept_by_world: tuple[str, ...] = ("scene", *OF_WORLD, "arguments", "compiled_so_far")  # attributes that a world may set
    host_only: tuple[str, ...] = (*OF_WORLD, "arguments", "compiled_so_far", "_built_values")  # that kernels do not read
    for_users: tuple[str, ...] = ()  # attributes that users read, beside arguments and knobs, see names_for_users()
    uploads_all = False  # upload() and end_motion() also work for many worlds, where knobs have an additional first axis
    compiled_for: tuple[str, ...] = ()  # properties that decide the code of its kernels
    has_own_compile_time = True  # compile times are reported per class
    does_work = False  # it may add energy unknown to reports; motion that only a knob causes is seen by `changed`
    is_fixed_in_space = False  # it depends on places that are no knobs, so World.shift() cannot move it
    conserves = False  # it takes no energy out of the scene, as far as is known
    has_no_particle_data = False  # no data of it, on device or host, depends on which particles exist; see can_regroup()
    code_size = 0.3  # size of its kernel code relative to that of a Distance; see build.LONG
    changed = True
    moving = new_force = has_released_load = needs_new_state = False
    compiled_so_far: frozenset[str] = frozenset()
    scene: Any = None  # Scene, from bind() on
    periodic: Any = None  # the Periodic of its world, set before prepare()
    _built_values: dict[str, Any] | None = None  # build_values() when the world was built; None where the feature does nothing
    ramp: Any = None  # the Ramp of its rest values, while it is bound
    start: Any = None  # Particles as they were when it was added; used whenever it is bound again

    __setattr__, __delattr__, _keep = set_attribute, refuse_deletion, keep
    __getstate__, __dir__ = state_alone, names_for_users

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        record_arguments(cls)

    @functools.cached_property
    def dev(self) -> Any:
        """Its data on the device while it is bound: fields, and constants of the kernels."""
        return SimpleNamespace()

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check the arguments against the particles; set inv_mass to 0 for particles that this feature holds."""

    def review(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Warn of useless or contradictory arguments; called when inv_mass of all features is known."""

    def check_added(self, particles: "Particles", first: int) -> None:
        """Check particles that are added later, from number `first` on."""

    def bind(self, scene: Scene) -> None:
        """Declare fields with scene.memory.field(...). Called when the world is built, and again when it is rebuilt."""

    def upload(self) -> None:
        """Write changed knobs to the device. Called before a frame when `changed`."""

    def end_motion(self) -> None:
        """End a motion: the target of the last frame is where the next motion starts. Called when `moving`."""

    def compiled(self) -> dict[str, Any]:
        """Return the values that its kernels contain: knobs that are compiled, and the properties in compiled_for."""
        knobs = [name for name in knobs_of(type(self)) if getattr(type(self), name).compiled]
        return {name: getattr(self, name) for name in (*knobs, *self.compiled_for)}

    def build_values(self) -> dict[str, Any]:
        """Return compiled(), and the knobs for which worlds are built though kernels do not contain them."""
        knobs = [name for name in knobs_of(type(self)) if getattr(type(self), name).built]
        return self.compiled() | {name: getattr(self, name) for name in knobs}

    def note_built(self) -> None:
        """Note the values for which a world was built with it. A world in which it does nothing has no kernels for it."""
        acts = not isinstance(self, Batch) or self.acts
        self._built_values = self.build_values() if acts else None
        self.compiled_so_far |= {name for name in self.compiled_for if acts and getattr(self, name)}

    @property
    def needs_other_kernels(self) -> bool:
        """Whether its knobs need other kernels than it has, so that the world has to be rebuilt around it.

        What was compiled once stays when a knob no longer needs it, see `compiled_so_far`: changing friction from above 0 to 0
        compiles nothing. The additional code may change results in the last bits, so it also stays when the world is rebuilt,
        cloned or replayed.
        """
        return self._built_values is not None and self._built_values != self.build_values()

    def copy(self) -> "Feature":
        """Return the same feature, unbound, with the same arrays and knobs, for another world."""
        new = object.__new__(type(self))
        new.__dict__.update(vars(self))
        new.release()
        new.compiled_so_far = frozenset()
        return new

    def copy_with_kernels(self) -> "Feature":
        """Return a copy for a world of the same state, with the same kernels."""
        new = self.copy()
        new.compiled_so_far = self.compiled_so_far
        return new

    def release(self) -> None:
        """Forget the world in which it acted. `compiled_so_far` stays, since that world may be rebuilt with it."""
        for name in ("scene", *OF_WORLD, "dev", "_built_values"):
            self.__dict__.pop(name, None)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return masks of the rows that stay, one per group of its fields. number: new numbers of particles, -1 if removed."""
        return ()

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Renumber its particles, of which there are `count` now, and drop constraints and bodies with a removed particle."""

    def can_regroup(self, change: "Regrouping") -> bool:
        """Whether particles can be added and removed while it stays bound. If not, the world is rebuilt around it."""
        return self.has_no_particle_data

    def regroup(self, change: "Regrouping") -> None:
        """Set per-particle fields after particles were added and removed: to the rows of `change.now`, with 0 for new ones."""

    def check_extension(self, more: "Feature") -> None:
        """Raise TypeError if extend() cannot take `more`."""
        raise TypeError(f"World.add: extend: {self!r} cannot take more constraints. Add {more!r} to features.")

    def extend(self, more: Any) -> None:
        """Append the constraints of another feature of its kind, while it is not bound."""

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the pairs of particles that rays hit as rods, (k, 2), and the number of each pair's link, (k,)."""
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)

    def __repr__(self) -> str:
        return type(self).__name__

    def _repr_html_(self) -> str:
        from ..recording.markup import of_feature

        return of_feature(self)


class Acceleration(Feature):
    """A force that acts on each particle independently: gravity, drag, a field.

    accelerates: acceleration() adds something (False for a pure drag).
    uniform: the acceleration is the same at every place, so it adds no stiffness. common: it is the same for all particles, and
    computed only once.
    steady: it changes with its knobs only, not with the time t.
    uses_velocity: acceleration() reads v, which needs one more field for second order.
    conservative: potential() is defined, so the energy report can account for it.
    decays: it has a rate, a linear drag [1/s] that is solved exactly (exponential); several rates add up.
    pairwise: it acts between particles, and is evaluated for all particles before any of them moves, see PairForce.
    is_tool: it is there for the user's hand, and frames have no more substeps for it by default.
    """

    accelerates = True
    uniform = False
    is_fixed_in_space = True  # forces may read places; those that read none, or tell them as knobs, say so
    common = False
    steady = False
    uses_velocity = False
    conservative = False
    decays = False
    rate = 0.0
    pairwise = False
    is_tool = False
    neighbours_per_particle = 0  # initial room for listed neighbours, per particle
    dim = 0  # of the world; 0 before it is in one

    @property
    def does_work(self) -> bool:
        """Whether it accelerates particles and has no known potential."""
        return self.accelerates and not self.conservative

    @property
    def conserves(self) -> bool:
        """Whether it does not brake particles."""
        return not (self.decays or self.uses_velocity)

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check its knobs again, with the dimension known."""
        self._keep(dim=particles.dim)
        for name in knobs_of(type(self)):
            setattr(self, name, getattr(self, name))

    def kernel_values(self) -> dict[str, Any]:
        """Return the numbers and vectors that kernels read as `dev.name[None]`, computed from its knobs."""
        return {}

    def bind(self, scene: Scene) -> None:
        """Declare a field for each of its kernel values."""
        self.scene = scene
        for name, value in self.kernel_values().items():
            kind, width = ti.i32 if isinstance(value, int) else None, np.size(value) if np.ndim(value) else 0
            field = scene.memory.field(f"{type(self).__name__}.{name}", None, width=width, kind=kind, values=value)
            setattr(self.dev, name, field)
        self.changed = False

    def upload(self) -> None:
        """Write the kernel values to their fields."""
        for name, value in self.kernel_values().items():
            self.scene.memory.write(vars(self.dev)[name], value)

    def make_search(self, scene: Scene, team: Any) -> Any:
        """If it is pairwise, declare its neighbour list and return it; None if it has none."""

    def may_act_from(self, first: int) -> bool:
        """Whether it may act on particles from number `first` on."""
        return True

    @ti.func
    def acts_on(self, i):
        """Whether it acts on particle i, if it reads velocities."""
        return True

    @ti.func
    def acceleration(self, i, x, v, t):
        """Return the acceleration [m/s^2] of particle i at position x [m] with velocity v [m/s] at time t [s]."""
        return 0.0 * x

    @ti.func
    def potential(self, i, x):
        """Return the potential energy of particle i per unit of mass [J/kg] at x."""
        return 0.0 * x[0]


class Batch(Feature):
    """m constraints of one kind on `arity` particles each. Its `dev` has the kernels of a substep, see passes()."""

    arity = 0  # 0: each constraint has any number, see Members
    rigid = True  # whether any constraint is rigid
    soft = False  # has springs, which act at a start (the first substep after velocities were set)
    breaks = False  # has constraints that a load can break
    clusters = False  # preserves shapes, see members_of() and shape_of()
    can_extend = False  # can be extended by more constraints, see extend()
    is_kinematic = False  # prescribes positions of its particles instead of relaxing them
    answers_alone = False  # answers impulses of contacts by itself, see Passes.answer(); others do by a system or as rows
    solvable_together = False  # the System of a solver may solve its constraints with others; see Scalar
    driven = False  # rest values change by themselves, by the Drive of drive_of()
    transcends = False  # computes angles, cube roots or exponentials, which SPIR-V has for f32 only
    members: Any  # Members: the particles of each constraint
    code_size = 1.0
    each: tuple[str, ...] = ()  # its arrays with one row per constraint, besides the indices
    rest_name = "rest"  # the argument of __init__ for `rest`
    for_users = ("broken", "count", "indices", "load", "residual")
    index_name = "indices"  # the argument of __init__ for the indices, in the form of `listing`

    @property
    def does_work(self) -> bool:
        """Whether rest values change by themselves."""
        return self.driven

    @property
    def indices(self) -> np.ndarray:
        """The particles of each constraint, (m, arity); for constraints of any size, all corners in sequence, (total,)."""
        return self.members.indices

    @property
    def count(self) -> int:
        """The number of constraints, m."""
        return self.dev.corners.count if inside_kernel() else self.members.count

    @property
    @in_turn
    def residual(self) -> np.ndarray:
        """The violation of each constraint after the last substep, (m,), relative as in StepReport.residual; 0 if broken."""
        if not self.count:
            return np.zeros(0)
        if self.scene is None:
            raise RuntimeError(f"{self!r}.residual: there is none before a world has been stepped with it.")
        return np.zeros(self.count) if self.is_kinematic or not self.acts else self.scene.residuals(self)

    @property
    def acts(self) -> bool:
        """Whether it is in a world and on the device: some of its particles can move, or it drives them."""
        return self.scene is not None and "slots" in vars(self.dev)

    @property
    def broken(self) -> np.ndarray:
        """Which constraints have broken so far, Boolean (m,)."""
        return self.stamps() > 0

    def stamps(self) -> np.ndarray:
        """Return when each constraint broke, (m,): the number of the substep, counted from 1, see Strength; 0 if unbroken."""
        return self.dev.strength.stamps() if self.breaks and self.acts else np.zeros(self.count, dtype=np.int32)

    @property
    def owner(self) -> np.ndarray:
        """The number of the constraint of each corner, (total,)."""
        return self.members.owner

    def acts_as_force(self, scene: Scene) -> np.ndarray:
        """Return which constraints act as forces, (m,): some of a Scalar do, in substeps of an order above 2."""
        return np.zeros(self.count, dtype=bool)

    def members_of(self, c: int) -> np.ndarray:
        """Return the particles of constraint c."""
        return self.members.row(c)

    def immovable(self, inv_mass: np.ndarray) -> np.ndarray:
        """Return which constraints have no particle that can move, (m,)."""
        return self.members.immovable(inv_mass)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the mask of the constraints that stay: those all of whose particles stay."""
        return self.members.kept_mask(number)

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Keep the rows of the constraints that stay, and renumber their particles."""
        some = self.kept_mask(number)[0]
        self.select(some, number)
        for name in self.each:
            if isinstance(rows := self.__dict__.get(name), np.ndarray):
                self.__dict__[name] = as_read_only(rows[some], getattr(rows, "advice", ""))
        self.note_arguments()

    def note_arguments(self) -> None:
        """Update `arguments` to those that would make it as it is now, with other particles and rows."""
        now = {name: self.__dict__[name] for name in self.each if name in self.__dict__} | {self.index_name: self.listing}
        if "rest" in now:
            now[self.rest_name] = now["rest"]
        self.arguments = {k: v if isinstance(v, ONE) else now.get(k, v) for k, v in self.arguments.items()}

    @property
    def listing(self) -> Any:
        """The particles of each constraint, in the form of the argument of __init__."""
        return self.members.listing

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the particles of the constraints in the mask `some`, by their new numbers."""
        self._keep(members=self.members.remapped(some, number))

    def check_extension(self, more: Feature) -> None:
        """Raise TypeError unless `more` is of the same kind, on as many particles each."""
        if not self.can_extend:
            super().check_extension(more)
        if type(more) is not type(self) or more.arity != self.arity or not more.can_extend:  # type: ignore[attr-defined]
            raise TypeError(f"World.add: extend: {self!r} cannot take {more!r}, which is of another kind. Add it to features.")

    def extend(self, more: "Batch") -> None:
        """Append the rows of `more`. If only one of the two has break_at, the other's constraints get infinite strength."""
        counts = self.count, more.count
        for name in self.each:
            both = [vars(one).get(name) for one in (self, more)]
            if any(rows is not None for rows in both):
                rows = [np.full(m, np.inf) if one is None else one for one, m in zip(both, counts, strict=True)]
                self.__dict__[name] = as_read_only(np.concatenate(rows), assign_whole_advice(type(self).__name__, name))
        listing = self.listing, more.listing
        self.set_listing(np.concatenate(listing) if self.arity else [*listing[0], *listing[1]])
        self.note_arguments()

    def set_listing(self, listing: Any) -> None:
        """Set the particles of all constraints, in the form of the argument of __init__."""

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the unbroken constraints on two particles, which pictures draw as lines: pairs, and their numbers."""
        if self.arity != 2:
            return Feature.rods(self)
        whole = np.flatnonzero(~self.broken)
        return self.indices[whole], whole

    def excluded_pairs(self, particles: "Particles") -> np.ndarray:
        """Return pairs of particles that may overlap, (k, 2), because this batch sets their relative position."""
        return self.members.pairs()

    def max_distances(self) -> tuple[np.ndarray, np.ndarray]:
        """Return pairs of particles that cannot get further apart than at the start, (k, 2), and that distance [m], (k,)."""
        return np.zeros((0, 2), dtype=np.int32), np.zeros(0)

    def passes(self, scene: Scene) -> Any:
        """Declare its fields, and make its `dev`: Passes, with the kernels of a substep for each constraint."""
        raise NotImplementedError

    def bind(self, scene: Scene) -> None:
        """Put it on the device."""
        self.scene = scene
        self._keep(dev=self.passes(scene))


def extended(feature: Any, more: Any, start: "Particles", now: "Particles", box: Any) -> "Particles":
    """Append to an unbound feature the constraints or bodies of another, which start now.

    Returns the particles by which the extended feature starts. Those of its own constraints are where they were when the feature
    was added; all others are where they are now.
    """
    more.periodic, more.start = box, now
    inv_mass = now.inv_mass.copy()
    more.prepare(now, inv_mass)
    if isinstance(more, Batch):  # bodies are reviewed with all constraints, see check_added()
        more.review(now, inv_mass)
    position = np.array(now.position)
    mine = feature.indices.ravel()
    position[mine] = start.position[mine]
    feature.extend(more)
    return start.placed(position)
