"""What a scene of the catalogue is: calls that are data, and the few facts that cannot be seen in them."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import tiverlet as tv

from ..fuzz.scenes import Call, Event, Set, Structure

ALL: dict[str, "Scene"] = {}
AT_ANY_TIME = ("substeps", "iterations")  # settings that are no structure


@dataclass(frozen=True)
class Scene:
    """A scene. smooth: it converges with h^2. flags: those that it rightly has. first: assignments before its first frame.

    known: what is still wrong with it. Only the ledger runs such a scene.
    """

    structure: Structure
    first: list[Event]
    smooth: bool
    flags: frozenset[str]
    known: str


class Calls:
    """c.Gravity(9.81) is the call tv.Gravity(9.81), not yet made."""

    def __getattr__(self, name: str) -> Callable[..., Call]:
        made = inspect.signature(getattr(tv, name))
        return lambda *args, **kwargs: Call(name, dict(made.bind(*args, **kwargs).arguments))


c: Any = Calls()


def scene(smooth: bool = False, flags: set[str] = frozenset(), known: str = ""):  # type: ignore[assignment]
    """Add a scene to the catalogue: a function that returns particles, features, and settings of the world, if any."""

    def add(make: Callable[[], tuple]) -> Callable[[], tuple]:
        particles, features, *settings = make()
        given = {"path": "fused", **(settings[0] if settings else {})}
        first: list[Event] = [Set(None, name, given.pop(name)) for name in AT_ANY_TIME if name in given]
        ALL[make.__name__.replace("_", " ")] = Scene(
            Structure(particles, tuple(features), given), first, smooth, frozenset(flags), known
        )
        return make

    return add
