"""Arrays that are handed out: they can be read like any other, and say what to do when they are written to."""

import numpy as np


class ReadOnly(np.ndarray):
    """A read-only array. Copies and results of arithmetic are plain arrays; `a += b` makes a new one, so x.a += b assigns it."""

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

    def copy(self, order="C") -> np.ndarray:
        """A plain array."""
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
    """The same numbers, which nobody can write to. advice: what to do instead, for the error."""
    out = array.view(ReadOnly)
    out.advice = advice
    out.flags.writeable = False
    return out


def assign_whole(owner: str, name: str) -> str:
    """Advice for an array that is live as a whole."""
    return (
        f"{owner}.{name} is read-only, because a world does not notice when numbers in it change. Assign the whole array: "
        f"new = {owner.lower()}.{name}.copy(); new[...] = ...; {owner.lower()}.{name} = new."
    )


def structure(owner: str, name: str) -> str:
    """Advice for an array that is not live."""
    return f"{owner}.{name} is read-only: it is structure, fixed when {owner} is made."
