"""Read-only arrays and mappings for users: they read like any other, and their errors say what to do instead of writing."""

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np


class ReadOnly(np.ndarray):
    """A read-only array. Copies and results of arithmetic are plain arrays. `a += b` makes a new one, so x.a += b assigns it."""

    advice = "This array is read-only."

    def __array_finalize__(self, source) -> None:
        if isinstance(source, ReadOnly):
            self.advice = source.advice

    def __array_wrap__(self, array, context=None, return_scalar=False):
        return array[()] if return_scalar else np.asarray(array)

    def __setitem__(self, key, value) -> None:
        if not self.flags.writeable:
            raise ValueError(self.advice)
        super().__setitem__(key, value)

    def __dlpack__(self, **options):
        """Export to PyTorch, JAX and others without a copy.

        Most of them accept no array that is marked as read-only, so the mark is dropped where the memory below is writable.
        """
        plain = np.asarray(self).view()
        if isinstance(self.base, np.ndarray) and self.base.flags.writeable:
            plain.flags.writeable = True
        return plain.__dlpack__(**options)

    def copy(self, order="C") -> np.ndarray:
        """Return a plain array."""
        return np.array(self, order=order)

    def __iadd__(self, other):
        return np.asarray(self) + other

    def __isub__(self, other):
        return np.asarray(self) - other

    def __imul__(self, other):
        return np.asarray(self) * other

    def __itruediv__(self, other):
        return np.asarray(self) / other

    def __repr__(self) -> str:
        return repr(np.asarray(self))

    def __str__(self) -> str:
        return str(np.asarray(self))


def read_only(array: np.ndarray, advice: str) -> ReadOnly:
    """Return a read-only view of an array. advice: what to do instead of writing, for the error."""
    out = array.view(ReadOnly)
    out.advice = advice
    out.setflags(write=False)
    return out


class ReadOnlyMapping(Mapping):
    """A mapping that cannot be written to."""

    host_only = ("_values", "_advice")

    def __init__(self, values: Mapping, advice: str):
        self._values, self._advice = dict(values), advice

    def __getitem__(self, key):
        return self._values[key]

    def __iter__(self):
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __setitem__(self, key, value) -> None:
        raise TypeError(self._advice)

    def __repr__(self) -> str:
        return repr(self._values)


def as_read_only(value: Any, advice: str) -> Any:
    """Return a value, read-only if it is an array or a mapping."""
    if isinstance(value, np.ndarray):
        return read_only(value, advice)
    if isinstance(value, Mapping):
        return ReadOnlyMapping(value, advice)
    return value


@cache
def assign_whole_advice(owner: str, name: str) -> str:
    """Return the advice for an array that is live as a whole."""
    return (
        f"{owner}.{name} is read-only, because a world does not notice when a part of it changes. Assign the whole: "
        f"new = {owner.lower()}.{name}.copy(); new[...] = ...; {owner.lower()}.{name} = new."
    )


@cache
def structure_advice(owner: str, name: str) -> str:
    """Return the advice for an array that is not live."""
    return f"{owner}.{name} is read-only: it is structure, fixed when {owner} is made."
