"""Adding to a world and removing from it. Particles and constraints come and go in place, see edit_in_place.py; for what else
there is the world is built anew around the same features, and what stays is carried over."""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from .. import checks
from ..constraints.pin import Pin
from ..contact.pair_contact import PairContact
from ..contact.touches import ContactEvents
from ..features.feature import Batch, Feature
from ..neighbours.periodic import Periodic
from ..particles import Particles
from . import edit_in_place, impulse, initial_shape, initial_violation
from .build import check_settings, checked_features, listed
from .sleep import Sleep

NONE: Mapping[Feature, Feature] = MappingProxyType({})


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
        if isinstance(particles, Feature):
            raise TypeError(f"World.add: particles = {particles!r} is a feature; write features=[...].")
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
        feature.check_extension(more)


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
        build_again(world, some, added, features, extend)
        return
    with world._runner.memory.compiler():
        told, (seen, loose, moved) = world._all_events(), _seen(world, some, number, features)
        others = (added is not None or not some.all()) and world._runner.step.has_pair_forces
        if world._has_new_force or others or any(more.soft for more in planned.more):
            world._runner.restart_between(world.iterations)
        world._clock.parted = None
        edit_in_place.regroup(world, planned, added)
        world._runner.pass_on(world._runner.left, some)
        world._runner.wake()
        tied = _first_off(world, [*planned.more]) if planned.more else None
        _edited(world, some, added, told, seen, loose, moved, np.arange(len(features)), bool(extend), tied)


def renew(world: Any) -> None:
    """Give a world what its knobs ask for: to pins other particles to hold, in place where that can be; or other kernels."""
    grabbing, runner, clock = edit_in_place.grabbing(world), world._runner, world._clock
    if grabbing is None:
        check_settings(world._precision, world._requested[1], world._order, world.features)
        build_again(world, np.ones(len(world.particles), dtype=bool), None, world.features, NONE)
        return
    told = world._all_events() if runner.logs else world._events
    loose = grabbing.some[runner.scene.inv_mass[grabbing.some] == 0]
    loose = np.unique(loose) if len(loose) > 1 else loose
    seen, moved = clock.parted, runner.scene.inv_mass > 0
    had = None
    if seen is not None:
        had = seen[loose]
    elif not clock.d_is_velocity:
        had = runner.memory.seen(runner.scene.state.d)[loose] / clock.h
    if grabbing.soft or not impulse.tells(runner):
        with runner.memory.compiler():
            runner.restart_between(world.iterations)
    clock.energy = None
    runner.wake()
    edit_in_place.grab(world, grabbing)
    world._events = told
    if had is not None:
        impulse.let_go(runner, loose, had, world.iterations)
    if clock.parted is not None:
        clock.parted = _held(runner, clock.parted, moved)
    for watcher in world._watchers:
        watcher.regrouped()


def build_again(
    world: Any, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...], extend: Mapping[Feature, Feature]
) -> None:
    """Make a change by building the world anew."""
    world._runner.memory.check()
    again = world._rebuild(some, added, features, extend)
    before, told = world.features, world._all_events()
    seen, loose, moved = _seen(world, some, again.number, features)
    again.run()
    walls = np.array([features.index(f) if f in features else -1 for f in before], dtype=np.int64)
    new = [*(f for f in again.came if f not in before), *again.extending.values()]
    tied = _first_off(world, new)
    _edited(world, some, added, told, seen, loose, moved, walls, bool(again.came or again.went or new), tied)


def _first_off(world: Any, new: list[Feature]) -> int | None:
    """The first particle of rigid constraints and clusters that came and are not met; None where all are."""
    x, w = world.position, world._runner.scene.inv_mass
    clusters = [f for f in new if isinstance(f, Batch) and f.acts]
    off = [initial_violation.first_off(new, x), initial_shape.first_off(clusters, w, x)]
    return min((i for i in off if i is not None), default=None)


def _seen(
    world: Any, some: np.ndarray, number: np.ndarray, features: tuple[Feature, ...]
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
    """Velocities before an edit, where what goes has a part in them, else None; the particles that rigid constraints hold which
    are about to go; and those that nothing drives: masks, (n,)."""
    loose, loses = np.zeros(len(some), dtype=bool), world._clock.parted is not None
    for f in world.features:
        if isinstance(f, Pin) and f in features and f.needs_new_state:  # which takes others
            if f.is_kinematic:
                loose[f.held] = loses = True
        elif isinstance(f, Batch | PairContact):
            stays = f.kept_mask(number)[0] if f in features else np.zeros(1, dtype=bool)
            if not stays.all():
                loses = True
                if isinstance(f, Batch) and f.acts:
                    batch: Any = f
                    goes = ~np.broadcast_to(stays, f.count) & (batch.compliance == 0)
                    loose[f.indices.ravel()[goes[f.owner]]] = True
    seen = world.velocity if loses and not world._clock.d_is_velocity else None
    return seen, loose, world._runner.scene.inv_mass > 0


def _edited(
    world: Any, some: np.ndarray, added: Particles | None, told: tuple[ContactEvents, ContactEvents], seen: np.ndarray | None,
    loose: np.ndarray, moved: np.ndarray, walls: np.ndarray, features_too: bool, tied: int | None = None,
) -> None:  # fmt: skip
    """What else there is to an edit once particles and features are there. told: events, of walls that have these numbers now.
    seen: velocities, see _seen(). loose, moved: likewise. features_too: whether features came or went, too.
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
    if seen is not None:  # what went has left its part in the velocities of what stays
        seen = seen[some] if added is None else np.concatenate([seen[some], added.velocity])
        _let_go(world, seen, np.concatenate([loose[some], np.zeros(m, dtype=bool)]))
        if not clock.d_is_velocity:
            clock.parted = _held(world._runner, seen, np.concatenate([moved[some], np.ones(m, dtype=bool)]))
    for watcher in world._watchers:
        watcher.regrouped()


def _held(runner: Any, velocity: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Velocities in which what moved, a mask, and is driven now goes as its displacement says."""
    now = moved & (runner.scene.inv_mass == 0)
    return np.where(now[:, None], runner.memory.read(runner.scene.state.d)[: runner.n] / runner.clock.h, velocity)


def _let_go(world: Any, seen: np.ndarray, loose: np.ndarray) -> None:
    """Have the particles in the mask `loose` go on with the velocities that they had, (n, dim)."""
    runner, some = world._runner, np.flatnonzero(loose)
    if runner.clock.d_is_velocity or impulse.tells(runner):
        impulse.let_go(runner, some, seen[some], world.iterations)
    elif len(some):
        world._start_from(seen)


def _launch(world: Any, first: int) -> None:
    """Give particles from `first` on the displacements that their velocities need, between two substeps."""
    runner = world._runner
    state, h = runner.scene.state, runner.clock.h
    if state.spins:
        runner.memory.write_from(state.spin.s, first, h * state.spin.from_rates(world._particles.spin)[first:])
    impulse.give_new(runner, first, world._particles.velocity[first:], world.iterations)
