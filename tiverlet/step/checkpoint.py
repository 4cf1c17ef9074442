"""The exact state of a world, on which its future depends: how to copy, hash, check and restore it."""

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..features.feature import Batch
from ..neighbours.neighbour_list import WALL
from ..neighbours.periodic import Periodic
from .clock import PACE, Clock

if TYPE_CHECKING:
    from ..world import World
    from .runner import Runner

PAIRS, PAIR = "Contact.pairs", "Contact."  # name of the array of pairs with data; prefix of the names of these data
RESTS = "rests."  # prefix of rest values while knobs wait, before a ramp to new values; the number of the feature follows
WORKING = "working."  # prefix of working fields; the number of the feature and of the field follow


@dataclass(frozen=True)
class Checkpoint:
    """The state at one time: every field on which the future depends, by name, the clock, and the memory of the controller."""

    values: dict[str, np.ndarray]
    clock: Clock
    controller: tuple

    def position(self, count: int) -> np.ndarray:
        """Return the positions of `count` particles [m]; in f64 if positions have a low word."""
        x = self.values["position"][:count]
        if "position_low" in self.values:
            x = x + self.values["position_low"][:count].astype(np.float64)
        return x


def state(world: "World", pairs: bool = True) -> dict[str, np.ndarray]:
    """Return every field on which the future depends, by name.

    Of the neighbour list, this is the data of its pairs, not the layout. pairs: False leaves these data out, which takes a
    fraction of the time; a difference in them appears in the positions of the next frame.
    """
    out = fields(world._runner, pairs)
    return out | {f"{RESTS}{k}": np.stack(f.ramp.now()) for k, f in enumerate(world.features) if f.ramp and f.ramp.has_pending}


def fields(runner: "Runner", pairs: bool = True) -> dict[str, np.ndarray]:
    """Return the same for a runner, without rest values before a ramp."""
    out = {name: values for memory in runner.memories for name, values in memory.state().items()}
    if runner.search and pairs:
        out[PAIRS], carried = runner.search.list.persistent_data()
        out.update((f"{PAIR}{name}", values) for name, values in carried.items())
    return out


def put_fields(runner: "Runner", values: dict[str, np.ndarray]) -> None:
    """Write back what fields() or state() returned, bit for bit, and forget the events since then."""
    stores = list(map(id, runner.memories))
    for memory in runner.memories:
        memory.restore(values)
    if runner.search:
        runner.search.list.restore(values[PAIRS], {piece.name: values[name] for name, piece in _pieces(runner).items()})
    for log in runner.logs:
        log.forget()
    runner.invalidate()
    if list(map(id, runner.memories)) != stores:
        runner.renew()  # fields were allocated


def keep(world: "World", pairs: bool = True) -> Checkpoint:
    """Return a copy of the exact state. pairs: as in state()."""
    return Checkpoint(state(world, pairs), world._clock.copy(), world._controller.memory)


def digest(world: "World", kept: Checkpoint) -> str:
    """Return the SHA-256 hash of a state of the world, with its clock and the memory of its controller."""
    numbers = [v.item() if isinstance(v, np.generic) else v for v in (*kept.clock.hashed, *kept.controller[PACE:])]
    out = hashlib.sha256(repr(tuple(numbers)).encode())  # Python's numbers, as recordings restore them, not NumPy's
    for name, values in _hashed(world, kept.values).items():
        out.update(name.encode())
        lost = np.isnan(values) if values.dtype.kind == "f" else np.zeros(0)
        out.update((np.where(lost, np.nan, values) if lost.any() else values).tobytes())  # the sign of NaN is not defined
    return out.hexdigest()


def _hashed(world: "World", values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the part of a state that is hashed.

    Left out are fields for reports alone, rest values, which follow from knobs, and late fields (allocated when first needed)
    that are 0. Pairs whose data are for reports alone are left out, too: whether a pair that has just bounced is on the list
    depends on the skin.
    """
    late, pieces = _late(world), _pieces(world._runner)
    told = {e.name for memory in world._runner.memories for e in memory.entries if e.for_reports}
    told |= {name for name, piece in pieces.items() if piece.for_reports}
    out = {n: v for n, v in values.items() if not (n in told or n.startswith(RESTS) or (n in late and not v.any()))}
    if PAIRS in out:
        carried, some = [name for name in pieces if name in out], np.zeros(len(out[PAIRS]), dtype=bool)
        for name in carried:
            some |= out[name].any(axis=tuple(range(1, out[name].ndim)))
        out |= {name: out[name][some] for name in (PAIRS, *carried)}
    return out


def _late(world: "World") -> set[str]:
    """Return the names of fields that are not hashed where they are 0: those of systems."""
    slots = world._runner.scene.slots
    return set(slots.system.late) if slots and slots.system else set()


def _pieces(runner: "Runner") -> dict[str, Any]:
    """Return the data of pairs that are part of the state (PairData), by name."""
    return {f"{PAIR}{piece.name}": piece for piece in runner.search.list.persistent} if runner.search else {}


def flags(world: "World") -> list[list[bool]]:
    """Return for each feature whether knobs wait to be uploaded, and whether a target is being approached."""
    return [[f.changed, f.moving] for f in world.features]


def put_back(world: "World", kept: Checkpoint) -> None:
    """Return to an earlier state, bit for bit."""
    world._runner.set_substep(kept.clock.h, kept.clock.drag)
    put_fields(world._runner, kept.values)
    for k, f in enumerate(world.features):
        if f"{RESTS}{k}" in kept.values:
            f.ramp.put(kept.values[f"{RESTS}{k}"])
    if world._runner.sleep:
        world._runner.sleep.rests = False
        world._runner.sleepers.review()
    if world._clock.softness != kept.clock.softness:
        world._runner.set_softness(kept.clock.softness)
    world._clock.put_back(kept.clock)
    world._runner.set_multipliers_per_newton()
    world._controller.memory = kept.controller


def install(world: "World", kept: Checkpoint, flagged: list[list[bool]]) -> None:
    """Set the state of a world that was just built to that of another one, bit for bit: the same scene, knobs and precision."""
    world._upload()
    undo(world, kept, flagged)
    for k, f in enumerate(world.features):
        if f.ramp and f.ramp.has_pending and f"{RESTS}{k}" not in kept.values:  # in that world, no ramp was under way
            f.ramp.finish()


def check(world: "World", kept: Checkpoint, flagged: list[list[bool]]) -> None:
    """Raise ValueError unless a state from elsewhere fits the world, above all the values that kernels use as indices."""
    present = keep(world)
    rests = {f"{RESTS}{k}": f.ramp.shape for k, f in enumerate(world.features) if f.ramp}
    late, pieces = _late(world), _pieces(world._runner)
    optional = late | rests.keys()
    if set(present.values) - optional != set(kept.values) - optional:
        raise ValueError("The state is not one of this scene: it has other fields.")
    most = {e.name: e.index_limit for memory in world._runner.memories for e in memory.entries if e.index_limit is not None}
    most[PAIRS] = len(world.particles)
    for name, value in kept.values.items():
        ours, free = present.values.get(name), name in pieces or name == PAIRS or name in late
        shape = value.shape == rests[name] if name in rests else ours is None or ours.shape[free:] == value.shape[free:]
        if not shape or (ours is not None and ours.dtype.kind != value.dtype.kind):
            raise ValueError(f"The state is not one of this scene: {name} has shape {value.shape} of {value.dtype}.")
        if name == PAIRS:
            value = np.where(value >= WALL, 0, value)
        if name in most and value.size and not (value.min() >= 0 and value.max() < most[name]):
            raise ValueError(f"The state is not one of this scene: {name} has {value.min()} to {value.max()}, of {most[name]}.")
    if len({len(value) for name, value in kept.values.items() if name in pieces or name == PAIRS}) > 1:
        raise ValueError("The state is not one of this scene: pairs in contact carry other numbers of values.")
    right = len(flagged) == len(world.features) and all(type(b) is bool for pair in flagged for b in pair)
    if not right or not kept.clock.is_valid(len(world.particles), world.particles.dim):
        raise ValueError("The state is not one of this scene: its clock is none.")


def undo(world: "World", kept: Checkpoint, flagged: list[list[bool]]) -> None:
    """Return to the state before a step that was not finished. The next step uploads again what that step uploaded."""
    put_back(world, kept)
    for feature, (changed, moving) in zip(world.features, flagged, strict=True):
        feature.changed, feature.moving = changed, moving


def working_fields(world: "World") -> dict[str, np.ndarray]:
    """Return the numbers that the last substep left in constraints, by name: residuals are computed from them, and the energy."""
    read, batches = world._runner.memory.scratch, [(k, f) for k, f in enumerate(world.features) if isinstance(f, Batch)]
    return {f"{WORKING}{k}.{n}": rows for k, f in batches for n, rows in enumerate(read(f))}


def put_working_fields(world: "World", values: dict[str, np.ndarray]) -> None:
    """Write back what working_fields() returned, as far as the world has such fields."""
    memory = world._runner.memory
    for k, f in enumerate(world.features):
        if isinstance(f, Batch):
            rows: list[np.ndarray] = memory.scratch(f)
            for n, now in enumerate(rows):
                new = values.get(f"{WORKING}{k}.{n}", now)
                if (new.dtype, new.ndim) == (now.dtype, now.ndim):
                    rows[n] = new
            memory.put_scratch(f, rows)


def transfer(old: "World", new: "World") -> None:
    """Copy the state of a world to another one, bit for bit if both have the same precision and order."""
    kept = keep(old)
    if new._precision == old._precision and new._order == old._order:
        install(new, kept, flags(old))
        # the factors from multipliers to loads
        new._runner.scene.multipliers_per_newton = old._runner.scene.multipliers_per_newton
        put_working_fields(new, working_fields(old))
        return
    ours, theirs = new._clock, old._clock
    ours.time, ours.tick, ours.frame = theirs.time, theirs.tick, theirs.frame
    new._controller.memory = kept.controller
    new.position, new.velocity = old.position, old.velocity
    if new._particles.spins:
        new.spin = old.spin
    if new._particles.orientation is not None:
        turned = np.reshape(old.orientation, (len(old.particles), 1 if old.particles.dim == 2 else 4))
        new._runner.memory.write(new._runner.scene.state.spin.orientation, turned)
    for mine, other in zip(new.features, old.features, strict=True):
        if isinstance(mine, Periodic) and isinstance(other, Periodic):
            mine.continued(other)
        if mine.ramp and other.ramp and other.ramp.has_pending:
            mine.ramp.put(other.ramp.now())
            mine.changed = True
    for broke, breaks in zip(old._runner.step.breakers, new._runner.step.breakers, strict=True):
        new._runner.memory.write(breaks.dev.strength.stamp, broke.stamps())
