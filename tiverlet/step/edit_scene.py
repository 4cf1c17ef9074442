"""World.add and World.remove: edits of particles, constraints and features.

Particles and constraints are added and removed in place, see edit_in_place.py. For all other edits the world is rebuilt around
the same features, and the state of the remaining particles and constraints is carried over.
"""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from .. import checks
from ..colliders.collider import Collider
from ..constraints.pin import Pin
from ..contact.pair_contact import PairContact
from ..contact.touches import Told, joined_events
from ..device.memory import numbers_of
from ..features.feature import Batch, Feature
from ..particles import Particles
from ..shapes import Shape
from . import added_shape, edit_in_place, impulse, solids, violations
from .build import check_settings, checked_features, listed, refuse_several

NONE: Mapping[Feature, Feature] = MappingProxyType({})


class Handle:
    """Some particles of a world, whose indices stay right when other particles are removed. NumPy uses it as an index array.

    drops = world.add(tv.Particles(places))
    world.remove([0, 1])
    world.position[drops]
    """

    def __init__(self, indices: np.ndarray):
        self._indices = indices

    @property
    def indices(self) -> np.ndarray:
        """The present indices of its particles, without those that were removed."""
        return self._indices.copy()

    def follow(self, number: np.ndarray) -> None:
        """Renumber the particles. number: (n,) new indices, -1 for removed particles."""
        new = number[self._indices]
        self._indices = new[new >= 0]

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return self._indices.astype(dtype or np.int64)

    def __len__(self) -> int:
        return len(self._indices)

    def __repr__(self) -> str:
        return f"Handle({len(self)} particles)"


def add(
    world: Any, particles: Particles | Shape | None, features: Iterable[Feature], extend: Mapping[Feature, Feature] | None
) -> Handle:
    """Add particles, features and constraints to a world, see World.add."""
    world._runner.memory.check()
    late, extend = listed("World.add", features), extend or {}
    check_extended(world, extend)
    shape = particles if isinstance(particles, Shape) else None
    if shape is not None:
        particles = Particles(shape.position, radius=shape.radius)
    if particles is not None:
        if isinstance(particles, Feature):
            raise TypeError(f"World.add: particles = {particles!r} is a feature; write features=[...].")
        if not isinstance(particles, Particles):
            raise TypeError(f"World.add: particles = {particles!r} is a {type(particles).__name__}; use tv.Particles(position).")
        if particles.dim != world.particles.dim:
            raise ValueError(f"World.add: particles are in {particles.dim}D, but the world is in {world.particles.dim}D.")
    if shape is not None:
        own, both = added_shape.features(world, shape)
        late, extend = (*late, *own), {**both, **extend}
    checked_features((*late, *extend.values()))
    refuse_several("World.add", (*world.features, *late))
    check_settings(world._precision, world._requested[1], world._order, (*world.features, *late))
    n, count = len(world.particles), 0 if particles is None else len(particles)
    if late or count or extend:
        change(world, np.ones(n, dtype=bool), particles, (*world.features, *late), extend)
    return handle(world, np.arange(n, n + count))


def check_extended(world: Any, extend: Mapping[Feature, Feature]) -> None:
    """Raise TypeError or ValueError for constraints of features that do not act in the world, or cannot take them."""
    if not isinstance(extend, Mapping):
        raise TypeError(f"World.add: extend = {extend!r} is a {type(extend).__name__}; write {{rope: tv.Distance(pairs)}}.")
    for feature, more in extend.items():
        if not any(feature is f for f in world.features):
            raise ValueError(f"World.add: extend: {feature!r} does not act in this world. Add it to features.")
        if not isinstance(more, Feature):
            raise TypeError(f"World.add: extend[{feature!r}] = {more!r} is a {type(more).__name__}; write {feature!r} of others.")
        feature.check_extension(more)


def remove(world: Any, particles: Any, features: Iterable[Feature]) -> None:
    """Remove particles and features from a world, see World.remove."""
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
    """Return a Handle of these particles, which the world keeps up to date."""
    new = Handle(indices.astype(np.int64))
    world._handles.add(new)
    return new


def chosen(world: Any, who: str, particles: Any) -> np.ndarray:
    """Return the indices of particles given as a handle, indices or a mask."""
    if any(isinstance(f, Feature) for f in (particles if isinstance(particles, (list, tuple)) else [particles])):
        raise TypeError(f"{who}: particles = {particles!r} are features; write features=[...].")
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
    """Keep the particles in the mask `some`, add others, and let these features act; in place if possible.

    extend: features, and for each a feature whose constraints it takes over.
    """
    number = np.where(some, np.cumsum(some) - 1, -1)
    planned = None
    world._runner.memory.check()
    world._take_forces()
    if features == world.features:
        planned = edit_in_place.planned(world, some, number, added, extend)
    if planned is None:
        build_again(world, some, added, features, extend)
        return
    if world._releases_load:
        world._runner.note_displacements()
        world._restart_with_reactions()
    with world._runner.memory.compiler():
        others = (added is not None or not some.all()) and world._runner.step.has_pair_forces
        restarts = world._has_new_force or others or any(more.soft for more in planned.more)
        told, (seen, loose, moved) = world._all_events(), _seen(world, some, number, features, restarts)
        if restarts:
            world._runner.restart_between(world.iterations)
        world._clock.velocity_override = None
        edit_in_place.regroup(world, planned, added)
        world._runner.pass_on(world._runner.left, some)
        world._runner.wake()
        tied = _first_off(world, [*planned.more]) if planned.more else None
        _edited(world, some, added, told, seen, loose, moved, np.arange(len(features)), bool(extend), tied)


def renew(world: Any) -> None:
    """Change what knobs cannot change in a running kernel: the particles that pins hold, in place if possible; or the kernels."""
    grabbing, runner, clock = edit_in_place.grabbing(world), world._runner, world._clock
    if grabbing is None:
        check_settings(world._precision, world._requested[1], world._order, world.features)
        build_again(world, np.ones(len(world.particles), dtype=bool), None, world.features, NONE)
        return
    told = world._all_events() if runner.logs else world._events
    seen, inv_mass, before = clock.velocity_override, runner.scene.inv_mass, grabbing.before
    want = None if seen is None else seen[before]
    if clock.d_is_velocity or grabbing.soft or not impulse.has_enough_digits(runner):
        clock.energy = None
        if not clock.d_is_velocity:
            want = runner.memory.rows(before, runner.scene.state.d)[0] / clock.h if want is None else want
            with runner.memory.compiler():
                runner.restart_between(world.iterations)
        edit_in_place.grab(world, grabbing)
        if want is not None:
            impulse.let_go(runner, np.atleast_1d(numbers_of(before)), want, world.iterations)
    else:
        edit_in_place.grab(world, grabbing)
        change = runner.release(before, want, grabbing.after, inv_mass)
        known = clock.energy is not None and not (runner.scene.state.spins or runner.step.pair_forces)
        clock.energy = clock.energy + change if known else None
    world._events = told
    if clock.velocity_override is not None:
        clock.velocity_override = _held(runner, clock.velocity_override, inv_mass > 0)
    for watcher in world._watchers:
        watcher.regrouped()


def build_again(
    world: Any, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...], extend: Mapping[Feature, Feature]
) -> None:
    """Make the edit of change() by rebuilding the world."""
    world._runner.memory.check()
    again = world._rebuild(some, added, features, extend)
    before, told = world.features, world._all_events()
    seen, loose, moved = _seen(world, some, again.number, features, again.restarts)
    again.run()
    walls = np.array([features.index(f) if f in features else -1 for f in before], dtype=np.int64)
    new = [*(f for f in again.new_features if f not in before), *again.extending.values()]
    tied = _first_off(world, new)
    _edited(world, some, added, told, seen, loose, moved, walls, bool(again.new_features or again.removed_features or new), tied)


def _first_off(world: Any, new: list[Feature]) -> int | None:
    """Return the first particle of added rigid constraints and clusters that are violated; None where none is."""
    x, w = world.position, world._runner.scene.inv_mass
    clusters = [f for f in new if isinstance(f, Batch) and f.acts]
    off = [violations.first_off(new, x), solids.first_off(clusters, w, x)]
    return min((i for i in off if i is not None), default=None)


def _seen(
    world: Any, some: np.ndarray, number: np.ndarray, features: tuple[Feature, ...], restarts: bool
) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
    """Return velocities before an edit, the particles that it lets go, and the particles that can move: masks, (n,).

    Velocities are None unless removed constraints or contacts contribute to them, or the edit leaves the contribution of rigid
    constraints, contacts and walls to the start after it. The edit lets go of particles that are held by rigid constraints which
    it removes. Driven particles cannot move. restarts: whether displacements are about to become velocities.
    """
    loose, clock = np.zeros(len(some), dtype=bool), world._clock
    loses = clock.velocity_override is not None or (restarts and any(_holds(f) for f in world.features))
    for f in world.features:
        if isinstance(f, Pin) and f in features and f.needs_new_state:  # a pin that takes other particles
            if f.is_kinematic:
                loose[f.held[:, 0]] = loses = True
        elif isinstance(f, Batch | PairContact):
            stays = f.kept_mask(number)[0] if f in features else np.zeros(1, dtype=bool)
            if not stays.all():
                loses = True
                if isinstance(f, Batch) and f.acts:
                    batch: Any = f
                    goes = ~np.broadcast_to(stays, f.count) & (batch.compliance == 0)
                    loose[f.indices.ravel()[goes[f.owner]]] = True
    seen = clock.velocity_override if clock.d_is_velocity or not loses else world.velocity
    return seen, loose, world._runner.scene.inv_mass > 0


def _holds(feature: Any) -> bool:
    """Whether it may hold particles."""
    return feature.acts if isinstance(feature, Batch) else isinstance(feature, PairContact | Collider)


def _edited(
    world: Any, some: np.ndarray, added: Particles | None, told: Told, seen: np.ndarray | None,
    loose: np.ndarray, moved: np.ndarray, walls: np.ndarray, features_too: bool, tied: int | None = None,
) -> None:  # fmt: skip
    """Finish an edit after particles and features have changed: events, handles, the clock, velocities, watchers.

    told: events before the edit. walls: the new index of each feature, for the walls in events. seen, loose, moved: see _seen().
    features_too: whether features were added or removed, too. tied: the first particle of added constraints that are violated.
    """
    number, clock = np.where(some, np.cumsum(some) - 1, -1), world._clock
    n, m = int(np.count_nonzero(some)), 0 if added is None else len(added)
    pairs, parted = told[0].without_removed(number, number, clock.time)
    touches, left = told[1].without_removed(number, walls, clock.time)
    known = world._ending and (world._ending[0].renumbered(number, number), world._ending[1].renumbered(number, walls))
    world._events, world._ending = (pairs, touches), joined_events((parted, left), known)
    for one in list(world._handles):
        one.follow(number)
    if m or features_too or n < len(some):  # otherwise only the kernels have changed
        clock.energy = None
    clock.moved_mask = None
    if clock.first_moved is not None:
        clock.first_moved = int(some[: clock.first_moved].sum())
    elif m:
        clock.first_moved = n
    if tied is not None:
        clock.first_moved = min(tied, n if clock.first_moved is None else clock.first_moved)
    if m and not clock.d_is_velocity:
        _launch(world, n)
    if seen is not None:  # removed constraints contributed to the velocities of particles that remain
        seen = seen[some] if added is None else np.concatenate([seen[some], added.velocity])
        moved = np.concatenate([moved[some], np.ones(m, dtype=bool)])
        _let_go(world, seen, np.concatenate([loose[some], np.zeros(m, dtype=bool)]), moved)
        clock.velocity_override = _held(world._runner, seen, moved)
    for watcher in world._watchers:
        watcher.regrouped()


def _held(runner: Any, velocity: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return velocities, (n, dim), with d / h for particles that moved freely before and are driven now. moved: (n,)."""
    now, h = moved & (runner.scene.inv_mass == 0), 1.0 if runner.clock.d_is_velocity else runner.clock.h
    return np.where(now[:, None], runner.memory.read(runner.scene.state.d)[: runner.n] / h, velocity)


def _let_go(world: Any, seen: np.ndarray, loose: np.ndarray, moved: np.ndarray) -> None:
    """Let the particles in the mask `loose` continue with the velocities `seen`, (n, dim), that they had before the edit.

    moved: which particles could move then; the others were driven.
    """
    runner, some = world._runner, np.flatnonzero(loose)
    if runner.clock.d_is_velocity:
        impulse.let_go(runner, some, seen[some], world.iterations)
    elif impulse.has_enough_digits(runner):
        driven, free = some[~moved[some]], some[moved[some]]
        impulse.let_go(runner, free, seen[free], world.iterations)
        if len(driven):
            runner.release(driven, seen[driven])
    elif len(some):
        world._start_from(seen)


def _launch(world: Any, first: int) -> None:
    """Set the displacements of added particles, from `first` on, to those that their velocities need between two substeps."""
    runner = world._runner
    state, h = runner.scene.state, runner.clock.h
    if state.spins:
        runner.memory.write_from(state.spin.s, first, h * state.spin.from_rates(world._particles.spin)[first:])
    impulse.give_new(runner, first, world._particles.velocity[first:], world.iterations)
