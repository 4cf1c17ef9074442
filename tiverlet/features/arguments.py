"""The arguments that an object was made with, what a recording needs to make it again; and which of them can be set later."""

import difflib
import functools
import inspect
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from ..device import at
from ..device.language import inside_kernel
from .read_only import assign_whole, handed_out, structure


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
        value = self.check(feature, value)
        feature.__dict__[self.name] = handed_out(value, assign_whole(type(feature).__name__, self.name))
        feature.changed = True
        if self.force:
            feature.new_force = True


class RecordsArguments:
    """Objects whose class keeps the arguments of __init__ in `arguments`, by name, as they were then.

    Once __init__ is over only knobs can be set, and names that begin with an underscore: what else an object consists of is
    compiled into kernels. Its own methods set such an attribute by self._keep(name=value). Arrays become read-only, since no
    kernel would see what is written to them.
    """

    arguments: Mapping[str, Any] = MappingProxyType({})
    kept_by_world: tuple[str, ...] = ()  # attributes that a world sets
    host_only: tuple[str, ...] = ()  # attributes that kernels do not read

    def __init_subclass__(cls, **kwargs) -> None:
        super().__init_subclass__(**kwargs)
        live = tuple(name for name, value in vars(cls).items() if isinstance(value, Knob))
        cls.host_only = (*vars(cls).get("host_only", ()), *live)  # what kernels have of them is compiled()
        if "__init__" in vars(cls):
            type.__setattr__(cls, "__init__", _recording(cls.__init__))

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_") or name in self.kept_by_world or isinstance(getattr(type(self), name, None), Knob):
            object.__setattr__(self, name, value)
        elif "arguments" in self.__dict__:
            raise AttributeError(self._refused(name))
        else:
            self._keep(**{name: value})

    def _keep(self, **values: Any) -> None:
        """Set attributes that cannot be set from outside."""
        for name, value in values.items():
            object.__setattr__(self, name, handed_out(value, structure(type(self).__name__, name)))

    def __delattr__(self, name: str) -> None:
        raise AttributeError(f"{self!r}.{name} cannot be deleted.")

    def _refused(self, name: str) -> str:
        live, given = knobs_of(type(self)), [*inspect.signature(type(self)).parameters]
        can = f"Live are {', '.join(live)}" if live else "Nothing of it is live"
        if name in given or inspect.getattr_static(self, name, None) is not None:
            return (
                f"{self!r}.{name} cannot be set: it is fixed when {type(self).__name__} is made. {can}. For another {name} make "
                f"a new {type(self).__name__}; in a world, world.remove(features=[old]) and world.add(features=[new])."
            )
        return f"{self!r} has no {name!r}{meant(name, [*live, *given])}. {can}."


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
        args, kwargs = _frozen(args), _frozen(kwargs)
        init(self, *args, **kwargs)
        if type(self).__init__ is recorded:  # and not that of a base class, whose subclass is not done yet
            self.arguments = dict(list(signature.bind(self, *args, **kwargs).arguments.items())[1:])

    return recorded


def _frozen(value: Any) -> Any:
    """The same value, safe from what its owner does with it later; what can be read only once is read."""
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
