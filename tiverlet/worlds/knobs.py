"""Knobs that differ from world to world."""

import contextlib
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..features.arguments import knobs_of
from ..features.feature import Feature
from ..features.unknown_names import owners_of, suggest

if TYPE_CHECKING:
    from ..world import World


class Knobs:
    """The knobs of the features of one World that stands for `count` worlds.

    Holds the knobs that differ from world to world, the value of each world, and which knobs wait to be uploaded for the next
    frame. worlds: the worlds from which they were made.
    """

    def __init__(self, features: tuple[Feature, ...], worlds: "list[World]", count: int):
        self.features, self.count = features, count
        self._given = _other_knobs(worlds)  # (feature, knob) -> the value of each world
        self._waiting = [[_flags(f) for f in world.features] for world in worlds]  # flags per world, for frame 1
        self._set: dict[int, np.ndarray] = {}  # feature -> mask of the worlds in which set() changed its knobs
        self._forced: set[Feature] = set()  # those of these features whose force changed
        for f, *each in zip(features, *self._waiting, strict=True):
            changed, moving, new_force = (any(flags) for flags in zip(*each, strict=True))
            _set_flags(f, (changed, moving, new_force))

    def forget_assigned(self) -> None:
        """Drop values per world of knobs that were assigned for all worlds since."""
        for i, name in [*self._given]:
            if vars(self.features[i])[name] is not self._given[i, name]:
                del self._given[i, name]

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

    def set(self, i: int, chosen: np.ndarray, knobs: dict[str, Any]) -> None:
        """Set knobs of feature i in the chosen worlds, see Worlds.set()."""
        f = self.features[i]
        self.forget_assigned()
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
            every = list(before) if (i, name) in self._given else [before] * self.count
            k = -1
            try:
                for k, value in zip(chosen, values, strict=True):
                    with self.shown(k):  # knobs are checked against other knobs of the same world
                        every[k] = knob.check(f, value)
                        if not f.uploads_all:
                            _check_fits(f, name, every[k])
                together = _stacked(every)
                if f.uploads_all:
                    k = -1
                    _check_fits(f, name, together)
            except (ValueError, TypeError) as error:
                if k >= 0:
                    error.add_note(f"That is what Worlds.set was given for world {k}.")
                raise
            vars(f)[name] = self._given[i, name] = together
            mask = self._set.setdefault(i, np.zeros(self.count, dtype=bool))
            mask[chosen] = True
            if knob.force:
                self._forced.add(f)

    def check_kernels(self) -> None:
        """Raise ValueError if a knob that was assigned for all worlds needs other kernels; for the world that is shown."""
        for f in self.features:
            if f.changed and f.needs_other_kernels:
                _refuse_other_kernels(f)

    def has_nothing_to_upload(self) -> bool:
        """Whether no knob waits to be uploaded."""
        if self._set or any(f.changed or f.moving for f in self.features):
            return False
        self._waiting = []  # no flag of the original worlds waits either
        return True

    def upload_to_all(self) -> bool:
        """Upload the knobs of all worlds at once if features can. Returns False if each world has to be uploaded by itself."""
        changed = [f for i, f in enumerate(self.features) if f.changed or i in self._set]
        able = all(f.uploads_all and not f.new_force and f not in self._forced for f in changed)
        able = able and all(f.uploads_all for f in self.features if f.moving) and len(self._waiting) <= 1
        stacked = [values for (i, _), values in self._given.items() if self.features[i] in changed]
        if not able or any(not isinstance(values, np.ndarray) or values.dtype == object for values in stacked):
            return False
        self._set, self._waiting = {}, []
        for f in self.features:
            if f.moving:
                f.moving = False
                f.end_motion()
        for f in changed:
            f.changed = False
            f.upload()
        return True

    @property
    def changed_worlds(self) -> np.ndarray:
        """The worlds in which a knob has another value than in the last frame, a mask."""
        if len(self._waiting) > 1 or any(f.changed for f in self.features):
            return np.ones(self.count, dtype=bool)
        return np.any([np.zeros(self.count, dtype=bool), *self._set.values()], axis=0)

    def waiting_mask(self, feature: Feature) -> np.ndarray:
        """Return the mask of the worlds in which a knob of a feature waits."""
        of = self._set.get(self.features.index(feature), np.zeros(self.count, dtype=bool))
        return of | feature.changed

    @property
    def waiting_worlds(self) -> np.ndarray:
        """The numbers of the worlds in which a knob waits or a target moves."""
        if len(self._waiting) > 1 or any(f.changed or f.moving for f in self.features):
            return np.arange(self.count)
        return np.flatnonzero(np.any([*self._set.values()], axis=0))

    def note_uploaded(self, moving: list[bool]) -> None:
        """Note that each world was uploaded by itself. moving: for each feature, whether a target moves in any world."""
        self._set, self._waiting = {}, []
        self._forced.clear()
        for f, still in zip(self.features, moving, strict=True):
            _set_flags(f, (False, still, False))

    @contextlib.contextmanager
    def flagged(self, k: Any) -> Iterator[None]:
        """Set the flags of features to those of world k while the context lasts."""
        common = [_flags(f) for f in self.features]
        own = self._waiting[k] if len(self._waiting) > 1 else common
        for i, (f, (changed, moving, new_force)) in enumerate(zip(self.features, own, strict=True)):
            changed = changed or (i in self._set and bool(self._set[i][k]))
            _set_flags(f, (changed, moving, new_force or (changed and f in self._forced)))
        try:
            yield
        finally:
            for f, flags in zip(self.features, common, strict=True):
                _set_flags(f, flags)


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


def _flags(feature: Feature) -> tuple[bool, bool, bool]:
    """Return the flags of a feature: what waits in it to be uploaded."""
    return feature.changed, feature.moving, feature.new_force


def _set_flags(feature: Feature, flags: tuple[bool, bool, bool]) -> None:
    feature.changed, feature.moving, feature.new_force = flags


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
