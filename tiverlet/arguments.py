"""The arguments that an object was made with: what a recording needs to make it again."""

import functools
import inspect
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np


class Noted:
    """Objects whose class keeps the arguments of __init__ in `arguments`, by name, as they were then."""

    arguments: Mapping[str, Any] = MappingProxyType({})

    def __init_subclass__(cls, **kwargs) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            type.__setattr__(cls, "__init__", _noting(cls.__init__))


def _noting(init):
    signature = inspect.signature(init)

    @functools.wraps(init)
    def noted(self, *args, **kwargs):
        args, kwargs = _frozen(args), _frozen(kwargs)
        init(self, *args, **kwargs)
        self.arguments = dict(list(signature.bind(self, *args, **kwargs).arguments.items())[1:])

    return noted


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
