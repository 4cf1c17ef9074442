"""Knobs that differ from world to world."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..features.arguments import knobs_of
from ..features.feature import Acceleration, Feature
from ..features.items import Items
from ..features.unknown_names import owners_of, suggest

if TYPE_CHECKING:
    from ..world import World

FLAGS = "changed", "moving", "new_force"  # see Feature
CHANGED, MOVING, FORCED = range(len(FLAGS))


class Knobs:
    """The knobs of the features of one World that stands for `count` worlds.

    Holds the knobs that differ from world to world, with the value of each world, and the FLAGS of each world. Features have
    those of a world while it is shown; between that, flags say what was assigned for all worlds. worlds: those from which they
    were made, as many or one.
    """

    def __init__(self, features: tuple[Feature, ...], worlds: "list[World]", count: int):
        self.features, self.count = features, count
        self._given = _other_knobs(worlds)  # (feature, knob) -> the value of each world
        self._flags = np.repeat([_flags(world.features) for world in worlds], count // len(worlds), axis=0)
        self._several = len(worlds) > 1  # and their flags are those of other worlds, with other data
        self._hide_flags()

    def take_assigned(self) -> None:
        """Take over knobs that were assigned for all worlds since, in place of values per world."""
        for i, name in [*self._given]:
            if vars(self.features[i])[name] is not self._given[i, name]:
                del self._given[i, name]
        self._flags |= _flags(self.features)
        self._hide_flags()

    def _hide_flags(self) -> None:
        self._set_flags(np.zeros((len(self.features), len(FLAGS)), dtype=bool))

    def _set_flags(self, flags: np.ndarray) -> None:
        for f, each in zip(self.features, flags.tolist(), strict=True):
            vars(f).update(zip(FLAGS, each, strict=True))

    def show(self, k: int | None) -> None:
        """Give features the knobs of world k; None: those of all worlds, as the user sees them."""
        for (i, name), values in self._given.items():
            self.features[i].__dict__[name] = values if k is None else values[k]

    @contextlib.contextmanager
    def shown(self, k: int) -> Iterator[None]:
        """Give features the knobs of world k while the context lasts."""
        self.show(k)
        try:
            yield
        finally:
            self.show(None)

    @contextlib.contextmanager
    def flagged(self, k: int) -> Iterator[None]:
        """Give features the knobs and flags of world k while the context lasts, and note the flags at its end."""
        with self.shown(k):
            self._set_flags(self._flags[k])
            try:
                yield
            finally:
                self._flags[k] = _flags(self.features)
                self._hide_flags()

    def set(self, i: int, chosen: np.ndarray, knobs: dict[str, Any]) -> None:
        """Set knobs of feature i in the chosen worlds, see Worlds.set()."""
        f = self.features[i]
        self.take_assigned()
        for name, values in knobs.items():
            if name not in knobs_of(type(f)):
                live = ", ".join(knobs_of(type(f))) or "nothing"
                guess = suggest(name, owners_of(type(f)), knobs_of(type(f)))
                raise AttributeError(f"Worlds.set: {name} is no knob of {f!r}{guess} Live are {live}.")
            one = not isinstance(values, (list, tuple)) and np.ndim(values) == 0
            if one or len(values) != len(chosen):
                has = "one value" if one else f"{len(values)} values"
                raise ValueError(f"Worlds.set: {name} has {has}, but there are {len(chosen)} worlds. Give each its own.")
            knob, before = getattr(type(f), name), vars(f)[name]
            every = before if (i, name) in self._given else [before] * self.count
            together = self._checked_at_once(f, knob, every, chosen, values)
            if together is None:
                together = self._checked_each(f, knob, list(every), chosen, values)
            vars(f)[name] = self._given[i, name] = together
            self._flags[chosen, i, CHANGED] = True
            self._flags[chosen, i, FORCED] |= knob.force

    def _checked_at_once(self, f: Feature, knob: Any, every: Any, chosen: np.ndarray, values: Any) -> np.ndarray | None:
        """Return the values of all worlds, (worlds, m), with these in the chosen ones; None where each is to be checked alone."""
        if not (f.uploads_all and isinstance(knob.check, Items)):
            return None
        try:
            values = knob.check.of_worlds(f, np.asarray(values))
        except (ValueError, TypeError):  # let the world be named whose value is wrong
            return None
        together = np.array(every)
        together[chosen] = values
        _check_fits(f, knob.name, together)
        return together

    def _checked_each(self, f: Feature, knob: Any, every: list[Any], chosen: np.ndarray, values: Any) -> Any:
        """Return the values of all worlds, stacked, with these in the chosen ones, after each has been checked in its world."""
        k = -1
        try:
            for k, value in zip(chosen, values, strict=True):
                with self.shown(k):  # knobs are checked against other knobs of the same world
                    every[k] = knob.check(f, value)
                    if not f.uploads_all:
                        _check_fits(f, knob.name, every[k])
            together = _stacked(every)
            if f.uploads_all:
                k = -1
                _check_fits(f, knob.name, together)
        except (ValueError, TypeError) as error:
            if k >= 0:
                error.add_note(f"That is what Worlds.set was given for world {k}.")
            raise
        return together

    def check_kernels(self) -> None:
        """Raise ValueError if a knob that was assigned for all worlds needs other kernels; for the world that is shown."""
        for f in self.features:
            if f.changed and f.needs_other_kernels:
                _refuse_other_kernels(f)

    @property
    def waiting(self) -> Any:
        """Which worlds have a knob that waits to be uploaded, or a target that has moved in the last frame, (worlds,)."""
        return self._flags[..., :FORCED].any(axis=(1, 2))

    def has_changed(self, feature: Feature) -> np.ndarray:
        """Return in which worlds a knob of a feature waits, (worlds,)."""
        return self._flags[:, self.features.index(feature), CHANGED]

    @property
    def any_moves(self) -> bool:
        """Whether a target moves in the coming frame, in any world."""
        return bool(self._flags[..., MOVING].any())

    def changed_forces(self) -> list[Any]:
        """Return the forces that wait in any world, where all that waits beside them uploads for all worlds."""
        changed, _, forced = np.any(self._flags, axis=0).T
        some = self._some(changed)
        forces = [f for f in some if isinstance(f, Acceleration)]
        return forces if not forced.any() and all(f.uploads_all for f in some if f not in forces) else []

    def note_uploaded(self, forces: list[Any]) -> None:
        """Note that these wait no more."""
        self._flags[:, [self.features.index(f) for f in forces], CHANGED] = False

    def upload_to_all(self) -> bool:
        """Upload the knobs of all worlds at once if features can. Returns False if each world has to be uploaded by itself."""
        several, self._several = self._several, False
        changed, moving, forced = np.any(self._flags, axis=0).T  # (features,)
        values = [values for (i, _), values in self._given.items() if changed[i]]
        stacked = all(isinstance(v, np.ndarray) and v.dtype != object for v in values)
        if several or not stacked or forced.any() or not all(f.uploads_all for f in self._some(changed | moving)):
            return False
        for f in self._some(moving):
            f.end_motion()
        for f in self._some(changed):
            f.upload()
        self._flags[..., MOVING] = self._flags[..., CHANGED] & [f.moving for f in self.features]
        self._flags[..., CHANGED] = False
        self._hide_flags()
        return True

    def _some(self, chosen: Any) -> list[Feature]:
        return [f for f, some in zip(self.features, chosen, strict=True) if some]


def _check_fits(feature: Feature, name: str, value: Any) -> None:
    """Raise ValueError if a value of a knob needs other kernels."""
    before, vars(feature)[name] = vars(feature)[name], value
    try:
        if feature.needs_other_kernels:
            _refuse_other_kernels(feature)
    finally:
        vars(feature)[name] = before


def _refuse_other_kernels(feature: Feature) -> None:
    raise ValueError(
        f"Worlds: a knob of {feature!r} asks for what these kernels do not have. Friction where there was none: give the World "
        "that Worlds is made of a value other than 0 first. Other lengths of links that imply others: give it solver=tv.Jacobi()."
    )


def _flags(features: tuple[Feature, ...]) -> np.ndarray:
    """Return the flags of features, (features, FLAGS)."""
    return np.array([(f.changed, f.moving, f.new_force) for f in features], dtype=bool).reshape(-1, len(FLAGS))


def _other_knobs(worlds: "list[World]") -> dict[tuple[int, str], Any]:
    """Return the knobs that differ between the worlds: (number of the feature, name) -> the values."""
    out: dict[tuple[int, str], Any] = {}
    for i, alike in enumerate(zip(*(world.features for world in worlds), strict=True)):
        for name in knobs_of(type(alike[0])):
            values = [vars(f)[name] for f in alike if name in vars(f)]
            if len(values) == len(worlds) and any(not _same(v, values[0]) for v in values):
                out[i, name] = _stacked(values)
    return out


def _same(one: Any, other: Any) -> bool:
    """Whether two values of a knob are equal. Mappings need a case of their own: NumPy would compare their keys."""
    return one == other if isinstance(one, Mapping) else not isinstance(other, Mapping) and np.array_equal(one, other)


def _stacked(values: list[Any]) -> Any:
    """Stack the values of all worlds to an array.

    Return a list if they are not numbers or arrays, such as (static, dynamic), or differ in shape, such as g = 9.81 and (0, 1).
    """
    listed = any(isinstance(v, (tuple, Mapping)) for v in values) or len({np.shape(v) for v in values}) > 1
    return values if listed else np.array(values)
