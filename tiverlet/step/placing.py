"""Placing walls and targets at once, and shifting a whole scene: changes of place that no motion leads to."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..colliders.collider import Collider
from ..constraints.core.anchored import Anchored
from ..constraints.pin import Pin
from ..features.arguments import knobs_of
from ..features.feature import Feature
from ..forces.gravity import Gravity
from .clock import CHANGED

Values = Mapping[Feature, Mapping[str, Any]]  # values of knobs


def place(world: Any, feature: Feature, values: Mapping[str, Any]) -> None:
    """Set knobs of a wall or a Pin, which is there at once. Raises what assigning them does, with the feature unchanged."""
    if feature not in world.features or not isinstance(feature, Collider | Anchored):
        raise ValueError(f"World.place: {feature!r} is no wall, Pin or Path of this world. Give one of world.features.")
    if unknown := sorted(set(values) - {*knobs_of(type(feature))}):
        raise TypeError(f"World.place: {feature!r} has no knob {unknown[0]}; it has {', '.join(knobs_of(type(feature)))}.")
    position, world._clock.bound = world.position.copy(), CHANGED
    _take(world, {feature: values})
    if isinstance(feature, Pin) and feature.is_kinematic:
        position[feature.indices[:, 0]] = feature.target
        world.position = position


def shift(world: Any, by: np.ndarray) -> None:
    """Shift all particles, walls, targets and centers by a vector, (dim,) [m]. Raises ValueError for what is fixed in space."""
    for f in world.features:
        if f.is_fixed_in_space:
            raise ValueError(
                f"World.shift: {f!r} is fixed in space. Remove it before, and add it again where it belongs then: "
                "world.remove(features=[...]), world.add(features=[...])."
            )
    world._check_places("World.shift", world.position + by)
    knobs = {f: {name: getattr(type(f), name) for name in knobs_of(type(f))} for f in world.features}
    values = {f: {n: knob.place(f, getattr(f, n), by) for n, knob in own.items() if knob.place} for f, own in knobs.items()}
    _take(world, values, by)


def _set(values: Values) -> None:
    """Set knobs that differ. Those of one feature change together: none is checked against what another was, as corners are."""
    other = {f: {n: v for n, v in some.items() if not np.array_equal(getattr(f, n, ()), v)} for f, some in values.items()}
    for f, some in other.items():
        for name in some:
            vars(f).pop(name, None)
        for name, value in some.items():
            setattr(f, name, value)


def _shift_energy(world: Any, by: np.ndarray, waits: bool) -> None:
    """Change the energy that is known, and its bound, as a shift by a vector, (dim,) [m], does.

    waits: whether anything else was assigned since the last step, which has happened now.
    """
    clock, w = world._clock, world._runner.scene.inv_mass
    if waits:
        clock.energy, clock.bound = None, CHANGED
        return
    more = -(1 / w[w > 0]).sum() * sum(
        float(np.dot(f.kernel_values()["g"], by)) for f in world.features if isinstance(f, Gravity)
    )
    clock.energy = None if clock.energy is None else clock.energy + more
    clock.bound = None if clock.bound is None else clock.bound + more


def _take(world: Any, values: Values, by: np.ndarray | None = None) -> None:
    """Set knobs, and shift all positions by a vector, (dim,) [m], without a motion from the present ones."""
    waits = any(f.changed or f.moving for f in world.features)
    world._rebuild_for_knobs()  # for what waits already
    before = {f: {name: getattr(f, name) for name in some} for f, some in values.items()}
    try:
        _set(values)
    except Exception:
        _set(before)
        raise
    if by is None:  # a shift changes no force
        world._rebuild_for_knobs()
    runner = world._runner
    for watcher in world._watchers:
        watcher.before()
    world._upload()
    for f in values:
        if f.moving:
            f.moving = False
            f.end_motion()
    if by is not None:
        runner.scene.state.put(runner.memory, world.position + by)
        _shift_energy(world, by, waits)
    runner.wake()
    runner.invalidate()
    for watcher in world._watchers:
        watcher.broken_off()
