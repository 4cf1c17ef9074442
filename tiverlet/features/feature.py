"""What acts on particles: the contract that every force, constraint and collider keeps, and the guide to writing one.

A feature is a batch of arrays and one small kernel function. It checks its arguments in Python, declares its own fields, and is
absent from memory, from the kernels and from the clock when it is not in the scene. Its kinds are told apart by what a substep
asks of them:

    Acceleration   acceleration(i, x, v, t) of one particle, and/or a linear drag rate
    Batch          relax(c, ...) of one constraint: reads its particles, writes the moves it wants into slots. That is done by its
                   Passes (constraints/core/passes.py), which passes() makes
    Scalar         (constraints/core/scalar.py) a Batch whose constraint is one number: name a Quantity with f and its gradients,
                   and C = f - rest gets compliance, damping, mass splitting, residual and load from there
    Anchored       (constraints/core/anchored.py) a Batch of particles, each drawn to a Place of its own
    Collider       (colliders/collider.py) confine(i, ...) of one particle, with the last word

Which particles a Batch acts on is an object that it holds, `members`: FixedSize, or VariableSize for constraints
on any number of particles each (constraints/core/members.py).

A new constraint on k particles is one file with one Scalar subclass, which names its Quantity (constraints/core/quantity.py) and
has an __init__ that checks its arrays. See constraints/distance.py. Arrays of its own with a row for each
constraint are named in `each`, and what depends on where particles were is taken from `self.start`, so that a world can be built
anew around it (step/build_again.py). What a method other than __init__ finds out is set by self._keep(name=value), or under a
name that begins with an underscore: from outside only Knobs can be set.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..device import ti
from ..device.language import inside_kernel
from ..device.number import Number
from .arguments import Knob as Knob
from .arguments import keep, knobs_of, record_arguments, refuse_deletion, set_attribute
from .read_only import assign_whole, handed_out

if TYPE_CHECKING:
    from ..device.memory import Memory
    from ..particles import Particles, State
    from .regrouping import Regrouping

ONE = (float, int, type(None))  # for all constraints
BENT, FAR = 1, 2  # how far a constraint turned in a substep: by more than 26 degrees, by more than 41


@dataclass
class Scene:
    """What a feature is bound to: the memory to declare fields in, and the particles they act on."""

    host_only = ("inv_mass", "residuals", "reach", "periodic")

    memory: "Memory"
    state: "State"
    particles: "Particles"
    inv_mass: np.ndarray  # (n,) after pins: 0 means that constraints cannot move it
    radius: Any = None  # where something asks for radii
    slots: Any = None  # where constraints leave their moves
    own_weight: Any = None  # the OwnWeight of particles, where loads become known
    impacts: Any = None  # the BodyImpacts, where linked particles may bounce off walls
    residuals: Any = None  # batch -> what the last substep left of each of its violations
    order: int = 2  # of the substep in h
    periodic: Any = None  # the Periodic of the world
    # [s^2] multipliers of the last substep for 1 N, of rigid and of soft constraints: h2_effective, see Batch.relax, and what the
    # rigid ones did beside where it was a start from velocities that lacked it
    reach: tuple[float, float] = (0.0, 0.0)

    @property
    def count(self) -> Number:
        """Of particles, for kernels, and for fields that have a row for each."""
        return self.state.number

    @property
    def real(self):
        """The Taichi type of the world's real numbers."""
        return self.memory.real


class Feature:
    """Base of all.

    arguments: those that it was made with. changed: a knob waits to be uploaded. new_force: it changes a force. lets_go: it no
    longer bears what it bore. afresh: it begins anew where the world is built anew. moving: a target is under way. once: names of
    compiled_for that its kernels have had in this world; they go on having them, however the world is built anew.
    """

    arguments: Mapping[str, Any] = MappingProxyType({})
    # Attributes that a world sets.
    kept_by_world: tuple[str, ...] = ("scene", "start", "periodic", "changed", "moving", "new_force", "arguments", "once")
    # What kernels do not read of it.
    host_only: tuple[str, ...] = ("start", "periodic", "changed", "moving", "new_force", "arguments", "once")
    uploads_all = False  # upload() and end_motion() do as well for many worlds, where knobs have one more axis, the first
    compiled_for: tuple[str, ...] = ()  # properties that decide what its kernels consist of
    told_apart = True  # its share of the time that kernels take to compile is known by its name
    does_work = False  # it may bring in energy that no report knows; what only moves when it is told to says so by `changed`
    for_all = False  # nothing of it, on the device or beside, depends on which particles there are; see can_regroup()
    bulk = 0.3  # of its code in the kernels, next to that of a Distance; see build.LONG
    changed = True
    moving = new_force = lets_go = afresh = False
    once: frozenset[str] = frozenset()
    scene: Any = None  # Scene, from bind() on
    periodic: Any = None  # the Periodic of its world, from before prepare() on
    _world_for: dict[str, Any] | None = None  # what the world was built for, of built_for(); None where the feature does nothing
    ramp: Any = None  # the Ramp of its rest values, where it has one, while it is bound
    start: Any = None  # Particles as they were when it came: it goes by these when it is bound again, too

    __setattr__, __delattr__, _keep = set_attribute, refuse_deletion, keep

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        record_arguments(cls)

    @functools.cached_property
    def dev(self) -> Any:
        """What it has on the device while it is bound: fields, and constants of the kernels."""
        return SimpleNamespace()

    def prepare(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Check the arguments against the particles; set inv_mass to 0 for those that this feature holds."""

    def review(self, particles: "Particles", inv_mass: np.ndarray) -> None:
        """Warn of what makes no sense; called when all features have said which particles can move."""

    def check_added(self, particles: "Particles", first: int) -> None:
        """Check particles that come later, from number `first` on."""

    def bind(self, scene: Scene) -> None:
        """Declare fields with scene.memory.field(...). Called when the world is built, and again when it is built anew."""

    def upload(self) -> None:
        """Write changed knobs to the device. Called before a frame when `changed`."""

    def end_motion(self) -> None:
        """End a motion: what was the target of the last frame is where the next one starts. Called when `moving`."""

    def compiled(self) -> dict[str, Any]:
        """What its kernels have in them: the values of knobs that are compiled, and what they are compiled for."""
        knobs = [name for name in knobs_of(type(self)) if getattr(type(self), name).compiled]
        return {name: getattr(self, name) for name in (*knobs, *self.compiled_for)}

    def built_for(self) -> dict[str, Any]:
        """The same, and the values of knobs for which worlds are built, though kernels do not have them."""
        knobs = [name for name in knobs_of(type(self)) if getattr(type(self), name).built]
        return self.compiled() | {name: getattr(self, name) for name in knobs}

    def built(self) -> None:
        """A world was built with it: note what for. One in which it does nothing has no kernels for it."""
        acts = not isinstance(self, Batch) or self.acts
        self._world_for = self.built_for() if acts else None
        self.once |= {name for name in self.compiled_for if acts and getattr(self, name)}

    @property
    def outgrown(self) -> bool:
        """Whether knobs ask for what its kernels do not have, so that the world has to be built anew around it.

        What once was compiled stays when a knob no longer needs it, see `once`: friction of 0 where there was some costs no
        compiling. It shows in bits, so it also stays where the world is built anew, cloned or replayed.
        """
        return self._world_for is not None and self._world_for != self.built_for()

    def copy(self) -> "Feature":
        """The same feature, unbound: same arrays and knobs, ready for another world."""
        new = object.__new__(type(self))
        new.__dict__.update(vars(self))
        new.release()
        new.once = frozenset()
        return new

    def twin(self) -> "Feature":
        """A copy for a world of the same state, whose kernels have what these have."""
        new = self.copy()
        new.once = self.once
        return new

    def release(self) -> None:
        """Forget the world that it acted in, but for what its kernels had there, for it may be built anew."""
        for name in ("scene", "start", "periodic", "changed", "moving", "new_force", "dev", "_world_for"):
            self.__dict__.pop(name, None)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """When particles get new numbers, -1 for those that go: masks of what stays, for its fields of as many rows."""
        return ()

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Take the new numbers of its particles, of which there are `count` now, and leave out what had one that goes."""

    def can_regroup(self, change: "Regrouping") -> bool:
        """Whether particles can come and go while it stays bound. Where not, the world is built anew around it."""
        return self.for_all

    def regroup(self, change: "Regrouping") -> None:
        """They came and went: fields with a row for each particle have those of `change.now`, with 0 for new ones."""

    def check_more(self, more: "Feature") -> None:
        """Raise TypeError where extend() cannot take it."""
        raise TypeError(f"World.add: extend: {self!r} cannot take more constraints. Add {more!r} to features.")

    def extend(self, more: Any) -> None:
        """While it is not bound: take the constraints of another one of its kind behind its own."""

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """What rays meet of it between two particles: these, (k, 2), and which of its links that is, (k,)."""
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64)

    def __repr__(self) -> str:
        return type(self).__name__

    def _repr_html_(self) -> str:
        from ..recording.markup import of_feature

        return of_feature(self)


class Acceleration(Feature):
    """A force that acts on each particle by itself: gravity, drag, a field.

    accelerates: acceleration() adds something (a pure drag leaves it False).
    uniform: it is the same everywhere, so it has no stiffness. common: it is the same for all particles, and asked only once.
    uses_velocity: acceleration() reads v, which costs one more field to have it to second order.
    conservative: potential() is known, so the energy report can account for it.
    decays: it has a rate, a linear drag [1/s] that is solved exactly (exponential); several add up.
    pairwise: it acts between particles, and is worked out for all before any of them moves, see PairForce.
    """

    accelerates = True
    uniform = False
    common = False
    uses_velocity = False
    conservative = False
    decays = False
    rate = 0.0
    pairwise = False
    room = 0  # listed neighbours of a particle for which there is room at first

    @property
    def does_work(self) -> bool:
        """Whether it accelerates, and its potential is not known."""
        return self.accelerates and not self.conservative

    def settings(self) -> dict[str, Any]:
        """What its knobs come to for kernels: numbers and vectors, which are `dev.name[None]`."""
        return {}

    def bind(self, scene: Scene) -> None:
        """Declare a field for each of its settings."""
        self.scene = scene
        for name, value in self.settings().items():
            kind, width = ti.i32 if isinstance(value, int) else None, np.size(value) if np.ndim(value) else 0
            field = scene.memory.field(f"{type(self).__name__}.{name}", None, width=width, kind=kind, values=value)
            setattr(self.dev, name, field)
        self.changed = False

    def upload(self) -> None:
        """Write them."""
        for name, value in self.settings().items():
            self.scene.memory.write(vars(self.dev)[name], value)

    def join(self, scene: Scene, team: Any) -> Any:
        """Where it is pairwise: declare its neighbour list and return it, None if it has none."""

    def may_act_from(self, first: int) -> bool:
        """Whether it may act on particles from number `first` on."""
        return True

    @ti.func
    def acts_on(self, i):
        """Where it reads velocities: whether it acts on particle i."""
        return True

    @ti.func
    def acceleration(self, i, x, v, t):
        """Acceleration [m/s^2] of particle i at position x [m] with velocity v [m/s] at time t [s]."""
        return 0.0 * x

    @ti.func
    def potential(self, i, x):
        """Potential energy of particle i per unit of mass [J/kg] at x."""
        return 0.0 * x[0]


class Batch(Feature):
    """m constraints of the same kind on `arity` particles each. What a substep does with them, says its `dev`, see passes()."""

    arity = 0  # 0: as many as each needs, see VariableSize
    reweighs = False  # residual_of() needs reduce_block()
    soft = False  # has springs, which act at a start
    breaks = False  # has constraints that a load can break
    clusters = False  # keeps shapes, which members_of() and shape_of() give
    grows = False  # can have more constraints behind its own, see extend()
    drives = False  # puts its particles in place instead of relaxing them
    solvable_together = False  # its constraints may be solved together with others, by the System of a solver; see Scalar
    driven = False  # rest values move by themselves: what drive_of() gives, see Drive
    transcends = False  # takes angles, cube roots or exponentials, which SPIR-V has for f32 only
    members: Any  # FixedSize or VariableSize: the particles of each constraint
    bulk = 1.0
    each: tuple[str, ...] = ()  # its arrays with one row for each constraint, beside the indices
    rest_name = "rest"  # the argument of __init__ that is `rest`
    index_name = "indices"  # the argument of __init__ that they are, as `listing` gives them

    @property
    def does_work(self) -> bool:
        """Whether rest values move by themselves."""
        return self.driven

    @property
    def indices(self) -> np.ndarray:
        """The particles of each constraint, (m, arity); of constraints of any size all corners one after the other, (total,)."""
        return self.members.indices

    @property
    def count(self) -> int:
        """The number of constraints, m."""
        return self.dev.corners.count if inside_kernel() else self.members.count

    @property
    def residual(self) -> np.ndarray:
        """What the last substep left of each violation, (m,), relative as in StepReport.residual; 0 where it is broken."""
        if not self.count:
            return np.zeros(0)
        if self.scene is None:
            raise RuntimeError(f"{self!r}.residual: there is none before a world has been stepped with it.")
        return np.zeros(self.count) if self.drives or not self.acts else self.scene.residuals(self)

    @property
    def acts(self) -> bool:
        """Whether it is in a world, and on the device: some of its particles can move, or it drives them."""
        return self.scene is not None and "slots" in vars(self.dev)

    @property
    def broken(self) -> np.ndarray:
        """Which constraints have broken so far, Boolean (m,)."""
        return self.stamps() > 0

    def stamps(self) -> np.ndarray:
        """When each constraint broke, (m,): the number of the substep from 1 on, see Strength; 0 where it holds."""
        return self.dev.strength.stamps() if self.breaks and self.acts else np.zeros(self.count, dtype=np.int32)

    @property
    def owner(self) -> np.ndarray:
        """The constraint of each corner, (total,)."""
        return self.members.owner

    def acts_as_force(self, scene: Scene) -> np.ndarray:
        """Which constraints act as forces, (m,): those of Scalar may, in substeps of an order above 2."""
        return np.zeros(self.count, dtype=bool)

    def members_of(self, c: int) -> np.ndarray:
        """The particles of constraint c."""
        return self.members.row(c)

    def idle(self, inv_mass: np.ndarray) -> np.ndarray:
        """Whether each constraint has no particle that can move, (m,)."""
        return self.members.idle(inv_mass)

    def kept_mask(self, number: np.ndarray) -> tuple[np.ndarray, ...]:
        """Constraints stay as long as all of their particles do."""
        return self.members.kept_mask(number)

    def remap_indices(self, number: np.ndarray, count: int) -> None:
        """Keep the rows of what stays."""
        some = self.kept_mask(number)[0]
        self.select(some, number)
        for name in self.each:
            if isinstance(rows := self.__dict__.get(name), np.ndarray):
                self.__dict__[name] = handed_out(rows[some], getattr(rows, "advice", ""))
        self.note_arguments()

    def note_arguments(self) -> None:
        """Keep what it would be made with now: other particles, and rows."""
        now = {name: self.__dict__[name] for name in self.each if name in self.__dict__} | {self.index_name: self.listing}
        if "rest" in now:
            now[self.rest_name] = now["rest"]
        self.arguments = {k: v if type(v) in ONE or np.isscalar(v) else now.get(k, v) for k, v in self.arguments.items()}

    @property
    def listing(self) -> Any:
        """The particles of each constraint, as the user gives them."""
        return self.members.listing

    def select(self, some: np.ndarray, number: np.ndarray) -> None:
        """Keep the particles of these constraints, by their new numbers."""
        self._keep(members=self.members.remapped(some, number))

    def check_more(self, more: Feature) -> None:
        """It takes others of its own kind, on as many particles each."""
        if not self.grows:
            super().check_more(more)
        if type(more) is not type(self) or more.arity != self.arity or not more.grows:  # type: ignore[attr-defined]
            raise TypeError(f"World.add: extend: {self!r} cannot take {more!r}, which is of another kind. Add it to features.")

    def extend(self, more: "Batch") -> None:
        """Rows behind rows. Where only one of the two can break, the other never does."""
        counts = self.count, more.count
        for name in self.each:
            both = [vars(one).get(name) for one in (self, more)]
            if any(rows is not None for rows in both):
                rows = [np.full(m, np.inf) if one is None else one for one, m in zip(both, counts, strict=True)]
                self.__dict__[name] = handed_out(np.concatenate(rows), assign_whole(type(self).__name__, name))
        listing = self.listing, more.listing
        self.hold_all(np.concatenate(listing) if self.arity else [*listing[0], *listing[1]])
        self.note_arguments()

    def hold_all(self, listing: Any) -> None:
        """Have these particles for each constraint, as the user would give them."""

    def rods(self) -> tuple[np.ndarray, np.ndarray]:
        """What has two corners, which pictures draw as lines, and is not broken."""
        if self.arity != 2:
            return Feature.rods(self)
        whole = np.flatnonzero(~self.broken)
        return self.indices[whole], whole

    def excluded_pairs(self, particles: "Particles") -> np.ndarray:
        """Pairs of particles that may overlap, (k, 2), because this batch says where they are to each other."""
        return self.members.pairs()

    def ties(self) -> tuple[np.ndarray, np.ndarray]:
        """Pairs of particles that it keeps from getting further apart than they were at the start, (k, 2), and how far that is
        [m], (k,)."""
        return np.zeros((0, 2), dtype=np.int32), np.zeros(0)

    def passes(self, scene: Scene) -> Any:
        """Declare its fields, and make its `dev`: Passes, which have what a substep does with each constraint."""
        raise NotImplementedError

    def bind(self, scene: Scene) -> None:
        """Have it on the device."""
        self.scene = scene
        self._keep(dev=self.passes(scene))
