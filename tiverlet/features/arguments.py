"""The arguments of an object's __init__, kept so that a recording can rebuild the object; and which of them can be set later.

Feature and Solver and their subclasses keep them in `arguments`. After __init__, only knobs and names that begin with an
underscore can be set: the rest of an object is compiled into kernels. The object's own methods set such an attribute by
self._keep(name=value). Arrays become read-only, since kernels would not see values written to them.
"""

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from .. import checks
from ..device.language import at, inside_kernel
from .read_only import as_read_only, assign_whole_advice, structure_advice
from .unknown_names import owners_of, suggest


class Knob:
    """A live setting: checked when assigned, written to the device before the next frame. Assigning the value that it has does
    nothing.

    check: a function (feature, value) -> value that raises for an invalid value.
    force: the knob changes a force, so displacements are turned into velocities first, see World._restart_for_new_forces().
    compiled: kernels contain the value, so the world is rebuilt for another one, see Feature.needs_other_kernels.
    built: the world is rebuilt for another value, too, but with the same kernels.
    place: a function (feature, value, vector) -> value after World.shift(vector), such as shifted(); None if it is no place.
    device: the attribute with the knob's field. Kernels read the setting by the knob's name; None where they do not read it.
    """

    def __init__(
        self, check: Callable, doc: str, *, force: bool = False, compiled: bool = False, built: bool = False,
        place: Callable | None = None, device: str | None = None,
    ):  # fmt: skip
        self.check, self.force, self.compiled, self.built, self.place, self.device = check, force, compiled, built, place, device
        self.__doc__ = doc

    def __set_name__(self, owner, name: str) -> None:
        self.name = name

    def __get__(self, feature, owner=None) -> Any:
        if feature is None:
            return self
        if self.device and inside_kernel() and self.device in vars(feature.dev):
            return at(vars(feature.dev)[self.device], None)
        if self.name not in feature.__dict__:
            raise AttributeError(f"{feature!r} has no {self.name} before it is in a World, which takes it from the particles.")
        return feature.__dict__[self.name]

    def __set__(self, feature, value) -> None:
        value = self.check(feature, value)
        if self.name not in feature.__dict__ or not _is_same(feature.__dict__[self.name], value):
            self.put(feature, value)

    def put(self, feature, value) -> None:
        """Set a checked value, and let it be written to the device, even if it is the present one."""
        own = feature.__dict__
        own[self.name] = as_read_only(value, assign_whole_advice(type(feature).__name__, self.name))
        own["changed"] = True
        if self.force:
            own["new_force"] = True


def shifted(feature: Any, value: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Return places (..., dim) [m], the value of a knob, after a shift of the scene by a vector, (dim,)."""
    return value + by


def _is_same(old: Any, new: Any) -> bool:
    """Whether two values of a knob are the same, bit for bit: numbers, or arrays of one type and shape."""
    if isinstance(old, np.ndarray) and isinstance(new, np.ndarray):
        return old.dtype == new.dtype and old.shape == new.shape and old.tobytes() == new.tobytes()
    return type(old) is type(new) and isinstance(old, (bool, int, float)) and repr(old) == repr(new)


def record_arguments(kind: Any) -> None:
    """Make a class keep the arguments of its __init__, by name, as they were when an object was made. Called per class."""
    live = tuple(name for name, value in vars(kind).items() if isinstance(value, Knob))
    kind.host_only = (*vars(kind).get("host_only", ()), *live)  # kernels contain only the values in compiled()
    if "__init__" in vars(kind):
        kind.__init__ = _recording(checks.answer_arguments(kind.__init__))


def set_attribute(thing: Any, name: str, value: Any) -> None:
    """The __setattr__ of classes that record arguments. After __init__, it sets only knobs and attributes that a world keeps."""
    if name.startswith("_") or name in thing.kept_by_world or name in knobs_of(type(thing)):
        object.__setattr__(thing, name, value)
    elif "arguments" in thing.__dict__:
        raise AttributeError(_refused(thing, name))
    else:
        keep(thing, **{name: value})


def keep(thing: Any, **values: Any) -> None:
    """Set attributes that cannot be set from outside."""
    for name, value in values.items():
        object.__setattr__(thing, name, as_read_only(value, structure_advice(type(thing).__name__, name)))


def state_alone(self: Any) -> dict[str, Any]:
    """The __getstate__ of features, for pickle and copy.deepcopy(): a feature without its world, like copy()."""
    return vars(self.copy())


def names_for_users(self: Any) -> list[str]:
    """The __dir__ of classes that record arguments, for completion: what users read and set, not what a world calls.

    These are arguments and knobs, the names in `for_users` of a class and its bases, and all that classes of the user define.
    """
    kind, names = type(self), {*inspect.signature(type(self)).parameters, *knobs_of(type(self))}
    for base in kind.__mro__[:-1]:
        own = not base.__module__.startswith("tiverlet.")
        names |= {*vars(base).get("for_users", ()), *(vars(base) if own else ())}
    return sorted(n for n in names if n[0] != "_" and (n in vars(self) or inspect.getattr_static(kind, n, None) is not None))


def refuse_deletion(thing: Any, name: str) -> None:
    """The __delattr__ of classes that record arguments."""
    raise AttributeError(f"{thing!r}.{name} cannot be deleted.")


def _refused(thing: Any, name: str) -> str:
    """Return why an attribute cannot be set, and what to do instead."""
    kind = type(thing)
    live, given = knobs_of(kind), [*inspect.signature(kind).parameters]
    can = f"Live are {', '.join(live)}" if live else "Nothing of it is live"
    if name in given or inspect.getattr_static(thing, name, None) is not None:
        return (
            f"{thing!r}.{name} cannot be set: it is fixed when {kind.__name__} is made. {can}. For another {name} make "
            f"a new {kind.__name__}; in a world, world.remove(features=[old]) and world.add(features=[new])."
        )
    return f"{thing!r} has no {name!r}{suggest(name, owners_of(kind), [*live, *given])} {can}."


@functools.cache
def knobs_of(kind: type) -> tuple[str, ...]:
    """Return the names of the live settings of a class."""
    return tuple(name for name in dir(kind) if isinstance(getattr(kind, name, None), Knob))


def _recording(init):
    signature = inspect.signature(init)

    @functools.wraps(init)
    def recorded(self, *args, **kwargs):
        """Run the original __init__, and keep its arguments."""
        args, kwargs = _frozen(args), _frozen(kwargs)
        init(self, *args, **kwargs)
        if type(self).__init__ is recorded:  # not in the __init__ of a base class, called by a subclass
            self.arguments = dict(list(signature.bind(self, *args, **kwargs).arguments.items())[1:])

    return recorded


def _frozen(value: Any) -> Any:
    """Copy a value so that later changes by its owner have no effect; iterators are read into lists."""
    if type(value) in (int, float, str):  # fast path: most items of long lists
        return value
    if isinstance(value, np.ndarray):
        if value.flags.writeable or value.base is not None:
            value = value.copy()
            value.flags.writeable = False
        return value
    if isinstance(value, Mapping):
        return {key: _frozen(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return tuple(_frozen(item) for item in value)
    if isinstance(value, (list, Iterator)):
        return [_frozen(item) for item in value]
    return value
