"""Rebuilding a world around the same features, with the particles and the state that remain."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..colliders.collider import Collider
from ..contact.pair_contact import PairContact
from ..device.memory import ALL, Memory
from ..features.feature import Acceleration, Batch, Feature, extended
from ..neighbours.neighbour_list import WALL
from ..neighbours.periodic import Periodic
from ..particles import Particles
from ..solvers.direct import SOFTENED
from . import checkpoint
from .build import assemble


class Rebuild:
    """A rebuild of a world with its particles in the mask `some`, added particles and these features, see edit_scene.change().

    new_features, removed_features: features whose state begins anew are in both. extending: features by which others are
    extended. If building fails, the world is left as it was.
    """

    def __init__(
        self, world: Any, some: np.ndarray, added: Particles | None, features: tuple[Feature, ...],
        extend: Mapping[Feature, Feature],
    ):  # fmt: skip
        self.world, self.some, self.added, self.features, self.before = world, some, added, features, world.features
        self.new_features = [f for f in features if f not in self.before or f.needs_new_state]
        self.removed_features = [f for f in self.before if f not in features or f.needs_new_state]
        self.extending = {f: other.copy() for f, other in extend.items()}
        self.number = np.where(some, np.cumsum(some) - 1, -1)
        self.particles = world._particles.regrouped(some, added, world.position[some])
        known = {one: start.regrouped(some, added) for one, start in {id(f.start): f.start for f in self.before}.items()}
        self.starts: list[Any] = [None if f in self.new_features else known[id(f.start)] for f in features]
        # The state before, to carry over and to restore after a failure.
        self.checkpoint = checkpoint.keep(world)
        self.attributes = {f: dict(vars(f)) for f in {*self.before, *features}}
        self.noted = {f: world._runner.memory.scratch(f) for f in self.before if isinstance(f, Batch)}
        self.old: dict[str, np.ndarray] = {}  # the state before, by name
        self.masks: dict[Feature, tuple[np.ndarray, ...]] = {}  # of the rows of each feature that remain
        self.rests: dict[Feature, np.ndarray] = {}  # rest values that still move to the assigned ones

    def run(self) -> None:
        """Rebuild the world. Raises the errors of building it, with the world unchanged."""
        parts, before, memories = None, dict(vars(self.world)), self.world._runner.memories
        try:
            self._settle()
            self._take_apart()
            parts = self._assembled()
            self._install(parts, self._carried(parts.memory))
        except BaseException:
            if parts:
                parts.memory.destroy()
            vars(self.world).update(before)
            self._undo()
            raise
        for memory in memories:
            memory.destroy()

    def _settle(self) -> None:
        """Store the state. If the forces on remaining particles will change, displacements become velocities first."""
        runner = self.world._runner
        runner.note_displacements()
        if self.world._releases_load or any(isinstance(f, Collider) for f in self.removed_features):
            self.world._restart_with_reactions()
        elif self.restarts:
            with runner.memory.compiler():
                runner.restart(self.world.iterations)
        else:
            self.old = self.checkpoint.values
            return
        self.old = checkpoint.state(self.world)

    @property
    def restarts(self) -> bool:
        """Whether forces will be others."""
        pulled = (self.added is not None or not self.some.all()) and self.world._runner.step.has_pair_forces  # by others
        return (
            pulled
            or self.world._has_new_force
            or any(map(self._drives, (*self.new_features, *self.removed_features, *self.extending.values())))
        )

    def _drives(self, feature: Feature) -> bool:
        """Whether adding or removing a feature changes the force on particles that remain."""
        if isinstance(feature, Batch):
            return feature.soft and bool(feature.kept_mask(self.number)[0].any()) if feature.scene else feature.soft
        return isinstance(feature, Acceleration)

    def _take_apart(self) -> None:
        """Release features, and give them the new indices of their particles."""
        self.masks = {f: tuple(mask & (f not in self.new_features) for mask in f.kept_mask(self.number)) for f in self.before}
        self.rests = {f: np.stack(f.ramp.now())[:, self.masks[f][0]] for f in self.features if f.ramp and f.ramp.has_pending}
        for f in self.before:
            f.release()
            f.remap_indices(self.number, len(self.particles))
        for f in self.removed_features:
            f.compiled_so_far = frozenset()

    def _assembled(self) -> Any:
        """Return the parts of the new world, see assemble()."""
        box = next((f for f in self.features if isinstance(f, Periodic)), None)
        for k, f in enumerate(self.features):
            if f in self.extending:
                self.starts[k] = extended(f, self.extending[f], self.starts[k], self.particles, box)
        return assemble(self.particles, self.features, self.starts, int(self.some.sum()), *self.world._build_options)

    def _carried(self, memory: Memory) -> dict[str, np.ndarray]:
        """Return the state of the new world, with the rows of particles and constraints that remain carried over."""
        new = memory.state()
        names = [one.places_in_state() for one in (self.world._runner.memory, memory)]
        owned: list[set[str]] = [set(), set()]
        moves: list[tuple[tuple[str, slice], tuple[str, slice], tuple[np.ndarray, ...]]] = []
        for feature, before in self.attributes.items():
            pair = [_fields(values, known) for values, known in zip((before, vars(feature)), names, strict=True)]
            for known, found in zip(owned, pair, strict=True):
                known.update(name for name, _ in found.values())
            for key in pair[0].keys() & pair[1].keys():
                per_particle = getattr(vars(feature.dev)[key[0]], "per_particle", False)  # not decided by the number of rows
                moves.append((pair[0][key], pair[1][key], (self.some,) if per_particle else self.masks[feature]))
        fields = [{name for name, _ in places.values()} for places in names]
        shared = (fields[0] - owned[0]) & (fields[1] - owned[1])
        if SOFTENED in shared and (self.extending or len(self.old[SOFTENED]) != len(new[SOFTENED])):  # there are other parts
            shared.remove(SOFTENED)
        moves += [((name, ALL), (name, ALL), (self.some,)) for name in shared]
        for (before, old), (after, place), choices in moves:
            rows = self.old[before][old]
            mask = next((choice for choice in choices if len(choice) == len(rows)), None)
            rows = rows if mask is None else rows[mask]
            new[after][place][: len(rows)] = rows
        return new

    def _undo(self) -> None:
        """Restore the world as it was."""
        for f, values in self.attributes.items():
            f.__dict__.clear()
            f.__dict__.update(values)
        if self.world._clock.d_is_velocity != self.checkpoint.clock.d_is_velocity:
            checkpoint.put_back(self.world, self.checkpoint)
        self.world._clock.put_back(self.checkpoint.clock)

    def _install(self, parts: Any, state: dict[str, np.ndarray]) -> None:
        """Install the new parts in the world, with the state that was carried over."""
        world, last = self.world, self.world._runner
        contact = next((c for c in last.step.contacts if c in self.features), None)
        multipliers, left, faces = last.scene.multipliers_per_newton, last.left, _faces(last.scene)
        world._clock.velocity_override = None
        world._install(world._particles.regrouped(self.some, self.added), self.features, parts)
        runner = world._runner
        runner.memory.compiler.times.add(last.memory.compiler.times)
        runner.pass_on(left, self.some)
        runner.scene.multipliers_per_newton = multipliers
        runner.memory.restore(state)
        for f, rows in self.noted.items():
            if f in self.features:
                runner.memory.put_scratch(f, rows, self.masks[f])
        runner.renew_softness()
        runner.wake()
        if contact and contact in runner.step.contacts:
            self._give_contacts(faces)
        drag, world._clock.drag = world._clock.drag, None
        if runner.integrator.decays:
            runner.set_substep(world._clock.h, drag)
        for f in self.features:
            if f not in self.new_features:
                f.changed, f.moving = self.attributes[f].get("changed", True), self.attributes[f].get("moving", False)
                f.new_force = self.attributes[f].get("new_force", False)
        for f, values in self.rests.items():
            if f.ramp:  # rest values continue to the assigned ones; those of added constraints begin at their own
                f.ramp.put([np.append(rows, now[len(rows) :]) for rows, now in zip(values, f.ramp.now(), strict=True)])
        if any(isinstance(f, PairContact) for f in self.new_features):
            world._clock.first_moved = 0

    def _give_contacts(self, faces: dict[Any, np.ndarray]) -> None:
        """Carry over the data of pairs in contact. faces: the numbers of those of each wall before."""
        search, pairs = self.world._runner.search, self.old["Contact.pairs"].copy()
        assert search
        some = pairs < WALL
        pairs[some] = self.number[pairs[some]]
        now, walls = _faces(self.world._runner.scene), pairs[~some] - WALL
        face = np.full(walls.max(initial=-1) + 1, -1)
        for wall, before in faces.items():
            kept = before[before < len(face)]
            if len(now.get(wall, ())) == len(before):
                face[kept] = WALL + now[wall][: len(kept)]
        pairs[~some] = face[walls]
        both = (pairs >= 0).all(axis=1)
        # Data without an old value, of features that were just added, is 0.
        nothing = {p.name: np.zeros((len(pairs), p.width) if p.width else len(pairs)) for p in search.list.persistent}
        search.list.restore(pairs[both], {name: self.old.get(f"Contact.{name}", none)[both] for name, none in nothing.items()})


def _faces(scene: Any) -> dict[Any, np.ndarray]:
    """Return the numbers of the faces of each wall that contacts meet."""
    return {wall: faces for group in scene.walls for wall, faces in zip(group.walls, group.faces, strict=False)}


def _fields(attributes: dict[str, Any], names: dict[int, Any]) -> dict[tuple[str, str], Any]:
    """Return the names and elements of the state fields that a feature's `dev` holds, or a part of it lists as `in_state`."""
    bound = vars(attributes["dev"]) if "dev" in attributes else {}
    parts = {key: getattr(value, "in_state", {"": value}) for key, value in bound.items()}
    fields = {(key, part): field for key, held in parts.items() for part, field in held.items()}
    return {key: names[id(field)] for key, field in fields.items() if id(field) in names}
