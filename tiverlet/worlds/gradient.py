"""Derivatives of a figure of worlds with respect to parameters: central differences, all worlds in one launch."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from .. import checks
from ..world import World
from .part import make_world
from .worlds import Worlds


class Gradient(NamedTuple):
    """The result of gradient().

    value: the figure of the world with the given parameters, a number or an array. derivative: by name of the parameter, an array
    of the figure's shape followed by the parameter's; a number where both are numbers.
    """

    value: Any
    derivative: dict[str, Any]


@checks.answer_arguments
def gradient(
    make: Callable[..., World],
    parameters: Mapping[str, Any],
    figure: Callable[[Worlds], Any],
    step: float | Mapping[str, Any] | None = None,
) -> Gradient:
    """Compute a figure of a world, and its derivatives with respect to numbers from which the world is made.

        def make(speed, angle):
            velocity = (speed * np.cos(angle), speed * np.sin(angle))
            return tv.World(tv.Particles([[0.0, 0.0]], velocity=velocity), [tv.Gravity()], precision="f64")

        def height(worlds):
            worlds.run(0.5)
            return worlds.position[:, 0, 1]

        value, derivative = tv.gradient(make, {"speed": 7.0, "angle": 0.8}, height)
        derivative["angle"]

    make: called with the parameters by name; returns a new World at each call, always of the same structure. parameters: numbers
    or arrays of numbers. figure: called once with a Worlds; steps it, and returns one number per world, (worlds,), or one array
    per world, (worlds, ...). step: how far a parameter is varied to either side, for all or by name; for an array one step, or
    one for each number. The default is eps^(1/3) times the value: 6e-6 in f64, 5e-3 in f32 and f32-compensated. For a value of 0
    it is that share of the parameter's largest number; if all are 0, of 1.

    n numbers take 2n + 1 worlds: (f(p + h) - f(p - h)) / 2h. The error is h^2 f''' / 6, and eps |f| / h of rounding. Give a
    smaller step where f changes faster than over lengths like p, as in chaos.

    It includes all features: contacts, friction, breaks. Where the figure jumps or has a kink, as when a contact begins or ends
    between p - h and p + h, the difference is no derivative: search with many worlds instead.

    Raises ValueError or TypeError for parameters that are no finite numbers, for steps that are not positive or vanish beside the
    value, for worlds of different structure, and for figures without a row per world.
    """
    for name, function in (("make", make), ("figure", figure)):
        if not callable(function):
            raise TypeError(f"gradient: {name} = {function!r} is a {type(function).__name__}, but a function is needed.")
    if not isinstance(parameters, Mapping) or not parameters:
        raise ValueError(f'gradient: parameters = {parameters!r}, but it must be a dict of numbers, such as {{"mass": 1.0}}.')
    values = {name: _numbers(name, value) for name, value in parameters.items()}
    worlds: list[World] = []
    try:
        first = make_world("gradient", make, 0, parameters, worlds)
        steps = _steps(values, step, 2.0**-52 if first.settings["precision"] == "f64" else 2.0**-23)
        for name, value in values.items():
            for index in np.ndindex(value.shape):
                for sign in (-1, 1):
                    varied = value.copy()
                    varied[index] += sign * steps[name][index]
                    make_world("gradient", make, len(worlds), {**parameters, name: _plain(varied)}, worlds)
        try:
            copies = Worlds(worlds)
        except ValueError as error:
            error.add_note(
                f"They are those of gradient: worlds[0] as it is, then two for each number of {', '.join(values)}, less and more."
            )
            raise
    finally:
        for world in worlds:
            world.close()
    with copies:
        figures = _figures(figure(copies), len(copies))
    out, at = {}, 1
    for name, value in values.items():
        less, more = figures[at : at + 2 * value.size].reshape(-1, 2, *figures.shape[1:]).swapaxes(0, 1)
        ways = ((value + steps[name]) - (value - steps[name])).reshape(-1)  # the differences as rounded in f64
        out[name] = _plain((np.moveaxis(more - less, 0, -1) / ways).reshape(figures.shape[1:] + value.shape))
        at += 2 * value.size
    return Gradient(_plain(figures[0]), out)


def _numbers(name: str, value: Any) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"gradient: {name} = {value!r}, but parameters are numbers or arrays of numbers.") from None
    if not np.isfinite(array).all():
        raise ValueError(f"gradient: {name} = {value!r}, but it must be finite.")
    return array


def _steps(values: dict[str, np.ndarray], step: Any, eps: float) -> dict[str, np.ndarray]:
    """Return how far each number is varied."""
    if isinstance(step, Mapping) and (unknown := set(step) - set(values)):
        raise ValueError(f"gradient: step has {sorted(unknown)[0]!r}, but parameters are {', '.join(values)}.")
    out = {}
    for name, value in values.items():
        given = step.get(name) if isinstance(step, Mapping) else step
        if given is None:
            scale = np.abs(value)
            scale = np.where(scale > 0, scale, scale.max(initial=0.0) or 1.0)
            out[name] = eps ** (1 / 3) * scale
            continue
        given = _numbers(f"step of {name}", given)
        if given.shape not in ((), value.shape):
            raise ValueError(f"gradient: step of {name} has shape {given.shape}, but {name} has {value.shape}.")
        out[name] = np.broadcast_to(given, value.shape)
        if not (given > eps * np.abs(value)).all():
            raise ValueError(
                f"gradient: step of {name} = {given}, but it must be positive, and more than {eps:.1e} of {name} = {value}, "
                "which is lost in rounding."
            )
    return out


def _figures(figures: Any, count: int) -> np.ndarray:
    try:
        out = np.asarray(figures, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"gradient: figure returned {figures!r:.200}, but it must return numbers.") from None
    if out.ndim == 0 or len(out) != count:
        raise ValueError(f"gradient: figure returned shape {out.shape}, but the first axis must have {count} worlds.")
    return out


def _plain(array: np.ndarray) -> Any:
    return array if array.ndim else float(array)
