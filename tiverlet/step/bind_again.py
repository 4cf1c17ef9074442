"""Adding and removing constraints in place: all constraints are bound again to the fields that they have, with new lengths.

The fields of a constraint depend on all constraints: slots are ordered by particle, and systems by elimination. So the code that
binds constraints when a world is built runs once more. Each field that it declares is one that exists already, see
device/redeclaration.py. If it would declare other fields, or kernels could read anything else than before, nothing is changed,
and the world is rebuilt.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..constraints.core.anchored import refuse_held_twice
from ..contact.exclusions import excluded_pairs
from ..device.redeclaration import DeclarationsDiffer, Redeclaration
from ..features.feature import Batch, Feature, extended
from ..features.regrouping import Regrouping
from ..particles import Particles


@dataclass(frozen=True)
class Bound:
    """The planned constraints of a world.

    inv_mass: (n,) of all particles, 0 for driven ones. linked: (m, 2) pairs that contacts exclude. attributes: objects, each with
    its attributes before and after. kept: masks of the rows of each feature that remain. more: features by which others are
    extended.
    """

    again: Redeclaration
    inv_mass: np.ndarray
    linked: np.ndarray
    attributes: list[tuple[Any, dict[str, Any], dict[str, Any]]]
    kept: dict[Feature, tuple[np.ndarray, ...]]
    more: dict[Feature, Any]


def bound_again(
    world: Any, number: np.ndarray, now: Particles, starts: dict[int, Particles], extend: Mapping[Feature, Feature]
) -> Bound | None:
    """Return the constraints of a world after an edit; None if it needs a rebuild.

    number: (n,) new indices of particles, -1 for removed ones. now: all particles after the edit. starts: the new particles at
    which features started, by the ids of the old ones. extend: features, and for each a feature whose constraints it takes over.
    Raises the ValueErrors of building a world. Nothing is changed yet.
    """
    runner, scene, memory = world._runner, world._runner.scene, world._runner.memory
    drivers, batches = runner.step.drivers, runner.batches
    bound = [*drivers, *batches]
    if not (set(extend) <= set(bound)) or any(f.needs_new_state for f in bound):
        return None
    if not batches or any(f.changed and f not in drivers for f in bound):
        return None
    if scene.slots.answers:  # contacts have tables of all corners
        return None
    structure = runner.structure = runner.structure or _structure(scene, bound)
    objects = [scene, scene.slots, *bound]
    before, exact = [dict(vars(one)) for one in objects], scene.slots.exact
    kept, ramps = {f: f.kept_mask(number) for f in bound}, {f: f.ramp for f in bound if f.ramp and f.ramp.is_allocated}
    more, inv_mass = {f: other.copy() for f, other in extend.items()}, now.inv_mass.copy()
    try:
        for f in world.features:
            if f in kept:
                start = starts[id(f.start)]
                f.release()
                f.remap_indices(number, now.count)
                f.periodic = scene.periodic
                f.start = extended(f, more[f], start, now, scene.periodic) if f in more else start
                f.prepare(f.start, inv_mass)
        _check(world, now, int(np.count_nonzero(number >= 0)), drivers, batches, inv_mass)
        scene.particles, scene.inv_mass = now, inv_mass
        with memory.redeclare({scene.count: now.count}) as again:
            system = scene.slots.system
            with memory.owned("slots"):
                scene.slots.__init__(scene, batches, world._solver, scene.slots.answers)
            if scene.slots.system and system:
                scene.slots.system.team, scene.slots.system.stride = system.team, system.stride
            for f in bound:
                with memory.owned(f):
                    f.bind(scene)
                if f in ramps:
                    f.ramp.adopt(ramps[f])
                f.note_built()
        if not (memory.has_room(again.longest) and scene.slots.exact == exact and _structure(scene, bound) == structure):
            return None
        linked = excluded_pairs(batches, now.radius)
        if runner.search and not runner.search.can_exclude(linked):
            return None
        attributes = [(one, old, dict(vars(one))) for one, old in zip(objects, before, strict=True)]
        return Bound(again, inv_mass, linked, attributes, kept, more)
    except DeclarationsDiffer:
        return None
    finally:
        for one, values in zip(objects, before, strict=True):
            vars(one).clear()
            vars(one).update(values)


def _check(world: Any, now: Particles, first: int, drivers: list[Batch], batches: list[Batch], inv_mass: np.ndarray) -> None:
    """Raise DeclarationsDiffer if other batches would act than before, and ValueError where building a world would.

    first: the index of the first added particle.
    """
    there = [f for f in world.features if isinstance(f, Batch) and f.count]
    acting = [f for f in there if not f.is_kinematic and (inv_mass[f.indices] > 0).any()]
    if acting != batches or [f for f in there if f.is_kinematic] != drivers:
        raise DeclarationsDiffer
    refuse_held_twice(now, world.features)
    if box := world._runner.scene.periodic:
        from .misfits import refuse_misfits  # noqa: PLC0415  (it imports features that the world may not use)

        refuse_misfits(box, now, world.features)
    for f in (*drivers, *batches):
        f.check_added(now, first)


def bind(world: Any, change: Regrouping, now: Bound) -> None:
    """Bind the planned constraints, after particles and contacts were changed."""
    runner = world._runner
    memory, particles = runner.memory, runner.scene.count
    names = {id(e.field): k for k, e in enumerate(memory.entries)}
    noted = {f: memory.scratch(f) for f in now.kept}
    held = {k: memory.view(memory.entries[k].field).copy() for k in now.again.state}
    now.again.write()
    for k, values in held.items():
        if memory.entries[k].rows is particles:
            memory.view(memory.entries[k].field)[...] = values
    for f, before, after in now.attributes:
        vars(f).clear()
        vars(f).update(after)
        if not isinstance(f, Batch):
            continue
        masks, old, new = now.kept[f], _state(before["dev"], names), _state(after["dev"], names)
        for key in [key for key in old.keys() & new.keys() if old[key] in held]:
            values = held[old[key]]
            choices = (change.some,) if getattr(vars(f.dev)[key[0]], "per_particle", False) else masks
            some = next((mask for mask in choices if len(mask) == len(values)), None)
            values = values if some is None else values[some]
            memory.view(memory.entries[new[key]].field)[: len(values)] = values
    for f, rows in noted.items():
        memory.put_scratch(f, rows, now.kept[f])
        if f.ramp and f.ramp.is_allocated:
            f.ramp.resize()
    constraints = runner.step.constraints
    constraints.systems[:] = [runner.scene.slots.system] if constraints.systems else []
    constraints.semi_iterations[:] = [runner.scene.slots.semi_iteration] if constraints.semi_iterations else []
    if runner.search:
        runner.search.exclude(now.linked)


def _structure(scene: Any, bound: list[Batch]) -> Any:
    """Return a key of all that kernels can read of constraints."""
    from ..device.patches.sharing import KernelInputs  # noqa: PLC0415  (it uses Taichi's internals; few worlds need it)

    return KernelInputs((scene.slots, *bound), known=(scene.memory, scene.state)).key


def _state(dev: Any, names: dict[int, int]) -> dict[tuple[str, str], int]:
    """Return the indices of the state fields that a feature's `dev` holds, or a part of it lists as `in_state`."""
    parts = {key: getattr(value, "in_state", {"": value}) for key, value in vars(dev).items()}
    fields = {(key, part): id(field) for key, held in parts.items() for part, field in held.items()}
    return {key: names[field] for key, field in fields.items() if field in names}
