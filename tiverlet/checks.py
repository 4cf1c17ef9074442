"""Argument checks, before Taichi reads anything. Errors name the argument, index and value, and say what to write instead."""

import functools
import inspect
import math
import numbers
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from .features.unknown_names import owners_of, suggest

ANY = 2**31 - 1  # number of particles, while it is not yet known
RATES = 24, 30, 60, 120, 144, 240  # [1/s] frames a second that are in use
FEW = 16  # numbers that Python examines faster than NumPy, at most
OF_SHAPE = {"position": "position", "pairs": "links", "triples": "bends", "quads": "quads", "loops": "loops"}  # by argument

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as ArrayLike
else:  # prints as its name in signatures, where NumPy's takes 230 characters
    ArrayLike = type("ArrayLike", (), {"__module__": "builtins"})

Kind = TypeVar("Kind", bound=type)
Function = TypeVar("Function", bound=Callable[..., Any])
PACKAGE = str(Path(__file__).parent) + os.sep


def warn(text: str, category: type[Warning] = UserWarning) -> None:
    """Warn of something at the line of the user: the first one outside of this package."""
    frame, level = sys._getframe(1), 2
    while frame.f_back and frame.f_code.co_filename.startswith(PACKAGE):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, category, stacklevel=level)


def number(who: str, name: str, value: Any, *, above=None, least=None, most=None) -> float:
    """Check a finite real number within the given bounds."""
    if type(value) is not float:
        value = _real(who, name, value)
    if not math.isfinite(value):
        raise ValueError(f"{who}: {name} = {value}, but it must be finite.")
    if words := _missed(value, above, least, most):
        raise ValueError(f"{who}: {name} = {value:g}, but it must be {words}.")
    return value


def _real(who: str, name: str, value: Any) -> float:
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (numbers.Real, np.ndarray)):
        raise TypeError(f"{who}: {name} = {value!r} is a {type(value).__name__}, but a number is needed.")
    array = np.asarray(value)
    if array.ndim or array.dtype.kind not in "iuf":
        raise TypeError(f"{who}: {name} has shape {array.shape}, but one real number is needed.")
    return float(value)


def frame_length(who: str, dt: Any) -> float:
    """Return the length of a frame [s]. Warn where it is how many frames a second has."""
    dt = number(who, "dt", dt, above=0.0)
    if dt in RATES:
        warn(f"{who}: dt = {dt:g} is a frame of {dt:g} s. For {dt:g} frames a second write dt=1/{dt:g}.")
    return dt


def flag(who: str, name: str, value: Any) -> bool:
    """Return `value` as True or False."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{who}: {name} = {value!r} is a {type(value).__name__}, but True or False is needed.")
    return bool(value)


def integer(who: str, name: str, value, *, least: int) -> int:
    """Check an integer of at least `least`."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, numbers.Integral):
        kind = type(value).__name__
        raise TypeError(f"{who}: {name} = {value!r} is a {kind}, but an integer of at least {least} is needed.")
    if value < least:
        raise ValueError(f"{who}: {name} = {value}, but it must be at least {least}.")
    return int(value)


def per_item(who: str, name: str, value, count: int, *, infinite=False, **bounds) -> np.ndarray:
    """Expand a scalar or a (count,) array to a (count,) array of floats: finite (or +inf if allowed) and within bounds."""
    array = _floats(who, name, value)
    if array.ndim == 0:
        array = np.full(count, float(array))
    if array.shape != (count,):
        raise ValueError(f"{who}: {name} has shape {array.shape}, but a number or an array of shape ({count},) is needed.")
    bad = np.isnan(array) | (array == -np.inf) | (np.isinf(array) & (not infinite))
    if bad.any():
        i = int(np.argmax(bad))
        raise ValueError(f"{who}: {name}[{i}] = {array[i]}, but it must be finite.")
    _bounds(who, name, array, **bounds)
    return array


def points(who: str, name: str, value, *, dim: int | None = None, count: int | None = None) -> np.ndarray:
    """Check an (n, dim) array of finite floats; dim is 2 or 3 if not given."""
    array = _floats(who, name, value)
    if array.size == 0 and array.ndim != 2:
        array = array.reshape(0, dim or 2)
    dims = (dim,) if dim else (2, 3)
    if array.ndim != 2 or array.shape[1] not in dims or (count is not None and len(array) != count):
        n = "n" if count is None else count
        want = " or ".join(f"({n}, {d})" for d in dims)
        write = f"; write [{tuple(array.tolist())}]" if array.ndim == 1 and len(array) in dims else ""
        raise ValueError(f"{who}: {name} has shape {array.shape}, but {want} is needed, one row per point{write}.")
    finite(who, name, array)
    return array


def vector(who: str, name: str, value, dim: int, *, infinite=False) -> np.ndarray:
    """Check a (dim,) array of finite floats."""
    array = _floats(who, name, value)
    if array.shape != (dim,):
        want = f"{dim} numbers are needed in a {dim}D world" if dim in (2, 3) else "2 numbers are needed in 2D, 3 in 3D"
        raise ValueError(f"{who}: {name} has shape {array.shape}, but {want}.")
    if np.isnan(array).any() or (not infinite and np.isinf(array).any()):
        finite(who, name, array)
    return array


def direction(array: np.ndarray) -> np.ndarray:
    """Return a vector of finite numbers as a unit vector; 0 where it is 0. Its square need not be a finite float above 0."""
    scaled = np.ldexp(array, -np.frexp(np.abs(array).max(initial=0.0))[1])  # exact
    return scaled / (np.linalg.norm(scaled) or 1.0)


def finite(who: str, name: str, array: np.ndarray) -> None:
    """Raise ValueError for the first element that is NaN or infinite."""
    if array.size <= FEW and all(map(math.isfinite, array.ravel().tolist())):
        return
    sound = np.isfinite(array)
    if not sound.all():
        at = np.unravel_index(int(np.argmin(sound)), array.shape)
        place = ", ".join(str(int(k)) for k in at)
        raise ValueError(f"{who}: {name}[{place}] = {array[at]}, but it must be finite.")


def indices(who: str, name: str, value, count: int, *, arity: int | None = None, things: str = "particles") -> np.ndarray:
    """Check indices of things below `count`: (m,), or (m, arity) with distinct members in each row."""
    array = plain(who, name, value)
    if array.size == 0:
        return np.zeros((0, arity) if arity else (0,), dtype=np.int32)
    if array.dtype.kind not in "iu":
        raise TypeError(f"{who}: {name} has type {array.dtype}, but integers (indices of {things}) are needed.")
    shape = f"(m, {arity})" if arity else "(m,)"
    if array.ndim != (2 if arity else 1) or (arity and array.shape[1] != arity):
        one = array.ndim == (1 if arity else 0) and array.size <= 4
        write = f"; write [{array.tolist()}]" if one else ""
        raise ValueError(f"{who}: {name} has shape {array.shape}, but {shape} is needed{write}.")
    if _beyond(array, count):
        bad = (array < 0) | (array >= count)
        i = int(np.argmax(bad.any(axis=1) if arity else bad))
        least = int(array[i].min())
        why = f"there are {count} {things} (0 ... {count - 1})" if count < ANY else f"{things} are numbered from 0"
        end = f"; count from the start, not {least} from the end" if least < 0 else ""
        raise ValueError(f"{who}: {name}[{i}] = {_show(array[i])}, but {why}{end}.")
    if arity:
        ordered = np.sort(array, axis=1)
        same = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        if same.any():
            i = int(np.argmax(same))
            raise ValueError(f"{who}: {name}[{i}] = {_show(array[i])} names a particle twice; its members must differ.")
    return np.ascontiguousarray(array, dtype=np.int32)


def _beyond(array: np.ndarray, count: int) -> bool:
    """Whether any of the integers is negative, or `count` or more."""
    if array.size <= FEW:
        return not all(0 <= i < count for i in array.ravel().tolist())
    return bool(array.astype(np.uint64).max() >= count)  # as unsigned numbers, negative ones are large, too


def _show(row) -> str:
    return str(tuple(int(v) for v in row)) if np.ndim(row) else str(int(row))


def rows(who: str, name: str, value: Any, what: str) -> list:
    """Return a sequence as a list. what: the expected kind of value, for the error."""
    if isinstance(value, (str, bytes)) or not isinstance(value, Iterable) or (isinstance(value, np.ndarray) and not value.ndim):
        raise TypeError(f"{who}: {name} = {value!r} is a {type(value).__name__}, but {what} is needed.")
    return list(value)


def plain(who: str, name: str, value: Any) -> np.ndarray:
    """Return anything whose rows have equal lengths as an array."""
    if type(value) is np.ndarray and value.dtype.kind != "O":
        return value
    # Importing numpy.ma takes 30 ms, and nothing is masked before somebody has imported it.
    if "numpy.ma" in sys.modules and isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError(f"{who}: {name} has masked values, which would count as any other. Fill them, or leave their rows out.")
    try:
        array = np.asarray(value)
    except ValueError:
        raise ValueError(f"{who}: {name} is ragged; its rows must have the same length.") from None
    if array.dtype == object and array.ndim == 0 and value is not None:
        part = OF_SHAPE.get(name, "")
        write = f"; write shape.{part}" if part and hasattr(value, part) else ""
        raise TypeError(f"{who}: {name} is a {type(value).__name__}, but an array is needed{write}.")
    return array


def _floats(who: str, name: str, value) -> np.ndarray:
    array = plain(who, name, value)
    if array.dtype.kind not in "iuf" and array.size:
        raise TypeError(f"{who}: {name} has type {array.dtype}, but real numbers are needed.")
    return np.array(array, dtype=np.float64)


def _missed(value: float, above=None, least=None, most=None) -> str:
    """Return the bound that a value violates, in words; empty if it is within the bounds."""
    if above is not None and not value > above:
        return f"above {above:g}"
    if least is not None and not value >= least:
        return f"at least {least:g}"
    if most is not None and not value <= most:
        return f"at most {most:g}"
    return ""


def _bounds(who, name, array, **bounds) -> None:
    """Raise ValueError for the first element of an array that is out of bounds."""
    ends = {int(np.argmin(array)), int(np.argmax(array))} if len(array) else set()
    if any(_missed(array[i], **bounds) for i in ends):
        i, words = next((i, words) for i, value in enumerate(array) if (words := _missed(value, **bounds)))
        raise ValueError(f"{who}: {name}[{i}] = {array[i]:g}, but it must be {words}.")


def group_pair(who: str, name: str, pair: Any, what: str = "") -> tuple[int, int]:
    """Check a pair of groups. what: the place of the pair in `name`, for the error."""
    if isinstance(pair, np.ndarray):
        pair = pair.tolist()
    if not (isinstance(pair, (tuple, list)) and len(pair) == 2 and all(isinstance(k, (int, np.integer)) for k in pair)):
        raise TypeError(f"{who}: {name} has {what}{pair!r}, but a pair of groups such as (0, 1) is needed.")
    return int(pair[0]), int(pair[1])


def answer_calls(kind: Kind) -> Kind:
    """Decorate a class: answer_arguments() for its __init__ and its public methods."""
    for name, value in list(vars(kind).items()):
        if inspect.isfunction(value) and (name == "__init__" or not name.startswith("_")):
            setattr(kind, name, answer_arguments(value))
    return kind


def answer_arguments(function: Function) -> Function:
    """Decorate a function: calling it with arguments that it does not take raises a TypeError that says which are meant.

    A call costs 0.1 us more.
    """

    @functools.wraps(function)
    def answering(*args, **kwargs):
        """Call it. Only where that fails are the arguments compared with those that it takes."""
        try:
            return function(*args, **kwargs)
        except TypeError:
            if words := _misfit(function, args, kwargs):
                raise TypeError(words) from None
            raise

    return answering  # type: ignore[return-value]


def _misfit(function: Callable[..., Any], args: tuple, kwargs: dict[str, Any]) -> str:
    """Return why arguments do not fit a function; empty if they do."""
    signature = inspect.signature(function)
    try:
        signature.bind(*args, **kwargs)
        return ""
    except TypeError as e:
        reason = str(e)
    takes, who = dict(signature.parameters), function.__qualname__
    owners, given = [who], len(args)
    if "self" in takes:
        del takes["self"]
        given -= 1
    if function.__name__ == "__init__":
        who, owners = type(args[0]).__name__, owners_of(type(args[0]))
    listed = f"It takes {', '.join(takes)}." if takes else "It takes no arguments."
    if unknown := [name for name in kwargs if name not in takes]:
        return f"{who}: there is no {unknown[0]}{suggest(unknown[0], owners, takes)} {listed}"
    places = [name for name, p in takes.items() if p.kind is p.POSITIONAL_OR_KEYWORD]
    if given > len(places):
        named = ", ".join(f"{name}=" for name in takes if name not in places)
        return f"{who}: {given} arguments, but {len(places)} without a name{f'; write {named} before others' if named else ''}."
    return f"{who}: {reason}. {listed}"
