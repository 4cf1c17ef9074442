"""The exact state of a world: what its future depends on, its hash, and how another world takes it over."""

import hashlib
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .world import World


def state(world: "World") -> dict[str, np.ndarray]:
    """Every field that the future depends on: not what the neighbour list looks like, but what its pairs carry."""
    out = {name: values for memory in world._memories for name, values in memory.state().items()}
    if world._grid:
        out["Contact.pairs"], carried = world._grid.carried()
        out.update((f"Contact.{name}", values) for name, values in carried.items())
    return out


def digest(world: "World") -> str:
    """SHA-256 of the exact state and the clock."""
    out = hashlib.sha256(repr((world._time, world._tick, world._since, world._h, world._fresh)).encode())
    for name, values in state(world).items():
        out.update(name.encode())
        out.update(values.tobytes())
    return out.hexdigest()


def transfer(old: "World", new: "World") -> None:
    """Take over the state, bit for bit where both have the same precision."""
    new._time, new._tick, new._since, new._frame = old._time, old._tick, old._since, old._frame
    if new._precision != old._precision:
        new.position, new.velocity = old.position, old.velocity
        for ours, theirs in zip(old._sub.breakers, new._sub.breakers, strict=True):
            new._memory.write(theirs._on_broken, ours.stamps())
        return
    new._upload(old._h, old._drag)
    if any(c._on_eases for c in old._sub.contacts):
        new._sub.contacts[0].ease()
        new._renew()
    values = state(old)
    for memory in new._memories:
        memory.restore(values)
    if new._grid:
        new._grid.restore(values["Contact.pairs"], {piece.name: values[f"Contact.{piece.name}"] for piece in new._grid.lasting})
        new._renew()
    for ours, theirs in zip(old.features, new.features, strict=True):
        theirs.changed, theirs.moving = ours.changed, ours.moving
    new._fresh, new._started = old._fresh, old._started
    new._placed, new._energy = old._placed, old._energy
