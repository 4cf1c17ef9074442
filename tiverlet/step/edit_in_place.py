"""Particles come and go in place: rows of fields move up, new ones are written behind them, and nothing is made anew.

Fields have room for many more elements than they have, see device/layout.py, and kernels find in a field how many there are. So
what has a row for each particle keeps those that stay, and whatever else is known of all particles is worked out again: levels of
sizes, pieces for threads, where slots begin. Pairs in contact keep what they remember, in the list or beside it. Where more than
that would change (features, what kernels are made of, particles that a constraint holds), the world is built anew.
"""

from typing import Any

import numpy as np

from ..constraints.core.anchored import refuse_held_twice
from ..features.feature import Batch
from ..features.regrouping import Regrouping
from ..particles import Particles
from .scale import Scale


def planned(world: Any, some: np.ndarray, number: np.ndarray, added: Particles | None) -> Regrouping | None:
    """What is to happen to the particles of a world if those in the mask `some` stay and others are added; None where the world
    has to be built anew for it. Raises ValueError as building it does, and changes nothing."""
    runner = world._runner
    scene, count = runner.scene, int(np.count_nonzero(some)) + (0 if added is None else len(added))
    work = count + sum(f.count for f in world.features if isinstance(f, Batch))
    if not (count and len(some) and scene.order == 2 and world._scale.holds(Scale(count, work))):
        return None
    if runner.launched or not all(memory.elastic and memory.holds(count + 1) for memory in runner.memories):
        return None
    if any(f.changed and f.outgrown for f in world.features):
        return None
    stay = np.flatnonzero(some)
    now = world._particles.regrouped(some, added, scene.state.get(runner.memory).take(stay, axis=0))
    inv_mass = scene.inv_mass[stay] if added is None else np.concatenate([scene.inv_mass[stay], added.inv_mass])
    change = Regrouping(some, number, scene.particles, now, inv_mass)
    if not (scene.state.can_regroup(change) and (scene.radius is None or scene.radius.can_be(now.radius))):
        return None
    if not all(f.can_regroup(change) for f in world.features):
        return None
    for f in world.features:
        f.check_added(now, change.kept)
    return change


def regroup(world: Any, change: Regrouping, added: Particles | None) -> None:
    """Do what was planned."""
    runner, count = world._runner, change.now.count
    scene, step, memory = runner.scene, runner.step, runner.memory
    pairs = _pairs(runner.search.list, change) if runner.search and runner.search.list.saved and change.goes else None
    rows = scene.count
    for one in runner.memories:
        one.regroup(rows, change.first, change.stay[change.first :], count)
    rows.set(count)
    scene.particles, scene.inv_mass = change.now, change.inv_mass
    scene.state.regroup(memory, change)
    if scene.radius:
        scene.radius.become(memory, change.now.radius)
    if scene.slots:
        scene.slots.regroup(memory, change)
    runner.team.regroup(count)
    step.particles.regroup(count)
    came = None if added is None else added.position
    known = {id(start): start for start in (world._particles, *(f.start for f in world.features))}
    starts = {one: change.now.placed(change.joined(start.position, came)) for one, start in known.items()}
    world._particles = starts[id(world._particles)]
    for f in world.features:
        waits = f.changed, f.moving, f.new_force
        f.start = starts[id(f.start)]
        f.regroup(change)
        f.changed, f.moving, f.new_force = waits
    runner.regroup()
    for log in runner.logs:
        log.forget()
    if pairs:
        memory.write(runner.search.list.number, 0)
        runner.search.list.restore(*pairs)
    runner.carry_loads()


def grabbing(world: Any, some: np.ndarray) -> Regrouping | None:
    """What is to happen where knobs ask for nothing but that pins hold other particles: none of all, `some`, comes or goes, but
    masses change, as contacts see them, and slots. None where the world has to be built anew for it, as where constraints act on
    what is driven now or was before."""
    runner, pins = world._runner, [f for f in world.features if f.afresh]
    scene, memory = runner.scene, runner.memory
    if not pins or pins != [f for f in world.features if f.changed and f.outgrown]:
        return None
    if runner.sleep or runner.launched or scene.order > 2 or not all(one.elastic for one in runner.memories):
        return None
    now, inv_mass = world._particles.placed(scene.state.get(memory)), world._particles.inv_mass.copy()
    for f in runner.step.drivers:
        inv_mass[f.indices] = 0.0
    change, touched = Regrouping(some, np.arange(len(some)), scene.particles, now, inv_mass), inv_mass != scene.inv_mass
    free = not any(touched[b.indices].any() for b in runner.batches)
    free = free and (all(f.drives for f in pins) or scene.slots.can_grab(change, runner.batches))
    static = not runner.search or runner.search.has_static == bool((inv_mass == 0).any())
    if not (free and static and scene.state.can_regroup(change) and all(f.can_grab(change) for f in pins)):
        return None
    refuse_held_twice(now, world.features)
    return change


def grab(world: Any, change: Regrouping) -> None:
    """Do what was asked for."""
    runner = world._runner
    scene = runner.scene
    alone = min(np.count_nonzero(inv_mass) for inv_mass in (scene.inv_mass, change.inv_mass)) >= len(change.inv_mass) - 1
    scene.particles, scene.inv_mass = change.now, change.inv_mass
    scene.state.w.become(runner.memory, change.inv_mass)
    pins = [f for f in world.features if f.afresh]
    if any(f.soft for f in pins):
        scene.slots.grab(runner.memory, change, runner.batches)
    for f in pins:
        f.grab(change)
    for log in runner.logs:
        log.forget()
    runner.carry_loads()
    if not alone:  # lists leave out pairs of which none can move
        runner.invalidate()


def _pairs(near: Any, change: Regrouping) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """What pairs of particles that stay remember, by their new numbers."""
    pairs, values = near.lasting_data()
    pairs = change.number[pairs]
    both = np.flatnonzero((pairs[:, 0] >= 0) & (pairs[:, 1] >= 0))
    return pairs.take(both, axis=0), {name: value.take(both, axis=0) for name, value in values.items()}
