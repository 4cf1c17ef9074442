"""The arguments that an object was made with, what a recording needs to make it again; and which of them can be set later.

Feature and Solver, and so all that is below them, keep them in `arguments`. Once __init__ is over only knobs can be set, and
names that begin with an underscore: what else an object consists of is compiled into kernels. Its own methods set such an
attribute by self._keep(name=value). Arrays become read-only, since no kernel would see what is written to them.
"""

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ..device import at
from ..device.language import inside_kernel
from .read_only import assign_whole, handed_out, structure

TAKEN_BY = {"one_way": "Capsule, Polygon and Mesh"}  # arguments that others of the same kind do not have


class Knob:
    """A live setting: checked when assigned, written to the device before the next frame.

    check: a function (feature, value) -> value that raises for a wrong one.
    force: it changes a force, so that displacements are turned into velocities first, see World._restart().
    compiled: kernels have its value in them, so that another one has the world built anew, see Feature.outgrown.
    built: another one has the world built anew, too, but with the same kernels.
    device: the attribute that is its field, for kernels, which read the setting by the same name; None where they do not.
    """

    def __init__(
        self, check: Callable, doc: str, *, force: bool = False, compiled: bool = False, built: bool = False,
        device: str | None = None,
    ):  # fmt: skip
        self.check, self.force, self.compiled, self.built, self.device = check, force, compiled, built, device
        self.__doc__ = doc

    def __set_name__(self, owner, name: str) -> None:
        self.name = name

    def __get__(self, feature, owner=None) -> Any:
        if feature is None:
            return self
        if self.device and inside_kernel() and self.device in vars(feature.dev):
            return at(vars(feature.dev)[self.device], None)
        if self.name not in feature.__dict__:
            raise AttributeError(f"{feature!r} has no {self.name}.")
        return feature.__dict__[self.name]

    def __set__(self, feature, value) -> None:
        value, own = self.check(feature, value), feature.__dict__
        own[self.name] = handed_out(value, assign_whole(type(feature).__name__, self.name))
        own["changed"] = True
        if self.force:
            own["new_force"] = True


def record_arguments(kind: Any) -> None:
    """Have a class, as it is made, keep the arguments of its __init__, by name, as they were when an object was made."""
    live = tuple(name for name, value in vars(kind).items() if isinstance(value, Knob))
    kind.host_only = (*vars(kind).get("host_only", ()), *live)  # what kernels have of them is compiled()
    if "__init__" in vars(kind):
        kind.__init__ = _recording(kind.__init__)


def set_attribute(thing: Any, name: str, value: Any) -> None:
    """The __setattr__ of what records its arguments: once it is made, only knobs and what a world keeps in it can be set."""
    if name.startswith("_") or name in thing.kept_by_world or isinstance(getattr(type(thing), name, None), Knob):
        object.__setattr__(thing, name, value)
    elif "arguments" in thing.__dict__:
        raise AttributeError(_refused(thing, name))
    else:
        keep(thing, **{name: value})


def keep(thing: Any, **values: Any) -> None:
    """Set attributes that cannot be set from outside."""
    for name, value in values.items():
        object.__setattr__(thing, name, handed_out(value, structure(type(thing).__name__, name)))


def refuse_deletion(thing: Any, name: str) -> None:
    """The __delattr__ of what records its arguments."""
    raise AttributeError(f"{thing!r}.{name} cannot be deleted.")


def _refused(thing: Any, name: str) -> str:
    """Why an attribute cannot be set, and what to do instead."""
    kind = type(thing)
    live, given = knobs_of(kind), [*inspect.signature(kind).parameters]
    can = f"Live are {', '.join(live)}" if live else "Nothing of it is live"
    if name in given or inspect.getattr_static(thing, name, None) is not None:
        return (
            f"{thing!r}.{name} cannot be set: it is fixed when {kind.__name__} is made. {can}. For another {name} make "
            f"a new {kind.__name__}; in a world, world.remove(features=[old]) and world.add(features=[new])."
        )
    return f"{thing!r} has no {name!r}{meant(name, [*live, *given])}. {can}."


@functools.cache
def knobs_of(kind: type) -> tuple[str, ...]:
    """The names of the live settings of a class."""
    return tuple(name for name in dir(kind) if isinstance(getattr(kind, name, None), Knob))


def meant(name: str, names: Iterable[str]) -> str:
    """A guess at what a misspelt name was to be, as the end of a sentence; empty if nothing is near."""
    near = difflib.get_close_matches(name, [*names], 1)
    return f"; did you mean {near[0]!r}?" if near else ""


def _recording(init):
    signature = inspect.signature(init)

    @functools.wraps(init)
    def recorded(self, *args, **kwargs):
        """The same __init__, which keeps its arguments."""
        for name in (kwargs.keys() - signature.parameters.keys()) & TAKEN_BY.keys():
            raise TypeError(f"{type(self).__name__}: there is no {name}. {TAKEN_BY[name]} take it.")
        args, kwargs = _frozen(args), _frozen(kwargs)
        init(self, *args, **kwargs)
        if type(self).__init__ is recorded:  # and not that of a base class, whose subclass is not done yet
            self.arguments = dict(list(signature.bind(self, *args, **kwargs).arguments.items())[1:])

    return recorded


def _frozen(value: Any) -> Any:
    """The same value, safe from what its owner does with it later; what can be read only once is read."""
    if type(value) in (int, float, str):  # most of what long lists hold
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
