"""Errors for names that do not exist, read or passed: they say which is meant, by terms of other programs and by spelling.

Public classes are decorated by answer_names(), and by answer_calls() of checks.py, which answers arguments. terms.ini has rows of
terms by the class, module or function that is asked for a name: names, and the clause that ends the error. Rows of a class hold
for its subclasses, too. Names are compared without case, underscores, and a get or set before them.
"""

import difflib
from collections.abc import Iterable
from configparser import ConfigParser, ExtendedInterpolation
from functools import cache
from importlib import resources
from typing import Any, TypeVar

Kind = TypeVar("Kind", bound=type)
_guesses: dict[tuple[type, str], str] = {}  # by class and name: hasattr() may ask often, and searching takes 1.6 ms


@cache
def rows() -> dict[str, dict[str, str]]:
    """Return names and clauses by owners, as terms.ini has them."""
    file = ConfigParser(delimiters=(":",), interpolation=ExtendedInterpolation())
    file.optionxform = str  # type: ignore[assignment, method-assign]  # names keep their case
    file.read_string(resources.files("tiverlet.features").joinpath("terms.ini").read_text(encoding="utf-8"))
    return {owners: dict(file[owners]) for owners in file.sections() if owners != "clauses"}


@cache
def terms() -> dict[str, dict[str, str]]:
    """Return the clause of each name, see spelt(), by owner."""
    out: dict[str, dict[str, str]] = {}
    for owners, found in rows().items():
        for owner in owners.split():
            out.setdefault(owner, {}).update((spelt(name), clause) for names, clause in found.items() for name in names.split())
    return out


def spelt(name: str) -> str:
    """Return a name without what differs between styles: case, underscores, and a get or set before it."""
    plain = name.lower()
    for word in ("get_", "set_"):
        plain = plain.removeprefix(word)
    if name[:3] in ("get", "set", "Get", "Set") and name[3:4].isupper():
        plain = plain[3:]
    return plain.replace("_", "")


def suggest(name: str, owners: Iterable[str], names: Iterable[str]) -> str:
    """Return what a name stands for, as the end of a sentence; a full stop if it resembles nothing.

    owners: whose terms are looked up, in this order. names: those that exist.
    """
    wanted = spelt(name)
    for owner in owners:
        if clause := terms().get(owner, {}).get(wanted):
            return f"; {clause}."
    there = {spelt(n): n for n in names}
    near = difflib.get_close_matches(wanted, there, 1)
    return f"; did you mean {there[near[0]]!r}?" if near else "."


def owners_of(kind: type) -> list[str]:
    """Return the names of a class and of its base classes, whose terms hold for it."""
    return [base.__name__ for base in kind.__mro__]


def no_attribute(thing: Any, name: str) -> AttributeError:
    """Return the error for an attribute that an object does not have."""
    kind = type(thing)
    guess = _guesses.get((kind, name))
    if guess is None:
        names = [n for n in [*vars(thing), *dir(kind)] if not n.startswith("_")]
        guess = _guesses[kind, name] = suggest(name, owners_of(kind), names)
    return AttributeError(f"{kind.__name__} has no {name!r}{guess}", name=name, obj=thing)


def no_name(module: str, name: str, names: Iterable[str]) -> AttributeError:
    """Return the error for a name that a module does not have."""
    guess = "" if name.startswith("_") else suggest(name, [module], names)
    return AttributeError(f"module {module!r} has no attribute {name!r}{guess}", name=name)


def answer_names(kind: Kind) -> Kind:
    """Decorate a class: reading an attribute that it lacks says which one is meant."""
    kind.__getattr__ = _missing  # type: ignore[attr-defined]
    return kind


def _missing(self: Any, name: str) -> Any:
    """The __getattr__ of classes that answer names: called where nothing of that name was found."""
    if name.startswith("_"):  # asked by Python, NumPy and Taichi for what few objects have
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)
    if hasattr(type(self), name):  # a property or a knob has raised it, and says why
        return object.__getattribute__(self, name)
    raise no_attribute(self, name)
