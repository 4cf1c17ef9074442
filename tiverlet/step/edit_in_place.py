"""Adding and removing particles and constraints in place: rows of fields move up, and new rows are written behind them.

Fields have room for many more elements than they use, see device/layout.py, and kernels read the number of elements from a field.
So fields with a row for each particle keep the rows of particles that remain. Data derived from all particles is recomputed:
levels of sizes, pieces for threads, where slots begin. Constraints whose number or particle indices change are bound again to the
fields that they have, see bind_again.py. Pairs in contact keep their data, in the list or outside it. Where more would
change (features, the code of kernels), the world is rebuilt.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..constraints.core.anchored import Anchored, refuse_held_twice
from ..constraints.pin import Pin
from ..device.memory import Rows, rows_of
from ..features.feature import Batch, Feature
from ..features.regrouping import Regrouping
from ..neighbours.neighbour_list import WALL
from ..particles import Particles
from .bind_again import Bound, bind, bound_again
from .scale import Scale

NOBODY = np.zeros(0, dtype=np.int32)


@dataclass(frozen=True)
class Edit:
    """A planned edit of a world.

    change: of its particles. starts: the new particles at which features started, by the ids of the old ones. bound: the new
    constraints, if they must be bound again.
    """

    change: Regrouping
    starts: dict[int, Particles]
    bound: Bound | None

    @property
    def more(self) -> tuple[Any, ...]:
        """The features by which others are extended."""
        return (*self.bound.more.values(),) if self.bound else ()


def planned(
    world: Any, some: np.ndarray, number: np.ndarray, added: Particles | None, extend: Mapping[Feature, Feature]
) -> Edit | None:
    """Return the edit that keeps particles in the mask `some`, adds others, and extends features; None if it needs a rebuild.

    number: (n,) new indices, -1 for removed particles. Raises the ValueErrors of building a world. Nothing is changed yet.
    """
    runner = world._runner
    scene, count = runner.scene, int(np.count_nonzero(some)) + (0 if added is None else len(added))
    batches = [f for f in world.features if isinstance(f, Batch)]
    if not (count and len(some) and scene.order == 2):
        return None
    if runner.launched or not all(memory.elastic and memory.has_room(count + 1) for memory in runner.memories):
        return None
    if any(f.changed and f.needs_other_kernels for f in world.features):
        return None
    stay = np.flatnonzero(some)
    now = world._particles.regrouped(some, added, scene.state.get(runner.memory).take(stay, axis=0))
    inv_mass = scene.inv_mass[stay] if added is None else np.concatenate([scene.inv_mass[stay], added.inv_mass])
    links: dict[Feature, Feature] = {f: more for f, more in extend.items() if isinstance(f, Batch)}
    bodies = {f: more.copy() for f, more in extend.items() if f not in links}
    change = Regrouping(some, number, scene.particles, now, inv_mass, bodies)
    came = None if added is None else added.position
    known = {id(start): start for start in (world._particles, *(f.start for f in world.features))}
    starts = {one: now.placed(change.regrouped_rows(start.position, came)) for one, start in known.items()}
    bound, tied = None, [f for f in batches if not f.can_regroup(change)]
    if links or tied:
        if any(not f.acts for f in tied):
            return None
        bound = bound_again(world, number, now, starts, links)
        if not bound:
            return None
        change = Regrouping(some, number, scene.particles, now, bound.inv_mass, bodies)
    work = count + sum(f.count for f in batches)
    if bound:
        work = count + sum(int(bound.kept[f][0].sum()) if f in bound.kept else f.count for f in batches)
        work += sum(more.count for more in bound.more.values())
    if not world._scale.holds(Scale(count, work)):
        return None
    if not scene.state.can_regroup(change):
        return None
    if not all(f.can_regroup(change) for f in world.features if not (bound and f in bound.kept)):
        return None
    for f in world.features:
        f.check_added(now, change.kept)
    return Edit(change, starts, bound)


def regroup(world: Any, edit: Edit, added: Particles | None) -> None:
    """Carry out a planned edit."""
    runner, change, bound = world._runner, edit.change, edit.bound
    scene, step, memory, count = runner.scene, runner.step, runner.memory, change.now.count
    search = runner.search
    apart = search and ((search.list.saved and change.has_removed) or (bound and search.exclusions_differ(bound.linked, change)))
    pairs = _pairs(search.list, change) if apart else None
    rows = scene.count
    for one in runner.memories:
        one.regroup(rows, change.first, change.kept_indices[change.first :], count)
    rows.set(count)
    scene.particles, scene.inv_mass = change.now, change.inv_mass
    scene.state.regroup(memory, change)
    if scene.radius:
        scene.radius.assign(memory, change.now.radius)
    if scene.slots and not bound:
        scene.slots.regroup(memory, change)
    runner.team.regroup(count)
    step.particles.regroup(count)
    world._particles = edit.starts[id(world._particles)]
    for f in world.features:
        if not (bound and f in bound.kept):
            waits = f.changed, f.moving, f.new_force
            f.start = edit.starts[id(f.start)]
            f.regroup(change)
            f.changed, f.moving, f.new_force = waits
    if bound:
        bind(world, change, bound)
        runner.renew_softness()
    if runner.sleep:
        runner.sleep.bind_again(step.drivers, runner.batches)
    runner.regroup()
    for log in runner.logs:
        log.forget()
    if pairs:
        search.list.replace(*pairs)


@dataclass
class Grab:
    """A planned change of the particles that pins hold.

    soft: whether any of the pins is a spring. inv_mass: (n,) inverse masses of all particles after the change, 0 for driven ones.
    before, after: the particles that pins have driven, in ascending order, and those that they will drive, see Rows.
    """

    pins: list[Pin]
    soft: bool
    inv_mass: np.ndarray
    before: Rows
    after: Rows


def grabbing(world: Any) -> Grab | None:
    """Return the change where knobs only ask pins to hold other particles; None if it needs a rebuild.

    No particle is added or removed, but slots change, and masses for contacts. Constraints on particles whose inverse mass
    changes, for example, need a rebuild.
    """
    runner = world._runner
    scene, pins = runner.scene, [f for f in world._features if f.changed and f.needs_other_kernels]
    if runner.sleep or runner.launched or scene.order > 2 or not runner.memory.elastic:
        return None
    for f in pins:
        if not (f.needs_new_state and f.acts):
            return None
    driving, inv_mass, before, after = [f for f in pins if f.is_kinematic], scene.inv_mass, NOBODY, NOBODY
    if driving:
        before, after = _joined([f.held for f in driving]), _joined([f.members.rows for f in driving])
        inv_mass = inv_mass.copy()
        inv_mass[before] = world._particles.inv_mass[before]
        inv_mass[after] = 0.0
        for b in runner.batches:
            if (inv_mass[b.indices] != scene.inv_mass[b.indices]).any():
                return None
    soft = len(driving) < len(pins)
    if soft and not scene.slots.can_reassign(inv_mass, runner.batches):
        return None
    # Fast path: a single feature holds particles, and those that it drives from now on could move.
    if soft or 0.0 in scene.inv_mass[after].tolist() or len([f for f in world._features if isinstance(f, Anchored)]) > 1:
        refuse_held_twice(world._particles, world._features, pins)
    return Grab(pins, soft, inv_mass, before, after)


def grab(world: Any, change: Grab) -> None:
    """Carry out a planned change of the particles that pins hold."""
    runner, pins = world._runner, change.pins
    scene, memory, particles = runner.scene, runner.memory, world._particles
    if change.inv_mass is not scene.inv_mass:
        owned: Any = runner.search.list if runner.search and runner.search.list.movable else None
        pairs = owned.persistent_data() if owned and owned.saved else None
        scene.inv_mass = change.inv_mass
        scene.state.set_inverse_mass(memory, particles, change.inv_mass, change.before, change.after)
        if pairs:  # other particles own what pairs bear
            owned.restore(*pairs)
        elif owned:
            numbers = np.arange(len(change.inv_mass))
            owned.settle_owners(np.concatenate([numbers[change.before], numbers[change.after]]))
        if runner.immovable > 1:  # lists lack pairs in which neither particle can move
            runner.invalidate()
    if change.soft:
        scene.particles = particles.placed(scene.state.get(memory))
        scene.slots.reassign(memory, change.inv_mass, runner.batches)
        runner.renew_softness()
        rows = runner.step.contact_pass.rows
        if rows and rows.answers:
            rows.answers.reassign(memory, change.inv_mass)
    for f in pins:
        f.grab(scene)
    for log in runner.logs:
        log.forget()


def _joined(some: list[np.ndarray]) -> Rows:
    """Return the particles of several pins, (m, 1) each, in ascending order."""
    return rows_of(some[0] if len(some) == 1 == len(some[0]) else np.sort(np.concatenate(some), axis=0))


def _pairs(near: Any, change: Regrouping) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the persistent pairs between particles that remain, (m, 2) by their new indices, and their data by name."""
    pairs, values = near.persistent_data()
    some = pairs < WALL
    pairs[some] = change.number[pairs[some]]
    both = np.flatnonzero((pairs[:, 0] >= 0) & (pairs[:, 1] >= 0))
    return pairs.take(both, axis=0), {name: value.take(both, axis=0) for name, value in values.items()}
