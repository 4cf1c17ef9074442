"""Colours of particles: the one meaning of the argument `color` of all views."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks
from .bodies import bodies
from .quantities import QUANTITIES, UNITS

if TYPE_CHECKING:
    from ..step.edit_scene import Handle
    from ..world import World
    from .scene import Parts

# Far from each other, and from all colours of strain (red, blue, grey), by at least 24 in CIELAB (1976).
PALETTE = np.array(
    [[85, 227, 242], [237, 242, 85], [242, 85, 137], [90, 242, 85], [118, 88, 226], [173, 140, 61], [242, 85, 242],
     [87, 173, 107], [214, 157, 242]], dtype=np.uint8,
)  # fmt: skip
FIXED = (140, 140, 150)  # of particles that cannot move
MANY = 600  # most bodies that are compared with all before them, which takes 10 ms; more are small, and take turns
RAMP = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], dtype=np.float64)  # viridis
NONE: Mapping[str, np.ndarray] = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Coloring:
    """How particles are coloured: by body, as given, or by a quantity.

    given: colours, (n, 3) in 0 ... 255. rows: the particles that they were given for. name: that of the quantity. function:
    computes it from a world; None for one that users log. ends: least and most value of its scale, or None.
    """

    given: np.ndarray | None = None
    rows: "Handle | None" = None
    name: str = ""
    function: "Callable[[Any], Any] | None" = None
    ends: tuple[float, ...] | None = None

    @staticmethod
    def checked(who: str, value: Any, count: int, logged: Iterable[str] | None = ()) -> "Coloring":
        """Check the argument `color` of a view.

        value: None, one colour for each body and each loose particle, grey for fixed ones; an array (n, 3), a colour for each
        particle: integers in 0 ... 255 or floats in 0 ... 1; or a quantity: one of QUANTITIES, the name of one that is logged, or
        a function of the world that returns (n,) numbers. It may come with the ends of its scale, (quantity, least, most);
        without them each frame has those of its own values. count: the number of particles. logged: names of the quantities that
        the view knows beside QUANTITIES; None for any.
        """
        if value is None:
            return BY_BODY
        what, *ends = value if isinstance(value, (tuple, list)) and len(value) == 3 else (value,)
        if not (isinstance(what, str) or callable(what)):
            return Coloring(_checked_colors(who, value, count))
        scale = None
        if ends:
            low, high = scale = tuple(checks.number(who, f"color[{k}]", end) for k, end in enumerate(ends, 1))
            if not low < high:
                raise ValueError(f"{who}: color = {value!r}, but {low:g} is not less than {high:g}.")
        if not isinstance(what, str):
            return Coloring(name=f"{getattr(what, '__name__', type(what).__name__)}()", function=what, ends=scale)
        if logged is not None and what not in {*QUANTITIES, *logged}:
            known = ", ".join(dict.fromkeys([*QUANTITIES, *logged]))
            raise ValueError(
                f"{who}: color = {what!r} is no quantity here; there are {known}. Or write a function of the world that returns "
                "a number for each particle."
            )
        return Coloring(name=what, function=QUANTITIES.get(what), ends=scale)

    def following(self, world: "World") -> "Coloring":
        """Return it for the present particles of a world: given colours do not fit others."""
        return self if self.given is None else replace(self, rows=world.handle(np.arange(len(self.given))))

    def colors(self, world: "World | Parts", logged: Mapping[str, np.ndarray] = NONE) -> np.ndarray:
        """Return the colours of particles, (n, 3) in 0 ... 255. logged: quantities, (n,), by name.

        A quantity that is not logged yet is grey, and so is a value that is not finite. Raises ValueError where colours were
        given and particles were added or removed since, and for a function that returns something else than numbers (n,).
        """
        count = len(world.particles)
        if self.given is not None:
            if len(self.given) != count or (self.rows is not None and len(self.rows) != count):
                raise ValueError(
                    f"color has a row for each of {len(self.given)} particles, and since then particles were added or removed: "
                    f"there are {count}. Write a quantity, or a function of the world, which follow."
                )
            return self.given
        if not self.name:
            return by_body(world)
        values = logged.get(self.name)
        if values is None and self.function:
            values = self.values(world)
        return ramp(np.full(count, np.nan) if values is None or len(values) != count else values, self.ends)

    def values(self, world: "World | Parts") -> np.ndarray:
        """Return the quantity of each particle as the function computes it, (n,) in f32, as recordings hold it."""
        assert self.function
        values, count = np.asarray(self.function(world)), len(world.particles)
        if values.dtype.kind not in "biuf" or values.shape != (count,):
            raise ValueError(
                f"color: {self.name} returned an array of shape {values.shape} and type {values.dtype}, but a number for each of "
                f"{count} particles is needed."
            )
        with np.errstate(over="ignore"):
            return values.astype(np.float32)

    @property
    def title(self) -> str | None:
        """The title of its scale; None without a quantity."""
        return f"{self.name} [{UNITS[self.name]}]" if self.name in UNITS else self.name or None

    def scale(self) -> tuple[np.ndarray, list[str]] | None:
        """Return colours and labels of its scale; None without a quantity."""
        if not self.name:
            return None
        low, high = self.ends or (0.0, 1.0)
        at = np.linspace(low, high, 7)
        return ramp(at, self.ends), [f"{v:.4g}" for v in at] if self.ends else ["least", *[""] * 5, "most"]

    def stored(self) -> Any:
        """Return it as JSON."""
        if self.given is not None:
            return self.given.tobytes().hex()
        return [self.name, *(self.ends or (None, None))] if self.name else None

    @staticmethod
    def of(stored: Any) -> "Coloring":
        """Return what stored() has returned; the values of a function of the user's are logged."""
        if stored is None:
            return BY_BODY
        if isinstance(stored, str):
            return Coloring(np.frombuffer(bytes.fromhex(stored), dtype=np.uint8).reshape(-1, 3))
        name, *ends = stored
        if not isinstance(name, str):
            raise TypeError(f"replay: color = {name!r}, but the name of a quantity is needed.")
        return Coloring.checked("replay", name if ends == [None, None] else (name, *ends), 0, None)


BY_BODY = Coloring()


def _checked_colors(who: str, value: Any, count: int) -> np.ndarray:
    """Return given colours, (n, 3), as integers in 0 ... 255."""
    try:
        rgb = np.asarray(value)
    except ValueError:  # rows of several lengths
        rgb = np.asarray(None)
    if rgb.dtype.kind not in "iuf":
        raise TypeError(
            f"{who}: color = {value!r}, but colours (n, 3) are needed, or a quantity ({', '.join(QUANTITIES)}) or a function of "
            'the world, alone or with the ends of its scale: ("speed", 0, 2).'
        )
    if rgb.shape != (count, 3):
        raise ValueError(
            f"{who}: color has shape {rgb.shape}, but ({count}, 3) is needed: red, green and blue of each particle. For a "
            "quantity write its name, or a function of the world."
        )
    most = 1 if rgb.dtype.kind == "f" else 255
    if (wrong := ~((rgb >= 0) & (rgb <= most))).any():
        i, k = np.argwhere(wrong)[0].tolist()
        hint = "write integers for 0 ... 255" if most == 1 else "write floats for 0 ... 1"
        raise ValueError(
            f"{who}: color[{i}, {k}] = {rgb[i, k]:g}, but {'floats' if most == 1 else 'integers'} are in 0 ... {most}; {hint}."
        )
    return np.rint(rgb * (255 // most)).astype(np.uint8)


def ramp(values: np.ndarray, ends: tuple[float, ...] | None = None) -> np.ndarray:
    """Return colours, (n, 3), of numbers (n,) between two ends; grey where they are not finite.

    Without ends the scale goes from the least to the largest of them.
    """
    known = np.isfinite(values)
    low, high = ends or (values[known].min(initial=np.inf), values[known].max(initial=-np.inf))
    with np.errstate(invalid="ignore"):
        at = np.clip((values - low) / ((high - low) or 1.0), 0, 1) * (len(RAMP) - 1)
    at = np.where(known, at, 0.0)
    k = np.minimum(at.astype(np.int64), len(RAMP) - 2)
    colors = RAMP[k] + (at - k)[:, None] * (RAMP[k + 1] - RAMP[k])
    return np.where(known[:, None], np.rint(colors), 128).astype(np.uint8)


def by_body(world: "World | Parts") -> np.ndarray:
    """Return hues, (n, 3): one for each body and each loose particle; grey for fixed particles."""
    first, body = np.unique(bodies(world), return_inverse=True)
    x = np.asarray(world.particles.position)
    middle = np.stack([np.bincount(body, column, len(first)) for column in x.T], axis=1) / np.bincount(body)[:, None]
    hues = PALETTE[apart(middle)][body]
    hues[world.particles.inv_mass == 0] = FIXED
    return hues


def apart(middle: np.ndarray) -> np.ndarray:
    """Return a number in PALETTE for each body, (n,), from their centers, (n, dim) [m]: near bodies have different ones.

    In order, each body takes the colour of which the nearest body is farthest. So bodies that are added change no colour.
    """
    out = np.arange(len(middle)) % len(PALETTE)
    for k in range(len(PALETTE), min(len(middle), MANY)):
        away = ((middle[:k] - middle[k]) ** 2).sum(axis=1)
        nearest = np.full(len(PALETTE), np.inf)
        np.minimum.at(nearest, out[:k], away)
        out[k] = np.argmax(nearest)
    return out
