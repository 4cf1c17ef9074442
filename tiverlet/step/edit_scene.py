"""Adding to a world and removing from it. Particles and constraints come and go in place, see edit_in_place.py; for what else
there is the world is built anew around the same features, and what stays is carried over."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from .. import checks
from ..colliders.collider import Collider
from ..contact.pair_contact import PairContact
from ..contact.touches import ContactEvents
from ..device.memory import Memory
from ..features.extending import extended
from ..features.feature import Acceleration, Batch, Feature
from ..neighbours.periodic import Periodic
from ..particles import Particles
from . import checkpoint, edit_in_place, initial_violation
from .build import assemble, check_settings, checked_features, listed
from .integrator import decay
from .sleep import Sleep

NONE: Mapping[Feature, Feature] = MappingProxyType({})
NOTHING = 2.0**-20  # of a velocity: less than this of it is in the next displacement


class Handle:
    """Some particles of a world, whatever happens to others: NumPy, and whatever takes indices, takes it for an index array.

    drops = world.add(tv.Particles(places))
    world.remove([0, 1])
    world.position[drops]
    """

    def __init__(self, indices: np.ndarray):
        self._indices = indices

    @property
    def indices(self) -> np.ndarray:
        """The present numbers of those that were not removed."""
        return self._indices.copy()

    def follow(self, number: np.ndarray) -> None:
        """Take new numbers, -1 for those that go."""
        new = number[self._indices]
        self._indices = new[new >= 0]

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return self._indices.astype(dtype or np.int64)

    def __len__(self) -> int:
        return len(self._indices)

    def __repr__(self) -> str:
        return f"Handle({len(self)} particles)"


def add(world: Any, particles: Particles | None, features: Iterable[Feature], extend: Mapping[Feature, Feature] | None) -> Handle:
    """See World.add."""
    world._runner.memory.check()
    late, extend = listed("World.add", features), extend or {}
    check_extended(world, extend)
    if particles is not None:
        if not isinstance(particles, Particles):
            raise TypeError(f"World.add: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        if particles.dim != world.particles.dim:
            raise ValueError(f"World.add: particles are in {particles.dim}D, but the world is in {world.particles.dim}D.")
    checked_features((*late, *extend.values()))
    if sum(isinstance(f, PairContact) for f in (*world.features, *late)) > 1:
        raise ValueError("World.add: more than one Contact; one covers all particles.")
    if sum(isinstance(f, Periodic) for f in (*world.features, *late)) > 1:
        raise ValueError("World.add: more than one Periodic; remove the old box first.")
    if sum(isinstance(f, Sleep) for f in (*world.features, *late)) > 1:
        raise ValueError("World.add: more than one Sleep; one is for all particles.")
    check_settings(world._precision, world._requested[1], world._order, (*world.features, *late))
    n, count = len(world.particles), 0 if particles is None else len(particles)
    if late or count or extend:
        change(world, np.ones(n, dtype=bool), particles, (*world.features, *late), extend)
    return handle(world, np.arange(n, n + count))


def check_extended(world: Any, extend: Mapping[Feature, Feature]) -> None:
    """Refuse constraints for features that do not act here, or cannot take them."""
    if not isinstance(extend, Mapping):
        raise TypeError(f"World.add: extend = {extend!r} is a {type(extend).__name__}; write {{rope: tv.Distance(pairs)}}.")
    for feature, more in extend.items():
        if not any(feature is f for f in world.features):
            raise ValueError(f"World.add: extend: {feature!r} does not act in this world. Add it to features.")
        if not isinstance(more, Feature):
            raise TypeError(f"World.add: extend[{feature!r}] = {more!r} is a {type(more).__name__}; write {feature!r} of others.")
        feature.check_more(more)


def remove(world: Any, particles: Any, features: Iterable[Feature]) -> None:
    """See World.remove."""
    world._runner.memory.check()
    gone = listed("World.remove", features)
    for k, feature in enumerate(gone):
        if not any(feature is f for f in world.features):
            raise ValueError(f"World.remove: features[{k}] = {feature!r} does not act in this world.")
    some = np.ones(len(world.particles), dtype=bool)
    some[chosen(world, "World.remove", particles)] = False
    if gone or not some.all():
        change(world, some, None, tuple(f for f in world.features if not any(f is g for g in gone)))


def handle(world: Any, indices: np.ndarray) -> Handle:
    """One that the world keeps up to date."""
    new = Handle(indices.astype(np.int64))
    world._handles.add(new)
    return new


def chosen(world: Any, who: str, particles: Any) -> np.ndarray:
    """Indices of particles that were given by a handle, indices or a mask."""
    array, n = np.asarray(particles), len(world.particles)
    if array.dtype == bool:
        if array.shape != (n,):
            raise ValueError(f"{who}: particles has shape {array.shape}, but a mask of shape ({n},) is needed.")
        return np.flatnonzero(array)
    return checks.indices(who, "particles", array, n)


def change(
    world: Any, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...],
    extend: Mapping[Feature, Feature] = NONE,
) -> None:  # fmt: skip
    """Keep particles in the mask `some`, add others, and let these features act; in place where that can be. extend: features,
    and others whose constraints they take."""
    number = np.where(some, np.cumsum(some) - 1, -1)
    planned = None
    if features == world.features:
        planned = edit_in_place.planned(world, some, number, added, extend)
    if planned is None:
        rebuild(world, some, added, features, extend)
        return
    with world._runner.memory.compiler():
        told, seen = world._all_events(), _seen(world, number, features)
        others = (added is not None or not some.all()) and world._runner.step.has_pair_forces
        if world._force_waits or others or any(more.soft for more in planned.more):
            world._runner.restart_between(world.iterations)
        world._clock.parted = None
        edit_in_place.regroup(world, planned, added)
        world._runner.pass_on(world._runner.left, some)
        world._runner.wake()
        tied = initial_violation.first_off([*planned.more], world.position) if planned.more else None
        _edited(world, some, added, told, seen, np.arange(len(features)), bool(extend), tied)


def renew(world: Any) -> None:
    """Give a world what its knobs ask for: to pins other particles to hold, in place where that can be; or other kernels."""
    grabbing, runner, clock = edit_in_place.grabbing(world), world._runner, world._clock
    if grabbing is None:
        check_settings(world._precision, world._requested[1], world._order, world.features)
        rebuild(world, np.ones(len(world.particles), dtype=bool), None, world.features)
        return
    told = world._all_events() if runner.logs else world._events
    if grabbing.soft:
        with runner.memory.compiler():
            runner.restart_between(world.iterations)
    clock.parted = clock.energy = None
    edit_in_place.grab(world, grabbing)
    world._events = told
    for watcher in world._watchers:
        watcher.regrouped()


def rebuild(
    world: Any, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...],
    extend: Mapping[Feature, Feature] = NONE,
) -> None:  # fmt: skip
    """Build the world anew, of its particles in the mask `some` and the added ones, under these features, see change()."""
    world._runner.memory.check()
    n, m, before = int(some.sum()), 0 if added is None else len(added), world.features
    number = np.where(some, np.cumsum(some) - 1, -1)
    now = world._particles.regrouped(some, added, world.position[some])
    kept, attributes = checkpoint.keep(world), {f: dict(vars(f)) for f in {*before, *features}}
    came = [f for f in features if f not in before or f.afresh]
    went = [f for f in before if f not in features or f.afresh]
    more = {f: other.copy() for f, other in extend.items()}
    known = {one: start.regrouped(some, added) for one, start in {id(f.start): f.start for f in before}.items()}
    starts: list[Any] = [None if f in came else known[id(f.start)] for f in features]
    parts, told, seen = None, world._all_events(), _seen(world, number, features)
    noted = {f: world._runner.memory.scratch(f) for f in before if isinstance(f, Batch)}
    try:
        world._runner.note_displacements()
        borne = any(isinstance(f, Collider) for f in went)
        pulled = (added is not None or not some.all()) and world._runner.step.has_pair_forces  # by others than before
        turned = borne or pulled or world._force_waits or any(_drives(f, number) for f in (*came, *went, *more.values()))
        if borne:
            world._let_go()
        elif turned:
            with world._runner.memory.compiler():
                world._runner.restart(world.iterations)
        old = checkpoint.state(world) if turned else kept.values
        masks = {f: tuple(mask & (f not in came) for mask in f.kept_mask(number)) for f in before}
        rests = {f: np.stack(f.ramp.now())[:, masks[f][0]] for f in features if f.ramp and f.ramp.waits}
        for f in before:
            f.release()
            f.remap_indices(number, n + m)
        for f in went:
            f.once = frozenset()
        box = next((f for f in features if isinstance(f, Periodic)), None)
        for k, f in enumerate(features):
            if f in more:
                starts[k] = extended(f, more[f], starts[k], now, box)
        parts = assemble(now, features, starts, n, *world._build_options)
        state = _carried(world, parts.memory, old, attributes, masks, some)
    except BaseException:
        if parts:
            parts.memory.destroy()
        for f, values in attributes.items():
            f.__dict__.clear()
            f.__dict__.update(values)
        if world._clock.d_is_velocity != kept.clock.d_is_velocity:
            checkpoint.put_back(world, kept)
        raise
    memories, particles = world._runner.memories, world._particles.regrouped(some, added)
    contact, h2_effective = (
        next((c for c in world._runner.step.contacts if c in features), None),
        world._runner.scene.h2_effective,
    )
    world._clock.parted, left = None, world._runner.left
    world._install(particles, features, parts)
    world._runner.pass_on(left, some)
    world._runner.scene.h2_effective = h2_effective
    world._runner.memory.restore(state)
    for f, rows in noted.items():
        if f in features:
            world._runner.memory.put_scratch(f, rows, masks[f])
    world._runner.wake()
    if contact and contact in world._runner.step.contacts:
        _give_contacts(world, contact, old, number, some)
    drag, world._clock.drag = world._clock.drag, None
    if world._runner.integrator.decays:
        world._runner.set_substep(world._clock.h, drag)
    for f in features:
        if f not in came:
            f.changed, f.moving = attributes[f].get("changed", True), attributes[f].get("moving", False)
            f.new_force = attributes[f].get("new_force", False)
    for f, values in rests.items():
        if f.ramp:
            f.ramp.put([*values])  # from where they go to those that were assigned
    for memory in memories:
        memory.destroy()
    if any(isinstance(f, PairContact) for f in came):
        world._clock.first_moved = 0
    walls = np.array([features.index(f) if f in features else -1 for f in before], dtype=np.int64)
    tied = initial_violation.first_off([*(f for f in came if f not in before), *more.values()], world.position)
    _edited(world, some, added, told, seen, walls, bool(came or went or more), tied)


def _seen(world: Any, number: np.ndarray, features: tuple[Feature, ...]) -> np.ndarray | None:
    """Velocities before an edit, where what goes has a part in them; None where they are what displacements say."""
    loses = any(_loses(f, number, features) for f in world.features)
    return world.velocity if not world._clock.d_is_velocity and (world._clock.parted is not None or loses) else None


def _edited(
    world: Any, some: np.ndarray, added: Particles | None, told: tuple[ContactEvents, ContactEvents], seen: np.ndarray | None,
    walls: np.ndarray, features_too: bool, tied: int | None = None,
) -> None:  # fmt: skip
    """What else there is to an edit once particles and features are there. told: events, of walls that have these numbers now.
    seen: velocities, see _seen(). features_too: whether features came or went, too.
    tied: the first particle of constraints that came and are not met."""
    number, clock = np.where(some, np.cumsum(some) - 1, -1), world._clock
    n, m = int(np.count_nonzero(some)), 0 if added is None else len(added)
    world._events = told[0].renumbered(number, number), told[1].renumbered(number, walls)
    for one in list(world._handles):
        one.follow(number)
    if m or features_too or n < len(some):  # else knobs only asked for other kernels
        clock.energy = None
    if clock.first_moved is not None:
        clock.first_moved = int(some[: clock.first_moved].sum())
    elif m:
        clock.first_moved = n
    if tied is not None:
        clock.first_moved = min(tied, n if clock.first_moved is None else clock.first_moved)
    if m and not clock.d_is_velocity:
        _launch(world, n)
    if seen is not None and not clock.d_is_velocity:  # what went has left its part in the velocities of what stays
        clock.parted = seen[some] if added is None else np.concatenate([seen[some], added.velocity])
    for watcher in world._watchers:
        watcher.regrouped()


def _drives(feature: Feature, number: np.ndarray) -> bool:
    """Whether a feature that comes or goes changes the force on particles that stay."""
    if isinstance(feature, Batch):
        return feature.soft and bool(feature.kept_mask(number)[0].any()) if feature.scene else feature.soft
    return isinstance(feature, Acceleration)


def _loses(feature: Feature, number: np.ndarray, features: tuple[Feature, ...]) -> bool:
    """Whether constraints go, or what may touch."""
    return isinstance(feature, Batch | PairContact) and (feature not in features or not feature.kept_mask(number)[0].all())


def _carried(
    world: Any, memory: Memory, old: dict[str, np.ndarray], attributes: dict[Feature, dict], masks: dict, some: np.ndarray
) -> dict[str, np.ndarray]:
    """The state of a world that was built anew: the rows of what stayed are as they were."""
    new = memory.state()
    names = [{id(e.field): e.name for e in one.entries if e.state} for one in (world._runner.memory, memory)]
    owned: list[set[str]] = [set(), set()]
    moves: list[tuple[str, str, tuple[np.ndarray, ...]]] = []
    for feature, before in attributes.items():
        pair = [_fields(values, known) for values, known in zip((before, vars(feature)), names, strict=True)]
        for known, found in zip(owned, pair, strict=True):
            known.update(found.values())
        for key in pair[0].keys() & pair[1].keys():
            per_particle = getattr(vars(feature.dev)[key[0]], "per_particle", False)  # and not by how many rows there are
            moves.append((pair[0][key], pair[1][key], (some,) if per_particle else masks[feature]))
    moves += [(name, name, (some,)) for name in (set(names[0].values()) - owned[0]) & (set(names[1].values()) - owned[1])]
    for before, after, choices in moves:
        rows = old[before]
        mask = next((choice for choice in choices if len(choice) == len(rows)), None)
        rows = rows if mask is None else rows[mask]
        new[after][: len(rows)] = rows
    return new


def _fields(attributes: dict[str, Any], names: dict[int, str]) -> dict[tuple[str, str], str]:
    """The fields of the state that a feature holds, or a part of it that lists them as `in_state`; and their names."""
    bound = vars(attributes["dev"]) if "dev" in attributes else {}
    parts = {key: getattr(value, "in_state", {"": value}) for key, value in bound.items()}
    fields = {(key, part): field for key, held in parts.items() for part, field in held.items()}
    return {key: names[id(field)] for key, field in fields.items() if id(field) in names}


def _give_contacts(world: Any, contact: PairContact, old: dict, number: np.ndarray, some: np.ndarray) -> None:
    """What pairs in contact remember, and how much smaller particles are than they will be."""
    if "Contact.shrunk" in old:
        contact.enable_shrink()
        less: Any = contact.store
        values = less.state()
        values["Contact.shrunk"][: some.sum()] = old["Contact.shrunk"][some]
        less.restore(values)
    search, pairs = world._runner.search, number[old["Contact.pairs"]]
    assert search
    both = (pairs >= 0).all(axis=1)
    # Of what came just now pairs remember nothing.
    nothing = {p.name: np.zeros((len(pairs), p.width) if p.width else len(pairs)) for p in search.list.lasting}
    search.list.restore(pairs[both], {name: old.get(f"Contact.{name}", none)[both] for name, none in nothing.items()})
    world._runner.carry_loads()


def _launch(world: Any, first: int) -> None:
    """Give particles from `first` on the displacements that their velocities need, between two substeps.

    v = share d / h + what forces add, see decay(): from any d, what it lacks of v says what d lacks. Where drag leaves nothing of
    a velocity in a substep, d does not matter.
    """
    h, memory, state = world._clock.h, world._runner.memory, world._runner.scene.state
    integrator = world._runner.integrator
    want = np.where(world._runner.scene.inv_mass[first:, None] > 0, world._particles.velocity[first:], 0.0)
    fields = [state.d, *([integrator.earlier] if integrator.uses_velocity else [])]
    for field in fields:
        memory.write_from(field, first, h * want)
    if state.spins:
        memory.write_from(state.spin.s, first, h * state.spin.from_rates(world._particles.spin)[first:])
    share = max(decay(sum(f.rate for f in integrator.forces.drags), h)[0], NOTHING)
    with world._runner.memory.compiler():
        seen = world._runner.velocity(world.iterations, came=first)
    d = h * want + h / share * (want - seen)
    d[world._runner.scene.inv_mass[first:] == 0] = 0.0
    for field, rows in zip(fields, (d, 3 * d - 2 * h * want), strict=False):  # so that 3 d - earlier = 2 h v
        memory.write_from(field, first, rows)
