"""A scene as plain data, and back: particles, features and settings as arguments, never as code."""

import inspect
import platform
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import checks, colliders, constraints, contact, forces, neighbours, solvers
from ..colliders.collider import Collider
from ..device import runtime
from ..device.language import is_kernel_function, undecorated
from ..features.arguments import knobs_of
from ..features.feature import Batch, Feature
from ..particles import TURNING, Particles
from ..solvers.solver import Solver
from ..step.sleep import Sleep

if TYPE_CHECKING:
    from ..world import World

PARTICLES = ("position", "velocity", "mass", "radius", "pinned", "group", *TURNING)
PUBLIC = {
    name: kind for module in (colliders, constraints, contact, forces, neighbours, solvers)
    for name, kind in vars(module).items()
    if isinstance(kind, type) and issubclass(kind, (Feature, Solver))
} | {"Sleep": Sleep}  # fmt: skip
KnobValues = tuple[int, dict[str, Any]]  # the number of a feature, and the values of its knobs
TAKES = {
    "Force": ("function",),
    "PairForce": ("function", "potential"),
    "Constraint": ("function", "gradient"),
    "Sdf": ("function", "gradient"),
}  # arguments that may be the user's functions
MOST = 10_000  # most steps of a solver in a substep
LONG = 8  # lists of at least so many rows of numbers are stored as arrays, and read back as lists


def plain(text: str) -> str:
    """Return text without the characters that a terminal would execute as commands."""
    return "".join(c if c.isprintable() or c == "\n" else "?" for c in text)


class Needs:
    """The user's own functions and classes in a scene: their source is stored for reading, and never run."""

    def __init__(self) -> None:
        self.sources: dict[str, str] = {}
        self._known: dict[str, Any] = {}

    def name(self, thing: Any) -> str:
        """Return a thing's name in the file, and store its source."""
        plain = getattr(thing, "__name__", type(thing).__name__)
        same = [name for name, known in self._known.items() if known is thing]
        if same:
            return same[0]
        count = sum(name == plain or name.startswith(f"{plain} #") for name in self._known)
        name = f"{plain} #{count + 1}" if count else plain
        self._known[name], self.sources[name] = thing, source(thing)
        return name


def source(thing: Any) -> str:
    """Return the source of a function, a ti.func or a class; "" if there is none."""
    try:
        return textwrap.dedent(inspect.getsource(undecorated(thing)))
    except (OSError, TypeError):
        return ""


def encode(value: Any, name: str, arrays: dict[str, np.ndarray], needs: Needs) -> Any:
    """Return a value as JSON; arrays are stored in `arrays` under names that begin with `name`."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        arrays[name] = value
        return {"array": name}
    if isinstance(value, Mapping):
        items = [[encode(part, f"{name}.{k}", arrays, needs) for part in item] for k, item in enumerate(value.items())]
        return {"map": items}
    if isinstance(value, Iterable):
        parts = list(value)
        if len(parts) >= LONG and (array := _array(parts)) is not None:
            arrays[name] = array
            return {"list": name}
        return [encode(part, f"{name}.{k}", arrays, needs) for k, part in enumerate(parts)]
    return {"given": needs.name(value)}


def _array(parts: list) -> np.ndarray | None:
    try:
        array = np.asarray(parts)
    except ValueError:
        return None
    return array if array.dtype.kind in "iuf" else None


def decode(data: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Return the value that encode() was given, for plain data; tuples and other iterables as lists."""
    if isinstance(data, list):
        return [decode(part, arrays) for part in data]
    if not isinstance(data, dict):
        return data
    ((kind, inner),) = data.items()
    if kind == "array":
        return arrays[inner]
    if kind == "list":
        return arrays[inner].tolist()
    if kind == "map":
        return {_key(decode(k, arrays)): decode(v, arrays) for k, v in inner}
    raise ValueError(f"replay: something of the user's stands where a scene has only data: {kind!r}.")


def _key(value: Any) -> Any:
    return tuple(value) if isinstance(value, (list, np.ndarray)) else value


def knobs(feature: Feature) -> dict[str, Any]:
    """Return the present values of a feature's knobs."""
    return {name: vars(feature)[name] for name in knobs_of(type(feature)) if name in vars(feature)}


def set_knobs(feature: Feature, values: Mapping[str, Any]) -> None:
    """Set knobs together: some are checked against each other, so setting them one by one would depend on the order."""
    if wrong := set(values) - set(knobs_of(type(feature))):
        raise ValueError(f"replay: {feature!r} has no knob {sorted(wrong)[0]!r}.")
    vars(feature).update(values)
    for name, value in values.items():
        knob = getattr(type(feature), name)
        knob.put(feature, knob.check(feature, value))
    feature.changed = True


def describe(world: "World") -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the scene of a world as JSON and arrays."""
    arrays: dict[str, np.ndarray] = {}
    needs = Needs()

    def made(thing: Any, name: str) -> dict[str, Any]:
        """Return class and arguments of a particle set, feature or solver."""
        kinds = type(thing).__mro__
        if kinds[0].__module__.partition(".")[0] == __name__.partition(".")[0]:
            kind = next(k.__name__ for k in kinds if PUBLIC.get(k.__name__) is k)
        else:
            kind = {"given": needs.name(kinds[0])}
        return {"class": kind, "arguments": {k: encode(v, f"{name}.{k}", arrays, needs) for k, v in thing.arguments.items()}}

    features = []
    for k, feature in enumerate(world.features):
        values = {name: encode(v, f"{k}.{name} now", arrays, needs) for name, v in knobs(feature).items()}
        features.append({**made(feature, str(k)), "knobs": values})
        if not np.array_equal(feature.start.position, world.particles.position):  # added after the start
            features[-1]["start"] = encode(feature.start.position, f"{k} start", arrays, needs)
    settings = dict(world.settings)
    settings["solver"] = made(settings["solver"], "solver")
    p = world.particles
    scene = {
        "particles": {name: encode(v, name, arrays, needs) for name in PARTICLES if (v := getattr(p, name)) is not None},
        "features": features, "settings": settings, "environment": environment(), "needs": needs.sources,
    }  # fmt: skip
    return scene, arrays


def environment() -> dict[str, Any]:
    """Return what the bits may depend on besides the scene, and how Taichi was started."""
    from ..device import ti

    wanted = runtime.wanted()
    return {
        "tiverlet": version("tiverlet"), "taichi": ".".join(map(str, ti.__version__)), "numpy": np.__version__,
        "python": platform.python_version(), "machine": platform.machine(), "system": platform.system(),
        "arch": runtime.architecture(), "threads": runtime.threads(), "fast_math": runtime.fast_math(),
        "default_fp": runtime.default_fp(), "compiler": runtime.compiler(),
        "seed": wanted.get("seed"), "debug": wanted.get("debug"),
    }  # fmt: skip


def _made(thing: dict[str, Any], base: type, arrays: Mapping[str, np.ndarray], given: Mapping[str, Any]) -> Any:
    """Make a feature or solver from its class and arguments."""
    name = thing["class"]
    own = isinstance(name, dict)
    kind = given[name["given"]] if own else PUBLIC.get(name)
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise ValueError(f"replay: the scene has {name!r}, which is no {base.__name__.lower()} of this version of tiverlet.")
    arguments = {}
    for argument, value in thing["arguments"].items():
        if isinstance(value, dict) and "given" in value:
            if not (own or argument in TAKES.get(name, ())):
                raise ValueError(f"replay: {kind.__name__} takes no function for {argument!r}.")
            arguments[argument] = given[value["given"]]
            if not (is_kernel_function(arguments[argument]) or inspect.isfunction(arguments[argument])):
                raise TypeError(f"replay: given {value['given']} is {arguments[argument]!r}, but the scene has a function there.")
        else:
            arguments[argument] = decode(value, arrays)
    if base is Solver and any(isinstance(v, int) and v > MOST for v in arguments.values()):
        raise ValueError(f"replay: the scene has {kind.__name__}({arguments}), of more than {MOST} steps.")
    try:
        return kind(**arguments)
    except TypeError as e:
        raise ValueError(f"replay: the scene has a {kind.__name__} that this version of tiverlet cannot make: {e}") from e


@dataclass(frozen=True)
class Parts:
    """Particles and features without a world. numbers: the number of each feature in the scene, from which some are left out."""

    particles: Particles
    features: tuple[Feature, ...]
    numbers: tuple[int, ...]


def parts(scene: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> Parts:
    """Make particles and features of a scene, for inspection only.

    Nothing is placed on a device. Features with functions or classes of the user's are left out.
    """
    particles, features = _particles(scene, arrays), {}
    for k, data in enumerate(scene["features"]):
        if any(isinstance(value, dict) and "given" in value for value in (data["class"], *data["arguments"].values())):
            continue
        feature = _feature(data, arrays, {})
        if isinstance(feature, Batch | Collider):  # sets the dimension, and the orientation of surfaces
            came = Particles(decode(data["start"], arrays)) if "start" in data else particles
            feature.prepare(came, came.inv_mass.copy())
        features[k] = feature
    return Parts(particles, tuple(features.values()), tuple(features))


def _feature(data: dict[str, Any], arrays: Mapping[str, np.ndarray], given: Mapping[str, Any]) -> Feature:
    """Make a feature from its class, arguments and knobs."""
    feature = _made(data, Feature, arrays, given)
    set_knobs(feature, {name: decode(value, arrays) for name, value in data["knobs"].items()})
    return feature


def _particles(scene: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> Particles:
    p = {name: decode(value, arrays) for name, value in scene["particles"].items()}
    return Particles(p.pop("position"), **p)


def rebuild(
    scene: dict[str, Any], arrays: Mapping[str, np.ndarray], given: Mapping[str, Any], knob_values: list[KnobValues],
    once: list[list[str]],
) -> "World":  # fmt: skip
    """Make a world from a scene and the knobs set since.

    knob_values: numbers of features, and their knobs. once: for each feature, the names in `compiled_for` that its kernels had,
    even if the present knobs no longer need them.
    """
    from ..world import World

    missing = sorted(set(scene["needs"]) - set(given))
    if missing:
        raise ValueError(
            f"replay: the scene uses {', '.join(missing)}, which the recording keeps only to be read. Give "
            f"{'it' if len(missing) == 1 else 'them'} again: tv.replay(path, given=[{', '.join(missing)}]). As recorded:\n\n"
            + "\n".join(plain(scene["needs"][name]) for name in missing)
        )
    for name, text in scene["needs"].items():
        if text and source(given[name]) not in ("", text):
            checks.warn(f"replay: {name} reads otherwise than when it was recorded; the bits may differ.")

    particles = _particles(scene, arrays)
    starts = [particles.placed(decode(data["start"], arrays)) if "start" in data else None for data in scene["features"]]
    features = [_feature(data, arrays, given) for data in scene["features"]]
    for k, values in knob_values:
        set_knobs(features[k], values)
    for feature, names in zip(features, once, strict=True):
        if not {*names} <= {*feature.compiled_for}:
            raise ValueError(f"replay: kernels of {feature!r} cannot have {names}.")
        feature.compiled_so_far = frozenset(names)
    settings = dict(scene["settings"])
    settings["solver"] = _made(settings["solver"], Solver, arrays, given)
    return World._from_starts(particles, tuple(features), starts, **settings)
